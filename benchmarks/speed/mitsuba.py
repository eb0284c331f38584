"""Mitsuba 3 as fast as we know how to drive it: foreground by ``prb``, shadow ratio by Dr.Jit AD.

The film is cropped to the object's pixels, the plane's rays start only from the pixels compared,
and both radiances of the plane share their samples, so that the ratio is exactly 1 where nothing
is blocked. Set the variant before importing this module.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.python.ad.integrators.common import mis_weight

from benchmarks.speed.scenes import SpeedScene
from warpir.core.arrays import Float64Array, FloatArray, PixelArray
from warpir.mitsuba.light import LatlongEmitter
from warpir.mitsuba.render import build, sensor_of

PASS_SAMPLES = {"llvm_ad_rgb": 1 << 25, "cuda_ad_rgb": 1 << 28}
"""Camera samples traced at once; bounds memory. Passes are long, as only samples of one pass are
stratified together."""


@dataclass
class ReceiverSamples:
    """What the lookups of one pass need: two directions per camera sample, detached.

    Of each the direction in the world frame, the factor on its radiance without the object [1], and
    whether it passes the object.
    """

    d_light: mi.Vector3f
    weight_light: mi.Float
    free_light: mi.Bool
    d_cosine: mi.Vector3f
    weight_cosine: mi.Float
    free_cosine: mi.Bool


class MitsubaScene:
    """One scene under one map.

    Args:
        scene: What to render.
        texels: Lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3].
        integrator: ``prb``, or ``gltf_path``, the referee's path replay.
        sampler: ``ldsampler`` is Mitsuba's best here: measured on the ball at 256 samples,
            ``independent`` takes 1.9 times as long for twice the error, ``multijitter`` 1.9 times
            as long for 0.9 of it.
        freeze: Whether Python traces each function once (``dr.freeze``), which saves up to 70 ms
            of a call, or each time.
    """

    def __init__(
        self,
        scene: SpeedScene,
        texels: FloatArray,
        integrator: str,
        sampler: str,
        freeze: bool,
    ) -> None:
        self.sampler = sampler
        self.setup = build(scene.asset, scene.matrix, scene.camera, texels, scene.depth)
        width = scene.camera.width
        rows, columns = scene.object_pixels // width, scene.object_pixels % width
        top, left = int(rows.min()), int(columns.min())
        height = int(rows.max()) + 1 - top
        self.crop = (height, int(columns.max()) + 1 - left)
        self.rows_of_objects = (rows - top) * self.crop[1] + columns - left
        self.plane_height = float(-self.setup.center[1] / self.setup.radius)
        self.crop_offset = (left, top)
        self.width = width
        # The referee's, which knows whether rays pass through glass
        self.integrator = self.setup.integrator
        if integrator != "gltf_path":
            self.integrator = mi.load_dict(
                {"type": integrator, "max_depth": scene.depth + 1, "hide_emitters": True}
            )
        self.plane_count = len(scene.receiver_pixels)
        self.parameters = mi.traverse(self.setup.scene)
        dr.enable_grad(self.parameters["light.texels"])
        self.parameters.update()
        d_image = np.zeros((self.crop[0] * self.crop[1], 3), np.float32)
        d_image[self.rows_of_objects] = scene.weight_fg
        self.weight_ratio = color(scene.weight_ratio)
        self.given: dict[str, Any] = {
            "scene": self.setup.scene,
            "sensor": sensor_of(
                scene.camera,
                self.setup.center,
                self.setup.radius,
                sampler,
                crop_offset_x=left,
                crop_offset_y=top,
                crop_width=self.crop[1],
                crop_height=height,
            ),
            "texels": self.parameters["light.texels"],
            "d_image": mi.TensorXf(d_image.reshape(*self.crop, 3)),
            "pixels": mi.UInt32(scene.receiver_pixels.astype(np.uint32)),
            "weight_ratio": self.weight_ratio,
        }
        """All arrays that a frozen function reads."""
        dr.eval(self.given)
        wrap = dr.freeze(warn_after=1000) if freeze else (lambda function: function)
        self.render = wrap(self._render)
        self.render_backward = wrap(self._render_backward)
        self.render_plane = wrap(self._render_plane)
        self.plane_step = wrap(self._plane_step)

    def largest_pass(self, part: str, spp: int) -> int:
        """Samples per pixel of the longest pass, which decide what is compiled."""
        pixels = self.plane_count if part == "ratio" else self.crop[0] * self.crop[1]
        return max(pass_spp for _, pass_spp in _passes(pixels, spp, 0))

    def foreground(self, spp: int, seed: int) -> mi.TensorXf:
        """Render the object alone, premultiplied by coverage, crop's shape."""
        return self._mean(self.render, spp, seed)

    def foreground_gradient(self, spp: int, seed: int) -> mi.TensorXf:
        """Gradient of the weighted foreground with respect to the texels, by path replay."""
        return self._mean(self.render_backward, spp, seed)

    def objects(self, image: mi.TensorXf) -> Float64Array:
        """Return the object pixels of `foreground`, shape [object_pixel, 3]."""
        return np.asarray(image, np.float64).reshape(-1, 3)[self.rows_of_objects]

    def ratio(self, spp: int, seed: int) -> mi.Color3f:
        """Render the shadow ratio."""
        return ratio_adjoint(*self.plane(spp, seed), self.weight_ratio)[2]

    def plane(self, spp: int, seed: int) -> tuple[mi.Color3f, mi.Color3f]:
        """Sum the plane's radiance with and without the object over all samples per pixel."""
        lit, unoccluded = (dr.zeros(mi.Color3f, self.plane_count) for _ in range(2))
        for pass_seed, pass_spp in _passes(self.plane_count, spp, seed):
            a, b = self.render_plane(self._inputs(), pass_seed, pass_spp)
            lit += a
            unoccluded += b
            dr.eval(lit, unoccluded)
        return lit, unoccluded

    def ratio_step(self, spp: int, seed: int) -> tuple[mi.Color3f, mi.TensorXf]:
        """Shadow ratio and the gradient of its weighted sum with respect to the texels.

        Samples of a single pass are kept for the backward pass, those of several traced again.
        """
        passes = list(_passes(self.plane_count, spp, seed))
        if len(passes) == 1:
            ratio, gradient = self.plane_step(self._inputs(), *passes[0])
            dr.eval(ratio, gradient)
            return ratio, gradient
        d_lit, d_unoccluded, ratio = ratio_adjoint(*self.plane(spp, seed), self.weight_ratio)
        return ratio, self.plane_gradient(spp, seed, d_lit, d_unoccluded)

    def plane_gradient(
        self, spp: int, seed: int, d_lit: mi.Color3f, d_unoccluded: mi.Color3f
    ) -> mi.TensorXf:
        """Gradient through the sums of `plane` for given adjoints."""
        texels = self.given["texels"]
        dr.set_grad(texels, 0.0)
        for pass_seed, pass_spp in _passes(self.plane_count, spp, seed):
            with dr.suspend_grad():
                samples = self._trace(self.given, pass_seed, pass_spp)
            self._backward(samples, d_lit, d_unoccluded, pass_spp)
            dr.eval(dr.grad(texels))
        return mi.TensorXf(dr.grad(texels))

    def _inputs(self) -> dict[str, Any]:
        """Return `given` in the one state that is recorded: without a gradient."""
        dr.clear_grad(self.given["texels"])
        return self.given

    def _mean(self, make: Callable[..., mi.TensorXf], spp: int, seed: int) -> mi.TensorXf:
        """Average an image or gradient over passes."""
        total = None
        for pass_seed, pass_spp in _passes(self.crop[0] * self.crop[1], spp, seed):
            part = make(self._inputs(), pass_seed, pass_spp) * (pass_spp / spp)
            total = part if total is None else total + part
            dr.eval(total)
        return total

    def _render(self, given: dict[str, Any], seed: mi.UInt32, spp: int) -> mi.TensorXf:
        with dr.suspend_grad():
            return self.integrator.render(given["scene"], given["sensor"], seed, spp)

    def _render_backward(self, given: dict[str, Any], seed: mi.UInt32, spp: int) -> mi.TensorXf:
        self.integrator.render_backward(
            given["scene"], self.parameters, given["d_image"], given["sensor"], seed, spp
        )
        return dr.grad(given["texels"])

    def _render_plane(
        self, given: dict[str, Any], seed: mi.UInt32, spp: int
    ) -> tuple[mi.Color3f, mi.Color3f]:
        with dr.suspend_grad():
            return self._radiance(self._trace(given, seed, spp), spp)

    def _plane_step(
        self, given: dict[str, Any], seed: mi.UInt32, spp: int
    ) -> tuple[mi.Color3f, mi.TensorXf]:
        with dr.suspend_grad():
            samples = self._trace(given, seed, spp)
            dr.eval(samples.__dict__)
            sums = self._radiance(samples, spp)
            d_lit, d_unoccluded, ratio = ratio_adjoint(*sums, given["weight_ratio"])
        self._backward(samples, d_lit, d_unoccluded, spp)
        return ratio, dr.grad(given["texels"])

    def _backward(
        self, samples: ReceiverSamples, d_lit: mi.Color3f, d_unoccluded: mi.Color3f, spp: int
    ) -> None:
        """Add one pass's gradient to the texels'."""
        index = dr.arange(mi.UInt32, self.plane_count * spp) // spp
        a = dr.gather(mi.Color3f, d_lit, index)
        b = dr.gather(mi.Color3f, d_unoccluded, index)
        loss = self._lookup(samples.d_light) * (
            samples.weight_light * (b + dr.select(samples.free_light, a, 0.0))
        )
        loss += self._lookup(samples.d_cosine) * (
            samples.weight_cosine * (b + dr.select(samples.free_cosine, a, 0.0))
        )
        dr.backward_from(loss)

    def _lookup(self, d: mi.Vector3f) -> mi.Color3f:
        return self.setup.scene.environment().radiance(d, mi.Bool(True))

    def _radiance(self, samples: ReceiverSamples, spp: int) -> tuple[mi.Color3f, mi.Color3f]:
        by_light = self._lookup(samples.d_light) * samples.weight_light
        by_cosine = self._lookup(samples.d_cosine) * samples.weight_cosine
        lit = dr.select(samples.free_light, by_light, 0.0)
        lit += dr.select(samples.free_cosine, by_cosine, 0.0)
        unoccluded = by_light + by_cosine
        # In one kernel: each reduction alone would evaluate, and trace, its input again
        dr.eval(lit, unoccluded)

        def reduce(value: mi.Color3f) -> mi.Color3f:
            return mi.Color3f(
                *(dr.block_reduce(dr.ReduceOp.Add, channel, spp) for channel in value)
            )

        return reduce(lit), reduce(unoccluded)

    def _trace(self, given: dict[str, Any], seed: mi.UInt32, spp: int) -> ReceiverSamples:
        """Draw one emitter and one cosine direction per camera sample and test both."""
        scene = given["scene"]
        emitter: LatlongEmitter = scene.environment()
        count = self.plane_count * spp
        sampler = mi.load_dict({"type": self.sampler, "sample_count": spp})
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, count)
        pixel = dr.gather(mi.UInt32, given["pixels"], dr.arange(mi.UInt32, count) // spp)
        width = self.width
        offset = sampler.next_2d()
        # Positions are shares of the crop
        position = mi.Point2f(
            (pixel % width + offset.x - self.crop_offset[0]) / self.crop[1],
            (pixel // width + offset.y - self.crop_offset[1]) / self.crop[0],
        )
        ray, _ = given["sensor"].sample_ray(0.0, 0.5, position, mi.Point2f(0.5))

        # Which comes first
        t = (self.plane_height - ray.o.y) / ray.d.y
        meets = (t > 0.0) & dr.isfinite(t)
        ray.maxt = dr.select(meets, t, 0.0)
        seen = meets & ~scene.ray_test(ray, True, active=meets)

        # Direct light on white: f cos_i = cos_i / pi, upper side
        it = dr.zeros(mi.SurfaceInteraction3f, count)
        it.p = ray(dr.select(seen, t, 0.0))
        it.p.y = self.plane_height
        start = mi.Point3f(it.p.x, it.p.y + 1e-5, it.p.z)

        def free(d: mi.Vector3f, active: mi.Bool) -> mi.Bool:
            return ~scene.ray_test(mi.Ray3f(start, d), False, active=active)

        ds, _ = emitter.sample_direction(it, sampler.next_2d(), seen)
        cos_i = dr.maximum(ds.d.y, 0.0)
        active = seen & (cos_i > 0.0) & (ds.pdf > 0.0)
        by_light = cos_i * dr.inv_pi / ds.pdf * mis_weight(ds.pdf, cos_i * dr.inv_pi)
        by_light = dr.select(active, by_light, 0.0)
        free_light = free(ds.d, active)

        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        d = mi.Vector3f(local.y, local.z, local.x)
        other = dr.zeros(mi.DirectionSample3f, count)
        other.d = d
        by_cosine = mis_weight(d.y * dr.inv_pi, emitter.pdf_direction(it, other, seen))
        by_cosine = dr.select(seen & (d.y > 0.0), by_cosine, 0.0)
        return ReceiverSamples(ds.d, by_light, free_light, d, by_cosine, free(d, seen))


def _passes(pixels: int, spp: int, seed: int) -> Iterator[tuple[mi.UInt32, int]]:
    """Seed and samples per pixel of each pass; powers of four, as the sampler wants."""
    largest = 4 ** ((max(1, PASS_SAMPLES[mi.variant()] // pixels).bit_length() - 1) // 2)
    for k, start in enumerate(range(0, spp, largest)):
        pass_seed = dr.opaque(mi.UInt32, (seed * 65537 + k) % (1 << 32))
        yield pass_seed, min(largest, spp - start)


def ratio_adjoint(
    lit: mi.Color3f, unoccluded: mi.Color3f, weight: mi.Color3f
) -> tuple[mi.Color3f, mi.Color3f, mi.Color3f]:
    """Return the adjoints of both sums for ``sum(weight * ratio)``, and the ratio."""
    seen = unoccluded > 0.0
    inverse = dr.select(seen, dr.rcp(dr.select(seen, unoccluded, 1.0)), 0.0)
    ratio = dr.select(seen, lit * inverse, 1.0)
    d_lit = weight * inverse
    d_unoccluded = dr.select(seen, -d_lit * ratio, 0.0)
    dr.eval(d_lit, d_unoccluded, ratio)
    return d_lit, d_unoccluded, ratio


def color(values: PixelArray) -> mi.Color3f:
    """Upload rows of RGB."""
    return mi.Color3f(*(mi.Float(np.ascontiguousarray(c, np.float32)) for c in values.T))
