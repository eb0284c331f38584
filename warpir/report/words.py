"""Describes a light in figures and in a photographer's words.

Everything is measured on a lat-long map, so that a recovered light, a panorama and a sun of the
command line are described alike. Directions in words are those of the camera: left and right as in
the photo, "behind the camera" is where the photographer stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.scene.light import angles_from_axis, bearing

HEIGHT = 128
"""Rows of the measured map; a texel is 1.4 degrees."""
OVERHEAD_DEG, LOW_DEG = 75.0, 20.0
"""Elevation from which a light is overhead, and up to which it is not in the upper part [deg]."""
REACH_DEG = 60.0
"""Largest angle of direct light from the brightest direction [deg]."""
EVEN = 0.1
"""Share of direct light on the ground below which no shadow has an edge [1]."""
EDGES = (
    (1.5, "hard, with crisp edges as in clear sunshine"),
    (4.0, "fairly hard, with slightly blurred edges"),
    (12.0, "soft, with clearly blurred edges"),
    (180.0, "very soft, without an edge that could be seen"),
)
"""Half width of the direct light [deg] up to which a shadow is called so."""
STRENGTHS = (
    (3.0, "strong direct light"),
    (1.5, "more direct light than sky"),
    (1.0 / 1.5, "direct light and sky of similar strength"),
    (0.0, "mostly light from all around, with some direct light"),
)
"""Ratio of direct to other light on the ground from which it is called so [1]."""
NEUTRAL, SLIGHT, STRONG = 0.08, 0.25, 0.55
"""Saturation (max - min) / max below which a colour is neutral or slight, and above strong [1]."""
HUES = ("red", "orange", "yellow", "green", "green", "turquoise", "blue", "blue", "violet", "pink")
"""Names of hue angles, a tenth of the circle each, from 342 degrees on."""


@dataclass(frozen=True)
class LightCharacter:
    """Direction, size and colour of a light on the ground."""

    azimuth_deg: float
    """Azimuth of the brightest area's middle, world frame, clockwise from -Z from above [deg]."""
    elevation_deg: float
    """Elevation of the brightest area's middle [deg]."""
    bearing_deg: float
    """Azimuth relative to the camera's viewing direction [deg]."""
    half_width_deg: float
    """Mean angle from the middle to half of the peak radiance [deg]."""
    direct: Float64Array
    """Irradiance of the ground by the direct light, RGB, relative [W/m^2]."""
    sky: Float64Array
    """Irradiance of the ground by all other light, RGB, relative [W/m^2]."""

    @property
    def direct_share(self) -> float:
        """Share of the ground's irradiance that is direct [1]."""
        direct, sky = float(luminance(self.direct)), float(luminance(self.sky))
        return direct / (direct + sky) if direct + sky > 0.0 else 0.0


def characterize(texels: FloatArray, normal: Float64Array, c2w: Float64Array) -> LightCharacter:
    """Measure a light.

    Args:
        texels: Lat-long radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3].
        normal: Normal of the ground, world frame, shape [3].
        c2w: Pose of the camera, shape [4, 4].
    """
    texels = resize_map(texels, HEIGHT).astype(np.float64)
    lum: Float64Array = np.asarray(luminance(texels), np.float64)
    directions = map_directions(HEIGHT, 2 * HEIGHT)
    solid_angles = np.broadcast_to(texel_solid_angles(HEIGHT, 2 * HEIGHT)[:, None], lum.shape)
    peak, half_width = _brightest(lum, directions, solid_angles)
    away = np.degrees(np.arccos(np.clip(directions @ peak, -1.0, 1.0)))
    # Direct is what exceeds the level around it; a sun's texel lies within three of its widths.
    reach = float(np.clip(3.0 * half_width, 3.0, REACH_DEG))
    ring = texels[(away > reach) & (away <= reach + 10.0)]
    excess = np.where((away <= reach)[..., None], texels - np.median(ring, axis=0), 0.0)
    excess = np.maximum(excess, 0.0)
    weight = np.maximum(directions @ normal, 0.0) * solid_angles
    direct = np.tensordot(weight, excess, axes=2)
    azimuth, elevation = angles_from_axis(peak)
    return LightCharacter(
        azimuth,
        elevation,
        bearing(peak, c2w),
        half_width,
        direct,
        np.tensordot(weight, texels, axes=2) - direct,
    )


def _brightest(
    lum: Float64Array, directions: Float64Array, solid_angles: Float64Array
) -> tuple[Float64Array, float]:
    """Return the middle of the brightest area, a unit vector, and its half width [deg].

    The area hangs together around the brightest texel and lies above half of its excess over the
    map's median. Its half width is that of a cap of the same solid angle, 2 pi (1 - cos r): exact
    for a uniform disc and for a spherical Gaussian.
    """
    row, column = np.unravel_index(np.argmax(lum), lum.shape)
    top, base = float(lum[row, column]), float(np.median(lum))
    if top <= base:  # even
        return directions[row, column], 180.0
    # With the brightest texel in the middle column, the map's seam cuts no area that matters.
    turn = lum.shape[1] // 2 - int(column)
    parts = label(np.roll(lum > 0.5 * (base + top), turn, axis=1), np.ones((3, 3)))[0]
    area = np.roll(parts == parts[row, lum.shape[1] // 2], -turn, axis=1)
    width = float(np.degrees(np.arccos(1.0 - solid_angles[area].sum() / (2.0 * np.pi))))
    if area.sum() <= 4:  # no more than where texels meet: its size is not resolved
        width = min(width, 0.99 * 180.0 / HEIGHT)
    weight = lum[area] * solid_angles[area]
    middle = weight @ directions[area] / weight.sum()
    length = float(np.linalg.norm(middle))
    # Of a band around the sphere the middle is nowhere.
    return (middle / length if length > 0.1 else directions[row, column]), width


# ---------------------------------------------------------------------------------- words


def light_rows(character: LightCharacter, shadow: LightCharacter | None) -> list[tuple[str, str]]:
    """Describe a light as rows of a name and a text."""
    direct, sky = color_words(character.direct), color_words(character.sky)
    rows = [("direction", origin_words(character))]
    if character.direct_share >= EVEN:
        position = (
            f"azimuth {character.azimuth_deg:.0f}° (clockwise from -Z of the world, seen from "
            f"above), elevation {character.elevation_deg:.0f}°; "
            f"{character.bearing_deg:+.0f}° from where the camera looks"
        )
        rows += [
            ("in degrees", position),
            ("strength", strength_words(character)),
            ("colour of the direct light", direct),
            ("colour of the rest", sky),
        ]
    else:
        rows += [("strength", strength_words(character)), ("colour", sky)]
    if shadow is not None:
        rows.append(("light of the shadow", origin_words(shadow)))
    rows.append(("shadow", softness_words(shadow or character)))
    return rows


def origin_words(character: LightCharacter) -> str:
    """Return the origin of a light in words, or its brightest side if it is even."""
    words = direction_words(character.bearing_deg, character.elevation_deg)
    return words if character.direct_share >= EVEN else f"from all around, brightest {words}"


def direction_words(bearing_deg: float, elevation_deg: float) -> str:
    """Return where a light comes from, such as "from the upper left, behind the camera, ...".

    Args:
        bearing_deg: Clockwise from where the camera looks [deg].
        elevation_deg: Above the horizon [deg].
    """
    height = f"{abs(elevation_deg):.0f} degrees {'above' if elevation_deg >= 0.0 else 'below'}"
    height += " the horizon"
    if abs(elevation_deg) > OVERHEAD_DEG:
        return f"from {'overhead' if elevation_deg > 0.0 else 'straight below'}, {height}"
    right, ahead = np.sin(np.radians(bearing_deg)), np.cos(np.radians(bearing_deg))
    clear = np.sin(np.radians(22.5))
    side = "" if abs(right) < clear else "right" if right > 0.0 else "left"
    depth = (
        "" if abs(ahead) < clear else "ahead of the camera" if ahead > 0.0 else "behind the camera"
    )
    level = "upper " if elevation_deg > LOW_DEG else "lower " if elevation_deg < -LOW_DEG else ""
    if not side:
        if level:
            depth = f"{'above' if elevation_deg > 0.0 else 'below'}, {depth}"
        return f"from {depth}, {height}"
    return ", ".join(part for part in (f"from the {level}{side}", depth, height) if part)


def strength_words(character: LightCharacter) -> str:
    """Return the ratio of direct to other light on the ground in words."""
    share = character.direct_share
    if share < EVEN:
        return "no direct light to speak of: the light comes from all around"
    ratio = share / max(1.0 - share, 1e-9)
    by = f"{ratio:.1f} times" if ratio < 100.0 else "more than 100 times"
    what = next(words for least, words in STRENGTHS if ratio >= least)
    return f"{what}: on the ground the direct part is {by} the rest"


def softness_words(character: LightCharacter) -> str:
    """Return the softness of a light's shadow in words."""
    if character.direct_share < EVEN:
        return "no edge: only where the object closes off the sky the ground is darker"
    width = character.half_width_deg
    words = next(words for limit, words in EDGES if width <= limit)
    if width > EDGES[-2][0]:
        return words
    # Of an edge one metre before the ground that it shades, by similar triangles.
    blur = 200.0 * float(np.tan(np.radians(width)))
    least = "less than " if width < 180.0 / HEIGHT else ""
    return f"{words} ({least}{blur:.0f} cm of blur per metre behind what casts it)"


def color_words(rgb: Float64Array) -> str:
    """Return the colour of a light in the photo's white balance, such as "slightly orange".

    Args:
        rgb: Linear Rec.709, any scale, shape [3].
    """
    rgb = np.maximum(np.asarray(rgb, np.float64), 0.0)
    top, low = float(rgb.max()), float(rgb.min())
    if top <= 0.0:
        return "black"
    saturation = (top - low) / top
    if saturation < NEUTRAL:
        return "neutral white"
    r, g, b = rgb
    hue = np.degrees(np.arctan2(np.sqrt(3.0) * (g - b), 2.0 * r - g - b)) % 360.0
    name = HUES[int(((hue + 18.0) % 360.0) // 36.0)]
    amount = "slightly " if saturation < SLIGHT else "strongly " if saturation > STRONG else ""
    return f"{amount}{name}"
