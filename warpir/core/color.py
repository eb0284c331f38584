"""Colour: the one place for transfer functions, luminance weights and chromaticities.

Working space: linear Rec.709 primaries with a D65 white, unclamped. Two pairs of transfer
functions exist on purpose: the sRGB pair describes what files mean, the gamma 2.2 pair is what
DiPIR uses between the photograph and the renderer (`photo_lin = photo_srgb ** 2.2`).
"""

import sys
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from warpir.core.arrays import AnyFloatArray, CodeArray

LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Luminance of linear Rec.709 red, green and blue [1]."""

REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""CIE xy of red, green, blue and white (D65), in the order of the OpenEXR attribute."""

GAMMA = 2.2
"""Exponent of DiPIR's transfer function [1] (supplement, section B)."""

WHITE_PERCENTILE, WHITE = 99.0, 0.9
"""An exposed photo shows this percentile of its encoded values above 0 [%] as this value [1]."""

XYZ_TO_REC709 = np.array(
    [
        [3.2409699419, -1.5373831776, -0.4986107603],
        [-0.9692436363, 1.8759675015, 0.0415550574],
        [0.0556300797, -0.2039769589, 1.0569715142],
    ]
)
"""CIE XYZ (D65, Y = 1 for white) to linear Rec.709, column vectors, shape [3, 3]."""


INTEROP_SPACES = {
    "lin_ap1_scene": "ACEScg",
    "lin_ap0_scene": "ACES2065-1",
    "lin_rec2020_scene": "ITU-R BT.2020",
    "lin_p3d65_scene": "P3-D65",
    "lin_adobergb_scene": "Adobe RGB (1998)",
}
"""Linear spaces of the OpenEXR attribute ``colorInteropID``, by colour-science's names."""


def chromaticities_of(space: str) -> tuple[float, ...]:
    """Return CIE xy of red, green, blue and white of one of colour-science's RGB spaces."""
    found = colour_science().RGB_COLOURSPACES[space]
    return (*found.primaries.ravel().tolist(), *np.asarray(found.whitepoint).tolist())


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
    colour = colour_science()
    to_xyz = colour.models.normalised_primary_matrix(xy[:3], xy[3])
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(
        colour.xy_to_XYZ(xy[3]), colour.xy_to_XYZ(np.asarray(white)), transform="Bradford"
    )
    matrix: AnyFloatArray = adapt @ to_xyz
    return matrix


def primaries_to_rec709(chromaticities: Sequence[float]) -> AnyFloatArray:
    """Return the matrix from linear RGB of some primaries to ours, white on white, [3, 3]."""
    matrix: AnyFloatArray = XYZ_TO_REC709 @ primaries_to_xyz(
        chromaticities, REC709_CHROMATICITIES[6:]
    )
    return matrix


def colour_science() -> Any:
    """Import colour-science, which takes a second, for the few files that need it.

    Where Matplotlib is absent, colour-science leaves a mock of it in ``sys.modules``, and then
    diffusers, which looks for Matplotlib, cannot be imported any more. So the mock is taken out.
    """
    plotting = {n: m for n, m in sys.modules.items() if n.split(".")[0] == "matplotlib"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Matplotlib, which we do not need, is absent
        import colour
    for name in [n for n in sys.modules if n.split(".")[0] == "matplotlib"]:
        if getattr(sys.modules[name], "__spec__", None) is None:
            del sys.modules[name]
    sys.modules.update({n: m for n, m in plotting.items() if n not in sys.modules})
    return colour


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


def expose(radiance: AnyFloatArray) -> tuple[AnyFloatArray, float]:
    """Expose radiance as a photograph (as the estimators' training and evaluation do).

    Returns:
        Display-encoded values in [0, 1], of the same shape, and the exposure [EV]. What is black
        everywhere stays so.
    """
    encoded = linear_to_gamma(radiance)
    seen = encoded[encoded > 0.0]
    alpha = WHITE / float(np.percentile(seen, WHITE_PERCENTILE)) if seen.size else 1.0
    return np.clip(alpha * encoded, 0.0, 1.0), float(GAMMA * np.log2(alpha))


def codes_of(encoded: AnyFloatArray) -> CodeArray:
    """Return the nearest 8-bit codes of display-encoded values, clipped to [0, 1]."""
    return np.round(255.0 * np.clip(encoded, 0.0, 1.0)).astype(np.uint8)
