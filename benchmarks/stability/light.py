"""Hard cases of maps, shadow ratio, tone, encoding and fusion: range, black, ends, 8k."""

from functools import partial

import numpy as np

from benchmarks.stability import maps, tone
from benchmarks.stability.case import (
    MAX_ABSOLUTE,
    MAX_RELATIVE,
    RELATIVE,
    Case,
    Measured,
    Quantity,
    table,
)

PEAK = "max over the peak"
LIGHT, TONE, FUSION = "Maps and shadow ratio", "Tone and encoding", "Fusion of two lights"

LOOKUP_ULPS = 4.0
"""A bilinear weight is what is left of ``u * width``: four roundings of ``width * 2^-24``."""
PLANE = 2e-3
"""Noise of 64 x 256 low-discrepancy samples."""
TEXEL_GRADIENT = 2e-2
"""Noise of 64 x 4096 samples over 64 texels of the upper half."""
DENSITY = 1e-2
"""Steps of 2^-24 of the float32 table, near 1, over a sky texel's share of the sun's row."""
DENSITY_PLAIN = 2e-3
"""The same without a sun: a texel is 1e-4 of its row on 8192 columns."""
ENERGY = 1e-6
"""The float32 result of a float64 sum."""
CURVE = 1e-6
"""Ten roundings, relative to one plus the curve's slope, which amplifies those of ``x``."""
CURVE_GRADIENT = 2e-3
"""Knots 1e-3 apart are 6e-5 coarse in float32, and slopes divide by them, twice."""
VALUE = 1e-6
"""Ten roundings."""
GRADIENT = 1e-5
"""Twenty roundings of terms of one sign, against central differences good to 1e-6."""
ENCODING = 0.5 / 255.0
"""Half an 8-bit code: what `warpir.kernels.composite` states for its linear toe."""
FUSED = 1e-5
"""Twenty roundings of both lights, relative to the brighter one."""
FUSED_GRADIENT = 1e-5
"""float64, against central differences with steps of 1e-5."""
NO_COUNTERPART = "has no counterpart"

PLAIN = {"1k map": (512, 0.0)}
SUN = {"1k map, sun of 1e5 times the mean": (512, 1e5)}
GLARE = {"1k map, sun of 1e9 times the mean": (512, 1e9)}
LARGE = {"8k map, sun of 1e5 times the mean": (4096, 1e5)}
"""Rows of the map, and its sun over its mean."""
LEVELS = (0.0, 1e-45, 1e-38, 1e-29, 1e-6, 1.0, 1e6, 1e30)
"""Radiance of a plane, relative [W/(m^2 sr)]."""
PLANES = {
    "sun of 1e5 in the topmost row": (partial(maps.sky, 512, 1e5, 0.0),),
    "one texel alone": (partial(maps.lone_texel, 64, 1.0),),
    "one texel alone, 1e30": (partial(maps.lone_texel, 64, 1e30),),
    "one texel alone, 1e-30": (partial(maps.lone_texel, 64, 1e-30),),
    "map of 1 x 1": (partial(np.ones, (1, 1, 3), np.float32),),
    "map of 1 x 2": (partial(np.ones, (1, 2, 3), np.float32),),
}
"""What makes the map."""
SMALL_PLANES = {
    "smooth sky of 8 x 16": (partial(maps.sky, 8, 0.0), True),
    "sun of 1e5 on 8 x 16": (partial(maps.sky, 8, 1e5), True),
    "one texel alone on 8 x 16": (partial(maps.lone_texel, 8, 1.0), True),
    "black map of 8 x 16": (partial(np.zeros, (8, 16, 3), np.float32), True),
}
"""The same for maps whose gradient is measured."""
LIGHT_PAIRS = {
    "both lights alike": (1.0, 1.0, ""),
    "a black texel in the object's light": (1.0, 1.0, "fg"),
    "black texels in the shadow's light": (1.0, 1.0, "shadow"),
    "a texel black in both": (1.0, 1.0, "both"),
    "object's light black": (0.0, 1.0, ""),
    "shadow's light black": (1.0, 0.0, ""),
    "both black": (0.0, 0.0, ""),
    "object's light 1e5 times brighter": (1e5, 1.0, ""),
    "shadow's light 1e5 times brighter": (1.0, 1e5, ""),
    "both 1e-20": (1e-20, 1e-20, "both"),
    "1e-20 and 1e5": (1e-20, 1e5, ""),
}
"""Level of the object's light, of the shadow's, and which of them has black texels."""


def lookup_bound(height: int, contrast: float) -> float:
    """Return what rounding ``u * width`` does to a lookup."""
    return LOOKUP_ULPS * 2.0 * height * 2.0**-24


def density_bound(height: int, contrast: float) -> float:
    """Return the bound of the density with and without a sun."""
    return DENSITY if contrast else DENSITY_PLAIN


def sky_plane(device: str, height: int, contrast: float) -> Measured:
    """Radiance of a white plane under a smooth sky with a sun."""
    return maps.plane(device, partial(maps.sky, height, contrast))


def cases() -> list[Case]:
    """Return the rows of these groups."""
    return [*of_maps(), *of_tone(), *of_fusion()]


def of_maps() -> list[Case]:
    """Return the rows on maps and on the shadow ratio."""
    noise = "its noise, not its precision, would be compared: benchmarks.speed"
    other = "samples other densities: constant between its texels' centres"
    none, name = NO_COUNTERPART, "power averaged to 128 x 64"
    lookup = Quantity("radiance", PEAK, maps.lookup, lookup_bound, maps.mitsuba_lookup)
    density = Quantity("density at own samples", MAX_RELATIVE, maps.density, density_bound, other)
    under = Quantity("white plane", RELATIVE, sky_plane, PLANE, noise)
    power = Quantity(name, RELATIVE, maps.energy, ENERGY, none)
    plane = Quantity("white plane", RELATIVE, maps.plane, PLANE, noise)
    small = plane._replace(gradient_bound=TEXEL_GRADIENT)
    dark = Quantity("radiance, samples, summary", MAX_ABSOLUTE, maps.dark, 0.0, maps.mitsuba_dark)
    ratio = Quantity("shadow ratio", MAX_ABSOLUTE, tone.ratio, VALUE, none, GRADIENT)
    levels = {f"plane of radiance {level:g}": (level,) for level in LEVELS}
    return [
        *table(LIGHT, PLAIN | SUN, lookup, density, under),
        *table(LIGHT, GLARE, lookup, under),
        *table(LIGHT, LARGE, lookup, density, is_slow=True),
        *table(LIGHT, PLANES, plane),
        *table(LIGHT, SMALL_PLANES, small),
        *table(LIGHT, {"black map": ()}, dark),
        *table(LIGHT, SUN, power),
        *table(LIGHT, LARGE, power, is_slow=True),
        *table(LIGHT, levels, ratio),
    ]


def of_tone() -> list[Case]:
    """Return the rows on tone curves and on the display encoding."""
    none = NO_COUNTERPART
    curves = {f"curve: {name}": (raw,) for name, raw in tone.COLLAPSED.items()}
    slope = Quantity("value", "max over 1 + slope", tone.curve, CURVE, none, CURVE_GRADIENT)
    ends = Quantity("value, gradient", MAX_ABSOLUTE, tone.beyond, 0.0, none)
    bins = Quantity("fall, excess", MAX_ABSOLUTE, tone.empty_bins, VALUE, none)
    knots = Quantity("knots", MAX_ABSOLUTE, tone.raw_curve, VALUE, none)
    bright = Quantity("value", MAX_RELATIVE, tone.bright, VALUE, none, GRADIENT)
    display = Quantity("display value", MAX_ABSOLUTE, tone.encoding, ENCODING, none, GRADIENT)
    return [
        *table(TONE, curves, slope),
        *table(TONE, {"curves at and beyond their ends": ()}, ends),
        *table(TONE, {"bins of no width or height": ()}, bins),
        *table(TONE, {"raw parameters up to 1e30": ()}, knots),
        *table(TONE, {"Reinhard from 0 to 1e30": ()}, bright),
        *table(TONE, {"encoding from 0 to 1e30": ()}, display),
    ]


def of_fusion() -> list[Case]:
    """Return the rows on the fusion of two lights."""
    primed = Quantity("primed maps", PEAK, tone.fusion, FUSED, NO_COUNTERPART, FUSED_GRADIENT)
    return table(FUSION, LIGHT_PAIRS, primed)
