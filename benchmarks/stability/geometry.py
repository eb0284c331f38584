"""Hard cases of geometry: scenes of 1 mm and 10 km, 100 km away, contact, broken meshes, needles.

Errors of positions are shares of the scene's diagonal. A ray that meets another triangle than in
float64, or none, counts as an error of 1.
"""

from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from benchmarks.stability.case import (
    MAX_ABSOLUTE,
    RELATIVE,
    SHARE,
    Case,
    Float64Array,
    Measured,
    download,
    finite,
    upload,
)
from tests import oracles as o
from tests.builders.shapes import all_pixels, box, camera, constant, ground, placed, quad, sphere
from warpir.kernels.trace import closest_hit, face_normal, hit_position, offset_origin, visibility
from warpir.kernels.types import MaterialArgs, MeshArgs, TextureArgs
from warpir.render.device_light import light_args
from warpir.render.device_scene import Receiver, Scene
from warpir.render.renderer import Renderer
from warpir.scene.asset import Material, Primitive
from warpir.scene.camera import Camera
from warpir.scene.light import Light

wp.set_module_options({"enable_backward": False})

GROUP = "geometry"
PLACES = (
    ("1 mm wide", 1e-3, 0.0),
    ("1 m wide", 1.0, 0.0),
    ("10 km wide", 1e4, 0.0),
    ("1 m wide, 100 km away", 1.0, 1e5),
    ("1 mm wide, 100 km away", 1e-3, 1e5),
)
"""Name, size [m], distance from the origin [m]."""
AWAY = np.array([0.6, 0.48, -0.64])
"""Where "away" is."""

POSITION = 1e-6
"""Eight roundings of coordinates within half the diagonal, over slopes of 0.2 and more."""
SELF_HITS = 0.0
"""A convex body: no ray that leaves it meets it again."""
LEAKS = 0.0
"""A closed body, or one that stands in the plane: no ray gets out of it or below it."""
SHADOW = 4e-3
"""RMS noise of 4096 low-discrepancy samples per pixel, half of the binomial one."""
NORMAL_ROUNDINGS = 4.0
"""Roundings of 2^-24 of a vertex, at most half the diagonal away, over the needle's width."""
FLAT = 1e-6
"""A few roundings."""
COVERAGE = 0.0
"""A card that fills the view covers it in every sample."""
FACETS = 1e-2
"""A sphere of 20 480 flat facets at 4096 samples a pixel against its curved truth, RMS."""
ALBEDO = 2e-3
"""Noise of 64 x 1024 low-discrepancy samples."""
SAGITTA = 4e-6
"""Facets of 2 pi / 1000 lie ``(pi / 1000)^2 / 2 = 5e-6`` of the radius deep at most, share of the
diagonal 1.5e-6, and eight roundings more."""
SHADOW_SPP = 4096


@wp.kernel
def hit_kernel(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    face: wp.array[int],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
):
    """First hit of each ray; ``face`` is -1 without one."""
    i = wp.tid()
    hit = closest_hit(mesh, material, texture, origin[i], direction[i], 1.0e30, 0, wp.uint32(0))
    face[i] = -1
    if hit.valid == 1:
        face[i] = hit.face
        position[i] = hit_position(mesh, hit)
        normal[i] = face_normal(mesh, hit.face)


@wp.kernel
def leave_kernel(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    visible: wp.array[float],
):
    """Share of light that reaches a surface point along each direction."""
    i = wp.tid()
    origin = offset_origin(position[i], normal[i], direction[i], mesh.epsilon)
    visible[i] = visibility(mesh, material, texture, origin, direction[i])


def scene_of(part: Primitive, device: str, material: Material | None = None) -> Scene:
    """A scene of one primitive; the view does not matter."""
    return Scene([placed(part, material or Material())], camera(1, 1, 1.0), ground(), device)


def trace(
    scene: Scene, origin: NDArray[np.floating[Any]], direction: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int32], Float64Array, Float64Array]:
    """Return face, position (recentred frame) and geometric normal of each ray's first hit."""
    count, device = len(origin), str(scene.device)
    face = wp.zeros(count, dtype=int, device=device)
    position, normal = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
    wp.launch(
        hit_kernel,
        count,
        inputs=[
            scene.mesh_args,
            scene.material_args,
            scene.texture_args,
            upload(origin, wp.vec3, device),
            upload(direction, wp.vec3, device),
        ],
        outputs=[face, position, normal],
        device=device,
    )
    return face.numpy(), download(position), download(normal)


def leave(
    scene: Scene, position: Float64Array, normal: Float64Array, direction: Float64Array
) -> Float64Array:
    """Return what reaches surface points along directions."""
    count, device = len(position), str(scene.device)
    visible = wp.zeros(count, dtype=float, device=device)
    wp.launch(
        leave_kernel,
        count,
        inputs=[
            scene.mesh_args,
            scene.material_args,
            scene.texture_args,
            *(upload(a, wp.vec3, device) for a in (position, normal, direction)),
        ],
        outputs=[visible],
        device=device,
    )
    return download(visible)


# ------------------------------------------------------------------- hits against float64


def soup(size: float, away: float) -> Primitive:
    """200 random triangles in a cube of ``size``, ``away`` from the origin."""
    rng = np.random.default_rng(8)
    middle = rng.uniform(-0.35, 0.35, (200, 1, 3))
    corners = (middle + rng.uniform(-0.15, 0.15, (200, 3, 3))).reshape(-1, 3)
    positions = corners * size + AWAY * away
    return Primitive(positions, np.arange(600, dtype=np.int32).reshape(-1, 3), 0)


def rays(count: int = 4000) -> tuple[Float64Array, Float64Array]:
    """Return rays toward a unit cube about the origin from a sphere of radius 1.5."""
    rng = np.random.default_rng(9)
    origin = 1.5 * o.normalize(rng.normal(size=(count, 3)))
    return origin, o.normalize(rng.uniform(-0.4, 0.4, (count, 3)) - origin)


def moller_trumbore(
    corners: Float64Array, origin: Float64Array, direction: Float64Array
) -> tuple[NDArray[np.int64], Float64Array, NDArray[np.bool_]]:
    """Return face (-1: none) and point of each first hit in float64, and which rays are clear.

    A ray is clear when its verdict survives a change of a thousandth: it stays off all edges and
    off grazing triangles, and its second hit is not next to the first.
    """
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d = direction[:, None]
    p = np.cross(d, e2[None])
    det = np.sum(p * e1[None], axis=-1)
    s = origin[:, None] - a[None]
    q = np.cross(s, e1[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.sum(s * p, axis=-1) / det
        v = np.sum(d * q, axis=-1) / det
        t = np.sum(e2[None] * q, axis=-1) / det
    inner = np.minimum(np.minimum(u, v), 1.0 - u - v)
    n = np.cross(e1, e2)
    slope = np.abs(direction @ (n / np.linalg.norm(n, axis=1, keepdims=True)).T)
    inside = (inner > 0.0) & (t > 0.0)
    t_in = np.where(inside, t, np.inf)
    order = np.sort(t_in, axis=1)
    face = np.argmin(t_in, axis=1)
    first = order[:, 0]
    shaky = (np.abs(inner) < 1e-3) | (inside & (slope < 0.2))
    before = np.where(t > 0.0, t, np.inf) <= first[:, None] * (1.0 + 1e-9)
    clear = ~np.any(shaky & before, axis=1)
    with np.errstate(invalid="ignore"):
        clear &= ~((order[:, 1] - first) < 1e-3 * first)
    hit = np.isfinite(first)
    point = origin + direction * np.where(hit, first, 0.0)[:, None]
    return np.where(hit, face, -1), point, clear


def hit_error(
    face: NDArray[Any], point: Float64Array, truth: tuple[Any, Any, Any], diagonal: float
) -> float:
    """Return the largest distance of a hit from its truth over the diagonal; 1 for a wrong one."""
    face_64, point_64, clear = truth
    wrong = face != face_64
    distance = np.where(face_64 >= 0, np.linalg.norm(point - point_64, axis=1) / diagonal, 0.0)
    return float(np.where(wrong, 1.0, distance)[clear].max())


def hits(device: str, size: float, away: float) -> Measured:
    """First hits of 4000 rays in a soup of triangles against Moeller-Trumbore in float64."""
    part = soup(size, away)
    scene = scene_of(part, device)
    origin, direction = rays()
    local = (origin * size + AWAY * away - scene.origin).astype(np.float32)
    d = direction.astype(np.float32)
    face, position, normal = trace(scene, local, d)
    corners = (part.positions - scene.origin).reshape(-1, 3, 3)
    truth = moller_trumbore(corners, local.astype(np.float64), d.astype(np.float64))
    return Measured(hit_error(face, position, truth, scene.diagonal), finite(position, normal))


# --------------------------------------------------------------------- rays that leave


def leaving(count: int = 20000) -> tuple[Float64Array, Float64Array]:
    """Return directions from the surface of a unit ball and, as local frames do, toward it."""
    rng = np.random.default_rng(10)
    cos = np.concatenate([rng.uniform(1e-3, 1.0, count // 2), np.geomspace(1e-3, 1, count // 2)])
    local = o.spherical(cos, rng.uniform(0.0, 2.0 * np.pi, count))
    return o.normalize(rng.normal(size=(count, 3))), local


def frames(n: Float64Array) -> Float64Array:
    """Return rotations with ``n`` as third column, shape [..., 3, 3]."""
    helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = o.normalize(np.cross(helper, n))
    return np.stack([x, np.cross(n, x), n], axis=-1)


def ball(size: float, away: float) -> Primitive:
    """A flat-shaded ball of 5120 facets."""
    round_one = sphere(AWAY * away, 0.5 * size, 4)
    return Primitive(round_one.positions, round_one.indices, 0)


def self_hits(device: str, size: float, away: float) -> Measured:
    """Share of rays that leave a ball, half of them nearly along its surface, and meet it again."""
    scene = scene_of(ball(size, away), device)
    toward, local = leaving()
    face, position, normal = trace(scene, toward * size, -toward)
    assert face.min() >= 0
    outward = np.einsum("ijk,ik->ij", frames(o.normalize(normal)), local)
    visible = leave(scene, position, normal, outward)
    return Measured(float(np.mean(visible < 1.0)), finite(visible, position, normal))


def dome(size: float, inside_out: bool) -> Primitive:
    """An open upper half ball of radius ``size`` whose rim lies a little below the plane."""
    theta = np.linspace(0.0, 0.5 * np.pi + 0.02, 33)[1:]
    phi = 2.0 * np.pi * np.arange(96) / 96
    rings = np.stack(
        np.broadcast_arrays(
            np.sin(theta)[:, None] * np.cos(phi),
            np.cos(theta)[:, None],
            np.sin(theta)[:, None] * np.sin(phi),
        ),
        axis=-1,
    ).reshape(-1, 3)
    positions = np.concatenate([[[0.0, 1.0, 0.0]], rings])
    faces = [[0, 1 + (k + 1) % 96, 1 + k] for k in range(96)]
    for row in range(31):
        a = 1 + 96 * row
        for k in range(96):
            j = (k + 1) % 96
            faces += [[a + k, a + j, a + 96 + k], [a + j, a + 96 + j, a + 96 + k]]
    indices = np.array(faces, np.int32)
    if inside_out:
        indices = indices[:, ::-1].copy()
    return Primitive(positions * size, indices, 0)


def dome_rays() -> tuple[Float64Array, Float64Array]:
    """Return points of the plane within a unit dome and directions above it."""
    rng = np.random.default_rng(12)
    radius, turn = np.sqrt(rng.uniform(0.0, 0.9, 100_000)), rng.uniform(0.0, 6.28, 100_000)
    points = np.stack([radius * np.cos(turn), 0.0 * turn, radius * np.sin(turn)], axis=-1)
    up = o.spherical(np.sqrt(rng.uniform(0.0, 1.0, 100_000)), rng.uniform(0.0, 6.28, 100_000))
    return points, up[:, [1, 2, 0]]


def dome_leaks(device: str, inside_out: bool, size: float) -> Measured:
    """Share of rays from the plane that get out of an open dome standing on it."""
    scene = scene_of(dome(size, inside_out), device)
    points, d = dome_rays()
    up = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    visible = leave(scene, points * size - scene.origin, up, d)
    return Measured(float(np.mean(visible > 0.0)), finite(visible))


# --------------------------------------------------------------------------- shadows


def from_above(width: int, height: int, metres: float, size: float, away: float) -> Camera:
    """A camera 50 sizes above the scene; ``metres`` a pixel at size 1."""
    eye = AWAY * away + np.array([0.0, 50.0 * size, 0.0])
    return camera(width, height, 50.0 / metres, eye, -90.0)


def foot(view: Camera, side: int) -> Float64Array:
    """The plane's x and z at ``side x side`` points of each pixel, size 1, [pixel, side^2, 2]."""
    metres = 50.0 / view.fx
    u = ((np.arange(view.width * side) + 0.5) / side - view.cx) * metres
    v = ((np.arange(view.height * side) + 0.5) / side - view.cy) * metres
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    blocks = grid.reshape(view.height, side, view.width, side, 2).swapaxes(1, 2)
    return blocks.reshape(-1, side * side, 2)


def ratio_of(part: Primitive, view: Camera, height: float, device: str, light: Light) -> Any:
    """Shadow ratio of the plane in every pixel, whatever stands before it."""
    plane = Receiver(np.array([0.0, 1.0, 0.0]), height)
    renderer = Renderer(Scene([placed(part)], view, plane, device))
    pixels = all_pixels(view)
    args = light_args(light, renderer.device)
    radiance = renderer.receiver(args, pixels, np.zeros(len(pixels), np.int32), SHADOW_SPP, 1, 0)
    return renderer.ratio(radiance)[:, 0].astype(np.float64), radiance


def roof(size: float, away: float) -> Primitive:
    """A square of 3 sizes, one size above the plane."""
    return quad(
        AWAY * away + np.array([0.0, size, 0.0]),
        (1.5 * size, 0.0, 0.0),
        (0.0, 0.0, -1.5 * size),
    )


def square_shadow(device: str, size: float, away: float) -> Measured:
    """Shadow ratio below and beside a square in a constant sky, RMS against its form factor."""
    view = from_above(8, 5, 0.6, size, away)
    height = float((AWAY * away)[1])
    ratio, radiance = ratio_of(roof(size, away), view, height, device, constant())
    points = foot(view, 8)
    truth = o.rectangle_ratio(points[..., 0], points[..., 1], 1.0, 1.5).mean(axis=1)
    return Measured(
        float(np.sqrt(np.mean((ratio - truth) ** 2))),
        finite(ratio, radiance.lit, radiance.unoccluded),
    )


def wall_factor(c: Float64Array, low: Float64Array, high: Float64Array, h: float) -> Float64Array:
    """Configuration factor of a plane's point to a wall at distance ``c`` that stands on it.

    The wall is ``h`` high and reaches from ``low`` to ``high`` along itself (Howell, B-4).
    """

    def corner(b: Float64Array) -> Float64Array:
        far = np.hypot(c, h)
        return (np.arctan(b / c) - c / far * np.arctan(b / far)) / (2.0 * np.pi)

    return np.asarray(corner(high) - corner(low))


def box_ratio(points: Float64Array, gap: float) -> Float64Array:
    """Shadow ratio of a unit box whose bottom is ``gap`` above the plane, or below it."""
    x, z = np.abs(points[..., 0]), np.abs(points[..., 1])
    blocked = np.zeros(x.shape)
    for along, across in ((x, z), (z, x)):
        c = along - 0.5
        beside = c > 0.0
        c = np.where(beside, c, 1.0)
        wall = wall_factor(c, -0.5 - across, 0.5 - across, 1.0 + gap)
        if gap > 0.0:
            wall -= wall_factor(c, -0.5 - across, 0.5 - across, gap)
        blocked += np.where(beside, wall, 0.0)
    if gap > 0.0:
        return np.asarray(o.rectangle_ratio(points[..., 0], points[..., 1], gap, 0.5) - blocked)
    return np.where((x < 0.5) & (z < 0.5), 0.0, 1.0 - blocked)


def contact(device: str, gap: float, size: float) -> Measured:
    """Shadow ratio round a unit box on, just above or sunk into the plane, RMS."""
    part = box((0.0, (0.5 + gap) * size, 0.0), (size, size, size))
    view = from_above(12, 12, 0.2, size, 0.0)
    ratio, radiance = ratio_of(part, view, 0.0, device, constant())
    truth = box_ratio(foot(view, 16), gap).mean(axis=1)
    return Measured(
        float(np.sqrt(np.mean((ratio - truth) ** 2))),
        finite(ratio, radiance.lit, radiance.unoccluded),
    )


def contact_leak(device: str, gap: float, size: float) -> Measured:
    """The most light that gets below a box which touches the plane."""
    part = box((0.0, (0.5 + gap) * size, 0.0), (size, size, size))
    view = from_above(12, 12, 0.2, size, 0.0)
    ratio, _ = ratio_of(part, view, 0.0, device, constant())
    under = np.abs(foot(view, 1)[:, 0]).max(axis=1) < 0.4
    assert under.sum() > 10
    return Measured(float(ratio[under].max()), finite(ratio))


# ---------------------------------------------------------------------- broken meshes

CARD_VIEW = camera(16, 16, 40.0)
"""A card of half side 1 at z = -5 fills it exactly."""


def card_error(device: str, parts: list[Primitive], *materials: Material) -> Measured:
    """Coverage, position and normal of a card that faces the camera, largest absolute error."""
    renderer = Renderer(Scene([placed(parts, *materials)], CARD_VIEW, ground(), device))
    gbuffer = renderer.gbuffer(0, 64)
    assert len(gbuffer.object_pixels) == 256
    errors = [
        np.abs(gbuffer.coverage - 1.0).max(),
        np.abs(gbuffer.normal - [0.0, 0.0, 1.0]).max(),
        np.abs(gbuffer.position[:, 2] + 5.0).max(),
    ]
    args = light_args(constant(), renderer.device)
    out = renderer.foreground(args, gbuffer.object_pixels, 16, 1, 2, 0)
    return Measured(
        float(np.max(errors)), finite(gbuffer.normal, gbuffer.position, out.radiance, out.mask)
    )


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
    scene = Scene(
        [placed(sheets, Material(alpha_mode="BLEND", alpha=0.25))],
        camera(1, 1, 1.0),
        ground(0.0),
        device,
    )
    rng = np.random.default_rng(14)
    points = np.concatenate([rng.uniform(-1, 1, (1000, 1)), -np.ones((1000, 1))], axis=1)
    points = np.concatenate([points, rng.uniform(-1, 1, (1000, 1))], axis=1)
    up = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    visible = leave(scene, points, up, up)
    return Measured(float(np.abs(visible - 0.75).max()), finite(visible))


def needle_card(width: float) -> tuple[Primitive, Float64Array]:
    """A tilted card of 1 m cut into triangles of ``width``; at most 2000 wide. Its normal too."""
    count = min(int(1.0 / width), 2000)
    turn = o.frame_of([0.3, 0.5, 0.8])
    x = (np.arange(count + 1) - 0.5 * count) * width
    lower = np.stack([x, np.full_like(x, -0.5), 0 * x], axis=-1)
    upper = np.stack([x, np.full_like(x, 0.5), 0 * x], axis=-1)
    k = np.arange(count)
    a, b, c, d = k, k + 1, k + count + 2, k + count + 1
    faces = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], axis=1).reshape(-1, 3)
    positions = np.concatenate([lower, upper]) @ turn.T
    return Primitive(positions, faces.astype(np.int32), 0), turn


def needle_rays(width: float) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return rays straight at the inside of the card, their truth, and the card's normal."""
    count = min(int(1.0 / width), 2000)
    _, turn = needle_card(width)
    rng = np.random.default_rng(15)
    half = 0.5 * count * width * 0.98
    xy = np.stack([rng.uniform(-half, half, 20000), rng.uniform(-0.49, 0.49, 20000)], axis=-1)
    target = np.concatenate([xy, np.zeros((20000, 1))], axis=1) @ turn.T
    d = o.normalize(-turn[:, 2] + 0.3 * rng.normal(size=(20000, 3)) @ np.diag([1, 1, 0]))
    return target - d, d, target


def needles(device: str, width: float) -> Measured:
    """Position and normal of hits on a card cut into needles; a ray that slips through counts 1."""
    part, turn = needle_card(width)
    scene = scene_of(part, device)
    origin, d, target = needle_rays(width)
    face, position, normal = trace(scene, origin - scene.origin, d)
    off_plane = np.abs((position + scene.origin - target) @ turn[:, 2])
    error = np.maximum(np.linalg.norm(normal - turn[:, 2], axis=1), off_plane)
    worst = float(np.where(face < 0, 1.0, error).max())
    return Measured(worst, finite(position, normal))


def inside_out(device: str, reverse: bool) -> Measured:
    """A double-sided matte ball, also with its triangles wound inside out: RMS of its radiance."""
    round_one = sphere((0.0, 0.0, -5.0), 1.0, 5)
    indices = round_one.indices[:, ::-1].copy() if reverse else round_one.indices
    part = Primitive(round_one.positions, indices, 0, normals=round_one.normals)
    material = Material(metallic=0.0, base_color=(0.8, 0.8, 0.8), double_sided=True)
    view = camera(12, 12, 30.0)
    renderer = Renderer(Scene([placed(part, material)], view, ground(), device))
    args = light_args(constant(), renderer.device)
    out = renderer.foreground(args, all_pixels(view), 1024, 1, 2, 0)
    # Closed form at 8 x 8 points of each pixel.
    side = (np.arange(12 * 8) + 0.5) / 8
    u, v = np.meshgrid((side - 6.0) / 30.0, -(side - 6.0) / 30.0)
    d = o.normalize(np.stack([u, v, -np.ones_like(u)], axis=-1))
    along = -5.0 * d[..., 2]
    rest = 1.0 - (25.0 - along**2)
    cosine = np.sqrt(np.maximum(rest, 0.0))
    knots = np.linspace(0.2, 1.0, 9)
    values = [o.gltf_albedo(float(c), 0.8, 0.0, 1.0) for c in knots]
    blocks = (12, 8, 12, 8)
    inside = (cosine > 0.25).reshape(blocks).all(axis=(1, 3)).ravel()
    truth = np.interp(cosine, knots, values).reshape(blocks).mean(axis=(1, 3)).ravel()
    found = out.radiance[:, 0].astype(np.float64)
    error = found[inside] / truth[inside] - 1.0
    return Measured(float(np.sqrt(np.mean(error**2))), finite(out.radiance))


# --------------------------------------------------------------------- size of the mesh


def big_ball() -> Primitive:
    """A ball of two million triangles."""
    theta = np.pi * np.arange(1, 1000) / 1000
    phi = 2.0 * np.pi * np.arange(1001) / 1001
    rings = np.stack(
        np.broadcast_arrays(
            np.sin(theta)[:, None] * np.cos(phi),
            np.cos(theta)[:, None],
            np.sin(theta)[:, None] * np.sin(phi),
        ),
        axis=-1,
    ).reshape(-1, 3)
    k = np.arange(1001)
    j = (k + 1) % 1001
    base = 1001 * np.arange(998)[:, None]
    upper = np.stack([base + k, base + j, base + 1001 + k], axis=-1).reshape(-1, 3)
    lower = np.stack([base + j, base + 1001 + j, base + 1001 + k], axis=-1).reshape(-1, 3)
    top, bottom = len(rings), len(rings) + 1
    caps = [
        np.stack([np.full(1001, top), j, k], axis=-1),
        np.stack([np.full(1001, bottom), 998 * 1001 + k, 998 * 1001 + j], axis=-1),
    ]
    positions = np.concatenate([rings, [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]])
    faces = np.concatenate([upper, lower, *caps]).astype(np.int32)
    return Primitive(positions, faces, 0, normals=positions.astype(np.float32))


def many_triangles(device: str) -> Measured:
    """Hits on a ball of two million triangles, and rays that leave it."""
    part = big_ball()
    scene = scene_of(part, device)
    toward, local = leaving()
    face, position, normal = trace(scene, toward * 3.0, -toward)
    depth = np.abs(np.linalg.norm(position + scene.origin, axis=1) - 1.0) / scene.diagonal
    error = float(np.where(face < 0, 1.0, depth).max())
    outward = np.einsum("ijk,ik->ij", frames(o.normalize(normal)), local)
    # Flat facets of a convex body: rays along the facet's own normal hemisphere are free.
    visible = leave(scene, position, normal, outward)
    worst = max(error, float(np.mean(visible < 1.0)))
    return Measured(worst, finite(position, normal, visible))


def one_pixel(device: str) -> Measured:
    """A view of one pixel, half covered by a matte card: coverage and radiance."""
    card = quad((-1.0, 0.0, -5.0), (1, 0, 0), (0, 1, 0))
    view = camera(1, 1, 2.5)
    material = Material(metallic=0.0, base_color=(0.8, 0.8, 0.8))
    renderer = Renderer(Scene([placed(card, material)], view, ground(), device))
    gbuffer = renderer.gbuffer(0, 64)
    args = light_args(constant(), renderer.device)
    out = renderer.foreground(args, all_pixels(view), 65536, 1, 1, 0)
    shaded = renderer.shaded_pixels(args, 0)
    # Mean albedo over the card's directions, Gauss-Legendre.
    x, weight_x = o.gauss_legendre([-0.4, 0.0], 12)
    y, weight_y = o.gauss_legendre([-0.4, 0.4], 12)
    x, weight_x, y, weight_y = 0.5 * x, 0.5 * weight_x, 0.5 * y, 0.5 * weight_y
    cosine = 1.0 / np.sqrt(1.0 + x[:, None] ** 2 + y[None] ** 2)
    knots = np.linspace(0.8, 1.0, 6)
    albedo = np.interp(cosine, knots, [o.gltf_albedo(float(c), 0.8, 0.0, 1.0) for c in knots])
    truth = float(weight_x @ albedo @ weight_y) / 0.16
    found = float(out.radiance[0, 0])
    error = max(abs(found / truth - 1.0), abs(float(out.mask[0]) / 0.5 - 1.0))
    return Measured(
        error if gbuffer.object_pixels.tolist() == [0] else 1.0,
        finite(out.radiance, gbuffer.normal, shaded),
    )


# ------------------------------------------------------------------------------ Mitsuba


def mitsuba_scene(part: Primitive) -> Any:
    """Return a Mitsuba scene of one mesh, in world coordinates, as Mitsuba takes them."""
    import mitsuba as mi

    mesh = mi.Mesh("part", len(part.positions), len(part.indices))
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(part.positions.astype(np.float32).ravel())
    values["faces"] = mi.UInt32(part.indices.astype(np.uint32).ravel())
    values.update()
    return mi.load_dict({"type": "scene", "part": mesh})


def mitsuba_trace(scene: Any, origin: Float64Array, direction: Float64Array) -> Any:
    """Return the surface interactions of rays in world coordinates."""
    import mitsuba as mi

    ray = mi.Ray3f(
        mi.Point3f(np.ascontiguousarray(origin.T, np.float32)),
        mi.Vector3f(np.ascontiguousarray(direction.T, np.float32)),
    )
    return scene.ray_intersect(ray)


def mitsuba_hits(size: float, away: float) -> float:
    """Error of Mitsuba's hits in the same soup."""
    part = soup(size, away)
    origin, direction = rays()
    d = direction.astype(np.float32).astype(np.float64)
    si = mitsuba_trace(mitsuba_scene(part), origin * size + AWAY * away, d)
    found = np.where(np.array(si.is_valid()), np.array(si.prim_index).astype(np.int64), -1)
    # In the middle's frame: float64 keeps 1e-11 m of 100 km.
    corners = (part.positions - AWAY * away).reshape(-1, 3, 3)
    truth = moller_trumbore(corners, origin * size, d)
    span = part.positions.max(axis=0) - part.positions.min(axis=0)
    point = np.array(si.p).T.astype(np.float64) - AWAY * away
    return hit_error(found, point, truth, float(np.linalg.norm(span)))


def mitsuba_self_hits(size: float, away: float) -> float:
    """Share of rays that Mitsuba lets leave the ball and that meet it again, or never met it."""
    import mitsuba as mi

    scene = mitsuba_scene(ball(size, away))
    toward, local = leaving()
    si = mitsuba_trace(scene, toward * size + AWAY * away, -toward)
    normal = np.array(si.n).T.astype(np.float64)
    valid = np.array(si.is_valid()) & (np.linalg.norm(normal, axis=1) > 0.5)
    normal[~valid] = [0.0, 0.0, 1.0]
    outward = np.einsum("ijk,ik->ij", frames(o.normalize(normal)), local)
    d = mi.Vector3f(np.ascontiguousarray(outward.T, np.float32))
    blocked = np.array(scene.ray_test(si.spawn_ray(d)))
    return float(np.mean(blocked | ~valid))


def mitsuba_visible(
    part: Primitive, points: Float64Array, d: Float64Array, height: float, size: float, away: float
) -> Float64Array:
    """Return 1 where a ray from the plane gets past the mesh; ``points`` are x and z at size 1."""
    import mitsuba as mi

    middle = AWAY * away
    plane = quad(
        (middle[0], height, middle[2]), (100.0 * size, 0.0, 0.0), (0.0, 0.0, -100.0 * size)
    )
    eye = middle + size * np.stack([points[:, 0], 0.0 * points[:, 0], points[:, 1]], axis=-1)
    eye[:, 1] = height + 20.0 * size
    down = np.broadcast_to([0.0, -1.0, 0.0], eye.shape)
    si = mitsuba_trace(mitsuba_scene(plane), eye, down)
    toward = mi.Vector3f(np.ascontiguousarray(d.T, np.float32))
    blocked = np.array(mitsuba_scene(part).ray_test(si.spawn_ray(toward)))
    return np.where(np.array(si.is_valid()), 1.0 - blocked, np.nan)


def mitsuba_ratio(
    part: Primitive, points: Float64Array, height: float, size: float, away: float
) -> Float64Array:
    """Return the shadow ratio of a constant sky at points, 4096 cosine directions each."""
    index = np.arange(SHADOW_SPP)[None]
    shift = np.random.default_rng(16).random((2, len(points), 1))
    # The R2 sequence (Roberts 2018), shifted at each point.
    u = np.mod(shift[0] + 0.7548776662466927 * index, 1.0).ravel()
    phi = 2.0 * np.pi * np.mod(shift[1] + 0.5698402909980532 * index, 1.0).ravel()
    radius = np.sqrt(u)
    d = np.stack([radius * np.cos(phi), np.sqrt(1.0 - u), radius * np.sin(phi)], axis=-1)
    repeated = np.repeat(points, SHADOW_SPP, axis=0)
    visible = mitsuba_visible(part, repeated, d, height, size, away)
    return np.asarray(visible.reshape(len(points), SHADOW_SPP).mean(axis=1))


def mitsuba_square(size: float, away: float) -> float:
    """RMS error of the square's shadow at the pixels' centres."""
    points = foot(from_above(8, 5, 0.6, size, 0.0), 1)[:, 0]
    ratio = mitsuba_ratio(roof(size, away), points, float((AWAY * away)[1]), size, away)
    truth = o.rectangle_ratio(points[:, 0], points[:, 1], 1.0, 1.5)
    return float(np.sqrt(np.mean((ratio - truth) ** 2)))


def mitsuba_contact(gap: float, size: float) -> float:
    """RMS error of the shadow round a box."""
    part = box((0.0, (0.5 + gap) * size, 0.0), (size, size, size))
    # Off the pixels' centres, some of which lie below the box's edges.
    points = foot(from_above(12, 12, 0.2, size, 0.0), 1)[:, 0] + 0.03
    ratio = mitsuba_ratio(part, points, 0.0, size, 0.0)
    return float(np.sqrt(np.mean((ratio - box_ratio(points, gap)) ** 2)))


def mitsuba_contact_leak(gap: float, size: float) -> float:
    """The most light that gets below a box which touches the plane."""
    part = box((0.0, (0.5 + gap) * size, 0.0), (size, size, size))
    points = foot(from_above(12, 12, 0.2, size, 0.0), 1)[:, 0]
    under = points[np.abs(points).max(axis=1) < 0.4]
    return float(mitsuba_ratio(part, under, 0.0, size, 0.0).max())


def mitsuba_dome(is_inside_out: bool, size: float) -> float:
    """Share of rays that get out of the dome."""
    points, d = dome_rays()
    visible = mitsuba_visible(dome(size, is_inside_out), points[:, [0, 2]], d, 0.0, size, 0.0)
    return float(np.mean(~(visible < 1.0)))


def mitsuba_needles(width: float) -> float:
    """Error of position and normal on the card of needles."""
    part, turn = needle_card(width)
    origin, d, target = needle_rays(width)
    si = mitsuba_trace(mitsuba_scene(part), origin, d)
    p, n = (np.array(a).T.astype(np.float64) for a in (si.p, si.n))
    normal = n * np.sign(n @ turn[:, 2])[:, None]
    off_plane = np.abs((p - target) @ turn[:, 2])
    error = np.maximum(np.linalg.norm(normal - turn[:, 2], axis=1), off_plane)
    return float(np.where(np.array(si.is_valid()), error, 1.0).max())


def mitsuba_many_triangles() -> float:
    """Error of hits on the big ball, or share of rays that meet it again."""
    import mitsuba as mi

    scene = mitsuba_scene(big_ball())
    toward, local = leaving()
    si = mitsuba_trace(scene, toward * 3.0, -toward)
    valid = np.array(si.is_valid())
    p, n = (np.array(a).T.astype(np.float64) for a in (si.p, si.n))
    depth = np.abs(np.linalg.norm(p, axis=1) - 1.0) / np.sqrt(12.0)
    outward = np.einsum("ijk,ik->ij", frames(o.normalize(n)), local)
    toward_d = mi.Vector3f(np.ascontiguousarray(outward.T, np.float32))
    blocked = np.array(scene.ray_test(si.spawn_ray(toward_d)))
    return float(max(np.where(valid, depth, 1.0).max(), np.mean(blocked)))


def mitsuba_degenerate() -> float:
    """Error of position and normal on the card among triangles of no area."""
    u = (np.arange(64) + 0.5) / 64.0 * 0.4 - 0.2
    x, y = (a.ravel() for a in np.meshgrid(u, u))
    d = o.normalize(np.stack([x, y, -np.ones_like(x)], axis=-1))
    si = mitsuba_trace(mitsuba_scene(degenerate_card()), np.zeros_like(d), d)
    p, n = (np.array(a).T.astype(np.float64) for a in (si.p, si.n))
    error = np.maximum(np.abs(n - [0.0, 0.0, 1.0]).max(axis=1), np.abs(p[:, 2] + 5.0))
    return float(np.where(np.array(si.is_valid()), error, 1.0).max())


OTHER_MATERIAL = "has no glTF material; benchmarks.referee compares whole pictures"


def cases() -> list[Case]:
    """Return the rows of this group."""
    rows = []
    for name, size, away in PLACES:
        rows += [
            Case(
                GROUP,
                name,
                "first hits",
                "max over the diagonal",
                partial(hits, size=size, away=away),
                POSITION,
                mitsuba=partial(mitsuba_hits, size, away),
            ),
            Case(
                GROUP,
                name,
                "rays that leave a ball",
                SHARE,
                partial(self_hits, size=size, away=away),
                SELF_HITS,
                mitsuba=partial(mitsuba_self_hits, size, away),
            ),
            Case(
                GROUP,
                name,
                "shadow of a square",
                "RMS absolute",
                partial(square_shadow, size=size, away=away),
                SHADOW,
                mitsuba=partial(mitsuba_square, size, away),
            ),
        ]
    for name, gap, size in (
        ("box on the plane", 0.0, 1.0),
        ("box on the plane, 1 mm wide", 0.0, 1e-3),
        ("box on the plane, 10 km wide", 0.0, 1e4),
        ("box 1e-7 of its size above", 1e-7, 1.0),
        ("box 1e-3 of its size above", 1e-3, 1.0),
        ("box sunk by 1e-3 of its size", -1e-3, 1.0),
        ("box sunk by 0.3 of its size", -0.3, 1.0),
    ):
        rows.append(
            Case(
                GROUP,
                name,
                "shadow",
                "RMS absolute",
                partial(contact, gap=gap, size=size),
                SHADOW,
                mitsuba=partial(mitsuba_contact, gap, size),
            )
        )
        if gap <= 0.0:
            rows.append(
                Case(
                    GROUP,
                    name,
                    "light below it",
                    MAX_ABSOLUTE,
                    partial(contact_leak, gap=gap, size=size),
                    LEAKS,
                    mitsuba=partial(mitsuba_contact_leak, gap, size),
                )
            )
    for size in (1e-3, 1.0, 1e4):
        for reverse in (False, True):
            rows.append(
                Case(
                    GROUP,
                    f"open dome of {size:g} m{', inside out' if reverse else ''}",
                    "light within it",
                    SHARE,
                    partial(dome_leaks, inside_out=reverse, size=size),
                    LEAKS,
                    mitsuba=partial(mitsuba_dome, reverse, size),
                )
            )
    rows += [
        Case(
            GROUP,
            "triangles of no area",
            "coverage, position, normal",
            MAX_ABSOLUTE,
            degenerate,
            FLAT,
            mitsuba=mitsuba_degenerate,
        ),
        *(
            Case(
                GROUP,
                f"two cards in one place, {'against each other' if opposite else 'alike'}, "
                f"{'double' if double else 'single'} sided",
                "coverage, position, normal",
                MAX_ABSOLUTE,
                partial(twins, opposite=opposite, double_sided=double),
                FLAT,
                mitsuba="culls no faces",
            )
            for opposite in (False, True)
            for double in (False, True)
        ),
        Case(
            GROUP,
            "two sheets of opacity 0.25 in one place",
            "sunlight through both, as one",
            MAX_ABSOLUTE,
            blended_twins,
            FLAT,
            mitsuba="has no ray query with transparency apart from its integrators",
        ),
        *(
            Case(
                GROUP,
                f"needles 1 m long, {width:g} m wide",
                "position, normal",
                MAX_ABSOLUTE,
                partial(needles, width=width),
                # The card's diagonal is 1 to 1.4 m.
                NORMAL_ROUNDINGS * 2.0**-24 * 0.7 / width,
                mitsuba=partial(mitsuba_needles, width),
                cost="quick" if width > 5e-4 else "medium",
            )
            for width in (1e-2, 1e-3, 1e-4, 1e-5)
        ),
        *(
            Case(
                GROUP,
                f"ball, triangles {'inside out' if reverse else 'wound as they should be'}",
                "radiance",
                "RMS relative",
                partial(inside_out, reverse=reverse),
                FACETS,
                mitsuba=OTHER_MATERIAL,
                cost="medium",
            )
            for reverse in (False, True)
        ),
        Case(
            GROUP,
            "a view of one pixel",
            "coverage, radiance",
            RELATIVE,
            one_pixel,
            ALBEDO,
            mitsuba=OTHER_MATERIAL,
            cost="medium",
        ),
        Case(
            GROUP,
            "two million triangles",
            "first hits, rays that leave",
            "max over the diagonal, share",
            many_triangles,
            SAGITTA,
            mitsuba=mitsuba_many_triangles,
            cost="slow",
        ),
    ]
    return rows
