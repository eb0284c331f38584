"""Lat-long environment maps: directions, solid angles, look-ups, rotation and resampling.

The convention is OpenEXR's, in a right-handed frame with +Y up: the image's centre is +Z, its left
quarter +X, and texel centres lie at +0.5. For a direction (x, y, z) the horizontal coordinate is
``u = 1/2 - atan2(x, z) / 2 pi``, to the right, and the vertical one ``v = acos(y) / pi``, down.
"""

from __future__ import annotations

import numpy as np

from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray

ROWS_AT_ONCE = 8
"""Rows of a map that `resize_map` makes at once."""


def longitudes(width: int) -> Float64Array:
    """Return ``atan2(x, z)`` of each column's centre [rad], falling, shape [width]."""
    lon: Float64Array = np.pi * (1.0 - 2.0 * (np.arange(width) + 0.5) / width)
    return lon


def latitudes(height: int) -> Float64Array:
    """Return the angle above the horizon of each row's centre [rad], falling, shape [height]."""
    lat: Float64Array = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    return lat


def row_edges(height: int) -> Float64Array:
    """Return y of unit directions at the rows' edges, from 1 down to -1, shape [height + 1].

    Solid angle is proportional to their differences (Archimedes).
    """
    edges: Float64Array = np.cos(np.pi * np.arange(height + 1) / height)
    return edges


def texel_solid_angles(height: int, width: int) -> Float64Array:
    """Return the solid angle of a texel in each row [sr], shape [height]; the map sums to 4 pi."""
    edges = row_edges(height)
    return (2.0 * np.pi / width) * (edges[:-1] - edges[1:])


def directions_at(lat: Float64Array, lon: Float64Array) -> Float64Array:
    """Return unit directions on a grid of angles.

    Args:
        lat: Angle above the horizon [rad], shape [row].
        lon: ``atan2(x, z)`` [rad], shape [column].

    Returns:
        Shape [row, column, 3], in the frame of the map.
    """
    return np.stack(
        [
            np.cos(lat)[:, None] * np.sin(lon)[None, :],
            np.broadcast_to(np.sin(lat)[:, None], (len(lat), len(lon))),
            np.cos(lat)[:, None] * np.cos(lon)[None, :],
        ],
        axis=-1,
    )


def map_directions(height: int, width: int) -> Float64Array:
    """Return the unit direction of each texel centre, world frame, shape [height, width, 3]."""
    return directions_at(latitudes(height), longitudes(width))


def uv_of(directions: AnyFloatArray) -> tuple[Float64Array, Float64Array]:
    """Return the map coordinates of directions, ``u`` to the right and ``v`` down, in [0, 1].

    Args:
        directions: Of any length, in the frame of the map, shape [..., 3].

    Returns:
        ``u`` and ``v``, shape [...] each.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    # atan2 keeps the digits that acos loses near the poles.
    return 0.5 - 0.5 * np.arctan2(x, z) / np.pi, np.arctan2(np.hypot(x, z), y) / np.pi


def look_up(texels: FloatArray, directions: Float64Array) -> Float64Array:
    """Return a map's radiance in some directions, bilinear between texel centres.

    Args:
        texels: Shape [He, We, 3].
        directions: Of any length, in the frame of the map, shape [..., 3].

    Returns:
        Radiance, shape [..., 3].
    """
    u, v = uv_of(directions)
    return interpolate(texels, u * texels.shape[1] - 0.5, v * texels.shape[0] - 0.5)


def interpolate(texels: FloatArray, column: Float64Array, row: Float64Array) -> Float64Array:
    """Read a map bilinearly at fractional positions; 0 is the centre of the first texel.

    Args:
        texels: Shape [He, We, 3].
        column: Wrapped, shape [...].
        row: Clamped, shape [...].

    Returns:
        Values, shape [..., 3].
    """
    height, width = texels.shape[:2]
    row = np.clip(row, 0.0, height - 1.0)
    left, top = np.floor(column), np.floor(row)
    x, y = (column - left)[..., None], (row - top)[..., None]
    j, i = left.astype(int) % width, top.astype(int)
    k, below = (j + 1) % width, np.minimum(i + 1, height - 1)
    upper = texels[i, j] * (1.0 - x) + texels[i, k] * x
    lower = texels[below, j] * (1.0 - x) + texels[below, k] * x
    values: Float64Array = upper * (1.0 - y) + lower * y
    return values


def rotate_map(texels: FloatArray, degrees: float) -> FloatArray:
    """Turn a map about +Y, counter-clockwise seen from above; each row keeps its sum.

    Whole columns are moved exactly; what stays as it is may be the array itself.

    The map's u falls with longitude (``lon = pi (1 - 2u)``), so content moves to smaller columns.
    """
    columns = -(degrees / 360.0) * texels.shape[1]
    if abs(columns - round(columns)) < 1e-6:  # what 360 degrees in float64 leave behind
        columns = round(columns)
    whole = int(np.floor(columns))
    part = np.float32(columns - whole)
    is_turned = whole % texels.shape[1] != 0
    moved = np.roll(texels, whole, axis=1) if is_turned else texels
    if part > 0.0:
        moved = (np.float32(1.0) - part) * moved + part * np.roll(texels, whole + 1, axis=1)
    return np.ascontiguousarray(moved, dtype=np.float32)


def resize_map(texels: FloatArray, height: int) -> FloatArray:
    """Resample a map to ``height`` rows: each texel is the mean over its solid angle.

    Texels are taken as constant, so energy is kept exactly at any size.
    """

    def boxes(values: AnyFloatArray, old: Float64Array, new: Float64Array) -> Float64Array:
        """Average rows between rising ``old`` edges over rising ``new`` ones."""
        averaged = np.empty((len(new) - 1, *values.shape[1:]))
        # Some rows at a time: a float64 copy of an 8k map and its running sum would take 3 GiB.
        for start in range(0, len(averaged), ROWS_AT_ONCE):
            edges = new[start : start + ROWS_AT_ONCE + 1]
            first = max(int(np.searchsorted(old, edges[0], side="right")) - 1, 0)
            last = max(int(np.searchsorted(old, edges[-1], side="left")), first + 1)
            reached = np.clip(old[None, first : last + 1], edges[:-1, None], edges[1:, None])
            share = np.diff(reached, axis=1) / np.diff(edges)[:, None]
            averaged[start : start + len(share)] = np.tensordot(share, values[first:last], axes=1)
        return averaged

    if texels.shape[0] == height and texels.shape[1] == 2 * height:
        return texels
    old_height, old_width = texels.shape[:2]
    rows = boxes(texels, -row_edges(old_height), -row_edges(height))
    columns = (np.linspace(0.0, 1.0, count + 1) for count in (old_width, 2 * height))
    resized = boxes(np.moveaxis(rows, 1, 0), *columns)
    return np.moveaxis(resized, 0, 1).astype(np.float32)
