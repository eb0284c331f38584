"""The command line: flags made from the fields of `InsertConfig`, and their help.

Texts of flags and values of a configuration file pass through one conversion by the field's type,
so that ``--place -1,0,-3``, ``place: [-1, 0, -3]`` and ``"place": "-1,0,-3"`` mean the same.
"""

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn, get_args

import warpir
from warpir.app.config import (
    DEFAULTS,
    DOTTED,
    OPTIONS,
    PARTS,
    InsertConfig,
    Option,
    flag,
    replaced_by,
    usage,
)
from warpir.app.config_file import closest, kind_of, read_config_file
from warpir.core.errors import InputError, raise_all, shown
from warpir.core.limits import Limits
from warpir.core.options import convert, help_of

FROM_HERE = ("photo", "asset", "camera", "light", "lamps", "occluder_mask", "proxy", "reuse")
"""What of a configuration file is looked for beside the command, for a notice where it is not."""
HEADINGS = {
    "inputs": "inputs",
    "camera": "camera and ground",
    "placement": "placement",
    "light": "light",
    "render": "rendering",
    "look": "look of the photo",
    "guidance": "guidance",
    "diffusion": "diffusion model",
    "adapter": "personalisation",
    "optimize": "optimisation",
    "task": "applications",
    "output": "output",
    "limits": "limits",
}
"""Headings in ``--help``, by the parts of `InsertConfig`."""
FLAGS = {
    heading: {name: option.rule.form for name, option in OPTIONS.items() if option.part == part}
    for part, heading in HEADINGS.items()
}
"""Every value by its heading, with what stands for it."""
FORMS = {name: option.rule.form for name, option in OPTIONS.items()}
"""What stands for each value; nothing for a switch."""
BY_HAND = tuple(name for name, option in OPTIONS.items() if option.rule.by_hand)
"""What a file cannot switch on, since files come from others: it opens the network, or runs code.
"""
SEPARATORS = {name: option.rule.separator for name, option in OPTIONS.items()}
"""What parts the texts of a list, where they may hold commas."""

SEVERAL = {
    "asset": "a run inserts one object; join them in one file, or insert one after the other",
    "lamp": "--lamps FILE lists several lamps",
}
"""What to do for several of what a flag names."""
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
    """Where a flag replaced or excluded a value of the configuration file, one line each."""


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
    values, notices = (texts, ()) if path is None else over_file(path, texts)
    config = InsertConfig(**read_values(values))
    config.require_inputs()
    return Command(config, validate, notices)


def over_file(path: str, texts: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a configuration file's values with those of flags in their place, and notices.

    Raises:
        InputError: The file cannot be used (`ExitCode.USAGE`).
    """
    filed = read_config_file(path, _limits_for_config(texts))
    raise_all([_not_by_hand(path, n) for n in BY_HAND if filed.get(n) and n not in texts])
    # Not a camera file, which says more than the one number that would take its place.
    excluded = replaced_by(texts, filed.keys() - {"camera"})
    notices = tuple(
        f"{flag(name)} given at the command line replaces the value in {path}"
        for name in texts
        if name in filed
    ) + tuple(
        f"{name} in {path} is left out: a flag given at the command line excludes it"
        for name in excluded
        if filed[name] != DEFAULTS[name]
    )
    for file in (filed[name] for name in FROM_HERE if name in filed.keys() - texts.keys()):
        if isinstance(file, str) and not os.path.isabs(file) and not os.path.exists(file):
            what = f"{file}, named in {path}, is not in the folder where the command runs"
            notices += (f"{what}, at which relative paths start",)
            break
    return {**filed, **excluded, **texts}, notices


def _not_by_hand(path: str, name: str) -> InputError:
    what = f"{name} is set, which counts at the command line alone"
    return usage(path, what, f"give {flag(name)} there if you want it")


def _limits_for_config(texts: Mapping[str, Any]) -> Limits:
    """Return the limits of the configuration file itself, which flags alone can set."""
    names = ("max_json_bytes", "max_json_values", "max_nesting")
    given = {name: texts[name] for name in names if name in texts}
    return InsertConfig(**read_values(given)).limits


def read_values(given: Mapping[str, Any], where: Callable[[str], str] = flag) -> dict[str, Any]:
    """Convert flags' texts or a file's plain values by the types of their fields.

    Args:
        given: Values by their fields' names.
        where: What a field is called in errors: by default its flag, for a file's keys ``str``.

    Raises:
        InputError: A value cannot be read as its field's type (`ExitCode.USAGE`).
    """
    values, problems = {}, []
    for name, value in given.items():
        option = OPTIONS[name]
        if value is False and "off" in option.rule.choices:
            value = "off"  # which YAML 1.1 reads as false
        try:
            values[name] = convert(value, option.kind, option.rule.separator)
        except ValueError:
            expected = _expected(option)
            problems.append(usage(where(name), f"expected {expected} (found {_shown(value)})"))
    raise_all(problems)
    return values


def _expected(option: Option) -> str:
    kinds = {int: "a whole number", float: "a number", bool: "true or false"}
    arms = [arm for arm in (get_args(option.kind) or (option.kind,)) if arm is not type(None)]
    if len(arms) == 1 and arms[0] in kinds:
        return kinds[arms[0]]
    return option.rule.form


def _shown(value: Any) -> str:
    # Not repr(): a YAML file of aliases can hold 10^9 entries in a few lines.
    return shown(value) if isinstance(value, str) else kind_of(value)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ours: one line, not a page of usage."""

    shows_all = False
    """Whether the help shows what is for experts too, and all that is known of each flag."""

    def error(self, message: str) -> NoReturn:
        """Refuse a command line.

        Raises:
            InputError: Always (`ExitCode.USAGE`).
        """
        raise usage("command line", message)

    def format_help(self) -> str:
        """Return the help; that of values without one is read from the sources of their fields."""
        about = field_docs()
        for action in self._actions:
            if action.dest in OPTIONS and action.help is None:
                is_shown = self.shows_all or not OPTIONS[action.dest].rule.expert
                text = _help_of(action.dest, about[action.dest], self.shows_all)
                action.help = text.replace("%", "%%") if is_shown else argparse.SUPPRESS
        return super().format_help()


class _Once(argparse.Action):
    """Keep the text of a flag of `SEVERAL`; the last one would count, without a word."""

    def __call__(
        self, _: argparse.ArgumentParser, given: argparse.Namespace, text: Any, *rest: Any
    ) -> None:
        if hasattr(given, self.dest):
            raise argparse.ArgumentError(self, f"given twice: {SEVERAL[self.dest]}")
        setattr(given, self.dest, text)


class _HelpAll(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        assert isinstance(parser, Parser)
        parser.shows_all = True
        parser.print_help()
        parser.exit()


def whole_number(least: int, most: int) -> Callable[[str], int]:
    """Return what reads an argument as a whole number of a range."""

    def read(text: str) -> int:
        is_number = text.isascii() and text.isdigit() and len(text) < 20
        if not (is_number and least <= int(text) <= most):
            expected = f"expected a whole number from {least} to {most}"
            raise argparse.ArgumentTypeError(f"{expected} (found {text[:40]})")
        return int(text)

    return read


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
    """Return a parser of the fields in ``flags``, as of `FLAGS`, whose values stay texts."""
    parser = Parser(
        prog=f"python -m warpir.{program}",
        usage=usage_line,
        description=description,
        epilog=epilog,
        formatter_class=partial(
            argparse.RawDescriptionHelpFormatter, max_help_position=30, width=100
        ),
        argument_default=argparse.SUPPRESS,
        allow_abbrev=False,
        exit_on_error=False,
    )
    for heading, forms in flags.items():
        group = parser.add_argument_group(heading)
        for name, form in forms.items():
            if form.startswith("["):
                group.add_argument(
                    flag(name), dest=name, nargs="?", const=True, metavar=form.strip("[]")
                )
            elif form:
                keep = _Once if name in SEVERAL else "store"
                group.add_argument(flag(name), dest=name, metavar=form, action=keep)
            else:
                action = "store_false" if DEFAULTS[name] else "store_true"
                group.add_argument(flag(name), dest=name, action=action)
    every = "Show every flag, and all that is known of each"
    parser.add_argument("--help-all", action=_HelpAll, nargs=0, help=every)
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
        advice = closest(unknown[0].split("=")[0], known)
        if not unknown[0].startswith("-"):
            advice = "each value follows its flag, in quotes where it has spaces"
        raise usage(unknown[0], "no such flag", advice)
    texts = vars(given)
    texts.pop("debug", None)
    return texts


def _help_of(name: str, about: str, is_whole: bool) -> str:
    default = DEFAULTS[name]
    about = about if is_whole else about.partition("; ")[0]
    if default is True:
        return f"Leave out: {about[0].lower()}{about[1:]}"
    # An optional value says in its own words what happens without it.
    if default is None or default is False or default == "":
        return about
    shown = ",".join(default) if isinstance(default, tuple) else default
    return f"{about} (default: {shown})"


def field_docs() -> dict[str, str]:
    """Return the help of every value, from the sources of the parts."""
    docs: dict[tuple[str, str], str] = {}
    sources = [(name, base) for name, part in PARTS.items() for base in part.__mro__[:-1]]
    for part, settings in sources:
        docs |= {(part, field): text for field, text in help_of(settings).items()}
    return {name: docs[option.part, option.field] for name, option in OPTIONS.items()}


def _join_minus_values(argv: Sequence[str]) -> list[str]:
    """Write ``--place -1,0,-3`` as ``--place=-1,0,-3``.

    argparse takes ``-1,0,-3`` (and a file named ``-x.png``) for a flag of its own.
    """
    takes_value = {flag(name) for name, form in FORMS.items() if form and form[0] != "["}
    takes_value.add("--config")
    joined: list[str] = []
    for argument in argv:
        is_value = argument.startswith("-") and not argument.startswith("--") and argument != "-h"
        if is_value and joined and joined[-1] in takes_value:
            joined[-1] += "=" + argument
        else:
            joined.append(_undotted(argument))
    return joined


def _undotted(argument: str) -> str:
    """Write ``--camera.height=2`` as ``--camera-height=2``; a switch has no dotted name."""
    name, *value = argument.split("=", 1)
    flat = DOTTED.get(name.removeprefix("--").replace("-", "_"), "")
    if not name.startswith("--") or not FORMS.get(flat):
        return argument
    return "=".join([flag(flat), *value])
