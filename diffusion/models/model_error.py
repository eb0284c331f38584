"""The one error of models, apart from torch: folders and files are checked before it is loaded."""

from pathlib import Path

from warpir.core.errors import ExitCode, InputError


class ModelError(InputError):
    """A model folder or LoRA file cannot be used; the program prints one line and exits with 4."""

    def __init__(self, where: str | Path, what: str, advice: str = "") -> None:
        super().__init__(where, what, advice, ExitCode.MODEL)
