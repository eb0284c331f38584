"""Launches `warpir.kernels.lamps.places`: derivatives of radiance to the place of a lamp."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpir.core.arrays import FloatArray, IntArray
from warpir.kernels.lamps.places import trace_ground_places, trace_places
from warpir.render.device import Rows
from warpir.render.launches import uploaded
from warpir.render.renderer import Renderer


def place_slopes(
    renderer: Renderer,
    object_pixels: IntArray,
    receiver_pixels: IntArray,
    may_see_object: IntArray,
    spp: int,
    depth: int,
    seed: int,
) -> tuple[FloatArray, ...]:
    """Trace the derivatives of radiance to the place of the scene's one lamp.

    Unbiased, at edges of shadows too. Left out is what a surface that touches the lamp adds; a
    glossy surface of low roughness has the right mean, and much noise.

    Args:
        renderer: A scene with one lamp.
        object_pixels: Row-major pixel indices, shape [object_pixel].
        receiver_pixels: The same of the receiver, shape [receiver_pixel].
        may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
        spp: Camera samples per pixel, each with one path.
        depth: Surface interactions of the object's paths.
        seed: Base seed.

    Returns:
        Of the object, and of the receiver with and without it, what the object throws there
        included: relative [W/(m^3 sr)], by world axis, shape [3, pixel, 3] each.

    Raises:
        ValueError: There is solid glass, through which no direction on the rim can be drawn.
    """
    scene, depth_thrown = renderer.scene, renderer.bounce_depth
    if scene.has_solid_glass:
        raise ValueError("no derivative to a lamp's place through solid glass")
    everywhere = np.zeros(len(object_pixels), np.int32)

    def traced(
        kernel: wp.Kernel, outputs: int, pixels: IntArray, *args: object
    ) -> list[FloatArray]:
        out = [renderer.zeros(len(pixels), wp.mat33) for _ in range(outputs)]
        given = [Rows(uploaded(renderer, pixels, scene.camera_args)), *args, seed, *map(Rows, out)]
        renderer.launch(kernel, len(pixels), given, spp * depth, "lamps")
        planes = tuple(a.numpy()[: len(pixels)] for a in out)
        width = scene.camera.width
        clean = renderer.bad_pixels.blackened(planes, pixels, width, "slope of a lamp")
        return [plane.transpose(1, 0, 2) for plane in clean]

    seen, hidden = (Rows(renderer.upload(a, wp.int32)) for a in (everywhere, may_see_object))
    view, lamp, ground = scene.camera_args, scene.lamp_args, scene.shadow_geometry()
    own = scene.geometry()
    (shown,) = traced(trace_places, 1, object_pixels, seen, 0, view, *own, lamp, spp, depth)
    halves = (hidden, view, *ground, lamp, spp)
    lit, unoccluded = traced(trace_ground_places, 2, receiver_pixels, *halves)
    if depth_thrown:
        thrown = (hidden, 1, view, *ground, lamp, spp, depth_thrown + 1)
        lit = lit + traced(trace_places, 1, receiver_pixels, *thrown)[0]
    return shown, lit, unoccluded
