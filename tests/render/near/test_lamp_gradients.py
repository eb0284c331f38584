"""Gradients to lamps near the object, to power and place: closed forms, scenes rendered anew."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.builders.shapes import all_pixels, ground, placed, quad, seen_ground, sphere
from tests.render.near.test_lamps import COLOR, DOWN, LAMBERT, POWER, UP, VIEW, ball_beside_glow
from warpir.core.arrays import Float64Array
from warpir.render.device_scene import Placed, Scene
from warpir.render.integrator import MaterialTensors, Radiance
from warpir.render.launches import THROWN_SHARE
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.near import rows as rows_of_lamps
from warpir.render.near.places import place_slopes
from warpir.render.near.rows import LampRows, lamp_rows
from warpir.render.renderer import Renderer
from warpir.render.transport.integrator import TransportIntegrator
from warpir.render.transport.rows import TransportSettings
from warpir.scene.asset import Material
from warpir.scene.camera import Camera
from warpir.scene.light import Light
from warpir.scene.near.lamps import Lamp, RectangleLamp, SphereLamp, irradiance

PIXELS = all_pixels(VIEW)
ROWS = TransportSettings(height_fg=16, height_shadow=16, dtype="float32")
SKY = torch.from_numpy(np.random.default_rng(4).uniform(0.1, 0.4, (16, 32, 3))).float()
WITHIN = 0.02
"""Asked of a gradient."""


def lamps_of_both_kinds() -> list[Lamp]:
    panel = np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.1, 0.3])
    return [
        SphereLamp(np.array([-0.8, 1.4, 0.7]), 0.15, POWER),
        RectangleLamp(np.array([0.4, 1.9, 0.3]), *panel, POWER[::-1].copy()),
    ]


def renderer(lamps: Sequence[Lamp], device: str) -> Renderer:
    scene = Scene([ball_beside_glow()], VIEW, ground(0.0), device, lamps)
    return Renderer(scene, bounce_depth=2)


def sums(out: Radiance, shadow: Tensor) -> Tensor:
    """Sums by channel of the object's radiance, both halves, the ratio in a shadow, [4, 3]."""
    weights = torch.from_numpy(np.random.default_rng(7).uniform(0.0, 1.0, (len(PIXELS), 1)))
    ratio = shadow * out.lit / out.unoccluded.clamp(min=1e-6)
    parts = (out.foreground, out.lit, out.unoccluded, ratio)
    return torch.stack([(weights.to(x.device) * x).sum(dim=0) for x in parts])


def shadow_of(lamp: Lamp, device: str) -> Tensor:
    """1 where the object takes most of a lamp's light from the ground, shape [pixel, 1]."""
    paths = MisIntegrator(renderer([lamp], device), PIXELS, PIXELS, 64, 1, 1)
    with torch.no_grad():
        out = paths.radiance(*[torch.zeros(16, 32, 3)] * 2, 1)
    return (out.lit < 0.5 * out.unoccluded).all(dim=1, keepdim=True).double()


def jacobian(values: Tensor, at: Tensor) -> Float64Array:
    """Derivatives of the sums, shape [*values.shape, *at.shape]."""
    rows = [torch.autograd.grad(v, at, retain_graph=True)[0] for v in values.reshape(-1)]
    return torch.stack(rows).reshape(*values.shape, *at.shape).double().cpu().numpy()


@pytest.mark.parametrize("kind", ["transport", "mis"])
def test_power_of_a_lamp_has_a_gradient_in_each_channel(
    kind: str, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Object, ground and ratio, against paths in scenes with other powers, of common samples."""
    monkeypatch.setattr(rows_of_lamps, "LAMP_SAMPLES", 512)
    lamp = lamps_of_both_kinds()[kind == "mis"]
    r = renderer([lamp], device)
    if kind == "transport":
        made = TransportIntegrator(r, PIXELS, PIXELS, 3, ROWS, Light(texels=SKY.numpy()))
    else:
        made = MisIntegrator(r, PIXELS, PIXELS, 256, 1, 3)
    shadow = shadow_of(lamp, device)
    assert shadow.sum() > 10
    powers = torch.from_numpy(lamp.power[None]).float().requires_grad_(True)
    found = jacobian(sums(made.radiance(SKY, SKY, 0, lamp_powers=powers), shadow), powers)[:, :, 0]

    def anew(factor: float) -> Float64Array:
        brighter = replace(lamp, power=factor * lamp.power)
        samples = 512 * THROWN_SHARE  # so 512 of what the object throws
        paths = MisIntegrator(renderer([brighter], device), PIXELS, PIXELS, samples, 1, 3)
        with torch.no_grad():
            return sums(paths.radiance(SKY, SKY, 3), shadow).double().cpu().numpy()

    slope = (anew(1.1) - anew(0.9)) / (0.2 * lamp.power)
    np.testing.assert_allclose(np.einsum("qcc->qc", found), slope, rtol=WITHIN)
    assert not (found * (1.0 - np.eye(3))).any(), "a channel depends on its own power alone"


def test_powers_of_lamps_are_those_of_the_scene_by_default(device: str) -> None:
    """And rows do not follow materials."""
    lamps = lamps_of_both_kinds()
    made = TransportIntegrator(renderer(lamps, device), PIXELS, PIXELS, 3, ROWS)
    own = torch.from_numpy(np.stack([k.power for k in lamps])).float()
    again = made.radiance(SKY, SKY, 0, lamp_powers=own)
    # A GPU adds in another order each time.
    rtol = 0.0 if device == "cpu" else 1e-6
    for name, value in vars(made.radiance(SKY, SKY, 0)).items():
        torch.testing.assert_close(value, getattr(again, name), rtol=rtol, atol=0.0)
    mis = MisIntegrator(renderer(lamps, device), PIXELS, PIXELS, 4, 1, 3)
    with pytest.raises(ValueError, match="frozen"):
        mis.radiance(SKY, SKY, 0, MaterialTensors(emission=torch.zeros(2, 3)), own)


def test_cached_rows_hold_no_light_of_lamps(device: str, tmp_path: Path) -> None:
    """The key does not know the lamps; what the object throws of their light is in no file."""
    few = TransportSettings(4, 4, 4, 4, dtype="float32")

    def traced(lamps: Sequence[Lamp]) -> TransportIntegrator:
        return TransportIntegrator(renderer(lamps, device), PIXELS, PIXELS, 2, few, cache=tmp_path)

    first, second = traced(lamps_of_both_kinds()), traced([])
    assert second.is_cached and second.lamps is None
    fresh = TransportIntegrator(renderer([], device), PIXELS, PIXELS, 2, few)
    for name in ("emission", "emission_thrown"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name
        torch.testing.assert_close(getattr(second, name), getattr(fresh, name), rtol=1e-5, atol=0)


# -------------------------------------------------------------------------------- places


EDGE = np.array([[0.0, 1.0, -1.0], [0.0, 1.0, 1.0]])
"""Of a card from x = -2 to 0 at a height of 1 m."""


def slopes(
    thing: Placed, lamp: Lamp, view: Camera, device: str, spp: int, hides: int = 1
) -> list[Float64Array]:
    """Derivatives of object, ground with and without it, shape [axis, pixel, 3]."""
    scene = Scene([thing], view, ground(0.0), device, [lamp])
    pixels = all_pixels(view)
    sees = np.full(len(pixels), hides, np.int32)
    found = place_slopes(Renderer(scene, bounce_depth=0), pixels, pixels, sees, spp, 1, 3)
    return [part.astype(np.float64) for part in found]


def visible(lamp: Lamp, point: Float64Array) -> float:
    """Irradiance by radiance 1 of a lamp beside the card: Lambert's sum over what is in view.

    A sphere is its cone, of 720 edges, which lose 1e-5 of it.
    """
    if isinstance(lamp, SphereLamp):
        toward = lamp.center - point
        away = np.linalg.norm(toward)
        axis = toward / away
        one = np.cross(axis, [0.0, 0.0, 1.0])
        one /= np.linalg.norm(one)
        phi = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)[:, None]
        sine = lamp.radius / away
        across = np.cos(phi) * one + np.sin(phi) * np.cross(axis, one)
        corners = axis * np.sqrt(1.0 - sine**2) + sine * across
    else:
        ex, ey = lamp.edge_x, lamp.edge_y
        corners = lamp.corner - point + np.array([0.0 * ex, ex, ex + ey, ey])
    cut = np.cross(EDGE[1] - point, EDGE[0] - point)
    side = corners @ (cut if cut[0] > 0.0 else -cut)
    kept = []
    for k in range(len(corners)):
        if (side[k - 1] < 0.0) != (side[k] < 0.0):
            share = side[k - 1] / (side[k - 1] - side[k])
            kept.append(corners[k - 1] + share * (corners[k] - corners[k - 1]))
        if side[k] >= 0.0:
            kept.append(corners[k])
    total = 0.0
    for a, b in zip(kept, [*kept[1:], *kept[:1]], strict=True):
        across = np.cross(a, b)
        length = np.linalg.norm(across)
        total += np.arctan2(length, a @ b) * across[1] / max(length, 1e-300)
    return abs(0.5 * total)


@pytest.mark.parametrize("kind", [0, 1])
def test_place_of_a_lamp_above_ground_and_card_is_that_of_closed_forms(
    kind: int, device: str
) -> None:
    """Lambert's card, and the ground without it: central differences of the irradiance."""
    lamp = replace(lamps_of_both_kinds()[kind], center=np.array([0.3, 1.4, 0.1]))
    card = placed(quad((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, -0.5)), LAMBERT)
    shown, _, unoccluded = slopes(card, lamp, DOWN, device, 512, 0)
    middles = seen_ground(DOWN, 8).mean(axis=1)

    def closed(center: Float64Array) -> Float64Array:
        moved = replace(lamp, center=center)
        return np.array([irradiance(moved, p, UP) for p in middles]) / np.pi

    step = 1e-4 * np.eye(3)
    true = [(closed(lamp.center + h) - closed(lamp.center - h)) / 2e-4 for h in step]
    for axis in range(3):
        size = np.abs(true).max()
        for found, albedo in ((shown, COLOR), (unoccluded, 1.0)):
            error = found[axis] - albedo * true[axis]
            assert np.abs(error).max() < 0.05 * size, axis
            assert np.abs(error.mean(axis=0)).max() < 0.005 * size, axis


@pytest.mark.slow
@pytest.mark.parametrize("kind", [0, 1])
def test_place_moves_a_penumbra(kind: int, device: str) -> None:
    """A card's edge hides part of a lamp: the visible part's closed form, in float64."""
    lamp = replace(lamps_of_both_kinds()[kind], center=np.array([0.05, 2.0, 0.1]))
    card = placed(quad((-1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    _, lit, unoccluded = slopes(card, lamp, DOWN, device, 4096, 0)
    row = slice(8 * DOWN.width, 9 * DOWN.width)
    points = seen_ground(DOWN, 8)[row, ::7]
    step = 1e-4 * np.eye(3)

    def closed(center: Float64Array) -> Float64Array:
        moved = replace(lamp, center=center)
        return np.array([np.mean([visible(moved, p) for p in pixel]) for pixel in points])

    moves = [(closed(lamp.center + h) - closed(lamp.center - h)) / 2e-4 for h in step]
    true = np.array(moves)[..., None] * lamp.radiance / np.pi
    own = np.array(lit)[:, row]
    assert np.linalg.norm(own - true) < WITHIN * np.linalg.norm(true)
    assert np.abs((own - true).mean(axis=1)).max() < 0.005 * np.abs(true).max()
    rest = np.linalg.norm(unoccluded[:, row] - true)
    assert rest > 0.5 * np.linalg.norm(true), "the card's shadow counts"


def test_place_has_no_slope_through_solid_glass(device: str) -> None:
    glass = Material(metallic=0.0, roughness=0.0, transmission=1.0, thickness=1.0, ior=1.5)
    thing = placed(sphere((0.0, 0.6, 0.0), 0.5, 2), glass)
    with pytest.raises(ValueError, match="solid glass"):
        slopes(thing, lamps_of_both_kinds()[0], VIEW, device, 4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [0, 1])
def test_place_moves_object_shadow_and_bounce(
    kind: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A glossy ball, a box and what they throw, against paths with the lamp 4 cm to either side."""
    monkeypatch.setattr(rows_of_lamps, "LAMP_SAMPLES", 4096)
    lamp, host = lamps_of_both_kinds()[kind], torch.device("cpu")
    afar = MisIntegrator(renderer([], device), PIXELS, PIXELS, 512, 1, 3)
    with torch.no_grad():
        rest = afar.radiance(SKY, SKY, 5)

    def rows(center: Float64Array, seed: int, has_slopes: bool = False) -> LampRows:
        beside = renderer([replace(lamp, center=center)], device)
        return lamp_rows(beside, PIXELS, PIXELS, 3, seed, host, has_slopes)

    moved = torch.zeros(1, 3, requires_grad=True)
    here = rows(lamp.center, 0, has_slopes=True).added(rest, None, moved)
    # From left above to right below: moments do not cancel as the shadow's sum does.
    x, y = (torch.linspace(-1.0, 1.0, n).double() for n in (VIEW.width, VIEW.height))
    ramp = (y[:, None] + x).reshape(-1, 1) * (here.unoccluded[:, :1] > 1e-3)
    found = jacobian(sums(here, ramp), moved)[:, :, 0]

    def anew(center: Float64Array) -> Float64Array:
        runs = [sums(rows(center, seed).added(rest), ramp) for seed in range(1, 4)]
        return torch.stack(runs).mean(dim=0).double().numpy()

    step = 0.04 * np.eye(3)
    slope = np.stack([anew(lamp.center + h) - anew(lamp.center - h) for h in step], -1) / 0.08
    for name, own, true in zip(("object", "lit", "open", "ratio"), found, slope, strict=True):
        error = np.linalg.norm(own - true) / np.linalg.norm(true)
        assert error < WITHIN, (name, error)
