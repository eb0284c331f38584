"""The scenes that the regressor learns from: light, frames, and what is promised of them."""

from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from tests.builders.image_files import write_envmap
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.kernels.training.scene import BOX, CYLINDER, ELLIPSOID, OccluderTable, is_open
from warpir.lighting.latlong_tensors import luminance, shrunk, solid_angles
from warpir.train.lights import (
    LightPool,
    load_panoramas,
    make_lights,
    split_sun,
)
from warpir.train.photo_look import draw_faults, draw_looks
from warpir.train.scenes.generator import PHOTO_SIZE, Mixture, SceneGenerator
from warpir.train.scenes.lighting import Lighting, to_map, to_world
from warpir.train.scenes.render import filled, render
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
        unknown, tensor(seen[None]), 1, 1,
    )  # fmt: skip


def even(device: str, sun: float = 0.0, axis: tuple[float, ...] = (0.0, 0.8, -0.6)) -> LightPool:
    return lights_of(device, torch.ones(32, 64, 3), sun, axis)


def generator(pool: LightPool, **shares: float) -> SceneGenerator:
    return SceneGenerator(pool, 5, Mixture(**shares))


CROPS = {"made_up": 0.0, "hybrid": 0.0, "proxies": 0.0, "misjudged": 0.0}


def test_batches_hold_what_they_promise(device: str) -> None:
    batch = generator(even(device, 3.0)).photo_batch(1, 24)
    assert batch.photo.shape == batch.rays.shape == (24, 3, 96, 144)
    assert torch.isfinite(batch.photo).all()
    assert 0.0 <= float(batch.photo.min()) and float(batch.photo.max()) <= 1.0
    for unit in (batch.rays, batch.axis):
        torch.testing.assert_close(unit.norm(dim=1), torch.ones_like(unit[:, 0]), atol=1e-5, rtol=0)
    assert ((batch.share >= 0.0) & (batch.share <= 1.0)).all()


@pytest.mark.slow
def test_a_batch_is_a_function_of_seed_and_index(device: str) -> None:
    pool = even(device, 3.0)
    first = generator(pool).photo_batch(7, 6)
    again = generator(pool).photo_batch(7, 6)
    other = generator(pool).photo_batch(8, 6)
    torch.testing.assert_close(first.photo, again.photo, atol=0, rtol=0)
    assert not torch.equal(first.photo, other.photo)


def test_directions_stand_for_the_light(device: str) -> None:
    """Irradiance of an even sky is pi, that of a sun its own times the cosine."""
    scenes = generator(even(device, 2.0, (0.0, 0.8, -0.6)), **CROPS)
    drawn = scenes._draw(0, 5, scenes._generator(0))
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
    scenes = generator(even(device, 40.0, (0.3, 0.15, -0.94)), **CROPS)
    batch = scenes.photo_batch(0, 48)
    drawn = scenes._draw(0, 48, scenes._generator(3, 0))
    shot = render(drawn, PHOTO_SIZE)
    brightest = shot.radiance.mean(dim=1).flatten(1).argmax(dim=1)
    ray = batch.rays.flatten(2)[torch.arange(48), :, brightest]
    angle = torch.rad2deg(torch.arccos((ray * batch.axis).sum(dim=1).clamp(-1.0, 1.0)))
    largest = shot.radiance.flatten(1).amax(dim=1)
    in_view = largest > 5.0
    assert 3 <= int(in_view.sum()) < 48
    assert float(angle[in_view].max()) < 2.5
    mirrors = drawn.lighting.mirror[in_view]
    assert (mirrors < 0).any() and (mirrors > 0).any()


def test_the_photos_light_has_the_photos_unit(device: str) -> None:
    """Level ground under the stated light is as bright as the photo shows it."""
    scenes = generator(even(device, 0.0), **CROPS)
    batch = scenes.photo_batch(4, 16)
    drawn = scenes._draw(4, 16, scenes._generator(3, 4))
    shot = render(drawn, PHOTO_SIZE)
    look = draw_looks(shot.radiance, _after_draw(scenes, 4, 16))
    # An even panorama: every pixel has the gain's radiance, and so has the ambient map.
    expected = (shot.radiance * look.gain[:, :, None, None]).mean(dim=(2, 3))
    torch.testing.assert_close(batch.ambient.mean(dim=(1, 2)), expected, rtol=2e-3, atol=1e-5)


def _after_draw(scenes: SceneGenerator, index: int, count: int) -> torch.Generator:
    draws = scenes._generator(3, index)
    scenes._draw(index, count, draws)
    return draws


def test_frames_of_map_and_world_are_inverse() -> None:
    torch.manual_seed(0)
    light = Lighting(
        torch.zeros(9), torch.rand(9) * 6.0, torch.tensor([1.0, -1.0, 1.0] * 3), torch.ones(9, 3),
        torch.nn.functional.normalize(torch.randn(9, 3), dim=1), torch.ones(9, 3), torch.ones(9),
    )  # fmt: skip
    d = torch.nn.functional.normalize(torch.randn(9, 5, 3), dim=-1)
    torch.testing.assert_close(to_world(light, to_map(light, d)), d, atol=1e-5, rtol=0)


@wp.kernel
def open_rays(
    solids: OccluderTable,
    point: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    reached: wp.array[float],
):
    """Tell by scene whether no solid stands in a ray's way: 1, else 0."""
    scene = wp.tid()
    reached[scene] = is_open(solids, scene, point[scene], axis[scene])


def reaches(
    solids: dict[str, torch.Tensor], point: torch.Tensor, axis: torch.Tensor
) -> list[float]:
    reached = torch.empty(len(point), device=point.device)
    rays = (wp.from_torch(x.contiguous(), dtype=wp.vec3) for x in (point, axis))
    wp.launch(
        open_rays,
        dim=len(point),
        inputs=[filled(OccluderTable, solids), *rays],
        outputs=[wp.from_torch(reached)],
        device=wp.device_from_torch(point.device),
    )
    found: list[float] = reached.tolist()
    return found


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
    up = torch.tensor([[0.0, 1.0, 0.0]] * count, device=device)
    slant = torch.nn.functional.normalize(torch.tensor([[1.0, 0.6, 0.0]] * count), dim=1).to(device)
    below = torch.zeros(count, 3, device=device)
    # From below a cylinder shows its lower cap, which is left out: it stands on the ground.
    blocked = reaches(solids, below, up)
    assert blocked[:2] == [0.0, 0.0]
    assert reaches(solids, below, slant) == [1.0] * 3
    level = torch.tensor([[-6.0, 5.0, 0.0]] * count, device=device)
    across = torch.tensor([[1.0, 0.0, 0.0]] * count, device=device)
    assert reaches(solids, level, across) == [0.0] * 3


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
    sunny = share > 0.25
    clear = sunny & (lights.sigma < 0.03) & (lights.indoors == 0)
    assert 80 < int(sunny.sum()) and 40 < int((share < 0.05).sum())
    # The sky around the sun is brighter than the sky away from it.
    near = torch.einsum(
        "hwc,nc->nhw", torch.from_numpy(map_directions(32, 64)).float(), lights.axis
    )
    up = torch.from_numpy(map_directions(32, 64)[..., 1]).float() > 0.1
    sky = luminance(lights.fine)
    brighter = []
    for k in torch.nonzero(clear).flatten().tolist():
        toward, away = (near[k] > 0.8) & up, (near[k] < 0.0) & up
        if toward.any() and away.any():
            brighter.append(float(sky[k][toward].mean()) > float(sky[k][away].mean()))
    # Clouds may turn it over where the sky is broken.
    assert len(brighter) > 100 and sum(brighter) > 0.95 * len(brighter)


def test_panoramas_of_nothing_but_sky_come_last(tmp_path: Path) -> None:
    texels = np.full((16, 32, 3), 0.5, np.float32)
    names = ("b_puresky", "c_place", "a_place")
    pool = load_panoramas([write_envmap(tmp_path / name, name, texels) for name in names], "cpu")
    assert pool.panorama_count == 3 and pool.grounded_count == 2
    # Whatever the file's unit, the mean luminance is 1.
    mean = (luminance(pool.fine) * solid_angles(pool.fine)).sum(dim=(1, 2)) / (4.0 * np.pi)
    torch.testing.assert_close(mean, torch.ones(3), atol=1e-3, rtol=0)


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
