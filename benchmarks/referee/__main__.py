"""Does Mitsuba 3, given the same scene and light, render what warpir renders?

`foreground`, `shadow` and `foreground_gradient` are the reference; run as
``python -m benchmarks.referee`` this compares warpir with them on the presets and leaves one
sheet (ours, Mitsuba, difference) and one JSON line per scene and depth. Material, light and
integrator are written from the specifications, not from warpir's kernels
(`warpir.mitsuba.render`).
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.presets import PRESETS, ScenePreset
from benchmarks.referee import ours
from benchmarks.referee.sheet import compare_images, write_sheet
from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray
from warpir.core.latlong import map_directions
from warpir.io.assets import load_asset
from warpir.mitsuba.render import (
    Ratio,
    build,
    foreground,
    passes,
    shadow_ratio,
)
from warpir.render.device import choose_device
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera


def foreground_gradient(
    asset: Asset,
    matrix: Float64Array,
    camera: Camera,
    texels: FloatArray,
    depth: int,
    spp: int,
    seed: int,
    d_image: Float64Array,
) -> Float64Array:
    """Gradient of ``sum(mean * d_image)`` with respect to the light, by path replay.

    Args:
        asset: Object, asset frame [m].
        matrix: Asset to world, shape [4, 4].
        camera: Pinhole camera, world frame [m].
        texels: Lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3].
        depth: Surface interactions of the longest path.
        spp: Camera samples per pixel.
        seed: Base seed.
        d_image: Loss gradient of ``Foreground.mean``, shape [H, W, 3].

    Returns:
        ``d_texels``, shape [He, We, 3].
    """
    setup = build(asset, matrix, camera, texels, depth)
    parameters = mi.traverse(setup.scene)
    dr.enable_grad(parameters["light.texels"])
    parameters.update()
    d_texels = np.zeros(texels.shape)
    for pass_seed, pass_spp in passes(camera, spp, seed):
        dr.set_grad(parameters["light.texels"], 0.0)
        setup.integrator.render_backward(
            setup.scene,
            parameters,
            mi.TensorXf(np.asarray(d_image, dtype=np.float32)),
            setup.sensor,
            pass_seed,
            pass_spp,
        )
        d_texels += np.asarray(dr.grad(parameters["light.texels"]), dtype=np.float64) * pass_spp
    return d_texels / spp


def comparable(image: Ratio, seen: Float64Array, floor: float = 1e-4) -> Ratio:
    """Keep the pixels that see the plane with half of their samples or more.

    ``floor`` is added to the standard errors: a handful of rare events has no honest variance.
    """
    used = (seen >= 0.5)[..., None]
    touched = image.variance > 0.0
    return image._replace(
        mean=np.where(used, image.mean, 1.0),
        variance=np.where(used, image.variance + touched * floor**2, 0.0),
        coverage=used[..., 0].astype(float),
    )


def gradient_line(
    preset: ScenePreset, assets: Path, depth: int, spp: int, seed: int, device: str
) -> dict[str, Any]:
    """Compare lobe gradients through a rasterised map: ours against path replay in Mitsuba.

    The loss is ``sum(foreground * d_image)`` with colour ramps for ``d_image``; the map's gradient
    of both is carried to the lobes by the same adjoint, of the lobes at the texels' centres.
    """
    import torch

    from warpir.lighting.fit import fit_lobes
    from warpir.render.mis import MisIntegrator

    asset = load_asset(assets / preset.asset)
    lobes = fit_lobes(preset.texels(assets), 32).lobes
    leaves = [
        torch.tensor(a, requires_grad=True)
        for a in (lobes.amplitude, lobes.axis, np.minimum(lobes.sharpness, 2000.0))
    ]
    amplitude, axis, sharpness = leaves
    toward = torch.tensor(map_directions(64, 128), dtype=torch.float32)
    texels = torch.exp((toward @ axis.T - 1.0) * sharpness) @ amplitude
    camera = preset.camera()
    row, column = np.mgrid[0 : camera.height, 0 : camera.width] / camera.height
    d_image = np.stack([0.5 + row, 0.5 + column, 1.5 - row], axis=-1)
    setting = asset, preset.matrix(asset), camera

    def to_lobes(d_texels: AnyFloatArray) -> list[Float64Array]:
        grads = torch.autograd.grad(
            texels, leaves, torch.tensor(d_texels, dtype=torch.float32), retain_graph=True
        )
        return [g.double().numpy() for g in grads]

    fixed = texels.detach().numpy()
    half = spp // 2
    start = time.perf_counter()
    theirs = [
        to_lobes(foreground_gradient(*setting, fixed, depth, half, seed + k, d_image))
        for k in range(2)
    ]
    theirs_s = time.perf_counter() - start
    renderer = ours.renderer(*setting, device)
    pixels = renderer.candidate_pixels(camera)
    mis = MisIntegrator(renderer, pixels, np.zeros(0, np.int32), spp=64, rays=1, depth=depth)
    weight = torch.tensor(d_image.reshape(-1, 3)[pixels], dtype=torch.float32)
    own: list[list[Float64Array]] = []
    start = time.perf_counter()
    for k in range(2):
        total = np.zeros(fixed.shape)
        for run in range(max(1, half // 64)):
            leaf = torch.tensor(fixed, requires_grad=True)
            image = mis.radiance(leaf, leaf, seed=1000 * (k + 1) + run).foreground
            (image * weight).sum().backward()
            assert leaf.grad is not None
            total += leaf.grad.double().numpy()
        own.append(to_lobes(total / max(1, half // 64)))
    ours_s = time.perf_counter() - start
    line: dict[str, Any] = {"scene": preset.name, "what": "gradient", "depth": depth, "spp": spp}
    for name, k in (("amplitude", 0), ("axis", 1), ("sharpness", 2)):
        a = 0.5 * (own[0][k] + own[1][k]).ravel()
        b = 0.5 * (theirs[0][k] + theirs[1][k]).ravel()
        noise = 0.25 * (
            np.square(own[0][k] - own[1][k]).sum() + np.square(theirs[0][k] - theirs[1][k]).sum()
        )
        size = float(np.linalg.norm(b))
        line[name] = {
            "relative_l2": float(np.linalg.norm(a - b)) / size,
            "noise_l2": float(np.sqrt(noise)) / size,
            "cosine": float(a @ b / np.linalg.norm(a) / size),
        }
    return {**line, "mitsuba_s": round(theirs_s, 2), "ours_s": round(ours_s, 2)}


def main(arguments: list[str] | None = None) -> None:
    """Compare on the presets; write one sheet per scene and quantity, and ``referee.json``."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--assets",
        type=Path,
        default=Path("../shared/data"),
        help="folder that holds mesh/ and hdri/",
    )
    parser.add_argument("--output", type=Path, default=Path("out/referee"))
    parser.add_argument("--scenes", nargs="*", default=[p.name for p in PRESETS])
    parser.add_argument("--depths", nargs="*", type=int, default=[1, 4])
    parser.add_argument("--spp", type=int, default=1024, help="camera samples per pixel")
    parser.add_argument("--gradients", nargs="*", default=["spot_night", "truck_overcast"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default=None)
    options = parser.parse_args(arguments)
    device = choose_device(options.device)
    options.output.mkdir(parents=True, exist_ok=True)
    lines: list[dict[str, Any]] = []

    def keep(line: dict[str, Any]) -> None:
        line |= {"mitsuba": mi.__version__, "variant": mi.variant(), "device": device}
        lines.append(line)
        print(json.dumps(line), flush=True)

    for preset in (p for p in PRESETS if p.name in options.scenes):
        asset = load_asset(options.assets / preset.asset)
        setting = asset, preset.matrix(asset), preset.camera(), preset.texels(options.assets)
        size = [preset.width, preset.height]
        for depth in options.depths:
            start = time.perf_counter()
            reference = foreground(*setting, depth, options.spp, options.seed)
            middle = time.perf_counter()
            candidate = ours.foreground(*setting, depth, options.spp, options.seed + 1, device)
            end = time.perf_counter()
            keep(
                {
                    "scene": preset.name,
                    "what": "foreground",
                    "depth": depth,
                    "spp": options.spp,
                    "size": size,
                    "mitsuba_s": round(middle - start, 2),
                    "ours_s": round(end - middle, 2),
                    **compare_images(candidate, reference),
                }
            )
            write_sheet(options.output / f"{preset.name}_d{depth}.png", candidate, reference)
        ratio = shadow_ratio(*setting, options.spp, options.seed)
        own = ours.shadow_ratio(*setting, options.spp, options.seed + 1, device)
        seen = ratio.coverage
        ratio, own = comparable(ratio, seen), comparable(own, seen)
        keep(
            {
                "scene": preset.name,
                "what": "shadow_ratio",
                "spp": options.spp,
                "size": size,
                **compare_images(own, ratio),
            }
        )
        write_sheet(options.output / f"{preset.name}_ratio.png", own, ratio)
    for preset in (p for p in PRESETS if p.name in options.gradients):
        for depth in options.depths:
            keep(gradient_line(preset, options.assets, depth, options.spp, options.seed, device))
    (options.output / "referee.json").write_text("\n".join(map(json.dumps, lines)) + "\n")


if __name__ == "__main__":
    main()
