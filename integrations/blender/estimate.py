"""Runs in warpir's own environment: ``python estimate.py PHOTO FOLDER [FLAG ...]``.

Camera and light are those of an insertion, whose object is a box that stands in for what will come;
``FOLDER/result`` is an ordinary result. ``FOLDER/grain.exr`` is grain as strong as the photo's, in
display values, where it has any, and ``FOLDER/turned`` is there if the photo's EXIF tag turns it.
"""

import json
import sys
from pathlib import Path

BOX = (0.5, 0.5, 0.5)  # its sides [m]
QUICK = ("--samples", "1", "--width", "64")  # the picture of the box is not wanted


def run(photo: str, folder: Path, flags: list[str]) -> int:
    """Return warpir's exit status."""
    import trimesh

    from warpir.insert import main

    trimesh.creation.box(extents=BOX).export(folder / "box.glb")
    named = ["--photo", photo, "--asset", str(folder / "box.glb"), "--out", str(folder / "result")]
    status = main([*named, *QUICK, *flags])
    if status == 0:
        write_grain(folder / "result", folder / "grain.exr")
        if is_turned(photo):
            (folder / "turned").touch()
    return status


def is_turned(photo: str) -> bool:
    """Return whether the file's pixels are not upright, by its EXIF tag."""
    import OpenImageIO as oiio

    return bool(oiio.ImageBuf(photo).spec().get_int_attribute("Orientation", 1) > 1)


def write_grain(result: Path, path: Path) -> None:
    """Write grain for the whole photo, RGB, float32; nothing where the photo has none."""
    import numpy as np
    from PIL import Image

    from warpir.app.earlier_runs import config_of_record
    from warpir.app.inputs import read_photo_of
    from warpir.core.color import GAMMA
    from warpir.io.images.writers import exr_bytes
    from warpir.look.grain import Grain

    record = json.loads((result / "run.json").read_text("utf-8"))
    if (found := record["measured"]["look"]["grain"]) is None:
        return
    grain, config = Grain(**found), config_of_record(record["config"])
    # It is that of a linear plate as it is exposed; Blender shows the plate as it is.
    alpha = read_photo_of(config.inputs, config.limits).exposure ** (1.0 / GAMMA)
    with Image.open(result / "photo.png") as picture:
        display = np.asarray(picture.convert("RGB"), np.float64) / 255.0
    noise = grain.deviation(alpha * display) / alpha * grain.draw(display.shape[:2], 0)
    path.write_bytes(exr_bytes(path, {c: noise[..., k].astype("f4") for k, c in enumerate("RGB")}))


if __name__ == "__main__":
    sys.exit(run(sys.argv[1], Path(sys.argv[2]), sys.argv[3:]))
