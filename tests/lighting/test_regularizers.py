"""Regularisers: closed forms, where their gradients go, black maps, and no dependence on texels."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tests import oracles as o
from tests.statistics import central_differences, compare_gradients
from warpir.core.arrays import Float64Array
from warpir.lighting.latlong_tensors import solid_angles
from warpir.lighting.regularizers import bend, chroma, consistency, spread
from warpir.lighting.sg_light import WIDEST, LightBounds, SGLight, narrowest
from warpir.render.tone_curve import Knots, ToneCurve
from warpir.scene.light import Lobes

FLOAT64 = 1e-12
"""About ten float64 operations, relative."""
FLOOR = 1e-6
"""What adding 1e-8 to densities of 1 / (4 pi) and less leaves of a closed form, relative."""


def maps(rng: np.random.Generator, height: int = 4) -> tuple[Float64Array, Float64Array]:
    """Two coloured maps of a contrast of 1e2."""
    first, second = np.exp(rng.uniform(np.log(0.1), np.log(10.0), (2, height, 2 * height, 3)))
    return first, second


def lights(rng: np.random.Generator) -> tuple[SGLight, SGLight]:
    """A sun and sky each, within the bounds of a map of 16 rows."""
    bounds = LightBounds(narrowest(16))
    made = []
    for _ in range(2):
        axis = o.normalize(rng.normal(size=(8, 3)))
        amplitude = rng.uniform(0.2, 1.0, (8, 3)) * np.r_[20.0, np.ones(7)][:, None]
        sharpness = np.r_[bounds.sigma_min**-2.0, rng.uniform(1.0, 8.0, 7)]
        parts = (a.astype(np.float32) for a in (amplitude, axis, sharpness))
        made.append(SGLight(Lobes(*parts), 1.0, bounds))
    return made[0], made[1]


def two_texels(first: float, second: float) -> Tensor:
    """A grey map of one row: both texels hold half of the sphere."""
    return torch.tensor([[[first] * 3, [second] * 3]], dtype=torch.float64)


def test_solid_angles_sum_to_the_sphere() -> None:
    for height in (1, 5, 64):
        texels = torch.zeros(height, 2 * height, 3, dtype=torch.float64)
        omega = solid_angles(texels)
        assert omega.shape == (height, 1) and omega.dtype is torch.float64
        assert float(omega.sum()) * 2 * height == pytest.approx(4.0 * np.pi, rel=FLOAT64)


# --------------------------------------------------------------------------- consistency


def test_consistency_of_equal_shapes_is_zero(rng: np.random.Generator) -> None:
    """Whatever the scales: the term sees shapes alone (eq. 10, normalised luminances)."""
    shape, _ = (torch.from_numpy(m) for m in maps(rng))
    for factor in (1e-10, 1.0, 1e10):
        assert abs(float(consistency(shape, factor * shape))) < FLOAT64
        assert abs(float(consistency(factor * shape, shape))) < FLOAT64


def test_consistency_of_a_dark_foreground_is_its_floor() -> None:
    """All light in a half that the foreground leaves black: ``log((1 / 2 pi) / 1e-8)``."""
    found = consistency(two_texels(1.0, 0.0), two_texels(0.0, 1.0))
    assert float(found) == pytest.approx(np.log(1.0 / (2.0 * np.pi) / 1e-8), rel=FLOOR)


def test_consistency_is_the_papers_less_the_entropy(rng: np.random.Generator) -> None:
    """Equation 10 is a cross entropy; what is subtracted is that of equal maps."""
    fg, shadow = maps(rng)
    expected = o.consistency(fg, shadow) - o.consistency(shadow, shadow)
    found = float(consistency(torch.from_numpy(fg), torch.from_numpy(shadow)))
    assert found == pytest.approx(expected, rel=1e-10) and found > 0.1


def test_consistency_pulls_the_foreground_alone(rng: np.random.Generator) -> None:
    """The shadow's light is detached; the foreground's gradient is that of the function."""
    fg, shadow = maps(rng, 3)
    tensors = [torch.tensor(m, requires_grad=True) for m in (fg, shadow)]
    consistency(*tensors).backward()
    assert tensors[1].grad is None and tensors[0].grad is not None
    expected = central_differences(
        lambda m: float(consistency(torch.from_numpy(m), torch.from_numpy(shadow))), fg, 1e-5 * fg
    )
    match = compare_gradients(tensors[0].grad.numpy(), expected)
    assert match.relative_l2 < 1e-7, match
    # A shape has no scale: moving along the map itself changes nothing.
    assert float((tensors[0].grad * tensors[0].detach()).sum()) == pytest.approx(0.0, abs=1e-9)


# -------------------------------------------------------------------------------- spread


def test_spread_is_the_papers(rng: np.random.Generator) -> None:
    for texels in maps(rng):
        assert float(spread(torch.from_numpy(texels))) == pytest.approx(o.cauchy(texels), rel=1e-12)


# -------------------------------------------------------------------------------- chroma


def sg_light(amplitude: Float64Array, sigma: Float64Array) -> SGLight:
    """Lobes of some amplitudes and widths, all around."""
    count = len(sigma)
    light = SGLight.uniform(count, 1.0, LightBounds(0.05, chroma=20.0))
    parts = (a.astype(np.float32) for a in (amplitude, light.lobes().axis, sigma**-2.0))
    return SGLight(Lobes(*parts), 1.0, light.bounds)


def test_chroma_of_white_is_zero() -> None:
    """At every brightness, and its gradient too."""
    light = sg_light(np.array([[1e-3] * 3, [1.0] * 3, [1e3] * 3]), np.array([0.1, 1.0, 3.0]))
    term = chroma(light)
    term.backward()
    assert float(term.detach()) < 1e-12
    assert light.chroma.grad is not None and float(light.chroma.grad.abs().max()) < 1e-6


def test_chroma_of_one_red_lobe_by_hand() -> None:
    """``(e^2, 1, 1)`` has the log ratios 4/3, -2/3, -2/3: ``24 / 9``, whatever its intensity."""
    for intensity in (1e-2, 1.0, 1e2):
        light = sg_light(intensity * np.array([[np.exp(2.0), 1.0, 1.0]]), np.array([0.5]))
        assert float(chroma(light).detach()) == pytest.approx(24.0 / 9.0, rel=1e-5)


@pytest.mark.parametrize("sigma", [0.05, 0.5, WIDEST])
def test_chroma_weighs_lobes_by_their_flux(sigma: float) -> None:
    """One red and one white lobe: the red one's share of the flux times its own term."""
    amplitude = np.array([[np.exp(2.0), 1.0, 1.0], [3.0, 3.0, 3.0]])
    widths = np.array([sigma, 1.0])
    flux = amplitude.mean(axis=1) * o.sg_flux(widths**-2.0)
    light = sg_light(amplitude, widths)
    expected = flux[0] / flux.sum() * 24.0 / 9.0
    assert float(chroma(light).detach()) == pytest.approx(expected, rel=1e-4)


def test_chroma_does_not_dim_colours() -> None:
    """It turns colours toward white and leaves intensity, axis and width alone."""
    light = sg_light(np.array([[2.0, 1.0, 1.0], [1.0, 1.0, 3.0]]), np.array([0.5, 1.0]))
    chroma(light).backward()
    assert light.chroma.grad is not None
    # Downhill is toward white: the gradient has the sign of the ratio.
    assert bool((light.chroma.grad * light.log_ratios().detach() > 0.0).all())
    for parameter in (light.log_intensity, light.axis, light.log_sigma):
        assert parameter.grad is None or not bool(parameter.grad.any())


# ---------------------------------------------------------------------------------- bend


def test_bend_of_the_identity_is_zero() -> None:
    """Untouched curves, and raw parameters that mean the identity too (softmax has a gauge)."""
    for curves in (1, 3):
        curve = ToneCurve(curves)
        with torch.no_grad():
            assert float(bend(curve())) < 1e-12
            curve.widths.add_(2.0)
            curve.heights.sub_(3.0)
            assert float(bend(curve())) < 1e-12


def test_bend_by_hand() -> None:
    """Mean square of ``y - x``, and a tenth of that of the slopes' logarithms."""
    x = torch.tensor([[0.0, 0.5, 1.0]])
    y = torch.tensor([[0.0, 0.8, 1.0]])
    slope = torch.tensor([[np.exp(1.0), 1.0, np.exp(-2.0)]])
    expected = 0.3**2 / 3.0 + 0.1 * (1.0 + 0.0 + 4.0) / 3.0
    assert float(bend(Knots(x, y, slope))) == pytest.approx(expected, rel=1e-5)


def test_bend_draws_curves_back(rng: np.random.Generator) -> None:
    """Steps downhill from any curve end at the identity."""
    curve = ToneCurve(3)
    with torch.no_grad():
        for parameter in curve.parameters():
            parameter.copy_(torch.from_numpy(rng.normal(0.0, 1.0, parameter.shape)))
        start = float(bend(curve()))
    optimizer = torch.optim.Adam(curve.parameters(), lr=0.1)
    for _ in range(100):
        optimizer.zero_grad()
        term = bend(curve())
        term.backward()
        optimizer.step()
    assert start > 0.05 and float(term.detach()) < 1e-4


# --------------------------------------------------------------------- black, resolution


@pytest.mark.parametrize("level", [0.0, 1e-45, 1e-38, 1e-30, 1e-20])
def test_regularizers_are_finite_at_black_maps(level: float) -> None:
    """Black or almost black, one map or both: value and float32 gradient are finite."""
    for first, second in ((level, 1.0), (1.0, level), (level, level)):
        fg = torch.full((8, 16, 3), first, requires_grad=True)
        shadow = torch.full((8, 16, 3), second, requires_grad=True)
        total = consistency(fg, shadow) + spread(shadow)
        total.backward()
        for tensor in (total, fg.grad, shadow.grad):
            assert tensor is not None and bool(tensor.isfinite().all()), (first, second)


def test_regularizers_are_finite_at_a_black_texel() -> None:
    """One dark texel among light, as `texels` has where every lobe underflows."""
    for k in range(2):
        pair = [torch.ones(8, 16, 3), torch.ones(8, 16, 3)]
        pair[k][2, 3] = 0.0
        fg, shadow = (m.requires_grad_(True) for m in pair)
        (consistency(fg, shadow) + spread(shadow)).backward()
        for tensor in (fg, shadow):
            assert tensor.grad is not None and bool(tensor.grad.isfinite().all())


def test_regularizers_do_not_depend_on_the_resolution(rng: np.random.Generator) -> None:
    """The same light on 16, 32 and 64 rows costs the same to 0.5 %, gradients to 2 %.

    The narrowest lobe spans 1.25 texels of the smallest map, where up to 3 % of its flux may be
    gained near a pole; elsewhere the sums agree to 0.1 %.
    """
    fg, shadow = lights(rng)
    values, gradients = [], []
    for height in (16, 32, 64):
        texels_fg, texels_shadow = fg.texels(height), shadow.texels(height)
        terms = consistency(texels_fg, texels_shadow), spread(texels_shadow)
        leaves = [*fg.parameters(), *shadow.parameters()]
        gradient = torch.autograd.grad(terms[0] + terms[1], leaves)
        gradients.append(torch.cat([g.reshape(-1) for g in gradient]).double().numpy())
        values.append([float(t.detach()) for t in terms])
    for k in range(2):
        assert values[k] == pytest.approx(values[2], rel=0.005)
        match = compare_gradients(gradients[k], gradients[2])
        assert match.relative_l2 < 0.02, match
