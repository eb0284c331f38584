"""Pose of a camera over the ground, in the numbers that the page edits.

The ground frame is right-handed and metric; the ground is its plane y = 0. The pose is
``translate(x, height, z) turn_y(heading) turn_x(pitch) turn_z(roll)``, which every pose is.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np

from warpir.core.arrays import Float64Array, affine_matrix
from warpir.scene.placement import turn, y_to

X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Stance:
    """A camera's pose in the ground frame."""

    x: float
    """Position along x [m]."""
    height: float
    """Height above the ground [m]."""
    z: float
    """Position along z [m]."""
    heading: float
    """Viewing direction, counter-clockwise from above, 0 along -Z [deg]."""
    pitch: float
    """Upward tilt [deg]."""
    roll: float
    """Counter-clockwise turn about its own axis, as the photographer sees it: the horizon falls to
    the right where it is positive [deg]."""

    def c2w(self) -> Float64Array:
        """Return the pose, camera to ground frame, shape [4, 4]."""
        heading, pitch, roll = (math.radians(a) for a in (self.heading, self.pitch, self.roll))
        rotation = turn(Y, heading) @ turn(X, pitch) @ turn(Z, roll)
        return affine_matrix(rotation, (self.x, self.height, self.z))

    def record(self) -> dict[str, float]:
        """Return the numbers by their names."""
        return asdict(self)


def stance_of(c2w: Float64Array) -> Stance:
    """Return the stance of a rigid pose in the ground frame, shape [4, 4].

    Straight up or down, where heading and roll are one turn, there is no roll.
    """
    r = c2w[:3, :3]
    sine = float(np.clip(-r[1, 2], -1.0, 1.0))
    if abs(sine) < 1.0 - 1e-9:
        heading, roll = math.atan2(r[0, 2], r[2, 2]), math.atan2(r[1, 0], r[1, 1])
    else:
        heading, roll = math.atan2(-r[2, 0], r[0, 0]), 0.0
    x, y, z = (float(c) for c in c2w[:3, 3])
    pitch = math.degrees(math.asin(sine))
    return Stance(x, y, z, math.degrees(heading), pitch, math.degrees(roll))


def ground_to_world(plane: Float64Array) -> Float64Array:
    """Return the pose of the ground frame in the world, shape [4, 4]; of y = 0 the identity.

    Args:
        plane: (a, b, c, d) with a unit normal toward the camera (`upright_plane`), shape [4].
    """
    return affine_matrix(y_to(plane[:3]), -plane[3] * plane[:3])
