"""Light of the lamps on the white receiver, with and without the object.

It is added to both halves of the shadow ratio (`warpir.kernels.receiver`). Directions are drawn
from the lamps alone: the cosine is bounded, so no draw counts for much more than the mean. Both
halves share them, so the ratio is exactly 1 where nothing is blocked. Detached.
"""

import warp as wp

from warpir.kernels.bsdf import INV_PI
from warpir.kernels.lamps.gather import LAMP_KEY, free_distance
from warpir.kernels.lamps.solid_angle import lamps_sample, pick_total
from warpir.kernels.maths.rng import hash_pair, pixel_seed, sobol_pair
from warpir.kernels.receiver import receiver_origin, receiver_point
from warpir.kernels.tracing.ray import visibility_within
from warpir.kernels.types import (
    CameraArgs,
    LampArgs,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def trace_lamps(
    pixels: wp.array[int],
    may_see_object: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    lamps: LampArgs,
    spp: int,
    rays: int,
    seed: int,
    lit: wp.array[wp.vec3],
    unoccluded: wp.array[wp.vec3],
):
    """Sum the radiance of the receiver in white by the lamps, with and without the object.

    Args:
        pixels: Row-major pixel indices, shape [receiver_pixel].
        may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
        camera: The view.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver: plane and mesh, which shades both halves.
        lamps: The lamps.
        spp: Camera samples per pixel, those of `trace_receiver`.
        rays: Directions that share one camera sample.
        seed: Base seed.
        lit: Mean radiance with the object over the samples that see the receiver; where a mesh ends
            within a pixel, what is open there loses nothing.
        unoccluded: The same without the object.
    """
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    own_key = hash_pair(key, LAMP_KEY)
    sum_lit = wp.vec3(0.0)
    sum_all = wp.vec3(0.0)
    count = float(0.0)
    open_count = float(0.0)
    for s in range(spp):
        point = receiver_point(
            camera, mesh, material, texture, receiver, pixel, may_see_object[i], s, key
        )
        open_count += float(point.is_open)
        if point.valid == 1:
            count += 1.0
            origin = receiver_origin(mesh, receiver, point)
            total = pick_total(lamps, point.position)
            for r in range(rays):
                index = s * rays + r
                u_pick = sobol_pair(index, own_key, 0)
                drawn = lamps_sample(
                    lamps, point.position, total, sobol_pair(index, own_key, 1), u_pick[0]
                )
                cos_i = wp.dot(drawn.wi, point.normal)
                if drawn.valid == 1 and cos_i > 0.0:
                    if free_distance(receiver, origin, drawn.wi) >= drawn.distance:
                        gained = drawn.radiance * (cos_i * INV_PI / drawn.pdf)
                        sum_all += gained
                        sum_lit += gained * visibility_within(
                            mesh, material, texture, origin, drawn.wi, drawn.distance
                        )
    scale = 1.0 / wp.max(count * float(rays), 1.0)
    if open_count > 0.0:
        sum_lit += (sum_all - sum_lit) * (open_count / (count + open_count))
    lit[i] = sum_lit * scale
    unoccluded[i] = sum_all * scale
