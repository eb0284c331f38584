"""How well the ground in a photo tells the level of the light: albedos of panoramas' grounds.

    python -m benchmarks.light.ground_albedo --panoramas DIR --assets DIR [--crops 8] [--seed 3]
        [--json FILE]

Crops of every panorama are photographs as `warpir.evaluate` makes them, each with a place for an
object. The ground's radiance near it times pi, over the irradiance that the panorama gives level
ground, is the ground's albedo; under the regressed light it is the implied albedo. A panorama is
judged by the networks that have not learned from it. Two ways to let the ground change the light's
level are measured: to lower a light under which the ground would be darker than grounds are, and to
weigh the albedo against the usual one as well. `warpir.insert` does neither, see
`docs/evaluation.md`.
"""

from dataclasses import asdict, dataclass

import numpy as np

from benchmarks.measure import flags, write_json
from benchmarks.scenes import panoramas_of, photo_of
from warpir.app.inputs import Inputs
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.errors import InputError
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.evaluate.scenes import ASSET_SUFFIXES, Places, Subject, find_files
from warpir.evaluate.stage import unseen_by
from warpir.lighting.exposure import DARK, ask_ground
from warpir.lighting.regression import regress
from warpir.lighting.regressor import Regressor, load_regressor
from warpir.scene.light import Light, as_map, fibonacci

UP = np.array([0.0, 1.0, 0.0])
ROWS = 128
"""Of the maps that irradiances are summed from."""
LOWER_MAX = float(np.log(2.0))
"""Logarithm of the factor that a light is lowered by at most [1]: some floors are black."""
NORMALS = 128
"""Directions over the sphere; those toward the camera stand for the object."""


@dataclass(frozen=True)
class Crop:
    """Natural logarithms for one photograph, and what the witnesses say."""

    panorama: str
    albedo: float
    """Of the ground's albedo under the true light."""
    implied: float
    """Of that under the regressed light."""
    level: float
    """Of the factor on the regressed light that fits the object's irradiance best."""


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
    return Crop(
        place.panorama,
        float(np.log(ground.implied * on_ground[1] / on_ground[0])),
        float(np.log(ground.implied)),
        float(np.log(wanted @ given / (given @ given))),
    )


def irradiance(texels: FloatArray, normals: Float64Array) -> Float64Array:
    """Return the luminance of the irradiance of surfaces under a map, shape [normal]."""
    omega = texel_solid_angles(*texels.shape[:2])[:, None]
    flux = (luminance(texels.astype(np.float64)) * omega).reshape(-1)
    directions = map_directions(*texels.shape[:2]).reshape(-1, 3)
    total: Float64Array = np.maximum(normals @ directions.T, 0.0) @ flux
    return total


def weigh(first: list[Crop], second: list[Crop]) -> None:
    """Print the gain of the best weight for the ground beside the bound, fitted on one half."""
    usual = float(np.median([c.albedo for c in first]))
    (implied, level), (implied_2, level_2) = (held(half, DARK) for half in (first, second))
    weight = float((implied - usual) @ level / ((implied - usual) @ (implied - usual)))
    after = level_2 - weight * (implied_2 - usual)
    print(
        f"first half: median albedo {np.exp(usual):.3f}, log std "
        f"{columns(first, 'albedo')[0].std():.2f}, best weight beside the bound {weight:.2f}; "
        f"second half: log level {abs(level_2).mean():.3f} -> {abs(after).mean():.3f}"
    )


def held(crops: list[Crop], darkest: float) -> list[Float64Array]:
    """Return implied albedos and levels, in logarithms, after the bound."""
    implied, level = columns(crops, "implied", "level")
    lower = np.clip(np.log(darkest) - implied, 0.0, LOWER_MAX)
    return [implied + lower, level + lower]


def bound(crops: list[Crop], darkest: float) -> None:
    """Print what it brings to hold the light to ground that is no darker."""
    albedo, level = columns(crops, "albedo", "level")
    _, after = held(crops, darkest)
    acts = after != level
    gain = abs(level) - abs(after)
    names = np.array([c.panorama for c in crops])
    of_place = np.array([gain[acts & (names == name)].mean() for name in np.unique(names[acts])])
    print(
        f"no ground darker than {darkest:.3f} ({(np.exp(albedo) < darkest).mean():.1%} are): log "
        f"level {abs(level).mean():.3f} -> {abs(after).mean():.3f}; acts on {acts.sum()} crops of "
        f"{len(of_place)} places, there {abs(level[acts]).mean():.2f} -> "
        f"{abs(after[acts]).mean():.2f}, better in {(of_place > 0.0).sum()} places"
    )


def columns(crops: list[Crop], *names: str) -> list[Float64Array]:
    """Return the named figures, each an array of shape [crop]."""
    return [np.array([getattr(c, name) for c in crops]) for name in names]


def main() -> None:
    """Measure, and print."""
    parser = flags(__doc__, "panoramas", "objects", "json")
    parser.add_argument("--crops", type=int, default=8, help="of each panorama")
    parser.add_argument("--seed", type=int, default=3, help="of the views and objects")
    options = parser.parse_args()
    assets = find_files(options.assets, ASSET_SUFFIXES, "--assets")
    network = load_regressor(None)
    halves: list[list[Crop]] = [[], []]
    for k, path in enumerate(panoramas_of(options)):
        unseen = unseen_by(network, path.stem)
        if unseen is None:
            print(f"{path.stem}: left out, all networks have learned from it")
            continue
        try:
            places = Places([path], assets, seed=options.seed, width=192)
        except InputError as error:
            print(f"{path.stem}: left out, {error}")
            continue
        crops = (crop_of(subjects[0], unseen) for _, subjects in places.make(options.crops))
        halves[k % 2] += [crop for crop in crops if crop is not None]
    crops = halves[0] + halves[1]
    print(f"{len(crops)} crops of {len({c.panorama for c in crops})} places")
    weigh(*halves)
    for darkest in (0.015, 0.02, DARK, 0.03, 0.04):
        bound(crops, darkest)
    write_json(options.json, [[asdict(c) for c in half] for half in halves], indent=None)


if __name__ == "__main__":
    main()
