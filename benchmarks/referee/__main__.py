"""Does Mitsuba 3, given the same scene and light, render what warpir renders?

`foreground`, `shadow` and `foreground_gradient` are the reference; run as
``python -m benchmarks.referee`` this compares warpir with them on the presets and leaves one
sheet (ours, Mitsuba, difference) and one JSON line per scene and depth. Material, light and
integrator are written from the specifications, not from warpir's kernels
(`warpir.mitsuba.render`).
"""

import argparse
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from benchmarks.measure import flags, report
from benchmarks.referee import ours
from benchmarks.referee.presets import PRESETS, ScenePreset
from benchmarks.referee.sheet import compare_images, write_sheet
from warpir.core.arrays import AnyFloatArray, Float64Array
from warpir.core.latlong import map_directions
from warpir.lighting.fit import fit_lobes
from warpir.mitsuba.render import Ratio, Setting, build, foreground, passes, shadow_ratio
from warpir.render.device import choose_device
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.renderer import Renderer

FLOOR = 1e-4
"""Added to the standard errors of ratios: a handful of rare events has no honest variance [1]."""


def foreground_gradient(
    setting: Setting, depth: int, spp: int, seed: int, d_image: Float64Array
) -> Float64Array:
    """Gradient of ``sum(mean * d_image)`` with respect to the light, by path replay.

    ``d_image`` is the loss gradient of ``Foreground.mean``, shape [H, W, 3]; all other arguments
    are those of `warpir.mitsuba.render.foreground`. Returns ``d_texels``, shape [He, We, 3].
    """
    setup = build(*setting, depth)
    parameters = mi.traverse(setup.scene)
    dr.enable_grad(parameters["light.texels"])
    parameters.update()
    d, d_texels = np.asarray(d_image, np.float32), np.zeros(setting.texels.shape)
    for pass_seed, pass_spp in passes(setting.camera, spp, seed):
        dr.set_grad(parameters["light.texels"], 0.0)
        setup.integrator.render_backward(
            setup.scene, parameters, mi.TensorXf(d), setup.sensor, pass_seed, pass_spp
        )
        d_texels += np.asarray(dr.grad(parameters["light.texels"]), dtype=np.float64) * pass_spp
    return d_texels / spp


def comparable(image: Ratio, seen: Float64Array) -> Ratio:
    """Keep the pixels that see the plane with half of their samples or more."""
    used = (seen >= 0.5)[..., None]
    touched = image.variance > 0.0
    return image._replace(
        mean=np.where(used, image.mean, 1.0),
        variance=np.where(used, image.variance + touched * FLOOR**2, 0.0),
        coverage=used[..., 0].astype(float),
    )


def own_gradient(
    renderer: Renderer, setting: Setting, depth: int, spp: int, seed: int, d_image: Float64Array
) -> Float64Array:
    """`foreground_gradient` by our `mis`, in runs of 64 samples."""
    texels, pixels = setting.texels, renderer.candidate_pixels(setting.camera)
    mis = MisIntegrator(renderer, pixels, np.zeros(0, np.int32), spp=64, rays=1, depth=depth)
    weight = torch.tensor(d_image.reshape(-1, 3)[pixels], dtype=torch.float32)
    total = np.zeros(texels.shape)
    runs = max(1, spp // 64)
    for run in range(runs):
        leaf = torch.tensor(texels, requires_grad=True)
        image = mis.radiance(leaf, leaf, seed=1000 * seed + run).foreground
        (image * weight).sum().backward()
        assert leaf.grad is not None
        total += leaf.grad.double().numpy()
    return total / runs


def compare_gradients(own: list[Float64Array], theirs: list[Float64Array]) -> dict[str, float]:
    """Return how far two pairs of independent estimates are from each other, and their noise."""
    a, b = (0.5 * (pair[0] + pair[1]).ravel() for pair in (own, theirs))
    noise = 0.25 * sum(np.square(pair[0] - pair[1]).sum() for pair in (own, theirs))
    size = float(np.linalg.norm(b))
    return {
        "relative_l2": float(np.linalg.norm(a - b)) / size,
        "noise_l2": float(np.sqrt(noise)) / size,
        "cosine": float(a @ b / np.linalg.norm(a) / size),
    }


def gradient_line(
    preset: ScenePreset, assets: Path, depth: int, spp: int, seed: int, device: str
) -> dict[str, Any]:
    """Compare lobe gradients through a rasterised map: ours against path replay in Mitsuba.

    The loss is ``sum(foreground * d_image)`` with colour ramps for ``d_image``; the map's gradient
    of both is carried to the lobes by the same adjoint, of the lobes at the texels' centres.
    """
    given = preset.setting(assets)
    camera, lobes = given.camera, fit_lobes(given.texels, 32).lobes
    parts = lobes.amplitude, lobes.axis, np.minimum(lobes.sharpness, 2000.0)
    leaves = [torch.tensor(part, requires_grad=True) for part in parts]
    amplitude, axis, sharpness = leaves
    toward = torch.tensor(map_directions(64, 128), dtype=torch.float32)
    texels = torch.exp((toward @ axis.T - 1.0) * sharpness) @ amplitude
    row, column = np.mgrid[0 : camera.height, 0 : camera.width] / camera.height
    d_image = np.stack([0.5 + row, 0.5 + column, 1.5 - row], axis=-1)
    setting = given._replace(texels=texels.detach().numpy())

    def to_lobes(d_texels: AnyFloatArray) -> list[Float64Array]:
        d = torch.tensor(d_texels, dtype=torch.float32)
        grads = torch.autograd.grad(texels, leaves, d, retain_graph=True)
        return [g.double().numpy() for g in grads]

    half = spp // 2
    start = time.perf_counter()
    theirs = [
        to_lobes(foreground_gradient(setting, depth, half, seed + k, d_image)) for k in range(2)
    ]
    middle = time.perf_counter()
    renderer = ours.renderer(setting, device)
    own = [to_lobes(own_gradient(renderer, setting, depth, half, k + 1, d_image)) for k in range(2)]
    end = time.perf_counter()
    return {
        "scene": preset.name,
        "what": "gradient",
        "depth": depth,
        "spp": spp,
        **{
            name: compare_gradients([g[k] for g in own], [g[k] for g in theirs])
            for k, name in enumerate(("amplitude", "axis", "sharpness"))
        },
        "mitsuba_s": round(middle - start, 2),
        "ours_s": round(end - middle, 2),
    }


def picture_lines(
    preset: ScenePreset, options: argparse.Namespace, device: str
) -> Iterator[dict[str, Any]]:
    """Compare foregrounds and shadow ratio of a scene; write a sheet of each."""
    setting, spp, seed = preset.setting(options.assets), options.spp, options.seed
    size = [setting.camera.width, setting.camera.height]

    def line(what: str, depth: int) -> dict[str, Any]:
        return {"scene": preset.name, "what": what, "depth": depth, "spp": spp, "size": size}

    for depth in options.depths:
        start = time.perf_counter()
        reference = foreground(setting, depth, spp, seed)
        middle = time.perf_counter()
        candidate = ours.foreground(setting, depth, spp, seed + 1, device)
        taken = {"mitsuba_s": middle - start, "ours_s": time.perf_counter() - middle}
        taken = {name: round(seconds, 2) for name, seconds in taken.items()}
        yield line("foreground", depth) | taken | compare_images(candidate, reference)
        write_sheet(options.output / f"{preset.name}_d{depth}.png", candidate, reference)
    for bounce in (0, *options.bounces):
        ratio = shadow_ratio(setting, spp, seed, bounce_depth=bounce)
        own = ours.shadow_ratio(setting, spp, seed + 1, device, bounce)
        seen = ratio.coverage
        ratio, own = comparable(ratio, seen), comparable(own, seen)
        yield line("shadow_ratio", bounce) | compare_images(own, ratio)
        name = f"{preset.name}_ratio" + f"_b{bounce}" * bool(bounce)
        write_sheet(options.output / f"{name}.png", own, ratio)


def main(arguments: list[str] | None = None) -> None:
    """Compare on the presets; write one sheet per scene and quantity, and ``referee.json``."""
    parser = flags(__doc__)
    parser.add_argument("--output", type=Path, default=Path("out/referee"))
    parser.add_argument("--scenes", nargs="*", default=[p.name for p in PRESETS])
    parser.add_argument("--depths", nargs="*", type=int, default=[1, 4])
    parser.add_argument("--bounces", nargs="*", type=int, default=[4], help="depths, beside none")
    parser.add_argument("--spp", type=int, default=1024, help="camera samples per pixel")
    parser.add_argument("--gradients", nargs="*", default=["spot_night", "truck_overcast"])
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    device = choose_device(options.device)
    options.output.mkdir(parents=True, exist_ok=True)
    pictures = (p for p in PRESETS if p.name in options.scenes)
    compared = (line for p in pictures for line in picture_lines(p, options, device))
    by_lobe = (
        gradient_line(p, options.assets, depth, options.spp, options.seed, device)
        for p in PRESETS
        if p.name in options.gradients
        for depth in options.depths
    )
    where = {"mitsuba": mi.__version__, "variant": mi.variant(), "device": device}
    path = options.json or options.output / "referee.json"
    path.unlink(missing_ok=True)
    for line in chain(compared, by_lobe):
        report(line | where, path)


if __name__ == "__main__":
    main()
