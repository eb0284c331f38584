"""How well the ground in a photo tells the level of the light: albedos of panoramas' grounds.

    python -m benchmarks.light.ground_albedo --panoramas DIR --assets DIR [--crops 8] [--json FILE]

Crops of every panorama are photographs as `warpir.evaluate` makes them, each with a place for an
object. The ground's radiance near it times pi, over the irradiance that the panorama gives level
ground, is the ground's albedo; under the regressed light it is the implied albedo. A panorama is
judged by the networks that have not learned from it. The panoramas, in the order of their names,
are dealt in turn to two halves: location, scale and degrees of freedom of the albedo's logarithm
are fitted on the first, and the second says how far the level of the regressed light is off, before
and after the ground is asked (`warpir.lighting.exposure`).
"""

from dataclasses import asdict, dataclass

import numpy as np
from scipy.stats import t as student

from benchmarks.measure import flags, rms, write_json
from benchmarks.scenes import panoramas_of, photo_of
from warpir.app.inputs import Inputs
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.evaluate.scenes import ASSET_SUFFIXES, Places, Subject, find_files
from warpir.evaluate.stage import unseen_by
from warpir.lighting.exposure import ALBEDO, ask_ground, level_log_std
from warpir.lighting.regression import regress
from warpir.lighting.regressor import Regressor, load_regressor
from warpir.scene.light import Light, as_map, fibonacci

UP = np.array([0.0, 1.0, 0.0])
ROWS = 128
"""Of the maps that irradiances are summed from."""
NORMALS = 128
"""Directions over the sphere; those toward the camera stand for the object."""


@dataclass(frozen=True)
class Crop:
    """Natural logarithms for one photograph, and what the witnesses say."""

    panorama: str
    is_sunny: bool
    albedo: float
    """Of the ground's albedo under the true light."""
    implied: float
    """Of that under the regressed light."""
    level: float
    """Of the factor on the regressed light that fits the object's irradiance best."""
    ground_level: float
    """Of the factor that makes the irradiance of the ground right."""
    log_std: float
    """What the regressor says of the ground's irradiance."""
    change: float
    """Of the factor that both witnesses give."""


def crop_of(subject: Subject, network: Regressor) -> Crop | None:
    """Return the figures of one photograph; None where its ground is not seen or is black."""
    place = subject.place
    inputs = Inputs(photo_of(place.photo), subject.asset, place.camera, subject.placement)
    regression = regress(network, place.photo, place.camera)
    ground = ask_ground(regression, inputs)
    if ground is None:
        return None
    normals = fibonacci(NORMALS)
    normals = normals[normals @ place.camera.c2w[:3, 2] > 0.0]
    true = resize_map(place.texels, ROWS)
    regressed = as_map(Light(lobes=regression.lobes()), ROWS)
    on_ground = [irradiance(texels, UP[None])[0] for texels in (true, regressed)]
    wanted, given = irradiance(true, normals), irradiance(regressed, normals)
    ratio = float(np.log(on_ground[0] / on_ground[1]))
    return Crop(
        place.panorama,
        place.is_sunny,
        float(np.log(ground.implied)) - ratio,
        float(np.log(ground.implied)),
        float(np.log(wanted @ given / (given @ given))),
        ratio,
        level_log_std(regression, UP),
        ground.weighed * float(np.log(2.0)),
    )


def irradiance(texels: FloatArray, normals: Float64Array) -> Float64Array:
    """Return the luminance of the irradiance of surfaces under a map, shape [normal]."""
    omega = texel_solid_angles(*texels.shape[:2])[:, None]
    flux = (luminance(texels.astype(np.float64)) * omega).reshape(-1)
    directions = map_directions(*texels.shape[:2]).reshape(-1, 3)
    total: Float64Array = np.maximum(normals @ directions.T, 0.0) @ flux
    return total


def describe(crops: list[Crop], name: str) -> None:
    """Print how far levels are off, before and after the ground is asked."""
    for words, chosen in (
        ("all", crops),
        ("sunny", [c for c in crops if c.is_sunny]),
        ("other", [c for c in crops if not c.is_sunny]),
    ):
        if not chosen:
            continue
        values = {k: np.array([asdict(c)[k] for c in chosen]) for k in
                  ("albedo", "implied", "level", "ground_level", "log_std", "change")}  # fmt: skip
        level, after = values["level"], values["level"] - values["change"]
        places = len({c.panorama for c in chosen})
        print(
            f"{name}, {words}: {len(chosen)} crops of {places} places; albedo: median "
            f"{np.exp(np.median(values['albedo'])):.3f}, log std {values['albedo'].std():.2f}; "
            f"implied: median {np.exp(np.median(values['implied'])):.3f}, log std "
            f"{values['implied'].std():.2f}"
        )
        print(
            f"    log level of the object: mean absolute {abs(level).mean():.3f} -> "
            f"{abs(after).mean():.3f}, RMS {rms(level):.3f} -> {rms(after):.3f}; the regressor "
            f"says {rms(values['log_std']):.2f} of the ground's, whose RMS is "
            f"{rms(values['ground_level']):.2f}"
        )


def main() -> None:
    """Measure, and print."""
    parser = flags(__doc__, "panoramas", "objects", "json")
    parser.add_argument("--crops", type=int, default=8, help="of each panorama")
    options = parser.parse_args()
    assets = find_files(options.assets, ASSET_SUFFIXES, "--assets")
    network = load_regressor(None)
    halves: list[list[Crop]] = [[], []]
    for k, path in enumerate(panoramas_of(options)):
        unseen = unseen_by(network, path.stem)
        if unseen is None:
            print(f"{path.stem}: left out, all networks have learned from it")
            continue
        places = Places([path], assets, seed=3, width=192)
        crops = (crop_of(subjects[0], unseen) for _, subjects in places.make(options.crops))
        halves[k % 2] += [crop for crop in crops if crop is not None]
    freedom, location, scale = student.fit(np.array([c.albedo for c in halves[0]]))
    print(
        f"first half: the albedo's logarithm is Student's t with {freedom:.1f} degrees of freedom "
        f"about {np.exp(location):.3f}, scale {scale:.2f} (in use: {ALBEDO:g})"
    )
    describe(halves[0], "first half")
    describe(halves[1], "second half")
    write_json(options.json, [[asdict(c) for c in half] for half in halves], indent=None)


if __name__ == "__main__":
    main()
