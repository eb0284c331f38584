"""Rows of an object with solid glass, out of recorded directions.

Refracted light meets single texels: no direction can be drawn for each of them beforehand. So the
paths of `mis` record where they saw the light, with weights that do not depend on it, as for the
light that an object throws (`warpir.render.transport.thrown`). What they see of the photo through
the glass is a constant to the light, as emission is.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import warp as wp

from warpir.core.arrays import FloatArray, IntArray
from warpir.kernels.transport.foreground import spread_record
from warpir.render.device import Rows
from warpir.render.device_light import FINE_FROM, drawn, light_args
from warpir.render.launches import ObjectLaunch, directions_of_path
from warpir.render.mis.samples import new_light_record
from warpir.render.renderer import Renderer
from warpir.render.transport.rows import (
    CHUNK_BYTES,
    LOWER_OBJECT,
    TRACING,
    ObjectRows,
    TransportSettings,
    proposal_of,
)


def glass_rows(
    renderer: Renderer,
    pixels: IntArray,
    depth: int,
    settings: TransportSettings,
    expected: FloatArray,
    seed: int,
) -> Iterator[ObjectRows]:
    """Trace the object's rows chunk by chunk, each pixel as often as one that mirrors.

    Arguments are those of `warpir.render.transport.rows.object_rows`.
    """
    scene, device = renderer.scene, renderer.device
    height, width = expected.shape[:2]
    light = light_args(proposal_of(expected), device)
    # Directions alone are asked for; what is left does not depend on the light.
    light.texels = wp.zeros((height, width), dtype=wp.vec3, device=device)
    light = drawn(renderer, light, seed, FINE_FROM)
    spp = settings.mirror_factor * settings.subsamples
    rays = max(1, settings.mirror_factor * settings.paths // spp)
    launch = ObjectLaunch(light, scene.material_args, scene.camera_args, rays, depth, 0.0, seed)
    capacity = spp * rays * directions_of_path(scene, depth)
    size = max(1, CHUNK_BYTES // (24 * capacity + 12 * height * width))
    for start in range(0, len(pixels), size):

        def part(first: int, last: int, start: int = start) -> ObjectRows:
            rows = np.arange(start + first, start + last, dtype=np.int32)
            record = new_light_record(len(rows), capacity, device)
            constant, *_, coverage = launch.sums(renderer, pixels[rows], spp, 1, record)
            T = wp.zeros((len(rows), height * width), dtype=wp.vec3, device=device)
            arrays = [Rows(record), height, width, Rows(T)]
            renderer.launch(spread_record, len(rows), arrays, capacity, "transport")
            count = np.round(coverage * spp).astype(np.int32)
            emission = wp.array(constant, dtype=wp.vec3, device=device)
            return ObjectRows(
                rows, T, emission, wp.array(count, dtype=wp.int32, device=device), spp
            )

        length = min(size, len(pixels) - start)
        yield from renderer.memory.in_chunks(part, length, TRACING, LOWER_OBJECT)
