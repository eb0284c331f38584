"""Converged images and gradients of both renderers, kept in a folder that git ignores.

Each renderer's reference is two independent halves: their difference is its noise, and products
over halves or over renderers are free of noise altogether.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.candidates import PARTS, Bench, MisPart, MitsubaPart, numpy
from benchmarks.speed.ratios import combined, rmse
from benchmarks.speed.scenes import MAP_HEIGHT
from warpir.core.arrays import BoolArray, Float64Array
from warpir.render.device_light import light_args
from warpir.scene.light import Light

TRIMMED = 0.02
"""Share of pixels left out of an image's error: those in which `mis` is noisiest. A handful of
mirrored suns holds 99 % of ToyCar's squared error in every renderer, and drowns the rest; the error
with them is stated beside."""
PILOT_RUNS, PILOT_SPP = 32, 16
"""Runs that tell which pixels these are. The references' own halves may not: where they happen to
agree, their products are no longer free of noise."""
REFERENCE_SPP = 512, 2048
"""Camera samples per pixel, ours and Mitsuba's, which are twice a power of 4."""
SEED = 10_000
CHUNK = 64
"""Samples per pixel of one run of `mis`."""


@dataclass(frozen=True)
class Reference:
    """One part."""

    own: tuple[Float64Array, Float64Array]
    """Our image, shape [2, pixel, 3], and gradient, shape [2, He, We, 3]."""
    mitsuba: tuple[Float64Array, Float64Array]
    """Mitsuba's."""
    kept: BoolArray
    """The pixels that count, shape [pixel]."""

    def rmse(self, values: tuple[Float64Array, Float64Array]) -> dict[str, float]:
        """Return relative RMSEs of an image and a gradient, free of the references' noise."""
        found = {}
        for name, k, where in (
            ("image", 0, self.kept),
            ("image_all", 0, slice(None)),
            ("gradient", 1, slice(None)),
        ):
            halves = [self.own[k][:, where], self.mitsuba[k][:, where]]
            # By inverse variance: the less noisy renderer counts more
            weights = [1.0 / max(float(np.square(h[0] - h[1]).mean()), 1e-30) for h in halves]
            found[name] = rmse(
                values[k][where], np.concatenate(halves), np.repeat(weights, 2) / sum(weights)
            )
        return found

    def agreement(self) -> dict[str, dict[str, float]]:
        """Compare both renderers: relative RMSE of the difference, of noise, and without noise.

        ``without_noise`` is a product of independent halves; ``resolved`` is the least that is not
        chance: four standard errors, pixels and texels taken as independent.
        """
        found = {}
        for name, own, other in (
            ("image", self.own[0][:, self.kept], self.mitsuba[0][:, self.kept]),
            ("gradient", self.own[1], self.mitsuba[1]),
        ):
            size = float(np.square(0.5 * (own + other)).mean())
            difference = np.square(own.mean(axis=0) - other.mean(axis=0)).mean()
            noise = sum(np.square(0.5 * (h[0] - h[1])).mean() for h in (own, other))
            product = ((own[0] - other[0]) * (own[1] - other[1])).mean(axis=-1)
            apart, chance = product.mean(), 4.0 * product.std() / np.sqrt(product.size)
            found[name] = {
                "difference": float(np.sqrt(difference / size)),
                "noise": float(np.sqrt(noise / size)),
                "without_noise": float(np.sqrt(max(float(apart), 0.0) / size)),
                "resolved": float(np.sqrt(chance / size)),
            }
        return found


class References:
    """Makes references of one scene, or reads them from the folder of the cache.

    Args:
        bench: The scene.
        cache: The folder.
        spp: Such as `REFERENCE_SPP`.
        log: Is told what was made.
    """

    def __init__(
        self, bench: Bench, cache: Path, spp: tuple[int, int], log: Callable[[str], None]
    ) -> None:
        self.bench, self.cache, self.spp, self.log = bench, cache, spp, log
        self.by_part = {part: self._converge(part) for part in PARTS}

    def _converge(self, part: str) -> Reference:
        kept, pixels = self._quiet(part), len(self.bench.weights[part])
        made = []
        renderers = ("own", _own), ("mitsuba", _mitsuba)
        for (name, make), spp in zip(renderers, self.spp, strict=True):
            flat = self._cached(
                f"{name}, {part}, {spp} samples",
                {"renderer": name, "part": part, "spp": spp, "map": self._hash(part)},
                lambda make=make, spp=spp: make(self.bench, part, spp),
            )
            image, gradient = np.split(flat, [3 * pixels], axis=1)
            shape = (2, MAP_HEIGHT, 2 * MAP_HEIGHT, 3)
            made.append((image.reshape(2, -1, 3), gradient.reshape(shape)))
        return Reference(made[0], made[1], kept)

    def _quiet(self, part: str) -> BoolArray:
        """Return which pixels are not among the noisiest, shape [pixel]."""

        def variance() -> Float64Array:  # of `mis` over seeds, summed over channels
            run = MisPart(self.bench, part, PILOT_SPP)
            images = [run.forward(SEED // 2 + k)()[part] for k in range(PILOT_RUNS)]
            return np.asarray(np.stack(images).var(axis=0).sum(axis=-1))

        key = {"pilot": [PILOT_RUNS, PILOT_SPP], "part": part, "map": self._hash(part)}
        return quiet(self._cached(f"noise, {part}", key, variance))

    def resolution(self) -> float:
        """Relative RMSE between the image under the map and under the lobes it was made of."""
        found = []
        for part, reference in self.by_part.items():
            spp = self.spp[0]
            key = {"renderer": "own", "part": part, "spp": spp}
            exact = self._cached(
                f"own, {part}, lobes, {spp} samples",
                {**key, "map": self._hash(part, of_lobes=True)},
                lambda part=part, spp=spp: _own_lobes(self.bench, part, spp),
            ).reshape(2, -1, 3)
            images = (k[0].mean(axis=0) for k in (reference.own, reference.mitsuba))
            own, other, *lobes = (image[reference.kept] for image in (*images, *exact))
            apart = float(((own - lobes[0]) * (other - lobes[1])).mean())
            size = float((lobes[0] * lobes[1]).mean())
            found.append(float(np.sqrt(max(apart, 0.0) / size)))
        return combined(*found)

    def _cached(
        self, what: str, key: dict[str, Any], make: Callable[[], Float64Array]
    ) -> Float64Array:
        name = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:24]
        path = self.cache / f"{name}.npy"
        if path.exists():
            kept: Float64Array = np.load(path)
            return kept
        made = make()
        self.cache.mkdir(parents=True, exist_ok=True)
        np.save(path, made)
        self.log(f"{self.bench.scene.name}: reference of {what}")
        return made

    def _hash(self, part: str, of_lobes: bool = False) -> str:
        """Digest of all that a reference depends on but its samples."""
        scene = self.bench.scene
        light = list(astuple(scene.lobes)) if of_lobes else [self.bench.texels]
        settings: tuple[Any, ...] = (scene.camera.width, scene.camera.fx)
        if part == "foreground":
            arrays = [scene.object_pixels, scene.weight_fg]
            arrays += [texture.pixels for texture in scene.asset.textures]
            materials = [
                (m.base_color, m.metallic, m.roughness, m.emission, m.transmission)
                for m in scene.asset.materials
            ]
            settings += (scene.depth, materials, self.bench.mitsuba_integrator)
        else:
            arrays = [scene.receiver_pixels, scene.weight_ratio]
        arrays += [*light, scene.matrix, scene.camera.c2w]
        arrays += [p.positions for p in scene.asset.primitives]
        digest = hashlib.sha256(repr(settings).encode())
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def quiet(variance: Float64Array) -> BoolArray:
    """Return which pixels are not among the noisiest, shape [pixel]."""
    kept = np.ones(len(variance), bool)
    noisiest = len(variance) - int(TRIMMED * len(variance))
    kept[np.argsort(variance, kind="stable")[noisiest:]] = False
    return kept


def _flat(image: Float64Array, gradient: Float64Array) -> Float64Array:
    return np.concatenate([image.ravel(), gradient.ravel()])


def _seeds(first: int, count: int) -> list[list[int]]:
    """Return the seeds of two halves' runs."""
    return [[SEED * (half + first) + k for k in range(count)] for half in range(2)]


def _own(bench: Bench, part: str, spp: int) -> Float64Array:
    """Converge `mis`: two halves of image and gradient, shape [2, image + gradient]."""
    chunk = min(CHUNK, spp // 2)
    run = MisPart(bench, part, chunk)
    halves = []
    for seeds in _seeds(1, spp // 2 // chunk):
        if part == "foreground":
            steps = [run.step(seed)()[part] for seed in seeds]
            image = np.mean([s[0] for s in steps], axis=0)
            halves.append(_flat(image, np.mean([s[1] for s in steps], axis=0)))
        else:
            halves.append(_flat(*_own_ratio(run, seeds)))
    return np.stack(halves)


def _own_ratio(run: MisPart, seeds: list[int]) -> tuple[Float64Array, Float64Array]:
    """Divide means over many runs, so that the quotient's bias falls with all their samples."""
    bench = run.bench
    light = bench.leaf(grad=False)
    lit, unoccluded = _plane_sums(run, light, seeds)
    seen = unoccluded > 0.0
    inverse = torch.where(seen, 1.0 / torch.where(seen, unoccluded, 1.0), 0.0)
    ratio = torch.where(seen, lit * inverse, 1.0)
    d_lit = bench.weights["ratio"] * inverse
    d_unoccluded = -d_lit * ratio
    total = np.zeros(bench.texels.shape)
    for seed in seeds:
        leaf = bench.leaf()
        # Seeds of their own: the adjoint must share no noise with what it multiplies
        out = run.mis.radiance(leaf, leaf, seed + 500_000)
        torch.autograd.backward([out.lit, out.unoccluded], [d_lit.float(), d_unoccluded.float()])
        total += numpy(leaf.grad)
    return numpy(ratio), total / len(seeds)


def _plane_sums(run: MisPart, light: Tensor, seeds: list[int]) -> tuple[Tensor, Tensor]:
    """Average the plane's two radiances over runs, in float64."""
    lit = unoccluded = torch.zeros(1, dtype=torch.float64, device=run.bench.device)
    with torch.no_grad():
        for seed in seeds:
            out = run.mis.radiance(light, light, seed)
            lit = lit + out.lit.double() / len(seeds)
            unoccluded = unoccluded + out.unoccluded.double() / len(seeds)
    return lit, unoccluded


def _own_lobes(bench: Bench, part: str, spp: int) -> Float64Array:
    """Converge `mis` under the lobes themselves: two halves of the image, shape [2, image]."""
    chunk = min(CHUNK, spp // 2)
    run = MisPart(bench, part, chunk)
    scene, renderer = bench.scene, bench.scene.renderer
    light = light_args(Light(scene.lobes), renderer.device)
    halves = []
    for seeds in _seeds(5, spp // 2 // chunk):
        if part == "ratio":
            seen_by = run.mis.receiver_pixels, run.mis.may_see_object
            runs = [renderer.receiver(light, *seen_by, chunk, 1, seed) for seed in seeds]
            lit = np.mean([r.lit.astype(np.float64) for r in runs], axis=0)
            unoccluded = np.mean([r.unoccluded.astype(np.float64) for r in runs], axis=0)
            seen = unoccluded > 0.0
            image = np.where(seen, lit / np.where(seen, unoccluded, 1.0), 1.0)
        else:
            images = (
                renderer.foreground(light, scene.object_pixels, chunk, 1, scene.depth, seed)
                for seed in seeds
            )
            image = np.mean([x.radiance.astype(np.float64) for x in images], axis=0)
        halves.append(image.ravel())
    return np.stack(halves)


def _mitsuba(bench: Bench, part: str, spp: int) -> Float64Array:
    """Converge Mitsuba; see `_own`."""
    from benchmarks.speed.mitsuba import ratio_adjoint

    target = bench.mitsuba
    halves = []
    for half in range(2):
        seed = SEED * (half + 3)
        if part == "foreground":
            image, gradient = MitsubaPart(bench, part, spp // 2).step(seed)()[part]
        else:
            sums = target.plane(spp // 2, seed)
            d_lit, d_unoccluded, ratio = ratio_adjoint(*sums, target.weight_ratio)
            made = target.plane_gradient(spp // 2, seed + 5_000, d_lit, d_unoccluded)
            image, gradient = np.asarray(ratio, np.float64).T, np.asarray(made, np.float64)
        halves.append(_flat(image, gradient))
    return np.stack(halves)
