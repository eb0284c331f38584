"""The renderer: closed forms, furnaces, linearity, shadows, geometry and determinism."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter, minimum_filter

from tests.builders.programs.children import output_of
from tests.builders.shapes import (
    DEEP,
    all_pixels,
    box,
    camera,
    constant,
    ground,
    lobe,
    placed,
    quad,
    seen_ground,
    sphere,
    view_rays,
)
from tests.oracles import (
    gltf_albedo,
    half_plane_ratio,
    half_plane_ratio_lobe,
    sphere_ratio,
)
from tests.statistics import z_test
from warpir.core.arrays import Float64Array, FloatArray, Int64Array
from warpir.core.color import srgb_to_linear
from warpir.render.device import load_kernels
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Scene
from warpir.render.renderer import Foreground, Renderer
from warpir.render.shadow.pilot import shaded_pixels
from warpir.scene.asset import Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import Camera
from warpir.scene.light import Light

FURNACE = 0.01
"""Share by which a furnace may miss the quadrature: importance-sampled, design reference 6."""
BIAS = 2e-3
"""The same for a mean over pixels: the facets of the sphere and what noise averages to."""
FLOAT32 = 1e-5
"""Relative; sums of a few hundred float32 terms."""
STANDARD_ERRORS = 4.0
"""Of a mean that must match: 1 in 16 000 for each of a few dozen fixed draws."""
FAR = 1e-4
"""Relative change of a picture when the whole scene moves or grows: the task's own figure."""
FLIPS = 0.01
"""Share of pixels in which a sample at an edge may fall on the other side after a move."""
FIREFLY = 0.25
"""Excess of a pixel over the converged value at 64 samples, as a share of it. Measured: 0.074."""
MEMORY_GROWTH = 16 << 20
"""Bytes that 16 times the samples may add: the allocator's slack, far below 16 times anything."""
OVERHEAD = lobe((0.0, 1.0, 0.0), 1e5)
"""A sun straight above; narrow enough that nothing of it reaches past a wide occluder."""
SUN_RADIANCE = 1e5


def render(
    renderer: Renderer,
    light: Light,
    spp: int = 16,
    rays: int = 1,
    depth: int = 1,
    seed: int = 0,
    limit: float = 0.0,
) -> Foreground:
    """Path-trace every pixel of the view."""
    pixels = all_pixels(renderer.scene.camera)
    args = light_args(light, renderer.device)
    return renderer.foreground(args, pixels, spp, rays, depth, seed, limit)


def shadow(
    renderer: Renderer, light: Light, spp: int = 16, rays: int = 1, seed: int = 0, sees: int = 0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shadow ratio, lit and unoccluded plane of every pixel; ``sees``: the object hides it."""
    pixels = all_pixels(renderer.scene.camera)
    args = light_args(light, renderer.device)
    flags = np.full(len(pixels), sees, np.int32)
    radiance = renderer.receiver(args, pixels, flags, spp, rays, seed)
    return renderer.ratio(radiance), radiance.lit, radiance.unoccluded


def make(
    objects: Placed | list[Placed],
    view: Camera,
    device: str,
    height: float = DEEP,
    threads: int = 0,
) -> Renderer:
    """A renderer over a few objects above a level plane."""
    several = objects if isinstance(objects, list) else [objects]
    return Renderer(Scene(several, view, ground(height), device), threads)


def block_mean(values: Float64Array, side: int) -> Float64Array:
    """Average ``side x side`` blocks, shape [H, W, ...]."""
    height, width = values.shape[0] // side, values.shape[1] // side
    blocks = values.reshape(height, side, width, side, *values.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3)))


def sphere_cosine(view: Camera, center: Float64Array, radius: float, side: int) -> Float64Array:
    """Cosine of view ray and normal of a sphere, NaN beside it, shape [pixel, side^2]."""
    d, eye = view_rays(view, side), view.c2w[:3, 3]
    along = d @ (center - eye)
    rest = radius**2 - (np.sum((center - eye) ** 2) - along**2)
    return np.where(rest >= 0.0, np.sqrt(np.maximum(rest, 0.0)) / radius, np.nan)


SPHERE_VIEW = camera(16, 16, 36.0)
SPHERE_AT = np.array([0.0, 0.0, -5.0])
WHITE_METAL = Material(roughness=0.5)
WHITE_ROUGH = Material(metallic=0.0)
MATERIALS = {
    "rough-dielectric": WHITE_ROUGH,
    "glossy-dielectric": Material(metallic=0.0, roughness=0.3, base_color=(0.8, 0.8, 0.8)),
    "rough-metal": Material(roughness=1.0),
    "metal": WHITE_METAL,
    "mirror": Material(roughness=0.0),
    "half-metal": Material(metallic=0.5, roughness=0.6, base_color=(0.5, 0.5, 0.5)),
}


def albedo(material: Material, cosine: Float64Array) -> Float64Array:
    """Directional albedo of a grey material at cosines above 0.2, by quadrature."""
    factors = material.base_color[0], material.metallic, material.roughness
    knots = np.linspace(0.2, 1.0, 17)
    values = [gltf_albedo(float(c), *factors, 256) for c in knots]
    return np.asarray(CubicSpline(knots, values)(cosine))


@pytest.mark.parametrize("name", MATERIALS)
def test_sphere_in_constant_light_matches_quadrature(device: str, name: str) -> None:
    """A convex object under L = 1 shows its directional albedo (M 4, method 2.13)."""
    material = MATERIALS[name]
    renderer = make(placed(sphere(SPHERE_AT, detail=5), material), SPHERE_VIEW, device)
    out = render(renderer, constant(), spp=1024)
    cosine = sphere_cosine(SPHERE_VIEW, SPHERE_AT, 1.0, 8)
    # Where the whole pixel sees the sphere well: oracle and facets both fray at the limb.
    inside = (np.nan_to_num(cosine) > 0.25).all(axis=1)
    expected = albedo(material, np.nan_to_num(cosine, nan=1.0)).mean(axis=1)[inside]
    found = out.radiance[inside].astype(np.float64)
    assert inside.sum() > 90
    np.testing.assert_array_equal(out.mask[inside], 1.0)
    error = found / expected[:, None] - 1.0
    assert np.sqrt((error**2).mean()) < FURNACE
    assert abs(error.mean()) < BIAS


def test_convex_object_never_meets_itself(device: str) -> None:
    """Depth 4 equals depth 1 on a sphere: no ray that leaves it hits it again."""
    renderer = make(placed(sphere(SPHERE_AT), WHITE_METAL), SPHERE_VIEW, device)
    shallow, deep = (render(renderer, constant(), depth=d) for d in (1, 4))
    np.testing.assert_allclose(deep.radiance, shallow.radiance, rtol=FLOAT32)


@pytest.mark.parametrize("roughness", [0.0, 0.3, 1.0])
def test_white_metal_furnace_never_gains_energy(device: str, roughness: float) -> None:
    """White metals that see each other under L = 1 send back at most 1, more with each bounce."""
    parts = [sphere((-0.9, 0.0, -5.0)), sphere((0.9, 0.0, -5.0)), box((0.0, -1.2, -5.0), (4, 1, 3))]
    renderer = make(placed(parts, Material(roughness=roughness)), SPHERE_VIEW, device)
    means = []
    for depth in range(1, 6):
        out = render(renderer, constant(), spp=512, depth=depth)
        assert np.isfinite(out.radiance).all()
        seen = out.mask > 0.0
        value = out.radiance[seen].astype(np.float64) / out.mask[seen, None]
        error = value.mean(axis=1).std() / np.sqrt(seen.sum())
        assert value.mean() <= 1.0 + STANDARD_ERRORS * error
        assert np.percentile(value, 99.0) <= 1.0 + FURNACE
        means.append(value.mean())
    assert np.all(np.diff(means) > -FLOAT32)


def test_mirror_shows_the_map_where_it_is(device: str) -> None:
    """A mirror turned to +X, -X, +Y or the viewer shows that side of the map: +Z is its middle."""
    texels = np.zeros((32, 64, 3), np.float32)
    texels[:, 24:40, 0] = 1.0  # round +Z: the middle
    texels[:, 8:24, 1] = 1.0  # round +X: the left quarter
    texels[:, 40:56, 2] = 1.0  # round -X
    texels[:6] = 1.0  # round +Y: the top rows
    seen = {
        (0.0, 0.0, 1.0): (1.0, 0.0, 0.0),
        (1.0, 0.0, 1.0): (0.0, 1.0, 0.0),
        (-1.0, 0.0, 1.0): (0.0, 0.0, 1.0),
        (0.0, 1.0, 1.0): (1.0, 1.0, 1.0),
    }
    for normal, color in seen.items():
        n = np.array(normal) / np.linalg.norm(normal)
        up = np.cross(n, [1.0, 0.0, 0.0]) if n[1] > 0.0 else np.array([0.0, 1.0, 0.0])
        mirror = placed(quad((0, 0, -5.0), np.cross(up, n), up), Material(roughness=0.0))
        out = render(make(mirror, camera(2, 2, 200.0), device), Light(texels=texels), spp=64)
        np.testing.assert_allclose(out.radiance.mean(axis=0), color, atol=FURNACE)


# ------------------------------------------------------------------- linearity in the light


def two_shapes(matrix: ArrayLike | None = None) -> Placed:
    """A ball and a box of two materials that see each other and stand on y = 0."""
    return placed(
        [sphere((-0.6, 0.5, -4.0), 0.5, 3), box((0.6, 0.4, -4.2), (0.8, 0.8, 0.8), 1)],
        Material(base_color=(0.9, 0.6, 0.3), metallic=1.0, roughness=0.3),
        Material(base_color=(0.3, 0.5, 0.8), metallic=0.0, roughness=0.6),
        matrix=matrix,
    )


EYE_HEIGHT = camera(24, 16, 24.0, (0.0, 1.0, 0.0), -8.0)
"""What sees them."""


def stand(device: str, threads: int = 0) -> Renderer:
    """The two shapes on the ground."""
    return make(two_shapes(), EYE_HEIGHT, device, 0.0, threads)


def uneven_map() -> FloatArray:
    """A coloured map with structure everywhere, shape [8, 16, 3]."""
    return np.random.default_rng(5).uniform(0.1, 2.0, (8, 16, 3)).astype(np.float32)


def test_light_times_two_is_exactly_twice(device: str) -> None:
    """Equal seeds and proposals: a power of two scales every float32 term (method 2.13)."""
    light = Light(lobe((0.3, 1.0, 0.5), 40.0, (5.0, 4.0, 3.0)).lobes, uneven_map())
    renderer = stand(device)
    one, two = (render(renderer, light.scaled(k), depth=3) for k in (1.0, 2.0))
    np.testing.assert_array_equal(two.radiance, 2.0 * one.radiance)
    np.testing.assert_array_equal(two.diffuse, 2.0 * one.diffuse)
    ratio_one, lit_one, _ = shadow(renderer, light)
    ratio_two, lit_two, _ = shadow(renderer, light.scaled(2.0))
    np.testing.assert_array_equal(lit_two, 2.0 * lit_one)
    np.testing.assert_array_equal(ratio_two, ratio_one)


def test_sum_of_two_lights_is_the_sum_of_pictures(device: str) -> None:
    """PT(a + b) = PT(a) + PT(b) within statistics: proposals differ (method 2.13)."""
    renderer = stand(device)
    a, b = lobe((0.3, 1.0, 0.5), 40.0, (5.0, 4.0, 3.0)), Light(texels=uneven_map())
    runs = []
    for seed in range(12):
        whole = render(renderer, Light(a.lobes, b.texels), 16, 1, 3, seed)
        parts = [render(renderer, x, 16, 1, 3, 100 + seed) for x in (a, b)]
        runs.append(whole.radiance - parts[0].radiance - parts[1].radiance)
    difference = np.array(runs, np.float64)
    seen = np.abs(difference).max(axis=(0, 2)) > 0.0
    means = difference[:, seen].mean(axis=1)
    error = means.std(axis=0, ddof=1) / np.sqrt(len(runs))
    assert np.all(np.abs(means.mean(axis=0)) < STANDARD_ERRORS * error), (means.mean(axis=0), error)
    # Per pixel: variance pooled over neighbours would hide edges, so each pixel has its own.
    pixel = difference[:, seen]
    variance = pixel.var(axis=0, ddof=1) / len(runs)
    typical = np.maximum(variance, np.median(variance))
    assert z_test(pixel.mean(axis=0), 0.0 * typical, typical).passed


# -------------------------------------------------------------------------------- shadows

DOWN = -90.0
"""Pitch of a camera that looks straight down: the image's top is -Z."""


def from_above(width: int, height: int, metres: float, at: tuple[float, float] = (0, 0)) -> Camera:
    """A camera 50 m above the plane's origin whose pixels are ``metres`` wide on the ground."""
    return camera(width, height, 50.0 / metres, (at[0], 50.0, at[1]), DOWN)


def foot(view: Camera) -> Float64Array:
    """The plane's x and z under each pixel's centre, shape [pixel, 2]."""
    return seen_ground(view)[:, 0, [0, 2]]


@pytest.mark.parametrize(
    "light",
    [constant((1.0, 2.0, 3.0)), Light(texels=uneven_map()), lobe((0.5, 0.6, 0.2), 30.0)],
    ids=["constant", "map", "lobe"],
)
def test_shadow_ratio_is_exactly_one_where_nothing_is_blocked(device: str, light: Light) -> None:
    """An empty scene, and an object wholly below the plane: lit and unoccluded agree bit by bit."""
    below = placed(box((0.0, -2.0, -4.0), (1.0, 1.0, 1.0)))
    for objects in ([], [below]):
        renderer = make(objects, EYE_HEIGHT, device, 0.0)
        ratio, lit, unoccluded = shadow(renderer, light, sees=1)
        np.testing.assert_array_equal(ratio, 1.0)
        np.testing.assert_array_equal(lit, unoccluded)
        assert unoccluded.max() > 0.0
        assert shaded_pixels(renderer, light_args(light, renderer.device), 0).size == 0
        assert render(renderer, light).mask.max() == 0.0


def test_full_occluder_takes_all_of_the_sun(device: str) -> None:
    """Below a wide roof the ratio of a lone sun is exactly 0, beside it exactly 1."""
    roof = placed(quad((0, 2.0, 0), (3.0, 0, 0), (0, 0, -3.0)))
    renderer = make(roof, from_above(10, 10, 1.0), device, 0.0)
    ratio, _, _ = shadow(renderer, OVERHEAD)
    x, z = np.abs(foot(renderer.scene.camera)).T
    inside, outside = np.maximum(x, z) < 2.4, np.maximum(x, z) > 3.6
    assert inside.any() and outside.any()
    np.testing.assert_array_equal(ratio[inside], 0.0)
    np.testing.assert_array_equal(ratio[outside], 1.0)


SHADOW_SPP = 4096
SHADOW_NOISE = 4.5 * np.sqrt(0.25 / SHADOW_SPP)
"""Largest error of a few dozen binomial ratios, before the low-discrepancy points help."""


@pytest.mark.parametrize("sharpness", [0.0, 3.0, 100.0])
def test_half_plane_shadow_matches_the_closed_form(device: str, sharpness: float) -> None:
    """Half the sky behind a wide wall-to-wall roof, in a constant sky and under slanted lobes."""
    reach = 60.0
    roof = placed(quad((reach, 1.0, 0), (reach, 0, 0), (0, 0, -reach)))
    renderer = make(roof, from_above(9, 1, 0.4), device, 0.0)
    axis = np.array([-0.6, 0.8, 0.0])
    light = lobe(axis, sharpness) if sharpness else constant()
    ratio, _, _ = shadow(renderer, light, SHADOW_SPP)
    # Two Gauss points per pixel: the quadrature under a lobe is slow.
    x = foot(renderer.scene.camera)[:, :1] + 0.2 * np.array([-1.0, 1.0]) / np.sqrt(3.0)
    if sharpness:
        lobe_truth = [half_plane_ratio_lobe(float(v), 1.0, axis, sharpness) for v in x.ravel()]
        truth = np.reshape(lobe_truth, x.shape)
    else:
        truth = half_plane_ratio(x, 1.0)
    error = ratio[:, 0] - truth.mean(axis=1)
    assert np.abs(error).max() < SHADOW_NOISE


def test_sphere_shadow_matches_the_closed_form(device: str) -> None:
    """The ratio below and beside a ball in a constant sky."""
    ball = placed(sphere((0.0, 1.5, 0.0), 1.0, 5))
    renderer = make(ball, from_above(9, 1, 0.5), device, 0.0)
    ratio, _, _ = shadow(renderer, constant(), SHADOW_SPP)
    expected = sphere_ratio(np.abs(foot(from_above(9 * 8, 1, 0.0625))[:, 0]), 1.5, 1.0)
    error = ratio[:, 0] - expected.reshape(9, 8).mean(axis=1)
    assert np.abs(error).max() < SHADOW_NOISE


@pytest.mark.parametrize("gap", [0.0, 0.01], ids=["touches", "1cm"])
def test_contact_shadow_matches_the_closed_form(device: str, gap: float) -> None:
    """Below and beside a long box on the ground or 1 cm above it, in a constant sky.

    In the plane across a long bar the directions at angle t from the ground carry ``sin t / 2``, so
    what lies between the angles a and b takes ``(cos a - cos b) / 2`` of the irradiance.
    """
    bar = placed(box((-0.5, gap + 0.5, 0.0), (1.0, 1.0, 40.0)))
    renderer = make(bar, from_above(24, 1, 0.01), device, 0.0)
    ratio, _, _ = shadow(renderer, constant(), SHADOW_SPP)
    x = foot(from_above(24 * 16, 1, 0.01 / 16))[:, 0]
    corners = [(a, b) for a in (-1.0, 0.0) for b in (gap, gap + 1.0)]
    angles = np.array([np.arctan2(up, x - across) for across, up in corners])
    open_sky = 1.0 - 0.5 * (np.cos(angles.min(axis=0)) - np.cos(angles.max(axis=0)))
    truth = open_sky.reshape(24, 16).mean(axis=1)
    noise = 4.5 * np.sqrt(truth * (1.0 - truth) / SHADOW_SPP) + 4.0 / SHADOW_SPP
    assert truth.min() < 0.02 and truth.max() > 0.5
    assert (np.abs(ratio[:, 0] - truth) / noise).max() < 1.0


def test_box_on_the_ground_makes_no_speckle(device: str) -> None:
    """A box whose bottom lies in the plane: 0 under it, smooth beside it, 1 on the sunny side.

    In its shadow the ratio is what the sampled loss leaves of the open plane's light.
    """
    rest = placed(box((0.0, 0.5, 0.0), (1.0, 1.0, 1.0)))
    view = from_above(20, 20, 0.1)
    renderer = make(rest, view, device, 0.0)
    x, z = foot(view).T
    under = (np.abs(x) < 0.44) & (np.abs(z) < 0.44)
    beside = np.maximum(np.abs(x), np.abs(z)) > 0.56
    ratio, _, _ = shadow(renderer, constant(), 1024)
    np.testing.assert_array_equal(ratio[under], 0.0)
    # The other three quarters are the same by symmetry: what differs is noise or speckle.
    image = ratio[:, 0].reshape(20, 20)
    turned = np.mean([np.rot90(image, k) for k in range(4)], axis=0).ravel()
    assert np.abs(ratio[beside, 0] - turned[beside]).max() < 4.5 * np.sqrt(0.25 / 1024)
    sun = lobe((1.0, 1.0, 0.0), 1e5)
    ratio, _, _ = shadow(renderer, sun, 64)
    np.testing.assert_array_equal(ratio[beside & (x > 0.0)], 1.0)
    in_shadow = (x > -1.4) & (x < -0.56) & (np.abs(z) < 0.44)
    assert 0.0 <= ratio[in_shadow].min() and ratio[in_shadow].max() < 5e-4


def test_sheet_on_the_ground_is_seen_whole(device: str) -> None:
    """A flat sheet that lies in the plane is the object in every sample, near or far."""
    for distance in (2.0, 10.0, 40.0, 400.0):
        sheet = placed(quad((0.3, 0.0, -distance), (1.0, 0, 0), (0, 0, -1.0)))
        focal = 16.0 * distance * max(1.0, distance / 4.0)
        view = camera(16, 16, focal, (0.3, 1.5, 0.0), -np.degrees(np.arctan(1.5 / distance)))
        renderer = make(sheet, view, device, 0.0)
        out = render(renderer, constant(), 16)
        x, z = foot(view).T
        inside = (np.abs(x - 0.3) < 0.8) & (np.abs(z + distance) < 0.5)
        assert inside.sum() > 5
        np.testing.assert_array_equal(out.mask[inside], 1.0)


def test_plane_hides_what_is_below_it(device: str) -> None:
    """A half sunk ball shows its upper half only; a buried one is not seen at all."""
    view = camera(24, 24, 60.0, (0.0, 1.0, 0.0), -11.0)
    ball = placed(sphere((0.0, 0.0, -5.0), 1.0, 5))
    sunk, free = (render(make(ball, view, device, h), constant(), 16) for h in (0.0, DEEP))
    d, eye = view_rays(view, 8), view.c2w[:3, 3]
    to_plane = -eye[1] / np.where(d[..., 1] < 0.0, d[..., 1], np.nan)
    cosine = sphere_cosine(view, np.array([0.0, 0.0, -5.0]), 1.0, 8)
    to_ball = d @ (np.array([0.0, 0.0, -5.0]) - eye) - cosine
    hits = ~np.isnan(cosine)
    with np.errstate(invalid="ignore"):
        shares = (hits & ~(to_ball > to_plane)).mean(axis=1), hits.mean(axis=1)
    above, whole = (share.reshape(view.height, view.width) for share in shares)
    # Pixels whose neighbours are whole or empty too: facets and jitter blur the very edge.
    shown = minimum_filter(above, 3).ravel() == 1.0
    hidden = maximum_filter(above, 3).ravel() == 0.0
    would_show = minimum_filter(whole, 3).ravel() == 1.0
    np.testing.assert_array_equal(sunk.mask[shown], 1.0)
    np.testing.assert_array_equal(sunk.mask[hidden], 0.0)
    np.testing.assert_array_equal(free.mask[would_show], 1.0)
    assert shown.sum() > 20 and (hidden & would_show).sum() > 10
    buried = make(placed(sphere((0.0, -1.5, -5.0), 1.0)), view, device, 0.0)
    assert render(buried, constant(), 4).mask.max() == 0.0
    assert buried.gbuffer(0).coverage.max(initial=0.0) == 0.0


def test_plane_behind_the_object_does_not_count(device: str) -> None:
    """The ratio of a pixel comes from its samples that see the plane; without one it is 1."""
    # A card stands upright in front of ground that is lit on the left and shaded on the right.
    card = quad((0.0, 0.5, -3.0), (0.5, 0, 0), (0, 0.5, 0))
    roof = quad((2.0, 3.0, -6.0), (2.0, 0, 0), (0, 0, -4.0))
    view = camera(32, 16, 32.0, (0.0, 1.0, 0.0), -10.0)
    renderer = make(placed([card, roof]), view, device, 0.0)
    ratio, _, unoccluded = shadow(renderer, OVERHEAD, 64, sees=1)
    mask = render(renderer, OVERHEAD, 64).mask
    np.testing.assert_array_equal(unoccluded[mask == 1.0], 0.0)
    np.testing.assert_array_equal(ratio[mask == 1.0], 1.0)
    assert (mask == 1.0).sum() > 20
    through, _, _ = shadow(renderer, OVERHEAD, 64, sees=0)
    free = mask == 0.0
    np.testing.assert_array_equal(ratio[free], through[free])
    assert (through[mask == 1.0] == 0.0).any(), "the shade behind the card is what must not count"


# ------------------------------------------------------------------------- determinism


def stages(renderer: Renderer, seed: int = 7) -> list[NDArray[np.generic]]:
    """Everything that a picture is made of, small."""
    light = Light(lobe((0.3, 1.0, 0.5), 40.0, (5.0, 4.0, 3.0)).lobes, uneven_map())
    args = light_args(light, renderer.device)
    gbuffer = renderer.gbuffer(seed)
    out = render(renderer, light, 4, 2, 3, seed)
    _, lit, unoccluded = shadow(renderer, light, 4, 2, seed, sees=1)
    arrays = [*vars(gbuffer).values(), *vars(out).values(), lit, unoccluded]
    return [*arrays, shaded_pixels(renderer, args, seed)]


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_do_not_change_a_bit(device: str, threads: int) -> None:
    """1, 2 and 5 threads, which cut launches differently, give identical arrays."""
    for one, several in zip(stages(stand(device, 1)), stages(stand(device, threads)), strict=True):
        np.testing.assert_array_equal(one, several)


def test_pixel_lists_do_not_change_a_bit(device: str) -> None:
    """A pixel's numbers do not depend on which others are traced with it, or in which order."""
    renderer = stand(device)
    args = light_args(Light(texels=uneven_map()), renderer.device)
    pixels = all_pixels(renderer.scene.camera)
    whole = renderer.foreground(args, pixels, 4, 2, 3, 7)
    for part in (pixels[:5], pixels[5:200], pixels[200:], pixels[::-7].copy()):
        found = renderer.foreground(args, part, 4, 2, 3, 7)
        for name, values in vars(found).items():
            np.testing.assert_array_equal(values, vars(whole)[name][part])


def test_seed_decides_the_noise(device: str) -> None:
    """The same seed gives the same bytes, another seed other ones."""
    renderer = stand(device)
    first, again, other = (stages(renderer, seed) for seed in (7, 7, 8))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(first, again, strict=True))
    radiance = len(vars(renderer.gbuffer(0)))
    assert first[radiance].tobytes() != other[radiance].tobytes()
    assert first[-2].tobytes() != other[-2].tobytes()


@pytest.mark.parametrize("seed", [2**31 - 1, 2**31, 2**32 - 1])
def test_every_32_bit_seed_is_accepted(device: str, seed: int) -> None:
    """The command line allows seeds up to 2^32 - 1, and each reaches the kernels (F8)."""
    renderer = stand(device)
    found = [render(renderer, constant(), 2, seed=s).radiance.tobytes() for s in (seed, seed - 1)]
    assert found[0] != found[1]


# ------------------------------------------------------------------ precision of geometry


def moved(shift: tuple[float, float, float], factor: float, device: str) -> Renderer:
    """`stand`, grown by ``factor`` about the origin and then moved, with camera and ground."""
    matrix = np.diag([factor, factor, factor, 1.0])
    matrix[:3, 3] = shift
    pose = EYE_HEIGHT.c2w.copy()
    pose[:3, 3] = factor * pose[:3, 3] + np.array(shift)
    return make(two_shapes(matrix), replace(EYE_HEIGHT, c2w=pose), device, shift[1])


@pytest.mark.parametrize(
    ("shift", "factor"),
    [
        ((1e5, 0.0, -7e4), 1.0),
        ((-3e4, 1e5, 2e4), 1.0),
        ((0.0, 0.0, 0.0), 1e-3),
        ((0.0, 0.0, 0.0), 1e4),
        ((1e5, 0.0, 0.0), 1e-1),
    ],
    ids=["100km", "100km-up", "millimetres", "10km-wide", "small-and-far"],
)
def test_place_and_size_do_not_change_the_picture(
    device: str, shift: tuple[float, float, float], factor: float
) -> None:
    """Everything moved or grown together gives the same picture: the scene is recentred."""
    light = Light(lobe((0.3, 1.0, 0.5), 400.0, (50.0, 40.0, 30.0)).lobes, uneven_map())
    near, far = stand(device), moved(shift, factor, device)
    pairs = [
        *zip(
            vars(render(near, light, 8, depth=3)).values(),
            vars(render(far, light, 8, depth=3)).values(),
            strict=True,
        ),
        (shadow(near, light, 8, sees=1)[0], shadow(far, light, 8, sees=1)[0]),
    ]
    for here, there in pairs:
        error = np.abs(there - here).reshape(len(here), -1).max(axis=1)
        scale = np.maximum(np.abs(here).reshape(len(here), -1).max(axis=1), 1e-3)
        assert np.mean(error > FAR * scale) <= FLIPS
    here, there = near.gbuffer(0), far.gbuffer(0)
    np.testing.assert_array_equal(here.object_pixels, there.object_pixels)
    local = (there.position.astype(np.float64) - np.array(shift)) / factor
    covered = here.coverage == 1.0
    assert np.abs(local - here.position)[covered].max() < FAR


# ------------------------------------------------------------------------------ materials

CARD_VIEW = camera(8, 8, 20.0)
"""Looks along -Z; a card of half side 1 at z = -5 fills it exactly."""


def card(material: Material, texture: Texture | None = None, uv: float = 1.0) -> Placed:
    """A card that fills `CARD_VIEW`."""
    textures = () if texture is None else (texture,)
    return placed(quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0), uv=uv), material, textures=textures)


def roofed(
    device: str,
    *materials: Material,
    color: FloatArray | None = None,
    textures: tuple[Texture, ...] = (),
) -> FloatArray:
    """Shadow ratio of a lone sun below one wide roof per material, above each other."""
    roofs = []
    for k in range(len(materials)):
        plain = quad((0, 1.0 + k, 0), (5.0, 0, 0), (0, 0, -5.0), k)
        roofs.append(replace(plain, colors=color))
    thing = placed(roofs, *materials, textures=textures)
    return shadow(make(thing, from_above(4, 4, 0.5), device, 0.0), OVERHEAD)[0]


@pytest.mark.case("M19")
def test_M19_blend_lets_its_share_through(device: str) -> None:
    """BLEND 0.25: a quarter of camera samples stop; 0.75 of the sunlight passes, 0.5625 twice."""
    glass = Material(alpha_mode="BLEND", alpha=0.25)
    out = render(make(card(glass), CARD_VIEW, device), constant(), 256)
    error = np.sqrt(0.25 * 0.75 / (256 * 64))
    assert abs(float(out.mask.mean()) - 0.25) < STANDARD_ERRORS * error
    # Radiance is premultiplied: what is seen of the card is as bright as an opaque one.
    opaque = render(make(card(Material()), CARD_VIEW, device), constant(), 256)
    share = out.radiance.sum() / opaque.radiance.sum()
    assert share == pytest.approx(float(out.mask.mean()), rel=FURNACE)
    np.testing.assert_allclose(roofed(device, glass), 0.75, rtol=FLOAT32)
    np.testing.assert_allclose(roofed(device, glass, glass), 0.5625, rtol=FLOAT32)
    opaque_texture = Texture(np.full((3, 5, 4), 255, np.uint8))
    still = Material(alpha_mode="BLEND", base_color_texture=TextureSlot(0))
    np.testing.assert_array_equal(roofed(device, still, textures=(opaque_texture,)), 0.0)
    half = np.full((4, 4), (1.0, 1.0, 1.0, 0.5), np.float32)
    np.testing.assert_allclose(roofed(device, glass, color=half), 0.875, rtol=FLOAT32)


def test_what_rays_pass_leaves_little_noise(device: str) -> None:
    """Of a pixel's 64 samples the right number stops at two panes, within one."""
    panes = [quad((0, 0, -5.0 - k), (1.0 + k, 0, 0), (0, 1.0 + k, 0)) for k in range(2)]
    scene = placed(panes, Material(alpha_mode="BLEND", alpha=0.3))
    mask = render(make(scene, CARD_VIEW, device), constant(), 64).mask
    assert np.abs(mask - (1.0 - 0.7**2)).max() <= 1.0 / 64 + FLOAT32


@pytest.mark.case("M19")
@pytest.mark.parametrize(
    ("mode", "alpha", "stays"),
    [
        ("MASK", 0.49, 0.0),
        ("MASK", 0.5, 1.0),
        ("MASK", 1.0, 1.0),
        ("OPAQUE", 0.1, 1.0),
        ("BLEND", 0.0, 0.0),
        ("BLEND", 1.0, 1.0),
    ],
)
def test_M19_alpha_modes_cover_and_shade_alike(
    device: str, mode: str, alpha: float, stays: float
) -> None:
    """MASK keeps all at or above its cutoff and nothing below; OPAQUE ignores alpha (M19)."""
    material = Material(alpha_mode=mode, alpha=alpha, alpha_cutoff=0.5)
    renderer = make(card(material), CARD_VIEW, device)
    np.testing.assert_array_equal(render(renderer, constant(), 8).mask, stays)
    np.testing.assert_array_equal(roofed(device, material), 1.0 - stays)


@pytest.mark.case("M19")
def test_M19_mask_follows_the_texture(device: str) -> None:
    """The left half of a card is cut away by its texture's alpha, for camera and for shadow."""
    pixels = np.full((4, 8, 4), 255, np.uint8)
    pixels[:, :4, 3] = 0
    material = Material(alpha_mode="MASK", base_color_texture=TextureSlot(0), double_sided=True)
    texture = Texture(pixels, "clamp", "clamp")
    mask = render(make(card(material, texture), CARD_VIEW, device), constant(), 8).mask
    expected = np.tile(np.repeat([0.0, 1.0], 4), (8, 1))
    np.testing.assert_array_equal(mask.reshape(8, 8), expected)
    roof = placed(quad((0, 0.01, 0), (2.0, 0, 0), (0, 0, -2.0)), material, textures=(texture,))
    ratio = shadow(make(roof, from_above(8, 4, 0.4), device, 0.0), OVERHEAD)[0]
    np.testing.assert_array_equal(ratio[:, 0].reshape(4, 8), 1.0 - expected[:4])


@pytest.mark.case("M19")
def test_M19_back_faces_are_culled_for_the_camera_alone(device: str) -> None:
    """A single-sided card seen from behind is invisible and still casts its shadow."""
    for double_sided, covered in ((False, 0.0), (True, 1.0)):
        material = Material(double_sided=double_sided)
        back = placed(quad((0, 0, -5.0), (-1, 0, 0), (0, 1, 0)), material)
        out = render(make(back, CARD_VIEW, device), constant(), 64)
        np.testing.assert_array_equal(out.mask, covered)
        roof = placed(quad((0, 1.0, 0), (5.0, 0, 0), (0, 0, 5.0)), material)
        ratio = shadow(make(roof, from_above(4, 4, 0.5), device, 0.0), OVERHEAD)[0]
        np.testing.assert_array_equal(ratio, 0.0)
    # Seen from behind, a double-sided card is shaded like its front.
    front = render(make(card(Material()), CARD_VIEW, device), constant(), 64)
    assert out.radiance.mean() == pytest.approx(float(front.radiance.mean()), rel=FURNACE)


def test_culled_card_shows_what_is_behind_it(device: str) -> None:
    """Camera rays go on through a culled face and hit the surface behind."""
    glow = Material(base_color=(0, 0, 0), metallic=1.0, emission=(0.5, 1.0, 2.0))
    shell = [quad((0, 0, -4.0), (-1, 0, 0), (0, 1, 0)), quad((0, 0, -5.0), (2, 0, 0), (0, 2, 0), 1)]
    out = render(make(placed(shell, Material(), glow), CARD_VIEW, device), constant((0, 0, 0)), 8)
    np.testing.assert_allclose(out.radiance, np.tile([0.5, 1.0, 2.0], (64, 1)), rtol=FLOAT32)


@pytest.mark.parametrize("diagonal", ["same", "other"])
def test_two_single_sided_cards_in_one_place_are_seen_from_both_sides(
    device: str, diagonal: str
) -> None:
    """A sheet modelled as two, wound against each other: each side shows its own material.

    A ray meets both at once and a query returns either; what it would cull must not hide the other.
    """
    front = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0), 0)
    if diagonal == "other":
        back = quad((0, 0, -5.0), (-1, 0, 0), (0, 1, 0), 1)
    else:
        back = replace(front, indices=front.indices[:, ::-1].copy(), material=1)
    glow = [
        Material(base_color=(0, 0, 0), metallic=1.0, emission=e)
        for e in ((3.0, 1.0, 2.0), (0.5, 4.0, 0.25))
    ]
    half_turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    half_turn[2, 3] = -10.0
    for matrix, emission in ((None, glow[0].emission), (half_turn, glow[1].emission)):
        for parts in ([front, back], [back, front]):
            renderer = make(placed(parts, *glow, matrix=matrix), CARD_VIEW, device)
            out = render(renderer, constant((0, 0, 0)), 64)
            np.testing.assert_array_equal(out.mask, 1.0)
            np.testing.assert_allclose(out.radiance, np.tile(emission, (64, 1)), rtol=FLOAT32)


def test_emission_is_seen_as_it_is(device: str) -> None:
    """Without light a lamp shows its emission times its texture, all of it in that layer."""
    pixels = np.full((2, 2, 4), 255, np.uint8)
    pixels[..., 1] = 188
    lamp = Material(emission=(0.5, 1.0, 40.0), emission_texture=TextureSlot(0))
    out = render(make(card(lamp, Texture(pixels)), CARD_VIEW, device), constant((0, 0, 0)), 8)
    expected = np.array([0.5, float(srgb_to_linear(np.array(188 / 255.0))), 40.0])
    np.testing.assert_allclose(out.radiance, np.tile(expected, (64, 1)), rtol=FLOAT32)
    np.testing.assert_array_equal(out.emission, out.radiance)
    np.testing.assert_array_equal(out.diffuse, 0.0)


def test_emission_lights_other_surfaces(device: str) -> None:
    """A card inside a glowing dome at depth 1 looks as under a constant map of that radiance."""
    dome = sphere((0, 0, 0), 50.0, 2, 1)
    dome = Primitive(dome.positions, dome.indices[:, ::-1].copy(), 1)
    glow = Material(base_color=(0, 0, 0), metallic=0.0, emission=(1.0, 2.0, 3.0))
    matte = Material(base_color=(0.5, 0.5, 0.5), metallic=0.0)
    lone = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0))
    inside = make(placed([lone, dome], matte, glow), CARD_VIEW, device)
    out = render(inside, constant((0, 0, 0)), 1024)
    free = make(placed(lone, matte), CARD_VIEW, device)
    expected = render(free, constant((1.0, 2.0, 3.0)), 1024)
    np.testing.assert_allclose(
        out.radiance.mean(axis=0), expected.radiance.mean(axis=0), rtol=FURNACE
    )
    np.testing.assert_array_equal(out.emission, 0.0)


def test_vertex_colors_multiply_the_base_color(device: str) -> None:
    """Linear vertex colours are interpolated and multiply factor and texture."""
    plain = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0))
    colors = np.ones((4, 4), np.float32)
    colors[:, 0] = [0.0, 1.0, 1.0, 0.0]  # red rises to the right
    tinted = replace(plain, colors=colors)
    pixels = np.full((1, 1, 4), 255, np.uint8)
    pixels[..., 1] = 188
    material = Material(base_color=(0.5, 0.5, 0.25), base_color_texture=TextureSlot(0))
    scene = placed(tinted, material, textures=(Texture(pixels),))
    seen = make(scene, CARD_VIEW, device).gbuffer(0, 64).base_color.reshape(8, 8, 3)
    red = 0.5 * (np.arange(8) + 0.5) / 8.0
    green = 0.5 * float(srgb_to_linear(np.array(188 / 255.0)))
    np.testing.assert_allclose(seen[..., 0], np.tile(red, (8, 1)), atol=1e-3)
    np.testing.assert_allclose(seen[..., 1], green, rtol=FLOAT32)
    np.testing.assert_allclose(seen[..., 2], 0.25, rtol=FLOAT32)


def wrapped(k: Int64Array, count: int, mode: str) -> Int64Array:
    """Texel index by wrap mode, as the glTF sampler (OpenGL 4.6, 8.14.2) has it."""
    if mode == "clamp":
        return np.clip(k, 0, count - 1)
    if mode == "repeat":
        return np.mod(k, count)
    inside = np.mod(k, 2 * count)
    return np.where(inside < count, inside, 2 * count - 1 - inside)


TURN = (0.8, -0.6, 0.3, 0.6, 0.8, -0.2)
"""A rotation of the texture coordinates by 37 degrees, and a shift."""


@pytest.mark.parametrize("wrap_u", ["repeat", "clamp", "mirror"])
@pytest.mark.parametrize("wrap_v", ["repeat", "clamp", "mirror"])
@pytest.mark.parametrize(
    "transform", [(1.0, 0.0, -1.0, 0.0, 1.0, -1.0), TURN], ids=["shift", "turn"]
)
def test_textures_wrap_and_turn(
    device: str, wrap_u: str, wrap_v: str, transform: tuple[float, ...], rng: np.random.Generator
) -> None:
    """Base colour is the decoded texture, filtered, wrapped and transformed as glTF has it."""
    pixels = rng.integers(0, 256, (3, 4, 4), dtype=np.uint8)
    slot = TextureSlot(0, transform=transform)  # type: ignore[arg-type]
    material = Material(base_color_texture=slot)
    scene = card(material, Texture(pixels, wrap_u, wrap_v), uv=3.0)
    view = camera(16, 16, 40.0)
    seen = make(scene, view, device).gbuffer(0, 256).base_color.reshape(16, 16, 3)
    fine = (np.arange(16 * 16) + 0.5) / 256.0 * 3.0
    u, v = np.meshgrid(fine, fine)
    a, b, c, d, e, f = transform
    x, y = (a * u + b * v + c) * 4.0 - 0.5, (d * u + e * v + f) * 3.0 - 0.5
    decoded = srgb_to_linear(pixels[..., :3] / 255.0)
    expected = np.zeros((256, 256, 3))
    for di in (0, 1):
        for dj in (0, 1):
            i = wrapped(np.floor(y).astype(int) + di, 3, wrap_v)
            j = wrapped(np.floor(x).astype(int) + dj, 4, wrap_u)
            weight = np.abs(1 - di - y % 1.0) * np.abs(1 - dj - x % 1.0)
            expected += weight[..., None] * decoded[i, j]
    # 256 stratified samples of a pixel against a grid of 256 points.
    np.testing.assert_allclose(seen, block_mean(expected, 16), atol=0.02)


def test_second_uv_set_is_used_where_asked(device: str) -> None:
    """A slot of UV set 1 reads the second coordinates."""
    plain = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0))
    pixels = np.zeros((1, 2, 4), np.uint8)
    pixels[0, 1] = 255
    for uv_set, value in ((0, 0.0), (1, 1.0)):
        both = replace(plain, uv0=np.zeros((4, 2), np.float32), uv1=np.ones((4, 2), np.float32))
        material = Material(base_color_texture=TextureSlot(0, uv_set))
        texture = Texture(pixels, "clamp", "clamp")
        scene = placed(both, material, textures=(texture,))
        seen = make(scene, CARD_VIEW, device).gbuffer(0).base_color
        np.testing.assert_array_equal(seen, value)


def test_metallic_roughness_texture_reads_green_and_blue(device: str) -> None:
    """G is roughness and B metallic, plain numbers, times the factors."""
    pixels = np.zeros((1, 1, 4), np.uint8)
    pixels[..., 1], pixels[..., 2] = 128, 255
    slot = TextureSlot(0)
    textured = Material(roughness=0.8, metallic=0.5, metallic_roughness_texture=slot)
    plain = Material(roughness=0.8 * 128 / 255, metallic=0.5)
    renderers = [
        make(card(textured, Texture(pixels)), CARD_VIEW, device),
        make(card(plain), CARD_VIEW, device),
    ]
    np.testing.assert_allclose(renderers[0].gbuffer(0).roughness, plain.roughness, rtol=FLOAT32)
    found, expected = (render(r, Light(texels=uneven_map()), 64).radiance for r in renderers)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_flat_normal_map_changes_nothing(device: str) -> None:
    """Scale 0 gives the picture without a map; the 8-bit flat colour is within 0.3 degrees."""
    flat = np.full((2, 2, 4), (128, 128, 255, 255), np.uint8)
    ball = sphere((0, 0, -5.0), 1.0)
    lon = np.arctan2(ball.positions[:, 0], ball.positions[:, 2] + 5.0) / (2.0 * np.pi)
    uv = np.stack([lon, 0.5 - 0.5 * ball.positions[:, 1]], axis=1).astype(np.float32)
    ball = replace(ball, uv0=uv)
    without = make(placed(ball, WHITE_METAL), SPHERE_VIEW, device)
    for scale, angle in ((0.0, 0.01), (1.0, 0.4)):
        material = Material(roughness=0.5, normal_texture=TextureSlot(0), normal_scale=scale)
        mapped = make(placed(ball, material, textures=(Texture(flat),)), SPHERE_VIEW, device)
        cosine = np.sum(mapped.gbuffer(0).normal * without.gbuffer(0).normal, axis=1)
        cosine = cosine[without.gbuffer(0).coverage > 0.0]
        assert cosine.min() > np.cos(np.radians(angle)) - 1e-6
    light = Light(texels=uneven_map())
    still = Material(roughness=0.5, normal_texture=TextureSlot(0), normal_scale=0.0)
    mapped = make(placed(ball, still, textures=(Texture(flat),)), SPHERE_VIEW, device)
    found, expected = (render(r, light, 16).radiance for r in (mapped, without))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("given", [False, True], ids=["from-uv", "from-asset"])
@pytest.mark.parametrize("flip", [1.0, -1.0], ids=["upright", "mirrored-uv"])
def test_normal_map_tilts_along_its_texture(device: str, given: bool, flip: float) -> None:
    """Red tilts toward rising u, green toward the image's top, scaled by normalScale."""
    plain = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0))
    assert plain.uv0 is not None
    uv = plain.uv0.copy()
    if flip < 0.0:
        uv[:, 0] = 1.0 - uv[:, 0]
    tangents = np.tile(np.array([flip, 0.0, 0.0, flip], np.float32), (4, 1))
    normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (4, 1))
    lying = replace(plain, normals=normals, tangents=tangents if given else None, uv0=uv)
    for code, scale in (((255, 128, 255), 1.0), ((128, 255, 255), 1.0), ((255, 128, 255), 0.5)):
        pixels = np.full((1, 1, 4), (*code, 255), np.uint8)
        material = Material(normal_texture=TextureSlot(0), normal_scale=scale)
        scene = placed(lying, material, textures=(Texture(pixels),))
        seen = make(scene, CARD_VIEW, device).gbuffer(0).normal
        x, y, z = 2.0 * np.array(code) / 255.0 - 1.0
        expected = np.array([flip * scale * x, scale * y, z])
        expected /= np.linalg.norm(expected)
        np.testing.assert_allclose(seen, np.tile(expected, (len(seen), 1)), atol=1e-5)


@pytest.mark.parametrize(
    "transform",
    [(0.0, 1.0, 0.2, -1.0, 0.0, 0.0), (-1.0, 0.0, 0.0, 0.0, 1.0, 0.0), TURN],
    ids=["quarter", "mirrored", "turn"],
)
def test_normal_map_turns_with_its_texture(device: str, transform: tuple[float, ...]) -> None:
    """KHR_texture_transform tilts normals as the same coordinates in the mesh do."""
    plain = quad((0, 0, -5.0), (1, 0, 0), (0, 1, 0))
    assert plain.uv0 is not None
    turned = plain.uv0 @ np.reshape(transform, (2, 3))[:, :2].T
    baked = replace(plain, uv0=turned.astype(np.float32))
    texture = Texture(np.full((1, 1, 4), (230, 180, 220, 255), np.uint8))
    slot = TextureSlot(0, transform=transform)  # type: ignore[arg-type]
    seen, expected = (
        make(
            placed(shape, Material(normal_texture=how), textures=(texture,)), CARD_VIEW, device
        ).gbuffer(0).normal
        for shape, how in ((plain, slot), (baked, TextureSlot(0)))
    )  # fmt: skip
    np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_mirrored_instance_is_its_mirrored_truth(device: str) -> None:
    """An asset placed with a negative determinant equals one whose mesh was mirrored by hand."""
    ball = sphere((0.4, 0.0, 0.0), 0.6, 3)
    wedge = quad((-0.5, 0.1, 0.3), (0.4, 0.1, 0.0), (0.0, 0.4, -0.2), 1)
    bumps = np.random.default_rng(2).integers(64, 192, (4, 4, 4), dtype=np.uint8)
    bumps[..., 2:] = 255
    materials = (
        Material(roughness=0.4),
        Material(metallic=0.0, normal_texture=TextureSlot(0), base_color=(0.2, 0.7, 0.4)),
    )
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[:3, 3] = [0.0, 0.0, -5.0]
    instance = placed([ball, wedge], *materials, textures=(Texture(bumps),), matrix=mirror)

    def by_hand(p: Primitive) -> Primitive:
        sign = np.array([-1.0, 1.0, 1.0])
        normals = None if p.normals is None else (p.normals * sign).astype(np.float32)
        positions = p.positions * sign + mirror[:3, 3]
        return Primitive(positions, p.indices[:, ::-1].copy(), p.material, normals, uv0=p.uv0)

    truth = placed([by_hand(ball), by_hand(wedge)], *materials, textures=(Texture(bumps),))
    light = Light(texels=uneven_map())
    first, second = (make(p, SPHERE_VIEW, device) for p in (instance, truth))
    for one, two in zip(
        vars(first.gbuffer(0)).values(), vars(second.gbuffer(0)).values(), strict=True
    ):
        np.testing.assert_allclose(one, two, atol=1e-5)
    assert (first.gbuffer(0).coverage > 0.0).sum() > 40
    found, expected = (render(r, light, 16, depth=2).radiance for r in (first, second))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_two_assets_keep_their_own_materials(device: str) -> None:
    """Two assets of two materials and a texture each in one scene: four colours in four places."""
    colors = [(0.9, 0.1, 0.1), (0.1, 0.8, 0.2), (0.2, 0.1, 0.7), (0.6, 0.6, 0.1)]
    corners = [(-0.5, 0.5), (0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)]
    assets = []
    for k in (0, 2):
        cards = [quad((*corners[k + m], -5.0), (0.4, 0, 0), (0, 0.4, 0), m) for m in (0, 1)]
        # Only the second material of each asset has a texture, at index 0 of its own list.
        code = 188 if k == 0 else 137
        texture = Texture(np.full((1, 1, 4), code, np.uint8))
        materials = (
            Material(base_color=colors[k]),
            Material(base_color=colors[k + 1], base_color_texture=TextureSlot(0)),
        )
        assets.append(placed(cards, *materials, textures=(texture,)))
    renderer = make(assets, camera(16, 16, 40.0), device)
    gbuffer = renderer.gbuffer(0)
    image = np.zeros((256, 3), np.float32)
    image[gbuffer.object_pixels] = gbuffer.base_color
    image = image.reshape(16, 16, 3)
    for k, (x, y) in enumerate(corners):
        scale = 1.0
        if k % 2:
            scale = float(srgb_to_linear(np.array((188 if k < 2 else 137) / 255.0)))
        found = image[int(8 - 8 * y), int(8 + 8 * x)]
        np.testing.assert_allclose(found, np.array(colors[k]) * scale, rtol=1e-4)


# ------------------------------------------------------------------- robustness and memory


def panorama() -> Light:
    """A 1k panorama of structured sky with a sun of 10^5 times its mean in one texel."""
    rng = np.random.default_rng(11)
    texels = rng.uniform(0.5, 1.5, (512, 1024, 3)).astype(np.float32)
    texels[150, 300] = SUN_RADIANCE
    return Light(texels=texels)


def test_bright_sun_makes_no_firefly(device: str) -> None:
    """64 samples of a 1k panorama whose sun is 10^5 times the mean: no bright pixel (issue 2)."""
    light = panorama()
    up = np.array([0.0, 1.0, 0.0])
    plane = make([], from_above(32, 32, 0.1), device, 0.0)
    _, _, unoccluded = shadow(plane, light, 64)
    expected = light.irradiance(up) / np.pi
    assert (unoccluded.max(axis=0) / expected).max() < 1.0 + FIREFLY
    assert np.abs(unoccluded.mean(axis=0) / expected - 1.0).max() < FURNACE
    ball = make(placed(sphere(SPHERE_AT), WHITE_ROUGH), camera(16, 16, 36.0), device)
    found = render(ball, light, 64, depth=3).radiance
    converged = render(ball, light, 2048, seed=1).radiance
    whole = render(ball, light, 64).mask == 1.0
    assert whole.sum() > 90
    assert (found[whole] / converged[whole]).max() < 1.0 + FIREFLY
    assert found.max() < (1.0 + FIREFLY) * converged.max()


def test_indirect_limit_takes_from_later_bounces_only(device: str) -> None:
    """The limit never adds light, leaves depth 1 and generous limits bit-identical, and bites."""
    parts = [
        quad((0.0, 0.0, -4.0), (1.0, 0, 0), (0, 0, -1.0)),
        quad((-1.0, 0.7, -4.0), (0.0, 0, -0.7), (0, 0.7, 0), 1),
    ]
    scene = placed(parts, WHITE_ROUGH, Material(roughness=0.05, double_sided=True))
    view = camera(16, 16, 24.0, (0.0, 1.0, 0.0), -12.0)
    renderer = make(scene, view, device, -1.0)
    sun = Light(lobe((0.7, 0.7, 0.1), 2e4, (3e4, 2e4, 1e4)).lobes, uneven_map())
    free, limited, generous = (
        render(renderer, sun, 32, depth=4, limit=x).radiance for x in (0.0, 1.0, 1e12)
    )
    assert np.all(limited <= free * (1.0 + FLOAT32) + FLOAT32)
    assert (limited < 0.9 * free).any()
    np.testing.assert_array_equal(generous, free)
    direct = [render(renderer, sun, 32, depth=1, limit=x).radiance for x in (0.0, 1e-3)]
    np.testing.assert_array_equal(direct[0], direct[1])
    # The most that the paths of a pixel can add behind the first vertex.
    assert np.all(limited <= direct[0] + 1.0 * 4 + FLOAT32)


def test_one_pixel_image(device: str) -> None:
    """A 1 x 1 view goes through every stage and is finite (I14)."""
    renderer = make(
        placed(box((0.0, 0.5, -4.0), (1.0, 1.0, 1.0))),
        camera(1, 1, 0.5, (0.0, 1.0, 0.0), -10.0),
        device,
        0.0,
    )
    light = Light(texels=uneven_map())
    args = light_args(light, renderer.device)
    gbuffer = renderer.gbuffer(0, 64)
    assert gbuffer.object_pixels.tolist() == [0]
    shaded = shaded_pixels(renderer, args, 0)
    assert shaded.tolist() in ([], [0])
    out = render(renderer, light, 64, depth=2)
    ratio, _, _ = shadow(renderer, light, 64, sees=1)
    assert 0.0 < out.mask[0] < 1.0
    assert np.isfinite(out.radiance).all() and np.all((ratio > 0.0) & (ratio <= 1.0))


def test_object_out_of_view_is_not_traced(device: str) -> None:
    """Beside or behind the camera: no object pixels, and whatever shadow reaches the view stays."""
    view = camera(16, 16, 16.0, (0.0, 1.0, 0.0), -20.0)
    for center in ((0.0, 0.5, 6.0), (60.0, 0.5, -4.0)):
        renderer = make(placed(box(center, (1.0, 1.0, 1.0))), view, device, 0.0)
        assert renderer.gbuffer(0).object_pixels.size == 0
        empty = renderer.foreground(
            light_args(constant(), renderer.device), np.zeros(0, np.int32), 4, 1, 2, 0
        )
        assert empty.radiance.shape == (0, 3)
    # A tall tower behind the camera throws its shadow into the picture.
    tower = make(placed(box((0.0, 10.0, 4.0), (2.0, 20.0, 2.0))), view, device, 0.0)
    low_sun = lobe((0.0, 0.5, 1.0), 1e4)
    assert tower.gbuffer(0).object_pixels.size == 0
    assert shaded_pixels(tower, light_args(low_sun, tower.device), 0).size > 50


MEMORY_CHILD = """
import resource
import numpy as np
import warp as wp
wp.config.quiet = True
from tests.builders.shapes import all_pixels, constant
from tests.render.test_render import stand, light_args
renderer = stand({device!r})
args = light_args(constant(), renderer.device)
pixels = all_pixels(renderer.scene.camera)
def peak():
    if renderer.device.is_cuda:
        return wp.get_mempool_used_mem_high(renderer.device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
peaks = []
for spp in (64, 64, 1024):
    renderer.foreground(args, pixels, spp, 2, 3, 0)
    renderer.receiver(args, pixels, np.ones(len(pixels), np.int32), spp, 2, 0)
    peaks.append(peak())
print(peaks[2] - peaks[1])
"""


@pytest.mark.slow
def test_memory_is_flat_in_samples(device: str) -> None:
    """Peak memory at 1024 samples is that at 64: nothing is kept per sample (issue 2)."""
    assert int(output_of(MEMORY_CHILD.format(device=device)).split()[-1]) < MEMORY_GROWTH


def test_load_kernels_says_how_many_are_there() -> None:
    """The share of the modules that are there grows to 1."""
    shares: list[float] = []
    device = wp.get_device("cpu")
    load_kernels(device, [(0, 0, 0, 0, 0, 0)], lambda stage, share: shares.append(share))
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len(shares) == len(set(shares)) > 3


@pytest.mark.parametrize("shape", [(32,), (4, 8)])
def test_mask_is_not_taken_for_pixel_numbers(shape: tuple[int, ...]) -> None:
    """Its values are 0 and 1: the picture was that of the first two pixels, over and over."""
    renderer = make(card(Material()), CARD_VIEW, "cpu")
    light, mask = light_args(constant(), renderer.device), np.ones(shape, np.bool_)
    with pytest.raises(TypeError, match="expected row-major indices"):
        renderer.foreground(light, mask, 1, 1, 1, 0)
    with pytest.raises(TypeError, match="expected row-major indices"):
        renderer.receiver(light, mask, np.ones(shape, np.int32), 1, 1, 0)


@pytest.mark.parametrize("wrong", [-1, 1 << 32, None])
def test_pixels_outside_the_picture_are_refused(wrong: int | None) -> None:
    """They were traced as if the picture went on, or as what is left of them in 32 bits."""
    renderer = make(card(Material()), CARD_VIEW, "cpu")
    count = CARD_VIEW.width * CARD_VIEW.height
    light = light_args(constant(), renderer.device)
    pixels = np.array([count - 1, count if wrong is None else wrong], np.int64)
    seen = np.ones(2, np.int32)
    with pytest.raises(ValueError, match=f"expected row-major indices from 0 to {count - 1} "):
        renderer.foreground(light, pixels, 1, 1, 1, 0)
    with pytest.raises(ValueError, match=f"from 0 to {count - 1} .found .*{pixels[1]}"):
        renderer.receiver(light, pixels, seen, 1, 1, 0)
    renderer.receiver(light, pixels[:1], seen[:1], 1, 1, 0)


def test_pixels_of_another_resolution_are_as_many_as_it_has() -> None:
    """The scene's own picture does not bound them; none is negative."""
    renderer = make(card(Material()), CARD_VIEW, "cpu")
    light, seen = light_args(constant(), renderer.device), np.ones(1, np.int32)
    larger = CARD_VIEW.scaled(2 * CARD_VIEW.width, 2 * CARD_VIEW.height)
    view, last = renderer.scene.camera_args_at(larger), larger.width * larger.height - 1
    renderer.receiver(light, np.array([last], np.int32), seen, 1, 1, 0, view)
    with pytest.raises(ValueError, match="expected row-major indices from 0"):
        renderer.receiver(light, np.array([-1], np.int32), seen, 1, 1, 0, view)
