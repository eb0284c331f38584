"""Transfer functions and matrices against colour-science and against their own inverses."""

import subprocess
import sys

import numpy as np
import pytest

from warpir.core import color


def test_srgb_pair_inverts_itself_beyond_the_unit_range() -> None:
    encoded = np.linspace(-0.5, 1.5, 4001)
    np.testing.assert_allclose(
        color.linear_to_srgb(color.srgb_to_linear(encoded)), encoded, atol=2e-8
    )


def test_srgb_pair_and_matrix_equal_colour_science() -> None:
    colour = color.colour_science()
    encoded = np.linspace(0.0, 1.0, 1001)
    np.testing.assert_allclose(
        color.srgb_to_linear(encoded), colour.models.eotf_sRGB(encoded), atol=1e-12
    )
    space = colour.RGB_COLOURSPACES["ITU-R BT.709"]
    np.testing.assert_allclose(
        color.REC709_CHROMATICITIES, [*space.primaries.ravel(), *space.whitepoint], atol=1e-12
    )
    rgb_to_xyz = colour.models.normalised_primary_matrix(space.primaries, space.whitepoint)
    np.testing.assert_allclose(color.XYZ_TO_REC709 @ rgb_to_xyz, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(rgb_to_xyz[1], color.LUMINANCE_WEIGHTS, atol=1e-4)


def test_gamma_pair_is_the_papers() -> None:
    photo_srgb = np.array([0.0, 0.25, 0.5, 1.0], np.float32)
    photo_lin = color.gamma_to_linear(photo_srgb)
    assert photo_lin.dtype == np.float32
    np.testing.assert_allclose(photo_lin, photo_srgb.astype(np.float64) ** 2.2, rtol=1e-6)
    np.testing.assert_allclose(color.linear_to_gamma(photo_lin), photo_srgb, rtol=1e-6)
    assert color.linear_to_gamma(np.array([-1.0])) == 0.0


def test_luminance_of_white_is_one() -> None:
    assert color.luminance(np.ones((2, 3))) == pytest.approx(1.0)


def test_colour_science_leaves_no_mock_of_matplotlib() -> None:
    """Diffusers looks for Matplotlib at import, and fails on a module without ``__spec__``."""
    script = (
        "import importlib.util, sys\n"
        "sys.modules['matplotlib'] = None\n"
        "from warpir.core.color import chromaticities_of\n"
        "chromaticities_of('P3-D65')\n"
        "print(importlib.util.find_spec('matplotlib'), 'colour' in sys.modules)\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["None", "True"]
