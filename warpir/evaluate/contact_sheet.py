"""One picture of many scenes: photo, ours, truth and their difference, the worst first."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from warpir.core.arrays import CodeArray, FloatArray

DIFFERENCE_GAIN = 4.0
"""Factor on the difference, round mid grey."""
LINE = 14
"""Height of a line of words [px]."""
COLUMNS = ("photo", "{row}", "truth", "{row} - truth, x 4")


@dataclass(frozen=True)
class Panel:
    """One scene of the sheet, 8-bit codes, shape [H, W, 3] each."""

    name: str
    error: float
    """What the scenes are sorted by."""
    photo: CodeArray
    image: CodeArray
    truth: CodeArray


def to_codes(picture: FloatArray) -> CodeArray:
    """Return a display-encoded picture as 8-bit codes."""
    codes: CodeArray = np.round(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)
    return codes


def contact_sheet(panels: Sequence[Panel], row: str, count: int = 40) -> CodeArray:
    """Return the sheet, worst scenes first.

    Args:
        panels: All of one size.
        row: Whose pictures they are.
        count: Most scenes that are shown.
    """
    strips = []
    for panel in sorted(panels, key=lambda p: -p.error)[:count]:
        width = panel.photo.shape[1]
        difference = panel.image.astype(np.float32) - panel.truth.astype(np.float32)
        shown = np.clip(128.0 + DIFFERENCE_GAIN * difference, 0.0, 255.0).astype(np.uint8)
        caption = Image.new("RGB", (4 * width, 2 * LINE), "white")
        draw = ImageDraw.Draw(caption)
        draw.text((2, 1), f"{panel.name}: RMSE of the box {panel.error:.4f}", fill="black")
        for k, words in enumerate(COLUMNS):
            draw.text((k * width + 2, LINE + 1), words.format(row=row), fill="black")
        pictures = np.concatenate([panel.photo, panel.image, panel.truth, shown], axis=1)
        strips += [np.asarray(caption), pictures]
    sheet: CodeArray = np.concatenate(strips, axis=0)
    return sheet
