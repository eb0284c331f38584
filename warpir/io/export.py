"""What other tools take over from a run: tone curves, a web light, the object, Blender's set-up.

Every file is named in docs/handoff.md with what opens it. All of them lie in the run's own folder
and refer to each other by bare names, so that the folder can be moved or handed on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

import warpir
from warpir.core.arrays import Float64Array, FloatArray, affine_matrix
from warpir.io.gltf.writer import write_glb
from warpir.io.images.envmap_conventions import from_ours
from warpir.io.images.photos import Photo
from warpir.io.layers import HALF_MAX
from warpir.io.results import OutputFolder
from warpir.scene.asset import Asset
from warpir.scene.camera import TO_Z_UP, Camera, blender_camera, square_pixel_error
from warpir.scene.lamps import LAMP_RADIUS_DEG, Sun, suns_of
from warpir.scene.placement import Placement, y_to
from warpir.scene.tone_curves import Curves, ToneKnots

PHOTO, OBJECT, BLENDER_SETUP = "photo.png", "object.glb", "blender_setup.py"
OBJECT_CURVE, SHADOW_CURVE = "tone_curve_object.cube", "tone_curve_shadow.cube"
RESPONSE = "response.cube"

CUBE_SIZE = 4096
"""Entries of a tone curve's table: interpolated, a curve of the narrowest bins is right to 1e-3."""
GROUND_SIDES = 40.0
"""Side of Blender's ground, in diagonals of the object."""
SQUARE_ENOUGH = 0.5
"""How far rows may be off in a tool that knows square pixels only, before it is said [px]."""


def write_hand_off(
    output: OutputFolder,
    photo: Photo,
    asset: Asset,
    camera: Camera,
    placement: Placement,
    curves: Curves,
    texels: FloatArray,
    envmap: str,
    response: ToneKnots | None,
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Stage the files for other tools.

    ``texels`` are the light on the object, relative [W/(m^2 sr)], shape [He, 2 He, 3], and
    ``envmap`` the file that holds them; ``response`` is the camera's, which the picture repeats
    behind the curves.

    Returns:
        Numbers for ``run.json``, and notices.

    Raises:
        InputError: The disk is full (exit 5).
    """
    _write_curves(output, curves, response)
    web, clamped = web_map(texels)
    output.write_hdr("envmap_web.hdr", web)
    output.write_bytes(OBJECT, write_glb(asset, placement.asset_to_world, camera))
    # Upright and without the photo's metadata: Blender does not turn pictures by their EXIF tag.
    codes = photo.codes
    if photo.is_linear:
        codes = photo.encode(photo.srgb, np.ones(codes.shape[:2], np.bool_))
    output.write_png(PHOTO, codes, icc=photo.icc, mark=False)
    script = blender_setup(asset, camera, placement, envmap, suns_of(texels))
    output.write_bytes(BLENDER_SETUP, script.encode())
    notices = []
    if (off := square_pixel_error(camera)) > SQUARE_ENOUGH:
        notices.append(
            f"Blender and Mitsuba know square pixels only: there the object is up to {off:.1f} px "
            f"off (the camera has fx {camera.fx:g}, fy {camera.fy:g})"
        )
    return {"web_values_clamped": clamped}, tuple(notices)


# -------------------------------------------------------------------------------- tone curves

_RADIANCE = {
    "linear": "radiance clipped to [0, 1]",
    "reinhard": "x / (1 + x) of radiance x",
}


def _write_curves(output: OutputFolder, curves: Curves, response: ToneKnots | None) -> None:
    """Write the tables; each states what it maps to what."""
    of_object, of_shadow = "fg.RGB of layers.exr, coverage divided out", "shadow.RGB of layers.exr"
    if response is not None:
        of_object, of_shadow = f"input of {RESPONSE}", f"share of the light before {RESPONSE}"
        about = "what the tone curve gives -> fg.RGB of layers.exr, coverage divided out"
        output.write_bytes(RESPONSE, tone_curve_cube(response, about))
    about = f"{_RADIANCE[curves.tone]} -> {of_object}"
    if curves.tone == "linear" and not curves.is_clipped:
        about += "; radiance above 1 stays as it is"
    output.write_bytes(OBJECT_CURVE, tone_curve_cube(curves.foreground, about))
    about = f"shadow ratio clipped to [0, 1] -> {of_shadow}"
    output.write_bytes(SHADOW_CURVE, tone_curve_cube(curves.shadow_ratio, about))


def tone_curve_cube(knots: ToneKnots, about: str) -> bytes:
    """Return tone curves as a 1-D LUT in the format ``.cube`` (Iridas/Adobe, version 1.0).

    The domain is [0, 1] in three columns, values are linear on both sides. Written out here because
    it is a few lines; colour-science's reader is the test.

    One curve serves all channels, or there are three; ``about`` says what is mapped to what.
    """
    x = np.linspace(0.0, 1.0, CUBE_SIZE)
    table = np.broadcast_to(knots.evaluate(x), (CUBE_SIZE, 3))
    lines = [
        f'TITLE "warpir {warpir.__version__}"',
        f"# {about}",
        f"LUT_1D_SIZE {CUBE_SIZE}",
        "DOMAIN_MIN 0.0 0.0 0.0",
        "DOMAIN_MAX 1.0 1.0 1.0",
        *(f"{r:.8f} {g:.8f} {b:.8f}" for r, g, b in table.tolist()),
    ]
    return ("\n".join(lines) + "\n").encode()


# -------------------------------------------------------------------------------------- light


def web_map(texels: FloatArray) -> tuple[FloatArray, int]:
    """Return a map as three.js reads it, and how many of its values were clamped.

    Browsers upload it in half precision, where a sun above 65504 becomes infinite and then black.
    """
    turned = from_ours(texels, "threejs")
    return np.minimum(turned, np.float32(HALF_MAX)), int((turned > HALF_MAX).sum())


# ------------------------------------------------------------------------------------ Blender


def blender_setup(
    asset: Asset, camera: Camera, placement: Placement, envmap: str, suns: Sequence[Sun]
) -> str:
    """Return the script that builds the scene in Blender."""
    low, high = asset.bounds()
    diagonal = float(np.linalg.norm((high - low) * np.linalg.norm(placement.asset_to_world[:3, 0])))
    middle = (placement.asset_to_world @ np.append(0.5 * (low + high), 1.0))[:3]
    normal, offset = placement.ground[:3], float(placement.ground[3])
    ground = affine_matrix(y_to(normal), middle - normal * (normal @ middle + offset))
    distance = float(np.linalg.norm(middle - camera.c2w[:3, 3]))
    values = blender_camera(camera)
    parts = ["blender_setup.py.in"]
    if any(m.transmission > 0.0 and not m.is_solid_glass for m in asset.materials):
        parts.append("blender_glass.py.in")
    texts = [files("warpir.io").joinpath(name).read_text("utf-8") for name in parts]
    return Template("".join(texts)).substitute(
        version=warpir.__version__,
        photo=PHOTO,
        envmap=envmap,
        object=OBJECT,
        width=camera.width,
        height=camera.height,
        angle=values["angle"],
        shift_x=values["shift_x"],
        shift_y=values["shift_y"],
        near=1e-3 * distance,
        far=1e3 * (distance + diagonal),
        camera=_rows(values["matrix_world"]),
        ground=_rows(TO_Z_UP @ ground @ TO_Z_UP.T),
        ground_size=GROUND_SIDES * diagonal,
        suns=[
            (*_tuples(TO_Z_UP[:3, :3] @ sun.axis, sun.irradiance), sun.angle, *_tuples(sun.behind))
            for sun in suns
        ],
        sun_cosine=math.cos(math.radians(LAMP_RADIUS_DEG)),
    )


def _tuples(*vectors: Float64Array) -> tuple[tuple[float, ...], ...]:
    """Return vectors as plain numbers; minus zero is zero."""
    return tuple(tuple(float(value) + 0.0 for value in vector) for vector in vectors)


def _rows(matrix: Float64Array) -> str:
    """Return a matrix as Python writes a tuple of rows."""
    return "(" + ",\n    ".join(map(repr, _tuples(*matrix))) + ")"
