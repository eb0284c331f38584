"""`mis`, the reference integrator: multiple importance sampling of light and BRDF at any depth.

The forward pass traces with the detached kernels; if a gradient is needed, it records its samples
(`warpir.render.mis.samples`). Radiance is linear in the light, so the light's gradient is a sum
over the recorded directions; the materials' goes through the attached kernel over the recorded
vertices; powers of lamps scale rows (`warpir.render.near.rows`). Samples that do not fit
`warpir.render.mis.samples.RECORD_BYTES` are drawn again from the seed, part by part, so memory does
not grow with the sample count.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from warpir.core.arrays import IntArray
from warpir.render.bridge import ShadeForeground, ShadeReceiver, host_light
from warpir.render.device_light import light_args
from warpir.render.integrator import MaterialTensors, Radiance
from warpir.render.near.rows import LampRows, lamp_rows, with_lamps
from warpir.render.renderer import Renderer, index_of

LAMP_SEED = 0x1A3B5
"""Seed of the lamps' rows."""


class MisIntegrator:
    """Unbiased for the light it is handed; gradients to light, lamps, materials and emission.

    Those to base colour and metallic of thin glass leave out what passes it, which is a decision.

    Args:
        renderer: The scene to render.
        object_pixels: Row-major pixels that may show the object, shape [object_pixel].
        receiver_pixels: Row-major pixels whose plane the object may shade, shape [receiver_pixel].
        spp: Camera samples per pixel.
        rays: Directions per technique and camera sample.
        depth: Surface interactions of the object's paths.
    """

    def __init__(
        self,
        renderer: Renderer,
        object_pixels: IntArray,
        receiver_pixels: IntArray,
        spp: int = 128,
        rays: int = 4,
        depth: int = 5,
    ) -> None:
        self.renderer = renderer
        self.object_pixels = object_pixels
        self.receiver_pixels = receiver_pixels
        camera = renderer.scene.camera
        rows = index_of(object_pixels, camera.width * camera.height)
        self.may_see_object: IntArray = (rows[receiver_pixels] >= 0).astype(np.int32)
        self.spp, self.rays, self.depth = spp, rays, depth

    @cached_property
    def _in_the_dark(self) -> tuple[MisIntegrator, LampRows]:
        """The same without the lamps, and their rows."""
        pixels = self.object_pixels, self.receiver_pixels
        rows = lamp_rows(self.renderer, *pixels, self.depth, LAMP_SEED, torch.device("cpu"))
        dark = with_lamps(self.renderer, ())
        return MisIntegrator(dark, *pixels, self.spp, self.rays, self.depth), rows

    def radiance(
        self,
        light_fg: Tensor,
        light_shadow: Tensor,
        seed: int,
        materials: MaterialTensors | None = None,
        lamp_powers: Tensor | None = None,
    ) -> Radiance:
        """Render the object under ``light_fg`` and the plane under ``light_shadow``.

        The light's proposal is rebuilt from its current values and stays detached. With
        ``lamp_powers`` the lamps' light is that of rows, which are traced once.

        Raises:
            ValueError: Materials and powers are given: the rows hold the scene's materials.
        """
        materials = materials or MaterialTensors()
        if lamp_powers is not None:
            if any(v is not None for v in vars(materials).values()):
                raise ValueError("rows of lamps are frozen for the scene's materials")
            rest, rows = self._in_the_dark
            return rows.added(rest.radiance(light_fg, light_shadow, seed), lamp_powers)
        scene = self.renderer.scene
        with torch.no_grad():
            args_fg = light_args(host_light(light_fg), scene.device)
            args_shadow = args_fg
            if light_shadow is not light_fg:
                args_shadow = light_args(host_light(light_shadow), scene.device)
        is_recording = torch.is_grad_enabled()
        foreground: Tensor = ShadeForeground.apply(
            self, args_fg, seed, is_recording, light_fg, *vars(materials).values()
        )
        lit, unoccluded = ShadeReceiver.apply(self, args_shadow, seed, is_recording, light_shadow)
        return Radiance(foreground, lit, unoccluded)
