"""Environment maps at the ends of their range: suns, one texel, black, 8k."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.stability.case import (
    Float64Array,
    Measured,
    finite,
    from_mitsuba,
    launch,
    max_relative,
    relative_l2,
    to_mitsuba,
    upload,
)
from tests import oracles as o
from tests.builders.shapes import all_pixels, camera, ground
from warpir.core.latlong import resize_map
from warpir.kernels.sampling import light_eval, proposal_sample
from warpir.kernels.types import LightArgs
from warpir.render.device_light import BRIGHT, light_args
from warpir.render.device_scene import Scene
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.renderer import Renderer
from warpir.scene.light import Light, summarize


@wp.kernel(enable_backward=False)
def sample_kernel(light: LightArgs, u: wp.array[wp.vec2], wi: wp.array[wp.vec3]):
    """Draw from the light's proposal."""
    i = wp.tid()
    wi[i] = proposal_sample(light, u[i])


@wp.kernel(enable_backward=False)
def eval_kernel(
    light: LightArgs, wi: wp.array[wp.vec3], radiance: wp.array[wp.vec3], pdf: wp.array[float]
):
    """Radiance and density of the light."""
    i = wp.tid()
    value = light_eval(light, wi[i])
    radiance[i] = value.radiance
    pdf[i] = value.pdf


def sky(height: int, contrast: float, row: float = 0.3) -> np.ndarray:
    """A smooth sky; one texel of ``contrast`` times its mean, at a share ``row`` of the height."""
    width = 2 * height
    v = (np.arange(height, dtype=np.float32) + 0.5) / height
    u = (np.arange(width, dtype=np.float32) + 0.5) / width
    level = 0.6 + 0.3 * np.cos(np.pi * v)[:, None] + 0.1 * np.sin(2.0 * np.pi * u)[None]
    texels = level[..., None] * np.array([0.7, 0.8, 1.0], np.float32)
    if contrast > 0.0:
        texels[int(row * height), width // 3] = contrast * texels.mean(dtype=np.float64)
    return np.ascontiguousarray(texels, np.float32)


def evaluate(device: str, light: LightArgs, d: np.ndarray) -> tuple[Float64Array, Float64Array]:
    """Return radiance and density of a light along directions."""
    inputs = [light, upload(d, wp.vec3, device)]
    radiance, pdf = launch(eval_kernel, len(d), inputs, wp.vec3, float, device=device)
    return radiance, pdf


def draw(device: str, light: LightArgs, count: int = 20000) -> Float64Array:
    """Return directions that the light's proposal draws."""
    rng = np.random.default_rng(17)
    inputs = [light, upload(rng.random((count, 2), dtype=np.float32), wp.vec2, device)]
    (wi,) = launch(sample_kernel, count, inputs, wp.vec3, device=device)
    return wi


def look_at(texels: np.ndarray) -> np.ndarray:
    """Return directions everywhere, round the brightest texel, at the poles and at the seam."""
    rng = np.random.default_rng(18)
    height, width = texels.shape[:2]
    i, j = np.unravel_index(np.argmax(texels[..., 1]), (height, width))
    near = np.array([(j + 0.5) / width, (i + 0.5) / height])
    uv = np.concatenate(
        [
            rng.random((10000, 2)),
            near + rng.uniform(-1.5, 1.5, (10000, 2)) / [width, height],
            np.stack([rng.random(2000), rng.random(2000) * 2.0 / height], axis=-1),
            np.stack([rng.uniform(-1.0, 1.0, 2000) / width, rng.random(2000)], axis=-1),
        ]
    )
    return np.asarray(o.latlong_direction(np.abs(uv)).astype(np.float32))


def bilinear(texels: np.ndarray, d: np.ndarray) -> Float64Array:
    """Return the oracle's lookup without a float64 copy of a large map."""
    rows, columns, weights = o.bilinear_weights(o.latlong_uv(d), *texels.shape[:2])
    values = texels[rows, columns].astype(np.float64)
    return np.asarray(np.einsum("nk...,nk->n...", values, weights))


def lookup(device: str, height: int, contrast: float) -> Measured:
    """Radiance of a map, everywhere and round its sun, relative to the peak."""
    texels = sky(height, contrast)
    light = light_args(Light(texels=texels), wp.get_device(device))
    d = look_at(texels)
    radiance, pdf = evaluate(device, light, d)
    error = np.abs(radiance - bilinear(texels, d)).max() / float(texels.max())
    return Measured(float(error), finite(radiance, pdf))


def importance(texels: np.ndarray, bright_prob: float) -> np.ndarray:
    """Return the probability of each texel, row by row in float64.

    Luminance times solid angle, of the bright texels and of the others each, which have the
    probabilities ``bright_prob`` and what is left.
    """
    omega = o.texel_solid_angle(*texels.shape[:2])
    levels = np.stack([o.luminance(row).astype(np.float32) for row in texels])
    mean = sum(float(row.sum(dtype=np.float64)) * w for row, w in zip(levels, omega, strict=True))
    is_bright = levels > BRIGHT * mean / (4.0 * np.pi)
    weight = (levels * omega[:, None]).astype(np.float32)
    total = [float(weight[part].sum(dtype=np.float64)) for part in (is_bright, ~is_bright)]
    weight[is_bright] *= bright_prob / max(total[0], 1e-300)
    weight[~is_bright] *= (1.0 - bright_prob) / total[1]
    return weight


def density(device: str, height: int, contrast: float) -> Measured:
    """Density at the proposal's own samples against the float64 table."""
    texels = sky(height, contrast)
    light = light_args(Light(texels=texels), wp.get_device(device))
    d = draw(device, light).astype(np.float32)
    radiance, pdf = evaluate(device, light, d)
    weight = importance(texels, light.bright_prob)
    sine = np.hypot(d[:, 0].astype(np.float64), d[:, 2])
    share = bilinear(weight, d) * weight.size
    truth = share / (2.0 * np.pi**2 * sine)
    # At the poles themselves the density of (u, v) over solid angle has no limit.
    away = sine > 2.0 * np.pi / height
    return Measured(max_relative(pdf[away], truth[away]), finite(radiance, pdf, d))


def texel_weights(height: int, width: int) -> Float64Array:
    """Return the plane's radiance per radiance of each texel: its tent times cosine over pi."""
    theta, weight_t = o.gauss_legendre(np.linspace(0.0, 0.5 * np.pi, height + 1), 12)
    # Tents are products, so the integral is one too.
    value = np.cos(theta) * np.sin(theta) * weight_t / np.pi
    y = theta / np.pi * height - 0.5
    rows = np.zeros(height)
    low = np.floor(y).astype(int)
    np.add.at(rows, np.clip(low, 0, height - 1), value * (1.0 - (y - low)))
    np.add.at(rows, np.clip(low + 1, 0, height - 1), value * (y - low))
    columns = np.full(width, 2.0 * np.pi / width)
    return np.asarray(rows[:, None] * columns[None])


def plane(device: str, make: Callable[[], np.ndarray], has_gradient: bool = False) -> Measured:
    """Radiance of a white plane under a map; its gradient by every texel where the map is small."""
    texels = make()
    view = camera(8, 8, 500.0, (0.0, 50.0, 0.0), -90.0)
    renderer = Renderer(Scene([], view, ground(0.0), device))
    spp = 4096 if has_gradient else 256
    integrator = MisIntegrator(renderer, np.zeros(0, np.int32), all_pixels(view), spp, 1, 1)
    light = torch.tensor(texels, requires_grad=has_gradient)
    with torch.set_grad_enabled(has_gradient):
        unoccluded = integrator.radiance(light, light, 3).unoccluded
    found = unoccluded.detach().numpy().astype(np.float64)
    weights = texel_weights(*texels.shape[:2])
    truth = np.array([float(np.sum(weights * texels[..., c])) for c in range(3)])
    error = max_relative(found.mean(axis=0), truth)
    if not has_gradient:
        return Measured(error, finite(found))
    unoccluded.mean(dim=0).sum().backward()
    assert light.grad is not None
    gradient = light.grad.numpy().astype(np.float64)
    expected = np.broadcast_to(weights[..., None], gradient.shape)
    return Measured(error, finite(found, gradient), relative_l2(gradient, expected))


def lone_texel(height: int, value: float) -> np.ndarray:
    """A black map but for one texel."""
    texels = np.zeros((height, 2 * height, 3), np.float32)
    texels[height // 4, height // 3] = value
    return texels


def dark(device: str) -> Measured:
    """A black map: no light, a summary of zeros, and samples that are directions all the same."""
    texels = np.zeros((16, 32, 3), np.float32)
    light = light_args(Light(texels=texels), wp.get_device(device))
    d = draw(device, light)
    radiance, pdf = evaluate(device, light, d)
    summary = summarize(Light(texels=texels))
    values = [summary.peak_luminance, summary.mean_luminance, summary.peak_share]
    is_finite = finite(d, radiance, pdf, values, summary.azimuth_deg, summary.elevation_deg)
    length = float(np.abs(np.linalg.norm(d, axis=1) - 1.0).max())
    worst = max(float(np.abs(radiance).max()), *values, length if length > 1e-6 else 0.0)
    return Measured(worst, is_finite)


def energy(device: str, height: int, contrast: float) -> Measured:
    """Power of a map after it is averaged down to 64 rows."""
    texels = sky(height, contrast)
    small = resize_map(texels, 64)
    omega, omega_small = o.texel_solid_angle(height, 2 * height), o.texel_solid_angle(64, 128)
    truth = sum(
        row.astype(np.float64).sum(axis=0) * w for row, w in zip(texels, omega, strict=True)
    )
    found = np.einsum("ijc,i->c", small.astype(np.float64), omega_small)
    return Measured(max_relative(found, truth), finite(small))


def mitsuba_envmap(texels: np.ndarray) -> Any:
    """Return Mitsuba's environment emitter of a map."""
    import mitsuba as mi

    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "envmap", "bitmap": mi.Bitmap(texels), "mis_compensation": False},
        }
    )
    return scene.emitters()[0]


def mitsuba_lookup(height: int, contrast: float) -> float:
    """Error of Mitsuba's lookup against its own rule in float64, relative to the peak.

    Its columns are texel-centred, its rows run from pole to pole.
    """
    import drjit as dr
    import mitsuba as mi

    texels = sky(height, contrast)
    d = look_at(texels)
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = to_mitsuba(-d)
    found = from_mitsuba(mitsuba_envmap(texels).eval(si))
    uv = o.latlong_uv(d)
    x, y = uv[:, 0] * texels.shape[1] - 0.5, uv[:, 1] * (height - 1)
    left, top = np.floor(x), np.minimum(np.floor(y), height - 2)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    j, i = left.astype(int) % texels.shape[1], top.astype(int)
    k = (j + 1) % texels.shape[1]
    upper = texels[i, j] * (1.0 - fx) + texels[i, k] * fx
    lower = texels[i + 1, j] * (1.0 - fx) + texels[i + 1, k] * fx
    truth = upper * (1.0 - fy) + lower * fy
    return float(np.abs(found - truth).max() / float(texels.max()))


def mitsuba_dark() -> float:
    """Radiance of a black envmap at its own samples; infinity when a number is not finite."""
    import drjit as dr
    import mitsuba as mi

    emitter = mitsuba_envmap(np.zeros((16, 32, 3), np.float32))
    u = np.random.default_rng(17).random((2, 20000)).astype(np.float32)
    it = dr.zeros(mi.SurfaceInteraction3f, 20000)
    sample, weight = emitter.sample_direction(it, mi.Point2f(u))
    values = [np.array(sample.d), np.array(sample.pdf), np.array(weight)]
    return float(np.abs(values[2]).max()) if finite(*values) else float("inf")
