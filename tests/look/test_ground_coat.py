"""A ground that mirrors is told from one that does not, and its roughness is the coat's."""

import json
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from tests.builders.shapes import view_rays
from tests.oracles import fresnel
from tests.slow import slow
from warpir.core.arrays import BoolArray, Float64Array
from warpir.core.color import gamma_to_linear
from warpir.demo import CAMERA, PHOTO, WET_PHOTO, WET_ROUGHNESS
from warpir.look.ground_coat import estimate_coat
from warpir.scene.camera import Camera, camera_from_fov

UP = np.array([0.0, 1.0, 0.0])
EYE, WALL = 1.6, 16.0
"""Height of the camera, and distance of an upright wall before it [m]."""
Pattern = Callable[[Float64Array, Float64Array], Float64Array]


def stripes(seed: int) -> Pattern:
    """Radiance of a wall at (x, height) [m]: uneven upright stripes of uneven height."""
    rng = np.random.default_rng(seed)
    values, tops = rng.uniform(0.02, 0.8, 400), rng.uniform(2.0, 7.0, 400)

    def radiance(x: Float64Array, y: Float64Array) -> Float64Array:
        k = np.clip((x / 0.9 + 200.0).astype(int), 0, 399)
        return np.where(y < tops[k], values[k], 0.5)

    return radiance


def view(pitch: float = -5.0) -> tuple[Camera, Float64Array]:
    """A camera, and the unit directions of its pixels."""
    camera = camera_from_fov(360, 240, 65.0, pitch, EYE)
    return camera, view_rays(camera).reshape(240, 360, 3)


def on_ground(rays: Float64Array) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Point (x, z) where a ray meets the ground, and whether that is before the wall."""
    t = EYE / np.maximum(-rays[..., 1], 1e-9)
    x, z = t * rays[..., 0], t * rays[..., 2]
    return x, z, (rays[..., 1] < 0.0) & (z > -WALL)


def scene(
    wall: Pattern, roughness: float | None, strength: float = 1.0, texture: float = 0.1
) -> tuple[Float64Array, Camera]:
    """Photo of a wall on a textured ground, whose coat is sampled with GGX normals; linear."""
    camera, rays = view()
    x, z, is_ground = on_ground(rays)
    reach = WALL / np.maximum(-rays[..., 2], 1e-9)
    photo = wall(reach * rays[..., 0], EYE + reach * rays[..., 1])
    rng = np.random.default_rng(7)
    slabs = rng.normal(0.2, 0.2 * texture, (64, 64))
    ground = slabs[(x[is_ground] // 0.7).astype(int) % 64, (z[is_ground] // 0.7).astype(int) % 64]
    if roughness is not None:
        ray, at_x, at_z = rays[is_ground], x[is_ground], z[is_ground]
        light, count = np.zeros(len(ray)), 128
        for _ in range(count):
            u, turn = rng.random(len(ray)), 2.0 * np.pi * rng.random(len(ray))
            slope = roughness**2 * np.sqrt(u / (1.0 - u))
            half = np.stack([slope * np.cos(turn), np.ones(len(ray)), slope * np.sin(turn)], -1)
            cos_half = 1.0 / np.linalg.norm(half, axis=-1)
            half *= cos_half[:, None]
            facing = -(ray * half).sum(-1)
            out = ray + 2.0 * facing[:, None] * half
            far = (-WALL - at_z) / np.minimum(out[:, 2], -1e-9)
            seen = wall(at_x + far * out[:, 0], far * out[:, 1])
            c = np.clip(facing, 0.0, 1.0)
            masked = np.ones(len(ray))
            for cos in (-ray[:, 1], out[:, 1]):
                tan2 = 1.0 / np.maximum(cos, 1e-4) ** 2 - 1.0
                masked = masked * 2.0 / (1.0 + np.sqrt(1.0 + roughness**4 * tan2))
            weight = fresnel(c) * masked * c / (-ray[:, 1] * cos_half)
            light += np.where((facing > 0.0) & (out[:, 1] > 0.0), weight * seen, 0.0)
        ground = ground + strength * light / count
    photo[is_ground] = ground
    return np.repeat(photo[..., None], 3, axis=-1), camera


@pytest.mark.parametrize("roughness", [0.2, *slow(0.1, 0.3)])
def test_roughness_of_a_coat_that_is_known(roughness: float) -> None:
    """The roughness is the coat's within 0.04 under slabs of uneven brightness."""
    found = estimate_coat(*scene(stripes(1), roughness), UP)
    assert found.roughness == pytest.approx(roughness, abs=0.04), found
    assert found.spread is not None and found.spread < 0.05 and not found.reason


@pytest.mark.parametrize("strength", [1.0, 0.5])
@pytest.mark.parametrize("seed", [1, *slow(2)])
def test_strength_is_told_over_fresnels(seed: int, strength: float) -> None:
    """On an even ground, of a coat whose lobe is wider than the steps of the distances tried."""
    found = estimate_coat(*scene(stripes(seed), 0.2, strength, texture=0.0), UP)
    assert found.strength == pytest.approx(strength, rel=0.12), found
    assert found.explained > 0.6


@pytest.mark.slow
def test_turned_camera_and_enlarged_photo_tell_the_same() -> None:
    """Azimuth counts from where the camera looks, and angles, not pixels."""
    photo, camera = scene(stripes(1), 0.2)
    turn = np.eye(4)
    turn[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    fields = {**vars(camera), "c2w": turn @ camera.c2w}
    turned = estimate_coat(photo, type(camera)(**fields), UP)
    here = estimate_coat(photo, camera, UP)
    assert turned.roughness == pytest.approx(here.roughness, abs=1e-6)
    large = estimate_coat(np.repeat(np.repeat(photo, 3, 0), 3, 1), camera.scaled(1080, 720), UP)
    assert large.roughness == pytest.approx(here.roughness, abs=0.02)


@pytest.mark.parametrize("texture", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
def test_matt_ground_has_no_coat(seed: int, texture: float) -> None:
    """Neither an even ground nor slabs of any contrast are taken for a mirror."""
    found = estimate_coat(*scene(stripes(seed), None, texture=texture), UP)
    assert found.roughness is None and found.spread is None and found.reason


@pytest.mark.parametrize("strength", [0.0, 8.0])
def test_image_of_another_strength_is_no_coat(strength: float) -> None:
    """A picture upside down that is much brighter than Fresnel's is something else."""
    found = estimate_coat(*scene(stripes(1), 0.1, strength), UP)
    assert found.roughness is None and found.reason


def test_wall_that_goes_on_below_the_horizon_is_no_image() -> None:
    """Stripes that reach down to the camera's feet are stripes."""
    photo, camera = scene(stripes(1), None)
    _, rays = view()
    reach = WALL / np.maximum(-rays[..., 2], 1e-9)
    photo = stripes(1)(reach * rays[..., 0], 0.0 * reach)
    found = estimate_coat(np.repeat(photo[..., None], 3, -1), camera, UP)
    assert found.roughness is None and found.reason


def test_shadows_toward_the_camera_are_no_image() -> None:
    """The sun stands low behind dark posts, whose parallel shadows reach to the lower edge."""
    photo, camera = scene(stripes(1), None)
    _, rays = view()
    x, _, is_ground = on_ground(rays)
    lit = stripes(1)(x[is_ground], np.zeros(is_ground.sum())) > 0.4
    photo[is_ground] *= np.where(lit, 1.0, 0.35)[:, None]
    found = estimate_coat(photo, camera, UP)
    assert found.roughness is None and found.reason


@pytest.mark.parametrize("pitch", [-5.0, -60.0])
def test_photo_that_shows_nothing_has_no_coat(pitch: float) -> None:
    """A constant photo, and one of the ground alone, end without a number."""
    camera, _ = view(pitch)
    found = estimate_coat(np.full((240, 360, 3), 0.4), camera, UP)
    assert found.roughness is None and found.line.startswith("the ground is matt: ")
    assert ("does not show" in found.reason) == (pitch == -60.0)
    assert np.isfinite([found.explained, found.over_displaced, found.strength]).all()


@pytest.mark.parametrize(
    ("width", "height", "fov_deg", "reason"),
    [(240, 360, 24.0, "no mirror image found"), (90, 360, 14.0, "too narrow to tell")],
)
def test_narrow_photo_has_no_coat(width: int, height: int, fov_deg: float, reason: str) -> None:
    """An upright telephoto, in which nothing lies far enough aside to compare with."""
    camera = camera_from_fov(width, height, fov_deg, -5.0, EYE)
    found = estimate_coat(np.full((height, width, 3), 0.4), camera, UP)
    assert found.roughness is None and reason in found.reason


def test_square_of_the_demo_is_wet_after_rain_alone() -> None:
    """The demo's photos, whose coat is known."""
    told = json.loads(CAMERA.read_text())
    lens = {name: told[name] for name in ("fx", "fy", "cx", "cy")}
    camera = Camera(width=told["w"], height=told["h"], **lens, c2w=np.array(told["c2w"]))
    found = []
    for path in (WET_PHOTO, PHOTO):
        codes = np.asarray(Image.open(path).convert("RGB"), np.float32) / 255.0
        found.append(estimate_coat(gamma_to_linear(codes), camera, UP))
    wet, dry = found
    assert wet.roughness == pytest.approx(WET_ROUGHNESS, abs=0.03)
    assert dry.roughness is None and dry.over_displaced < 0.5
