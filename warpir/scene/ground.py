"""Robust fit of the ground plane to a point cloud, as for LiDAR of driving scenes.

Hypotheses through three points each are scored by MSAC (Torr and Zisserman 2000: the sum of squared
distances, cut off at a threshold), the best is refined by total least squares on its inliers.
"""

from dataclasses import dataclass, replace
from hashlib import sha256

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array
from warpir.core.errors import InputError
from warpir.scene.camera import Camera

HYPOTHESES = 50_000
"""Number of triples tried: ground that holds 5 % of the points is drawn about six times."""
SCORED_ON = 1000
"""Number of points on which hypotheses are scored."""
THRESHOLD_SHARE = 0.005
"""Cut-off distance, as a share of the points' median distance from the camera: 7 cm at 15 m."""
LEAST_INLIERS = 30
LEAST_SHARE = 0.05
"""Least share of inliers [1]; a plane through unordered points has a tenth of it."""
TILT_LIMIT = 30.0
"""Largest angle of the ground's normal from up [deg]."""
TILT_LIMIT_OF_CAMERA = 45.0
"""Largest angle of the normal from the camera's up, where the world's is unknown [deg]."""
REFINEMENTS = 10


@dataclass(frozen=True)
class GroundFit:
    """A plane through the points that show the ground."""

    plane: Float64Array
    """Plane (a, b, c, d): unit normal on the camera's side, offset, shape [4]."""
    rms: float
    """Root mean square of the inliers' distances from the plane [m]."""
    inliers: int
    points: int
    """Number of points in view of the camera, which were fitted."""
    tilt_deg: float
    """Angle of the normal from the world's up, or from the camera's where unknown [deg]."""
    camera_height: float
    """Height of the camera above the plane [m]."""
    has_up: bool = True
    """Whether the world's up was known."""
    is_earlier: bool = False
    """Whether all but the height is of an earlier frame's camera."""

    @property
    def about(self) -> str:
        """Summary of the fit in one line."""
        if self.is_earlier:
            return (
                "the ground is the plane fitted to what an earlier frame sees of the points, "
                f"{self.camera_height:.3g} m below this camera (--ground-points)"
            )
        share = 100.0 * self.inliers / self.points
        level = "level" if self.has_up else "the camera's"
        return (
            f"the ground is a plane fitted to {self.inliers} of the {self.points} points in view "
            f"({share:.0f} %, off by {self.rms:.2g} m rms), {self.camera_height:.3g} m below the "
            f"camera, {self.tilt_deg:.1f} degrees off {level} (--ground-points)"
        )

    def record(self) -> dict[str, object]:
        """Return the fit's entry in ``run.json``."""
        return {
            "plane": self.plane.tolist(),
            "rms": self.rms,
            "inliers": self.inliers,
            "points": self.points,
            "tilt_deg": self.tilt_deg,
            "camera_height": self.camera_height,
        }


def fit_ground(points: Float64Array, camera: Camera, *, has_up: bool = True) -> GroundFit:
    """Fit a plane below the camera, about level, to the points that the camera sees.

    The same points give the same plane.

    Args:
        points: World frame [m], shape [point, 3].
        camera: The camera.
        has_up: Whether +Y of the world is up; if not, the camera's up replaces it.

    Raises:
        InputError: Too few points in view, or no plane that enough of them lie on.
    """
    origin = camera.c2w[:3, 3]
    seen = points[in_view(points, camera)]
    if len(seen) < LEAST_INLIERS:
        raise InputError(
            "--ground-points",
            f"no ground (found {len(seen)} of {len(points)} points in view of the camera; expected "
            f"at least {LEAST_INLIERS})",
            "camera and points must be in one world: check --up, or give --ground",
        )
    up = np.array([0.0, 1.0, 0.0]) if has_up else camera.c2w[:3, 1]
    limit = TILT_LIMIT if has_up else TILT_LIMIT_OF_CAMERA
    threshold = THRESHOLD_SHARE * float(np.median(np.linalg.norm(seen - origin, axis=1)))

    fit = _fit(seen, origin, up, limit, threshold)
    if fit is None:
        raise InputError(
            "--ground-points",
            f"no ground found (the {len(seen)} points in view hold no plane below the camera, "
            f"within {limit:.0f} degrees of level, with at least {100 * LEAST_SHARE:.0f} % of "
            "them)",
            "check --up, or give --ground",
        )
    return replace(fit, has_up=has_up)


def _fit(
    points: Float64Array, origin: Float64Array, up: Float64Array, limit: float, threshold: float
) -> GroundFit | None:
    """Return the best plane, or None where too few points lie on it."""
    plane = _best_hypothesis(points, origin, up, float(np.cos(np.radians(limit))), threshold)
    if plane is None:
        return None
    spread = threshold
    for _ in range(REFINEMENTS):
        near = np.abs(points @ plane[:3] + plane[3]) <= spread
        if near.sum() < LEAST_INLIERS:
            return None
        plane = _through(points[near], up)
        distances = np.abs(points @ plane[:3] + plane[3])
        # Three robust standard deviations, between a tenth of the threshold and all of it.
        deviation = 1.4826 * float(np.median(distances[near]))
        spread = float(np.clip(3.0 * deviation, 0.1 * threshold, threshold))
    near = distances <= spread
    height = float(plane[:3] @ origin + plane[3])
    tilt = float(np.degrees(np.arccos(np.clip(plane[:3] @ up, -1.0, 1.0))))
    enough = max(LEAST_INLIERS, LEAST_SHARE * len(points))
    if near.sum() < enough or height <= threshold or tilt > limit:
        return None
    rms = float(np.sqrt(np.mean(distances[near] ** 2)))
    return GroundFit(plane, rms, int(near.sum()), len(points), tilt, height)


class FirstGround:
    """Fits one plane to the same points, to those that the first camera sees.

    Each camera of a sequence sees others, and planes of their own would let the object tremble.
    """

    def __init__(self) -> None:
        self._found: dict[bytes, tuple[GroundFit, Float64Array]] = {}

    def __call__(self, points: Float64Array, camera: Camera, *, has_up: bool = True) -> GroundFit:
        """Return the first fit to such points; arguments as of `fit_ground`."""
        key = sha256(points.tobytes()).digest()
        if key not in self._found:
            self._found[key] = fit_ground(points, camera, has_up=has_up), camera.c2w
        fit, first = self._found[key]
        if np.array_equal(first, camera.c2w):
            return fit
        height = float(fit.plane[:3] @ camera.c2w[:3, 3] + fit.plane[3])
        return replace(fit, camera_height=height, is_earlier=True)


def in_view(points: Float64Array, camera: Camera) -> BoolArray:
    """Return which points project into the photo, shape [point]."""
    with np.errstate(invalid="ignore"):
        pixels = camera.project(points)
        inside = (pixels >= 0.0) & (pixels <= (camera.width, camera.height))
    return np.asarray(inside.all(axis=1))


def _best_hypothesis(
    points: Float64Array,
    origin: Float64Array,
    up: Float64Array,
    least_cosine: float,
    threshold: float,
) -> Float64Array | None:
    """Return the admissible plane through three points with the least MSAC score, shape [4]."""
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(0, len(points), (3, HYPOTHESES))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0.0] / lengths[lengths > 0.0, None]
    normals *= np.sign(normals @ up)[:, None]
    offsets = -np.sum(normals * a[lengths > 0.0], axis=1)
    admissible = (normals @ up >= least_cosine) & (normals @ origin + offsets > threshold)
    normals, offsets = normals[admissible], offsets[admissible]
    if not len(normals):
        return None
    sample = points[rng.permutation(len(points))[:SCORED_ON]]
    scores = np.concatenate(
        [
            np.minimum((n @ sample.T + d[:, None]) ** 2, threshold**2).sum(axis=1)
            for n, d in zip(_slices(normals), _slices(offsets), strict=True)
        ]
    )
    best = int(np.argmin(scores))
    return np.append(normals[best], offsets[best])


def _slices(rows: Float64Array) -> list[Float64Array]:
    return [rows[first : first + 2048] for first in range(0, len(rows), 2048)]


def _through(points: Float64Array, up: Float64Array) -> Float64Array:
    """Return the plane of total least squares through points, shape [4]."""
    centre = points.mean(axis=0)
    normal = np.linalg.eigh(np.cov((points - centre).T))[1][:, 0]
    normal = normal if normal @ up > 0.0 else -normal
    return np.append(normal, -normal @ centre)
