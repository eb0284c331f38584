"""How a JPEG file was coded, and pictures coded like it."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from warpir.core.arrays import CodeArray
from warpir.io.images.decoder import upright
from warpir.io.images.kinds import open_by_pillow

FIRST_ROWS = (16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55)
"""First two rows of the luminance table of ITU-T T.81, Annex K.1, that quality 50 stands for."""
BACK = {6: 8, 8: 6}
"""Orientations that undo others; the rest undo themselves."""


@dataclass(frozen=True)
class JpegCoding:
    """Quantisation of a JPEG file."""

    tables: tuple[tuple[int, ...], ...]
    """Of luminance and, where it has colours, of chrominance; 64 steps each, row by row."""
    subsampling: int
    """Pillow's number: 0 is 4:4:4, 1 is 4:2:2, 2 is 4:2:0."""
    orientation: int = 1
    """EXIF orientation: the blocks lie in the file's picture, not in the upright one."""

    @property
    def quality(self) -> int:
        """Quality from 1 to 100 of the Independent JPEG Group's scale that fits the luminance."""
        scale = 100.0 * sum(self.tables[0][:16]) / sum(FIRST_ROWS)
        quality = 100.0 - scale / 2.0 if scale <= 100.0 else 5000.0 / scale
        return int(np.clip(round(quality), 1, 100))

    def recoded(self, codes: CodeArray) -> CodeArray:
        """Return a picture as this coding leaves it; upright, of the photo's size, [H, W, 3]."""
        from PIL import Image

        stored = upright(codes, BACK.get(self.orientation, self.orientation))
        file = BytesIO()
        tables = [list(table) for table in self.tables]
        picture = Image.fromarray(np.ascontiguousarray(stored))
        picture.save(file, "JPEG", qtables=tables, subsampling=self.subsampling)
        with open_by_pillow(file) as image:
            decoded = np.asarray(image)
        turned: CodeArray = np.ascontiguousarray(upright(decoded, self.orientation))
        return turned


def read_coding(path: Path, orientation: int) -> JpegCoding | None:
    """Return how a JPEG file was coded; None where it is neither grey nor YCbCr in 8 bits."""
    from PIL import JpegImagePlugin

    with open_by_pillow(path) as image:
        if not isinstance(image, JpegImagePlugin.JpegImageFile) or image.mode not in ("RGB", "L"):
            return None
        tables = tuple(tuple(image.quantization[k]) for k in sorted(image.quantization)[:2])
        sampling = JpegImagePlugin.get_sampling(image) if image.mode == "RGB" else 0
    if not tables or sampling < 0:
        return None
    return JpegCoding(tables, sampling, orientation)
