"""Fusion of two lights: the typeset equations, their ends, black maps.

Gradients, lights far apart and black lights are among the hard cases of `benchmarks.stability`.
"""

import numpy as np
import pytest
import torch

from tests import oracles as o
from warpir.core.arrays import Float64Array
from warpir.lighting.fusion import fuse, fused_light

FLOAT64 = 1e-12
"""About ten float64 operations, relative."""
FLOAT32 = 2e-6
"""About ten float32 operations, relative to the brighter light."""


def maps(rng: np.random.Generator, height: int = 4, width: int = 6) -> tuple[Float64Array, ...]:
    """Return two coloured maps of a contrast of 1e4."""
    first, second = np.exp(rng.uniform(np.log(1e-2), np.log(1e2), (2, height, width, 3)))
    return first, second


def run(fg: Float64Array, shadow: Float64Array, scale: float) -> tuple[Float64Array, ...]:
    first, second = fuse(torch.tensor(fg), torch.tensor(shadow), scale)
    return first.numpy(), second.numpy()


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


def test_equal_lights_stay(rng: np.random.Generator) -> None:
    """Equal maps fuse to themselves."""
    fg, _ = maps(rng)
    np.testing.assert_array_equal(fused_light(torch.tensor(fg), torch.tensor(fg)).numpy(), fg)


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
