"""The one error of models, apart from torch: folders and files are checked before it is loaded."""

from pathlib import Path


class ModelError(Exception):
    """A model folder or LoRA file cannot be used; the program prints one line and exits with 4.

    Args:
        where: The folder, file or flag at fault.
        what: What is wrong, with what was found and what was expected.
        advice: What to do about it, or an empty string.
    """

    def __init__(self, where: str | Path, what: str, advice: str = "") -> None:
        super().__init__(f"{where}: {what}")
        self.where, self.what, self.advice = str(where), what, advice
