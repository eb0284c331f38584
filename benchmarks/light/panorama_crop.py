"""Write a view into a panorama as a photo whose camera, light and exposure are known.

`warpir.evaluate.scenes` makes it. With ``--tone linear`` and the exposure that
``light.json`` holds, an object is lit and shown exactly as the place itself.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks.scenes import write_picture
from warpir.core.color import expose
from warpir.evaluate.scenes import crop_camera, crop_radiance
from warpir.io.images.photos import read_envmap
from warpir.scene.camera import Camera


def write_crop(panorama: Path, camera: Camera, out: Path) -> dict[str, Any]:
    """Write ``photo.png``, ``camera.json`` and ``light.json``; return the content of the last."""
    display, exposure = expose(crop_radiance(read_envmap(panorama), camera))
    # A configuration of warpir.insert; the panorama itself is the light, unturned.
    light = {"light": str(panorama), "exposure": exposure, "tone": "linear"}
    out.mkdir(parents=True, exist_ok=True)
    write_picture(out / "photo.png", display)
    for name, content in (("camera.json", camera.record()), ("light.json", light)):
        (out / name).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return light


def main() -> None:
    """Write a crop and print the flags that insert into it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--panorama", type=Path, required=True, help="lat-long .hdr or .exr")
    parser.add_argument("--fov", type=float, default=60.0, help="horizontal field of view [deg]")
    parser.add_argument("--azimuth", type=float, default=0.0, help="clockwise from -Z [deg]")
    parser.add_argument("--pitch", type=float, default=0.0, help="negative looks down [deg]")
    parser.add_argument("--camera-height", type=float, default=1.6, help="above the ground [m]")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=427)
    parser.add_argument("--out", type=Path, required=True, help="folder for the three files")
    options = parser.parse_args()
    view = options.fov, options.azimuth, options.pitch, options.camera_height
    camera = crop_camera(options.width, options.height, *view)
    write_crop(options.panorama, camera, options.out)
    names = {"photo": "photo.png", "camera": "camera.json", "config": "light.json"}
    print(*(f"--{flag} {options.out / name}" for flag, name in names.items()))


if __name__ == "__main__":
    main()
