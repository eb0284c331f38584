"""Recognises pictures that no pinhole camera takes: fisheyes, whole panoramas and collages.

The network has never seen any and answers them as confidently as photos.
"""

from __future__ import annotations

import numpy as np

from warpir.core.arrays import BoolArray, FloatArray

SECTORS, AROUND, LEAST_DIFFERENCE = 24, 0.75, 0.02
"""Sectors of a fisheye's rim, the share of them that differ from its corners, and by how much."""
LONGEST = 1024
"""Longer side that seams are looked for at [px]: larger pictures are averaged."""
SHORTEST = 64
"""Shorter side of a picture in which seams are looked for [px]."""
PARTS = 40
"""Parts of a seam; each is a mean, in which noise and fine texture vanish."""
REACH, APART = 2, 3
"""Columns that the step at a seam is taken over (JPEG and resizing smear it over two), and from
there to the columns beside it, whose own steps it must exceed [px]."""
CLEAR, FAINTEST = 2.5, 0.015
"""A part shows the seam where its step is so many times those beside it, and so much more."""
VARIATION = 0.3
"""Greatest share of the parts that need not show it, where the step varies along the seam; of a
step that is the same all along, as a pillar's, a door's or a level horizon's, all must."""
FARTHER, LEAST_FARTHER = 8, 0.3
"""Columns to either side of a step [px], and the share of the step that must be left in their
difference: on both sides of a thin line, as a joint of a pavement, lies the same."""
MARGIN = 0.08
"""Share of the columns at either side in which no seam is looked for."""
EVEN = 0.008
"""Largest difference along a border of one colour."""
JOINED, POLE = 2.0, 0.3
"""A panorama's ends differ by at most so many times what neighbouring columns do in the median; its
top row is one point of the sky, and varies by at most this share of what the picture does."""


def looks_like(photo: FloatArray) -> str:
    """Return what a picture looks like that no pinhole camera takes; empty for a photo.

    Args:
        photo: Display-encoded in [0, 1], shape [H, W, 3].
    """
    if has_image_circle(photo):
        return "a circular fisheye picture"
    if is_panorama(photo):
        return "a 360-degree panorama, which --light takes,"
    return "a collage" if has_seam(photo) else ""


def has_image_circle(photo: FloatArray) -> bool:
    """Tell whether a photo is a circle in corners of one colour, as a circular fisheye's.

    What is within the circle differs from the corners all around, unlike an object that is shown
    before a backdrop of one colour.

    Args:
        photo: Display-encoded in [0, 1], shape [H, W, 3].
    """
    step = max(1, min(photo.shape[:2]) // 256)  # one for both axes: a circle stays one
    photo = photo[::step, ::step]
    height, width = photo.shape[:2]
    v, u = np.ogrid[:height, :width]
    down, right = v + 0.5 - height / 2.0, u + 0.5 - width / 2.0
    radius = np.hypot(down, right) / (min(height, width) / 2.0)
    outside, is_rim = photo[radius > 1.1], (radius > 0.8) & (radius < 0.95)
    if not (len(outside) and is_rim.any()):
        return False
    # JPEG leaves a code or two of noise in what was one colour.
    if outside.std(axis=0).max() >= 0.01 or photo[is_rim].std(axis=0).max() <= 0.05:
        return False
    sector = ((np.arctan2(down, right)[is_rim] / (2.0 * np.pi) + 0.5) * SECTORS).astype(np.intp)
    differs = np.abs(photo[is_rim] - outside.mean(axis=0)).max(axis=1) > LEAST_DIFFERENCE
    most = np.bincount(sector % SECTORS, differs, SECTORS) > 0.5 * np.bincount(
        sector % SECTORS, minlength=SECTORS
    )
    return bool(most.mean() >= AROUND)


def is_panorama(photo: FloatArray) -> bool:
    """Tell whether a photo is twice as wide as high and goes on at its left where its right ends.

    Args:
        photo: Display-encoded in [0, 1], shape [H, W, 3].
    """
    height, width = photo.shape[:2]
    if width != 2 * height or height < SHORTEST:
        return False
    grey = _averaged(_averaged(photo, 0, LONGEST // 2), 1, LONGEST).mean(axis=2)
    steps = np.abs(np.diff(grey, axis=1, append=grey[:, :1])).mean(axis=0)
    is_joined = steps[-1] < JOINED * np.median(steps)
    return bool(is_joined and grey[0].std() < POLE * grey.std())


def has_seam(photo: FloatArray) -> bool:
    """Tell whether a straight seam cuts a photo from side to side, as those of a collage.

    At a seam neighbouring pixels differ more than those beside them, along its whole length, and so
    does what lies a little farther off. Borders of one colour are cut off first.

    Args:
        photo: Display-encoded in [0, 1], shape [H, W, 3].
    """
    height, width = photo.shape[:2]
    longer = max(height, width)
    photo = _averaged(_averaged(photo, 0, LONGEST * height // longer), 1, LONGEST * width // longer)
    for _ in range(2):
        if min(photo.shape[:2]) < SHORTEST:
            return False
        photo = _without_borders(photo).swapaxes(0, 1)
    if min(photo.shape[:2]) < SHORTEST:
        return False
    return _has_upright_seam(photo) or _has_upright_seam(photo.swapaxes(0, 1))


def _averaged(photo: FloatArray, axis: int, count: int) -> FloatArray:
    """Return a photo of at most so many rows (axis 0) or columns (1), means of those it had."""
    length = photo.shape[axis]
    count = min(max(count, 1), length)
    edges = np.arange(count + 1) * length // count
    sums = np.add.reduceat(photo, edges[:-1], axis=axis)
    shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
    means: FloatArray = sums / np.diff(edges).astype(np.float32).reshape(shape)
    return means


def _without_borders(photo: FloatArray) -> FloatArray:
    """Cut columns of one colour off either side of a photo."""
    is_even: BoolArray = np.ptp(_averaged(photo, 0, PARTS), axis=0).max(axis=1) < EVEN
    inside = np.flatnonzero(~is_even)
    return photo[:, inside[0] : inside[-1] + 1] if len(inside) else photo[:, :0]


def _has_upright_seam(photo: FloatArray) -> bool:
    """As `has_seam`, of seams along columns."""
    parts = _averaged(photo, 0, PARTS)
    steps = parts[:, REACH:] - parts[:, :-REACH]
    size = np.abs(steps).max(axis=2)
    beside = np.maximum(size[:, : -2 * APART], size[:, 2 * APART :])
    steps, size = steps[:, APART:-APART], size[:, APART:-APART]
    shown = (size > CLEAR * beside + FAINTEST).mean(axis=0)
    rms = np.sqrt((steps**2).mean(axis=0).sum(axis=1)).clip(min=1e-6)
    varies = 1.0 - np.linalg.norm(steps.mean(axis=0), axis=1) / rms
    left = np.arange(len(rms)) + APART
    right = (left + REACH + FARTHER).clip(max=parts.shape[1] - 1)
    farther = parts[:, right] - parts[:, (left - FARTHER).clip(min=0)]
    left_over = (farther * steps).mean(axis=0).sum(axis=1) / rms**2
    is_seam = (left_over >= LEAST_FARTHER) & (shown >= 1.0 - varies.clip(max=VARIATION))
    margin = round(MARGIN * len(rms))
    return bool(is_seam[margin : len(rms) - margin].any())
