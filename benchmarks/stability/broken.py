"""Broken and odd meshes: no area, two in one place, inside out, half a pixel."""

import numpy as np

from benchmarks.stability.case import Measured, finite, lit
from benchmarks.stability.rays import leave, mitsuba_scene, mitsuba_trace
from tests import oracles as o
from tests.builders.shapes import all_pixels, camera, ground, placed, quad, sphere, view_rays
from warpir.render.device_scene import Scene
from warpir.render.shadow.pilot import shaded_pixels
from warpir.scene.asset import Material, Primitive

CARD_VIEW = camera(16, 16, 40.0)
"""A card of half side 1 at z = -5 fills it exactly."""


def card_error(device: str, parts: list[Primitive], *materials: Material) -> Measured:
    """Coverage, position and normal of a card that faces the camera, largest absolute error."""
    renderer, args = lit(device, [placed(parts, *materials)], CARD_VIEW)
    gbuffer = renderer.gbuffer(0, 64)
    assert len(gbuffer.object_pixels) == 256
    errors = [
        np.abs(gbuffer.coverage - 1.0).max(),
        np.abs(gbuffer.normal - [0.0, 0.0, 1.0]).max(),
        np.abs(gbuffer.position[:, 2] + 5.0).max(),
    ]
    out = renderer.foreground(args, gbuffer.object_pixels, 16, 1, 2, 0)
    is_finite = finite(gbuffer.normal, gbuffer.position, out.radiance, out.mask)
    return Measured(float(np.max(errors)), is_finite)


def degenerate_card() -> Primitive:
    """A card among triangles of no area: a corner twice, three corners on a line, three in one."""
    card = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0))
    rng = np.random.default_rng(13)
    p = np.concatenate([rng.uniform(-0.9, 0.9, (300, 2)), np.full((300, 1), -5.0)], axis=1)
    q = np.concatenate([rng.uniform(-0.9, 0.9, (300, 2)), np.full((300, 1), -4.0)], axis=1)
    twice = np.stack([p[:100], q[:100], q[:100]], axis=1)
    line = np.stack([p[100:200], 0.5 * (p[100:200] + q[100:200]), q[100:200]], axis=1)
    point = np.stack([q[200:]] * 3, axis=1)
    corners = np.concatenate([twice, line, point]).reshape(-1, 3)
    flat = np.arange(900, dtype=np.int32).reshape(-1, 3)
    positions = np.concatenate([corners, card.positions])
    return Primitive(positions, np.concatenate([flat, card.indices + 900]), 0)


def degenerate(device: str) -> Measured:
    """Coverage, position and normal of that card."""
    return card_error(device, [degenerate_card()], Material())


def twins(device: str, opposite: bool, double_sided: bool) -> Measured:
    """Two cards in one place, wound alike or against each other."""
    front = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0))
    other = quad((0, 0, -5.0), (-1, 0, 0), (0, 1, 0)) if opposite else front
    first = card_error(device, [front, other], Material(double_sided=double_sided))
    second = card_error(device, [other, front], Material(double_sided=double_sided))
    return Measured(max(first.error, second.error), first.is_finite and second.is_finite)


def blended_twins(device: str) -> Measured:
    """Sunlight through two sheets of opacity 0.25 in one place: they count as one."""
    sheets = [quad((0, 1.0, 0), (5.0, 0, 0), (0, 0, -5.0))] * 2
    pale = placed(sheets, Material(alpha_mode="BLEND", alpha=0.25))
    scene = Scene([pale], camera(1, 1, 1.0), ground(0.0), device)
    rng = np.random.default_rng(14)
    x, z = rng.uniform(-1, 1, (2, 1000))
    points = np.stack([x, -np.ones(1000), z], axis=1)
    up = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    visible = leave(scene, points, up, up)
    return Measured(float(np.abs(visible - 0.75).max()), finite(visible))


def inside_out(device: str, reverse: bool) -> Measured:
    """A double-sided matte ball, also with its triangles wound inside out: RMS of its radiance."""
    round_one = sphere((0.0, 0.0, -5.0), 1.0, 5)
    indices = round_one.indices[:, ::-1].copy() if reverse else round_one.indices
    part = Primitive(round_one.positions, indices, 0, normals=round_one.normals)
    material = Material(metallic=0.0, base_color=(0.8, 0.8, 0.8), double_sided=True)
    view = camera(12, 12, 30.0)
    renderer, args = lit(device, [placed(part, material)], view)
    out = renderer.foreground(args, all_pixels(view), 1024, 1, 2, 0)
    # Closed form at 8 x 8 points of each pixel.
    along = -5.0 * view_rays(view, 8)[..., 2]
    rest = 1.0 - (25.0 - along**2)
    cosine = np.sqrt(np.maximum(rest, 0.0))
    knots = np.linspace(0.2, 1.0, 9)
    values = [o.gltf_albedo(float(c), 0.8, 0.0, 1.0) for c in knots]
    inside = (cosine > 0.25).all(axis=1)
    truth = np.interp(cosine, knots, values).mean(axis=1)
    found = out.radiance[:, 0].astype(np.float64)
    error = found[inside] / truth[inside] - 1.0
    return Measured(float(np.sqrt(np.mean(error**2))), finite(out.radiance))


def one_pixel(device: str) -> Measured:
    """A view of one pixel, half covered by a matte card: coverage and radiance."""
    card = quad((-1.0, 0.0, -5.0), (1, 0, 0), (0, 1, 0))
    view = camera(1, 1, 2.5)
    material = Material(metallic=0.0, base_color=(0.8, 0.8, 0.8))
    renderer, args = lit(device, [placed(card, material)], view)
    gbuffer = renderer.gbuffer(0, 64)
    runs = [renderer.foreground(args, all_pixels(view), 65536, 1, 1, seed) for seed in range(8)]
    shaded = shaded_pixels(renderer, args, 0)
    # Mean albedo over the card's directions, Gauss-Legendre.
    x, weight_x = o.gauss_legendre([-0.4, 0.0], 12)
    y, weight_y = o.gauss_legendre([-0.4, 0.4], 12)
    x, weight_x, y, weight_y = 0.5 * x, 0.5 * weight_x, 0.5 * y, 0.5 * weight_y
    cosine = 1.0 / np.sqrt(1.0 + x[:, None] ** 2 + y[None] ** 2)
    knots = np.linspace(0.8, 1.0, 6)
    albedo = np.interp(cosine, knots, [o.gltf_albedo(float(c), 0.8, 0.0, 1.0) for c in knots])
    truth = float(weight_x @ albedo @ weight_y) / 0.16
    found = float(np.mean([out.radiance[0, 0] for out in runs]))
    coverage = float(np.mean([out.mask[0] for out in runs]))
    error = max(abs(found / truth - 1.0), abs(coverage / 0.5 - 1.0))
    is_finite = finite(*(out.radiance for out in runs), gbuffer.normal, shaded)
    return Measured(error if gbuffer.object_pixels.tolist() == [0] else 1.0, is_finite)


def mitsuba_degenerate() -> float:
    """Error of position and normal on the card among triangles of no area."""
    u = (np.arange(64) + 0.5) / 64.0 * 0.4 - 0.2
    x, y = (a.ravel() for a in np.meshgrid(u, u))
    d = o.normalize(np.stack([x, y, -np.ones_like(x)], axis=-1))
    _, valid, p, n = mitsuba_trace(mitsuba_scene(degenerate_card()), np.zeros_like(d), d)
    error = np.maximum(np.abs(n - [0.0, 0.0, 1.0]).max(axis=1), np.abs(p[:, 2] + 5.0))
    return float(np.where(valid, error, 1.0).max())
