"""From what the user said about the light to one `Light` at the photo's exposure."""

from dataclasses import dataclass

import numpy as np

from warpir.app.config import usage
from warpir.app.earlier_runs import EarlierRun
from warpir.app.inputs import Inputs
from warpir.app.settings import LightConfig
from warpir.core.arrays import BoolArray, Float64Array
from warpir.core.color import luminance
from warpir.core.errors import InputError
from warpir.io.images.photos import Photo
from warpir.lighting.fit import LobeFit, fit_lobes
from warpir.scene.lamps import lamp_axes, without_lamps
from warpir.scene.light import Light, plain_sky, sun_lobe
from warpir.scene.near.lamps import irradiance
from warpir.scene.placement import foot_of_box
from warpir.scene.receiver import first_hit
from warpir.scene.shadow_mask import values_at
from warpir.scene.tone_curves import Curves

SKIES = {
    # Radiance of the sky, and the colour of the sun that goes with it.
    "clear": ((0.45, 0.62, 1.0), (1.0, 0.94, 0.85)),
    "overcast": ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
    "sunset": ((0.75, 0.62, 0.72), (1.0, 0.62, 0.32)),
}
"""Relative radiances by preset, linear RGB; only their proportions matter."""
SUN_TO_SKY = 5.0
"""Irradiance of a surface facing the sun over that from a clear sky on the ground [1]."""
GROUND_PERCENTILE = 50.0
"""Of the ground round the object: the level of an even light (the authors state none)."""
LEVELS = (1e-3, 0.9)
"""Darkest and brightest level of the ground that a photo is believed to show [1]."""
LIT_PERCENTILE = 75.0
"""The brighter quarter of the ground round the object stands for ground that is not in shadow."""
LEAST_FROM_AFAR = 0.05
"""Share of that ground's light which does not come from lamps near it, at least [1]."""
LIT_SHARE = 0.1
"""Share of that ground which must be known to be out of shadow to be measured alone [1]."""
SEEN = 0.99
"""A point counts as seen when the camera's ray gets this share of the way to it [1]."""


@dataclass(frozen=True)
class SceneLight:
    """The light of the scene, at the photo's exposure, and the tone curves that go with it."""

    light: Light
    """Lights the object."""
    light_shadow: Light
    """Casts its shadow; the same object as `light` where there is one light."""
    curves: Curves
    exposure: float
    """What the given light was multiplied with, in stops [EV]."""
    assumed: tuple[str, ...]
    """What was chosen because nothing was given, one line each."""
    fit: LobeFit | None = None
    """How well the lobes fit the panorama, when they were fitted."""
    detailed: Light | None = None
    """`light` with what the photo shows of the surroundings, where that is wanted; not a light of
    the place that another photo could use."""

    @property
    def has_lamps(self) -> bool:
        """Whether a part of it is as narrow as a lamp's light."""
        return any(len(lamp_axes(light)) > 0 for light in (self.light, self.light_shadow))

    @property
    def on_object(self) -> Light:
        """What the object is rendered under."""
        return self.light if self.detailed is None else self.detailed


def make_light(inputs: Inputs, asked: LightConfig, tone: str) -> SceneLight | None:
    """Build the light and set its exposure; None: it is to be estimated from the photo.

    Raises:
        InputError: The light is black, so no exposure can be chosen; or --tone contradicts the run
            whose light is used again.
    """
    if inputs.run is not None:
        return _reused(inputs.run, asked)
    if not asked.is_described and inputs.light is None:
        return _even(inputs, tone) if asked.start == "uniform" else None
    assumed: list[str] = []
    light = inputs.light if inputs.light is not None else _described(asked, assumed)
    fit = None
    if asked.fit_lobes is not None and light.texels is not None:
        fit = fit_lobes(light.texels, asked.fit_lobes)
        light = Light(lobes=fit.lobes)
    exposure = asked.exposure
    if exposure is None:
        exposure = _automatic_exposure(light, inputs, asked, tone)
        assumed.append(
            f"the light is {exposure:+.2f} EV, so that ground of albedo "
            f"{asked.assumed_albedo:g} looks as bright as the photo's lit ground "
            "(--exposure, --ground-albedo)"
        )
    light = light.scaled(2.0**exposure)
    curves = Curves.identity(tone)
    return SceneLight(light, light, curves, exposure, tuple(assumed), fit)


def _even(inputs: Inputs, tone: str) -> SceneLight:
    """Return an even light at the ground's level (ours)."""
    level = start_level(inputs, tone)
    light = Light(texels=np.full((8, 16, 3), level, np.float32))
    assumed = "no light is given: it starts as an even one (--start, --light, --sun)"
    return SceneLight(light, light, Curves.identity(tone), 0.0, (assumed,))


def start_level(inputs: Inputs, tone: str) -> float:
    """Return the radiance of an even light under which white ground looks as the photo's does."""
    level = believed(_level(inputs, _ring(inputs), GROUND_PERCENTILE), inputs.photo)
    return _radiance(level, tone)


def believed(level: float, photo: Photo) -> float:
    """Return a level of the ground as far as a photo can show it [1]; a linear plate shows all."""
    low, high = LEVELS
    if photo.is_linear:
        return max(level, low / photo.exposure)
    return min(max(level, low), high)


def _radiance(level: float, tone: str) -> float:
    """Return what the tone operator shows as a level; Reinhard's never shows more than `LEVELS`."""
    if tone != "reinhard":
        return level
    level = min(level, LEVELS[1])
    return level / (1.0 - level)


def _reused(run: EarlierRun, asked: LightConfig) -> SceneLight:
    """Return an earlier run's light and curves; they are at the exposure of that run's photo."""
    if asked.tone not in (None, run.curves.tone):
        found = f"the curves of {run.path} are made for {run.curves.tone}"
        raise usage("--tone", f"cannot be {asked.tone}: {found}", "leave --tone out")
    exposure = asked.exposure or 0.0

    def adapted(light: Light) -> Light:
        return light.rotated(asked.rotate).scaled(2.0**exposure)

    light = light_shadow = adapted(run.light_fg)
    if run.light_shadow is not run.light_fg:
        light_shadow = adapted(run.light_shadow)
    return SceneLight(light, light_shadow, run.curves, exposure, ())


def _described(asked: LightConfig, assumed: list[str]) -> Light:
    """Return the sun and sky of the flags."""
    sun, sky = asked.sun, asked.sky
    preset = sky if isinstance(sky, str) else "clear"
    if sky is None:
        assumed.append("the sky round the sun of --sun is clear (--sky)")
    sky_color, sun_color = SKIES[preset]
    if isinstance(sky, tuple):
        sky_color = sky
    # What the ground sends back up, by the same albedo that sets the exposure.
    from_sky = np.pi * np.asarray(sky_color)
    lobes = None
    horizontal = from_sky.copy()
    if sun is not None and sun[1] <= 0.0:
        assumed.append("a sun below the horizon is meant: it lights from underneath (--sun)")
    if sun is not None:
        strength = sun[2] if len(sun) == 3 else SUN_TO_SKY * float(luminance(from_sky))
        tint = np.asarray(sun_color) / float(luminance(np.asarray(sun_color)))
        r, g, b = (float(strength * c) for c in tint)
        lobes = sun_lobe(sun[0], sun[1], (r, g, b))
        horizontal += strength * tint * max(np.sin(np.radians(sun[1])), 0.0)
    r, g, b = (float(c) for c in asked.assumed_albedo * horizontal / np.pi)
    return Light(lobes, plain_sky(sky_color, (r, g, b)))


def _automatic_exposure(light: Light, inputs: Inputs, asked: LightConfig, tone: str) -> float:
    """Choose the light's scale so that Lambertian ground appears as the photo shows it.

    The tone curve's start is the identity, so display value = Reinhard(albedo * E / pi), or the
    value itself with ``--tone linear``.
    """
    points, light = lit_ground(_ring(inputs), light, inputs)
    from_afar = float(luminance(light.irradiance(inputs.placement.ground[:3])))
    if not from_afar > 0.0:
        raise InputError(
            asked.file or "--sun",
            "no light reaches the ground, so no exposure follows from the photo",
            "give --exposure",
        )
    level = believed(_level(inputs, points, LIT_PERCENTILE), inputs.photo)
    received = _radiance(level, tone) * np.pi / asked.assumed_albedo
    left = received - _by_lamps(inputs, points)
    return float(np.log2(max(left, LEAST_FROM_AFAR * received) / from_afar))


def _by_lamps(inputs: Inputs, points: Float64Array) -> float:
    """Return the median luminance of what lamps near the object give to points of the ground."""
    if not inputs.lamps:
        return 0.0
    normal = inputs.placement.ground[:3]
    given = [sum(irradiance(lamp, point, normal) for lamp in inputs.lamps) for point in points]
    return float(np.median(luminance(np.array(given))))


def lit_ground(points: Float64Array, light: Light, inputs: Inputs) -> tuple[Float64Array, Light]:
    """Return those points of the ground that the lamps reach, and the light that reaches them.

    Where mesh and mask say that they reach too few, all points and the light without its lamps.
    Points are in the world frame [m], shape [point, 3]; the inputs hold mesh, mask and camera.
    """
    reached = _reached(points, light, inputs)
    if (reached > 0.5).mean() >= LIT_SHARE:
        return points[reached > 0.5], light
    return points, without_lamps(light, 1.0 - float(reached.mean()))


def _ring(inputs: Inputs) -> Float64Array:
    """Return points of the ground round the object's foot, world frame [m], shape [point, 3]."""
    camera, placement = inputs.camera, inputs.placement
    low, high = inputs.asset.bounds()
    size = float(np.linalg.norm((high - low) * np.linalg.norm(placement.asset_to_world[:3, 0])))
    rings = np.linspace(0.2, 1.5, 16) * size
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    if inputs.proxy is not None:
        # Each of them is looked for through the mesh.
        rings, angles = rings[1::4], angles[::4]
    side = np.cross(placement.ground[:3], camera.c2w[:3, 0])
    across = np.cross(side, placement.ground[:3])
    circle = np.cos(angles)[:, None] * _unit(across) + np.sin(angles)[:, None] * _unit(side)
    points: Float64Array = (foot_of(inputs) + rings[:, None, None] * circle[None]).reshape(-1, 3)
    is_seen = seen_past_mesh(points, inputs)
    return points[is_seen] if is_seen.any() else points


def foot_of(inputs: Inputs) -> Float64Array:
    """Return the middle of the lower side of the object's box, world frame [m], shape [3]."""
    middle = np.append(foot_of_box(*inputs.asset.bounds()), 1.0)
    foot: Float64Array = (inputs.placement.asset_to_world @ middle)[:3]
    return foot


def seen_past_mesh(points: Float64Array, inputs: Inputs) -> BoolArray:
    """Return whether no --proxy hides points [m] from the camera, shape [point]."""
    if inputs.proxy is None:
        return np.ones(len(points), bool)
    eye = np.broadcast_to(inputs.camera.c2w[:3, 3], points.shape)
    is_seen: BoolArray = first_hit(inputs.proxy, eye, points - eye)[0] > SEEN
    return is_seen


def _reached(points: Float64Array, light: Light, inputs: Inputs) -> Float64Array:
    """Return which share of the lamps reaches points of the ground [1], shape [point]."""
    reached = np.ones(len(points))
    axes = lamp_axes(light) if inputs.proxy is not None else np.zeros((0, 3))
    if inputs.proxy is not None and len(axes):
        lifted = points + inputs.placement.ground[:3] * 1e-3
        free = [first_hit(inputs.proxy, lifted, np.tile(a, (len(points), 1)))[0] for a in axes]
        reached = np.isinf(free).mean(axis=0)
    if inputs.shadow_mask is not None:
        shares = values_at(inputs.shadow_mask.shares, points, inputs.camera)
        # Nothing is known of the ground outside the photo: it counts as lit.
        reached = reached * (1.0 - np.where(np.isnan(shares), 0.0, shares))
    return reached


def _level(inputs: Inputs, points: Float64Array, percentile: float) -> float:
    """Return a percentile of the photo's linear luminance at world points [1].

    Where the photo shows none of them, of the whole photo.
    """
    seen = photo_luminance(inputs, points)
    if not len(seen):
        seen = np.asarray(luminance(inputs.photo.linear().astype(np.float64)), np.float64)
    return float(np.percentile(seen, percentile))


def photo_luminance(inputs: Inputs, points: Float64Array) -> Float64Array:
    """Return the photo's linear luminance at those world points that it shows [1], shape [seen].

    Points outside the frame are left out, and those behind what --occluder-mask names.
    """
    camera = inputs.camera
    uv = camera.project(points)
    inside = (uv >= 0.0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    columns, rows = uv[inside].astype(int).T
    if inputs.occluder is not None:
        is_free = inputs.occluder[rows, columns] < 0.5
        columns, rows = columns[is_free], rows[is_free]
    linear = inputs.photo.linear((rows, columns)).astype(np.float64)
    return np.asarray(luminance(linear), np.float64)


def _unit(v: Float64Array) -> Float64Array:
    unit: Float64Array = v / np.linalg.norm(v)
    return unit
