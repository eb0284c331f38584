"""Compare the demo's result with the truth, and put it into the picture of README.

    python -m warpir.insert --demo --out out/demo
    python -m tools.demo.compare out/demo docs/demo.jpg

The picture shows the middle of the photo, of the result and of the truth side by side, 480 pixels
wide each; the first and the last stay. Errors are of the display values of these pictures.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from warpir.core.arrays import FloatArray
from warpir.io.layers import read_layers

BOX = (300, 200, 1110, 740)
"""Left, upper, right and lower edge of what is shown of the photo [px]."""
SIZE, GAP = (480, 320), 8
"""Width and height of a panel, and the space between two [px]."""


def shown(picture: Image.Image) -> FloatArray:
    """Return the part of a picture that is shown, in [0, 1]."""
    small = picture.resize(SIZE, Image.Resampling.LANCZOS, box=BOX)
    return np.asarray(small).astype(np.float32) / np.float32(255.0)


def main() -> None:
    """Print the errors of object and box, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("result", type=Path, help="folder of a finished demo")
    parser.add_argument("picture", type=Path, help="the three panels, changed in place")
    options = parser.parse_args()
    panels = Image.open(options.picture).convert("RGB")
    right = 2 * (SIZE[0] + GAP)
    truth = np.asarray(panels.crop((right, 0, right + SIZE[0], SIZE[1]))).astype(np.float32) / 255.0
    result = shown(Image.open(options.result / "composite.png").convert("RGB"))
    matte = read_layers(options.result / "layers.exr").matte
    inside = shown(Image.fromarray(np.round(255.0 * matte).astype(np.uint8))) > 0.99
    rows, columns = np.nonzero(inside)
    # The object's box, and a third of its width more on each side for the shadow.
    margin = (columns.max() - columns.min()) // 3
    first, last = max(columns.min() - margin, 0), columns.max() + margin
    square = (result - truth) ** 2
    box = square[rows.min() : rows.max() + margin // 4, first:last]
    of_object, of_box = np.sqrt(square[inside].mean()), np.sqrt(box.mean())
    print(f"RMSE of the object {of_object:.3f}, of its box {of_box:.3f}")
    middle = Image.fromarray(np.round(255.0 * result).astype(np.uint8))
    panels.paste(middle, (SIZE[0] + GAP, 0))
    panels.save(options.picture, quality=92)


if __name__ == "__main__":
    main()
