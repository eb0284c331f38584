"""Photographs that the regressor learns from, with the light of each known exactly.

Three kinds: made-up streets, yards, tables and rooms; such scenes under a real panorama's light and
sky; and panorama crops. In the first two everything is rendered; in the third the photo is the
panorama itself, now and then with solids put into it. Everything of a batch is drawn and rendered
on one device at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warpir.lighting.latlong_tensors import luminance, map_directions, shrunk, solid_angles, uv_of
from warpir.train.batches import PhotoBatch
from warpir.train.lights import LightPool, make_lights
from warpir.train.photo_look import draw_faults, draw_looks
from warpir.train.sampler import Sampler
from warpir.train.scenes.layout import draw_grounds, draw_stands, draw_views, misjudged
from warpir.train.scenes.lighting import Lighting, draw_directions, lighting_of, to_map
from warpir.train.scenes.render import Scenes, render
from warpir.train.scenes.solids import draw_solids

PHOTO_SIZE = (96, 144)
"""Height and width of a photo [px]."""
NEW_SKIES_EVERY = 40
"""Batches between two sets of made-up lights."""
SKY_COUNT = 2048
AMBIENT_HEIGHT = 8


@dataclass(frozen=True)
class Mixture:
    """Shares of what is drawn."""

    made_up: float = 0.15
    """Made-up scenes under made-up lights."""
    hybrid: float = 0.35
    """Made-up scenes under panoramas; the rest are panorama crops."""
    no_cue: float = 0.12
    """Of made-up scenes without anything that casts a shadow."""
    proxies: float = 0.25
    """Of panorama crops with solids put into them, lit rightly."""
    misjudged: float = 0.5
    """Of photos whose camera is known as an estimate knows it."""


class SceneGenerator:
    """Draws and renders batches; batch k is a function of the seed and k alone.

    Panoramas, of `warpir.train.lights.load_panoramas`, may be none; their device is used. The
    mixture has the shares of what is drawn.
    """

    def __init__(self, panoramas: LightPool, seed: int, mixture: Mixture | None = None) -> None:
        self.panoramas, self.seed, self.mixture = panoramas, seed, mixture or Mixture()
        self.device = panoramas.fine.device
        self._pool: tuple[int, LightPool] | None = None
        self._newest: int | None = None

    def _generator(self, *key: int) -> torch.Generator:
        generator = torch.Generator(device=self.device)
        state = np.random.SeedSequence((self.seed, *key)).generate_state(1, np.uint64)[0]
        return generator.manual_seed(int(state >> np.uint64(1)))

    def _lights(self, index: int) -> LightPool:
        epoch = index // NEW_SKIES_EVERY
        if self._pool is None or self._pool[0] != epoch:
            skies = make_lights(SKY_COUNT, self._generator(1, epoch), self.device)
            pool = self.panoramas.with_skies(skies)
            self._pool = epoch, pool
            self._share = pool.flux_share()
        return self._pool[1]

    def next_batch(self, count: int, generator: torch.Generator) -> PhotoBatch:
        """Return new photos; the generator draws once at which batch they begin."""
        if self._newest is None:
            drawn = torch.randint(2**30, (), generator=generator, device=generator.device)
            self._newest = int(drawn)
        self._newest += 1
        return self.photo_batch(self._newest, count)

    def photo_batch(self, index: int, count: int) -> PhotoBatch:
        """Return photos and their light."""
        generator = self._generator(3, index)
        scenes = self._draw(index, count, generator)
        made = render(scenes, PHOTO_SIZE)
        look = draw_looks(made.radiance, generator)
        photo = draw_faults(look.show(made.radiance), generator)
        light, rays = scenes.lighting, scenes.views.rays(PHOTO_SIZE)
        ambient = self._rest_map(light) * look.gain[:, None, None]
        sun = light.sun * look.gain
        rest = (luminance(ambient) * solid_angles(ambient)).sum(dim=(1, 2))
        share = luminance(sun) / (luminance(sun) + rest).clamp(min=1e-20)
        toward = torch.einsum("bchw,bc->bhw", rays, light.axis).flatten(1).max(dim=1).values
        in_view = toward > float(np.cos(np.radians(3.0)))
        shows_solid = made.solid.mean(dim=(1, 2)) > 0.015
        has_cue = (share > 0.15) & (scenes.is_panorama | in_view | shows_solid)
        draw = Sampler(count, generator)
        is_misjudged = draw.chance(self.mixture.misjudged)[:, None, None, None]
        rays = torch.where(is_misjudged, misjudged(draw, scenes.views).rays(PHOTO_SIZE), rays)
        return PhotoBatch(
            photo, rays, light.axis, share, sun, light.sigma,
            ambient, has_cue,
        )  # fmt: skip

    def _rest_map(self, light: Lighting) -> Tensor:
        """Return what is not sun in the world's frame, shape [B, 8, 16, 3]."""
        assert self._pool is not None
        fine = self._pool[1].fine
        height, width = fine.shape[1:3]
        directions = map_directions(height, width, fine.device)
        d = to_map(light, directions.reshape(1, -1, 3).expand(len(light.map), -1, -1))
        u, v = uv_of(d)
        column = (u * width).long() % width
        row = (v * height).long().clamp(0, height - 1)
        texels = fine[light.map.long()[:, None], row, column].view(-1, height, width, 3)
        return shrunk(texels, AMBIENT_HEIGHT) * light.gain[:, None, None]

    def _draw(self, index: int, count: int, generator: torch.Generator) -> Scenes:
        """Draw all of a batch but its cameras' looks."""
        pool = self._lights(index)
        draw = Sampler(count, generator)
        light, made_up, is_panorama = self._draw_light(draw, pool)
        lights, panoramas = light.map.long(), pool.panorama_count
        indoors = pool.indoors[lights]
        place_kind = draw.index(3)
        place_kind = torch.where(indoors == 1, torch.where(draw.chance(0.4), 2, 3), place_kind)
        views = draw_views(draw, place_kind)
        place, scale = draw_stands(draw, views)
        solids = draw_solids(
            draw, place_kind, is_panorama, place, scale, views.height,
            panoramas, self.mixture.proxies, self.mixture.no_cue,
        )  # fmt: skip
        seen = torch.where(made_up, -1, lights)
        ground = draw_grounds(draw, is_panorama, seen, views.height, panoramas)
        tables: dict[str, Any] = {
            "views": vars(views) | {"window": views.window},
            "maps": {"light": pool.fine, "seen": pool.seen},
            "solids": solids,
            "ground": ground,
            "light": draw_directions(light, pool.fine, generator),
        }
        return Scenes(tables, light, views, is_panorama)

    def _draw_light(self, draw: Sampler, pool: LightPool) -> tuple[Lighting, Tensor, Tensor]:
        """Draw each scene's light; also whether it is made up, and whether a panorama crop."""
        mixture, panoramas = self.mixture, pool.panorama_count
        drawn = draw.unit()
        made_up = drawn < mixture.made_up if panoramas else torch.ones_like(drawn, dtype=torch.bool)
        is_panorama = (drawn >= mixture.made_up + mixture.hybrid) & ~made_up
        first = torch.where(made_up, panoramas, 0)
        last = torch.where(made_up, pool.count, panoramas)
        # Panoramas of nothing but sky have no ground to photograph: they come last.
        last = torch.where(is_panorama & (pool.grounded_count > 0), pool.grounded_count, last)
        index, second = (
            (first + (draw.unit() * (last - first)).long()).clamp(max=pool.count - 1)
            for _ in range(2)
        )
        # Few panoramas have a sun: made-up scenes and a third of the crops have the sunnier of two.
        is_sunnier = (self._share[second] > self._share[index]) & ~made_up
        is_sunnier &= ~is_panorama | draw.chance(1.0 / 3.0)
        index = torch.where(is_sunnier, second, index)
        light = lighting_of(pool, index, draw.uniform(0.0, 2.0 * np.pi), draw.chance(0.5))
        return light, made_up, is_panorama
