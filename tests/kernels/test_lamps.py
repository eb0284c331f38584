"""Lamps as a point sees them: closed irradiance, densities, what rays meet; shadows and paths."""

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import launch, upload
from warpir.kernels.lamps.solid_angle import (
    lamp_along,
    lamp_point,
    lamps_sample,
    pick_total,
)
from warpir.kernels.types import LampArgs
from warpir.render.device_light import lamp_args
from warpir.scene.near.lamps import Lamp, RectangleLamp, SphereLamp, irradiance

WHITE = np.ones(3)
SPHERE = SphereLamp(np.array([0.3, 1.2, -0.4]), 0.35, WHITE)
RECTANGLE = RectangleLamp(
    np.array([0.3, 1.2, -0.4]), np.array([0.9, 0.0, 0.0]), np.array([0.0, 0.3, 0.4]), WHITE
)
POINTS = np.array(
    [
        (0.0, 0.0, 0.0),
        (2.0, 0.0, 1.0),
        (0.3, 0.8, -0.4),  # near the surface
        (0.3, 1.1, 0.1),
        (-20.0, 0.0, 11.0),  # far
        (0.3, 1.25, 1.5),  # the horizon of an upright normal cuts the lamp
    ]
)
INSIDE = np.array([(0.3, 1.2, -0.4), (0.4, 1.3, -0.3), (0.3, 1.2, -0.06)])
NORMALS = np.array([(0.0, 1.0, 0.0), (0.48, 0.6, 0.64), (1.0, 0.0, 0.0), (0.0, -0.8, -0.6)])
SAMPLE_COUNT = 1 << 16
ROUNDING = 2e-5
"""Relative, of float32 angles; those of rectangles add up four of them."""

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sample_kernel(
    lamps: LampArgs,
    p: wp.vec3,
    u: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    pdf: wp.array[float],
    distance: wp.array[float],
    radiance: wp.array[wp.vec3],
):
    i = wp.tid()
    total = pick_total(lamps, p)
    out = lamps_sample(lamps, p, total, wp.vec2(u[i][0], u[i][1]), u[i][2])
    pdf[i] = wp.where(out.valid == 1, out.pdf, 0.0)
    wi[i] = out.wi
    distance[i] = out.distance
    radiance[i] = out.radiance


@wp.kernel
def along_kernel(
    lamps: LampArgs,
    p: wp.vec3,
    wi: wp.array[wp.vec3],
    pdf: wp.array[float],
    distance: wp.array[float],
):
    i = wp.tid()
    met = lamp_along(lamps, 0, p, wi[i])
    pdf[i] = wp.where(met.valid == 1, met.pdf, 0.0)
    distance[i] = met.distance


@wp.kernel
def own_kernel(
    lamps: LampArgs,
    p: wp.vec3,
    u: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    pdf: wp.array[float],
    distance: wp.array[float],
):
    i = wp.tid()
    out = lamp_point(lamps, 0, p, wp.vec2(u[i][0], u[i][1]))
    pdf[i] = wp.where(out.valid == 1, out.pdf, 0.0)
    wi[i] = out.wi
    distance[i] = out.distance


OUTPUTS = {
    "sample_kernel": (wp.vec3, float, float, wp.vec3),
    "along_kernel": (float, float),
    "own_kernel": (wp.vec3, float, float),
}


def seen(
    kernel: wp.Kernel, lamps: list[Lamp], p: np.ndarray, given: np.ndarray, device: str
) -> list[np.ndarray]:
    """Return what a kernel writes for one point: directions, densities, distances."""
    args = lamp_args(lamps, np.zeros(3), wp.get_device(device))
    inputs = [args, wp.vec3(*p.astype(np.float32)), upload(given, wp.vec3, device)]
    return launch(kernel, len(given), inputs, *OUTPUTS[kernel.key], device=device)


def numbers(rng: np.random.Generator, count: int = SAMPLE_COUNT) -> np.ndarray:
    """Uniform numbers, the first two stratified, shape [count, 3]."""
    side = int(np.sqrt(count))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    pair = (grid + rng.random(grid.shape)) / side
    return np.minimum(np.hstack([pair, rng.random((len(pair), 1))]), 0.9999999)


def surface(lamp: Lamp, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Evenly spread points of a lamp's surface, ``count`` squared, their normals, and its area."""
    g = (np.arange(count) + 0.5) / count
    if isinstance(lamp, RectangleLamp):
        s, t = (x.reshape(-1, 1) for x in np.meshgrid(g, g))
        q = lamp.corner + s * lamp.edge_x + t * lamp.edge_y
        m = np.cross(lamp.edge_x, lamp.edge_y)
        area = float(np.linalg.norm(m))
        return q, np.broadcast_to(m / area, q.shape), area
    z, phi = (x.reshape(-1) for x in np.meshgrid(2.0 * g - 1.0, 2.0 * np.pi * g))
    r = np.sqrt(1.0 - z * z)
    m = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    return lamp.center + lamp.radius * m, m, 4.0 * np.pi * lamp.radius**2


def quadrature(lamp: Lamp, p: np.ndarray, n: np.ndarray) -> float:
    """Irradiance by radiance 1 from the lamp's surface, by midpoints."""
    q, m, area = surface(lamp, 600)
    w = q - p
    d = np.linalg.norm(w, axis=1)
    cosines = np.maximum(w @ n / d, 0.0) * np.maximum(-(w * m).sum(axis=1) / d, 0.0)
    return float((cosines / d**2).mean() * area)


@pytest.mark.parametrize("lamp", [SPHERE, RECTANGLE])
def test_lamps_closed_irradiance_is_that_of_the_surface(lamp: Lamp) -> None:
    for p in POINTS:
        for n in NORMALS:
            expected = quadrature(lamp, p, n)
            closed = float(irradiance(lamp, p, n)[0] / lamp.radiance[0])
            assert closed == pytest.approx(expected, rel=4e-3, abs=2e-5), (p, n)


@pytest.mark.parametrize("lamp", [SPHERE, RECTANGLE])
def test_lamps_samples_give_the_closed_irradiance(
    lamp: Lamp, device: str, rng: np.random.Generator
) -> None:
    """Mean of cos / pdf; 65 536 stratified directions of a bounded cosine."""
    for p in POINTS:
        wi, pdf, _, radiance = seen(sample_kernel, [lamp], p, numbers(rng), device)
        for n in NORMALS:
            expected = float(irradiance(lamp, p, n)[0])
            weight = np.where(pdf > 0.0, np.maximum(wi @ n, 0.0) / np.maximum(pdf, 1e-30), 0.0)
            found = weight * radiance[:, 0]
            error = found.std() / np.sqrt(len(found)) * 0.1 + ROUNDING * found.max()
            assert found.mean() == pytest.approx(expected, rel=3e-4, abs=4.0 * error), (p, n)


def test_lamps_light_what_is_inside_from_all_sides(device: str, rng: np.random.Generator) -> None:
    for p in INSIDE:
        wi, pdf, distance, _ = seen(sample_kernel, [SPHERE], p, numbers(rng), device)
        np.testing.assert_allclose(pdf, 0.25 / np.pi, rtol=1e-6)
        end = p + wi * distance[:, None]
        reach = np.linalg.norm(end - SPHERE.center, axis=1)
        np.testing.assert_allclose(reach, SPHERE.radius, rtol=1e-5)
        for n in NORMALS:
            assert float(irradiance(SPHERE, p, n)[0]) == np.pi * SPHERE.radiance[0]
            mean = (np.maximum(wi @ n, 0.0) / pdf).mean()
            assert mean == pytest.approx(np.pi, rel=1e-3)


@pytest.mark.parametrize("lamp", [SPHERE, RECTANGLE])
def test_lamps_rays_meet_what_is_drawn(lamp: Lamp, device: str, rng: np.random.Generator) -> None:
    """Both techniques agree on density and distance, so their weights add up to 1."""
    for p in [*POINTS, *(INSIDE if lamp is SPHERE else [])]:
        u = numbers(rng, 4096)
        wi, pdf, distance = seen(own_kernel, [lamp], p, u, device)
        if not pdf.any():
            continue
        met_pdf, met_distance = seen(along_kernel, [lamp], p, wi, device)
        met = met_pdf > 0.0
        assert met.mean() > 0.998  # all but a few of the lamp's edge
        np.testing.assert_allclose(met_pdf[met], pdf[met], rtol=1e-4)
        np.testing.assert_allclose(met_distance[met], distance[met], rtol=3e-3)


@pytest.mark.parametrize("lamp", [SPHERE, RECTANGLE])
def test_lamps_density_integrates_to_one(lamp: Lamp, device: str, rng: np.random.Generator) -> None:
    """Over all directions, by `lamp_along`; each count is that of the lamp's solid angle."""
    z, phi = 2.0 * rng.random(1 << 21) - 1.0, 2.0 * np.pi * rng.random(1 << 21)
    r = np.sqrt(1.0 - z * z)
    wi = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    for p in POINTS[[0, 3]]:
        pdf, _ = seen(along_kernel, [lamp], p, wi, device)
        if not pdf.any():
            continue
        values = 4.0 * np.pi * pdf
        error = values.std() / np.sqrt(len(values))
        assert abs(values.mean() - 1.0) < 4.0 * error


def test_lamps_of_many_add_up(device: str, rng: np.random.Generator) -> None:
    """One lamp is picked, by luminance times solid angle; the sum of all comes out."""
    dim = SphereLamp(np.array([-1.0, 0.4, 0.5]), 0.02, np.array([0.1, 0.4, 0.0]))
    black = SphereLamp(np.array([0.1, 0.4, 0.5]), 0.2, np.zeros(3))
    lamps: list[Lamp] = [black, SPHERE, dim, RECTANGLE]
    p, n = np.array([0.0, 0.0, 0.4]), NORMALS[0]
    expected = sum(irradiance(lamp, p, n) for lamp in lamps)
    wi, pdf, _, radiance = seen(sample_kernel, lamps, p, numbers(rng), device)
    found = radiance * (np.maximum(wi @ n, 0.0) / pdf)[:, None]
    error = found.std(axis=0) / np.sqrt(len(found))
    assert (np.abs(found.mean(axis=0) - expected) < 4.0 * error).all()


def test_lamps_that_are_black_or_turned_away_give_nothing(
    device: str, rng: np.random.Generator
) -> None:
    black = SphereLamp(SPHERE.center, 0.2, np.zeros(3))
    away = RectangleLamp(RECTANGLE.center, RECTANGLE.edge_y, RECTANGLE.edge_x, WHITE)
    behind = np.array([0.3, 1.25, 1.5])
    for lamp, p in ((black, POINTS[0]), (away, behind), (RECTANGLE, np.array([0.3, 1.0, -3.0]))):
        assert irradiance(lamp, p, -NORMALS[3]).max() == 0.0
        assert seen(sample_kernel, [lamp], p, numbers(rng, 64), device)[1].max() == 0.0
