"""Samples of `mis`, drawn once for an image and its gradient. Pure Warp, no torch.

While the kernels trace, they write down what the gradient needs. Radiance is linear in the light,
so the light's gradient is a sum over the recorded directions; the materials' goes through the
attached kernel over the recorded vertices. Both run on the renderer's threads; private sums are
added up in a fixed order, so threads do not change a bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpir.core.arrays import Float64Array, FloatArray
from warpir.kernels import light_gradient as light_kernels
from warpir.kernels import shade as shade_kernels
from warpir.kernels.types import (
    Layers,
    LightArgs,
    LightRecord,
    VertexRecord,
)
from warpir.render.allocation import Sharing, as_it_is
from warpir.render.device import SAMPLES_PER_SLICE, Rows
from warpir.render.launches import directions_of_path
from warpir.render.renderer import ReceiverRadiance, Renderer
from warpir.render.upload.materials import FACTORS

if TYPE_CHECKING:
    from warpir.render.mis.integrator import MisIntegrator

Gradients = list[Float64Array | None]
"""Gradients of the map, then of base colour, metallic, roughness and emission; None for those not
asked for."""

RECORD_BYTES = 1 << 30
"""Memory limit of an image's records; beyond it, samples are drawn again in parts.
Unused records cost no physical memory: four fifths of a convex object's at five interactions."""
ENTRY_BYTES = 24
VERTEX_BYTES = 112
LAYERS_BYTES = 96
PART_PATHS = 4096
"""Least paths of a part: a path costs about 1 us, the launches of a part about 1 ms."""
RECORDING, LOWER = "the samples of mis", "--mis-samples or --guidance-width"
"""Subject of a memory error, and the flag that lowers its need."""
PART_COUNT = 16
"""Private sums of texels and materials; fixed, so that their order does not depend on threads."""


class ObjectSamples:
    """Samples of the object at one light, one set of materials and one seed.

    Args:
        mis: The integrator.
        args: The light that samples are drawn from, and whose radiance they carry.
        seed: Base seed.
        factors: Base colour, metallic, roughness and emission; the scene's own where None.
        free: Whether each of `Gradients` will be asked for.
    """

    def __init__(
        self,
        mis: MisIntegrator,
        args: LightArgs,
        seed: int,
        factors: Sequence[FloatArray | None],
        free: Sequence[bool],
    ) -> None:
        self.mis, self.args, self.seed, self.free = mis, args, seed, free
        self.materials = mis.renderer.scene.materials_with(factors)
        self.factors = [getattr(self.materials, name) for name, _ in FACTORS]
        self.path_count = mis.spp * mis.rays
        scene = mis.renderer.scene
        assert not (scene.has_solid_glass and any(free[1:])), "glass has no gradient to materials"
        self.entries = directions_of_path(scene, mis.depth) * self.path_count * free[0]
        self.vertices = self.path_count * (mis.depth + 1) * any(free[1:])
        self.has_layers = self.materials.any_layers > 0
        vertex_bytes = VERTEX_BYTES + LAYERS_BYTES * self.has_layers
        row_bytes = ENTRY_BYTES * self.entries + vertex_bytes * self.vertices
        self.parts = _parts(len(mis.object_pixels), row_bytes)
        self.kept: tuple[LightRecord | None, VertexRecord | None] | None = None

    def render(self) -> FloatArray:
        """Trace the object's radiance [object_pixel, 3]; keep the records if they fit."""

        def drawn() -> FloatArray:
            if len(self.parts) > 1:
                return self.draw(slice(None), is_recording=False)[0]
            whole, self.parts = self.parts[0], _halves(len(self.mis.object_pixels))
            radiance, light, vertex = self.draw(whole)
            # It did fit; where it does not, the next attempt keeps no record of the whole.
            self.parts, self.kept = [whole], (light, vertex)
            return radiance

        return self.mis.renderer.memory.again(drawn, RECORDING, LOWER)

    def draw(
        self, rows: slice, is_recording: bool = True
    ) -> tuple[FloatArray, LightRecord | None, VertexRecord | None]:
        """Trace some of the object's pixels: radiance [pixel, 3] and the records asked for."""
        mis, device = self.mis, self.mis.renderer.device
        pixels = mis.object_pixels[rows]
        lanes = mis.renderer.lanes(len(pixels), mis.spp)
        light, vertex = None, None
        if is_recording and self.entries:
            light = new_light_record(len(pixels) * lanes, self.entries // lanes, device)
        if is_recording and self.vertices:
            vertex = _new_vertex_record(
                len(pixels) * lanes, self.vertices // lanes, self.has_layers, device
            )
        out = mis.renderer.foreground(
            self.args,
            pixels,
            mis.spp,
            mis.rays,
            mis.depth,
            self.seed,
            light_record=light,
            vertex_record=vertex,
            materials=self.materials,
            is_recorded=any(self.free),
            sharing=None if any(self.free) else Sharing(as_it_is),
        )
        return out.radiance, light, vertex

    def gradient(self, d_radiance: FloatArray) -> Gradients:
        """Return the loss gradient of light and materials from that of `render`."""
        total: Gradients = [None] * 5
        for rows in self.parts:
            light, vertex = self.kept or self.draw(rows)[1:]
            # Records serve one backward pass, so that two steps' never live side by side.
            self.kept = None
            if light is not None:
                d_pixel = _per_channel(d_radiance[rows])
                part = map_gradient(self.mis.renderer, self.args, light, d_pixel)
                total[:1] = _add(total[:1], [part])
            if vertex is not None:
                lanes = self.mis.renderer.lanes(len(d_radiance[rows]), self.mis.spp)
                d_rows = np.repeat(d_radiance[rows], lanes, axis=0)
                total[1:] = _add(
                    total[1:], self.material_gradient(vertex, d_rows, self.path_count // lanes)
                )
        return total

    def material_gradient(
        self, record: VertexRecord, d_radiance: FloatArray, count: int
    ) -> Gradients:
        """Return the gradient of the four factors over rows of ``count`` paths each."""
        renderer, device = self.mis.renderer, self.mis.renderer.device
        pixels = len(d_radiance)
        # On the CPU each part has a sum of its own and is gone through in short launches.
        parts = max(1, min(PART_COUNT, pixels * count // PART_PATHS)) if device.is_cpu else 1
        size = max(1, SAMPLES_PER_SLICE // count) if device.is_cpu else pixels
        d_path = wp.array(
            np.repeat(d_radiance / self.path_count, count, axis=0), dtype=wp.vec3, device=device
        )
        d_factors = [
            wp.zeros((parts, len(a)), dtype=a.dtype, device=device) if is_free else None
            for a, is_free in zip(self.factors, self.free[1:], strict=True)
        ]

        def one(part: int) -> None:
            own = [None if d is None else d[part] for d in d_factors]
            stop = pixels * (part + 1) // parts
            for start in range(pixels * part // parts, stop, size):
                end = min(start + size, stop)
                vertices = Rows(record).cut(start, end)
                self.differentiate(vertices, d_path[start * count : end * count], count, own)

        wp.load_module(shade_kernels, device=device)
        renderer.in_threads(one, range(parts if pixels else 0), "materials")
        return [None if d is None else d.numpy().sum(axis=0, dtype=np.float64) for d in d_factors]

    def differentiate(
        self,
        record: VertexRecord,
        d_path: wp.array,
        count: int,
        d_factors: Sequence[wp.array | None],
    ) -> None:
        """Add the gradient of some paths to ``d_factors``: vertices forward, adjoints backward.

        Launched by hand, since a ``wp.Tape`` belongs to one thread.

        Args:
            record: Vertices, rows are pixels.
            d_path: Loss gradient of each path's radiance, shape [path].
            count: Paths of a row.
            d_factors: Accumulated gradients, shape [material] each, or None.
        """
        device, paths, depth = d_path.device, len(d_path), self.mis.depth
        throughput = [wp.full(paths, wp.vec3(1.0), dtype=wp.vec3, device=device)]
        throughput += [wp.empty(paths, dtype=wp.vec3, device=device) for _ in range(depth + 1)]
        unused = wp.empty(paths, dtype=wp.vec3, device=device)
        d_next = wp.zeros(paths, dtype=wp.vec3, device=device)

        def launch(k: int, **adjoint: object) -> None:
            wp.launch(
                shade_kernels.shade_vertex,
                dim=paths,
                inputs=[record, count, k, *self.factors, throughput[k]],
                outputs=[unused, throughput[k + 1]],
                device=device,
                record_tape=False,
                **adjoint,
            )

        for k in range(depth):
            launch(k)
        for k in range(depth, -1, -1):
            d_throughput = wp.zeros(paths, dtype=wp.vec3, device=device)
            launch(
                k,
                adjoint=True,
                adj_inputs=[VertexRecord(), 0, 0, *d_factors, d_throughput],
                adj_outputs=[d_path, d_next],
            )
            d_next = d_throughput


class ReceiverSamples:
    """Samples of the receiver, with the methods of `ObjectSamples`."""

    def __init__(
        self, mis: MisIntegrator, args: LightArgs, seed: int, free: Sequence[bool]
    ) -> None:
        self.mis, self.args, self.seed, self.free = mis, args, seed, free
        self.entries = 2 * mis.spp * mis.rays * free[0]
        self.thrown_entries = self.entries * mis.renderer.bounce_depth
        row_bytes = ENTRY_BYTES * (self.entries + self.thrown_entries)
        self.parts = _parts(len(mis.receiver_pixels), row_bytes)
        self.kept: tuple[LightRecord | None, ...] = ()

    def render(self) -> ReceiverRadiance:
        """Trace the receiver with and without the object; keep the records if they fit."""

        def drawn() -> ReceiverRadiance:
            if len(self.parts) > 1:
                return self.draw(slice(None), is_recording=False)[0]
            whole, self.parts = self.parts[0], _halves(len(self.mis.receiver_pixels))
            radiance, *kept = self.draw(whole)
            self.parts, self.kept = [whole], tuple(kept)
            return radiance

        return self.mis.renderer.memory.again(drawn, RECORDING, LOWER)

    def draw(
        self, rows: slice, is_recording: bool = True
    ) -> tuple[ReceiverRadiance, LightRecord | None, LightRecord | None]:
        """Trace some of the receiver's pixels, with the records that are asked for.

        They are of its light from the sky, and of what the object throws there.
        """
        mis = self.mis
        pixels = mis.receiver_pixels[rows]
        lanes, device = mis.renderer.lanes(len(pixels), mis.spp), mis.renderer.device
        count = len(pixels) * lanes
        record, thrown = (
            new_light_record(count, n // lanes, device) if is_recording and n else None
            for n in (self.entries, self.thrown_entries)
        )
        out = mis.renderer.receiver(
            self.args,
            pixels,
            mis.may_see_object[rows],
            mis.spp,
            mis.rays,
            self.seed,
            record=record,
            thrown_record=thrown,
            is_recorded=self.free[0],
            sharing=None if self.free[0] else Sharing(as_it_is),
        )
        return out, record, thrown

    def gradient(self, d_lit: FloatArray, d_unoccluded: FloatArray) -> Gradients:
        """Return the loss gradient of the light from those of `render`."""
        total: Gradients = [None]
        for rows in self.parts:
            record, thrown = self.kept or self.draw(rows)[1:]
            self.kept = ()
            assert record is not None, "no gradient was announced"
            d_pixel = np.zeros((len(d_lit[rows]), 3, 3), np.float32)
            d_pixel[:, :, 0], d_pixel[:, :, 1] = d_lit[rows], d_unoccluded[rows]
            part = map_gradient(self.mis.renderer, self.args, record, d_pixel)
            total = _add(total, [part])
            if thrown is not None:
                d_thrown = _per_channel(d_lit[rows])
                total = _add(total, [map_gradient(self.mis.renderer, self.args, thrown, d_thrown)])
        return total


def map_gradient(
    renderer: Renderer, args: LightArgs, record: LightRecord, d_pixel: FloatArray
) -> Float64Array:
    """Return the loss gradient of a light's map over recorded directions, shape [He, We, 3].

    Args:
        renderer: Renderer, whose device and threads are used.
        args: The light.
        record: Directions and weights, rows are pixels or lanes of them.
        d_pixel: Times a weight it is the loss gradient of the radiance from there, shape
            [pixel, 3, 3].
    """
    device = renderer.device
    rows, capacity = record.wi.shape
    lanes = max(rows // max(len(d_pixel), 1), 1)
    d_array = Rows(wp.array(d_pixel, dtype=wp.mat33, device=device))
    height, width = args.map_height, args.map_width
    # A copy of the map pays where more is added into it than there is to add up of it.
    copies = max(1, min(PART_COUNT, rows * capacity // (height * width)))
    texels = wp.zeros((copies, height, width), dtype=wp.vec3, device=device)
    # On the CPU each part of the rows has a copy of its own, else neighbours have.
    parts = copies if device.is_cpu else 1

    def one(part: int) -> None:
        start, stop = rows * part // parts, rows * (part + 1) // parts
        own, kept = d_array.cut(start // lanes, stop // lanes), Rows(record).cut(start, stop)
        wp.launch(
            light_kernels.map_gradient,
            dim=stop - start,
            inputs=[own, lanes, kept, height, width],
            outputs=[texels if parts == 1 else texels[part : part + 1]],
            device=device,
            record_tape=False,
        )

    wp.load_module(light_kernels, device=device)
    renderer.in_threads(one, range(parts if rows else 0), "light")
    total: Float64Array = texels.numpy().sum(axis=0, dtype=np.float64)
    return total


def _per_channel(d_pixel: FloatArray) -> FloatArray:
    """Return what takes RGB weights to a gradient per channel, shape [pixel, 3, 3]."""
    diagonal = np.zeros((len(d_pixel), 3, 3), np.float32)
    np.einsum("nii->ni", diagonal)[:] = d_pixel
    return diagonal


def _add(total: Gradients, part: Gradients) -> Gradients:
    return [f if t is None or f is None else t + f for t, f in zip(total, part, strict=True)]


def _parts(count: int, bytes_per_row: int) -> list[slice]:
    """Cut rows so that each part's record fits; one part where all fit."""
    size = max(1, RECORD_BYTES // max(bytes_per_row, 1))
    return [slice(start, min(start + size, count)) for start in range(0, max(count, 1), size)]


def _halves(count: int) -> list[slice]:
    """Cut rows into two parts, whose records are smaller."""
    middle = (count + 1) // 2
    return [slice(0, middle), slice(middle, count)]


def new_light_record(pixels: int, capacity: int, device: wp.Device) -> LightRecord:
    """Return an empty record of ``capacity`` directions for each of ``pixels`` rows."""
    record = LightRecord()
    record.count = wp.zeros(pixels, dtype=wp.int32, device=device)
    record.wi = wp.empty((pixels, capacity), dtype=wp.vec3, device=device)
    record.weight = wp.empty((pixels, capacity), dtype=wp.vec3, device=device)
    return record


def _new_vertex_record(
    pixels: int, capacity: int, has_layers: bool, device: wp.Device
) -> VertexRecord:
    record = VertexRecord()
    vectors = (
        "n", "wo", "texture_color", "texture_emission",
        "wi_light", "incident_light", "wi_bsdf", "incident_bsdf",
    )  # fmt: skip
    for name in vectors:
        setattr(record, name, wp.empty((pixels, capacity), dtype=wp.vec3, device=device))
    for name in ("texture_metallic", "texture_roughness", "cos_over_pdf"):
        setattr(record, name, wp.empty((pixels, capacity), dtype=wp.float32, device=device))
    record.layers = wp.empty((pixels, capacity * has_layers), dtype=Layers, device=device)
    record.material = wp.full((pixels, capacity), -1, dtype=wp.int32, device=device)
    return record
