"""The pictures of the report: small, display-encoded, as data URIs.

All of them show the linear layers, with the gamma of 2.2 by which the renderer sees the
photo, so that they look as ``composite.png`` does and agree with each other to the pixel.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, WebPImagePlugin

from warpir.core.arrays import BoolArray, CodeArray, FloatArray, mask_box, on_cores
from warpir.core.color import codes_of, linear_to_gamma, luminance
from warpir.io.images.decoder import decode_image
from warpir.io.layers import Layers

Box = tuple[int, int, int, int]
"""A box: left, top, right, bottom, half-open [px]."""

LARGEST = 4096
"""Longest side of the picture in the report [px]: most photos are there at full resolution."""
LAYER_LARGEST = 960
"""Longest side of a layer in the report [px]."""
THUMBNAIL = 320
"""Longest side of a frame in the report of a sequence [px]."""
MARGIN = 0.12
"""Margin around the object, over its own sides [1]."""
SHADED = 0.9
"""Green of the shadow ratio below which a pixel belongs to the close-up [1]."""
WHOLE = 0.7
"""Share of both sides of the photo from which a close-up is left out [1]."""


@dataclass(frozen=True)
class Shown:
    """A picture in the report."""

    uri: str
    width: int
    height: int


def jpeg(codes: CodeArray) -> Shown:
    """Encode 8-bit codes, shape [H, W, 3] or [H, W]."""
    stream = io.BytesIO()
    Image.fromarray(codes).save(stream, "JPEG", quality=88, subsampling=0)
    return Shown(_uri("image/jpeg", stream.getvalue()), codes.shape[1], codes.shape[0])


def webp(codes: CodeArray) -> Shown:
    """Encode 8-bit codes with alpha, shape [H, W, 4]."""
    stream = io.BytesIO()
    # By its plugin, which is imported above: for a mere name Pillow would import all it has.
    kind = WebPImagePlugin.WebPImageFile.format
    Image.fromarray(codes).save(stream, kind, quality=88, method=1, alpha_quality=90)
    return Shown(_uri("image/webp", stream.getvalue()), codes.shape[1], codes.shape[0])


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def shrink(plane: FloatArray, largest: int) -> FloatArray:
    """Average whole squares of pixels, so that no side is longer than ``largest``.

    Args:
        plane: Shape [H, W] or [H, W, channel]; what is left over at the right and lower edge is cut
            off.
        largest: Longest side of the result [px].
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
    return codes_of(linear_to_gamma(linear))


def thumbnail(path: Path, max_pixels: int) -> Shown:
    """Return a thumbnail of a picture file, in its own colour profile.

    Args:
        path: The file.
        max_pixels: Largest image decoded [px].

    Raises:
        InputError: It cannot be read.
    """
    found = decode_image(path, max_pixels)
    # Codes of 16 bits are 257 times those of 8.
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
    rows, columns = mask_box(chosen)
    if not rows.stop:
        return None
    height, width = chosen.shape
    longest = max(rows.stop - rows.start, columns.stop - columns.start) - 1
    room = max(8, round(MARGIN * longest))
    rows, columns = mask_box(chosen, room)
    return columns.start, rows.start, min(columns.stop, width), min(rows.stop, height)


def _cropped(layers: Layers, box: Box) -> Layers:
    left, top, right, bottom = box
    planes = {n: p[top:bottom, left:right] for n, p in vars(layers).items() if p is not None}
    return Layers(**planes)


# --------------------------------------------------------------------------------- layers


@dataclass(frozen=True)
class Layer:
    """One layer as the report shows it."""

    name: str
    about: str
    picture: Shown
    has_alpha: bool = True

    @property
    def id(self) -> str:
        """Identifier of the layer's element in the page."""
        return f"layer-{self.name}"


def layers_shown(layers: Layers) -> list[Layer]:
    """Return every layer of ``layers.exr`` that was written, cut to the object and its shadow."""
    box = _box_of((layers.matte > 0.0) | (layers.shadow_ratio[..., 1] < SHADED))
    if box is not None:
        layers = _cropped(layers, box)
    composite, *others = _opaque_layers(layers)
    foreground, *parts = _object_layers(layers)
    entries = [composite, foreground, *others, *parts, *_surface_layers(layers)]
    return on_cores(lambda entry: entry(), entries)  # encoding takes most of the time


def _entry(
    name: str, about: str, picture: Callable[[], Shown], has_alpha: bool = True
) -> Callable[[], Layer]:
    """Return what makes a layer; its picture is made by the call."""
    return lambda: Layer(name, about, picture(), has_alpha)


def _opaque_layers(layers: Layers) -> Iterator[Callable[[], Layer]]:
    """Yield the layers that have a value in every pixel."""

    def opaque(plane: FloatArray) -> Shown:
        return jpeg(encoded(shrink(plane, LAYER_LARGEST)))

    def of_either_sign(plane: FloatArray, factor: float) -> Shown:
        return jpeg(codes_of(shrink((0.5 + factor * plane).astype(np.float32), LAYER_LARGEST)))

    about = "The picture: fg + (1 − fg.A) × plate × shadow, pixel by pixel"
    others = [name for name in ("mirror", "grain") if getattr(layers, name) is not None]
    about += f", plus {' and '.join(others)}." if others else "."
    yield _entry("composite", about, partial(opaque, layers.composite), has_alpha=False)
    about = "What the photo is multiplied with: white where the object changes nothing."
    if (darkest := float(luminance(layers.shadow_ratio).min())) < 1.0:
        about += f" Its darkest pixel keeps {100.0 * max(darkest, 0.0):.0f} % of the light."
    yield _entry("shadow", about, partial(opaque, layers.shadow_ratio), has_alpha=False)
    about = "The photo, linearised."
    yield _entry("plate", about, partial(opaque, layers.plate), has_alpha=False)
    if layers.mirror is not None:
        about = "What the object's mirror image adds to the ground, of either sign: grey is none."
        shown = partial(of_either_sign, layers.mirror, 1.0)
        yield _entry("mirror", about, shown, has_alpha=False)
    if layers.grain is not None:
        about = "The photo's grain on what has changed, of either sign: grey is none, tenfold."
        shown = partial(of_either_sign, layers.grain, 10.0)
        yield _entry("grain", about, shown, has_alpha=False)
    about = "How much of each pixel the object covers: white is all."
    matte = shrink(layers.matte, LAYER_LARGEST)
    yield _entry("matte", about, lambda: jpeg(codes_of(matte)), has_alpha=False)


def _object_layers(layers: Layers) -> Iterator[Callable[[], Layer]]:
    """Yield the object's own light and its parts, which are premultiplied by the coverage."""
    matte = shrink(layers.matte, LAYER_LARGEST)

    def straight(premultiplied: FloatArray) -> Shown:
        plane = shrink(premultiplied, LAYER_LARGEST)
        covered = plane / np.maximum(matte, np.float32(1e-6))[..., None]
        return _with_alpha(encoded(covered.astype(np.float32, copy=False)), matte)

    about = "The object alone, lit and tone-mapped, premultiplied by its coverage (RGBA)."
    yield _entry("fg", about, partial(straight, layers.foreground[..., :3]))
    if layers.diffuse is not None:
        about = "Part of fg that the object scatters in all directions."
        yield _entry("diffuse", about, partial(straight, layers.diffuse))
    if layers.specular is not None:
        about = "Part of fg that the object mirrors: highlights and reflections."
        yield _entry("specular", about, partial(straight, layers.specular))
    if layers.emission is not None:
        about = "Part of fg that the object emits."
        if not layers.emission.any():
            about += " This one emits nothing."
        yield _entry("emission", about, partial(straight, layers.emission))


def _surface_layers(layers: Layers) -> Iterator[Callable[[], Layer]]:
    """Yield what describes the surface, averaged over the object alone."""
    if layers.depth is None:
        return
    is_surface = np.isfinite(layers.depth)
    share = shrink(is_surface.astype(np.float32), LAYER_LARGEST)
    is_shown = share > 0.0
    weight: FloatArray = np.where(is_shown, share, np.float32(1.0))

    def mean(plane: FloatArray) -> FloatArray:
        shrunk = shrink(plane, LAYER_LARGEST)
        average: FloatArray = shrunk / (weight if shrunk.ndim == 2 else weight[..., None])
        return average

    def surface(codes: CodeArray) -> Callable[[], Shown]:
        return partial(_with_alpha, codes, share)

    if layers.albedo is not None:
        about = "Base colour of the surface, without any light."
        yield _entry("albedo", about, surface(encoded(mean(layers.albedo))))
    if layers.roughness is not None:
        about = "Perceptual roughness: black is a mirror, white is matt."
        yield _entry("roughness", about, surface(codes_of(mean(layers.roughness))))
    if layers.normal is not None:
        about = "Unit normal of the surface in world axes: red +X, green +Y (up), blue +Z."
        yield _entry("normal", about, surface(codes_of(0.5 + 0.5 * mean(layers.normal))))
    if not is_shown.any():  # the surface is in the pixels alone that shrinking cuts off
        return
    depth = mean(np.where(is_surface, layers.depth, np.float32(0.0)))
    low, high = float(depth[is_shown].min()), float(depth[is_shown].max())
    about = f"Distance along the viewing axis: white is {low:.2f} m, black is {high:.2f} m."
    nearness = (high - depth) / max(high - low, 1e-6)
    yield _entry("depth", about, surface(codes_of(nearness)))
    if layers.position is not None:
        position = mean(layers.position)
        lows, highs = position[is_shown].min(axis=0), position[is_shown].max(axis=0)
        axes = zip(("X (red)", "Y (green)", "Z (blue)"), lows, highs, strict=True)
        ranges = ", ".join(f"{axis} from {a:.2f} to {b:.2f} m" for axis, a, b in axes)
        about = f"Position of the surface in the world: {ranges}."
        scaled = (position - lows) / np.maximum(highs - lows, 1e-6)
        yield _entry("position", about, surface(codes_of(scaled)))


def _with_alpha(codes: CodeArray, alpha: FloatArray) -> Shown:
    """Encode codes, shape [H, W] or [H, W, 3], under an alpha in [0, 1], shape [H, W]."""
    rgb = np.repeat(codes[..., None], 3, axis=-1) if codes.ndim == 2 else codes
    return webp(np.concatenate([rgb, codes_of(alpha)[..., None]], axis=-1))
