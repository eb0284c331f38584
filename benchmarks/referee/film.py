"""Do thin films reflect and pass light as the specification's formulas do in Mitsuba?

    python -m benchmarks.referee.film --spp 4096

Mitsuba has no BSDF with a thin film: its side is `warpir.mitsuba`, the specification written again.
"""

from dataclasses import replace

import numpy as np

from benchmarks.referee import ours
from benchmarks.referee.ours import Runs
from benchmarks.referee.sheet import Pair, compare_cases
from benchmarks.referee.subjects import ball
from warpir.core.arrays import FloatArray
from warpir.mitsuba import render as theirs
from warpir.mitsuba.render import Setting
from warpir.scene.asset import Asset, Material, Texture, TextureSlot
from warpir.scene.camera import Camera

DEPTH = 8
"""Interactions; the inside of what passes light is seen."""
ABOVE = np.diag([0.7, 0.7, 0.7, 1.0])
ABOVE[1, 3] = 0.75
"""Places the ball over the ground, which hides what is below it."""


def cases() -> dict[str, Asset]:
    """Return what is compared, by name."""
    body = ball(32)
    # 8-bit codes of a smooth random texture
    codes = np.random.default_rng(3).integers(0, 256, (6, 12, 4), dtype=np.uint8)
    oil = Material(
        base_color=(0.1, 0.1, 0.1),
        metallic=0.0,
        roughness=0.25,
        iridescence=1.0,
        iridescence_thickness=(150.0, 600.0),
        iridescence_thickness_texture=TextureSlot(0),
    )
    copper = replace(oil, base_color=(0.9, 0.6, 0.4), metallic=1.0, iridescence=0.8)
    brushed = {"anisotropy": 0.7, "anisotropy_rotation": 0.5, "anisotropy_texture": TextureSlot(0)}
    metal = replace(copper, iridescence_ior=1.8, **brushed)
    clear = replace(oil, base_color=(1.0, 1.0, 1.0), transmission=1.0, ior=1.0)
    soap = replace(clear, iridescence_ior=1.33, double_sided=True)
    return {
        name: Asset(name, (body,), (material,), (Texture(codes),))
        for name, material in (("oil", oil), ("metal", metal), ("soap", soap))
    }


def both(asset: Asset, view: Camera, texels: FloatArray, spp: int) -> Pair:
    """Return our picture and theirs."""
    setting = Setting(asset, ABOVE, view, texels)
    found, true = (Runs(*side.foreground(setting, DEPTH, spp, 7)[:2]) for side in (ours, theirs))
    return found, true


if __name__ == "__main__":
    compare_cases(__doc__, cases(), both)
