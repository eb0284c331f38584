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
from warpir.render.launches import ObjectLaunch, directions_of_path
from warpir.render.mis.samples import new_light_record
from warpir.render.renderer import Renderer
from warpir.render.transport.rows import (
    CHUNK_BYTES,
    LOWER_OBJECT,
    ObjectRows,
    TransportSettings,
    chunks,
    recorded_light,
    spread_rows,
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
    scene, device, height = renderer.scene, renderer.device, len(expected)
    light = recorded_light(renderer, expected, seed)
    spp = settings.mirror_factor * settings.subsamples
    rays = max(1, settings.mirror_factor * settings.paths // spp)
    launch = ObjectLaunch(light, scene.material_args, scene.camera_args, rays, depth, 0.0, seed)
    capacity = spp * rays * directions_of_path(scene, depth)
    size = max(1, CHUNK_BYTES // (24 * capacity + 24 * height * height))

    def trace(start: int, stop: int) -> ObjectRows:
        rows = np.arange(start, stop, dtype=np.int32)
        record = new_light_record(len(rows), capacity, device)
        constant, *_, coverage = launch.sums(renderer, pixels[rows], spp, 1, record)
        T = spread_rows(renderer, record, height)
        emission = renderer.upload(constant, wp.vec3)
        count = renderer.upload(np.round(coverage * spp).astype(np.int32), wp.int32)
        return ObjectRows(rows, T, emission, count, spp)

    yield from chunks(renderer, trace, len(pixels), size, LOWER_OBJECT)
