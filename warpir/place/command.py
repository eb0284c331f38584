"""Place an object in a photo by hand, in the browser.

    python -m warpir.place --photo street.jpg --asset car.glb --out placed/street

opens a page on this machine: the horizon, the ground and the object are dragged into place, and
Save writes ``camera.json`` and ``insert.json`` into --out, which ``python -m warpir.insert --config
placed/street/insert.json`` takes; with the same --config this program goes on. torch is loaded here
only for a camera that has to be estimated; the light is estimated in a process of its own.
"""

import os
import sys
import threading
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from warpir.app.command import flags_of, make_parser, over_file, read_arguments, read_values
from warpir.app.config import DEFAULTS, DEMO_HINT, InsertConfig, flag, usage
from warpir.app.program import run_program, say
from warpir.core.errors import ExitCode, raise_all
from warpir.core.signals import Stopped

USAGE = "python -m warpir.place --photo FILE --asset FILE [--out DIR] [FLAG ...]"
DESCRIPTION = "Place a 3D object in a photograph by hand, in the browser."
FLAGS = {
    "input and output": flags_of(
        "photo", "layer", "asset", "materials", "out", "overwrite", "demo"
    ),
    "where the page starts": flags_of(
        "camera", "frame", "fov", "pitch", "roll", "horizon", "camera_height", "camera_from", "up",
        "ground", "place", "at", "rotate_y", "scale", "size", "asset_up", "sun", "sky", "lamp",
        "lamps", "occluder_mask",
    ),
    "rules for the files": flags_of(
        "alpha", "max_pixels", "strict", "max_file_bytes", "max_triangles", "max_texture_pixels",
        "max_nodes", "max_instances", "max_json_bytes", "max_gltf_json_bytes", "max_json_values",
        "max_nesting", "missing_textures",
    ),
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`: 0 when ``--once`` ended it, 130 after Ctrl-C."""
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    parser = make_parser("place", USAGE, DESCRIPTION, "", FLAGS)
    group = parser.add_argument_group("the page")
    goes_on = "A saved insert.json to go on with; or a configuration or run.json of an insertion"
    group.add_argument("--config", metavar="FILE", help=goes_on)
    group.add_argument("--port", metavar="N", help="Port of 127.0.0.1 (default: any that is free)")
    group.add_argument("--no-browser", action="store_true", help="Only print the address")
    group.add_argument("--once", action="store_true", help="End after the placement was saved")
    texts = read_arguments(parser, arguments)
    port = _port(texts.pop("port", "0"))
    opens, once = not texts.pop("no_browser", False), texts.pop("once", False)
    path = texts.pop("config", None)
    values, unseen = (read_values(texts), {}) if path is None else _from_file(path, texts)
    config = _with_inputs(InsertConfig(**values))

    from warpir.io.lamps_file import given_lamps
    from warpir.place.answers import Answers
    from warpir.place.server import PlaceServer
    from warpir.place.session import PlacementFolder, open_session

    assert config.output.out is not None
    folder = PlacementFolder(config.output.out, config.output.overwrite)
    if path is not None:
        folder.take(path)
    folder.check()
    near = config.light.lamp, config.light.lamps
    lamps = given_lamps(*near, config.limits, lambda line: say(f"notice: {line}"))
    session = open_session(config.inputs, config.camera, config.placement, config.limits)
    session = replace(session, lamps=lamps)
    for line in session.assumed:
        say(f"assumed: {line}")
    with ExitStack() as until_end:
        answers = Answers(session, folder, config, unseen)
        until_end.callback(answers.close)
        wait = answers.renderings.wait if once else None
        server = PlaceServer(port, answers.contents, answers.posts, answers.file, once=wait)
        until_end.enter_context(server)
        say(f"page: {server.address}")
        answers.renderings.load()
        if not once:
            say("Ctrl-C ends it")
        if opens and _has_screen():
            try:
                way = until_end.enter_context(way_to(server.address)).as_uri()
                threading.Thread(target=webbrowser.open, args=(way,), daemon=True).start()
            except OSError as error:
                say(f"notice: open the page yourself ({error.filename}: {error.strerror})")
        try:
            server.serve_forever(poll_interval=0.1)
        except Stopped as stopped:
            with server.working:  # lets a save finish
                stopped.kept = (
                    f"the placement is in {config.output.out}" if folder.is_written else ""
                )
            raise
    return ExitCode.DONE


@contextmanager
def way_to(address: str) -> Iterator[Path]:
    """Yield a page that leads to an address, which only this user can read while it is there.

    Every user of the machine sees the arguments that a browser is started with: they may not hold
    the session's token.

    Raises:
        OSError: It cannot be written.
    """
    content = (
        '<!doctype html><meta charset="utf-8"><title>warpir.place</title>'
        f'<meta http-equiv="refresh" content="0; url={address}"><a href="{address}">Place</a>\n'
    )
    # Its folder is this user's alone, and so is the file should it be moved out of there.
    with TemporaryDirectory(prefix="warpir-place-", ignore_cleanup_errors=True) as folder:
        path = Path(folder, "place.html")
        path.touch(mode=0o600)
        path.write_text(content, encoding="utf-8")
        yield path


def _from_file(path: str, texts: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return values of a configuration under those of flags: the page's, and what it does not know.

    A placement that was saved goes on in its folder.

    Raises:
        InputError: The file cannot be used (`ExitCode.USAGE`).
    """
    from warpir.place.session import CONFIG

    merged, notices = over_file(path, texts)
    if "out" not in texts:
        merged.pop("out", None)
        if os.path.basename(path) == CONFIG:
            merged["out"] = os.path.dirname(os.path.abspath(path))
    values = {n: v for n, v in read_values(merged).items() if v != DEFAULTS[n]}
    unseen = {n: values.pop(n) for n in values.keys() - {n for f in FLAGS.values() for n in f}}
    for line in notices:
        say(f"notice: {line}")
    if unseen:
        named = ", ".join(sorted(unseen))
        say(f"notice: the page does not show what {path} says of {named}; a save keeps it")
    return values, unseen


def _with_inputs(config: InsertConfig) -> InsertConfig:
    """Return the configuration with the demo's files, and with a folder for what is saved.

    Raises:
        InputError: Photo or asset is not named (`ExitCode.USAGE`).
    """
    if config.inputs.demo:
        from warpir.demo import demo_config

        demo = demo_config(config)
        return demo.changed(
            light=None, exposure=None, out=config.output.out or os.path.join("placed", "demo")
        )
    missing = [name for name in ("photo", "asset") if config.flat()[name] is None]
    raise_all([usage(flag(name), "needed", DEMO_HINT) for name in missing])
    assert config.inputs.photo is not None
    return config.changed(
        out=config.output.out or os.path.join("placed", Path(config.inputs.photo).stem)
    )


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) < 65_536):
        raise usage("--port", f"expected a whole number up to 65535 (found {text[:60]!a})")
    return int(text)


def _has_screen() -> bool:
    """Return whether a browser can show itself; one that lives in the terminal would take it."""
    return sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
