"""Three spheres under a light: the published protocol of StyleLight and DiffusionLight, and ours.

A convex sphere under a distant light has no shadow and no reflection of itself, so each pixel is a
fixed linear combination of the map's texels and there is nothing to sample at random. Seen from a
camera that looks at its centre, the sphere is symmetric about the line to the camera: the light,
written as flux over polar angle and azimuth about that line, is convolved along the azimuth. A
Fourier transform over the azimuth does that exactly, also for the camera's perspective.

The published chain (https://github.com/DiffusionLight/DiffusionLight-evaluation, folder
``stylelight``) raises both maps to 1/2.4 and sets the median of their non-zero values to 0.5 BEFORE
it renders. So it is no error of linear light: a sun counts far too little, and exposure not at all.
Its numbers stand beside published ones only; the linear ones tell how an object will look.

What differs from the chain: no noise (there: 5 samples and a denoiser), no depth of field, and the
metallic-roughness BRDF of glTF 2.0 that the rest of warpir uses in place of Blender's Principled
BSDF (same base colour, roughness and reflectance at normal incidence; Blender's diffuse lobe rises
a little at grazing angles).

Frame: maps are given in the camera-yaw frame (the photo's horizontal viewing direction is -Z, its
right +X, up +Y). The chain stores a map with the viewing direction in the image centre; Blender
puts the centre at its +X, and the script the spheres' camera at (0, -16, 2). In our frame that
camera stands at (16, 2, 0), to the right of the photo's viewing direction, and looks to its left.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom
from scipy.sparse import csr_array

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, texel_solid_angles, uv_of
from warpir.evaluate.light_errors import HEIGHT, checked_maps, sun_sky_ratio_error

CAMERA = np.array([16.0, 2.0, 0.0])
"""Position of the spheres' camera; the unit sphere is at the origin (camera-yaw frame)."""
FOCAL_PX = 960.0 * 85.0 / 36.0
"""85 mm lens on a 36 mm wide sensor at 960 px [px]."""
IMAGE_PIXELS = 960 * 540
"""Pixels of a picture, background included."""

RING_COUNT = 96
"""Rings of the rough spheres' pictures, each of the same area."""
AZIMUTH_COUNT = 360
"""Points of a ring, and bins of the light's azimuth about the line to the camera."""
POLAR_COUNT = 180
"""Bins of the light's polar angle."""
MIRROR_RING_COUNT = 160
"""Rings of the mirror's picture: as many points as the published picture has pixels."""
MIRROR_STEPS = 4
"""Look-ups across a ring of the mirror, whose reflections fan out toward its edge."""

GAMMA = 2.4
"""Exponent of the published chain [1]."""
MEDIAN = 0.5
"""Median of the non-zero values after the published chain's scaling [1]."""
MEAN_LUMINANCE = 0.5
"""Mean luminance of the true diffuse sphere in the linear variant [1]."""
LOG_OFFSET = 1e-3
"""Added to linear radiance before its logarithm, 1/500 of that mean [1]."""
NORM_PERCENTILE = 99.9
"""Percentile of the whole picture that becomes 1 in the normalised error [%]."""

F0_DIELECTRIC = 0.04


@dataclass(frozen=True)
class Material:
    """A metallic-roughness material without texture."""

    base_color: float
    """Base colour, linear, grey [1]."""
    metallic: float
    """Metallic, 0 or 1."""
    roughness: float
    """Perceptual [1]; the GGX width is its square."""


MATERIALS = {
    "diffuse": Material(0.8, 0.0, 0.364),
    "matte": Material(0.8, 1.0, 0.3271),
    "mirror": Material(0.8, 1.0, 0.0),
}


def sphere_errors(predicted: FloatArray, true: FloatArray) -> dict[str, float]:
    """Return the errors of a light on three spheres, published chain and linear.

    Args:
        predicted: Radiance, lat-long, camera-yaw frame, shape [He, 2 He, 3].
        true: True light in the same unit, of any size.

    Returns:
        For M in ``diffuse``, ``matte``, ``mirror``:

        * ``published_M_rmse``, ``published_M_si_rmse``: as printed, the squared error summed over
          RGB and divided by the number of PIXELS (not of values); the second after the best scale.
        * ``published_M_angular_deg``: mean angle between RGB vectors [deg].
        * ``published_M_nrmse``: ``rmse`` after both pictures were normalised to their percentiles
          over the WHOLE picture. The code's (0.01, 99.9) and the paper's (0.1, 99.9) are the same
          number, since 7 of 8 pixels are black background.
        * ``linear_M_rmse``, ``linear_M_si_rmse``, ``linear_M_angular_deg``: the same in linear
          radiance, both maps scaled so that the TRUE diffuse sphere has mean luminance 0.5.
        * ``linear_M_log_rmse``: ``rmse`` of natural logarithms.

        And ``linear_log_sun_sky_ratio_error``, see `warpir.evaluate.light_errors.light_errors`.

    Raises:
        ValueError: Not two lat-long maps, or one is black, negative or not finite.
    """
    linear = checked_maps(predicted, true)
    scale = MEAN_LUMINANCE / float(luminance(picture(linear[1], "diffuse")).mean())
    published = [published_tone(published_resize(texels)) for texels in (predicted, true)]
    errors: dict[str, float] = {}
    for name in MATERIALS:
        pred, wanted = (picture(texels, name) for texels in published)
        errors[f"published_{name}_rmse"] = rmse(pred, wanted)
        errors[f"published_{name}_si_rmse"] = si_rmse(pred, wanted)
        errors[f"published_{name}_angular_deg"] = angular_deg(pred, wanted)
        errors[f"published_{name}_nrmse"] = rmse(normalized(pred), normalized(wanted))
        pred, wanted = (scale * picture(texels, name) for texels in linear)
        errors[f"linear_{name}_rmse"] = rmse(pred, wanted)
        errors[f"linear_{name}_si_rmse"] = si_rmse(pred, wanted)
        errors[f"linear_{name}_angular_deg"] = angular_deg(pred, wanted)
        errors[f"linear_{name}_log_rmse"] = rmse(
            np.log(pred + LOG_OFFSET), np.log(wanted + LOG_OFFSET)
        )
    errors["linear_log_sun_sky_ratio_error"] = sun_sky_ratio_error(predicted, true)
    return errors


# ---------------------------------------------------------------------------- the published chain


def published_resize(texels: FloatArray) -> Float64Array:
    """Bring a map to 128 x 256 as skylibs does: linear between points, so a sun may vanish.

    Its points run from the first texel to the last, so it matters where the map's edge is: opposite
    to the viewing direction.
    """
    stored = np.roll(texels, texels.shape[0], axis=1)
    factors = (HEIGHT / texels.shape[0], 2 * HEIGHT / texels.shape[1], 1.0)
    resized: Float64Array = zoom(stored.astype(np.float64), factors, order=1)
    return np.roll(resized, HEIGHT, axis=1)


def published_tone(texels: Float64Array) -> Float64Array:
    """Raise a map to 1/2.4 and set the median of its non-zero values to 0.5.

    Raises:
        ValueError: The map is black.
    """
    powered = texels ** (1.0 / GAMMA)
    if not powered.any():
        raise ValueError("the map is black at 128 x 256 texels")
    return powered * (MEDIAN / float(np.median(powered[powered > 0.0])))


def rmse(predicted: Float64Array, true: Float64Array) -> float:
    """Return the root of the squared error summed over RGB, per point; shape [point, 3]."""
    return float(np.sqrt(((predicted - true) ** 2).sum() / len(true)))


def si_rmse(predicted: Float64Array, true: Float64Array) -> float:
    """Return `rmse` after the scale of the prediction that makes it least."""
    power = float((predicted**2).sum())
    best = float((predicted * true).sum()) / power if power > 0.0 else 0.0
    return rmse(best * predicted, true)


def angular_deg(predicted: Float64Array, true: Float64Array) -> float:
    """Return the mean angle between RGB vectors [deg]; where one is black it counts as 0."""
    length = np.linalg.norm(predicted, axis=1) * np.linalg.norm(true, axis=1)
    inner = (predicted * true).sum(axis=1)
    cosine = np.divide(inner, length, out=np.ones_like(inner), where=length > 0.0)
    return float(np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))).mean())


def normalized(points: Float64Array) -> Float64Array:
    """Divide a picture by its 99.9th percentile, background counted; shape [point, 3].

    The low percentile that the chain subtracts first is that of the background: 0.
    """
    background = round(len(points) * (IMAGE_PIXELS / (np.pi * radius_px() ** 2) - 1.0))
    whole = np.concatenate([points.ravel(), np.zeros(3 * background)])
    return points / float(np.percentile(whole, NORM_PERCENTILE))


# --------------------------------------------------------------------------------- the rendering


def radius_px() -> float:
    """Return the radius of the sphere's outline in the picture [px]."""
    return FOCAL_PX / float(np.sqrt(CAMERA @ CAMERA - 1.0))


def picture(texels: Float64Array, material: str) -> Float64Array:
    """Return radiance at points that stand for the same picture area each, shape [point, 3].

    Points run along a ring first, counter-clockwise from the right, rings from the centre out;
    `ring_points` tells where they are.

    Args:
        texels: Radiance, camera-yaw frame, shape [128, 256, 3].
        material: A key of `MATERIALS`.
    """
    flat = texels.reshape(-1, 3)
    if material == "mirror":
        mirrored: Float64Array = _mirror_operator() @ flat
        return mirrored
    flux = (_flux_operator() @ flat).reshape(POLAR_COUNT, AZIMUTH_COUNT, 3)
    spectrum = np.fft.rfft(flux, axis=1)
    # [frequency, ring, polar] @ [frequency, polar, channel]
    rings = _convolution(material) @ spectrum.transpose(1, 0, 2)
    shone: Float64Array = np.fft.irfft(rings.transpose(1, 0, 2), AZIMUTH_COUNT, axis=1)
    # What is far below the strongest texel is rounding, of either sign.
    return np.maximum(shone, 0.0).reshape(-1, 3)


def camera_axes() -> Float64Array:
    """Return the spheres' camera's right, up and the direction to it, as columns, shape [3, 3]."""
    toward = CAMERA / np.linalg.norm(CAMERA)
    right = np.cross([0.0, 1.0, 0.0], toward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward], axis=1)


def ring_points(radius: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return normal and direction to the camera of points to the right of the sphere's centre.

    Args:
        radius: Distance from the centre in the picture, over that of the outline, shape [ring].

    Returns:
        Unit vectors in (right, up, toward the camera), shape [ring, 3] each.
    """
    distance = float(np.linalg.norm(CAMERA))
    angle = np.arctan(radius * radius_px() / FOCAL_PX)
    # The nearer intersection of the ray with the unit sphere
    length = distance * np.cos(angle) - np.sqrt(1.0 - (distance * np.sin(angle)) ** 2)
    zero = np.zeros_like(angle)
    normal = np.stack([length * np.sin(angle), zero, distance - length * np.cos(angle)], axis=1)
    return normal, np.stack([-np.sin(angle), zero, np.cos(angle)], axis=1)


def ring_radii(count: int) -> Float64Array:
    """Return the radii that halve the area of rings of equal area, outline = 1, shape [ring]."""
    return np.sqrt((np.arange(count) + 0.5) / count)


def ring_azimuths() -> Float64Array:
    """Return the azimuths of a ring's points, counter-clockwise from the right [rad]."""
    return 2.0 * np.pi * np.arange(AZIMUTH_COUNT) / AZIMUTH_COUNT


def reflected(
    cos_o: Float64Array, cos_i: Float64Array, cos_oi: Float64Array, material: Material
) -> Float64Array:
    """Return the glTF 2.0 metallic-roughness BRDF times ``cos_i`` [1/sr], 0 below the surface.

    For a grey material whose `metallic` is 0 or 1; the formulas are those of
    `warpir.kernels.bsdf`. The cosines are those between normal and camera, normal and light, and
    camera and light.
    """
    cos_i = np.maximum(cos_i, 0.0)
    # The half vector h = (wo + wi) / |wo + wi|: |wo + wi| = 2 (wo . h)
    cos_oh = np.sqrt(np.maximum(0.5 + 0.5 * cos_oi, 1e-12))
    cos_h = np.minimum((cos_o + cos_i) / (2.0 * cos_oh), 1.0)
    f0 = F0_DIELECTRIC + (material.base_color - F0_DIELECTRIC) * material.metallic
    schlick = (1.0 - np.minimum(cos_oh, 1.0)) ** 5
    alpha2 = material.roughness**4
    spread = cos_h**2 * (alpha2 - 1.0) + 1.0
    density = alpha2 / (np.pi * spread**2)
    # Height-correlated Smith masking over 4 cos_o cos_i (Heitz 2014, eq. 99), without Lambda
    masking = 0.5 / (
        cos_i * np.sqrt(alpha2 + (1.0 - alpha2) * cos_o**2)
        + cos_o * np.sqrt(alpha2 + (1.0 - alpha2) * cos_i**2)
    )
    specular = (f0 + (1.0 - f0) * schlick) * density * masking
    fresnel = F0_DIELECTRIC + (1.0 - F0_DIELECTRIC) * schlick
    diffuse = (1.0 - material.metallic) * material.base_color / np.pi * (1.0 - fresnel)
    return (specular + diffuse) * cos_i


@cache
def _convolution(material: str) -> Float64Array:
    """Return the rings' response to each frequency of the light, shape [frequency, ring, polar].

    Real, because a point's response is the same on both sides of the plane through the line to
    the camera.
    """
    normal, wo = ring_points(ring_radii(RING_COUNT))
    theta = np.pi * (np.arange(POLAR_COUNT) + 0.5) / POLAR_COUNT
    azimuth = ring_azimuths()
    wi = np.stack(
        [
            np.sin(theta)[:, None] * np.cos(azimuth),
            np.sin(theta)[:, None] * np.sin(azimuth),
            np.broadcast_to(np.cos(theta)[:, None], (POLAR_COUNT, AZIMUTH_COUNT)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    cos_o = (normal * wo).sum(axis=1)[:, None]
    response = reflected(cos_o, normal @ wi.T, wo @ wi.T, MATERIALS[material])
    response = response.reshape(RING_COUNT, POLAR_COUNT, AZIMUTH_COUNT)
    return np.ascontiguousarray(np.fft.rfft(response, axis=2).real.transpose(2, 0, 1))


@cache
def _flux_operator() -> csr_array:
    """Return the matrix from texels to flux in bins about the line to the camera.

    Bins run over the polar angle, then the azimuth. Each quarter of a texel is shared among the
    four nearest ones; flux is kept exactly.
    """
    fine = 2 * HEIGHT
    axes = camera_axes()
    local = map_directions(fine, 2 * fine).reshape(-1, 3) @ axes
    theta = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    rows = theta / np.pi * POLAR_COUNT - 0.5
    columns = azimuth / (2.0 * np.pi) * AZIMUTH_COUNT
    share = bilinear_matrix(rows, columns, POLAR_COUNT, AZIMUTH_COUNT)
    flux = np.repeat(texel_solid_angles(fine, 2 * fine), 2 * fine)
    texel = np.arange(HEIGHT * 2 * HEIGHT).reshape(HEIGHT, 2 * HEIGHT)
    owner = texel.repeat(2, axis=0).repeat(2, axis=1).ravel()
    spread = csr_array((flux, (np.arange(len(owner)), owner)), shape=(len(owner), texel.size))
    return csr_array(share.T @ spread)


@cache
def _mirror_operator() -> csr_array:
    """Return the matrix from texels to the mirror's picture, shape [point, texel]."""
    radius = ring_radii(MIRROR_RING_COUNT * MIRROR_STEPS)
    normal, wo = ring_points(radius)
    cos_o = (normal * wo).sum(axis=1)
    wi = 2.0 * cos_o[:, None] * normal - wo
    azimuth = ring_azimuths()
    # Turned about the line to the camera; ring points have no part along the camera's up.
    local = np.stack(
        [
            wi[:, :1] * np.cos(azimuth),
            wi[:, :1] * np.sin(azimuth),
            np.broadcast_to(wi[:, 2:], (len(wi), AZIMUTH_COUNT)),
        ],
        axis=-1,
    ).reshape(MIRROR_RING_COUNT, MIRROR_STEPS, AZIMUTH_COUNT, 3)
    base = MATERIALS["mirror"].base_color
    fresnel = (base + (1.0 - base) * (1.0 - cos_o) ** 5).reshape(MIRROR_RING_COUNT, MIRROR_STEPS)
    operator = csr_array((MIRROR_RING_COUNT * AZIMUTH_COUNT, HEIGHT * 2 * HEIGHT))
    for step in range(MIRROR_STEPS):
        weight = np.repeat(fresnel[:, step] / MIRROR_STEPS, AZIMUTH_COUNT)
        look_up = lookup_matrix(local[:, step].reshape(-1, 3) @ camera_axes().T, HEIGHT)
        operator = operator + look_up.multiply(weight[:, None])
    return csr_array(operator)


def lookup_matrix(directions: Float64Array, height: int) -> csr_array:
    """Return the matrix that reads a map in some directions, bilinear between texel centres.

    Args:
        directions: Unit vectors in the map's frame, shape [direction, 3].
        height: Rows of the map; it has twice as many columns.

    Returns:
        Weights, shape [direction, height * 2 * height]; each row sums to 1.
    """
    u, v = uv_of(directions)
    return bilinear_matrix(v * height - 0.5, u * 2 * height - 0.5, height, 2 * height)


def bilinear_matrix(
    rows: Float64Array, columns: Float64Array, row_count: int, column_count: int
) -> csr_array:
    """Return the weights of the four cells around each position; columns wrap, rows end.

    Positions, shape [position], are in cells, 0 at the centre of the first.
    """
    rows = np.clip(rows, 0.0, row_count - 1.0)
    top, left = np.floor(rows).astype(np.int64), np.floor(columns).astype(np.int64)
    down, across = rows - top, columns - left
    cells: list[NDArray[np.int64]] = []
    weights: list[Float64Array] = []
    for i in (0, 1):
        for j in (0, 1):
            row = np.minimum(top + i, row_count - 1)
            cells.append(row * column_count + (left + j) % column_count)
            weights.append((down if i else 1.0 - down) * (across if j else 1.0 - across))
    position = np.tile(np.arange(len(rows)), 4)
    entries = (np.concatenate(weights), (position, np.concatenate(cells)))
    return csr_array(entries, shape=(len(rows), row_count * column_count))
