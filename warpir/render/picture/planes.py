"""Object and shadow from the renderer: tone-mapped planes of the picture, before the photo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.io.images.resize import resize
from warpir.kernels.types import LightArgs
from warpir.look.denoise import denoised_object, denoised_ratio
from warpir.render.allocation import Sharing, as_shown
from warpir.render.device_light import light_args
from warpir.render.picture.quality import Quality
from warpir.render.picture.tone import tone_mapped
from warpir.render.renderer import Foreground, GBuffer, Renderer
from warpir.render.shadow.mirror import mirror_planes
from warpir.render.shadow.picture import picture_ratio
from warpir.scene.camera import Camera
from warpir.scene.lamps import without_lamps
from warpir.scene.light import Light
from warpir.scene.shadow_mask import ShadowMask
from warpir.scene.tone_curves import Curves

TINY = 1e-12


@dataclass(frozen=True)
class Rendering:
    """Object and shadow at the rendering's resolution, tone-mapped."""

    planes: dict[str, FloatArray]
    """``foreground`` (premultiplied), ``matte``, ``shadow_ratio``, the parts of the foreground and
    the geometry, shape [H, W] or [H, W, 3]; on a glossy ground those of `mirror_planes`."""
    object_pixel_count: int
    receiver_pixel_count: int
    curves: Curves
    """What the planes were tone-mapped with."""


def render(
    renderer: Renderer,
    light_fg: Light,
    light_shadow: Light,
    quality: Quality,
    curves: Curves,
    *,
    shadow_mask: ShadowMask | None = None,
    behind: Light | None = None,
) -> Rendering:
    """Render object and shadow at the scene camera's resolution.

    Args:
        renderer: The scene; its camera may be smaller than the photo, never of another aspect.
        light_fg: Lights the object.
        light_shadow: Casts its shadow; often the same object as ``light_fg``.
        quality: Samples, rays, depth, seed.
        curves: Tone curves and operator.
        shadow_mask: Mask of the ground that is in shadow already.
        behind: What a glossy ground showed before the object came; None: ``light_fg``.
    """
    renderer.load_kernels(quality.ground_roughness is not None)
    dimmed = light_fg if shadow_mask is None else without_lamps(light_fg, shadow_mask.at_object)
    args_fg = light_args(dimmed, renderer.device)
    args_shadow = args_fg if light_shadow is dimmed else light_args(light_shadow, renderer.device)
    gbuffer = renderer.gbuffer(quality.seed)
    foreground = renderer.foreground(
        args_fg,
        gbuffer.object_pixels,
        quality.samples,
        quality.rays,
        quality.depth,
        quality.seed,
        quality.indirect_limit,
        sharing=Sharing(partial(as_shown, white=quality.white), quality.noise),
    )
    receiver_pixels, ratio = _shadow(
        renderer,
        args_shadow,
        light_shadow,
        gbuffer.object_pixels,
        foreground.mask,
        quality,
        shadow_mask,
    )
    if quality.is_denoised:
        camera = renderer.scene.camera
        foreground = _denoised(foreground, gbuffer, camera)
        covered = gbuffer.object_pixels[foreground.mask >= 1.0]
        ratio = denoised_ratio(ratio, receiver_pixels, covered, (camera.height, camera.width))
    fg, beta = tone_mapped(renderer, foreground, ratio, curves)
    planes = _planes(renderer.scene.camera, gbuffer, foreground, fg, (receiver_pixels, beta))
    if quality.ground_roughness is not None:
        hidden = None if behind is None else light_args(behind, renderer.device)
        planes |= mirror_planes(renderer, args_fg, gbuffer.object_pixels, planes, quality, hidden)
    counts = len(gbuffer.object_pixels), len(receiver_pixels)
    return Rendering(planes, *counts, curves)


def _denoised(foreground: Foreground, gbuffer: GBuffer, camera: Camera) -> Foreground:
    """Return the object without noise: its diffuse and its other reflections each by themselves."""
    other = np.maximum(foreground.radiance - foreground.diffuse - foreground.emission, 0.0)
    diffuse, other = denoised_object(
        (foreground.diffuse, other),
        foreground.mask,
        gbuffer.base_color,
        gbuffer.normal,
        gbuffer.object_pixels,
        (camera.height, camera.width),
    )
    radiance = diffuse + other + foreground.emission
    return replace(foreground, radiance=radiance, diffuse=diffuse)


def _shadow(
    renderer: Renderer,
    args: LightArgs,
    light: Light,
    object_pixels: IntArray,
    mask: FloatArray,
    quality: Quality,
    shadow_mask: ShadowMask | None,
) -> tuple[IntArray, FloatArray]:
    """Return the pixels that the object shades, and their ratio; ``args`` are those of ``light``.

    ``mask`` is the coverage of ``object_pixels``.

    Where the photo's ground is in shadow already, the lamps do not count.
    """
    camera = renderer.scene.camera
    coverage = spread((camera.height, camera.width), object_pixels, mask).reshape(-1)
    may_see_object = spread((camera.height, camera.width), object_pixels, np.ones_like(mask))
    sees = may_see_object.reshape(-1).astype(np.int32)

    def shaded(args: LightArgs, wanted: BoolArray) -> tuple[IntArray, FloatArray]:
        # The samples of a pixel that the object fills, as its radiance has seen, see no ground.
        return picture_ratio(renderer, args, sees, wanted & (coverage < 1.0), quality)

    if shadow_mask is None:
        return shaded(args, np.ones(len(sees), bool))
    resized = resize(shadow_mask.shares, camera.height, camera.width)
    shares = np.clip(resized, 0.0, 1.0).reshape(-1)
    lit = shaded(args, shares < 1.0)
    left = without_lamps(light)
    rest = shaded(light_args(left, renderer.device), shares > 0.0)
    open_lit, open_rest = (x.irradiance(renderer.scene.receiver.normal) for x in (light, left))
    return _mixed(lit, rest, shares, open_rest / np.maximum(open_lit, TINY))


def _mixed(
    lit: tuple[IntArray, FloatArray],
    rest: tuple[IntArray, FloatArray],
    shares: FloatArray,
    kept: Float64Array,
) -> tuple[IntArray, FloatArray]:
    """Return the ratio under the light less the mask's share of its lamps.

    With s that share and k what open ground keeps of its light without them, the ratio is
    ``((1 - s) lit + s k rest) / (1 - s + s k)``: each counts as much as the light that it is of.

    Args:
        lit: Pixels and ratio of the whole light; all others are 1.
        rest: The same without lamps.
        shares: Share of the lamps that is taken away in each pixel [1].
        kept: Share of the open plane's irradiance by the light from afar that is left without its
            lamps [1], shape [3].

    Returns:
        Pixels of either, and their ratio.
    """
    pixels = np.union1d(lit[0], rest[0]).astype(np.int32)
    whole, without = (np.ones((len(shares), 3), np.float32) for _ in range(2))
    whole[lit[0]], without[rest[0]] = lit[1], rest[1]
    whole, without, share = whole[pixels], without[pixels], shares[pixels, None]
    weight = share * kept.astype(np.float32)
    share = weight / np.maximum(1.0 - share + weight, TINY)
    # Exact where both agree, and at both ends.
    return pixels, np.where(shares[pixels, None] < 1.0, whole + share * (without - whole), without)


def _planes(
    camera: Camera,
    gbuffer: GBuffer,
    foreground: Foreground,
    fg_display: FloatArray,
    shadow: tuple[IntArray, FloatArray],
) -> dict[str, FloatArray]:
    """Spread the tone-mapped rows over planes of the rendering's size."""
    size = (camera.height, camera.width)
    objects, mask = gbuffer.object_pixels, foreground.mask
    premultiplied = fg_display * mask[:, None]
    parts = _parts(foreground, premultiplied)
    return {
        "foreground": spread(size, objects, premultiplied),
        "matte": spread(size, objects, mask),
        "shadow_ratio": spread(size, *shadow, outside=1.0),
        **{name: spread(size, objects, values) for name, values in parts.items()},
        **_geometry(size, gbuffer, camera),
    }


def _parts(foreground: Foreground, premultiplied: FloatArray) -> dict[str, FloatArray]:
    """Split the tone-mapped object so that diffuse + specular + emission = foreground.

    A curve is not additive: each part keeps its share of the radiance.
    """
    whole = np.maximum(foreground.radiance, 1e-30)
    diffuse = premultiplied * (foreground.diffuse / whole)
    emission = premultiplied * (foreground.emission / whole)
    return {
        "diffuse": diffuse,
        "emission": emission,
        "specular": np.maximum(premultiplied - diffuse - emission, 0.0),
    }


def _geometry(size: tuple[int, int], gbuffer: GBuffer, camera: Camera) -> dict[str, FloatArray]:
    seen = gbuffer.coverage > 0.0
    pixels = gbuffer.object_pixels[seen]
    position = gbuffer.position[seen]
    depth = (camera.c2w[:3, 3] - position) @ camera.c2w[:3, 2]
    return {
        "depth": spread(size, pixels, depth.astype(np.float32), outside=np.inf),
        "position": spread(size, pixels, position.astype(np.float32)),
        "normal": spread(size, pixels, gbuffer.normal[seen]),
        "albedo": spread(size, pixels, gbuffer.base_color[seen]),
        "roughness": spread(size, pixels, gbuffer.roughness[seen]),
    }


def spread(
    size: tuple[int, int], pixels: IntArray, values: FloatArray, outside: float = 0.0
) -> FloatArray:
    """Spread rows of values over an image.

    Args:
        size: Height and width of the image [px].
        pixels: Row-major pixel indices, a row each, shape [row].
        values: Shape [row, ...].
        outside: Value of all other pixels.

    Returns:
        Shape [height, width, ...], float32.
    """
    plane = blank((size[0] * size[1], *values.shape[1:]), outside)
    plane[pixels] = values
    return plane.reshape(*size, *values.shape[1:])


def blank(shape: tuple[int, ...], value: float) -> FloatArray:
    """Return an array of one value, float32; what is left 0 takes no memory."""
    if value == 0.0:
        return np.zeros(shape, np.float32)
    return np.full(shape, value, np.float32)
