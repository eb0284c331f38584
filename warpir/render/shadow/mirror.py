"""The object's mirror image on a glossy ground: which pixels show it, and what it changes there.

The ground is the photo's, under a smooth or rough dielectric coat. The coat showed the light that
is now behind the object; without that the photo is the ground, which the shadow darkens, and the
object's image is added: differential rendering (Debevec 1998, eq. 3) of one more lobe. What the
coat goes on showing beside the object is taken off while the ground is darkened, and added again.
"""

from __future__ import annotations

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.kernels.types import LightArgs
from warpir.look.camera_look import CameraLook
from warpir.render.picture.quality import Quality
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import dilate
from warpir.scene.placement import box_corners
from warpir.scene.tone_curves import Curves

TAIL = 1e-3
"""Share of a rough coat's normals beyond which the image is not looked for [1]."""
KEPT = 0.25
"""Share of the photo's radiance, in each channel, that is the ground's own at least [1]: what the
light says of the directions behind may be wrong, and would leave a coloured or black patch."""
DARKEST = 1e-3
"""Share of the ground's value that the image leaves at least [1]: rounding to halves moves a value
by half of this, and nothing may become negative."""
TINY = 1e-12
FAINTEST = 6e-8
"""Smallest half-precision number."""


def mirror_pixels(renderer: Renderer, wanted: BoolArray, roughness: float) -> IntArray:
    """Return the pixels of the plane in which the coat may show the object's box, row-major.

    Args:
        renderer: The scene; its receiver is a plane.
        wanted: Pixels to return at most, shape [H, W].
        roughness: Perceptual roughness of the coat [1].
    """
    camera, plane = renderer.scene.camera, renderer.scene.receiver
    if renderer.scene.triangle_count == 0:
        return np.zeros(0, np.int32)
    pixels = np.flatnonzero(wanted)
    v, u = np.divmod(pixels, camera.width)
    ray = camera.toward(u + 0.5, v + 0.5) @ camera.c2w[:3, :3].T
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    eye = camera.c2w[:3, 3]
    down = ray @ plane.normal
    with np.errstate(divide="ignore"):
        t = (plane.offset - eye @ plane.normal) / down
    below = (down < 0.0) & (t > 0.0)
    pixels, ray, t, down = pixels[below], ray[below], t[below], down[below]
    mirrored = ray - 2.0 * down[:, None] * plane.normal
    corners = box_corners(*renderer.scene.bounds)
    centre = corners.mean(axis=0)
    toward = centre - (eye + t[:, None] * ray)
    distance = np.linalg.norm(toward, axis=1)
    reach = np.linalg.norm(corners[0] - centre) / np.maximum(distance, 1e-12)
    angle = np.arcsin(np.minimum(reach, 1.0))
    # GGX normals lie within tan = alpha sqrt((1 - p) / p) but for a share p (Walter et al. 2007);
    # a normal turns the reflection by twice its angle.
    angle = angle + 2.0 * np.arctan(roughness**2 * np.sqrt((1.0 - TAIL) / TAIL))
    apart = np.arccos(np.clip((mirrored * toward).sum(axis=1) / np.maximum(distance, 1e-12), -1, 1))
    shows = np.zeros((camera.height, camera.width), np.bool_)
    shows.reshape(-1)[pixels[(apart < angle) | (reach >= 1.0)]] = True
    return np.flatnonzero(dilate(shows) & wanted).astype(np.int32)


def mirror_planes(
    renderer: Renderer,
    light: LightArgs,
    object_pixels: IntArray,
    planes: dict[str, FloatArray],
    quality: Quality,
    behind: LightArgs | None = None,
) -> dict[str, FloatArray]:
    """Return the radiance of the image, ``image``, what it hides, ``hidden``, and not, ``kept``.

    Shape [H, W, 3] each; 0 where neither image nor shadow is.

    Args:
        renderer: The scene; its receiver is a plane.
        light: Light on the object.
        object_pixels: Where the object may hide the plane, row-major.
        planes: ``matte``, shape [H, W], and ``shadow_ratio``, shape [H, W, 3].
        quality: Counts, seed, and the roughness of the coat.
        behind: What the coat showed before; None: the light.
    """
    assert quality.ground_roughness is not None
    matte = planes["matte"]
    wanted = (planes["shadow_ratio"] != 1.0).any(axis=-1) & (matte < 1.0)
    wanted.reshape(-1)[mirror_pixels(renderer, matte < 1.0, quality.ground_roughness)] = True
    pixels = np.flatnonzero(wanted).astype(np.int32)
    may_see_object = np.zeros(matte.size, np.int32)
    may_see_object[object_pixels] = 1
    traced = renderer.mirrored(
        light,
        pixels,
        may_see_object[pixels],
        quality.ground_roughness,
        quality.samples,
        quality.rays,
        quality.depth,
        quality.seed,
        quality.indirect_limit,
        behind,
    )
    found = np.zeros((3, matte.size, 3), np.float32)
    found[:, pixels] = traced
    image, hidden, kept = found.reshape(3, *matte.shape, 3)
    return {"image": image, "hidden": hidden, "kept": kept}


def shown_mirror(
    planes: dict[str, FloatArray], plate: FloatArray, curves: Curves, look: CameraLook
) -> tuple[FloatArray, int]:
    """Return what the image adds to the ground's display-linear values, and how often it is cut.

    The photo is led back through response, curve and operator to radiance, without what the object
    hides; then shaded, and led back once more for the image.

    Args:
        planes: Those of `mirror_planes`; ``shadow_ratio``, shape [H, W, 3]; ``matte``, [H, W].
        plate: Display-linear photo, shape [H, W, 3].
        curves: Tone curves and operator.
        look: The camera's response counts.

    Returns:
        Values times the ground's share of each pixel, shape [H, W, 3], and the number of pixels
        of whose photo what the image hides would be more than `KEPT` leaves.
    """
    changed = (planes["image"] != 0.0).any(axis=-1) | (planes["hidden"] != 0.0).any(axis=-1)
    changed |= (planes["kept"] != 0.0).any(axis=-1) & (planes["shadow_ratio"] != 1.0).any(axis=-1)
    image, hidden, kept, ratio, photo = (
        plane[changed].astype(np.float64)
        for plane in (*(planes[k] for k in ("image", "hidden", "kept", "shadow_ratio")), plate)
    )
    response = None if look.response is None else look.response.knots()

    def radiance(shown: Float64Array) -> Float64Array:
        if response is not None:
            shown = np.where(shown > 1.0, shown, response.invert(shown))
        return curves.radiance(shown)

    def shown(radiance: Float64Array) -> Float64Array:
        values = curves.shown(radiance)
        if response is None:
            return values
        return np.where(values > 1.0, values, response.evaluate(values)[..., 0])

    before = radiance(photo)
    # All channels by the same factor, so that what is left keeps its hue.
    share = ((hidden + kept) / np.maximum(before, TINY)).max(axis=-1, keepdims=True)
    factor = np.minimum(1.0, (1.0 - KEPT) / np.maximum(share, TINY))
    ground = shown(before - factor * (hidden + kept)) * ratio
    without = shown(radiance(photo * ratio))
    mirrored = shown(radiance(ground) + factor * kept + image)
    if curves.is_clipped:  # as the object, the image is shown up to white
        mirrored = np.minimum(mirrored, np.maximum(without, 1.0))
    out = np.zeros_like(plate)
    out[changed] = (mirrored - without) * (1.0 - planes["matte"][changed, None])
    return out, int((hidden > (1.0 - KEPT) * before).any(axis=-1).sum())


def leaving_ground(mirror: FloatArray, ground: FloatArray) -> FloatArray:
    """Return the layer, cut where rounding it could make the composite negative.

    Args:
        mirror: Layer, of either sign, shape [H, W, 3].
        ground: What it is added to, shape [H, W, 3].
    """
    least = np.minimum(FAINTEST - (1.0 - DARKEST) * ground, 0.0)
    return np.asarray(np.maximum(mirror, least), np.float32)
