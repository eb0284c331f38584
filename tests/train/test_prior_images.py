"""The scenes that the embedded networks learn from: light, frames, and what is promised of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.diffusion.models.embedded_words import KINDS, NOUNS
from warpir.kernels.training.scene import BOX, CYLINDER, ELLIPSOID
from warpir.lighting.latlong_tensors import luminance, shrunk, solid_angles
from warpir.lighting.regression import estimate_shading_light
from warpir.lighting.regressor import random_regressor
from warpir.train.lights import (
    LightPool,
    load_panoramas,
    make_lights,
    split_sun,
)
from warpir.train.meshes import FAMILIES, make_meshes
from warpir.train.photo_look import draw_faults, draw_looks
from warpir.train.scenes.generator import PHOTO_SIZE, Mixture, SceneGenerator
from warpir.train.scenes.lighting import Lighting, about_y, to_map, to_world
from warpir.train.scenes.render import Stock, render, sun_reaches
from warpir.train.scenes.solids import SOLIDS, packed_solids


def lights_of(device: str, fine: torch.Tensor, sun: float, axis: tuple[float, ...]) -> LightPool:
    """Return a pool of one panorama: this map, and a narrow sun, also where it is seen."""
    height = 128
    directions = map_directions(height, 2 * height)
    seen = np.full((height, 2 * height, 3), float(fine.mean()), np.float32)
    place = np.unravel_index(np.argmax(directions @ np.array(axis)), directions.shape[:2])
    seen[place] += sun / texel_solid_angles(height, 2 * height)[place[0]]

    def tensor(values: object) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, np.float32)).to(device)

    unknown = torch.full((1,), -1, device=device)
    return LightPool(
        fine[None].to(device), tensor([directions[place]]), tensor([[sun] * 3]), tensor([0.01]),
        unknown, unknown, tensor(seen[None]), 1, 1,
    )  # fmt: skip


def even(device: str, sun: float = 0.0, axis: tuple[float, ...] = (0.0, 0.8, -0.6)) -> LightPool:
    return lights_of(device, torch.ones(32, 64, 3), sun, axis)


def generator(device: str, pool: LightPool, **shares: float) -> SceneGenerator:
    return SceneGenerator(Stock(make_meshes(12, 3), pool, device), 5, Mixture(**shares))


CROPS = {"made_up": 0.0, "hybrid": 0.0, "proxies": 0.0, "misjudged": 0.0}


def test_a_wrong_black_point_changes_the_object_alone() -> None:
    scenes = SceneGenerator(Stock(make_meshes(12, 3), even("cpu"), "cpu"), 5, Mixture(mismatched=1))
    drawn = scenes._draw(0, 64, scenes._generator(2, 0), with_object=True)
    is_black = drawn.kind == KINDS.index("shadow")
    assert 4 < int(is_black.sum()) < 30
    assert bool((drawn.black.abs() >= 0.03)[is_black].all())
    assert not drawn.black[~is_black].any()
    shot = scenes._shoot(drawn, scenes._generator(9))
    wrong = scenes._inserted(drawn, shot).image
    right = scenes._inserted(replace(drawn, black=0 * drawn.black), shot).image
    changed = (wrong - right).abs().amax(dim=(1, 2, 3))
    assert bool((changed[is_black] > 0.01).any()) and not changed[~is_black].any()


@pytest.mark.slow
def test_batches_hold_what_they_promise(device: str) -> None:
    scenes = generator(device, even(device, 3.0))
    batch = scenes.prior_batch(1, 24)
    assert batch.image.shape == (24, 3, 64, 64) and batch.background.shape == (24, 6, 64, 64)
    for picture in (batch.image, batch.background, batch.gbuffer[:, :4]):
        assert torch.isfinite(picture).all()
        assert 0.0 <= float(picture.min()) and float(picture.max()) <= 1.0
    assert batch.gbuffer.shape == (24, 13, 64, 64)
    mask, normal = batch.gbuffer[:, 0], batch.gbuffer[:, 4:7]
    length = normal.norm(dim=1)
    torch.testing.assert_close(
        length[mask > 0], torch.ones_like(length[mask > 0]), atol=1e-4, rtol=0
    )
    assert not normal[:, :, :, :].abs().amax(dim=1)[mask == 0].any()
    # Every object is seen, and most of its visible normals look at the camera.
    assert (mask.amax(dim=(1, 2)) > 0.0).float().mean() > 0.9
    assert float((normal[:, 2][mask > 0.99] > 0.0).float().mean()) > 0.9
    assert set(batch.kind.tolist()) <= set(range(len(KINDS)))
    assert (batch.noun < len(NOUNS)).all()
    photo = scenes.photo_batch(1, 8)
    assert photo.photo.shape == photo.rays.shape == (8, 3, 96, 144)
    for unit in (photo.rays, photo.axis):
        torch.testing.assert_close(unit.norm(dim=1), torch.ones_like(unit[:, 0]), atol=1e-5, rtol=0)
    assert ((photo.share >= 0.0) & (photo.share <= 1.0)).all()


@pytest.mark.slow
def test_a_batch_is_a_function_of_seed_and_index(device: str) -> None:
    pool = even(device, 3.0)
    first = generator(device, pool).prior_batch(7, 6)
    again = generator(device, pool).prior_batch(7, 6)
    other = generator(device, pool).prior_batch(8, 6)
    torch.testing.assert_close(first.image, again.image, atol=0, rtol=0)
    assert not torch.equal(first.image, other.image)


@pytest.mark.slow
def test_the_same_scenes_lit_rightly_and_wrongly(device: str) -> None:
    pool = even(device, 3.0)
    right = generator(device, pool, mismatched=0.0).prior_batch(2, 32)
    wrong = generator(device, pool, mismatched=1.0).prior_batch(2, 32)
    assert not right.kind.any() and (wrong.kind > 0).all()
    torch.testing.assert_close(right.background, wrong.background, atol=0, rtol=0)
    torch.testing.assert_close(right.gbuffer, wrong.gbuffer, atol=0, rtol=0)
    changed = (right.image - wrong.image).abs().amax(dim=(1, 2, 3))
    assert float((changed > 0.02).float().mean()) > 0.8


def test_relit_with_no_change_is_the_batch_itself(device: str) -> None:
    scenes = generator(device, even(device, 3.0), mismatched=0.0)
    plain = scenes.prior_batch(3, 8)
    same, dark = scenes.relit(
        3, 8, [lambda x: x, lambda x: replace(x, sun=0.0 * x.sun, gain=0.0 * x.gain)]
    )
    torch.testing.assert_close(same.background, plain.background, atol=0, rtol=0)
    # Other directions stand for the same light.
    assert float((same.image - plain.image).abs().mean()) < 0.01
    covered = dark.gbuffer[:, :1] > 0.999
    assert float(dark.image[covered.expand(-1, 3, -1, -1)].max()) < 0.02


def test_directions_stand_for_the_light(device: str) -> None:
    """Irradiance of an even sky is pi, that of a sun its own times the cosine."""
    scenes = generator(device, even(device, 2.0, (0.0, 0.8, -0.6)), **CROPS)
    drawn = scenes._draw(0, 5, scenes._generator(0), with_object=False)
    table = drawn.tables["light"]
    facing = torch.tensor([0.0, 1.0, 0.0], device=device)
    sky = (table["flux"] * (table["direction"] @ facing).clamp(min=0.0)[..., None]).sum(dim=1)
    np.testing.assert_allclose(sky.cpu(), np.pi, rtol=0.05)
    elevation = drawn.lighting.axis[:, 1]
    sun = (table["sun_direction"] @ facing).mean(dim=1)
    np.testing.assert_allclose(sun.cpu(), elevation.cpu(), atol=5e-3)
    np.testing.assert_allclose((table["flux"].sum(dim=1) / (4.0 * np.pi)).cpu(), 1.0, rtol=1e-3)


def test_the_sun_is_seen_where_the_photo_says(device: str) -> None:
    """The brightest pixel of a panorama's crop looks along ``axis``, turned and mirrored or not."""
    scenes = generator(device, even(device, 40.0, (0.3, 0.15, -0.94)), **CROPS)
    batch = scenes.photo_batch(0, 48)
    drawn = scenes._draw(0, 48, scenes._generator(3, 0), with_object=False)
    shot = render(scenes.stock, drawn, drawn.photo_window, (96, 144), 2, with_object=False)
    brightest = shot.background.mean(dim=1).flatten(1).argmax(dim=1)
    ray = batch.rays.flatten(2)[torch.arange(48), :, brightest]
    angle = torch.rad2deg(torch.arccos((ray * batch.axis).sum(dim=1).clamp(-1.0, 1.0)))
    largest = shot.background.flatten(1).amax(dim=1)
    in_view = largest > 5.0
    assert 3 <= int(in_view.sum()) < 48
    assert float(angle[in_view].max()) < 2.5
    mirrors = drawn.lighting.mirror[in_view]
    assert (mirrors < 0).any() and (mirrors > 0).any()


def test_the_photos_light_has_the_photos_unit(device: str) -> None:
    """Level ground under the stated light is as bright as the photo shows it."""
    scenes = generator(device, even(device, 0.0), **CROPS)
    batch = scenes.photo_batch(4, 16)
    drawn = scenes._draw(4, 16, scenes._generator(3, 4), with_object=False)
    shot = render(scenes.stock, drawn, drawn.photo_window, (96, 144), 2, with_object=False)
    look = draw_looks(shot.background, _after_draw(scenes, 4, 16))
    # An even panorama: every pixel has the gain's radiance, and so has the ambient map.
    expected = (shot.background * look.gain[:, :, None, None]).mean(dim=(2, 3))
    torch.testing.assert_close(batch.ambient.mean(dim=(1, 2)), expected, rtol=2e-3, atol=1e-5)


def _after_draw(scenes: SceneGenerator, index: int, count: int) -> torch.Generator:
    draws = scenes._generator(3, index)
    scenes._draw(index, count, draws, with_object=False)
    return draws


def test_frames_of_map_and_world_are_inverse() -> None:
    torch.manual_seed(0)
    light = Lighting(
        torch.zeros(9), torch.rand(9) * 6.0, torch.tensor([1.0, -1.0, 1.0] * 3), torch.ones(9, 3),
        torch.nn.functional.normalize(torch.randn(9, 3), dim=1), torch.ones(9, 3), torch.ones(9),
    )  # fmt: skip
    d = torch.nn.functional.normalize(torch.randn(9, 5, 3), dim=-1)
    torch.testing.assert_close(to_world(light, to_map(light, d)), d, atol=1e-5, rtol=0)
    # A light turned by an angle shows in a turned direction what it showed before.
    angle = torch.rand(9) * 6.0
    turned = light.turned(angle)
    torch.testing.assert_close(
        to_map(turned, about_y(d, angle)), to_map(light, d), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(turned.axis, about_y(light.axis, angle))


def test_solids_block_the_sun(device: str) -> None:
    """A box, an ellipsoid and a cylinder over a point: straight up is blocked, beside is open."""
    count = 3
    solids = {
        "kind": torch.full((count, SOLIDS), -1, dtype=torch.int32, device=device),
        "centre": torch.zeros(count, SOLIDS, 3, device=device),
        "half": torch.ones(count, SOLIDS, 3, device=device),
        "turn": torch.tensor([np.cos(0.7), np.sin(0.7)], dtype=torch.float32, device=device).expand(
            count, SOLIDS, 2
        ),
        "albedo": torch.ones(count, SOLIDS, 3, device=device),
        "texture": torch.full((count, SOLIDS), -1, dtype=torch.int32, device=device),
    }
    solids["kind"][:, 3] = torch.tensor([BOX, ELLIPSOID, CYLINDER])
    solids["centre"][:, 3, 1] = 5.0
    solids = packed_solids(solids)
    assert solids["count"].tolist() == [1] * count
    scenes = generator(device, even(device))
    up = torch.tensor([[0.0, 1.0, 0.0]] * count, device=device)
    slant = torch.nn.functional.normalize(torch.tensor([[1.0, 0.6, 0.0]] * count), dim=1).to(device)
    below = torch.zeros(count, 3, device=device)
    # From below a cylinder shows its lower cap, which is left out: it stands on the ground.
    blocked = sun_reaches(scenes.stock, solids, below, up).tolist()
    assert blocked[:2] == [0.0, 0.0]
    assert sun_reaches(scenes.stock, solids, below, slant).tolist() == [1.0] * 3
    level = torch.tensor([[-6.0, 5.0, 0.0]] * count, device=device)
    across = torch.tensor([[1.0, 0.0, 0.0]] * count, device=device)
    assert sun_reaches(scenes.stock, solids, level, across).tolist() == [0.0] * 3
    wp.synchronize()


def test_a_split_map_is_the_sum_of_its_parts() -> None:
    height = 64
    directions = map_directions(height, 2 * height)
    omega = texel_solid_angles(height, 2 * height)[:, None]
    axis = np.array([0.36, 0.48, -0.8])
    sharpness = 1.0 / np.radians(2.0) ** 2
    lobe = 500.0 * np.exp(sharpness * (directions @ axis - 1.0))
    texels = (0.4 + lobe[..., None] * (1.0, 0.8, 0.5)).astype(np.float32)
    split = split_sun(texels)
    assert np.degrees(np.arccos(np.clip(split.axis @ axis, -1.0, 1.0))) < 0.3
    assert split.sigma == pytest.approx(np.radians(2.0), rel=0.1)
    expected = 500.0 * 2.0 * np.pi / sharpness * np.array([1.0, 0.8, 0.5])
    np.testing.assert_allclose(split.sun, expected, rtol=0.03)
    total = (texels * omega[..., None]).sum(axis=(0, 1))
    rest = (split.rest.astype(np.float64) * omega[..., None]).sum(axis=(0, 1))
    # The sun's irradiance is its flux but for the cosines within the cap.
    np.testing.assert_allclose(rest + split.sun, total, rtol=0.01)


def test_shrinking_keeps_the_flux() -> None:
    torch.manual_seed(1)
    maps = torch.rand(2, 32, 64, 3)
    sums = [(x * solid_angles(x)[..., None]).sum(dim=(1, 2)) for x in (maps, shrunk(maps, 16))]
    torch.testing.assert_close(*sums)


def test_made_up_lights_are_sound() -> None:
    lights = make_lights(400, torch.Generator().manual_seed(0), "cpu")
    for part in (lights.fine, lights.sun, lights.sigma):
        assert torch.isfinite(part).all() and float(part.min()) >= 0.0
    torch.testing.assert_close(lights.axis.norm(dim=1), torch.ones(400), atol=1e-5, rtol=0)
    share = lights.flux_share()
    clear, overcast = share[lights.weather == 0], share[lights.weather == 1]
    assert float(clear.median()) > 0.25 and float(overcast.median()) < 0.05
    # The sky around the sun is brighter than the sky away from it.
    near = torch.einsum(
        "hwc,nc->nhw", torch.from_numpy(map_directions(32, 64)).float(), lights.axis
    )
    up = torch.from_numpy(map_directions(32, 64)[..., 1]).float() > 0.1
    sky = luminance(lights.fine)
    brighter = []
    for k in torch.nonzero(lights.weather == 0).flatten().tolist():
        toward, away = (near[k] > 0.8) & up, (near[k] < 0.0) & up
        if toward.any() and away.any():
            brighter.append(float(sky[k][toward].mean()) > float(sky[k][away].mean()))
    # Clouds may turn it over where the sky is broken.
    assert len(brighter) > 100 and sum(brighter) > 0.95 * len(brighter)


def test_panoramas_of_nothing_but_sky_come_last(tmp_path: Path) -> None:
    from warpir.io.results import OutputFolder

    texels = np.full((16, 32, 3), 0.5, np.float32)
    for name in ("b_puresky", "c_place", "a_place"):
        with OutputFolder(tmp_path / name) as folder:
            folder.write_envmap(texels, name)
    paths = sorted(tmp_path.glob("*/*.exr"))
    pool = load_panoramas(paths, "cpu")
    assert pool.panorama_count == 3 and pool.grounded_count == 2
    # Whatever the file's unit, the mean luminance is 1.
    mean = (luminance(pool.fine) * solid_angles(pool.fine)).sum(dim=(1, 2)) / (4.0 * np.pi)
    torch.testing.assert_close(mean, torch.ones(3), atol=1e-3, rtol=0)


def test_objects_stand_on_the_ground_and_know_their_normals() -> None:
    for mesh in make_meshes(len(FAMILIES), 0):
        assert mesh.noun in NOUNS
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        assert low[1] == pytest.approx(0.0, abs=1e-5)
        assert (high - low).max() == pytest.approx(1.0, abs=1e-5)
        corners = mesh.vertices[mesh.faces]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(flat, axis=1, keepdims=True)
        sound = length[:, 0] > 1e-9
        agreement = np.einsum(
            "fc,fkc->fk", (flat / np.maximum(length, 1e-12))[sound], mesh.normals[sound]
        )
        assert (agreement > 0.0).mean() > 0.98
        assert (mesh.albedo > 0.0).all() and (mesh.albedo < 1.0).all()


def test_cameras_expose_and_spoil_within_range() -> None:
    draws = torch.Generator().manual_seed(0)
    radiance = torch.rand(64, 3, 32, 48, generator=draws) * 5.0
    look = draw_looks(radiance, draws)
    shown = look.show(radiance)
    assert 0.0 <= float(shown.min()) and float(shown.max()) <= 1.0
    # A brighter scene is never shown darker.
    assert (look.show(radiance * 1.1) >= shown - 1e-6).all()
    spoilt = draw_faults(shown, draws)
    assert 0.0 <= float(spoilt.min()) and float(spoilt.max()) <= 1.0
    assert 0.001 < float((spoilt - shown).abs().mean()) < 0.1


@pytest.mark.slow
def test_the_prior_is_told_what_the_regressor_says(device: str) -> None:
    """The planes of a level, unturned camera are those of ``Regression.matte_picture``."""
    stock = Stock(make_meshes(12, 3), even(device, 3.0), device)
    network = random_regressor(1).to(device)
    scenes = SceneGenerator(stock, 5, regressor=network)
    batch = scenes.prior_batch(0, 4)
    drawn = scenes._draw(0, 4, scenes._generator(2, 0), with_object=True)
    draws = scenes._generator(2, 0)
    scenes._draw(0, 4, draws, with_object=True)
    shot = scenes._shoot(drawn, draws)
    assert shot.estimate is not None
    expected = estimate_shading_light(network, shot.whole_photo, drawn.rays(PHOTO_SIZE))
    torch.testing.assert_close(shot.estimate.toward, expected.toward, atol=2e-2, rtol=2e-2)
    for k in range(4):
        axes = torch.stack([drawn.right[k], drawn.up[k], drawn.back[k]])
        told = batch.gbuffer[k, 10:]
        assert float((told - told[:, :1, :1]).abs().max()) == 0.0
        torch.testing.assert_close(told[:, 0, 0], axes @ shot.estimate.toward[k], atol=1e-5, rtol=0)
        # Pixel by pixel: irradiance of the nearest texel's direction, which is smooth.
        inside = batch.gbuffer[k, 0] > 0.999
        normals = batch.gbuffer[k, 4:7, inside].T @ axes
        directions = torch.from_numpy(map_directions(16, 32).reshape(-1, 3)).float().to(device)
        nearest = (normals @ directions.T).argmax(dim=1)
        e = shot.estimate.irradiance[k].flatten(0, 1)[nearest]
        albedo = batch.gbuffer[k, 1:4, inside].T ** 2.2
        shown = (albedo * e / np.pi).clamp(0.0, 1.0) ** (1.0 / 2.2)
        assert float((shown - batch.gbuffer[k, 7:10, inside].T).abs().mean()) < 0.02


@pytest.mark.slow
def test_a_misled_prior_is_told_of_the_next_scene(device: str) -> None:
    scenes = SceneGenerator(
        Stock(make_meshes(12, 3), even(device, 3.0), device),
        5,
        regressor=random_regressor(1).to(device),
    )
    (right,), (wrong,) = (scenes.relit(0, 4, [lambda x: x], misled) for misled in (False, True))
    torch.testing.assert_close(wrong.image, right.image, atol=0, rtol=0)
    torch.testing.assert_close(wrong.background, right.background.roll(-1, dims=0), atol=0, rtol=0)
    torch.testing.assert_close(wrong.gbuffer[:, :7], right.gbuffer[:, :7], atol=0, rtol=0)
    assert not torch.equal(wrong.gbuffer[:, 7:], right.gbuffer[:, 7:])
