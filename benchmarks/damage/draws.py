"""Strange values and photos, drawn from a seed."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
from PIL import Image

from tests.builders.image_files import icc_profile, matrix_profile, write_image
from tests.builders.insertions import arguments

FLOATS = (0.0, -0.0, 1.0, -1.0, 1e30, -1e30, 1e-30, 1e38, 3.4e38, 1e300, 0.5, 65504.0, 1e-45)
NOT_FINITE = (float("nan"), float("inf"), -float("inf"))
SIZES = ((1, 1), (1, 64), (64, 1), (2, 2), (3, 300), (300, 3), (64, 48), (7, 5), (65, 33))


class Draw:
    """Draws inputs from a seed."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def one(self, of: Sequence[Any]) -> Any:
        """Return one of several."""
        return of[int(self.rng.integers(len(of)))]

    def odd(self, share: float) -> bool:
        """Return true for a share of all calls."""
        return bool(self.rng.random() < share)

    def number(self) -> float:
        """Return a number of any size."""
        if self.odd(0.5):
            return float(self.one(FLOATS))
        return float(self.rng.normal() * 10.0 ** self.rng.integers(-40, 39))

    def value(self) -> Any:
        """Return a value of any type."""
        kind = int(self.rng.integers(6))
        if kind == 0:
            return self.number()
        if kind == 1:
            return int(self.one((0, 1, 2, -1, 7, 2**31, 2**32, 2**63, 2**64, -(2**63), 90, 360)))
        if kind == 2:
            return [self.number() for _ in range(int(self.rng.integers(0, 5)))]
        texts = ("", " ", "auto", "off", "nan", "inf", "1e400", "x", "0,0", "1,2,3", "0,90", "é",
                 "-", "/", ".", "..", "\u202e", "1_000", "٣", "0x10", "true", "clear", "+z", "a\nb",
                 "1;2")  # fmt: skip
        if kind == 3:
            return self.one((None, True, False, {}, [], {"x": 1}, [[1]]))
        return self.one(texts)


class Photos(Draw):
    """Draws photos whose modes, sizes, tags and profiles are unusual."""

    def photos(self, folder: Path) -> list[str]:
        """Write a photo and return a command line."""
        size = (30_000, 3) if self.odd(0.005) else self.one(SIZES)
        kind = self.one(("pil", "pil", "pil", "tiff", "exr"))
        path = getattr(self, f"_{kind}_photo")(folder, size)
        changes: dict[str, str | None] = {"photo": str(path), "width": None}
        if self.odd(0.5):
            changes.update(fov=None, pitch=None, camera_from="assume")  # tags count
        if self.odd(0.3):
            changes["alpha"] = "ignore"
        return run_of(folder, **changes)

    def _pil_photo(self, folder: Path, size: tuple[int, int]) -> Path:
        modes = {
            "png": ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "I;16", "I"),
            "jpg": ("L", "RGB", "CMYK", "YCbCr"),
            "tif": ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "I;16", "F", "YCbCr", "LAB", "I"),
            "webp": ("RGB", "RGBA", "L"),
            "gif": ("P", "L", "RGB"),
        }
        suffix = self.one(("png", "png", "jpg", "jpg", "tif", "webp", "gif"))
        picture = self._picture(self.one(modes[suffix]), size)
        options: dict[str, Any] = {}
        if self.odd(0.4):
            options["exif"] = self._exif()
        if self.odd(0.3):
            space = self.one((b"RGB ", b"GRAY", b"CMYK", b"Lab ", b"XYZ "))
            profiles = (b"", b"x", matrix_profile("p3"), icc_profile(space, {}), bytes(128),
                        matrix_profile("p3")[:200], self.rng.bytes(300))  # fmt: skip
            options["icc_profile"] = self.one(profiles)
        if suffix == "jpg":
            blocks = int(self.one((0, 1, 3)))
            options |= {"progressive": self.odd(0.4), "quality": int(self.one((1, 50, 95, 100))),
                        "restart_marker_blocks": blocks, "optimize": self.odd(0.3)}  # fmt: skip
        if suffix in ("png", "webp", "gif", "tif") and self.odd(0.2):
            others = [self._picture(picture.mode, size) for _ in range(2)]
            options |= {"save_all": True, "append_images": others}
        if suffix in ("png", "gif") and picture.mode in ("P", "L", "RGB", "1") and self.odd(0.4):
            options["transparency"] = (1, 2, 3) if picture.mode == "RGB" else 1
        if suffix == "tif":
            options["compression"] = self.one((None, "tiff_lzw", "tiff_adobe_deflate", "packbits"))
        path = folder / f"photo.{suffix}"
        try:
            picture.save(path, **options)
        except (ValueError, OSError, KeyError, RuntimeError, struct.error, TypeError):
            path = folder / "photo.png"
            picture.convert("RGB").save(path)
        return path

    def _picture(self, mode: str, size: tuple[int, int]) -> Image.Image:
        noise = self.rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        if self.odd(0.2):
            noise[...] = self.one((0, 255, 128))
        picture = Image.fromarray(noise)
        if mode == "I;16":
            return Image.fromarray(noise[..., 0].astype(np.uint16) * 257)
        if mode in ("F", "I"):
            return Image.fromarray(noise[..., 0].astype(np.float32)).convert(mode)
        if mode == "PA":
            return picture.convert("RGBA").convert("P")
        if mode == "LAB":
            return Image.frombytes("LAB", size, noise.tobytes())
        return picture.convert("L").convert(mode) if mode == "LA" else picture.convert(mode)

    def _exif(self) -> bytes:
        tags = Image.Exif()
        tags[0x0112] = int(self.one((*range(10), 255, 65535)))
        inner = tags.get_ifd(0x8769)
        lengths = (0.0, 1e-6, 0.5, 24.0, 1e6, 4e9, -3.0)
        inner[0x920A] = float(self.one(lengths))
        inner[0xA405] = int(self.one((0, 1, 24, 65535)))
        inner[0xA20E] = float(self.one(lengths))
        inner[0xA210] = int(self.one((0, 1, 2, 3, 9)))
        inner[0x927C] = self.rng.bytes(int(self.rng.integers(2000)))  # maker's note
        if self.odd(0.3):
            inner[0xA404] = float(self.one((0.0, 1e-3, 2.0, 1e5)))  # digital zoom
        try:
            return bytes(tags.tobytes())
        except (struct.error, ValueError):
            return b"Exif\0\0" + self.rng.bytes(60)

    def _floats(self, size: tuple[int, int], count: int) -> np.ndarray:
        pixels = self.rng.lognormal(size=(size[1], size[0], count)).astype(np.float32)
        for _ in range(int(self.one((0, 0, 1, 3)))):
            value = self.one(NOT_FINITE) if self.odd(0.5) else self.number()
            with np.errstate(over="ignore"):
                pixels[tuple(self.rng.integers(pixels.shape))] = np.float32(value)
        if self.odd(0.1):
            with np.errstate(all="ignore"):
                pixels *= np.float32(self.one((0.0, 1e30, 1e-38, -1.0)))
        return pixels

    def _tiff_photo(self, folder: Path, size: tuple[int, int]) -> Path:
        path = folder / "photo.tif"
        kind = self.one(("uint8", "uint16", "float16", "float32"))
        pixels = self._floats(size, int(self.one((1, 2, 3, 4, 5))))
        with np.errstate(all="ignore"):
            top = np.iinfo(kind).max if kind.startswith("u") else 1
            scaled = pixels * top if kind.startswith("f") else np.clip(pixels, 0.0, 1.0) * top
            pixels = np.where(np.isnan(scaled) & (top > 1), 0, scaled).astype(kind)
        options: dict[str, Any] = {"Orientation": int(self.one(range(1, 9)))}
        options["compression"] = self.one(("none", "lzw", "zip", "packbits"))
        if self.odd(0.3):
            options["planarconfig"] = "separate"
        write_image(path, pixels, **options)
        if self.odd(0.4):
            spec = oiio.ImageBuf(str(path))
            spec.set_write_tiles(16, 16)
            spec.write(str(folder / "tiled.tif"))
            return folder / "tiled.tif"
        return path

    def _exr_photo(self, folder: Path, size: tuple[int, int]) -> Path:
        path = folder / "photo.exr"
        names = self.one((("R", "G", "B"), ("R", "G", "B", "A"), ("Y",), ("R", "G"),
                          ("X", "Y", "Z"), ("a.R", "a.G", "a.B"), ("R", "G", "B", "Z", "odd"),
                          ("Y", "RY", "BY"),
                          ("r", "g", "b"), ("R", "G", "B", "b.R", "b.G", "b.B")))  # fmt: skip
        kinds = (np.float16, np.float32, np.float32, np.uint32)
        kind = self.one(kinds)
        channels = {}
        for name in names:
            plane = self._floats(size, 1)[..., 0]
            with np.errstate(all="ignore"):
                if kind == np.uint32:
                    plane = np.where(np.isfinite(plane) & (plane > 0), plane, 0)
                channels[name] = np.ascontiguousarray(np.minimum(plane, 4e9).astype(kind))
        corner = np.array([self.one((0, 0, -5, 3, 100_000, -(2**20))) for _ in "xy"], np.int32)
        window = (corner, corner + np.array(size, np.int32) - 1)
        header = {"type": OpenEXR.scanlineimage, "dataWindow": window, "displayWindow": window,
                  "compression": self.one((OpenEXR.ZIP_COMPRESSION, OpenEXR.NO_COMPRESSION,
                                           OpenEXR.PIZ_COMPRESSION, OpenEXR.DWAA_COMPRESSION)),
                  "pixelAspectRatio": float(self.one((1.0, 1.0, 2.0, 1e-3)))}  # fmt: skip
        if self.odd(0.4):
            whole = np.array([self.one((1, 4, 64, 200)) for _ in "xy"], np.int32)
            start = np.array([self.one((0, -3, 7)) for _ in "xy"], np.int32)
            header["displayWindow"] = (start, start + whole - 1)
        OpenEXR.File(header, channels).write(str(path))
        return path


def shown(value: Any) -> str:
    """Return a value as a flag takes it."""
    if isinstance(value, list):
        return ",".join(map(shown, value))
    return value if isinstance(value, str) else json.dumps(value)


def run_of(folder: Path, **changes: str | None) -> list[str]:
    """Return the command line of a small run."""
    same: dict[str, str | None] = {"samples": "1", "width": "32", "threads": "1", "denoise": "off"}
    same |= {"light": None, "sun": "120,40", "sky": "clear", "no_report": "", "overwrite": ""}
    return arguments(folder, folder / "out", **{**same, **changes})
