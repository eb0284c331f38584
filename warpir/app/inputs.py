"""All inputs of one insertion, read and checked; torch and Warp are not needed here."""

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warpir.app.config import InsertConfig, usage
from warpir.app.model_files import require_model
from warpir.app.photo_world import PhotoWorld, make_world
from warpir.app.record import file_hash, input_files
from warpir.app.reuse import EarlierRun, read_run
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.errors import InputError, raise_all
from warpir.core.limits import Limits
from warpir.io.assets import load_asset
from warpir.io.cameras.reader import read_photo_camera
from warpir.io.cameras.source import PhotoCamera
from warpir.io.images.photos import Photo, read_envmap, read_mask, read_photo
from warpir.io.images.undistort import undistort_photo, undistorted
from warpir.io.lobes_file import read_lobes
from warpir.io.meshes.materials_file import with_materials
from warpir.io.meshes.point_cloud import read_point_cloud
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera, camera_from_exif, camera_from_fov
from warpir.scene.free_space import find_place, points_in_way
from warpir.scene.light import Light
from warpir.scene.placement import Placement, place_asset, up_to_y, upright_plane
from warpir.scene.receiver import ReceiverMesh, first_hit, is_in_view, mesh_of
from warpir.scene.shadow_mask import ShadowMask, shadow_mask

DEFAULT_FOV = 60.0
"""Horizontal field of view without --camera, --fov and EXIF [deg]: a phone's main camera."""
DEFAULT_CAMERA_HEIGHT = 1.6
"""Height of a photographer's eyes [m]."""

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
    assumed: tuple[str, ...] = ()
    """What was chosen because nothing was given, one line each."""
    notices: tuple[str, ...] = ()
    """What was repaired, converted, left out or looks odd, one line each."""
    occluder: FloatArray | None = None
    """What --occluder-mask holds: share of the photo in front of the object [1], shape [H, W]."""
    measured: dict[str, Any] = field(default_factory=dict)
    """What ``run.json`` says of the undone distortion and of the ground's fit."""
    hashes: dict[str, str] = field(default_factory=dict)
    """sha256 of what was read, by the field's name; of files that an asset brings along, by
    ``asset/`` and their names, relative to it."""


class Loaders:
    """Reads assets, places and earlier runs; remembers the last of each, for many insertions."""

    def __init__(self) -> None:
        self.asset: Callable[[str, str, Limits], Asset] = lru_cache(maxsize=1)(load_asset)
        self.proxy: Callable[[str, Limits], Asset] = lru_cache(maxsize=1)(_read_proxy)
        self.run: Callable[[str, Limits], EarlierRun] = lru_cache(maxsize=1)(read_run)


def read_inputs(config: InsertConfig, loaders: Loaders | None = None) -> Inputs:
    """Read and check every input, so that all problems are known before anything is rendered.

    Args:
        config: Names the files.
        loaders: Of earlier insertions; what they remember is not read again.

    Raises:
        InputError: The first problem; the others are in its ``also``.
    """
    config.require_inputs()
    loaders = loaders or Loaders()
    problems: list[InputError] = []

    def attempt(read: Callable[[], Read]) -> Read | None:
        try:
            return read()
        except InputError as error:
            problems.append(error)
            return None

    assert config.inputs.photo is not None and config.inputs.asset is not None
    photo_path, asset_path = config.inputs.photo, config.inputs.asset
    states: dict[str, tuple[Path, _State | None]] = {}
    with suppress(InputError):  # the reader tells
        states = {name: (path, _state(path)) for name, path in input_files(config).items()}
    problems += _inputs_in_out(config)
    notices: list[str] = []
    assumed: list[str] = []
    photo = attempt(
        lambda: read_photo(
            photo_path,
            max_pixels=config.limits.pixels,
            alpha="ignore" if config.inputs.alpha == "ignore" else "refuse",
            layer=config.inputs.layer,
            strict=config.inputs.strict,
        )
    )
    occluder = attempt(lambda: _read_mask(config.inputs.occluder_mask, photo, config, notices))
    shaded = attempt(lambda: _read_mask(config.camera.shadow_mask, photo, config, notices))
    asset = attempt(lambda: read_asset(asset_path, config, loaders, assumed))
    reuse = config.light.reuse
    run = attempt(lambda: loaders.run(reuse, config.limits)) if reuse is not None else None
    view = attempt(lambda: photo_camera(config, photo, assumed)) if photo is not None else None
    # Without a camera the run ends below, but all that is wrong with the light is told too.
    pose = view.camera.c2w if view is not None else np.eye(4)
    light = attempt(lambda: _read_light(config, pose, notices))
    points_path, proxy_path = config.camera.ground_points, config.camera.proxy
    limits = config.limits
    points = proxy = None
    if points_path is not None:
        points = attempt(lambda: read_point_cloud(points_path, limits))
    if proxy_path is not None:
        proxy = attempt(lambda: loaders.proxy(proxy_path, limits))
    attempt(lambda: require_model(config))
    raise_all(problems)
    assert photo is not None and asset is not None and view is not None
    hashes = {name: file_hash(path) for name, (path, _) in states.items()}
    raise_all([_changed(path) for path, before in states.values() if _state(path) != before])
    for name, mesh_read in (("asset", asset), ("proxy", proxy)):
        for file, digest in mesh_read.hashes.items() if mesh_read is not None else ():
            hashes[f"{name}/{file}" if file else name] = digest
            folder = Path(config.flat()[name]).parent.resolve()
            problems += _within_out(config, folder / file) if file else []
    raise_all(problems)
    if run is not None:
        hashes["reuse"] = run.digest

    measured: dict[str, Any] = {}
    straight = photo
    if not view.lens.is_straight:
        straight, border = undistort_photo(photo, view.camera, view.lens)
        measured["undistorted"] = {**view.lens.record(), "border_share": border}
        masks = [mask for mask in (occluder, shaded) if mask is not None]
        bent = iter(undistorted(masks, view.camera, view.lens)[0])
        occluder = None if occluder is None else next(bent)
        shaded = None if shaded is None else next(bent)
    elif config.camera.undistort:
        notices.append("--undistort: the camera has no distortion, nothing was undone")
    world = make_world(config, view, points)
    camera = world.camera
    mesh = None if proxy is None else mesh_of(proxy)
    placement = _place(config, asset, world, mesh)
    notices = [
        *_about(photo_path, straight.notices),
        *_about(asset_path, asset.notices),
        *(_about(config.camera.proxy, proxy.notices) if config.camera.proxy and proxy else ()),
        *notices,
        *camera.notices,
        *world.notices,
        *placement.warnings,
    ]
    if config.render.width is not None and config.render.width < camera.width:
        notices.append(
            f"a preview: object and shadow are rendered {config.render.width} px wide and enlarged "
            f"to the photo's {camera.width} px (--width)"
        )
    assumed += [*camera.assumed, *world.assumed, *placement.assumed]
    measured |= world.measured
    if mesh is not None:
        notices += _about_mesh(mesh, asset, placement, camera)
        if not np.allclose(camera.c2w, view.camera.c2w):
            notices.append("--proxy counts after that turn, in the world of camera.json")
    shade = None
    if shaded is not None:
        shade = shadow_mask(shaded, *asset.bounds(), placement.asset_to_world, camera)
        assumed.append(
            f"{100.0 * shade.at_object:.0f} % of the lamps' light is kept from the object, the "
            "mean of --shadow-mask under its footprint"
        )
    if run is not None and (assumption := run.assumption(camera.c2w, config.camera.file)):
        assumed.append(assumption)
    if run is not None and run.materials is not None and config.inputs.materials is None:
        notices.append(
            f"{run.path} had changed its object's materials, this run has not (--materials "
            f"{run.materials} does the same to that object)"
        )
    if occluder is not None and config.is_guided:
        notices.append("guidance does not see --occluder-mask; the pictures it leads to do")
    return Inputs(
        straight,
        asset,
        camera,
        placement,
        light,
        run,
        proxy=mesh,
        is_plane=config.camera.plane,
        shadow_mask=shade,
        assumed=tuple(assumed),
        notices=tuple(notices),
        occluder=occluder,
        measured=measured,
        hashes=hashes,
    )


_State = tuple[int, int, int]


def _state(path: Path) -> _State | None:
    """Return what a change of a file's content changes; None where there is no such file."""
    try:
        status = path.stat()
    except (OSError, ValueError):  # the reader tells
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def _changed(path: Path) -> InputError:
    return InputError(path, "changed while it was read", "run again when it is complete")


def _inputs_in_out(config: InsertConfig) -> list[InputError]:
    """Refuse an --out that holds an input: --overwrite could replace it."""
    named = (
        *(
            config.inputs.photo,
            config.inputs.asset,
            config.inputs.materials,
            config.camera.file,
            config.light.file,
        ),
        *(
            config.inputs.occluder_mask,
            config.camera.shadow_mask,
            config.camera.proxy,
            config.light.reuse,
            config.diffusion.model,
        ),
        *(
            config.adapter.lora,
            config.guidance.prior,
            config.light.regressor,
            config.camera.ground_points,
        ),
    )
    return _within_out(config, *(path for path in named if path is not None))


def _within_out(config: InsertConfig, *paths: str | Path) -> list[InputError]:
    """Refuse the first path that is --out or below it: by links, or in a folder of the results."""
    if config.output.out is None:
        return []
    out = _places(config.output.out)[:1]
    if not out or out[0] == out[0].parent:
        return []  # no name, or the root: `warpir.io.results.OutputFolder` says so
    for path in paths:
        if any(place.is_relative_to(out[0]) for place in _places(path)):
            return [usage("--out", f"holds the input {path}", "choose a folder of its own")]
    return []


def _places(path: str | Path) -> list[Path]:
    """Return where a path leads, and where it lies itself if it is a link: either can be replaced.

    None for what no file can be called: the reader tells.
    """
    folder, name = os.path.split(os.path.abspath(path))
    try:
        return [Path(os.path.realpath(path)), Path(os.path.realpath(folder), name)]
    except ValueError:
        return []


def read_asset(path: str, config: InsertConfig, loaders: Loaders, assumed: list[str]) -> Asset:
    """Read --asset as its flags say: which way is up, and its materials.

    Args:
        path: The file.
        config: The flags.
        loaders: Of earlier insertions.
        assumed: What was chosen because nothing was given is appended here.

    Raises:
        InputError: The asset or its materials cannot be used.
    """
    asset = loaders.asset(path, config.inputs.missing_textures, config.limits)
    if config.inputs.asset_up is not None:
        turned = f"turned: its {config.inputs.asset_up} axis points up (--asset-up)"
        asset = asset.turned(up_to_y(config.inputs.asset_up))
        asset = replace(asset, notices=(*asset.notices, turned))
    elif Path(path).suffix.lower() not in STATED_UP:
        assumed.append("the asset's +y axis points up (--asset-up)")
    if config.inputs.materials is not None:
        asset = with_materials(asset, config.inputs.materials, config.limits)
    for name in config.task.refine_materials or ():
        if not asset.materials_named([name]):
            found = ", ".join(dict.fromkeys(ascii(m.name) for m in asset.materials))
            what = f"no material {name[:60]!a} in {path} (found {found[:400]})"
            raise usage("--refine-materials", what, "name some of these, or leave it out for all")
    return asset


def _place(
    config: InsertConfig, asset: Asset, world: PhotoWorld, mesh: ReceiverMesh | None
) -> Placement:
    """Set the asset on the ground: where it was asked for, or where the points leave space."""
    low, high = asset.bounds()

    def put(place: tuple[float, float, float] | None) -> Placement:
        return place_asset(
            low,
            high,
            world.camera,
            world.ground,
            place=place,
            at=config.placement.at if place is None else None,
            rotate_y=config.placement.rotate_y,
            scale=config.placement.scale,
            size=config.placement.size,
            mesh=mesh,
            is_plane=config.camera.plane,
        )

    if world.cloud is None:
        return put(world.place)
    if world.place is None and config.placement.at is None:
        plane = upright_plane(world.ground, world.camera.c2w[:3, 3])
        place = find_place(put, low, high, world.camera, plane, world.cloud)
        placement = put(place)
        shown = ",".join(f"{x:.3g}" for x in place)
        line = f"the object stands at {shown}, where no points are in its way (--at, --place)"
        return replace(placement, assumed=(*placement.assumed, line))
    placement = put(world.place)
    if count := len(points_in_way(placement.asset_to_world, low, high, world.cloud)):
        warning = f"{count} points of --ground-points stand where the object does; is it free?"
        placement = replace(placement, warnings=(*placement.warnings, warning))
    return placement


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


def photo_camera(config: InsertConfig, photo: Photo, assumed: list[str]) -> PhotoCamera:
    """Return the camera of --camera, else of the numbers given, the photo's EXIF and what is usual.

    Args:
        config: The flags.
        photo: The upright photo.
        assumed: What was chosen because nothing was given is appended here.

    Raises:
        InputError: The camera file cannot be used, or does not fit the photo.
    """
    height, width = photo.codes.shape[:2]
    if config.camera.file is not None:
        assert config.inputs.photo is not None
        return read_photo_camera(
            config.camera.file,
            (width, height),
            config.camera.up,
            frame=config.camera.frame,
            photo_name=Path(config.inputs.photo).name,
            undistort=config.camera.undistort,
            limits=config.limits,
        )
    return PhotoCamera(_camera_from_numbers(config, photo, assumed))


def _camera_from_numbers(config: InsertConfig, photo: Photo, assumed: list[str]) -> Camera:
    height, width = photo.codes.shape[:2]
    camera_height, pitch = config.camera.height, config.camera.pitch
    if camera_height is None:
        camera_height = DEFAULT_CAMERA_HEIGHT
        assumed.append(f"the camera is {camera_height} m above the ground (--camera-height)")
    if pitch is None:
        pitch = 0.0
        if config.camera.horizon is None:
            assumed.append("the camera is level (--pitch, --horizon)")
    pose = (pitch, camera_height, config.camera.horizon)
    if config.camera.fov is None and photo.focal_35mm is not None:
        return camera_from_exif(photo.focal_35mm, width, height, *pose)
    if config.camera.fov is None:
        assumed.append(f"the horizontal field of view is {DEFAULT_FOV:g} degrees (--fov)")
    return camera_from_fov(width, height, config.camera.fov or DEFAULT_FOV, *pose)


def _read_mask(
    path: str | None, photo: Photo | None, config: InsertConfig, notices: list[str]
) -> FloatArray | None:
    if path is None or photo is None:
        return None
    height, width = photo.codes.shape[:2]
    found: list[str] = []
    mask = read_mask(path, (width, height), max_pixels=config.limits.pixels, notices=found)
    notices += _about(path, found)
    return mask


def _read_light(
    config: InsertConfig, camera_to_world: Float64Array, notices: list[str]
) -> Light | None:
    if config.light.file is None:
        return None
    if Path(config.light.file).suffix.lower() == ".json":
        if config.light.fit_lobes is not None:
            raise usage(
                "--fit-lobes", f"needs a panorama to fit (found lobes: {config.light.file})"
            )
        if config.light.convention != "openexr":
            raise usage(
                "--light-convention", f"is for panoramas (found lobes: {config.light.file})"
            )
        return Light(lobes=read_lobes(config.light.file, config.limits)).rotated(
            config.light.rotate
        )
    found: list[str] = []
    texels = read_envmap(
        config.light.file,
        convention=config.light.convention,
        camera_to_world=camera_to_world,
        pictures=True,
        strict=config.inputs.strict,
        max_width=config.limits.envmap_width,
        notices=found,
    )
    notices += _about(config.light.file, found)
    return Light(texels=texels).rotated(config.light.rotate)


def _about(path: str, notices: tuple[str, ...] | list[str]) -> list[str]:
    return [f"{Path(path).name}: {notice}" for notice in notices]
