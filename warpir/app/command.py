"""The command line and configuration files: both become one `InsertConfig`.

Flags are made from the fields of `InsertConfig`; their help is the line below each field. Values
from both sources pass through one conversion by the field's type, so that ``--place -1,0,-3``,
``place: [-1, 0, -3]`` and ``"place": "-1,0,-3"`` mean the same.
"""

import argparse
import ast
import difflib
import inspect
import json
import re
import stat
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn, Union, get_args, get_origin

import warpir
from warpir.app.config import (
    CPU_DEFAULTS,
    DEFAULTS,
    OPTIONS,
    PARTS,
    PRIOR_DEFAULTS,
    InsertConfig,
    flag,
    kinds,
    usage,
)
from warpir.app.record import RUN_FORMAT
from warpir.core.errors import LISTED, SHOWN, ExitCode, InputError, raise_all, shown
from warpir.core.limits import Limits
from warpir.core.strict_json import read_json_object
from warpir.diffusion.settings import GuidanceSettings

YAML_SHARE = 256
"""YAML takes this many times as long to read as JSON, so it may be as much shorter."""

YAML = "tag:yaml.org,2002:"
"""Begins the tags of YAML's own types."""

FLAGS = {
    "input and output": {
        "photo": "FILE",
        "layer": "NAME",
        "occluder_mask": "FILE",
        "asset": "FILE",
        "materials": "FILE",
        "out": "DIR",
        "overwrite": "",
        "demo": "",
    },
    "camera and ground": {
        "camera": "FILE|DIR",
        "frame": "NAME",
        "undistort": "",
        "fov": "DEG",
        "pitch": "DEG",
        "horizon": "ROW",
        "camera_height": "M",
        "up": "AXIS",
        "ground": "A,B,C,D",
        "ground_points": "FILE|DIR",
        "proxy": "FILE",
        "plane": "",
        "shadow_mask": "FILE",
    },
    "placement": {
        "place": "X,Y,Z",
        "at": "U,V",
        "rotate_y": "DEG",
        "scale": "S",
        "size": "METRES",
        "asset_up": "AXIS",
    },
    "light": {
        "light": "FILE",
        "light_convention": "NAME",
        "light_rotate": "DEG",
        "fit_lobes": "N",
        "sun": "AZIMUTH,ELEVATION[,STRENGTH]",
        "sky": "NAME|R,G,B",
        "exposure": "EV",
        "tone": "NAME",
        "ground_albedo": "SHARE",
        "detail": "",
    },
    "rendering": {
        "samples": "N",
        "rays": "N",
        "depth": "D",
        "indirect_limit": "RADIANCE",
        "width": "W",
        "device": "NAME",
        "threads": "N",
        "seed": "N",
        "deterministic": "",
    },
    "guidance": {
        "guidance": "NAME",
        "prompt": "TEXT",
        "prior": "FILE",
        "regressor": "FILE",
        "start": "NAME",
        "accept": "",
        "show_prior": "TEXT|TEXT",
        "loss": "NAME",
        "null_background": "RULE",
        "guidance_scale": "G",
        "negative_prompt": "TEXT",
        "base_prompt": "TEXT",
        "null_prompt": "TEXT",
        "time_min": "SHARE",
        "time_max": "SHARE",
        "time_max_end": "SHARE",
        "weight": "NAME",
        "literal_alpha": "",
        "noises": "N",
        "crop_min": "SIDES",
        "crop_max": "SIDES",
        "gradient_clip": "MEDIANS",
        "update_every": "N",
        "update_steps": "N",
        "update_scale": "G",
    },
    "diffusion model": {
        "model": "DIR|ID",
        "allow_download": "",
        "allow_pickle": "",
        "precision": "NAME",
        "vae_precision": "NAME",
        "vae_checkpointing": "",
        "graphs": "",
    },
    "personalisation": {
        "personalize": "",
        "token": "WORD",
        "class_noun": "WORD",
        "class_images": "N",
        "indoors": "",
        "class_steps": "N",
        "class_scale": "G",
        "class_batch": "N",
        "lora": "FILE",
        "lora_rank": "N",
        "lora_layers": "NAME,NAME",
        "lora_steps": "N",
        "lora_rate": "R",
        "lora_class_batch": "N",
        "lora_class_weight": "W",
        "lora_decay": "W",
        "lora_clip": "NORM",
        "lora_crop": "SHARE",
    },
    "optimisation": {
        "steps": "N",
        "guidance_width": "W",
        "lobes": "N",
        "lobe_width": "SPACINGS",
        "light_height": "ROWS",
        "object_light_height": "ROWS",
        "fusion": "NAME",
        "fusion_start": "SHARE",
        "fusion_end": "SHARE",
        "lobe_shape": "",
        "tone_curve": "",
        "integrator": "NAME",
        "transport_memory": "MIB",
        "mis_samples": "N",
        "retrace_at": "FACTOR",
        "rate": "FACTOR",
        "rate_end": "FACTOR",
        "rate_intensity": "R",
        "rate_axis": "R",
        "rate_width": "R",
        "rate_chroma": "R",
        "rate_tone": "R",
        "rate_material": "R",
        "rate_emission": "R",
        "adam_beta1": "B",
        "adam_beta2": "B",
        "consistency": "W",
        "spread": "W",
        "chroma": "W",
        "tone_bins": "N",
        "bend": "W",
        "trust": "W",
        "chroma_limit": "LOG",
        "intensity_limit": "FACTOR",
        "score_every": "N",
        "preview_every": "N",
        "checkpoint_every": "N",
        "resume": "",
    },
    "applications": {
        "reuse": "DIR",
        "sequence": "FILE",
        "fps": "N",
        "refine": "WHAT",
        "refine_parts": "NAME,NAME",
        "refine_materials": "NAME,NAME",
    },
    "rules for the files": {
        "alpha": "RULE",
        "max_pixels": "N",
        "strict": "",
        "max_envmap_width": "PX",
        "max_file_bytes": "BYTES",
        "max_triangles": "N",
        "max_texture_pixels": "N",
        "max_nodes": "N",
        "max_instances": "N",
        "max_points": "N",
        "max_json_bytes": "BYTES",
        "max_gltf_json_bytes": "BYTES",
        "max_json_values": "N",
        "max_nesting": "LEVELS",
        "max_prompt_bytes": "BYTES",
        "missing_textures": "RULE",
        "mark": "",
        "hand_off": "",
        "report": "",
        "mitsuba": "",
    },
}
"""Every field of `InsertConfig` by its heading in ``--help``, with what stands for its value."""
FORMS = {name: form for forms in FLAGS.values() for name, form in forms.items()}
"""The forms of all flags by their fields."""
BY_HAND = ("allow_download", "allow_pickle")
"""What a file cannot switch on, since files come from others: it opens the network, or runs code.
"""
SEPARATORS = {"show_prior": "|"}
"""What parts the texts of a list, where they may hold commas."""

USAGE = "python -m warpir.insert --photo FILE --asset FILE --out DIR [FLAG ...]"
DESCRIPTION = "Put a 3D object into a photograph so that it looks as if it had stood there."
EXAMPLES = """\
examples:
  python -m warpir.insert --demo --out out/demo
  python -m warpir.insert --photo street.jpg --asset car.glb --light street.hdr \\
      --fov 60 --pitch -8 --camera-height 1.6 --at 640,610 --size 4.2 --out out/street
"""


@dataclass(frozen=True)
class Command:
    """A parsed command line."""

    config: InsertConfig
    validate: bool = False
    """Stop after all inputs were read and checked."""
    notices: tuple[str, ...] = ()
    """Where a flag replaced a value of the configuration file, one line each."""


def flags_of(*names: str) -> dict[str, str]:
    """Return some of an insertion's flags, for a program that takes these alone."""
    return {name: FORMS[name] for name in names}


def parse(argv: Sequence[str]) -> Command:
    """Read a command line, and the configuration file it names.

    ``--help`` and ``--version`` print and raise `SystemExit`.

    Raises:
        InputError: The command line or the configuration file is wrong (`ExitCode.USAGE`).
    """
    texts = read_arguments(_make_parser(), argv)
    validate, path = texts.pop("validate", False), texts.pop("config", None)
    filed: dict[str, Any] = {}
    if path is not None:
        filed = _read_config_file(path, _limits_for_config(texts))
        raise_all([_not_by_hand(path, n) for n in BY_HAND if filed.get(n) and n not in texts])
    config = _make_config({name: (text, flag(name)) for name, text in texts.items()}, filed)
    notices = tuple(
        f"{flag(name)} given at the command line replaces the value in {path}"
        for name in texts
        if name in filed
    )
    config.require_inputs()
    return Command(config, validate, notices)


def _not_by_hand(path: str, name: str) -> InputError:
    what = f"{name} is set, which counts at the command line alone"
    return usage(path, what, f"give {flag(name)} there if you want it")


def _limits_for_config(texts: Mapping[str, Any]) -> Limits:
    """Return the limits of the configuration file itself, which flags alone can set."""
    names = ("max_json_bytes", "max_json_values", "max_nesting")
    values = read_values({name: (texts[name], flag(name)) for name in names if name in texts})
    return InsertConfig(**values).limits


def _make_config(given: Mapping[str, tuple[Any, str]], filed: Mapping[str, Any]) -> InsertConfig:
    """Convert each value by its field's type; ``given`` wins over ``filed``."""
    return InsertConfig(**read_values({**{n: (v, flag(n)) for n, v in filed.items()}, **given}))


def read_values(given: Mapping[str, tuple[Any, str]]) -> dict[str, Any]:
    """Convert flags' texts or a file's plain values by the types of their fields.

    Args:
        given: By the field's name, the value and where it stands.

    Raises:
        InputError: A value cannot be read as its field's type (`ExitCode.USAGE`).
    """
    hints = kinds()
    values, problems = {}, []
    for name, (value, where) in given.items():
        try:
            values[name] = _convert(value, hints[name], SEPARATORS.get(name, ","))
        except ValueError:
            expected = _expected(name, hints[name])
            problems.append(usage(where, f"expected {expected} (found {_shown(value)})"))
    raise_all(problems)
    return values


def _convert(value: Any, hint: Any, separator: str = ",") -> Any:
    """Turn a flag's text or a file's value into the field's type.

    Raises:
        ValueError: It cannot be read as that type.
    """
    if get_origin(hint) in (Union, types.UnionType):
        if value is None and type(None) in get_args(hint):
            return None
        # The narrow forms come first: any text would pass as str.
        arms = sorted((arm for arm in get_args(hint) if arm is not type(None)), key=_width)
        for arm in arms:
            try:
                return _convert(value, arm, separator)
            except ValueError:
                continue
        raise ValueError
    if get_origin(hint) is tuple:
        parts = value.split(separator) if isinstance(value, str) else value
        kinds = get_args(hint)
        if not isinstance(parts, list | tuple):
            raise ValueError
        if kinds[-1] is Ellipsis:
            return tuple(_convert(part, kinds[0]).strip() for part in parts)
        if len(parts) != len(kinds):
            raise ValueError
        return tuple(_convert(part, kind) for part, kind in zip(parts, kinds, strict=True))
    if isinstance(value, bool) or hint is bool:
        if isinstance(value, bool) and hint is bool:
            return value
        raise ValueError
    if hint is str:
        if isinstance(value, str):
            return value
        raise ValueError
    if not isinstance(value, str | int | float) or (hint is int and isinstance(value, float)):
        raise ValueError
    if isinstance(value, str) and "_" in value:
        raise ValueError  # Python would read 1_0 as 10
    try:
        return hint(value)
    except OverflowError:
        raise ValueError from None


def _width(hint: Any) -> int:
    return 1 if hint is str else 0


def _expected(name: str, hint: Any) -> str:
    kinds = {int: "a whole number", float: "a number", bool: "true or false"}
    arms = [arm for arm in (get_args(hint) or (hint,)) if arm is not type(None)]
    if len(arms) == 1 and arms[0] in kinds:
        return kinds[arms[0]]
    return FORMS[name]


def _shown(value: Any) -> str:
    # Not repr(): a YAML file of aliases can hold 10^9 entries in a few lines.
    return shown(value) if isinstance(value, str) else _kind(value)


def _kind(value: Any) -> str:
    if value is None or isinstance(value, bool | int | float):
        return json.dumps(value)[:60]
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "a mapping" if isinstance(value, dict) else "another kind"


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ours: one line, not a page of usage."""

    def error(self, message: str) -> NoReturn:
        """Refuse a command line.

        Raises:
            InputError: Always (`ExitCode.USAGE`).
        """
        raise usage("command line", message)


def _make_parser() -> argparse.ArgumentParser:
    parser = make_parser("insert", USAGE, DESCRIPTION, EXAMPLES, FLAGS)
    group = parser.add_argument_group("the run itself")
    group.add_argument(
        "--config",
        metavar="FILE",
        help="YAML or JSON with these flags' names as keys, or a run.json",
    )
    group.add_argument(
        "--validate", action="store_true", help="Read and check all inputs, render nothing"
    )
    return parser


def make_parser(
    program: str,
    usage_line: str,
    description: str,
    epilog: str,
    flags: Mapping[str, Mapping[str, str]],
) -> argparse.ArgumentParser:
    """Return a parser of some fields of `InsertConfig`, all of whose values stay texts.

    Args:
        program: Name of the module.
        usage_line: How it is called.
        description: What it does.
        epilog: What follows the flags.
        flags: As `FLAGS`.
    """
    parser = Parser(
        prog=f"python -m warpir.{program}",
        usage=usage_line,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
        allow_abbrev=False,
        exit_on_error=False,
    )
    about = _field_docs()
    for heading, forms in flags.items():
        group = parser.add_argument_group(heading)
        for name, form in forms.items():
            text = _help_of(name, about[name]).replace("%", "%%")
            if form:
                group.add_argument(flag(name), dest=name, metavar=form, help=text)
            elif DEFAULTS[name] is None:
                either = argparse.BooleanOptionalAction
                group.add_argument(flag(name), dest=name, action=either, help=text)
            else:
                action = "store_false" if DEFAULTS[name] else "store_true"
                group.add_argument(flag(name), dest=name, action=action, help=text)
    parser.add_argument("--debug", action="store_true", help="Show tracebacks")
    parser.add_argument("--version", action="version", version=f"warpir {warpir.__version__}")
    return parser


def read_arguments(parser: argparse.ArgumentParser, argv: Sequence[str]) -> dict[str, Any]:
    """Return the flags that were given and their texts, by the names of their fields.

    Raises:
        InputError: A flag is unknown or lacks its value (`ExitCode.USAGE`).
    """
    try:
        given, unknown = parser.parse_known_args(_join_minus_values(argv))
    except argparse.ArgumentError as error:
        raise usage(error.argument_name or "command line", error.message) from None
    if unknown:
        known = [text for action in parser._actions for text in action.option_strings]
        raise usage(unknown[0], "no such flag", closest(unknown[0].split("=")[0], known))
    texts = vars(given)
    texts.pop("debug", None)
    return texts


def _help_of(name: str, about: str) -> str:
    default = DEFAULTS[name]
    if name in PRIOR_DEFAULTS["embedded"]:
        return f"{about} (default: {_by_prior(name)})"
    if default is True:
        return f"Leave out: {about[0].lower()}{about[1:]}"
    # An optional value says in its own words what happens without it.
    if default is None or default is False or default == "":
        return about
    shown = ",".join(default) if isinstance(default, tuple) else default
    return f"{about} (default: {shown})"


def _by_prior(name: str) -> str:
    """Return in words what an open field stands for."""
    names = {"embedded": "embedded", "stable-diffusion": "Stable Diffusion"}
    found = {}
    for prior, words in names.items():
        value = _words(PRIOR_DEFAULTS[prior][name])
        on_cpu = CPU_DEFAULTS[prior].get(name)
        found[words] = value if on_cpu is None else f"{value}, on the CPU {_words(on_cpu)}"
    if len(set(found.values())) == 1:
        return found["embedded"]
    return "; ".join(f"{words} {value}" for words, value in found.items())


def _words(value: object) -> str:
    return str(value) if not isinstance(value, bool) else "yes" if value else "no"


def _field_docs() -> dict[str, str]:
    """Read the line below each field of the parts and their base classes from their sources."""
    names = {(option.part, option.field.name): name for name, option in OPTIONS.items()}
    docs = {}
    # `GuidanceChoices` has its help at `GuidanceSettings`.
    sources = [(name, base) for name, part in PARTS.items() for base in part.__mro__[:-1]]
    for part, settings in (*sources, ("guidance", GuidanceSettings)):
        body = ast.parse(inspect.getsource(settings)).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                assert isinstance(field.target, ast.Name) and isinstance(below.value, ast.Constant)
                text = inspect.cleandoc(str(below.value.value)).replace("\n", " ")
                docs[names[part, field.target.id]] = text
    return docs


def _join_minus_values(argv: Sequence[str]) -> list[str]:
    """Write ``--place -1,0,-3`` as ``--place=-1,0,-3``.

    argparse takes ``-1,0,-3`` (and a file named ``-x.png``) for a flag of its own.
    """
    takes_value = {flag(name) for name, form in FORMS.items() if form}
    takes_value.add("--config")
    joined: list[str] = []
    for argument in argv:
        is_value = argument.startswith("-") and not argument.startswith("--") and argument != "-h"
        if is_value and joined and joined[-1] in takes_value:
            joined[-1] += "=" + argument
        else:
            joined.append(argument)
    return joined


def _read_config_file(path: str, limits: Limits) -> dict[str, Any]:
    """Read the keys of a configuration file or the ``config`` of a ``run.json``.

    Relative paths in it mean what they mean at the command line: they start at the working
    directory.

    Raises:
        InputError: The file cannot be read or holds an unknown key (`ExitCode.USAGE`).
    """
    content = _load(path, limits)
    if not isinstance(content, dict):
        raise usage(path, f"keys and values expected (found {_kind(content)})")
    if isinstance(content.get("config"), dict):
        found = content.get("format")
        if isinstance(found, bool) or not isinstance(found, int) or not 1 <= found <= RUN_FORMAT:
            raise usage(
                path,
                f"run.json of unknown format (found {_kind(found)}; expected 1 to {RUN_FORMAT})",
                "use the warpir version that wrote it",
            )
        content = content["config"]
    return by_name(path, content)


def by_name(where: str, content: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the values of a file by the names of their fields, written with ``-`` or ``_``.

    Raises:
        InputError: Keys are unknown, with advice for the first, or mean the same
            (`ExitCode.USAGE`).
    """
    given = {str(key).replace("-", "_"): value for key, value in content.items()}
    unknown = [str(key) for key in content if str(key).replace("-", "_") not in DEFAULTS]
    problems = [usage(where, f"unknown key {shown(key)}") for key in unknown[:LISTED]]
    if problems:
        problems[0].advice = closest(unknown[0].replace("-", "_"), list(DEFAULTS))
    if len(unknown) > LISTED:
        problems.append(usage(where, f"{len(unknown) - LISTED} more unknown keys"))
    raise_all(problems)
    if len(given) < len(content):
        raise usage(where, "a key is given twice, once with - and once with _")
    return given


def _load(path: str, limits: Limits) -> Any:
    """Parse a file into plain values: JSON by its extension, anything else as YAML."""
    if Path(path).suffix.lower() == ".json":
        try:
            return read_json_object(path, limits)
        except InputError as error:
            error.code = ExitCode.USAGE
            raise
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
            _within(limits, "nesting", self.level, path, "nested too deeply", " levels")
            node = compose(anchor)
            self.level -= 1
            return node

        def flatten_mapping(self, node: Any) -> None:
            # Merges of merges grow without end, in a few lines; no configuration needs one.
            if any(key.tag == f"{YAML}merge" for key, _ in node.value):
                raise usage(path, f"line {node.start_mark.line + 1}: merge keys (<<) are not read")

    try:
        loader = Loader(_read_text(path, limits))
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


def _within(limits: Limits, name: str, found: int, path: str, what: str, more: str) -> None:
    """As `Limits.check`, with the status of a wrong configuration."""
    try:
        limits.check(name, found, path, what, more=more)
    except InputError as error:
        error.code = ExitCode.USAGE
        raise


def _read_text(path: str, limits: Limits) -> str:
    try:
        status = Path(path).stat()
        if not stat.S_ISREG(status.st_mode):
            raise usage(path, "not a regular file")
        limit = replace(limits, json_bytes=limits.json_bytes // YAML_SHARE)
        _within(limit, "json_bytes", status.st_size, path, "too large for YAML", " bytes")
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


def closest(name: str, names: Sequence[str]) -> str:
    """Return advice for a name that is none of ``names``."""
    close = difflib.get_close_matches(name[:SHOWN], names, n=1)
    return f"did you mean {close[0]}?" if close else "see --help"
