"""The G-buffer: what the camera sees of the object, averaged over each pixel.

Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.maths.rng import pixel_seed, sobol_pair
from warpir.kernels.tracing.ray import camera_hit, camera_ray
from warpir.kernels.tracing.surface import surface_at
from warpir.kernels.types import CameraArgs, MaterialArgs, MeshArgs, ReceiverArgs, TextureArgs

wp.set_module_options({"enable_backward": False})


@wp.kernel
def trace_gbuffer(
    pixels: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    spp: int,
    seed: int,
    coverage: wp.array[float],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    base_color: wp.array[wp.vec3],
    roughness: wp.array[float],
    emission: wp.array[wp.vec3],
):
    """Average what the camera sees of the object in each listed pixel.

    ``coverage`` is the share of samples that see the object; the others are means over those.
    """
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    count = float(0.0)
    p = wp.vec3(0.0)
    n = wp.vec3(0.0)
    color = wp.vec3(0.0)
    rough = float(0.0)
    emitted = wp.vec3(0.0)
    for s in range(spp):
        ray_dir = camera_ray(camera, pixel, sobol_pair(s, key, 0))
        hit = camera_hit(camera, mesh, material, texture, receiver, s, key, ray_dir)
        if hit.valid == 1:
            surface = surface_at(mesh, material, texture, hit, -ray_dir)
            count += 1.0
            p += surface.position
            n += surface.n
            color += surface.base_color
            rough += surface.roughness
            emitted += surface.emission
    if count > 0.0:
        coverage[i] = count / float(spp)
        position[i] = p / count
        normal[i] = wp.normalize(n)
        base_color[i] = color / count
        roughness[i] = rough / count
        emission[i] = emitted / count
