"""Is a sun that a photo shows found, is nothing else taken for one, and is the light better for it?

    python -m benchmarks.light.visible_sun --panoramas DIR --json visible_sun.json

Photographs are crops of panoramas, 288 x 192, with the peak of the light inside (at most four of a
place) and outside (seven): pitch -15 to 35 degrees, vertical field of view 35 to 75, exposure off
by half a stop, the camera's glare in half of them, one of two responses, 8 bits. A panorama is
judged by the networks that have not learned from it. Places are halved by the checksum of their
names; ``--fit`` fits the rule's weights to one half. The errors of the light are those of crops
with an unclouded sun in them, before and after.
"""

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from benchmarks.measure import flags, write_json
from benchmarks.scenes import is_for_fitting, panoramas_of, photo_of
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import expose, linear_to_gamma, luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.evaluate.scenes import (
    CAMERA_HEIGHT,
    RESPONSES,
    Place,
    crop_camera,
    crop_radiance,
)
from warpir.evaluate.stage import unseen_by
from warpir.io.images.photos import read_envmap
from warpir.lighting import visible_sun
from warpir.lighting.regression import Regression, regress
from warpir.lighting.regressor import Regressor, load_regressor
from warpir.train.lights import SPLIT_HEIGHT, split_sun

WIDTH, HEIGHT = 288, 192
INSIDE, OUTSIDE = 4, 7
"""Crops of a place with the light's peak in them, and without."""
CAP_DEG = 5.0
"""Half angle of the cap whose flux is the peak's [deg]."""
SUN_SHARE, SUN_PEAK = 0.2, 3000.0
"""An unclouded sun: least share of the flux from its cap, and least peak over the mean [1]."""
FOUND_DEG, WRONG_DEG = 2.0, 4.0
"""A sun is found within the first; what is found beyond the second is a false alarm [deg]."""
RIDGE = 0.15
"""Weight of the squared weights in the fit."""
LIKELY, OPINION_MAX = -1.5, 1.5
"""Log odds that a spot must reach with the best opinion of the regressor for it to be asked."""


@dataclass(frozen=True)
class Truth:
    """The brightest light of a panorama."""

    name: str
    axis: Float64Array
    """Unit direction, shape [3]."""
    share: float
    """Of the flux, within `CAP_DEG` [1]."""
    is_sun: bool
    """Unclouded and above the horizon; a lamp may be one too."""
    texels: FloatArray


@dataclass(frozen=True)
class Crop:
    """A photograph of a place."""

    truth: Truth
    place: Place
    is_inside: bool
    """Whether the peak is in it."""


@dataclass(frozen=True)
class Judged:
    """The spots of a crop, and which of them is the likeliest."""

    crop: Crop
    regression: Regression | None
    """Where the regressor was asked."""
    features: Float64Array
    """Of each spot, shape [spot, 6]; the regressor's opinion is 0 where it was not asked."""
    angles_deg: Float64Array
    """Between each spot and the true peak, shape [spot]."""

    def best(self, weights: Float64Array, bias: float) -> tuple[float, float]:
        """Return the log odds of the likeliest spot, and its angle [deg]."""
        if not len(self.features):
            return -np.inf, 180.0
        odds = self.features @ weights + bias
        k = int(np.argmax(odds))
        return float(odds[k]), float(self.angles_deg[k])


def truth_of(path: Path) -> Truth:
    """Find the brightest light of a panorama."""
    texels = resize_map(np.maximum(read_envmap(path), 0.0), 512)
    height, width = texels.shape[:2]
    directions = map_directions(height, width)
    lum = luminance(texels.astype(np.float64))
    flux = lum * texel_solid_angles(height, width)[:, None]
    near = directions @ directions[np.unravel_index(lum.argmax(), lum.shape)] > np.cos(0.05)
    axis = flux[near] @ directions[near]
    axis /= np.linalg.norm(axis)
    cap = directions @ axis > np.cos(np.radians(CAP_DEG))
    share = float(flux[cap].sum() / flux.sum())
    peak = float(lum.max() / (flux.sum() / (4.0 * np.pi)))
    is_sun = share >= SUN_SHARE and peak >= SUN_PEAK and axis[1] > 0.0
    return Truth(path.stem, axis, share, is_sun, texels.astype(np.float32))


def with_glare(radiance: Float64Array, share: float, pixel_deg: float) -> Float64Array:
    """Spread a share of the radiance as lenses do: by the angle to the power of -2.2."""
    height, width = radiance.shape[:2]
    rows, columns = np.mgrid[-height:height, -width:width]
    kernel = ((rows**2 + columns**2) * pixel_deg**2 + 0.09) ** -1.1
    spectrum = np.fft.rfft2(np.fft.ifftshift(kernel / kernel.sum()))[..., None]
    padded = np.pad(radiance, ((0, height), (0, width), (0, 0)))
    spread = np.fft.irfft2(np.fft.rfft2(padded, axes=(0, 1)) * spectrum, kernel.shape, (0, 1))
    return (1.0 - share) * radiance + share * np.maximum(spread[:height, :width], 0.0)


def crops_of(truth: Truth) -> Iterator[Crop]:
    """Yield photographs of a place, as many inside and outside as can be had in 400 tries."""
    seed = (7, zlib.crc32(truth.name.encode()))
    rng = np.random.default_rng(seed)
    azimuth = float(np.degrees(np.arctan2(truth.axis[0], -truth.axis[2])))
    wanted = {True: INSIDE, False: OUTSIDE}
    for _ in range(400):
        pitch = float(rng.uniform(-15.0, 10.0 if rng.random() < 0.6 else 35.0))
        across = 2.0 * np.degrees(np.arctan(np.tan(np.radians(rng.uniform(35, 75)) / 2.0) * 1.5))
        turn = float(rng.uniform(0.0, 360.0))
        if wanted[True] and rng.random() < 0.5:
            turn = azimuth + float(rng.uniform(-0.5, 0.5)) * across
        camera = crop_camera(WIDTH, HEIGHT, float(across), turn, pitch, CAMERA_HEIGHT)
        u, v = camera.project(camera.c2w[:3, 3] + 100.0 * truth.axis[None])[0]
        is_inside = bool(0.0 <= u < WIDTH and 0.0 <= v < HEIGHT)
        if not wanted[is_inside]:
            continue
        wanted[is_inside] -= 1
        seen = crop_radiance(truth.texels, camera, 1)
        if rng.random() < 0.5:
            pixel_deg = float(np.degrees(1.0 / camera.fx))
            seen = with_glare(seen, 10.0 ** rng.uniform(-3.0, -1.6), pixel_deg)
        gain = 2.0 ** (expose(seen)[1] + np.clip(0.5 * rng.normal(), -1.2, 1.2))
        response = "gamma" if rng.random() < 0.6 else "filmic"
        shown = linear_to_gamma(RESPONSES[response].show(seen * gain))
        photo = photo_of(shown).srgb
        name = f"{truth.name}-{sum(wanted.values())}"
        place = Place(
            name, truth.name, camera, turn, pitch, photo, float(gain), response, truth.texels, seed
        )
        yield Crop(truth, place, is_inside)


def judge(crop: Crop, network: Regressor) -> Judged:
    """Measure the spots; the regressor is asked only where there may be a sun."""
    place, weights = crop.place, visible_sun.WEIGHTS
    spots = visible_sun.find_spots(place.photo, place.camera)
    features = np.zeros((len(spots), len(weights)))
    for row, spot in zip(features, spots, strict=True):
        row[:-1] = spot.features()
    odds = features @ weights + visible_sun.BIAS + OPINION_MAX * float(weights[-1])
    regression = None
    if (crop.truth.is_sun and crop.is_inside) or (odds > LIKELY).any():
        regression = regress(network, place.photo, place.camera)
        features[:, -1] = [visible_sun.features_of(s, regression)[-1] for s in spots]
    cosine = np.clip([float(s.axis @ crop.truth.axis) for s in spots], -1.0, 1.0)
    return Judged(crop, regression, features, np.degrees(np.arccos(cosine)))


def fit(judged: list[Judged]) -> tuple[Float64Array, float]:
    """Fit the rule: first what spots look like, then how much the regressor's opinion adds."""
    x, sign = [], []
    for j in judged:
        for features, angle in zip(j.features[:, :-1], j.angles_deg, strict=True):
            if angle > WRONG_DEG or (is_sun_crop(j) and angle < FOUND_DEG):
                x.append(features)
                sign.append(1.0 if angle < FOUND_DEG else -1.0)
    weights, bias = logistic(np.array(x), np.array(sign))
    pairs, sign = [], []
    for j in (j for j in judged if j.regression is not None and len(j.features)):
        plain = j.features[:, :-1] @ weights + bias
        k = int(np.argmax(plain))
        if j.angles_deg[k] > WRONG_DEG or (is_sun_crop(j) and j.angles_deg[k] < FOUND_DEG):
            pairs.append((plain[k], j.features[k, -1]))
            sign.append(1.0 if j.angles_deg[k] < FOUND_DEG else -1.0)
    (scale, opinion), shift = logistic(np.array(pairs), np.array(sign))
    return np.append(scale * weights, opinion), float(scale * bias + shift)


def logistic(x: Float64Array, sign: Float64Array) -> tuple[Float64Array, float]:
    """Return the weights and the bias of a logistic regression."""
    scale = x.std(axis=0)

    def loss(w: Float64Array) -> float:
        odds = (x / scale) @ w[1:] + w[0]
        return float(np.logaddexp(0.0, -sign * odds).sum() + RIDGE * (w[1:] ** 2).sum())

    w = minimize(loss, np.zeros(x.shape[1] + 1)).x
    return w[1:] / scale, float(w[0])


def is_sun_crop(judged: Judged) -> bool:
    """Return whether an unclouded sun is in the crop."""
    return judged.crop.truth.is_sun and judged.crop.is_inside


def detection(judged: list[Judged], weights: Float64Array, bias: float) -> dict[str, float]:
    """Return how many suns are found, and how often something else is taken for one."""
    least = float(np.log(visible_sun.PROBABILITY_MIN / (1.0 - visible_sun.PROBABILITY_MIN)))
    best = [(j, *j.best(weights, bias)) for j in judged]
    suns = [(odds, angle) for j, odds, angle in best if is_sun_crop(j)]
    found = [angle for odds, angle in suns if odds >= least]
    alarms = [j for j, odds, angle in best if odds >= least and angle > WRONG_DEG]
    return {
        "places": len({j.crop.truth.name for j in judged}),
        "crops": len(judged),
        "suns": len(suns),
        "found": sum(angle <= FOUND_DEG for angle in found) / max(len(suns), 1),
        "mean_angle_deg": float(np.mean(found or [np.nan])),
        "false_alarms": len(alarms) / max(len(judged), 1),
    }


def sun_and_rest(truth: Truth) -> tuple[float, float]:
    """Return what the sun gives a surface that faces it, and the flux of all else; luminances."""
    split = split_sun(resize_map(truth.texels, SPLIT_HEIGHT))
    omega = texel_solid_angles(*split.rest.shape[:2])[:, None]
    rest = float((luminance(split.rest.astype(np.float64)) * omega).sum())
    return float(luminance(split.sun)), rest


def suns_in_view(judged: list[Judged]) -> dict[str, Any]:
    """Return mean and deviation of the two logarithms that `visible_sun` expects of a sun in view.

    Of the sun's irradiance over the flux of the rest, by place, and of both over the photo's mean.
    """
    crops = [j.crop for j in judged if is_sun_crop(j)]
    parts = {c.truth.name: c.truth for c in crops}
    known = {name: sun_and_rest(truth) for name, truth in parts.items()}
    totals = []
    for crop in crops:
        mean = float(luminance(crop.place.photo_lin.astype(np.float64)).mean())
        totals.append(np.log(sum(known[crop.truth.name]) * crop.place.exposure / mean))
    ratios = [np.log(sun / rest) for sun, rest in known.values()]
    return {
        name: {"count": len(v), "mean": float(np.mean(v)), "std": float(np.std(v))}
        for name, v in (("log_ratio", ratios), ("log_total", totals))
    }


def light_before_and_after(judged: list[Judged]) -> dict[str, dict[str, float]]:
    """Return mean errors of the light of crops with a sun in them: angle, logs of ratio and sum."""
    errors: dict[str, list[tuple[float, float, float]]] = {"before": [], "after": []}
    for j in filter(is_sun_crop, judged):
        assert j.regression is not None
        place, (sun, rest) = j.crop.place, sun_and_rest(j.crop.truth)
        after = visible_sun.with_visible_sun(j.regression, place.photo, place.camera)
        for name, light in (("before", j.regression), ("after", after)):
            own = float(luminance(light.sun)), float(luminance(light.ambient.flux().sum(axis=0)))
            cosine = np.clip(light.axis @ j.crop.truth.axis, -1.0, 1.0)
            ratio = abs(np.log(own[0] / own[1] * rest / sun))
            total = abs(np.log(sum(own) / (sun + rest) / place.exposure))
            errors[name].append((float(np.degrees(np.arccos(cosine))), float(ratio), float(total)))
    names = ("angle_deg", "log_ratio", "log_total")
    return {
        when: dict(zip(names, np.mean(found, axis=0).tolist(), strict=True))
        for when, found in errors.items()
        if found
    }


def main() -> None:
    """Print and write what is found, and what it does to the light."""
    parser = flags(__doc__, "panoramas", "json")
    parser.add_argument("--fit", action="store_true", help="fit the rule to one half of the places")
    options = parser.parse_args()
    network = load_regressor(None)
    judged = []
    for path in panoramas_of(options):
        truth, unseen = truth_of(path), unseen_by(network, path.stem)
        if unseen is None:
            print(f"{path.stem}: left out, all networks have learned from it")
            continue
        judged += [judge(crop, unseen) for crop in crops_of(truth)]
    halves: dict[str, list[Judged]] = {"tuned on": [], "held out": []}
    for j in judged:
        halves["tuned on" if is_for_fitting(j.crop.truth.name) else "held out"].append(j)
    weights, bias = visible_sun.WEIGHTS, visible_sun.BIAS
    if options.fit:
        weights, bias = fit(halves["tuned on"])
    record: dict[str, Any] = {"weights": weights.tolist(), "bias": bias}
    record |= {name: detection(half, weights, bias) for name, half in halves.items()}
    record["suns in view"] = suns_in_view(halves["tuned on"])
    record["light"] = light_before_and_after(halves["held out"])
    print(json.dumps(record, indent=2))
    write_json(options.json, record, indent=2)


if __name__ == "__main__":
    main()
