"""Where a Stable Diffusion is: a folder, or a repository of the hub, of which little is fetched."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.model_folder import (
    ADVICE,
    CONFIGS,
    WEIGHTS,
    choose_weights,
    missing_files,
)

HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
WITHDRAWN = "the original Stable Diffusion 2 repositories were withdrawn in November 2025"


@contextmanager
def hub_offline(offline: bool) -> Iterator[None]:
    """Within this context the hub's libraries refuse every request, if ``offline``."""
    from huggingface_hub import constants

    # The variable of the same name is read when they are imported, which was long ago.
    before = constants.HF_HUB_OFFLINE
    constants.HF_HUB_OFFLINE = before or offline
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = before


def find_model(model: str | None, allow_download: bool, allow_pickle: bool = False) -> Path:
    """Return the folder of a model: itself, or a hub id's, ``owner/name``, in the local cache.

    With ``allow_download`` a hub id that is not in the cache is fetched, only the files that are
    read; with ``allow_pickle`` weights are among them where a part has no other.

    Raises:
        ModelError: It is not there, or could not be downloaded.
    """
    if not model:
        raise ModelError("--model", f"no Stable Diffusion was named; {WITHDRAWN}", ADVICE)
    folder = Path(model).expanduser()
    # Of os.path: pathlib raises where a name is longer than a file's can be.
    if os.path.isdir(folder):
        return folder
    if os.path.exists(folder):
        raise ModelError(model, "is a file (expected a folder in diffusers' layout)", ADVICE)
    if not HUB_ID.fullmatch(model):
        raise ModelError(model, f"no such folder; {WITHDRAWN}", ADVICE)

    from huggingface_hub import snapshot_download

    try:
        cached = Path(snapshot_download(model, local_files_only=True))
    except (OSError, ValueError) as error:
        if not allow_download or model.startswith("stabilityai/stable-diffusion-2"):
            what = f"neither a folder nor in this machine's cache of the hub; {WITHDRAWN}"
            raise ModelError(model, what, ADVICE) from error
        return _download(model, allow_pickle)
    # A download that was stopped leaves a part of it.
    is_whole = not missing_files(cached, allow_pickle)
    return _download(model, allow_pickle) if allow_download and not is_whole else cached


def _download(model: str, allow_pickle: bool) -> Path:
    """Fetch what is read of a hub repository, and nothing else."""
    from huggingface_hub import HfApi, snapshot_download

    try:
        names = HfApi().list_repo_files(model)
        return Path(snapshot_download(model, allow_patterns=needed_files(names, allow_pickle)))
    except Exception as error:  # the hub's own, those of its HTTP client, and the system's
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        what = f"could not be downloaded ({type(error).__name__}); {WITHDRAWN}"
        raise ModelError(model, what, ADVICE) from error


def needed_files(names: Collection[str], allow_pickle: bool = False) -> list[str]:
    """Return which files of a repository are read, each part's weights in one variant only."""
    needed = {"model_index.json"}
    needed |= {f"{part}/{name}" for part, name in CONFIGS.items()}
    needed |= {n for n in names if n.startswith("tokenizer/") and n.endswith((".json", ".txt"))}
    for part, stem in WEIGHTS.items():
        within = {n.removeprefix(f"{part}/") for n in names if n.startswith(f"{part}/")}
        chosen, variant = choose_weights(part, within, allow_pickle) or ("", None)
        needed.add(f"{part}/{chosen}")
        if chosen.endswith(".json"):
            stem += f".{variant}" if variant else ""
            shard = re.compile(re.escape(stem) + r"-\d+-of-\d+\.safetensors")
            needed |= {f"{part}/{n}" for n in within if shard.fullmatch(n)}
    return sorted(needed & set(names))
