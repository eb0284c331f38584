"""Whether a run has the models that it asks for, by their files: torch is not loaded for it."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from warpir.config import InsertConfig
from warpir.diffusion.model_error import ModelError
from warpir.errors import ExitCode, InputError, raise_all

Checked = TypeVar("Checked")


def require_model(config: InsertConfig) -> None:
    """Check what the run reads beside its inputs: the model's folder, or the weights that we ship.

    Configurations, and headers of weights: their names, shapes and lengths. A model that is to be
    downloaded is not looked for.

    Raises:
        InputError: Something is not there, or not what it should be (`ExitCode.MODEL`); the other
            problems are in its ``also``.
    """
    from warpir.diffusion.weight_files import check_lora, check_prior, check_regressor

    problems: list[InputError] = []

    def attempt(check: Callable[[], Checked]) -> Checked | None:
        try:
            return check()
        except ModelError as error:
            problems.append(InputError(error.where, error.what, error.advice, ExitCode.MODEL))
            return None

    lora, prior, regressor = (_path(f) for f in (config.lora, config.prior, config.regressor))
    is_told = config.is_light_described or config.reuse is not None
    embedding_width: int | None = None
    if config.guided_by == "stable-diffusion":
        embedding_width = attempt(lambda: _model_width(config))
    if prior is not None or (config.guided_by == "embedded" and config.is_guided):
        embedding_width = attempt(lambda: check_prior(prior))
    if lora is not None:
        attempt(lambda: check_lora(lora, embedding_width))
    if regressor is not None or (config.start != "uniform" and not is_told):
        attempt(lambda: check_regressor(regressor))
    raise_all(problems)


def _model_width(config: InsertConfig) -> int | None:
    """Check the folder of Stable Diffusion; return the width of its prompts' embeddings."""
    from warpir.diffusion.model_folder import check_model_folder, find_model

    if config.allow_download and not os.path.isdir(config.model or ""):
        return None
    found = find_model(config.model, allow_download=False)
    folder = check_model_folder(found, config.allow_pickle)
    width: int = folder.configs["unet"]["cross_attention_dim"]
    return width


def _path(name: str | None) -> Path | None:
    return None if name is None else Path(name)
