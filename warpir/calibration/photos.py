"""Asks for the cameras of photos, one after another; the network is read with the first."""

from __future__ import annotations

from warpir.core.arrays import FloatArray
from warpir.scene.camera import CameraEstimate


def estimate_photo(photo: FloatArray, vfov_deg: float | None) -> CameraEstimate:
    """Estimate the camera of a photo: `warpir.calibration.estimate.estimate_camera`."""
    from warpir.calibration.estimate import estimate_camera

    return estimate_camera(photo, vfov_deg=vfov_deg)


class FirstPhoto:
    """Estimates one camera for all photos of a sequence that have one size and field of view.

    A sequence whose camera moves has camera files; of one that stands still, estimates of single
    frames would let the object tremble.
    """

    def __init__(self) -> None:
        self._found: dict[tuple[int, int, float | None], CameraEstimate] = {}

    def __call__(self, photo: FloatArray, vfov_deg: float | None) -> CameraEstimate:
        """Return the estimate of the first such photo; arguments as of `estimate_photo`."""
        key = (*photo.shape[:2], vfov_deg)
        if key not in self._found:
            self._found[key] = estimate_photo(photo, vfov_deg)
        return self._found[key]
