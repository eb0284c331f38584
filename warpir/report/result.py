"""Result of a run: the final render and the files, those for other tools included."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from warpir.app.inputs import Inputs
from warpir.app.record import config_of_picture
from warpir.app.run import Run
from warpir.app.settings import LookConfig
from warpir.core.arrays import CodeArray, FloatArray
from warpir.core.progress import progress_bar
from warpir.io.curves_file import curves_to_json
from warpir.io.export import OBJECT, write_hand_off
from warpir.io.images.photos import Photo
from warpir.io.layers import write_layers
from warpir.io.lobes_file import lobes_to_json
from warpir.io.results import OutputFolder
from warpir.lighting.scene_light import SceneLight
from warpir.look.camera_look import CameraLook, estimate_look, look_of_preview, region_around
from warpir.look.denoise import denoiser_version
from warpir.render.composite import Picture, make_picture
from warpir.render.device_scene import Scene
from warpir.render.picture.light_preview import balls
from warpir.render.picture.photo_scene import scene_of
from warpir.render.picture.quality import SEEN_NOISE, Quality
from warpir.render.renderer import Renderer
from warpir.report.page import Results
from warpir.report.pictures import shrink
from warpir.report.viewer import VIEWER, viewer_page
from warpir.scene.camera import Camera
from warpir.scene.light import Light, LightSummary, as_file_map, summarize
from warpir.scene.near.lamps import records_of
from warpir.scene.placement import box_corners
from warpir.scene.tone_curves import Curves, ToneKnots

NOT_HANDED_OVER = (
    "the files for Blender, three.js and Mitsuba hold the light from afar alone, not the lamps "
    "near the object (--usd has them)"
)
NO_MESH_HANDED_OVER = (
    "the files for Blender, three.js and Mitsuba hold the ground plane, not the mesh of --proxy"
)
NO_MASK_HANDED_OVER = (
    "the files for Blender, three.js and Mitsuba do not know --occluder-mask and --shadow-mask; "
    "layers.exr does"
)
PREVIEW_SAMPLES = 16
"""Camera samples per pixel of the preview of an unguided run."""
PREVIEW_SIDE = 900
"""Longer side of that preview, at most [px]."""


# ------------------------------------------------------------------------------ the picture


@dataclass(frozen=True)
class RenderedResult:
    """The rendered picture of a run."""

    picture: Picture
    device: str
    """Name of the Warp device that rendered it."""
    measured: dict[str, Any]
    """Samples, asked for and taken, triangles, bad pixels and repeats, for ``run.json``."""


def place_result(run: Run, light: SceneLight) -> Scene:
    """Put the object into the scene that `render_result` renders."""
    camera = _rendering_camera(run.inputs.camera, run.config.render.width)
    return run.memory.again(
        lambda: scene_of(run.inputs, camera, run.device, light.curves), "the scene", "--asset"
    )


def render_result(run: Run, light: SceneLight, look: CameraLook, placed: Scene) -> RenderedResult:
    """Render object and shadow, and composite them into the photo with the camera's look."""
    with run.timings.stage("render"), progress_bar(run.log.say) as report:
        quality, camera = run.config.render, placed.camera
        renderer = Renderer(
            placed, quality.threads or 0, report, run.memory, bounce_depth=quality.bounce_depth
        )
        samples = quality.samples_at(camera.width, camera.height)
        # As many as were asked for; without such a wish more where their noise would be seen.
        noise = SEEN_NOISE if quality.samples is None else None
        picture = _picture(run, light, renderer, (samples, quality.rays), look, noise)
    run.log.notices += run.memory.notices()  # printed when it happened
    run.log.notice(*renderer.bad_pixels.notices())
    measured = {
        "samples": samples,
        "mean_samples": {
            name: round(mean, 1)
            for name, mean in renderer.mean_samples.items()
            if name in ("object", "shadow")
        },
        "triangles": renderer.scene.triangle_count,
        "rays": renderer.scene.rays,
        "bad_pixels": renderer.bad_pixels.count,
        "memory_retries": run.memory.retries,
        "denoiser": denoiser_version() if quality.denoise == "auto" else None,
    }
    return RenderedResult(picture, str(renderer.scene.device), measured)


def write_preview(run: Run, light: SceneLight) -> None:
    """Write a small and noisy preview of the composite, if previews are asked for."""
    settings = run.config.optimize
    if not settings.preview_every:
        return
    with run.timings.stage("preview"):
        look = look_of_preview(run.inputs.photo, run.config.look.response)
        run = replace(run, inputs=_small_inputs(run.inputs))
        camera = _rendering_camera(run.inputs.camera, run.config.render.width)
        # Of a photo that is enlarged, no more than the photo has.
        width = min(settings.guidance_width, camera.width, run.inputs.camera.width)
        camera = _rendering_camera(run.inputs.camera, width)
        placed = scene_of(run.inputs, camera, run.device, light.curves)
        asked = run.config.render
        renderer = Renderer(placed, asked.threads or 0, bounce_depth=asked.bounce_depth)
        picture = _picture(run, light, renderer, (PREVIEW_SAMPLES, 1), look)
        codes = picture.codes_in(run.inputs.photo)
        run.log.say(f"preview: {run.output.write_preview(0, codes, run.inputs.photo.icc)}")


def _small_inputs(inputs: Inputs) -> Inputs:
    """Return the inputs with a photo of `PREVIEW_SIDE` at most, in 8 bits if that is smaller."""
    if max(inputs.photo.srgb.shape[:2]) <= PREVIEW_SIDE:
        return inputs
    srgb = shrink(inputs.photo.srgb, PREVIEW_SIDE)
    photo = Photo(np.round(255.0 * srgb).astype(np.uint8), srgb, "png")
    occluder = None if inputs.occluder is None else shrink(inputs.occluder, PREVIEW_SIDE)
    camera = inputs.camera.scaled(srgb.shape[1], srgb.shape[0])
    return replace(inputs, photo=photo, camera=camera, occluder=occluder)


def look_of(run: Run, light: SceneLight, shared: CameraLook | None = None) -> CameraLook:
    """Return what the camera did to the photo, as far as the object is to share it.

    ``shared`` is `estimated_look` of another frame, which holds for this one but for its JPEG.
    """
    photo, asked = run.inputs.photo, run.config.look
    look = replace(
        shared or estimated_look(run.inputs, asked, light.curves),
        jpeg=None if asked.grain == "off" else photo.jpeg,
    )
    words = {"blur": asked.sharpness, "grain": asked.grain, "response": asked.response}
    given: dict[str, Any] = {part: None for part, word in words.items() if word != "auto"}
    run.log.assume(*replace(look, **given).lines())
    return look


def estimated_look(inputs: Inputs, asked: LookConfig, curves: Curves) -> CameraLook:
    """Estimate blur, response, grain and toning of a photo; what is given stays as it is.

    A recovered tone curve was judged beside the photo, so it holds the response already; Reinhard's
    operator has a shoulder of its own, and a linear plate has no response. A plate of any unit is
    looked at as it is exposed.
    """
    photo, to_world = inputs.photo, inputs.placement.asset_to_world
    world = box_corners(*inputs.asset.bounds()) @ to_world[:3, :3].T + to_world[:3, 3]
    around = region_around(inputs.camera.project(world), photo.srgb.shape[0], photo.srgb.shape[1])
    response = asked.response
    is_shown = curves.tone == "reinhard" or not curves.foreground.is_identity
    if response == "auto" and (is_shown or photo.is_linear):
        response = "off"
    shown, factor = photo.exposed()
    linear = photo.linear() * np.float32(factor) if photo.is_linear else photo.linear()
    words = asked.sharpness, asked.grain, response
    look = estimate_look(shown, linear, around, *words, photo.jpeg)
    return replace(look, toning=look_of_preview(photo, asked.response).toning)


def _picture(
    run: Run,
    light: SceneLight,
    renderer: Renderer,
    samples: tuple[int, int],
    look: CameraLook,
    noise: float | None = None,
) -> Picture:
    """Render and composite; ``samples`` are those of a pixel, and the rays of each."""
    inputs, quality = run.inputs, run.config.render
    is_denoised = quality.denoise == "auto" and denoiser_version() is not None
    return make_picture(
        renderer,
        light.on_object,
        light.light_shadow,
        inputs.photo,
        Quality(
            *samples,
            quality.depth,
            quality.seed,
            quality.indirect_limit * inputs.photo.unit,
            noise=None if is_denoised else noise,
            white=inputs.photo.unit,
            is_denoised=is_denoised,
            ground_roughness=quality.coat_roughness,
        ),
        light.curves,
        occluder=inputs.occluder,
        shadow_mask=inputs.shadow_mask,
        look=look,
        behind=_mirrored_light(run, light),
    )


def _mirrored_light(run: Run, light: SceneLight) -> Light | None:
    """Return what a glossy ground showed before: the photo, where it knows; None: the light."""
    if run.config.render.coat_roughness is None or light.detailed is not None:
        return None
    from warpir.lighting.detail import detail_of, with_detail

    return with_detail(light.on_object, detail_of(run.inputs, light.curves))


def _rendering_camera(camera: Camera, width: int | None) -> Camera:
    """Return the photo's camera, or the same view at another width [px]."""
    if width is None:
        return camera
    return camera.scaled(width, max(1, round(width * camera.height / camera.width)))


# -------------------------------------------------------------------------------- the files


@dataclass(frozen=True)
class Maps:
    """Lights of a result as in its files, shape [He, 2 He, 3] each."""

    light: FloatArray
    shadow: FloatArray | None
    """Light that casts the shadow, if it is another one."""
    detail: FloatArray | None
    """Light with the photo's detail, if that is asked for."""

    @property
    def on_object(self) -> FloatArray:
        """The light on the object."""
        return self.light if self.detail is None else self.detail

    @property
    def name_on_object(self) -> str:
        """File name of `on_object`."""
        return "envmap.exr" if self.detail is None else "envmap_detail.exr"


@dataclass(frozen=True)
class Written:
    """Written results."""

    results: Results
    """Results in memory, for the report."""
    maps: Maps
    measured: dict[str, Any]
    """Entries of ``run.json``."""


def _not_handed_over(inputs: Inputs) -> list[str]:
    """Return what the files for other tools leave out of these inputs, one line each."""
    left_out = {
        NOT_HANDED_OVER: bool(inputs.lamps),
        NO_MESH_HANDED_OVER: inputs.proxy is not None,
        NO_MASK_HANDED_OVER: inputs.occluder is not None or inputs.shadow_mask is not None,
    }
    return [line for line, is_given in left_out.items() if is_given]


def write_results(run: Run, light: SceneLight, picture: Picture) -> Written:
    """Stage all files of a result but Mitsuba's scene, the report and ``run.json``.

    Raises:
        InputError: The disk is full (exit 5).
    """
    inputs, output, photo = run.inputs, run.output, run.inputs.photo
    asked = run.config.output
    codes = picture.codes_in(photo)
    # Many shadows are too faint for a code; a linear plate has no codes of the same kind.
    changed = picture.changed if photo.is_linear else (codes != photo.codes).any(axis=-1)
    maps, response = _maps_of(light), picture.look.response
    knots = None if response is None else response.knots()
    light = replace(light, curves=replace(light.curves, is_clipped=not photo.is_linear))
    output.write_json("curves.json", curves_to_json(light.curves, knots))
    output.write_json("camera.json", inputs.camera.record())
    # Compression takes most of the time.
    _, clamped, _, pair, handed = output.write_together(
        lambda: output.write_png("composite.png", codes, icc=photo.icc, mark=asked.mark),
        lambda: _write_layers(run, picture),
        lambda: _write_light(output, light, maps),
        lambda: _write_balls(run, light),
        lambda: _hand_off(run, light, maps, picture, knots) if asked.hand_off else {},
    )
    if asked.usd:
        _write_usd(run, maps.name_on_object)
    summary = summarize(light.light)
    _say_what_is_seen(run, summary, picture)
    if asked.hand_off:
        run.log.notice(*_not_handed_over(inputs))
    measured = {
        **_measured(run, light, summary),
        **({"lamps": records_of(inputs.lamps)} if inputs.lamps else {}),
        "object_pixels": picture.object_pixel_count,
        "shadow_pixels": picture.receiver_pixel_count,
        "changed_pixels": int(changed.sum()),
        "values_clamped_to_half": clamped,
        "look": picture.look.record(),
        **_mirror(run, picture),
        **handed,
    }
    results = Results(
        layers=picture.layers,
        light=maps.light,
        light_shadow=maps.shadow,
        light_detail=maps.detail,
        balls=pair,
        curves=light.curves,
        camera=inputs.camera.record(),
    )
    return Written(results, maps, measured)


def _write_layers(run: Run, picture: Picture) -> int:
    return write_layers(
        run.output,
        picture.layers,
        run.inputs.camera,
        is_deep=run.inputs.photo.is_deep,
        config=config_of_picture(run.config.flat()),
        inputs=run.inputs.hashes,
    )


def _maps_of(light: SceneLight) -> Maps:
    shadow = detail = None
    if light.light_shadow is not light.light:
        shadow = as_file_map(light.light_shadow)
    if light.detailed is not None:
        detail = as_file_map(light.on_object)
    return Maps(as_file_map(light.light), shadow, detail)


def _write_light(output: OutputFolder, light: SceneLight, maps: Maps) -> None:
    """Write the maps of the lights, and the lobes if there are any."""
    output.write_envmap(maps.light)
    if maps.shadow is not None:
        output.write_envmap(maps.shadow, "envmap_shadow")
    if maps.detail is not None:
        output.write_envmap(maps.detail, "envmap_detail")
    if light.light.lobes is not None:
        output.write_json("lobes.json", lobes_to_json(light.light.lobes))


def _write_balls(run: Run, light: SceneLight) -> CodeArray:
    pair = balls(light.on_object, run.inputs.camera, light.curves.tone == "reinhard")
    about = "Mirror ball and grey diffuse ball under the light"
    run.output.write_png("balls.png", pair, mark=False, description=about)
    return pair


def _hand_off(
    run: Run, light: SceneLight, maps: Maps, picture: Picture, response: ToneKnots | None
) -> dict[str, Any]:
    """Write the files for Blender, three.js and colour tools; return entries of ``run.json``."""
    inputs = run.inputs
    handed, notices = write_hand_off(
        run.output,
        inputs.photo,
        inputs.asset,
        inputs.camera,
        inputs.placement,
        light.curves,
        maps.on_object,
        maps.name_on_object,
        response,
    )
    for line in notices:
        run.log.say(f"notice: {line}")
    _write_viewer(run, light, maps, picture)
    return handed


def _write_usd(run: Run, envmap: str) -> None:
    """Stage ``scene.usdz`` with a map that is staged."""
    from warpir.io.usd import USDZ, write_usdz

    inputs, light = run.inputs, run.output.staging / envmap
    to_world = inputs.placement.asset_to_world
    package = write_usdz(inputs.asset, to_world, inputs.camera, light, inputs.lamps)
    run.output.write_bytes(USDZ, package)


def _write_viewer(run: Run, light: SceneLight, maps: Maps, picture: Picture) -> None:
    """Write the page that shows the object on the photo in 3D."""
    inputs, output = run.inputs, run.output
    to_world = inputs.placement.asset_to_world
    corners = box_corners(*inputs.asset.bounds()) @ to_world[:3, :3].T + to_world[:3, 3]
    page = viewer_page(
        (output.staging / OBJECT).read_bytes(),
        (corners.min(axis=0), corners.max(axis=0)),
        picture.layers.plate,
        inputs.camera.record(),
        inputs.placement.ground,
        (maps.light, maps.light if maps.shadow is None else maps.shadow),
        light.curves.tone,
    )
    output.write_bytes(VIEWER, page)


def _mirror(run: Run, picture: Picture) -> dict[str, Any]:
    """Return the entry of ``run.json`` about the ground's mirror image, if there is one."""
    roughness, cut = run.config.render.coat_roughness, picture.mirror_cut_count
    if roughness is None:
        return {}
    if cut:
        run.log.notice(
            f"in {cut} pixels the ground's mirror image hides more light than the photo can have "
            "from there, and less is taken (--ground-roughness)"
        )
    return {"ground_mirror": {"roughness": roughness, "cut_pixels": cut}}


def _say_what_is_seen(run: Run, summary: LightSummary, picture: Picture) -> None:
    run.log.say(
        f"light: brightest toward azimuth {summary.azimuth_deg:.0f}, elevation "
        f"{summary.elevation_deg:.0f} degrees; {100.0 * summary.peak_share:.0f} % of its flux "
        "comes from there"
    )
    if not (picture.layers.matte > 0.0).any():
        masked = (
            " (of --occluder-mask, white stays in front)" if run.inputs.occluder is not None else ""
        )
        run.log.notice(f"the object is not seen in the photo{masked}")


def _measured(run: Run, light: SceneLight, summary: LightSummary) -> dict[str, Any]:
    """Return the entries of ``run.json`` about placement, light, mask and mesh."""
    inputs, fit = run.inputs, light.fit
    measured: dict[str, Any] = {
        "prior": "none",
        "integrator": "mis",
        "placement": inputs.placement.record(
            *inputs.asset.bounds(), inputs.camera, run.config.placement.sink
        ),
        "exposure_ev": light.exposure,
        "light": asdict(summary),
        "lobe_fit": fit
        and {
            "irradiance_error": fit.irradiance_error,
            "flux_error": fit.flux_error,
            "lamps": fit.lamp_count,
        },
    }
    if inputs.shadow_mask is not None:
        measured["shadow_mask_at_object"] = inputs.shadow_mask.at_object
    if inputs.proxy is not None:
        measured["proxy_triangles"] = len(inputs.proxy.indices)
    return measured
