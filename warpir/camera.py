"""Pinhole camera: intrinsics, pose, the projection both ways, and where cameras come from.

World right-handed, +Y up, metres; the camera looks along its own -Z with +Y up and +X right.
Pixel (column j, row i) has its centre at (j + 0.5, i + 0.5), origin top left, y down.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.errors import ExitCode, InputError
from warpir.strict_json import JSON_BYTES_MAX, parse_json_object, read_json_object

Float64Array = NDArray[np.float64]

FILM_DIAGONAL_35MM = 43.267
"""Diagonal of the 36 x 24 mm frame that EXIF's equivalent focal length refers to [mm]."""

RIGID_TOLERANCE = 1e-4
"""How far R^T R may be from the identity; smaller errors are removed."""

_UP_TO_Y = {
    "+x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "+y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "+z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
}
"""Rotations that turn a world whose up axis is the key into ours."""


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
    """What was assumed or looks odd, one line each; printed and kept in ``run.json``."""

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

    def ray(self, u: float, v: float) -> tuple[Float64Array, Float64Array]:
        """Return origin [m] and unit direction, world frame, through pixel position (u, v)."""
        local = np.array([(u - self.cx) / self.fx, -(v - self.cy) / self.fy, -1.0])
        direction = self.c2w[:3, :3] @ local
        return self.c2w[:3, 3].copy(), direction / np.linalg.norm(direction)

    def record(self) -> dict[str, Any]:
        """Return the content of ``camera.json``, which `read_camera` takes back."""
        return {
            "w": self.width,
            "h": self.height,
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            "c2w": self.c2w.tolist(),
        }


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
    turn = np.eye(4)
    turn[:3, :3] = np.transpose(_UP_TO_Y["+z"])
    return {
        "matrix_world": turn @ camera.c2w,
        "angle": float(2.0 * np.arctan(longer / 2.0 / camera.fx)),
        "shift_x": (camera.width / 2.0 - camera.cx) / longer,
        "shift_y": (camera.cy - camera.height / 2.0) / longer,
    }


def square_pixel_error(camera: Camera) -> float:
    """Return how far rows are off where fx has to stand for fy too, at the worst pixel [px]."""
    farthest = max(abs(camera.cy), abs(camera.height - camera.cy))
    return float(abs(camera.fx / camera.fy - 1.0) * farthest)


# ----------------------------------------------------------------------- cameras from few numbers


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
        InputError: A number outside its range; the text names the flag.
    """
    notices = []
    if not (np.isfinite(fov_deg) and 0.0 < fov_deg < 180.0):
        raise InputError(
            "--fov",
            f"not a field of view (found {fov_deg}; expected degrees between 0 and 180)",
            code=ExitCode.USAGE,
        )
    if fov_deg < 3.2:
        notices.append(f"--fov: {fov_deg} degrees is very narrow; was it meant in radians?")
    fx = width / 2.0 / np.tan(np.radians(fov_deg) / 2.0)
    return _level_camera(width, height, float(fx), pitch_deg, camera_height, horizon, notices)


def camera_from_exif(
    focal_35mm: float,
    width: int,
    height: int,
    pitch_deg: float,
    camera_height: float,
    horizon: float | None = None,
) -> Camera:
    """As `camera_from_fov`, from EXIF's 35 mm equivalent focal length [mm], by the diagonal."""
    if not (np.isfinite(focal_35mm) and focal_35mm > 0.0):
        raise InputError(
            "--photo",
            f"EXIF focal length is not one (found {focal_35mm}; expected millimetres > 0)",
            "give --fov",
        )
    fx = focal_35mm * float(np.hypot(width, height)) / FILM_DIAGONAL_35MM
    fov_deg = 2.0 * float(np.degrees(np.arctan(width / 2.0 / fx)))
    notices = [
        f"assumed: field of view {fov_deg:.1f} degrees, from the EXIF focal length "
        f"{focal_35mm:g} mm (35 mm equivalent, by the diagonal); wrong if cropped"
    ]
    return _level_camera(width, height, fx, pitch_deg, camera_height, horizon, notices)


def _level_camera(
    width: int,
    height: int,
    focal: float,
    pitch_deg: float,
    camera_height: float,
    horizon: float | None,
    notices: list[str],
) -> Camera:
    """Return a camera without roll whose principal point is the image centre."""
    if width < 1 or height < 1:
        raise InputError("--photo", f"no pixels (found {width} x {height})")
    if not (np.isfinite(camera_height) and camera_height > 0.0):
        raise InputError(
            "--camera-height",
            f"not above the ground (found {camera_height}; expected metres > 0)",
            code=ExitCode.USAGE,
        )
    cx, cy = width / 2.0, height / 2.0
    if horizon is None:
        if not (np.isfinite(pitch_deg) and -90.0 <= pitch_deg <= 90.0):
            raise InputError(
                "--pitch",
                f"not a tilt (found {pitch_deg}; expected degrees between -90 and 90)",
                code=ExitCode.USAGE,
            )
        pitch = float(np.radians(pitch_deg))
    else:
        if not np.isfinite(horizon):
            raise InputError("--horizon", f"not a row (found {horizon})", code=ExitCode.USAGE)
        row = horizon * height if 0.0 < horizon < 1.0 else horizon
        # A level direction straight ahead projects to row cy + f tan(pitch).
        pitch = float(np.arctan2(row - cy, focal))
    cos, sin = np.cos(pitch), np.sin(pitch)
    c2w = np.array(
        [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, cos, -sin, camera_height],
            [0.0, sin, cos, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return Camera(width, height, focal, focal, cx, cy, c2w, tuple(notices))


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
        raise InputError(
            "--at",
            f"pixel ({u:g}, {v:g}) shows no ground: it lies at or above the horizon",
            "choose a pixel lower in the image, or check the camera's pitch and field of view",
        )
    point: Float64Array = origin - direction * (distance / approach)
    return point


# ------------------------------------------------------------------------------ camera files


def read_camera(path: str | Path, photo_size: tuple[int, int], up: str | None = None) -> Camera:
    """Read a camera: our ``camera.json``, an fSpy project (``.fspy``) or fSpy's JSON export.

    Args:
        path: The file; recognised by content.
        photo_size: Width and height of the upright photograph [px]. A camera made for another
            size of the same aspect is scaled.
        up: World axis of the file that points up: ``x``, ``y``, ``z``, with a sign if wanted.
            Default: +Y for our own files, for fSpy the axis closest to the camera's up.

    Raises:
        InputError: Missing, malformed, not a rigid right-handed pose, or of another aspect.
    """
    path = Path(path)
    axis = None if up is None else _up_axis(up)
    content, from_fspy = _camera_content(path)
    if from_fspy:
        camera = _read_fspy(path, content, axis)
    elif "fx" in content or "c2w" in content:
        camera = _read_own(path, content, axis)
    else:
        raise InputError(
            path,
            f"not a camera that warpir reads (found keys "
            f"{', '.join(list(content)[:8]) or 'none'}; expected fx fy cx cy w h c2w, "
            "or an fSpy file)",
        )
    return _fit(path, camera, photo_size)


def _up_axis(up: str) -> str:
    axis = up.strip().lower()
    axis = axis if axis[:1] in ("+", "-") else f"+{axis}"
    if axis not in _UP_TO_Y:
        raise InputError(
            "--up", f"not an axis (found {up}; expected x, y, z, -x, -y or -z)", code=ExitCode.USAGE
        )
    return axis


def _camera_content(path: Path) -> tuple[dict[str, Any], bool]:
    """Return the JSON of a camera file, and whether it is fSpy's."""
    is_project = False
    if path.is_file():
        try:
            with path.open("rb") as stream:
                is_project = stream.read(4) == b"fspy"
        except OSError as error:
            raise InputError(path, f"cannot be read ({error.strerror})") from error
    if is_project:
        return _fspy_project(path), True
    content = read_json_object(path)
    return content, "cameraTransform" in content or "cameraParameters" in content


def _fspy_project(path: Path) -> dict[str, Any]:
    """Return the state of a binary fSpy project: magic, three u32, JSON, image."""
    with path.open("rb") as stream:
        header = stream.read(16)
        if len(header) < 16:
            raise InputError(
                path, f"truncated fSpy project (found {len(header)} bytes; expected a header of 16)"
            )
        version, state_size, image_size = struct.unpack("<3I", header[4:])
        if version != 1:
            raise InputError(path, f"fSpy project of another version (found {version}; expected 1)")
        if state_size > JSON_BYTES_MAX:
            raise InputError(
                path,
                f"fSpy state too large (found {state_size} bytes; expected at "
                f"most {JSON_BYTES_MAX})",
            )
        state = stream.read(state_size)
    found = path.stat().st_size
    if len(state) < state_size or found < 16 + state_size + image_size:
        raise InputError(
            path,
            f"truncated fSpy project (found {found} bytes; expected "
            f"{16 + state_size + image_size})",
        )
    return parse_json_object(path, state)


def _read_fspy(path: Path, content: dict[str, Any], axis: str | None) -> Camera:
    """Read fSpy's camera parameters; its camera axes are ours, its world may stand otherwise."""
    parameters = content.get("cameraParameters", content)
    if parameters is None:
        raise InputError(
            path,
            "fSpy found no camera in this project (cameraParameters is null)",
            "place the vanishing lines in fSpy until it shows a camera, save again",
        )
    width = _count(path, parameters, "imageWidth")
    height = _count(path, parameters, "imageHeight")
    centre = _member(path, parameters, "principalPoint")
    px, py = _number(path, centre, "x"), _number(path, centre, "y")
    angle = _number(path, parameters, "horizontalFieldOfView")
    if not 0.0 < angle < np.pi:
        raise InputError(
            path,
            f"not a field of view (found horizontalFieldOfView {angle}; "
            "expected radians between 0 and pi)",
        )
    # fSpy's "horizontal" angle spans the longer side; its principal point has y up.
    focal = max(width, height) / 2.0 / float(np.tan(angle / 2.0))
    aspect = width / height
    if aspect > 1.0:
        cx, cy = width / 2.0 * (px + 1.0), height / 2.0 * (1.0 - py * aspect)
    else:
        cx, cy = width / 2.0 * (px / aspect + 1.0), height / 2.0 * (1.0 - py)
    c2w = _rigid(path, "cameraTransform", _member(path, parameters, "cameraTransform").get("rows"))
    notices = []
    if axis is None:
        camera_up = c2w[:3, 1]
        k = int(np.argmax(np.abs(camera_up)))
        axis = f"{'+' if camera_up[k] > 0.0 else '-'}{'xyz'[k]}"
        notices.append(f"assumed: {axis} of the fSpy world points up; --up overrides")
    return Camera(width, height, focal, focal, cx, cy, _turned_up(c2w, axis), tuple(notices))


def _read_own(path: Path, content: dict[str, Any], axis: str | None) -> Camera:
    """Read our own ``camera.json``."""
    focal = {key: _number(path, content, key) for key in ("fx", "fy")}
    for key, value in focal.items():
        if value <= 0.0:
            raise InputError(path, f"/{key}: not a focal length (found {value}; expected > 0)")
    c2w = _rigid(path, "c2w", content.get("c2w"))
    return Camera(
        _count(path, content, "w"),
        _count(path, content, "h"),
        focal["fx"],
        focal["fy"],
        _number(path, content, "cx"),
        _number(path, content, "cy"),
        _turned_up(c2w, axis or "+y"),
    )


def _turned_up(c2w: Float64Array, axis: str) -> Float64Array:
    """Turn the world so that `axis` becomes +Y."""
    turn = np.eye(4)
    turn[:3, :3] = _UP_TO_Y[axis]
    turned: Float64Array = turn @ c2w
    return turned


def _fit(path: Path, camera: Camera, photo_size: tuple[int, int]) -> Camera:
    """Scale to the photograph's size; note what looks odd."""
    width, height = photo_size
    # The other side may have been rounded to a whole pixel, once in each size.
    slack = max(width / camera.width, height / camera.height, 1.0)
    if (
        abs(camera.width * height / camera.height - width) > slack
        and abs(camera.height * width / camera.width - height) > slack
    ):
        raise InputError(
            path,
            f"made for a picture of another shape (found {camera.width} x "
            f"{camera.height}; expected the aspect of {width} x {height})",
            "use the camera of this photograph, before cropping or turning it",
        )
    notices = list(camera.notices)
    if (camera.width, camera.height) != photo_size:
        notices.append(
            f"camera scaled from {camera.width} x {camera.height} to the photograph's "
            f"{width} x {height}"
        )
    if not (0.0 <= camera.cx <= camera.width and 0.0 <= camera.cy <= camera.height):
        notices.append(f"principal point ({camera.cx:.1f}, {camera.cy:.1f}) lies outside the image")
    return replace(camera.scaled(width, height), notices=tuple(notices))


def _rigid(path: Path, name: str, rows: Any) -> Float64Array:
    """Check a camera-to-world matrix given as 3 or 4 rows; return it exactly rigid, [4, 4]."""
    try:
        matrix = np.array(rows)
        if matrix.dtype.kind not in "if":
            raise ValueError
        matrix = matrix.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(path, f"/{name}: not a matrix of numbers") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise InputError(
            path, f"/{name}: not a matrix (found shape {matrix.shape}; expected 4 x 4 or 3 x 4)"
        )
    if not np.isfinite(matrix).all():
        raise InputError(path, f"/{name}: numbers that are not finite")
    last = np.array([0.0, 0.0, 0.0, 1.0])
    if np.abs(matrix[3] - last).max() > RIGID_TOLERANCE:
        if np.abs(matrix[:, 3] - last).max() <= RIGID_TOLERANCE:
            raise InputError(
                path,
                f"/{name}: transposed (found the translation in the last row; "
                "expected it in the last column)",
                "transpose the matrix",
            )
        raise InputError(
            path,
            f"/{name}: last row is not 0 0 0 1 (found {' '.join(f'{x:g}' for x in matrix[3])})",
        )
    rotation = matrix[:3, :3]
    product = rotation.T @ rotation
    scale = float(np.trace(product)) / 3.0
    deviation = float(np.abs(product - np.eye(3)).max())
    if deviation > RIGID_TOLERANCE:
        if scale > 0.0 and np.abs(product / scale - np.eye(3)).max() <= RIGID_TOLERANCE:
            raise InputError(
                path,
                f"/{name}: scaled (found a factor of {np.sqrt(scale):.6g}; expected 1)",
                "remove the scale from the camera",
            )
        raise InputError(
            path,
            f"/{name}: not orthonormal (found axes off by {deviation:.3g}; "
            f"expected at most {RIGID_TOLERANCE})",
        )
    if np.linalg.det(rotation) < 0.0:
        raise InputError(
            path,
            f"/{name}: left-handed (found determinant -1; expected +1)",
            "export it with right-handed axes: camera along -Z, +Y up, +X right",
        )
    left, _, right = np.linalg.svd(rotation)
    rigid = np.eye(4)
    rigid[:3, :3] = left @ right
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def _member(path: Path, content: Any, key: str) -> dict[str, Any]:
    value = content.get(key) if isinstance(content, dict) else None
    if not isinstance(value, dict):
        raise InputError(path, f"/{key}: missing or not an object")
    return value


def _number(path: Path, content: Any, key: str) -> float:
    value = content.get(key) if isinstance(content, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e15:
        raise InputError(path, f"/{key}: not a number that can be used (found {str(value)[:40]})")
    return float(value)


def _count(path: Path, content: Any, key: str) -> int:
    value = _number(path, content, key)
    if value != int(value) or not 1 <= value <= 1_000_000:
        raise InputError(
            path, f"/{key}: not an image size (found {value:g}; expected whole pixels)"
        )
    return int(value)
