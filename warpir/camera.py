"""Pinhole camera: intrinsics, pose, and the projection both ways.

World right-handed, +Y up, metres; the camera looks along its own -Z with +Y up and +X right.
Pixel (column j, row i) has its centre at (j + 0.5, i + 0.5), origin top left, y down.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]


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

    def scaled(self, width: int, height: int) -> "Camera":
        """Return the same view at another resolution."""
        sx, sy = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy,
                       cx=self.cx * sx, cy=self.cy * sy)

    def project(self, points: Float64Array) -> Float64Array:
        """Project world points [m], shape [point, 3], to pixels, shape [point, 2].

        Points behind the camera give NaN.
        """
        w2c = np.linalg.inv(self.c2w)
        local = points @ w2c[:3, :3].T + w2c[:3, 3]
        depth = np.where(local[:, 2] < 0.0, -local[:, 2], np.nan)
        return np.stack([self.cx + self.fx * local[:, 0] / depth,
                         self.cy - self.fy * local[:, 1] / depth], axis=1)

    def ray(self, u: float, v: float) -> tuple[Float64Array, Float64Array]:
        """Return origin [m] and unit direction, world frame, through pixel position (u, v)."""
        local = np.array([(u - self.cx) / self.fx, -(v - self.cy) / self.fy, -1.0])
        direction = self.c2w[:3, :3] @ local
        return self.c2w[:3, 3].copy(), direction / np.linalg.norm(direction)
