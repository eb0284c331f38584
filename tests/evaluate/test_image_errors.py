"""Errors of pictures against closed forms and against restatements from their papers."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.ndimage import correlate1d
from scipy.optimize import minimize_scalar

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.errors import ExitCode, InputError
from warpir.evaluate.image_errors import (
    flip_map,
    has_flip,
    image_errors,
    make_regions,
    rmse,
    si_rmse,
    ssim_map,
)
from warpir.evaluate.lpips import Lpips


def pictures(rng: np.random.Generator, height: int = 40, width: int = 60) -> list[FloatArray]:
    """Two pictures that look alike."""
    truth = rng.uniform(0.0, 1.0, (height, width, 3))
    image = np.clip(truth + rng.normal(0.0, 0.1, truth.shape), 0.0, 1.0)
    return [image.astype(np.float32), truth.astype(np.float32)]


def test_rmse_of_a_constant_offset_is_the_offset() -> None:
    a = np.full((5, 7, 3), 0.5)
    assert rmse(a, a - 0.2) == pytest.approx(0.2)


def test_si_rmse_is_the_least_over_all_factors(rng: np.random.Generator) -> None:
    image, truth = (x.astype(np.float64) for x in pictures(rng))
    least = minimize_scalar(lambda s: rmse(s * image, truth), bounds=(0.0, 4.0), method="bounded")
    assert si_rmse(image, truth) == pytest.approx(least.fun, rel=1e-6)
    assert si_rmse(0.3 * truth, truth) == pytest.approx(0.0, abs=1e-12)
    assert si_rmse(np.zeros_like(truth), truth) == pytest.approx(rmse(truth, 0.0 * truth))


def test_ssim_is_that_of_wang_2004(rng: np.random.Generator) -> None:
    """Restated: a Gaussian window of 11 x 11, sigma 1.5, no correction for sample size."""
    image, truth = pictures(rng)
    offsets = np.arange(-5, 6)
    window = np.exp(-0.5 * (offsets / 1.5) ** 2)
    window /= window.sum()

    def mean(x: Float64Array) -> Float64Array:
        for axis in (0, 1):
            x = correlate1d(x, window, axis=axis, mode="reflect")
        return x

    a, b = image.astype(np.float64), truth.astype(np.float64)
    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2 * ma * mb + c1) * (2 * cov + c2)) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    inside = slice(5, -5), slice(5, -5)
    assert ssim_map(image, truth)[inside] == pytest.approx(similarity.mean(axis=-1)[inside])


def test_equal_pictures_have_no_error(rng: np.random.Generator) -> None:
    _, truth = pictures(rng)
    errors = image_errors(truth, truth, {"full": np.ones(truth.shape[:2], bool)})["full"]
    assert errors.pop("ssim") == pytest.approx(1.0)
    assert set(errors) >= {"rmse", "linear_rmse", "si_rmse"}
    assert all(value == pytest.approx(0.0, abs=1e-7) for value in errors.values())


def test_linear_error_is_that_of_decoded_values() -> None:
    image, truth = np.full((12, 12, 3), 0.5, np.float32), np.full((12, 12, 3), 0.25, np.float32)
    errors = image_errors(image, truth, {"full": np.ones((12, 12), bool)})["full"]
    assert errors["linear_rmse"] == pytest.approx(0.5**2.2 - 0.25**2.2, rel=1e-5)


def test_an_error_counts_in_its_region_alone(rng: np.random.Generator) -> None:
    """The mean square over the whole picture is that over the region times its share."""
    _, truth = pictures(rng)
    region = np.zeros(truth.shape[:2], bool)
    region[10:20, 15:45] = True
    image = truth.copy()
    image[region] = np.clip(image[region] * 0.7, 0.0, 1.0)
    regions = {
        "full": np.ones_like(region),
        "part": region,
        "rest": ~region,
        "none": region & False,
    }
    errors = image_errors(image, truth, regions)
    assert errors["rest"]["rmse"] == 0.0
    assert errors["none"] == {}
    whole = errors["part"]["rmse"] * np.sqrt(region.mean())
    assert errors["full"]["rmse"] == pytest.approx(whole, rel=1e-6)
    assert errors["part"]["si_rmse"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.skipif(not has_flip(), reason="flip-evaluator is not installed")
def test_flip_grows_with_the_error_and_knows_its_place(rng: np.random.Generator) -> None:
    truth = np.full((48, 48, 3), 0.5, np.float32)
    image = truth.copy()
    image[:24] = (0.9, 0.1, 0.1)
    errors = flip_map(image, truth)
    assert errors.shape == (48, 48)
    assert errors[:18].min() > 0.3
    assert errors[-10:].max() < 0.01


def test_regions_are_those_of_the_truth() -> None:
    mask, ratio = np.zeros((20, 30), np.float32), np.ones((20, 30, 3), np.float32)
    mask[8:12, 10:18] = 1.0
    mask[8, 10] = 0.25
    ratio[10:14, 14:24] = 0.5
    ratio[0, 0] = 0.96
    regions = make_regions(mask, ratio)
    assert regions["full"].all()
    assert regions["asset"].sum() == 4 * 8
    # A quarter of 4 rows and of 8 columns to each side
    assert np.argwhere(regions["box"]).min(axis=0).tolist() == [7, 8]
    assert np.argwhere(regions["box"]).max(axis=0).tolist() == [12, 19]
    assert regions["box"].sum() == 6 * 12
    # 4 x 10 in shadow, of which 2 x 4 lie behind the object
    assert regions["shadow"].sum() == 40 - 8


def test_a_box_ends_at_the_edge_of_the_picture() -> None:
    mask = np.zeros((20, 30), np.float32)
    mask[:12, 20:] = 0.5
    box = make_regions(mask, np.ones((20, 30, 3), np.float32))["box"]
    assert np.argwhere(box).min(axis=0).tolist() == [0, 18]
    assert np.argwhere(box).max(axis=0).tolist() == [14, 29]


# ----------------------------------------------------------------------------------------- LPIPS


def alexnet_state(seed: int) -> dict[str, torch.Tensor]:
    """Random weights, named as the authors' package names them."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator) / np.sqrt(np.prod(shape[1:]))

    shapes = {
        "net.slice1.0": (64, 3, 11, 11),
        "net.slice2.3": (192, 64, 5, 5),
        "net.slice3.6": (384, 192, 3, 3),
        "net.slice4.8": (256, 384, 3, 3),
        "net.slice5.10": (256, 256, 3, 3),
    }
    state = {}
    for k, (name, shape) in enumerate(shapes.items()):
        state[f"{name}.weight"] = draw(*shape)
        state[f"{name}.bias"] = 0.1 * draw(shape[0], 1)[:, 0]
        state[f"lin{k}.model.1.weight"] = draw(1, shape[0], 1, 1).abs()
    return state


def test_lpips_is_alexnet_by_layers(tmp_path: Path, rng: np.random.Generator) -> None:
    """Restated with torch's modules in the order of torchvision's AlexNet."""
    state = alexnet_state(1)
    save_file(state, tmp_path / "lpips.safetensors")
    image, truth = pictures(rng, 70, 90)

    nn = torch.nn
    layers: list[nn.Module] = [
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(),
    ]  # fmt: skip
    for name in [n for n in state if n.endswith(".weight") and n.startswith("net")]:
        layer = layers[int(name.split(".")[2])]
        layer.load_state_dict({k: state[name.replace("weight", k)] for k in ("weight", "bias")})
    expected = 0.0
    both = torch.from_numpy(np.stack([image, truth])).permute(0, 3, 1, 2) * 2.0 - 1.0
    shift = torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]
    x = (both - shift) / torch.tensor([0.458, 0.448, 0.450])[None, :, None, None]
    k = 0
    with torch.no_grad():
        for layer in layers:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                unit = x / x.norm(dim=1, keepdim=True)
                squared = (unit[0] - unit[1]).square()
                weight = state[f"lin{k}.model.1.weight"].reshape(-1, 1, 1)
                expected += float((squared * weight).sum(dim=0).mean())
                k += 1

    lpips = Lpips(tmp_path / "lpips.safetensors")

    assert k == 5
    assert lpips(image, truth) == pytest.approx(expected, rel=1e-4)
    assert lpips(truth, truth) == 0.0
    errors = image_errors(image, truth, {"full": np.ones((70, 90), bool)}, lpips)
    assert errors["full"]["lpips"] == lpips(image, truth)


def test_lpips_refuses_what_is_not_its_weights(tmp_path: Path) -> None:
    state = alexnet_state(1)
    del state["lin3.model.1.weight"]
    save_file(state, tmp_path / "part.safetensors")
    (tmp_path / "text.safetensors").write_text("no weights")
    for name in ("part.safetensors", "text.safetensors", "absent.safetensors"):
        with pytest.raises(InputError) as caught:
            Lpips(tmp_path / name)
        assert caught.value.code == ExitCode.MODEL
        assert name in str(caught.value)
    with pytest.raises(ValueError, match="64"):
        save_file(alexnet_state(1), tmp_path / "lpips.safetensors")
        Lpips(tmp_path / "lpips.safetensors")(*pictures(np.random.default_rng(0)))
