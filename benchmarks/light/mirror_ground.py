"""Is a ground that mirrors told from one that does not, and how rough it is?

    python -m benchmarks.light.mirror_ground --panoramas DIR [DIR ...] --json mirror_ground.json

Photographs are crops of panoramas of real places, 288 x 192, eight of each: 45 degrees apart within
5, pitch -15 to 0 degrees, horizontal field of view 60 to 75, 8 bits. Which of them show mirror
images was judged by eye, in the unrolled panoramas and in crops of seed 0: `MIRRORS` names the
headings where they are plain, `UNCLEAR` the places whose floors are smooth enough to show some;
every other crop is matt. The rule and its thresholds were chosen on crops of seed 0; other seeds
are other crops of the same places. For roughness with a known truth, some open places are coated:
below the horizon half of the ground's light is left, and to it is added what 96 random GGX normals
per pixel mirror of the whole panorama, unclipped and infinitely distant.
``--pitch-error`` turns the camera that the estimate is told away from the true one.
"""

import json
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import flags, rms, write_json
from benchmarks.scenes import panoramas_of
from tests.oracles import fresnel
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import expose, gamma_to_linear
from warpir.core.errors import InputError
from warpir.core.latlong import look_up
from warpir.evaluate.scenes import CAMERA_HEIGHT, crop_camera, crop_radiance
from warpir.io.images.photos import read_envmap
from warpir.look.ground_coat import GroundCoat, estimate_coat
from warpir.scene.camera import Camera

WIDTH, HEIGHT, VIEWS = 288, 192, 8
UP = np.array([0.0, 1.0, 0.0])
SKY_ONLY = "puresky"
MIRRORS = {
    "blue_grotto": "3",
    "blue_photo_studio": "67",
    "brown_photostudio_03": "456",
    "brown_photostudio_05": "345",
    "brown_photostudio_07": "45",
    "combination_room": "1",
    "mirrored_hall": "3456",
    "neon_photostudio": "345",
    "old_hall": "2567",
    "rostock_laage_airport": "23456",
    "sepulchral_chapel_rotunda": "24",
    "spree_bank": "012",
    "vestibule": "015",
    "vignaioli_night": "01234567",
    "workshop": "15",
}
"""Headings, in eighths of a turn from -Z, at which a place's ground shows mirror images."""
UNCLEAR = (
    *MIRRORS,
    *(f"studio_small_0{k}" for k in (2, 3, 5, 7, 8, 9)),
    *"""aerodynamics_workshop autoshop_01 brown_photostudio_01 brown_photostudio_02 cayley_interior
    christmas_photo_studio_01 christmas_photo_studio_03 christmas_photo_studio_07
    cobblestone_street_night lake_pier large_corridor leadenhall_market lebombo metro_noord
    modern_buildings_2 parking_garage photo_studio_loft_hall pmndrs_sky poly_haven_studio
    provence_studio shanghai_riverside st_fagans_interior st_peters_square_night thatch_chapel
    veranda warm_restaurant""".split(),
)
"""Places whose other crops are neither plainly mirrors nor plainly matt."""
COATED = """blouberg_sunrise_2 bryanston_park_sunrise dresden_square dry_cracked_lake
grasslands_sunset noon_grass palermo_square piazza_bologni pine_picnic pmndrs_sunset potsdamer_platz
rooitou_park round_platform rural_asphalt_road urban_street_01""".split()
"""Open places that are coated."""
ROUGHNESSES = (0.1, 0.2, 0.3)
COATED_VIEWS = (1,)
NORMALS = 96
LEFT = 0.5
"""Share of its light that a coated ground keeps [1]."""


@dataclass(frozen=True)
class Judged:
    """What was found in one crop."""

    place: str
    view: int
    kind: str
    """``mirrors``, ``matt``, ``unclear``, or ``coated`` with a known roughness."""
    truth: float | None
    """Of the coat [1]."""
    found: GroundCoat


def kind_of(place: str, view: int) -> str:
    """Return how a crop was judged by eye."""
    if str(view) in MIRRORS.get(place, ""):
        return "mirrors"
    return "unclear" if place in UNCLEAR else "matt"


def coat_light(texels: FloatArray, rays: Float64Array, roughness: float, seed: int) -> Float64Array:
    """Return what a rough coat sends toward the camera, by random normals, shape [N, 3].

    Normals are drawn from GGX's distribution D cos; a normal counts by Fresnel's share, Smith's
    masking and the projected areas (Walter et al. 2007, equation 41). The light is a lat-long map,
    ``rays`` are unit directions from the camera down to the ground, shape [N, 3], and the roughness
    is perceptual.
    """
    rng, alpha, light = np.random.default_rng(seed), roughness**2, np.zeros_like(rays)
    out = -rays[:, 1]

    def masking(cos: Float64Array) -> Float64Array:
        tan = np.sqrt(np.maximum(1.0 / np.maximum(cos, 1e-4) ** 2 - 1.0, 0.0))
        return np.asarray(2.0 / (1.0 + np.sqrt(1.0 + (alpha * tan) ** 2)))

    for _ in range(NORMALS):
        u, turn = rng.random(len(rays)), 2.0 * np.pi * rng.random(len(rays))
        theta = np.arctan(alpha * np.sqrt(u / (1.0 - u)))
        sin = np.sin(theta)
        half = np.stack([sin * np.cos(turn), np.cos(theta), sin * np.sin(turn)], -1)
        facing = -(rays * half).sum(-1)
        mirrored = rays + 2.0 * facing[:, None] * half
        seen = (facing > 0.0) & (mirrored[:, 1] > 0.0)
        c = np.clip(facing, 1e-6, 1.0)
        weight = fresnel(c, 1.5) * masking(out) * masking(mirrored[:, 1])
        weight = np.where(seen, weight * c / (out * half[:, 1]), 0.0)
        light += weight[:, None] * look_up(texels, mirrored)
    return light / NORMALS


def coated(
    radiance: Float64Array, texels: FloatArray, camera: Camera, roughness: float, seed: int
) -> Float64Array:
    """Return what the camera sees when the ground has a coat, shape [H, W, 3]."""
    rays = camera.pixel_rays()
    below = rays[..., 1] < -0.03
    shown = radiance.copy()
    shown[below] *= LEFT
    shown[below] += coat_light(texels, rays[below], roughness, seed)
    return shown


def judged(path: Path, seed: int, pitch_error: float) -> Iterator[Judged]:
    """Yield what is found in the crops of one panorama."""
    place = path.name.split(".")[0].removesuffix("_1k")
    texels = np.maximum(read_envmap(path), 0.0)
    rng = np.random.default_rng([zlib.crc32(place.encode()), *([seed] if seed else [])])
    for view in range(VIEWS):
        pitch, fov = rng.uniform(-15.0, 0.0), rng.uniform(60.0, 75.0)
        angles = fov, view * 360.0 / VIEWS + rng.uniform(-5.0, 5.0)
        camera = crop_camera(WIDTH, HEIGHT, *angles, pitch, CAMERA_HEIGHT)
        told = pitch + pitch_error * rng.normal() if pitch_error else pitch
        as_told = crop_camera(WIDTH, HEIGHT, *angles, told, CAMERA_HEIGHT)
        radiance = crop_radiance(texels, camera)
        cases: list[tuple[str, float | None]] = [(kind_of(place, view), None)]
        if place in COATED and view in COATED_VIEWS:
            cases += [("coated", roughness) for roughness in ROUGHNESSES]
        for kind, truth in cases:
            shown = radiance if truth is None else coated(radiance, texels, camera, truth, view)
            codes = np.round(255.0 * expose(shown)[0]) / 255.0
            found = estimate_coat(gamma_to_linear(codes.astype(np.float32)), as_told, UP)
            yield Judged(place, view, kind, truth, found)


def summary(results: list[Judged]) -> dict[str, Any]:
    """Return how many of each kind are said to mirror, and the errors of known roughness."""
    table: dict[str, Any] = {}
    for kind in ("mirrors", "matt", "unclear"):
        of = [r for r in results if r.kind == kind]
        table[kind] = [sum(r.found.roughness is not None for r in of), len(of)]
    for truth in ROUGHNESSES:
        of = [r for r in results if r.truth == truth]
        errors = [r.found.roughness - truth for r in of if r.found.roughness is not None]
        found = (float(np.mean(errors)), rms(errors)) if errors else (None, None)
        table[f"coated {truth}"] = [len(errors), len(of), *found]
    return table


def main() -> None:
    """Print the table, and write every crop's figures."""
    parser = flags(__doc__, "panoramas", "json")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pitch-error", type=float, default=0.0, help="standard deviation [deg]")
    asked = parser.parse_args()
    results: list[Judged] = []
    for path in (path for path in panoramas_of(asked) if SKY_ONLY not in path.name):
        try:
            results += judged(path, asked.seed, asked.pitch_error)
        except InputError as error:
            print(f"left out: {error}")
    table = summary(results)
    print(json.dumps(table))
    write_json(asked.json, {"table": table, "crops": [asdict(result) for result in results]})


if __name__ == "__main__":
    main()
