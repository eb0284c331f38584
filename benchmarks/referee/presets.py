"""Scenes that benchmarks and previews share: an asset on the ground, a camera, a light."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera


@dataclass(frozen=True)
class ScenePreset:
    """One object standing on the ground (world y = 0), seen from a camera above it."""

    name: str
    asset: str
    """Asset file, relative to the folder of assets."""
    light: str
    """Lat-long Radiance file, relative to the folder of assets."""
    size: float
    """Largest extent of the placed object [m]."""
    distance: float
    """From the camera to the object's centre, along the ground [m]."""
    camera_height: float
    """Camera above the ground [m]."""
    aim: float = 0.3
    """Height of the point looked at, in units of ``size`` [1]."""
    fov: float = 30.0
    """Horizontal angle of view [deg]."""
    rotate_y: float = 0.0
    """Turn of the object about +Y, counter-clockwise seen from above [deg]."""
    light_rotate: float = 0.0
    """Turn of the light about +Y, rounded to a texel [deg]."""
    light_width: int = 512
    """Columns of the light after averaging down, a divisor of the file's width."""
    width: int = 144
    """Image width [px]."""
    height: int = 96
    """Image height [px]."""

    def matrix(self, asset: Asset) -> Float64Array:
        """Asset to world: scaled to ``size``, turned, centred and set on the ground, [4, 4]."""
        low, high = asset.bounds()
        scale = self.size / float(np.max(high - low))
        angle = np.radians(self.rotate_y)
        turn = np.array(
            [
                [np.cos(angle), 0.0, np.sin(angle)],
                [0.0, 1.0, 0.0],
                [-np.sin(angle), 0.0, np.cos(angle)],
            ]
        )
        matrix = np.eye(4)
        matrix[:3, :3] = scale * turn
        base = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
        matrix[:3, 3] = -matrix[:3, :3] @ base
        return matrix

    def camera(self) -> Camera:
        """Camera on the +Z side, aimed at ``aim`` above the object's foot."""
        position = np.array([0.0, self.camera_height, self.distance])
        drop = self.camera_height - self.aim * self.size
        pitch = np.arctan2(drop, self.distance)
        c2w = np.eye(4)
        c2w[1:3, 1:3] = [[np.cos(pitch), np.sin(pitch)], [-np.sin(pitch), np.cos(pitch)]]
        c2w[:3, 3] = position
        focal = 0.5 * self.width / np.tan(np.radians(0.5 * self.fov))
        return Camera(
            self.width, self.height, focal, focal, 0.5 * self.width, 0.5 * self.height, c2w
        )

    def texels(self, assets: Path) -> FloatArray:
        """Light, relative [W/(m^2 sr)], shape [light_width / 2, light_width, 3]."""
        import OpenImageIO as oiio

        image = oiio.ImageInput.open(str(assets / self.light))
        if image is None:
            raise FileNotFoundError(assets / self.light)
        full = image.read_image("float32")[..., :3].astype(np.float64)
        image.close()
        factor = full.shape[1] // self.light_width
        rows, columns = full.shape[0] // factor, full.shape[1] // factor
        small = full.reshape(rows, factor, columns, factor, 3).mean(axis=(1, 3))
        # Longitude grows to the left, so a counter-clockwise turn rolls to the left
        shift = -round(self.light_rotate / 360.0 * columns)
        return np.roll(small, shift, axis=1).astype(np.float32)


TOYCAR = ScenePreset(
    "toycar_sunny",
    "mesh/ToyCar.glb",
    "hdri/modern_buildings_2_1k.hdr",
    size=0.3,
    distance=0.8,
    camera_height=0.35,
    aim=0.22,
    fov=22.0,
    rotate_y=-50.0,
)
PRESETS = (
    TOYCAR,
    replace(TOYCAR, name="toycar_overcast", light="hdri/potsdamer_platz_1k.hdr"),
    ScenePreset(
        "truck_overcast",
        "mesh/kenney_trucks/vehicle-truck-red.glb",
        "hdri/potsdamer_platz_1k.hdr",
        size=5.0,
        distance=12.0,
        camera_height=3.0,
        rotate_y=35.0,
    ),
    ScenePreset(
        "spot_night",
        "mesh/spot/spot.obj",
        "hdri/st_peters_square_night_1k.hdr",
        size=1.0,
        distance=3.0,
        camera_height=1.0,
        aim=0.5,
        rotate_y=-140.0,
    ),
    ScenePreset(
        "mug_indoor",
        "mesh/mug.glb",
        "hdri/lebombo_1k.hdr",
        size=0.12,
        distance=0.4,
        camera_height=0.2,
        aim=0.35,
        light_rotate=90.0,
    ),
    ScenePreset(
        "shaderball_studio",
        "mesh/shaderball.glb",
        "hdri/studio_small_03_1k.hdr",
        size=0.5,
        distance=1.5,
        camera_height=0.5,
        aim=0.48,
        rotate_y=20.0,
    ),
    ScenePreset(
        "wicker_sunny",
        "mesh/ClearcoatWicker.glb",
        "hdri/modern_buildings_2_1k.hdr",
        size=0.5,
        distance=1.6,
        camera_height=0.5,
        aim=0.5,
        light_rotate=120.0,
    ),
    ScenePreset(
        "truck_sunny",
        "mesh/kenney_trucks/vehicle-truck-red.glb",
        "hdri/rooitou_park_1k.hdr",
        size=5.0,
        distance=12.0,
        camera_height=2.0,
        rotate_y=-35.0,
    ),
    ScenePreset(
        "alpha_overcast",
        "mesh/AlphaBlendModeTest.glb",
        "hdri/potsdamer_platz_1k.hdr",
        size=1.0,
        distance=2.2,
        camera_height=0.4,
        aim=0.15,
    ),
)
