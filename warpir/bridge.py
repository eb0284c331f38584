"""Torch tensors to Warp arrays and gradients back: the only file with both libraries.

Tensors are detached before Warp sees them and gradients are read from arrays of Warp's own, so no
``.grad`` buffer is shared: sharing breaks when the optimiser replaces it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from warpir.integrator import LightTensors
from warpir.kernels import composite as composite_kernels
from warpir.kernels import light_gradient as light_kernels
from warpir.kernels import shade as shade_kernels
from warpir.kernels.rasterize import rasterize as rasterize_kernel
from warpir.kernels.shadow_ratio import shadow_ratio as ratio_kernel
from warpir.kernels.types import LightArgs, LightRecord, MaterialArgs, VertexRecord
from warpir.light import Light, Lobes
from warpir.render import SAMPLES_PER_SLICE, ProxyRadiance, Renderer, Rows, index_of
from warpir.tone import Knots

if TYPE_CHECKING:
    from warpir.mis import IntArray, MisIntegrator

FloatArray = NDArray[np.float32]
Gradients = list[NDArray[np.float64] | None]
"""Sums of loss gradients, one for each input of a shading pass; None where none is asked for."""

RECORD_BYTES = 1 << 30
"""Memory that the recorded samples of one call may take; beyond it they are drawn again, in parts.
What is not filled is not touched: about a tenth of it on a convex object at five interactions."""
ENTRY_BYTES = 24
VERTEX_BYTES = 112
LOBE_BLOCK = 4096
"""Directions that one thread of `lobe_gradient` adds up; on the CPU they stay in its cache."""
PART_COUNT = 16
"""Private gradients of texels and materials; fixed, so that sums do not depend on threads."""


def _from_torch(tensor: Tensor, dtype: Any, device: wp.Device, grad: bool = False) -> wp.array:
    """Copy a tensor into a Warp array of ``dtype`` on ``device``, with a gradient if asked."""
    host = tensor.detach().to(torch.float32).contiguous()
    if host.is_cuda and device.is_cuda:
        array = wp.clone(wp.from_torch(host, dtype=dtype, requires_grad=False))
    else:
        array = wp.array(host.cpu().numpy(), dtype=dtype, device=device)
    array.requires_grad = grad
    return array


def _to_torch(array: wp.array, like: Tensor) -> Tensor:
    """Copy a Warp array into a tensor on ``like``'s device, with its dtype."""
    if array.device.is_cuda and like.is_cuda:
        copied: Tensor = wp.to_torch(array).clone().to(like.dtype)
        return copied
    # On the CPU `numpy()` is a view of the array, which the next `tape.zero()` would clear.
    return torch.from_numpy(array.numpy().copy()).to(like.device, like.dtype)


def host_light(light: LightTensors) -> Light:
    """Return plain arrays of a light's current values."""

    def plain(tensor: Tensor) -> np.ndarray[Any, np.dtype[np.float32]]:
        return tensor.detach().cpu().numpy().astype(np.float32)

    lobes = None
    if light.amplitude is not None:
        assert light.axis is not None and light.sharpness is not None
        lobes = Lobes(plain(light.amplitude), plain(light.axis), plain(light.sharpness))
    return Light(lobes, plain(light.texels) if light.texels is not None else None)


def _new_light_record(pixels: int, capacity: int, device: wp.Device) -> LightRecord:
    record = LightRecord()
    record.count = wp.zeros(pixels, dtype=wp.int32, device=device)
    record.wi = wp.empty((pixels, capacity), dtype=wp.vec3, device=device)
    record.weight = wp.empty((pixels, capacity), dtype=wp.vec3, device=device)
    return record


def _new_vertex_record(pixels: int, capacity: int, device: wp.Device) -> VertexRecord:
    record = VertexRecord()
    vectors = (
        "n", "wo", "texture_color", "texture_emission",
        "wi_light", "incident_light", "wi_brdf", "incident_brdf",
    )  # fmt: skip
    for name in vectors:
        setattr(record, name, wp.empty((pixels, capacity), dtype=wp.vec3, device=device))
    for name in ("texture_metallic", "texture_roughness", "weight_next"):
        setattr(record, name, wp.empty((pixels, capacity), dtype=wp.float32, device=device))
    record.material = wp.full((pixels, capacity), -1, dtype=wp.int32, device=device)
    return record


def _parts(count: int, bytes_per_row: int) -> list[slice]:
    """Cut rows so that each part's record fits; one part where all fit."""
    size = max(1, RECORD_BYTES // max(bytes_per_row, 1))
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


class ObjectSamples:
    """The object's samples at one light, material and seed, written down while they are traced.

    Args:
        mis: The integrator.
        args: The light that samples are drawn from, and whose radiance they carry.
        seed: Base seed.
        materials: Factors that replace the scene's.
        of_light: Whether to record what the light's gradient needs.
        of_materials: Whether to record what the materials' gradient needs.
    """

    def __init__(
        self,
        mis: MisIntegrator,
        args: LightArgs,
        seed: int,
        materials: SceneMaterials,
        of_light: bool,
        of_materials: bool,
    ) -> None:
        self.mis, self.args, self.seed, self.materials = mis, args, seed, materials
        self.path_count = mis.spp * mis.rays
        self.entries = 2 * self.path_count * mis.depth if of_light else 0
        self.vertices = self.path_count * (mis.depth + 1) if of_materials else 0
        row_bytes = ENTRY_BYTES * self.entries + VERTEX_BYTES * self.vertices
        self.parts = _parts(len(mis.object_pixels), row_bytes)

    def draw(self, rows: slice) -> tuple[FloatArray, LightRecord | None, VertexRecord | None]:
        """Trace the paths of some object pixels: radiance [pixel, 3] and the records asked for."""
        mis, device = self.mis, self.mis.renderer.device
        pixels = mis.object_pixels[rows]
        light = _new_light_record(len(pixels), self.entries, device) if self.entries else None
        vertex = _new_vertex_record(len(pixels), self.vertices, device) if self.vertices else None
        with self.materials:
            out = mis.renderer.foreground(
                self.args,
                pixels,
                mis.spp,
                mis.rays,
                mis.depth,
                self.seed,
                light_record=light,
                vertex_record=vertex,
            )
        return out.radiance, light, vertex


class ShadeForeground(torch.autograd.Function):
    """Object radiance of `warpir.mis.MisIntegrator`, shape [object_pixel, 3]."""

    @staticmethod
    def forward(
        ctx: Any,
        mis: MisIntegrator,
        args: LightArgs,
        seed: int,
        is_recording: bool,
        *tensors: Tensor | None,
    ) -> Tensor:
        """Render with the detached kernels; materials given as tensors replace the scene's."""
        ctx.like = tensors
        free = ctx.needs_input_grad[4:] if is_recording else (False,) * len(tensors)
        materials = SceneMaterials(mis.renderer, tensors[4:])
        ctx.samples = ObjectSamples(mis, args, seed, materials, any(free[:4]), any(free[4:]))
        ctx.drawn = None
        if len(ctx.samples.parts) == 1:
            ctx.drawn = ctx.samples.draw(ctx.samples.parts[0])
            radiance = ctx.drawn[0]
        else:
            radiance = ObjectSamples(mis, args, seed, materials, False, False).draw(slice(None))[0]
        return torch.from_numpy(radiance).to(_device_of(tensors))

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Go through the recorded samples, which are drawn again if they did not fit."""
        samples: ObjectSamples = ctx.samples
        renderer = samples.mis.renderer
        free = ctx.needs_input_grad[4:]
        total: Gradients = [None] * 8
        for rows in samples.parts:
            _, light_record, vertex_record = ctx.drawn or samples.draw(rows)
            # A record serves one backward pass, so that two steps' never live side by side.
            ctx.drawn = None
            d_radiance = d_outputs[0][rows]
            found: Gradients = [None] * 8
            if light_record is not None:
                d_pixel = torch.diag_embed(d_radiance)
                found[:4] = light_gradient(renderer, samples.args, light_record, d_pixel, free[:4])
            if vertex_record is not None:
                found[4:] = material_gradient(samples, vertex_record, d_radiance, free[4:])
            total = _add(total, found)
        return (None, None, None, None, *_tensors(total, ctx.like))


class ShadeProxy(torch.autograd.Function):
    """White plane with and without the object, shape [proxy_pixel, 3] each."""

    @staticmethod
    def forward(
        ctx: Any,
        mis: MisIntegrator,
        args: LightArgs,
        seed: int,
        is_recording: bool,
        *tensors: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Render with the detached kernels."""
        ctx.like = tensors
        is_free = is_recording and any(ctx.needs_input_grad[4:])
        ctx.samples = PlaneSamples(mis, args, seed, is_free)
        ctx.drawn = None
        if len(ctx.samples.parts) == 1:
            ctx.drawn = ctx.samples.draw(ctx.samples.parts[0])
            out = ctx.drawn[0]
        else:
            out = PlaneSamples(mis, args, seed, False).draw(slice(None))[0]
        where = _device_of(tensors)
        return torch.from_numpy(out.lit).to(where), torch.from_numpy(out.unoccluded).to(where)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Go through the recorded samples, which are drawn again if they did not fit."""
        samples: PlaneSamples = ctx.samples
        total: Gradients = [None] * 4
        for rows in samples.parts:
            _, record = ctx.drawn or samples.draw(rows)
            ctx.drawn = None
            d_lit, d_unoccluded = (d[rows] for d in d_outputs)
            d_pixel = torch.stack([d_lit, d_unoccluded, torch.zeros_like(d_lit)], dim=-1)
            assert record is not None
            found = light_gradient(
                samples.mis.renderer, samples.args, record, d_pixel, ctx.needs_input_grad[4:]
            )
            total = _add(total, found)
        return (None, None, None, None, *_tensors(total, ctx.like))


class PlaneSamples:
    """The plane's samples, as `ObjectSamples`."""

    def __init__(self, mis: MisIntegrator, args: LightArgs, seed: int, of_light: bool) -> None:
        self.mis, self.args, self.seed = mis, args, seed
        self.entries = 2 * mis.spp * mis.rays if of_light else 0
        self.parts = _parts(len(mis.proxy_pixels), ENTRY_BYTES * self.entries)

    def draw(self, rows: slice) -> tuple[ProxyRadiance, LightRecord | None]:
        """Trace the samples of some plane pixels."""
        mis = self.mis
        pixels = mis.proxy_pixels[rows]
        record = None
        if self.entries:
            record = _new_light_record(len(pixels), self.entries, mis.renderer.device)
        out = mis.renderer.proxy(
            self.args,
            pixels,
            mis.may_see_object[rows],
            mis.spp,
            mis.rays,
            self.seed,
            record=record,
        )
        return out, record


def light_gradient(
    renderer: Renderer,
    args: LightArgs,
    record: LightRecord,
    d_pixel: Tensor,
    free: tuple[bool, ...],
) -> Gradients:
    """Return the loss gradient of a light over recorded directions.

    Args:
        renderer: Whose device and threads are used.
        args: The light.
        record: Directions and weights, rows are pixels.
        d_pixel: See `warpir.kernels.light_gradient.lobe_gradient`, shape [pixel, 3, 3].
        free: Which of amplitude, axis, sharpness and texels are asked for.

    Returns:
        Gradients of the four, shapes [lobe, 3], [lobe, 3], [lobe] and [He, We, 3].
    """
    device = renderer.device
    pixels, capacity = record.wi.shape
    d_array = _from_torch(d_pixel, wp.mat33, device)
    out: Gradients = [None] * 4
    if any(free[:3]) and args.lobe_count > 0:
        block_size = max(1, LOBE_BLOCK // capacity)
        first = np.arange(0, pixels, block_size, dtype=np.int32)
        shape = (len(first), args.lobe_count)
        sums = [wp.empty(shape, dtype=t, device=device) for t in (wp.vec3, wp.vec3, wp.float32)]
        renderer.launch(
            light_kernels.lobe_gradient,
            len(first),
            [
                record,
                d_array,
                Rows(wp.array(first, dtype=wp.int32, device=device)),
                block_size,
                args.amplitude,
                args.axis,
                args.sharpness,
                *map(Rows, sums),
            ],
            block_size * capacity,
            "light",
            width=args.lobe_count,
        )
        out[:3] = [a.numpy().sum(axis=0, dtype=np.float64) for a in sums]
    if free[3]:
        height, width = args.map_height, args.map_width
        # A private map pays where it is smaller than what is added into it.
        parts = max(1, min(PART_COUNT, pixels * capacity // (height * width)))
        parts = parts if device.is_cpu else 1
        texels = wp.zeros((parts, height, width), dtype=wp.vec3, device=device)
        bounds = [pixels * part // parts for part in range(parts + 1)]

        def one(part: int) -> None:
            start, stop = bounds[part], bounds[part + 1]
            wp.launch(
                light_kernels.map_gradient,
                dim=stop - start,
                inputs=[
                    Rows(record).cut(start, stop),
                    d_array[start:stop],
                    height,
                    width,
                    texels[part],
                ],
                device=device,
                record_tape=False,
            )

        wp.load_module(light_kernels, device=device)
        renderer.in_threads(one, range(parts), "light")
        out[3] = texels.numpy().sum(axis=0, dtype=np.float64)
    return out


def material_gradient(
    samples: ObjectSamples, record: VertexRecord, d_radiance: Tensor, free: tuple[bool, ...]
) -> Gradients:
    """Return the loss gradient of the material factors over recorded vertices.

    Args:
        samples: Where ``record`` comes from.
        record: Vertices, rows are pixels.
        d_radiance: Loss gradient of the pixels' radiance, shape [pixel, 3].
        free: Which of base colour, metallic, roughness and emission are asked for.

    Returns:
        Gradients of the four, shapes [material, 3], [material], [material] and [material, 3].
    """
    mis, path_count = samples.mis, samples.path_count
    renderer, device = mis.renderer, mis.renderer.device
    factors = samples.materials.arrays
    pixels = record.material.shape[0]
    # One private gradient for each part; on the CPU a part is gone through in short launches.
    parts = min(PART_COUNT, pixels) if device.is_cpu else 1
    size = max(1, SAMPLES_PER_SLICE // path_count) if device.is_cpu else pixels
    d_path = _from_torch(
        (d_radiance / path_count).repeat_interleave(path_count, dim=0), wp.vec3, device
    )
    d_factors = [
        wp.zeros((parts, len(a)), dtype=a.dtype, device=device) if is_free else None
        for a, is_free in zip(factors, free, strict=True)
    ]

    def one(part: int) -> None:
        own = [None if d is None else d[part] for d in d_factors]
        stop = pixels * (part + 1) // parts
        for start in range(pixels * part // parts, stop, size):
            end = min(start + size, stop)
            d_rows = d_path[start * path_count : end * path_count]
            differentiate_vertices(
                Rows(record).cut(start, end), path_count, mis.depth, factors, d_rows, own
            )

    wp.load_module(shade_kernels, device=device)
    renderer.in_threads(one, range(parts), "materials")
    return [None if d is None else d.numpy().sum(axis=0, dtype=np.float64) for d in d_factors]


def differentiate_vertices(
    record: VertexRecord,
    path_count: int,
    depth: int,
    factors: list[wp.array],
    d_path: wp.array,
    d_factors: list[wp.array | None],
) -> None:
    """Add the gradient of some paths to ``d_factors``: vertices forward, adjoints backward.

    Launched by hand: ``wp.Tape`` belongs to one thread.

    Args:
        record: Vertices, rows are pixels.
        path_count: Paths of a pixel.
        depth: Surface interactions; there is one vertex more, which may emit.
        factors: Base colour, metallic, roughness and emission, shape [material] each.
        d_path: Loss gradient of each path's radiance, shape [path].
        d_factors: Where to add, or None, as ``factors``.
    """
    device, paths = d_path.device, len(d_path)
    throughput = [wp.full(paths, wp.vec3(1.0), dtype=wp.vec3, device=device)]
    throughput += [wp.empty(paths, dtype=wp.vec3, device=device) for _ in range(depth + 1)]
    unused = wp.empty(paths, dtype=wp.vec3, device=device)
    for k in range(depth):
        wp.launch(
            shade_kernels.shade_vertex,
            dim=paths,
            inputs=[record, path_count, k, *factors, throughput[k]],
            outputs=[unused, throughput[k + 1]],
            device=device,
            record_tape=False,
        )
    d_next = wp.zeros(paths, dtype=wp.vec3, device=device)
    for k in range(depth, -1, -1):
        d_throughput = wp.zeros(paths, dtype=wp.vec3, device=device)
        wp.launch(
            shade_kernels.shade_vertex,
            dim=paths,
            inputs=[record, path_count, k, *factors, throughput[k]],
            outputs=[unused, throughput[k + 1]],
            adj_inputs=[VertexRecord(), 0, 0, *d_factors, d_throughput],
            adj_outputs=[d_path, d_next],
            adjoint=True,
            device=device,
            record_tape=False,
        )
        d_next = d_throughput


def _add(total: Gradients, found: Gradients) -> Gradients:
    return [f if t is None else t + f for t, f in zip(total, found, strict=True)]


def _tensors(gradients: Gradients, like: tuple[Tensor | None, ...]) -> tuple[Tensor | None, ...]:
    """Return gradients in the tensors' shapes, types and places."""
    return tuple(
        None if g is None or t is None else torch.from_numpy(g).to(t).reshape(t.shape)
        for g, t in zip(gradients, like, strict=True)
    )


def _device_of(tensors: tuple[Tensor | None, ...]) -> torch.device:
    for tensor in tensors:
        if tensor is not None:
            return tensor.device
    return torch.device("cpu")


class SceneMaterials:
    """Material factors on the device; within the context the scene renders with them.

    Args:
        renderer: Whose scene.
        tensors: Base colour, metallic, roughness and emission; the scene's own where None.
    """

    NAMES = (
        ("base_color", wp.vec3),
        ("metallic", wp.float32),
        ("roughness", wp.float32),
        ("emission", wp.vec3),
    )

    def __init__(self, renderer: Renderer, tensors: tuple[Tensor | None, ...]) -> None:
        self.args: MaterialArgs = renderer.scene.material_args
        self.own = [getattr(self.args, name) for name, _ in self.NAMES]
        self.arrays = [
            own if tensor is None else _from_torch(tensor, dtype, renderer.device)
            for own, tensor, (_, dtype) in zip(self.own, tensors, self.NAMES, strict=True)
        ]
        self.own_any_emission = self.args.any_emission
        self.any_emission = self.own_any_emission if tensors[3] is None else 1

    def __enter__(self) -> None:
        for (name, _), array in zip(self.NAMES, self.arrays, strict=True):
            setattr(self.args, name, array)
        self.args.any_emission = self.any_emission

    def __exit__(self, *_: object) -> None:
        for (name, _), array in zip(self.NAMES, self.own, strict=True):
            setattr(self.args, name, array)
        self.args.any_emission = self.own_any_emission


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        height: int,
        device: wp.Device,
        amplitude: Tensor,
        axis: Tensor,
        sharpness: Tensor,
    ) -> Tensor:
        arrays = [
            _from_torch(amplitude, wp.vec3, device, grad=True),
            _from_torch(axis, wp.vec3, device, grad=True),
            _from_torch(sharpness, wp.float32, device, grad=True),
        ]
        texels = wp.zeros((height, 2 * height), dtype=wp.vec3, device=device, requires_grad=True)
        ctx.tape = wp.Tape()
        with ctx.tape:
            wp.launch(
                rasterize_kernel,
                dim=(height, 2 * height),
                inputs=[height, 2 * height, *arrays, len(amplitude)],
                outputs=[texels],
                device=device,
            )
        ctx.arrays, ctx.texels, ctx.like = arrays, texels, (amplitude, axis, sharpness)
        return _to_torch(texels, amplitude)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        ctx.tape.backward(grads={ctx.texels: _from_torch(d_outputs[0], wp.vec3, ctx.texels.device)})
        grads = [_to_torch(a.grad, t) for a, t in zip(ctx.arrays, ctx.like, strict=True)]
        ctx.tape.zero()
        return (None, None, *grads)


def rasterize(
    amplitude: Tensor, axis: Tensor, sharpness: Tensor, height: int, device: str
) -> Tensor:
    """Average lobes over the texels of a lat-long map; differentiable in all three.

    Args:
        amplitude: Lobe peaks, relative [W/(m^2 sr)], shape [lobe, 3].
        axis: Unit lobe axes, world frame, shape [lobe, 3].
        sharpness: Lobe concentration [1], shape [lobe].
        height: Rows of the map; it is twice as wide.
        device: Warp device.

    Returns:
        Radiance, shape [height, 2 height, 3].
    """
    out: Tensor = _Rasterize.apply(height, wp.get_device(device), amplitude, axis, sharpness)
    return out


class _Compose(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, constants: ComposeConstants, *tensors: Tensor) -> Tensor:
        device = constants.device
        foreground, lit, unoccluded = (
            _from_torch(t, wp.vec3, device, grad=True) for t in tensors[:3]
        )
        knots = [_from_torch(t, wp.float32, device, grad=True) for t in tensors[3:]]
        objects, proxies = len(tensors[0]), len(tensors[1])
        pixels = constants.height * constants.width
        new = [
            wp.zeros(max(n, 1), dtype=wp.vec3, device=device, requires_grad=True)
            for n in (proxies, objects, proxies, pixels)
        ]
        ratio, fg_display, ratio_display, image = new
        ctx.tape = wp.Tape()
        with ctx.tape:
            wp.launch(
                ratio_kernel, dim=proxies, inputs=[lit, unoccluded], outputs=[ratio], device=device
            )
            wp.launch(
                composite_kernels.tone_foreground,
                dim=objects,
                inputs=[
                    foreground,
                    constants.mask,
                    constants.is_reinhard,
                    *knots[:3],
                    constants.bins_fg,
                ],
                outputs=[fg_display],
                device=device,
            )
            wp.launch(
                composite_kernels.tone_shadow,
                dim=proxies,
                inputs=[ratio, *knots[3:], constants.bins_shadow],
                outputs=[ratio_display],
                device=device,
            )
            wp.launch(
                composite_kernels.compose,
                dim=pixels,
                inputs=[
                    constants.photo_lin,
                    constants.object_index,
                    constants.proxy_index,
                    constants.mask,
                    fg_display,
                    ratio_display,
                ],
                outputs=[image],
                device=device,
            )
        ctx.arrays = [foreground, lit, unoccluded, *knots]
        ctx.image, ctx.like = image, tensors
        shape = (constants.height, constants.width, 3)
        return _to_torch(image, tensors[0]).reshape(shape).permute(2, 0, 1)[None].contiguous()

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        d_image = d_outputs[0][0].permute(1, 2, 0).reshape(-1, 3)
        ctx.tape.backward(grads={ctx.image: _from_torch(d_image, wp.vec3, ctx.image.device)})
        grads = [_to_torch(a.grad, t) for a, t in zip(ctx.arrays, ctx.like, strict=True)]
        ctx.tape.zero()
        return (None, *grads)


class ComposeConstants:
    """What `compose` needs and never differentiates, uploaded once.

    Args:
        photo_lin: Linear photo, shape [H, W, 3].
        object_pixels: Row-major, shape [object_pixel].
        proxy_pixels: Row-major, shape [proxy_pixel].
        mask: Coverage of the object pixels [1], shape [object_pixel].
        device: Warp device.
        is_reinhard: Whether Reinhard's operator precedes the foreground curve.
    """

    def __init__(
        self,
        photo_lin: np.ndarray[Any, np.dtype[np.float32]],
        object_pixels: IntArray,
        proxy_pixels: IntArray,
        mask: np.ndarray[Any, np.dtype[np.float32]],
        device: str,
        is_reinhard: bool = True,
    ) -> None:
        self.device = wp.get_device(device)
        self.height, self.width = photo_lin.shape[:2]
        count = self.height * self.width
        flat = np.ascontiguousarray(photo_lin.reshape(-1, 3), np.float32)
        self.photo_lin = wp.array(flat, dtype=wp.vec3, device=self.device)
        self.object_index = wp.array(
            index_of(object_pixels, count), dtype=wp.int32, device=self.device
        )
        self.proxy_index = wp.array(
            index_of(proxy_pixels, count), dtype=wp.int32, device=self.device
        )
        self.mask = wp.array(
            mask if len(mask) else np.zeros(1, np.float32), dtype=wp.float32, device=self.device
        )
        self.is_reinhard = int(is_reinhard)
        self.bins_fg = self.bins_shadow = 5


def compose(
    constants: ComposeConstants,
    foreground: Tensor,
    lit: Tensor,
    unoccluded: Tensor,
    curve_fg: Knots,
    curve_shadow: Knots,
) -> Tensor:
    """Shadow ratio, tone curves, composite and encoding (DiPIR, eq. 5 and 6); differentiable.

    Args:
        constants: Photo, pixel lists and coverage.
        foreground: Object radiance, premultiplied, shape [object_pixel, 3].
        lit: White plane with the object, shape [proxy_pixel, 3].
        unoccluded: White plane without it, shape [proxy_pixel, 3].
        curve_fg: One curve.
        curve_shadow: Three curves.

    Returns:
        The composite, display-encoded, shape [1, 3, H, W].
    """
    constants.bins_fg, constants.bins_shadow = curve_fg.bin_count, curve_shadow.bin_count
    out: Tensor = _Compose.apply(
        constants,
        foreground,
        lit,
        unoccluded,
        curve_fg.x,
        curve_fg.y,
        curve_fg.slope,
        curve_shadow.x,
        curve_shadow.y,
        curve_shadow.slope,
    )
    return out
