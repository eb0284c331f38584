"""All inputs of one insertion, read and checked; torch and Warp are not needed here."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warpir.app.config import (
    DEFAULTS,
    InsertConfig,
    fields_of,
    flag,
    refused_refinement,
    unread_by_loop,
    unread_by_loss,
    usage,
)
from warpir.app.earlier_runs import EarlierRun, read_run
from warpir.app.model_files import require_model
from warpir.app.photo_world import (
    CameraEstimator,
    PhotoWorld,
    make_world,
    other_camera,
    photo_camera,
)
from warpir.app.record import PATHS, file_hash, input_files
from warpir.app.settings import InputConfig, LightConfig
from warpir.app.standing import FirstThumbnail, stand_on_ground
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.errors import InputError, raise_all
from warpir.core.limits import Limits
from warpir.core.progress import Log
from warpir.io.assets import load_asset
from warpir.io.cameras.source import PhotoCamera
from warpir.io.folder_lock import inputs_within
from warpir.io.images.photos import Photo, read_envmap, read_mask, read_photo
from warpir.io.images.undistort import undistort_photo, undistorted
from warpir.io.lamps_file import given_lamps
from warpir.io.lobes_file import read_lobes
from warpir.io.meshes.materials_file import with_materials
from warpir.io.meshes.point_cloud import read_point_cloud
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera
from warpir.scene.ground import FirstGround
from warpir.scene.light import Light
from warpir.scene.near.lamps import Lamp, notices_of
from warpir.scene.placement import Placement, up_to_y
from warpir.scene.receiver import ReceiverMesh, first_hit, is_in_view, mesh_of
from warpir.scene.shadow_mask import ShadowMask, shadow_mask

STATED_UP = (".glb", ".gltf")
"""Kinds of asset whose format says which way is up."""

Read = TypeVar("Read")


@dataclass(frozen=True)
class Inputs:
    """What was read from disk, and where the object stands."""

    photo: Photo
    asset: Asset
    """With the materials of --materials."""
    camera: Camera
    """At the photo's resolution."""
    placement: Placement
    light: Light | None = None
    """What --light holds, turned by --light-rotate; absent: --sun and --sky describe it."""
    run: EarlierRun | None = None
    """What --reuse holds, as the run left it; in place of any other light."""
    proxy: ReceiverMesh | None = None
    """What --proxy holds."""
    is_plane: bool = True
    """Whether the ground plane receives shadows too."""
    shadow_mask: ShadowMask | None = None
    """What --shadow-mask holds."""
    lamps: tuple[Lamp, ...] = ()
    """What --lamp and --lamps say, near the object."""
    assumed: tuple[str, ...] = ()
    """What was chosen because nothing was given, one line each."""
    notices: tuple[str, ...] = ()
    """What was repaired, converted, left out or looks odd, one line each."""
    occluder: FloatArray | None = None
    """What --occluder-mask holds: share of the photo in front of the object [1], shape [H, W]."""
    measured: dict[str, Any] = field(default_factory=dict)
    """What ``run.json`` says of the camera, the undone distortion and the ground's fit."""
    hashes: dict[str, str] = field(default_factory=dict)
    """sha256 of what was read, by the field's name; of files that an asset brings along, by
    ``asset/`` and their names, relative to it."""


class Loaders:
    """Reads inputs; remembers the last asset, place, points with their ground, and earlier run.

    Args:
        estimator: Estimates the camera of a photo; None: nothing is estimated, because the inputs
            are only checked.
        must_be_seen: Whether an object outside the photo is refused: it may leave a film's frame.
    """

    def __init__(self, estimator: CameraEstimator | None = None, must_be_seen: bool = True) -> None:
        self.estimator, self.must_be_seen = estimator, must_be_seen
        self.photo: Callable[[InputConfig, Limits], Photo] = read_photo_of
        self.asset: Callable[[str, str, Limits], Asset] = lru_cache(maxsize=1)(load_asset)
        self.proxy: Callable[[str, Limits], Asset] = lru_cache(maxsize=1)(_read_proxy)
        self.run: Callable[[str, Limits], EarlierRun] = lru_cache(maxsize=1)(read_run)
        self.points = lru_cache(maxsize=1)(read_point_cloud)
        self.ground, self.thumbnail = FirstGround(), FirstThumbnail()
        self.light = read_light


@dataclass(frozen=True)
class _Files:
    """What the files of one insertion hold, each by itself."""

    photo: Photo
    view: PhotoCamera
    asset: Asset
    occluder: FloatArray | None
    shaded: FloatArray | None
    light: Light | None
    run: EarlierRun | None
    points: Float64Array | None
    proxy: Asset | None
    lamps: tuple[Lamp, ...]
    hashes: dict[str, str]
    log: Log
    """What was assumed and repaired on the way, but for what photo and meshes say themselves."""


def read_inputs(config: InsertConfig, loaders: Loaders | None = None) -> Inputs:
    """Read and check every input, so that all problems are known before anything is rendered.

    Raises:
        InputError: The first problem; the others are in its ``also``.
    """
    config.require_inputs()
    loaders = loaders or Loaders()
    files = _read_files(config, loaders)
    try:
        return _joined(config, files, loaders)
    except InputError as error:
        if (other := other_camera(files.view.camera)) is None:
            raise
        changed, notice = other
        try:
            inputs = read_inputs(config.changed(camera_from="assume", **changed), loaders)
        except InputError:
            raise error from None
        return replace(inputs, notices=(f"{notice} ({error.what})", *inputs.notices))


def _joined(config: InsertConfig, files: _Files, loaders: Loaders) -> Inputs:
    """Set the object into the photo's world.

    Raises:
        InputError: There is no place for it, or no ground.
    """
    straight, undistorted_by = _straightened(files)
    ask, place = config.camera, config.placement.place
    world = make_world(ask, place, files.view, files.points, loaders.ground)
    world = replace(world, thumbnail=partial(loaders.thumbnail, straight.photo))
    mesh = None if files.proxy is None else mesh_of(files.proxy)
    placement = stand_on_ground(
        config.placement, files.asset, world, mesh, config.camera.plane, loaders.must_be_seen
    )
    shade = None
    if straight.shaded is not None:
        bounds = files.asset.bounds()
        shade = shadow_mask(straight.shaded, *bounds, placement.asset_to_world, world.camera)
    return Inputs(
        straight.photo,
        files.asset,
        world.camera,
        placement,
        files.light,
        files.run,
        proxy=mesh,
        is_plane=config.camera.plane,
        shadow_mask=shade,
        lamps=files.lamps,
        assumed=tuple(_assumptions(config, files, world, placement, shade)),
        notices=tuple(_notices(config, straight, world, placement, mesh)),
        occluder=straight.occluder,
        measured=undistorted_by | world.measured | {"camera": world.camera.numbers()},
        hashes=files.hashes,
    )


def _read_files(config: InsertConfig, loaders: Loaders) -> _Files:
    """Read each file by itself; one that is damaged does not hide what is wrong with the others.

    Raises:
        InputError: The first problem; the others are in its ``also``.
    """
    problems = _inputs_in_out(config)

    def attempt(read: Callable[[], Read]) -> Read | None:
        try:
            return read()
        except InputError as error:
            problems.append(error)
            return None

    states: dict[str, tuple[Path, _State | None]] = {}
    with suppress(InputError):  # the reader tells
        states = {name: (path, file_state(path)) for name, path in input_files(config).items()}
    log, limits, inputs, given = Log(), config.limits, config.inputs, config.light
    for name, (path, state) in states.items():
        if state is not None and name in PICTURES:  # all of it is read for its sha256
            attempt(partial(limits.check, "file_bytes", state[1], path, "too large", more=" bytes"))
    photo = attempt(lambda: loaders.photo(inputs, limits))
    occluder = attempt(lambda: _read_mask(inputs.occluder_mask, photo, limits, log))
    shaded = attempt(lambda: _read_mask(config.camera.shadow_mask, photo, limits, log))
    asset = attempt(lambda: read_asset(inputs, limits, loaders, log))
    if asset is not None:
        problems += refused_refinement(config, asset)
    run = view = points = proxy = None
    if (reuse := given.reuse) is not None:
        run = attempt(lambda: loaders.run(reuse, limits))
    if photo is not None:
        attempt(lambda: _check_photo(config, photo))
        name = Path(str(inputs.photo)).name
        # What stops the run anyway is not worth the seconds of an estimate.
        estimator = None if problems else loaders.estimator
        view = attempt(lambda: photo_camera(config.camera, photo, name, estimator, limits))
    # Without a camera the run ends below, but all that is wrong with the light is told too.
    pose = view.camera.c2w if view is not None else np.eye(4)
    light = attempt(lambda: loaders.light(given, inputs.strict, pose, limits, log))
    if (points_path := config.camera.ground_points) is not None:
        points = attempt(lambda: loaders.points(points_path, limits))
    if (proxy_path := config.camera.proxy) is not None:
        proxy = attempt(lambda: loaders.proxy(proxy_path, limits))
    lamps = attempt(lambda: given_lamps(given.lamp, given.lamps, limits, log.notice)) or ()
    attempt(lambda: require_model(config))
    raise_all(problems)
    assert photo is not None and asset is not None and view is not None
    hashes = {name: file_hash(path) for name, (path, _) in states.items()}
    changed = [path for path, before in states.values() if file_state(path) != before]
    advice = "run again when it is complete"
    raise_all([InputError(path, "changed while it was read", advice) for path in changed])
    hashes |= _hashes_beside(config, asset, proxy)
    if run is not None:
        hashes["reuse"] = run.digest
    return _Files(
        photo, view, asset, occluder, shaded, light, run, points, proxy, lamps, hashes, log
    )


def _check_photo(config: InsertConfig, photo: Photo) -> None:
    """Refuse a width that enlarges the photo too far, and a camera's response for a linear plate.

    Raises:
        InputError: It would be rendered at too many pixels, or bent by a curve of photographs.
    """
    (rows, columns), width = photo.codes.shape[:2], config.render.width or 0
    if width > columns:
        rendered = width * round(width * rows / columns)
        config.limits.check("pixels", rendered, "--width", "too many pixels to render")
    if photo.is_linear and not isinstance(config.look.response, str):
        raise usage("--response", "a scene-linear plate has none", "leave it out")


def _hashes_beside(config: InsertConfig, asset: Asset, proxy: Asset | None) -> dict[str, str]:
    """Return the sha256 of the meshes' files by their names; see `Inputs.hashes`.

    Raises:
        InputError: One that a mesh brings along is in --out.
    """
    hashes: dict[str, str] = {}
    problems: list[InputError] = []
    meshes = (("asset", config.inputs.asset, asset), ("proxy", config.camera.proxy, proxy))
    for name, path, mesh in meshes:
        if mesh is None or path is None:
            continue
        for file, digest in mesh.hashes.items():
            hashes[f"{name}/{file}" if file else name] = digest
            problems += (
                inputs_within(config.output.out, Path(path).parent.resolve() / file) if file else []
            )
    raise_all(problems)
    return hashes


def _straightened(files: _Files) -> tuple[_Files, dict[str, Any]]:
    """Undo the lens' distortion in photo and masks; return also what ``run.json`` says of it."""
    view = files.view
    if view.lens.is_straight:
        return files, {}
    photo, border = undistort_photo(files.photo, view.camera, view.lens)
    masks = [mask for mask in (files.occluder, files.shaded) if mask is not None]
    bent = iter(undistorted(masks, view.camera, view.lens)[0])
    occluder = None if files.occluder is None else next(bent)
    shaded = None if files.shaded is None else next(bent)
    measured = {"undistorted": {**view.lens.record(), "border_share": border}}
    return replace(files, photo=photo, occluder=occluder, shaded=shaded), measured


def _assumptions(
    config: InsertConfig,
    files: _Files,
    world: PhotoWorld,
    placement: Placement,
    shade: ShadowMask | None,
) -> Iterator[str]:
    """Yield what was chosen because nothing was given."""
    yield from files.log.assumed
    yield from world.camera.assumed
    yield from world.assumed
    yield from placement.assumed
    if shade is not None:
        yield (
            f"{100.0 * shade.at_object:.0f} % of the light of the sun and of far lamps is kept "
            "from the object, the mean of --shadow-mask under its footprint"
        )
    if (run := files.run) and (line := run.assumption(world.camera.c2w, config.camera.file)):
        yield line


def _notices(
    config: InsertConfig,
    files: _Files,
    world: PhotoWorld,
    placement: Placement,
    mesh: ReceiverMesh | None,
) -> Iterator[str]:
    """Yield what was repaired, converted, left out or looks odd."""
    assert config.inputs.photo is not None and config.inputs.asset is not None
    camera, run = world.camera, files.run
    yield from _about(config.inputs.photo, files.photo.notices)
    yield from _about(config.inputs.asset, files.asset.notices)
    if config.camera.proxy and files.proxy:
        yield from _about(config.camera.proxy, files.proxy.notices)
    yield from files.log.notices
    yield from _without_effect(config)
    if config.camera.undistort and files.view.lens.is_straight:
        yield "--undistort: the camera has no distortion, nothing was undone"
    yield from camera.notices
    yield from world.notices
    yield from placement.warnings
    yield from notices_of(files.lamps, placement.ground if config.camera.plane else None)
    if config.render.width is not None and config.render.width < camera.width:
        yield (
            f"a preview: object and shadow are rendered {config.render.width} px wide and enlarged "
            f"to the photo's {camera.width} px (--width)"
        )
    if mesh is not None:
        yield from _about_mesh(mesh, files.asset, placement, camera)
        if not np.allclose(camera.c2w, files.view.camera.c2w):
            yield "--proxy counts after that turn, in the world of camera.json"
    if run is not None and run.materials is not None and config.inputs.materials is None:
        yield (
            f"{run.path} had changed its object's materials, this run has not (--materials "
            f"{run.materials} does the same to that object)"
        )
    if files.occluder is not None and config.is_guided:
        yield "guidance does not see --occluder-mask; the pictures it leads to do"


def _without_effect(config: InsertConfig) -> Iterator[str]:
    """Yield the flags that were given and that nothing reads in this run, a line a reason."""
    unread = [*unread_by_loss(config), *unread_by_loop(config)]
    if not config.is_guided:
        parts = ("guidance", "diffusion", "adapter", "optimize")
        unread = [("where no model guides", " ".join(n for p in parts for n in fields_of(p)))]
    values = config.flat()
    for why, names in unread:
        given = [flag(name) for name in names.split() if values[name] != DEFAULTS[name]]
        if given:
            yield f"without effect {why}: {', '.join(given)}"
    if config.light.reuse is not None and config.light.ground_albedo is not None:
        yield "--ground-albedo: without effect on the light of --reuse (--exposure)"
    is_given = config.light.is_described or config.light.reuse or config.light.start == "uniform"
    if is_given and not config.light.visible_sun and not config.is_guided:
        yield "--no-visible-sun: without effect where the light is not estimated from the photo"


PICTURES = ("photo", "occluder_mask", "shadow_mask", "light")
"""Inputs whose readers have a limit of pixels, but none of bytes."""
_State = tuple[int, int, int]


def file_state(path: Path) -> _State | None:
    """Return what a change of a file's content changes; None where there is no such file."""
    try:
        status = path.stat()
    except (OSError, ValueError):  # the reader tells
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def _inputs_in_out(config: InsertConfig) -> list[InputError]:
    """Refuse an --out that holds an input: --overwrite could replace it."""
    values = config.flat()
    named = [values[name] for name in PATHS if name not in ("sequence", "out")]
    return inputs_within(config.output.out, *(path for path in named if path is not None))


def read_photo_of(inputs: InputConfig, limits: Limits) -> Photo:
    """Read --photo as its flags say.

    Raises:
        InputError: It cannot be used.
    """
    assert inputs.photo is not None
    return read_photo(
        inputs.photo,
        max_pixels=limits.pixels,
        alpha=inputs.alpha,
        layer=inputs.layer,
        strict=inputs.strict,
    )


def read_asset(inputs: InputConfig, limits: Limits, loaders: Loaders, log: Log) -> Asset:
    """Read --asset as its flags say: which way is up, and its materials.

    Raises:
        InputError: The asset or its materials cannot be used.
    """
    assert inputs.asset is not None
    asset = loaders.asset(inputs.asset, inputs.missing_textures, limits)
    if inputs.asset_up not in (None, "y", "+y"):
        turned = f"turned: its {inputs.asset_up} axis points up (--asset-up)"
        asset = asset.turned(up_to_y(inputs.asset_up))
        asset = replace(asset, notices=(*asset.notices, turned))
    elif inputs.asset_up is None and Path(inputs.asset).suffix.lower() not in STATED_UP:
        log.assume("the asset's +y axis points up (--asset-up)")
    if inputs.materials is not None:
        asset = with_materials(asset, inputs.materials, limits)
    return asset


def _read_proxy(path: str, limits: Limits) -> Asset:
    """Read the mesh of the place; of its materials nothing is used."""
    asset = load_asset(path, "grey", limits)
    notices = [n for n in asset.notices if "material" not in n and "texture" not in n]
    if any(m.alpha_mode != "OPAQUE" for m in asset.materials):
        notices.append("the opacity of its materials is not used: all of the mesh blocks light")
    return replace(asset, notices=tuple(notices))


def _about_mesh(
    mesh: ReceiverMesh, asset: Asset, placement: Placement, camera: Camera
) -> Iterator[str]:
    """Yield what looks odd of the place's mesh."""
    if not is_in_view(mesh, camera):
        yield "no triangle of --proxy is in view: it only stands in the light's way"
    low, high = asset.bounds()
    middle = placement.asset_to_world[:3, :3] @ (0.5 * (low + high))
    toward = middle + placement.asset_to_world[:3, 3] - camera.c2w[:3, 3]
    if first_hit(mesh, camera.c2w[None, :3, 3], toward[None])[0][0] < 1.0:
        yield "the mesh of --proxy hides the object's middle from the camera"


def _read_mask(
    path: str | None, photo: Photo | None, limits: Limits, log: Log
) -> FloatArray | None:
    if path is None or photo is None:
        return None
    height, width = photo.codes.shape[:2]
    found: list[str] = []
    mask = read_mask(path, (width, height), max_pixels=limits.pixels, notices=found)
    log.notice(*_about(path, found))
    return mask


def read_light(
    asked: LightConfig, strict: bool, camera_to_world: Float64Array, limits: Limits, log: Log
) -> Light | None:
    """Return what --light holds, turned by --light-rotate; None where it is not given."""
    if asked.file is None:
        return None
    if Path(asked.file).suffix.lower() == ".json":
        if asked.fit_lobes is not None:
            raise usage("--fit-lobes", f"needs a panorama to fit (found lobes: {asked.file})")
        if asked.convention != "openexr":
            raise usage("--light-convention", f"is for panoramas (found lobes: {asked.file})")
        return Light(lobes=read_lobes(asked.file, limits)).rotated(asked.rotate)
    found: list[str] = []
    texels = read_envmap(
        asked.file,
        convention=asked.convention,
        camera_to_world=camera_to_world,
        pictures=True,
        strict=strict,
        max_width=limits.envmap_width,
        notices=found,
    )
    log.notice(*_about(asked.file, found))
    return Light(texels=texels).rotated(asked.rotate)


def _about(path: str, notices: tuple[str, ...] | list[str]) -> list[str]:
    return [f"{Path(path).name}: {notice}" for notice in notices]
