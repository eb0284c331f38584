"""Hard cases of maps, shadow ratio, tone, encoding and fusion: range, black, ends, 8k."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.stability.case import (
    MAX_ABSOLUTE,
    MAX_RELATIVE,
    RELATIVE,
    Case,
    Float64Array,
    Measured,
    download,
    finite,
    max_relative,
    relative_l2,
    upload,
    worst_l2,
)
from tests import oracles as o
from tests.builders.shapes import all_pixels, camera, ground
from tests.statistics import central_differences
from warpir.core.latlong import resize_map
from warpir.kernels.composite import compose
from warpir.kernels.sampling import light_eval, light_sample
from warpir.kernels.shadow_ratio import shadow_ratio
from warpir.kernels.tone import reinhard, tone_curve
from warpir.kernels.types import LightArgs
from warpir.lighting.fusion import fuse
from warpir.render.device_light import light_args
from warpir.render.device_scene import Scene
from warpir.render.mis import MisIntegrator
from warpir.render.renderer import Renderer
from warpir.render.tone_curve import ToneCurve
from warpir.scene.light import Light, summarize

LIGHT, TONE, FUSION = "light", "tone", "fusion"
UP = np.array([0.0, 1.0, 0.0])

LOOKUP_ULPS = 4.0
"""A bilinear weight is what is left of ``u * width``: four roundings of ``width * 2^-24``."""
PLANE = 2e-3
"""Noise of 64 x 256 low-discrepancy samples."""
TEXEL_GRADIENT = 2e-2
"""Noise of 64 x 4096 samples over 64 texels of the upper half."""
DENSITY = 1e-2
"""Steps of 2^-24 of the float32 table, near 1, over a sky texel's share of the sun's row."""
DENSITY_PLAIN = 2e-3
"""The same without a sun: a texel is 1e-4 of its row on 8192 columns."""
ENERGY = 1e-6
"""The float32 result of a float64 sum."""
CURVE = 1e-6
"""Ten roundings, relative to one plus the curve's slope, which amplifies those of ``x``."""
CURVE_GRADIENT = 2e-3
"""Knots 1e-3 apart are 6e-5 coarse in float32, and slopes divide by them, twice."""
VALUE = 1e-6
"""Ten roundings."""
GRADIENT = 1e-5
"""Twenty roundings of terms of one sign, against central differences good to 1e-6."""
ENCODING = 0.5 / 255.0
"""Half an 8-bit code: what `warpir.kernels.composite` states for its linear toe."""
FUSED = 1e-5
"""Twenty roundings of both lights, relative to the brighter one."""
FUSED_GRADIENT = 1e-5
"""float64, against central differences with steps of 1e-5."""
NO_COUNTERPART = "has no counterpart"


@wp.kernel(enable_backward=False)
def sample_kernel(
    light: LightArgs, u: wp.array[wp.vec2], pick: wp.array[float], wi: wp.array[wp.vec3]
):
    """Draw from the light's proposal."""
    i = wp.tid()
    wi[i] = light_sample(light, u[i], pick[i])


@wp.kernel(enable_backward=False)
def eval_kernel(
    light: LightArgs, wi: wp.array[wp.vec3], radiance: wp.array[wp.vec3], pdf: wp.array[float]
):
    """Radiance and density of the light."""
    i = wp.tid()
    value = light_eval(light, wi[i])
    radiance[i] = value.radiance
    pdf[i] = value.pdf


@wp.kernel
def curve_kernel(
    x: wp.array[float],
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
    y: wp.array[float],
):
    """One tone curve."""
    i = wp.tid()
    y[i] = tone_curve(x[i], 0, knot_x, knot_y, knot_slope, bin_count)


@wp.kernel
def reinhard_kernel(x: wp.array[float], y: wp.array[float]):
    """Reinhard's operator."""
    i = wp.tid()
    y[i] = reinhard(x[i])


# ------------------------------------------------------------------------------- maps


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
    radiance = wp.zeros(len(d), dtype=wp.vec3, device=device)
    pdf = wp.zeros(len(d), dtype=float, device=device)
    source = upload(d, wp.vec3, device)
    wp.launch(eval_kernel, len(d), inputs=[light, source], outputs=[radiance, pdf], device=device)
    return download(radiance), download(pdf)


def draw(device: str, light: LightArgs, count: int = 20000) -> Float64Array:
    """Return directions that the light's proposal draws."""
    rng = np.random.default_rng(17)
    u, pick = rng.random((count, 2), dtype=np.float32), rng.random(count, dtype=np.float32)
    wi = wp.zeros(count, dtype=wp.vec3, device=device)
    inputs = [light, upload(u, wp.vec2, device), upload(pick, float, device)]
    wp.launch(sample_kernel, count, inputs=inputs, outputs=[wi], device=device)
    return download(wi)


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


def table(texels: np.ndarray) -> tuple[np.ndarray, float]:
    """Return luminance times solid angle and its sum, row by row in float64."""
    omega = o.texel_solid_angle(*texels.shape[:2])
    weight = np.empty(texels.shape[:2], np.float32)
    total = 0.0
    for i, row in enumerate(texels):
        exact = o.luminance(row) * omega[i]
        weight[i] = exact
        total += float(exact.sum())
    return weight, total


def density(device: str, height: int, contrast: float) -> Measured:
    """Density at the proposal's own samples against the float64 table."""
    texels = sky(height, contrast)
    light = light_args(Light(texels=texels), wp.get_device(device))
    d = draw(device, light).astype(np.float32)
    radiance, pdf = evaluate(device, light, d)
    weight, total = table(texels)
    sine = np.hypot(d[:, 0].astype(np.float64), d[:, 2])
    share = bilinear(weight, d) / total * weight.size
    truth = share / (2.0 * np.pi**2 * sine)
    # At the poles themselves the density of (u, v) over solid angle has no limit.
    away = sine > 2.0 * np.pi / height
    return Measured(max_relative(pdf[away], truth[away]), finite(radiance, pdf, d))


def level_plane(device: str) -> MisIntegrator:
    """`mis` on an empty level plane, 64 pixels and 256 samples."""
    view = camera(8, 8, 500.0, (0.0, 50.0, 0.0), -90.0)
    renderer = Renderer(Scene([], view, ground(0.0), device))
    return MisIntegrator(renderer, np.zeros(0, np.int32), all_pixels(view), 256, 1, 1)


def texel_weights(height: int, width: int) -> Float64Array:
    """Return the plane's radiance per radiance of each texel: its tent times cosine over pi."""
    theta, weight_t = o.gauss_legendre(np.linspace(0.0, 0.5 * np.pi, height + 1), 12)
    u, weight_u = o.gauss_legendre(np.linspace(0.0, 1.0, 2 * width + 1), 4)
    # Tents are products, so the integral is one too.
    value = np.cos(theta) * np.sin(theta) * weight_t / np.pi
    y = theta / np.pi * height - 0.5
    rows = np.zeros(height)
    low = np.floor(y).astype(int)
    np.add.at(rows, np.clip(low, 0, height - 1), value * (1.0 - (y - low)))
    np.add.at(rows, np.clip(low + 1, 0, height - 1), value * (y - low))
    columns = np.full(width, 2.0 * np.pi / width)
    assert abs(weight_u.sum() - 1.0) < 1e-12 and len(u)
    return np.asarray(rows[:, None] * columns[None])


def plane(device: str, make: Callable[[], np.ndarray], has_gradient: bool = False) -> Measured:
    """Radiance of a white plane under a map; its gradient by every texel where the map is small."""
    texels = make()
    integrator = level_plane(device)
    if has_gradient:
        integrator.spp = 4096
    tensor = torch.tensor(texels, requires_grad=has_gradient)
    light = tensor
    if has_gradient:
        unoccluded = integrator.radiance(light, light, 3).unoccluded
        unoccluded.mean(dim=0).sum().backward()
    else:
        with torch.no_grad():
            unoccluded = integrator.radiance(light, light, 3).unoccluded
    found = unoccluded.detach().numpy().astype(np.float64)
    weights = texel_weights(*texels.shape[:2])
    truth = np.array([float(np.sum(weights * texels[..., c])) for c in range(3)])
    error = max_relative(found.mean(axis=0), truth)
    if not has_gradient:
        return Measured(error, finite(found))
    assert tensor.grad is not None
    gradient = tensor.grad.numpy().astype(np.float64)
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


# ------------------------------------------------------------------------ shadow ratio


def ratio(device: str, level: float) -> Measured:
    """``lit / unoccluded`` and its gradient at one level of light; 1 where there is none."""
    share = np.linspace(0.0, 1.0, 33)
    unoccluded = np.full((33, 3), level, np.float32)
    lit = (unoccluded * share[:, None]).astype(np.float32)
    arrays = [upload(a, wp.vec3, device, True) for a in (lit, unoccluded)]
    out = wp.zeros(33, dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(shadow_ratio, 33, inputs=arrays, outputs=[out], device=device)
    tape.backward(grads={out: upload(np.ones((33, 3)), wp.vec3, device)})
    gradients = [download(a.grad) for a in arrays]
    a, b = lit.astype(np.float64), unoccluded.astype(np.float64)
    # Below 1e-30 the plane counts as dark.
    if level < 1e-30:
        truth, slopes = np.ones_like(a), [np.zeros_like(a), np.zeros_like(a)]
    else:
        truth = a / b
        h = 1e-4 * b
        slopes = [
            ((a + h) / b - (a - h) / b) / (2.0 * h),
            (a / (b + h) - a / (b - h)) / (2.0 * h),
        ]
    return Measured(
        float(np.abs(download(out) - truth).max()),
        finite(out.numpy(), *gradients),
        worst_l2([g * level for g in gradients], [s * level for s in slopes]),
    )


# ------------------------------------------------------------------------------- tone


def run_curve(
    device: str, x: np.ndarray, knots: tuple[np.ndarray, ...], y: np.ndarray
) -> tuple[Float64Array, list[Float64Array]]:
    """Return values of a curve and gradients by ``x`` and the knots' x, y and slopes."""
    arrays = [upload(x, float, device, True)]
    arrays += [upload(k[None], float, device, True) for k in knots]
    out = wp.zeros(len(x), dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(
            curve_kernel,
            len(x),
            inputs=[*arrays, len(knots[0]) - 1],
            outputs=[out],
            device=device,
        )
    tape.backward(grads={out: upload(y, float, device)})
    return download(out), [download(a.grad) for a in arrays]


COLLAPSED = {
    "identity": np.zeros(16),
    "widths at their least": np.concatenate([[12.0, -12, -12, -12, -12], np.zeros(11)]),
    "heights at their least": np.concatenate(
        [np.zeros(5), [-12.0, -12, 12, -12, -12], np.zeros(6)]
    ),
    "slopes at their least": np.concatenate([np.zeros(10), np.full(6, -12.0)]),
    "slopes of 30": np.concatenate([np.zeros(10), np.full(6, 30.0)]),
}
"""Raw parameters; 12 is where softmax and softplus have reached their floors to 1e-5."""


def curve(device: str, raw: np.ndarray) -> Measured:
    """A curve within its ends: values over one plus the slope, and gradients."""
    knots = tuple(k.astype(np.float32) for k in o.spline_knots(raw))
    wide = [k.astype(np.float64) for k in knots]
    inside = np.concatenate(
        [np.linspace(a, b, 41)[1:-1] for a, b in zip(wide[0][:-1], wide[0][1:], strict=True)]
    )
    x = np.concatenate([inside, wide[0]]).astype(np.float32)
    y = np.concatenate([np.ones(len(inside)), np.zeros(len(wide[0]))])
    values, gradients = run_curve(device, x, knots, y)
    truth, slope = o.spline(x, *wide)
    error = float(np.max(np.abs(values - truth) / (1.0 + slope)))
    x64 = x[: len(inside)].astype(np.float64)

    def loss(k: int, value: Float64Array) -> float:
        moved = [value if i == k else w for i, w in enumerate(wide)]
        return float(np.sum(o.spline(x64, *moved)[0]))

    slopes = [slope[: len(inside)]]
    slopes += [central_differences(partial(loss, k), wide[k], 1e-8) for k in range(3)]
    found = [gradients[0][: len(inside)], *(g[0] for g in gradients[1:])]
    # The outermost knots are the ends of the interval, never free.
    found[1], slopes[1] = found[1][1:-1], slopes[1][1:-1]
    return Measured(error, finite(values, *gradients), worst_l2(found, slopes))


def beyond(device: str) -> Measured:
    """At the ends and beyond: exactly 0 and 1, and no gradient from outside."""
    x = np.array([-3e38, -1.0, -1e-30, 0.0, 1.0, 1.0 + 2.0**-23, 5.0, 3e38])
    truth = np.array([0.0, 0, 0, 0, 1, 1, 1, 1])
    worst, values = 0.0, []
    for raw in COLLAPSED.values():
        knots = tuple(k.astype(np.float32) for k in o.spline_knots(raw))
        found, gradients = run_curve(device, x, knots, np.ones(8))
        outside = np.delete(gradients[0], [3, 4])
        worst = max(worst, float(np.abs(found - truth).max()), float(np.abs(outside).max()))
        values += [found, *gradients]
    return Measured(worst, finite(*values))


def empty_bins(device: str) -> Measured:
    """Bins of no width or no height at all, at their knots too: finite, monotone, in [0, 1]."""
    worst, values = 0.0, []
    shapes = (
        ([0.0, 0.5, 0.5, 1.0], [0.0, 0.3, 0.7, 1.0]),
        ([0.0, 0.5, 1.0, 1.0], [0.0, 0.3, 0.7, 1.0]),
        ([0.0, 0.0, 0.5, 1.0], [0.0, 0.3, 0.7, 1.0]),
        ([0.0, 0.3, 0.7, 1.0], [0.0, 0.5, 0.5, 1.0]),
        ([0.0, 0.3, 0.7, 1.0], [0.0, 0.0, 0.5, 1.0]),
        ([0.0, 0.3, 0.7, 1.0], [0.0, 0.5, 1.0, 1.0]),
    )
    for knot_x, knot_y in shapes:
        knots = tuple(np.array(k, np.float32) for k in (knot_x, knot_y, np.ones(4)))
        x = np.sort(np.concatenate([np.linspace(0, 1, 101), knots[0]])).astype(np.float32)
        found, gradients = run_curve(device, x, knots, np.ones(len(x)))
        values += [found, *gradients]
        worst = max(worst, float(-np.diff(found).min()), float(-found.min()), found.max() - 1.0)
    return Measured(max(worst, 0.0), finite(*values))


def raw_curve(device: str) -> Measured:
    """Raw parameters of 1e3 and 1e30: knots that rise by the least bin, finite gradients."""
    worst, values = 0.0, []
    for size in (0.0, 30.0, 1e3, 1e30):
        model = ToneCurve(3)
        with torch.no_grad():
            for k, parameter in enumerate(model.parameters()):
                sign = torch.where(torch.arange(parameter.numel()) % 2 == k % 2, size, -size)
                parameter.copy_(sign.reshape(parameter.shape))
        knots = model.forward()
        (knots.x.sum() + knots.y.sum() + knots.slope.sum()).backward()
        for edges in (knots.x, knots.y):
            step = edges.detach().numpy().astype(np.float64)
            worst = max(worst, 1e-3 - float(np.diff(step, axis=1).min()))
        if size <= 1e3:
            raw = np.concatenate([p.detach().numpy() for p in model.parameters()], axis=1)
            truth = o.spline_knots(raw)
            for found, expected in zip((knots.x, knots.y, knots.slope), truth, strict=True):
                worst = max(worst, max_relative(found.detach().numpy(), expected, 1.0))
        values += [np.asarray(k.detach()) for k in (knots.x, knots.y, knots.slope)]
        values += [np.asarray(p.grad) for p in model.parameters()]
    return Measured(worst, finite(*values))


def bright(device: str) -> Measured:
    """Reinhard's operator from black to 1e30, and its gradient."""
    x = np.concatenate([[0.0], np.geomspace(1e-30, 1e30, 241)]).astype(np.float32)
    source = upload(x, float, device, True)
    out = wp.zeros(len(x), dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(reinhard_kernel, len(x), inputs=[source], outputs=[out], device=device)
    tape.backward(grads={out: upload(np.ones(len(x)), float, device)})
    gradient = download(source.grad)
    x64 = x.astype(np.float64)
    # Beyond 1e19 the slope, 1 / x^2, leaves float32's normal numbers, and CUDA makes it 0: what
    # is below 1e-32 is compared absolutely, to 1e-37.
    slope = 1.0 / (1.0 + x64) ** 2
    return Measured(
        max_relative(download(out), o.reinhard(x64)),
        finite(out.numpy(), gradient),
        max_relative(gradient, slope, 1e-32),
    )


def encoding(device: str) -> Measured:
    """Display encoding from 0 to beyond 1, and its gradient above the linear toe."""
    x = np.concatenate([[0.0], np.geomspace(1e-30, 1.0, 400)[:-1], [1.5, 1e30]]).astype(np.float32)
    count = len(x)
    display = upload(np.repeat(x[:, None], 3, axis=1), wp.vec3, device, True)
    row = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    none = wp.array(np.full(count, -1, np.int32), dtype=int, device=device)
    out = wp.zeros(count, dtype=wp.vec3, device=device, requires_grad=True)
    blank = upload(np.zeros((count, 3)), wp.vec3, device)
    mask = upload(np.ones(count), float, device)
    with wp.Tape() as tape:
        wp.launch(
            compose,
            count,
            inputs=[blank, row, none, mask, display, blank],
            outputs=[out],
            device=device,
        )
    tape.backward(grads={out: upload(np.ones((count, 3)), wp.vec3, device)})
    gradient = download(display.grad)[:, 0]
    x64 = x.astype(np.float64)
    power = (x64 > 1.1e-6) & (x64 < 1.0)
    h = 1e-4 * x64[power]
    slope = (o.encode(x64[power] + h) - o.encode(x64[power] - h)) / (2.0 * h)
    return Measured(
        float(np.abs(download(out)[:, 0] - np.minimum(o.encode(x64), 1.0)).max()),
        finite(out.numpy(), gradient),
        max_relative(gradient[power], slope),
    )


# ----------------------------------------------------------------------------- fusion


def fusion(device: str, fg_level: float, shadow_level: float, black: str) -> Measured:
    """Both primed maps in float32, and the gradient in float64."""
    rng = np.random.default_rng(19)
    fg = fg_level * rng.uniform(0.2, 1.0, (4, 6, 3))
    shadow = shadow_level * rng.uniform(0.2, 1.0, (4, 6, 3))
    if black in ("fg", "both"):
        fg[1, 2] = 0.0
    if black in ("shadow", "both"):
        shadow[1, 2] = 0.0
        shadow[2, 3] = 0.0
    y = rng.uniform(0.5, 1.5, (2, 4, 6, 3))
    dark = fg.max() == 0.0
    peak = max(float(fg.max()), float(shadow.max()), 1e-300)

    def primed(a: Float64Array, b: Float64Array) -> tuple[Float64Array, Float64Array]:
        if dark:
            # By definition: without a foreground there is nothing to fuse.
            return a, 0.5 * a + 0.5 * b
        return o.fuse(a, b, 0.5)

    def loss(a: Float64Array, b: Float64Array) -> float:
        return float(sum(np.sum(w * x) for w, x in zip(y, primed(a, b), strict=True)))

    single = fuse(torch.tensor(fg).float(), torch.tensor(shadow).float(), 0.5)
    scale = np.maximum(peak, 0.0)
    error = max(
        float(np.abs(f.numpy().astype(np.float64) - t).max() / scale)
        for f, t in zip(single, primed(fg, shadow), strict=True)
    )
    tensors = [torch.tensor(a, requires_grad=True) for a in (fg, shadow)]
    out = fuse(tensors[0], tensors[1], 0.5)
    (torch.tensor(y) * torch.stack(out)).sum().backward()
    gradients = [np.asarray(t.grad) for t in tensors]
    # The steps follow the scales of the equation: the foreground's own, and the larger one.
    step = 1e-5 * (fg_level or 1.0), 1e-6 * (max(fg_level, shadow_level) or 1.0)
    slopes = [
        central_differences(lambda a: loss(a, shadow), fg, step[0]),
        central_differences(lambda b: loss(fg, b), shadow, step[1]),
    ]
    return Measured(error, finite(*single, *gradients), worst_l2(gradients, slopes))


# ------------------------------------------------------------------------------ Mitsuba


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
    si.wi = mi.Vector3f(np.ascontiguousarray(-d.T))
    found = np.array(mitsuba_envmap(texels).eval(si)).T.astype(np.float64)
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


def cases() -> list[Case]:
    """Return the rows of these groups."""
    rows = []
    noise = "its noise, not its precision, would be compared: benchmarks.speed"
    maps = (
        ("1k map", 512, 0.0, "quick"),
        ("1k map, sun of 1e5 times the mean", 512, 1e5, "quick"),
        ("1k map, sun of 1e9 times the mean", 512, 1e9, "quick"),
        ("8k map, sun of 1e5 times the mean", 4096, 1e5, "slow"),
    )
    for name, height, contrast, cost in maps:
        rows.append(
            Case(
                LIGHT,
                name,
                "radiance",
                "max over the peak",
                partial(lookup, height=height, contrast=contrast),
                LOOKUP_ULPS * 2.0 * height * 2.0**-24,
                mitsuba=partial(mitsuba_lookup, height, contrast),
                cost=cost,
            )
        )
        if contrast < 1e9:
            rows.append(
                Case(
                    LIGHT,
                    name,
                    "density at own samples",
                    MAX_RELATIVE,
                    partial(density, height=height, contrast=contrast),
                    DENSITY if contrast else DENSITY_PLAIN,
                    mitsuba="samples other densities: constant between its texels' centres",
                    cost=cost,
                )
            )
        if cost == "quick":
            rows.append(
                Case(
                    LIGHT,
                    name,
                    "white plane",
                    RELATIVE,
                    partial(plane, make=partial(sky, height, contrast)),
                    PLANE,
                    mitsuba=noise,
                )
            )
    plane_maps: tuple[tuple[str, Any, bool], ...] = (
        ("sun of 1e5 in the topmost row", lambda: sky(512, 1e5, 0.0), False),
        ("one texel alone", lambda: lone_texel(64, 1.0), False),
        ("one texel alone, 1e30", lambda: lone_texel(64, 1e30), False),
        ("one texel alone, 1e-30", lambda: lone_texel(64, 1e-30), False),
        ("map of 1 x 1", lambda: np.ones((1, 1, 3), np.float32), False),
        ("map of 1 x 2", lambda: np.ones((1, 2, 3), np.float32), False),
        ("smooth sky of 8 x 16", lambda: sky(8, 0.0), True),
        ("sun of 1e5 on 8 x 16", lambda: sky(8, 1e5), True),
        ("one texel alone on 8 x 16", lambda: lone_texel(8, 1.0), True),
        ("black map of 8 x 16", lambda: np.zeros((8, 16, 3), np.float32), True),
    )
    for name, make, has_gradient in plane_maps:
        rows.append(
            Case(
                LIGHT,
                name,
                "white plane",
                RELATIVE,
                partial(plane, make=make, has_gradient=has_gradient),
                PLANE,
                TEXEL_GRADIENT if has_gradient else None,
                noise,
            )
        )
    rows += [
        Case(
            LIGHT,
            "black map",
            "radiance, samples, summary",
            MAX_ABSOLUTE,
            dark,
            0.0,
            mitsuba=mitsuba_dark,
        ),
        Case(
            LIGHT,
            "1k map, sun of 1e5 times the mean",
            "power averaged to 128 x 64",
            RELATIVE,
            partial(energy, height=512, contrast=1e5),
            ENERGY,
            mitsuba=NO_COUNTERPART,
        ),
        Case(
            LIGHT,
            "8k map, sun of 1e5 times the mean",
            "power averaged to 128 x 64",
            RELATIVE,
            partial(energy, height=4096, contrast=1e5),
            ENERGY,
            mitsuba=NO_COUNTERPART,
            cost="slow",
        ),
    ]
    for level in (0.0, 1e-45, 1e-38, 1e-29, 1e-6, 1.0, 1e6, 1e30):
        rows.append(
            Case(
                LIGHT,
                f"plane of radiance {level:g}",
                "shadow ratio",
                MAX_ABSOLUTE,
                partial(ratio, level=level),
                VALUE,
                GRADIENT,
                NO_COUNTERPART,
            )
        )
    for name, raw in COLLAPSED.items():
        rows.append(
            Case(
                TONE,
                f"curve: {name}",
                "value",
                "max over 1 + slope",
                partial(curve, raw=raw),
                CURVE,
                CURVE_GRADIENT,
                NO_COUNTERPART,
            )
        )
    rows += [
        Case(
            TONE,
            "curves at and beyond their ends",
            "value, gradient",
            MAX_ABSOLUTE,
            beyond,
            0.0,
            mitsuba=NO_COUNTERPART,
        ),
        Case(
            TONE,
            "bins of no width or height",
            "fall, excess",
            MAX_ABSOLUTE,
            empty_bins,
            VALUE,
            mitsuba=NO_COUNTERPART,
        ),
        Case(
            TONE,
            "raw parameters up to 1e30",
            "knots",
            MAX_ABSOLUTE,
            raw_curve,
            VALUE,
            mitsuba=NO_COUNTERPART,
        ),
        Case(
            TONE,
            "Reinhard from 0 to 1e30",
            "value",
            MAX_RELATIVE,
            bright,
            VALUE,
            GRADIENT,
            NO_COUNTERPART,
        ),
        Case(
            TONE,
            "encoding from 0 to 1e30",
            "display value",
            MAX_ABSOLUTE,
            encoding,
            ENCODING,
            GRADIENT,
            NO_COUNTERPART,
        ),
    ]
    levels = (
        ("both lights alike", 1.0, 1.0, ""),
        ("a black texel in the object's light", 1.0, 1.0, "fg"),
        ("black texels in the shadow's light", 1.0, 1.0, "shadow"),
        ("a texel black in both", 1.0, 1.0, "both"),
        ("object's light black", 0.0, 1.0, ""),
        ("shadow's light black", 1.0, 0.0, ""),
        ("both black", 0.0, 0.0, ""),
        ("object's light 1e5 times brighter", 1e5, 1.0, ""),
        ("shadow's light 1e5 times brighter", 1.0, 1e5, ""),
        ("both 1e-20", 1e-20, 1e-20, "both"),
        ("1e-20 and 1e5", 1e-20, 1e5, ""),
    )
    for name, fg_level, shadow_level, black in levels:
        rows.append(
            Case(
                FUSION,
                name,
                "primed maps",
                "max over the peak",
                partial(fusion, fg_level=fg_level, shadow_level=shadow_level, black=black),
                FUSED,
                FUSED_GRADIENT,
                NO_COUNTERPART,
            )
        )
    return rows
