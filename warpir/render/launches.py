"""Arguments of the launches that trace pixels: the object, and the receiver under it.

A launch's numbers depend on its arguments alone; `warpir.render.renderer` cuts the pixels where
memory is short.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpir.core.arrays import BoolArray, FloatArray, IntArray
from warpir.kernels.path import foreground_kernel
from warpir.kernels.receiver import trace_receiver
from warpir.kernels.types import CameraArgs, LightArgs, LightRecord, MaterialArgs, VertexRecord
from warpir.render.device import Rows

if TYPE_CHECKING:
    from warpir.render.renderer import Renderer


@dataclass(frozen=True)
class ObjectLaunch:
    """Arguments of a path-tracing launch over the object that all pixels share."""

    light: LightArgs
    materials: MaterialArgs
    camera_args: CameraArgs
    rays: int
    depth: int
    """Interactions with the object."""
    indirect_limit: float
    seed: int

    def sums(
        self,
        renderer: Renderer,
        pixels: IntArray,
        spp: int,
        lanes: int,
        light_record: LightRecord | None = None,
        vertex_record: VertexRecord | None = None,
    ) -> tuple[FloatArray, ...]:
        """Return radiance, its diffuse and emitted parts, and coverage, a row a pixel."""
        out = [renderer.zeros(len(pixels) * lanes, t) for t in (wp.vec3, wp.vec3, wp.vec3, float)]
        repeated = np.repeat(pixels, lanes)
        self._trace(renderer, repeated, None, spp // lanes, lanes, out, light_record, vertex_record)
        parts = (a.numpy()[: len(repeated)] for a in out)
        return tuple(p.reshape(-1, lanes, *p.shape[1:]).sum(axis=1) for p in parts)

    def thrown(
        self,
        renderer: Renderer,
        pixels: IntArray,
        may_see_object: IntArray,
        spp: int,
        record: LightRecord | None = None,
    ) -> FloatArray:
        """Return what the object throws onto the white receiver, a row a pixel."""
        out = renderer.zeros(len(pixels), wp.vec3)
        self._trace(renderer, pixels, may_see_object, spp, 1, [out], record, None)
        radiance: FloatArray = out.numpy()[: len(pixels)]
        return radiance

    def _trace(
        self,
        renderer: Renderer,
        pixels: IntArray,
        may_see_object: IntArray | None,
        spp: int,
        lanes: int,
        out: list[wp.array],
        light_record: LightRecord | None,
        vertex_record: VertexRecord | None,
    ) -> None:
        """Launch the kernel; what it does not look at is None."""
        scene, is_from_ground = renderer.scene, may_see_object is not None
        kernel = foreground_kernel(
            bool(self.materials.any_layers), bool(scene.receiver_args.mesh), is_from_ground
        )
        hidden = None
        if may_see_object is not None:
            hidden = Rows(renderer.upload(may_see_object, wp.int32))
        renderer.launch(
            kernel,
            len(pixels),
            [
                Rows(renderer.upload(pixels, wp.int32)),
                hidden,
                self.camera_args,
                *scene.geometry(self.materials),
                self.light,
                spp,
                self.rays,
                lanes,
                self.depth + is_from_ground,
                self.indirect_limit,
                self.seed,
                *map(Rows, out),
                *[None] * (4 - len(out)),
                LightRecord() if light_record is None else Rows(light_record),
                VertexRecord() if vertex_record is None else Rows(vertex_record),
            ],
            spp * self.rays,
            "bounce" if is_from_ground else "object",
        )


THROWN_LIMIT = 0.125
"""Of `ReceiverLaunch.indirect_limit`, for light on the ground: there 64 samples of a path of
radiance 8 leave a speck of a tenth, and the whole bounce is a few hundredths."""


@dataclass(frozen=True)
class ReceiverLaunch:
    """Arguments of a launch over the white receiver that all pixels share."""

    light: LightArgs
    camera_args: CameraArgs
    rays: int
    seed: int
    bounce_depth: int
    """Interactions with the object of light that it throws onto the receiver; 0: not traced."""
    indirect_limit: float

    def sums(
        self,
        renderer: Renderer,
        pixels: IntArray,
        may_see_object: IntArray,
        may_gain: BoolArray,
        spp: int,
        record: LightRecord | None = None,
        thrown_record: LightRecord | None = None,
    ) -> tuple[FloatArray, ...]:
        """Return the radiance with and without the object and what it throws there, a row a pixel.

        Where ``may_gain`` is False the object throws nothing. The first includes the last.
        """
        count = len(pixels)
        out = [renderer.zeros(count, wp.vec3) for _ in range(2)]
        renderer.launch(
            trace_receiver,
            count,
            [
                Rows(renderer.upload(pixels, wp.int32)),
                Rows(renderer.upload(may_see_object, wp.int32)),
                self.camera_args,
                *renderer.scene.geometry(),
                self.light,
                spp,
                self.rays,
                self.seed,
                *map(Rows, out),
                LightRecord() if record is None else Rows(record),
            ],
            spp * self.rays,
            "shadow",
        )
        lit, unoccluded = (a.numpy()[:count] for a in out)
        thrown = np.zeros_like(lit)
        if self.bounce_depth and may_gain.any():
            launch = self.thrown(renderer)
            thrown[may_gain] = launch.thrown(
                renderer, pixels[may_gain], may_see_object[may_gain], spp, thrown_record
            )
        return lit + thrown, unoccluded, thrown

    def thrown(self, renderer: Renderer) -> ObjectLaunch:
        """Return the launch that traces the object's light on the receiver."""
        return ObjectLaunch(
            self.light,
            renderer.scene.material_args,
            self.camera_args,
            self.rays,
            self.bounce_depth,
            THROWN_LIMIT * self.indirect_limit,
            self.seed,
        )
