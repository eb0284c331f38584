"""The video of a sequence: its composites, by ffmpeg where that is installed.

H.264 with 4:2:0 subsampling, which every player reads; Rec.709 primaries and matrix, the transfer
function of sRGB, limited range, and the file says so. A profile in the composites is followed.
Nothing of a scene depends on the video, so whatever goes wrong with it is a notice.
"""

import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import DEVNULL, PIPE

import numpy as np

from warpir.core.arrays import PixelArray
from warpir.core.atomic import WriteError, replacing
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS
from warpir.io.images.photos import read_photo

VIDEO = "composite.mp4"
CRF = "16"
"""Constant quality of x264: the pictures are a result, not a preview."""
FILTERS = ",".join(
    (
        "crop=trunc(iw/2)*2:trunc(ih/2)*2:0:0",
        "scale=in_range=pc:out_range=tv:out_color_matrix=bt709:flags=accurate_rnd+full_chroma_int",
        "format=yuv420p",
        "setparams=range=tv:colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1",
    )
)
"""Even sizes, and colours that are what the file says of them."""


class NoVideo(Exception):
    """There is none; the text says why, for a notice."""


def write_video(
    path: Path, frames: Sequence[Path], fps: float, max_pixels: int = LIMITS.pixels
) -> None:
    """Write a video of pictures, whole or not at all.

    Odd widths and heights lose their last column and row, since colours are stored for squares of
    two by two pixels.

    Args:
        path: The file; one that is there is replaced.
        frames: Pictures of one size, at least 2 by 2 pixels.
        fps: Frames per second [1/s].
        max_pixels: Largest picture that is opened [px].

    Raises:
        NoVideo: No ffmpeg, sizes that differ, or ffmpeg or the disk refused it.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        raise NoVideo("no ffmpeg was found on PATH, so there is no video of the frames")

    def read(frame: Path) -> PixelArray:
        photo = read_photo(frame, max_pixels=max_pixels)
        return np.round(np.clip(photo.srgb, 0.0, 1.0) * 255.0).astype(np.uint8)

    try:
        first = read(frames[0])
        with replacing(path) as staged:
            _encode(program, staged, first, (read(frame) for frame in frames[1:]), fps)
    except (InputError, WriteError) as error:
        raise NoVideo(f"no video of the frames: {error}") from error


def _encode(
    program: str, path: Path, first: PixelArray, others: Iterable[PixelArray], fps: float
) -> None:
    """Let ffmpeg write a file of pictures that it gets one by one.

    Raises:
        NoVideo: It fails, or a picture has another size than the first.
    """
    height, width = first.shape[:2]
    if min(height, width) < 2:
        raise NoVideo(f"no video of frames of {width} x {height} pixels")
    # Not a name that ffmpeg could take for a protocol or an option: a path beginning with a slash.
    argv = [
        *(program, "-nostdin", "-hide_banner", "-loglevel", "error", "-y"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}"),
        *("-i", "pipe:0", "-vf", FILTERS, "-c:v", "libx264", "-crf", CRF, "-preset", "medium"),
        *("-fflags", "+bitexact", "-movflags", "+faststart", "-f", "mp4", str(path.absolute())),
    ]
    with tempfile.TemporaryFile() as said:
        ffmpeg = subprocess.Popen(argv, stdin=PIPE, stdout=DEVNULL, stderr=said)
        assert ffmpeg.stdin is not None
        try:
            with suppress(BrokenPipeError):  # its status and its words say why
                for picture in chain([first], others):
                    if picture.shape != first.shape:
                        found = f"{width} x {height} and {picture.shape[1]} x {picture.shape[0]}"
                        raise NoVideo(f"no video of frames of several sizes (found {found} pixels)")
                    ffmpeg.stdin.write(picture.tobytes())
                ffmpeg.stdin.close()
            status = ffmpeg.wait()
        finally:
            ffmpeg.kill()
            ffmpeg.wait()
            with suppress(BrokenPipeError):
                ffmpeg.stdin.close()
        if status:
            said.seek(0)
            words = said.read().decode("utf-8", "replace").strip().splitlines()
            raise NoVideo(f"no video of the frames: ffmpeg: {words[-1] if words else status}")
