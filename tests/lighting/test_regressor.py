"""The light regressor: its frames, units, files, loss, augmentation, calibration and training."""

import json
import math
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.integrate import quad

from tests.builders.poses import rotation
from tests.builders.shapes import a_regression
from warpir.calibration.forward import softmax
from warpir.core.errors import InputError
from warpir.core.latlong import map_directions
from warpir.lighting.regression import (
    camera_rays,
    facing_irradiance,
    mean_training_light,
    regress,
    yaw_to_world,
)
from warpir.lighting.regressor import (
    AMBIENT_SHARPNESS,
    Prediction,
    ambient_axes,
    candidates,
    least_angle,
    load_regressor,
    mirrored,
    shapes,
    split,
)
from warpir.lighting.regressor import mean_luminance as mean_luminance_of
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.light import Light, Lobes, fibonacci, rasterize_lobes
from warpir.train.augmentation import discolour, erase, mirror, stretch
from warpir.train.batches import PhotoBatch
from warpir.train.light_loss import LightLoss
from warpir.train.networks.regressor import (
    RegressorConfig,
    RegressorModule,
    mean_luminance,
    random_regressor,
    read_regressor,
    save_regressor,
)
from warpir.train.regressor import checkpoints_of, train_regressor
from warpir.train.stepping import TrainingSettings
from warpir.train.validation import calibrated_temperature, measure, region_mass

SMALL = RegressorConfig(
    channels=(8, 16, 32),
    blocks=(1, 1),
    depth=1,
    heads=2,
    directions=300,
    dropout=0.0,
    skipped=0.0,
    hidden=0.0,
)
FLIP = np.array([-1.0, 1.0, 1.0])
FLOAT32 = 1e-5
"""Relative error of short sums in float32."""


def turned(camera: Camera, yaw_deg: float, roll_deg: float = 0.0) -> Camera:
    """Turn a camera about the world's +Y, and before that about its own viewing axis."""
    c2w = camera.c2w.copy()
    about_z = rotation(roll=np.radians(roll_deg))
    c2w[:3, :3] = rotation(np.radians(yaw_deg)) @ c2w[:3, :3] @ about_z
    return replace(camera, c2w=c2w)


def photo_of(rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    return rng.random((height, width, 3)).astype(np.float32)


def photo_batch(count: int, seed: int = 0) -> PhotoBatch:
    """Noise under random light; every part of it differs from photo to photo."""
    g = torch.Generator().manual_seed(seed)
    rays = torch.from_numpy(camera_rays(camera_from_fov(144, 96, 60.0, -10.0, 1.6)))
    axis = F.normalize(torch.randn(count, 3, generator=g), dim=1)
    axis[:, 1] = axis[:, 1].abs()
    return PhotoBatch(
        photo=torch.rand(count, 3, 96, 144, generator=g),
        rays=rays.permute(2, 0, 1).expand(count, -1, -1, -1),
        axis=axis,
        share=torch.rand(count, generator=g),
        sun=0.5 + torch.rand(count, 3, generator=g),
        sigma=0.01 + 0.1 * torch.rand(count, generator=g),
        ambient=0.2 + torch.rand(count, 8, 16, 3, generator=g),
        has_cue=torch.ones(count, dtype=torch.bool),
    )


# ------------------------------------------------------------------------------------ network


def test_regressor_fits_its_file(tmp_path: Path) -> None:
    """About 2 M parameters in fp16, and every file of a training state within 16 MiB."""
    network = random_regressor(0)
    count = sum(p.numel() for p in network.parameters())
    assert 1.8e6 < count < 2.2e6 and 4 * count < 16 * 2**20
    save_regressor(network, tmp_path / "regressor.safetensors", {})
    assert (tmp_path / "regressor.safetensors").stat().st_size < 4.4e6


def test_regressor_parts_use_every_number() -> None:
    """`split` names each number of the flat answer once."""
    network = random_regressor(0, SMALL)
    batch = photo_batch(2)
    (flat,) = network(batch.photo, batch.rays)
    parts = split(flat)
    assert parts.logits.shape == (2, len(network.directions))
    assert parts.ambient.shape == (2, 14, 3) and parts.tint.shape == (2, 2)
    assert sum(part[0].numel() for part in parts) == flat.shape[1]


@pytest.mark.parametrize("count", [300, 1000])
def test_candidates_are_symmetric_and_high(count: int) -> None:
    """Rolling by K / 2 mirrors the directions; none lies below the limit; none is far from one."""
    directions = candidates(count)
    np.testing.assert_array_equal(np.roll(directions, len(directions) // 2, 0), directions * FLIP)
    assert directions[:, 1].min() > -0.25
    upper = fibonacci(5000)
    upper = upper[upper[:, 1] > 0.0]
    gap = np.arccos((upper @ directions.T).max(axis=1).clip(-1.0, 1.0)).max()
    assert gap < 1.6 * math.sqrt(4.0 * math.pi / count)


def test_prediction_mirrors_exactly() -> None:
    """The mirrored photo gives the mirrored answer, bit for bit, whatever the weights."""
    network = random_regressor(3, SMALL)
    batch = photo_batch(2)
    reflected = mirror(batch, torch.tensor([True, True]))
    seen = network.predict(batch.photo, batch.rays)
    other = network.predict(reflected.photo, reflected.rays)
    for a, b in zip(mirrored(seen), other, strict=True):
        assert torch.equal(a, b)
    assert not torch.allclose(seen.logits, other.logits)


@pytest.mark.parametrize("members", [1, 3])
def test_numpy_gives_the_answers_of_torch(rng: np.random.Generator, members: int) -> None:
    """What asks one photo without torch, against the module that is trained, in float64."""
    config = replace(SMALL, blocks=(2, 1), depth=2, members=members)
    network = random_regressor(6, config).double()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2, generator=torch.Generator().manual_seed(1))
    network.temperature.fill_(1.3)
    photo = rng.random((96, 144, 3))
    rays = camera_rays(camera_from_fov(144, 96, 60.0, -10.0, 1.6)).astype(np.float64)
    planes = (torch.from_numpy(part).permute(2, 0, 1)[None] for part in (photo, rays))
    expected = network.predict(*planes)
    for found, part in zip(network.regressor().predict(photo, rays), expected, strict=True):
        np.testing.assert_allclose(found, part[0], rtol=1e-9, atol=1e-9)


def test_sizes_tell_the_shapes_of_the_weights() -> None:
    """The shapes that a file must have are those that torch gives the network."""
    for config in (SMALL, replace(SMALL, blocks=(2, 1), depth=3, members=2)):
        state = random_regressor(0, config).state_dict()
        assert shapes(asdict(config)) == {name: tuple(part.shape) for name, part in state.items()}


def test_regression_flips_with_the_photo(rng: np.random.Generator) -> None:
    """Direction, distribution and ambient light of a flipped photo have the other sign of x."""
    network = random_regressor(1, SMALL).regressor()
    camera = camera_from_fov(120, 80, 60.0, -15.0, 1.6)
    photo = photo_of(rng, 80, 120)
    photo[:, :40] *= 0.2
    seen, other = regress(network, photo, camera), regress(network, photo[:, ::-1], camera)
    np.testing.assert_allclose(other.axis, seen.axis * FLIP, atol=1e-6)
    np.testing.assert_allclose(other.sun, seen.sun, rtol=FLOAT32)
    for normal in (np.array([1.0, 0.0, 0.0]), np.array([0.6, 0.8, 0.0])):
        a = Light(seen.ambient).irradiance(normal)
        b = Light(other.ambient).irradiance(normal * FLIP)
        np.testing.assert_allclose(a, b, rtol=FLOAT32)


def test_regression_turns_with_the_camera(rng: np.random.Generator) -> None:
    """The same photo from a camera turned about +Y: the whole light turns along."""
    network = random_regressor(1, SMALL).regressor()
    camera = camera_from_fov(120, 80, 60.0, -15.0, 1.6)
    photo = photo_of(rng, 80, 120)
    still, moved = regress(network, photo, camera), regress(network, photo, turned(camera, 70.0))
    expected = Light(still.lobes()).rotated(70.0).lobes
    assert expected is not None
    np.testing.assert_allclose(moved.lobes().axis, expected.axis, atol=1e-6)
    np.testing.assert_allclose(moved.lobes().amplitude, expected.amplitude, rtol=FLOAT32)
    np.testing.assert_allclose(still.directions[5] @ still.axis, moved.directions[5] @ moved.axis)


@pytest.mark.parametrize("size", [(768, 512), (512, 768), (1000, 400)])
@pytest.mark.parametrize("pitch_deg", [-40.0, 0.0, 25.0])
def test_rays_are_the_cameras(size: tuple[int, int], pitch_deg: float) -> None:
    """Elevation is the world's; azimuth counts from where the camera looks.

    Restated through `Camera.ray` and angles alone, with a yaw and a roll.
    """
    camera = turned(camera_from_fov(*size, 55.0, pitch_deg, 1.6), 130.0, 8.0)
    rays = camera_rays(camera)
    assert rays.shape == (96, 144, 3)
    _, ahead = camera.ray(camera.cx, camera.cy)
    for i, j in [(0, 0), (95, 143), (20, 100), (48, 72)]:
        _, world = camera.ray((j + 0.5) / 144.0 * size[0], (i + 0.5) / 96.0 * size[1])
        azimuth = np.arctan2(world[0], -world[2]) - np.arctan2(ahead[0], -ahead[2])
        level = np.hypot(world[0], world[2])
        expected = [level * np.sin(azimuth), world[1], -level * np.cos(azimuth)]
        np.testing.assert_allclose(rays[i, j], expected, atol=1e-6)


@pytest.mark.parametrize("pitch_deg", [-90.0, 90.0])
def test_frame_of_a_vertical_view_is_its_up_axis(pitch_deg: float) -> None:
    """Straight down, the picture's top is ahead; straight up, its bottom is."""
    camera = turned(camera_from_fov(100, 100, 60.0, pitch_deg, 1.6), 30.0)
    frame = yaw_to_world(camera)
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame[:, 0], camera.c2w[:3, 0], atol=1e-9)


# -------------------------------------------------------------------------------------- units


@pytest.mark.parametrize("sigma", [0.0023, 0.05, 0.4, 1.0])
@pytest.mark.parametrize("sigma_min", [0.0, 0.1])
def test_lobes_give_the_irradiance_stated(sigma: float, sigma_min: float) -> None:
    """Integrate the lobe itself over a hemisphere that faces it; a wider lobe keeps the value."""
    axis = np.array([0.48, 0.6, -0.64])
    light = a_regression(axis=axis, sigma=sigma)
    lobes = light.lobes(sigma_min)
    sharpness, amplitude = float(lobes.sharpness[0]), lobes.amplitude[0].astype(np.float64)
    assert sharpness == pytest.approx(1.0 / max(sigma, sigma_min) ** 2, rel=1e-6)

    def ring(angle: float) -> float:
        radiance = math.exp(-2.0 * sharpness * math.sin(angle / 2.0) ** 2)
        return 2.0 * math.pi * radiance * math.sin(angle) * math.cos(angle)

    bend = min(10.0 / math.sqrt(sharpness), math.pi / 2.0)
    total = quad(ring, 0.0, bend, epsrel=1e-9)[0] + quad(ring, bend, math.pi / 2.0)[0]
    np.testing.assert_allclose(amplitude * total, light.sun, rtol=FLOAT32)
    assert facing_irradiance(sharpness) == pytest.approx(total, rel=1e-6)


def test_regression_record_is_plain(rng: np.random.Generator) -> None:
    """What goes into ``run.json`` is JSON without NaN, and says the same."""
    light = regress(
        random_regressor(0, SMALL).regressor(),
        photo_of(rng, 60, 90),
        camera_from_fov(90, 60, 50.0, 0.0, 1.6),
    )
    record = json.loads(json.dumps(light.record(), allow_nan=False))
    assert record["axis"] == light.axis.tolist() and record["share"] == light.share
    assert 0.0 < light.spread_deg < 90.0 and abs(light.probability.sum() - 1.0) < 1e-9


def test_level_follows_the_luminance_of_the_photo() -> None:
    """The same answer for a photo half as bright means half the light, in photo-linear units."""
    network = random_regressor(0, SMALL).regressor()
    camera = camera_from_fov(90, 60, 50.0, 0.0, 1.6)
    bright = np.full((60, 90, 3), 0.8, np.float32)
    dim = (bright.astype(np.float64) ** 2.2 / 2.0) ** (1.0 / 2.2)
    a, b = (mean_training_light(network, photo, camera) for photo in (bright, dim))
    np.testing.assert_allclose(b.lobes().amplitude, a.lobes().amplitude / 2.0, rtol=FLOAT32)
    assert float(mean_luminance(torch.full((1, 3, 8, 8), 0.8))) == pytest.approx(0.8**2.2)
    assert mean_luminance_of(np.full((8, 8, 3), 0.8)) == pytest.approx(0.8**2.2)


# ------------------------------------------------------------------------------- distributions


def test_least_angle_finds_the_centre_between_candidates() -> None:
    """The centre of a broad lobe comes back within a sixth of the 6-degree grid."""
    directions = candidates(1000)
    g = torch.Generator().manual_seed(2)
    truth = F.normalize(torch.randn(50, 3, generator=g, dtype=torch.float64), dim=1)
    truth[:, 1] = truth[:, 1].abs()
    truth = F.normalize(truth + torch.tensor([0.0, 0.5, 0.0]), dim=1)
    logits = 90.0 * truth.numpy() @ directions.T
    axis, spread = least_angle(directions, softmax(logits))
    angle = np.degrees(np.arccos((axis * truth.numpy()).sum(axis=1).clip(max=1.0)))
    assert angle.max() < 1.0
    # The mean angle of a narrow Gaussian on the plane is sigma sqrt(pi / 2).
    expected = math.sqrt(1.0 / 90.0) * math.sqrt(math.pi / 2.0)
    np.testing.assert_allclose(spread, expected, rtol=0.05)


def test_least_angle_stays_with_the_majority() -> None:
    """Of two far modes the heavier one is the answer: no compromise between them."""
    directions = candidates(1000)
    modes = np.array([[0.9, 0.5, 0.2], [-0.9, 0.5, 0.2]]) / math.sqrt(1.1)
    lobes = softmax(200.0 * modes @ directions.T)
    (axis,), (spread,) = least_angle(directions, 0.65 * lobes[:1] + 0.35 * lobes[1:])
    assert axis @ modes[0] > math.cos(math.radians(5.0))
    apart = math.degrees(math.acos(modes[0] @ modes[1]))
    assert math.degrees(spread) > 0.35 * apart - 5.0


def drawn_from(logits: torch.Tensor, seed: int) -> torch.Tensor:
    """Draw one candidate's number from each row."""
    g = torch.Generator().manual_seed(seed)
    return torch.multinomial(logits.softmax(1), 1, generator=g)[:, 0]


def random_logits(directions: torch.Tensor, count: int) -> torch.Tensor:
    """Lobes of random place and width."""
    g = torch.Generator().manual_seed(5)
    centre = directions[torch.randint(len(directions), (count,), generator=g)]
    kappa = torch.exp(1.5 + 2.0 * torch.rand(count, 1, generator=g))
    return kappa * (centre @ directions.T)


def test_region_mass_is_uniform_for_the_truth() -> None:
    """Where truth is drawn from the distribution itself, a region of mass m holds a share m."""
    directions = torch.from_numpy(candidates(1000)).float()
    logits = random_logits(directions, 4000)
    axis = directions[drawn_from(logits, 1)]
    mass = region_mass(directions, logits.softmax(1), axis)
    for level in (0.25, 0.5, 0.68, 0.9):
        error = 3.0 * math.sqrt(level * (1.0 - level) / 4000.0)
        assert abs(float((mass <= level).float().mean()) - level) < error


@pytest.mark.parametrize("overconfidence", [0.6, 2.5])
def test_temperature_undoes_overconfidence(overconfidence: float) -> None:
    """Logits that are too sharp by a known factor get that factor back."""
    directions = torch.from_numpy(candidates(300)).float()
    logits = random_logits(directions, 4000)
    axis = directions[drawn_from(logits, 1)]
    found = calibrated_temperature(directions, [(logits * overconfidence, axis)])
    assert found == pytest.approx(overconfidence, rel=0.1)


# --------------------------------------------------------------------------------------- files


def test_file_keeps_the_network(tmp_path: Path) -> None:
    """What is read gives the same answers as the fp16 weights that were written."""
    network = random_regressor(4, SMALL)
    network.temperature.fill_(1.7)
    network.mean_light.fill_(0.25)
    path = tmp_path / "regressor.safetensors"
    save_regressor(network, path, {"steps": 12})
    found = read_regressor(path)
    assert found.config == SMALL and found.record == {"steps": 12} and not found.training
    assert torch.equal(found.directions, network.directions)
    assert float(found.temperature) == pytest.approx(1.7) and found.mean_light[0] == 0.25
    rounded = random_regressor(4, SMALL)
    for parameter in rounded.parameters():
        parameter.data = parameter.data.half().float()
    rounded.temperature.fill_(1.7)
    batch = photo_batch(1)
    for a, b in zip(
        found.predict(batch.photo, batch.rays),
        rounded.predict(batch.photo, batch.rays),
        strict=True,
    ):
        assert torch.equal(a, b)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-500])


# ---------------------------------------------------------------------------------------- loss


def true_prediction(network: RegressorModule, loss: LightLoss, batch: PhotoBatch) -> Prediction:
    """What a network would have to say to be right."""
    targets = loss.targets(batch)
    zero = torch.zeros(len(batch.photo))
    scale = mean_luminance(batch.photo)
    amplitude = torch.full((len(scale), 14, 3), 0.3) / scale[:, None, None]
    return Prediction(
        logits=targets["labels"].log(),
        level=targets["level"],
        level_log_var=zero,
        tint=targets["tint"],
        tint_log_var=torch.zeros(len(zero), 2),
        softness=targets["softness"],
        softness_log_var=zero,
        share=torch.logit(targets["share"]),
        ambient=amplitude.log(),
        ambient_log_var=zero,
    )


def test_loss_is_least_at_the_truth() -> None:
    """No step away from the truth, of any part, makes any term smaller."""
    network = random_regressor(0, SMALL)
    loss = LightLoss(network, 8.0)
    ambient = torch.einsum("tl,lc->tc", loss.lobe_map, torch.full((14, 3), 0.3)).view(8, 16, 3)
    batch = replace(photo_batch(6), ambient=ambient.expand(6, -1, -1, -1))
    truth, targets = true_prediction(network, loss, batch), loss.targets(batch)
    at_truth = loss.terms(truth, targets)
    assert float(at_truth["irradiance"]) < FLOAT32 and float(at_truth["radiance"]) < FLOAT32
    g = torch.Generator().manual_seed(0)
    reached = set()
    for name in ("logits", "level", "tint", "softness", "share", "ambient"):
        part = getattr(truth, name)
        for size in (0.05, 0.5):
            step = size * torch.randn(part.shape, generator=g)
            terms = loss.terms(truth._replace(**{name: part + step}), targets)
            assert all(float(terms[k] - at_truth[k]) > -1e-6 for k in terms)
            reached |= {k for k in terms if float(terms[k] - at_truth[k]) > 1e-5}
    assert reached == set(at_truth)


def test_loss_learns_the_variance_it_sees() -> None:
    """A Gaussian's likelihood is best where the variance is the mean squared error."""
    network = random_regressor(0, SMALL)
    loss = LightLoss(network, 8.0)
    batch = replace(photo_batch(4), share=torch.ones(4))
    truth, targets = true_prediction(network, loss, batch), loss.targets(batch)
    log_var = torch.full((4,), math.log(0.3**2), requires_grad=True)
    off = truth._replace(level=truth.level + 0.3, level_log_var=log_var)
    (slope,) = torch.autograd.grad(loss.terms(off, targets)["level"], log_var)
    assert float(slope.abs().max()) < 1e-6


def test_ambient_matrices_agree_with_light() -> None:
    """Lobes on the map and a map's irradiance are those of `warpir.scene.light`."""
    loss = LightLoss(random_regressor(0, SMALL), 8.0)
    rng = np.random.default_rng(0)
    lobes = Lobes(
        rng.random((14, 3)).astype(np.float32),
        ambient_axes().astype(np.float32),
        np.full(14, AMBIENT_SHARPNESS, np.float32),
    )
    mapped = loss.lobe_map.numpy() @ lobes.amplitude
    np.testing.assert_allclose(mapped.reshape(8, 16, 3), rasterize_lobes(lobes, 8, 16), rtol=0.01)
    texels = rng.random((8, 16, 3)).astype(np.float32)
    irradiance = loss.map_irradiance.numpy() @ texels.reshape(128, 3)
    for normal, found in zip(fibonacci(32), irradiance, strict=True):
        np.testing.assert_allclose(found, Light(texels=texels).irradiance(normal), rtol=FLOAT32)


# -------------------------------------------------------------------------------- augmentation


def test_mirror_keeps_what_is_seen_where() -> None:
    """In direction d the mirrored photo and map show what the first show in d with x negated."""
    batch = photo_batch(2)
    # Pictures that are functions of direction, so that each can be checked on its own.
    slope = torch.tensor([0.3, 0.2, 0.1])
    shown = torch.einsum("bchw,c->bhw", batch.rays, slope)[:, None].expand(-1, 3, -1, -1)
    d = torch.from_numpy(map_directions(8, 16)).float()
    ambient = (1.0 + d @ slope)[None, ..., None].expand(2, -1, -1, 3)
    batch = replace(batch, photo=shown, ambient=ambient)
    other = mirror(batch, torch.tensor([False, True]))
    for f in fields(PhotoBatch):
        assert torch.equal(getattr(other, f.name)[0], getattr(batch, f.name)[0])
    reflected = slope * torch.tensor([-1.0, 1.0, 1.0])
    seen = torch.einsum("chw,c->hw", other.rays[1], reflected)
    torch.testing.assert_close(other.photo[1, 0], seen)
    torch.testing.assert_close(other.ambient[1, ..., 0], 1.0 + d @ reflected)
    assert torch.equal(other.axis[1], batch.axis[1] * torch.tensor([-1.0, 1.0, 1.0]))
    assert torch.allclose(other.rays[1], batch.rays[1], atol=1e-6)  # of an upright camera


def test_stretch_takes_the_rays_along() -> None:
    """A photo that shows its own rays still does after it was cropped and stretched."""
    batch = photo_batch(8)
    batch = replace(batch, photo=batch.rays * 0.5 + 0.5)
    chosen = torch.tensor([True] * 7 + [False])
    other = stretch(batch, chosen, torch.Generator().manual_seed(0))
    torch.testing.assert_close(other.photo * 2.0 - 1.0, other.rays, atol=1e-3, rtol=0.0)
    torch.testing.assert_close(other.rays[7], batch.rays[7], atol=1e-6, rtol=0.0)
    width = (other.rays[:7, :, 48, 0] * other.rays[:7, :, 48, -1]).sum(1)
    assert (width > float((batch.rays[0, :, 48, 0] * batch.rays[0, :, 48, -1]).sum())).all()


def test_discolour_keeps_the_luminance() -> None:
    """Photo, light and surroundings turn grey together."""
    batch = photo_batch(2)
    other = discolour(batch, torch.tensor([True, False]))
    torch.testing.assert_close(mean_luminance(other.photo), mean_luminance(batch.photo))
    weights = torch.tensor([0.2126, 0.7152, 0.0722])
    torch.testing.assert_close(other.sun @ weights, batch.sun @ weights)
    torch.testing.assert_close(other.ambient @ weights, batch.ambient @ weights)
    assert float(other.photo[0].std(dim=0).max() + other.sun[0].std()) < FLOAT32
    assert torch.equal(other.photo[1], batch.photo[1]) and torch.equal(other.sun[1], batch.sun[1])


def test_erase_paints_a_part() -> None:
    """With certainty three patches change a part of the photo; with share 0 nothing changes."""
    photo = photo_batch(16).photo
    painted = erase(photo, 1.0, torch.Generator().manual_seed(0))
    changed = (painted != photo).any(dim=1).float().mean(dim=(1, 2))
    assert 0.0 < float(changed.min()) and float(changed.max()) < 0.4
    assert torch.equal(erase(photo, 0.0, torch.Generator().manual_seed(0)), photo)


# ------------------------------------------------------------------------------------ training


def blobs(count: int, generator: torch.Generator) -> PhotoBatch:
    """Grey photos with one bright blob, which is where the light is."""
    camera = camera_from_fov(144, 96, 90.0, 20.0, 1.5)
    rays = torch.from_numpy(camera_rays(camera, 32, 48)).permute(2, 0, 1)
    rays = rays.expand(count, -1, -1, -1)
    pixel = torch.randint(32 * 48, (count,), generator=generator)
    axis = rays.flatten(2)[torch.arange(count), :, pixel]
    blob = torch.exp(100.0 * (torch.einsum("bchw,bc->bhw", rays, axis) - 1.0))[:, None]
    noise = torch.rand(count, 3, 32, 48, generator=generator)
    return PhotoBatch(
        photo=0.3 + 0.5 * blob + 0.05 * noise,
        rays=rays,
        axis=axis,
        share=torch.full((count,), 0.7),
        sun=torch.tensor([2.5, 2.0, 1.5]).expand(count, -1),
        sigma=torch.full((count,), 0.05),
        ambient=torch.tensor([0.3, 0.4, 0.5]).expand(count, 8, 16, -1),
        has_cue=torch.ones(count, dtype=torch.bool),
    )


HELD_OUT = {"blobs": [blobs(64, torch.Generator().manual_seed(99))]}
TOY = TrainingSettings(
    batch=16,
    learning_rate=3e-3,
    warmup_steps=10,
    average=0.95,
    label_sigma_deg=8.0,
    crop_share=0.0,
    erase_share=0.0,
    noise=0.0,
    step_limit=150,
)


@pytest.mark.slow
def test_training_learns_where_the_blob_is(tmp_path: Path) -> None:
    """A rule that can be seen is learned, holds for photos never seen, and is written to a file."""
    start = random_regressor(0, SMALL)
    loss = LightLoss(start, TOY.label_sigma_deg)
    before = measure(start, loss, HELD_OUT["blobs"])
    end = train_regressor(blobs, HELD_OUT, tmp_path, TOY, "cpu", 5.0, 5.0, network=start)
    assert end.is_complete and end.steps == TOY.step_limit
    found = read_regressor(tmp_path / "regressor.safetensors")
    after = measure(found, loss, HELD_OUT["blobs"])
    assert before["angle_median"] > 30.0 and after["angle_median"] < 8.0
    assert after["sun_error"] < 0.1 and after["ambient_error"] < 0.1
    assert after["coverage"] >= 0.6
    assert found.record["validation"]["blobs"]["angle_median"] == pytest.approx(
        after["angle_median"], abs=0.1
    )


def part_of(out: Path, name: str) -> dict[str, torch.Tensor]:
    """Return a part of the newest checkpoint: weights or moments by name."""
    part: dict[str, torch.Tensor] = checkpoints_of(out).load(pytest.fail).state[name]
    return part


def test_training_goes_on_where_it_stopped(tmp_path: Path) -> None:
    """A resumed call has the steps, weights, moments and curve of the one before."""
    short = replace(TOY, batch=4, step_limit=3)
    first = train_regressor(
        blobs, HELD_OUT, tmp_path, short, "cpu", 5.0, 5.0, network=random_regressor(0, SMALL)
    )
    weights = part_of(tmp_path, "weights")
    longer = replace(short, step_limit=4, learning_rate=1e-9)
    second = train_regressor(blobs, HELD_OUT, tmp_path, longer, "cpu", 5.0, 5.0, resume=True)
    assert (first.steps, second.steps) == (3, 4) and second.minutes > first.minutes
    assert checkpoints_of(tmp_path).newest == "000002-regressor-4"
    later = part_of(tmp_path, "weights")
    for name, tensor in weights.items():  # a step of next to no length
        torch.testing.assert_close(later[name], tensor, atol=1e-7, rtol=1e-6)
    moments = part_of(tmp_path, "second")
    train_regressor(
        blobs,
        HELD_OUT,
        tmp_path / "fresh",
        replace(longer, step_limit=1),
        "cpu",
        5.0,
        5.0,
        network=random_regressor(0, SMALL),
    )
    alone = part_of(tmp_path / "fresh", "second")
    # After 4 steps with beta 0.99 the second moment has about 4 times that of one step.
    assert sum(m.sum() for m in moments.values()) > 2.0 * sum(m.sum() for m in alone.values())
    lines = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [3, 4]
    assert set(lines[0]["validation"]) == {"blobs"}


def test_training_refuses_what_it_cannot_resume(tmp_path: Path) -> None:
    """No state, or a state that is cut off."""
    with pytest.raises(InputError, match="nothing to go on from"):
        train_regressor(blobs, HELD_OUT, tmp_path, TOY, "cpu", 1.0, 1.0, resume=True)
    tiny = replace(TOY, batch=2, step_limit=1)
    start = random_regressor(0, SMALL)
    train_regressor(blobs, HELD_OUT, tmp_path, tiny, "cpu", 1.0, 1.0, network=start)
    cut(tmp_path / "checkpoints" / "000001-regressor-1" / "state.safetensors")
    with pytest.raises(InputError, match="cannot be used"):
        train_regressor(blobs, HELD_OUT, tmp_path, tiny, "cpu", 1.0, 1.0, resume=True)


def test_training_takes_a_step_whatever_the_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = replace(TOY, batch=2, step_limit=0)
    start = random_regressor(0, SMALL)
    end = train_regressor(blobs, HELD_OUT, tmp_path, tiny, "cpu", 1e-6, 1e-6, network=start)
    assert end.steps == 1 and (tmp_path / "regressor.safetensors").exists()
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("step 1, ") and told[1] == "calibrating the best weights"


def test_training_collects_the_mean_light(tmp_path: Path) -> None:
    """Where every scene has the same levels, the mean training light has them too."""
    end = replace(TOY, batch=32, step_limit=2)
    start = random_regressor(0, SMALL)
    train_regressor(blobs, HELD_OUT, tmp_path, end, "cpu", 5.0, 5.0, network=start)
    network = load_regressor(tmp_path / "regressor.safetensors")
    photo = blobs(1, torch.Generator().manual_seed(3)).photo[0].permute(1, 2, 0).numpy()
    mean = mean_training_light(network, photo, camera_from_fov(144, 96, 90.0, 20.0, 1.5))
    # Photos differ a little in mean luminance, to which levels are relative.
    np.testing.assert_allclose(mean.sun, [2.5, 2.0, 1.5], rtol=0.1)
    assert mean.sigma == pytest.approx(0.05, rel=0.01)
    assert mean.share == pytest.approx(0.7, abs=0.01)
    assert mean.axis[2] < -0.8 and abs(mean.axis[0]) < 0.15  # blobs lie ahead
    for normal in (np.array([0.0, 1.0, 0.0]), np.array([0.6, 0.0, 0.8])):
        found = Light(mean.ambient).irradiance(normal)
        np.testing.assert_allclose(found, math.pi * np.array([0.3, 0.4, 0.5]), rtol=0.1)
