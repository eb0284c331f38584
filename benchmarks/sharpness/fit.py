"""Trains the networks of `warpir.look.texture` on pictures whose blur and grain are known.

Three kinds: crops of the places that numbers are chosen by, photographs that scikit-image brings
and that are made smaller, hence sharp, and made-up leaves (Lee, Mumford and Huang 2001, "Occlusion
models for natural images"). All pass through the cameras of `benchmarks.look.composites`.
"""

import itertools
import zlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import skimage
import torch
from PIL import Image
from safetensors.numpy import save_file
from scipy import ndimage

from benchmarks.look.composites import draw_camera, softness
from warpir.core.arrays import BoolArray, Float64Array, FloatArray
from warpir.core.color import codes_of, expose, gamma_to_linear, linear_to_gamma
from warpir.evaluate.scenes import CAMERA_HEIGHT, PITCH, crop_camera, crop_radiance
from warpir.io.images.photos import read_envmap
from warpir.look.grain import Grain
from warpir.look.sharpness import gaussian
from warpir.look.texture import FARTHEST, UNITS, WEIGHTS, statistics
from warpir.scene.camera import Camera

CROPS, SMALLER, LEAVES = 96, 300, 24
"""Of a place, of a photograph, and of a set of made-up pictures."""
SETS = 48
"""Of made-up pictures."""
BLURS = ((0.0, 1.6), (1.2, 3.0))
"""Of the cameras [px], the second with a chance of `SOFT`."""
SOFT, SOFTEST = 0.12, 0.6
"""The chance, and the softness from which a crop is left out [px]."""
PHOTOGRAPHS = ("astronaut", "chelsea", "motorcycle_left", "camera", "brick", "grass", "gravel")
"""In `skimage.data`; none of them is in the pictures that judge."""
GRAINLESS, SIZES, CORRELATIONS = 0.15, (0.0, 1.2), (0.0, 0.8)
"""Of the cameras: the chance that one has no grain, its size [px] and its correlation between
channels [1]: sensors, their noise reduction and files that were made smaller differ in both."""
UNEVEN, FARTHER = 0.2, (0.5, 2.5)
"""The chance that a picture is softer in its region than beyond, or beyond than there, and by how
much [px]: the lens is in focus at one distance, and it is the region that is asked about."""
NETWORKS, HIDDEN, DROPPED = 4, (128, 48), 0.1
STEPS, BATCH, RATE, DECAY = 5000, 512, 2e-3, 0.01
LARGE = 0.2
"""Error from which it counts as it is and no more by its square, of `UNITS`."""
Sample = tuple[tuple[float, float], Float64Array]
"""Blur and grain, as in `Texture`, and the statistics of a picture."""


def seen_by_camera(
    linear: FloatArray, own: float, region: BoolArray, rng: np.random.Generator
) -> Sample:
    """Return what a drawn camera makes of a picture that is softer than a render by ``own``."""
    if rng.random() < UNEVEN:
        more = float(rng.uniform(*FARTHER))
        is_here = rng.random() < 0.5
        linear = np.where((region == is_here)[..., None], gaussian(linear, more), linear)
        own = float(np.hypot(own, more)) if is_here else own
    shot = draw_camera(linear, rng, BLURS[int(rng.random() < SOFT)])
    size, correlation = (float(rng.uniform(*ends)) for ends in (SIZES, CORRELATIONS))
    grain = replace(shot.grain, size=size, correlation=correlation)
    if rng.random() < GRAINLESS:
        grain = replace(grain, strength=((0.0,) * 3,) * len(grain.level))
    noise = grain.draw(linear.shape[:2], int(rng.integers(2**31)))
    photo = gamma_to_linear(replace(shot, grain=grain, noise=noise).shoot(linear))
    return (float(np.hypot(shot.blur, own)), grain.of_luminance), statistics(photo, region)


def shown_crop(texels: FloatArray, camera: Camera) -> FloatArray | None:
    """Return a crop of a panorama in 8 bits, display-linear, [H, W, 3]; None where it is black."""
    seen = crop_radiance(texels, camera)
    if not seen.any():
        return None
    return gamma_to_linear((codes_of(expose(seen)[0]) / np.float32(255.0)).astype(np.float32))


def draw_region(rng: np.random.Generator, height: int, width: int) -> BoolArray:
    """Draw a box in a picture."""
    high, wide = rng.uniform(0.25, 0.8, 2)
    top, left = int(rng.uniform(0, 1 - high) * height), int(rng.uniform(0, 1 - wide) * width)
    region = np.zeros((height, width), bool)
    region[top : top + int(high * height), left : left + int(wide * width)] = True
    return region


def of_place(path: Path) -> list[Sample]:
    """Return crops of a panorama."""
    texels = read_envmap(path)
    rng = np.random.default_rng(zlib.crc32(path.stem.encode()) + 77)
    found = []
    for _ in range(CROPS):
        width = int(rng.choice((128, 192, 256, 320)))
        height, pitch = 2 * width // 3, float(rng.uniform(*PITCH))
        fov, azimuth = rng.uniform((45, 0), (95, 360))
        camera = crop_camera(width, height, fov, azimuth, pitch, CAMERA_HEIGHT)
        linear, region = shown_crop(texels, camera), draw_region(rng, height, width)
        own = float(softness(camera, texels.shape[1])[region].mean())
        if linear is None or own > SOFTEST:
            continue
        found += [seen_by_camera(linear, own, region, rng) for _ in range(2)]
    return found


def of_photograph(name: str) -> list[Sample]:
    """Return a photograph, 2 to 6 times smaller."""
    rng = np.random.default_rng(zlib.crc32(name.encode()) + 5)
    with Image.open(Path(skimage.__file__).parent / "data" / f"{name}.png") as image:
        codes = np.asarray(image.convert("RGB"))
    linear = gamma_to_linear((codes / np.float32(255.0)).astype(np.float32))
    found = []
    for _ in range(SMALLER):
        times = min(rng.uniform(2.0, 6.0), min(codes.shape[:2]) / rng.uniform(90.0, 130.0))
        height, width = (int(n / times) for n in codes.shape[:2])
        planes = (Image.fromarray(linear[..., c]) for c in range(3))
        small = [np.asarray(p.resize((width, height), Image.Resampling.BOX)) for p in planes]
        region = draw_region(rng, height, width)
        found.append(seen_by_camera(np.stack(small, axis=-1), 0.0, region, rng))
    return found


def of_leaves(seed: int) -> list[Sample]:
    """Return made-up pictures: discs and boxes of all sizes, half of them with a texture.

    Some are seen through a plain camera: steps without any other fault.
    """
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(LEAVES):
        height, width = int(rng.integers(80, 200)), int(rng.integers(100, 260))
        linear, region = leaves(height, width, rng), draw_region(rng, height, width)
        if rng.random() < 0.4:
            blur = float(rng.uniform(*BLURS[int(rng.random() < SOFT)]))
            shown = linear_to_gamma(gaussian(linear, blur))
            noise = float(rng.uniform(0.0, 3.0)) / 255.0
            shown = shown + noise * rng.normal(size=shown.shape)
            codes = (np.round(255.0 * np.clip(shown, 0.0, 1.0)) / 255.0).astype(np.float32)
            told = blur, Grain((0.5,), ((noise,) * 3,), 0.0, 0.0).of_luminance
            found.append((told, statistics(gamma_to_linear(codes), region)))
        else:
            found.append(seen_by_camera(linear, 0.0, region, rng))
    return found


def leaves(height: int, width: int, rng: np.random.Generator) -> FloatArray:
    """Return a made-up picture, drawn four times finer, shape [H, W, 3]."""
    finer = 4
    high, wide = height * finer, width * finer
    image = np.full((high, wide, 3), rng.uniform(0.02, 0.8), np.float32)
    largest, smallest = rng.uniform(0.1, 0.5) * min(high, wide), rng.uniform(3.0, 20.0) * finer
    grain = rng.uniform(0.0, 0.3) * (rng.random() < 0.5)
    for _ in range(int(rng.integers(8, 60))):
        radius = min(largest, smallest * rng.random() ** -0.7)
        x, y, turn = rng.uniform(0.0, (wide, high, np.pi))
        rows, columns = (
            slice(*(int(np.clip(c + k * 1.5 * radius, 0, n)) for k in (-1, 1)))
            for c, n in ((y, high), (x, wide))
        )
        v, u = np.mgrid[rows, columns].astype(np.float32)
        along = (u - x) * np.cos(turn) + (v - y) * np.sin(turn)
        across = (v - y) * np.cos(turn) - (u - x) * np.sin(turn)
        inside = np.hypot(along, across) < radius
        if rng.random() < 0.6:
            inside = (np.abs(along) < radius) & (np.abs(across) < radius * rng.uniform(0.2, 1.0))
        colour = rng.uniform(0.01, 0.95) * rng.uniform(0.8, 1.2, 3) * np.ones((*v.shape, 1))
        if grain > 0.0:
            few = [-(-n // finer) + 1 for n in v.shape]
            noise = ndimage.zoom(rng.normal(size=few), finer, order=1)[: v.shape[0], : v.shape[1]]
            colour *= 1.0 + grain * noise[..., None]
        image[rows, columns][inside] = np.clip(colour, 0.0, 1.0)[inside]
    return image.reshape(height, finer, width, finer, 3).mean(axis=(1, 3))


def samples(places: Iterable[Path]) -> Iterator[Sample]:
    """Yield all pictures, made on every core."""
    # Processes that are forked hang where torch has threads already.
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(of_place, path) for path in places]
        jobs += [pool.submit(of_photograph, name) for name in PHOTOGRAPHS]
        jobs += [pool.submit(of_leaves, seed) for seed in range(SETS)]
        for job in jobs:
            yield from job.result()


def trained(given: torch.Tensor, told: torch.Tensor, seed: int) -> list[torch.nn.Linear]:
    """Return the layers of a network, trained on statistics [N, S] and what they tell [N, 2]."""
    generator = torch.manual_seed(seed)
    sizes = (given.shape[1], *HIDDEN, told.shape[1])
    layers = [torch.nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
    between = torch.nn.ReLU(), torch.nn.Dropout(DROPPED)
    network = torch.nn.Sequential(layers[0], *between, layers[1], *between, layers[2])
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        drawn = torch.randint(len(told), (BATCH,), generator=generator)
        loss = torch.nn.functional.smooth_l1_loss(network(given[drawn]), told[drawn], beta=LARGE)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return layers


def fit(places: list[Path], path: Path = WEIGHTS) -> None:
    """Train the networks and write their weights."""
    answers, rows = zip(*samples(places), strict=True)
    given, told = np.array(rows), torch.from_numpy(np.array(answers) / UNITS).float()
    mean, spread = given.mean(axis=0), np.maximum(given.std(axis=0), 1e-3)
    x = torch.from_numpy(np.clip((given - mean) / spread, -FARTHEST, FARTHEST)).float()
    networks = [trained(x, told, seed) for seed in range(NETWORKS)]
    weights = {"mean": mean, "spread": spread}
    for k in range(len(networks[0])):
        weights[f"weight.{k}"] = np.stack([n[k].weight.detach().numpy().T for n in networks])
        weights[f"bias.{k}"] = np.stack([n[k].bias.detach().numpy()[None] for n in networks])
    names = ", ".join(p.stem for p in places)
    about = {"record": f"{len(told)} pictures, {len(places)} places: {names}"}
    # As they lie in memory they are written, whatever their strides.
    half = {name: np.ascontiguousarray(v, np.float16) for name, v in weights.items()}
    save_file(half, path, about)
    path.chmod(0o644)
    print(f"{path}: {about['record']}")
