"""Hard cases of the material: roughness down to the clamp, grazing angles, normals facing away."""

from typing import Any

import numpy as np
import warp as wp

from benchmarks.stability.case import (
    MAX_ABSOLUTE,
    MAX_RELATIVE,
    RELATIVE,
    Case,
    Float64Array,
    Measured,
    Quantity,
    differentiate,
    finite,
    from_mitsuba,
    launch,
    lit,
    max_relative,
    table,
    to_mitsuba,
    upload,
    worst_l2,
)
from tests import oracles as o
from tests.builders.shapes import all_pixels, camera, placed, quad
from warpir.kernels.bsdf import bsdf_f, bsdf_of, bsdf_sample
from warpir.kernels.maths.frame import basis
from warpir.kernels.types import Layers
from warpir.scene.asset import Material, Primitive

CLAMP = 0.0317
"""Roughness just above the clamp: its square is 1.005e-3, the least GGX width 1e-3."""
ROUGHNESS = (0.0, CLAMP, 0.1, 0.5, 1.0)
GRAZING = (1e-2, 1e-4, 1e-6)
"""Cosines of both directions."""

VALUE = 1e-5
"""About forty roundings of 2^-24, those of the half vector's slope four times: 120 of 6e-8."""
GRADIENT = 1e-5
"""The same; each row is a number of its own, so no sum cancels."""
NORMALS = 2e-3
"""Noise of 16 x 4096 low-discrepancy samples with an importance-sampled lobe."""
FRAME = 1e-6
"""Eight roundings of 2^-24, near -Z too."""


@wp.kernel
def eval_kernel(
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    base_color: wp.array[wp.vec3],
    metallic: wp.array[float],
    roughness: wp.array[float],
    f: wp.array[wp.vec3],
    pdf: wp.array[float],
):
    """Value and density of the material."""
    i = wp.tid()
    value = bsdf_f(bsdf_of(wo[i], base_color[i], metallic[i], roughness[i], Layers()), wi[i])
    f[i] = value.diffuse + value.specular
    pdf[i] = value.pdf


@wp.kernel(enable_backward=False)
def sample_kernel(wo: wp.vec3, u: wp.array[wp.vec2], roughness: float, wi: wp.array[wp.vec3]):
    """Draw directions from given numbers."""
    i = wp.tid()
    wi[i] = bsdf_sample(bsdf_of(wo, wp.vec3(1.0), 1.0, roughness, Layers()), u[i], 0.5)


@wp.kernel(enable_backward=False)
def frame_kernel(n: wp.array[wp.vec3], x: wp.array[wp.vec3], y: wp.array[wp.vec3]):
    """Tangents of the frame round a normal."""
    i = wp.tid()
    frame = basis(n[i])
    x[i] = frame.x
    y[i] = frame.y


def evaluate(
    device: str,
    wo: np.ndarray,
    wi: np.ndarray,
    base_color: np.ndarray,
    metallic: np.ndarray,
    roughness: np.ndarray,
    y: np.ndarray | None = None,
) -> tuple[Float64Array, Float64Array, list[Float64Array]]:
    """Return value, density and gradients of the material; ``y`` weights the value, or 1."""
    arrays = [
        upload(wo, wp.vec3, device),
        upload(wi, wp.vec3, device),
        upload(base_color, wp.vec3, device, True),
        upload(metallic, float, device, True),
        upload(roughness, float, device, True),
    ]
    weights = np.ones(np.shape(wo)) if y is None else y
    (f, pdf), gradients = differentiate(eval_kernel, arrays, weights, wp.vec3, float, device=device)
    return f, pdf, gradients


def pairs(roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 directions above the surface, half of them within the mirror lobe."""
    rng, count = np.random.default_rng(4), 20000
    cos = np.exp(rng.uniform(np.log(1e-3), 0.0, (2, count)))
    wo, wi = (o.spherical(c, rng.uniform(0.0, 2.0 * np.pi, count)) for c in cos)
    alpha = float(o.ggx_alpha(roughness))
    half = count // 2
    cosine = np.cos(np.arctan(alpha * rng.uniform(0.0, 3.0, half)))
    wm = o.spherical(cosine, rng.uniform(0.0, 6.28, half))
    mirrored = 2.0 * o.dot(wo[:half], wm)[:, None] * wm - wo[:half]
    wi[:half] = np.where(mirrored[:, 2:] > 1e-3, mirrored, wi[:half])
    return wo.astype(np.float32), wi.astype(np.float32)


def metal(count: int, roughness: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a white metal: F = 1, specular alone, which Mitsuba has too."""
    return np.ones((count, 3)), np.ones(count), np.full(count, roughness, np.float32)


def value(device: str, roughness: float) -> Measured:
    """Value of a half metal and its gradients by base colour, metallic and roughness."""
    wo, wi = pairs(roughness)
    rng = np.random.default_rng(5)
    base = rng.uniform(0.05, 0.95, (len(wo), 3)).astype(np.float32)
    metallic = rng.uniform(0.05, 0.95, len(wo)).astype(np.float32)
    rough = np.full(len(wo), roughness, np.float32)
    truth = o.gltf_brdf(wo, wi, base, metallic, rough)
    # Peaks would drown everything else: each row is scaled to a value of about 1.
    y = rng.uniform(0.5, 1.5, wo.shape) / (1e-3 + truth.max(axis=1, keepdims=True))
    y = y.astype(np.float32)
    f, _, gradients = evaluate(device, wo, wi, base, metallic, rough, y)

    def rows(b: Any, m: Any, r: Any) -> Float64Array:
        return np.asarray(np.sum(o.gltf_brdf(wo, wi, b, m, r) * y, axis=-1))

    b, m, r = (a.astype(np.float64) for a in (base, metallic, rough))
    h = 1e-6
    slopes = [
        np.stack([(rows(b + h * e, m, r) - rows(b - h * e, m, r)) / (2 * h) for e in np.eye(3)], 1),
        (rows(b, m + h, r) - rows(b, m - h, r)) / (2 * h),
        (rows(b, m, r + h) - rows(b, m, r - h)) / (2 * h),
    ]
    return Measured(max_relative(f, truth), finite(f, *gradients), worst_l2(gradients, slopes))


def density(device: str, roughness: float) -> Measured:
    """Density of visible normals, mirror lobe and far tail."""
    wo, wi = pairs(roughness)
    _, pdf, _ = evaluate(device, wo, wi, *metal(len(wo), roughness))
    truth = o.vndf_reflection_pdf(wo, wi, o.ggx_alpha(np.float32(roughness)))
    return Measured(max_relative(pdf, truth), finite(pdf))


def eye(cos_o: float) -> np.ndarray:
    """Return a float32 direction toward the camera."""
    return np.asarray(o.spherical(cos_o, 0.8).astype(np.float32))


def own_samples(device: str, roughness: float) -> Measured:
    """Density at the sampler's own directions, from the normal to grazing: what weights divide."""
    errors, values = [], []
    u = np.random.default_rng(6).random((20000, 2), dtype=np.float32)
    for cos_o in (1.0, 0.3, 0.02, 1e-3):
        wo = eye(cos_o)
        inputs = [wp.vec3(*map(float, wo)), upload(u, wp.vec2, device), roughness]
        (d,) = launch(sample_kernel, len(u), inputs, wp.vec3, device=device)
        above = d[:, 2] > 0.0
        everywhere = np.broadcast_to(wo, d.shape)
        _, pdf, _ = evaluate(device, everywhere, d, *metal(len(d), roughness))
        truth = o.vndf_reflection_pdf(wo, d, o.ggx_alpha(np.float32(roughness)))
        errors.append(max_relative(pdf[above], truth[above]))
        errors.append(float(np.abs(np.linalg.norm(d, axis=1) - 1.0).max()))
        values += [d, pdf]
    return Measured(float(np.max(errors)), finite(*values))


def grazing_pairs(cosine: float) -> tuple[np.ndarray, np.ndarray]:
    """Return directions at one cosine over all azimuths, the mirror direction among them."""
    phi = np.concatenate([[np.pi], np.linspace(0.0, 2.0 * np.pi, 721)])
    phi = np.concatenate([phi, np.pi + 1e-4 * np.linspace(-1.0, 1.0, 101)])
    wo = np.broadcast_to(o.spherical(cosine, 0.0), (len(phi), 3))
    return wo.astype(np.float32), o.spherical(cosine, phi).astype(np.float32)


def grazing(device: str, cosine: float) -> Measured:
    """Both directions at one grazing cosine, over all roughnesses."""
    errors, values = [], []
    wo, wi = grazing_pairs(cosine)
    for roughness in ROUGHNESS:
        base, metallic, rough = metal(len(wo), roughness)
        y = np.full(wo.shape, 1e-6)
        f, pdf, gradients = evaluate(device, wo, wi, base, metallic, rough, y)
        errors.append(max_relative(f, o.gltf_brdf(wo, wi, base, metallic, rough)))
        alpha = o.ggx_alpha(np.float32(roughness))
        errors.append(max_relative(pdf, o.vndf_reflection_pdf(wo, wi, alpha)))
        values += [f, pdf, *gradients]
    return Measured(float(np.max(errors)), finite(*values))


def facing_away(device: str) -> Measured:
    """One or both directions below the surface or exactly on it: nothing, and no gradient."""
    up, down, flat = [0.6, 0.0, 0.8], [0.6, 0.0, -0.8], [1.0, 0.0, 0.0]
    both = [(up, down), (down, up), (down, down), (up, flat), (flat, up), (flat, flat)]
    wo, wi = (np.array([p[k] for p in both], np.float32) for k in (0, 1))
    worst, values = 0.0, []
    for roughness in ROUGHNESS:
        base, metallic, rough = metal(len(wo), roughness)
        f, pdf, gradients = evaluate(device, wo, wi, base, 0.5 * metallic, rough, np.ones((6, 3)))
        worst = max(worst, *(float(np.abs(x).max()) for x in (f, pdf, *gradients)))
        values += [f, pdf, *gradients]
    return Measured(worst, finite(*values))


TILTED = Material(metallic=0.0, roughness=0.6, base_color=(0.8, 0.8, 0.8))


def tilted_truth(tilt: float) -> float:
    """Return the radiance of `TILTED` under L = 1, seen along the geometric normal.

    Light counts where it is above both surfaces. Polar coordinates about the geometric normal, so
    that its horizon is a border of the quadrature; at the other one the integrand is continuous.
    """
    cos, weight = o.gauss_legendre(np.linspace(0.0, 1.0, 65), 8)
    phi = 2.0 * np.pi * (np.arange(1024) + 0.5) / 1024
    wi = o.spherical(cos[:, None], phi)
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    turn = o.frame_of(normal)
    f = o.gltf_brdf(np.array([0.0, 0.0, 1.0]) @ turn, wi @ turn, np.full(3, 0.8), 0.0, 0.6)
    cosine = np.maximum(wi @ normal, 0.0)
    return float(2.0 * np.pi * np.mean(f[..., 0] * cosine, axis=1) @ weight)


def shading_normal(device: str, tilt_deg: float) -> Measured:
    """A card whose shading normal leans away from its geometric one by up to half a turn."""
    tilt = np.radians(tilt_deg)
    plain = quad((0.0, 0.0, -5.0), (1, 0, 0), (0, 1, 0))
    normals = np.tile(np.array([np.sin(tilt), 0.0, np.cos(tilt)], np.float32), (4, 1))
    leaning = Primitive(plain.positions, plain.indices, 0, normals=normals)
    view = camera(4, 4, 2e4)
    renderer, args = lit(device, [placed(leaning, TILTED)], view)
    out = renderer.foreground(args, all_pixels(view), 4096, 1, 1, 0)
    # A shading normal that faces away from the viewer gives way to the geometric one.
    truth = tilted_truth(tilt if tilt_deg < 90.0 else 0.0)
    found = float(out.radiance.astype(np.float64).mean())
    return Measured(abs(found / truth - 1.0), finite(out.radiance))


def hard_normals() -> np.ndarray:
    """Return unit normals next to both poles of the construction and random ones."""
    rng = np.random.default_rng(7)
    n = rng.normal(size=(20000, 3))
    n[:6000] = [0.0, 0.0, -1.0] + n[:6000] * np.geomspace(1e-8, 1.0, 6000)[:, None]
    n[6000:12000] = [0.0, 0.0, 1.0] + n[6000:12000] * np.geomspace(1e-8, 1.0, 6000)[:, None]
    n[12000:14000, 2] *= 1e-6
    return np.asarray(o.normalize(n).astype(np.float32))


def frame_error(n: np.ndarray, x: Float64Array, y: Float64Array) -> float:
    """Return the largest entry of ``F^T F - 1``."""
    frame = np.stack([x, y, n.astype(np.float64)], axis=-1)
    return float(np.abs(np.swapaxes(frame, 1, 2) @ frame - np.eye(3)).max())


def frame(device: str) -> Measured:
    """Is the frame round a normal orthonormal, next to -Z too?"""
    n = hard_normals()
    source = upload(n, wp.vec3, device)
    x, y = launch(frame_kernel, len(n), [source], wp.vec3, wp.vec3, device=device)
    return Measured(frame_error(n, x, y), finite(x, y))


# ------------------------------------------------------------------------------ Mitsuba


def conductor(roughness: float) -> Any:
    """Return Mitsuba's GGX conductor with F = 1 and visible-normal sampling."""
    import mitsuba as mi

    metal = {"type": "roughconductor", "distribution": "ggx", "material": "none"}
    return mi.load_dict({**metal, "alpha": float(o.ggx_alpha(np.float32(roughness)))})


def interaction(wo: np.ndarray) -> Any:
    """Return a surface interaction whose ``wi`` (our ``wo``) is given in the local frame."""
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f, len(wo))
    si.wi = to_mitsuba(wo)
    return si


def separable(wo: np.ndarray, wi: np.ndarray, roughness: float) -> Float64Array:
    """Return ``D G1 G1 / (4 cos_o)``: Mitsuba masks and shadows independently."""
    alpha = o.ggx_alpha(np.float32(roughness))
    wm = o.normalize(wo.astype(np.float64) + wi)
    g = o.smith_g1(wo, wm, alpha) * o.smith_g1(wi, wm, alpha)
    return np.asarray(o.ggx_d(wm, alpha) * g / (4.0 * wo[:, 2].astype(np.float64)))


def mitsuba_eval(wo: np.ndarray, wi: np.ndarray, roughness: float) -> tuple[float, float]:
    """Return errors of Mitsuba's value and density against the formulas it implements."""
    import mitsuba as mi

    bsdf, si = conductor(roughness), interaction(wo)
    toward = to_mitsuba(wi)
    f = np.array(bsdf.eval(mi.BSDFContext(), si, toward))[0]
    pdf = np.array(bsdf.pdf(mi.BSDFContext(), si, toward))
    truth = o.vndf_reflection_pdf(wo, wi, o.ggx_alpha(np.float32(roughness)))
    return max_relative(f, separable(wo, wi, roughness)), max_relative(pdf, truth)


def mitsuba_value(roughness: float) -> float:
    """Error of Mitsuba's conductor at the same directions."""
    return mitsuba_eval(*pairs(roughness), roughness)[0]


def mitsuba_density(roughness: float) -> float:
    """Error of its density."""
    return mitsuba_eval(*pairs(roughness), roughness)[1]


def mitsuba_grazing(cosine: float) -> float:
    """Error of both at one grazing cosine."""
    wo, wi = grazing_pairs(cosine)
    return float(np.max([mitsuba_eval(wo, wi, r) for r in ROUGHNESS]))


def mitsuba_own_samples(roughness: float) -> float:
    """Error of the density that Mitsuba's sampler returns with its directions."""
    import mitsuba as mi

    bsdf = conductor(roughness)
    u = np.random.default_rng(6).random((20000, 2), dtype=np.float32)
    errors = []
    for cos_o in (1.0, 0.3, 0.02, 1e-3):
        wo = np.broadcast_to(eye(cos_o), (len(u), 3))
        numbers = mi.Float(0.5), mi.Point2f(np.ascontiguousarray(u.T))
        sample, _ = bsdf.sample(mi.BSDFContext(), interaction(wo), *numbers)
        d = from_mitsuba(sample.wo)
        truth = o.vndf_reflection_pdf(wo, d, o.ggx_alpha(np.float32(roughness)))
        above = d[:, 2] > 0.0
        errors.append(max_relative(np.array(sample.pdf)[above], truth[above]))
    return float(np.max(errors))


def mitsuba_frame() -> float:
    """Error of Mitsuba's coordinate system."""
    import mitsuba as mi

    n = hard_normals()
    x, y = mi.coordinate_system(to_mitsuba(n))
    return frame_error(n, from_mitsuba(x), from_mitsuba(y))


def cases() -> list[Case]:
    """Return the rows of this group."""
    group = "Material"
    below = "zero by definition there as well"
    through = "another integral: it lets light through below the geometric surface"
    widths = {f"roughness {r:g}": (r,) for r in ROUGHNESS}
    flat = {f"both cosines {c:g}": (c,) for c in GRAZING}
    leaning = {f"shading normal {t:g} deg off": (t,) for t in (30.0, 60.0, 85.0, 100.0, 180.0)}
    away = Quantity("value, density, gradient", MAX_ABSOLUTE, facing_away, 0.0, below)
    tilted = Quantity("radiance", RELATIVE, shading_normal, NORMALS, through)
    round_it = Quantity("frame", MAX_ABSOLUTE, frame, FRAME, mitsuba_frame)
    of_pairs, of_density, of_samples, of_grazing = (
        Quantity(name, MAX_RELATIVE, run, VALUE, mitsuba)
        for name, run, mitsuba in (
            ("value", value, mitsuba_value),
            ("density", density, mitsuba_density),
            ("density at own samples", own_samples, mitsuba_own_samples),
            ("value and density", grazing, mitsuba_grazing),
        )
    )
    of_pairs = of_pairs._replace(gradient_bound=GRADIENT)
    return [
        *table(group, widths, of_pairs, of_density, of_samples),
        *table(group, flat, of_grazing),
        *table(group, {"directions below the surface": ()}, away),
        *table(group, leaning, tilted),
        *table(group, {"normals next to -Z and +Z": ()}, round_it),
    ]
