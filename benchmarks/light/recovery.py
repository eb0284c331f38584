"""Does the loop find light and tone curves again when the guidance is right?

    python -m benchmarks.light.recovery [--quick] [--assets DIR] --json FILE

A photo is cut out of a panorama, an object is set into it under that very panorama and unknown tone
curves, and the optimisation is guided by the squared distance to this true composite, in place of a
diffusion model. What is left is renderer, fusion, curves and optimiser. The truth is path-traced
with `mis` under the full panorama; the loop knows lobes, coarse maps and `transport` only.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from benchmarks.measure import context, flags, rms, table, write_json
from benchmarks.scenes import on_the_ground, write_picture
from tests.oracles import reinhard, spline
from warpir.app.settings import OptimizeSettings
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import expose, gamma_to_linear, luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.evaluate.scenes import crop_camera, crop_radiance
from warpir.io.assets import load_asset
from warpir.io.images.photos import read_envmap
from warpir.optimize.light import LightOptimization, Unknowns
from warpir.optimize.view import Frame
from warpir.render.bridge import ComposeConstants, compose
from warpir.render.device_light import light_args
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.tone_curve import Knots, ToneCurve
from warpir.scene.asset import Asset
from warpir.scene.light import Light
from warpir.scene.placement import place_asset

MEASURE_HEIGHT = 128
"""Rows of the maps on which lights are compared."""
SMOOTHING = 200.0
"""Sharpness of the lobe that smooths a map before its brightest direction is sought: 4 degrees."""
SUN_RADIUS_DEG = 20.0
"""What lies within this of the brightest direction and above its surroundings is the sun."""


@dataclass(frozen=True)
class RecoveryScene:
    """One photo with a known light."""

    name: str
    panorama: str
    asset: str
    size: float
    """Longest side of the object [m]."""
    azimuth: float
    """Where the camera looks, clockwise from -Z seen from above [deg]."""
    distance: float
    """From the camera to the object along the ground [m]."""
    camera_height: float
    """Above the ground [m]."""
    rotate_y: float = 0.0
    """Turn of the object [deg]."""
    contrast: float = 0.0
    """Raw height of the true foreground curve: its bend."""


SPOT, BALL = "mesh/spot/spot.obj", "mesh/shaderball.glb"
RED, YELLOW = (f"mesh/kenney_trucks/vehicle-truck-{color}.glb" for color in ("red", "yellow"))
SCENES = tuple(
    RecoveryScene(*row)
    for row in (
        ("plaza_spot", "modern_buildings_2_1k", SPOT, 1.6, 100.0, 4.5, 1.6, 200.0, 0.4),
        ("park_truck", "rooitou_park_1k", RED, 4.0, 300.0, 9.0, 2.2, 35.0, -0.3),
        ("clouds_ball", "pmndrs_sky", BALL, 1.2, 150.0, 4.5, 1.6, 20.0, 0.2),
        ("hills_truck", "hilly_terrain_01_1k", YELLOW, 4.0, 120.0, 9.0, 2.2, -60.0, 0.5),
        ("noon_spot", "noon_grass_1k", SPOT, 1.6, 20.0, 4.5, 1.6, 130.0, -0.4),
        ("meadow_ball", "pmndrs_sunrise", BALL, 1.2, 330.0, 4.5, 1.6, -70.0, 0.0),
    )
)
"""Six places with a sun between 8 and 86 degrees high, seen from different sides of it."""


@dataclass(frozen=True)
class Truth:
    """A photo, what it would look like with the object, and why."""

    scene: RecoveryScene
    frame: Frame
    image: Tensor
    """Composite under the panorama and the true curves, display-encoded, shape [1, 3, H, W]."""
    texels: FloatArray
    """The panorama at the photo's exposure, shape [He, We, 3]."""
    curve_fg: Knots
    curve_shadow: Knots


def true_curves(contrast: float) -> tuple[ToneCurve, ToneCurve]:
    """Return an S-shaped (or, below 0, flattened) foreground curve and three shadow curves."""
    curve_fg, curve_shadow = ToneCurve(1), ToneCurve(3)
    bend = torch.tensor([-1.0, 0.3, 1.0, 0.5, -0.8])
    with torch.no_grad():
        curve_fg.heights += contrast * bend
        tint = torch.tensor([[-0.15], [0.0], [0.15]])
        curve_shadow.heights += (0.5 * contrast + tint) * torch.linspace(1.0, -1.0, 5)
    return curve_fg, curve_shadow


def make_truth(
    scene: RecoveryScene,
    panorama: FloatArray,
    asset: Asset,
    width: int,
    height: int,
    samples: int,
    device: str,
) -> Truth:
    """Cut the photo and render the true composite, both of that width and height [px].

    The panorama is lat-long radiance, shape [He, We, 3].
    """
    camera = crop_camera(width, height, 45.0, scene.azimuth, -8.0, scene.camera_height)
    display, exposure = expose(crop_radiance(panorama, camera))
    photo_lin = gamma_to_linear(display.astype(np.float32))
    texels = (panorama * 2.0**exposure).astype(np.float32)
    forward = -camera.c2w[:3, 2] * np.array([1.0, 0.0, 1.0])
    x, y, z = (float(c) for c in scene.distance * forward / np.linalg.norm(forward))
    stand = {"place": (x, y, z), "rotate_y": scene.rotate_y, "size": scene.size}
    placement = place_asset(*asset.bounds(), camera, None, **stand)
    renderer = on_the_ground(asset, placement.asset_to_world, camera, device)
    frame = Frame(renderer, photo_lin, True, 3, seed=1)
    curves = true_curves(scene.contrast)
    with torch.no_grad():
        knots = curves[0](), curves[1]()
        image = reference(frame, texels, *knots, samples)
    return Truth(scene, frame, image, texels, *knots)


def reference(
    frame: Frame, texels: FloatArray, curve_fg: Knots, curve_shadow: Knots, samples: int
) -> Tensor:
    """Return the composite by `mis` under a full map, shape [1, 3, H, W]."""
    renderer = frame.renderer
    args = light_args(Light(texels=texels), renderer.device)
    objects = renderer.gbuffer(99).object_pixels
    proxies = shaded_pixels(renderer, args, 99)
    mask = renderer.foreground(args, objects, 64, 1, 1, 99).mask
    mis = MisIntegrator(renderer, objects, proxies, samples, 2, frame.depth)
    light = torch.from_numpy(texels)
    radiance = mis.radiance(light, light, 99)
    constants = ComposeConstants(
        frame.photo_lin, objects, proxies, mask, str(renderer.device.alias), frame.is_reinhard
    )
    return compose(constants, radiance, curve_fg, curve_shadow)


class TowardTruth:
    """Guidance that knows the answer: the gradient of half the squared distance to the truth.

    The sum is scaled to the pixels of a 384 x 256 picture, so that the regularisers weigh the same
    at every size.

    Args:
        image: The truth, shape [1, 3, H, W].
        noise: Standard deviation of noise in blocks of 8 x 8 pixels, as a diffusion model's latents
            have it, added to each gradient, in root mean squares of the first residual [1].
    """

    def __init__(self, image: Tensor, noise: float = 0.0) -> None:
        self.image, self.noise = image, noise
        self.scale = 384 * 256 / (image.shape[2] * image.shape[3])
        self.first_rms = 0.0

    def gradient(self, image: Tensor, step: int) -> Tensor:
        """Return the residual, with noise, scaled."""
        residual = image - self.image.to(image.device)
        if self.noise:
            self.first_rms = self.first_rms or float(residual.square().mean().sqrt())
            height, width = image.shape[2:]
            generator = torch.Generator().manual_seed(step)
            coarse = torch.randn(1, 3, -(-height // 8), -(-width // 8), generator=generator)
            blocks = coarse.repeat_interleave(8, dim=2).repeat_interleave(8, dim=3)
            blocks = blocks[:, :, :height, :width].to(image.device)
            residual = residual + self.noise * self.first_rms * blocks
        return self.scale * residual

    def score(self, image: Tensor) -> float:
        """Return the mean squared error."""
        return float((image - self.image.to(image.device)).square().mean())

    def state_dict(self) -> dict[str, Any]:
        """Nothing to remember."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Nothing to remember."""


def brightest_direction(texels: FloatArray) -> Float64Array:
    """Return the centroid of what stands out round the brightest smoothed direction, unit."""
    grid, grey, weight = _measured(texels)
    coarse = map_directions(32, 64).reshape(-1, 3)
    smooth = np.array([(weight * np.exp(SMOOTHING * (grid @ v - 1.0))).sum() for v in coarse])
    axis: Float64Array = coarse[int(np.argmax(smooth))]
    for _ in range(3):  # the cap follows its own centroid
        excess = _excess(axis, grid, grey, weight)
        axis = (excess[:, None] * grid).sum(axis=0)
        axis = axis / np.linalg.norm(axis)
    return axis


def sun_sky_ratio(texels: FloatArray, axis: Float64Array) -> float:
    """Return the flux of the sun over that of the rest of the upper hemisphere [1]."""
    grid, grey, weight = _measured(texels)
    sun = float(_excess(axis, grid, grey, weight).sum())
    upper = float(weight[grid[:, 1] > 0.0].sum())
    return sun / max(upper - sun, 1e-12)


def _measured(texels: FloatArray) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return directions, luminance and luminous flux by texel, flat."""
    grey = luminance(resize_map(texels, MEASURE_HEIGHT).astype(np.float64)).reshape(-1)
    omega = np.repeat(texel_solid_angles(MEASURE_HEIGHT, 2 * MEASURE_HEIGHT), 2 * MEASURE_HEIGHT)
    grid = map_directions(MEASURE_HEIGHT, 2 * MEASURE_HEIGHT).reshape(-1, 3)
    return grid, grey, grey * omega


def _excess(
    axis: Float64Array, grid: Float64Array, grey: Float64Array, weight: Float64Array
) -> Float64Array:
    """Return the flux within the sun's cap that exceeds the median of the ring round it."""
    cosine = grid @ axis
    near = cosine > np.cos(np.radians(SUN_RADIUS_DEG))
    ring = ~near & (cosine > np.cos(np.radians(1.5 * SUN_RADIUS_DEG))) & (grid[:, 1] > 0.0)
    level = float(np.median(grey[ring])) if ring.any() else 0.0
    above = np.maximum(grey - level, 0.0) / np.maximum(grey, 1e-30)
    excess: Float64Array = np.where(near, weight * above, 0.0)
    return excess


def response(knots: Knots, radiance: Float64Array) -> Float64Array:
    """Return display-linear values of some radiances under Reinhard and a foreground curve."""
    parts = (k.detach().double().numpy()[0] for k in (knots.x, knots.y, knots.slope))
    return spline(reinhard(radiance), *parts)[0]


def measure(truth: Truth, loop: LightOptimization) -> dict[str, Any]:
    """Compare what was recovered with what is true."""
    light = loop.final_lights(MEASURE_HEIGHT)[0].texels
    assert light is not None
    axis, true_axis = brightest_direction(light), brightest_direction(truth.texels)
    error = (delivered(truth, loop) - truth.image).cpu().numpy()[0]
    photo = (truth.frame.photo_lin ** (1.0 / 2.2)).transpose(2, 0, 1)
    changed = np.abs(truth.image.cpu().numpy()[0] - photo).max(axis=0) > 2.0 / 255.0
    # The scale of the light and the curve are one unknown: radiances are matched by total flux.
    ratio = float(_measured(light)[2].sum() / _measured(truth.texels)[2].sum())
    radiance = np.geomspace(0.02, 2.0, 64)
    shown = response(loop.unknowns.curve_fg(), ratio * radiance)
    curves = shown - response(truth.curve_fg, radiance)
    ratios = sun_sky_ratio(light, axis), sun_sky_ratio(truth.texels, true_axis)
    return {
        "name": truth.scene.name,
        "angle_deg": float(np.degrees(np.arccos(np.clip(axis @ true_axis, -1.0, 1.0)))),
        "sun_sky_log_error": float(abs(np.log(max(ratios[0], 1e-6) / max(ratios[1], 1e-6)))),
        "rmse": rms(error),
        "rmse_changed": rms(error[:, changed]),
        "tone_rmse": rms(curves),
        "true_sun_sky": ratios[1],
    }


def delivered(truth: Truth, loop: LightOptimization) -> Tensor:
    """Return the composite as a user gets it: by `mis`, under finer maps, at an unseen seed."""
    texels = loop.final_lights(256)[0].texels
    assert texels is not None
    with torch.no_grad():
        curves = loop.unknowns.curve_fg(), loop.unknowns.curve_shadow()
        return reference(truth.frame, texels, *curves, 64)


def recover(truth: Truth, settings: OptimizeSettings, noise: float = 0.0) -> LightOptimization:
    """Run the loop toward the truth from an even light at the photo's level."""
    level = float(np.median(luminance(truth.frame.photo_lin)))
    unknowns = Unknowns.start(None, level / (1.0 - min(level, 0.95)), settings)
    loop = LightOptimization(truth.frame, TowardTruth(truth.image, noise), settings, unknowns)
    loop.run()
    return loop


def show(truth: Truth, loop: LightOptimization, path: Path) -> None:
    """Write truth, result and five times their difference side by side."""
    pictures = truth.image, delivered(truth, loop)
    true, image = (p.cpu().numpy()[0].transpose(1, 2, 0) for p in pictures)
    write_picture(path, np.concatenate([true, image, 0.5 + 5.0 * (image - true)], axis=1))


HEAD = (
    *("scene", "angle to the true sun [deg]", "log error of sun/sky", "true sun/sky"),
    *("RMSE of the composite", "RMSE where it differs from the photo"),
    *("RMSE of the tone curve", "seconds"),
)
PAGE = """# Recovery of light and tone curves with guidance that is right

Made by `python -m benchmarks.light.recovery --markdown docs/recovery.md`: the
optimisation is guided by the squared distance to the true composite in place of a
diffusion model. The truth is path-traced under the full panorama, through tone curves
that the loop does not know; the result is path-traced too, at an unseen seed.

{date}, {device}, commit {commit}; {width} x {height}
pixels, {steps} steps, {lobes} lobes.

{table}

Largest angle: {max_angle_deg:.2f} degrees (target 3).
"""


def page(record: Mapping[str, Any]) -> str:
    """Return the figures as a page."""
    width, height = record["size"]
    rows = [
        (
            *(x["name"], f"{x['angle_deg']:.2f}", f"{x['sun_sky_log_error']:.2f}"),
            *(f"{x['true_sun_sky']:.2f}", f"{x['rmse']:.4f}", f"{x['rmse_changed']:.4f}"),
            *(f"{x['tone_rmse']:.4f}", f"{x['seconds']['recovery']:.0f}"),
        )
        for x in record["scenes"]
    ]
    known = {**record, **record["settings"], "width": width, "height": height}
    return PAGE.format(**known, table=table(HEAD, rows))


def main() -> None:
    """Recover six scenes and write what was found."""
    parser = flags(__doc__)
    parser.set_defaults(device="cpu")
    parser.add_argument("--quick", action="store_true", help="96 x 64, 200 steps")
    parser.add_argument("--pictures", type=Path, help="folder for truth, result, difference")
    parser.add_argument("--scenes", default="", help="names, separated by commas")
    parser.add_argument("--noise", type=float, default=0.0, help="of the guidance, see TowardTruth")
    parser.add_argument("--markdown", type=Path, help="file for the table")
    parser.add_argument("--set", action="append", default=[], help="field=value of the settings")
    options = parser.parse_args()
    settings = OptimizeSettings(steps=600)
    width, height = 384, 256
    if options.quick:
        settings = replace(settings, steps=200, lobes=48, light_height=48, object_light_height=24)
        width, height = 96, 64
    for text in options.set:
        name, _, value = text.partition("=")
        kind = type(getattr(settings, name))
        settings = replace(settings, **{name: kind(value)})
    chosen = [s for s in SCENES if not options.scenes or s.name in options.scenes.split(",")]
    lines = []
    for scene in chosen:
        started = time.perf_counter()
        panorama = read_envmap(options.assets / "hdri" / f"{scene.panorama}.hdr")
        asset = load_asset(options.assets / scene.asset)
        truth = make_truth(scene, panorama, asset, width, height, 128, options.device)
        made = time.perf_counter()
        loop = recover(truth, settings, noise=options.noise)
        line = measure(truth, loop)
        line["seconds"] = {
            "truth": round(made - started, 1),
            "recovery": round(time.perf_counter() - made, 1),
        }
        lines.append(line)
        print(json.dumps(line), flush=True)
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            show(truth, loop, options.pictures / f"{scene.name}.png")
    record = {
        **context(wp.get_device(options.device), 0),
        "size": [width, height],
        "noise": options.noise,
        "settings": asdict(settings),
        "scenes": lines,
        "max_angle_deg": max(line["angle_deg"] for line in lines),
    }
    write_json(options.json, record)
    if options.markdown is not None:
        options.markdown.write_text(page(record), encoding="utf-8")


if __name__ == "__main__":
    main()
