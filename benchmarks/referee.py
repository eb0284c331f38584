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
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

if mi.variant() is None:
    mi.set_variant("llvm_ad_rgb")

import drjit as dr
from mitsuba.python.ad.integrators.common import mis_weight

from benchmarks.mitsuba_light import LatlongEmitter
from benchmarks.mitsuba_material import GltfBSDF
from benchmarks.mitsuba_path import GltfPath, intersect
from benchmarks.presets import PRESETS, ScenePreset
from benchmarks.sheet import compare_images, write_sheet
from warpir.asset import Asset, load_asset
from warpir.camera import Camera

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
    has_alpha = any(asset.materials[p.material].alpha_mode != "OPAQUE" for p in asset.primitives)
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


def ours(preset: ScenePreset, depth: int, samples: int, seed: int) -> Foreground:
    """Render the preset's object with warpir.

    Raises:
        NotImplementedError: Until `warpir.render` is wired in here.
    """
    raise NotImplementedError("warpir.render is not wired into benchmarks.referee.ours yet")


def main(arguments: list[str] | None = None) -> None:
    """Compare on the presets; write ``referee.png`` per scene and depth and ``referee.json``."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--assets",
        type=Path,
        default=Path("../shared/data"),
        help="folder that holds mesh/ and hdri/",
    )
    parser.add_argument("--output", type=Path, default=Path("runs/referee"))
    parser.add_argument("--scenes", nargs="*", default=[p.name for p in PRESETS])
    parser.add_argument("--depths", nargs="*", type=int, default=[1, 4])
    parser.add_argument("--spp", type=int, default=256, help="camera samples per pixel")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--self-check",
        action="store_true",
        help="compare Mitsuba with itself at another seed: the statistics' null",
    )
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    lines = []
    for preset in (p for p in PRESETS if p.name in options.scenes):
        asset = load_asset(options.assets / preset.asset)
        texels = preset.texels(options.assets)
        setting = asset, preset.matrix(asset), preset.camera(), texels
        for depth in options.depths:
            start = time.perf_counter()
            reference = foreground(*setting, depth, options.spp, options.seed)
            seconds = time.perf_counter() - start
            if options.self_check:
                candidate = foreground(*setting, depth, options.spp, options.seed + 1)
            else:
                candidate = ours(preset, depth, options.spp, options.seed + 1)
            line = {
                "scene": preset.name,
                "depth": depth,
                "spp": options.spp,
                "size": [preset.width, preset.height],
                "mitsuba": mi.__version__,
                "variant": mi.variant(),
                "reference_s": round(seconds, 2),
                **compare_images(candidate, reference),
            }
            write_sheet(options.output / f"{preset.name}_d{depth}.png", candidate, reference)
            lines.append(line)
            print(json.dumps(line), flush=True)
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
