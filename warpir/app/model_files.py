"""Whether a run has the models that it asks for, by their files: torch is not loaded for it."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from warpir.app.config import InsertConfig
from warpir.core.errors import InputError, raise_all
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.settings import ModelSettings

if TYPE_CHECKING:
    from warpir.diffusion.models.model_folder import ModelFolder

Checked = TypeVar("Checked")


def require_model(config: InsertConfig) -> None:
    """Check what the run reads beside its inputs: the model's folder, or the weights that we ship.

    Configurations, and headers of weights: their names, shapes and lengths. A model that is to be
    downloaded is not looked for.

    Raises:
        InputError: Something is not there, or not what it should be (`ExitCode.MODEL`); the other
            problems are in its ``also``.
    """
    from warpir.diffusion.models.weight_files import check_lora, check_regressor

    problems: list[InputError] = []

    def attempt(check: Callable[[], Checked]) -> Checked | None:
        try:
            return check()
        except ModelError as error:
            problems.append(error)
            return None

    lora = None if config.adapter.lora is None else Path(config.adapter.lora)
    regressor = None if config.light.regressor is None else Path(config.light.regressor)
    is_told = config.light.is_described or config.light.reuse is not None
    embedding_width: int | None = None
    if config.is_guided:
        embedding_width = attempt(lambda: _model_width(config.diffusion))
    if lora is not None:
        attempt(lambda: check_lora(lora, embedding_width))
    if regressor is not None or (config.light.start != "uniform" and not is_told):
        attempt(lambda: check_regressor(regressor))
    raise_all(problems)


def _model_width(asked: ModelSettings) -> int | None:
    """Check the folder of Stable Diffusion; return the width of its prompts' embeddings."""
    if asked.allow_download and not os.path.isdir(asked.model or ""):
        return None
    width: int = _checked_folder(asked).configs["unet"]["cross_attention_dim"]
    return width


def _checked_folder(asked: ModelSettings) -> "ModelFolder":
    from warpir.diffusion.models.hub import find_model
    from warpir.diffusion.models.model_folder import check_model_folder

    found = find_model(asked.model, allow_download=False, allow_pickle=asked.allow_pickle)
    return check_model_folder(found, asked.allow_pickle)


def model_hashes(asked: ModelSettings) -> dict[str, str] | None:
    """Return the sha256 of every file of Stable Diffusion's that a run would read, by its name.

    None: there is no such model now, or it is damaged.
    """
    try:
        folder = _checked_folder(asked)
        states = [(file, file.stat()) for file in folder.files]
        return dict(
            _hash(folder, file, (state.st_ino, state.st_size, state.st_mtime_ns))
            for file, state in states
        )
    except (ModelError, OSError):
        return None


_hashes: dict[tuple[object, ...], tuple[str, str]] = {}


def _hash(folder: "ModelFolder", file: Path, state: tuple[int, ...]) -> tuple[str, str]:
    """Return a file's name and sha256; a batch asks again for gigabytes that stay as they are."""
    if (file, state) not in _hashes:
        _hashes[file, state] = folder.file_hash(file)
    return _hashes[file, state]
