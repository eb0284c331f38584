"""The interface of two dielectrics, in the frame of a normal (z) on the side of ``wo``.

Exact Fresnel terms, and Snell's law at the surface (smooth) or at GGX microfacets (Walter et al.
2007, "Microfacet Models for Refraction through Rough Surfaces", eqs. 20 and 21, with their
separable Smith masking). What is carried is radiance over the square of the index, which an
interface does not scale (Veach 1997, 5.2): the factors of entry and exit cancel, and glass without
a back is not darker. Refraction is tinted by the base colour at each crossing, as glTF's
specification multiplies the transmission's BTDF. Detached.
"""

import warp as wp

from warpir.kernels.bsdf import ALPHA_MIN, ggx_d, smith_lambda, visible_normal_sample

wp.set_module_options({"enable_backward": False})

SAME_INDEX = wp.constant(1.0e-3)
"""Indices that differ by less, as a share, do not bend light: it passes straight."""


@wp.struct
class Interface:
    """An interface as seen from ``wo``."""

    wo: wp.vec3
    """Unit direction toward the camera."""
    eta: float
    """Index of refraction beyond the interface over that on the side of ``wo``."""
    alpha: float
    """GGX roughness; up to `ALPHA_MIN` the interface is smooth."""
    tint: wp.vec3
    """Factor on what is refracted [1]."""


@wp.struct
class InterfaceSample:
    """A direction drawn from an interface."""

    wi: wp.vec3
    weight: wp.vec3
    """``f |cos| / pdf`` [1]; 0 where the draw must be dropped."""
    pdf: float
    """Density [1/sr]; 0 of a smooth interface."""


@wp.func
def fresnel_dielectric(cos_o: float, eta: float) -> float:
    """Return the share of unpolarised light that is reflected; 1 in total internal reflection.

    Args:
        cos_o: Cosine with the normal on the side that the light comes from, not negative.
        eta: Index of refraction beyond over that on this side.
    """
    sin2 = wp.max(1.0 - cos_o * cos_o, 0.0) / (eta * eta)
    if sin2 >= 1.0:
        return 1.0
    cos_t = wp.sqrt(1.0 - sin2)
    p = (eta * cos_o - cos_t) / (eta * cos_o + cos_t)
    s = (cos_o - eta * cos_t) / (cos_o + eta * cos_t)
    return 0.5 * (p * p + s * s)


@wp.func
def refracted(wo: wp.vec3, wm: wp.vec3, eta: float) -> wp.vec3:
    """Return the direction beyond by Snell's law; ``wo.wm > 0``, no total internal reflection."""
    cos_o = wp.dot(wo, wm)
    sin2 = wp.max(1.0 - cos_o * cos_o, 0.0) / (eta * eta)
    cos_t = wp.sqrt(wp.max(1.0 - sin2, 0.0))
    return wp.normalize(wm * (cos_o / eta - cos_t) - wo / eta)


@wp.func
def is_smooth(interface: Interface) -> bool:
    """Return whether a direction from ``wo`` goes on in one or two directions alone."""
    return interface.alpha <= ALPHA_MIN or wp.abs(interface.eta - 1.0) < SAME_INDEX


@wp.func
def interface_sample(interface: Interface, u: wp.vec2, u_part: float) -> InterfaceSample:
    """Draw a direction: visible normals, then reflection with the Fresnel term's probability."""
    sample = InterfaceSample()
    sample.weight = wp.vec3(0.0)
    sample.pdf = 0.0
    wo = interface.wo
    eta = interface.eta
    if wp.abs(eta - 1.0) < SAME_INDEX:
        sample.wi = -wo
        sample.weight = interface.tint
        return sample
    wm = wp.vec3(0.0, 0.0, 1.0)
    if interface.alpha > ALPHA_MIN:
        wm = visible_normal_sample(wo, interface.alpha, u)
    cos_o = wp.dot(wo, wm)
    if cos_o <= 0.0:
        return sample
    F = fresnel_dielectric(cos_o, eta)
    weight = wp.vec3(1.0)
    side = float(1.0)
    if u_part < F:
        sample.wi = wp.normalize(wm * (2.0 * cos_o) - wo)
    else:
        sample.wi = refracted(wo, wm, eta)
        weight = interface.tint
        side = -1.0
    if sample.wi[2] * side <= 0.0:
        return sample
    if interface.alpha > ALPHA_MIN:
        value = interface_f(interface, sample.wi)
        sample.pdf = value[3]
        # Of visible normals all but the masking of the new direction cancels.
        weight = weight / (1.0 + smith_lambda(sample.wi, interface.alpha))
        if sample.pdf <= 0.0:
            weight = wp.vec3(0.0)
    sample.weight = weight
    return sample


@wp.func
def interface_f(interface: Interface, wi: wp.vec3) -> wp.vec4:
    """Return ``f |cos|`` of a rough interface, RGB [1/sr], and the density of `interface_sample`.

    0 for a smooth one, whose directions no other technique finds.
    """
    wo = interface.wo
    eta = interface.eta
    nothing = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if is_smooth(interface) or wo[2] <= 0.0 or wi[2] == 0.0:
        return nothing
    wm = wo + wi
    if wi[2] < 0.0:
        wm = wo + wi * eta
    wm = wp.normalize(wm)
    if wm[2] < 0.0:
        wm = -wm
    cos_o = wp.dot(wo, wm)
    cos_i = wp.dot(wi, wm)
    if cos_o <= 0.0 or cos_i * wi[2] <= 0.0:
        return nothing
    F = fresnel_dielectric(cos_o, eta)
    alpha = interface.alpha
    # D with the masking of wo, over its cosine
    seen = ggx_d(wm, alpha) / ((1.0 + smith_lambda(wo, alpha)) * wp.max(wo[2], 1.0e-30))
    masking = 1.0 / (1.0 + smith_lambda(wi, alpha))
    if wi[2] > 0.0:
        pdf = F * seen * 0.25
        return wp.vec4(pdf * masking, pdf * masking, pdf * masking, pdf)
    # Walter et al. 2007, eq. 17
    root = cos_i + cos_o / eta
    pdf = (1.0 - F) * seen * cos_o * wp.abs(cos_i) / wp.max(root * root, 1.0e-30)
    f = interface.tint * (pdf * masking)
    return wp.vec4(f[0], f[1], f[2], pdf)
