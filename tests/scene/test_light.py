"""Light as arrays: turning, resampling, measuring, describing, fitting lobes, exposure."""

import numpy as np
import pytest

from tests.builders.shapes import box_before, camera, constant, lobe
from tests.oracles import (
    latlong_direction,
    luminance,
    reinhard,
    sg_flux,
    sg_irradiance,
    sg_radiance,
    texel_direction,
    texel_solid_angle,
)
from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import map_directions, resize_map, rotate_map, texel_solid_angles
from warpir.lighting.fit import LAMP_COUNT_MAX, fit_lobes
from warpir.lighting.scene_light import SKIES, SUN_TO_SKY, SceneLight, make_light
from warpir.render.device_light import light_args
from warpir.scene.lamps import LAMP_RADIUS_DEG, suns_of
from warpir.scene.light import (
    Light,
    Lobes,
    angles_from_axis,
    as_file_map,
    as_map,
    axis_from_angles,
    plain_sky,
    rasterize_lobes,
    summarize,
    sun_lobe,
)

FLOAT32 = 1e-5
"""Relative; what float32 maps keep of a float64 sum."""
QUADRATURE = 2e-3
"""Relative; midpoint rules of 256 x 256 points in a lobe, or of a map of 64 rows."""
UP = np.array([0.0, 1.0, 0.0])


def flux(texels: FloatArray) -> Float64Array:
    """Energy of a map [sr x radiance], RGB, with the oracle's solid angles."""
    omega = texel_solid_angle(*texels.shape[:2])
    return np.einsum("i,ijc->c", omega, texels.astype(np.float64))


def one_texel(height: int, i: int, j: int, value: float = 1.0) -> FloatArray:
    """A black map with one bright texel."""
    texels = np.zeros((height, 2 * height, 3), np.float32)
    texels[i, j] = value
    return texels


def noise_map(height: int) -> FloatArray:
    """A map with structure at every texel."""
    rng = np.random.default_rng(3)
    return rng.uniform(0.0, 2.0, (height, 2 * height, 3)).astype(np.float32)


def turned(v: Float64Array, degrees: float) -> Float64Array:
    """Rotation about +Y by the right-hand rule: counter-clockwise seen from above."""
    a = np.radians(degrees)
    x, y, z = v
    return np.array([np.cos(a) * x + np.sin(a) * z, y, -np.sin(a) * x + np.cos(a) * z])


# ----------------------------------------------------------------------- frames and turning


def test_map_directions_and_solid_angles_are_the_oracle() -> None:
    """Texel centres and solid angles match the formulas; the sphere sums to 4 pi."""
    v, u = np.meshgrid((np.arange(5) + 0.5) / 5, (np.arange(10) + 0.5) / 10, indexing="ij")
    expected = latlong_direction(np.stack([u, v], axis=-1))
    np.testing.assert_allclose(map_directions(5, 10), expected, atol=1e-12)
    np.testing.assert_allclose(texel_solid_angles(5, 10), texel_solid_angle(5, 10), rtol=1e-12)
    assert texel_solid_angles(5, 10).sum() * 10 == pytest.approx(4.0 * np.pi)


@pytest.mark.parametrize("degrees", [90.0, -90.0, 45.0, 180.0, 337.5, -720.0])
def test_rotation_turns_maps_and_lobes_alike(degrees: float) -> None:
    """A texel and a lobe both end where the right-handed rotation about +Y puts them."""
    height = 32
    for i, j in ((8, 5), (16, 40), (25, 63)):
        before = map_directions(height, 2 * height)[i, j]
        light = Light(lobe(before, 50.0).lobes, one_texel(height, i, j)).rotated(degrees)
        assert light.texels is not None and light.lobes is not None
        peak = np.unravel_index(np.argmax(light.texels[..., 0]), (height, 2 * height))
        expected = turned(before, degrees)
        found = map_directions(height, 2 * height)[peak]
        np.testing.assert_allclose(found, expected, atol=1e-9)
        np.testing.assert_allclose(light.lobes.axis[0], expected, atol=1e-6)


def test_rotation_by_90_takes_the_right_to_the_front() -> None:
    """Counter-clockwise from above: light from the right, +X, then comes from ahead, -Z."""
    light = lobe((1.0, 0.0, 0.0), 10.0).rotated(90.0)
    assert light.lobes is not None
    np.testing.assert_allclose(light.lobes.axis[0], [0.0, 0.0, -1.0], atol=1e-6)
    assert angles_from_axis(light.lobes.axis[0].astype(float))[0] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("degrees", [1.0, -77.7, 123.456])
def test_rotation_keeps_energy_between_texels(degrees: float) -> None:
    """Turns by a share of a texel keep each row's sum and move the centroid by the angle."""
    texels = one_texel(64, 20, 30, 5.0)
    found = rotate_map(texels, degrees)
    np.testing.assert_allclose(found.sum(axis=1), texels.sum(axis=1), rtol=FLOAT32, atol=1e-6)
    assert found.min() >= 0.0
    directions = map_directions(64, 128)
    centroid = (found[..., :1] * directions).sum(axis=(0, 1))
    expected = turned(directions[20, 30], degrees)
    angle = np.degrees(np.arctan2(centroid[0], centroid[2]) - np.arctan2(expected[0], expected[2]))
    # Linear interpolation shifts the direction's centroid by under 0.02 texels.
    assert abs((angle + 180.0) % 360.0 - 180.0) < 0.02 * 360.0 / 128.0


@pytest.mark.parametrize("degrees", [0.0, 360.0, -360.0])
def test_full_turn_is_the_identity(degrees: float) -> None:
    """0 and 360 degrees change no bit of a map, and no digit of a lobe."""
    light = Light(lobe((0.3, 0.5, -0.8), 7.0).lobes, noise_map(8))
    found = light.rotated(degrees)
    assert found.lobes is not None and light.lobes is not None
    np.testing.assert_array_equal(found.texels, light.texels)
    np.testing.assert_allclose(found.lobes.axis, light.lobes.axis, atol=1e-7)


def test_angles_and_axes_are_inverse() -> None:
    """Azimuth 0 is -Z, +90 is +X, elevation 90 is +Y; both directions agree."""
    for angles, axis in {
        (0.0, 0.0): (0, 0, -1),
        (90.0, 0.0): (1, 0, 0),
        (-90.0, 0.0): (-1, 0, 0),
        (180.0, 0.0): (0, 0, 1),
        (0.0, 90.0): (0, 1, 0),
    }.items():
        np.testing.assert_allclose(axis_from_angles(*angles), axis, atol=1e-12)
    for angles in ((-120.0, 40.0), (33.0, -12.5), (179.0, 89.0)):
        assert angles_from_axis(axis_from_angles(*angles)) == pytest.approx(angles)


# ------------------------------------------------------------------------------ resampling


@pytest.mark.parametrize("height", [1, 2, 8, 16, 24, 31, 48, 100])
def test_resize_keeps_energy_and_constants(height: int) -> None:
    """Any size keeps the flux, keeps a constant constant, and creates no negative value."""
    texels = noise_map(24)
    found = resize_map(texels, height)
    assert found.shape == (height, 2 * height, 3) and found.min() >= 0.0
    np.testing.assert_allclose(flux(found), flux(texels), rtol=FLOAT32)
    flat = resize_map(np.full((24, 48, 3), 3.0, np.float32), height)
    np.testing.assert_allclose(flat, 3.0, rtol=FLOAT32)


def test_resize_down_is_the_solid_angle_mean() -> None:
    """A whole factor down averages each block by solid angle; the same size is the same array."""
    texels = noise_map(24)
    omega = texel_solid_angle(24, 48)[:, None, None]
    blocks = (texels * omega).reshape(8, 3, 16, 3, 3).sum(axis=(1, 3))
    weight = np.broadcast_to(omega, (24, 48, 1)).reshape(8, 3, 16, 3, 1).sum(axis=(1, 3))
    np.testing.assert_allclose(resize_map(texels, 8), blocks / weight, rtol=FLOAT32)
    np.testing.assert_array_equal(resize_map(texels, 24), texels)
    back = resize_map(resize_map(texels, 48), 24)
    np.testing.assert_allclose(back, texels, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("sharpness", [0.5, 5.0, 100.0, 3e3, 2e4, 1.85e5])
@pytest.mark.parametrize("height", [16, 64])
def test_as_map_keeps_the_flux_of_lobes(height: int, sharpness: float) -> None:
    """A lobe's energy is on the map, however narrow it is, also at the pole and the seam."""
    for axis in ((0.3, 0.4, -0.8), (0.0, 1.0, 0.0), (0.0, 0.2, -1.0), (1e-9, -1.0, 0.0)):
        light = lobe(axis, sharpness, (3.0, 2.0, 1.0))
        found = flux(as_map(light, height))
        # 4 x 4 points per texel at the narrowest lobe that is not put into one texel.
        np.testing.assert_allclose(found, np.array([3, 2, 1]) * sg_flux(sharpness), rtol=0.02)


def test_as_map_adds_lobes_and_map() -> None:
    """The whole light is the sum; a map alone is resampled, at its own size untouched."""
    light = Light(lobe((0.2, 0.9, 0.1), 20.0).lobes, noise_map(16))
    assert light.texels is not None and light.lobes is not None
    expected = light.texels + rasterize_lobes(light.lobes, 16, 32)
    np.testing.assert_allclose(as_map(light, 16), expected, rtol=FLOAT32)
    np.testing.assert_array_equal(as_map(Light(texels=light.texels), 16), light.texels)


def test_rasterized_lobes_are_means_over_each_texel() -> None:
    """Against many more directions per texel, at a pole too."""
    axis = np.array([[0.3, 0.4, -0.8], [0.0, 1.0, 0.0], [-1.0, -0.1, 0.3]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    amplitude = np.array([[3.0, 2.0, 1.0], [0.5, 0.5, 0.5], [1.0, 4.0, 9.0]])
    lobes = Lobes(*(x.astype(np.float32) for x in (amplitude, axis, np.array([2.0, 15.0, 60.0]))))
    side = 24
    fine = sg_radiance(texel_direction(16 * side, 32 * side), amplitude, axis, lobes.sharpness)
    omega = texel_solid_angle(16 * side, 32 * side)[:, None, None]
    sums = (fine * omega).reshape(16, side, 32, side, 3).sum(axis=(1, 3))
    means = sums / texel_solid_angle(16, 32)[:, None, None]
    host = rasterize_lobes(lobes, 16, 32)
    # A few directions per texel; the sharpest lobe is one texel wide.
    assert np.abs(host - means).max() < 0.02 * means.max()
    np.testing.assert_allclose(flux(host), flux(means), rtol=FLOAT32 + QUADRATURE)


# ------------------------------------------------------------------------------- measuring


@pytest.mark.parametrize("sharpness", [0.1, 1.0, 10.0, 300.0, 1.85e5])
@pytest.mark.parametrize("elevation", [90.0, 40.0, 3.0, 0.0, -20.0])
def test_lobe_irradiance_matches_quadrature(sharpness: float, elevation: float) -> None:
    """Irradiance over flux is the mean clamped cosine of a lobe, above and below."""
    axis = axis_from_angles(70.0, elevation)
    expected = sg_irradiance(UP, axis, sharpness) / sg_flux(sharpness)
    light = lobe(axis, sharpness, (1.0, 2.0, 3.0))
    found = light.irradiance(UP) / (np.array([1, 2, 3]) * sg_flux(sharpness))
    np.testing.assert_allclose(found, expected, rtol=QUADRATURE, atol=1e-5)


def test_map_irradiance_matches_closed_forms() -> None:
    """A constant sky gives pi; one texel its radiance, solid angle and cosine; sums add up."""
    for normal in (UP, np.array([0.6, 0.0, 0.8])):
        found = constant((1.0, 2.0, 3.0), 64).irradiance(normal)
        np.testing.assert_allclose(found, np.pi * np.array([1, 2, 3]), rtol=QUADRATURE)
    texels = one_texel(32, 10, 20, 7.0)
    cosine = map_directions(32, 64)[10, 20] @ UP
    expected = 7.0 * texel_solid_angle(32, 64)[10] * cosine
    np.testing.assert_allclose(Light(texels=texels).irradiance(UP), expected, rtol=FLOAT32)
    np.testing.assert_array_equal(Light(texels=texels).irradiance(-UP), 0.0)
    both = Light(lobe(UP, 10.0).lobes, texels).irradiance(UP)
    np.testing.assert_allclose(both, expected + lobe(UP, 10.0).irradiance(UP), rtol=1e-12)


def test_scaling_scales_everything() -> None:
    """Irradiance of a scaled light is scaled, lobes and map alike."""
    light = Light(lobe(UP, 10.0).lobes, noise_map(8))
    found = light.scaled(2.5).irradiance(UP)
    np.testing.assert_allclose(found, 2.5 * light.irradiance(UP), rtol=FLOAT32)


def test_sun_lobe_gives_the_irradiance_asked_for() -> None:
    """A surface facing the sun gets its irradiance, and the sun has the sun's angular size."""
    lobes = sun_lobe(30.0, 50.0, (4.0, 3.0, 2.0))
    axis = axis_from_angles(30.0, 50.0)
    np.testing.assert_allclose(lobes.axis[0], axis, atol=1e-6)
    found = Light(lobes).irradiance(axis)
    np.testing.assert_allclose(found, [4.0, 3.0, 2.0], rtol=1e-4)
    found = Light(lobes).irradiance(UP)
    np.testing.assert_allclose(found, np.sin(np.radians(50.0)) * np.array([4, 3, 2]), rtol=1e-4)
    # Mean squared angle: r^2 / 2 of a disc, 2 / sharpness of a lobe.
    radius = np.degrees(np.sqrt(4.0 / float(lobes.sharpness[0])))
    assert radius == pytest.approx(0.2665, rel=1e-4)


def test_plain_sky_is_two_hemispheres() -> None:
    """Radiance above and below the horizon; irradiance pi times each."""
    texels = plain_sky((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
    above = map_directions(*texels.shape[:2])[..., 1] > 0.0
    np.testing.assert_array_equal(texels[above], np.tile(np.float32([1, 2, 3]), (above.sum(), 1)))
    light = Light(texels=texels)
    np.testing.assert_allclose(light.irradiance(UP), np.pi * np.array([1, 2, 3]), rtol=QUADRATURE)
    below = light.irradiance(-UP)
    np.testing.assert_allclose(below, np.pi * np.array([0.1, 0.2, 0.3]), rtol=QUADRATURE)


def test_summary_finds_the_brightest_direction() -> None:
    """Azimuth and elevation of a sun, its share of the flux, mean of a constant."""
    flat = summarize(constant((2.0, 2.0, 2.0)))
    assert flat.mean_luminance == pytest.approx(2.0, rel=FLOAT32)
    assert flat.peak_luminance == pytest.approx(2.0, rel=FLOAT32)
    cap = 0.5 * (1.0 - np.cos(np.radians(5.0)))
    assert flat.peak_share == pytest.approx(cap, rel=0.1)
    sun = sun_lobe(-75.0, 35.0, (1.0, 1.0, 1.0))
    found = summarize(Light(sun, plain_sky((1 / np.pi, 1 / np.pi, 1 / np.pi), (0, 0, 0))))
    assert found.azimuth_deg == pytest.approx(-75.0, abs=1.0)
    assert found.elevation_deg == pytest.approx(35.0, abs=1.0)
    # Sun: flux 1; sky: 2 pi / pi = 2, of which the cap is 2 cap.
    assert found.peak_share == pytest.approx((1.0 + 4.0 * cap) / 3.0, rel=0.01)
    assert found.mean_luminance == pytest.approx(3.0 / (4.0 * np.pi), rel=0.01)
    assert summarize(constant((0.0, 0.0, 0.0))).peak_share == 0.0


# --------------------------------------------------------------------------------- upload


def test_file_map_keeps_a_given_maps_texels() -> None:
    """A panorama is written as it was given; lobes come on 512 rows; both are summed."""
    texels = np.random.default_rng(1).uniform(0, 2, (32, 64, 3)).astype(np.float32)
    np.testing.assert_array_equal(as_file_map(Light(texels=texels)), texels)
    lobes = lobe((0.2, 0.9, 0.1), 20.0).lobes
    assert as_file_map(Light(lobes)).shape == (512, 1024, 3)
    both = as_file_map(Light(lobes, texels))
    np.testing.assert_allclose(
        both,
        as_file_map(Light(lobes)) + np.repeat(np.repeat(texels, 16, axis=0), 16, axis=1),
        rtol=1e-4,
        atol=1e-5,
    )


@pytest.mark.parametrize(
    "light",
    [
        Light(),
        Light(lobes=Lobes(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0))),
        lobe(UP, 3.0, (1.0, -1e-6, 1.0)),
        Light(texels=np.full((2, 4, 3), -1e-6, np.float32)),
        Light(lobe(UP, 3.0).lobes, np.full((2, 4, 3), -1.0, np.float32)),
    ],
    ids=["nothing", "no-lobes", "negative-lobe", "negative-map", "lobe-and-negative-map"],
)
def test_upload_refuses_what_no_light_is(device: str, light: Light) -> None:
    """Negative or absent light never reaches a kernel."""
    with pytest.raises(ValueError, match=r"light|lobes"):
        light_args(light, device)


@pytest.mark.case("R10")
@pytest.mark.parametrize(
    ("light", "words"),
    [
        (lobe(UP, 3.0, (1.0, np.nan, 1.0)), "1 of the"),
        (lobe(UP, np.inf), "1 of the"),
        (Light(texels=np.full((2, 4, 3), np.nan, np.float32)), "24 of the 24 values of its map"),
        (Light(texels=np.full((2, 4, 3), np.inf, np.float32)), "24 of the 24 values of its map"),
    ],
    ids=["nan-lobe", "infinite-sharpness", "nan-map", "infinite-map"],
)
def test_upload_refuses_what_is_not_finite(device: str, light: Light, words: str) -> None:
    """A light that is not finite is a numeric failure of the run, not a fault of the program."""
    with pytest.raises(InputError, match=words) as caught:
        light_args(light, device)
    assert caught.value.code == ExitCode.NUMERIC


def test_upload_shares_the_proposal_by_the_root_of_the_flux(device: str) -> None:
    """Strong parts have sixteenths in proportion to the root of their flux; the sum is 1."""
    texels = np.full((8, 16, 3), 1.0, np.float32)
    light = Light(lobe(UP, 10.0, (5.0, 5.0, 5.0)).lobes, texels)
    args = light_args(light, device)
    root = np.sqrt([4.0 * np.pi, 5.0 * float(sg_flux(10.0))])
    assert args.map_prob == round(16.0 * root[0] / root.sum()) / 16.0 == 11.0 / 16.0
    assert args.bright_prob == 0.0
    assert args.lobe_prob.numpy().sum() + args.map_prob == pytest.approx(1.0, rel=FLOAT32)
    table = args.texel_prob.numpy() / args.map_prob
    expected = texel_solid_angle(8, 16) / (4.0 * np.pi)
    np.testing.assert_allclose(table, np.tile(expected[:, None], (1, 16)), rtol=1e-4, atol=1e-8)
    texels[2, 5] = 1000.0
    args = light_args(Light(texels=texels), device)
    flux = texel_solid_angle(8, 16)[2] * 1000.0
    root = np.sqrt([4.0 * np.pi, flux])
    assert args.bright_prob == round(16.0 * root[1] / root.sum()) / 16.0
    assert args.texel_prob.numpy()[2, 5] == pytest.approx(args.bright_prob, rel=FLOAT32)


def test_upload_draws_weak_lobes_by_flux_after_the_strong(device: str) -> None:
    """Strong lobes come first, in sixteenths; forty weak ones share what is left by their flux."""
    rng = np.random.default_rng(5)
    axis = rng.normal(size=(42, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    level = np.append(np.linspace(0.5, 1.5, 40), [400.0, 60.0])
    amplitude = np.repeat(level[:, None], 3, axis=1)
    lobes = Lobes(*(a.astype(np.float32) for a in (amplitude, axis, np.full(42, 30.0))))
    args = light_args(Light(lobes), device)
    prob = args.lobe_prob.numpy().astype(np.float64)
    np.testing.assert_allclose(args.axis.numpy()[:2], lobes.axis[-2:])
    np.testing.assert_array_equal(prob[:2] * 16.0, np.round(prob[:2] * 16.0))
    np.testing.assert_allclose(prob[2:] / prob[2:].sum(), level[39::-1] / 40.0, rtol=1e-6)
    assert prob.sum() == pytest.approx(1.0)


def test_upload_of_a_black_light_is_a_proposal_too(device: str) -> None:
    """Black maps and lobes are drawn all the same."""
    texels = np.ones((8, 16, 3), np.float32)
    for black in (Light(texels=0.0 * texels), lobe(UP, 3.0, (0.0, 0.0, 0.0))):
        args = light_args(black, device)
        assert args.map_prob + args.lobe_prob.numpy().sum() == pytest.approx(1.0)


# -------------------------------------------------------------------------------- lobe fit


def with_lamps(*lamps: tuple[float, float, float, float], base: float = 0.2) -> FloatArray:
    """A map of constant ``base`` plus discs (azimuth, elevation, radius [deg], radiance)."""
    texels = np.full((128, 256, 3), base, np.float32)
    directions = map_directions(128, 256)
    for azimuth, elevation, radius, radiance in lamps:
        inside = directions @ axis_from_angles(azimuth, elevation) > np.cos(np.radians(radius))
        texels[inside] = radiance
    return texels


FIT_MAPS = {
    # name: map, lamps, greatest error of irradiance and of flux at 32 lobes.
    "constant": (with_lamps(), 0, 0.01, 0.01),
    "sun": (with_lamps((40.0, 50.0, 1.0, 1e4)), 1, 0.02, 0.01),
    "low-sun": (with_lamps((-100.0, 5.0, 1.0, 1e4)), 1, 0.02, 0.01),
    "lamps": (
        with_lamps((0.0, 60.0, 3.0, 80.0), (90.0, 40.0, 3.0, 60.0), (-120.0, 20.0, 3.0, 50.0)),
        3, 0.03, 0.02,
    ),
    "two-skies": (plain_sky((1.0, 1.5, 2.0), (0.3, 0.2, 0.1)), 0, 0.06, 0.03),
}  # fmt: skip
"""Tolerances: broad lobes spaced evenly are within 2 % of a constant; a horizon is blurred."""


@pytest.mark.parametrize("name", FIT_MAPS)
def test_fitted_lobes_light_like_the_map(name: str) -> None:
    """Irradiance and flux of 32 fitted lobes match the map; lamps get lobes of their own."""
    texels, lamps, irradiance_error, flux_error = FIT_MAPS[name]
    fit = fit_lobes(texels, 32)
    assert len(fit.lobes.sharpness) == 32
    assert fit.lobes.amplitude.min() >= 0.0 and np.isfinite(fit.lobes.amplitude).all()
    np.testing.assert_allclose(np.linalg.norm(fit.lobes.axis, axis=1), 1.0, atol=1e-6)
    assert fit.lamp_count == lamps
    assert fit.irradiance_error < irradiance_error
    assert fit.flux_error < flux_error
    # What the record says is what an independent measurement finds.
    truth = float(luminance(flux(texels)))
    fitted = float(luminance(fit.lobes.flux().sum(axis=0)))
    assert abs(fitted / truth - 1.0) == pytest.approx(fit.flux_error, abs=1e-4)
    for normal in (UP, axis_from_angles(40.0, 20.0), axis_from_angles(-60.0, 0.0)):
        expected = Light(texels=texels).irradiance(normal)
        found = Light(fit.lobes).irradiance(normal)
        assert np.abs(found / expected - 1.0).max() < 3.0 * irradiance_error


def test_fitted_sun_has_its_direction_and_flux() -> None:
    """The sun's lobe points at it within a texel and holds its flux, at any count of lobes."""
    texels = with_lamps((40.0, 50.0, 1.0, 1e4))
    axis = axis_from_angles(40.0, 50.0)
    disc = flux(np.where(texels > 1.0, texels, 0.0).astype(np.float32))
    for count in (1, 2, 8, 64):
        fit = fit_lobes(texels, count)
        angle = np.degrees(np.arccos(np.clip(fit.lobes.axis @ axis, -1.0, 1.0)))
        assert angle.min() < 180.0 / 128.0
        if count > 1:
            found = fit.lobes.flux()[np.argmin(angle)]
            np.testing.assert_allclose(found, disc, rtol=0.05)


@pytest.mark.parametrize("name", FIT_MAPS)
def test_more_lobes_never_fit_much_worse(name: str) -> None:
    """From 1 to 128 lobes the irradiance error falls, or stays within a few percent."""
    texels = FIT_MAPS[name][0]
    best = np.inf
    for count in (1, 2, 4, 8, 16, 32, 64, 128):
        error = fit_lobes(texels, count).irradiance_error
        assert error < max(1.25 * best, best + 0.02), count
        best = min(best, error)


def test_many_lamps_are_limited() -> None:
    """More lamps than lobes, or than the limit, still gives the number asked for."""
    discs = [(30.0 * k, 20.0 + 10.0 * (k % 3), 2.0, 100.0) for k in range(12)]
    texels = with_lamps(*discs, base=0.01)
    for count in (1, 3, 16):
        fit = fit_lobes(texels, count)
        assert len(fit.lobes.sharpness) == count
        assert fit.lamp_count <= min(count, LAMP_COUNT_MAX)


def test_black_map_fits_black_lobes() -> None:
    """No light fits no light, without a division by zero."""
    fit = fit_lobes(np.zeros((16, 32, 3), np.float32), 4)
    np.testing.assert_array_equal(fit.lobes.amplitude, 0.0)
    assert fit.flux_error == 0.0 and fit.irradiance_error == 0.0


def test_a_fit_of_no_lobes_is_refused() -> None:
    """SciPy's solver ends the process where there is nothing to solve for."""
    with pytest.raises(ValueError, match="at least one"):
        fit_lobes(np.ones((16, 32, 3), np.float32), 0)


# ------------------------------------------------------------------- from flags to a light


def inputs_for(level: float | FloatArray, light: Light | None = None) -> Inputs:
    """A 48 x 32 photo of one linear level, a box on y = 0 in its middle."""
    srgb = np.asarray(level, np.float32) ** np.float32(1.0 / 2.2)
    srgb = np.broadcast_to(srgb, (32, 48, 3)).astype(np.float32)
    codes = np.round(srgb * 65535.0).astype(np.uint16)
    return box_before(camera(48, 32, 48.0, (0.0, 1.5, 0.0), -15.0), srgb, codes, light)


def config_for(tone: str = "reinhard", **values: object) -> InsertConfig:
    """A configuration that names its files but reads none."""
    return InsertConfig(photo="p", asset="a", out="o", tone=tone, **values)


def light_for(inputs: Inputs, **values: object) -> SceneLight | None:
    """The light of these values."""
    config = config_for(**values)
    return make_light(inputs, config.light, config.tone_operator)


def ground_level(light: Light, albedo: float) -> float:
    """Linear luminance of Lambertian ground before the tone operator."""
    return albedo * float(luminance(light.irradiance(UP))) / np.pi


@pytest.mark.parametrize("tone", ["reinhard", "linear"])
@pytest.mark.parametrize("level", [0.02, 0.18, 0.5, 1.0])
@pytest.mark.parametrize("albedo", [0.25, 0.8])
def test_exposure_puts_the_ground_at_the_photos_level(
    level: float, tone: str, albedo: float
) -> None:
    """Display value of ground of the stated albedo = the photo's; a white photo counts as 0.9."""
    given = Light(lobe((0.3, 0.8, 0.2), 500.0, (90.0, 80.0, 70.0)).lobes, noise_map(8))
    config = config_for(light="l.hdr", tone=tone, ground_albedo=albedo)
    made = make_light(inputs_for(level, given), config.light, config.tone_operator)
    shown = ground_level(made.light, albedo)
    if tone == "reinhard":
        shown = float(reinhard(shown))
    assert shown == pytest.approx(min(level, 0.9), rel=1e-3)
    ratio = made.light.irradiance(UP) / given.irradiance(UP)
    np.testing.assert_allclose(ratio, 2.0**made.exposure, rtol=FLOAT32)
    assert len(made.assumed) == 1
    assert "--exposure" in made.assumed[0] and "--ground-albedo" in made.assumed[0]
    assert f"{made.exposure:+.2f} EV" in made.assumed[0]


def test_exposure_reads_the_ground_round_the_object() -> None:
    """A bright sky above the horizon and a bright corner do not count: only ground nearby does."""
    level = np.full((32, 48, 3), 0.1, np.float32)
    level[:6] = 0.9
    level[:, :3] = 0.9
    light = constant()
    made = light_for(inputs_for(level, light), light="l.hdr")
    assert float(reinhard(ground_level(made.light, 0.25))) == pytest.approx(0.1, rel=1e-3)


def test_exposure_stands_for_lit_ground() -> None:
    """Where a third of the ground is in shadow, the lit part sets the level."""
    level = np.full((32, 48, 3), 0.4, np.float32)
    level[:, :20] = 0.05
    made = light_for(inputs_for(level, constant()), light="l.hdr")
    assert float(reinhard(ground_level(made.light, 0.25))) == pytest.approx(0.4, rel=1e-3)


def test_given_exposure_is_taken_and_nothing_assumed() -> None:
    """--exposure multiplies by 2^EV, and then nothing about the light was assumed."""
    made = light_for(inputs_for(0.2, constant()), light="l.hdr", exposure=-1.5)
    assert made.exposure == -1.5 and made.assumed == ()
    np.testing.assert_allclose(made.light.texels, 2.0**-1.5, rtol=FLOAT32)


def test_nothing_said_means_that_the_photo_is_asked() -> None:
    """There is no light of our own making, except the even one that --start uniform asks for."""
    assert light_for(inputs_for(0.2)) is None
    even = light_for(inputs_for(0.2), start="uniform")
    assert even is not None and even.light.texels is not None
    # Reinhard shows radiance .25 as .2.
    np.testing.assert_allclose(even.light.texels, 0.25, rtol=1e-3)
    assert "an even one" in even.assumed[0]


def test_sun_alone_stands_in_a_clear_sky() -> None:
    """A sun without a strength has the stated ratio to the sky, and points where it is said."""
    made = light_for(inputs_for(0.2), sun=(-120.0, 40.0), exposure=0.0)
    assert made is not None
    assert made.light.lobes is not None and made.light.texels is not None
    axis = axis_from_angles(-120.0, 40.0)
    np.testing.assert_allclose(made.light.lobes.axis[0], axis, atol=1e-6)
    sun = float(luminance(Light(made.light.lobes).irradiance(axis)))
    sky = float(luminance(Light(texels=made.light.texels).irradiance(UP)))
    assert sun / sky == pytest.approx(SUN_TO_SKY, rel=QUADRATURE)
    np.testing.assert_allclose(made.light.texels[0, 0], SKIES["clear"][0], rtol=FLOAT32)


@pytest.mark.parametrize("preset", SKIES)
def test_sky_alone_has_no_sun(preset: str) -> None:
    """--sky gives its radiance above and what the ground sends back below, and no lobe."""
    made = light_for(inputs_for(0.2), sky=preset, exposure=0.0)
    assert made.light.lobes is None and made.light.texels is not None
    sky = np.array(SKIES[preset][0])
    np.testing.assert_allclose(made.light.texels[0, 0], sky, rtol=FLOAT32)
    np.testing.assert_allclose(made.light.texels[-1, 0], 0.25 * sky, rtol=FLOAT32)
    assert made.assumed == ()


def test_sun_and_sky_flags_are_taken_as_given() -> None:
    """--sun AZ,EL,STRENGTH and --sky R,G,B: both at their values, the ground by its albedo."""
    config = config_for(sun=(30.0, 60.0, 7.0), sky=(0.1, 0.2, 0.3), exposure=0.0, ground_albedo=0.5)
    light = make_light(inputs_for(0.2), config.light, config.tone_operator).light
    assert light.lobes is not None and light.texels is not None
    axis = axis_from_angles(30.0, 60.0)
    np.testing.assert_allclose(light.lobes.axis[0], axis, atol=1e-6)
    assert luminance(Light(light.lobes).irradiance(axis)) == pytest.approx(7.0, rel=1e-4)
    np.testing.assert_allclose(light.texels[0, 0], [0.1, 0.2, 0.3], rtol=FLOAT32)
    expected = 0.5 * light.irradiance(UP) / np.pi
    np.testing.assert_allclose(light.texels[-1, 0], expected, rtol=QUADRATURE)


def test_sun_below_the_horizon_lights_no_ground() -> None:
    """A set sun adds nothing to what the ground sends back."""
    made = light_for(inputs_for(0.2), sun=(0.0, -10.0), exposure=0.0)
    assert any("below the horizon" in line for line in made.assumed)
    light = made.light
    assert light.texels is not None
    expected = 0.25 * np.array(SKIES["clear"][0])
    np.testing.assert_allclose(light.texels[-1, 0], expected, rtol=FLOAT32)


@pytest.mark.parametrize(
    ("light", "config"),
    [
        (constant((0.0, 0.0, 0.0)), {"light": "night.hdr"}),
        (lobe((0.0, -1.0, 0.0), 1e4), {"light": "night.hdr"}),
        (None, {"sky": (0.0, 0.0, 0.0)}),
    ],
    ids=["black-map", "from-below", "black-sky"],
)
def test_light_that_misses_the_ground_is_refused(
    light: Light | None, config: dict[str, object]
) -> None:
    """No exposure follows from a dark ground: the error names the flag; --exposure still works."""
    with pytest.raises(InputError, match="no light reaches the ground") as caught:
        light_for(inputs_for(0.2, light), **config)
    assert caught.value.where == config.get("light", "--sun")
    assert "--exposure" in caught.value.advice
    made = light_for(inputs_for(0.2, light), exposure=1.0, **config)
    assert made.exposure == 1.0


def test_fit_lobes_replaces_the_panorama() -> None:
    """--fit-lobes leaves lobes alone, at the photo's exposure, with the fit's errors."""
    texels = FIT_MAPS["sun"][0]
    given = Light(texels=texels)
    made = light_for(inputs_for(0.2, given), light="l.hdr", fit_lobes=16)
    assert made.light.texels is None and made.light.lobes is not None
    assert len(made.light.lobes.sharpness) == 16
    assert made.fit is not None and made.fit.irradiance_error < 0.05
    assert float(reinhard(ground_level(made.light, 0.25))) == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize("height", [256, 1024])
def test_suns_and_the_map_without_them_are_the_same_light(height: int) -> None:
    """Two lamps on a sky with a horizon: directions, widths, and irradiance of every normal."""
    axes = np.array([axis_from_angles(40.0, 50.0), axis_from_angles(-100.0, 20.0)])
    lobes = Lobes(
        np.array([[900.0, 700.0, 500.0], [200.0, 300.0, 400.0]], np.float32),
        axes.astype(np.float32),
        np.array([4000.0, 2000.0], np.float32),
    )
    sky = plain_sky((0.4, 0.6, 1.0), (0.2, 0.15, 0.1))
    sky = np.broadcast_to(np.repeat(sky, height // sky.shape[0], 0)[:, :1], (height, 2 * height, 3))
    texels = as_map(Light(lobes, np.array(sky, np.float32)), height)
    suns = sorted(suns_of(texels), key=lambda sun: -sun.irradiance[0])
    np.testing.assert_allclose([sun.axis for sun in suns], axes, atol=2e-3)
    np.testing.assert_allclose([sun.irradiance for sun in suns], lobes.flux(), rtol=0.02)
    # A disc of the lobes' mean 1 - cos, 1 / sharpness
    spread = 1.0 - np.cos(0.5 * np.array([sun.angle for sun in suns]))
    np.testing.assert_allclose(spread / 2.0, 1.0 / lobes.sharpness, rtol=0.1)
    rest, directions = texels.copy(), map_directions(height, 2 * height)
    for sun in suns:
        rest[directions @ sun.axis > np.cos(np.radians(LAMP_RADIUS_DEG))] = sun.behind
    assert rest.max() < 1.5
    for normal in np.array([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8], *axes]):
        from_suns = sum(max(float(sun.axis @ normal), 0.0) * sun.irradiance for sun in suns)
        split = Light(texels=rest).irradiance(normal) + from_suns
        np.testing.assert_allclose(split, Light(texels=texels).irradiance(normal), rtol=0.01)


def test_an_even_sky_has_no_suns() -> None:
    assert suns_of(np.ones((32, 64, 3), np.float32)) == []
