"""The object's mirror image on a glossy ground: closed forms, quadrature, the picture's layer."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests import oracles as o
from tests.builders.shapes import all_pixels, camera, constant, ground, placed, sphere, view_rays
from tests.render.test_picture import QUALITY, bent, picture
from warpir.core.arrays import Float64Array, FloatArray
from warpir.look.response import Response
from warpir.render.composite import UNCHANGED
from warpir.render.device_light import light_args
from warpir.render.device_scene import Scene
from warpir.render.renderer import Renderer
from warpir.render.shadow.mirror import mirror_pixels, shown_mirror
from warpir.scene.asset import Material
from warpir.scene.light import Light
from warpir.scene.tone_curves import Curves

VIEW = camera(24, 16, 24.0, (0.0, 2.0, 0.0), pitch=-30.0)
CENTRE, RADIUS = np.array([0.0, 1.2, -4.0]), 0.8
LAMBERT = Material(base_color=(0.0, 0.0, 0.0), metallic=0.0, specular=0.0, roughness=1.0)
SKY = np.array([0.3, 0.5, 1.0])


def image_of(
    device: str, material: Material, light: Light, roughness: float, radius: float, spp: int = 256
) -> FloatArray:
    """Trace what a ball's image adds in every pixel, also where the ball hides the ground."""
    ball = placed(sphere(CENTRE, radius, 5), material)
    r = Renderer(Scene([ball], VIEW, ground(0.0), device))
    pixels, hidden = all_pixels(VIEW), np.zeros(VIEW.width * VIEW.height, np.int32)
    args = light_args(light, r.device)
    image, behind, _ = r.mirrored(args, pixels, hidden, roughness, spp, 1, 1, 7)
    return image - behind


def mirrored(radius: float, side: int = 24) -> tuple[Float64Array, Float64Array]:
    """Return F where a mirror shows the ball, else 0, and F; means over each pixel's ground."""
    ray = view_rays(VIEW, side)
    down = ray[..., 1]
    sees = down < 0.0
    t = np.where(sees, -VIEW.c2w[1, 3] / np.where(sees, down, -1.0), 0.0)
    point = VIEW.c2w[:3, 3] + t[..., None] * ray
    wi = ray * [1.0, -1.0, 1.0]
    toward = CENTRE - point
    along = (wi * toward).sum(axis=-1)
    apart = (toward**2).sum(axis=-1) - along**2
    hit = sees & (along > 0.0) & (apart < radius**2)
    F = np.where(sees, o.fresnel(-down), 0.0)
    count = np.maximum(sees.sum(axis=1), 1)
    return (F * hit).sum(axis=1) / count, F.sum(axis=1) / count


def test_black_ball_takes_what_a_mirror_showed(device: str) -> None:
    """Under an even sky the image of a black ball is -F L, where geometry puts it."""
    added = image_of(device, LAMBERT, constant(SKY), 0.0, RADIUS) / SKY
    expected, F = mirrored(RADIUS)
    inside = np.isclose(expected, F, rtol=1e-9) & (F > 0.0)
    outside = expected == 0.0
    assert inside.sum() > 10 and outside.sum() > 200
    np.testing.assert_allclose(added[inside], -np.repeat(F[inside, None], 3, 1), rtol=4e-3)
    assert not added[outside].any()
    # Edges: 256 samples of a share
    np.testing.assert_allclose(added[:, 0], -expected, atol=0.02 * F.max() + 1e-4)


def test_emitter_adds_fresnel_times_its_radiance(device: str) -> None:
    """A glowing ball in the dark adds F E; what it emits is not clipped by a limit of paths."""
    material = replace(LAMBERT, emission=(3.0, 20.0, 0.5))
    added = image_of(device, material, constant((0.0, 0.0, 0.0)), 0.0, RADIUS)
    expected, F = mirrored(RADIUS)
    inside = np.isclose(expected, F, rtol=1e-9) & (F > 0.0)
    np.testing.assert_allclose(added[inside], np.outer(F[inside], (3.0, 20.0, 0.5)), rtol=4e-3)


def test_what_is_hidden_is_what_was_behind(device: str) -> None:
    """The light on the object and what the coat showed before may differ."""
    r = Renderer(Scene([placed(sphere(CENTRE, RADIUS, 5), LAMBERT)], VIEW, ground(0.0), device))
    pixels = all_pixels(VIEW)
    dark, even = (light_args(constant((x, x, x)), r.device) for x in (0.0, 1.0))
    args = pixels, np.zeros(len(pixels), np.int32), 0.2, 16, 1, 1, 7
    _, hidden, kept = r.mirrored(even, *args)
    image, behind, beside = r.mirrored(dark, *args, behind=even)
    assert hidden.max() > 0.01 and not image.any()
    np.testing.assert_array_equal(behind, hidden)
    np.testing.assert_array_equal(beside, kept)


@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_white_ball_in_a_furnace_is_not_seen_in_the_mirror(device: str, roughness: float) -> None:
    """A white Lambert ball under an even sky is as bright as what it hides."""
    white = replace(LAMBERT, base_color=(1.0, 1.0, 1.0))
    added = image_of(device, white, constant(), roughness, RADIUS)
    assert np.abs(added).max() < 0.02
    assert abs(added.mean()) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.6, 1.0])
def test_coat_under_a_black_dome_loses_its_albedo(device: str, roughness: float) -> None:
    """Where every reflection meets a black wall, the image is minus the coat's albedo."""
    added = image_of(device, LAMBERT, constant(), roughness, 500.0, 1024)[:, 0]
    cos_o = -view_rays(VIEW, 8)[..., 1].mean(axis=1)
    pixels = np.flatnonzero(cos_o > 0.15)[::17]
    expected = np.array([o.reflected_share(c, roughness**2, o.fresnel) for c in cos_o[pixels]])
    np.testing.assert_allclose(-added[pixels], expected, rtol=0.04)
    assert abs((-added[pixels] / expected).mean() - 1.0) < 5e-3


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.25])
def test_traced_pixels_hold_nearly_all_of_the_image(device: str, roughness: float) -> None:
    """What lies beyond the pixels that are looked at is next to nothing."""
    added = -image_of(device, LAMBERT, constant(), roughness, RADIUS)[:, 0]
    ball = placed(sphere(CENTRE, RADIUS, 5), LAMBERT)
    r = Renderer(Scene([ball], VIEW, ground(0.0), device))
    traced = mirror_pixels(r, np.ones((VIEW.height, VIEW.width), np.bool_), roughness)
    missed = np.delete(added, traced)
    assert missed.sum() <= 1e-3 * added.sum()
    assert len(traced) < VIEW.width * VIEW.height


@pytest.mark.parametrize("tone", ["reinhard", "linear"])
@pytest.mark.parametrize("made", [Curves.identity, bent], ids=["identity", "curves"])
def test_image_is_a_layer_and_changes_nothing_else(
    device: str, tone: str, made: Callable[[str], Curves]
) -> None:
    """A coat adds a layer, which recomposes; object and shadow keep their bytes."""
    off = picture(device, made(tone))
    on = picture(device, made(tone), quality=replace(QUALITY, ground_roughness=0.2))
    assert off.layers.mirror is None and on.layers.mirror is not None
    for name in ("foreground", "shadow_ratio", "plate", "matte"):
        np.testing.assert_array_equal(getattr(off.layers, name), getattr(on.layers, name))
    np.testing.assert_array_equal(on.layers.composite, off.layers.composite + on.layers.mirror)
    assert np.abs(on.layers.mirror).max() > 0.02
    assert on.layers.composite.min() >= 0.0
    assert not on.layers.mirror[on.layers.matte == 1.0].any()
    changed = (on.layers.mirror != 0.0).any(axis=-1)
    assert on.changed[changed].all()
    np.testing.assert_array_equal(on.image[~on.changed], off.image[~on.changed])


@pytest.mark.parametrize("tone", ["reinhard", "linear"])
def test_image_replaces_what_the_photo_mirrored(tone: str) -> None:
    """The shadow darkens the ground without the hidden light; a quarter of the photo stays."""
    plate = np.full((1, 5, 3), 0.5, np.float32)
    ratio = np.full_like(plate, 0.4)
    image, hidden, kept = np.zeros_like(plate), np.zeros_like(plate), np.zeros_like(plate)
    image[0, 1], hidden[0, 1], hidden[0, 2], image[0, 3] = 0.1, 0.2, 5.0, 9.0
    planes = {"image": image, "hidden": hidden, "shadow_ratio": ratio, "kept": kept}
    kept[0, 4] = 0.2
    planes["matte"] = np.zeros((1, 5), np.float32)
    shown, cut = shown_mirror(planes, plate, Curves.identity(tone), UNCHANGED)
    assert cut == 1
    assert not shown[0, 0].any()
    left = 0.125 if tone == "linear" else 0.25 / 1.25
    np.testing.assert_allclose(shown[0, 2], 0.4 * left - 0.2, rtol=1e-6)
    if tone == "linear":
        expected, beside, bright = 0.4 * 0.3 + 0.1, 0.4 * 0.3 + 0.2, 1.0
    else:
        ground = 0.4 * (0.8 / 1.8)
        radiance = ground / (1.0 - ground) + np.array([0.1, 0.2])
        (expected, beside), bright = radiance / (1.0 + radiance), 9.25 / 10.25
    np.testing.assert_allclose(shown[0, 1], expected - 0.2, rtol=1e-5)
    np.testing.assert_allclose(shown[0, 3], bright - 0.2, rtol=1e-5)
    np.testing.assert_allclose(shown[0, 4], beside - 0.2, rtol=1e-5)


def test_image_on_a_linear_plate_does_not_end_at_white() -> None:
    """Bright ground gains what the image adds, and an image may be brighter than 1."""
    plate = np.array([[[3.0] * 3, [0.5] * 3]], np.float32)
    planes = {name: np.zeros_like(plate) for name in ("hidden", "kept")}
    planes["image"] = np.array([[[0.5] * 3, [9.0] * 3]], np.float32)
    planes["shadow_ratio"] = np.ones_like(plate)
    planes["matte"] = np.zeros((1, 2), np.float32)
    curves = replace(Curves.identity("linear"), is_clipped=False)
    added, _ = shown_mirror(planes, plate, curves, UNCHANGED)
    np.testing.assert_allclose(added, planes["image"], rtol=1e-5)
    response = Response(1.2)
    added, _ = shown_mirror(planes, plate, curves, replace(UNCHANGED, response=response))
    dark = response.knots().invert(0.5)  # the ground's light; above 1 nothing is bent
    np.testing.assert_allclose(added[0, :, 0], [0.5, 9.0 + dark - 0.5], rtol=1e-5)
