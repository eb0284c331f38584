"""Brings what was rendered at another size to the photo's."""

import numpy as np

from warpir.core.arrays import FloatArray
from warpir.io.images.resize import resize

SLIVER = 1e-4
"""Share of a pixel below which its surface layers are left empty [1]."""


def resize_planes(planes: dict[str, FloatArray], height: int, width: int) -> dict[str, FloatArray]:
    """Bring all planes to the photo's size.

    What describes the object's surface is averaged over the object alone: mixed with the empty
    background, its depth would fall to 0 along the outline.
    """
    seen = np.isfinite(planes["depth"])
    share = resize(seen.astype(np.float32), height, width)
    resized = {name: resize(plane, height, width) for name, plane in planes.items()}
    shown = (share > SLIVER) & (resized["matte"] > 0.0)
    weight = np.where(shown, share, 1.0)
    for name in ("depth", "position", "normal", "albedo", "roughness"):
        plane = resized[name]
        plane /= weight if plane.ndim == 2 else weight[..., None]
        plane[~shown] = np.inf if name == "depth" else 0.0
    length = np.linalg.norm(resized["normal"], axis=-1, keepdims=True)
    resized["normal"] /= np.where(length > 0.0, length, 1.0)
    return resized
