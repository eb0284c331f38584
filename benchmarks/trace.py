"""How many rays per second: primary (closest hit) and shadow (any hit)?

    python -m benchmarks.trace [--assets DIR] [--device cpu|cuda] [--json FILE]

The object fills the view; shadow rays start on its surface in cosine-distributed directions.
"""

from functools import partial

import numpy as np
import warp as wp

from benchmarks.measure import context, flags, report, seconds
from benchmarks.scenes import on_the_ground
from warpir.io.assets import load_asset
from warpir.kernels.maths.frame import basis, to_world
from warpir.kernels.maths.rng import hash_pair, pixel_seed, sobol_pair, to_unit
from warpir.kernels.receiver_mesh import INFINITY
from warpir.kernels.sampling import cosine_sample
from warpir.kernels.tracing.hit import offset_origin
from warpir.kernels.tracing.ray import camera_ray, closest_hit, visibility
from warpir.kernels.tracing.surface import surface_at
from warpir.kernels.types import CameraArgs, MaterialArgs, MeshArgs, TextureArgs
from warpir.render.device import Rows, choose_device
from warpir.render.renderer import Renderer
from warpir.scene.camera import Camera

wp.set_module_options({"enable_backward": False})

ASSETS = ("mesh/ToyCar.glb", "mesh/spot/spot.obj", "mesh/kenney_trucks/vehicle-truck-red.glb")
SIDE = 768
SHADOW_RAYS = 8
"""Per primary ray; the primary ray's time is subtracted."""


@wp.kernel
def cast(
    pixels: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    shadow_rays: int,
    hits: wp.array[float],
):
    """Cast one primary ray a thread and ``shadow_rays`` from where it hits."""
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(0, pixel)
    ray_dir = camera_ray(camera, pixel, sobol_pair(0, key, 0))
    draw = to_unit(hash_pair(key, wp.uint32(0)))
    hit = closest_hit(mesh, material, texture, camera.origin, ray_dir, INFINITY, 1, draw)
    total = float(hit.valid)
    if hit.valid == 1 and shadow_rays > 0:
        surface = surface_at(mesh, material, texture, hit, -ray_dir)
        frame = basis(surface.ng)
        for s in range(shadow_rays):
            wi = to_world(cosine_sample(sobol_pair(s, key, 1)), frame)
            origin = offset_origin(surface.position, surface.ng, wi, mesh.epsilon)
            total += visibility(mesh, material, texture, origin, wi)
    hits[i] = total


def launch(renderer: Renderer, pixels: wp.array, hits: wp.array, shadow_rays: int) -> None:
    """Cast the rays of all pixels."""
    scene = renderer.scene
    inputs = [scene.camera_args, scene.mesh_args, scene.material_args, scene.texture_args]
    arguments = [Rows(pixels), *inputs, shadow_rays, Rows(hits)]
    renderer.launch(cast, SIDE * SIDE, arguments, 1 + shadow_rays)


def main() -> None:
    """Measure the assets of the referee's presets."""
    options = flags(__doc__).parse_args()
    device = choose_device(options.device)
    for name in ASSETS:
        asset = load_asset(options.assets / name)
        low, high = asset.bounds()
        radius = 0.5 * float(np.linalg.norm(high - low))
        pose = np.eye(4)
        pose[:3, 3] = 0.5 * (low + high) + [0.0, 0.0, 4.0 * radius]
        focal = 0.5 * SIDE * 3.9
        camera = Camera(SIDE, SIDE, focal, focal, 0.5 * SIDE, 0.5 * SIDE, pose)
        height = float(low[1]) - radius
        renderer = on_the_ground(asset, np.eye(4), camera, device, height=height)
        scene = renderer.scene
        pixels = wp.array(np.arange(SIDE * SIDE, dtype=np.int32), dtype=int, device=device)
        hits = wp.zeros(SIDE * SIDE, dtype=float, device=device)

        run = partial(launch, renderer, pixels, hits)
        primary = seconds(partial(run, 0), scene.device)
        share = float(hits.numpy().mean())
        both = seconds(partial(run, SHADOW_RAYS), scene.device)
        shadow_count = share * SIDE * SIDE * SHADOW_RAYS
        report(
            {
                "question": "trace",
                "asset": name,
                "triangles": scene.triangle_count,
                "hit_share": round(share, 3),
                "primary_mrays_per_s": round(SIDE * SIDE / primary / 1e6, 2),
                "shadow_mrays_per_s": round(shadow_count / (both - primary) / 1e6, 2),
                **context(scene.device, renderer.threads),
            },
            options.json,
        )


if __name__ == "__main__":
    main()
