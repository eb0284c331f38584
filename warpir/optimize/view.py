"""Pictures of the optimisation loop: under a light of every step, or under a fixed one.

A `View` renders each step, with gradients to the light. There are two integrators. `transport`
traces once, with samples for an expected light, so that a step is a matrix product; it traces
again when the light has moved away. `mis` traces every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from warpir.core.arrays import FloatArray, IntArray, PixelArray
from warpir.lighting.scene_light import SceneLight
from warpir.render.bridge import ComposeConstants, compose
from warpir.render.device_light import light_args
from warpir.render.integrator import Integrator, Radiance
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.near.rows import with_lamps
from warpir.render.renderer import Renderer, index_of
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.tone_curve import Knots
from warpir.render.transport.integrator import TransportIntegrator
from warpir.render.transport.rows import TransportSettings
from warpir.scene.light import Light

COVERAGE_SAMPLES = 64
"""Camera samples per pixel of the object's coverage for `mis`."""
STILL_SAMPLES = 64
"""Camera samples per pixel of the parts that are rendered once."""


@dataclass(frozen=True)
class Frame:
    """Constants of the loop: scene, photo and sampling."""

    renderer: Renderer
    """The scene, with a camera of the loop's resolution."""
    photo_lin: FloatArray
    """Linear photo at that resolution, shape [H, W, 3]."""
    is_reinhard: bool
    """Whether Reinhard's operator precedes the foreground curve."""
    depth: int
    """Surface interactions of the object's paths."""
    seed: int

    def coverage(self) -> FloatArray:
        """Return the object's share of each pixel, from a few samples, shape [H, W]."""
        height, width = self.photo_lin.shape[:2]
        plane = np.zeros(height * width, np.float32)
        gbuffer = self.renderer.gbuffer(self.seed)
        plane[gbuffer.object_pixels] = gbuffer.coverage
        return plane.reshape(height, width)


class View:
    """Renders composites of a frame; gradients to the light.

    Args:
        frame: Scene, photo, tone operator.
        expected: Light that directions are sampled by.
        transport: Resolution of `transport`; None for `mis`.
        mis_samples: Camera samples per pixel of `mis`.
        cache: Folder for traced rows, or None.

    Attributes:
        integrator: What renders.
        transport: The same if its rows were traced, or None.
    """

    def __init__(
        self,
        frame: Frame,
        expected: Light,
        transport: TransportSettings | None,
        mis_samples: int = 16,
        cache: Path | None = None,
    ) -> None:
        self.frame = frame
        renderer, seed = frame.renderer, frame.seed
        objects = renderer.gbuffer(seed).object_pixels
        proxies = _shaded(renderer, expected, seed)
        self.integrator: Integrator
        self.transport: TransportIntegrator | None = None
        if transport is not None:
            self.transport = TransportIntegrator(
                renderer, objects, proxies, frame.depth, transport, expected, seed, cache
            )
            self.integrator, coverage = self.transport, self.transport.mask
        else:
            self.integrator = MisIntegrator(renderer, objects, proxies, mis_samples, 1, frame.depth)
            args = light_args(expected, renderer.device)
            coverage = renderer.foreground(args, objects, COVERAGE_SAMPLES, 1, 1, seed).mask
        self.constants = ComposeConstants(
            frame.photo_lin,
            objects,
            proxies,
            coverage,
            str(renderer.device.alias),
            frame.is_reinhard,
        )

    def image(
        self,
        texels_fg: Tensor,
        texels_shadow: Tensor,
        curve_fg: Knots,
        curve_shadow: Knots,
        seed: int,
        lamp_powers: Tensor | None = None,
    ) -> Tensor:
        """Return the composite, display-encoded, shape [1, 3, H, W]; differentiable.

        Args:
            texels_fg: Lat-long radiance that lights the object, shape [He, We, 3].
            texels_shadow: Lat-long radiance that casts its shadow, shape [He, We, 3].
            curve_fg: One tone curve.
            curve_shadow: Three tone curves.
            seed: Seed of this step's samples; `transport` has none.
            lamp_powers: Relative [W], shape [lamp, 3]; None: those of the scene's lamps.
        """
        radiance = self.integrator.radiance(texels_fg, texels_shadow, seed, lamp_powers=lamp_powers)
        return compose(self.constants, radiance, curve_fg, curve_shadow)


def _shaded(renderer: Renderer, expected: Light, seed: int) -> IntArray:
    """Return the pixels whose ground the object may shade: by a sky, the expected light, a lamp.

    Other pixels keep a ratio of 1 and have no gradient, so the even sky covers lights that are not
    expected, and each lamp counts as if there were no other light.
    """
    even, dark = (Light(texels=np.full((8, 16, 3), L, np.float32)) for L in (1.0, 0.0))
    alone = [(with_lamps(renderer, [lamp]), dark) for lamp in renderer.scene.lamps]
    pixels: PixelArray = np.zeros(0, np.int32)
    for lit, light in ((renderer, even), (renderer, expected), *alone):
        found = shaded_pixels(lit, light_args(light, renderer.device), seed)
        pixels = np.union1d(pixels, found)
    return pixels.astype(np.int32)


def expected_light(texels_fg: Tensor, texels_shadow: Tensor) -> Light:
    """Return the light to sample by at the next tracing: both maps, each at mean 1."""
    with torch.no_grad():
        both = [t / t.mean().clamp(min=1e-20) for t in (texels_fg, texels_shadow)]
    return Light(texels=(0.5 * (both[0] + both[1])).cpu().numpy())


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
        radiance = Radiance(foreground, self.lit, self.unoccluded)
        return compose(self.constants, radiance, curve_fg, curve_shadow)
