"""Hard cases of spherical Gaussians: sharpness 1e-3, a flat sky, to 1e6, narrower than a sun."""

import numpy as np
import warp as wp

from benchmarks.stability.case import (
    MAX_RELATIVE,
    RELATIVE,
    Case,
    Float64Array,
    Measured,
    Quantity,
    finite,
    from_mitsuba,
    launch,
    lit,
    max_relative,
    table,
    to_mitsuba,
    upload,
)
from benchmarks.stability.maps import evaluate
from tests import oracles as o
from tests.builders.shapes import all_pixels, camera, lobe
from warpir.kernels.sampling import lobe_sample
from warpir.render.device_light import light_args
from warpir.scene.light import Light, Lobes, rasterize_lobes

SHARPNESS = (1e-3, 1e-1, 1.0, 30.0, 1e3, 6e3, 1e5, 1e6)
AXIS = np.array([0.48, -0.6, 0.64], np.float32)
"""A general direction: no component is 0."""
Z = np.array([0.0, 0.0, 1.0], np.float32)
"""The axis of Mitsuba's lobes."""
EXPONENT = 20.0
"""Cases reach out to ``exp(-20)``, 2e-9 of the peak."""
NO_LOBES = "has no spherical-Gaussian light"

VALUE = 2e-5
"""The exponent, up to 20, carries about 16 roundings of 2^-24 = 6e-8 from the float32 directions,
the squared chord and the product."""
CDF_ARITHMETIC, CDF_DIRECTION = 5e-7, 2e-7
"""Eight roundings, and three roundings of a unit direction times the lobe's width ``sqrt(s)``."""
POWER = 1e-2
"""What `warpir.scene.light.rasterize_lobes` states."""
PLANE = 2e-3
"""Noise of 64 x 256 low-discrepancy samples, as in the renderer's own tests."""
HOST = 2e-3
"""256 rings of equal probability about a lobe, midpoint rule, relative to the lobe's flux."""
FLUX = 1e-12
"""A few float64 operations."""


@wp.kernel(enable_backward=False)
def sample_kernel(u: wp.array[wp.vec2], axis: wp.vec3, sharpness: float, wi: wp.array[wp.vec3]):
    """Draw directions from given numbers."""
    i = wp.tid()
    wi[i] = lobe_sample(u[i], axis, sharpness)


def directions(sharpness: float, axis: np.ndarray) -> np.ndarray:
    """Return float32 unit directions out to `EXPONENT`, as far as the sphere goes."""
    rng, count = np.random.default_rng(1), 20000
    t = rng.uniform(0.0, min(EXPONENT / sharpness, 2.0), count)
    # Through the sine, which keeps the digits of a small angle.
    sine, phi = np.sqrt(t * (2.0 - t)), rng.uniform(0.0, 2.0 * np.pi, count)
    local = np.stack([sine * np.cos(phi), sine * np.sin(phi), 1.0 - t], axis=-1)
    return np.asarray((local @ o.frame_of(axis).T).astype(np.float32))


def radiance(device: str, sharpness: float) -> Measured:
    """Radiance of one lobe, at directions out to `EXPONENT`."""
    amplitude, s = np.array([[0.7, 1.3, 2.0]], np.float32), np.array([sharpness], np.float32)
    light = light_args(Light(Lobes(amplitude, AXIS[None], s)), wp.get_device(device))
    v = directions(sharpness, AXIS)
    found, _ = evaluate(device, light, v)
    truth = o.sg_radiance(v, amplitude, o.normalize(AXIS)[None], s)
    return Measured(max_relative(found, truth), finite(found))


def sampling_error(wi: Float64Array, u: Float64Array, axis: np.ndarray, sharpness: float) -> float:
    """Return the largest distance of a sample's CDF, about the axis, from the number it is of."""
    t = o.one_minus_cos(wi, axis)
    return float(np.max(np.abs(np.expm1(-sharpness * t) / np.expm1(-2.0 * sharpness) - u)))


def numbers() -> np.ndarray:
    """Return uniform float32 pairs, the ends of the interval among them."""
    u = np.random.default_rng(3).random((20000, 2), dtype=np.float32)
    u[:4, 0] = [0.0, 2.0**-24, 0.5, 1.0 - 2.0**-24]
    return u


def sampling(device: str, sharpness: float) -> Measured:
    """Draw from one lobe: does the direction lie where the inverted CDF says?"""
    u = numbers()
    s = float(np.float32(sharpness))
    inputs = [upload(u, wp.vec2, device), wp.vec3(*map(float, AXIS)), s]
    (d,) = launch(sample_kernel, len(u), inputs, wp.vec3, device=device)
    return Measured(sampling_error(d, u[:, 0].astype(np.float64), AXIS, s), finite(d))


def density(device: str, sharpness: float) -> Measured:
    """Density of the light's proposal, at directions out to `EXPONENT`."""
    light = light_args(lobe(AXIS, sharpness), wp.get_device(device))
    v = directions(sharpness, AXIS)
    _, pdf = evaluate(device, light, v)
    truth = o.sg_pdf(v, AXIS, float(np.float32(sharpness)))
    return Measured(max_relative(pdf, truth), finite(pdf))


def host_map(device: str, sharpness: float) -> Measured:
    """Power of a lobe on a map of 64 x 128 texels, near a pole too."""
    found = []
    for axis in ([0.3, 0.8, -0.5], [0.0, 1.0, 0.0], [0.02, -0.99, 0.05]):
        lobes = lobe(axis, sharpness).lobes
        assert lobes is not None
        texels = rasterize_lobes(lobes, 64, 128).astype(np.float64)
        found.append(np.einsum("ijc,i->c", texels, o.texel_solid_angle(64, 128)))
    truth = float(o.sg_flux(float(np.float32(sharpness))))
    return Measured(max_relative(found, np.full_like(found, truth)), finite(found))


def flux(device: str, sharpness: float) -> Measured:
    """Closed-form integral over the sphere against Gauss-Legendre in ``1 - cos``."""
    s = float(np.float32(sharpness))
    lobes = Lobes(np.ones((1, 3), np.float32), AXIS[None], np.array([s], np.float32))
    edges = np.concatenate([[0.0], np.geomspace(1e-3 / max(s, 1.0), 1.0, 80)]) * min(2.0, 745.0 / s)
    t, weight = o.gauss_legendre(edges, 20)
    truth = 2.0 * np.pi * float(np.sum(weight * np.exp(-s * t)))
    return Measured(max_relative(lobes.flux(), np.full((1, 3), truth)), finite(lobes.flux()))


def host_irradiance(device: str, sharpness: float) -> Measured:
    """Irradiance of a plane by `warpir.scene.light`: the lobe high, grazing, below the horizon."""
    errors, values = [], []
    for elevation in (90.0, 30.0, 1.0, 0.0, -1.0, -20.0, -90.0):
        a = np.radians(elevation)
        axis = np.array([np.cos(a), np.sin(a), 0.0])
        up = np.array([0.0, 1.0, 0.0])
        found = lobe(axis, sharpness).irradiance(up)
        truth = o.sg_irradiance(up, axis, float(np.float32(sharpness)))
        errors.append(np.abs(found - truth).max() / float(o.sg_flux(sharpness)))
        values.append(found)
    return Measured(float(np.max(errors)), finite(values))


def plane(device: str, sharpness: float) -> Measured:
    """Radiance of a white plane under a slanted lobe."""
    view = camera(8, 8, 500.0, (0.0, 50.0, 0.0), -90.0)
    pixels = all_pixels(view)
    axis = o.normalize([0.5, 0.6, 0.2]).astype(np.float32)
    renderer, args = lit(device, [], view, lobe(axis, sharpness), height=0.0)
    white = renderer.receiver(args, pixels, np.zeros(len(pixels), np.int32), 256, 1, 5)
    truth = o.sg_irradiance([0.0, 1.0, 0.0], axis, float(np.float32(sharpness))) / np.pi
    found = white.unoccluded.astype(np.float64).mean(axis=0)
    return Measured(max_relative(found, np.full(3, truth)), finite(found))


# ------------------------------------------------------------------------------ Mitsuba


def mitsuba_pdf(sharpness: float) -> tuple[np.ndarray, Float64Array]:
    """Return the same directions about +Z and Mitsuba's von Mises-Fisher density there."""
    import mitsuba as mi

    v = directions(sharpness, Z)
    pdf = mi.warp.square_to_von_mises_fisher_pdf(to_mitsuba(v), mi.Float(sharpness))
    return v, np.array(pdf).astype(np.float64)


def mitsuba_density(sharpness: float) -> float:
    """Error of that density."""
    v, pdf = mitsuba_pdf(sharpness)
    return max_relative(pdf, o.sg_pdf(v, Z, float(np.float32(sharpness))))


def mitsuba_radiance(sharpness: float) -> float:
    """Error of the same density over its peak, which is a lobe of amplitude 1."""
    v, pdf = mitsuba_pdf(sharpness)
    s = float(np.float32(sharpness))
    truth = o.sg_radiance(v, np.ones((1, 1)), Z[None], np.array([s]))[:, 0]
    return max_relative(pdf * float(o.sg_flux(s)), truth)


def mitsuba_sampling(sharpness: float) -> float:
    """Error of Mitsuba's von Mises-Fisher sampler in the same measure."""
    import mitsuba as mi

    u = numbers()
    # Its polar angle is a function of the second number.
    d = mi.warp.square_to_von_mises_fisher(
        mi.Point2f(u[:, 1].copy(), u[:, 0].copy()), mi.Float(sharpness)
    )
    s = float(np.float32(sharpness))
    return sampling_error(from_mitsuba(d), u[:, 0].astype(np.float64), Z, s)


def cdf_bound(sharpness: float) -> float:
    """Return what the arithmetic and the float32 direction do to a lobe's CDF."""
    return CDF_ARITHMETIC + CDF_DIRECTION * max(1.0, float(np.sqrt(sharpness)))


def cases() -> list[Case]:
    """Return the rows of this group."""
    return table(
        "Spherical Gaussians",
        {f"sharpness {s:g}": (s,) for s in SHARPNESS},
        Quantity("radiance", MAX_RELATIVE, radiance, VALUE, mitsuba_radiance),
        Quantity("sampling", "max CDF distance", sampling, cdf_bound, mitsuba_sampling),
        Quantity("density", MAX_RELATIVE, density, VALUE, mitsuba_density),
        Quantity("integral", RELATIVE, flux, FLUX, NO_LOBES),
        Quantity("power on a 64 x 128 map, host", RELATIVE, host_map, POWER, NO_LOBES),
        Quantity("irradiance, host", "max over the flux", host_irradiance, HOST, NO_LOBES),
        Quantity("white plane", RELATIVE, plane, PLANE, NO_LOBES),
    )
