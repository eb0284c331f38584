"""Compositing: the planes of object and shadow, brought to the photo's size and put into it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warpir.core.arrays import BoolArray, FloatArray, PixelArray, by_pixel
from warpir.core.color import GAMMA, linear_to_gamma
from warpir.io.images.photos import Photo
from warpir.io.layers import HALF_MAX, Layers
from warpir.look.camera_look import CameraLook
from warpir.look.sharpness import shown_box
from warpir.render.picture.planes import Rendering, blank, render
from warpir.render.picture.quality import Quality
from warpir.render.picture.resizing import resize_planes
from warpir.render.renderer import Renderer
from warpir.render.shadow.mirror import leaving_ground, shown_mirror
from warpir.scene.light import Light
from warpir.scene.shadow_mask import ShadowMask
from warpir.scene.tone_curves import Curves

UNCHANGED = CameraLook()
"""Look of a camera that neither blurs nor has noise."""
SHOWN = ("matte", "shadow_ratio", "normal", "image", "hidden", "kept")
"""Planes that tell where there is something."""
SUMMED_UP = ("foreground", "matte", "shadow_ratio")
"""Planes that the composite is made of."""
NOT_LAYERS = {"foreground", "image", "hidden", "kept"}
"""Planes of a rendering that are no layers of their own."""
OUTSIDE = {"shadow_ratio": 1.0, "depth": np.inf}
"""What planes hold where there is nothing, if not 0."""


@dataclass(frozen=True)
class Picture:
    """A finished composite and its layers, at the photo's resolution."""

    layers: Layers
    image: FloatArray
    """The composite, display-encoded, shape [H, W, 3]."""
    changed: BoolArray
    """Pixels that differ from the photo, shape [H, W]."""
    object_pixel_count: int
    """Pixels whose object was traced, at the rendering resolution."""
    receiver_pixel_count: int
    """Pixels whose shadow was traced, at the rendering resolution."""
    look: CameraLook = UNCHANGED
    """What the camera did to the photo, repeated on object and shadow."""
    mirror_cut_count: int = 0
    """Pixels whose ground hid more light in the mirror than the photo shows there."""

    def codes_in(self, photo: Photo) -> PixelArray:
        """Return the composite in the codes of its photo (`Photo.encode`)."""
        kept = None
        if photo.icc is not None:
            kept = (np.float32(1.0) - self.layers.matte)[..., None] * self.layers.shadow_ratio
        return photo.encode(self.image, self.changed, kept)


def make_picture(
    renderer: Renderer,
    light_fg: Light,
    light_shadow: Light,
    photo: Photo,
    quality: Quality,
    curves: Curves,
    *,
    occluder: FloatArray | None = None,
    shadow_mask: ShadowMask | None = None,
    look: CameraLook = UNCHANGED,
    behind: Light | None = None,
) -> Picture:
    """Render object and shadow at the scene camera's resolution and put them into the photo.

    The arguments are those of `render` and `composite`. On a linear plate the object does not end
    at 1 either.
    """
    curves, lights = replace(curves, is_clipped=not photo.is_linear), (light_fg, light_shadow)
    rendering = render(renderer, *lights, quality, curves, shadow_mask=shadow_mask, behind=behind)
    return composite(rendering, photo, quality.seed, occluder, look)


def composite(
    rendering: Rendering,
    photo: Photo,
    seed: int,
    occluder: FloatArray | None = None,
    look: CameraLook = UNCHANGED,
) -> Picture:
    """Put a rendering into the photo, behind what the photo's camera did.

    Args:
        rendering: Of a camera that may be smaller than the photo; its planes are not changed.
        photo: The photograph.
        seed: Of the grain.
        occluder: Share of the photo that stays in front of the object [1], shape [H, W].
        look: What the camera did to the photo, to be repeated on object and shadow.
    """
    planes, curves = dict(rendering.planes), rendering.curves
    counts = rendering.object_pixel_count, rendering.receiver_pixel_count
    del rendering  # of whose planes some are replaced now, the largest arrays of a run
    enlarged = photo.srgb.shape[1] / planes["matte"].shape[1]
    if planes["matte"].shape != photo.srgb.shape[:2]:
        planes = resize_planes(planes, *photo.srgb.shape[:2])
    plate = photo.linear()
    shows = {name: planes[name] for name in SHOWN if name in planes}
    box = shown_box(shows, look.blur_to_add(enlarged))
    before = {name: plane[box] for name, plane in planes.items()}
    after = dict(look.shown_like_photo(look.sharpened_like_photo(before, enlarged), plate[box]))
    cut = 0
    if "image" in planes:
        after["mirror"], cut = shown_mirror(after, plate[box], curves, look)
    after = look.coloured_like_photo(after, plate[box])
    if occluder is not None:
        after = _behind(after, occluder[box])
    after = {name: plane for name, plane in after.items() if plane is not before.get(name)}
    del before
    if not photo.is_deep:
        plate = by_pixel(_halves, plate)
    layers = _layers(planes, after, box, plate, photo.is_deep)
    changed = (layers.matte > 0.0) | (layers.shadow_ratio != 1.0).any(axis=-1)
    if layers.mirror is not None:
        changed |= (layers.mirror != 0.0).any(axis=-1)
    layers = _with_grain(layers, look, changed, seed, photo)
    image = by_pixel(linear_to_gamma, layers.composite)
    return Picture(layers, image, changed, *counts, look, cut)


def _layers(
    planes: dict[str, FloatArray],
    after: dict[str, FloatArray],
    box: tuple[slice, slice],
    plate: FloatArray,
    is_deep: bool,
) -> Layers:
    """Put the planes over the photo.

    Args:
        planes: Those of the rendering, of the photo's size; left are those that nothing replaces.
        after: What is in place of some of them within the box; beyond it nothing is shown.
        box: Rows and columns of these.
        plate: Display-linear photo as in its layer, shape [H, W, 3].
        is_deep: Whether the photo has more than 8 bits.
    """
    after = {name: planes[name][box] for name in SUMMED_UP} | after
    if not is_deep:
        # Rounded as in the file of layers, so that they recompose exactly; rounding to
        # half changes 8-bit codes by .06 at most.
        after |= {name: by_pixel(_halves, after[name]) for name in SUMMED_UP}
    ground = (1.0 - after["matte"])[..., None] * plate[box] * after["shadow_ratio"]
    shown = after["foreground"] + ground
    if "mirror" in after:
        after["mirror"] = leaving_ground(after["mirror"], ground)
        after["mirror"] = after["mirror"] if is_deep else by_pixel(_halves, after["mirror"])
        shown = shown + after["mirror"]
    composite = plate.copy()
    composite[box] = shown
    object_alone = blank((*plate.shape[:2], 4), 0.0)
    object_alone[box][..., :3], object_alone[box][..., 3] = after["foreground"], after["matte"]
    for name in NOT_LAYERS | after.keys():
        planes.pop(name, None)
    for name in after.keys() - NOT_LAYERS:
        part = after[name]
        planes[name] = blank((*plate.shape[:2], *part.shape[2:]), OUTSIDE.get(name, 0.0))
        planes[name][box] = part
    return Layers(composite, object_alone, plate=plate, **planes)


def _with_grain(
    layers: Layers, look: CameraLook, changed: BoolArray, seed: int, photo: Photo
) -> Layers:
    """Add the photo's grain to what has changed, in a layer of its own."""
    shown, plate = layers.composite, layers.plate
    if photo.is_linear:  # its codes are those of the plate as it is exposed
        exposure = np.float32(photo.exposure)
        shown, plate = exposure * shown, exposure * plate
    grain = look.grain_on(shown, plate, layers.matte, changed, seed, GAMMA)
    if grain is None:
        return layers
    if photo.is_linear:
        grain /= exposure
    grain = grain if photo.is_deep else by_pixel(_halves, grain)
    return replace(layers, composite=layers.composite + grain, grain=grain)


def _behind(planes: dict[str, FloatArray], occluder: FloatArray) -> dict[str, FloatArray]:
    """Put the object and its shadow behind what the occluder marks in the photo.

    With m the occluder, a the matte and s the ratio, the composite ``m plate + (1 - m) (fg +
    (1 - a) plate s)`` is again ``fg' + (1 - a') plate s'`` with ``fg' = (1 - m) fg``,
    ``a' = (1 - m) a`` and ``s' = (m + (1 - m) (1 - a) s) / (1 - a')``.
    """
    m, free = occluder, 1.0 - occluder
    matte = planes["matte"]
    left = 1.0 - free * matte  # share of the pixel that the photo fills
    lit = m[..., None] + (free * (1.0 - matte))[..., None] * planes["shadow_ratio"]
    ratio = lit / np.maximum(left, 1e-9)[..., None]
    # Exact where nothing is in front; there the object may also fill the pixel, and left is 0.
    ratio = np.where((m == 0.0)[..., None], planes["shadow_ratio"], ratio)
    behind = {**planes, "matte": free * matte, "shadow_ratio": ratio}
    for name in {"foreground", "diffuse", "emission", "specular", "mirror"} & planes.keys():
        behind[name] = free[..., None] * planes[name]
    hidden = m == 1.0
    for name in ("depth", "position", "normal", "albedo", "roughness"):
        behind[name] = planes[name].copy()
        behind[name][hidden] = np.inf if name == "depth" else 0.0
    return behind


def _halves(plane: FloatArray) -> FloatArray:
    """Round to what half-precision numbers can hold; what shines brighter is clamped there."""
    # All values are display-linear, near [0, 1] but for strong emitters. NaN and Inf pass through.
    if not np.abs(plane).max(initial=0.0) < HALF_MAX:
        plane = np.where(np.isfinite(plane), np.clip(plane, -HALF_MAX, HALF_MAX), plane)
    rounded: FloatArray = plane.astype(np.float16).astype(np.float32)
    return rounded
