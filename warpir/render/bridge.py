"""Torch tensors to Warp arrays and gradients back: the only file with both libraries.

Tensors are detached before Warp sees them and gradients are read from arrays of Warp's own, so no
``.grad`` buffer is shared: sharing breaks when the optimiser replaces it.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from warpir.core.arrays import FloatArray, IntArray
from warpir.kernels import composite as composite_kernels
from warpir.kernels.shadow_ratio import shadow_ratio as ratio_kernel
from warpir.kernels.types import LightArgs
from warpir.render.integrator import Radiance
from warpir.render.mis.samples import Gradients, ObjectSamples, ReceiverSamples
from warpir.render.renderer import index_of
from warpir.render.tone_curve import Knots
from warpir.scene.light import Light

if TYPE_CHECKING:
    from warpir.render.mis.integrator import MisIntegrator


KNOT_COPIES = 32
"""Copies of the tone curves on CUDA, so that threads add to gradients of their own; see
`warpir.kernels.composite`."""


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


def _host(tensor: Tensor) -> FloatArray:
    """Copy a tensor to the host; torch may change the original in place later."""
    return tensor.detach().cpu().numpy().astype(np.float32)


def host_light(texels: Tensor) -> Light:
    """Return the current values of a map [He, We, 3] as a light."""
    return Light(texels=_host(texels))


class ShadeForeground(torch.autograd.Function):
    """Object radiance of `warpir.render.mis.integrator.MisIntegrator`, shape [object_pixel, 3]."""

    @staticmethod
    def forward(
        ctx: Any,
        mis: MisIntegrator,
        args: LightArgs,
        seed: int,
        is_recording: bool,
        *tensors: Tensor | None,
    ) -> Tensor:
        """Trace; the map is in ``args``, the materials replace the scene's."""
        free = ctx.needs_input_grad[4:] if is_recording else (False,) * len(tensors)
        factors = [None if t is None else _host(t) for t in tensors[1:]]
        ctx.like, ctx.samples = tensors, ObjectSamples(mis, args, seed, factors, free)
        return torch.from_numpy(ctx.samples.render()).to(_device_of(tensors))

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Sum over the recorded samples."""
        return (None,) * 4 + _tensors(ctx.samples.gradient(_host(d_outputs[0])), ctx.like)


class ShadeReceiver(torch.autograd.Function):
    """White plane with and without the object, shape [receiver_pixel, 3] each."""

    @staticmethod
    def forward(
        ctx: Any,
        mis: MisIntegrator,
        args: LightArgs,
        seed: int,
        is_recording: bool,
        *tensors: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Trace; the map is in ``args``."""
        free = ctx.needs_input_grad[4:] if is_recording else (False,) * len(tensors)
        ctx.like, ctx.samples = tensors, ReceiverSamples(mis, args, seed, free)
        out, where = ctx.samples.render(), _device_of(tensors)
        return torch.from_numpy(out.lit).to(where), torch.from_numpy(out.unoccluded).to(where)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Sum over the recorded samples."""
        return (None,) * 4 + _tensors(ctx.samples.gradient(*map(_host, d_outputs)), ctx.like)


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


class _Compose(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, constants: ComposeConstants, *tensors: Tensor) -> Tensor:
        device = constants.device
        foreground, lit, unoccluded = (
            _from_torch(t, wp.vec3, device, grad=True) for t in tensors[:3]
        )
        copies = KNOT_COPIES if device.is_cuda else 1
        knots = [
            _from_torch(t.repeat(copies, 1), wp.float32, device, grad=True) for t in tensors[3:]
        ]
        bins_fg, bins_shadow = (t.shape[1] - 1 for t in (tensors[3], tensors[6]))
        objects, shaded = len(tensors[0]), len(tensors[1])
        pixels = constants.height * constants.width
        ratio, fg_display, ratio_display, image = (
            wp.zeros(max(n, 1), dtype=wp.vec3, device=device, requires_grad=True)
            for n in (shaded, objects, shaded, pixels)
        )

        def launch(kernel: wp.Kernel, dim: int, inputs: list[object], output: wp.array) -> None:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=[output], device=device)

        of_object = [foreground, constants.mask, constants.is_reinhard]
        indices = [constants.object_index, constants.receiver_index]
        ctx.tape = wp.Tape()
        with ctx.tape:
            launch(ratio_kernel, shaded, [lit, unoccluded], ratio)
            launch(
                composite_kernels.tone_foreground,
                objects,
                [*of_object, *knots[:3], bins_fg],
                fg_display,
            )
            launch(
                composite_kernels.tone_shadow,
                shaded,
                [ratio, *knots[3:], bins_shadow],
                ratio_display,
            )
            launch(
                composite_kernels.compose,
                pixels,
                [constants.photo_lin, *indices, constants.mask, fg_display, ratio_display],
                image,
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
        # The curves' copies count together.
        shapes = [t.shape for t in ctx.like[3:]]
        grads[3:] = [g.reshape(-1, *s).sum(0) for g, s in zip(grads[3:], shapes, strict=True)]
        return (None, *grads)


class ComposeConstants:
    """Constant inputs of `compose`, uploaded once.

    Args:
        photo_lin: Linear photo, shape [H, W, 3].
        object_pixels: Row-major, shape [object_pixel].
        receiver_pixels: Row-major, shape [receiver_pixel].
        mask: Coverage of the object pixels [1], shape [object_pixel].
        device: Warp device.
        is_reinhard: Whether Reinhard's operator precedes the foreground curve.
    """

    def __init__(
        self,
        photo_lin: FloatArray,
        object_pixels: IntArray,
        receiver_pixels: IntArray,
        mask: FloatArray,
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
        self.receiver_index = wp.array(
            index_of(receiver_pixels, count), dtype=wp.int32, device=self.device
        )
        self.mask = wp.array(
            mask if len(mask) else np.zeros(1, np.float32), dtype=wp.float32, device=self.device
        )
        self.is_reinhard = int(is_reinhard)


def compose(
    constants: ComposeConstants, radiance: Radiance, curve_fg: Knots, curve_shadow: Knots
) -> Tensor:
    """Shadow ratio, tone curves, composite and encoding (DiPIR, eq. 5 and 6); differentiable.

    Args:
        constants: Photo, pixel lists and coverage.
        radiance: Of object and receiver.
        curve_fg: One curve.
        curve_shadow: Three curves.

    Returns:
        The composite, display-encoded, shape [1, 3, H, W].
    """
    parts = (vars(group).values() for group in (radiance, curve_fg, curve_shadow))
    out: Tensor = _Compose.apply(constants, *chain.from_iterable(parts))
    return out
