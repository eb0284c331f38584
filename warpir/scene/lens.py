"""Lens distortion: the Brown-Conrady model in the terms of OpenCV.

A point at (x, y) of the image plane at depth 1, x right and y down, is seen at

    (x, y) (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8)
        + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y),    r^2 = x^2 + y^2

(OpenCV's ``calib3d`` without its rational terms; k4 is nerfstudio's).
"""

from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import Float64Array

NEGLIGIBLE = 1e-6
"""Largest coefficient of a lens that counts as undistorted [1]."""


@dataclass(frozen=True)
class Lens:
    """Distortion in normalised image coordinates, so the same at every resolution."""

    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Radial coefficients k1, k2, k3, k4 [1]."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """Tangential coefficients p1, p2 [1]."""

    @property
    def is_straight(self) -> bool:
        """Whether all coefficients are negligible."""
        return all(abs(k) <= NEGLIGIBLE for k in (*self.radial, *self.tangential))

    def reach(self) -> float:
        """Return the radius up to which the radial part grows; beyond it the image folds back."""
        factors = [float(2 * n + 1) * k for n, k in enumerate((1.0, *self.radial))]
        roots = np.roots(np.trim_zeros(factors[::-1], "f"))
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        return float(np.sqrt(real.min())) if len(real) else float("inf")

    def distort(self, x: Float64Array, y: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the distorted positions of points of the plane at depth 1; y is down."""
        k1, k2, k3, k4 = self.radial
        p1, p2 = self.tangential
        rr = x * x + y * y
        radial = 1.0 + rr * (k1 + rr * (k2 + rr * (k3 + rr * k4)))
        return (
            x * radial + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x),
            y * radial + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y,
        )

    def record(self) -> dict[str, list[float]]:
        """Return the lens's entry in ``run.json``."""
        return {"radial": list(self.radial), "tangential": list(self.tangential)}


STRAIGHT = Lens()
"""The lens of a pinhole camera."""
