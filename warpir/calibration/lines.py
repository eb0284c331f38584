"""A second witness of a camera's roll: the vanishing point of the photo's upright edges.

Straight segments come from scikit-image (Canny's edges, then the probabilistic Hough transform of
Galamhos et al. 1999). Each segment and the camera's centre span a plane; the normals of the planes
of all upright edges are at right angles to the world's up, which RANSAC finds.
"""

from __future__ import annotations

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import luminance

LONGER_SIDE = 480
"""Of the photo in which lines are looked for [px]."""
EDGE_SIGMA = 2.0
"""Of the Gaussian before edges are found [px]."""
EDGE_QUANTILES = (0.75, 0.90)
"""Of the gradients: where an edge may go on, and where it must begin."""
WEAKEST = 0.02
"""Gradient below which nothing is an edge (Sobel's sum: eight times the change from one pixel to
the next), so that even areas have none."""
VOTES, SHORTEST, GAP = 10, 30, 2
"""Of a segment: least votes, least length and longest gap [px]."""
CONE_DEG = 25.0
"""Largest angle between the first guess of up and what is found [deg]."""
INLIER_DEG = 2.0
"""Largest angle between up and the plane of an upright segment [deg]."""
TRIALS = 300
FEWEST = 10
"""Segments that must agree before they are believed."""
LEAST_SHARE = 0.6
"""Of the length of all nearly upright segments that must agree."""
UPRIGHT = np.cos(np.radians(45.0))
"""Least length of the upward direction across the optical axis [1]: of a camera that looks further
down or up, it lies so nearly along the axis that a few degrees of it turn the roll round."""
SIGMA_DEG = 0.7
"""Standard deviation of what is believed, on crops of places that the network has not seen."""


def find_segments(photo: FloatArray) -> Float64Array:
    """Return straight segments (x0, y0, x1, y1) of a photo [px], shape [N, 4].

    Args:
        photo: Display-encoded in [0, 1], shape [H, W, 3].
    """
    from scipy.ndimage import gaussian_filter, sobel
    from skimage.feature import canny
    from skimage.transform import probabilistic_hough_line

    grey = luminance(photo.astype(np.float64))
    smooth = gaussian_filter(grey, EDGE_SIGMA)
    strength = np.hypot(sobel(smooth, axis=0), sobel(smooth, axis=1))
    low, high = np.quantile(strength, EDGE_QUANTILES).clip(min=WEAKEST)
    edges = canny(  # type: ignore[no-untyped-call]
        grey, EDGE_SIGMA, low_threshold=low, high_threshold=high
    )
    lines = probabilistic_hough_line(  # type: ignore[no-untyped-call]
        edges, VOTES, SHORTEST, GAP, rng=0
    )
    return np.array(lines, np.float64).reshape(-1, 4)


def upright_roll(
    segments: Float64Array,
    centre: tuple[float, float],
    focal: float,
    pitch_deg: float,
    roll_deg: float,
) -> float | None:
    """Estimate the roll [deg] from upright edges; None where too few agree.

    The pitch that they tell is left out: it depends on the focal length, which is less sure, and on
    held-out places it was no better than the network's.

    The segments are those of `find_segments`, centre (x, y) and focal length in pixels; pitch and
    roll are a first guess, which tells upright edges from others.
    """
    pitch, roll = np.radians([pitch_deg, roll_deg])
    guess = np.array([np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch), -np.sin(pitch)])
    ends = (segments.reshape(-1, 2, 2) - centre) / focal * (1.0, -1.0)
    rays = np.concatenate([ends, -np.ones((*ends.shape[:2], 1))], axis=2)
    normals = np.cross(rays[:, 0], rays[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-12)
    lengths = np.linalg.norm(segments[:, 2:] - segments[:, :2], axis=1)
    near = np.abs(normals @ guess) < np.sin(np.radians(CONE_DEG))
    normals, lengths = normals[near], lengths[near]
    if len(normals) < FEWEST:
        return None
    # RANSAC: two planes meet in a line, which is up if many others contain it.
    pairs = np.random.default_rng(0).integers(0, len(normals), (TRIALS, 2))
    ups = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    sine = np.linalg.norm(ups, axis=1)
    ups = ups[sine > 0.02] / sine[sine > 0.02, None]
    ups *= np.sign(ups @ guess)[:, None]
    ups = np.concatenate([ups[ups @ guess > np.cos(np.radians(CONE_DEG))], guess[None]])
    agree = np.abs(ups @ normals.T) < np.sin(np.radians(INLIER_DEG))
    chosen = agree[int(np.argmax(agree @ lengths))]
    for _ in range(3):
        if chosen.sum() < FEWEST:
            return None
        weighted = normals[chosen] * np.sqrt(lengths[chosen])[:, None]
        up = np.linalg.svd(weighted)[2][2]
        up *= np.sign(up @ guess)
        chosen = np.abs(normals @ up) < np.sin(np.radians(INLIER_DEG))
    is_clear = lengths[chosen].sum() >= LEAST_SHARE * lengths.sum()
    if chosen.sum() < FEWEST or not is_clear or up @ guess < np.cos(np.radians(CONE_DEG)):
        return None
    if np.hypot(up[0], up[1]) < UPRIGHT:
        return None
    return float(np.degrees(np.arctan2(up[0], up[1])))
