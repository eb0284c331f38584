"""Launches that trace pixels: the object's G-buffer and radiance, and the receiver under it.

A launch's numbers depend on its arguments alone; `warpir.render.renderer` cuts the pixels where
memory is short.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import warp as wp

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.kernels.dielectric.glass import GLASS_DEPTH
from warpir.kernels.lamps.receiver import trace_lamps
from warpir.kernels.path import Viewer, foreground_kernel
from warpir.kernels.receiver import plane_shadow_kernel, trace_receiver
from warpir.kernels.tracing.gbuffer import trace_gbuffer
from warpir.kernels.types import CameraArgs, LightArgs, LightRecord, MaterialArgs, VertexRecord
from warpir.render.allocation import pilot_seed
from warpir.render.device import Rows

if TYPE_CHECKING:
    from warpir.render.device_scene import Scene
    from warpir.render.renderer import Renderer


def directions_of_path(scene: Scene, depth: int) -> int:
    """Return how many directions a path of ``depth`` interactions records at most.

    Two at each; at glass none goes on and sees the light.
    """
    return 2 * depth + (GLASS_DEPTH + 1 if scene.has_solid_glass else 0)


def variant_of(scene: Scene, materials: MaterialArgs, viewer: Viewer) -> tuple[int, ...]:
    """Return the variant of `foreground_kernel` that a scene needs."""
    return (
        materials.any_layers,
        bool(scene.receiver_args.mesh),
        viewer,
        bool(scene.lamps),
        scene.has_solid_glass and viewer != Viewer.GROUND,
        scene.has_passing,
    )


def uploaded(renderer: Renderer, pixels: IntArray, view: CameraArgs) -> wp.array:
    """Copy row-major pixel indices to the device.

    Args:
        renderer: The scene.
        pixels: Shape [pixel].
        view: Of the camera whose picture they are of; only the scene's own says how high it is.

    Raises:
        TypeError: It is a mask, whose values would be pixels 0 and 1.
        ValueError: A pixel lies outside the picture; one that the kernels would trace all the same.
    """
    if pixels.dtype == np.bool_:
        raise TypeError("pixels: expected row-major indices, as np.flatnonzero(mask) gives")
    scene, camera = renderer.scene, renderer.scene.camera
    count = camera.width * camera.height if view is scene.camera_args else 1 << 31
    if pixels.size and not 0 <= pixels.min() <= pixels.max() < count:
        found = f"found {pixels.min()} to {pixels.max()}"
        raise ValueError(f"pixels: expected row-major indices from 0 to {count - 1} ({found})")
    return renderer.upload(pixels, wp.int32)


def geometry_of(
    renderer: Renderer, pixels: IntArray, spp: int, seed: int
) -> tuple[FloatArray, ...]:
    """Return coverage, position, normal, base colour, roughness and emission, a row a pixel.

    Means over the samples that hit the object; positions in the scene's recentred frame [m].
    """
    scene, count = renderer.scene, len(pixels)
    kinds = (float, wp.vec3, wp.vec3, wp.vec3, float, wp.vec3)
    out = [renderer.zeros(count, kind) for kind in kinds]
    renderer.launch(
        trace_gbuffer,
        count,
        [
            Rows(uploaded(renderer, pixels, scene.camera_args)),
            scene.camera_args,
            *scene.geometry(),
            spp,
            seed,
            *map(Rows, out),
        ],
        spp,
        "geometry",
    )
    return tuple(array.numpy()[:count].copy() for array in out)


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
    ground_roughness: float | None = None
    """Of the coat in which the ground shows the object; None: the ground is white."""
    behind: LightArgs | None = None
    """What that coat shows where the object is not; None: the light."""
    is_recorded: bool = False
    """Whether to draw what a record holds, also where none is given."""

    def sums(
        self,
        renderer: Renderer,
        pixels: IntArray,
        spp: int,
        lanes: int,
        light_record: LightRecord | None = None,
        vertex_record: VertexRecord | None = None,
    ) -> tuple[FloatArray, ...]:
        """Return radiance, its diffuse and emitted parts, and coverage, a row a pixel.

        ``lanes`` threads share a pixel's samples; each has a row of the records.
        """
        out = [renderer.zeros(len(pixels), t) for t in (wp.vec3, wp.vec3, wp.vec3, float)]
        self._trace(renderer, pixels, None, spp, lanes, out, light_record, vertex_record)
        return tuple(a.numpy()[: len(pixels)] for a in out)

    def thrown(
        self,
        renderer: Renderer,
        pixels: IntArray,
        may_see_object: IntArray,
        spp: int,
        lanes: int,
        record: LightRecord | None = None,
    ) -> FloatArray:
        """Return what the object throws onto the white receiver, a row a pixel.

        ``lanes`` are as in `sums`.
        """
        out = renderer.zeros(len(pixels), wp.vec3)
        self._trace(renderer, pixels, may_see_object, spp, lanes, [out], record, None)
        radiance: FloatArray = out.numpy()[: len(pixels)]
        return radiance

    def mirrored(
        self, renderer: Renderer, pixels: IntArray, may_see_object: IntArray, spp: int, lanes: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the object's image in the ground's coat, what it hides there, and what not."""
        out = [renderer.zeros(len(pixels), wp.vec3) for _ in range(3)]
        self._trace(renderer, pixels, may_see_object, spp, lanes, out, None, None)
        image, hidden, kept = (a.numpy()[: len(pixels)] for a in out)
        return image, hidden, kept

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
        viewer, alpha = Viewer.GROUND if is_from_ground else Viewer.CAMERA, 0.0
        if self.ground_roughness is not None:
            viewer, alpha = Viewer.MIRROR, self.ground_roughness**2
        kernel = foreground_kernel(*variant_of(scene, self.materials, viewer))
        is_recorded = self.is_recorded or bool(light_record or vertex_record)
        hidden = None
        if may_see_object is not None:
            hidden = Rows(renderer.upload(may_see_object, wp.int32))
        renderer.launch(
            kernel,
            len(pixels),
            [
                Rows(uploaded(renderer, pixels, self.camera_args)),
                hidden,
                self.camera_args,
                *scene.geometry(self.materials),
                self.light,
                self.light if self.behind is None else self.behind,
                scene.lamp_args,
                scene.glass_args,
                spp // lanes,
                self.rays,
                lanes,
                self.depth + is_from_ground,
                1 if is_recorded else CANDIDATES,
                self.indirect_limit,
                self.seed,
                alpha,
                *map(Rows, out),
                *[None] * (4 - len(out)),
                LightRecord() if light_record is None else Rows(light_record),
                VertexRecord() if vertex_record is None else Rows(vertex_record),
            ],
            spp * self.rays,
            {Viewer.CAMERA: "object", Viewer.GROUND: "bounce", Viewer.MIRROR: "mirror"}[viewer],
            lanes,
        )


CANDIDATES = 8
"""Directions of the light among which the object's first vertex picks the one that it traces, with
what is expected of all as its control variate. Seconds times squared error on two cores: a quarter
of that of four without it on a matte ball, and two thirds on a metal one. Sixteen gain a fifth on
the ball and lose as much on an object in its own shadow."""
THROWN_LIMIT = 0.25
"""Of `ReceiverLaunch.indirect_limit`, for light on the ground: there ten samples, a third of 32, of
a path of radiance 1 leave a speck of a tenth, and the whole bounce is a few hundredths."""
THROWN_SHARE = 3
"""Samples of the receiver for one of the light that the object throws there: with as many it takes
three fifths of the time and holds a seventh of the squared error. Not in blocks of pixels, where
noise would bend what is interpolated."""


class ReceiverRows(NamedTuple):
    """Pixels of the receiver, a row each."""

    pixels: IntArray
    """Row-major indices."""
    may_see_object: IntArray
    """1 where the object may hide the receiver."""
    may_gain: BoolArray
    """False where the object throws nothing."""

    def at(self, rows: IntArray | BoolArray) -> ReceiverRows:
        """Return some of the rows."""
        return ReceiverRows(self.pixels[rows], self.may_see_object[rows], self.may_gain[rows])


@dataclass(frozen=True)
class ReceiverLaunch:
    """Arguments of a launch over the white receiver that all pixels share."""

    light: LightArgs
    """Drawn for the receiver (`warpir.render.device_light.drawn`)."""
    object_light: LightArgs | None
    """Drawn for the object, which throws it on; None: it throws nothing."""
    plane_radiance: Float64Array | None
    """Of the open receiver, shape [3]; None where that differs by place, or a record is kept."""
    camera_args: CameraArgs
    rays: int
    seed: int
    bounce_depth: int
    """Interactions with the object of light that it throws onto the receiver; 0: not traced."""
    indirect_limit: float
    is_recorded: bool = False
    """Of `ObjectLaunch`."""

    def sums(
        self,
        renderer: Renderer,
        seen: ReceiverRows,
        spp: int,
        lanes: int,
        record: LightRecord | None = None,
        thrown_record: LightRecord | None = None,
    ) -> tuple[FloatArray, ...]:
        """Return the radiance with and without the object and what it throws there, a row a pixel.

        The first includes the last. ``lanes`` threads share a pixel's samples; each has a row of
        the records.
        """
        pixels, may_see_object, may_gain = seen
        count = len(pixels)
        out = [renderer.zeros(count, wp.vec3) for _ in range(2)]
        common = [
            Rows(uploaded(renderer, pixels, self.camera_args)),
            Rows(renderer.upload(may_see_object, wp.int32)),
            self.camera_args,
            *renderer.scene.shadow_geometry(),
            self.light,
        ]
        rows, work = map(Rows, out), spp * self.rays
        shared = [spp // lanes, self.rays, lanes, self.seed, *rows]
        if self.plane_radiance is not None:
            args = [*common, wp.vec3(*map(float, self.plane_radiance)), *shared]
            kernel = plane_shadow_kernel(renderer.scene.has_passing)
        else:
            args = [*common, *shared, LightRecord() if record is None else Rows(record)]
            kernel = trace_receiver
        renderer.launch(kernel, count, args, work, "shadow", lanes)
        lit, unoccluded = (a.numpy()[:count] for a in out)
        if renderer.scene.lamps:
            near = self.by_lamps(renderer, pixels, may_see_object, spp)
            lit, unoccluded = lit + near[0], unoccluded + near[1]
        thrown = np.zeros_like(lit)
        if self.bounce_depth and may_gain.any():
            launch = self.thrown(renderer)
            few = spp if self.is_recorded else max(1, spp // THROWN_SHARE)
            lanes = lanes if self.is_recorded else renderer.lanes(int(may_gain.sum()), few)
            thrown[may_gain] = launch.thrown(
                renderer, pixels[may_gain], may_see_object[may_gain], few, lanes, thrown_record
            )
        return lit + thrown, unoccluded, thrown

    def by_lamps(
        self, renderer: Renderer, pixels: IntArray, may_see_object: IntArray, spp: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return what the lamps near the object add with and without it, a row a pixel."""
        out = [renderer.zeros(len(pixels), wp.vec3) for _ in range(2)]
        renderer.launch(
            trace_lamps,
            len(pixels),
            [
                Rows(uploaded(renderer, pixels, self.camera_args)),
                Rows(renderer.upload(may_see_object, wp.int32)),
                self.camera_args,
                *renderer.scene.shadow_geometry(),
                renderer.scene.lamp_args,
                spp,
                self.rays,
                self.seed,
                *map(Rows, out),
            ],
            spp * self.rays,
            "shadow",
        )
        lit, unoccluded = (a.numpy()[: len(pixels)] for a in out)
        return lit, unoccluded

    def thrown(self, renderer: Renderer) -> ObjectLaunch:
        """Return the launch that traces the object's light on the receiver."""
        assert self.object_light is not None
        return ObjectLaunch(
            self.object_light,
            renderer.scene.shadow_material_args,
            self.camera_args,
            self.rays,
            self.bounce_depth,
            THROWN_LIMIT * self.indirect_limit,
            self.seed,
            is_recorded=self.is_recorded,
        )


Launch = TypeVar("Launch", ObjectLaunch, ReceiverLaunch)


def launch_of_part(launch: Launch, number: int, share: float) -> Launch:
    """Return the launch of a part of a picture, or of a pilot (`warpir.render.allocation.Trace`).

    Args:
        launch: Of the picture.
        number: 0 for the picture, else the pilot's.
        share: Samples of the part's pixels over those asked for. The limit of a path grows with
            them: a path may then add as much to a pixel that has few samples as to one of many.
    """
    if number:
        return replace(launch, seed=pilot_seed(launch.seed, number))
    return replace(launch, indirect_limit=launch.indirect_limit * share)
