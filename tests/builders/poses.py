"""Rotations, cameras at random, and points that they see."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Turn about +Z by the roll, then about +X by the pitch, then about +Y by the yaw [rad]."""
    return Rotation.from_euler("YXZ", [yaw, pitch, roll]).as_matrix()


def pose(rng: np.random.Generator, tilt: float = 0.3) -> np.ndarray:
    """A random camera whose up axis stays close to +Y."""
    c2w = np.eye(4)
    c2w[:3, :3] = rotation(rng.uniform(-3, 3), rng.uniform(-tilt, tilt), rng.uniform(-0.1, 0.1))
    c2w[:3, 3] = rng.normal(size=3)
    return c2w


def points_in_view(c2w: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Eight world points in front of the camera, shape [8, 3]."""
    depth = rng.uniform(2.0, 20.0, (8, 1))
    local = np.hstack([rng.uniform(-0.5, 0.5, (8, 2)) * depth, -depth])
    return local @ c2w[:3, :3].T + c2w[:3, 3]


def write_json(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path
