"""Colour: the one place for transfer functions, luminance weights and chromaticities.

Working space: linear Rec.709 primaries with a D65 white, unclamped. Two pairs of transfer
functions exist on purpose: the sRGB pair describes what files mean, the gamma 2.2 pair is what
DiPIR uses between the photograph and the renderer (`photo_lin = photo_srgb ** 2.2`).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]

LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Luminance of linear Rec.709 red, green and blue [1]."""

REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""CIE xy of red, green, blue and white (D65), in the order of the OpenEXR attribute."""

GAMMA = 2.2
"""Exponent of DiPIR's transfer function [1] (supplement, section B)."""

XYZ_TO_REC709 = np.array(
    [
        [3.2409699419, -1.5373831776, -0.4986107603],
        [-0.9692436363, 1.8759675015, 0.0415550574],
        [0.0556300797, -0.2039769589, 1.0569715142],
    ]
)
"""CIE XYZ (D65, Y = 1 for white) to linear Rec.709, column vectors, shape [3, 3]."""


def luminance(rgb: FloatArray) -> FloatArray:
    """Return the luminance of linear Rec.709 colours, shape [..., 3] to [...]."""
    red, green, blue = LUMINANCE_WEIGHTS
    total: FloatArray = red * rgb[..., 0] + green * rgb[..., 1] + blue * rgb[..., 2]
    return total


def srgb_to_linear(srgb: FloatArray) -> FloatArray:
    """Decode sRGB (IEC 61966-2-1), odd about 0 so that out-of-gamut values survive."""
    size = np.abs(srgb)
    linear = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(linear, srgb).astype(srgb.dtype, copy=False)


def linear_to_srgb(linear: FloatArray) -> FloatArray:
    """Encode linear light as sRGB (IEC 61966-2-1), odd about 0: inverse of `srgb_to_linear`."""
    size = np.abs(linear)
    srgb = np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1.0 / 2.4) - 0.055)
    return np.copysign(srgb, linear).astype(linear.dtype, copy=False)


def gamma_to_linear(encoded: FloatArray) -> FloatArray:
    """Decode the photograph as DiPIR does: ``encoded ** 2.2``, negative values as 0."""
    return np.maximum(encoded, 0) ** encoded.dtype.type(GAMMA)


def linear_to_gamma(linear: FloatArray) -> FloatArray:
    """Encode the composite as DiPIR does: ``linear ** (1 / 2.2)``, negative values as 0."""
    return np.maximum(linear, 0) ** linear.dtype.type(1.0 / GAMMA)
