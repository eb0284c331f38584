"""Pinhole camera: intrinsics, pose, the projection both ways, and cameras from a few numbers.

World right-handed, +Y up, metres; the camera looks along its own -Z with +Y up and +X right.
Pixel (column j, row i) has its centre at (j + 0.5, i + 0.5), origin top left, y down.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from warpir.core.arrays import BoolArray, Float64Array, IntArray, affine_matrix
from warpir.core.errors import ExitCode, InputError

FILM_DIAGONAL_35MM = 43.267
"""Diagonal of the 36 x 24 mm frame that EXIF's equivalent focal length refers to [mm]."""

TILE = 16
"""Side of the tiles of `Camera.tiles_of` [px]."""

TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Blender's world from ours, column vectors."""


class Source(NamedTuple):
    """Where a number of a camera comes from, and how wrong it may be."""

    name: str
    """Such as ``--fov``, ``EXIF``, ``estimate`` or ``assumed``."""
    sigma: float | None = None
    """Standard deviation, in the number's unit; None where it is not known."""


ESTIMATE, ASSUMED, CAMERA_FILE = "estimate", "assumed", "camera file"
"""Names of sources: estimated from the photo, usual where nothing is known, of a camera file."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion."""

    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, x [px]."""
    cy: float
    """Principal point, y [px]."""
    c2w: Float64Array
    """Camera to world, rigid, column vectors, shape [4, 4]."""
    notices: tuple[str, ...] = field(default=(), compare=False)
    """Scalings and doubtful values, one line each; printed and kept in ``run.json``."""
    assumed: tuple[str, ...] = field(default=(), compare=False)
    """Assumed values, one line each; printed and kept in ``run.json``."""
    sources: Mapping[str, Source] = field(default_factory=dict, compare=False)
    """Where ``pitch_deg``, ``roll_deg``, ``vfov_deg`` and ``principal`` come from; a number without
    an entry is that of a camera file."""

    def scaled(self, width: int, height: int) -> "Camera":
        """Return the same view at another resolution."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def project(self, points: Float64Array) -> Float64Array:
        """Project world points [m], shape [point, 3], to pixels, shape [point, 2].

        Points behind the camera give NaN.
        """
        w2c = np.linalg.inv(self.c2w)
        local = points @ w2c[:3, :3].T + w2c[:3, 3]
        depth = np.where(local[:, 2] < 0.0, -local[:, 2], np.nan)
        return np.stack(
            [self.cx + self.fx * local[:, 0] / depth, self.cy - self.fy * local[:, 1] / depth],
            axis=1,
        )

    def pixels_of_box(self, corners: Float64Array) -> IntArray:
        """Return a superset of the pixels that a box covers and their neighbours, row-major.

        ``corners`` are in the world [m], shape [8, 3]. All pixels if one is behind the camera.
        """
        uv = self.project(corners)
        if np.isnan(uv).any():
            left, top, right, bottom = 0, 0, self.width, self.height
        else:
            left, top = np.maximum(np.floor(uv.min(axis=0)).astype(int) - 1, 0)
            right, bottom = np.ceil(uv.max(axis=0)).astype(int) + 1
            right, bottom = min(right, self.width), min(bottom, self.height)
        if right <= left or bottom <= top:
            return np.zeros(0, np.int32)
        rows = np.arange(top, bottom, dtype=np.int64)[:, None] * self.width
        return (rows + np.arange(left, right)[None]).reshape(-1).astype(np.int32)

    def tiles_of(self, points: Float64Array, triangles: IntArray) -> BoolArray:
        """Return the pixels of all tiles that the box of a triangle's image meets, and 2 px around.

        All pixels if a point is behind the camera.

        Args:
            points: World [m], shape [point, 3].
            triangles: Their points, shape [triangle, 3].

        Returns:
            Shape [height, width].
        """
        uv = self.project(points)
        if np.isnan(uv).any():
            return np.ones((self.height, self.width), bool)
        low, high = uv[triangles].min(axis=1) - 2.0, uv[triangles].max(axis=1) + 2.0
        tiles = -(-np.array([self.width, self.height]) // TILE)
        first = np.clip(np.floor(low / TILE), 0, tiles).astype(int)
        past = np.clip(np.floor(high / TILE) + 1.0, first, tiles).astype(int)
        # A rectangle of tiles is a sum over both axes of its four corners.
        columns, rows = tiles + 1
        starts = np.zeros(rows * columns)
        for (a, x), (b, y) in product(enumerate((first, past)), repeat=2):
            at = y[:, 1] * columns + x[:, 0]
            starts += (-1.0) ** (a + b) * np.bincount(at, minlength=rows * columns)
        near = starts.reshape(rows, columns).cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0.0
        mask: BoolArray = near.repeat(TILE, axis=0).repeat(TILE, axis=1)
        return mask[: self.height, : self.width]

    def toward(self, u: ArrayLike, v: ArrayLike) -> Float64Array:
        """Return the directions of image positions [px], camera frame, z = -1, shape [..., 3]."""
        x = (np.asarray(u, np.float64) - self.cx) / self.fx
        y = (self.cy - np.asarray(v, np.float64)) / self.fy
        return np.stack([x, y, np.full_like(x, -1.0)], axis=-1)

    def pixel_rays(self, u: float = 0.5, v: float = 0.5) -> Float64Array:
        """Return unit directions through a place in every pixel, world frame, shape [H, W, 3]."""
        columns, rows = np.meshgrid(np.arange(self.width) + u, np.arange(self.height) + v)
        rays = self.toward(columns, rows) @ self.c2w[:3, :3].T
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def ray(self, u: float, v: float) -> tuple[Float64Array, Float64Array]:
        """Return origin [m] and unit direction, world frame, through pixel position (u, v)."""
        direction = self.c2w[:3, :3] @ self.toward(u, v)
        return self.c2w[:3, 3].copy(), direction / np.linalg.norm(direction)

    def record(self) -> dict[str, Any]:
        """Return the content of ``camera.json``, which ``--camera`` takes back."""
        return {
            "w": self.width,
            "h": self.height,
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            "c2w": self.c2w.tolist(),
        }

    def numbers(self) -> dict[str, dict[str, Any]]:
        """Return what ``run.json`` says of pitch, roll, field of view and principal point.

        By name: ``value``, ``sigma`` (standard deviation, None where it is not known) and
        ``source``. Angles are degrees above the world's horizon; the principal point is given as
        shares of width and height from the top left.
        """
        _, up, back = self.c2w[:3, :3].T
        values: dict[str, Any] = {
            "pitch_deg": math.degrees(math.asin(float(np.clip(-back[1], -1.0, 1.0)))),
            "roll_deg": math.degrees(math.atan2(float(self.c2w[1, 0]), float(up[1]))),
            "vfov_deg": math.degrees(2.0 * math.atan(self.height / 2.0 / self.fy)),
            "principal": [self.cx / self.width, self.cy / self.height],
        }
        record = {}
        for name, value in values.items():
            source = self.sources.get(name, Source(CAMERA_FILE))
            sigma = None if source.sigma is None else round(source.sigma, 3)
            rounded = np.round(value, 6).tolist()
            record[name] = {"value": rounded, "sigma": sigma, "source": source.name}
        return record


def exr_matrices(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Return OpenEXR's ``worldToCamera`` and ``worldToNDC``, shape [4, 4] each.

    OpenEXR's camera is left-handed with +Z forward, its NDC runs from (0, 0) top left to (1, 1)
    bottom right, and its matrices multiply row vectors, hence the transposes.
    """
    w2c = np.linalg.inv(camera.c2w)
    width, height = camera.width, camera.height
    projection = np.array(
        [
            [camera.fx / width, 0.0, -camera.cx / width, 0.0],
            [0.0, -camera.fy / height, -camera.cy / height, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )
    return (np.diag([1.0, 1.0, -1.0, 1.0]) @ w2c).T, (projection @ w2c).T


def mitsuba_sensor(camera: Camera) -> dict[str, Any]:
    """Return the parameters of Mitsuba 3's ``perspective`` sensor with ``fov_axis="x"``.

    Mitsuba's camera looks along +Z with +X to the left. Its pixels are square: where fx and fy
    differ, columns agree and rows do not, by `square_pixel_error`.

    Returns:
        ``to_world``: world from sensor, column vectors, array of shape [4, 4]; ``fov_deg``: angle
        across the width [deg]; ``principal_point_offset_x`` and ``_y``: shares of width and height.
    """
    return {
        "to_world": camera.c2w @ np.diag([-1.0, 1.0, -1.0, 1.0]),
        "fov_deg": float(np.degrees(2.0 * np.arctan(camera.width / 2.0 / camera.fx))),
        "principal_point_offset_x": (camera.width / 2.0 - camera.cx) / camera.width,
        "principal_point_offset_y": (camera.height / 2.0 - camera.cy) / camera.height,
    }


def blender_camera(camera: Camera) -> dict[str, Any]:
    """Return the parameters of a Blender camera with ``sensor_fit="AUTO"``.

    Blender's camera axes are ours, its world has +Z up. AUTO measures angle and shifts by the
    longer side. Pixels are taken to be square, as in `mitsuba_sensor`.

    Returns:
        ``matrix_world``: Blender's world from camera, column vectors, array of shape [4, 4];
        ``angle``: across the longer side [rad]; ``shift_x`` and ``shift_y``: shares of it.
    """
    longer = max(camera.width, camera.height)
    return {
        "matrix_world": TO_Z_UP @ camera.c2w,
        "angle": float(2.0 * np.arctan(longer / 2.0 / camera.fx)),
        "shift_x": (camera.width / 2.0 - camera.cx) / longer,
        "shift_y": (camera.cy - camera.height / 2.0) / longer,
    }


def square_pixel_error(camera: Camera) -> float:
    """Return the largest error of rows where fx replaces fy, over all pixels [px]."""
    farthest = max(abs(camera.cy), abs(camera.height - camera.cy))
    return float(abs(camera.fx / camera.fy - 1.0) * farthest)


# ----------------------------------------------------------------------- cameras from few numbers


@dataclass(frozen=True)
class CameraEstimate:
    """What a photo shows of its camera.

    Standard deviations are calibrated: about 68 % of errors on places that were not learned from
    are smaller.
    """

    pitch_deg: float
    """Tilt of the optical axis [deg]: positive looks up, negative looks down, as ``--pitch``."""
    roll_deg: float
    """Turn about the camera's own +Z, which points out of the photo toward the viewer [deg]:
    positive is counter-clockwise from behind the camera, so the photo's horizon falls to the right.
    The camera's rotation to the world is Ry(yaw) Rx(pitch) Rz(roll)."""
    vfov_deg: float
    """Vertical field of view [deg]: 2 atan(height / 2 f), wherever the principal point is."""
    principal: tuple[float, float]
    """Principal point as shares of width and height from the top left; (.5, .5) is the middle. In a
    photo that was corrected to upright it is off the middle, and the pitch about 0."""
    pitch_sigma_deg: float
    """Standard deviation of the pitch [deg]."""
    roll_sigma_deg: float
    """Standard deviation of the roll [deg]."""
    vfov_sigma_deg: float
    """Standard deviation of the vertical field of view [deg]."""
    principal_sigma: tuple[float, float]
    """Standard deviations of the principal point, in the same shares."""
    witnesses: tuple[str, ...]
    """What the estimate rests on, one name each."""
    looks_like: str = ""
    """What the picture looks like that no pinhole camera takes, as "a collage"; empty for a
    photo."""

    @property
    def is_upright_corrected(self) -> bool:
        """Whether the photo was corrected to upright: level, its optical axis off the middle."""
        return self.principal[1] != 0.5

    def camera(self, width: int, height: int, camera_height: float) -> Camera:
        """Return the estimated camera at (0, camera_height, 0), turned toward -Z.

        Args:
            width: Image width [px].
            height: Image height [px].
            camera_height: Height above the ground [m].
        """
        focal = height / 2.0 / math.tan(math.radians(self.vfov_deg) / 2.0)
        pose = camera_pose(self.pitch_deg, self.roll_deg, camera_height)
        cx, cy = self.principal[0] * width, self.principal[1] * height
        return Camera(width, height, focal, focal, cx, cy, pose)


def camera_pose(pitch_deg: float, roll_deg: float, camera_height: float) -> Float64Array:
    """Return the pose of a camera at (0, camera_height, 0), turned toward -Z, shape [4, 4].

    Args:
        pitch_deg: Upward tilt [deg]; negative looks down.
        roll_deg: Turn about the camera's own +Z [deg]; positive lets the horizon fall to the right.
        camera_height: Height above the ground [m].
    """
    pitch, roll = math.radians(pitch_deg), math.radians(roll_deg)
    tilt = [[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)]]
    tilt.append([0, math.sin(pitch), math.cos(pitch)])
    turn = [[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]]
    return affine_matrix(np.array(tilt) @ np.array(turn), (0.0, camera_height, 0.0))


def camera_from_fov(
    width: int,
    height: int,
    fov_deg: float,
    pitch_deg: float,
    camera_height: float,
    horizon: float | None = None,
) -> Camera:
    """Return an upright camera at (0, camera_height, 0) that looks along -Z over the ground y = 0.

    Args:
        width: Image width [px].
        height: Image height [px].
        fov_deg: Horizontal field of view [deg].
        pitch_deg: Upward tilt [deg]; negative looks down. Not used when `horizon` is given.
        camera_height: Height over the ground [m].
        horizon: Where the horizon is: a share of the height when within (0, 1), else a row [px].

    Raises:
        InputError: No field of view (`ExitCode.USAGE`).
    """
    notices = []
    if not (np.isfinite(fov_deg) and 0.0 < fov_deg < 180.0):
        raise InputError(
            "--fov",
            f"not a field of view (found {fov_deg}; expected degrees between 0 and 180)",
            code=ExitCode.USAGE,
        )
    focal = float(width / 2.0 / np.tan(np.radians(fov_deg) / 2.0))
    if fov_deg < 3.2:
        notices.append(f"--fov: {fov_deg} degrees is very narrow; was it meant in radians?")
    return _level_camera(width, height, focal, pitch_deg, camera_height, horizon, notices)


def camera_from_exif(
    focal_35mm: float,
    width: int,
    height: int,
    pitch_deg: float,
    camera_height: float,
    horizon: float | None = None,
) -> Camera:
    """Return an upright camera from EXIF's 35 mm equivalent focal length [mm], by the diagonal."""
    fx = focal_35mm * float(np.hypot(width, height)) / FILM_DIAGONAL_35MM
    fov_deg = 2.0 * float(np.degrees(np.arctan(width / 2.0 / fx)))
    assumed = [
        f"field of view {fov_deg:.1f} degrees, from the EXIF focal length "
        f"{focal_35mm:g} mm (35 mm equivalent, by the diagonal); wrong if cropped"
    ]
    return _level_camera(width, height, fx, pitch_deg, camera_height, horizon, assumed=assumed)


def horizon_row(horizon: float, height: int) -> float:
    """Return the row of ``--horizon`` [px].

    Args:
        horizon: A share of the height when within (0, 1), else a row [px].
        height: Image height [px].
    """
    return horizon * height if 0.0 < horizon < 1.0 else horizon


def _level_camera(
    width: int,
    height: int,
    focal: float,
    pitch_deg: float,
    camera_height: float,
    horizon: float | None,
    notices: Sequence[str] = (),
    assumed: Sequence[str] = (),
) -> Camera:
    """Return a camera without roll whose principal point is the image centre."""
    cx, cy = width / 2.0, height / 2.0
    pitch = float(np.radians(pitch_deg))
    if horizon is not None:
        # A level direction straight ahead projects to row cy + f tan(pitch).
        pitch = float(np.arctan2(horizon_row(horizon, height) - cy, focal))
    cos, sin = np.cos(pitch), np.sin(pitch)
    c2w = np.array(
        [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, cos, -sin, camera_height],
            [0.0, sin, cos, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return Camera(width, height, focal, focal, cx, cy, c2w, tuple(notices), tuple(assumed))


def ground_point(
    camera: Camera, u: float, v: float, plane: Sequence[float] = (0.0, 1.0, 0.0, 0.0)
) -> Float64Array:
    """Return where the ray through pixel position (u, v) meets the ground, world [m], shape [3].

    Args:
        camera: The camera.
        u: Position to the right [px].
        v: Position down [px].
        plane: (a, b, c, d) of ``a x + b y + c z + d = 0``; any length of the normal.

    Raises:
        InputError: No plane, a camera in it, or a pixel at or beyond its horizon.
    """
    normal = np.asarray(plane[:3], dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if len(plane) != 4 or not np.isfinite(plane).all() or length < 1e-12:
        raise InputError(
            "--ground",
            f"not a plane (found {', '.join(map(str, plane))}; expected "
            "a,b,c,d with a normal that is not 0)",
            code=ExitCode.USAGE,
        )
    origin, direction = camera.ray(u, v)
    distance = float(normal @ origin + plane[3]) / length
    if abs(distance) < 1e-9:
        raise InputError("--ground", "the plane passes through the camera")
    approach = float(normal @ direction) / length
    if approach * distance >= -1e-9 * abs(distance):
        what = f"pixel ({u:g}, {v:g}) shows no ground: it lies at or above the horizon"
        advice = "choose a pixel lower in the image, or check the camera's pitch and field of view"
        if max(u, v) <= 1.0:
            advice = "give pixels of the photo, not shares of it"
        raise InputError("--at", what, advice)
    point: Float64Array = origin - direction * (distance / approach)
    return point
