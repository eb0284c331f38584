"""Colour: the one place for transfer functions, luminance weights and chromaticities.

Working space: linear Rec.709 primaries with a D65 white, unclamped. Two pairs of transfer
functions exist on purpose: the sRGB pair describes what files mean, the gamma 2.2 pair is what
DiPIR uses between the photograph and the renderer (`photo_lin = photo_srgb ** 2.2`).
"""

from collections.abc import Sequence

import numpy as np

from warpir.core.arrays import AnyFloatArray

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


INTEROP_SPACES = {
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767),
    "lin_ap0_scene": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
    "lin_rec2020_scene": (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329),
    "lin_p3d65_scene": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329),
    "lin_adobergb_scene": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.329),
}
"""CIE xy of red, green, blue and white of the linear spaces that the OpenEXR attribute
``colorInteropID`` names: ACEScg, ACES2065-1, Rec.2020, P3-D65, Adobe RGB (1998)."""

BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
"""CIE XYZ to the cone responses in which whites are adapted (Lam 1985; ICC.1, annex E)."""


def are_primaries(chromaticities: Sequence[float]) -> bool:
    """Return whether eight numbers can be CIE xy of red, green, blue and white."""
    xy = np.asarray(chromaticities, np.float64)
    if xy.shape != (8,) or not np.isfinite(xy).all() or (np.abs(xy) > 2.0).any() or xy[7] <= 0.0:
        return False
    (xr, yr), (xg, yg), (xb, yb), _ = xy.reshape(4, 2)
    return bool(abs((xg - xr) * (yb - yr) - (xb - xr) * (yg - yr)) > 1e-3)


def primaries_to_xyz(chromaticities: Sequence[float], white: Sequence[float]) -> AnyFloatArray:
    """Return the matrix from linear RGB of some primaries to CIE XYZ, shape [3, 3].

    Args:
        chromaticities: CIE xy of red, green, blue and the primaries' own white.
        white: CIE xy of the white that theirs is adapted to (Bradford), with Y = 1.
    """
    xy = np.asarray(chromaticities, np.float64).reshape(4, 2)
    rgb, own = _xyz_of(xy[:3]).T, _xyz_of(xy[3]) / xy[3, 1]
    adapted = _xyz_of(np.asarray(white, np.float64)) / white[1]
    # Each primary as strong as it must be for all of them together to give their white (SMPTE
    # RP 177), then the whites' cone responses divided.
    to_xyz = rgb * np.linalg.solve(rgb, own)
    cones = (BRADFORD @ adapted) / (BRADFORD @ own)
    matrix: AnyFloatArray = np.linalg.solve(BRADFORD, cones[:, None] * BRADFORD) @ to_xyz
    return matrix


def _xyz_of(xy: AnyFloatArray) -> AnyFloatArray:
    """Return the CIE xyz of chromaticities, whose sum is 1, shape [..., 2] to [..., 3]."""
    xyz: AnyFloatArray = np.concatenate([xy, 1.0 - xy.sum(axis=-1, keepdims=True)], axis=-1)
    return xyz


def primaries_to_rec709(chromaticities: Sequence[float]) -> AnyFloatArray:
    """Return the matrix from linear RGB of some primaries to ours, white on white, [3, 3]."""
    matrix: AnyFloatArray = XYZ_TO_REC709 @ primaries_to_xyz(
        chromaticities, REC709_CHROMATICITIES[6:]
    )
    return matrix


def luminance(rgb: AnyFloatArray) -> AnyFloatArray:
    """Return the luminance of linear Rec.709 colours, shape [..., 3] to [...]."""
    red, green, blue = LUMINANCE_WEIGHTS
    total: AnyFloatArray = red * rgb[..., 0] + green * rgb[..., 1] + blue * rgb[..., 2]
    return total


def srgb_to_linear(srgb: AnyFloatArray) -> AnyFloatArray:
    """Decode sRGB (IEC 61966-2-1), odd about 0 so that out-of-gamut values survive."""
    size = np.abs(srgb)
    linear = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(linear, srgb).astype(srgb.dtype, copy=False)


def linear_to_srgb(linear: AnyFloatArray) -> AnyFloatArray:
    """Encode linear light as sRGB (IEC 61966-2-1), odd about 0: inverse of `srgb_to_linear`."""
    size = np.abs(linear)
    srgb = np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1.0 / 2.4) - 0.055)
    return np.copysign(srgb, linear).astype(linear.dtype, copy=False)


def gamma_to_linear(encoded: AnyFloatArray) -> AnyFloatArray:
    """Decode the photograph as DiPIR does: ``encoded ** 2.2``, negative values as 0."""
    return np.maximum(encoded, 0) ** encoded.dtype.type(GAMMA)


def linear_to_gamma(linear: AnyFloatArray) -> AnyFloatArray:
    """Encode the composite as DiPIR does: ``linear ** (1 / 2.2)``, negative values as 0."""
    return np.maximum(linear, 0) ** linear.dtype.type(1.0 / GAMMA)
