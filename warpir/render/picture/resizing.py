"""Brings what was rendered at another size to the photo's."""

import numpy as np

from warpir.core.arrays import FloatArray
from warpir.io.images.resize import resize
from warpir.look.sharpness import GROUND

SLIVER = 1e-4
"""Share of a pixel below which its surface layers are left empty [1]."""
LEAST_GROUND = 1e-3
"""Share of ground in a pixel below which the planes of `GROUND` end [1]."""


def resize_planes(planes: dict[str, FloatArray], height: int, width: int) -> dict[str, FloatArray]:
    """Bring all planes to the photo's size.

    What describes the object's surface is averaged over the object alone: mixed with the empty
    background, its depth would fall to 0 along the outline. What describes the ground is averaged
    over the ground that is seen: no light leaks into the shadow at the object's contact.
    """
    ground = 1.0 - planes["matte"]
    ground_share = np.maximum(resize(ground, height, width), LEAST_GROUND)[..., None]
    seen = np.isfinite(planes["depth"])
    share = resize(seen.astype(np.float32), height, width)
    resized = {}
    for name, plane in planes.items():
        if name in GROUND:
            # In differences, so that ground beyond shadow and image stays as it is.
            change = resize((plane - GROUND[name]) * ground[..., None], height, width)
            change /= ground_share
            change += GROUND[name]
            resized[name] = change
        else:
            resized[name] = resize(plane, height, width)
    shown = (share > SLIVER) & (resized["matte"] > 0.0)
    weight = np.where(shown, share, 1.0)
    for name in ("depth", "position", "normal", "albedo", "roughness"):
        plane = resized[name]
        plane /= weight if plane.ndim == 2 else weight[..., None]
        plane[~shown] = np.inf if name == "depth" else 0.0
    length = np.linalg.norm(resized["normal"], axis=-1, keepdims=True)
    resized["normal"] /= np.where(length > 0.0, length, 1.0)
    return resized
