"""Compositing: rendered radiance to layers at the photo's size, codes, ball preview."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warpir.app.inputs import Inputs
from warpir.core.arrays import BoolArray, CodeArray, FloatArray, IntArray
from warpir.core.color import GAMMA, linear_to_gamma
from warpir.core.latlong import map_directions, texel_solid_angles, uv_of
from warpir.io.images.photos import Photo
from warpir.io.layers import HALF_MAX, Layers
from warpir.kernels.types import LightArgs
from warpir.look.camera_look import CameraLook
from warpir.look.denoise import denoised_object, denoised_ratio
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.renderer import Foreground, GBuffer, Renderer
from warpir.render.resizing import resize, resize_planes
from warpir.render.shadow.mirror import leaving_ground, mirror_planes, shown_mirror
from warpir.render.shadow.picture import ShadowSamples, picture_ratio
from warpir.scene.camera import Camera
from warpir.scene.lamps import without_lamps
from warpir.scene.light import Light, as_map
from warpir.scene.shadow_mask import ShadowMask
from warpir.scene.tone_curves import Curves, ToneKnots

RECEIVER_WIDTH = 1024
"""Largest width of the photo as a radiance texture of the receiver [px]."""
BEHIND_GLASS_WIDTH = 2048
"""The same where glass shows it [px]."""
GREY_BALL = 0.18
"""Reflectance of the matte ball in ``balls.png``."""


@dataclass(frozen=True)
class Quality:
    """Sampling of a rendering."""

    samples: int
    """Camera samples per pixel."""
    rays: int
    """Rays per camera sample and sampling technique."""
    depth: int
    """Largest number of surface interactions of a path."""
    seed: int
    indirect_limit: float = 0.0
    """Clamp on a path's indirect radiance; 0 for none, which is unbiased."""
    is_denoised: bool = False
    """Whether the noise of object and shadow is taken out (`warpir.look.denoise`)."""
    ground_roughness: float | None = None
    """Of the coat in which the ground shows the object [1]; None: the ground is matt."""


UNCHANGED = CameraLook()
"""Look of a camera that neither blurs nor has noise."""


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


def make_picture(
    renderer: Renderer,
    light_fg: Light,
    light_shadow: Light,
    photo: Photo,
    quality: Quality,
    curve_fg: ToneKnots,
    curve_shadow: ToneKnots,
    is_reinhard: bool = True,
    *,
    occluder: FloatArray | None = None,
    shadow_mask: ShadowMask | None = None,
    look: CameraLook = UNCHANGED,
    behind: Light | None = None,
) -> Picture:
    """Render object and shadow at the scene camera's resolution and put them into the photo.

    The arguments are those of `render` and `composite`.
    """
    rendering = render(
        renderer,
        light_fg,
        light_shadow,
        quality,
        curve_fg,
        curve_shadow,
        is_reinhard,
        shadow_mask=shadow_mask,
        behind=behind,
    )
    return composite(rendering, photo, quality.seed, occluder, look)


def render(
    renderer: Renderer,
    light_fg: Light,
    light_shadow: Light,
    quality: Quality,
    curve_fg: ToneKnots,
    curve_shadow: ToneKnots,
    is_reinhard: bool = True,
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
        curve_fg: One tone curve.
        curve_shadow: Three tone curves.
        is_reinhard: Whether Reinhard's operator precedes the foreground curve.
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
        ratio = denoised_ratio(ratio, receiver_pixels, (camera.height, camera.width))
    fg, beta = renderer.tone(foreground, ratio, curve_fg, curve_shadow, is_reinhard)
    planes = _planes(renderer.scene.camera, gbuffer, foreground, fg, (receiver_pixels, beta))
    if quality.ground_roughness is not None:
        objects, matte = gbuffer.object_pixels, planes["matte"]
        how = quality.ground_roughness, quality.depth, _samples(quality)
        hidden = None if behind is None else light_args(behind, renderer.device)
        shaded = (planes["shadow_ratio"] != 1.0).any(axis=-1)
        planes |= mirror_planes(renderer, args_fg, objects, matte, shaded, *how, hidden)
    counts = len(gbuffer.object_pixels), len(receiver_pixels)
    curves = Curves("reinhard" if is_reinhard else "linear", curve_fg, curve_shadow)
    return Rendering(planes, *counts, curves)


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
    planes = dict(rendering.planes)
    enlarged = photo.srgb.shape[1] / planes["matte"].shape[1]
    if planes["matte"].shape != photo.srgb.shape[:2]:
        planes = resize_planes(planes, *photo.srgb.shape[:2])
    planes = look.sharpened_like_photo(planes, enlarged)
    planes = look.shown_like_photo(planes, photo.linear())
    cut = 0
    if "image" in planes:
        planes["mirror"], cut = shown_mirror(planes, photo.linear(), rendering.curves, look)
    if occluder is not None:
        planes = _behind(planes, occluder)
    layers = _layers(planes, photo)
    changed = (layers.matte > 0.0) | (layers.shadow_ratio != 1.0).any(axis=-1)
    if layers.mirror is not None:
        changed |= (layers.mirror != 0.0).any(axis=-1)
    layers = _with_grain(layers, look, changed, seed, photo.is_deep)
    image = linear_to_gamma(layers.composite).astype(np.float32)
    counts = rendering.object_pixel_count, rendering.receiver_pixel_count
    return Picture(layers, image, changed, *counts, look, cut)


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
    samples = _samples(quality)
    coverage = _plane((camera.height, camera.width), object_pixels, mask).reshape(-1)
    may_see_object = _plane((camera.height, camera.width), object_pixels, np.ones_like(mask))
    sees = may_see_object.reshape(-1).astype(np.int32)

    def shaded(args: LightArgs, wanted: BoolArray) -> tuple[IntArray, FloatArray]:
        # The samples of a pixel that the object fills, as its radiance has seen, see no ground.
        return picture_ratio(renderer, args, sees, wanted & (coverage < 1.0), samples)

    if shadow_mask is None:
        return shaded(args, np.ones(len(sees), bool))
    resized = resize(shadow_mask.shares, camera.height, camera.width)
    shares = np.clip(resized, 0.0, 1.0).reshape(-1)
    lit = shaded(args, shares < 1.0)
    rest = shaded(light_args(without_lamps(light), renderer.device), shares > 0.0)
    return _mixed(lit, rest, shares)


def _samples(quality: Quality) -> ShadowSamples:
    return ShadowSamples(quality.samples, quality.rays, quality.seed, quality.indirect_limit)


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
        "foreground": _plane(size, objects, premultiplied),
        "matte": _plane(size, objects, mask),
        "shadow_ratio": _plane(size, *shadow, outside=1.0),
        **{name: _plane(size, objects, values) for name, values in parts.items()},
        **_geometry(size, gbuffer, camera),
    }


def _layers(planes: dict[str, FloatArray], photo: Photo) -> Layers:
    """Put the planes over the photo, both of one size."""
    plate = photo.linear()
    if not photo.is_deep:
        # Rounded as in the file of layers, so that they recompose exactly; rounding to
        # half changes 8-bit codes by .06 at most.
        plate = _halves(plate)
        for name in ("foreground", "matte", "shadow_ratio"):
            planes[name] = _halves(planes[name])
    matte = planes["matte"]
    ground = (1.0 - matte)[..., None] * plate * planes["shadow_ratio"]
    composite = planes["foreground"] + ground
    if "mirror" in planes:
        planes["mirror"] = leaving_ground(planes["mirror"], ground)
        planes["mirror"] = planes["mirror"] if photo.is_deep else _halves(planes["mirror"])
        composite = composite + planes["mirror"]
    return Layers(
        composite=composite,
        foreground=np.concatenate([planes["foreground"], matte[..., None]], axis=-1),
        plate=plate,
        **{k: v for k, v in planes.items() if k not in {"foreground", "image", "hidden", "kept"}},
    )


def _with_grain(
    layers: Layers, look: CameraLook, changed: BoolArray, seed: int, is_deep: bool
) -> Layers:
    """Add the photo's grain to what has changed, in a layer of its own."""
    grain = look.grain_on(layers.composite, layers.plate, layers.matte, changed, seed, GAMMA)
    if grain is None:
        return layers
    grain = grain if is_deep else _halves(grain)
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


def _mixed(
    lit: tuple[IntArray, FloatArray],
    rest: tuple[IntArray, FloatArray],
    shares: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Blend the ratio under the whole light and that without lamps by the mask.

    Args:
        lit: Pixels and ratio of the whole light; all others are 1.
        rest: The same without lamps.
        shares: Weight of the second in each pixel [1].

    Returns:
        Pixels of either, and their ratio.
    """
    pixels = np.union1d(lit[0], rest[0]).astype(np.int32)
    whole, without = (np.ones((len(shares), 3), np.float32) for _ in range(2))
    whole[lit[0]], without[rest[0]] = lit[1], rest[1]
    whole, without, share = whole[pixels], without[pixels], shares[pixels, None]
    # Exact where both agree, and at both ends.
    return pixels, np.where(share < 1.0, whole + share * (without - whole), without)


def scene_of(inputs: Inputs, camera: Camera, device: str, curves: Curves) -> Scene:
    """Put the object onto its plane or onto the mesh that --proxy gave.

    Args:
        inputs: Photo, asset, receiver and placement.
        camera: At the resolution that is to be rendered.
        device: Warp device.
        curves: Tone curves of the picture, which the photo of the receiver is taken to have passed.
    """
    ground = inputs.placement.ground
    placed = Placed(inputs.asset, inputs.placement.asset_to_world)
    radiance = None
    if any(m.is_solid_glass for m in inputs.asset.materials):
        radiance = photo_radiance(inputs.photo, curves, BEHIND_GLASS_WIDTH)
    elif inputs.proxy is not None:
        radiance = photo_radiance(inputs.photo, curves)
    receiver = Receiver(ground[:3], -float(ground[3]), inputs.proxy, radiance, inputs.is_plane)
    return Scene([placed], camera, receiver, device, inputs.lamps)


def photo_radiance(photo: Photo, curves: Curves, width_max: int = RECEIVER_WIDTH) -> FloatArray:
    """Return the radiance that the picture's curves and operator would show as the photo.

    Args:
        photo: The photograph.
        curves: Tone curves of the picture.
        width_max: Largest width of the result [px].

    Returns:
        Relative [W/(m^2 sr)], shape [height, width, 3].
    """
    linear = photo.linear()
    height, width = linear.shape[:2]
    if width > width_max:
        linear = resize(linear, max(1, round(height * width_max / width)), width_max)
    radiance = np.empty_like(linear, np.float32)
    # By the row: what lies between in float64 would be the largest arrays of a run.
    for row, values in zip(radiance, linear, strict=True):
        row[:] = curves.radiance(values)
    return radiance


def _halves(plane: FloatArray) -> FloatArray:
    """Round to what half-precision numbers can hold; what shines brighter is clamped there."""
    # All values are display-linear, near [0, 1] but for strong emitters. NaN and Inf pass through.
    if not np.abs(plane).max(initial=0.0) < HALF_MAX:
        plane = np.where(np.isfinite(plane), np.clip(plane, -HALF_MAX, HALF_MAX), plane)
    rounded: FloatArray = plane.astype(np.float16).astype(np.float32)
    return rounded


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
        "depth": _plane(size, pixels, depth.astype(np.float32), outside=np.inf),
        "position": _plane(size, pixels, position.astype(np.float32)),
        "normal": _plane(size, pixels, gbuffer.normal[seen]),
        "albedo": _plane(size, pixels, gbuffer.base_color[seen]),
        "roughness": _plane(size, pixels, gbuffer.roughness[seen]),
    }


def _plane(
    size: tuple[int, int], pixels: IntArray, values: FloatArray, outside: float = 0.0
) -> FloatArray:
    """Spread rows of values over an image."""
    plane = np.full((size[0] * size[1], *values.shape[1:]), outside, np.float32)
    plane[pixels] = values
    return plane.reshape(*size, *values.shape[1:])


def balls(light: Light, camera: Camera, is_reinhard: bool, size: int = 192) -> CodeArray:
    """Return a mirror ball and a grey diffuse ball under the light, as the camera sees them.

    As on a film set: `GREY_BALL` keeps the lit side of a sunny light below the photo's white.

    Args:
        light: At the photo's exposure.
        camera: Gives the viewing direction.
        is_reinhard: The tone operator of the picture.
        size: Height of the preview [px]; it is twice as wide.

    Returns:
        Display codes, shape [size, 2 size, 3].
    """
    axis = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(axis * 1.06, -axis * 1.06)
    inside = x * x + y * y < 1.0
    z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
    normal = np.stack([x, y, z], axis=-1) @ camera.c2w[:3, :3].T
    view = camera.c2w[:3, 2]
    reflected = 2.0 * (normal @ view)[..., None] * normal - view
    sharp = as_map(light, 256)
    u, v = uv_of(reflected)
    column = (u * sharp.shape[1]).astype(int) % sharp.shape[1]
    row = np.minimum(v * sharp.shape[0], sharp.shape[0] - 1).astype(int)
    mirror = sharp[row, column].astype(np.float64)
    coarse = as_map(light, 32).astype(np.float64)
    weighted = (coarse * texel_solid_angles(32, 64)[:, None, None]).reshape(-1, 3)
    toward = map_directions(32, 64).reshape(-1, 3).T
    # One row at a time: the cosines of all pixels with all texels would take gigabytes.
    diffuse = np.stack([np.maximum(row @ toward, 0.0) @ weighted / np.pi for row in normal])
    diffuse *= GREY_BALL
    pair = []
    for ball in (mirror, diffuse):
        shown = ball / (1.0 + ball) if is_reinhard else np.minimum(ball, 1.0)
        shown = np.where(inside[..., None], shown, 0.03)
        pair.append(linear_to_gamma(shown))
    return np.round(np.concatenate(pair, axis=1) * 255.0).astype(np.uint8)


def as_file_map(light: Light) -> FloatArray:
    """Return the light as a map for files: a given map's own size, lobes on 512 rows or more."""
    height = 256
    if light.texels is not None:
        height = max(light.texels.shape[0], 16)
    if light.lobes is not None:
        height = max(height, 512)
    if light.texels is not None and light.lobes is None:
        return light.texels
    return as_map(light, height)
