"""Scenes with a known light: photographs cut out of panoramas, and objects that stand in them.

A place is a photograph: a panorama seen by a camera that is turned at random, so that no constant
guess of the light's direction can score well. In each place one asset stands on the ground twice,
once diffuse and once glossy. Everything is a function of the seed, the number of the place and the
names of the files (method: DiPIR's Poly Haven test, whose scenes were set up by hand).

The photo is ``clip(alpha * radiance ** (1 / 2.2), 0, 1)`` with the 99th percentile of its non-zero
values at 0.9, so its linear exposure is ``alpha ** 2.2``: with ``--tone linear`` and that exposure,
an object is lit and shown exactly as the place itself. Only the camera turns; the panorama stays as
it is, since it is the light.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import count, product
from pathlib import Path
from typing import TypeVar

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import expose, gamma_to_linear, linear_to_gamma, luminance
from warpir.core.errors import InputError
from warpir.core.latlong import look_up, resize_map, rotate_map
from warpir.io.assets import load_asset
from warpir.io.images.photos import read_envmap
from warpir.scene.asset import Asset, Material
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.light import Light, summarize
from warpir.scene.placement import Placement, place_asset, point_on_ground, turn, upright_plane

Read = TypeVar("Read")

LIGHT_HEIGHT = 512
"""Rows of the map that a panorama is averaged to where it is the light."""
PANORAMA_SUFFIXES = (".hdr", ".exr")
ASSET_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
AZIMUTHS = 256
"""Directions that a camera may look: whole columns of every map that is compared."""
PITCH = (-15.0, 5.0)
"""Least and greatest upward tilt of the camera [deg]."""
CAMERA_HEIGHT = 1.6
"""Height of the camera above the ground [m]."""
ASPECT = 1.5
"""Width of the photograph over its height [1]."""
HEIGHT_SHARE = (0.20, 0.35)
"""Least and greatest height of the object over that of the photograph [1]."""
WIDTH_SHARE = 0.45
"""Greatest width of the object over that of the photograph [1]."""
FOOT_COLUMN = (0.3, 0.7)
"""Range of the object's foot, over the photograph's width [1]."""
FOOT_ROW = (0.35, 0.75)
"""Range of the object's foot, over the distance from the horizon to the lower edge [1]."""
EDGE = 0.02
"""Share of the photograph that the object keeps away from its edges [1]."""
SUNNY_SHARE = 0.25
"""A sunny place sends at least this share of its flux from within 5 degrees of the peak [1]."""
SUNNY_PEAK = 3000.0
"""Least peak of a sunny place over its mean: lamps and soft boxes are larger than a sun [1]."""
MATERIALS = {"diffuse": (0.0, 1.0), "glossy": (1.0, 0.3)}
"""Metallic and roughness of the two objects of a place; their colours are the asset's own."""


# ------------------------------------------------------------------------- views of a panorama


def crop_camera(
    width: int, height: int, fov: float, azimuth: float, pitch: float, camera_height: float
) -> Camera:
    """Return a camera above the origin that is turned to an azimuth.

    Args:
        width: Image width [px].
        height: Image height [px].
        fov: Horizontal field of view [deg].
        azimuth: Azimuth of the camera, clockwise from -Z seen from above [deg].
        pitch: Upward tilt of the camera [deg].
        camera_height: Above the ground y = 0 [m].
    """
    return turned_to(camera_from_fov(width, height, fov, pitch, camera_height), azimuth)


def turned_to(camera: Camera, azimuth: float) -> Camera:
    """Return a camera that looks toward -Z, turned clockwise as seen from above [deg]."""
    c2w = camera.c2w.copy()
    c2w[:3, :3] = turn(np.array([0.0, 1.0, 0.0]), -np.radians(azimuth)) @ c2w[:3, :3]
    return replace(camera, c2w=c2w)


def crop_radiance(texels: FloatArray, camera: Camera, side: int = 2) -> Float64Array:
    """Return what a camera sees of a lat-long map, linear, shape [height, width, 3].

    A pixel averages ``side`` rows and columns of look-ups.
    """
    step = (np.arange(side) + 0.5) / side
    total = np.zeros((camera.height, camera.width, 3))
    for v, u in product(step, step):
        total += look_up(texels, camera.pixel_rays(u, v))
    return total / side**2


# ------------------------------------------------------------------------ the camera's response


def _filmic(x: Float64Array) -> Float64Array:
    """Return Narkowicz's fit of the ACES film curve, linear to display-linear, clipped to 1."""
    shown: Float64Array = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    return np.clip(shown, 0.0, 1.0)


def _filmic_inverse(y: Float64Array) -> Float64Array:
    """Return the linear value that `_filmic` shows as ``y`` in [0, 1]."""
    a, b, c = 2.43 * y - 2.51, 0.59 * y - 0.03, 0.14 * y
    linear: Float64Array = (-b - np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return np.maximum(linear, 0.0)


@dataclass(frozen=True)
class Response:
    """Response of a camera, radiance to display-linear values, and its inverse; elementwise."""

    show: Callable[[Float64Array], Float64Array]
    """Radiance, photo-linear, to display-linear values in [0, 1]."""
    invert: Callable[[Float64Array], Float64Array]
    """Display-linear values to the least radiance that is shown so."""


RESPONSES = {
    "gamma": Response(lambda x: np.clip(x, 0.0, 1.0), lambda y: y),
    "filmic": Response(_filmic, _filmic_inverse),
}
"""Responses by name: clipping alone (DiPIR's photographs), and a film curve unknown to methods."""


# --------------------------------------------------------------------------------------- places


@dataclass(frozen=True)
class Place:
    """A photograph and the light it was taken in."""

    name: str
    """Number and panorama, such as ``003-noon_grass_1k``: unique, and fit for a file name."""
    panorama: str
    """File name without its ending."""
    camera: Camera
    """Camera above the world's origin, turned by `azimuth`; the ground is y = 0."""
    azimuth: float
    """Viewing direction, clockwise from -Z seen from above [deg]."""
    pitch: float
    """Upward tilt of the camera [deg]."""
    photo: FloatArray
    """Display-encoded, 8-bit codes as floats in [0, 1], shape [H, W, 3]."""
    exposure: float
    """Photo-linear radiance over the panorama's [1]."""
    response: str
    """Response of the camera, a key of `RESPONSES`."""
    radiance: FloatArray
    """The panorama itself, unturned, shape [512, 1024, 3]."""
    seed: tuple[int, ...]
    """Seed of all random numbers of this place."""

    @cached_property
    def texels(self) -> FloatArray:
        """The true light, world frame, photo-linear, shape [512, 1024, 3]."""
        return (self.radiance * np.float32(self.exposure)).astype(np.float32)

    @cached_property
    def photo_lin(self) -> FloatArray:
        """The photograph, decoded as warpir decodes photographs, shape [H, W, 3]."""
        return gamma_to_linear(self.photo)

    @cached_property
    def is_sunny(self) -> bool:
        """Whether a sun is up (`SUNNY_SHARE`, `SUNNY_PEAK`)."""
        summary = summarize(Light(texels=self.radiance))
        peak = float(luminance(self.radiance).max())
        return (
            summary.peak_share >= SUNNY_SHARE
            and peak >= SUNNY_PEAK * summary.mean_luminance
            and summary.elevation_deg > 0.0
        )

    def to_camera(self, texels: FloatArray) -> FloatArray:
        """Turn a map from the world frame to the camera-yaw frame."""
        return rotate_map(texels, self.azimuth)

    def to_world(self, texels: FloatArray) -> FloatArray:
        """Turn a map from the camera-yaw frame to the world frame."""
        return rotate_map(texels, -self.azimuth)


@dataclass(frozen=True)
class Subject:
    """An object that stands in a place."""

    place: Place
    asset: Asset
    """The asset with the surface of `material`."""
    asset_path: Path
    """File of the asset."""
    material: str
    """Surface of the asset, a key of `MATERIALS`."""
    placement: Placement
    """Pose on the ground y = 0."""

    @property
    def name(self) -> str:
        """Place, asset and material."""
        return f"{self.place.name}-{self.asset_path.stem}-{self.material}"


def find_files(paths: Sequence[Path], suffixes: Sequence[str], where: str) -> list[Path]:
    """Return the files of some kinds among files and folders, by name; folders to any depth.

    Raises:
        InputError: A path is missing, or nothing was found.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(path, "no such file or folder", f"{where} needs one")
        files = path.rglob("*") if path.is_dir() else [path]
        found += [f for f in files if f.suffix.lower() in suffixes and f.is_file()]
    if not found:
        kinds = ", ".join(suffixes)
        raise InputError(", ".join(map(str, paths)), f"nothing for {where} here (expected {kinds})")
    return sorted(set(found), key=lambda f: (f.name, str(f)))


class Places:
    """A sequence of places, generated on demand, each with its subjects.

    Every panorama is seen once before any is seen again; so are the assets. A file that cannot be
    used is left out with a notice.

    Args:
        panoramas: Files of lat-long radiance.
        assets: Files of objects.
        seed: Seed of all random numbers.
        width: Width of the photographs [px]; their height is two thirds of it.
        fov: Vertical field of view [deg].
        response: A key of `RESPONSES`.
    """

    def __init__(
        self,
        panoramas: Sequence[Path],
        assets: Sequence[Path],
        seed: int,
        width: int = 384,
        fov: float = 60.0,
        response: str = "gamma",
    ) -> None:
        self.seed, self.width, self.fov, self.response = seed, width, fov, response
        self.height = round(width / ASPECT)
        self.notices: list[str] = []
        self._radiance: dict[Path, FloatArray] = {}
        self._panoramas = self._usable(panoramas, self._read_panorama, "--panoramas", 0)
        read_asset = cache(lambda path: load_asset(path, "grey"))
        self._subjects = self._usable(assets, read_asset, "--assets", 1)

    def _usable(
        self, paths: Sequence[Path], read: Callable[[Path], Read], where: str, stream: int
    ) -> Iterator[tuple[Path, Read]]:
        """Yield usable files and their content without end, in a new random order each round."""
        left = list(paths)
        for lap in count():
            order = np.random.default_rng([self.seed, stream, lap]).permutation(len(left))
            for path in [left[k] for k in order]:
                try:
                    content = read(path)
                except InputError as error:
                    self.notices.append(f"left out: {error.where}: {error.what}")
                    left.remove(path)
                else:
                    yield path, content
            if not left:
                raise InputError(where, "none of the files found can be used", self.notices[-1])

    def _read_panorama(self, path: Path) -> FloatArray:
        """Return a panorama's full map, and keep the light averaged from it."""
        texels = read_envmap(path)
        if not texels.any():
            raise InputError(path, "all black")
        self._radiance.setdefault(path, resize_map(texels, LIGHT_HEIGHT))
        return texels

    def make(self, number: int) -> list[tuple[Place, list[Subject]]]:
        """Return the first ``number`` places, each with a diffuse and a glossy subject.

        Raises:
            InputError: None of the panoramas or assets can be used.
        """
        places = []
        for k in range(number):
            place = self._place(k, *next(self._panoramas))
            places.append((place, self._stand(place, *next(self._subjects))))
        return places

    def _place(self, k: int, path: Path, panorama: FloatArray) -> Place:
        seed = (self.seed, k, zlib.crc32(path.stem.encode()))
        rng = np.random.default_rng([2, *seed])
        azimuth = 360.0 / AZIMUTHS * int(rng.integers(AZIMUTHS))
        pitch = float(rng.uniform(*PITCH))
        across = 2.0 * np.degrees(np.arctan(np.tan(np.radians(self.fov) / 2.0) * ASPECT))
        camera = crop_camera(self.width, self.height, float(across), azimuth, pitch, CAMERA_HEIGHT)
        seen = crop_radiance(panorama, camera)
        if not seen.any():
            raise InputError(path, f"all black toward azimuth {azimuth:g} degrees")
        display, ev = expose(seen)
        exposure = 2.0**ev
        if self.response != "gamma":
            shown = RESPONSES[self.response].show(seen * exposure)
            display = linear_to_gamma(shown).astype(np.float64)
        photo = (np.round(255.0 * display) / 255.0).astype(np.float32)
        return Place(
            name=f"{k:03d}-{path.stem}",
            panorama=path.stem,
            camera=camera,
            azimuth=azimuth,
            pitch=pitch,
            photo=photo,
            exposure=exposure,
            response=self.response,
            radiance=self._radiance[path],
            seed=seed,
        )

    def _stand(self, place: Place, path: Path, asset: Asset) -> list[Subject]:
        rng = np.random.default_rng([3, *place.seed])
        camera = place.camera
        horizon = camera.cy + camera.fy * np.tan(np.radians(place.pitch))
        lowest = (1.0 - EDGE) * camera.height
        at = (
            float(rng.uniform(*FOOT_COLUMN)) * camera.width,
            float(horizon + rng.uniform(*FOOT_ROW) * (lowest - horizon)),
        )
        yaw = float(rng.uniform(0.0, 360.0))
        share = float(rng.uniform(*HEIGHT_SHARE))
        low, high = asset.bounds()
        stand = point_on_ground(at, camera, upright_plane(None, camera.c2w[:3, 3]))
        size = _largest(low, high, camera, stand, yaw, share)
        placement = place_asset(low, high, camera, at=at, rotate_y=yaw, size=size)
        return [
            Subject(place, with_surface(asset, *surface), path, name, placement)
            for name, surface in MATERIALS.items()
        ]


def _largest(
    low: Float64Array,
    high: Float64Array,
    camera: Camera,
    stand: Float64Array,
    yaw: float,
    share: float,
) -> float:
    """Return the size [m] at which the object's box is ``share`` of the photograph high.

    Less if it would be wider than `WIDTH_SHARE` or come within `EDGE` of the photograph's edge.

    Args:
        low: Lowest corner of the asset's box, asset frame [m], shape [3].
        high: Highest corner, shape [3].
        camera: The view.
        stand: Place of the object, world frame [m], shape [3].
        yaw: Turn of the object, counter-clockwise seen from above [deg].
        share: Height of the object over that of the photograph [1].
    """
    sides = (high - low) / max(float((high - low).max()), 1e-12)
    grid = np.stack(np.meshgrid(*[(0.0, 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    box = (grid - (0.5, 0.0, 0.5)) * sides
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    box = box @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]).T
    frame = np.array([camera.width, camera.height])

    def fits(size: float) -> bool:
        pixels = camera.project(stand + size * box) / frame
        if not np.isfinite(pixels).all():
            return False
        left_top, right_bottom = pixels.min(axis=0), pixels.max(axis=0)
        wide, tall = right_bottom - left_top
        inside = (left_top >= EDGE).all() and (right_bottom <= 1.0 - EDGE).all()
        return bool(inside and tall <= share and wide <= WIDTH_SHARE)

    # The projected box grows with the size as long as it is in front of the camera.
    least, most = 0.0, 2.0 * float(np.linalg.norm(stand - camera.c2w[:3, 3]))
    for _ in range(40):
        middle = 0.5 * (least + most)
        least, most = (middle, most) if fits(middle) else (least, middle)
    return least


def with_surface(asset: Asset, metallic: float, roughness: float) -> Asset:
    """Return the asset with other roughness and metallic, its own colours, and no emission.

    Emission carries no information about the light.
    """

    def changed(material: Material) -> Material:
        return replace(
            material,
            metallic=metallic,
            roughness=roughness,
            metallic_roughness_texture=None,
            emission=(0.0, 0.0, 0.0),
            emission_texture=None,
        )

    return replace(asset, materials=tuple(changed(m) for m in asset.materials))


def mirrored(light: Light, azimuth: float) -> Light:
    """Return a light reflected at the vertical plane that a camera looks along.

    Args:
        light: World frame.
        azimuth: Azimuth of the camera, clockwise from -Z seen from above [deg].
    """
    lobes, texels = light.lobes, light.texels
    if lobes is not None:
        right = np.array([np.cos(np.radians(azimuth)), 0.0, np.sin(np.radians(azimuth))])
        axis = lobes.axis - 2.0 * (lobes.axis @ right)[:, None] * right
        lobes = replace(lobes, axis=axis.astype(np.float32))
    if texels is not None:
        flipped = rotate_map(texels, azimuth)[:, ::-1]
        texels = rotate_map(np.ascontiguousarray(flipped), -azimuth)
    return Light(lobes, texels)
