"""Does Mitsuba 3, given the same scene and light, render what warpir renders?

`foreground`, `shadow` and `foreground_gradient` are the reference; run as
``python -m benchmarks.referee`` this compares warpir with them on the presets and leaves one
sheet (ours, Mitsuba, difference) and one JSON line per scene and depth. Material, light and
integrator are written from the specifications, not from warpir's kernels.

Scenes are moved to the object's centre and scaled to unit radius, where float32 is best;
radiance does not notice. The environment is at infinity in both.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import warp as wp
from numpy.typing import NDArray

if mi.variant() is None:
    mi.set_variant("cuda_ad_rgb" if wp.is_cuda_available() else "llvm_ad_rgb")

import drjit as dr
from mitsuba.python.ad.integrators.common import mis_weight

from benchmarks import ours
from benchmarks.mitsuba_light import LatlongEmitter
from benchmarks.mitsuba_material import GltfBSDF
from benchmarks.mitsuba_path import GltfPath, intersect
from benchmarks.presets import PRESETS, ScenePreset
from benchmarks.sheet import compare_images, write_sheet
from warpir.asset import Asset, load_asset
from warpir.camera import Camera
from warpir.render import choose_device

FloatArray = NDArray[np.float64]

SAMPLES_PER_PASS = 1 << 21
"""Camera samples traced at once; bounds memory at about 1 GB."""


class Foreground(NamedTuple):
    """The object alone, averaged over all camera samples of each pixel."""

    mean: FloatArray
    """Radiance premultiplied by coverage, relative [W/(m^2 sr)], shape [H, W, 3]."""
    variance: FloatArray
    """Variance of ``mean``, shape [H, W, 3]."""
    coverage: FloatArray
    """Share of camera samples that see the object [1], shape [H, W]."""


class Shadow(NamedTuple):
    """A white Lambertian plane, averaged over the camera samples that see it."""

    lit: FloatArray
    """Radiance with the object, relative [W/(m^2 sr)], shape [H, W, 3]; NaN where unseen."""
    unoccluded: FloatArray
    """Radiance without it, relative [W/(m^2 sr)], shape [H, W, 3]; NaN where unseen."""
    lit_variance: FloatArray
    """Variance of ``lit``, shape [H, W, 3]."""
    unoccluded_variance: FloatArray
    """Variance of ``unoccluded``, shape [H, W, 3]."""
    covariance: FloatArray
    """Covariance of the two means: they share samples, shape [H, W, 3]."""
    seen: FloatArray
    """Share of camera samples that see the plane [1], shape [H, W]."""


@dataclass(frozen=True)
class RefereeScene:
    """A Mitsuba scene with what is needed to render it."""

    scene: mi.Scene
    sensor: mi.Sensor
    integrator: GltfPath
    center: FloatArray
    """World position that became the origin [m], shape [3]."""
    radius: float
    """World length that became 1 [m]."""


def build(
    asset: Asset, matrix: FloatArray, camera: Camera, texels: NDArray[np.float32], depth: int
) -> RefereeScene:
    """Build the Mitsuba scene of one object under one light.

    Args:
        asset: Object, asset frame [m].
        matrix: Asset to world, column vectors, shape [4, 4].
        camera: Pinhole with ``fx == fy``, world frame [m].
        texels: Lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3].
        depth: Surface interactions of the longest path.

    Raises:
        ValueError: Mitsuba's camera has square pixels only.
    """
    if not np.isclose(camera.fx, camera.fy, rtol=1e-6):
        raise ValueError(f"Mitsuba needs square pixels, got fx {camera.fx}, fy {camera.fy}")
    linear, offset = matrix[:3, :3], matrix[:3, 3]
    world = [p.positions @ linear.T + offset for p in asset.primitives]
    used = np.concatenate(
        [w[p.indices.ravel()] for w, p in zip(world, asset.primitives, strict=True)]
    )
    low, high = used.min(axis=0), used.max(axis=0)
    center, radius = 0.5 * (low + high), float(0.5 * np.linalg.norm(high - low))
    parts = {"type": "scene", "light": LatlongEmitter(texels)}
    for k, positions in enumerate(world):
        parts[f"primitive_{k}"] = _mesh(asset, k, (positions - center) / radius, linear)
    used_materials = [asset.materials[p.material] for p in asset.primitives]
    has_alpha = any(m.alpha_mode != "OPAQUE" or m.transmission > 0.0 for m in used_materials)
    integrator = mi.load_dict({"type": "gltf_path", "max_depth": depth + 1, "has_alpha": has_alpha})
    return RefereeScene(
        mi.load_dict(parts), _sensor(camera, center, radius), integrator, center, radius
    )


def foreground(
    asset: Asset,
    matrix: FloatArray,
    camera: Camera,
    texels: NDArray[np.float32],
    depth: int,
    spp: int,
    seed: int,
) -> Foreground:
    """Render the object alone under the light.

    Args:
        asset: Object, asset frame [m].
        matrix: Asset to world, shape [4, 4].
        camera: Pinhole camera, world frame [m].
        texels: Lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3].
        depth: Surface interactions of the longest path.
        spp: Camera samples per pixel, at least 2.
        seed: Base seed.
    """
    setup = build(asset, matrix, camera, texels, depth)
    shape = (camera.height, camera.width)
    moments = np.zeros((2, *shape, 3))
    hits = np.zeros(shape)
    count = 0
    for pass_seed, pass_spp in _passes(camera, spp, seed):
        with dr.suspend_grad():
            sampler, _ = setup.integrator.prepare(setup.sensor, pass_seed, pass_spp)
            ray, _, _ = setup.integrator.sample_rays(setup.scene, setup.sensor, sampler)
            L, seen, _, _ = setup.integrator.sample(
                dr.ADMode.Primal, setup.scene, sampler, ray, active=mi.Bool(True)
            )
        samples = np.asarray(L, dtype=np.float64).T.reshape(*shape, pass_spp, 3)
        moments += np.stack([samples.sum(axis=2), np.square(samples).sum(axis=2)])
        hits += np.asarray(seen).reshape(*shape, pass_spp).sum(axis=2)
        count += pass_spp
    mean, variance = _mean_and_variance(moments, np.full((*shape, 1), float(count)))
    return Foreground(mean, variance, hits / count)


def shadow(
    asset: Asset,
    matrix: FloatArray,
    camera: Camera,
    texels: NDArray[np.float32],
    spp: int,
    seed: int,
    height: float = 0.0,
) -> Shadow:
    """Render an infinite white plane, lit directly, with and without the object above it.

    Only camera samples that meet the plane before the object count; both radiances use the
    same ones, so their ratio is exactly 1 where nothing is blocked.

    Args:
        asset: Object, asset frame [m].
        matrix: Asset to world, shape [4, 4].
        camera: Pinhole camera above the plane, world frame [m].
        texels: Lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3].
        spp: Camera samples per pixel, at least 2.
        seed: Base seed.
        height: Height of the plane, world +Y [m].
    """
    setup = build(asset, matrix, camera, texels, 1)
    plane = float((height - setup.center[1]) / setup.radius)
    shape = (camera.height, camera.width)
    moments = np.zeros((2, *shape, 6))
    products = np.zeros((*shape, 3))
    hits = np.zeros((*shape, 1))
    for pass_seed, pass_spp in _passes(camera, spp, seed):
        with dr.suspend_grad():
            lit, unoccluded, seen = _trace_plane(setup, plane, pass_seed, pass_spp)
        both = np.concatenate([np.asarray(lit), np.asarray(unoccluded)]).astype(np.float64)
        samples = both.T.reshape(*shape, pass_spp, 6)
        moments += np.stack([samples.sum(axis=2), np.square(samples).sum(axis=2)])
        products += (samples[..., :3] * samples[..., 3:]).sum(axis=2)
        hits += np.asarray(seen).reshape(*shape, pass_spp, 1).sum(axis=2)
    mean, variance = _mean_and_variance(moments, hits)
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = (products / hits - mean[..., :3] * mean[..., 3:]) / (hits - 1.0)
    return Shadow(
        mean[..., :3],
        mean[..., 3:],
        variance[..., :3],
        variance[..., 3:],
        covariance,
        hits[..., 0] / spp,
    )


def foreground_gradient(
    asset: Asset,
    matrix: FloatArray,
    camera: Camera,
    texels: NDArray[np.float32],
    depth: int,
    spp: int,
    seed: int,
    d_image: FloatArray,
) -> FloatArray:
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
    for pass_seed, pass_spp in _passes(camera, spp, seed):
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


def shadow_ratio(
    asset: Asset,
    matrix: FloatArray,
    camera: Camera,
    texels: NDArray[np.float32],
    spp: int,
    seed: int,
) -> ours.Ratio:
    """Return the quotient of `shadow`'s two radiances, 1 where the plane is not seen."""
    plane = shadow(asset, matrix, camera, texels, spp, seed)
    seen = np.isfinite(plane.lit) & (plane.unoccluded > 0.0)
    u = np.where(seen, plane.unoccluded, 1.0)
    ratio = np.where(seen, np.where(seen, plane.lit, 0.0) / u, 1.0)
    residual = (
        plane.lit_variance - 2.0 * ratio * plane.covariance + ratio**2 * plane.unoccluded_variance
    )
    variance = np.where(seen & np.isfinite(residual), np.maximum(residual, 0.0) / u**2, 0.0)
    return ours.Ratio(ratio, variance, plane.seen)


def comparable(image: ours.Ratio, seen: FloatArray, floor: float = 1e-4) -> ours.Ratio:
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
    of both is carried to the lobes by the same adjoint of `warpir.bridge.rasterize`.
    """
    import torch

    from warpir.bridge import rasterize
    from warpir.integrator import LightTensors
    from warpir.lobe_fit import fit_lobes
    from warpir.mis import MisIntegrator

    asset = load_asset(assets / preset.asset)
    lobes = fit_lobes(preset.texels(assets), 32).lobes
    leaves = [
        torch.tensor(a, requires_grad=True)
        for a in (lobes.amplitude, lobes.axis, np.minimum(lobes.sharpness, 2000.0))
    ]
    texels = rasterize(*leaves, 64, device)
    camera = preset.camera()
    row, column = np.mgrid[0 : camera.height, 0 : camera.width] / camera.height
    d_image = np.stack([0.5 + row, 0.5 + column, 1.5 - row], axis=-1)
    setting = asset, preset.matrix(asset), camera

    def to_lobes(d_texels: NDArray[np.floating[Any]]) -> list[FloatArray]:
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
    own: list[list[FloatArray]] = []
    start = time.perf_counter()
    for k in range(2):
        total = np.zeros(fixed.shape)
        for run in range(max(1, half // 64)):
            leaf = torch.tensor(fixed, requires_grad=True)
            light = LightTensors(texels=leaf)
            image = mis.radiance(light, light, seed=1000 * (k + 1) + run).foreground
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


def _mesh(asset: Asset, index: int, positions: FloatArray, linear: FloatArray) -> mi.Mesh:
    """Mitsuba mesh of one primitive, unit frame, without texture coordinates (see `GltfBSDF`)."""
    primitive = asset.primitives[index]
    bsdf = GltfBSDF(asset, primitive, linear)
    properties = mi.Properties()
    properties["material"] = bsdf
    flat = primitive.normals is None
    properties["face_normals"] = flat
    mesh = mi.Mesh(
        f"primitive_{index}",
        len(positions),
        len(primitive.indices),
        properties,
        has_vertex_normals=not flat,
        has_vertex_texcoords=False,
    )
    parameters = mi.traverse(mesh)
    parameters["faces"] = bsdf.indices
    parameters["vertex_positions"] = mi.Float(positions.astype(np.float32).ravel())
    parameters.update()
    if not flat:
        # On its own: changing positions makes Mitsuba recompute the normals
        normals = primitive.normals.astype(np.float64) @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        parameters["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
        parameters.update()
    return mesh


def _sensor(camera: Camera, center: FloatArray, radius: float) -> mi.Sensor:
    """Mitsuba camera in the unit frame: +Z forward, +X left, box filter."""
    c2w = camera.c2w.copy()
    c2w[:3, 3] = (c2w[:3, 3] - center) / radius
    width, height = camera.width, camera.height
    return mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(c2w @ np.diag([-1.0, 1.0, -1.0, 1.0])),
            "fov_axis": "x",
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * width / camera.fx))),
            "principal_point_offset_x": (0.5 * width - camera.cx) / width,
            "principal_point_offset_y": (0.5 * height - camera.cy) / height,
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent"},
        }
    )


def _passes(camera: Camera, spp: int, seed: int) -> Iterator[tuple[int, int]]:
    """Seed and samples per pixel of each pass."""
    largest = max(1, SAMPLES_PER_PASS // (camera.width * camera.height))
    count = -(-spp // largest)
    for k in range(count):
        yield (seed * 65537 + k) % (1 << 32), spp * (k + 1) // count - spp * k // count


def _mean_and_variance(moments: FloatArray, count: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean, and variance of the mean, from sums of samples and of their squares."""
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = moments[0] / count
        variance = np.maximum(moments[1] / count - np.square(mean), 0.0) / (count - 1.0)
    return mean, variance


def _trace_plane(
    setup: RefereeScene, plane: float, seed: int, spp: int
) -> tuple[mi.Color3f, mi.Color3f, mi.Bool]:
    """Sample plane radiance with and without the object, 0 where the plane is not seen."""
    scene, integrator = setup.scene, setup.integrator
    sampler, _ = integrator.prepare(setup.sensor, seed, spp)
    ray, _, _ = integrator.sample_rays(scene, setup.sensor, sampler)
    ray = mi.Ray3f(ray)
    has_alpha = integrator.has_alpha

    # Which comes first
    t = (plane - ray.o.y) / ray.d.y
    meets = (t > 0.0) & dr.isfinite(t)
    si = intersect(scene, ray, sampler, True, has_alpha, mi.Bool(True))
    nearer = si.is_valid() & (dr.dot(si.p - ray.o, ray.d) < t)
    seen = meets & ~nearer

    # Direct light on white: f cos_i = cos_i / pi, upper side
    it = dr.zeros(mi.SurfaceInteraction3f, dr.width(t))
    it.p = ray(dr.select(seen, t, 0.0))
    it.p.y = plane
    it.n = mi.Normal3f(0.0, 1.0, 0.0)
    frame = mi.Frame3f(it.n)

    def visible(d: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        start = mi.Point3f(it.p.x, it.p.y + 1e-5, it.p.z)
        return ~intersect(scene, mi.Ray3f(start, d), sampler, False, has_alpha, active).is_valid()

    ds, em_weight = scene.sample_emitter_direction(it, sampler.next_2d(), False, seen)
    cos_i = dr.maximum(ds.d.y, 0.0)
    by_light = em_weight * cos_i * dr.inv_pi * mis_weight(ds.pdf, cos_i * dr.inv_pi)
    active = seen & (cos_i > 0.0)
    by_light = dr.select(active, by_light, 0.0)
    unblocked_light = visible(ds.d, active)

    d = frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    cos_i = dr.maximum(d.y, 0.0)
    ds = dr.zeros(mi.DirectionSample3f, dr.width(t))
    ds.d = d
    ds.emitter = mi.EmitterPtr(scene.environment())
    by_cosine = scene.eval_emitter_direction(it, ds, seen) * mis_weight(
        cos_i * dr.inv_pi, scene.pdf_emitter_direction(it, ds, seen)
    )
    by_cosine = dr.select(seen & (cos_i > 0.0), by_cosine, 0.0)
    unblocked_cosine = visible(d, seen)
    lit = dr.select(unblocked_light, by_light, 0.0) + dr.select(unblocked_cosine, by_cosine, 0.0)
    return lit, by_light + by_cosine, seen


if __name__ == "__main__":
    main()
