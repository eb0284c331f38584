"""Cameras at random, and points that they see."""

import json
from pathlib import Path
from typing import Any

import numpy as np


def pose(rng: np.random.Generator, tilt: float = 0.3) -> np.ndarray:
    """A random camera whose up axis stays close to +Y."""
    yaw, pitch, roll = rng.uniform(-3, 3), rng.uniform(-tilt, tilt), rng.uniform(-0.1, 0.1)
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    about_z = np.array(
        [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
    )
    c2w = np.eye(4)
    c2w[:3, :3] = about_y @ about_x @ about_z
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
