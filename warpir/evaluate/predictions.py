"""Crops as input of other systems, and the maps that they predict.

`export_crops` writes one photo per scene and ``crops.json``, which describes the orientation of a
map; `read_predictions` takes the maps back, named as the crops are.

A map is expected as DiffusionLight, StyleLight and LuxDiT write it: lat-long, the image centre
shows what the photo's centre shows, what lies to the right of the camera is right of the centre, up
is up. For a camera that looks up or down, ``maps.frame`` in ``crops.json`` defines
"up", see `FRAMES`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap
from scipy.ndimage import uniform_filter1d

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import codes_of, gamma_to_linear
from warpir.core.errors import InputError, raise_all
from warpir.core.latlong import latitudes, map_directions, rotate_map
from warpir.core.limits import LIMITS
from warpir.core.strict_json import read_json_object
from warpir.evaluate.scenes import Place
from warpir.evaluate.three_spheres import lookup_matrix
from warpir.io.images.kinds import check_regular_file
from warpir.io.images.photos import read_envmap
from warpir.io.results import OutputFolder
from warpir.scene.camera import Camera
from warpir.scene.light import angles_from_axis

INDEX = "crops.json"
SUFFIXES = (".exr", ".hdr", ".npy")
"""Accepted file types of a map."""

FRAMES = {
    "camera": "tilted with the camera: image centre = optical axis, top = the photo's up "
    "(DiffusionLight, StyleLight)",
    "level": "the horizon is the middle row: image centre = optical axis without its pitch, "
    "top = the sky",
}
"""Alignments of a map; all are the same for a camera that looks straight ahead."""
DEFAULT_FRAME = "camera"

PUBLIC_SIZE = (192, 256)
"""Rows and columns of the crop of the public three-sphere protocol [px]."""
PUBLIC_FOV_DEG = 60.0
"""Vertical field of view of that crop [deg]."""
PUBLIC_GAMMA = 2.4
PUBLIC_PERCENTILE = 99.0
PUBLIC_WHITE = 0.9
"""Tone mapping: ``(alpha x) ** (1 / 2.4)`` with this percentile of the non-zero values at .9."""
LEVEL_TOLERANCE = 1e-9
"""A camera whose up axis differs less from +Y is level: its maps are turned without resampling."""


@dataclass(frozen=True)
class Predictions:
    """Maps predicted by another system."""

    maps: dict[str, FloatArray]
    """Radiance by scene name, world frame, our orientation, shape [He, 2 He, 3]."""
    missing: tuple[str, ...]
    """Names of scenes without a map."""
    unused: tuple[str, ...]
    """Names of files that match no scene."""


def export_crops(places: Sequence[Place], folder: Path, overwrite: bool = False) -> None:
    """Write ``NAME.png`` for each place, ``NAME.public.png`` where it can be made, and the index.

    Raises:
        InputError: The folder holds files, or cannot be written.
    """
    entries: list[dict[str, Any]] = []
    with OutputFolder(folder, overwrite) as output:
        for place in places:
            output.write_png(f"{place.name}.png", codes_of(place.photo), mark=False)
            public = public_crop(place.photo, place.camera)
            if public is not None:
                output.write_png(f"{place.name}.public.png", codes_of(public), mark=False)
            entries.append(_crop_entry(place, public is not None))
        output.write_json(
            INDEX,
            {
                "photos": "display-encoded: linear = code ** 2.2; linear = exposure x radiance of "
                "the panorama. public_photo: the 192 x 256 crop of the public three-sphere "
                "protocol, vertical field of view 60 degrees, gamma 2.4, 99th percentile at 0.9, "
                "made from the photo where that shows enough",
                "expected": "one map per photo, NAME.exr, NAME.hdr or NAME.npy (float, [H, 2 H, "
                "3]): lat-long, linear radiance, finite, not negative, twice as wide as high",
                "orientation": "image centre = viewing direction of the photo; right of the "
                "centre = to the camera's right; left and right edge = behind the camera; top = "
                "up. Test: a map that is black but for its centre lights an object from behind "
                "it, as seen in the photo; one that is bright three quarters to the right lights "
                "its right side",
                "world": "right-handed, +Y up; azimuth clockwise from -Z seen from above",
                "maps": {"frame": DEFAULT_FRAME, "scale": 1.0},
                "about_maps": {
                    "use": "copy this file to the folder of the maps and edit `maps` if they "
                    "differ from it; without the file, these values hold",
                    "frame": FRAMES,
                    "scale": "factor from the maps' unit to the photo's linear values",
                },
                "crops": entries,
            },
        )


def _crop_entry(place: Place, has_public: bool) -> dict[str, Any]:
    """Return a crop's entry in the index."""
    rotation = place.camera.c2w[:3, :3]
    azimuth, pitch = angles_from_axis(-rotation[:, 2])
    return {
        "name": place.name,
        "photo": f"{place.name}.png",
        "public_photo": f"{place.name}.public.png" if has_public else None,
        "panorama": place.panorama,
        "azimuth_deg": azimuth,
        "pitch_deg": pitch,
        "exposure": place.exposure,
        "camera": place.camera.record(),
        "world_direction_of_a_map_in_the_camera_frame": {
            "image_centre": (-rotation[:, 2]).tolist(),
            "middle_row_three_quarters_to_the_right": rotation[:, 0].tolist(),
            "top_row": rotation[:, 1].tolist(),
        },
    }


def read_predictions(folder: Path, places: Sequence[Place]) -> Predictions:
    """Read the maps of another system for the places and turn them to the world frame.

    Args:
        folder: Holds ``NAME.exr``, ``NAME.hdr`` or ``NAME.npy``, and ``crops.json`` if the maps
            are not as it says by default.
        places: Those that were exported, at least one.

    Raises:
        InputError: No folder, no map for any scene, two for one, or one that is not clean 2:1
            radiance; all problems at once.
    """
    if not folder.is_dir():
        raise InputError(folder, "not a folder (expected a folder of environment maps)")
    frame, scale = _options(folder)
    paths_by_name: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in SUFFIXES:
            paths_by_name.setdefault(path.stem, []).append(path)
    maps: dict[str, FloatArray] = {}
    problems: list[InputError] = []
    for place in places:
        paths = paths_by_name.pop(place.name, [])
        try:
            if len(paths) > 1:
                names = " and ".join(path.name for path in paths)
                raise InputError(paths[0], f"more than one map of a scene (found {names})")
            if paths:
                texels = _read_map(paths[0]) * np.float32(scale)
                maps[place.name] = to_world(texels, place.camera, frame)
        except InputError as problem:
            problems.append(problem)
    raise_all(problems)
    unused = tuple(path.name for paths in paths_by_name.values() for path in paths)
    if not maps:
        raise InputError(
            folder,
            f"no map for any scene (found {unused[0] if unused else 'no map'}; expected "
            f"{places[0].name}.exr, .hdr or .npy)",
            "name the maps as the exported crops",
        )
    missing = tuple(place.name for place in places if place.name not in maps)
    return Predictions(maps, missing, unused)


def to_world(texels: FloatArray, camera: Camera, frame: str) -> FloatArray:
    """Turn a map whose image centre is the viewing direction to the world and our orientation.

    Args:
        texels: Radiance, shape [He, 2 He, 3].
        camera: Camera of the photo.
        frame: A key of `FRAMES`.

    Returns:
        Radiance, world frame, same shape. A level camera's maps are moved by columns; others are
        resampled with 2 x 2 look-ups per texel, which keeps the flux of a single one to 2 %
        (to 10 % in the row at a pole).
    """
    # Ours has -Z at its left and right edge, not in the centre.
    seen = rotate_map(texels, 180.0)
    rotation = camera.c2w[:3, :3]
    is_level = float(np.abs(rotation[:, 1] - (0.0, 1.0, 0.0)).max()) < LEVEL_TOLERANCE
    if frame == "level" or is_level:
        azimuth, _ = angles_from_axis(-rotation[:, 2])
        return rotate_map(seen, -azimuth)
    height = len(texels)
    # Toward the poles texels get narrower than the look-ups' spacing: average them to it first.
    wide = seen.astype(np.float64)
    for row, breadth in enumerate(np.cos(latitudes(height))):
        wide[row] = uniform_filter1d(wide[row], 2 * int(0.5 / breadth) + 1, axis=0, mode="wrap")
    flat = wide.reshape(-1, 3)
    total = np.zeros_like(flat)
    fine = map_directions(2 * height, 4 * height)
    for i in (0, 1):
        for j in (0, 1):
            directions = fine[i::2, j::2].reshape(-1, 3)
            total += lookup_matrix(directions @ rotation, height) @ flat
    return (total / 4.0).reshape(texels.shape).astype(np.float32)


def public_crop(photo: FloatArray, camera: Camera) -> Float64Array | None:
    """Return the crop that the public three-sphere protocol gives to a method, [192, 256, 3].

    Args:
        photo: Display-encoded with gamma 2.2, shape [H, W, 3].
        camera: Camera of the photo.

    Returns:
        Display-encoded with gamma 2.4, or nothing where the photo's vertical field of view is not
        60 degrees or it is narrower than 4:3. What the photo clips stays clipped, and the camera
        keeps its pitch, where the protocol's is level.
    """
    from skimage.transform import resize as resize_image

    fov = 2.0 * np.degrees(np.arctan(camera.height / (2.0 * camera.fy)))
    rows, columns = PUBLIC_SIZE
    width = round(camera.height * columns / rows)
    if abs(fov - PUBLIC_FOV_DEG) > 0.5 or width > camera.width:
        return None
    left = (camera.width - width) // 2
    linear = gamma_to_linear(photo[:, left : left + width].astype(np.float64))
    small = resize_image(  # type: ignore[no-untyped-call]
        linear, (rows, columns, 3), order=1, anti_aliasing=camera.height > rows
    )
    powered = np.maximum(np.asarray(small, np.float64), 0.0) ** (1.0 / PUBLIC_GAMMA)
    if not powered.any():
        return powered
    alpha = PUBLIC_WHITE / float(np.percentile(powered[powered > 0.0], PUBLIC_PERCENTILE))
    return np.clip(alpha * powered, 0.0, 1.0)


def _options(folder: Path) -> tuple[str, float]:
    """Return frame and scale of a folder's maps, from its ``crops.json`` if there is one."""
    path = folder / INDEX
    if not path.exists():
        return DEFAULT_FRAME, 1.0
    maps = read_json_object(path).get("maps", {})
    if not isinstance(maps, dict):
        raise InputError(path, "/maps: not an object")
    frame, scale = maps.get("frame", DEFAULT_FRAME), maps.get("scale", 1.0)
    if frame not in FRAMES:
        raise InputError(
            path, f"/maps/frame: unknown (found {frame!r}; expected {' or '.join(FRAMES)})"
        )
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not scale > 0.0:
        raise InputError(path, f"/maps/scale: not a factor (found {scale!r}; expected > 0)")
    return frame, float(scale)


def _read_map(path: Path) -> FloatArray:
    """Read one map unchanged; refuse invalid or black radiance."""
    if path.suffix.lower() == ".npy":
        texels = _read_array(path)
    else:
        texels = read_envmap(path, strict=True)
    if not texels.any():
        raise InputError(path, "black: every texel is 0")
    return texels


def _read_array(path: Path) -> FloatArray:
    """Read a map from a NumPy file, with the checks that `read_envmap` makes."""
    check_regular_file(path)
    try:
        # Unlike `numpy.load`, this reads no zip archives and no pickles, whatever the file says.
        stored = open_memmap(path, mode="r")
    except Exception as error:  # its header is parsed as Python: whatever the tokenizer raises
        raise InputError(path, "not a NumPy array of numbers, or damaged") from error
    if stored.dtype.kind != "f":
        raise InputError(path, "not an array of floating-point numbers")
    height = stored.shape[0] if stored.ndim else 0
    if stored.shape != (height, 2 * height, 3) or not 2 <= height <= LIMITS.envmap_width // 2:
        raise InputError(
            path,
            f"not a lat-long map (found shape {stored.shape}; expected [H, 2 H, 3])",
            "resize it to twice as wide as high, RGB last",
        )
    with np.errstate(over="ignore"):  # counted as not finite below
        texels = np.array(stored, np.float32)
    bad, negative = int((~np.isfinite(texels)).sum()), int((texels < 0.0).sum())
    if bad or negative:
        raise InputError(
            path,
            f"not clean radiance (found {bad} values that are not finite, {negative} negative; "
            "expected finite values >= 0)",
        )
    return texels
