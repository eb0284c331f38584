r"""Train the networks that warpir ships: for the light, and for the camera.

    python -m warpir.train regressor --panoramas DIR --out DIR --minutes 12 --networks 5
    python -m warpir.train regressor ... --resume
    python -m warpir.train camera --panoramas DIR --regressor FILE --out DIR --minutes 6 \
        --fold 0/5

Scenes are rendered as they are needed and then forgotten. A command stops after ``--minutes``, and
``--resume`` goes on, with the same panoramas, until ``--total-minutes`` are used up. With torchrun
one regressor's network is trained on several cards. ``--without`` names panoramas that must not be
learned from; of those that ``--validation`` names only the errors are looked at.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpir.app.config import usage
from warpir.app.program import run_program, say
from warpir.core.atomic import Checkpoints
from warpir.core.errors import ExitCode, InputError
from warpir.core.signals import Stopped

if TYPE_CHECKING:
    import torch

    from warpir.train.batches import PhotoBatch
    from warpir.train.lights import LightPool

VALIDATION_PICTURES = 768
"""Of each kind."""
VALIDATION_SEED = 10**6
REPLAYS, REPLAYED = 3, 12
"""Steps that each photo is learned from, on average, and batches that they are drawn from: photos
take longer to render than to learn from, and each is varied anew."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`."""
    return run_program(_run, argv)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m warpir.train", description=__doc__.partition("\n")[0]
    )
    add = parser.add_argument
    add("network", choices=("camera", "regressor"))
    add("--panoramas", type=Path, nargs="+", required=True, metavar="DIR")
    add("--without", nargs="*", default=[], metavar="NAME", help="not learned from")
    add("--validation", nargs="*", default=[], metavar="NAME", help="only looked at")
    add("--out", type=Path, required=True, metavar="DIR")
    add("--minutes", type=float, default=9.0, help="of this command")
    add("--total-minutes", type=float, help="of all commands together")
    add("--batch", type=int, default=None)
    words = "largest learning rate (default: 1e-3, with --start 3e-4 suits; camera: 1.2e-3, half of"
    add("--rate", type=float, metavar="R", help=f"{words} it with weights to begin with)")
    add("--seed", type=int, default=0)
    add("--device", default=None)
    add("--resume", action="store_true")
    add("--start", type=Path, metavar="FILE", help="weights to begin with")
    words = "weights whose first layers the camera's network begins with"
    add("--regressor", type=Path, metavar="FILE", help=words)
    words = "networks, each without a share of the places; their answers are averaged"
    add("--networks", type=int, default=1, metavar="N", help=words)
    words = "hold out the places of fold K of N, for validation and calibration"
    add("--fold", type=_fold, metavar="K/N", help=words)
    words = "panoramas to learn from, whole places drawn at random"
    add("--places", type=int, metavar="N", help=words)
    add("--no-compile", action="store_true", help="do without torch.compile")
    return parser


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    _refuse_idle(options, parser)
    if options.networks > 1:
        return _train_members(options, arguments)
    _check(options)
    panoramas = files_in(options.panoramas, (".hdr", ".exr"))
    unknown = sorted({*options.without, *options.validation} - {p.stem for p in panoramas})
    if unknown:
        say(f"notice: no panorama is called {', '.join(unknown)}")

    if options.network == "camera":
        result: Mapping[str, Any] = _train_camera(options, panoramas)
    else:
        result = _train_regressor(options, panoramas)
    from warpir.train.worker import Worker

    if Worker.this().is_first:
        say(json.dumps(result))
    return ExitCode.DONE


def _train_regressor(options: argparse.Namespace, panoramas: Sequence[Path]) -> dict[str, Any]:
    """Train the network that estimates the light, on rendered scenes and cut photographs."""
    import torch

    from warpir.render.device import choose_device
    from warpir.train.lights import load_panoramas
    from warpir.train.places import learned_from, of_fold, some_places
    from warpir.train.worker import Worker

    worker = Worker.this()
    device = choose_device(f"cuda:{worker.local_rank}" if worker.count > 1 else options.device)
    names = [p.stem for p in panoramas if p.stem not in options.without]
    held = _held_record(options.out) if options.resume else {}
    began_with = held.get("started_from", {}) if options.resume else _start_record(options.start)
    known = learned_from(began_with)
    watched_names = {*options.validation, *of_fold(names, options.fold, known)}
    kept_out = {*options.without, *watched_names}
    kept_out |= {*names} - some_places(
        [n for n in names if n not in kept_out], options.places, known
    )
    learned = [p for p in panoramas if p.stem not in kept_out]
    watched = [p for p in panoramas if p.stem in watched_names]
    if worker.is_first:
        say(f"device: {device}; {len(learned)} panoramas; validation on {len(watched)} panoramas")
        _say_known(watched, known)
    torch_device = torch.device(device)
    record = {
        "panoramas": [p.stem for p in learned],
        "validation_panoramas": [p.stem for p in watched],
        "kept_out": list(options.without),
        "device": torch.cuda.get_device_name(torch_device) if device != "cpu" else "cpu",
        "started_from": began_with,
    }
    if options.resume:
        _compare(options.out, held, record)
    pools = load_panoramas(learned, torch_device), load_panoramas(watched, torch_device)
    return _train_on(pools, options, options.seed * 1000 + worker.local_rank, torch_device, record)


def _train_camera(options: argparse.Namespace, panoramas: Sequence[Path]) -> dict[str, float]:
    """Train the network that estimates cameras; Warp only knows the devices."""
    import torch

    from warpir.render.device import choose_device
    from warpir.train.camera.crops import read_panoramas
    from warpir.train.camera.loop import WEIGHTS, begin_with_trunk, train_camera
    from warpir.train.lights import SKY_ONLY
    from warpir.train.networks.calibrator import random_calibrator, read_calibrator
    from warpir.train.networks.regressor import read_regressor
    from warpir.train.places import learned_from, of_fold
    from warpir.train.stepping import CameraSettings

    device = torch.device(choose_device(options.device))
    # What shows no ground shows no camera.
    usable = [p for p in panoramas if SKY_ONLY not in p.stem and p.stem not in options.without]
    names = [p.stem for p in usable]
    held_out = {*options.validation, *of_fold(names, options.fold, ())}
    learned = [p for p in usable if p.stem not in held_out]
    watched = [p for p in usable if p.stem in held_out]
    if not learned:
        raise InputError("--panoramas", "none to learn from")
    say(f"device: {device}; {len(learned)} panoramas; validation on {len(watched)}")
    start = None if options.start is None else read_calibrator(options.start, device)
    started_from = None if start is None else start.record
    _say_known(watched, learned_from(started_from or {}))
    if options.regressor is not None:
        regressor = read_regressor(options.regressor)
        start = start or random_calibrator(options.seed)
        begin_with_trunk(start, regressor)
        started_from = {"regressor": regressor.record}
    record = {
        "panoramas": [p.stem for p in learned],
        "validation_panoramas": [p.stem for p in watched],
        "started_from": started_from,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
    }
    settings = CameraSettings(
        batch=options.batch or CameraSettings.batch,
        learning_rate=options.rate
        or CameraSettings.learning_rate * (1.0 if start is None else 0.5),
    )
    try:
        return train_camera(
            read_panoramas(learned, device),
            read_panoramas(watched, device) if watched else None,
            options.out,
            settings,
            device,
            options.minutes,
            seed=options.seed,
            start=start,
            record=record,
        )
    except Stopped as stopped:
        weights = options.out / WEIGHTS  # `_check` has found none
        if weights.exists():
            stopped.kept = f"kept: {weights}; --start {weights} and another --out go on from there"
        raise


def _say_known(watched: Sequence[Path], known: set[str]) -> None:
    """Say how many panoramas judge a network that begins with weights that know them."""
    count = sum(p.stem in known for p in watched)
    if count:
        words = "that the weights of --start have learned from: errors elsewhere are larger"
        say(f"notice: validation on {count} panoramas {words}")


def _held_record(out: Path) -> Mapping[str, Any]:
    """Return the record of the training in a folder."""
    from warpir.train.regressor import checkpoints_of

    # `train_regressor` tells of checkpoints that are damaged.
    state = checkpoints_of(out).load(lambda _: None).state
    return state.get("record", {})  # type: ignore[no-any-return]


def _compare(out: Path, held: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Compare the panoramas of a training in its folder with those that it would go on with.

    Raises:
        InputError: They differ: what is judged by must not have been learned from.
    """
    for name in ("panoramas", "validation_panoramas"):
        was, now = (set(r.get(name, ())) for r in (held, record))
        if was != now:
            what = f"a training with other {name} ({', '.join(sorted(was ^ now))})"
            raise InputError(out, what, "give the same again, or choose another --out")


def _start_record(start: Path | None) -> Mapping[str, Any]:
    """Return the record of the regressor to begin with; empty without any.

    Raises:
        InputError: It is not one network (`ExitCode.MODEL`).
    """
    if start is None:
        return {}
    from warpir.lighting.regressor import load_regressor

    network = load_regressor(start)
    if len(network.members) > 1:
        what = f"holds {len(network.members)} networks, and a training begins with one"
        raise InputError(start, what, code=ExitCode.MODEL)
    return network.record


def _fold(text: str) -> tuple[int, int]:
    """Read ``K/N``: fold K of N, counted from 0."""
    fold, _, count = text.partition("/")
    if not (fold.isdecimal() and count.isdecimal() and int(fold) < int(count)):
        raise argparse.ArgumentTypeError(f"expected K/N with K below N (found {text!r})")
    return int(fold), int(count)


def _refuse_idle(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Refuse flags that would do nothing.

    Raises:
        InputError: One is given (exit 2).
    """
    is_camera = options.network == "camera"
    for name in ("total_minutes", "networks", "places") if is_camera else ("regressor",):
        if getattr(options, name) != parser.get_default(name):
            raise usage(f"--{name.replace('_', '-')}", f"not for the {options.network}'s network")
    if options.start is not None and options.resume:
        raise usage("--start", "what is resumed has its own weights")
    if options.start is not None and options.regressor is not None:
        raise usage("--regressor", "the weights of --start have first layers of their own")
    if options.networks > 1 and options.fold is not None:
        raise usage("--fold", "each of --networks has its own")
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and (is_camera or options.networks > 1):
        what = "its processes share the training of one regressor's network, and no other"
        raise usage("torchrun", what, "leave it out")


def _check(options: argparse.Namespace) -> None:
    """Find what is wrong with numbers and folders before scenes are made, which takes minutes.

    Raises:
        InputError: A number makes no sense (exit 2), there is nothing to resume (3), or --out holds
            a training that would be lost (7).
    """
    for name in ("minutes", "total_minutes", "rate"):
        value = getattr(options, name)
        if value is not None and not 0.0 < value < math.inf:
            raise usage(f"--{name.replace('_', '-')}", f"expected above 0 (found {value})")
    for name, least in (("batch", 1), ("places", 1), ("networks", 1), ("seed", 0)):
        value = getattr(options, name)
        if value is not None and value < least:
            raise usage(f"--{name}", f"expected at least {least} (found {value})")
    for name in ("start", "regressor"):
        path = getattr(options, name)
        if path is not None and not path.is_file():
            raise InputError(path, "no such file", code=ExitCode.MODEL)
    if options.out.exists() and not options.out.is_dir():
        raise InputError(options.out, "not a folder", "choose another --out", ExitCode.OUTPUT)
    begun = Checkpoints(options.out, {}).newest is not None
    if begun and not options.resume:
        advice = "--resume goes on with it; or choose another --out"
        raise InputError(options.out, "holds a training that was begun", advice, ExitCode.OUTPUT)
    if (options.out / "calibrator.safetensors").exists():  # the camera's leaves no checkpoints
        what = "holds a camera's training"
        raise InputError(options.out, what, "choose another --out", ExitCode.OUTPUT)
    if options.resume and not begun:
        raise InputError(options.out, "nothing to resume", "leave --resume out to begin")


def files_in(folders: Sequence[Path], suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of these kinds in folders and the folders in them, sorted by name.

    Raises:
        InputError: A folder is not there.
    """
    found = []
    for folder in folders:
        if not folder.is_dir():
            raise InputError(folder, "no such folder")
        paths = (*folder.glob("*"), *folder.glob("*/*"))
        found += [path for path in paths if path.suffix.lower() in suffixes]
    return sorted(found, key=lambda path: path.stem)


def _train_on(
    pools: tuple[LightPool, LightPool],
    options: argparse.Namespace,
    seed: int,
    device: torch.device,
    record: dict[str, Any],
) -> dict[str, Any]:
    """Train on the first panoramas, validate on the second ones; return how it ended."""
    from warpir.train.batches import Replay
    from warpir.train.networks.regressor import read_regressor
    from warpir.train.regressor import PANORAMAS, train_regressor
    from warpir.train.scenes.generator import Mixture, SceneGenerator
    from warpir.train.stepping import TrainingSettings
    from warpir.train.worker import Worker

    learned, unseen = pools
    scenes = SceneGenerator(learned, seed)

    def drawn(**shares: float) -> list[PhotoBatch]:
        mixture = Mixture(**shares, proxies=0.0, misjudged=0.0)
        made = SceneGenerator(unseen, VALIDATION_SEED, mixture)
        return [made.photo_batch(k, 128) for k in range(VALIDATION_PICTURES // 128)]

    if Worker.this().is_first:
        say("rendering photos for validation")
    validation = {"procedural": drawn(made_up=1.0, hybrid=0.0)}
    if unseen.panorama_count:
        validation[PANORAMAS] = drawn(made_up=0.0, hybrid=0.0)
    settings = TrainingSettings(
        batch=options.batch or 512,
        learning_rate=options.rate or TrainingSettings.learning_rate,
        compile=not options.no_compile,
    )
    start = None if options.start is None else read_regressor(options.start, device)
    end = train_regressor(
        Replay(scenes.next_batch, REPLAYS, REPLAYED),
        validation,
        options.out,
        settings,
        device,
        options.minutes,
        options.total_minutes or options.minutes,
        resume=options.resume,
        seed=options.seed,
        network=start,
        record=record,
    )
    return vars(end)


def _train_members(options: argparse.Namespace, arguments: list[str]) -> int:
    """Train one network for each fold at the same time, and join them.

    Each network is trained without its fold's places, and its uncertainty is calibrated on them.

    Raises:
        InputError: A training failed; its output says why.
    """
    from warpir.train.regressor import WEIGHTS, join_members

    folders = [options.out / f"member_{fold}" for fold in range(options.networks)]
    commands = []
    for fold, folder in enumerate(folders):
        # Of a flag that stands twice the last one counts.
        own = ["--networks", "1", "--fold", f"{fold}/{options.networks}", "--out", str(folder)]
        commands.append([sys.executable, "-m", "warpir.train", *arguments, *own])
    running = [subprocess.Popen(command) for command in commands]
    try:
        for folder, process in zip(folders, running, strict=True):
            if process.wait():
                raise InputError(folder, f"its training failed (exit {process.returncode})")
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()
    join_members([folder / WEIGHTS for folder in folders], options.out / WEIGHTS)
    return ExitCode.DONE
