"""Scenes that the referee judges: an asset on the ground, a camera, a light."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warpir.core.arrays import FloatArray
from warpir.io.assets import load_asset
from warpir.io.images.photos import read_envmap
from warpir.mitsuba.render import Setting
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.placement import place_asset

LIGHT_WIDTH = 512
"""Columns of the light after averaging down, a divisor of the files' width."""


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

    def setting(self, assets: Path) -> Setting:
        """Return asset, pose, camera and light."""
        asset, camera = load_asset(assets / self.asset), self.camera()
        stand = {"place": (0.0, 0.0, 0.0), "rotate_y": self.rotate_y, "size": self.size}
        placement = place_asset(*asset.bounds(), camera, **stand)
        return Setting(asset, placement.asset_to_world, camera, self.texels(assets))

    def camera(self) -> Camera:
        """Camera on the +Z side, aimed at ``aim`` above the object's foot."""
        drop = self.camera_height - self.aim * self.size
        pitch = -float(np.degrees(np.arctan2(drop, self.distance)))
        view = camera_from_fov(144, 96, self.fov, pitch, self.camera_height)
        c2w = view.c2w.copy()
        c2w[2, 3] = self.distance
        return replace(view, c2w=c2w)

    def texels(self, assets: Path) -> FloatArray:
        """Light, relative [W/(m^2 sr)], shape [LIGHT_WIDTH / 2, LIGHT_WIDTH, 3]."""
        full = read_envmap(assets / self.light).astype(np.float64)
        factor = full.shape[1] // LIGHT_WIDTH
        blocks = full.reshape(LIGHT_WIDTH // 2, factor, LIGHT_WIDTH, factor, 3)
        # Longitude grows to the left, so a counter-clockwise turn rolls to the left
        shift = -round(self.light_rotate / 360.0 * LIGHT_WIDTH)
        return np.roll(blocks.mean(axis=(1, 3)), shift, axis=1).astype(np.float32)


SUNNY, OVERCAST = "hdri/modern_buildings_2_1k.hdr", "hdri/potsdamer_platz_1k.hdr"
PARK, NIGHT = "hdri/rooitou_park_1k.hdr", "hdri/st_peters_square_night_1k.hdr"
INDOOR, STUDIO = "hdri/lebombo_1k.hdr", "hdri/studio_small_03_1k.hdr"
TOYCAR, TRUCK = "mesh/ToyCar.glb", "mesh/kenney_trucks/vehicle-truck-red.glb"
SPOT, MUG, BALL = "mesh/spot/spot.obj", "mesh/mug.glb", "mesh/shaderball.glb"
WICKER, ALPHA = "mesh/ClearcoatWicker.glb", "mesh/AlphaBlendModeTest.glb"
PRESETS = (
    ScenePreset("toycar_sunny", TOYCAR, SUNNY, 0.3, 0.8, 0.35, 0.22, 22.0, rotate_y=-50.0),
    ScenePreset("toycar_overcast", TOYCAR, OVERCAST, 0.3, 0.8, 0.35, 0.22, 22.0, rotate_y=-50.0),
    ScenePreset("truck_overcast", TRUCK, OVERCAST, 5.0, 12.0, 3.0, rotate_y=35.0),
    ScenePreset("spot_night", SPOT, NIGHT, 1.0, 3.0, 1.0, 0.5, rotate_y=-140.0),
    ScenePreset("mug_indoor", MUG, INDOOR, 0.12, 0.4, 0.2, 0.35, light_rotate=90.0),
    ScenePreset("shaderball_studio", BALL, STUDIO, 0.5, 1.5, 0.5, 0.48, rotate_y=20.0),
    ScenePreset("wicker_sunny", WICKER, SUNNY, 0.5, 1.6, 0.5, 0.5, light_rotate=120.0),
    ScenePreset("truck_sunny", TRUCK, PARK, 5.0, 12.0, 2.0, rotate_y=-35.0),
    ScenePreset("alpha_overcast", ALPHA, OVERCAST, 1.0, 2.2, 0.4, 0.15),
)
