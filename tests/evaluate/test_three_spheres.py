"""Spheres under a light: brute-force quadrature, furnaces, reflection, and the published trap."""

import numpy as np
import pytest

from tests import oracles
from tests.slow import slow
from warpir.core.latlong import map_directions, rotate_map
from warpir.evaluate import three_spheres
from warpir.evaluate.three_spheres import (
    AZIMUTH_COUNT,
    MATERIALS,
    MIRROR_RING_COUNT,
    RING_COUNT,
    angular_deg,
    camera_axes,
    lookup_matrix,
    normalized,
    picture,
    published_resize,
    published_tone,
    reflected,
    ring_azimuths,
    ring_points,
    ring_radii,
    rmse,
    si_rmse,
    sphere_errors,
)
from warpir.scene.light import axis_from_angles

QUADRATURE = 5e-3
"""Of radiance, relative to the picture's root mean square: bins of 1 degree against the texels'
own directions, under lobes some degrees wide. The worst of five panoramas is 1.4 % (a low sun in
the outermost ring), the others stay below .5 %."""


def uniform(value: float = 1.0) -> np.ndarray:
    return np.full((128, 256, 3), value, np.float32)


def with_sun(azimuth: float, elevation: float, flux: float, sky: float = 1.0) -> np.ndarray:
    """Return a grey sky with all of a sun's flux in one texel; frame of `axis_from_angles`."""
    texels = uniform(sky)
    index = np.argmax(map_directions(128, 256) @ axis_from_angles(azimuth, elevation))
    row, column = np.unravel_index(index, (128, 256))
    texels[row, column] += flux / oracles.texel_solid_angle(128, 256)[row]
    return texels


def geometry(ring_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return normal and direction to the camera of all points, map's frame, [ring, azimuth, 3]."""
    phi = ring_azimuths()
    turn = np.zeros((AZIMUTH_COUNT, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(phi)
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(phi), -np.sin(phi), 1.0
    local = ring_points(ring_radii(ring_count))
    axes = camera_axes() @ turn
    normal, wo = (np.einsum("aij,rj->rai", axes, vectors) for vectors in local)
    return normal, wo


def errors_of(predicted: np.ndarray, true: np.ndarray, kind: str) -> dict[str, float]:
    return {k: v for k, v in sphere_errors(predicted, true).items() if k.startswith(kind)}


# ------------------------------------------------------------------------------- the rendering


@pytest.mark.parametrize("name", MATERIALS)
def test_response_is_the_glTF_brdf_times_cosine(name: str, rng: np.random.Generator) -> None:
    """Match the specification, down to grazing angles and for directions below the surface."""
    material = MATERIALS[name]
    if name == "mirror":
        material = three_spheres.Material(0.8, 1.0, 0.05)  # roughness 0 is a lookup
    wo, wi = oracles.normalize(rng.normal(size=(2, 4000, 3)))
    wo[:, 2] = np.abs(wo[:, 2])
    f = oracles.gltf_brdf(wo, wi, [material.base_color] * 3, material.metallic, material.roughness)[
        :, 0
    ]
    found = reflected(wo[:, 2], wi[:, 2], oracles.dot(wo, wi), material)
    assert np.allclose(found, f * np.maximum(wi[:, 2], 0.0), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", ["diffuse", *slow("matte")])
def test_white_furnace_gives_the_directional_albedo(name: str) -> None:
    """A sphere in a constant light shows the albedo at each angle; it is bounded by it."""
    material = MATERIALS[name]
    rings = picture(uniform().astype(np.float64), name).reshape(RING_COUNT, AZIMUTH_COUNT, 3)
    normal, wo = ring_points(ring_radii(RING_COUNT))
    for ring in (0, 60, 95):
        cosine = float(normal[ring] @ wo[ring])
        albedo = oracles.gltf_albedo(
            cosine, material.base_color, material.metallic, material.roughness
        )
        assert np.abs(rings[ring] - albedo).max() < 4e-3 * albedo


def test_mirror_in_a_constant_light_shows_its_fresnel_reflectance() -> None:
    rings = picture(uniform(2.0).astype(np.float64), "mirror")
    rings = rings.reshape(MIRROR_RING_COUNT, AZIMUTH_COUNT, 3)
    normal, wo = ring_points(ring_radii(MIRROR_RING_COUNT))
    expected = 2.0 * oracles.schlick(0.8, oracles.dot(normal, wo))
    # Four look-ups across a ring: Fresnel's term is curved where the outline begins
    assert rings[:-3, 0, 0] == pytest.approx(expected[:-3], rel=1e-3)
    assert np.ptp(rings, axis=(1, 2)).max() < 1e-12


@pytest.mark.parametrize("name", ["diffuse", "matte"])
def test_picture_matches_brute_force(name: str, rng: np.random.Generator) -> None:
    """Sum the BRDF over all texels at some points, under coloured noise, a sun and a lamp."""
    texels = rng.uniform(0.0, 2.0, (8, 16, 3)).repeat(16, axis=0).repeat(16, axis=1)
    texels += with_sun(60.0, 35.0, 4.0, 0.0) + with_sun(-150.0, -20.0, 1.0, 0.0)
    material = MATERIALS[name]
    directions = oracles.texel_direction(128, 256).reshape(-1, 3)
    flux = texels.reshape(-1, 3) * np.repeat(oracles.texel_solid_angle(128, 256), 256)[:, None]
    rings = picture(texels, name).reshape(RING_COUNT, AZIMUTH_COUNT, 3)
    normal, wo = geometry(RING_COUNT)
    found, expected = [], []
    for ring in range(0, RING_COUNT, 4):
        point = int(rng.integers(AZIMUTH_COUNT))
        frame = oracles.frame_of(normal[ring, point])
        wi = directions @ frame
        f = oracles.gltf_brdf(
            np.broadcast_to(wo[ring, point] @ frame, wi.shape),
            wi,
            [material.base_color] * 3,
            material.metallic,
            material.roughness,
        )
        expected.append(((f * np.maximum(wi[:, 2:], 0.0)) * flux).sum(axis=0))
        found.append(rings[ring, point])
    error = np.asarray(found) - np.asarray(expected)
    assert np.sqrt(np.mean(error**2) / np.mean(np.square(expected))) < QUADRATURE


@pytest.mark.parametrize(("azimuth", "elevation"), [(60.0, 30.0), (150.0, 10.0), (20.0, 70.0)])
def test_sun_shines_where_the_reflection_law_says(azimuth: float, elevation: float) -> None:
    texels = with_sun(azimuth, elevation, 10.0, 0.01).astype(np.float64)
    sun = map_directions(128, 256).reshape(-1, 3)[np.argmax(texels[..., 0])]
    for name, ring_count, tolerance in (
        ("mirror", MIRROR_RING_COUNT, 1.0),
        ("matte", RING_COUNT, 3.0),
    ):
        normal, wo = geometry(ring_count)
        brightest = int(np.argmax(picture(texels, name)[:, 0]))
        half = oracles.normalize(sun + wo.reshape(-1, 3)[brightest])
        off = oracles.angle_between(half, normal.reshape(-1, 3)[brightest])
        assert np.degrees(off) < tolerance, name


def test_sphere_s_camera_stands_where_the_published_script_puts_it() -> None:
    """16 to the right of the photo's view and 2 up; its right is the photo's viewing direction."""
    axes = camera_axes()
    assert axes[:, 0] == pytest.approx([0.0, 0.0, -1.0])
    assert axes[:, 2] == pytest.approx(np.array([16.0, 2.0, 0.0]) / np.sqrt(260.0))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    # Method: focal length 2266.7 px, radius 140.8 px
    assert three_spheres.FOCAL_PX == pytest.approx(2266.7, abs=0.05)
    assert three_spheres.radius_px() == pytest.approx(140.8, abs=0.05)
    # So a sun straight ahead lights the right half, one overhead the upper half.
    phi = np.tile(ring_azimuths(), RING_COUNT)
    for elevation, side in ((0.0, np.cos(phi)), (90.0, np.sin(phi))):
        shown = picture(with_sun(0.0, elevation, 5.0, 0.0).astype(np.float64), "diffuse")[:, 0]
        assert shown[side > 0.3].mean() > 5.0 * shown[side < -0.3].mean()


def test_rings_have_the_points_of_a_perspective_camera() -> None:
    """Project the points: equal areas of the picture, on the sphere, not behind its outline."""
    for ring_count in (RING_COUNT, MIRROR_RING_COUNT):
        normal, wo = ring_points(ring_radii(ring_count))
        assert np.linalg.norm(normal, axis=1) == pytest.approx(np.ones(ring_count))
        distance = np.sqrt(260.0)
        toward = np.array([0.0, 0.0, distance]) - normal
        assert oracles.normalize(toward) == pytest.approx(wo, abs=1e-12)
        assert (oracles.dot(normal, wo) > 0.0).all()
        radius = normal[:, 0] / toward[:, 2] * three_spheres.FOCAL_PX / three_spheres.radius_px()
        assert np.diff(radius**2) == pytest.approx(np.full(ring_count - 1, 1.0 / ring_count))


def test_light_turned_about_the_line_to_the_camera_turns_the_picture() -> None:
    """A light on a cone about that line, at one azimuth and another: the picture moves along."""
    axes = camera_axes()
    directions = map_directions(128, 256)
    pictures = []
    for turn in (0, 75):
        phi = 2.0 * np.pi * turn / AZIMUTH_COUNT + 0.4
        axis = axes @ np.array([np.sin(1.1) * np.cos(phi), np.sin(1.1) * np.sin(phi), np.cos(1.1)])
        light = np.exp(60.0 * (directions @ axis - 1.0))[..., None] * np.ones(3)
        pictures.append(picture(light, "matte").reshape(RING_COUNT, AZIMUTH_COUNT, 3))
    turned = np.roll(pictures[0], 75, axis=1)
    assert np.abs(turned - pictures[1]).max() < 2e-3 * pictures[1].max()


@pytest.mark.parametrize("name", MATERIALS)
def test_picture_is_linear_in_the_light_and_never_negative(
    name: str, rng: np.random.Generator
) -> None:
    a = rng.uniform(0.0, 1.0, (128, 256, 3))
    b = with_sun(30.0, 20.0, 50.0, 0.0).astype(np.float64)
    joint = picture(2.0 * a + b, name)
    apart = 2.0 * picture(a, name) + picture(b, name)
    assert np.abs(joint - apart).max() < 1e-9 * joint.max()
    assert picture(b, name).min() >= 0.0


# ---------------------------------------------------------------------------------- the errors


def test_identical_maps_have_no_error() -> None:
    light = with_sun(40.0, 30.0, 5.0)
    errors = sphere_errors(light, light)
    assert len(errors) == 3 * 8 + 1
    assert list(errors.values()) == pytest.approx([0.0] * len(errors), abs=1e-5)


def test_scaled_map_has_no_published_and_no_scale_free_error() -> None:
    light = with_sun(40.0, 30.0, 5.0)
    errors = sphere_errors(4.0 * light, light)
    for name in MATERIALS:
        assert errors[f"linear_{name}_si_rmse"] == pytest.approx(0.0, abs=1e-5)
        assert errors[f"linear_{name}_angular_deg"] == pytest.approx(0.0, abs=1e-4)
        # Exposure is 3 times the true radiance off; the chain removes it.
        true = picture(light.astype(np.float64), name)
        scale = 0.5 / picture(light.astype(np.float64), "diffuse")[:, 0].mean()
        expected = 3.0 * scale * np.sqrt(3.0 * np.mean(true[:, 0] ** 2))
        assert errors[f"linear_{name}_rmse"] == pytest.approx(expected, rel=1e-5)
        assert errors[f"linear_{name}_log_rmse"] == pytest.approx(
            np.sqrt(3.0) * np.log(4.0), rel=0.02
        )
        assert errors[f"published_{name}_rmse"] == pytest.approx(0.0, abs=1e-5)
    assert errors["linear_log_sun_sky_ratio_error"] == pytest.approx(0.0, abs=1e-6)


def test_published_chain_hardly_sees_a_sun_ten_times_too_strong() -> None:
    """The trap: raised to 1/2.4 before rendering, the sun counts 2.6 times instead of 10."""
    true, predicted = with_sun(60.0, 35.0, 4.0), with_sun(60.0, 35.0, 40.0)
    errors = sphere_errors(predicted, true)
    assert errors["published_diffuse_rmse"] < 0.05
    assert errors["linear_diffuse_rmse"] > 1.0
    assert errors["linear_diffuse_si_rmse"] > 5.0 * errors["published_diffuse_si_rmse"]
    assert errors["linear_log_sun_sky_ratio_error"] > 2.0


def test_linear_error_of_diffuse_spheres_is_that_of_two_constant_lights() -> None:
    """Truth scaled to mean .5: half the light gives half the error everywhere, per pixel."""
    errors = errors_of(uniform(1.5), uniform(3.0), "linear_diffuse")
    true = picture(uniform().astype(np.float64), "diffuse")[:, 0]
    expected = 0.5 * 0.5 * np.sqrt(3.0 * np.mean((true / true.mean()) ** 2))
    assert errors["linear_diffuse_rmse"] == pytest.approx(expected, rel=1e-5)


def test_rmse_divides_by_pixels_not_by_values() -> None:
    assert rmse(np.full((50, 3), 0.3), np.full((50, 3), 0.1)) == pytest.approx(0.2 * np.sqrt(3.0))


def test_scale_free_error_is_the_least_over_scales(rng: np.random.Generator) -> None:
    predicted, true = rng.uniform(0.0, 1.0, (2, 200, 3))
    scales = np.linspace(0.0, 3.0, 3001)
    least = min(rmse(s * predicted, true) for s in scales)
    assert si_rmse(predicted, true) == pytest.approx(least, rel=1e-6)
    assert si_rmse(np.zeros_like(true), true) == rmse(np.zeros_like(true), true)


def test_angular_error_is_the_mean_angle_and_black_counts_as_zero() -> None:
    predicted = np.array([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    true = np.array([[0.0, 5.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    assert angular_deg(predicted, true) == pytest.approx((90.0 + 45.0 + 0.0 + 0.0) / 4.0)


def test_normalisation_is_that_of_the_whole_picture(rng: np.random.Generator) -> None:
    """Both published forms on a picture with its background, point for point."""
    count = 5000
    points = rng.gamma(1.0, 1.0, (count, 3))
    share = np.pi * three_spheres.radius_px() ** 2 / (960 * 540)
    whole = np.concatenate([points, np.zeros((round(count / share) - count, 3))])
    for low in (0.01, 0.1):
        floor, top = np.percentile(whole, low), np.percentile(whole, 99.9)
        assert np.allclose(normalized(points), (points - floor) / (top - floor))


# ------------------------------------------------------------------------------ chain and frames


def test_published_tone_sets_the_median_of_non_zero_values(rng: np.random.Generator) -> None:
    texels = rng.uniform(0.0, 9.0, (128, 256, 3))
    texels[:100] = 0.0
    toned = published_tone(texels)
    assert np.median(toned[toned > 0.0]) == pytest.approx(0.5)
    assert toned[120, 7] / toned[120, 8] == pytest.approx(
        (texels[120, 7] / texels[120, 8]) ** (1.0 / 2.4)
    )
    with pytest.raises(ValueError, match="black"):
        published_tone(np.zeros((128, 256, 3)))


def test_published_resize_keeps_directions_and_may_lose_a_sun() -> None:
    """Linear between points: it aliases, as the authors remark; a smooth map survives."""
    directions = map_directions(512, 1024).astype(np.float32)
    shrunk = published_resize(directions + 1.0)
    # Its points are spread from the first texel to the last, 3/8 of a new texel off at the edges.
    assert np.abs(shrunk - 1.0 - map_directions(128, 256)).max() < 0.02
    totals = []
    for column in range(4):
        texels = np.zeros((512, 1024, 3), np.float32)
        texels[302, 500 + column] = 1.0
        totals.append(published_resize(texels).sum())
    assert min(totals) < 0.1 * max(totals)


def test_errors_depend_on_direction_in_the_camera_frame() -> None:
    true = with_sun(60.0, 35.0, 4.0)
    near = sphere_errors(rotate_map(true, 22.5), true)
    far = sphere_errors(rotate_map(true, 90.0), true)
    for name in MATERIALS:
        assert far[f"linear_{name}_si_rmse"] > 0.99 * near[f"linear_{name}_si_rmse"] > 0.0
    assert far["linear_diffuse_si_rmse"] > 2.0 * near["linear_diffuse_si_rmse"]


def test_lookup_is_bilinear_between_texel_centres(rng: np.random.Generator) -> None:
    texels = rng.uniform(0.0, 1.0, (16, 32, 3))
    directions = oracles.normalize(rng.normal(size=(500, 3)))
    expected = oracles.bilinear_lookup(texels, oracles.latlong_uv(directions))
    assert np.allclose(lookup_matrix(directions, 16) @ texels.reshape(-1, 3), expected)


def test_maps_of_another_size_are_compared_too() -> None:
    light = with_sun(60.0, 35.0, 4.0)
    larger = light.repeat(2, axis=0).repeat(2, axis=1)
    errors = errors_of(larger, light, "linear")
    assert list(errors.values()) == pytest.approx([0.0] * len(errors), abs=1e-5)


def test_black_map_is_refused() -> None:
    with pytest.raises(ValueError, match="black"):
        sphere_errors(uniform(0.0), uniform())
