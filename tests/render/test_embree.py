"""Rays on the CPU: Embree's tree beside Warp's, and what a tree of triangles must never do."""

import weakref
from importlib.util import find_spec

import numpy as np
import pytest
import warp as wp

from tests.builders.shapes import all_pixels, camera, constant, ground, placed, quad, sphere
from warpir.core.arrays import Float64Array, IntArray
from warpir.kernels.tracing.triangles import any_triangle, closest_triangle
from warpir.kernels.types import MeshArgs
from warpir.render import device_scene
from warpir.render.device_light import light_args
from warpir.render.device_scene import Scene
from warpir.render.rays.embree import EmbreeScene, library
from warpir.render.renderer import Renderer
from warpir.scene.asset import Material

pytestmark = pytest.mark.skipif(find_spec("embreex") is None, reason="embreex is not installed")

VIEW = camera(32, 24, 40.0, (0.0, 1.0, 4.0), pitch=-10.0)
FAR = 1e30


@wp.kernel(module="unique", enable_backward=False)
def cast_rays(
    mesh: MeshArgs,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    reach: wp.array[float],
    triangle: wp.array[int],
    weights: wp.array[wp.vec2],
    blocked: wp.array[int],
):
    """Write what each ray meets first, -1 where nothing, and whether it meets anything."""
    i = wp.tid()
    hit = closest_triangle(mesh, origin[i], direction[i], reach[i])
    triangle[i] = hit.face
    weights[i] = wp.vec2(hit.u, hit.v)
    blocked[i] = int(any_triangle(mesh, 0, origin[i], direction[i], reach[i]))


def cast(
    mesh: MeshArgs, origin: Float64Array, direction: Float64Array, reach: float = FAR
) -> tuple[IntArray, Float64Array, IntArray]:
    count = len(origin)
    arrays = [wp.array(a.astype(np.float32), wp.vec3, device="cpu") for a in (origin, direction)]
    limits = wp.full(count, reach, dtype=float, device="cpu")
    out = [wp.zeros(count, dtype=t, device="cpu") for t in (int, wp.vec2, int)]
    wp.launch(cast_rays, count, [mesh, *arrays, limits, *out], device="cpu")
    triangle, weights, blocked = (a.numpy() for a in out)
    return triangle, weights, blocked


def warp_alone(mesh: MeshArgs) -> MeshArgs:
    args = MeshArgs()
    args.id, args.passing, args.passing_start = mesh.id, mesh.passing, mesh.passing_start
    return args


@pytest.fixture(scope="module")
def ball() -> Scene:
    return Scene([placed(sphere((0.0, 1.0, 0.0), 1.0))], VIEW, ground(0.0), "cpu")


def unit(rng: np.random.Generator, count: int) -> Float64Array:
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def points_of(mesh: MeshArgs, triangle: IntArray, weights: Float64Array) -> Float64Array:
    corners = mesh.positions.numpy()[mesh.indices.numpy().reshape(-1, 3)[triangle]]
    u, v = weights.T[..., None].astype(np.float64)
    return corners[:, 0] * u + corners[:, 1] * v + corners[:, 2] * (1.0 - u - v)


def test_embree_is_what_the_cpu_uses(ball):
    assert library() is not None
    assert ball.mesh_args.embree and ball.mesh_args.embree_intersect


def test_both_trees_find_the_same_points(ball):
    rng = np.random.default_rng(1)
    origin, direction = 3.0 * unit(rng, 50_000), unit(rng, 50_000)
    ours, theirs = (
        cast(m, origin, direction) for m in (ball.mesh_args, warp_alone(ball.mesh_args))
    )
    np.testing.assert_array_equal(ours[0] >= 0, ours[2] == 1)
    hit = (ours[0] >= 0) & (theirs[0] >= 0)
    assert 1_000 < hit.sum()
    # A ray along the silhouette may meet one tree and not the other.
    assert ((ours[0] >= 0) != (theirs[0] >= 0)).sum() <= 5
    found, expected = (points_of(ball.mesh_args, t[hit], w[hit]) for t, w, _ in (ours, theirs))
    # Grazing rays spread the rounding of their origins over the surface.
    distance = np.linalg.norm(found - expected, axis=1)
    assert np.quantile(distance, 0.99) < 2e-6 and distance.max() < 1e-3


def test_hit_lies_on_the_ray_and_before_its_reach(ball):
    rng = np.random.default_rng(2)
    origin, direction = 3.0 * unit(rng, 20_000), unit(rng, 20_000)
    triangle, weights, _ = cast(ball.mesh_args, origin, direction)
    hit = triangle >= 0
    to_point = points_of(ball.mesh_args, triangle[hit], weights[hit]) - origin[hit]
    t = (to_point * direction[hit]).sum(axis=1)
    assert t.min() > 0.0
    assert np.linalg.norm(to_point - t[:, None] * direction[hit], axis=1).max() < 1e-5
    short, _, blocked = cast(ball.mesh_args, origin, direction, reach=2.5)
    np.testing.assert_array_equal(short[hit] >= 0, t < 2.5)
    np.testing.assert_array_equal(short >= 0, blocked == 1)


def test_no_ray_leaves_a_closed_mesh_through_an_edge(ball):
    low, high = (np.asarray(corner) - ball.origin for corner in ball.bounds)
    centre = 0.5 * (low + high)
    positions = ball.mesh_args.positions.numpy().astype(np.float64)
    corners = positions[ball.mesh_args.indices.numpy().reshape(-1, 3)]
    edges = 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)
    rng = np.random.default_rng(3)
    origin = centre + 0.3 * unit(rng, len(positions) + len(edges))
    direction = np.concatenate([positions, edges]) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    triangle, _, blocked = cast(ball.mesh_args, origin, direction)
    through = (triangle < 0) | (blocked == 0)
    assert not through[len(positions) :].any()
    # Aimed at a corner itself, 5 of 2562 pass in float32, and 10 by Warp's tree.
    assert through[: len(positions)].mean() < 0.004


def test_degenerate_triangles_are_passed_by():
    embree = library()
    assert embree is not None
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]], np.float32)
    scene = EmbreeScene(embree, positions, np.array([0, 3, 0, 0, 1, 2], np.int32))
    args = MeshArgs()
    args.embree, args.embree_intersect = scene.handle, embree.intersect
    args.embree_occluded = embree.occluded
    triangle, weights, blocked = cast(
        args, np.array([[0.2, 0.3, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    )
    assert triangle[0] == 1 and blocked[0] == 1
    np.testing.assert_allclose(weights[0], [0.5, 0.2], atol=1e-6)


def test_triangles_that_may_be_passed_have_a_tree_of_their_own():
    """A sheet of alpha .25 before a wall, on whichever place of the asset's list each stands."""
    sheet = Material(alpha=0.25, alpha_mode="BLEND", double_sided=True)
    clear, solid = (quad((0, 0, z), (1, 0, 0), (0, 1, 0), material=m) for z, m in ((1, 0), (0, 1)))
    origin = np.array([[0.1, 0.2, 5.0]] * 2 + [[3.0, 0.0, 5.0]])
    direction = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    for parts in ((clear, solid), (solid, clear)):
        scene = Scene([placed(parts, sheet, Material())], VIEW, ground(-9.0), "cpu")
        args = scene.mesh_args
        assert args.id and args.passing and args.embree and args.embree_passing
        assert args.passing_start == 2
        assert args.face_material.numpy().tolist() == [1, 1, 0, 0]
        for mesh in (args, warp_alone(args)):
            triangle, _, blocked = cast(mesh, origin, direction)
            assert triangle[0] in (2, 3) and triangle[1:].tolist() == [-1, -1]
            assert blocked.tolist() == [1, 0, 0], "by the wall alone"
    for material in (sheet, Material()):
        scene = Scene([placed(solid, material, material)], VIEW, ground(-9.0), "cpu")
        trees = bool(scene.mesh_args.id), bool(scene.mesh_args.passing)
        assert trees == (not material.may_be_passed, material.may_be_passed)


def test_the_tree_is_released_with_its_scene():
    embree = library()
    assert embree is not None
    tree = EmbreeScene(embree, np.eye(3, dtype=np.float32), np.arange(3, dtype=np.int32))
    release, alive = tree._release, weakref.ref(tree)
    del tree
    assert alive() is None and not release.alive


def test_warps_tree_serves_where_embree_is_absent(ball, monkeypatch):
    monkeypatch.setattr(device_scene, "library", lambda: None)
    without = Scene([placed(sphere((0.0, 1.0, 0.0), 1.0))], VIEW, ground(0.0), "cpu")
    assert not without.mesh_args.embree
    pictures = []
    for scene in (ball, without):
        renderer = Renderer(scene)
        light = light_args(constant(), renderer.device)
        pictures.append(renderer.foreground(light, all_pixels(VIEW), 16, 1, 3, 7).radiance)
    assert pictures[0].max() > 0.1
    difference = np.abs(pictures[0] - pictures[1]).max(axis=1)
    # The same samples; a path along a silhouette may differ.
    assert np.quantile(difference, 0.98) < 1e-4
