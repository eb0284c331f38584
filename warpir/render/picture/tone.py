"""Tone mapping of what a renderer has traced."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpir.core.arrays import FloatArray
from warpir.kernels.composite import tone_foreground, tone_shadow
from warpir.render.device import Rows
from warpir.render.renderer import Foreground, Renderer
from warpir.scene.tone_curves import Curves


def tone_mapped(
    renderer: Renderer,
    foreground: Foreground,
    ratio: FloatArray,
    curves: Curves,
) -> tuple[FloatArray, FloatArray]:
    """Map object radiance and shadow ratio to display-linear values.

    Args:
        renderer: Launches the kernels.
        foreground: Radiance of the object, premultiplied.
        ratio: Shadow ratio, shape [receiver_pixel, 3].
        curves: Tone curves and operator.

    Returns:
        The object, not premultiplied [1], shape [object_pixel, 3], above 1 where its curves do not
        clip; and what the plate is multiplied by [1], shape [receiver_pixel, 3].
    """
    objects, receivers = len(foreground.mask), len(ratio)
    fg = renderer.zeros(objects, wp.vec3)
    shadow = renderer.zeros(receivers, wp.vec3)
    renderer.launch(
        tone_foreground,
        objects,
        [
            Rows(renderer.upload(foreground.radiance, wp.vec3)),
            Rows(renderer.upload(foreground.mask, wp.float32)),
            int(curves.tone == "reinhard"),
            *(renderer.upload(k, wp.float32) for k in curves.foreground.arrays()),
            curves.foreground.bin_count,
            Rows(fg),
        ],
        1,
    )
    renderer.launch(
        tone_shadow,
        receivers,
        [
            Rows(renderer.upload(ratio, wp.vec3)),
            *(renderer.upload(k, wp.float32) for k in curves.shadow_ratio.arrays()),
            curves.shadow_ratio.bin_count,
            Rows(shadow),
        ],
        1,
    )
    shown = fg.numpy()[:objects]
    if not curves.is_clipped and curves.tone == "linear":
        share = np.where(foreground.mask > 0.0, foreground.mask, np.inf)
        radiance = foreground.radiance / share[:, None]
        shown = np.where(radiance > 1.0, radiance, shown)
    return shown, shadow.numpy()[:receivers]
