"""Torch tensors to Warp arrays and gradients back: the only file with both libraries.

Tensors are detached before Warp sees them and gradients are read from arrays of Warp's own, so no
``.grad`` buffer is shared: sharing breaks when the optimiser replaces it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from warpir.integrator import LightTensors
from warpir.kernels import composite as composite_kernels
from warpir.kernels import shade as shade_kernels
from warpir.kernels.path import PathRecord, record_paths
from warpir.kernels.proxy import ProxyRecord, record_proxy
from warpir.kernels.rasterize import rasterize as rasterize_kernel
from warpir.kernels.shadow_ratio import shadow_ratio as ratio_kernel
from warpir.kernels.types import LightArgs, MaterialArgs
from warpir.light import Light, Lobes
from warpir.render import Renderer, index_of
from warpir.tone import Knots

if TYPE_CHECKING:
    from warpir.mis import IntArray, MisIntegrator

CHUNK_BYTES = 256 << 20
"""Memory that recorded samples may take at once."""
BYTES_PER_VERTEX = 150
BYTES_PER_DIRECTION = 20


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


class Leaves:
    """The differentiable inputs of a shading pass as Warp arrays, and their gradients as tensors.

    ``tensors`` holds (tensor or None, dtype, fallback array); an absent tensor is a constant.
    """

    def __init__(
        self, tensors: list[tuple[Tensor | None, Any, wp.array]], device: wp.Device
    ) -> None:
        self.tensors = [t for t, _, _ in tensors]
        self.arrays = [
            fallback if t is None else _from_torch(t, dtype, device, grad=True)
            for t, dtype, fallback in tensors
        ]

    def gradients(self) -> tuple[Tensor | None, ...]:
        """Return what the tapes have added up, in the tensors' shapes."""
        return tuple(
            None if t is None else _to_torch(a.grad, t).reshape(t.shape)
            for t, a in zip(self.tensors, self.arrays, strict=True)
        )


def light_leaves(
    tensors: tuple[Tensor | None, ...], args: LightArgs
) -> list[tuple[Tensor | None, Any, wp.array]]:
    """Return the light's four inputs with their types; what is absent stays a constant."""
    amplitude, axis, sharpness, texels = tensors
    return [
        (amplitude, wp.vec3, args.amplitude),
        (axis, wp.vec3, args.axis),
        (sharpness, wp.float32, args.sharpness),
        (texels, wp.vec3, args.texels),
    ]


def _path_record(vertices: int, paths: int, device: wp.Device) -> PathRecord:
    record = PathRecord()
    vectors = ("n", "wo", "wi_light", "wi_brdf", "texture_color", "texture_emission")
    scalars = (
        "weight_light",
        "weight_brdf",
        "weight_next",
        "texture_metallic",
        "texture_roughness",
    )
    record.material = wp.zeros((vertices, paths), dtype=wp.int32, device=device)
    for name in vectors:
        setattr(record, name, wp.zeros((vertices, paths), dtype=wp.vec3, device=device))
    for name in scalars:
        setattr(record, name, wp.zeros((vertices, paths), dtype=float, device=device))
    return record


class ShadeForeground(torch.autograd.Function):
    """Object radiance of `warpir.mis.MisIntegrator`, shape [object_pixel, 3]."""

    @staticmethod
    def forward(
        ctx: Any, mis: MisIntegrator, args: LightArgs, seed: int, *tensors: Tensor | None
    ) -> Tensor:
        """Render with the detached kernels; materials given as tensors replace the scene's."""
        ctx.mis, ctx.args, ctx.seed = mis, args, seed
        ctx.tensors = tensors
        with scene_materials(mis.renderer, tensors[4:]):
            out = mis.renderer.foreground(
                args, mis.object_pixels, mis.spp, mis.rays, mis.depth, seed
            )
        return torch.from_numpy(out.radiance).to(_device_of(tensors))

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Replay the samples chunk by chunk and differentiate the attached kernels."""
        mis: MisIntegrator = ctx.mis
        device = mis.renderer.device
        with scene_materials(mis.renderer, ctx.tensors[4:]):
            leaves = foreground_leaves(mis, ctx.args, ctx.tensors)
            for rows, tape, radiance in replay_foreground(mis, ctx.args, ctx.seed, leaves.arrays):
                tape.backward(grads={radiance: _from_torch(d_outputs[0][rows], wp.vec3, device)})
        return (None, None, None, *leaves.gradients())


def foreground_leaves(
    mis: MisIntegrator, args: LightArgs, tensors: tuple[Tensor | None, ...]
) -> Leaves:
    """Return the inputs of the object's attached pass: four of the light, four of the materials."""
    material = mis.renderer.scene.material_args
    return Leaves(
        [
            *light_leaves(tensors[:4], args),
            (tensors[4], wp.vec3, material.base_color),
            (tensors[5], wp.float32, material.metallic),
            (tensors[6], wp.float32, material.roughness),
            (tensors[7], wp.vec3, material.emission),
        ],
        mis.renderer.device,
    )


def replay_foreground(
    mis: MisIntegrator, args: LightArgs, seed: int, arrays: list[wp.array]
) -> Iterator[tuple[slice, wp.Tape, wp.array]]:
    """Draw the object's samples again and evaluate the attached kernels over them.

    Samples, densities and visibility are those of ``args`` and the scene's materials; radiance is
    evaluated at ``arrays``, which need not hold the same values: then it is a pinned-sample render.

    Args:
        mis: The integrator.
        args: The light that the samples are drawn from.
        seed: Base seed.
        arrays: From `foreground_leaves`.

    Yields:
        The rows of ``object_pixels``, the tape, and their radiance [object_pixel].
    """
    device = mis.renderer.device
    amplitude, axis, sharpness, texels, *factors = arrays
    per_pixel = mis.spp * mis.rays
    vertices = mis.depth + 1
    size = max(1, CHUNK_BYTES // (BYTES_PER_VERTEX * vertices * per_pixel))
    for start in range(0, len(mis.object_pixels), size):
        pixels = mis.object_pixels[start : start + size]
        paths = len(pixels) * per_pixel
        record = _path_record(vertices, paths, device)
        _record_foreground(mis, args, seed, pixels, record)
        tape = wp.Tape()
        radiance = wp.zeros(len(pixels), dtype=wp.vec3, device=device, requires_grad=True)
        with tape:
            throughput = wp.full(
                paths, wp.vec3(1.0), dtype=wp.vec3, device=device, requires_grad=True
            )
            for k in range(vertices):
                gathered, onward = (
                    wp.zeros(paths, dtype=wp.vec3, device=device, requires_grad=True)
                    for _ in range(2)
                )
                wp.launch(
                    shade_kernels.shade_vertex,
                    dim=paths,
                    inputs=[
                        record,
                        k,
                        *factors,
                        amplitude,
                        axis,
                        sharpness,
                        args.lobe_count,
                        texels,
                        args.map_height,
                        args.map_width,
                        throughput,
                    ],
                    outputs=[gathered, onward],
                    device=device,
                )
                wp.launch(
                    shade_kernels.sum_paths,
                    dim=len(pixels),
                    inputs=[gathered, per_pixel, 1.0 / per_pixel],
                    outputs=[radiance],
                    device=device,
                )
                throughput = onward
        yield slice(start, start + len(pixels)), tape, radiance


def _record_foreground(
    mis: MisIntegrator, args: LightArgs, seed: int, pixels: IntArray, record: PathRecord
) -> None:
    scene = mis.renderer.scene
    wp.launch(
        record_paths,
        dim=len(pixels) * mis.spp * mis.rays,
        inputs=[
            wp.array(pixels, dtype=wp.int32, device=scene.device),
            scene.camera_args,
            scene.mesh_args,
            scene.material_args,
            scene.texture_args,
            scene.proxy_args,
            args,
            mis.spp,
            mis.rays,
            mis.depth,
            seed,
            record,
        ],
        device=scene.device,
        record_tape=False,
    )


class ShadeProxy(torch.autograd.Function):
    """White plane with and without the object, shape [proxy_pixel, 3] each."""

    @staticmethod
    def forward(
        ctx: Any, mis: MisIntegrator, args: LightArgs, seed: int, *tensors: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Render with the detached kernels."""
        ctx.mis, ctx.args, ctx.seed = mis, args, seed
        ctx.tensors = tensors
        out = mis.renderer.proxy(
            args, mis.proxy_pixels, mis.may_see_object, mis.spp, mis.rays, seed
        )
        where = _device_of(tensors)
        return torch.from_numpy(out.lit).to(where), torch.from_numpy(out.unoccluded).to(where)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Replay the samples chunk by chunk and differentiate the attached kernel."""
        d_lit, d_unoccluded = d_outputs
        mis: MisIntegrator = ctx.mis
        device = mis.renderer.device
        leaves = Leaves(light_leaves(ctx.tensors, ctx.args), device)
        for rows, tape, lit, unoccluded in replay_proxy(mis, ctx.args, ctx.seed, leaves.arrays):
            tape.backward(
                grads={
                    lit: _from_torch(d_lit[rows], wp.vec3, device),
                    unoccluded: _from_torch(d_unoccluded[rows], wp.vec3, device),
                }
            )
        return (None, None, None, *leaves.gradients())


def replay_proxy(
    mis: MisIntegrator, args: LightArgs, seed: int, arrays: list[wp.array]
) -> Iterator[tuple[slice, wp.Tape, wp.array, wp.array]]:
    """Draw the plane's samples again and evaluate the attached kernel; see `replay_foreground`.

    Yields:
        The rows of ``proxy_pixels``, the tape, ``lit`` and ``unoccluded`` [proxy_pixel].
    """
    scene, device = mis.renderer.scene, mis.renderer.device
    amplitude, axis, sharpness, texels = arrays
    per_pixel = mis.spp * mis.rays
    size = max(1, CHUNK_BYTES // (2 * BYTES_PER_DIRECTION * per_pixel))
    for start in range(0, len(mis.proxy_pixels), size):
        pixels = mis.proxy_pixels[start : start + size]
        may_see_object = mis.may_see_object[start : start + size]
        paths = len(pixels) * per_pixel
        record = ProxyRecord()
        record.wi = wp.zeros((2, paths), dtype=wp.vec3, device=device)
        record.weight = wp.zeros((2, paths), dtype=float, device=device)
        record.visible = wp.zeros((2, paths), dtype=float, device=device)
        wp.launch(
            record_proxy,
            dim=len(pixels),
            inputs=[
                wp.array(pixels, dtype=wp.int32, device=device),
                wp.array(may_see_object, dtype=wp.int32, device=device),
                scene.camera_args,
                scene.mesh_args,
                scene.material_args,
                scene.texture_args,
                scene.proxy_args,
                args,
                mis.spp,
                mis.rays,
                seed,
                record,
            ],
            device=device,
            record_tape=False,
        )
        tape = wp.Tape()
        lit, unoccluded = (
            wp.zeros(len(pixels), dtype=wp.vec3, device=device, requires_grad=True)
            for _ in range(2)
        )
        with tape:
            wp.launch(
                shade_kernels.shade_proxy,
                dim=len(pixels),
                inputs=[
                    record,
                    per_pixel,
                    amplitude,
                    axis,
                    sharpness,
                    args.lobe_count,
                    texels,
                    args.map_height,
                    args.map_width,
                ],
                outputs=[lit, unoccluded],
                device=device,
            )
        yield slice(start, start + len(pixels)), tape, lit, unoccluded


def _device_of(tensors: tuple[Tensor | None, ...]) -> torch.device:
    for tensor in tensors:
        if tensor is not None:
            return tensor.device
    return torch.device("cpu")


class scene_materials:
    """Within the context the scene's material factors are those of the tensors that are given."""

    NAMES = (
        ("base_color", wp.vec3),
        ("metallic", wp.float32),
        ("roughness", wp.float32),
        ("emission", wp.vec3),
    )

    def __init__(self, renderer: Renderer, tensors: tuple[Tensor | None, ...]) -> None:
        self.scene, self.tensors = renderer.scene, tensors

    def __enter__(self) -> None:
        args: MaterialArgs = self.scene.material_args
        self.kept = {name: getattr(args, name) for name, _ in self.NAMES}
        self.any_emission = args.any_emission
        for tensor, (name, dtype) in zip(self.tensors, self.NAMES, strict=True):
            if tensor is not None:
                setattr(args, name, _from_torch(tensor, dtype, self.scene.device))
                if name == "emission":
                    args.any_emission = 1

    def __exit__(self, *_: object) -> None:
        args = self.scene.material_args
        for name, array in self.kept.items():
            setattr(args, name, array)
        args.any_emission = self.any_emission


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
