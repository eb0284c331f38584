"""Small meshes, cameras and lights that tests share, and estimates of these from a photo."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from warpir.app.inputs import Inputs
from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.io.images.photos import Photo
from warpir.lighting.regression import Regression
from warpir.lighting.regressor import AMBIENT_SHARPNESS, ambient_axes, candidates
from warpir.render.device_scene import Placed, Receiver
from warpir.scene.asset import Asset, Material, Primitive, Texture
from warpir.scene.camera import Camera, CameraEstimate
from warpir.scene.light import Light, Lobes, axis_from_angles
from warpir.scene.placement import place_asset

DEEP = -1e3
"""Height of a ground plane that is in nobody's way [m]."""


def quad(
    center: ArrayLike, right: ArrayLike, up: ArrayLike, material: int = 0, uv: float = 1.0
) -> Primitive:
    """A parallelogram that faces ``cross(right, up)``; texture row 0 lies along its upper edge.

    Args:
        center: Its middle [m].
        right: From the middle to the edge where ``u = uv`` [m].
        up: From the middle to the edge where ``v = 0`` [m].
        material: Index of its material.
        uv: Texture coordinates run from 0 to this.
    """
    c, r, u = (np.asarray(v, np.float64) for v in (center, right, up))
    corners = np.array([c - r - u, c + r - u, c + r + u, c - r + u])
    coordinates = np.array([[0, uv], [uv, uv], [uv, 0], [0, 0]], np.float32)
    return Primitive(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), material, uv0=coordinates)


def sphere(
    center: ArrayLike = (0.0, 0.0, 0.0), radius: float = 1.0, detail: int = 4, material: int = 0
) -> Primitive:
    """A sphere with its true normals; ``detail`` halves the triangles' edges each time."""
    ball = trimesh.creation.icosphere(subdivisions=detail, radius=radius)
    unit = np.asarray(ball.vertices, np.float64) / radius
    return Primitive(
        unit * radius + np.asarray(center, np.float64),
        np.array(ball.faces, np.int32),
        material,
        normals=unit.astype(np.float32),
    )


def box(center: ArrayLike, extents: ArrayLike, material: int = 0) -> Primitive:
    """A closed box with flat faces."""
    mesh = trimesh.creation.box(extents=extents)
    return Primitive(
        np.array(mesh.vertices) + np.asarray(center, np.float64),
        np.array(mesh.faces, np.int32),
        material,
    )


def placed(
    primitives: Primitive | Sequence[Primitive],
    *materials: Material,
    textures: Sequence[Texture] = (),
    matrix: ArrayLike | None = None,
) -> Placed:
    """An asset where its coordinates say, or moved by ``matrix``."""
    parts = (primitives,) if isinstance(primitives, Primitive) else tuple(primitives)
    whole = Asset("test", parts, materials or (Material(),), tuple(textures))
    return Placed(whole, np.eye(4) if matrix is None else np.asarray(matrix, np.float64))


def ground(height: float = DEEP) -> Receiver:
    """A level ground plane."""
    return Receiver(np.array([0.0, 1.0, 0.0]), height)


def camera(
    width: int, height: int, focal: float, eye: ArrayLike = (0.0, 0.0, 0.0), pitch: float = 0.0
) -> Camera:
    """A camera that looks along -Z, or up by ``pitch`` [deg]; the principal point is central."""
    a = np.radians(pitch)
    pose = np.eye(4)
    pose[1:3, 1:3] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    pose[:3, 3] = eye
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose)


def all_pixels(view: Camera) -> IntArray:
    """Every pixel of a view, row-major."""
    return np.arange(view.width * view.height, dtype=np.int32)


def view_rays(view: Camera, side: int = 1) -> Float64Array:
    """Unit view rays through ``side x side`` places of each pixel, world, [pixel, side^2, 3]."""
    inner = (np.arange(side) + 0.5) / side
    rows, columns = np.arange(view.height), np.arange(view.width)
    v, u, b, a = np.meshgrid(rows, columns, inner, inner, indexing="ij")
    x, y = (u + a - view.cx) / view.fx, (view.cy - v - b) / view.fy
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1) @ view.c2w[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays.reshape(-1, side * side, 3)


def seen_ground(view: Camera, side: int = 1) -> Float64Array:
    """Where these rays meet the ground y = 0 [m], NaN in the sky, shape [pixel, side^2, 3]."""
    rays, eye = view_rays(view, side), view.c2w[:3, 3]
    down = np.where(rays[..., 1:2] < 0.0, rays[..., 1:2], np.nan)
    return eye - rays * (eye[1] / down)


def constant(radiance: ArrayLike = (1.0, 1.0, 1.0), height: int = 8) -> Light:
    """The same radiance from everywhere, as a map."""
    return Light(texels=np.full((height, 2 * height, 3), radiance, np.float32))


def lobe(axis: ArrayLike, sharpness: float, amplitude: ArrayLike = (1.0, 1.0, 1.0)) -> Light:
    """One spherical Gaussian; the axis need not be a unit vector."""
    a = np.asarray(axis, np.float64)
    return Light(
        Lobes(
            np.asarray([amplitude], np.float32),
            (a / np.linalg.norm(a))[None].astype(np.float32),
            np.array([sharpness], np.float32),
        )
    )


def even_ambient(radiance: float) -> Lobes:
    """The regressor's lobes of all other light, equal and white."""
    axes = ambient_axes().astype(np.float32)
    sharpness = np.full(len(axes), AMBIENT_SHARPNESS, np.float32)
    return Lobes(np.full((len(axes), 3), radiance, np.float32), axes, sharpness)


def a_regression(**changes: Any) -> Regression:
    """A sun of which no direction is likelier than another, and no other light."""
    directions = candidates(300)
    plain: dict[str, Any] = {
        "axis": axis_from_angles(20.0, 50.0),
        "spread_deg": 10.0,
        "concentration": 20.0,
        "directions": directions,
        "probability": np.full(len(directions), 1.0 / len(directions)),
        "sun": np.array([3.0, 2.5, 1.5]),
        "sun_log_std": 0.3,
        "sigma": 0.05,
        "share": 0.6,
        "ambient": even_ambient(0.0),
        "ambient_log_std": 0.2,
    }
    return Regression(**plain | changes)


def a_camera(**changes: Any) -> CameraEstimate:
    """A level camera of 50 degrees, as unsure in every number."""
    plain: dict[str, Any] = {
        "pitch_deg": 0.0,
        "roll_deg": 0.0,
        "vfov_deg": 50.0,
        "principal": (0.5, 0.5),
        "pitch_sigma_deg": 1.0,
        "roll_sigma_deg": 1.0,
        "vfov_sigma_deg": 1.0,
        "principal_sigma": (0.1, 0.1),
        "witnesses": (),
    }
    return CameraEstimate(**plain | changes)


def box_before(
    view: Camera, srgb: FloatArray, codes: np.ndarray, light: Light | None = None
) -> Inputs:
    """A photo of level ground, and a box of a metre that stands on it, five metres ahead."""
    asset = Asset("box", (box((0.0, 0.5, 0.0), (1.0, 1.0, 1.0)),), (Material(),))
    placement = place_asset(*asset.bounds(), view, place=(0.0, 0.0, -5.0))
    return Inputs(Photo(codes, srgb, "png"), asset, view, placement, light)
