"""A frame of the loop's size under a fixed light."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from warpir.lighting.scene_light import SceneLight
from warpir.optimize.view import Frame
from warpir.render.bridge import ComposeConstants, compose
from warpir.render.device_light import light_args
from warpir.render.renderer import index_of
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.tone_curve import Knots

STILL_SAMPLES = 64
"""Camera samples per pixel of the parts that are rendered once."""


class LitFrame:
    """A frame under a fixed light; parts that do not depend on the unknowns are rendered once.

    Args:
        frame: Scene, photo, tone operator.
        light: The light.
        device: Device of the unknowns.
        samples: Camera samples per pixel.

    Attributes:
        foreground: The object with its own materials, premultiplied, shape [object_pixel, 3].
    """

    def __init__(
        self,
        frame: Frame,
        light: SceneLight,
        device: torch.device,
        samples: int = STILL_SAMPLES,
    ) -> None:
        self.frame, renderer, seed = frame, frame.renderer, frame.seed
        self.args_fg = args_shadow = light_args(light.light, renderer.device)
        if light.light_shadow is not light.light:
            args_shadow = light_args(light.light_shadow, renderer.device)
        self.object_pixels = renderer.gbuffer(seed).object_pixels
        height, width = frame.photo_lin.shape[:2]
        is_object = (index_of(self.object_pixels, height * width) >= 0).astype(np.int32)
        proxies = shaded_pixels(renderer, args_shadow, seed)
        plane = renderer.receiver(args_shadow, proxies, is_object[proxies], samples, 1, seed)
        seen = renderer.foreground(self.args_fg, self.object_pixels, samples, 1, frame.depth, seed)
        self.foreground, self.lit, self.unoccluded = (
            torch.from_numpy(values).to(device)
            for values in (seen.radiance, plane.lit, plane.unoccluded)
        )
        self.constants = ComposeConstants(
            frame.photo_lin,
            self.object_pixels,
            proxies,
            seen.mask,
            str(renderer.device.alias),
            frame.is_reinhard,
        )

    def image(self, foreground: Tensor, curve_fg: Knots, curve_shadow: Knots) -> Tensor:
        """Return the composite, display-encoded, shape [1, 3, H, W]; differentiable."""
        return compose(
            self.constants, foreground, self.lit, self.unoccluded, curve_fg, curve_shadow
        )
