"""Is the referee right? Closed forms, stock integrators and chi-square tests.

Run as ``python -m benchmarks.referee.checks``; prints one line per check with the measured
value, the expected one and the error in standard errors, and fails at the first that is wrong.
"""

import io
from contextlib import redirect_stdout
from dataclasses import replace

import numpy as np

from benchmarks.referee.subjects import sphere, square, sun_and_sky, view
from tests.builders import shapes
from tests.oracles import bilinear_lookup, gltf_albedo, latlong_uv, rectangle_ratio
from warpir.core.arrays import FloatArray

from benchmarks.referee import __main__ as referee  # isort: skip  (sets the variant)

import drjit as dr
import mitsuba as mi

from warpir.mitsuba import render as mitsuba_render
from warpir.mitsuba.light import LatlongEmitter
from warpir.mitsuba.material import GltfBSDF, Image
from warpir.mitsuba.render import Setting
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import Camera

SIGMAS = 4.5
"""Allowed error in standard errors: one false alarm in 1e5 checks, with room for heavy tails."""


def report(name: str, value: float, expected: float, error: float) -> None:
    """Print a check; raise where it is off by more than `SIGMAS` standard errors."""
    sigmas = abs(value - expected) / max(error, 1e-30)
    print(f"{name:58s} {value:12.6g} expected {expected:12.6g}  {sigmas:6.2f} s.e.", flush=True)
    if not sigmas < SIGMAS:
        raise AssertionError(name)


def check_light(rng: np.random.Generator) -> None:
    """Match the bilinear formula in float64; sample it with the density stated."""
    texels = sun_and_sky(rng)
    emitter = LatlongEmitter(texels)
    directions = rng.normal(size=(100000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    truth = bilinear_lookup(texels, latlong_uv(directions))
    toward = mi.Vector3f(directions.T.astype(np.float32))
    found = np.asarray(emitter.radiance(toward, mi.Bool(True))).T
    # One float32 rounding of u moves the reading by 6e-8 of a slope of peak * columns
    rounding = 6e-8 * texels.shape[1]
    error = np.abs(found - truth).max() / texels.max()
    report("light: largest difference to bilinear float64, of peak", error, 0.0, rounding)

    # Without the sun, whose density the test's own quadrature cannot integrate
    emitter = LatlongEmitter(rng.exponential(size=(8, 16, 3)).astype(np.float32) ** 3)
    interaction = dr.zeros(mi.Interaction3f)

    def draw(sample: mi.Vector3f) -> mi.Vector3f:
        return emitter.sample_direction(interaction, mi.Point2f(sample.x, sample.y))[0].d

    def density(d: mi.Vector3f) -> mi.Float:
        ds = dr.zeros(mi.DirectionSample3f, dr.width(d))
        ds.d = d
        return emitter.pdf_direction(interaction, ds)

    chi2("light", draw, density, 2)


def chi2(name: str, draw: object, density: object, dimensions: int) -> None:
    """Compare samples on the sphere with their stated density; raise on rejection at 1e-3."""
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=draw,
        pdf_func=density,
        sample_dim=dimensions,
        sample_count=1_000_000,
        res=101,
        ires=16,
    )
    with redirect_stdout(io.StringIO()):
        accepted = test.run(0.001)
    print(f"{name:58s} chi-square p = {test.p_value:.3f}", flush=True)
    if not accepted:
        raise AssertionError(f"{name}: {test.messages}")


def on_triangle(material: Material) -> GltfBSDF:
    """Return Mitsuba's plugin for a material on a triangle whose normal map leans."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [0.0, 0.0]], dtype=np.float32)
    codes = np.array([[[190, 60, 220, 255]]], dtype=np.uint8)
    triangle = Primitive(corners, np.array([[0, 1, 2]], dtype=np.int32), 0, uv0=uv)
    asset = Asset("triangle", (triangle,), (material,), (Texture(codes),))
    return GltfBSDF(asset, triangle, np.eye(3))


def seen_from(polar: float) -> mi.SurfaceInteraction3f:
    """Return a point on the triangle seen at an angle from its normal [rad]."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.n = mi.Normal3f(0.0, 0.0, 1.0)
    si.sh_frame = mi.Frame3f(si.n)
    sine, cosine = float(np.sin(polar)), float(np.cos(polar))
    si.wi = si.to_local(mi.Vector3f(0.6 * sine, 0.8 * sine, cosine))
    return si


def check_sampling(name: str, bsdf: GltfBSDF, si: mi.SurfaceInteraction3f) -> None:
    """Sample a material with the density that it states."""

    def draw(u: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float]:
        bs, weight = bsdf.sample(mi.BSDFContext(), si, u.x, mi.Point2f(u.y, u.z))
        return si.to_world(bs.wo), dr.select(dr.max(weight) > 0.0, mi.Float(1.0), 0.0)

    def density(d: mi.Vector3f) -> mi.Float:
        return bsdf.pdf(mi.BSDFContext(), si, si.to_local(d))

    chi2(name, draw, density, 3)


def energy_by_sampler(
    bsdf: GltfBSDF, si: mi.SurfaceInteraction3f, u: FloatArray
) -> tuple[float, float]:
    """Return mean and standard deviation of the red weights for numbers, shape [3, n]."""
    _, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(u[1:]))
    red = np.asarray(weight)[0].astype(np.float64)
    return float(red.mean()), float(red.std())


def energy_by_uniform(
    bsdf: GltfBSDF, si: mi.SurfaceInteraction3f, u: FloatArray
) -> tuple[float, float]:
    """Return the same by uniform directions for numbers, shape [2, n]."""
    d = mi.warp.square_to_uniform_hemisphere(mi.Point2f(u))
    f_cos = np.asarray(bsdf.eval(mi.BSDFContext(), si, si.to_local(d)))[0].astype(np.float64)
    return float(2.0 * np.pi * f_cos.mean()), float(2.0 * np.pi * f_cos.std())


def check_material(rng: np.random.Generator) -> None:
    """Sample the material with its density, mapped normals included; its energy."""
    count = 4_000_000
    for roughness, metallic, mapped in (
        (0.15, 0.0, False),
        (0.5, 0.0, True),
        (0.8, 0.7, True),
        (0.3, 1.0, False),
    ):
        bsdf = on_triangle(
            Material(
                base_color=(0.8, 0.5, 0.2),
                metallic=metallic,
                roughness=roughness,
                normal_texture=TextureSlot(0) if mapped else None,
            )
        )
        for polar in (0.2, 1.3):
            name = f"roughness {roughness}, metallic {metallic}, map {mapped}, polar {polar}"
            si = seen_from(polar)
            check_sampling(f"material: {name}", bsdf, si)
            found, spread = energy_by_sampler(bsdf, si, rng.random((3, count), dtype=np.float32))
            # In closed form, or by uniform directions where there is none.
            expected = gltf_albedo(np.cos(polar), 0.8, metallic, roughness)
            if mapped:
                u = rng.random((2, count), dtype=np.float32)
                expected, other = energy_by_uniform(bsdf, si, u)
                spread = float(np.hypot(spread, other))
            error = spread / np.sqrt(count)
            report("material: its energy by its sampler", found, expected, error + 1e-5)


def check_layers(rng: np.random.Generator) -> None:
    """Sample coat, cloth, anisotropy, film and glass with their density; energy by two draws."""
    count = 1_000_000
    base = Material(base_color=(0.8, 0.5, 0.2), metallic=0.3, roughness=0.6)
    coat = replace(base, clearcoat=0.9, clearcoat_roughness=0.3)
    for name, material in (
        ("coat", replace(coat, clearcoat_normal_texture=TextureSlot(0))),
        ("cloth", replace(base, sheen_color=(0.9, 0.4, 0.2), sheen_roughness=0.5)),
        ("brushed", replace(base, anisotropy=0.7, anisotropy_texture=TextureSlot(0))),
        ("film", replace(base, iridescence=0.9, iridescence_thickness=(100.0, 500.0))),
        ("glass", replace(base, transmission=0.8, ior=1.7, specular_color=(1.0, 0.5, 2.0))),
    ):
        bsdf = on_triangle(material)
        for polar in (0.2, 1.3):
            si = seen_from(polar)
            check_sampling(f"layers: {name}, polar {polar}", bsdf, si)
            u = rng.random((3, count), dtype=np.float32)
            found, spread = energy_by_sampler(bsdf, si, u)
            expected, other = energy_by_uniform(bsdf, si, u[:2])
            error = np.hypot(spread, other) / np.sqrt(count)
            report(f"layers: energy of {name} by its sampler", found, expected, error + 1e-5)


def check_textures(rng: np.random.Generator) -> None:
    """Read textures as Mitsuba's bitmap does, where that has the wrap mode."""
    codes = rng.integers(0, 256, size=(5, 7, 4), dtype=np.uint8)
    uv = mi.Point2f(rng.uniform(-3.0, 3.0, size=(2, 10000)).astype(np.float32))
    for mode in ("repeat", "clamp", "mirror"):
        image = Image(Texture(codes, mode, mode), TextureSlot(0), is_color=True)
        found = np.asarray(image.read(uv, mi.Bool(True)))[:3]
        linear = np.asarray(image.texels).reshape(5, 7, 4)[..., :3]
        raw = {"data": mi.TensorXf(linear), "raw": True, "format": "variant"}
        bitmap = mi.load_dict({"type": "bitmap", "wrap_mode": mode, **raw})
        si = dr.zeros(mi.SurfaceInteraction3f, 10000)
        si.uv = uv
        error = np.abs(np.asarray(bitmap.eval(si)) - found).max()
        report(f"textures: largest difference to Mitsuba's bitmap, {mode}", error, 0.0, 1e-5)
    mixed = Image(Texture(codes, "clamp", "repeat"), TextureSlot(0), is_color=False)
    value = np.asarray(mixed.read(mi.Point2f([-0.4], [1.1]), mi.Bool(True))).ravel()
    # v = 1.1 on 5 rows: between the last row (wrapped) and row 0 at 0.0
    expected = codes[0, 0] / 255.0
    report("textures: clamp in u, repeat in v", np.abs(value - expected).max(), 0.0, 1e-5)


def check_energy() -> None:
    """Match the float64 energy of the material per angle on a sphere under uniform light."""
    texels = np.ones((8, 16, 3), dtype=np.float32)
    camera = view(6.0)
    cases = ((0.2, 0.0), (0.7, 0.0), (1.0, 1.0), (0.0, 1.0))
    for seed, (roughness, metallic) in enumerate(cases):
        asset = sphere(Material(metallic=metallic, roughness=roughness), rings=256)
        found = mitsuba_render.foreground(Setting(asset, np.eye(4), camera, texels), 1, 512, seed)
        # Angle at the centre of each pixel well inside the disc; E is smooth there
        along = -6.0 * camera.pixel_rays()[..., 2]
        closest = np.sqrt(np.maximum(36.0 - along**2, 0.0))
        inside = closest < 0.7
        cos_o = np.sqrt(1.0 - closest[inside] ** 2)
        grid = np.linspace(0.6, 1.0, 41)
        table = [gltf_albedo(c, 1.0, metallic, roughness, 512) for c in grid]
        expected = np.interp(cos_o, grid, table)
        error = float(np.sqrt(found.variance[inside][:, 0].sum())) / inside.sum()
        name = f"furnace: sphere, roughness {roughness}, metallic {metallic}"
        report(name, found.mean[inside][:, 0].mean(), expected.mean(), error + 1e-4)
        if metallic == 1.0:
            margin = found.mean[..., 0] - 6.0 * np.sqrt(found.variance[..., 0])
            excess = max(margin.max(), 1.0)
            report("furnace: white metal stays at or below 1, excess", excess, 1.0, 1e-4)


def check_lambert() -> None:
    """Render 1 with Mitsuba's own white Lambert sphere and plane under our uniform light."""
    asset = sphere(Material())
    camera = view(6.0)
    texels = np.ones((8, 16, 3), dtype=np.float32)
    setup = mitsuba_render.build(asset, np.eye(4), camera, texels, 1)
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    ball = {"type": "sphere", "bsdf": white}
    stock = mi.load_dict({"type": "scene", "light": LatlongEmitter(texels), "sphere": ball})
    shot = mi.render(stock, sensor=setup.sensor, spp=1024, integrator=stock_integrator("path", 1))
    image = np.asarray(shot)
    report("lambert: white sphere under uniform light", image[12:20, 12:20].mean(), 1.0, 1e-3)


def stock_integrator(name: str, depth: int) -> mi.Integrator:
    """Return Mitsuba's own integrator of that name, without Russian roulette."""
    return mi.load_dict(
        {"type": name, "max_depth": depth + 1, "rr_depth": 1000, "hide_emitters": True}
    )


def check_stock_integrators(rng: np.random.Generator) -> None:
    """Agree with Mitsuba's `path` and `prb` on an opaque closed mesh, image and gradient."""
    texels = sun_and_sky(rng)
    codes = rng.integers(60, 256, size=(8, 8, 4), dtype=np.uint8)
    material = Material(
        roughness=0.6,
        metallic=0.4,
        base_color_texture=TextureSlot(0),
        metallic_roughness_texture=TextureSlot(0),
    )
    ball = sphere(material, (Texture(codes),), rings=24)
    # Two balls, so that paths bounce
    part = ball.primitives[0]
    other = replace(part, positions=0.6 * part.positions + [1.5, 0.3, 0.2])
    asset = replace(ball, primitives=(part, other))
    camera = view(7.0, width=24, height=16, fov=35.0)
    for depth in (1, 4):
        setting = Setting(asset, np.eye(4), camera, texels)
        found = mitsuba_render.foreground(setting, depth, 1024, 5)
        setup = mitsuba_render.build(*setting, depth)
        for name in ("path", "prb"):
            given = {"sensor": setup.sensor, "integrator": stock_integrator(name, depth)}
            runs = (mi.render(setup.scene, **given, spp=256, seed=k) for k in range(4))
            images = np.stack([np.asarray(run) for run in runs])
            sums = images.sum(axis=(1, 2, 3), dtype=np.float64)
            error = np.hypot(sums.std(ddof=1) / 2.0, np.sqrt(found.variance.sum()))
            # Mitsuba's ray offset is 20 times ours; 2e-4 of a length moves little light
            report(
                f"stock: image sum against {name}, depth {depth}",
                found.mean.sum(),
                sums.mean(),
                error + 2e-5 * sums.mean(),
            )

        check_gradient(asset, camera, rng, depth)


def check_gradient(asset: Asset, camera: Camera, rng: np.random.Generator, depth: int) -> None:
    """Satisfy the adjoint identity and agree with Mitsuba's `prb` up to both noises."""
    texels = rng.exponential(size=(8, 16, 3)).astype(np.float32)
    setting = Setting(asset, np.eye(4), camera, texels)
    found = mitsuba_render.foreground(setting, depth, 1024, 5)
    d_image = rng.normal(size=found.mean.shape) + 1.0
    setup = mitsuba_render.build(*setting, depth)
    parameters = mi.traverse(setup.scene)
    dr.enable_grad(parameters["light.texels"])
    parameters.update()
    stock, d = stock_integrator("prb", depth), mi.TensorXf(d_image.astype(np.float32))
    ours, theirs = [], []
    for seed in range(6):
        ours.append(referee.foreground_gradient(setting, depth, 256, seed, d_image))
        dr.set_grad(parameters["light.texels"], 0.0)
        stock.render_backward(setup.scene, parameters, d, setup.sensor, 100 + seed, 256)
        theirs.append(np.asarray(dr.grad(parameters["light.texels"]), dtype=np.float64))
    sums = np.array([(d_texels * texels).sum() for d_texels in ours])
    spread = float(np.sqrt((found.variance * d_image**2).sum()))
    report(
        f"gradient: <d_texels, texels> = <d_image, image>, depth {depth}",
        sums.mean(),
        (d_image * found.mean).sum(),
        np.hypot(spread, sums.std(ddof=1) / np.sqrt(6.0)),
    )
    z = (np.mean(ours, axis=0) - np.mean(theirs, axis=0)) / np.sqrt(
        (np.var(ours, axis=0, ddof=1) + np.var(theirs, axis=0, ddof=1)) / 6.0
    )
    # Student's t of about 10 degrees of freedom has a variance of 1.25
    report(f"gradient: mean square z against prb, depth {depth}", np.square(z).mean(), 1.25, 0.2)
    a, b = np.mean(ours, axis=0).ravel(), np.mean(theirs, axis=0).ravel()
    print(f"{'':10s}cosine {a @ b / np.linalg.norm(a) / np.linalg.norm(b):.5f}", flush=True)


def check_coverage() -> None:
    """Count alpha, cutoff, culling and sidedness as glTF says."""
    texels = np.ones((8, 16, 3), dtype=np.float32)
    camera = view(6.0, fov=8.0)
    for name, material, turn, expected in (
        ("blend, alpha 0.3", Material(alpha=0.3, alpha_mode="BLEND"), 0.0, 0.3),
        ("mask, alpha 0.3 under the cutoff", Material(alpha=0.3, alpha_mode="MASK"), 0.0, 0.0),
        ("opaque ignores alpha", Material(alpha=0.3), 0.0, 1.0),
        ("single-sided from behind", Material(), 180.0, 0.0),
        ("double-sided from behind", Material(double_sided=True), 180.0, 1.0),
    ):
        asset = square(material, 2.0, 0.0, up=True)
        setting = Setting(asset, np.eye(4), view(6.0, fov=8.0, turn=turn), texels)
        found = mitsuba_render.foreground(setting, 2, 256, 1)
        error = np.sqrt(expected * (1.0 - expected) / 256.0 / 1024.0) + 1e-9
        report(f"coverage: {name}", found.coverage.mean(), expected, error)
    # Emission is seen by the camera and by a bounce; the mask hides the rest
    glow = Material(base_color=(0.0,) * 3, roughness=1.0, emission=(2.0, 1.0, 0.5))
    lit = Setting(square(glow, 2.0, 0.0, up=True), np.eye(4), camera, np.zeros_like(texels))
    found = mitsuba_render.foreground(lit, 1, 16, 1)
    report("emission: seen by the camera, green", found.mean[..., 1].mean(), 1.0, 1e-6)


def check_shadow() -> None:
    """Match the configuration factor of a square over a plane; 1 where nothing is blocked."""
    texels = np.ones((8, 16, 3), dtype=np.float32)
    height, half = 1.0, 0.75
    # Look at the point under the square's centre, from the side
    eye = (0.0, 6.0 * np.sin(0.1), 6.0 * np.cos(0.1))
    camera = shapes.camera(8, 8, 2000.0, eye, -np.degrees(0.1))
    factor = 1.0 - float(rectangle_ratio(0.0, 0.0, height, half))
    for name, material, expected in (
        ("opaque, single-sided from below", Material(), 1.0 - factor),
        ("blend, alpha 0.5", Material(alpha=0.5, alpha_mode="BLEND"), 1.0 - 0.5 * factor),
    ):
        setting = Setting(square(material, 2.0 * half, height), np.eye(4), camera, texels)
        found = mitsuba_render.shadow(setting, 4096, 2)
        error = float(np.sqrt(found.lit_variance[..., 0].sum())) / 64.0
        report(f"shadow: unoccluded white plane, {name}", found.unoccluded.mean(), 1.0, 1e-3)
        report(f"shadow: square above the plane, {name}", found.lit[..., 0].mean(), expected, error)
        report("shadow: share of samples that see the plane", found.seen.mean(), 1.0, 1e-9)
    tiny = Setting(square(Material(), 1e-3, 40.0), np.eye(4), camera, texels)
    far = mitsuba_render.shadow(tiny, 64, 2)
    off = np.abs(far.lit / far.unoccluded - 1.0).max()
    report("shadow: ratio is exactly 1 far from the object", off, 0.0, 1e-30)


def main() -> None:
    """Run all checks."""
    rng = np.random.default_rng(12345)
    check_light(rng)
    check_textures(rng)
    check_material(rng)
    check_layers(rng)
    check_energy()
    check_lambert()
    check_coverage()
    check_shadow()
    check_stock_integrators(rng)


if __name__ == "__main__":
    main()
