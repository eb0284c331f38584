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
import warp as wp
from torch import Tensor

from warpir.diffusion.models.embedded import KINDS, NOUNS
from warpir.kernels import training_scene as kernel
from warpir.lighting.latlong_tensors import luminance, map_directions, shrunk, solid_angles, uv_of
from warpir.lighting.regressor import Hint, Regressor, hints
from warpir.train.batches import PhotoBatch, PriorBatch
from warpir.train.lights import LightPool, make_lights
from warpir.train.meshes import TrainingMesh
from warpir.train.photo_look import Look, draw_faults, draw_looks

SIDE = 64
"""Side of a crop [px]."""
PHOTO_SIZE = (96, 144)
"""Height and width of a whole photo [px]."""
SOLIDS = 14
"""Of a scene: two walls or houses, six small ones, two trees of two, and two far away."""
DIRECTIONS, SUN_DIRECTIONS = 96, 16
"""Directions that stand for a light, shared by a pixel's four points."""
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


@dataclass
class Lighting:
    """Lights of a batch, one per scene, world frame (that is the camera-yaw frame)."""

    map: Tensor
    yaw: Tensor
    mirror: Tensor
    gain: Tensor
    axis: Tensor
    sun: Tensor
    """Gain included."""
    sigma: Tensor

    def turned(self, angle: Tensor) -> Lighting:
        """Return the lights turned about +Y [rad]."""
        # World directions w become turn(w, angle); the map's frame stays: yaw' o turn = yaw.
        return replace(self, yaw=self.yaw - self.mirror * angle, axis=about_y(self.axis, angle))

    def chosen(self, other: Lighting, use_other: Tensor) -> Lighting:
        """Return these lights, or the others where asked for, bool [B]."""

        def pick(a: Tensor, b: Tensor) -> Tensor:
            return torch.where(use_other.view(-1, *[1] * (a.ndim - 1)), b, a)

        return Lighting(**{k: pick(v, getattr(other, k)) for k, v in vars(self).items()})


def about_y(v: Tensor, angle: Tensor) -> Tensor:
    """Turn vectors [B, ..., 3] about +Y by angles [B]; the kernel's ``turned``."""
    shape = (-1, *[1] * (v.ndim - 2))
    c, s = angle.cos().view(shape), angle.sin().view(shape)
    x, y, z = v.unbind(-1)
    return torch.stack([c * x + s * z, y, c * z - s * x], dim=-1)


def to_world(lighting: Lighting, in_map: Tensor) -> Tensor:
    """Turn directions of the lights' maps [B, D, 3] into the world."""
    turned = about_y(in_map, -lighting.yaw)
    flip = torch.ones_like(turned)
    flip[..., 0] = lighting.mirror[:, None]
    return turned * flip


def to_map(lighting: Lighting, directions: Tensor) -> Tensor:
    """Turn world directions [B, D, 3] into the frame of the lights' maps."""
    flip = torch.ones_like(directions)
    flip[..., 0] = lighting.mirror[:, None]
    return about_y(directions * flip, lighting.yaw)


def rays_of(scenes: Scenes) -> Tensor:
    """Return the photos' unit viewing directions, camera-yaw frame, shape [B, 3, 96, 144]."""
    window = scenes.photo_window
    height, width = PHOTO_SIZE
    across = (torch.arange(width, device=window.device) + 0.5) / width
    down = (torch.arange(height, device=window.device) + 0.5) / height
    u = (window[:, 0:1] + across * window[:, 2:3])[:, None, :, None]
    v = (window[:, 1:2] + down * window[:, 3:4])[:, :, None, None]
    right, up, back = (x[:, None, None] for x in (scenes.right, scenes.up, scenes.back))
    rays = torch.nn.functional.normalize(right * u - up * v - back, dim=-1)
    return rays.permute(0, 3, 1, 2).contiguous()


def packed_solids(solids: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a table of solids with those that are there in front, and their count."""
    order = torch.argsort((solids["kind"] < 0).int(), dim=1, stable=True)

    def moved(part: Tensor) -> Tensor:
        places = order.view(*order.shape, *[1] * (part.ndim - 2))
        return part.gather(1, places.expand(-1, -1, *part.shape[2:])).contiguous()

    count = (solids["kind"] >= 0).sum(dim=1).int()
    return {name: moved(part) for name, part in solids.items()} | {"count": count}


class Stock:
    """Meshes and lights on one device, shared by all generators.

    Args:
        meshes: Objects to insert.
        panoramas: From `warpir.train.lights.load_panoramas`; may be none.
        device: Warp device; torch uses the same.
    """

    def __init__(self, meshes: Sequence[TrainingMesh], panoramas: LightPool, device: str) -> None:
        self.device, self.panoramas = wp.get_device(device), panoramas
        self.torch_device = panoramas.fine.device
        self.meshes = [
            wp.Mesh(
                wp.array(m.vertices, dtype=wp.vec3, device=device),
                wp.array(m.faces.ravel(), dtype=wp.int32, device=device),
            )
            for m in meshes
        ]

        def tensor(values: Any, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=dtype, device=self.torch_device)

        self.ids = torch.tensor([m.id for m in self.meshes], dtype=torch.int64).to(
            self.torch_device
        )
        counts = np.array([len(m.faces) for m in meshes])
        self.first_face = tensor(np.cumsum(counts) - counts, torch.int32)
        self.normals = tensor(np.concatenate([m.normals.reshape(-1, 3) for m in meshes]))
        self.albedos = tensor(np.concatenate([m.albedo for m in meshes]))
        spheres = []
        for m in meshes:
            middle = 0.5 * (m.vertices.min(axis=0) + m.vertices.max(axis=0))
            radius = float(np.linalg.norm(m.vertices - middle, axis=1).max())
            spheres.append([*middle, 1.001 * radius])
        self.spheres = tensor(spheres)
        self.nouns = tensor(
            [NOUNS.index(m.noun) if m.noun in NOUNS else 0 for m in meshes], torch.int64
        )


@dataclass
class Scenes:
    """What a batch of scenes is made of; all tensors, one row per scene."""

    tables: dict[str, Any]
    """Arguments of the kernel."""
    lighting: Lighting
    object_lighting: Lighting
    right: Tensor
    up: Tensor
    back: Tensor
    photo_window: Tensor
    crop_window: Tensor
    is_panorama: Tensor
    """Bool: the photo is a panorama crop."""
    kind: Tensor
    noun: Tensor
    setting: Tensor
    weather: Tensor


@dataclass(frozen=True)
class Rendered:
    """Planes of a batch, shape [B, C, H, W]; see the kernel's ``Pixels``."""

    background: Tensor
    object: Tensor
    coverage: Tensor
    albedo: Tensor
    normal: Tensor
    ratio: Tensor
    solid: Tensor


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
    hint: Hint | None
    """What the regressor reads off the whole photo."""

    def next(self) -> Shot:
        """Return for each scene what belongs to the next one; looks and radiance stay."""
        hint = self.hint and Hint(*(part.roll(-1, dims=0) for part in self.hint))
        return replace(
            self, photo=self.photo.roll(-1, dims=0), whole=self.whole.roll(-1, dims=0), hint=hint
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
            directions = self._directions(light, self._generator(4, index))
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
        whole = self._render(scenes, scenes.photo_window, PHOTO_SIZE, 1, with_object=False)
        look = draw_looks(whole.background, generator)
        made = self._render(scenes, scenes.crop_window, (SIDE, SIDE), 2, with_object=False)
        plain = look.show(made.background)
        photo = draw_faults(plain, generator)
        whole_photo = draw_faults(look.show(whole.background), generator)
        hint = None
        if self.regressor is not None:
            is_cuda = whole_photo.device.type == "cuda"
            with torch.autocast("cuda", torch.bfloat16) if is_cuda else nullcontext():
                hint = hints(self.regressor, whole_photo, rays_of(scenes))
        small = torch.nn.functional.interpolate(
            whole_photo, (SIDE, SIDE), mode="bilinear", antialias=True
        )
        return Shot(look, made.background, plain, photo, whole_photo, small, hint)

    def _inserted(self, scenes: Scenes, shot: Shot) -> PriorBatch:
        """Insert the objects into the photos."""
        made = self._render(scenes, scenes.crop_window, (SIDE, SIDE), 2)
        # What the shadow does to the picture is applied to the photo with all its faults.
        shaded = shot.look.show(shot.radiance * made.ratio)
        factor = (shaded.clamp(min=1e-4) / shot.plain.clamp(min=1e-4)).clamp(max=1.0)
        covered = made.coverage
        part = shot.look.show(made.object / covered.clamp(min=1e-6))
        image = covered * part + (1.0 - covered) * shot.photo * factor
        normal = made.normal / made.normal.norm(dim=1, keepdim=True).clamp(min=1e-6)
        albedo = (made.albedo / covered.clamp(min=1e-6)).clamp(0.0, 1.0) ** (1.0 / 2.2)
        is_covered = (covered > 0.0).float()
        light = self._light_planes(scenes, shot.hint, albedo**2.2, normal) * torch.cat(
            [is_covered.expand(-1, 3, -1, -1), torch.ones_like(normal)], dim=1
        )
        gbuffer = torch.cat([covered, albedo * is_covered, normal * is_covered, light], dim=1)
        words = scenes.noun, scenes.setting, scenes.weather, scenes.kind
        background = torch.cat([shot.photo, shot.whole], dim=1)
        return PriorBatch(image.clamp(0.0, 1.0), background, gbuffer, *words)

    def _light_planes(
        self, scenes: Scenes, hint: Hint | None, albedo: Tensor, normal: Tensor
    ) -> Tensor:
        """Return what the regressor makes of the objects; see `Regression.hint`.

        Args:
            scenes: Their cameras.
            hint: The light, or None: nothing is known of it.
            albedo: Linear, shape [B, 3, H, W].
            normal: Camera frame, same shape.
        """
        if hint is None:
            return torch.zeros_like(torch.cat([normal, normal], dim=1))
        axes = torch.stack([scenes.right, scenes.up, scenes.back], dim=1)
        n = torch.einsum("bchw,bcd->bdhw", normal, axes)
        # Lat-long coordinates in [-1, 1] for grid_sample; a column beyond each side wraps.
        u, v = (2.0 * part - 1.0 for part in uv_of(n.movedim(1, -1)))
        maps = hint.irradiance.permute(0, 3, 1, 2)
        maps = torch.cat([maps[..., -1:], maps, maps[..., :1]], dim=-1)
        grid = torch.stack([u * (32.0 / 34.0), v], dim=-1)
        irradiance = torch.nn.functional.grid_sample(
            maps, grid, padding_mode="border", align_corners=False
        )
        shown = (albedo * irradiance / np.pi).clamp(0.0, 1.0) ** (1.0 / 2.2)
        toward = torch.einsum("bd,bcd->bc", hint.toward, axes)
        return torch.cat([shown, toward[:, :, None, None].expand_as(normal)], dim=1)

    def photo_batch(self, index: int, count: int) -> PhotoBatch:
        """Return whole photos and their light; arguments are those of `prior_batch`."""
        generator = self._generator(3, index)
        scenes = self._draw(index, count, generator, with_object=False)
        made = self._render(scenes, scenes.photo_window, PHOTO_SIZE, 2, with_object=False)
        look = draw_looks(made.background, generator)
        photo = draw_faults(look.show(made.background), generator)
        light, rays = scenes.lighting, rays_of(scenes)
        ambient = self._rest_map(light) * look.gain[:, None, None]
        sun = light.sun * look.gain
        omega = solid_angles(ambient)
        rest = (luminance(ambient) * omega).sum(dim=(1, 2))
        share = luminance(sun) / (luminance(sun) + rest).clamp(min=1e-20)
        toward = torch.einsum("bchw,bc->bhw", rays, light.axis).flatten(1).max(dim=1).values
        in_view = toward > float(np.cos(np.radians(3.0)))
        shows_solid = made.solid.mean(dim=(1, 2, 3)) > 0.015
        has_cue = (share > 0.15) & (scenes.is_panorama | in_view | shows_solid)
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

    def _directions(self, light: Lighting, generator: torch.Generator) -> dict[str, Tensor]:
        """Return directions that stand for the lights, and the flux of each.

        Half of them follow the luminance, half the solid angle; drawn systematically over the
        texels, so every fourth one of them covers the whole sphere too.
        """
        fine = self._levels[0][light.map.long()]
        count, height, width, _ = fine.shape
        omega = solid_angles(fine)
        power = luminance(fine) * omega
        p = 0.5 * power / power.sum(dim=(1, 2), keepdim=True).clamp(min=1e-20)
        p = (p + 0.5 * omega / (4.0 * np.pi)).flatten(1)
        p = p / p.sum(dim=1, keepdim=True)
        device = fine.device

        def rand(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=device)

        steps = (torch.arange(DIRECTIONS, device=device) + rand(count, 1)) / DIRECTIONS
        index = torch.searchsorted(p.cumsum(dim=1), steps).clamp(max=height * width - 1)
        row, column = index // width, index % width
        u = (column + rand(count, DIRECTIONS)) / width
        v = (row + rand(count, DIRECTIONS)) / height
        lon, theta = np.pi * (1.0 - 2.0 * u), np.pi * v
        s = theta.sin()
        in_map = torch.stack([lon.sin() * s, theta.cos(), lon.cos() * s], dim=-1)
        texel = fine.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 3))
        share = (omega.expand(height, width).reshape(1, -1).expand(count, -1)).gather(1, index)
        share = share / (p.gather(1, index) * DIRECTIONS)
        flux = texel * share[..., None] * light.gain[:, None]
        # The sun's disc: a Gaussian, by a spiral that is turned at random.
        k = torch.arange(SUN_DIRECTIONS, device=device) + 0.5
        radius = torch.sqrt(-2.0 * torch.log1p(-k / SUN_DIRECTIONS * 0.98))
        angle = k * (np.pi * (3.0 - np.sqrt(5.0))) + 2.0 * np.pi * rand(count, 1)
        helper = torch.zeros_like(light.axis)
        helper[:, 0] = 1.0
        helper[light.axis[:, 0].abs() > 0.8] = torch.tensor([0.0, 0.0, 1.0], device=device)
        x = torch.nn.functional.normalize(torch.linalg.cross(helper, light.axis), dim=1)
        y = torch.linalg.cross(light.axis, x)
        r = (light.sigma[:, None] * radius)[..., None]
        sun = light.axis[:, None] + r * (
            angle.cos()[..., None] * x[:, None] + angle.sin()[..., None] * y[:, None]
        )
        return {
            "direction": to_world(light, in_map).contiguous(),
            "flux": flux.contiguous(),
            "sun_direction": torch.nn.functional.normalize(sun, dim=-1).contiguous(),
        }

    def _draw(
        self, index: int, count: int, generator: torch.Generator, with_object: bool
    ) -> Scenes:
        """Draw all of a batch but its cameras' looks."""
        pool, stock, mixture = self._lights(index), self.stock, self.mixture
        device = stock.torch_device

        def rand(*shape: int) -> Tensor:
            return torch.rand(count, *shape, generator=generator, device=device)

        def u(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * rand(*shape)

        def log_u(low: float, high: float, *shape: int) -> Tensor:
            return torch.exp(u(float(np.log(low)), float(np.log(high)), *shape))

        def pick(chance: float) -> Tensor:
            return rand() < chance

        # Which kind of scene, and its light.
        draw = rand()
        panoramas = pool.panorama_count
        made_up = draw < mixture.made_up if panoramas else torch.ones_like(draw, dtype=torch.bool)
        is_panorama = (draw >= mixture.made_up + mixture.hybrid) & ~made_up
        first = torch.where(made_up, panoramas, 0)
        last = torch.where(made_up, pool.count, panoramas)
        # Panoramas of nothing but sky have no ground to photograph: they come last.
        last = torch.where(is_panorama & (pool.grounded_count > 0), pool.grounded_count, last)
        map_index, second = (
            (first + (rand() * (last - first)).long()).clamp(max=pool.count - 1) for _ in range(2)
        )
        # Few panoramas have a sun: made-up scenes are lit by the sunnier of two.
        is_sunnier = self._share[second] > self._share[map_index]
        map_index = torch.where(~made_up & ~is_panorama & is_sunnier, second, map_index)
        light = self._light_of(pool, map_index, u(0.0, 2.0 * np.pi), pick(0.5))
        # Scene types: 0 street, 1 yard, 2 table, 3 room.
        place_kind = (rand() * 3.0).long()
        indoors = pool.indoors[map_index]
        place_kind = torch.where(indoors == 1, torch.where(pick(0.4), 2, 3), place_kind)
        # Cameras.
        fov = torch.deg2rad(u(32.0, 74.0))
        half_height = torch.tan(fov / 2.0)
        aspects = torch.tensor([1.5, 1.5, 1.5, 1.5, 1.333, 1.333, 1.778, 1.0, 0.75], device=device)
        half_width = half_height * aspects[(rand() * len(aspects)).long()]
        half_width = half_width.clamp(max=1.6)
        steepest = torch.atan(half_height * 0.7)
        tilt = torch.deg2rad(-5.0 + 9.0 * torch.randn(count, generator=generator, device=device))
        tilt = torch.minimum(tilt.clamp(min=-0.6), steepest)
        heights = torch.tensor([[1.2, 2.0], [1.1, 1.9], [0.25, 0.7], [1.0, 1.7]], device=device)
        low, high = heights[place_kind].T
        camera_height = low + (high - low) * rand()
        zero, one = torch.zeros(count, device=device), torch.ones(count, device=device)
        right = torch.stack([one, zero, zero], dim=1)
        up = torch.stack([zero, tilt.cos(), tilt.sin()], dim=1)
        back = torch.stack([zero, -tilt.sin(), tilt.cos()], dim=1)
        origin = torch.stack([zero, camera_height, zero], dim=1)
        photo_window = torch.stack(
            [-half_width, -half_height, 2.0 * half_width, 2.0 * half_height], dim=1
        )
        # Where the object stands: a pixel below the horizon.
        a = u(-0.65, 0.65) * half_width
        horizon = torch.tan(tilt)
        top = torch.maximum(horizon + 0.12 * half_height, -0.1 * half_height)
        b = top + rand() * (0.95 * half_height - top).clamp(min=0.02)
        d = right * a[:, None] - up * b[:, None] - back
        place = origin + d * (-camera_height / d[:, 1].clamp(max=-0.03))[:, None]
        depth = -((place - origin) * back).sum(dim=1)
        scale = log_u(0.14, 0.55) * 2.0 * half_height * depth
        mesh = (rand() * len(stock.ids)).long()
        sphere = stock.spheres[mesh]
        yaw = u(0.0, 2.0 * np.pi)
        # The crop, as the optimiser draws it.
        middle = place + about_y(sphere[:, :3], yaw) * scale[:, None]
        middle_depth = -((middle - origin) * back).sum(dim=1)
        cu = ((middle - origin) * right).sum(dim=1) / middle_depth
        cv = -((middle - origin) * up).sum(dim=1) / middle_depth
        half_box = 0.8 * sphere[:, 3] * scale / middle_depth
        shorter = 2.0 * torch.minimum(half_width, half_height)
        side = torch.minimum(log_u(1.2, 4.0) * 2.0 * half_box, shorter)
        left = cu + u(-1.0, 1.0) * half_box - side / 2.0
        upper = cv + u(-1.0, 1.0) * half_box - side / 2.0
        left = torch.minimum(torch.maximum(left, -half_width), half_width - side)
        upper = torch.minimum(torch.maximum(upper, -half_height), half_height - side)
        crop_window = torch.stack([left, upper, side, side], dim=1)
        solids = self._solids(generator, place_kind, is_panorama, place, scale, camera_height)

        # Grounds.
        def colour(low: float, high: float) -> Tensor:
            tint = 1.0 + u(-0.35, 0.35, 3) * u(0.0, 1.0, 1)
            return (log_u(low, high)[:, None] * tint).clamp(0.02, 0.9)

        albedo = colour(0.06, 0.55)
        second = (albedo * torch.exp(u(-0.7, 0.7, 1) + u(-0.15, 0.15, 3))).clamp(0.02, 0.9)
        ground = {
            "is_seen": (~is_panorama).int(),
            "seen": torch.where(made_up, -1, map_index).int(),
            "albedo": albedo,
            "second": torch.where(pick(0.25)[:, None], albedo, second),
            "pattern": torch.where(
                pick(0.5) if panoramas else zero.bool(), 4, (rand() * 4.0).long()
            ).int(),
            "texture": (rand() * max(panoramas, 1)).int(),
            "size": camera_height * log_u(0.08, 1.5),
            "turn": u(0.0, np.pi),
            "roughen": u(0.0, 0.4),
            "wetness": torch.where(pick(0.15), u(0.2, 1.0), zero),
        }
        kind, object_light = self._wrong(light, pool, generator)
        if with_object:
            # In the shadow of a solid no sun reaches the object, whatever light it is judged by.
            visible = self._sun_reaches(solids, middle, light.axis)
            object_light = replace(object_light, sun=object_light.sun * visible[:, None])
        soft = torch.where(pick(0.5), torch.deg2rad(u(0.0, 4.0)), zero)
        object_light = replace(object_light, sigma=torch.maximum(object_light.sigma, soft))
        objects = {
            "mesh": stock.ids[mesh],
            "place": place,
            "yaw": yaw,
            "scale": scale,
            "sphere": sphere,
            "first_face": stock.first_face[mesh],
            "normals": stock.normals,
            "albedos": stock.albedos,
            "tint": colour(0.03, 0.85),
            "recolour": torch.where(pick(0.45), u(0.4, 1.0), zero),
            "pattern": torch.where(pick(0.2), u(0.2, 0.8), zero),
            "roughness": torch.where(pick(0.6), u(0.5, 1.0), u(0.12, 0.6)),
            "metallic": torch.where(pick(0.15), u(0.3, 1.0), zero),
        }
        tables: dict[str, Any] = {
            "views": {"origin": origin, "right": right, "up": up, "back": back},
            "solids": solids,
            "ground": ground,
            "objects": objects,
            "blur_min": torch.where(pick(0.5), u(0.5, 2.0), zero),
            "light": self._directions(light, generator),
            "object_light": self._directions(object_light, generator),
        }
        if not with_object:
            objects["mesh"] = torch.zeros_like(objects["mesh"])
        setting = torch.where(indoors >= 0, indoors, -1)
        return Scenes(
            tables, light, object_light, right, up, back, photo_window, crop_window,
            is_panorama, kind, stock.nouns[mesh], setting, pool.weather[map_index],
        )  # fmt: skip

    def _light_of(
        self, pool: LightPool, index: Tensor, yaw: Tensor, is_mirrored: Tensor
    ) -> Lighting:
        mirror = torch.where(is_mirrored, -1.0, 1.0)
        gain = torch.ones(len(index), 3, device=index.device)
        light = Lighting(
            index.int(), yaw, mirror, gain, pool.axis[index], pool.sun[index], pool.sigma[index]
        )
        return replace(light, axis=to_world(light, light.axis[:, None])[:, 0])

    def _wrong(
        self, light: Lighting, pool: LightPool, generator: torch.Generator
    ) -> tuple[Tensor, Lighting]:
        """Return what is wrong with the object's light, and that light."""
        count, device = len(light.map), light.axis.device

        def rand(*shape: int) -> Tensor:
            return torch.rand(count, *shape, generator=generator, device=device)

        def sign() -> Tensor:
            return torch.where(rand() < 0.5, -1.0, 1.0)

        # Half of the wrong ones have a wrong direction.
        shares = torch.tensor([0.52, 0.14, 0.12, 0.12, 0.10], device=device)
        drawn = 1 + torch.multinomial(shares, count, replacement=True, generator=generator)
        kind = torch.where(rand() < self.mixture.mismatched, drawn, 0)
        # Direction: the whole light turned, and its sun raised or lowered.
        near = rand() < 0.3
        angle = torch.where(near, 0.2 + 0.4 * rand(), 0.6 + (np.pi - 0.6) * rand()) * sign()
        turned = light.turned(angle)
        old = torch.arcsin(turned.axis[:, 1].clamp(-1.0, 1.0))
        new = torch.where(near, old + 0.25 * (rand() - 0.5), torch.deg2rad(5.0 + 75.0 * rand()))
        new = torch.where((rand() < 0.5) | (old < 0.0), new.clamp(0.03, 1.5), old)
        flat = torch.nn.functional.normalize(
            turned.axis * torch.tensor([1.0, 0.0, 1.0], device=device) + 1e-6, dim=1
        )
        axis = flat * new.cos()[:, None]
        axis[:, 1] = new.sin()
        turned = replace(turned, axis=axis)
        # Without a sun nothing shows a direction: a sun is put there.
        omega = solid_angles(self._levels[0])
        rest = (luminance(self._levels[0][light.map.long()]) * omega).sum(dim=(1, 2))
        weak = self._share[light.map.long()] < 0.12
        added = rest[:, None] * (0.3 + 1.5 * rand(1)) * (1.0 - 0.3 * rand(3))
        turned = replace(turned, sun=torch.where(weak[:, None], added, turned.sun))
        # Another scene's light, at about the same exposure.
        order = torch.randperm(count, generator=generator, device=device)
        other = Lighting(**{k: v[order] for k, v in vars(light).items()})
        level = rest + luminance(light.sun)
        balance = (level / level[order].clamp(min=1e-9))[:, None].clamp(0.02, 50.0)
        other = replace(other, gain=other.gain * balance, sun=other.sun * balance)
        far = (other.axis * light.axis).sum(dim=1) < 0.85
        wrong = turned.chosen(other, far & ~near & (rand() < 0.35) & ~weak)
        stops = torch.exp2((0.6 + 1.9 * rand(1)) * sign()[:, None])
        brighter = replace(light, gain=light.gain * stops, sun=light.sun * stops)
        cast = torch.exp(torch.randn(count, 3, generator=generator, device=device) * 0.35)
        cast = cast / cast.mean(dim=1, keepdim=True)
        tinted = replace(light, gain=light.gain * cast, sun=light.sun * cast)
        # Softness: the sun's light moved to the sky, or the sky's to a sun.
        moved = luminance(light.sun)[:, None] / rest.clamp(min=1e-9)[:, None]
        part = 0.6 + 0.4 * rand(1)
        softer = replace(
            light, gain=light.gain * (1.0 + part * moved), sun=light.sun * (1.0 - part)
        )
        harder = replace(
            light, gain=light.gain * 0.45, sun=0.55 * rest[:, None] * (0.7 + rand(3) * 0.3)
        )
        soft = softer.chosen(harder, weak)
        result = light
        for number, choice in ((1, wrong), (2, brighter), (3, tinted), (4, soft)):
            result = result.chosen(choice, kind == number)
        assert KINDS[1:] == ("direction", "exposure", "colour", "softness", "shadow")
        return kind, result

    def _solids(
        self,
        generator: torch.Generator,
        place_kind: Tensor,
        is_panorama: Tensor,
        place: Tensor,
        scale: Tensor,
        camera_height: Tensor,
    ) -> dict[str, Tensor]:
        """Draw what stands in the scenes, [B, SOLIDS] each."""
        count, device = len(place), place.device

        def rand(*shape: int) -> Tensor:
            return torch.rand(count, *shape, generator=generator, device=device)

        small = SOLIDS - 8
        kind = torch.where(rand(small) < 0.4, 0, torch.where(rand(small) < 0.5, 1, 2))
        half = scale[:, None, None] * torch.exp(np.log(0.13) + rand(small, 3) * np.log(9.0))
        half = torch.minimum(half, camera_height[:, None, None] * 1.5)
        thin = rand(small) < 0.25
        thin_half = torch.stack(
            [half[..., 0] * 0.25, half[..., 1].clamp(min=0.0) * 2.0, half[..., 0] * 0.25], dim=-1
        )
        half = torch.where(thin[..., None], thin_half, half)
        angle = 2.0 * np.pi * rand(small)
        away = scale[:, None] * torch.exp(np.log(0.9) + rand(small) * np.log(5.0)) + half[..., 0]
        offset = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], dim=-1)
        centre = place[:, None] + offset * away[..., None]
        # Nothing stands on the camera, or between it and the object.
        to_camera = torch.nn.functional.normalize(
            -place * torch.tensor([1.0, 0, 1.0], device=device), dim=1
        )
        before = (offset * to_camera[:, None]).sum(-1) > 0.75
        centre = torch.where(before[..., None], place[:, None] - offset * away[..., None], centre)
        too_near = (
            centre[..., [0, 2]].norm(dim=-1) < 2.0 * half.max(dim=-1).values + 0.5 * scale[:, None]
        )
        centre[..., 1] = half[..., 1]
        chance = torch.tensor([0.5, 0.6, 0.7, 0.6], device=device)[place_kind]
        kind = torch.where((rand(small) < chance[:, None]) & ~too_near, kind, -1)
        # Houses along a street; walls behind and beside in yards and rooms.
        side = torch.where(rand(2) < 0.5, -1.0, 1.0)
        side[:, 1] = -side[:, 0]
        h = camera_height[:, None]
        size = h * torch.stack(
            [1.0 + 4.0 * rand(2), 1.0 + 6.0 * rand(2), 1.5 + 9.0 * rand(2)], dim=0
        )
        house_half = size.permute(1, 2, 0)
        reach = torch.maximum(place[:, 0:1] * side, torch.zeros_like(side)) + h * (
            1.2 + 4.0 * rand(2)
        )
        house = torch.stack(
            [side * (reach + house_half[..., 0]), house_half[..., 1], -h * (1.0 + 20.0 * rand(2))],
            dim=-1,
        )
        wall_half = torch.stack(
            [h * 25.0 * torch.ones_like(side), h * (0.5 + 1.6 * rand(2)), 0.1 * h.expand(-1, 2)],
            dim=-1,
        )
        wall_yaw = torch.stack([0.7 * (rand() - 0.5), np.pi / 2.0 + 0.5 * (rand() - 0.5)], dim=1)
        behind = place[:, 2] - scale * (0.8 + 4.0 * rand()) - 0.3 * camera_height
        beside = place[:, 0] + side[:, 0] * (scale * (0.9 + 4.0 * rand()) + 0.8 * camera_height)
        beyond = torch.maximum(beside * side[:, 0], camera_height * 0.8) * side[:, 0]
        zero = torch.zeros_like(behind)
        wall = torch.stack(
            [
                torch.stack([zero, wall_half[:, 0, 1], behind], dim=1),
                torch.stack([beyond, wall_half[:, 1, 1], zero], dim=1),
            ],
            dim=1,
        )
        is_street = (place_kind == 0)[:, None]
        large_kind = torch.where(rand(2) < torch.tensor([0.6, 0.45], device=device), 0, -1)
        is_table = (place_kind == 2)[:, None]
        large_kind = torch.where(is_table & (rand(2) < 0.6), -1, large_kind)
        large_half = torch.where(is_street[..., None], house_half, wall_half)
        large_centre = torch.where(is_street[..., None], house, wall)
        large_yaw = torch.where(is_street, 0.3 * (rand(2) - 0.5), wall_yaw)
        # Trees out of doors, and what stands far away before the sky.
        outdoors = (place_kind < 2)[:, None]
        around = 2.0 * np.pi * rand(2)
        tree_away = h * torch.exp(np.log(2.0) + rand(2) * np.log(8.0))
        tree = place[:, None] + tree_away[..., None] * torch.stack(
            [around.sin(), torch.zeros_like(around), -around.cos()], dim=-1
        )
        crown = h[..., None] * (0.5 + 1.8 * rand(2, 1)) * (0.7 + 0.6 * rand(2, 3))
        trunk = h[..., None] * torch.tensor([0.08, 0.0, 0.08], device=device).expand(count, 2, 3)
        trunk = trunk.clone()
        trunk[..., 1] = h * (0.3 + 0.9 * rand(2))
        trunk_centre, crown_centre = tree.clone(), tree.clone()
        trunk_centre[..., 1] = trunk[..., 1]
        crown_centre[..., 1] = 2.0 * trunk[..., 1] + 0.8 * crown[..., 1]
        stands = (rand(2) < 0.45) & outdoors
        # The camera stands in no crown.
        stands &= tree[..., [0, 2]].norm(dim=-1) > 1.5 * crown.max(dim=-1).values
        far = h * (12.0 + 50.0 * rand(2))
        far_half = (
            h[..., None]
            * torch.exp(rand(2, 3) * np.log(12.0))
            * torch.tensor([2.5, 0.6, 1.0], device=device)
        )
        far_centre = torch.stack([far * 1.4 * (rand(2) - 0.5), 0.7 * far_half[..., 1], -far], -1)
        far_kind = torch.where(rand(2) < 0.5, 1, 0)
        far_kind = torch.where((rand(2) < 0.45) & outdoors, far_kind, -1)
        more_kind = torch.cat([torch.where(stands, 2, -1), torch.where(stands, 1, -1), far_kind], 1)
        more_centre = torch.cat([trunk_centre, crown_centre, far_centre], dim=1)
        more_half = torch.cat([trunk, crown, far_half], dim=1)
        kind = torch.cat([large_kind, kind, more_kind], dim=1)
        # Few or none in panorama crops, and never a wall.
        few = rand(SOLIDS) < 0.35
        few[:, :2] = False
        few[:, -6:] = False
        few &= (rand() < self.mixture.proxies)[:, None]
        kind = torch.where(is_panorama[:, None] & ~few, -1, kind)
        kind = torch.where((rand() < self.mixture.no_cue)[:, None], -1, kind)
        tint = 1.0 - 0.6 * rand(SOLIDS, 3) * rand(SOLIDS, 1)
        panoramas = self.stock.panoramas.panorama_count
        is_textured = (rand(SOLIDS) < 0.4) & (panoramas > 0)
        yaw = torch.cat([large_yaw, 2.0 * np.pi * rand(SOLIDS - 2)], dim=1)
        solids = {
            "kind": kind.int(),
            "centre": torch.cat([large_centre, centre, more_centre], dim=1),
            "half": torch.cat([large_half, half, more_half], dim=1).clamp(min=1e-4),
            "turn": torch.stack([yaw.cos(), yaw.sin()], dim=-1),
            "albedo": (0.08 + 0.7 * rand(SOLIDS, 1)) * tint,
            "texture": torch.where(
                is_textured, (rand(SOLIDS) * max(panoramas, 1)).long(), -1
            ).int(),
        }
        return packed_solids(solids)

    def _sun_reaches(self, solids: dict[str, Tensor], point: Tensor, axis: Tensor) -> Tensor:
        """Return 1 where no solid stands between the points and the sun, else 0, shape [B]."""
        reached = torch.empty(len(point), device=point.device)
        wp.launch(
            kernel.sun_reaches,
            dim=len(point),
            inputs=[_struct(kernel.OccluderTable, solids), _vectors(point), _vectors(axis)],
            outputs=[wp.from_torch(reached)],
            device=self.stock.device,
        )
        return reached

    def _render(
        self,
        scenes: Scenes,
        window: Tensor,
        size: tuple[int, int],
        side: int,
        with_object: bool = True,
    ) -> Rendered:
        """Render a window of each scene, ``side`` squared points per pixel."""
        (height, width), count = size, len(window)
        tables, device = scenes.tables, self.stock.torch_device
        names = ("background", "object", "albedo", "normal", "ratio")
        pixels = count * height * width
        planes = {name: torch.empty(pixels, 3, device=device) for name in names}
        planes |= {name: torch.empty(pixels, device=device) for name in ("coverage", "solid")}
        lights = [
            _struct(
                kernel.LightTable,
                tables[name]
                | {"map": x.map, "yaw": x.yaw, "mirror": x.mirror, "gain": x.gain}
                | {"sun_axis": x.axis, "sun": x.sun, "sun_sigma": x.sigma},
            )
            for name, x in (("light", scenes.lighting), ("object_light", scenes.object_lighting))
        ]
        fine, middle, coarse = self._levels
        seen = self.stock.panoramas.seen
        maps = {"fine": fine, "middle": middle, "coarse": coarse, "seen": seen}
        objects = tables["objects"]
        if not with_object:
            objects = objects | {"mesh": torch.zeros_like(objects["mesh"])}
        wp.launch(
            kernel.render_scenes,
            dim=pixels,
            inputs=[
                width, height, side, wp.from_torch(tables["blur_min"]),
                _struct(kernel.ViewTable, tables["views"] | {"window": window.contiguous()}),
                *lights,
                _struct(kernel.MapTable, maps),
                _struct(kernel.OccluderTable, tables["solids"]),
                _struct(kernel.GroundTable, tables["ground"]),
                _struct(kernel.ObjectTable, objects),
            ],
            outputs=[_struct(kernel.Pixels, planes)],
            device=self.stock.device,
        )  # fmt: skip

        def plane(name: str) -> Tensor:
            return planes[name].view(count, height, width, -1).permute(0, 3, 1, 2)

        return Rendered(**{name: plane(name) for name in planes})


def _vectors(values: Tensor) -> wp.array:
    return wp.from_torch(values.contiguous(), dtype=wp.vec3)


def _struct(kind: Any, tensors: dict[str, Tensor]) -> Any:
    """Fill one of the kernel's tables with views of tensors; ids of meshes must outlive it."""
    table = kind()
    for name, variable in kind.vars.items():
        values = tensors[name].contiguous()
        dtype = variable.type.dtype
        if dtype is wp.uint64:
            array = wp.array(
                ptr=values.data_ptr(), dtype=wp.uint64, shape=values.shape,
                device=wp.device_from_torch(values.device), copy=False,
            )  # fmt: skip
        else:
            array = wp.from_torch(values, dtype=dtype)
        setattr(table, name, array)
    return table
