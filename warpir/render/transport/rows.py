"""Trace the rows of light transport, chunk by chunk: launches `warpir.kernels.transport`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import warp as wp

from warpir.core.arrays import FloatArray, IntArray
from warpir.core.color import luminance
from warpir.core.latlong import texel_solid_angles
from warpir.kernels.transport.foreground import (
    SurfacePoints,
    spread_record,
    trace_direct,
    trace_paths,
    trace_points,
)
from warpir.kernels.transport.receiver import (
    trace_blocked,
    trace_bounced,
    trace_received,
    trace_receiver_points,
)
from warpir.kernels.transport.texels import TexelArgs
from warpir.kernels.types import Layers, LightArgs, LightRecord
from warpir.render.device import Rows
from warpir.render.device_light import FINE_FROM, drawn, light_args
from warpir.render.launches import uploaded
from warpir.render.renderer import Renderer
from warpir.render.transport.tents import direction_counts, texel_args
from warpir.scene.light import Light

Traced = TypeVar("Traced")

CHUNK_BYTES = 64 << 20
"""Memory of the rows that are traced at once, before they are stored in a small type."""
TRACING = "tracing light transport"
LOWER_OBJECT = "--object-light-height or --guidance-width"
LOWER_SHADOW = "--light-height or --guidance-width"
"""Flags that lower the memory of tracing."""

DTYPES = ("bfloat16", "float32")
"""Torch's types in which the object's rows may be stored."""
PILOT_SUBSAMPLES = 8
PILOT_SEED = 0x2F6E2B1
"""Seed of the samples that classify mirrors."""


@dataclass(frozen=True)
class ObjectRows:
    """Traced rows of ``T_fg``."""

    rows: IntArray
    """Indices of the rows, shape [row]."""
    T: wp.array
    """Pixel radiance per texel radiance [1], vec3, shape [row, texel]."""
    emission: wp.array
    """Radiance that does not depend on the light, vec3, shape [row]."""
    count: wp.array
    """Subsamples that met the object, shape [row]."""
    subsamples: int
    """Number of subsamples."""


@dataclass(frozen=True)
class TransportSettings:
    """Resolution and storage of traced light transport.

    Raises:
        ValueError: ``dtype`` is not one of `DTYPES`.
    """

    height_fg: int = 32
    """Rows of the map that lights the object; the map is twice as wide."""
    height_shadow: int = 32
    """Rows of the map that casts the shadow."""
    subsamples: int = 32
    """Number of positions within each pixel."""
    paths: int = 64
    """Paths per pixel, for narrow specular lobes and for all light of two or more interactions."""
    mirror_factor: int = 16
    """Factor on `subsamples` and `paths` for mirroring pixels, whose reflection changes with every
    normal in the pixel."""
    bright_directions: int = 1024
    """Directions per pixel and map that are allocated by the expected light, on top of one per
    texel."""
    dtype: str = "bfloat16"
    """Type in which the object's rows are stored, of `DTYPES`."""
    memory_mib: int = 1024
    """Memory limit of the stored rows [MiB]."""

    def __post_init__(self) -> None:
        if self.dtype not in DTYPES:
            raise ValueError(f"dtype: expected {' or '.join(DTYPES)} (found {self.dtype!r})")


@dataclass(frozen=True)
class _ObjectTrace:
    """Arguments of tracing the object's rows that all rows share."""

    renderer: Renderer
    texels: TexelArgs
    proposal: LightArgs
    """Proposal of light directions at later vertices."""
    depth: int
    seed: int
    direction_count: int
    """Number of directions of all texels."""

    def rows(
        self, pixels: IntArray, group: IntArray, subsamples: int, paths: int, start: int, stop: int
    ) -> ObjectRows:
        """Trace rows ``start`` to ``stop`` of a group, by one interaction and by more."""
        rows = group[start:stop]
        pixels = pixels[rows]
        renderer, texels, seed = self.renderer, self.texels, self.seed
        geometry = renderer.scene.geometry()
        points, emission = _surface_points(renderer, pixels, subsamples, seed)
        texel_count = texels.height * texels.width
        T = wp.zeros((len(pixels), texel_count), dtype=wp.vec3, device=renderer.device)
        launched = Rows(uploaded(renderer, pixels, renderer.scene.camera_args))
        renderer.launch(
            trace_direct,
            len(pixels),
            [launched, Rows(points), *geometry, texels, subsamples, paths, seed, Rows(T)],
            self.direction_count,
            "transport",
            texels.lanes,
        )
        # Threads of a pixel add to one row: in one order if one runs at a time, as on the CPU.
        step = 1 if renderer.is_ordered and renderer.device.is_cuda else max(paths, 1)
        for first in range(0, paths, step):
            counts = (subsamples, first, paths, self.depth, seed)
            outputs = (Rows(T), Rows(emission))
            renderer.launch(
                trace_paths,
                len(pixels),
                [launched, Rows(points), *geometry, texels, self.proposal, *counts, *outputs],
                step * self.depth,
                "transport",
                step,
            )
        return ObjectRows(rows, T, emission, points.count, subsamples)


def object_rows(
    renderer: Renderer,
    pixels: IntArray,
    depth: int,
    settings: TransportSettings,
    expected: FloatArray,
    seed: int,
) -> Iterator[ObjectRows]:
    """Trace the object's rows chunk by chunk, pixels that mirror with more samples than others."""
    height = settings.height_fg
    counts = direction_counts(expected, settings.bright_directions)
    every = np.arange(2 * height * height, dtype=np.int32)
    texels = texel_args(counts, height, renderer, every)
    light = light_args(proposal_of(expected), renderer.device)
    proposal = drawn(renderer, light, seed, FINE_FROM)
    trace = _ObjectTrace(renderer, texels, proposal, depth, seed, int(counts.sum()))
    for group, factor in _groups(renderer, pixels, settings, seed):
        subsamples, paths = factor * settings.subsamples, factor * settings.paths
        part = partial(trace.rows, pixels, group, subsamples, paths)
        yield from renderer.memory.in_chunks(part, len(group), TRACING, LOWER_OBJECT)


def proposal_of(expected: FloatArray) -> Light:
    """Return the light of later vertices: half of their directions look everywhere."""
    height = len(expected)
    flux = luminance(expected.astype(np.float64))
    mean = float((flux * texel_solid_angles(height, 2 * height)[:, None]).sum()) / (4.0 * np.pi)
    flat = 0.5 + 0.5 * flux / mean if mean > 0.0 else np.ones_like(flux)
    return Light(texels=np.repeat(flat[..., None], 3, axis=2).astype(np.float32))


def recorded_light(renderer: Renderer, expected: FloatArray, seed: int) -> LightArgs:
    """Return black light whose directions are those of later vertices, for paths that record them.

    What such paths still see does not depend on the light.
    """
    light = light_args(proposal_of(expected), renderer.device)
    light.texels = wp.zeros(expected.shape[:2], dtype=wp.vec3, device=renderer.device)
    return drawn(renderer, light, seed, FINE_FROM)


def spread_rows(renderer: Renderer, record: LightRecord, height: int) -> wp.array:
    """Return the rows of a map that recorded directions are, vec3, shape [row, texel]."""
    count, capacity = record.wi.shape
    T = wp.zeros((count, 2 * height * height), dtype=wp.vec3, device=renderer.device)
    rows = [Rows(record), height, 2 * height, Rows(T)]
    renderer.launch(spread_record, count, rows, capacity, "transport")
    return T


def _groups(
    renderer: Renderer, pixels: IntArray, settings: TransportSettings, seed: int
) -> Iterator[tuple[IntArray, int]]:
    """Yield chunks of rows, and by how much the counts of each are to be multiplied.

    A pixel counts as mirroring when any of a few samples, which are not used again, meets a lobe
    narrower than half a texel: what it shows is decided by normals, not by directions. Lobes up to
    two texels wide take the square root of that factor.
    """
    texel = np.pi / settings.height_fg
    middle = round(settings.mirror_factor**0.5)
    factors = np.ones(len(pixels), np.int32)
    size = max(1, CHUNK_BYTES // (24 * settings.height_fg**2))
    for start in range(0, len(pixels), size):
        points, _ = _surface_points(
            renderer, pixels[start : start + size], PILOT_SUBSAMPLES, seed ^ PILOT_SEED
        )
        filled = np.arange(PILOT_SUBSAMPLES)[None] < points.count.numpy()[:, None]
        alpha = np.where(filled, points.roughness.numpy() ** 2, 1.0).min(axis=1)
        found = np.where(alpha < 0.5 * texel, settings.mirror_factor, middle)
        factors[start : start + size] = np.where(alpha < 2.0 * texel, found, 1)
    for factor in np.unique(factors):
        rows = np.flatnonzero(factors == factor).astype(np.int32)
        for start in range(0, len(rows), size):
            yield rows[start : start + size], int(factor)


def _surface_points(
    renderer: Renderer, pixels: IntArray, subsamples: int, seed: int
) -> tuple[SurfacePoints, wp.array]:
    """Trace the surface points of each pixel and its mean emitted radiance."""
    scene, device, count = renderer.scene, renderer.device, len(pixels)
    points = SurfacePoints()
    points.count = wp.zeros(count, dtype=int, device=device)
    for name in ("position", "ng", "n", "wo", "base_color"):
        setattr(points, name, wp.empty((count, subsamples), dtype=wp.vec3, device=device))
    for name in ("metallic", "roughness"):
        setattr(points, name, wp.zeros((count, subsamples), dtype=float, device=device))
    columns = subsamples * (scene.material_args.any_layers > 0)
    points.layers = wp.empty((count, columns), dtype=Layers, device=device)
    emission = wp.zeros(count, dtype=wp.vec3, device=device)
    renderer.launch(
        trace_points,
        count,
        [
            Rows(uploaded(renderer, pixels, scene.camera_args)),
            scene.camera_args,
            *scene.geometry(),
            subsamples,
            seed,
            Rows(points),
            Rows(emission),
        ],
        subsamples,
        "transport",
    )
    return points, emission


@dataclass(frozen=True)
class _ReceiverPoints:
    """Points of the receiver under each pixel's subsamples."""

    pixels: Rows
    count: Rows
    """Number of points, shape [pixel]."""
    position: Rows
    """Positions, recentred [m], shape [pixel, subsample]."""
    normal: Rows
    """Unit normals, shape [pixel, subsample]."""
    spread: Rows
    """Largest distance of a pixel's points from its first one [m], shape [pixel]."""
    share: Rows
    """Share of the pixel's unhidden part that shows the receiver [1], shape [pixel]."""


def _receiver_points(
    renderer: Renderer, pixels: IntArray, may_see_object: IntArray, subsamples: int, seed: int
) -> _ReceiverPoints:
    scene, device, count = renderer.scene, renderer.device, len(pixels)
    points = _ReceiverPoints(
        Rows(uploaded(renderer, pixels, scene.camera_args)),
        Rows(wp.zeros(count, dtype=int, device=device)),
        Rows(wp.empty((count, subsamples), dtype=wp.vec3, device=device)),
        Rows(wp.empty((count, subsamples), dtype=wp.vec3, device=device)),
        *(Rows(wp.zeros(count, dtype=float, device=device)) for _ in range(2)),
    )
    renderer.launch(
        trace_receiver_points,
        count,
        [
            points.pixels,
            Rows(wp.array(may_see_object, dtype=int, device=device)),
            scene.camera_args,
            *scene.shadow_geometry(),
            subsamples,
            seed,
            points.count,
            points.position,
            points.normal,
            points.spread,
            points.share,
        ],
        subsamples,
        "transport",
    )
    return points


def plane_rows(
    renderer: Renderer,
    pixels: IntArray,
    may_see_object: IntArray,
    columns: IntArray,
    settings: TransportSettings,
    expected: FloatArray,
    seed: int,
) -> Iterator[wp.array]:
    """Trace the plane's rows chunk by chunk.

    Yields:
        Share of each texel's irradiance that the object blocks [1], shape [row, column].
    """
    scene, device, height = renderer.scene, renderer.device, settings.height_shadow
    counts = direction_counts(expected, settings.bright_directions)
    texels = texel_args(counts, height, renderer, columns, scene.receiver.normal)
    size = max(1, CHUNK_BYTES // (4 * len(columns)))
    if scene.triangle_count == 0:
        return
    geometry = scene.shadow_geometry()
    wp_columns = wp.array(columns, dtype=int, device=device)

    def trace(first: int, last: int) -> wp.array:
        chunk = slice(first, last)
        points = _receiver_points(
            renderer, pixels[chunk], may_see_object[chunk], settings.subsamples, seed
        )
        blocked = wp.zeros((last - first, len(columns)), dtype=float, device=device)
        renderer.launch(
            trace_blocked,
            last - first,
            [
                points.pixels,
                points.count,
                points.position,
                points.spread,
                *geometry,
                texels,
                wp_columns,
                seed,
                Rows(blocked),
            ],
            len(columns) // 4,
            "transport",
            texels.lanes,
        )
        return blocked

    yield from chunks(renderer, trace, len(pixels), size)


def chunks(
    renderer: Renderer,
    trace: Callable[[int, int], Traced],
    count: int,
    size: int,
    lower: str = LOWER_SHADOW,
) -> Iterator[Traced]:
    """Yield ``trace`` of each ``size`` pixels, in halves where memory is short."""
    for start in range(0, count, size):

        def part(first: int, last: int, start: int = start) -> Traced:
            return trace(start + first, start + last)

        length = min(size, count - start)
        yield from renderer.memory.in_chunks(part, length, TRACING, lower)


@dataclass(frozen=True)
class MeshRows:
    """Traced rows of a receiver with a mesh; blocked light is a part of the received light."""

    received: wp.array
    """Radiance of the white receiver without the object per texel radiance [1], shape [row,
    texel]."""
    blocked: wp.array
    """Part of `received` that the object blocks, shape [row, texel]."""
    bounced: wp.array
    """Radiance of the white receiver that the mesh sends it, vec3, shape [row]."""
    bounced_blocked: wp.array
    """Part of `bounced` that the object blocks, vec3, shape [row]."""


def mesh_rows(
    renderer: Renderer,
    pixels: IntArray,
    may_see_object: IntArray,
    settings: TransportSettings,
    expected: FloatArray,
    seed: int,
) -> Iterator[MeshRows]:
    """Trace the rows of a receiver with a mesh chunk by chunk: nothing is known beforehand."""
    scene, device, height = renderer.scene, renderer.device, settings.height_shadow
    texel_count = 2 * height * height
    counts = direction_counts(expected, settings.bright_directions)
    texels = texel_args(counts, height, renderer, np.arange(texel_count, dtype=np.int32))
    size = max(1, CHUNK_BYTES // (8 * texel_count))
    geometry = scene.shadow_geometry()

    def trace(first: int, last: int) -> MeshRows:
        chunk, count = slice(first, last), last - first
        points = _receiver_points(
            renderer, pixels[chunk], may_see_object[chunk], settings.subsamples, seed
        )
        seen = (
            points.pixels,
            points.count,
            points.position,
            points.normal,
            points.share,
            *geometry,
        )
        received, blocked = (
            wp.zeros((count, texel_count), dtype=float, device=device) for _ in range(2)
        )
        renderer.launch(
            trace_received,
            count,
            [*seen, texels, seed, Rows(received), Rows(blocked)],
            int(counts.sum()),
            "transport",
            texels.lanes,
        )
        bounced, kept = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
        renderer.launch(
            trace_bounced,
            count,
            [*seen, settings.paths, seed, Rows(bounced), Rows(kept)],
            settings.paths,
            "transport",
        )
        return MeshRows(received, blocked, bounced, kept)

    yield from chunks(renderer, trace, len(pixels), size)
