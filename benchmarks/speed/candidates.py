"""What competes in `benchmarks.speed`, behind one interface each.

`mis` and Mitsuba render foreground and shadow ratio apart, so that each part has a sweep of its
own; `transport` makes both at once. Of each, ``warm`` compiles all that the timed calls use, and
candidates of one ``warm_key`` compile the same kernels; ``forward`` and ``step`` render to the end,
the latter with the gradient, and calling what they return downloads the result. `mis` samples an
image without a gradient in other ways than one with, so each has an error of its own.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from benchmarks.speed.memory import PeakMemory
from benchmarks.speed.scenes import MAP_HEIGHT, SpeedScene
from warpir.core.arrays import Float64Array
from warpir.render.integrator import Radiance
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.transport.integrator import TransportIntegrator, TransportSettings
from warpir.scene.light import Light

PARTS = ("foreground", "ratio")
WARM_SEED = 1

Images = dict[str, Float64Array]
"""By part: the image [pixel, 3]."""
Step = dict[str, tuple[Float64Array, Float64Array]]
"""By part: the image [pixel, 3] and the gradient of its weighted sum [He, We, 3]."""


class Bench:
    """One scene, its map, and what all candidates share.

    ``freeze`` says whether Mitsuba's functions are traced once.
    """

    def __init__(self, scene: SpeedScene, sampler: str, freeze: bool) -> None:
        from benchmarks.speed.mitsuba import MitsubaScene

        self.scene, self.sampler = scene, sampler
        # Stock prb does not see ToyCar's emission texture, and takes twice gltf_path's time there
        self.mitsuba_integrator = "gltf_path" if scene.name == "toycar" else "prb"
        self.texels = scene.texels()
        self.mitsuba = MitsubaScene(scene, self.texels, self.mitsuba_integrator, sampler, freeze)
        self.memory = PeakMemory(scene.renderer.device)
        self.device = torch.device("cuda" if scene.renderer.device.is_cuda else "cpu")
        weights = zip(PARTS, (scene.weight_fg, scene.weight_ratio), strict=True)
        self.weights = {part: torch.tensor(w, device=self.device) for part, w in weights}

    def leaf(self, grad: bool = True) -> Tensor:
        """Upload the map as the optimiser holds it."""
        return torch.tensor(self.texels, device=self.device, requires_grad=grad)

    def synchronize(self) -> None:
        """Wait for our side of the device."""
        wp.synchronize_device(self.scene.renderer.device)
        if self.device.type == "cuda":
            torch.cuda.synchronize()


class MisPart:
    """`mis` on one part."""

    integrator = "mis"

    def __init__(self, bench: Bench, part: str, spp: int) -> None:
        scene = bench.scene
        self.bench, self.part, self.spp = bench, part, spp
        self.warm_key = (self.integrator, part)
        self.mis = MisIntegrator(
            scene.renderer, scene.object_pixels, scene.receiver_pixels, spp, 1, scene.depth
        )
        # Emptied after it was made: the plane must know where the object may hide it
        nothing = np.zeros(0, np.int32)
        if part == "foreground":
            self.mis.receiver_pixels = self.mis.may_see_object = nothing
        else:
            self.mis.object_pixels = nothing

    def warm(self) -> None:
        """Compile."""
        MisPart(self.bench, self.part, 1).step(WARM_SEED)

    def forward(self, seed: int) -> Callable[[], Images]:
        """Render."""
        light = self.bench.leaf(grad=False)
        with torch.no_grad():
            image = self._image(self.mis.radiance(light, light, seed))
        self.bench.synchronize()
        return lambda: {self.part: numpy(image)}

    def step(self, seed: int) -> Callable[[], Step]:
        """Render and differentiate."""
        leaf = self.bench.leaf()
        image = self._image(self.mis.radiance(leaf, leaf, seed))
        (image * self.bench.weights[self.part]).sum().backward()  # type: ignore[no-untyped-call]
        self.bench.synchronize()
        return lambda: {self.part: (numpy(image), numpy(leaf.grad))}

    def _image(self, radiance: Radiance) -> Tensor:
        return radiance.foreground if self.part == "foreground" else shadow_ratio(radiance)


class MitsubaPart:
    """Mitsuba on one part."""

    integrator = "mitsuba"

    def __init__(self, bench: Bench, part: str, spp: int) -> None:
        self.bench, self.part, self.spp = bench, part, spp
        self.target = bench.mitsuba
        self.pass_spp = self.target.largest_pass(part, spp)
        self.warm_key = (self.integrator, part, self.pass_spp)

    def warm(self) -> None:
        """Compile and record, with the samples of one pass; a scene's first call records twice."""
        one = MitsubaPart(self.bench, self.part, self.pass_spp)
        for seed in range(WARM_SEED, WARM_SEED + (2 if self.pass_spp < 100 else 1)):
            one.forward(seed)
            one.step(seed)

    def forward(self, seed: int) -> Callable[[], Images]:
        """Render."""
        render = self.target.foreground if self.part == "foreground" else self.target.ratio
        image = render(self.spp, seed)
        mitsuba_synchronize()
        return lambda: {self.part: self._rows(image)}

    def step(self, seed: int) -> Callable[[], Step]:
        """Render and differentiate; the foreground's two passes have seeds of their own."""
        if self.part == "foreground":
            image = self.target.foreground(self.spp, seed)
            gradient = self.target.foreground_gradient(self.spp, seed + 50_000)
        else:
            image, gradient = self.target.ratio_step(self.spp, seed)
        mitsuba_synchronize()
        return lambda: {self.part: (self._rows(image), np.asarray(gradient, np.float64))}

    def _rows(self, image: Any) -> Float64Array:
        """Download an image of Mitsuba's, shape [pixel, 3]."""
        if self.part == "foreground":
            return self.target.objects(image)
        return np.asarray(image, np.float64).T


class Transport:
    """`transport` on both parts, traced when made.

    ``settings`` are fields of ``TransportSettings``, and ``expects_light``: whether tracing puts
    directions where this scene's light is, or evenly everywhere.
    """

    def __init__(self, bench: Bench, settings: dict[str, Any], seed: int) -> None:
        self.bench = bench
        fields = {k: v for k, v in settings.items() if k != "expects_light"}
        scene = bench.scene
        self.traced = TransportIntegrator(
            scene.renderer,
            scene.object_pixels,
            scene.receiver_pixels,
            depth=scene.depth,
            settings=TransportSettings(height_fg=MAP_HEIGHT, height_shadow=MAP_HEIGHT, **fields),
            expected=Light(scene.lobes) if settings.get("expects_light", True) else None,
            seed=seed,
        )

    def warm(self) -> None:
        """Touch everything once."""
        self.forward(WARM_SEED)
        self.step(WARM_SEED)

    def forward(self, seed: int) -> Callable[[], Images]:
        """Render."""
        with torch.no_grad():
            light = self.bench.leaf(grad=False)
            out = self.traced.radiance(light, light, seed)
            images = (out.foreground, shadow_ratio(out))
        self.bench.synchronize()
        return lambda: dict(zip(PARTS, map(numpy, images), strict=True))

    def step(self, seed: int) -> Callable[[], Step]:
        """Render and differentiate."""
        leaves = [self.bench.leaf() for _ in PARTS]
        out = self.traced.radiance(*leaves, seed)
        images = (out.foreground, shadow_ratio(out))
        weights = self.bench.weights
        loss = (images[0] * weights["foreground"]).sum() + (images[1] * weights["ratio"]).sum()
        loss.backward()  # type: ignore[no-untyped-call]
        self.bench.synchronize()
        return lambda: {
            part: (numpy(image), numpy(leaf.grad))
            for part, image, leaf in zip(PARTS, images, leaves, strict=True)
        }


def mitsuba_synchronize() -> None:
    """Wait for what Dr.Jit has queued."""
    import drjit as dr

    dr.sync_thread()


def shadow_ratio(radiance: Radiance) -> Tensor:
    """Return lit / unoccluded, 1 where no light arrives, shape [receiver_pixel, 3]."""
    seen = radiance.unoccluded > 0.0
    below = torch.where(seen, radiance.unoccluded, torch.ones_like(radiance.unoccluded))
    return torch.where(seen, radiance.lit / below, torch.ones_like(below))


def numpy(tensor: Tensor | None) -> Float64Array:
    """Download as float64."""
    assert tensor is not None
    return tensor.detach().double().cpu().numpy()


def use_device(device: str, threads: int) -> None:
    """Choose Mitsuba's variant and give everyone the same number of cores.

    Must come before anything imports `benchmarks.speed.mitsuba`.
    """
    if device == "cpu" and "DRJIT_LIBLLVM_PATH" not in os.environ:
        # LLVM 15, which Dr.Jit may find first, aborts in code generation
        found = sorted(Path("/usr/lib").glob("*/libLLVM.so.2?.*"))
        if found:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(found[-1])
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb" if device == "cpu" else "cuda_ad_rgb")
    import drjit as dr

    dr.set_thread_count(threads)
    torch.set_num_threads(threads)
