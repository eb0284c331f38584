"""Pictures that the embedded networks learn from, with the light of each known exactly.

Three kinds: made-up streets, yards, tables and rooms; such scenes under a real panorama's light and
sky; and panorama crops. In the first two everything is rendered; in the third the photo is the
panorama itself, and only what is inserted is rendered, over its shadow on an assumed ground, as
warpir inserts objects. Everything of a batch is drawn and rendered on one device at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warpir.lighting.latlong_tensors import luminance, map_directions, shrunk, solid_angles, uv_of
from warpir.lighting.regression import ShadingLight, estimate_shading_light
from warpir.lighting.regressor import Regressor
from warpir.train.batches import PhotoBatch, PriorBatch
from warpir.train.lights import LightPool, make_lights
from warpir.train.photo_look import Look, draw_faults, draw_looks
from warpir.train.sampler import Sampler
from warpir.train.scenes.layout import (
    draw_crops,
    draw_grounds,
    draw_stands,
    draw_surfaces,
    draw_views,
    misjudged_rays,
)
from warpir.train.scenes.lighting import (
    Lighting,
    draw_directions,
    draw_wrong_lights,
    lighting_of,
    to_map,
)
from warpir.train.scenes.render import Scenes, Stock, render, sun_reaches
from warpir.train.scenes.solids import draw_solids

SIDE = 64
"""Side of a crop [px]."""
PHOTO_SIZE = (96, 144)
"""Height and width of a whole photo [px]."""
NEW_SKIES_EVERY = 40
"""Batches between two sets of made-up lights."""
SKY_COUNT = 2048
AMBIENT_HEIGHT = 8


@dataclass(frozen=True)
class Mixture:
    """Shares of what is drawn."""

    made_up: float = 0.4
    """Made-up scenes under made-up lights."""
    hybrid: float = 0.2
    """Made-up scenes under panoramas; the rest are panorama crops."""
    mismatched: float = 0.48
    """Of wrongly lit composites."""
    no_cue: float = 0.12
    """Of made-up scenes without anything that casts a shadow."""
    proxies: float = 0.25
    """Of panorama crops with solids put into them, lit rightly."""
    misjudged: float = 0.5
    """Of photos whose camera is known as an estimate knows it."""


@dataclass(frozen=True)
class Shot:
    """Photos of scenes without their objects, shape [B, 3, H, W] each."""

    look: Look
    radiance: Tensor
    plain: Tensor
    """Display values of a faultless camera."""
    photo: Tensor
    """With noise, blur and the rest."""
    whole_photo: Tensor
    """What it is a crop of, likewise, shape [B, 3, 96, 144]."""
    whole: Tensor
    """The same, squeezed to the crop's size."""
    estimate: ShadingLight | None
    """The regressor's estimate from the whole photo, or None without a regressor."""

    def next(self) -> Shot:
        """Return for each scene what belongs to the next one; looks and radiance stay."""
        estimate = self.estimate and ShadingLight(
            *(part.roll(-1, dims=0) for part in self.estimate)
        )
        return replace(
            self,
            photo=self.photo.roll(-1, dims=0),
            whole=self.whole.roll(-1, dims=0),
            estimate=estimate,
        )


class SceneGenerator:
    """Draws and renders batches; batch k is a function of the seed and k alone.

    Args:
        stock: Meshes and panoramas.
        seed: Of everything that is drawn.
        mixture: Shares of what is drawn.
        regressor: Reads the light off the photos of `prior_batch`, as it will for the prior's
            users; without one the G-buffer says nothing of the light.
    """

    def __init__(
        self,
        stock: Stock,
        seed: int,
        mixture: Mixture | None = None,
        regressor: Regressor | None = None,
    ) -> None:
        self.stock, self.seed, self.mixture = stock, seed, mixture or Mixture()
        self.regressor = regressor
        self._pool: tuple[int, LightPool] | None = None

    def _generator(self, *key: int) -> torch.Generator:
        generator = torch.Generator(device=self.stock.torch_device)
        state = np.random.SeedSequence((self.seed, *key)).generate_state(1, np.uint64)[0]
        return generator.manual_seed(int(state >> np.uint64(1)))

    def _lights(self, index: int) -> LightPool:
        epoch = index // NEW_SKIES_EVERY
        if self._pool is None or self._pool[0] != epoch:
            device = self.stock.torch_device
            skies = make_lights(SKY_COUNT, self._generator(1, epoch), device)
            pool = self.stock.panoramas.with_skies(skies)
            self._pool = epoch, pool
            self._levels = pool.levels()
            self._share = pool.flux_share()
        return self._pool[1]

    def prior_batch(self, index: int, count: int) -> PriorBatch:
        """Return composites and what they are made of.

        Args:
            index: Which batch.
            count: Pictures in it.
        """
        generator = self._generator(2, index)
        scenes = self._draw(index, count, generator, with_object=True)
        shot = self._shoot(scenes, generator)
        return self._inserted(scenes, shot)

    def relit(
        self,
        index: int,
        count: int,
        changes: Sequence[Callable[[Lighting], Lighting]],
        is_misled: bool = False,
    ) -> list[PriorBatch]:
        """Return the same scenes with the object under several lights.

        Args:
            index: Which batch.
            count: Scenes in it.
            changes: Each makes an object's light from the one that `prior_batch` has.
            is_misled: Give each scene the background, and what is read off it, of the next one.
        """
        generator = self._generator(2, index)
        scenes = self._draw(index, count, generator, with_object=True)
        shot = self._shoot(scenes, generator)
        told = shot.next() if is_misled else shot
        batches = []
        for change in changes:
            light = change(scenes.object_lighting)
            # The same random numbers for all, so that only the light differs.
            directions = draw_directions(light, self._levels[0], self._generator(4, index))
            tables = scenes.tables | {"object_light": directions}
            changed = replace(scenes, tables=tables, object_lighting=light)
            made = self._inserted(changed, shot)
            if is_misled:
                made = replace(self._inserted(changed, told), image=made.image)
            batches.append(made)
        return batches

    def light_of(self, index: int, count: int) -> Tensor:
        """Return the sun's share of the object's light in `prior_batch`, in [0, 1], shape [B]."""
        scenes = self._draw(index, count, self._generator(2, index), with_object=True)
        light = scenes.object_lighting
        rest = self._rest_map(light)
        flux = (luminance(rest) * solid_angles(rest)).sum(dim=(1, 2))
        return luminance(light.sun) / (luminance(light.sun) + flux).clamp(min=1e-20)

    def _shoot(self, scenes: Scenes, generator: torch.Generator) -> Shot:
        """Take the photos: exposed as a whole, seen through the crop's window."""
        whole = render(self.stock, scenes, scenes.photo_window, PHOTO_SIZE, 1, with_object=False)
        look = draw_looks(whole.background, generator)
        made = render(self.stock, scenes, scenes.crop_window, (SIDE, SIDE), 2, with_object=False)
        plain = look.show(made.background)
        photo = draw_faults(plain, generator)
        whole_photo = draw_faults(look.show(whole.background), generator)
        estimate = None
        if self.regressor is not None:
            is_cuda = whole_photo.device.type == "cuda"
            with torch.autocast("cuda", torch.bfloat16) if is_cuda else nullcontext():
                estimate = estimate_shading_light(
                    self.regressor, whole_photo, scenes.rays(PHOTO_SIZE)
                )
        small = torch.nn.functional.interpolate(
            whole_photo, (SIDE, SIDE), mode="bilinear", antialias=True
        )
        return Shot(look, made.background, plain, photo, whole_photo, small, estimate)

    def _inserted(self, scenes: Scenes, shot: Shot) -> PriorBatch:
        """Insert the objects into the photos."""
        made = render(self.stock, scenes, scenes.crop_window, (SIDE, SIDE), 2)
        # What the shadow does to the picture is applied to the photo with all its faults.
        shaded = shot.look.show(shot.radiance * made.ratio)
        factor = (shaded.clamp(min=1e-4) / shot.plain.clamp(min=1e-4)).clamp(max=1.0)
        covered = made.coverage
        part = shot.look.show(made.object / covered.clamp(min=1e-6))
        black = scenes.black[:, None, None, None]
        part = ((part + black) / (1.0 + black)).clamp(0.0, 1.0)
        image = covered * part + (1.0 - covered) * shot.photo * factor
        normal = made.normal / made.normal.norm(dim=1, keepdim=True).clamp(min=1e-6)
        albedo = (made.albedo / covered.clamp(min=1e-6)).clamp(0.0, 1.0) ** (1.0 / 2.2)
        is_covered = (covered > 0.0).float()
        light = self._light_planes(scenes, shot.estimate, albedo**2.2, normal) * torch.cat(
            [is_covered.expand(-1, 3, -1, -1), torch.ones_like(normal)], dim=1
        )
        gbuffer = torch.cat([covered, albedo * is_covered, normal * is_covered, light], dim=1)
        words = scenes.noun, scenes.setting, scenes.weather, scenes.kind
        background = torch.cat([shot.photo, shot.whole], dim=1)
        return PriorBatch(image.clamp(0.0, 1.0), background, gbuffer, *words)

    def _light_planes(
        self, scenes: Scenes, estimate: ShadingLight | None, albedo: Tensor, normal: Tensor
    ) -> Tensor:
        """Return the objects as the regressor's light shows them; see `Regression.matte_picture`.

        Args:
            scenes: Their cameras.
            estimate: The light, or None if it is unknown.
            albedo: Linear, shape [B, 3, H, W].
            normal: Camera frame, same shape.
        """
        if estimate is None:
            return torch.zeros_like(torch.cat([normal, normal], dim=1))
        axes = torch.stack([scenes.right, scenes.up, scenes.back], dim=1)
        n = torch.einsum("bchw,bcd->bdhw", normal, axes)
        # Lat-long coordinates in [-1, 1] for grid_sample; a column beyond each side wraps.
        u, v = (2.0 * part - 1.0 for part in uv_of(n.movedim(1, -1)))
        maps = estimate.irradiance.permute(0, 3, 1, 2)
        maps = torch.cat([maps[..., -1:], maps, maps[..., :1]], dim=-1)
        grid = torch.stack([u * (32.0 / 34.0), v], dim=-1)
        irradiance = torch.nn.functional.grid_sample(
            maps, grid, padding_mode="border", align_corners=False
        )
        shown = (albedo * irradiance / np.pi).clamp(0.0, 1.0) ** (1.0 / 2.2)
        toward = torch.einsum("bd,bcd->bc", estimate.toward, axes)
        return torch.cat([shown, toward[:, :, None, None].expand_as(normal)], dim=1)

    def photo_batch(self, index: int, count: int) -> PhotoBatch:
        """Return whole photos and their light; arguments are those of `prior_batch`."""
        generator = self._generator(3, index)
        scenes = self._draw(index, count, generator, with_object=False)
        made = render(self.stock, scenes, scenes.photo_window, PHOTO_SIZE, 2, with_object=False)
        look = draw_looks(made.background, generator)
        photo = draw_faults(look.show(made.background), generator)
        light, rays = scenes.lighting, scenes.rays(PHOTO_SIZE)
        ambient = self._rest_map(light) * look.gain[:, None, None]
        sun = light.sun * look.gain
        rest = (luminance(ambient) * solid_angles(ambient)).sum(dim=(1, 2))
        share = luminance(sun) / (luminance(sun) + rest).clamp(min=1e-20)
        toward = torch.einsum("bchw,bc->bhw", rays, light.axis).flatten(1).max(dim=1).values
        in_view = toward > float(np.cos(np.radians(3.0)))
        shows_solid = made.solid.mean(dim=(1, 2, 3)) > 0.015
        has_cue = (share > 0.15) & (scenes.is_panorama | in_view | shows_solid)
        draw = Sampler(count, generator)
        axes = scenes.right, scenes.up, scenes.back
        is_misjudged = draw.chance(self.mixture.misjudged)[:, None, None, None]
        wrong = misjudged_rays(draw, scenes.photo_window, PHOTO_SIZE, axes)
        rays = torch.where(is_misjudged, wrong, rays)
        return PhotoBatch(
            photo, rays, light.axis, share, sun, light.sigma,
            ambient, has_cue,
        )  # fmt: skip

    def _rest_map(self, light: Lighting) -> Tensor:
        """Return what is not sun in the world's frame, shape [B, 8, 16, 3]."""
        fine = self._levels[0]
        height, width = fine.shape[1:3]
        directions = map_directions(height, width, fine.device)
        d = to_map(light, directions.reshape(1, -1, 3).expand(len(light.map), -1, -1))
        u, v = uv_of(d)
        column = (u * width).long() % width
        row = (v * height).long().clamp(0, height - 1)
        texels = fine[light.map.long()[:, None], row, column].view(-1, height, width, 3)
        return shrunk(texels, AMBIENT_HEIGHT) * light.gain[:, None, None]

    def _draw(
        self, index: int, count: int, generator: torch.Generator, with_object: bool
    ) -> Scenes:
        """Draw all of a batch but its cameras' looks."""
        pool, stock = self._lights(index), self.stock
        draw = Sampler(count, generator)
        light, made_up, is_panorama = self._draw_light(draw, pool)
        lights, panoramas = light.map.long(), pool.panorama_count
        indoors = pool.indoors[lights]
        place_kind = draw.index(3)
        place_kind = torch.where(indoors == 1, torch.where(draw.chance(0.4), 2, 3), place_kind)
        views = draw_views(draw, place_kind)
        stands = draw_stands(draw, views, stock.spheres)
        crop_window = draw_crops(draw, views, stands)
        solids = draw_solids(
            draw, place_kind, is_panorama, stands.place, stands.scale, views.height,
            panoramas, self.mixture.proxies, self.mixture.no_cue,
        )  # fmt: skip
        seen = torch.where(made_up, -1, lights)
        ground = draw_grounds(draw, is_panorama, seen, views.height, panoramas)
        rest = (luminance(self._levels[0][lights]) * solid_angles(self._levels[0])).sum(dim=(1, 2))
        kind, object_light, black = draw_wrong_lights(
            light, rest, self._share[lights] < 0.12, self.mixture.mismatched, generator
        )
        if with_object:
            # In the shadow of a solid no sun reaches the object, whatever light it is judged by.
            visible = sun_reaches(stock, solids, stands.middle, light.axis)
            object_light = replace(object_light, sun=object_light.sun * visible[:, None])
        zero = torch.zeros_like(object_light.sigma)
        soft = torch.where(draw.chance(0.5), torch.deg2rad(draw.uniform(0.0, 4.0)), zero)
        object_light = replace(object_light, sigma=torch.maximum(object_light.sigma, soft))
        objects = stock.objects(stands, with_object) | draw_surfaces(draw)
        fine, middle, coarse = self._levels
        axes = {"right": views.right, "up": views.up, "back": views.back}
        tables: dict[str, Any] = {
            "views": {"origin": views.origin, **axes},
            "maps": {"fine": fine, "middle": middle, "coarse": coarse, "seen": pool.seen},
            "solids": solids,
            "ground": ground,
            "objects": objects,
            "blur_min": torch.where(draw.chance(0.5), draw.uniform(0.5, 2.0), zero),
            "light": draw_directions(light, fine, generator),
            "object_light": draw_directions(object_light, fine, generator),
        }
        return Scenes(
            tables=tables,
            lighting=light,
            object_lighting=object_light,
            **axes,
            photo_window=views.window,
            crop_window=crop_window,
            is_panorama=is_panorama,
            kind=kind,
            black=black,
            noun=stock.nouns[stands.mesh],
            setting=torch.where(indoors >= 0, indoors, -1),
            weather=pool.weather[lights],
        )

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
