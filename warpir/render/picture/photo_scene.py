"""The scene of a run: the object, and the photo as what its receiver shows."""

from __future__ import annotations

from warpir.app.inputs import Inputs
from warpir.core.arrays import FloatArray, by_pixel
from warpir.io.images.photos import Photo
from warpir.io.images.resize import resize
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.scene.camera import Camera
from warpir.scene.tone_curves import Curves

RECEIVER_WIDTH = 1024
"""Largest width of the photo as a radiance texture of the receiver [px]."""
BEHIND_GLASS_WIDTH = 2048
"""The same where glass shows it [px]."""


def scene_of(inputs: Inputs, camera: Camera, device: str, curves: Curves) -> Scene:
    """Put the object onto its plane or onto the mesh that --proxy gave.

    Args:
        inputs: Photo, asset, receiver and placement.
        camera: At the resolution that is to be rendered.
        device: Warp device.
        curves: Tone curves of the picture, which the photo of the receiver is taken to have passed.
    """
    ground = inputs.placement.ground
    placed = Placed(inputs.asset, inputs.placement.asset_to_world)
    radiance = None
    if any(m.is_solid_glass for m in inputs.asset.materials):
        radiance = photo_radiance(inputs.photo, curves, BEHIND_GLASS_WIDTH)
    elif inputs.proxy is not None:
        radiance = photo_radiance(inputs.photo, curves)
    receiver = Receiver(ground[:3], -float(ground[3]), inputs.proxy, radiance, inputs.is_plane)
    return Scene([placed], camera, receiver, device, inputs.lamps)


def photo_radiance(photo: Photo, curves: Curves, width_max: int = RECEIVER_WIDTH) -> FloatArray:
    """Return the radiance that the picture's curves and operator would show as the photo.

    Args:
        photo: The photograph.
        curves: Tone curves of the picture.
        width_max: Largest width of the result [px].

    Returns:
        Relative [W/(m^2 sr)], shape [height, width, 3].
    """
    linear = photo.linear()
    height, width = linear.shape[:2]
    if width > width_max:
        linear = resize(linear, max(1, round(height * width_max / width)), width_max)
    return by_pixel(curves.radiance, linear)
