"""Photographs with known cameras, cut out of panoramas on the device that trains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from warpir.calibration.network import HEIGHT, WIDTH, blur_sigma
from warpir.core.latlong import resize_map
from warpir.io.images.photos import read_envmap
from warpir.train.augmentation import erase
from warpir.train.lights import at_mean_luminance
from warpir.train.networks.calibrator import SHAPE, soften
from warpir.train.photo_look import draw_faults, draw_looks
from warpir.train.sampler import Sampler

ROWS = 512
"""Rows of a panorama, over 180 degrees."""
ASPECTS = (1.5, 1.5, 1.5, 1.333, 1.333, 1.778, 1.778, 1.0, 0.75, 0.75, 0.667, 0.5625)
"""Width over height of the photos, by frequency."""
SAMPLES = 2
"""Rays along each side of a pixel."""
OWN_BLUR = 0.5
"""Standard deviation of the blur of a panorama that is magnified, over one texel: that of the texel
(.29) and of linear interpolation (.41)."""
BLURS = (1.2, 1.8)
"""Least and greatest blur of a photo, in the units of `warpir.calibration.network.BLUR`; it is
drawn alike for all fields of view."""
KNOWN_SHARE = 0.2
"""Share of photos whose focal length the network is given."""
BLANK_SHARE = 0.01
"""Share of photos of one colour, so that those too have an answer: that nothing is known."""
GREY_SHARE = 0.1
ERASE_SHARE = 0.15
"""Chance of each of three rectangles to be painted over."""


class Panoramas(NamedTuple):
    """Panoramas to photograph, on one device."""

    texels: Tensor
    """Radiance of mean luminance 1, first and last column repeated on the other side, shape
    [1, 3, P, 512, 1026]."""
    coarseness: Tensor
    """Rows here over rows of the file, at least 1, shape [P]."""


@dataclass(frozen=True)
class DrawnCameras:
    """Cameras of a batch; signs as of `warpir.scene.camera`."""

    pitch: Tensor
    """Upward tilt [rad], shape [B]."""
    roll: Tensor
    """Turn about the camera's +Z [rad], shape [B]."""
    focal: Tensor
    """Focal length over the photo's height, shape [B]."""
    x: Tensor
    """Principal point over the width, from the left, shape [B]."""
    y: Tensor
    """Principal point over the height, from the top, shape [B]."""
    aspect: Tensor
    """Width over height, shape [B]."""
    bend: Tensor
    """How much farther from the principal point than it is shown the corner of a centred photo
    lies on the image plane (barrel), as a share; negative for pincushion; shape [B]."""

    @property
    def barrel(self) -> Tensor:
        """Share by which a point lies farther out than shown, over its square distance, [B]."""
        return self.bend / (0.25 * (1.0 + self.aspect**2) / self.focal**2)

    def shown(self, height: int, width: int) -> Tensor:
        """Return `plane` of a lens that does not bend."""
        across = (torch.arange(width, device=self.x.device) + 0.5) / width
        down = (torch.arange(height, device=self.x.device) + 0.5) / height
        right = (across - self.x[:, None]) * (self.aspect / self.focal)[:, None]
        up = (self.y[:, None] - down) / self.focal[:, None]
        return torch.stack(torch.broadcast_tensors(right[:, None, :], up[:, :, None]), dim=-1)

    def plane(self, height: int, width: int) -> Tensor:
        """Return right and up of pixels on the image plane at depth 1, shape [B, H, W, 2]."""
        shown = self.shown(height, width)
        squared = shown.square().sum(dim=-1, keepdim=True)
        return shown * (1.0 + self.barrel[:, None, None, None] * squared)

    def world(self, plane: Tensor) -> Tensor:
        """Return unit directions in the camera-yaw frame, shape [B, H, W, 3].

        Args:
            plane: As `plane` gives it.
        """
        c, s = self.roll.cos()[:, None, None], self.roll.sin()[:, None, None]
        x, y = plane.unbind(-1)
        x, y = c * x - s * y, s * x + c * y
        c, s = self.pitch.cos()[:, None, None], self.pitch.sin()[:, None, None]
        return F.normalize(torch.stack([x, c * y + s, s * y - c], dim=-1), dim=-1)

    def field(self) -> Tensor:
        """Return the perspective field of the tokens, shape [B, 384, 3].

        The unit direction in the picture (right, up) of what lies straight above the scene point
        that a token sees, and that point's elevation above the horizon [rad].
        """
        size = HEIGHT // SHAPE[0], WIDTH // SHAPE[1]
        plane, shown = self.plane(*size), self.shown(*size)
        elevation = torch.asin(self.world(plane)[..., 1].clamp(-1.0, 1.0))
        # World up in the camera's axes; a point of the plane at depth 1 that moves along it.
        up = torch.stack([self.roll.sin() * self.pitch.cos(), self.roll.cos() * self.pitch.cos()])
        forward = -self.pitch.sin()[:, None, None, None]
        moved = up.T[:, None, None] + plane * forward
        # Where the lens shows that: the inverse of how `plane` follows from `shown`.
        along, squared = ((shown * v).sum(dim=-1, keepdim=True) for v in (moved, shown))
        barrel = self.barrel[:, None, None, None]
        moved = moved - shown * 2.0 * barrel * along / (1.0 + 3.0 * barrel * squared)
        return torch.cat([F.normalize(moved, dim=-1), elevation[..., None]], dim=-1).flatten(1, 2)

    def numbers(self) -> Tensor:
        """Return the truth in the units and the order of `NUMBERS`, shape [B, 5]."""
        degrees = torch.rad2deg(torch.stack([self.pitch, self.roll]))
        return torch.stack([*degrees, self.focal.log(), self.x, self.y], dim=1)


class CameraBatch(NamedTuple):
    """Photos and their cameras."""

    photo: Tensor
    """As the network sees them, shape [B, 3, 128, 192]."""
    aspect: Tensor
    """Shape [B]."""
    focal: Tensor
    """What the network is given of the focal length: its logarithm or NaN, shape [B]."""
    numbers: Tensor
    """The truth, as `DrawnCameras.numbers`."""
    field: Tensor
    """As `DrawnCameras.field`."""


def read_panoramas(paths: Sequence[Path], device: torch.device | str) -> Panoramas:
    """Read panoramas; each is scaled to mean luminance 1.

    Raises:
        InputError: A file cannot be used.
    """
    stack = torch.empty(1, 3, len(paths), ROWS, 2 * ROWS + 2)
    coarseness = []
    for k, path in enumerate(paths):
        texels = read_envmap(path)
        coarseness.append(max(1.0, ROWS / texels.shape[0]))
        texels = resize_map(at_mean_luminance(texels), ROWS)
        stack[0, :, k, :, 1:-1] = torch.from_numpy(texels).permute(2, 0, 1)
    stack[..., 0], stack[..., -1] = stack[..., -2], stack[..., 1]
    return Panoramas(stack.to(device), torch.tensor(coarseness, device=device))


def draw_cameras(draw: Sampler) -> DrawnCameras:
    """Draw cameras: most nearly level, some steep, cropped or corrected to upright."""
    device = draw.device
    pitch = torch.where(draw.chance(0.4), -18.0 + 14.0 * draw.normal(), -4.0 + 8.0 * draw.normal())
    pitch = torch.where(draw.chance(0.25), draw.uniform(-50.0, 40.0), pitch)
    pitch = torch.where(draw.chance(0.03), draw.uniform(-90.0, -50.0), pitch).clamp(-90.0, 60.0)
    roll = torch.where(draw.chance(0.35), 0.7 * draw.normal(), 4.0 * draw.normal())
    roll = torch.where(draw.chance(0.2), draw.uniform(-30.0, 30.0), roll).clamp(-44.0, 44.0)
    # Of the shorter side: a portrait photo is a landscape one whose camera was turned.
    fov = torch.where(draw.chance(0.6), draw.log_uniform(25.0, 90.0), draw.uniform(20.0, 100.0))
    aspect = torch.tensor(ASPECTS, device=device)[draw.index(len(ASPECTS))]
    aspect = aspect * torch.where(draw.chance(0.3), draw.log_uniform(0.8, 1.25), 1.0)
    half = torch.tan(torch.deg2rad(fov) / 2.0) / aspect.clamp(max=1.0)
    x, y = 0.5 + 0.004 * draw.normal(), 0.5 + 0.004 * draw.normal()
    kind = draw.category([0.68, 0.14, 0.18])
    is_cropped, is_upright = kind == 1, kind == 2
    x = torch.where(is_cropped, draw.uniform(0.2, 0.8), x)
    y = torch.where(is_cropped, draw.uniform(0.2, 0.8), y)
    # Most are of buildings that were looked up at: the horizon is in the lower part.
    upright = torch.where(draw.chance(0.7), draw.uniform(0.5, 1.0), draw.uniform(0.1, 0.5))
    y = torch.where(is_upright, upright, y)
    pitch = torch.where(is_upright, 0.5 * draw.normal(), pitch)
    roll = torch.where(is_upright, 0.3 * draw.normal(), roll)
    bend = torch.where(draw.chance(0.5), 0.02 * draw.normal(), torch.zeros_like(x))
    bend = torch.where(draw.chance(0.1), draw.uniform(-0.08, 0.3), bend)
    focal = (0.5 / half).clamp(0.36, 3.9)
    pitch, roll = torch.deg2rad(pitch), torch.deg2rad(roll)
    return DrawnCameras(pitch, roll, focal, x, y, aspect, bend)


def cut(
    panoramas: Panoramas,
    cameras: DrawnCameras,
    which: Tensor,
    draw: Sampler,
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> Tensor:
    """Return the radiance that cameras see, looking anywhere around, shape [B, 3, H, W].

    ``which`` is the panorama of each, shape [B]; the azimuths, and which panoramas are mirrored,
    are drawn. The size is height and width [px].
    """
    plane = cameras.plane(SAMPLES * size[0], SAMPLES * size[1])
    x, y, z = cameras.world(plane).unbind(-1)
    mirror, yaw = draw.sign()[:, None, None], draw.uniform(0.0, 1.0)[:, None, None]
    # Image centre +Z, left quarter +X.
    u = (0.5 - torch.atan2(mirror * x, z) / (2.0 * math.pi) + yaw) % 1.0
    v = torch.acos(y.clamp(-1.0, 1.0)) / math.pi
    count, columns = panoramas.texels.shape[2], panoramas.texels.shape[4]
    across = 2.0 * (u * (columns - 2) + 1.0) / columns - 1.0
    layer = ((2.0 * which + 1.0) / count - 1.0)[:, None, None].expand_as(u)
    grid = torch.stack([across, 2.0 * v - 1.0, layer], dim=-1)
    seen = F.grid_sample(panoramas.texels, grid[None], padding_mode="border", align_corners=False)
    return F.avg_pool2d(seen[0].transpose(0, 1).clamp(min=0.0), SAMPLES)


def with_blur(photo: Tensor, cameras: DrawnCameras, coarseness: Tensor, rows: Tensor) -> Tensor:
    """Blur photos until each has the blur that it should, as far as its panorama allows.

    Args:
        photo: Shape [B, 3, 128, 192].
        cameras: Of the photos.
        coarseness: Of their panoramas, shape [B].
        rows: The blur, in the units of `warpir.calibration.network.BLUR`, shape [B].
    """
    texel = cameras.focal * HEIGHT * math.pi / ROWS * coarseness
    missing = (rows**2 - (OWN_BLUR * texel) ** 2).clamp(min=0.0).sqrt()
    return soften(photo, torch.stack(blur_sigma(missing, cameras.aspect), dim=1))


def draw_batch(panoramas: Panoramas, count: int, generator: torch.Generator) -> CameraBatch:
    """Draw photos with their cameras.

    All are brought to blurs drawn alike for all fields of view: what is narrow is magnified from a
    panorama of few texels, and sharpness must not tell that.
    """
    draw = Sampler(count, generator)
    cameras, which = draw_cameras(draw), draw.index(panoramas.texels.shape[2])
    radiance = cut(panoramas, cameras, which, draw)
    photo = draw_looks(radiance, generator).show(radiance)
    grey = photo.mean(dim=1, keepdim=True).expand_as(photo)
    photo = torch.where(draw.chance(GREY_SHARE, 1, 1, 1), grey, photo)
    photo = with_blur(photo, cameras, panoramas.coarseness[which], draw.log_uniform(*BLURS))
    is_blank = draw.chance(BLANK_SHARE, 1, 1, 1)
    photo = torch.where(is_blank, photo.mean(dim=(2, 3), keepdim=True), photo)
    photo = erase(draw_faults(photo, generator), ERASE_SHARE, generator)
    unknown = torch.full_like(cameras.focal, math.nan)
    focal = torch.where(draw.chance(KNOWN_SHARE), cameras.focal.log(), unknown)
    return CameraBatch(photo, cameras.aspect, focal, cameras.numbers(), cameras.field())
