"""Object and ground by lamps near the object: furnace, fall-off, soft shadows, contact, bounce."""

import numpy as np
import pytest
import torch

from tests.builders.shapes import (
    all_pixels,
    box,
    camera,
    constant,
    ground,
    lobe,
    placed,
    quad,
    seen_ground,
    sphere,
)
from tests.kernels.test_lamps import surface
from warpir.core.arrays import Float64Array
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.picture.quality import Quality
from warpir.render.renderer import Foreground, ReceiverRadiance, Renderer
from warpir.render.shadow.picture import picture_ratio
from warpir.render.transport.integrator import TransportIntegrator
from warpir.render.transport.rows import TransportSettings
from warpir.scene.asset import Material
from warpir.scene.camera import Camera
from warpir.scene.light import Light
from warpir.scene.near.lamps import Lamp, RectangleLamp, SphereLamp, irradiance
from warpir.scene.receiver import mesh_of

DARK = constant((0.0, 0.0, 0.0))
LAMBERT = Material(base_color=(0.6, 0.5, 0.25), metallic=0.0, specular=0.0, roughness=1.0)
COLOR = np.array([0.6, 0.5, 0.25])
UP = np.array([0.0, 1.0, 0.0])
POWER = np.array([40.0, 30.0, 20.0])
DOWN = camera(24, 16, 800.0, (0.0, 20.0, 0.0), pitch=-90.0)
"""Sees 0.6 x 0.4 m of the ground, nearly along its normal; a pixel is 2.5 cm wide."""
VIEW = camera(24, 16, 24.0, (0.0, 1.5, 4.0), pitch=-15.0)
RUN_COUNT = 16
STANDARD_ERRORS = 5.0
"""Of a pixel that must match; with 16 runs and some 400 pixels."""


def renderer(
    thing: Placed,
    lamps: list[Lamp],
    view: Camera,
    device: str,
    receiver: Receiver | None = None,
    bounce_depth: int = 0,
) -> Renderer:
    scene = Scene([thing], view, receiver or ground(0.0), device, lamps)
    return Renderer(scene, bounce_depth=bounce_depth)


def foreground(
    r: Renderer, light: Light = DARK, depth: int = 1, spp: int = 64, seed: int = 1
) -> Foreground:
    args, pixels = light_args(light, r.device), all_pixels(r.scene.camera)
    return r.foreground(args, pixels, spp, 1, depth, seed)


def receiver(
    r: Renderer, light: Light = DARK, spp: int = 64, seed: int = 1, hides: int = 1
) -> ReceiverRadiance:
    """Trace all pixels; with ``hides`` 0 the camera sees the ground through the object."""
    args, pixels = light_args(light, r.device), all_pixels(r.scene.camera)
    return r.receiver(args, pixels, np.full(len(pixels), hides, np.int32), spp, 1, seed)


MATERIALS = {
    "lambert": LAMBERT,
    "gloss": Material(base_color=(0.6, 0.5, 0.25), metallic=0.0, roughness=0.3),
    "metal": Material(base_color=(0.9, 0.8, 0.6), metallic=1.0, roughness=0.05),
    "layers": Material(base_color=(0.6, 0.5, 0.25), metallic=0.0, roughness=0.5, clearcoat=1.0),
}


@pytest.mark.parametrize("material", list(MATERIALS))
def test_lamps_around_everything_are_an_even_sky(material: str, device: str) -> None:
    """From within a sphere of radiance 1 it is seen in all directions: a furnace of 3 bounces."""
    parts = [sphere((0.0, 0.0, -4.0), 1.0, 3), quad((0.0, -1.2, -4.0), (2.0, 0, 0), (0, 0, -2.0))]
    thing, view = placed(parts, MATERIALS[material]), camera(16, 12, 20.0)
    around = SphereLamp(np.array([3.0, -1.0, 2.0]), 40.0, np.full(3, 4.0 * np.pi**2 * 40.0**2))
    lamp_lit = renderer(thing, [around], view, device, ground())
    sky_lit = renderer(thing, [], view, device, ground())
    runs = [
        (foreground(lamp_lit, depth=3, seed=s), foreground(sky_lit, constant(), 3, seed=s + 99))
        for s in range(RUN_COUNT)
    ]
    for part in ("radiance", "diffuse"):
        difference = np.stack([getattr(a, part) - getattr(b, part) for a, b in runs])
        assert getattr(runs[0][0], part).max() > 0.2 or material == "metal"
        assert_zero(difference.astype(np.float64))


def assert_zero(difference: Float64Array) -> None:
    """Runs of a difference have mean 0 in each pixel, and over all of them."""
    for part in (difference, difference.sum(axis=1)):
        error = part.std(axis=0, ddof=1) / np.sqrt(len(part)) + 2e-4 * np.sqrt(
            difference.shape[1] if part.ndim < 3 else 1
        )
        z = part.mean(axis=0) / error
        assert (np.abs(z) < STANDARD_ERRORS).all(), np.abs(z).max()


def lamps_of_all_kinds(center: tuple[float, float, float]) -> list[Lamp]:
    c = np.array(center)
    flat = RectangleLamp(c, np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.1, 0.3]), POWER)
    return [SphereLamp(c, 0.15, POWER), flat]


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize("height", [0.7, 1.4, 2.8, 5.6])
def test_lamps_fall_off_on_object_and_ground(kind: int, height: float, device: str) -> None:
    """A Lambert card and the white ground show albedo / pi times the closed irradiance."""
    lamp = lamps_of_all_kinds((0.3, height, 0.1))[kind]
    card = quad((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, -0.5))
    on_card = foreground(renderer(placed(card, LAMBERT), [lamp], DOWN, device, ground()), spp=256)
    below = placed(quad((50.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    on_ground = receiver(renderer(below, [lamp], DOWN, device), spp=256)
    expected = np.array([irradiance(lamp, p, UP) for p in seen_ground(DOWN)[:, 0]]) / np.pi
    np.testing.assert_allclose(on_card.radiance, COLOR * expected, rtol=0.02)
    np.testing.assert_allclose(on_ground.lit, expected, rtol=0.02)
    assert (on_ground.lit == on_ground.unoccluded).all()
    for found, true in ((on_card.radiance, COLOR * expected), (on_ground.lit, expected)):
        assert found.mean() == pytest.approx(true.mean(), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [0, 1])
def test_lamps_penumbra_is_the_part_of_the_lamp_in_view(kind: int, device: str) -> None:
    """A card's edge hides part of a lamp: surface points of the lamp, one by one, in float64."""
    lamp = lamps_of_all_kinds((0.0, 2.0, 0.0))[kind]
    card = quad((-1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))  # x from -2 to 0
    found = receiver(renderer(placed(card), [lamp], DOWN, device), spp=1024, hides=0)
    expected, whole = [], []
    q, m, _ = surface(lamp, 400)
    for p in seen_ground(DOWN)[:, 0]:
        w = q - p
        d = np.linalg.norm(w, axis=1)
        part = np.maximum(w[:, 1], 0.0) * np.maximum(-(w * m).sum(axis=1), 0.0) / d**4
        crossing = p[0] + w[:, 0] / w[:, 1]  # at the card's height
        expected.append((part * (crossing > 0.0)).sum())
        whole.append(part.sum())
    ratio = (found.lit / found.unoccluded)[:, 0]
    true = np.array(expected) / np.array(whole)
    assert true.min() == 0.0 and true.max() == 1.0
    assert ((true > 0.2) & (true < 0.8)).sum() > 40
    np.testing.assert_allclose(ratio, true, atol=0.02)
    assert abs((ratio - true).mean()) < 1e-3
    # A pixel's border sees a little more or less than its middle.
    assert (ratio[true == 1.0] > 0.995).all() and (ratio[true == 0.0] < 5e-3).all()


def test_lamps_in_a_closed_object_leave_the_ground_what_comes_from_afar(device: str) -> None:
    """Without the object the lamp would light the ground; with it around, none of it comes out."""
    lamp = SphereLamp(np.array([0.0, 0.5, 0.0]), 0.1, POWER)
    thing = placed(box((0.0, 0.5, 0.0), (0.6, 0.6, 0.6)))
    r = renderer(thing, [lamp], VIEW, device)
    only = receiver(r)
    seen = only.unoccluded.max(axis=1) > 0.0
    assert seen.any() and only.lit.max() == 0.0
    assert foreground(r, depth=3).radiance.max() == 0.0
    with_sky, sky = (receiver(x, constant()) for x in (r, renderer(thing, [], VIEW, device)))
    np.testing.assert_array_equal(with_sky.lit, sky.lit)
    np.testing.assert_array_equal(with_sky.unoccluded, sky.unoccluded + only.unoccluded)


def test_lamps_on_the_ground_light_it_and_shine_no_way_through(device: str) -> None:
    """Half a sphere above the plane: its cut closed form; a card below it stays dark."""
    lamp = SphereLamp(np.array([0.05, 0.0, 0.02]), 0.1, POWER)
    far = placed(quad((50.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    found = receiver(renderer(far, [lamp], DOWN, device), spp=1024)
    points = seen_ground(DOWN)[:, 0]
    expected = np.array([irradiance(lamp, p, UP) for p in points]) / np.pi
    away = np.linalg.norm(points - lamp.center, axis=1)
    clear = np.abs(away - lamp.radius) > 0.03  # no pixel across the lamp's edge
    np.testing.assert_allclose(found.lit[clear], expected[clear], rtol=0.1)
    error = (found.lit[clear] - expected[clear]).sum() / expected[clear].sum()
    assert abs(error) < 3e-3
    card = quad((0.0, -0.5, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, -0.5))
    sunk = renderer(placed(card, LAMBERT), [lamp], DOWN, device, Receiver(UP, 0.0, None, None))
    assert foreground(sunk).radiance.max() == 0.0
    buried = SphereLamp(np.array([0.0, -0.3, 0.0]), 0.1, POWER)
    assert receiver(renderer(far, [buried], DOWN, device)).unoccluded.max() == 0.0
    upright = placed(quad((0.0, 0.5, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0)), LAMBERT)
    before = SphereLamp(np.array([0.0, -0.3, 0.5]), 0.1, POWER)
    assert foreground(renderer(upright, [before], VIEW, device)).radiance.max() == 0.0


@pytest.mark.slow
def test_lamps_beside_light_at_infinity_add_up(device: str) -> None:
    """Radiance and both halves are sums over the lights; sun, sky, two lamps, three bounces."""
    parts = [sphere((0.0, 0.6, 0.0), 0.5, 3), quad((0.9, 0.5, 0.0), (0, 0, -0.5), (0.0, 0.5, 0.0))]
    gloss = Material(base_color=(0.7, 0.7, 0.7), metallic=0.5, roughness=0.3)
    sky = Light(
        lobe((0.5, 0.6, 0.4), 80.0, (9.0, 8.0, 7.0)).lobes, constant((0.4, 0.5, 0.8)).texels
    )
    ball, flat = lamps_of_all_kinds((-0.7, 1.3, 0.6))
    near = [([ball], DARK), ([flat], DARK), ([], sky)]

    def runs(lamps: list[Lamp], light: Light, first: int) -> tuple[Float64Array, Float64Array]:
        r = renderer(placed(parts, gloss), lamps, VIEW, device, bounce_depth=2)
        on_object = [foreground(r, light, 3, seed=first + s).radiance for s in range(RUN_COUNT)]
        on_ground = [receiver(r, light, seed=first + s).lit for s in range(RUN_COUNT)]
        return np.stack(on_object).astype(np.float64), np.stack(on_ground).astype(np.float64)

    whole = runs([ball, flat], sky, 0)
    alone = [runs(lamps, light, 100 * (k + 1)) for k, (lamps, light) in enumerate(near)]
    for k in range(2):
        assert_zero(whole[k] - sum(one[k] for one in alone))


def test_lamps_are_shaded_by_the_receivers_mesh_and_by_glass(device: str) -> None:
    """A wall of --proxy stands between lamp and ground; a pane of alpha .25 lets .75 through."""
    lamp = SphereLamp(np.array([0.0, 1.0, 0.0]), 0.05, POWER)
    wall = placed(quad((0.0, 0.5, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, -3.0)), LAMBERT).asset
    thing = placed(quad((0.0, 0.3, 0.0), (0.1, 0.0, 0.0), (0.0, 0.0, -0.1)))
    under = Receiver(UP, 0.0, mesh_of(wall))
    low = camera(24, 16, 24.0, (0.0, 0.4, 4.0), pitch=-15.0)
    hidden = receiver(renderer(thing, [lamp], low, device, under))
    inside = receiver(renderer(thing, [lamp], low, device))
    near = np.abs(seen_ground(low)[:, 0]).max(axis=1) < 1.0
    assert near.any() and hidden.unoccluded[near].max() == 0.0 < inside.unoccluded[near].min()
    pane = Material(base_color=(1.0, 1.0, 1.0), alpha=0.25, alpha_mode="BLEND")
    wide = placed(quad((0.0, 0.5, 0.0), (9.0, 0.0, 0.0), (0.0, 0.0, -9.0)), pane)
    under_pane = SphereLamp(np.array([0.0, 0.3, 0.0]), 0.05, POWER)
    free, dimmed = (
        receiver(renderer(wide, [each], DOWN, device), spp=256, hides=0)
        for each in (under_pane, lamp)
    )
    seen = free.unoccluded[:, 0] > 0.0
    np.testing.assert_allclose(free.lit[seen], free.unoccluded[seen], rtol=1e-6)
    np.testing.assert_allclose(dimmed.lit[seen], 0.75 * dimmed.unoccluded[seen], rtol=1e-5)


def test_lamps_shade_a_picture_by_the_pixel(device: str) -> None:
    """Ratio of the sums of both kinds of light, and 1 where neither is hidden."""
    lamp = SphereLamp(np.array([0.8, 1.5, 0.3]), 0.1, POWER)
    view = camera(96, 64, 96.0, (0.0, 1.5, 4.0), pitch=-15.0)
    thing = placed(sphere((0.0, 0.6, 0.0), 0.4, 3))
    r = renderer(thing, [lamp], view, device)
    args, count = light_args(constant((0.3, 0.3, 0.3)), r.device), len(all_pixels(view))
    sees, quality = np.ones(count, np.int32), Quality(64, 1, 1, 5)
    pixels, ratio = picture_ratio(r, args, sees, np.ones(count, np.bool_), quality)
    both = receiver(r, constant((0.3, 0.3, 0.3)), seed=9)
    exact = r.ratio(both)
    assert ratio.min() < 0.3
    assert np.abs(ratio - exact[pixels]).mean() < 0.02
    rest = np.setdiff1d(np.arange(count), pixels)
    assert (1.0 - exact[rest]).max() < 0.02 and (1.0 - exact[rest]).mean() < 1e-3


def ball_beside_glow() -> Placed:
    """A glossy ball beside a box that glows; they throw light on the ground."""
    parts = [sphere((0.0, 0.6, 0.0), 0.5, 3), box((0.9, 0.3, 0.0), (0.4, 0.6, 0.4), 1)]
    gloss = Material(base_color=(0.7, 0.7, 0.7), metallic=0.2, roughness=0.6)
    glow = Material(base_color=(0.5, 0.5, 0.5), emission=(0.3, 0.2, 0.1))
    return placed(parts, gloss, glow)


def both_integrators(
    device: str, spp: int, receiver: Receiver | None = None
) -> tuple[TransportIntegrator, MisIntegrator, torch.Tensor]:
    """Stored rows and paths of one scene: `ball_beside_glow`, two lamps, a sky."""
    lamps = lamps_of_all_kinds((-0.7, 1.3, 0.6))
    r = renderer(ball_beside_glow(), lamps, VIEW, device, receiver, bounce_depth=2)
    pixels = all_pixels(VIEW)
    sky = np.random.default_rng(4).uniform(0.2, 1.0, (16, 32, 3)).astype(np.float32)
    settings = TransportSettings(height_fg=16, height_shadow=16, dtype="float32")
    light = Light(texels=sky)
    transport = TransportIntegrator(r, pixels, pixels, 3, settings, light)
    return transport, MisIntegrator(r, pixels, pixels, spp, 1, 3), torch.from_numpy(sky)


@pytest.mark.slow
@pytest.mark.parametrize("has_mesh", [False, True])
def test_lamps_in_stored_transport_are_those_of_mis(has_mesh: bool, device: str) -> None:
    """Object, ground with and without it, glow and bounce; lamps are half of the light."""
    floor = placed(quad((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 0.0, -9.0))).asset
    under = Receiver(UP, 0.0, mesh_of(floor), None, is_plane=False) if has_mesh else None
    transport, mis, sky = both_integrators(device, 1024, under)
    mine, theirs = transport.radiance(sky, sky, 0), mis.radiance(sky, sky, 5)
    dark = mis.radiance(torch.zeros_like(sky), torch.zeros_like(sky), 6)
    for name in ("foreground", "lit", "unoccluded"):
        a, b, lamp = (getattr(out, name).double().cpu() for out in (mine, theirs, dark))
        # Stored rows know the plane also where no sample of the pixel sees it.
        a, b = (x * (b > 0.0) for x in (a, b))
        assert lamp.sum() > 0.2 * b.sum(), name
        assert float((a.sum() - b.sum()).abs() / b.sum()) < 0.01, name
        assert float((a - b).norm() / b.norm()) < 0.05, name


def test_lamps_leave_the_gradient_of_stored_transport_true(device: str) -> None:
    """Of a ratio's square, by central differences: the lamps stand in both of its halves."""
    transport, _, sky = both_integrators(device, 1)

    def loss(texels: torch.Tensor) -> torch.Tensor:
        out = transport.radiance(texels, texels, 0)
        ratio = out.lit / out.unoccluded.clamp(min=1e-3)
        return (ratio.double() ** 2).sum() + (out.foreground.double() ** 2).sum()

    texels = sky.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(loss(texels), texels)
    direction = torch.from_numpy(np.random.default_rng(6).normal(size=sky.shape)).float()
    step = 2e-3
    change = loss(sky + step * direction) - loss(sky - step * direction)
    slope = float((gradient.double() * direction.double()).sum())
    assert float(change) / (2.0 * step) == pytest.approx(slope, rel=5e-3)
