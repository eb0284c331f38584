"""Solid glass: furnace, slab and sphere in closed form, the photo behind it, shadow, gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.builders.poses import rotation
from tests.builders.shapes import (
    all_pixels,
    box,
    camera,
    constant,
    ground,
    placed,
    quad,
    sphere,
    view_rays,
)
from tests.oracles import fresnel
from tests.slow import slow
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.latlong import map_directions
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.glass.solid import absorption, mean_way, straight_shares
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.renderer import Foreground, Renderer
from warpir.render.transport.integrator import TransportIntegrator
from warpir.render.transport.rows import TransportSettings
from warpir.scene.asset import Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import Camera
from warpir.scene.light import Light
from warpir.scene.near.lamps import SphereLamp
from warpir.scene.receiver import mesh_of

GLASS = Material(metallic=0.0, roughness=0.0, transmission=1.0, thickness=1.0)
DARK = constant((0.0, 0.0, 0.0))
SLOPE = np.array([0.3, 0.5, -0.6])
"""Of `sloped` along the axes."""
GREEN = {"attenuation_distance": 0.7, "attenuation_color": (0.3, 0.9, 0.6)}
SIGMA = -np.log([0.3, 0.9, 0.6]) / 0.7


def sloped(height: int = 64) -> Light:
    """Radiance ``1 + SLOPE . direction``, which tells every direction."""
    return Light(texels=radiance_of(map_directions(height, 2 * height)).astype(np.float32))


def radiance_of(directions: Float64Array) -> Float64Array:
    return (1.0 + directions @ SLOPE)[..., None] * np.array([1.0, 0.7, 0.4])


def renderer(
    thing: Placed, view: Camera, device: str, receiver: Receiver | None = None, **more: object
) -> Renderer:
    return Renderer(Scene([thing], view, receiver or ground(), device), **more)


def foreground(
    r: Renderer, light: Light, depth: int = 1, spp: int = 64, seed: int = 1
) -> Foreground:
    return r.foreground(
        light_args(light, r.device), all_pixels(r.scene.camera), spp, 1, depth, seed
    )


def tumbler() -> Primitive:
    """A square cup, open above, with a wall of 0.2 m and flat faces."""
    outer, inner = box((0, 0, 0), (1.4, 1.0, 1.4)), box((0, 0.1, 0), (1.0, 0.8, 1.0))

    def without_lid(p: Primitive) -> np.ndarray:
        top = p.positions[:, 1].max()
        return np.array([f for f in p.indices if not (p.positions[f, 1] == top).all()])

    faces = [without_lid(outer), without_lid(inner)[:, ::-1] + len(outer.positions)]
    positions = np.concatenate([outer.positions, inner.positions])
    ring = []
    corners = [(x, z) for x, z in ((-1, -1), (-1, 1), (1, 1), (1, -1))]
    at = {tuple(np.sign(p)): k for k, p in enumerate(positions) if p[1] > 0.4 and k < 8}
    inside = {tuple(np.sign(p)): k for k, p in enumerate(positions) if p[1] > 0.4 and k >= 8}
    for (x, z), (u, w) in zip(corners, corners[1:] + corners[:1], strict=True):
        a, b, c, d = at[x, 1, z], at[u, 1, w], inside[u, 1, w], inside[x, 1, z]
        ring += [(a, b, c), (a, c, d)]
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    return Primitive(
        positions @ turn.T + [0.0, -0.5, -4.0], np.concatenate([*faces, ring]).astype(np.int32), 0
    )


BODIES = {
    "sphere": lambda: sphere((0.0, 0.0, -4.0), 1.0, 4),
    "coarse sphere": lambda: sphere((0.0, 0.0, -4.0), 1.0, 1),
    "box": lambda: box((0.2, 0.1, -4.0), (1.0, 1.0, 1.0)),
    "tumbler": tumbler,
    "open sheet": lambda: quad((0.0, 0.0, -4.0), (1.0, 0.0, 0.3), (0.0, 1.0, 0.4)),
}


@pytest.mark.parametrize("depth", [1, 64])
@pytest.mark.parametrize("ior", [1.0, 1.5, 2.4])
@pytest.mark.parametrize("body", list(BODIES))
def test_lossless_glass_vanishes_in_even_light(
    body: str, ior: float, depth: int, device: str
) -> None:
    """Every path that leaves brings exactly 1; a few never leave a box or a coarse mesh."""
    r = renderer(placed(BODIES[body](), replace(GLASS, ior=ior)), camera(24, 16, 24.0), device)
    out = foreground(r, constant(), depth)
    assert out.mask.sum() > 20
    assert (out.radiance <= out.mask[:, None]).all()
    lost = 1.0 - out.radiance.sum() / (3.0 * out.mask.sum())
    if body in ("sphere", "open sheet") or ior == 1.0:
        np.testing.assert_array_equal(out.radiance, np.repeat(out.mask[:, None], 3, axis=1))
    assert lost < (0.02 if body == "coarse sphere" else 0.003)


def bent(d: Float64Array, n: Float64Array, eta: float) -> Float64Array:
    """Directions beyond by Snell's law; ``n`` is against ``d``, and ``eta`` beyond over before."""
    cos_i = -np.einsum("rk,rk->r", d, n)[:, None]
    cos_t = np.sqrt(np.maximum(1.0 - (1.0 - cos_i**2) / eta**2, 0.0))
    return d / eta + n * (cos_i / eta - cos_t)


def mirrored(d: Float64Array, n: Float64Array) -> Float64Array:
    return d - 2.0 * np.einsum("rk,rk->r", d, n)[:, None] * n


def through_a_sphere(d: Float64Array, center: Float64Array, ior: float) -> Float64Array:
    """Radiance along rays from the origin that meet a unit sphere of glass, bounce by bounce."""
    along = d @ center
    root = np.sqrt(1.0 - (center @ center - along**2))
    n = d * (along - root)[:, None] - center
    F = fresnel(-np.einsum("rk,rk->r", d, n), ior)[:, None]
    total = F * radiance_of(mirrored(d, n))
    inside = bent(d, n, ior)
    chord = -2.0 * np.einsum("rk,rk->r", inside, n)
    left = np.exp(-SIGMA * chord[:, None])
    weight = 1.0 - F
    for _ in range(20):
        n = n + inside * chord[:, None]
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        weight = weight * left
        total += weight * (1.0 - F) * radiance_of(bent(inside, -n, 1.0 / ior))
        weight = weight * F
        inside = mirrored(inside, -n)
    return total


@pytest.mark.parametrize("ior", [1.33, *slow(1.0, 1.5, 2.0)])
def test_absorbing_sphere_is_that_of_float64(ior: float, device: str) -> None:
    """Snell, Fresnel and Beer-Lambert over all bounces, by pixels within 0.97 of the radius."""
    view, center = camera(24, 24, 240.0), np.array([0.0, 0.0, -20.0])
    material = replace(GLASS, ior=ior, **GREEN)
    r = renderer(placed(sphere(center, 1.0, 6), material), view, device)
    found = foreground(r, sloped(), spp=2048).radiance.astype(float)
    d = view_rays(view, 8)
    is_inside = (np.linalg.norm(np.cross(d, center), axis=-1) < 0.97).all(axis=1)
    d = d[is_inside]
    expected = through_a_sphere(d.reshape(-1, 3), center, ior).reshape(-1, 64, 3).mean(axis=1)
    assert is_inside.sum() > 300
    error = found[is_inside] - expected
    np.testing.assert_allclose(found[is_inside], expected, atol=0.04)
    assert np.sqrt(np.square(error).mean()) < 0.01
    assert np.abs(error.mean(axis=0)).max() < 1e-3


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_slab_is_the_series_of_its_reflections(tilt: float, device: str) -> None:
    """``R = F + F T^2 A^2 / (1 - F^2 A^2)``, ``T = (1 - F)^2 A / (1 - F^2 A^2)``, tint at each."""
    view, ior, thick, tint = camera(8, 8, 4000.0), 1.5, 0.5, np.array([0.9, 0.8, 0.5])
    a = np.radians(tilt)
    turn = rotation(a)
    slab = box((0, 0, 0), (90.0, 90.0, thick))
    slab = replace(slab, positions=slab.positions @ turn.T + [0, 0, -20.0])
    material = replace(GLASS, ior=ior, base_color=tuple(tint), **GREEN)
    found = foreground(renderer(placed(slab, material), view, device), sloped(), spp=4096).radiance
    d = np.array([[0.0, 0.0, -1.0]])
    n = (turn @ [0.0, 0.0, 1.0])[None]
    F = fresnel(np.cos(a), ior)
    A = np.exp(-SIGMA * thick / np.sqrt(1.0 - (np.sin(a) / ior) ** 2))
    more = 1.0 - (F * A) ** 2
    T = (1.0 - F) ** 2 * tint**2 * A / more
    R = F + (1.0 - F) ** 2 * tint**2 * F * A**2 / more
    expected = R * radiance_of(mirrored(d, n))[0] + T * radiance_of(d)[0]
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=5e-3)


def test_open_sheet_bends_light_once_and_stays_as_bright(device: str) -> None:
    """Nothing is behind its back: ``F L(mirrored) + (1 - F) L(bent)``, undimmed."""
    view, ior = camera(8, 8, 4000.0), 1.5
    sheet = quad((0.0, 0.0, -4.0), (1.0, 0.0, 0.0), (0.0, 1.0, 1.0))
    r = renderer(placed(sheet, replace(GLASS, ior=ior, **GREEN)), view, device)
    found = foreground(r, sloped(), spp=4096).radiance
    d = np.array([[0.0, 0.0, -1.0]])
    n = np.array([[0.0, -1.0, 1.0]]) / 2**0.5
    F = fresnel(np.array(0.5**0.5), ior)
    expected = F * radiance_of(mirrored(d, n))[0] + (1.0 - F) * radiance_of(bent(d, n, ior))[0]
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=3e-3)


def test_share_of_glass_mixes_with_the_rest(device: str) -> None:
    """A material that is glass in part, by factor, texture and metal, is the sum of its parts."""
    view = camera(8, 8, 60.0)
    sheet = quad((0.0, 0.0, -4.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.3))
    half = Texture(np.full((2, 2, 4), 128, np.uint8))
    matte = Material(base_color=(0.6, 0.5, 0.2), metallic=0.0, roughness=0.5)
    metal = replace(matte, metallic=1.0)
    mixed = replace(
        matte, metallic=0.25, transmission=0.8, thickness=1.0, transmission_texture=TextureSlot(0)
    )

    def mean(material: Material) -> FloatArray:
        thing = placed(sheet, material, textures=[half])
        return foreground(renderer(thing, view, device), constant(), spp=1024).radiance.mean(axis=0)

    rough = mean(replace(matte, transmission=1.0, thickness=1.0))
    share = 0.8 * 128 / 255
    expected = 0.25 * mean(metal) + 0.75 * (share * rough + (1.0 - share) * mean(matte))
    np.testing.assert_allclose(mean(mixed), expected, rtol=0.01)


def pictured(
    view: Camera, device: str, material: Material, has_mesh: bool
) -> tuple[Renderer, FloatArray]:
    """A block of glass on ground that the photo shows, a ramp along rows and columns."""
    v, u = np.meshgrid(np.arange(view.height), np.arange(view.width), indexing="ij")
    photo = np.stack([0.1 + 0.02 * u, 0.2 + 0.03 * v, 1.0 - 0.01 * u], -1).astype(np.float32)
    block = placed(box((0.0, 0.25, -3.0), (1.2, 0.5, 0.8)), material)
    receiver = replace(ground(0.0), radiance=photo)
    if has_mesh:
        floor = placed(quad((0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, -50.0))).asset
        receiver = replace(receiver, mesh=mesh_of(floor), is_plane=False)
    return renderer(block, view, device, receiver), photo.reshape(-1, 3)


DOWN = camera(32, 24, 40.0, (0.0, 2.0, 0.0), pitch=-35.0)


@pytest.mark.parametrize("has_mesh", [False, True])
def test_ground_behind_glass_is_the_photo(has_mesh: bool, device: str) -> None:
    """Glass that bends nothing shows what is behind its pixel; no light has a part in it."""
    r, photo = pictured(DOWN, device, replace(GLASS, ior=1.0), has_mesh)
    out = foreground(r, DARK)
    whole = out.mask == 1.0
    assert whole.sum() > 100
    np.testing.assert_allclose(out.radiance[whole], photo[whole], atol=2e-3)
    np.testing.assert_array_equal(foreground(r, constant()).radiance[whole], out.radiance[whole])


def test_ground_that_the_photo_does_not_show_is_the_light(device: str) -> None:
    """A glass ball over the ground shows the photo where its rays end in view, else the light."""
    r, _ = pictured(DOWN, device, GLASS, has_mesh=False)
    photo, sky = foreground(r, DARK), foreground(r, constant((2.0, 2.0, 2.0)))
    blank = replace(ground(0.0), radiance=np.ones((24, 32, 3), np.float32))
    white = renderer(placed(box((0.0, 0.25, -3.0), (1.2, 0.5, 0.8)), GLASS), DOWN, device, blank)
    share = foreground(white, DARK).radiance  # of the photo in each pixel
    assert 0.2 < share.sum() / (3.0 * photo.mask.sum()) < 0.95
    gained = sky.radiance - photo.radiance
    np.testing.assert_allclose(gained, 2.0 * (sky.mask[:, None] - share), atol=2e-3)


def test_shadow_of_solid_glass_is_that_of_thin_walls(device: str) -> None:
    """Shadow and bounce see walls that let light pass straight, whether there is an inside."""
    view = camera(24, 16, 30.0, (0.0, 2.0, 1.0), pitch=-40.0)
    block = box((0.0, 0.4, -1.5), (0.8, 0.6, 0.8))
    tinted = replace(GLASS, base_color=(0.8, 0.9, 0.7))
    args, pixels = None, all_pixels(view)
    out = []
    for material in (tinted, replace(tinted, thickness=0.0), replace(tinted, transmission=0.0)):
        r = renderer(placed(block, material), view, device, ground(0.0), bounce_depth=2)
        args = light_args(sloped(16), r.device)
        out.append(r.receiver(args, pixels, np.zeros_like(pixels), 64, 1, 1))
    solid, thin, _ = out
    np.testing.assert_array_equal(solid.lit, thin.lit)
    np.testing.assert_array_equal(solid.thrown, thin.thrown)
    lost = [(x.unoccluded - x.lit + x.thrown).sum() for x in out]
    assert 0.3 < lost[0] / lost[2] < 0.7


def test_mean_way_is_cauchys() -> None:
    """4 V / S of a ball is 4 r / 3, of a thin plate twice its thickness."""
    ball = sphere((9.0, 3.0, 1.0), 0.5, 5)
    assert mean_way([ball.positions[ball.indices]]) == pytest.approx(4.0 / 3.0 * 0.5, rel=2e-3)
    plate = box((1.0, 2.0, 3.0), (50.0, 0.01, 50.0))
    assert mean_way([plate.positions[plate.indices]]) == pytest.approx(0.02, rel=1e-3)
    assert mean_way([]) == 0.0


def test_absorption_grows_with_the_asset() -> None:
    """A bottle of twice the size looks the same: its distances double."""
    materials = [replace(GLASS, **GREEN), Material(transmission=1.0)]
    np.testing.assert_allclose(absorption(materials, [1.0, 1.0]), [SIGMA, np.zeros(3)])
    np.testing.assert_allclose(absorption(materials, [2.0, 1.0])[0], 0.5 * SIGMA)
    absorbed = absorption(materials, [1.0, 1.0])
    shares = straight_shares(materials, absorbed, [0.7, 0.7])
    left = np.sqrt([0.3, 0.9, 0.6]) @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(shares, [left, 1.0], rtol=1e-3)


def test_black_absorption_and_infinite_index_are_finite(device: str) -> None:
    """Colour 0, a short distance, an index of 0 (which stands for infinity), a share of 1."""
    for material in (
        replace(GLASS, attenuation_distance=1e-6, attenuation_color=(0.0, 0.0, 0.0)),
        replace(GLASS, ior=0.0),
        replace(GLASS, roughness=1.0, ior=0.0, **GREEN),
    ):
        for body in BODIES.values():
            r = renderer(placed(body(), material), camera(24, 16, 24.0), device)
            out = foreground(r, constant(), 64, spp=16)
            assert np.isfinite(out.radiance).all()
            assert (out.radiance <= 2.0).all()
            assert r.bad_pixels.count == 0


@pytest.mark.slow
def test_lamp_is_seen_through_glass(device: str) -> None:
    """From within a lamp that is all around, glass vanishes as in an even sky."""
    around = SphereLamp(np.array([3.0, -1.0, 2.0]), 40.0, np.full(3, 4.0 * np.pi**2 * 40.0**2))
    view = camera(24, 16, 24.0)
    thing = placed(BODIES["sphere"](), GLASS)
    r = Renderer(Scene([thing], view, Receiver(np.zeros(3), 0.0, is_plane=False), device, [around]))
    out = foreground(r, DARK)
    np.testing.assert_allclose(out.radiance, np.repeat(out.mask[:, None], 3, axis=1), rtol=1e-5)


def test_a_scene_without_solid_glass_has_todays_materials(device: str) -> None:
    """Nothing of the glass is uploaded, and its kernels are not those with glass."""
    thin = renderer(placed(BODIES["box"](), replace(GLASS, thickness=0.0)), DOWN, device)
    assert not thin.scene.has_solid_glass
    assert thin.scene.shadow_material_args is thin.scene.material_args
    solid = renderer(placed(BODIES["box"](), GLASS), DOWN, device)
    assert solid.scene.has_solid_glass and solid.scene.glass_bounds is None
    assert len(list(solid.scene.contents())) > len(list(thin.scene.contents()))


@pytest.mark.parametrize("place", ["in view", "beside the view", "before the whole view"])
def test_thin_glass_is_looked_for_where_it_is(place: str, device: str) -> None:
    """Its pixels have 64 samples, those of what is beside it 8; glass out of sight costs none."""
    glass = {
        "in view": box((1.5, 0.0, -4.0), (1.0, 1.0, 0.02), 1),
        "beside the view": box((20.0, 0.0, -4.0), (1.0, 1.0, 0.02), 1),
        "before the whole view": box((0.0, 0.0, -1.0), (8.0, 8.0, 0.02), 1),
    }[place]
    solid = box((-1.0, 0.0, -4.0), (0.93, 0.93, 0.02))
    view = camera(64, 32, 40.0)
    clear = replace(GLASS, thickness=0.0, transmission=1.0)
    r = Renderer(Scene([placed((solid, glass), Material(), clear)], view, ground(), device))
    found = r.gbuffer(seed=3)
    column = found.object_pixels % view.width
    is_left = column < 32
    eighths = 8.0 * found.coverage[is_left]
    assert (found.coverage[is_left] == 1.0).any()
    if place == "before the whole view":
        assert len(found.object_pixels) == view.width * view.height
        assert not np.allclose(eighths, np.round(eighths))
        return
    np.testing.assert_allclose(eighths, np.round(eighths), atol=1e-5)
    if place == "in view":
        # Clear glass reflects .08 of what comes straight; 8 samples would have missed many pixels.
        middle = found.coverage[(column >= 48) & (column < 57)]
        assert 0.0 < np.mean(middle) < 0.3
        assert not np.allclose(8.0 * middle, np.round(8.0 * middle))
    else:
        assert is_left.all()


SETTINGS = TransportSettings(
    height_fg=16, height_shadow=16, subsamples=16, paths=32, dtype="float32"
)


@pytest.mark.parametrize("roughness", [0.0, 0.5])
def test_glass_in_stored_transport_is_that_of_mis(roughness: float, device: str) -> None:
    """Rows times the light, and a constant of the photo, which does not scale with it."""
    view = camera(16, 12, 20.0, (0.0, 2.0, 0.0), pitch=-35.0)
    r, _ = pictured(view, device, replace(GLASS, roughness=roughness, **GREEN), has_mesh=False)
    pixels = r.gbuffer(1).object_pixels
    light = sloped(16)
    sky = torch.from_numpy(light.texels)
    transport = TransportIntegrator(r, pixels, all_pixels(view), 3, SETTINGS, light)
    mis = MisIntegrator(r, pixels, all_pixels(view), 512, 1, 3)
    mine, theirs = transport.radiance(sky, sky, 0), mis.radiance(sky, sky, 5)
    dark = mis.radiance(0.0 * sky, 0.0 * sky, 6).foreground.double()
    assert 0.1 < float(dark.sum() / theirs.foreground.sum()) < 0.9
    for a, b in (
        (mine.foreground, theirs.foreground),
        (transport.emission, dark),
        (mine.lit, theirs.lit),
    ):
        a, b = a.double().cpu(), b.double().cpu()
        assert float((a.sum() - b.sum()).abs() / b.sum()) < 0.025
        assert float((a - b).norm() / b.norm()) < 0.06


@pytest.mark.parametrize("roughness", [0.0, 0.5])
def test_glass_is_linear_in_the_light(roughness: float, device: str) -> None:
    """The gradient times the light is the radiance less that in the dark (Euler), with mis too."""
    view = camera(16, 12, 20.0, (0.0, 2.0, 0.0), pitch=-35.0)
    r, _ = pictured(view, device, replace(GLASS, roughness=roughness, **GREEN), has_mesh=False)
    pixels, light = r.gbuffer(1).object_pixels, sloped(16)
    transport = TransportIntegrator(r, pixels, all_pixels(view), 3, SETTINGS, light)
    mis = MisIntegrator(r, pixels, all_pixels(view), 64, 1, 3)
    for integrator in (transport, mis):
        sky = torch.from_numpy(light.texels).clone().requires_grad_(True)
        out = integrator.radiance(sky, sky, 4).foreground.double().sum()
        (gradient,) = torch.autograd.grad(out, sky)
        by_light = float((gradient.double() * sky.detach().double()).sum())
        dark = integrator.radiance(0.0 * sky.detach(), 0.0 * sky.detach(), 4).foreground
        if integrator is mis:  # drawn from another proposal in the dark
            assert by_light == pytest.approx(float(out - dark.double().sum()), rel=0.03)
        else:
            assert by_light == pytest.approx(float(out - dark.double().sum()), rel=1e-4)
            step = torch.from_numpy(np.random.default_rng(1).normal(size=sky.shape)).float()
            ends = [
                integrator.radiance(sky.detach() + h * step, sky.detach(), 4).foreground.double()
                for h in (1e-2, -1e-2)
            ]
            slope = float((ends[0] - ends[1]).sum()) / 2e-2
            assert slope == pytest.approx(float((gradient * step).sum()), rel=1e-3)


def test_mirror_image_of_glass_that_bends_nothing_is_what_it_hides(device: str) -> None:
    """In the coat of a glossy ground the object's paths go through glass as before the camera."""
    view = camera(16, 12, 20.0, (0.0, 1.0, 1.5), pitch=-25.0)
    ball = placed(sphere((0.0, 0.6, -2.0), 0.6, 3), replace(GLASS, ior=1.0))
    r = renderer(ball, view, device, ground(0.0))
    pixels = all_pixels(view)
    args = light_args(sloped(16), r.device)
    image, hidden, _ = r.mirrored(args, pixels, np.zeros_like(pixels), 0.1, 64, 1, 1, 1)
    assert (hidden[:, 0] > 0.0).sum() > 10
    np.testing.assert_allclose(image, hidden, rtol=1e-4, atol=1e-6)
