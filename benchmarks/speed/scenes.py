"""The scenes, lights and losses that `benchmarks.speed` gives to every renderer.

A scene is an object on the plane y = 0 under 32 spherical Gaussians. Renderers see those as one
lat-long map, so that all estimate the same integrals; the loss is linear in the foreground and in
the shadow ratio, with weights that are part smooth and part noise, as a guidance gradient is.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.referee.subjects import ball
from benchmarks.scenes import on_the_ground
from benchmarks.speed.textured import textured_heap
from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.core.latlong import resize_map
from warpir.io.assets import load_asset
from warpir.io.images.photos import read_envmap
from warpir.lighting.fit import fit_lobes
from warpir.render.device_light import light_args
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import shaded_pixels
from warpir.scene.asset import Asset, Material, Primitive
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.light import Light, Lobes, axis_from_angles, rasterize_lobes
from warpir.scene.placement import place_asset

NAMES = ("ball", "toycar", "metal", "textured")
PLACES = {
    "ball": ((-0.3, 0.0, -5.5), 0.0, 1.5),
    "toycar": ((0.0, 0.0, -5.5), -35.0, 2.0),
    "textured": ((-0.3, 0.0, -5.5), 30.0, 1.6),
}
"""Where the object stands [m], its turn about +Y [deg], and its longest side [m]; others stand as
the ball does."""
TOYCAR = "mesh/ToyCar.glb"
PANORAMA = "hdri/modern_buildings_2_1k.hdr"
PANORAMA_HEIGHT = 256
MAP_HEIGHT = 32
"""Rows of the light's map."""
PANORAMA_TURN = -90.0
"""About +Y [deg]."""
SHARPNESS_MAX = 2000.0
"""Sharper lobes are widened to this, flux kept: a map of 64 rows holds them."""
COVERAGE_SAMPLES = 64
"""Camera samples per pixel that decide which pixels are the plane's."""


@dataclass(frozen=True)
class SpeedScene:
    """One scene with all that is fixed before the clock runs."""

    name: str
    asset: Asset
    matrix: Float64Array
    """Asset to world, shape [4, 4]."""
    camera: Camera
    lobes: Lobes
    depth: int
    """Surface interactions of the longest path."""
    triangles: int
    renderer: Renderer
    object_pixels: IntArray
    """Row-major, shape [object_pixel]."""
    receiver_pixels: IntArray
    """Row-major pixels whose plane the object may shade and at most half hides, shape
    [receiver_pixel]."""
    weight_fg: FloatArray
    """Loss gradient of the foreground, shape [object_pixel, 3]."""
    weight_ratio: FloatArray
    """Loss gradient of the shadow ratio, shape [receiver_pixel, 3]."""

    def record(self) -> dict[str, Any]:
        """Return its sizes."""
        return {
            "name": self.name,
            "triangles": self.triangles,
            "depth": self.depth,
            "object_pixels": len(self.object_pixels),
            "receiver_pixels": len(self.receiver_pixels),
        }

    def texels(self) -> FloatArray:
        """Return the light as a map, relative [W/(m^2 sr)], shape [He, We, 3]."""
        return rasterize_lobes(self.lobes, MAP_HEIGHT, 2 * MAP_HEIGHT)


def standing_ball(rings: int = 128) -> Primitive:
    """Return a unit ball of ``4 rings (rings - 1)`` triangles standing on y = 0."""
    unit = ball(rings)
    return replace(unit, positions=unit.positions + np.array([0.0, 1.0, 0.0]))


def sun_and_sky(seed: int = 7) -> Lobes:
    """Return one sharp lobe and 31 broad ones, brighter above the horizon."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(31, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    color = rng.uniform(0.02, 0.2, (31, 3)) * np.where(axis[:, 1:2] > 0.0, 1.0, 0.3)
    sun = axis_from_angles(-60.0, 38.0)
    return Lobes(
        np.concatenate([[[110.0, 100.0, 85.0]], color]).astype(np.float32),
        np.concatenate([sun[None], axis]).astype(np.float32),
        np.concatenate([[400.0], rng.uniform(2.0, 20.0, 31)]).astype(np.float32),
    )


def panorama_lobes(path: Path) -> Lobes:
    """Fit 32 lobes to a panorama, turned so that its sun stands to the left."""
    texels = resize_map(read_envmap(path), PANORAMA_HEIGHT)
    lobes = Light(fit_lobes(texels, 32).lobes).rotated(PANORAMA_TURN).lobes
    assert lobes is not None
    sharpness = np.minimum(lobes.sharpness, SHARPNESS_MAX)
    amplitude = lobes.amplitude * (sharpness / lobes.sharpness)[:, None]
    return Lobes(amplitude.astype(np.float32), lobes.axis, sharpness.astype(np.float32))


def make_scene(
    name: str, width: int, height: int, assets: Path, device: str, threads: int
) -> SpeedScene:
    """Build one of `NAMES`, in pictures of that width and height [px].

    Raises:
        FileNotFoundError: A file of the scene is absent.
    """
    camera = camera_from_fov(width, height, 40.0, -12.0, 1.4)
    asset, lobes, depth = _contents(name, assets)
    place, turn, size = PLACES.get(name, PLACES["ball"])
    placement = place_asset(*asset.bounds(), camera, None, place=place, rotate_y=turn, size=size)
    renderer = on_the_ground(asset, placement.asset_to_world, camera, device)
    renderer.threads = threads
    object_pixels = renderer.gbuffer(seed=1, spp=COVERAGE_SAMPLES).object_pixels
    light = light_args(Light(lobes), renderer.device)
    hidden = np.zeros(width * height)
    seen = renderer.foreground(light, object_pixels, COVERAGE_SAMPLES, 1, 1, seed=2)
    hidden[object_pixels] = seen.mask
    shaded = shaded_pixels(renderer, light, seed=3)
    receiver_pixels = shaded[hidden[shaded] <= 0.5]
    weight = loss_weights(width, height)
    return SpeedScene(
        name,
        asset,
        placement.asset_to_world,
        camera,
        lobes,
        depth,
        sum(len(p.indices) for p in asset.primitives),
        renderer,
        object_pixels,
        receiver_pixels,
        weight[0].reshape(-1, 3)[object_pixels],
        weight[1].reshape(-1, 3)[receiver_pixels],
    )


def _contents(name: str, assets: Path) -> tuple[Asset, Lobes, int]:
    """Return the object, the light, and how many surfaces the longest path meets."""
    if name == "toycar":
        for file in (TOYCAR, PANORAMA):
            if not (assets / file).exists():
                raise FileNotFoundError(f"{file} is not in the folder of assets")
        return load_asset(assets / TOYCAR), panorama_lobes(assets / PANORAMA), 5
    if name == "textured":
        return textured_heap(), sun_and_sky(), 3
    metal = name == "metal"
    material = Material(
        base_color=(0.95, 0.75, 0.45) if metal else (0.8, 0.35, 0.2),
        metallic=1.0 if metal else 0.0,
        roughness=0.3 if metal else 0.6,
    )
    return Asset(name, (standing_ball(),), (material,)), sun_and_sky(), 3


def loss_weights(width: int, height: int) -> FloatArray:
    """Return colour ramps plus noise for foreground and ratio, shape [2, height, width, 3]."""
    rng = np.random.default_rng(11)
    row, column = np.mgrid[0:height, 0:width] / height
    smooth = np.stack([0.5 + row, 0.5 + column, 1.5 - row], axis=-1)
    return (smooth + rng.normal(0.0, 0.5, (2, height, width, 3))).astype(np.float32)
