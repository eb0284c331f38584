"""Pictures of another size."""

import numpy as np
from PIL import Image

from warpir.core.arrays import AnyFloatArray, FloatArray, on_cores


def resize(picture: AnyFloatArray, height: int, width: int) -> FloatArray:
    """Return a picture, shape [H, W] or [H, W, C], in another size [px].

    Bilinear, over as many pixels as each new one covers; what is not finite counts as 0.
    """
    finite = np.where(np.isfinite(picture), picture, 0.0).astype(np.float32)

    def each(plane: FloatArray) -> FloatArray:
        whole = Image.fromarray(np.ascontiguousarray(plane))
        return np.asarray(whole.resize((width, height), Image.Resampling.BILINEAR))

    if picture.ndim == 2:
        return each(finite).copy()  # what Pillow gives is read-only
    return np.stack(on_cores(each, np.moveaxis(finite, 2, 0)), axis=2)
