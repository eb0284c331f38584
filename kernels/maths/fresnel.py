"""Fresnel terms: Schlick's, and that of a thin film on a base.

The film is that of KHR_materials_iridescence: Belcour & Barla 2017, "A Practical Extension to
Microfacet Theory for the Modeling of Varying Iridescence", without polarisation, with Schlick's
term at both interfaces. Airy's sum over the reflections within the film is a cosine series of the
phase. It is integrated in closed form against the eye's response, whose fit is a sum of Gaussians
in the wave number; the second order is the last.
"""

import math

import warp as wp

_RADIANS = 2e-9 * math.pi
"""Phase over path times wave number, with the path in nm [rad m/nm]."""


def _response(weight: float, center: float, spread: float) -> tuple[float, float, float]:
    """Return height [1], phase over path [rad/nm] and damping [1/nm^2] of one Gaussian of the fit.

    Args:
        weight: ``val`` of the specification.
        center: Wave number ``pos`` [1/m].
        spread: Half the variance, ``var`` [1/m^2].
    """
    height = weight * math.sqrt(2.0 * math.pi * spread) / 1.0685e-7
    return height, center * _RADIANS, spread * _RADIANS**2


_X = _response(5.4856e-13, 1.6810e6, 4.3278e9)
_Y = _response(4.4201e-13, 1.7953e6, 9.3046e9)
_Z = _response(5.2481e-13, 2.2084e6, 6.6121e9)
_BLUE_X = _response(9.7470e-14, 2.2399e6, 4.5282e9)
HEIGHT = wp.constant(wp.vec4(_X[0], _Y[0], _Z[0], _BLUE_X[0]))
TURN = wp.constant(wp.vec4(_X[1], _Y[1], _Z[1], _BLUE_X[1]))
DAMPING = wp.constant(wp.vec4(_X[2], _Y[2], _Z[2], _BLUE_X[2]))
"""Of CIE X, Y and Z, and the blue part of X."""


@wp.func
def schlick(cos_d: float) -> float:
    """Schlick's ``(1 - cos)^5``."""
    x = wp.clamp(1.0 - cos_d, 0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


@wp.func
def seen_wave(path: float, shift: wp.vec3) -> wp.vec3:
    """Return ``cos(2 pi path / wavelength + shift)`` as the eye sees it, linear Rec.709 [1].

    Args:
        path: Optical path difference [nm].
        shift: Phase, one for each of X, Y and Z [rad].
    """
    fade = -path * path
    X = HEIGHT[0] * wp.cos(TURN[0] * path + shift[0]) * wp.exp(DAMPING[0] * fade)
    X += HEIGHT[3] * wp.cos(TURN[3] * path + shift[0]) * wp.exp(DAMPING[3] * fade)
    Y = HEIGHT[1] * wp.cos(TURN[1] * path + shift[1]) * wp.exp(DAMPING[1] * fade)
    Z = HEIGHT[2] * wp.cos(TURN[2] * path + shift[2]) * wp.exp(DAMPING[2] * fade)
    return wp.vec3(
        3.2404542 * X - 1.5371385 * Y - 0.4985314 * Z,
        -0.9692660 * X + 1.8760108 * Y + 0.0415560 * Z,
        0.0556434 * X - 0.2040259 * Y + 1.0572252 * Z,
    )


@wp.func
def film_fresnel(f0: wp.vec3, ior: float, thickness: float, cos_d: float) -> wp.vec3:
    """Return the reflectance of a film on a base, linear Rec.709, brought into 0 ... 1.

    Some of the model's colours are outside of that. The path difference is the paper's, with the
    angle in the film; the specification's text has the angle outside, its sample viewer does not.

    Args:
        f0: Reflectance of the base in air at normal incidence [1].
        ior: Index of refraction of the film, at least 1.
        thickness: Of the film [nm].
        cos_d: Cosine of the angle of incidence [1].
    """
    cos_in = wp.sqrt(wp.max(1.0 - (1.0 - cos_d * cos_d) / (ior * ior), 0.0))
    outer = (ior - 1.0) / (ior + 1.0)
    R12 = outer * outer + (1.0 - outer * outer) * schlick(cos_d)
    T121 = 1.0 - R12
    weight = schlick(cos_in)
    C0 = wp.vec3(0.0)
    C1 = wp.vec3(0.0)
    C2 = wp.vec3(0.0)
    shift = wp.vec3(0.0)
    for k in range(3):
        # The bounds keep its index finite, and its derivative.
        root = wp.sqrt(wp.clamp(f0[k], 1.0e-6, 0.9999))
        base = (1.0 + root) / (1.0 - root)
        inner = (base - ior) / (base + ior)
        R23 = inner * inner + (1.0 - inner * inner) * weight
        # The floor keeps the root's derivative finite.
        R123 = wp.clamp(R12 * R23, 1.0e-10, 0.9999)
        Rs = T121 * T121 * R23 / (1.0 - R123)
        C0[k] = R12 + Rs
        C1[k] = 2.0 * (Rs - T121) * wp.sqrt(R123)
        C2[k] = 2.0 * (Rs - T121) * R123
        # Light turns by half a wave where it meets the higher index: outside, and at the base.
        shift[k] = wp.PI
        if base < ior:
            shift[k] = 2.0 * wp.PI
    path = 2.0 * ior * thickness * cos_in
    out = C0 + wp.cw_mul(C1, seen_wave(path, shift))
    out += wp.cw_mul(C2, seen_wave(2.0 * path, 2.0 * shift))
    return wp.vec3(
        wp.clamp(out[0], 0.0, 1.0), wp.clamp(out[1], 0.0, 1.0), wp.clamp(out[2], 0.0, 1.0)
    )
