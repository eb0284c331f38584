"""Configuration files: YAML or JSON whose keys are the names of flags, and the record of a run."""

import difflib
import json
import re
import stat
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from warpir.app.config import DEFAULTS, DOTTED, as_usage, usage
from warpir.app.record import RUN_FORMAT
from warpir.core.errors import LISTED, SHOWN, raise_all, shown
from warpir.core.limits import Limits
from warpir.core.strict_json import read_json_object

YAML_SHARE = 256
"""YAML takes this many times as long to read as JSON, so it may be as much shorter."""

YAML = "tag:yaml.org,2002:"
"""Begins the tags of YAML's own types."""

ELSEWHERE = {
    "azimuth": "sun", "background": "photo", "cpu": "device", "elevation": "sun",
    "envmap": "light", "gpu": "device", "hdri": "light", "height": "camera-height",
    "image": "photo", "input": "photo", "mask": "occluder-mask", "mesh": "asset",
    "object": "asset", "output": "out", "position": "at", "resolution": "width",
    "rotate": "rotate-y", "rotation": "rotate-y", "spp": "samples", "turn": "rotate-y",
    "yaw": "rotate-y",
}  # fmt: skip
"""Our flags, by what other programs call them."""
ALIKE = 0.7
"""From which likeness a name may be meant: at difflib's 0.6, --quiet was taken for --out."""


def read_config_file(path: str, limits: Limits) -> dict[str, Any]:
    """Read the keys of a configuration file or the ``config`` of a ``run.json``.

    Relative paths in it mean what they mean at the command line: they start at the working
    directory.

    Raises:
        InputError: The file cannot be read or holds an unknown key (`ExitCode.USAGE`).
    """
    content = _load(path, limits)
    if not isinstance(content, dict):
        raise usage(path, f"keys and values expected (found {kind_of(content)})")
    if isinstance(content.get("config"), dict):
        found = content.get("format")
        if isinstance(found, bool) or not isinstance(found, int) or not 1 <= found <= RUN_FORMAT:
            raise usage(
                path,
                f"run.json of unknown format (found {kind_of(found)}; expected 1 to {RUN_FORMAT})",
                "use the warpir version that wrote it",
            )
        content = content["config"]
    return by_name(path, content)


def by_name(where: str, content: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the values of a file by their names, written with ``-`` or ``_``, or as part.field.

    Raises:
        InputError: Keys are unknown, with advice for the first, or mean the same
            (`ExitCode.USAGE`).
    """
    names = {key: str(key).replace("-", "_") for key in content}
    names = {key: DOTTED.get(name, name) for key, name in names.items()}
    unknown = [key for key, name in names.items() if name not in DEFAULTS]
    problems = [usage(where, f"unknown key {shown(str(key))}") for key in unknown[:LISTED]]
    if problems:
        problems[0].advice = closest(names[unknown[0]], list(DEFAULTS))
    if len(unknown) > LISTED:
        problems.append(usage(where, f"{len(unknown) - LISTED} more unknown keys"))
    raise_all(problems)
    if len(set(names.values())) < len(content):
        raise usage(where, "a key is given twice, in two spellings")
    return {names[key]: value for key, value in content.items()}


def _load(path: str, limits: Limits) -> Any:
    """Parse a file into plain values: JSON by its extension, anything else as YAML."""
    if Path(path).suffix.lower() == ".json":
        with as_usage():
            return read_json_object(path, limits)
    import yaml

    try:
        loader = _yaml_loader(path, limits)(_read_text(path, limits))
        try:
            node = loader.get_single_node()
            _refuse_double_keys(path, node)
            return loader.construct_document(node) if node is not None else {}
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f"line {mark.line + 1}: " if mark is not None else ""
        raise usage(path, f"{line}not YAML ({error.problem})") from None
    except (LookupError, AttributeError):  # of !!bool maybe, !!float "", !!timestamp x
        raise usage(path, "not usable YAML (a value is not what its tag says)") from None
    except (yaml.YAMLError, ValueError, TypeError) as error:
        reason = "".join(str(error).splitlines()[:1])[:120]
        raise usage(path, f"not usable YAML ({reason})") from None


def _yaml_loader(path: str, limits: Limits) -> Callable[[str], Any]:
    """Return PyYAML's safe loader without what a configuration does not need."""
    import yaml

    class Loader(yaml.SafeLoader):
        level = 0

        def compose_sequence_node(self, anchor: Any) -> Any:
            return self.deeper(super().compose_sequence_node, anchor)

        def compose_mapping_node(self, anchor: Any) -> Any:
            return self.deeper(super().compose_mapping_node, anchor)

        def compose_scalar_node(self, anchor: Any) -> Any:
            node = super().compose_scalar_node(anchor)
            # YAML 1.1 reads 0640 as 416, 1:30 as 90 and 0x10 as 16; a flag does not.
            is_int = node.tag == f"{YAML}int"
            if (is_int and not re.fullmatch("[-+]?(0|[1-9][0-9_]*)", node.value)) or (
                node.tag == f"{YAML}float" and ":" in node.value
            ):
                line = f"line {node.start_mark.line + 1}: "
                what = f"{line}{shown(node.value)} is no decimal number without leading zeros"
                raise usage(path, what, "quote a text")
            return node

        def deeper(self, compose: Callable[[Any], Any], anchor: Any) -> Any:
            self.level += 1
            with as_usage():
                limits.check("nesting", self.level, path, "nested too deeply", more=" levels")
            node = compose(anchor)
            self.level -= 1
            return node

        def flatten_mapping(self, node: Any) -> None:
            # Merges of merges grow without end, in a few lines; no configuration needs one.
            if any(key.tag == f"{YAML}merge" for key, _ in node.value):
                raise usage(path, f"line {node.start_mark.line + 1}: merge keys (<<) are not read")

    return Loader


def _read_text(path: str, limits: Limits) -> str:
    try:
        status = Path(path).stat()
        if not stat.S_ISREG(status.st_mode):
            raise usage(path, "not a regular file")
        limit = replace(limits, json_bytes=limits.json_bytes // YAML_SHARE)
        with as_usage():
            limit.check("json_bytes", status.st_size, path, "too large for YAML", more=" bytes")
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise usage(path, "not UTF-8 text") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a file name"
        raise usage(path, f"cannot be read ({reason})") from None


def _refuse_double_keys(path: str, node: Any) -> None:
    """Refuse a key given twice, of which PyYAML would silently keep the last."""
    seen: set[str] = set()
    for key, _ in node.value if node is not None and node.id == "mapping" else ():
        line = f"line {key.start_mark.line + 1}: "
        if key.id != "scalar":  # its text may be 10^9 entries, by aliases
            raise usage(path, f"{line}unknown key (found a {key.id})")
        if key.value in seen:
            raise usage(path, f"{line}key {shown(key.value)} twice")
        seen.add(key.value)


def kind_of(value: Any) -> str:
    """Return in a few words what a file holds in place of what is expected."""
    if value is None or isinstance(value, bool | int | float):
        return json.dumps(value)[:60]
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "a mapping" if isinstance(value, dict) else "another kind"


def closest(name: str, names: Sequence[str]) -> str:
    """Return advice for a name that is none of ``names``: flags, or keys of a file."""
    bare = {other.lstrip("-").replace("_", "-"): other for other in names}
    asked = name[:SHOWN].lstrip("-").replace("_", "-").lower()
    meant = ELSEWHERE.get(asked)
    close = [meant] if meant in bare else difflib.get_close_matches(asked, bare, 1, ALIKE)
    return f"did you mean {bare[close[0]]}?" if close else "see --help"
