"""Fusion of two lights: the typeset equations, derived identities, gradients, black maps."""

import numpy as np
import pytest
import torch

from tests import oracles as o
from tests.statistics import central_differences, compare_gradients
from warpir.core.arrays import Float64Array
from warpir.lighting.fusion import fuse, fused_light

FLOAT64 = 1e-12
"""About ten float64 operations, relative."""
FLOAT32 = 2e-6
"""About ten float32 operations, relative to the brighter light."""
GRADIENT_RELATIVE_L2 = 1e-7
"""Central differences in float64, steps of 1e-5: 3e-8 of round-off, 1e-10 of curvature."""
FACTOR_MIN = 2.0 * np.sqrt(2.0) - 2.0
"""Least value of ``1 + S (S - F) / (M (F + S))``, at ``F = M`` and ``S = (sqrt 2 - 1) F``."""


def maps(rng: np.random.Generator, height: int = 4, width: int = 6) -> tuple[Float64Array, ...]:
    """Return two coloured maps of a contrast of 1e4."""
    first, second = np.exp(rng.uniform(np.log(1e-2), np.log(1e2), (2, height, width, 3)))
    return first, second


def run(fg: Float64Array, shadow: Float64Array, scale: float) -> tuple[Float64Array, ...]:
    first, second = fuse(torch.tensor(fg), torch.tensor(shadow), scale)
    return first.numpy(), second.numpy()


def test_fused_light_is_the_typeset_equation(rng: np.random.Generator) -> None:
    """Where the printed form is defined, the division-free one equals it (S 1-3)."""
    for _ in range(5):
        fg, shadow = maps(rng)
        fused = fused_light(torch.tensor(fg), torch.tensor(shadow)).numpy()
        np.testing.assert_allclose(fused, o.fuse_literal(fg, shadow), rtol=FLOAT64)


@pytest.mark.parametrize("scale", [0.0, 0.25, 0.5, 1.0])
def test_fuse_blends_both_maps(rng: np.random.Generator, scale: float) -> None:
    """``L' = s L_fused + (1 - s) L`` for both lights (S 6, S 7), in float64 and in float32."""
    fg, shadow = maps(rng)
    fused = o.fuse_literal(fg, shadow)
    expected = [scale * fused + (1.0 - scale) * x for x in (fg, shadow)]
    for found, truth in zip(run(fg, shadow, scale), expected, strict=True):
        np.testing.assert_allclose(found, truth, rtol=FLOAT64)
    single = fuse(torch.tensor(fg).float(), torch.tensor(shadow).float(), scale)
    for found, truth in zip(single, expected, strict=True):
        np.testing.assert_allclose(found.numpy(), truth, rtol=FLOAT32 * 10.0, atol=FLOAT32)


def test_scale_zero_separates_and_scale_one_unites(rng: np.random.Generator) -> None:
    """The ends are exact: the given maps, bit for bit, and one light."""
    fg, shadow = (x.astype(np.float32) for x in maps(rng))
    apart = run(fg, shadow, 0.0)
    np.testing.assert_array_equal(apart[0], fg)
    np.testing.assert_array_equal(apart[1], shadow)
    one = run(fg, shadow, 1.0)
    np.testing.assert_array_equal(one[0], one[1])


def test_factor_has_its_lower_bound(rng: np.random.Generator) -> None:
    """Fusion takes at most 17.2 % from a texel, and takes that much at ``S = (sqrt 2 - 1) F``."""
    grey = np.ones(3)
    fg = np.ones((64, 128, 1)) * grey
    shadow = np.exp(rng.uniform(-20.0, 20.0, (64, 128, 1))) * grey
    shadow[0, 0] = np.sqrt(2.0) - 1.0
    factor = fused_light(torch.tensor(fg), torch.tensor(shadow)).numpy() / fg
    assert factor.min() >= FACTOR_MIN - FLOAT64
    assert factor[0, 0, 0] == pytest.approx(FACTOR_MIN, rel=FLOAT64)
    fg = np.exp(rng.uniform(-20.0, 20.0, (64, 128, 3)))
    factor = fused_light(torch.tensor(fg), torch.tensor(shadow)).numpy() / fg
    assert factor.min() >= FACTOR_MIN - FLOAT64


def test_brightest_texel_and_dark_texels(rng: np.random.Generator) -> None:
    """At the peak ``(F^2 + S^2) / (F + S)``; toward ``F = 0`` it is ``F (1 + S / M)``."""
    fg, shadow = maps(rng)
    fused = o.luminance(fused_light(torch.tensor(fg), torch.tensor(shadow)).numpy())
    F, S = o.luminance(fg), o.luminance(shadow)
    at = np.unravel_index(np.argmax(F), F.shape)
    assert fused[at] == pytest.approx((F[at] ** 2 + S[at] ** 2) / (F[at] + S[at]), rel=FLOAT64)
    fg[0, 0] = 1e-12
    fused = o.luminance(fused_light(torch.tensor(fg), torch.tensor(shadow)).numpy())
    peak = o.luminance(fg).max()
    assert fused[0, 0] == pytest.approx(1e-12 * (1.0 + S[0, 0] / peak), rel=1e-8)


def test_equal_lights_and_chroma_stay(rng: np.random.Generator) -> None:
    """Equal maps fuse to themselves, and the fused chroma is always the foreground's."""
    fg, shadow = maps(rng)
    np.testing.assert_array_equal(fused_light(torch.tensor(fg), torch.tensor(fg)).numpy(), fg)
    fused = fused_light(torch.tensor(fg), torch.tensor(shadow)).numpy()
    chroma = [x / x.sum(axis=-1, keepdims=True) for x in (fused, fg)]
    np.testing.assert_allclose(chroma[0], chroma[1], rtol=FLOAT64)


def test_fusion_scales_with_both_lights(rng: np.random.Generator) -> None:
    """``fuse(a L) = a fuse(L)``: there is no absolute unit."""
    fg, shadow = maps(rng)
    for factor in (1e-20, 1e20):
        for scaled, plain in zip(
            run(factor * fg, factor * shadow, 0.4), run(fg, shadow, 0.4), strict=True
        ):
            np.testing.assert_allclose(scaled, factor * plain, rtol=FLOAT64)


@pytest.mark.parametrize("scale", [0.0, 0.3, 1.0])
def test_gradient_against_central_differences(rng: np.random.Generator, scale: float) -> None:
    """Both primed maps, by both given maps, the brightest texel's part included."""
    fg, shadow = maps(rng, 3, 4)
    y = rng.normal(size=(2, *fg.shape))

    def loss(a: Float64Array, b: Float64Array) -> float:
        return float(sum(np.sum(w * x) for w, x in zip(y, o.fuse(a, b, scale), strict=True)))

    tensors = [torch.tensor(x, requires_grad=True) for x in (fg, shadow)]
    found = fuse(*tensors, scale)
    sum((torch.tensor(w) * x).sum() for w, x in zip(y, found, strict=True)).backward()
    expected = [
        central_differences(lambda a: loss(a, shadow), fg, 1e-5 * fg),
        central_differences(lambda b: loss(fg, b), shadow, 1e-5 * shadow),
    ]
    for tensor, truth in zip(tensors, expected, strict=True):
        assert tensor.grad is not None
        match = compare_gradients(tensor.grad.numpy(), truth)
        assert match.relative_l2 < GRADIENT_RELATIVE_L2, match


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0.0, 1e-45, 1e-38, 1e-30])
def test_black_texels_and_maps_are_finite(dtype: torch.dtype, level: float) -> None:
    """Black or almost black, one map or both, everywhere or in a texel: the foreground stays."""
    for black_fg in ("none", "texel", "all"):
        for black_shadow in ("none", "texel", "all"):
            pair = []
            for kind, value in ((black_fg, 3.0), (black_shadow, 2.0)):
                texels = torch.full((2, 4, 3), value, dtype=dtype)
                if kind == "all":
                    texels[:] = level
                elif kind == "texel":
                    texels[0, 0] = level
                pair.append(texels.requires_grad_(True))
            primed = fuse(pair[0], pair[1], 0.5)
            (primed[0].sum() + primed[1].sum()).backward()
            for tensor in (*primed, *(p.grad for p in pair)):
                assert tensor is not None and bool(torch.isfinite(tensor).all())
            if level == 0.0:
                fused = fused_light(pair[0], pair[1]).detach()
                if black_fg == "all":
                    np.testing.assert_array_equal(fused.numpy(), pair[0].detach().numpy())
                elif black_fg == black_shadow == "texel":
                    np.testing.assert_array_equal(fused[0, 0].numpy(), 0.0)


def test_gradient_at_a_black_texel() -> None:
    """There the one-sided derivatives are ``1 + S / M`` by the foreground, 0 by the shadow."""
    fg = torch.full((1, 2, 3), 4.0, dtype=torch.float64)
    shadow = torch.full((1, 2, 3), 2.0, dtype=torch.float64)
    fg[0, 0] = 0.0
    fg.requires_grad_(True)
    shadow.requires_grad_(True)
    fused_light(fg, shadow)[0, 0].sum().backward()
    assert fg.grad is not None and shadow.grad is not None
    np.testing.assert_allclose(fg.grad[0, 0].numpy(), 1.0 + 2.0 / 4.0, rtol=FLOAT64)
    np.testing.assert_array_equal(shadow.grad[0, 0].numpy(), 0.0)


@pytest.mark.parametrize("scale", [-0.1, 1.1, float("nan")])
def test_scale_outside_its_range_is_refused(scale: float) -> None:
    with pytest.raises(ValueError, match="scale"):
        fuse(torch.ones(2, 4, 3), torch.ones(2, 4, 3), scale)


def test_maps_of_two_shapes_are_refused() -> None:
    for other in (torch.ones(2, 5, 3), torch.ones(2, 4)):
        with pytest.raises(ValueError, match="shape"):
            fuse(torch.ones(2, 4, 3), other, 0.5)
