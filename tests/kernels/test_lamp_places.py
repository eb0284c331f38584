"""Directions on a lamp's rim: the derivative of closed irradiance to the lamp's place."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import launch
from tests.kernels.test_lamps import INSIDE, NORMALS, POINTS, RECTANGLE, SPHERE
from tests.statistics import central_differences
from warpir.core.arrays import Float64Array
from warpir.kernels.lamps.places import rim_point
from warpir.kernels.types import LampArgs
from warpir.render.device_light import lamp_args
from warpir.scene.near.lamps import Lamp, irradiance

SIDE = 512
"""Of the grid of midpoints on the unit square of the draw."""
WITHIN = 2e-3
"""Of the gradient's length: the midpoint rule across the horizon's kink, and float32."""

wp.set_module_options({"enable_backward": False})


@wp.kernel
def rim_kernel(lamps: LampArgs, p: wp.vec3, normal: wp.vec3, side: int, slope: wp.array[wp.vec3]):
    i = wp.tid()
    u = wp.vec2((float(i % side) + 0.5) / float(side), (float(i // side) + 0.5) / float(side))
    rim = rim_point(lamps, 0, p, u)
    slope[i] = wp.vec3(0.0)
    if rim.valid == 1:
        slope[i] = rim.speed * wp.max(wp.dot(rim.wi, normal), 0.0)


def found(lamp: Lamp, point: Float64Array, normal: Float64Array, device: str) -> Float64Array:
    """Derivative of irradiance by radiance 1 to x, y and z."""
    args = lamp_args([lamp], np.zeros(3), wp.get_device(device))
    inputs = [args, wp.vec3(*point), wp.vec3(*normal), SIDE]
    (slope,) = launch(rim_kernel, SIDE * SIDE, inputs, wp.vec3, device=device)
    return np.asarray(slope.mean(axis=0))


@pytest.mark.parametrize("lamp", [SPHERE, RECTANGLE], ids=["sphere", "rectangle"])
@pytest.mark.parametrize("normal", NORMALS)
def test_rim_gives_the_derivative_of_closed_irradiance(
    lamp: Lamp, normal: Float64Array, device: str
) -> None:
    """Near, far, where the horizon cuts the lamp, and behind."""
    for point in POINTS:

        def closed(center: Float64Array, point: Float64Array = point) -> float:
            moved = replace(lamp, center=center)
            return float(irradiance(moved, point, normal)[0] / moved.radiance[0])

        slope = central_differences(closed, lamp.center, 1e-5)
        own = found(lamp, point, normal, device)
        assert np.linalg.norm(own - slope) <= WITHIN * np.linalg.norm(slope) + 1e-9, (point, slope)


def test_rim_is_none_within_a_sphere_and_behind_a_rectangle(device: str) -> None:
    """What shines from all sides, or not at all, does not depend on the lamp's place."""
    for point in INSIDE:
        assert not found(SPHERE, point, NORMALS[0], device).any()
    above = RECTANGLE.center + np.cross(RECTANGLE.edge_x, RECTANGLE.edge_y) * -2.0
    assert not found(RECTANGLE, above, NORMALS[3], device).any()
