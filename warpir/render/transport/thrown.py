"""Rows of the light that the object throws onto the receiver, out of recorded directions.

`mis` records, per pixel, the directions that its paths saw the light in, with weights that do not
depend on the light (`warpir.kernels.light_gradient`): spread over the texels they are a row of
transport. Directions follow the expected light as later vertices of the object's rows do.
"""

from __future__ import annotations

from collections.abc import Iterator

import warp as wp

from warpir.core.arrays import FloatArray, IntArray
from warpir.render.launches import ObjectLaunch
from warpir.render.mis.samples import new_light_record
from warpir.render.renderer import Renderer
from warpir.render.transport.rows import (
    CHUNK_BYTES,
    TransportSettings,
    chunks,
    recorded_light,
    spread_rows,
)


def thrown_rows(
    renderer: Renderer,
    pixels: IntArray,
    may_see_object: IntArray,
    settings: TransportSettings,
    expected: FloatArray,
    seed: int,
) -> Iterator[tuple[wp.array, FloatArray]]:
    """Trace the rows chunk by chunk.

    Args:
        renderer: The scene; its ``bounce_depth`` is that of the paths.
        pixels: Row-major pixel indices, shape [receiver_pixel].
        may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
        settings: Samples; the map is as high as the object's.
        expected: Likely radiance of the map, shape [He, 2 He, 3].
        seed: Base seed.

    Yields:
        Radiance of the white receiver per texel radiance [1], vec3, shape [row, texel], and that
        which does not depend on the light, shape [row, 3].
    """
    scene, depth, height = renderer.scene, renderer.bounce_depth, len(expected)
    light = recorded_light(renderer, expected, seed)
    spp = min(settings.subsamples, settings.paths)
    rays = settings.paths // spp
    launch = ObjectLaunch(
        light, scene.shadow_material_args, scene.camera_args, rays, depth, 0.0, seed
    )
    capacity = 2 * spp * rays * depth
    size = max(1, CHUNK_BYTES // (24 * capacity + 24 * height * height))

    def trace(start: int, stop: int) -> tuple[wp.array, FloatArray]:
        record = new_light_record(stop - start, capacity, renderer.device)
        emitted = launch.thrown(
            renderer, pixels[start:stop], may_see_object[start:stop], spp, 1, record
        )
        return spread_rows(renderer, record, height), emitted

    yield from chunks(renderer, trace, len(pixels), size)
