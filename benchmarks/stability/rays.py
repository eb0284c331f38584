"""Rays in hard geometry: far away, tiny, huge, among needles and two million triangles.

Errors of positions are shares of the scene's diagonal. A ray that meets another triangle than in
float64, or none, counts as an error of 1.
"""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from benchmarks.stability.case import (
    Float64Array,
    Measured,
    finite,
    from_mitsuba,
    launch,
    to_mitsuba,
    upload,
)
from tests import oracles as o
from tests.builders.shapes import camera, ground, placed, quad, sphere
from warpir.kernels.tracing.hit import face_normal, hit_position, offset_origin
from warpir.kernels.tracing.ray import closest_hit, visibility
from warpir.kernels.types import MaterialArgs, MeshArgs, TextureArgs
from warpir.render.device_scene import Scene
from warpir.scene.asset import Primitive

wp.set_module_options({"enable_backward": False})

AWAY = np.array([0.6, 0.48, -0.64])
"""Where "away" is."""


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
    hit = closest_hit(mesh, material, texture, origin[i], direction[i], 1.0e30, 0, 0.0)
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


def scene_of(part: Primitive, device: str) -> Scene:
    """A scene of one primitive; the view does not matter."""
    return Scene([placed(part)], camera(1, 1, 1.0), ground(), device)


def trace(
    scene: Scene, origin: NDArray[np.floating[Any]], direction: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int32], Float64Array, Float64Array]:
    """Return face, position (recentred frame) and geometric normal of each ray's first hit."""
    device = str(scene.device)
    inputs = [scene.mesh_args, scene.material_args, scene.texture_args]
    inputs += [upload(a, wp.vec3, device) for a in (origin, direction)]
    kinds = int, wp.vec3, wp.vec3
    face, position, normal = launch(hit_kernel, len(origin), inputs, *kinds, device=device)
    return face.astype(np.int32), position, normal


def leave(
    scene: Scene, position: Float64Array, normal: Float64Array, direction: Float64Array
) -> Float64Array:
    """Return what reaches surface points along directions."""
    device = str(scene.device)
    inputs = [scene.mesh_args, scene.material_args, scene.texture_args]
    inputs += [upload(a, wp.vec3, device) for a in (position, normal, direction)]
    (visible,) = launch(leave_kernel, len(position), inputs, float, device=device)
    return visible


# ------------------------------------------------------------------- hits against float64


def soup(size: float, away: float) -> Primitive:
    """200 random triangles in a cube of ``size``, ``away`` from the origin."""
    rng = np.random.default_rng(8)
    middle = rng.uniform(-0.35, 0.35, (200, 1, 3))
    corners = (middle + rng.uniform(-0.15, 0.15, (200, 3, 3))).reshape(-1, 3)
    positions = corners * size + AWAY * away
    return Primitive(positions, np.arange(600, dtype=np.int32).reshape(-1, 3), 0)


def rays() -> tuple[Float64Array, Float64Array]:
    """Return rays toward a unit cube about the origin from a sphere of radius 1.5."""
    rng = np.random.default_rng(9)
    origin = 1.5 * o.normalize(rng.normal(size=(4000, 3)))
    return origin, o.normalize(rng.uniform(-0.4, 0.4, (4000, 3)) - origin)


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
    distance = np.where(face_64 >= 0, np.linalg.norm(point - point_64, axis=1) / diagonal, 0.0)
    return float(np.where(face != face_64, 1.0, distance)[clear].max())


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


def leaving() -> tuple[Float64Array, Float64Array]:
    """Return directions from the surface of a unit ball and, as local frames do, toward it."""
    rng, count = np.random.default_rng(10), 20000
    cos = np.concatenate([rng.uniform(1e-3, 1.0, count // 2), np.geomspace(1e-3, 1, count // 2)])
    local = o.spherical(cos, rng.uniform(0.0, 2.0 * np.pi, count))
    return o.normalize(rng.normal(size=(count, 3))), local


def outward(normal: Float64Array, local: Float64Array) -> Float64Array:
    """Return directions given in frames whose third axis is the normal, shape [n, 3]."""
    n = o.normalize(normal)
    helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = o.normalize(np.cross(helper, n))
    frames = np.stack([x, np.cross(n, x), n], axis=-1)
    return np.asarray(np.einsum("ijk,ik->ij", frames, local))


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
    visible = leave(scene, position, normal, outward(normal, local))
    return Measured(float(np.mean(visible < 1.0)), finite(visible, position, normal))


def lathe(theta: Float64Array, count: int) -> tuple[Float64Array, NDArray[np.int32]]:
    """Return rings of a unit sphere below its pole at (0, 1, 0), the first vertex, and their faces.

    Each of ``count`` vertices lies at an angle ``theta`` from +Y, growing [rad].
    """
    phi = 2.0 * np.pi * np.arange(count) / count
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    axes = np.broadcast_arrays(sine * np.cos(phi), cosine, sine * np.sin(phi))
    rings = np.stack(axes, axis=-1).reshape(-1, 3)
    k = np.arange(count)
    j = (k + 1) % count
    base = 1 + count * np.arange(len(theta) - 1)[:, None]
    faces = [
        np.stack([np.zeros_like(k), 1 + j, 1 + k], axis=-1),
        np.stack([base + k, base + j, base + count + k], axis=-1).reshape(-1, 3),
        np.stack([base + j, base + count + j, base + count + k], axis=-1).reshape(-1, 3),
    ]
    return np.concatenate([[[0.0, 1.0, 0.0]], rings]), np.concatenate(faces).astype(np.int32)


def dome(size: float, inside_out: bool) -> Primitive:
    """An open upper half ball of radius ``size`` whose rim lies a little below the plane."""
    positions, indices = lathe(np.linspace(0.0, 0.5 * np.pi + 0.02, 33)[1:], 96)
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


def dome_leaks(device: str, size: float, inside_out: bool) -> Measured:
    """Share of rays from the plane that get out of an open dome standing on it."""
    scene = scene_of(dome(size, inside_out), device)
    points, d = dome_rays()
    up = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    visible = leave(scene, points * size - scene.origin, up, d)
    return Measured(float(np.mean(visible > 0.0)), finite(visible))


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


def card_error(
    offset: Float64Array, normal: Float64Array, truth: Float64Array, valid: NDArray[np.bool_]
) -> float:
    """Return the largest error of hits on a card: off its plane, of the normal; 1 for a miss."""
    error = np.maximum(np.linalg.norm(normal - truth, axis=1), np.abs(offset @ truth))
    return float(np.where(valid, error, 1.0).max())


def needles(device: str, width: float) -> Measured:
    """Position and normal of hits on a card cut into needles; a ray that slips through counts 1."""
    part, turn = needle_card(width)
    scene = scene_of(part, device)
    origin, d, target = needle_rays(width)
    face, position, normal = trace(scene, origin - scene.origin, d)
    error = card_error(position + scene.origin - target, normal, turn[:, 2], face >= 0)
    return Measured(error, finite(position, normal))


def big_ball() -> Primitive:
    """A ball of two million triangles."""
    positions, faces = lathe(np.pi * np.arange(1, 1000) / 1000, 1001)
    bottom = len(positions)
    k = np.arange(1001)
    cap = np.stack([np.full(1001, bottom), bottom - 1001 + k, bottom - 1001 + (k + 1) % 1001], 1)
    positions = np.concatenate([positions, [[0.0, -1.0, 0.0]]])
    indices = np.concatenate([faces, cap.astype(np.int32)])
    return Primitive(positions, indices, 0, normals=positions.astype(np.float32))


def many_triangles(device: str) -> Measured:
    """Hits on a ball of two million triangles, and rays that leave it."""
    part = big_ball()
    scene = scene_of(part, device)
    toward, local = leaving()
    face, position, normal = trace(scene, toward * 3.0, -toward)
    depth = np.abs(np.linalg.norm(position + scene.origin, axis=1) - 1.0) / scene.diagonal
    error = float(np.where(face < 0, 1.0, depth).max())
    # Flat facets of a convex body: rays along the facet's own normal hemisphere are free.
    visible = leave(scene, position, normal, outward(normal, local))
    worst = max(error, float(np.mean(visible < 1.0)))
    return Measured(worst, finite(position, normal, visible))


def mitsuba_scene(part: Primitive) -> Any:
    """Return a Mitsuba scene of one mesh, in world coordinates, as Mitsuba takes them."""
    import mitsuba as mi

    mesh = mi.Mesh("part", len(part.positions), len(part.indices))
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(part.positions.astype(np.float32).ravel())
    values["faces"] = mi.UInt32(part.indices.astype(np.uint32).ravel())
    values.update()
    return mi.load_dict({"type": "scene", "part": mesh})


def mitsuba_trace(
    scene: Any, origin: Float64Array, direction: Float64Array
) -> tuple[Any, NDArray[np.bool_], Float64Array, Float64Array]:
    """Return interactions of rays in world coordinates: hit or not, position, geometric normal."""
    import mitsuba as mi

    si = scene.ray_intersect(mi.Ray3f(to_mitsuba(origin), to_mitsuba(direction)))
    return si, np.array(si.is_valid()), from_mitsuba(si.p), from_mitsuba(si.n)


def mitsuba_blocked(scene: Any, si: Any, direction: Float64Array) -> NDArray[np.bool_]:
    """Say which rays that leave interactions along ``direction`` meet the scene."""
    return np.array(scene.ray_test(si.spawn_ray(to_mitsuba(direction))))


def mitsuba_hits(size: float, away: float) -> float:
    """Error of Mitsuba's hits in the same soup."""
    part = soup(size, away)
    origin, direction = rays()
    d = direction.astype(np.float32).astype(np.float64)
    si, valid, p, _ = mitsuba_trace(mitsuba_scene(part), origin * size + AWAY * away, d)
    found = np.where(valid, np.array(si.prim_index).astype(np.int64), -1)
    # In the middle's frame: float64 keeps 1e-11 m of 100 km.
    corners = (part.positions - AWAY * away).reshape(-1, 3, 3)
    truth = moller_trumbore(corners, origin * size, d)
    span = part.positions.max(axis=0) - part.positions.min(axis=0)
    return hit_error(found, p - AWAY * away, truth, float(np.linalg.norm(span)))


def mitsuba_self_hits(size: float, away: float) -> float:
    """Share of rays that Mitsuba lets leave the ball and that meet it again, or never met it."""
    scene = mitsuba_scene(ball(size, away))
    toward, local = leaving()
    si, valid, _, normal = mitsuba_trace(scene, toward * size + AWAY * away, -toward)
    valid &= np.linalg.norm(normal, axis=1) > 0.5
    normal[~valid] = [0.0, 0.0, 1.0]
    return float(np.mean(mitsuba_blocked(scene, si, outward(normal, local)) | ~valid))


def mitsuba_visible(
    part: Primitive, points: Float64Array, d: Float64Array, height: float, size: float, away: float
) -> Float64Array:
    """Return 1 where a ray from the plane gets past the mesh; ``points`` are x and z at size 1."""
    middle = AWAY * away
    wide = 100.0 * size
    plane = quad((middle[0], height, middle[2]), (wide, 0.0, 0.0), (0.0, 0.0, -wide))
    eye = middle + size * np.stack([points[:, 0], 0.0 * points[:, 0], points[:, 1]], axis=-1)
    eye[:, 1] = height + 20.0 * size
    down = np.broadcast_to([0.0, -1.0, 0.0], eye.shape)
    si, valid, _, _ = mitsuba_trace(mitsuba_scene(plane), eye, down)
    return np.where(valid, 1.0 - mitsuba_blocked(mitsuba_scene(part), si, d), np.nan)


def mitsuba_dome(size: float, is_inside_out: bool) -> float:
    """Share of rays that get out of the dome."""
    points, d = dome_rays()
    visible = mitsuba_visible(dome(size, is_inside_out), points[:, [0, 2]], d, 0.0, size, 0.0)
    return float(np.mean(~(visible < 1.0)))


def mitsuba_needles(width: float) -> float:
    """Error of position and normal on the card of needles."""
    part, turn = needle_card(width)
    origin, d, target = needle_rays(width)
    _, valid, p, n = mitsuba_trace(mitsuba_scene(part), origin, d)
    normal = n * np.sign(n @ turn[:, 2])[:, None]
    return card_error(p - target, normal, turn[:, 2], valid)


def mitsuba_many_triangles() -> float:
    """Error of hits on the big ball, or share of rays that meet it again."""
    scene = mitsuba_scene(big_ball())
    toward, local = leaving()
    si, valid, p, n = mitsuba_trace(scene, toward * 3.0, -toward)
    depth = np.abs(np.linalg.norm(p, axis=1) - 1.0) / np.sqrt(12.0)
    blocked = mitsuba_blocked(scene, si, outward(n, local))
    return float(max(np.where(valid, depth, 1.0).max(), np.mean(blocked)))
