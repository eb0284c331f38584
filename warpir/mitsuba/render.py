"""Rendering of an insertion by Mitsuba 3: object, shadow, and a run's composite.

`foreground` and `shadow` are what ``benchmarks/referee/__main__.py`` judges warpir by; `render_run`
puts them together as a run with ``--mitsuba`` was, for the ``render.py`` in its folder. Material,
light and integrator are written from the specifications, not from warpir's kernels.

Scenes are moved to the object's centre and scaled to unit radius, where float32 is best;
radiance does not notice. The environment is at infinity in both.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

if mi.variant() is None:
    mi.set_variant("cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb")


from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import codes_of, linear_to_gamma, linear_to_srgb
from warpir.io.assets import load_asset
from warpir.io.cameras.reader import read_camera
from warpir.io.curves_file import read_curves
from warpir.io.export import OBJECT
from warpir.io.images.photos import read_envmap
from warpir.io.images.writers import png_bytes
from warpir.mitsuba.light import LatlongEmitter
from warpir.mitsuba.material import GltfBSDF
from warpir.mitsuba.plane import ObjectScene, trace_plane
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera, mitsuba_sensor
from warpir.scene.near.lamps import Lamp, RectangleLamp

SAMPLES_PER_PASS = 1 << 21
"""Camera samples traced at once; bounds memory at about 1 GB."""
HORIZON = 1e5
"""Where a ground of finite size ends, in radii of the object."""


class Setting(NamedTuple):
    """An object before a camera under one light."""

    asset: Asset
    """Object, asset frame [m]."""
    matrix: Float64Array
    """Asset to world, column vectors, shape [4, 4]."""
    camera: Camera
    """Pinhole with ``fx == fy``, world frame [m]."""
    texels: FloatArray
    """Lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3]."""


class Foreground(NamedTuple):
    """The object alone, averaged over all camera samples of each pixel."""

    mean: Float64Array
    """Radiance premultiplied by coverage, relative [W/(m^2 sr)], shape [H, W, 3]."""
    variance: Float64Array
    """Variance of ``mean``, shape [H, W, 3]."""
    coverage: Float64Array
    """Share of camera samples that see the object [1], shape [H, W]."""


class Shadow(NamedTuple):
    """A white Lambertian plane, averaged over the camera samples that see it."""

    lit: Float64Array
    """Radiance with the object, relative [W/(m^2 sr)], shape [H, W, 3]; NaN where unseen."""
    unoccluded: Float64Array
    """Radiance without it, relative [W/(m^2 sr)], shape [H, W, 3]; NaN where unseen."""
    lit_variance: Float64Array
    """Variance of ``lit``, shape [H, W, 3]."""
    unoccluded_variance: Float64Array
    """Variance of ``unoccluded``, shape [H, W, 3]."""
    covariance: Float64Array
    """Covariance of the two means: they share samples, shape [H, W, 3]."""
    seen: Float64Array
    """Share of camera samples that see the plane [1], shape [H, W]."""


class Ratio(NamedTuple):
    """Quotient of a plane's two radiances; 1 where it is not seen."""

    mean: Float64Array
    """Ratio [1], shape [H, W, 3]."""
    variance: Float64Array
    """Variance of ``mean``, shape [H, W, 3]."""
    coverage: Float64Array
    """Share of camera samples that see the plane [1], shape [H, W]."""


def build(
    asset: Asset,
    matrix: Float64Array,
    camera: Camera,
    texels: FloatArray,
    depth: int,
    ground: tuple[float, float, float, float] | None = None,
    albedo: float = 0.0,
    lamps: Sequence[Lamp] = (),
    horizon: float = HORIZON,
    coat: float | None = None,
) -> ObjectScene:
    """Build the Mitsuba scene of one object under one light.

    Args:
        asset: Object, asset frame [m].
        matrix: Asset to world, column vectors, shape [4, 4].
        camera: Pinhole with ``fx == fy``, world frame [m].
        texels: Lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3].
        depth: Surface interactions of the longest path.
        ground: Plane ``a x + b y + c z + d = 0`` with a unit normal, world frame [m].
        albedo: Of the plane [1].
        lamps: Near the object, as surfaces that shine: they block light, and `GltfPath` knows none.
        horizon: Where the plane ends, in radii of the object, which is how coarse its points are
            over 1e7.
        coat: Perceptual roughness of a dielectric over a black plane in place of ``albedo`` [1].

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
    if ground is not None:
        normal, offset = _in_unit_frame(ground, center, radius)
        to_plane = mi.ScalarTransform4f().look_at(
            origin=normal * offset, target=normal * (offset + 1.0), up=np.roll(normal, 1)
        )
        parts["ground"] = {
            "type": "disk",  # a rectangle is two triangles, whose corners round where they slope
            "to_world": to_plane @ mi.ScalarTransform4f().scale([horizon, horizon, 1.0]),
            "bsdf": _matt(albedo) if coat is None else _coat(coat),
        }
    for k, lamp in enumerate(lamps):
        parts[f"lamp_{k}"] = _emitter(lamp, center, radius)
    used_materials = [asset.materials[p.material] for p in asset.primitives]
    has_alpha = any(m.alpha_mode != "OPAQUE" or m.transmission > 0.0 for m in used_materials)
    integrator = mi.load_dict({"type": "gltf_path", "max_depth": depth + 1, "has_alpha": has_alpha})
    return ObjectScene(
        mi.load_dict(parts), sensor_of(camera, center, radius), integrator, center, radius
    )


def foreground(setting: Setting, depth: int, spp: int, seed: int) -> Foreground:
    """Render the object alone under the light."""
    setup = build(*setting, depth)

    def trace(seed: int, spp: int) -> tuple[mi.Color3f, mi.Bool]:
        sampler, _ = setup.integrator.prepare(setup.sensor, seed, spp)
        ray, _, _ = setup.integrator.sample_rays(setup.scene, setup.sensor, sampler)
        L, seen, _, _ = setup.integrator.sample(
            dr.ADMode.Primal, setup.scene, sampler, ray, active=mi.Bool(True)
        )
        return L, seen

    moments, hits = sums(setting.camera, spp, seed, trace)
    return Foreground(*mean_and_variance(moments, spp), hits[..., 0] / spp)


def shadow(
    setting: Setting,
    spp: int,
    seed: int,
    ground: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0),
    bounce_depth: int = 0,
) -> Shadow:
    """Render an infinite white plane with and without the object above it.

    Only camera samples that meet the plane before the object count; both radiances use the
    same ones, so their ratio is exactly 1 where nothing is blocked. It is lit directly and, with a
    ``bounce_depth``, by paths of that many interactions with the object over black ground.

    Args:
        setting: The object, its light, and a camera on the side of the plane's normal.
        spp: Camera samples per pixel, at least 2.
        seed: Base seed.
        ground: Plane ``a x + b y + c z + d = 0`` with a unit normal, world frame [m].
        bounce_depth: Interactions of light that the object throws onto the plane; 0 for none.
    """
    setup = build(*setting, 1)
    normal, offset = _in_unit_frame(ground, setup.center, setup.radius)
    bounce = build(*setting, bounce_depth, ground) if bounce_depth else None

    def trace(seed: int, spp: int) -> tuple[Float64Array, mi.Bool]:
        lit, unoccluded, seen = trace_plane(setup, normal, offset, seed, spp, bounce)
        a, u = (np.asarray(L, np.float64) for L in (lit, unoccluded))
        return np.concatenate([a, u, a * u]), seen

    moments, hits = sums(setting.camera, spp, seed, trace)
    mean, variance = mean_and_variance(moments, hits)
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = (mean[..., 6:] - mean[..., :3] * mean[..., 3:6]) / (hits - 1.0)
    return Shadow(
        mean[..., :3],
        mean[..., 3:6],
        variance[..., :3],
        variance[..., 3:6],
        covariance,
        hits[..., 0] / spp,
    )


def shadow_ratio(
    setting: Setting,
    spp: int,
    seed: int,
    ground: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0),
    bounce_depth: int = 0,
) -> Ratio:
    """Return the quotient of `shadow`'s two radiances; arguments are `shadow`'s."""
    plane = shadow(setting, spp, seed, ground, bounce_depth)
    seen = np.isfinite(plane.lit) & (plane.unoccluded > 0.0)
    u = np.where(seen, plane.unoccluded, 1.0)
    ratio = np.where(seen, np.where(seen, plane.lit, 0.0) / u, 1.0)
    residual = (
        plane.lit_variance - 2.0 * ratio * plane.covariance + ratio**2 * plane.unoccluded_variance
    )
    variance = np.where(seen & np.isfinite(residual), np.maximum(residual, 0.0) / u**2, 0.0)
    return Ratio(ratio, variance, plane.seen)


def _in_unit_frame(
    ground: tuple[float, float, float, float], center: Float64Array, radius: float
) -> tuple[Float64Array, float]:
    """Return normal and offset of the plane ``dot(normal, x) = offset`` in the scene's frame."""
    normal = np.asarray(ground[:3])
    return normal, float(-(ground[3] + normal @ center) / radius)


def _matt(albedo: float) -> dict[str, object]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}


def _coat(roughness: float) -> dict[str, object]:
    """Return a dielectric coat over black; Mitsuba's shadowing is separable, ours correlated."""
    coat = {"int_ior": 1.5, "ext_ior": 1.0, "diffuse_reflectance": {"type": "rgb", "value": 0.0}}
    if roughness == 0.0:
        return {"type": "plastic"} | coat
    return {"type": "roughplastic", "distribution": "ggx", "alpha": roughness**2} | coat


def _emitter(lamp: Lamp, center: Float64Array, radius: float) -> dict[str, object]:
    """Return a black surface that shines as a lamp does, unit frame."""
    color = {"type": "rgb", "value": [float(c) for c in lamp.radiance]}
    to_world = np.eye(4)
    to_world[:3, 3] = (lamp.center - center) / radius
    kind = "sphere"
    if isinstance(lamp, RectangleLamp):
        kind = "rectangle"
        to_world[:3, 0] = lamp.edge_x / (2.0 * radius)
        to_world[:3, 1] = lamp.edge_y / (2.0 * radius)
        normal = np.cross(lamp.edge_x, lamp.edge_y)
        to_world[:3, 2] = normal / np.linalg.norm(normal)
    else:
        to_world[:3, :3] *= lamp.radius / radius
    return {
        "type": kind,
        "to_world": mi.ScalarTransform4f(to_world),
        "emitter": {"type": "area", "radiance": color},
        "bsdf": _matt(0.0),
    }


def _mesh(asset: Asset, index: int, positions: Float64Array, linear: Float64Array) -> mi.Mesh:
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


def sensor_of(
    camera: Camera, center: Float64Array, radius: float, sampler: str = "independent", **crop: int
) -> mi.Sensor:
    """Mitsuba camera in the unit frame, box filter; ``crop`` is the film's, as ``crop_width``."""
    c2w = camera.c2w.copy()
    c2w[:3, 3] = (c2w[:3, 3] - center) / radius
    view = mitsuba_sensor(replace(camera, c2w=c2w))
    return mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(view["to_world"]),
            "fov_axis": "x",
            "fov": view["fov_deg"],
            "principal_point_offset_x": view["principal_point_offset_x"],
            "principal_point_offset_y": view["principal_point_offset_y"],
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
                **crop,
            },
            "sampler": {"type": sampler},
        }
    )


def passes(camera: Camera, spp: int, seed: int) -> Iterator[tuple[int, int]]:
    """Seed and samples per pixel of each pass."""
    largest = max(1, SAMPLES_PER_PASS // (camera.width * camera.height))
    count = -(-spp // largest)
    for k in range(count):
        yield (seed * 65537 + k) % (1 << 32), spp * (k + 1) // count - spp * k // count


def sums(
    camera: Camera,
    spp: int,
    seed: int,
    trace: Callable[[int, int], tuple[mi.Color3f | Float64Array, mi.Bool]],
) -> tuple[Float64Array, Float64Array]:
    """Add up the camera samples of each pixel.

    Args:
        camera: Whose film is traced.
        spp: Samples per pixel.
        seed: Base seed.
        trace: Given the seed and the samples of a pass, returns values, shape [value, sample], and
            whether a sample counts.

    Returns:
        Sums of the values and of their squares, shape [2, H, W, value], and the number of samples
        that count, shape [H, W, 1].
    """
    shape = (camera.height, camera.width)
    moments, hits = np.zeros(()), np.zeros((*shape, 1))
    for pass_seed, pass_spp in passes(camera, spp, seed):
        with dr.suspend_grad():
            values, counts = trace(pass_seed, pass_spp)
        samples = np.asarray(values, dtype=np.float64).T.reshape(*shape, pass_spp, -1)
        moments = moments + np.stack([samples.sum(axis=2), np.square(samples).sum(axis=2)])
        hits += np.asarray(counts).reshape(*shape, pass_spp, 1).sum(axis=2)
    return moments, hits


def mean_and_variance(
    moments: Float64Array, count: Float64Array | float
) -> tuple[Float64Array, Float64Array]:
    """Mean, and variance of the mean, from sums of samples and of their squares."""
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = moments[0] / count
        variance = np.maximum(moments[1] / count - np.square(mean), 0.0) / (count - 1.0)
    return mean, variance


# -------------------------------------------------------------------------------- a whole run


class Composite(NamedTuple):
    """A run's picture as Mitsuba renders it, display-linear, shape [H, W, 3]."""

    mean: Float64Array
    error: Float64Array
    """Standard error of ``mean``, to first order through the tone curves."""


def render_run(
    folder: Path,
    ground: tuple[float, float, float, float],
    depth: int,
    spp: int,
    seed: int,
    bounce_depth: int = 0,
) -> Composite:
    """Render object and shadow of a finished run and put them into its photo.

    Read are its light, camera, curves, placed object and the layer ``plate``, of a folder that is
    complete with the files of its hand-off. Ground, samples and ``bounce_depth`` are those of
    `shadow`; the longest path interacts with ``depth`` surfaces.

    Raises:
        InputError: A file of the run is missing or damaged.
    """
    plate = _plate(folder / "layers.exr")
    camera = read_camera(folder / "camera.json", (plate.shape[1], plate.shape[0]))
    curves = read_curves(folder / "curves.json")
    setting = Setting(load_asset(folder / OBJECT), np.eye(4), camera, _light(folder, "detail"))
    lit = foreground(setting, depth, spp, seed)
    coverage = lit.coverage[..., None]
    share = np.where(coverage > 0.0, coverage, 1.0)

    def tone(radiance: Float64Array) -> Float64Array:
        if not curves.is_clipped:
            return curves.shown(radiance)
        x = radiance / (1.0 + radiance) if curves.tone == "reinhard" else radiance
        return curves.foreground.evaluate(x)[..., 0]

    displayed, slope = _through(tone, lit.mean / share)
    setting = setting._replace(texels=_light(folder, "shadow"))
    plane = shadow_ratio(setting, spp, seed + 1, ground, bounce_depth)

    ratio, ratio_slope = _through(curves.shadow_ratio.evaluate_ratio, plane.mean)
    behind = (1.0 - coverage) * plate
    variance = slope**2 * lit.variance + (behind * ratio_slope) ** 2 * plane.variance
    return Composite(displayed * coverage + behind * ratio, np.sqrt(variance))


def _light(folder: Path, name: str) -> FloatArray:
    """Return the map of one use, where it has one of its own, else that of all."""
    own = folder / f"envmap_{name}.exr"
    return read_envmap(own if own.exists() else folder / "envmap.exr")


def write_composite(path: Path, composite: Composite, is_plate: bool) -> None:
    """Write ``<path>.png``, and ``<path>.exr`` with the standard error in ``error.R/G/B``.

    The PNG of a scene-linear plate has the sRGB curve, as the run's own.
    """
    names = [*"RGB", *(f"error.{c}" for c in "RGB")]
    pixels = np.concatenate(composite, axis=-1).astype(np.float32)
    mi.Bitmap(pixels, channel_names=names).write(str(path.with_suffix(".exr")))
    codes = codes_of((linear_to_srgb if is_plate else linear_to_gamma)(composite.mean))
    path.with_suffix(".png").write_bytes(png_bytes(codes, None, True, "Rendered by Mitsuba 3"))


def main(
    folder: Path,
    ground: tuple[float, float, float, float],
    depth: int,
    bounce_depth: int = 0,
) -> None:
    """Run ``render.py`` of a run's folder; its command line has ``--samples`` and ``--seed``.

    The other numbers are those of `render_run`.
    """
    parser = argparse.ArgumentParser(description="Render this insertion with Mitsuba 3.")
    parser.add_argument("--samples", type=int, default=256, help="camera samples per pixel")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    composite = render_run(folder, ground, depth, options.samples, options.seed, bounce_depth)
    path = folder / "mitsuba" / "composite"
    write_composite(path, composite, not read_curves(folder / "curves.json").is_clipped)
    noisy = composite.error[composite.error > 0.0]
    print(f"{path}.png and .exr: standard error {np.median(noisy):.2g} in the median pixel")


def _through(
    curve: Callable[[Float64Array], Float64Array], x: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return a curve's values and its slopes, by central differences."""
    step = 1e-4
    return curve(x), (curve(x + step) - curve(np.maximum(x - step, 0.0))) / (2.0 * step)


def _plate(path: Path) -> Float64Array:
    """Return the linearised photo out of a file of layers, shape [H, W, 3]."""
    bitmap = mi.Bitmap(str(path))
    names = [field.name for field in bitmap.struct_()]
    planes = [names.index(f"plate.{c}") for c in "RGB"]
    plate: Float64Array = np.array(bitmap)[..., planes].astype(np.float64)
    return plate
