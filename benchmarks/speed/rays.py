"""Rays per second through the demo's car, by Embree and by Warp's tree: the bound of a render.

python -m benchmarks.speed.rays [--device cpu]
"""

from functools import partial

import numpy as np
import warp as wp

from benchmarks.measure import flags, seconds
from benchmarks.scenes import on_the_ground
from warpir.demo import ASSET
from warpir.io.assets import load_asset
from warpir.kernels.tracing.triangles import any_triangle, closest_triangle
from warpir.kernels.types import MeshArgs
from warpir.render.device import choose_device
from warpir.render.device_scene import Scene
from warpir.scene.camera import Camera

RAYS = 1 << 19


@wp.kernel(module="unique", enable_backward=False)
def cast_any(mesh: MeshArgs, origin: wp.array[wp.vec3], wi: wp.array[wp.vec3], hits: wp.array[int]):
    """Count rays that meet a triangle."""
    i = wp.tid()
    hits[i] = int(any_triangle(mesh, 0, origin[i], wi[i], 1.0e30))


@wp.kernel(module="unique", enable_backward=False)
def cast_closest(
    mesh: MeshArgs, origin: wp.array[wp.vec3], wi: wp.array[wp.vec3], hits: wp.array[int]
):
    """Count rays that meet a triangle, each at its first."""
    i = wp.tid()
    hits[i] = closest_triangle(mesh, origin[i], wi[i], 1.0e30).valid


def rays_of(scene: Scene, rng: np.random.Generator) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return origins and unit directions, from the ground to the car and from its surface."""
    low, high = (np.asarray(corner) - scene.origin for corner in scene.bounds)
    ground = rng.normal(size=(RAYS, 3)) * [3.0, 0.0, 3.0] + 0.5 * (low + high)
    ground[:, 1] = low[1]
    toward = low + (high - low) * rng.random((RAYS, 3)) - ground
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    corners = scene.mesh_args.indices.numpy().reshape(-1, 3)
    corners = corners[rng.integers(len(corners), size=RAYS)]
    weights = rng.dirichlet([1.0, 1.0, 1.0], size=RAYS)[..., None]
    surface = (scene.mesh_args.positions.numpy()[corners] * weights).sum(axis=1)
    away = rng.normal(size=(RAYS, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return {"ground": (ground, toward), "surface": (surface + 1e-3 * away, away)}


def main() -> None:
    """Print a line per tree and kind of ray."""
    device = wp.get_device(choose_device(flags(__doc__, "device").parse_args().device))
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
    scene = on_the_ground(load_asset(ASSET), np.eye(4), camera, device.alias).scene
    trees = {"Warp": MeshArgs(), "Embree": scene.mesh_args}
    trees["Warp"].id = scene.mesh_args.id
    if not scene.mesh_args.embree:
        del trees["Embree"]
    for where, (origin, wi) in rays_of(scene, np.random.default_rng(0)).items():
        rays = (a.astype(np.float32) for a in (origin, wi))
        arrays = [wp.array(a, dtype=wp.vec3, device=device) for a in rays]
        for kind, kernel in (("any", cast_any), ("closest", cast_closest)):
            for tree, mesh in trees.items():
                hits = wp.zeros(RAYS, dtype=int, device=device)
                inputs = [mesh, *arrays, hits]
                spent = seconds(partial(wp.launch, kernel, RAYS, inputs, device=device), device)
                rate, share = RAYS / spent / 1e6, hits.numpy().mean()
                print(f"{where:8} {kind:8} {tree:7} {rate:7.1f} M/s, {share:.3f} hit")


if __name__ == "__main__":
    main()
