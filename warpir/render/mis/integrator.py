"""`mis`, the reference integrator: multiple importance sampling of light and BRDF at any depth.

The forward pass traces with the detached kernels; if a gradient is needed, it records its samples
(`warpir.render.mis.samples`). Radiance is linear in the light, so the light's gradient is a sum
over the recorded directions; the materials' goes through the attached kernel over the recorded
vertices. Samples that do not fit `warpir.render.mis.samples.RECORD_BYTES` are drawn again from the
seed, part by part, so memory does not grow with the sample count.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from warpir.core.arrays import IntArray
from warpir.render.bridge import ShadeForeground, ShadeReceiver, host_light
from warpir.render.device_light import light_args
from warpir.render.integrator import MaterialTensors, Radiance
from warpir.render.renderer import Renderer, index_of


class MisIntegrator:
    """Unbiased for the light it is handed; gradients to light, materials and emission.

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

    def radiance(
        self,
        light_fg: Tensor,
        light_shadow: Tensor,
        seed: int,
        materials: MaterialTensors | None = None,
    ) -> Radiance:
        """Render the object under ``light_fg`` and the plane under ``light_shadow``.

        The light's proposal is rebuilt from its current values and stays detached.
        """
        materials = materials or MaterialTensors()
        scene = self.renderer.scene
        with torch.no_grad():
            args_fg = light_args(host_light(light_fg), scene.device)
            args_shadow = light_args(host_light(light_shadow), scene.device)
        is_recording = torch.is_grad_enabled()
        foreground: Tensor = ShadeForeground.apply(
            self, args_fg, seed, is_recording, light_fg, *_material(materials)
        )
        lit, unoccluded = ShadeReceiver.apply(self, args_shadow, seed, is_recording, light_shadow)
        return Radiance(foreground, lit, unoccluded)


def _material(materials: MaterialTensors) -> tuple[Tensor | None, ...]:
    return materials.base_color, materials.metallic, materials.roughness, materials.emission
