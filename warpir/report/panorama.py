"""Lights as the report shows them: panoramas with the horizon, the photo's frame and a mark."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpir.core.arrays import CodeArray, Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.latlong import resize_map, rotate_map
from warpir.report.pictures import Shown, encoded, jpeg
from warpir.report.words import EVEN, LightCharacter
from warpir.scene.light import bearing

HEIGHT = 192
"""Rows of the panorama in the report."""
STOPS = 8
"""Largest change of the panorama's exposure [EV]."""
BRIGHT = 90.0
"""Percentile of the panorama's luminance that maps to white [%]."""
RING = 7
"""Radius of the mark around the brightest direction [px]."""


@dataclass(frozen=True)
class Panorama:
    """A light as the report shows it, ahead of the camera in the middle."""

    id: str
    name: str
    picture: Shown
    """Picture of the panorama at `stops`."""
    stops: float
    """Change of the photo's exposure at which the light can be looked at [EV]."""
    rgbe: str
    """Radiance for other exposures: zlib-compressed RGBE, base64, row by row."""
    tone: str
    """The picture's operator, ``linear`` or ``reinhard``."""
    marks: list[tuple[str, str]]
    """Class and SVG outline of each line drawn over it."""
    stops_limit: int = STOPS


def panorama(
    name: str,
    identifier: str,
    texels: FloatArray,
    camera: Mapping[str, Any] | None,
    character: LightCharacter | None,
    tone: str,
) -> Panorama:
    """Return a light as a person at the camera would see it, turning all the way round.

    Texels are radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3], shown by
    the operator ``linear`` or ``reinhard``; ``identifier`` is the element's. Of the content of
    ``camera.json`` the photo's frame is drawn where it is known, of the light's character the
    brightest direction of direct light.
    """
    pose = pose_of(camera)
    turned = rotate_map(resize_map(texels, HEIGHT), -bearing(np.array([0.0, 0.0, -1.0]), pose))
    # Our map's seam is what a camera along -Z looks at.
    ahead = np.roll(turned, turned.shape[1] // 2, axis=1)
    bright = float(np.percentile(luminance(ahead), BRIGHT))
    stops = float(np.clip(np.round(-2.0 * np.log2(max(bright, 1e-6))) / 2.0, -STOPS, STOPS))
    exposed = ahead * np.float32(2.0**stops)
    exposed = exposed / (1.0 + exposed) if tone == "reinhard" else exposed
    marks = [("", f"M0 {HEIGHT / 2}H{2 * HEIGHT}")]
    if camera is not None and (outline := _photo_outline(camera, pose)) is not None:
        marks.append(("frame", outline))
    if character is not None and character.direct_share >= EVEN:
        x = (1.0 + character.bearing_deg / 180.0) * HEIGHT
        y = (0.5 - character.elevation_deg / 180.0) * HEIGHT
        circle = f"a{RING} {RING} 0 1 0 {2 * RING} 0a{RING} {RING} 0 1 0 {-2 * RING} 0"
        marks.append(("aim", f"M{x - RING:.1f} {y:.1f}{circle}"))
    packed = base64.b64encode(zlib.compress(rgbe(ahead).tobytes(), 9)).decode()
    return Panorama(identifier, name, jpeg(encoded(exposed)), stops, packed, tone, marks)


def pose_of(camera: Mapping[str, Any] | None) -> Float64Array:
    """Return the camera's pose (camera to world), shape [4, 4]; the identity where unknown."""
    return np.asarray((camera or {}).get("c2w", np.eye(4)), np.float64)


def _photo_outline(camera: Mapping[str, Any], pose: Float64Array) -> str | None:
    """Return the photo's outline in the panorama; None where it crosses the seam."""
    edge = np.linspace(0.0, 1.0, 25)
    zero, one = np.zeros(25), np.ones(25)
    u = np.concatenate([edge, one, edge[::-1], zero]) * camera["w"]
    v = np.concatenate([zero, edge, one, edge[::-1]]) * camera["h"]
    rays = np.stack(
        [(u - camera["cx"]) / camera["fx"], -(v - camera["cy"]) / camera["fy"], -np.ones_like(u)],
        axis=1,
    )
    rays = rays @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    azimuth = np.radians([bearing(ray, pose) for ray in rays])
    elevation = np.arcsin(np.clip(rays[:, 1], -1.0, 1.0))
    if np.abs(np.diff(azimuth)).max() > np.pi / 2.0:  # a pole is in the picture
        return None
    x = (1.0 + azimuth / np.pi) * HEIGHT
    y = (0.5 - elevation / np.pi) * HEIGHT
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)) + "Z"


def rgbe(linear: FloatArray) -> CodeArray:
    """Return values as three mantissas and an exponent (Ward 1991), shape [H, W, 4]."""
    largest = linear.max(axis=-1)
    is_lit = largest > 1e-32
    _, exponent = np.frexp(np.where(is_lit, largest, np.float32(1.0)))
    scale = np.where(is_lit, np.ldexp(np.float32(256.0), -exponent), 0.0)
    mantissas = np.minimum(linear * scale[..., None], 255.0).astype(np.uint8)
    exponents = np.where(is_lit, exponent + 128, 0).astype(np.uint8)
    return np.concatenate([mantissas, exponents[..., None]], axis=-1)
