"""Is what the photo shows of the surroundings nearer to the truth than a smooth light alone?

    python -m benchmarks.light.detail --panoramas DIR --places 8 --json FILE --sheet detail.png

Photographs are crops of panoramas; a sphere stands in each, once as a mirror, once as polished
paint, satin metal and matte. The light is the regressor's, and once the best that 32 lobes can be.
The truth is the panorama with its lower half laid on the ground plane, as the object sees it, and
for comparison the panorama at infinity. Error: RMSE over the sphere, display-encoded.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import flags, table, write_json
from benchmarks.referee.subjects import ball
from benchmarks.scenes import panoramas_of, places_of, write_picture
from warpir.core.latlong import look_up, map_directions, resize_map, texel_solid_angles
from warpir.evaluate.image_errors import rmse
from warpir.evaluate.scenes import Place, Subject
from warpir.evaluate.stage import Prediction, Stage
from warpir.lighting.detail import HEIGHT, Detail, seen_from, with_detail
from warpir.lighting.fit import fit_lobes
from warpir.lighting.regression import regress
from warpir.lighting.regressor import load_regressor
from warpir.render.device import choose_device
from warpir.render.picture.quality import Quality
from warpir.scene.asset import Asset, Material
from warpir.scene.camera import Camera
from warpir.scene.light import Light, as_map
from warpir.scene.placement import place_asset
from warpir.scene.tone_curves import Curves

GROUND = np.array([0.0, 1.0, 0.0, 0.0])
MATERIALS = {
    "mirror": Material(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.05),
    "paint": Material(base_color=(0.2, 0.02, 0.02), metallic=0.0, roughness=0.1),
    "satin": Material(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.3),
    "matte": Material(base_color=(0.6, 0.6, 0.6), metallic=0.0, roughness=1.0),
}
COARSE, SIGMA_DEG = 32, 20.0
"""Rows and width of the low pass of `keeping_low_frequencies`."""
WIDTH, TILE = 384, 96
"""Of the photographs, and of what is cut out of them for the sheet [px]."""


def on_the_ground(place: Place, centre: NDArray[np.float64]) -> Light:
    """Return the panorama as it is seen from a point, its lower half laid on the ground."""
    rays = map_directions(HEIGHT, 2 * HEIGHT)
    below = rays[..., 1] < 0.0
    point = centre + (centre[1] / -rays[..., 1][below])[:, None] * rays[below]
    rays[below] = point - place.camera.c2w[:3, 3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return Light(texels=look_up(place.texels, rays).astype(np.float32))


def keeping_low_frequencies(light: Light, detail: Detail) -> Light:
    """Return the light times the photo over its own low frequencies: what was not chosen."""
    weight = detail.weight[..., None]
    smooth = as_map(light, HEIGHT)
    level = 0.02 * detail.radiance[detail.weight > 0.0].mean(axis=0)
    mean = low_pass(weight * detail.radiance) / np.maximum(low_pass(weight), 1e-6)
    directions = map_directions(HEIGHT, 2 * HEIGHT)
    factor = (detail.radiance + level) / (look_up(mean, directions) + level)
    sharp = smooth * (1.0 + weight * (factor - 1.0))
    kept = low_pass(smooth) / np.maximum(low_pass(sharp), 1e-30)
    return Light(texels=(sharp * look_up(kept, directions)).astype(np.float32))


def low_pass(texels: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return each direction's mean under a Gaussian, shape [COARSE, 2 COARSE, channel]."""
    coarse = resize_map(texels.astype(np.float32), COARSE).reshape(2 * COARSE**2, -1)
    directions = map_directions(COARSE, 2 * COARSE).reshape(-1, 3)
    omega = np.repeat(texel_solid_angles(COARSE, 2 * COARSE), 2 * COARSE)
    kernel = np.exp((directions @ directions.T - 1.0) / np.radians(SIGMA_DEG) ** 2) * omega
    smooth = kernel @ coarse / kernel.sum(axis=1, keepdims=True)
    return smooth.reshape(COARSE, 2 * COARSE, -1).astype(np.float32)


def stand(subject: Subject, camera: Camera) -> tuple[Subject, NDArray[np.float64]]:
    """Put the sphere where the subject stands, as large; return it and its centre [m]."""
    low, high = subject.asset.bounds()
    matrix = subject.placement.asset_to_world
    size = float((high - low).max() * np.linalg.norm(matrix[:3, 0]))
    x, _, z = (matrix @ np.append((low + high) / 2.0, 1.0))[:3]
    asset = Asset("sphere", (ball(96),), (Material(),))
    placement = place_asset(*asset.bounds(), camera, place=(x, 0.0, z), size=size)
    return replace(subject, asset=asset, placement=placement), np.array([x, size / 2.0, z])


Pictures = dict[str, NDArray[np.float32]]


def insertions(
    stage: Stage, place: Place, centre: NDArray[np.float64], lights: dict[str, Light]
) -> tuple[Pictures, dict[str, Pictures]]:
    """Return the true pictures by what is true, and those of each light by what it is given."""
    shown = Curves.identity("linear").radiance(place.photo_lin).astype(np.float32)
    detail = seen_from(centre, shown, place.camera, GROUND)

    def picture(light: Light) -> NDArray[np.float32]:
        prediction = Prediction.of(light)
        return stage.compose(stage.render(prediction), prediction.curves)

    truths = {"on the ground": picture(on_the_ground(place, centre)), "far": stage.truth}
    return truths, {
        kind: {
            "without": picture(light),
            "detail": picture(with_detail(light, detail)),
            "low frequencies kept": picture(keeping_low_frequencies(light, detail)),
        }
        for kind, light in lights.items()
    }


def tile(pictures: list[NDArray[np.float32]], covered: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return cuts round the sphere side by side."""
    v, u = (int(k.mean()) for k in np.nonzero(covered))
    h, w = covered.shape
    top, left = min(max(v - TILE // 2, 0), h - TILE), min(max(u - TILE // 2, 0), w - TILE)
    cut = (slice(top, top + TILE), slice(left, left + TILE))
    return np.concatenate([p[cut] for p in pictures], axis=1)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print the mean errors, three designs a line."""
    names = ("material", "light", "truth")
    lines = [
        [*(rows[k][name] for name in names), *(f"{r['rmse']:.4f}" for r in rows[k : k + 3])]
        for k in range(0, len(rows), 3)
    ]
    print(table((*names, "without", "detail", "low frequencies kept"), lines))


def main() -> None:
    """Run it."""
    parser = flags(__doc__, "panoramas", "objects", "device", "json")
    parser.add_argument("--places", type=int, default=8)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--sheet", type=Path)
    options = parser.parse_args()
    device = choose_device(options.device)
    regressor = load_regressor(None)
    errors: dict[tuple[str, str, str, str], list[float]] = {}
    tiles = []
    places = places_of(options, panoramas_of(options), WIDTH)
    for place, subjects in places.make(options.places):
        subject, centre = stand(subjects[0], place.camera)
        lights = {
            "regressed": Light(lobes=regress(regressor, place.photo, place.camera).lobes()),
            "32 lobes": Light(lobes=fit_lobes(place.texels, 32).lobes),
        }
        for name, material in MATERIALS.items():
            asset = replace(subject.asset, materials=(material,))
            quality = Quality(options.samples, 1, 1, options.seed, 8.0)
            stage = Stage(replace(subject, asset=asset), device, quality)
            truths, pictures = insertions(stage, place, centre, lights)
            covered = stage.mask > 0.5
            for kind, truth in product(lights, truths):
                for which, image in pictures[kind].items():
                    error = rmse(image[covered], truths[truth][covered])
                    errors.setdefault((name, kind, truth, which), []).append(error)
            if name in ("mirror", "paint"):
                two = [image for by in pictures.values() for image in list(by.values())[:2]]
                tiles.append(tile([*truths.values(), *two], covered))
    names = ("material", "light", "truth", "which", "rmse")
    rows = [
        dict(zip(names, (*key, float(np.mean(values))), strict=True))
        for key, values in errors.items()
    ]
    print_table(rows)
    record = {"device": device, "places": options.places, "seed": options.seed, "rows": rows}
    write_json(options.json, record, indent=None)
    if options.sheet is not None:
        write_picture(options.sheet, np.concatenate(tiles))


if __name__ == "__main__":
    main()
