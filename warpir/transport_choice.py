"""Choose how finely to trace light transport, from an error target and a memory limit.

A pilot over some pixels measures instead of guessing: what averaging the expected light over
texels does to object and shadow ratio, and how noisy the rows are at rising counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from warpir.integrator import LightTensors
from warpir.light import Light, Lobes
from warpir.render import Renderer, light_args
from warpir.transport import TransportIntegrator, to_texels
from warpir.transport_matrix import SparseRows
from warpir.transport_rows import TransportSettings, sharpness_limit

IntArray = NDArray[np.int32]
Float64Array = NDArray[np.float64]
_Runs = tuple[Float64Array, Float64Array]

PILOT_PIXELS = 192
"""Pixels of object and of plane that the pilot traces."""
PILOT_SAMPLES = 128
"""Camera samples of each of its four renders."""
HEIGHTS = (16, 24, 32, 48, 64, 96, 128)
"""Maps to choose from; T grows with the square."""
LEVELS = (
    TransportSettings(subsamples=16, paths=32, bright_directions=256),
    TransportSettings(subsamples=32, paths=64, bright_directions=1024),
    TransportSettings(subsamples=64, paths=128, bright_directions=4096),
)
"""Counts to choose from, each several times as costly as the one before."""


@dataclass(frozen=True)
class TransportChoice:
    """Settings, and the errors that the pilot saw with them: RMSE over the RMS of the quantity."""

    settings: TransportSettings
    resolution_object: float
    """What averaging the light over texels changes, after a tone curve [1]."""
    resolution_shadow: float
    """The same in the shadow, over the RMS of ``1 - ratio``: mostly its edge [1]."""
    noise_object: float
    """What another seed of the frozen samples changes [1]."""
    noise_shadow: float
    """The same in the shadow, over the RMS of ``1 - ratio`` [1]."""
    mib: float
    """Memory that the rows will take."""


def choose_settings(
    renderer: Renderer,
    object_pixels: IntArray,
    proxy_pixels: IntArray,
    depth: int,
    expected: Light,
    error: float = 0.05,
    memory_mib: int = 1024,
    seed: int = 0,
) -> TransportChoice:
    """Find the coarsest settings whose pilot stays below an error.

    Resolution and noise may each take ``error / sqrt(2)``. Where no map that fits holds the
    expected lobes, the sharp ones are left to `warpir.mis` and out of the figures. If memory or the
    finest level ends the search first, the best that fits is returned with its errors: look there.

    Args:
        renderer: The scene.
        object_pixels: Row-major pixels that may show the object, shape [object_pixel].
        proxy_pixels: Row-major pixels whose plane the object may shade, shape [proxy_pixel].
        depth: Surface interactions of the object's paths.
        expected: Light to choose for; the sharper, the finer the map.
        error: Relative RMSE aimed at, of the tone-mapped object and of the shadow [1].
        memory_mib: Most memory that the rows may take [MiB].
        seed: Of the pilot.
    """
    rng = np.random.default_rng(seed)
    pilot = _Pilot(
        renderer, _some(rng, object_pixels), _some(rng, proxy_pixels), depth, seed, object_pixels
    )
    share = error / np.sqrt(2.0)
    # A place with a mesh has a stored row for each of its pixels.
    placed = len(proxy_pixels) if renderer.scene.proxy.mesh is not None else 0
    fits = [h for h in HEIGHTS if _mib(len(object_pixels), placed, h, 0.0) < memory_mib]
    fits = fits or [HEIGHTS[0]]
    settings, costs, light = _choose_height(pilot, expected, fits, share)
    settings = replace(settings, memory_mib=memory_mib)
    noise, fill = (0.0, 0.0), 0.0
    for level in LEVELS:
        settings = replace(
            settings,
            subsamples=level.subsamples,
            paths=level.paths,
            bright_directions=level.bright_directions,
        )
        noise, fill = pilot.noise(settings, light)
        if max(noise) < share:
            break
    entries = fill * len(proxy_pixels)
    mib = _mib(len(object_pixels), placed, settings.height_fg, entries)
    return TransportChoice(settings, *costs, *noise, mib)


def _some(rng: np.random.Generator, pixels: IntArray) -> IntArray:
    count = min(PILOT_PIXELS, len(pixels))
    return np.sort(rng.choice(pixels, count, replace=False)).astype(np.int32)


def _mib(objects: int, placed: int, height: int, entries: float) -> float:
    dense = (12.0 * objects + 4.0 * placed) * height * height
    return (dense + SparseRows.BYTES * entries) / 2**20


def _choose_height(
    pilot: _Pilot, expected: Light, heights: list[int], share: float
) -> tuple[TransportSettings, tuple[float, float], Light]:
    """Return settings with a map's height, what averaging costs, and the light of the last map."""

    def costs(light: Light, exact: _Runs, height: int) -> tuple[float, float]:
        averaged = pilot.render(pilot.averaged(light, height), 4)
        return _difference(exact[0], averaged[0]), _difference(exact[1], averaged[1])

    exact = pilot.render(expected, 2)
    for height in heights:
        cost = costs(expected, exact, height)
        if max(cost) < share:
            sharpest = max((float(s) for s in _sharpness(expected)), default=0.0)
            settings = TransportSettings(
                height_fg=height,
                height_shadow=height,
                sharpness_max=max(sharpest, sharpness_limit(height)),
            )
            return settings, cost, pilot.averaged(expected, height)
    height = min(heights[-1], TransportSettings.height_fg)
    broad = _broad(expected, height)
    cost = costs(broad, pilot.render(broad, 2), height)
    settings = TransportSettings(height_fg=height, height_shadow=height)
    return settings, cost, pilot.averaged(broad, height)


def _sharpness(light: Light) -> NDArray[np.float32]:
    return light.lobes.sharpness if light.lobes is not None else np.zeros(0, np.float32)


def _broad(light: Light, height: int) -> Light:
    """Leave out the lobes that `warpir.mis` adds at this height."""
    lobes = light.lobes
    if lobes is None:
        return light
    keep = lobes.sharpness <= sharpness_limit(height)
    if not keep.any():
        texels = light.texels if light.texels is not None else np.zeros((2, 4, 3), np.float32)
        return Light(texels=texels)
    return Light(
        Lobes(lobes.amplitude[keep], lobes.axis[keep], lobes.sharpness[keep]), light.texels
    )


def _difference(a: Float64Array, b: Float64Array) -> float:
    """RMSE between two pairs of runs, freed of the noise that each pair shows, over the RMS."""
    noise = 0.25 * (np.square(a[0] - a[1]) + np.square(b[0] - b[1])).mean()
    squared = np.square(a.mean(axis=0) - b.mean(axis=0)).mean() - noise
    size = np.square(a).mean()
    return float(np.sqrt(max(squared, 0.0) / size)) if size > 0.0 else 0.0


class _Pilot:
    """Renders of a few pixels by the reference and by trial rows."""

    def __init__(
        self,
        renderer: Renderer,
        objects: IntArray,
        proxies: IntArray,
        depth: int,
        seed: int,
        object_pixels: IntArray,
    ) -> None:
        self.renderer, self.depth, self.seed = renderer, depth, seed
        # Where the object may hide the plane, only part of a pixel is plane: left to the real run.
        self.objects, self.proxies = objects, np.setdiff1d(proxies, object_pixels)
        self.proxies = self.proxies.astype(np.int32)

    def averaged(self, light: Light, height: int) -> Light:
        """Return the light as a map of that height."""
        return Light(texels=to_texels(light, height, self.renderer.device))

    def render(self, light: Light, first: int) -> _Runs:
        """Return two runs of the tone-mapped object and two of what the shadow takes."""
        args = light_args(light, self.renderer.device)
        hidden = np.zeros(len(self.proxies), np.int32)
        seeds = (self.seed + first, self.seed + first + 1)
        objects = [
            self.renderer.foreground(args, self.objects, PILOT_SAMPLES, 1, self.depth, s).radiance
            for s in seeds
        ]
        ratios = [
            self.renderer.ratio(
                self.renderer.proxy(args, self.proxies, hidden, PILOT_SAMPLES, 1, s)
            )
            for s in seeds
        ]
        return _toned(np.stack(objects)), 1.0 - np.stack(ratios).astype(np.float64)

    def noise(self, settings: TransportSettings, light: Light) -> tuple[tuple[float, float], float]:
        """Return the relative RMSE of one seed for object and ratio, and entries per plane row."""
        assert light.texels is not None
        texels = LightTensors(texels=torch.from_numpy(light.texels))
        runs, entries = [], 0
        for k in range(2):
            trial = TransportIntegrator(
                self.renderer, self.objects, self.proxies, self.depth, settings, light, k
            )
            entries = trial.T_shadow.entry_count
            runs.append(trial.radiance(texels, texels, 0))
        objects = _toned(np.stack([r.foreground.numpy() for r in runs]))
        taken = np.stack([1.0 - (r.lit / r.unoccluded.clamp(min=1e-30)).numpy() for r in runs])
        noise = tuple(
            float(np.sqrt(0.5 * np.square(x[0] - x[1]).mean() / max(np.square(x).mean(), 1e-30)))
            if x.size
            else 0.0
            for x in (objects, taken.astype(np.float64))
        )
        return (noise[0], noise[1]), entries / max(len(self.proxies), 1)


def _toned(radiance: NDArray[np.float32]) -> Float64Array:
    """Compress radiance around its mean, as a photograph would; a firefly is then one pixel."""
    x = radiance.astype(np.float64)
    toned: Float64Array = x / (x + max(float(x.mean()), 1e-30))
    return toned
