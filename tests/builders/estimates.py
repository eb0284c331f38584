"""What estimates of a photo may be, and what they are made of, for tests that need one."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tests.builders.shapes import box
from warpir.app.inputs import Inputs
from warpir.core.arrays import FloatArray
from warpir.io.images.photos import Photo
from warpir.io.results import OutputFolder
from warpir.lighting.regression import Regression
from warpir.lighting.regressor import AMBIENT_SHARPNESS, ambient_axes, candidates
from warpir.scene.asset import Asset, Material
from warpir.scene.camera import Camera, CameraEstimate
from warpir.scene.light import Lobes, axis_from_angles
from warpir.scene.placement import place_asset


def even_ambient(radiance: float) -> Lobes:
    """The regressor's lobes of all other light, equal and white."""
    axes = ambient_axes().astype(np.float32)
    sharpness = np.full(len(axes), AMBIENT_SHARPNESS, np.float32)
    return Lobes(np.full((len(axes), 3), radiance, np.float32), axes, sharpness)


def a_regression(**changes: Any) -> Regression:
    """A sun of which no direction is likelier than another, and no other light."""
    directions = candidates(300)
    plain: dict[str, Any] = {
        "axis": axis_from_angles(20.0, 50.0),
        "spread_deg": 10.0,
        "concentration": 20.0,
        "directions": directions,
        "probability": np.full(len(directions), 1.0 / len(directions)),
        "sun": np.array([3.0, 2.5, 1.5]),
        "sun_log_std": 0.3,
        "sigma": 0.05,
        "share": 0.6,
        "ambient": even_ambient(0.0),
        "ambient_log_std": 0.2,
    }
    return Regression(**plain | changes)


def a_camera(**changes: Any) -> CameraEstimate:
    """A level camera of 50 degrees, as unsure in every number."""
    plain: dict[str, Any] = {
        "pitch_deg": 0.0,
        "roll_deg": 0.0,
        "vfov_deg": 50.0,
        "principal": (0.5, 0.5),
        "pitch_sigma_deg": 1.0,
        "roll_sigma_deg": 1.0,
        "vfov_sigma_deg": 1.0,
        "principal_sigma": (0.1, 0.1),
        "witnesses": (),
    }
    return CameraEstimate(**plain | changes)


def box_before(view: Camera, srgb: FloatArray, codes: np.ndarray) -> Inputs:
    """A photo of level ground, and a box of a metre that stands on it, five metres ahead."""
    asset = Asset("box", (box((0.0, 0.5, 0.0), (1.0, 1.0, 1.0)),), (Material(),))
    placement = place_asset(*asset.bounds(), view, place=(0.0, 0.0, -5.0))
    return Inputs(Photo(codes, srgb, "png"), asset, view, placement)


def write_envmap(folder: Path, name: str, texels: FloatArray, kind: str = "exr") -> Path:
    """Write one panorama and nothing else into a folder, which need not be there."""
    with OutputFolder(folder / "made", overwrite=True) as output:
        output.write_envmap(texels, name)
    path = (folder / "made" / f"{name}.{kind}").rename(folder / f"{name}.{kind}")
    shutil.rmtree(folder / "made")
    return path
