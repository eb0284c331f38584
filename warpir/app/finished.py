"""Whether an output folder already holds the result of a configuration: then nothing is to be done.

A result is that of a configuration if its ``run.json`` was asked for the same and every file that
it read has the same sha256 now. What it wrote must be there as it wrote it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from warpir.app.command import read_values
from warpir.app.config import DEFAULTS, InsertConfig
from warpir.app.model_files import model_hashes
from warpir.app.record import file_hash, input_files
from warpir.app.reuse import check_files, run_record
from warpir.core.errors import ExitCode, InputError
from warpir.io.unfinished import results_in


class OtherRun(InputError):
    """A folder holds a whole result, but of other settings or other files."""


def is_done(config: InsertConfig, filled: InsertConfig | None = None) -> bool:
    """Return whether the folder of a configuration holds its result.

    ``filled`` is the same with the demo's files, where those are asked for. With ``overwrite``
    nothing is done.

    Raises:
        OtherRun: It holds the whole result of another one.
        InputError: It holds something else.
    """
    out = config.output.folder
    if out.is_symlink():
        raise _something_else(out, "a link")
    if config.output.overwrite or not out.is_dir():
        return False
    if not (out / "run.json").exists():
        if results_in(out):
            raise _something_else(out, "no finished run")
        return False
    try:
        record = run_record(out, config.limits)
        check_files(out, record["files"])
        same = _same(config, filled or config, record)
    except InputError as error:
        raise _something_else(out, f"{error.where}: {error.what}") from error
    if not same:
        raise _something_else(out, "a run of other settings or other files", OtherRun)
    return True


def config_of_record(values: dict[str, Any]) -> InsertConfig:
    """Return the configuration whose fields are plain values, as ``run.json`` has them.

    Raises:
        InputError: A value is none of its field's.
    """
    return InsertConfig(**read_values(values, str))


def _same(config: InsertConfig, filled: InsertConfig, record: dict[str, Any]) -> bool:
    """Return whether a run was asked for the same and read the same files."""
    made = {name: value for name, value in record["config"].items() if name in DEFAULTS}
    if len(made) < len(record["config"]):
        return False
    # Elsewhere, or by as many threads as there are, it is the same picture.
    of_the_run = {name: config.flat()[name] for name in ("out", "overwrite", "resume", "threads")}
    read = record.get("inputs")
    if config_of_record(made).changed(**of_the_run) != config or not isinstance(read, dict):
        return False
    config = filled  # from here on, what names the files
    paths = input_files(config)
    for name in read:
        field, _, file = name.partition("/")
        if name not in paths and field in ("asset", "proxy") and (path := config.flat()[field]):
            paths[name] = Path(path).parent.resolve() / file if file else Path(path)
    if config.light.reuse is not None:
        paths["reuse"] = Path(config.light.reuse, "run.json")
    hashes = {name: file_hash(path) for name, path in paths.items()}
    return read == hashes and _same_model(config, record)


def _same_model(config: InsertConfig, record: Mapping[str, Any]) -> bool:
    """Return whether Stable Diffusion's files are those that guided a run.

    Other priors are among the inputs, or part of the package.
    """
    measured = record.get("measured")
    guide = measured.get("model") if isinstance(measured, dict) else None
    if not isinstance(guide, dict) or guide.get("name") != "stable-diffusion":
        return True
    return bool(guide.get("sha256") == model_hashes(config.diffusion))


def _something_else(out: Path, found: str, kind: type[InputError] = InputError) -> InputError:
    return kind(
        out,
        f"holds something other than what is asked for (found {found})",
        "pass --overwrite to replace results",
        ExitCode.OUTPUT,
    )
