"""Coat, sheen, glass and reflection of glTF in whole pictures: textures, rays, both integrators."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.builders.shapes import box, camera, constant, lobe, placed, quad, sphere
from tests.oracles import film_fresnel, schlick, sheen_albedo
from tests.render.test_render import (
    BIAS,
    CARD_VIEW,
    FLOAT32,
    STANDARD_ERRORS,
    card,
    make,
    render,
    roofed,
)
from tests.render.test_transport import EXACT, HEIGHT, lights, pixels_of
from warpir.core.arrays import Float64Array
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.transport.integrator import TransportIntegrator
from warpir.scene.asset import Material, Primitive, Texture, TextureSlot
from warpir.scene.light import Light, as_map

DARK = Material(base_color=(0.0, 0.0, 0.0), metallic=0.0, roughness=1.0)
GLASS = Material(base_color=(0.5, 0.5, 0.5), metallic=0.0, roughness=0.4, transmission=1.0)
CODES = (64, 128, 192, 96)
SKY = lobe((0.3, 0.5, 1.0), 2.0)


LAYERED = Material(
    base_color=(0.7, 0.5, 0.3), metallic=0.2, roughness=0.6, specular=0.9, ior=2.0,
    specular_color=(1.0, 0.6, 0.8), clearcoat=0.8, clearcoat_roughness=0.7,
    sheen_color=(0.9, 0.7, 0.5), sheen_roughness=0.9, anisotropy=0.7, iridescence=0.8,
)  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        "specular", "specular_color", "clearcoat", "clearcoat_roughness", "sheen_color",
        "sheen_roughness", "transmission", "anisotropy", "iridescence",
    ],
)  # fmt: skip
def test_textures_multiply_their_factor(device: str, name: str) -> None:
    """Each texture is read in its channel, sRGB where it is a colour, as if in the factor."""
    texture = Texture(np.full((1, 1, 4), CODES, np.uint8))
    linear = [c / 255.0 for c in CODES]
    color = [((c + 0.055) / 1.055) ** 2.4 for c in linear[:3]]
    whole = replace(LAYERED, transmission=0.9 if name == "transmission" else 0.0)
    by = {
        "specular": linear[3], "specular_color": color, "clearcoat": linear[0],
        "clearcoat_roughness": linear[1], "sheen_color": color, "sheen_roughness": linear[3],
        "transmission": linear[0], "anisotropy": linear[2],
        "iridescence": linear[0],
    }  # fmt: skip
    value = np.array(getattr(whole, name)) * by[name]
    multiplied = replace(whole, **{name: tuple(value) if value.ndim else float(value)})
    textured = replace(whole, **{f"{name}_texture": TextureSlot(0)})
    if name == "anisotropy":
        turn = float(np.arctan2(2.0 * linear[1] - 1.0, 2.0 * linear[0] - 1.0))
        multiplied = replace(multiplied, anisotropy_rotation=turn)
    found, expected, without = (
        render(make(card(m, texture), CARD_VIEW, device), SKY, 64).radiance.mean(axis=0)
        for m in (textured, multiplied, whole)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert np.abs(found / without - 1.0).max() > 3e-3


def test_coat_has_a_normal_of_its_own(device: str) -> None:
    """A mirror coat shows what lies in the mirror direction of its map, not of the base's."""
    tilt = np.array([0.6, 0.0, 0.8])
    codes = np.append(np.round(255.0 * (0.5 * tilt + 0.5)), 255).astype(np.uint8)
    # The map's x runs along u, to the right; the camera looks along -Z at the card's middle.
    mirror = 2.0 * tilt[2] * tilt - [0.0, 0.0, 1.0]
    light = lobe(mirror, 400.0, (100.0, 100.0, 100.0))
    texture = Texture(np.tile(codes, (1, 1, 1)))
    view = camera(4, 4, 400.0)
    coated = replace(DARK, specular=0.0, clearcoat=0.5)
    mapped = replace(coated, clearcoat_normal_texture=TextureSlot(0))
    other = replace(coated, normal_texture=TextureSlot(0))
    seen = [
        float(render(make(card(m, texture), view, device), light, 64).radiance.mean())
        for m in (mapped, coated, other)
    ]
    # 8-bit codes and the few pixels' angles cost some of the lobe's peak.
    assert seen[0] == pytest.approx(0.5 * schlick(0.04, 0.8) * 100.0, rel=0.05)
    assert max(seen[1:]) < 1e-3 * seen[0]


def test_coat_darkens_what_shines_below_it(device: str) -> None:
    """Emission loses what the coat reflects toward the camera (KHR_materials_clearcoat)."""
    lamp = replace(DARK, emission=(1.0, 2.0, 3.0), clearcoat=0.75)
    view = camera(4, 4, 4000.0)
    found = render(make(card(lamp), view, device), constant((0.0, 0.0, 0.0)), 4).emission
    share = 1.0 - 0.75 * 0.04
    np.testing.assert_allclose(found, np.tile([share, 2 * share, 3 * share], (16, 1)), rtol=1e-4)


BRUSHED = Material(base_color=(0.9, 0.8, 0.7), metallic=1.0, roughness=0.2, anisotropy=0.8)


def streak(
    device: str, material: Material, tangent: tuple[float, ...] | None = None
) -> Float64Array:
    """Return the second moments of a card's highlight in the picture, x right and y up."""
    part = card(material).asset.primitives[0]
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    given = None if tangent is None else np.tile(np.array(tangent, np.float32), (4, 1))
    view = camera(32, 32, 80.0)
    scene = placed(replace(part, normals=normals, tangents=given), material)
    radiance = render(make(scene, view, device), lobe((0, 0, 1), 1e3), 256).radiance.mean(axis=1)
    x, y = np.meshgrid(np.arange(32) - 15.5, 15.5 - np.arange(32))
    moments = [np.sum(radiance.reshape(32, 32) * m) for m in (x * x, x * y, y * y)]
    return np.array(moments) / radiance.sum()


def test_stretch_follows_tangents_and_coordinates(device: str) -> None:
    """The highlight is long along the stretch: of u, of given tangents, turned toward up."""
    xx, xy, yy = streak(device, BRUSHED)
    assert xx > 1.5 * yy and abs(xy) < 0.03 * xx
    # u of the card points right; a quarter turn leads to its up, against v.
    quarter = replace(BRUSHED, anisotropy_rotation=np.pi / 2)
    for found in (streak(device, quarter), streak(device, BRUSHED, (0, 1, 0, 1))):
        np.testing.assert_allclose(found[[2, 0]], [xx, yy], rtol=0.02)
    turned = replace(BRUSHED, anisotropy_rotation=np.pi / 4)
    assert streak(device, turned)[1] > 0.1 * xx
    # The bitangent of a mirrored tangent space points down.
    assert streak(device, turned, (1, 0, 0, 1))[1] > 0.1 * xx
    assert streak(device, turned, (1, 0, 0, -1))[1] < -0.1 * xx


def test_stretch_without_direction_is_none(device: str) -> None:
    """Where coordinates say nothing of a direction the lobe is round, behind a normal map too."""
    tilted = Texture(np.full((1, 1, 4), (200, 100, 220, 255), np.uint8))
    for slot in (None, TextureSlot(0)):
        found = []
        for anisotropy in (0.8, 0.0):
            material = replace(BRUSHED, anisotropy=anisotropy, clearcoat=0.1, normal_texture=slot)
            part = replace(card(material).asset.primitives[0], uv0=None)
            scene = placed(part, material, textures=(tilted,))
            found.append(render(make(scene, CARD_VIEW, device), SKY, 16).radiance)
        np.testing.assert_array_equal(*found)


@pytest.mark.slow
def test_film_has_the_thickness_of_its_texture(device: str) -> None:
    """The green channel lies between the bounds; without a texture the upper one counts."""
    texture = Texture(np.full((1, 1, 4), CODES, np.uint8))
    whole = replace(BRUSHED, anisotropy=0.0, iridescence=1.0, iridescence_thickness=(150.0, 450.0))
    slot, half = TextureSlot(0), 150.0 + 300.0 * CODES[1] / 255.0
    textured = replace(whole, iridescence_thickness_texture=slot)
    plain = replace(whole, iridescence_thickness=(0.0, half))
    found, expected, without = (
        render(make(card(m, texture), CARD_VIEW, device), SKY, 64).radiance.mean(axis=0)
        for m in (textured, plain, whole)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.abs(found / without - 1.0).max() > 0.1


def test_film_of_no_thickness_is_none(device: str) -> None:
    """At thickness 0 the base is left; a share of 0 leaves it to the last bit."""
    base = replace(BRUSHED, anisotropy=0.0, metallic=0.5, specular=0.9)
    films = (
        base,
        replace(base, iridescence=1.0, iridescence_thickness=(0.0, 0.0)),
        replace(base, iridescence=0.0, iridescence_ior=2.0),
    )
    bare, thin, absent = (render(make(card(m), CARD_VIEW, device), SKY, 64).radiance for m in films)
    np.testing.assert_allclose(thin, bare, rtol=FLOAT32)
    np.testing.assert_array_equal(absent, bare)


def leaning(angle: float) -> Primitive:
    """A wide pane before the camera that leans back by ``angle`` [deg]."""
    a = np.radians(angle)
    return quad((0, 0, -5.0), (50, 0, 0), (0, 50 * np.cos(a), -50 * np.sin(a)))


@pytest.mark.parametrize("angle", [0.0, 60.0, 80.0])
def test_glass_covers_what_it_does_not_let_through(device: str, angle: float) -> None:
    """Coverage is 1 - T: half of what Fresnel lets in passes grey glass, at every angle."""
    view = camera(4, 4, 4000.0)
    out = render(make(placed(leaning(angle), GLASS), view, device), constant(), 4096)
    passes = 0.5 * (1.0 - schlick(0.04, np.cos(np.radians(angle))))
    error = np.sqrt(passes * (1 - passes) / (4096 * 16))
    assert abs(float(out.mask.mean()) - (1.0 - passes)) < STANDARD_ERRORS * error
    # What is seen of it is its reflection alone, undiminished: that of black glass.
    black = replace(DARK, roughness=GLASS.roughness)
    opaque = render(make(placed(leaning(angle), black), view, device), constant(), 4096)
    share = STANDARD_ERRORS * error / (1.0 - passes)
    assert out.radiance.mean() == pytest.approx(float(opaque.radiance.mean()), rel=share)


@pytest.mark.parametrize("angle", [0.0, 60.0, 80.0])
def test_sheen_lets_through_what_is_below_it(device: str, angle: float) -> None:
    """What sheen reflects does not pass: a white curtain sends on all light once."""
    curtain = Material(
        metallic=0.0, specular=0.0, transmission=1.0, sheen_color=(1.0,) * 3, sheen_roughness=1.0
    )
    view, spp = camera(4, 4, 4000.0), 4096
    out = render(make(placed(leaning(angle), curtain), view, device), constant(), spp)
    reflected = min(sheen_albedo(float(np.cos(np.radians(angle))), 1.0), 1.0)
    error = np.sqrt(reflected * (1.0 - reflected) / (spp * 16))
    # The table that kernels read is right to a percent.
    assert abs(out.mask.mean() - reflected) < STANDARD_ERRORS * error + 0.01
    assert out.radiance.mean() - out.mask.mean() == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 60.0])
def test_soap_film_reflects_what_it_keeps(device: str, angle: float) -> None:
    """A film on glass passes what its brightest colour leaves, and shows its own colours."""
    soap = replace(
        GLASS, base_color=(1.0,) * 3, roughness=0.05, ior=1.0, iridescence=1.0,
        iridescence_ior=1.33, iridescence_thickness=(0.0, 320.0),
    )  # fmt: skip
    view, spp = camera(4, 4, 4000.0), 4096
    out = render(make(placed(leaning(angle), soap), view, device), constant(), spp)
    expected = film_fresnel(np.zeros(3), 1.33, 320.0, np.cos(np.radians(angle)))
    passes = 1.0 - expected.max()
    error = np.sqrt(passes * (1 - passes) / (spp * 16))
    assert abs(float(out.mask.mean()) - (1.0 - passes)) < STANDARD_ERRORS * error
    share = STANDARD_ERRORS * error / (1.0 - passes)
    np.testing.assert_allclose(out.radiance.mean(axis=0), expected, rtol=share + 0.02, atol=1e-4)
    assert np.ptp(expected) > 0.1 * expected.max()


def test_glass_throws_a_light_shadow(device: str) -> None:
    """Sunlight loses what each wall reflects and absorbs; coat, index and metal count."""
    passes = 0.5 * 0.96
    np.testing.assert_allclose(roofed(device, GLASS), passes, rtol=FLOAT32)
    np.testing.assert_allclose(roofed(device, GLASS, GLASS), passes**2, rtol=FLOAT32)
    dense = replace(GLASS, ior=3.0, metallic=0.25, clearcoat=0.5, transmission=0.8)
    passes = 0.8 * 0.5 * 0.75 * (1.0 - 0.25) * (1.0 - 0.5 * 0.04)
    np.testing.assert_allclose(roofed(device, dense), passes, rtol=FLOAT32)
    blended = replace(GLASS, alpha_mode="BLEND", alpha=0.25)
    np.testing.assert_allclose(roofed(device, blended), 1.0 - 0.25 * 0.52, rtol=FLOAT32)
    textured = replace(
        GLASS, transmission_texture=TextureSlot(0), base_color_texture=TextureSlot(0)
    )
    texture = Texture(np.full((1, 1, 4), 128, np.uint8))
    ratio = roofed(device, textured, textures=(texture,))
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(ratio, (128 / 255) * 0.5 * linear * 0.96, rtol=FLOAT32)


def test_clear_glass_is_found_by_the_g_buffer(device: str) -> None:
    """A pane that lets 96 % of the rays through is still traced in every pixel that it covers."""
    clear = replace(GLASS, base_color=(1.0, 1.0, 1.0), double_sided=True)
    view = camera(32, 32, 80.0)
    assert len(make(card(clear), view, device).gbuffer(0).object_pixels) == 32 * 32


@pytest.mark.parametrize("name", ["coat", "brushed"])
def test_transport_agrees_with_mis_on_layered_materials(device: str, name: str) -> None:
    """Both integrators find the same light on a narrow coat, on cloth, stretch, through glass."""
    coat = Material(
        base_color=(0.8, 0.3, 0.2), metallic=0.0, roughness=0.8, clearcoat=1.0,
        clearcoat_roughness=0.1, sheen_color=(0.3, 0.3, 0.6), sheen_roughness=0.5,
    )  # fmt: skip
    ball = sphere((0.0, 0.5, -4.0), 0.5)
    if name == "brushed":
        coat, normals = replace(BRUSHED, iridescence=1.0), ball.normals
        around = np.cross([0.0, 1.0, 0.0], normals)
        tangents = np.column_stack([around, np.ones(len(around))]).astype(np.float32)
        ball = replace(ball, tangents=tangents)
    parts = ball, box((0.8, 0.4, -4.0), (0.4, 0.8, 0.4), material=1)
    scene = placed(parts, coat, replace(GLASS, roughness=0.1))
    view = camera(12, 8, 19.0, (0.3, 1.5, 0.0), pitch=-14.0)
    renderer = make(scene, view, device, 0.0)
    objects, proxies = pixels_of(renderer)
    light = Light(lobes=lights(6.0))
    texels = torch.from_numpy(as_map(light, HEIGHT))
    own = [
        TransportIntegrator(renderer, objects, proxies, 2, EXACT, light, seed).radiance(
            texels, texels, 0
        )
        for seed in range(12)
    ]
    reference = MisIntegrator(renderer, objects, proxies, spp=512, rays=1, depth=2)
    other = [reference.radiance(texels, texels, 1000 + seed) for seed in range(4)]
    for name in ("foreground", "lit"):
        mine, theirs = (
            np.stack([getattr(r, name).numpy().astype(np.float64).sum(axis=(0, 1)) for r in runs])
            for runs in (own, other)
        )
        error = np.hypot(mine.std(ddof=1) / np.sqrt(12), theirs.std(ddof=1) / 2.0)
        difference = mine.mean() - theirs.mean()
        assert abs(difference) < STANDARD_ERRORS * error + 1e-3 * BIAS * theirs.mean(), name
