"""The trust region: zero at its middle, in the stated units, with the gradient of what it says."""

import math

import numpy as np
import pytest
import torch

from tests.statistics import central_differences, compare_gradients
from warpir.lighting.regularizers import (
    LOG_STD_MIN,
    SHAPE_STD,
    SPREAD_MIN,
    TrustRegion,
    squared_angle,
)
from warpir.lighting.sg_light import LightBounds, SGLight
from warpir.scene.light import Lobes, fibonacci

BOUNDS = LightBounds(0.05)


def light(seed: int = 0) -> SGLight:
    """A sun and five broad lobes of several colours."""
    rng = np.random.default_rng(seed)
    amplitude = rng.uniform(0.3, 1.0, (6, 3)).astype(np.float32)
    amplitude[0] *= 40.0
    sharpness = np.array([100.0, *[4.0] * 5], np.float32)
    return SGLight(Lobes(amplitude, fibonacci(6).astype(np.float32), sharpness), 0.5, BOUNDS)


def turned(axis: torch.Tensor, degrees: float) -> torch.Tensor:
    """Turn a direction within the plane of itself and +X."""
    side = torch.tensor([1.0, 0.0, 0.0], dtype=axis.dtype)
    side = torch.nn.functional.normalize(side - (side @ axis) * axis, dim=0)
    angle = math.radians(degrees)
    return math.cos(angle) * axis + math.sin(angle) * side


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 0.1, 1.0, 30.0, 90.0, 179.0])
def test_squared_angle(degrees: float) -> None:
    axis = torch.nn.functional.normalize(torch.tensor([0.2, 0.7, -0.4], dtype=torch.float64), dim=0)
    found = float(squared_angle(turned(axis, degrees), axis))
    assert found == pytest.approx(math.radians(degrees) ** 2, rel=2e-4, abs=1e-20)


def test_nothing_pulls_at_the_start() -> None:
    """Distance and gradient are 0 where the light starts."""
    start = light()
    region = TrustRegion.around(start, 0.2, 0.5, 0.4)
    distance = region.distance(start)
    distance.backward()
    assert float(distance.detach()) == 0.0
    for parameter in start.parameters():
        gradient = parameter.grad
        assert gradient is None or float(gradient.abs().max()) == 0.0


def test_distance_is_in_units_of_the_uncertainty() -> None:
    """One spread of angle, one deviation of either flux: 1 each, and they add up."""
    start, spread, sun_std, ambient_std = light(), math.radians(12.0), 0.5, 0.3
    region = TrustRegion.around(start, spread, sun_std, ambient_std)

    def distance(turn: float = 0.0, sun: float = 0.0, ambient: float = 0.0) -> float:
        moved = light()
        with torch.no_grad():
            moved.axis[0] = turned(moved.axis[0], turn)
            moved.log_intensity[0] += sun
            moved.log_intensity[1:] += ambient
        return float(region.distance(moved))

    assert distance(turn=12.0) == pytest.approx(1.0, rel=1e-4)
    assert distance(turn=36.0) == pytest.approx(9.0, rel=1e-4)
    assert distance(sun=0.5) == pytest.approx(1.0, rel=1e-4)
    assert distance(ambient=-0.6) == pytest.approx(4.0, rel=1e-4)
    assert distance(12.0, -0.5, 0.3) == pytest.approx(3.0, rel=1e-4)


def test_the_other_lobes_change_together() -> None:
    """What one of them does alone costs its share, in units of the shape's deviation."""
    start = light()
    region = TrustRegion.around(start, 0.2, 0.5, 0.4)
    log_fluxes = region.log_fluxes.double()
    share = float(torch.exp(log_fluxes[2]) / torch.exp(log_fluxes).sum())
    with torch.no_grad():
        start.log_intensity[3] += 0.4
        start.axis[4] = turned(start.axis[4], 10.0)
    change = math.log1p(share * math.expm1(0.4))
    turned_share = float(torch.exp(log_fluxes[3]) / torch.exp(log_fluxes).sum())
    away = share * (0.4 - change) ** 2 + (1.0 - share) * change**2
    away += turned_share * (2.0 * math.sin(math.radians(5.0))) ** 2
    expected = away / SHAPE_STD**2 + (change / 0.4) ** 2
    assert float(region.distance(start).detach()) == pytest.approx(expected, rel=1e-4)


def test_softness_and_colour_are_free() -> None:
    """A lobe that is wider at the same flux, or of another colour at the same luminance."""
    region = TrustRegion.around(light(), 0.2, 0.5, 0.4)
    wide = light()
    with torch.no_grad():
        before = torch.exp(2.0 * wide.log_sigma[0])
        wide.log_sigma[0] += 0.7
        after = torch.exp(2.0 * wide.log_sigma[0])
        flux = [v * -torch.expm1(-2.0 / v) for v in (before, after)]
        wide.log_intensity[0] += torch.log(flux[0] / flux[1])
    assert float(region.distance(wide)) == pytest.approx(0.0, abs=1e-9)


def test_what_is_too_sure_is_not_believed() -> None:
    """Five degrees, and a tenth in the logarithms, are the least."""
    region = TrustRegion.around(light(), 1e-3, 1e-3, 1e-3)
    assert (region.spread, region.sun_std) == (SPREAD_MIN, LOG_STD_MIN)
    assert region.ambient_std == LOG_STD_MIN and math.degrees(SPREAD_MIN) == pytest.approx(5.0)


def test_gradient_is_the_distances() -> None:
    """Central differences in float64, over every kind of parameter at once."""
    region = TrustRegion.around(light(), 0.2, 0.5, 0.4)
    moved = light(3).double()
    names = ("log_intensity", "chroma", "axis", "log_sigma")
    shapes = [getattr(moved, name).shape for name in names]
    start = torch.cat([getattr(moved, name).detach().flatten() for name in names])
    region.distance(moved).backward()
    found = torch.cat([getattr(moved, name).grad.flatten() for name in names])

    def value(numbers: np.ndarray) -> float:
        other = light(3).double()
        parts = torch.tensor(numbers).split([math.prod(shape) for shape in shapes])
        for name, part, shape in zip(names, parts, shapes, strict=True):
            getattr(other, name).data = part.view(shape)
        with torch.no_grad():
            return float(region.distance(other))

    match = compare_gradients(found, central_differences(value, start.numpy(), 1e-5))
    assert match.relative_l2 < 1e-6 and float(found.abs().max()) > 0.1
