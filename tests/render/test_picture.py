"""From radiance to the picture: both composites agree, parts add up, resizing, ball preview."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from tests.builders.shapes import box, camera, constant, ground, lobe, placed, quad, sphere
from tests.oracles import composite, encode, luminance, reinhard, spline
from warpir.core.arrays import CodeArray, Int64Array
from warpir.io.images.photos import Photo
from warpir.io.images.resize import resize
from warpir.look.camera_look import CameraLook
from warpir.look.denoise import denoised_ratio, denoiser_version
from warpir.look.grain import Grain
from warpir.look.response import Response
from warpir.look.sharpness import EdgeBlur
from warpir.render.bridge import ComposeConstants, compose
from warpir.render.composite import Picture, make_picture
from warpir.render.device_light import light_args
from warpir.render.device_scene import Scene
from warpir.render.integrator import Radiance
from warpir.render.picture import planes
from warpir.render.picture.light_preview import balls
from warpir.render.picture.quality import Quality
from warpir.render.picture.resizing import resize_planes
from warpir.render.renderer import Renderer
from warpir.render.shadow.picture import picture_ratio
from warpir.render.tone_curve import Knots, ToneCurve
from warpir.scene.asset import Material
from warpir.scene.camera import Camera
from warpir.scene.light import Light, axis_from_angles, plain_sky
from warpir.scene.tone_curves import Curves, ToneKnots

COMPOSITE = 1e-5
"""Largest difference of two composites of the same numbers, display-encoded: the task's figure."""
PART = 1e-5
"""Parts of a pixel are shares of it, so only rounding keeps their sum from it."""
CODE = 1
"""Codes of 8 bits by which mirrored halves of a ball may differ: the map's texels are square."""
FILTER_TAIL = 1e-6
"""What the Gaussian of a reduction still weighs four standard deviations away."""
QUALITY = Quality(samples=8, rays=1, depth=3, seed=5)
VIEW = camera(48, 32, 48.0, (0.0, 1.2, 0.0), -12.0)
PLAIN = Curves.identity("reinhard")


def photo(height: int = 32, width: int = 48) -> Photo:
    """A photo with structure everywhere, 16 bit."""
    rng = np.random.default_rng(4)
    codes = rng.integers(6000, 60000, (height, width, 3), dtype=np.uint16)
    return Photo(codes, (codes / np.float32(65535.0)).astype(np.float32), "png")


def renderer(device: str, view: Camera = VIEW, glow: float = 1.0) -> Renderer:
    """A glossy ball and a glowing matte box on the ground."""
    emission = (0.2 * glow, 0.1 * glow, 0.05 * glow)
    objects = placed(
        [sphere((-0.6, 0.5, -4.0), 0.5), box((0.6, 0.4, -4.2), (0.8, 0.8, 0.8), 1)],
        Material(base_color=(0.9, 0.6, 0.3), metallic=0.0, roughness=0.3),
        Material(base_color=(0.3, 0.5, 0.8), metallic=0.5, emission=emission),
    )
    return Renderer(Scene([objects], view, ground(0.0), device))


def sunny() -> Light:
    """A sun and a sky."""
    sky = plain_sky((0.4, 0.6, 1.0), (0.2, 0.2, 0.1))
    return Light(lobe((0.6, 0.7, 0.3), 400.0, (60.0, 50.0, 40.0)).lobes, sky)


def bent(tone: str = "reinhard") -> Curves:
    """Random tone curves."""
    return Curves(tone, bent_knots(1, 1), bent_knots(3, 2))


def bent_knots(curves: int, seed: int) -> ToneKnots:
    generator = torch.Generator().manual_seed(seed)
    curve = ToneCurve(curves)
    with torch.no_grad():
        for values in curve.parameters():
            values.copy_(0.7 * torch.randn(values.shape, generator=generator))
    return curve.plain()


def tensors(knots: ToneKnots) -> Knots:
    """The same curves as the differentiable composite takes them."""
    return Knots(*(torch.from_numpy(k) for k in knots.arrays()))


def picture(
    device: str,
    curves: Curves = PLAIN,
    view: Camera = VIEW,
    quality: Quality = QUALITY,
    **more: Any,
) -> Picture:
    """A finished picture of `renderer` under `sunny`."""
    light = sunny()
    return make_picture(renderer(device, view), light, light, photo(), quality, curves, **more)


@pytest.mark.parametrize("tone", ["reinhard", "linear"])
@pytest.mark.parametrize("made", [Curves.identity, bent], ids=["identity", "curves"])
def test_picture_equals_the_differentiable_composite(
    device: str, tone: str, made: Callable[[str], Curves]
) -> None:
    """The final picture and the composite of the loop agree on the same radiance (B4, B5)."""
    curves = made(tone)
    final = picture(device, curves)
    r, light = renderer(device), sunny()
    args = light_args(light, r.device)
    objects = r.gbuffer(QUALITY.seed).object_pixels
    out = r.foreground(args, objects, QUALITY.samples, QUALITY.rays, QUALITY.depth, QUALITY.seed)
    coverage = np.zeros(VIEW.width * VIEW.height)
    sees = np.zeros(VIEW.width * VIEW.height, np.int32)
    coverage[objects], sees[objects] = out.mask, 1
    shaded, ratio = picture_ratio(r, args, sees, coverage < 1.0, QUALITY)
    is_reinhard = tone == "reinhard"
    constants = ComposeConstants(photo().linear(), objects, shaded, out.mask, device, is_reinhard)
    image = compose(
        constants,
        Radiance(*(torch.from_numpy(x) for x in (out.radiance, ratio, np.ones_like(ratio)))),
        *(tensors(k) for k in (curves.foreground, curves.shadow_ratio)),
    )
    found = image[0].permute(1, 2, 0).numpy()
    assert found.shape == final.image.shape
    assert np.abs(found - np.clip(final.image, 0.0, 1.0)).max() < COMPOSITE
    assert final.object_pixel_count == len(objects) and final.receiver_pixel_count == len(shaded)


def test_picture_is_recomputed_from_its_layers(device: str) -> None:
    """Composite = fg + (1 - a) plate ratio, and the image is its encoding (method 2.13, M 6)."""
    final = picture(device, bent())
    layers = final.layers
    alpha = layers.foreground[..., 3]
    straight = layers.foreground[..., :3] / np.maximum(alpha, 1e-9)[..., None]
    expected = composite(layers.plate, alpha, straight, layers.shadow_ratio)
    np.testing.assert_allclose(layers.composite, expected, atol=COMPOSITE)
    np.testing.assert_allclose(final.image, encode(layers.composite), atol=COMPOSITE)
    np.testing.assert_array_equal(layers.matte, alpha)
    np.testing.assert_array_equal(layers.plate, photo().linear())


def test_i20_occluder_keeps_the_photo_in_front(device: str) -> None:
    """White keeps the photo's codes, black changes nothing, grey mixes both; layers add up."""
    free = picture(device)
    ramp = np.broadcast_to(np.linspace(0.0, 1.0, 5, dtype=np.float32)[:, None], (5, 48))
    occluder = np.zeros((32, 48), np.float32)
    rows = 12
    assert free.layers.matte[rows:].max() == 1.0 and free.changed[rows + 5 :].any()
    occluder[rows : rows + 5], occluder[rows + 5 :] = ramp, 1.0
    behind = picture(device, occluder=occluder)
    m = occluder[..., None]
    expected = m * free.layers.plate + (1.0 - m) * free.layers.composite
    np.testing.assert_allclose(behind.layers.composite, expected, atol=COMPOSITE)
    layers = behind.layers
    recomputed = (
        layers.foreground[..., :3]
        + (1.0 - layers.foreground[..., 3:]) * layers.plate * layers.shadow_ratio
    )
    np.testing.assert_allclose(layers.composite, recomputed, atol=COMPOSITE)
    np.testing.assert_array_equal(layers.matte, (1.0 - occluder) * free.layers.matte)
    np.testing.assert_array_equal(layers.composite[:rows], free.layers.composite[:rows])
    assert not behind.changed[rows + 4 :].any()
    np.testing.assert_array_equal(
        photo().encode(behind.image, behind.changed)[rows + 4 :], photo().codes[rows + 4 :]
    )
    assert layers.depth is not None and np.isinf(layers.depth[rows + 4 :]).all()
    parts = sum(getattr(layers, name) for name in ("diffuse", "specular", "emission"))
    np.testing.assert_allclose(parts, layers.foreground[..., :3], atol=PART)


def test_foreground_is_the_tone_mapped_radiance(device: str) -> None:
    """Reinhard, then the curve, of radiance over coverage (method 2.4), in float64."""
    curves = bent()
    layers = picture(device, curves).layers
    r = renderer(device)
    objects = r.gbuffer(QUALITY.seed).object_pixels
    args = light_args(sunny(), r.device)
    out = r.foreground(args, objects, QUALITY.samples, QUALITY.rays, QUALITY.depth, QUALITY.seed)
    seen = out.mask > 0.0
    mask = out.mask[seen, None]
    x, y, slope = (k[0].astype(np.float64) for k in curves.foreground.arrays())
    shown, _ = spline(reinhard(out.radiance[seen] / mask), x, y, slope)
    found = layers.foreground.reshape(-1, 4)[objects[seen], :3]
    np.testing.assert_allclose(found, mask * shown, atol=COMPOSITE)


@pytest.mark.parametrize("tone", ["reinhard", "linear"])
def test_object_on_a_linear_plate_exceeds_one_where_a_photo_clips(device: str, tone: str) -> None:
    """Without an operator radiance above 1 stays; everything else is as on a photo."""
    codes = photo().linear()
    plate = Photo(codes, photo().srgb, "exr")
    light, curves = sunny().scaled(4.0), bent(tone)
    on_photo, layers = (
        make_picture(renderer(device), light, light, p, QUALITY, curves).layers
        for p in (photo(), plate)
    )
    found, clipped = layers.foreground, on_photo.foreground
    if tone == "reinhard":
        np.testing.assert_array_equal(found, clipped)
        return
    r = renderer(device)
    objects = r.gbuffer(QUALITY.seed).object_pixels
    args = light_args(light, r.device)
    out = r.foreground(args, objects, QUALITY.samples, QUALITY.rays, QUALITY.depth, QUALITY.seed)
    bright = out.radiance > out.mask[:, None]
    assert bright.sum() > 20
    shown = found.reshape(-1, 4)[objects, :3]
    np.testing.assert_allclose(shown[bright], out.radiance[bright], rtol=1e-6)
    np.testing.assert_array_equal(shown[~bright], clipped.reshape(-1, 4)[objects, :3][~bright])
    parts = sum(getattr(layers, name) for name in ("diffuse", "specular", "emission"))
    np.testing.assert_allclose(parts, found[..., :3], rtol=1e-3, atol=PART)


@pytest.mark.parametrize("tone", ["reinhard", "linear"])
def test_parts_add_up_to_the_foreground(device: str, tone: str) -> None:
    """Diffuse + specular + emission = foreground, each at least 0, each where it should be."""
    layers = picture(device, bent(tone)).layers
    assert layers.diffuse is not None and layers.specular is not None
    assert layers.emission is not None
    total = layers.diffuse + layers.specular + layers.emission
    np.testing.assert_allclose(total, layers.foreground[..., :3], atol=PART)
    for part in (layers.diffuse, layers.specular, layers.emission):
        assert part.min() >= 0.0 and part.max() > 0.01
    assert layers.position is not None
    ball = (layers.matte == 1.0) & (layers.position[..., 0] < 0.0)
    np.testing.assert_array_equal(layers.emission[ball], 0.0)


def test_untouched_pixels_are_marked_and_equal(device: str) -> None:
    """Where neither object nor shadow is, the composite is the plate bit for bit."""
    final = picture(device)
    away = ~final.changed
    assert 100 < away.sum() < away.size - 100
    np.testing.assert_array_equal(final.layers.composite[away], final.layers.plate[away])
    np.testing.assert_array_equal(final.layers.shadow_ratio[away], 1.0)
    assert final.changed[final.layers.matte > 0.0].all()


def test_geometry_layers_describe_the_surface(device: str) -> None:
    """Depth is along the viewing axis, positions lie on the object, unit normals face us."""
    layers = picture(device).layers
    assert layers.depth is not None and layers.position is not None and layers.normal is not None
    assert layers.albedo is not None and layers.roughness is not None
    whole = layers.matte == 1.0
    np.testing.assert_array_equal(np.isinf(layers.depth), layers.depth == np.inf)
    assert np.isinf(layers.depth[layers.matte == 0.0]).all()
    local = (layers.position[whole] - VIEW.c2w[:3, 3]) @ VIEW.c2w[:3, :3]
    np.testing.assert_allclose(layers.depth[whole], -local[:, 2], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(layers.normal[whole], axis=1), 1.0, atol=1e-5)
    view = VIEW.c2w[:3, 3] - layers.position[whole]
    assert ((view * layers.normal[whole]).sum(axis=1) > 0.0).all()
    ball = minimum_filter((layers.position[..., 0] < -0.15) & whole, 3)
    distance = np.linalg.norm(layers.position[ball] - [-0.6, 0.5, -4.0], axis=1)
    np.testing.assert_allclose(distance, 0.5, atol=0.03)
    np.testing.assert_allclose(layers.albedo[ball], np.tile([0.9, 0.6, 0.3], (ball.sum(), 1)))
    np.testing.assert_allclose(layers.roughness[ball], 0.3, rtol=1e-6)


def test_blur_response_and_grain_recompose(device: str) -> None:
    """The layers add up with a camera's look too, and what did not change keeps its codes."""
    look = CameraLook(EdgeBlur(1.0, 0), Grain((0.5,), ((0.02,) * 3,), 0.5, 0.3), Response(1.2))
    plain, final = picture(device), picture(device, look=look)
    layers = final.layers
    assert layers.grain is not None and np.abs(layers.grain).max() > 0.01
    added = layers.foreground[..., :3] + layers.grain
    left = (1.0 - layers.matte)[..., None] * layers.plate * layers.shadow_ratio
    np.testing.assert_allclose(layers.composite, added + left, atol=1e-6)
    parts = layers.diffuse + layers.specular + layers.emission
    np.testing.assert_allclose(parts, layers.foreground[..., :3], atol=1e-4)
    codes = photo().encode(final.image, final.changed)
    np.testing.assert_array_equal(codes[~final.changed], photo().codes[~final.changed])
    # The outline is softer, and no coverage is lost.
    assert layers.matte.sum() == pytest.approx(plain.layers.matte.sum(), rel=0.01)
    assert (layers.matte == 1.0).sum() < (plain.layers.matte == 1.0).sum()
    np.testing.assert_array_equal(picture(device, look=look).image, final.image)


@pytest.mark.skipif(denoiser_version() is None, reason="pyoidn is not installed")
def test_denoised_picture_is_nearer_to_the_truth(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Less error on object and shadow; layers recompose, parts add up, other pixels keep codes.

    The shadow's filter is told which pixels the object fills.
    """
    filled = []
    monkeypatch.setattr(
        planes, "denoised_ratio", lambda *a: filled.append(a[2]) or denoised_ratio(*a)
    )

    def final(samples: int, is_denoised: bool) -> Picture:
        quality = replace(QUALITY, samples=samples, is_denoised=is_denoised)
        return picture(device, quality=quality)

    truth, noisy, clean = final(512, False), final(8, False), final(8, True)
    for where in (truth.layers.matte > 0.5, truth.changed & (truth.layers.matte == 0.0)):
        before, after = (np.abs(p.image - truth.image)[where].mean() for p in (noisy, clean))
        assert after < before
    layers = clean.layers
    np.testing.assert_array_equal(filled[0], np.flatnonzero(layers.matte == 1.0))
    parts = layers.diffuse + layers.specular + layers.emission
    np.testing.assert_allclose(parts, layers.foreground[..., :3], atol=1e-3)
    codes = photo().encode(clean.image, clean.changed)
    np.testing.assert_array_equal(codes[~clean.changed], photo().codes[~clean.changed])
    np.testing.assert_array_equal(final(8, True).image, clean.image)


@pytest.mark.parametrize("size", [(24, 16), (96, 64), (31, 21)], ids=["half", "double", "odd"])
def test_another_rendering_size_gives_the_photos_size(device: str, size: tuple[int, int]) -> None:
    """--width changes the sampling, not the picture's size, nor where the object is."""
    full = picture(device)
    other = picture(device, view=VIEW.scaled(*size))
    for field in fields(other.layers):
        plane = getattr(other.layers, field.name)
        if field.name in {"grain", "mirror"}:
            assert plane is None, "this picture has none"
            continue
        assert plane.shape == getattr(full.layers, field.name).shape, field.name
        assert not np.isnan(plane).any(), field.name
    np.testing.assert_array_equal(other.layers.plate, full.layers.plate)
    # Two pixels of the coarser grid: the edge's own, and the one that interpolation reaches.
    reach = 4 * max(1, round(48 / size[0])) + 1
    sure = minimum_filter(full.layers.matte, reach) == 1.0
    never = maximum_filter(full.layers.matte, reach) == 0.0
    np.testing.assert_allclose(other.layers.matte[sure], 1.0, atol=1e-5)
    np.testing.assert_allclose(other.layers.matte[never], 0.0, atol=FILTER_TAIL)
    away = ~maximum_filter(full.changed | other.changed, 3)
    assert away.any()
    np.testing.assert_array_equal(other.layers.composite[away], full.layers.plate[away])


@pytest.mark.parametrize("size", [(24, 16), (96, 64)], ids=["half", "double"])
def test_resized_geometry_is_not_mixed_with_the_background(
    device: str, size: tuple[int, int]
) -> None:
    """At the object's border, depth, position, normal and colour are the object's own."""
    other = picture(device, view=VIEW.scaled(*size)).layers
    assert other.depth is not None and other.normal is not None
    assert other.albedo is not None and other.roughness is not None and other.position is not None
    seen = np.isfinite(other.depth)
    assert (other.matte[seen] > 0.0).all() and seen[other.matte > 0.5].all()
    corners = np.array(np.meshgrid(*np.transpose(renderer(device).scene.bounds))).reshape(3, -1).T
    depth = (VIEW.c2w[:3, 3] - corners) @ VIEW.c2w[:3, 2]
    assert depth.min() < other.depth[seen].min() < other.depth[seen].max() < depth.max()
    np.testing.assert_allclose(np.linalg.norm(other.normal[seen], axis=1), 1.0, atol=1e-5)
    assert other.roughness[seen].min() > 0.29
    assert other.albedo[seen].max(axis=1).min() > 0.75
    local = (other.position[seen] - VIEW.c2w[:3, 3]) @ VIEW.c2w[:3, :3]
    np.testing.assert_allclose(other.depth[seen], -local[:, 2], rtol=1e-3)


@pytest.mark.parametrize("edge", [16.0, 15.5])
@pytest.mark.parametrize("width", [16, 24, 96, 192])
def test_no_light_leaks_in_where_a_resized_object_touches_its_shadow(
    width: int, edge: float
) -> None:
    """Below the object's edge the shadow and the mirror image are those beside it."""
    column = np.arange(48) * np.ones((32, 1))
    planes = {name: np.zeros((32, 48, 3), np.float32) for name in ("position", "normal", "albedo")}
    planes["matte"] = np.clip(edge - column, 0.0, 1.0).astype(np.float32)
    planes["depth"] = np.where(column < edge, 1.0, np.inf).astype(np.float32)
    planes["roughness"] = np.zeros((32, 48), np.float32)
    shade, image = np.array([[0.3, 0.4, 0.5], [0.1, 0.2, 3.0]], np.float32)
    shown = ((column >= edge - 0.9) & (column < 32))[..., None]
    planes["shadow_ratio"] = np.where(shown, shade, 1.0).astype(np.float32)
    planes["image"] = np.where(shown, image, 0.0).astype(np.float32)
    resized = resize_planes(planes, width * 2 // 3, width)
    contact = (resized["matte"] > 0.0) & (resized["matte"] < 0.99)
    assert contact.any(axis=1).all()
    np.testing.assert_allclose(resized["shadow_ratio"][contact] - shade, 0.0, atol=1e-5)
    np.testing.assert_allclose(resized["image"][contact] - image, 0.0, atol=1e-5)
    assert (resized["shadow_ratio"][:, -width // 8 :] == 1.0).all()


def test_resize_keeps_coverage_and_constants() -> None:
    """Any factor keeps a constant, the mean within a percent, and the range."""
    rng = np.random.default_rng(0)
    plane = rng.uniform(0.0, 1.0, (20, 30)).astype(np.float32)
    plane[:, :10] = 0.0
    for height, width in ((10, 15), (40, 60), (7, 11), (33, 47)):
        resized = resize(plane, height, width)
        assert resized.shape == (height, width)
        assert resized.min() >= 0.0 and resized.max() <= 1.0
        assert resized.mean() == pytest.approx(float(plane.mean()), rel=0.05)
        flat = resize(np.full((20, 30, 3), 0.7, np.float32), height, width)
        np.testing.assert_allclose(flat, 0.7, rtol=1e-5)


def test_enlarging_is_linear_between_centres_and_even_beyond() -> None:
    """A ramp stays that ramp at the new pixels' centres; outside the outermost it goes on level."""
    ramp = np.broadcast_to(np.arange(30.0, dtype=np.float32), (20, 30))
    at = (np.arange(90) + 0.5) / 3.0 - 0.5
    found = resize(np.stack([ramp, 2.0 * ramp], axis=-1), 40, 90)
    expected = np.broadcast_to(np.clip(at, 0.0, 29.0), (40, 90))
    np.testing.assert_allclose(found[..., 0], expected, atol=1e-4)
    np.testing.assert_allclose(found[..., 1], 2.0 * expected, atol=2e-4)


def test_object_away_from_the_frame_leaves_the_photo(device: str) -> None:
    """Nothing of the object and no shadow in view: the composite is the photo."""
    far = placed(box((500.0, 0.5, -4.0), (1.0, 1.0, 1.0)))
    away = Renderer(Scene([far], VIEW, ground(0.0), device))
    final = make_picture(away, sunny(), sunny(), photo(), QUALITY, PLAIN)
    assert not final.changed.any()
    np.testing.assert_array_equal(final.layers.composite, photo().linear())
    np.testing.assert_array_equal(photo().encode(final.image, final.changed), photo().codes)


def test_two_lights_serve_object_and_shadow_apart(device: str) -> None:
    """The first light colours the object alone, the second the shadow alone."""
    dark = constant((0.0, 0.0, 0.0))
    side = lobe((-0.8, 0.6, 0.1), 1e4, (1e3, 1e3, 1e3))
    both, only_shadow, other = (
        make_picture(renderer(device, glow=0.0), *lights, photo(), QUALITY, PLAIN).layers
        for lights in ((sunny(), side), (dark, side), (sunny(), sunny()))
    )
    np.testing.assert_array_equal(both.shadow_ratio, only_shadow.shadow_ratio)
    np.testing.assert_array_equal(only_shadow.foreground[..., :3], 0.0)
    np.testing.assert_array_equal(only_shadow.matte, both.matte)
    np.testing.assert_array_equal(other.foreground, both.foreground)
    assert not np.array_equal(other.shadow_ratio, both.shadow_ratio)


# ------------------------------------------------------------------------------- previews

LEVEL = camera(48, 32, 48.0)


def halves(preview: CodeArray) -> tuple[Int64Array, Int64Array]:
    """The mirror ball and the diffuse ball."""
    size = preview.shape[0]
    return preview[:, :size].astype(int), preview[:, size:].astype(int)


@pytest.mark.parametrize("is_reinhard", [True, False], ids=["reinhard", "linear"])
def test_balls_under_constant_light_are_flat_discs(is_reinhard: bool) -> None:
    """A mirror ball shows the radiance itself, a matte one 18 % of it, the same in every pixel."""
    preview = balls(constant((0.5, 0.25, 0.75), 64), VIEW, is_reinhard)
    assert preview.shape == (192, 384, 3) and preview.dtype == np.uint8
    radiance = np.array([0.5, 0.25, 0.75])
    for ball, reflectance in zip(halves(preview), (1.0, 0.18), strict=True):
        seen = reflectance * radiance
        expected = np.round(encode(reinhard(seen) if is_reinhard else seen) * 255.0)
        middle = ball[60:130, 60:130]
        # The diffuse ball sums 32 rows of texels: a percent of ripple.
        assert np.abs(middle - expected).max() <= 2
        for flipped in (ball[::-1], ball[:, ::-1]):
            assert np.abs(ball - flipped).max() <= CODE


def test_balls_show_the_sun_where_the_camera_would() -> None:
    """A sun on the right lights the right of the matte ball; the mirror shows it there too."""
    light = Light(lobe(axis_from_angles(110.0, 30.0), 300.0, (300.0, 300.0, 300.0)).lobes)
    for ball in halves(balls(light, LEVEL, True)):
        lum = luminance(ball)
        y, x = np.mgrid[:192, :192]
        lit = lum > 130
        assert lit.any()
        assert x[lit].mean() > 100 and y[lit].mean() < 92
    left = Light(lobe(axis_from_angles(-110.0, 30.0), 300.0, (300.0, 300.0, 300.0)).lobes)
    for right_ball, left_ball in zip(
        halves(balls(light, LEVEL, True)), halves(balls(left, LEVEL, True)), strict=True
    ):
        differs = np.abs(right_ball - left_ball[:, ::-1]).max(axis=2) > 3 * CODE
        assert differs.mean() < 0.01


def test_balls_turn_with_the_camera() -> None:
    """The camera's pitch and yaw turn what the balls show; a sun straight behind is centred."""
    down = camera(48, 32, 48.0, (0.0, 1.0, 0.0), -40.0)
    # Behind the camera that looks 40 degrees down is 40 degrees up, toward +Z.
    light = Light(lobe(axis_from_angles(180.0, 40.0), 300.0, (300.0, 300.0, 300.0)).lobes)
    mirror, matte = halves(balls(light, down, True))
    for ball in (mirror, matte):
        y, x = np.mgrid[:192, :192]
        lit = luminance(ball) > 0.9 * luminance(ball).max()
        assert abs(x[lit].mean() - 95.5) < 2 and abs(y[lit].mean() - 95.5) < 2


def test_card_in_front_of_its_own_shadow(device: str) -> None:
    """A half-covered pixel takes its ratio from the samples that see the ground (method 2.3)."""
    # Under a vertical sun an upright card covers pixels but shades no ground in view.
    card = placed(quad((0.07, 1.0, -4.0), (0.8, 0, 0), (0, 0.6, 0)))
    r = Renderer(Scene([card], VIEW, ground(0.0), device))
    light = lobe((0.0, 1.0, 0.0), 1e5, (1e4, 1e4, 1e4))
    layers = make_picture(r, light, light, photo(), QUALITY, PLAIN).layers
    half = (layers.matte > 0.0) & (layers.matte < 1.0)
    assert half.any()
    np.testing.assert_array_equal(layers.shadow_ratio[half], 1.0)
