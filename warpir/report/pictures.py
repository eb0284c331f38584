"""The pictures of the report: small, display-encoded, as data URIs.

All of them are made of the linear layers, with the gamma of 2.2 by which the renderer sees the
photo, so that they look as ``composite.png`` does and agree with each other to the pixel.
"""

from __future__ import annotations

import base64
import io
import math
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from warpir.core.arrays import BoolArray, CodeArray, Float64Array, FloatArray
from warpir.core.color import linear_to_gamma, luminance
from warpir.io.images.decoder import decode_image
from warpir.io.results import Layers
from warpir.scene.light import bearing, resize_map, rotate_map

Box = tuple[int, int, int, int]
"""Left, top, right, bottom, half-open [px]."""

LARGEST = 1600
"""Longest side of the picture in the report [px]."""
LAYER_LARGEST = 960
"""Longest side of a layer in the report [px]."""
THUMBNAIL = 320
"""Longest side of a frame in the report of a sequence [px]."""
PANORAMA_HEIGHT = 192
"""Rows of the panorama in the report."""
STOPS = 8.0
"""Most that the panorama can be brightened or darkened by [EV]."""
BRIGHT = 90.0
"""Percentile of the panorama's luminance that is shown as white [%]."""
MARGIN = 0.12
"""Round the object, in its own sides [1]."""
SHADED = 0.9
"""Green of the shadow ratio below which a pixel belongs to what is looked at closely [1]."""
WHOLE = 0.7
"""Share of both sides of the photo from which a closer look shows nothing more [1]."""


@dataclass(frozen=True)
class Shown:
    """A picture in the report."""

    uri: str
    width: int
    height: int


def jpeg(codes: CodeArray, quality: int = 88) -> Shown:
    """Encode 8-bit codes, shape [H, W, 3] or [H, W]."""
    stream = io.BytesIO()
    Image.fromarray(codes).save(stream, "JPEG", quality=quality, subsampling=0)
    return Shown(_uri("image/jpeg", stream.getvalue()), codes.shape[1], codes.shape[0])


def webp(codes: CodeArray) -> Shown:
    """Encode 8-bit codes with alpha, shape [H, W, 4]."""
    stream = io.BytesIO()
    Image.fromarray(codes).save(stream, "WEBP", quality=88, method=1, alpha_quality=90)
    return Shown(_uri("image/webp", stream.getvalue()), codes.shape[1], codes.shape[0])


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def shrink(plane: FloatArray, largest: int) -> FloatArray:
    """Average whole squares of pixels, so that no side is longer than ``largest``.

    Args:
        plane: Shape [H, W] or [H, W, channel]; what is left over at the right and lower edge is cut
            off.
        largest: Of both sides [px].
    """
    k = math.ceil(max(plane.shape[:2]) / largest)
    if k == 1:
        return plane
    height, width = (max(side // k, 1) * min(k, side) for side in plane.shape[:2])
    # Rows first: they lie in a piece in memory, and only a k-th of them is left for the columns.
    down = min(k, plane.shape[0])
    rows = plane[0:height:down, :width].astype(np.float32)
    for j in range(1, down):
        rows += plane[j:height:down, :width]
    across = min(k, plane.shape[1])
    columns = rows[:, 0::across].copy()
    for j in range(1, across):
        columns += rows[:, j::across]
    shrunk: FloatArray = columns / np.float32(down * across)
    return shrunk


def encoded(linear: FloatArray) -> CodeArray:
    """Return display codes of linear values."""
    codes: CodeArray = np.round(255.0 * np.clip(linear_to_gamma(linear), 0.0, 1.0)).astype(np.uint8)
    return codes


def plain(values: FloatArray) -> CodeArray:
    """Return codes of values in [0, 1] that are no light."""
    codes: CodeArray = np.round(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)
    return codes


def thumbnail(path: Path, max_pixels: int) -> Shown:
    """Return a picture file in small, in its own colour profile.

    Args:
        path: The file.
        max_pixels: Largest image decoded [px].

    Raises:
        InputError: It cannot be read.
    """
    found = decode_image(path, max_pixels)
    # CodeArray of 16 bits are 257 times those of 8.
    is_deep = found.pixels.dtype != np.uint8
    codes: CodeArray = (found.pixels // 257).astype(np.uint8) if is_deep else found.pixels
    image = Image.fromarray(codes[..., 0] if codes.shape[-1] == 1 else codes).convert("RGB")
    image.thumbnail((THUMBNAIL, THUMBNAIL), reducing_gap=2.0)
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=80, icc_profile=found.icc)
    return Shown(_uri("image/jpeg", stream.getvalue()), *image.size)


# ------------------------------------------------------------------------ before and after


def before_and_after(layers: Layers, box: Box | None = None) -> tuple[Shown, Shown]:
    """Return the photo and the composite, or a box of them."""
    if box is not None:
        layers = _cropped(layers, box)
    before, after = (
        jpeg(encoded(shrink(plane, LARGEST))) for plane in (layers.plate, layers.composite)
    )
    return before, after


def object_box(layers: Layers) -> Box | None:
    """Return the object's surroundings in the photo; None: it is not seen, or nearly fills it."""
    height, width = layers.matte.shape
    box = _box_of(layers.matte > 0.0)
    if box is None:
        return None
    is_whole = box[2] - box[0] > WHOLE * width and box[3] - box[1] > WHOLE * height
    return None if is_whole else box


def _box_of(chosen: BoolArray) -> Box | None:
    rows, columns = np.flatnonzero(chosen.any(axis=1)), np.flatnonzero(chosen.any(axis=0))
    if not len(rows):
        return None
    height, width = chosen.shape
    room = max(8, round(MARGIN * max(rows[-1] - rows[0], columns[-1] - columns[0])))
    return (
        max(int(columns[0]) - room, 0),
        max(int(rows[0]) - room, 0),
        min(int(columns[-1]) + 1 + room, width),
        min(int(rows[-1]) + 1 + room, height),
    )


def _cropped(layers: Layers, box: Box) -> Layers:
    left, top, right, bottom = box
    planes = {f.name: getattr(layers, f.name) for f in fields(layers)}
    part: dict[str, Any] = {
        n: p[top:bottom, left:right] for n, p in planes.items() if p is not None
    }
    return Layers(**part)


# --------------------------------------------------------------------------------- layers


@dataclass(frozen=True)
class Layer:
    """One layer as the report shows it."""

    name: str
    about: str
    picture: Shown
    has_alpha: bool


def layers_shown(layers: Layers) -> list[Layer]:
    """Return every layer of ``layers.exr`` that was written, cut to the object and its shadow."""
    box = _box_of((layers.matte > 0.0) | (layers.shadow_ratio[..., 1] < SHADED))
    if box is not None:
        layers = _cropped(layers, box)

    def cut(plane: FloatArray) -> FloatArray:
        return shrink(plane, LAYER_LARGEST)

    matte = cut(layers.matte)
    seen = matte[..., None]
    if layers.depth is not None:
        # What describes the surface is averaged over the object alone.
        is_surface = np.isfinite(layers.depth).astype(np.float32)
        share = cut(is_surface)

    def surface(plane: FloatArray) -> FloatArray:
        averaged = cut(plane)
        weight = np.where(share > 0.0, share, 1.0)
        weight = weight if averaged.ndim == 2 else weight[..., None]
        return np.asarray(averaged / weight, np.float32)

    def over(codes: CodeArray, alpha: FloatArray) -> Shown:
        rgb = np.repeat(codes[..., None], 3, axis=-1) if codes.ndim == 2 else codes
        return webp(np.concatenate([rgb, plain(alpha)[..., None]], axis=-1))

    def part(plane: FloatArray) -> Shown:
        return over(encoded(np.asarray(cut(plane) / np.maximum(seen, 1e-6), np.float32)), matte)

    found: list[Layer] = []

    def add(name: str, about: str, picture: Shown, has_alpha: bool = False) -> None:
        found.append(Layer(name, about, picture, has_alpha))

    add(
        "composite",
        "The picture: fg + (1 − fg.A) × plate × shadow, pixel by pixel.",
        jpeg(encoded(cut(layers.composite))),
    )
    add(
        "fg",
        "The object alone, lit and tone-mapped, premultiplied by its coverage (RGBA).",
        part(layers.foreground[..., :3]),
        True,
    )
    darkest = float(luminance(layers.shadow_ratio).min())
    about = "What the photo is multiplied with: white where the object changes nothing."
    if darkest < 1.0:
        about += f" Its darkest pixel keeps {100.0 * max(darkest, 0.0):.0f} % of the light."
    add("shadow", about, jpeg(encoded(cut(layers.shadow_ratio))))
    add("plate", "The photo, linearised.", jpeg(encoded(cut(layers.plate))))
    add("matte", "How much of each pixel the object covers: white is all.", jpeg(plain(matte)))
    if layers.diffuse is not None:
        about = "Part of fg that the object scatters in all directions."
        add("diffuse", about, part(layers.diffuse), True)
    if layers.specular is not None:
        about = "Part of fg that the object mirrors: highlights and reflections."
        add("specular", about, part(layers.specular), True)
    if layers.emission is not None:
        about = "Part of fg that the object emits."
        if not layers.emission.any():
            about += " This one emits nothing."
        add("emission", about, part(layers.emission), True)
    if layers.albedo is not None:
        add(
            "albedo",
            "Base colour of the surface, without any light.",
            over(encoded(surface(layers.albedo)), share),
            True,
        )
    if layers.roughness is not None:
        add(
            "roughness",
            "Perceptual roughness: black is a mirror, white is matt.",
            over(plain(surface(layers.roughness)), share),
            True,
        )
    if layers.normal is not None:
        add(
            "normal",
            "Unit normal of the surface in world axes: red +X, green +Y (up), blue +Z.",
            over(plain(0.5 + 0.5 * surface(layers.normal)), share),
            True,
        )
    # Seen in the pixels alone that shrinking cuts off, it has no depth either.
    if layers.depth is not None and (share > 0.0).any():
        clean = np.where(np.isfinite(layers.depth), layers.depth, np.float32(0.0))
        depth = surface(clean)
        low, high = float(depth[share > 0.0].min()), float(depth[share > 0.0].max())
        add(
            "depth",
            f"Distance along the viewing axis: white is {low:.2f} m, black is {high:.2f} m.",
            over(plain((high - depth) / max(high - low, 1e-6)), share),
            True,
        )
        if layers.position is not None:
            position = surface(layers.position)
            points = position[share > 0.0]
            lows, highs = points.min(axis=0), points.max(axis=0)
            ranges = ", ".join(
                f"{axis} from {a:.2f} to {b:.2f} m"
                for axis, a, b in zip(
                    ("X (red)", "Y (green)", "Z (blue)"), lows, highs, strict=True
                )
            )
            span = np.maximum(highs - lows, 1e-6)
            add(
                "position",
                f"Position of the surface in the world: {ranges}.",
                over(plain((position - lows) / span), share),
                True,
            )
    return found


# ---------------------------------------------------------------------------------- light


@dataclass(frozen=True)
class Panorama:
    """A light as the report shows it, ahead of the camera in the middle."""

    picture: Shown
    """At `stops`."""
    stops: float
    """By which the photo's exposure was changed, so that the light can be looked at [EV]."""
    rgbe: str
    """The same values for other exposures: zlib'd RGBE, base64, row by row."""


def panorama(texels: FloatArray, c2w: Float64Array, tone: str) -> Panorama:
    """Return a light as a person at the camera would see it, turning all the way round.

    Args:
        texels: Radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3].
        c2w: Pose of the camera, shape [4, 4].
        tone: The picture's operator, ``linear`` or ``reinhard``.
    """
    small = resize_map(texels, PANORAMA_HEIGHT)
    turned = rotate_map(small, -bearing(np.array([0.0, 0.0, -1.0]), c2w))
    # Our map's seam is what a camera along -Z looks at.
    seen = np.roll(turned, turned.shape[1] // 2, axis=1)
    bright = float(np.percentile(luminance(seen), BRIGHT))
    stops = float(np.clip(np.round(-2.0 * np.log2(max(bright, 1e-6))) / 2.0, -STOPS, STOPS))
    shown = seen * np.float32(2.0**stops)
    shown = shown / (1.0 + shown) if tone == "reinhard" else shown
    packed = base64.b64encode(zlib.compress(rgbe(seen).tobytes(), 9)).decode()
    return Panorama(jpeg(encoded(shown)), stops, packed)


def rgbe(linear: FloatArray) -> CodeArray:
    """Return values as three mantissas and an exponent (Ward 1991), shape [H, W, 4]."""
    largest = linear.max(axis=-1)
    _, exponent = np.frexp(largest)
    scale = np.where(largest > 1e-32, np.ldexp(np.float32(256.0), -exponent), 0.0)
    mantissas = np.minimum(linear * scale[..., None], 255.0).astype(np.uint8)
    exponents = np.where(largest > 1e-32, exponent + 128, 0).astype(np.uint8)
    return np.concatenate([mantissas, exponents[..., None]], axis=-1)
