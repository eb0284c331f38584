"""The video of a sequence: what ffmpeg was given comes out of it again, in the same colours."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests.builders.insertions import arguments, digest, write_inputs
from warpir.core.errors import ExitCode
from warpir.insert import main
from warpir.sequence.video import VIDEO, NoVideo, write_video

ROUNDING = 2.0
"""Of codes of 8 bits, on an average: luma and chroma are rounded to 220 and 225 levels."""


@pytest.fixture
def ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The program on PATH, which holds nothing else."""
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "ffmpeg"
    program.symlink_to(imageio_ffmpeg.get_ffmpeg_exe())
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    return program


def read_video(program: Path, path: Path) -> tuple[str, NDArray[np.float64]]:
    """Return what ffmpeg says of the file, and its frames as sRGB codes, shape [T, H, W, 3]."""
    said = subprocess.run([program, "-i", path], capture_output=True, text=True, check=False).stderr
    (line,) = (line for line in said.splitlines() if "Video:" in line)
    found = re.search(r" (\d+)x(\d+)[, ]", line)
    assert found is not None, line
    width, height = map(int, found.groups())
    argv = [str(program), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "yuv420p", "-"]
    raw = subprocess.run(argv, capture_output=True, check=True).stdout
    planes = np.frombuffer(raw, np.uint8).reshape(-1, 3 * height // 2, width)
    luma = (planes[:, :height].astype(float) - 16.0) / 219.0
    chroma = (planes[:, height:].reshape(-1, 2, height // 2, width // 2) - 128.0) / 224.0
    blue, red = np.repeat(np.repeat(chroma, 2, axis=2), 2, axis=3).transpose(1, 0, 2, 3)
    # ITU-R BT.709-6, items 3.2 to 3.4, solved for red, green and blue.
    r, b = luma + 1.5748 * red, luma + 1.8556 * blue
    g = (luma - 0.2126 * r - 0.0722 * b) / 0.7152
    return line, np.clip(255.0 * np.stack([r, g, b], axis=-1), 0.0, 255.0)


def picture(color: tuple[int, int, int], height: int = 32, width: int = 48) -> NDArray[np.uint8]:
    """A smooth ramp round a colour: what lies between two pixels is no matter of chroma planes."""
    ramp = np.linspace(-30, 30, width)[None, :, None] + np.linspace(-10, 10, height)[:, None, None]
    return np.clip(np.array(color) + ramp, 0, 255).astype(np.uint8)


COLORS = ((200, 60, 40), (40, 190, 70), (50, 70, 210), (128, 128, 128), (235, 235, 225))


@pytest.mark.parametrize("size", [(32, 48), (33, 49)], ids=["even", "odd"])
def test_frames_come_back_in_their_colours(
    size: tuple[int, int], ffmpeg: Path, tmp_path: Path
) -> None:
    """As many, of even size, tagged, in the rate asked for, and not shifted in colour."""
    frames = [tmp_path / f"{k}.png" for k in range(len(COLORS))]
    for path, color in zip(frames, COLORS, strict=True):
        Image.fromarray(picture(color, *size)).save(path)
    write_video(tmp_path / VIDEO, frames, 12.5)
    line, found = read_video(ffmpeg, tmp_path / VIDEO)
    assert "h264" in line and "yuv420p(tv, bt709/bt709/iec61966-2-1" in line and "12.5" in line
    assert found.shape == (len(COLORS), 32, 48, 3)
    for seen, color in zip(found, COLORS, strict=True):
        expected = picture(color, *size)[:32, :48].astype(float)
        assert np.abs(seen.mean(axis=(0, 1)) - expected.mean(axis=(0, 1))).max() < ROUNDING
        assert np.abs(seen - expected).mean() < ROUNDING
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *(f"{k}.png" for k in range(len(COLORS))), "bin", VIDEO,
    ]  # fmt: skip


def test_a_video_that_cannot_be_made_leaves_the_old_one(
    ffmpeg: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of frames of several sizes, by an ffmpeg that fails, by none: one line says why."""
    old = tmp_path / VIDEO
    old.write_bytes(b"old")
    for k, size in enumerate([(32, 48), (32, 50)]):
        Image.fromarray(picture((9, 9, 9), *size)).save(tmp_path / f"{k}.png")
    frames = [tmp_path / "0.png", tmp_path / "1.png"]
    with pytest.raises(NoVideo, match=r"several sizes \(found 48 x 32 and 50 x 32"):
        write_video(old, frames, 24)
    ffmpeg.unlink()
    ffmpeg.write_text("#!/bin/sh\necho 'Unknown encoder libx264' >&2\nexit 8\n")
    ffmpeg.chmod(0o755)
    with pytest.raises(NoVideo, match="ffmpeg: Unknown encoder libx264"):
        write_video(old, frames[:1], 24)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NoVideo, match="no ffmpeg was found on PATH"):
        write_video(old, frames[:1], 24)
    assert old.read_bytes() == b"old"
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
def test_insert_makes_the_video_of_a_sequence(
    ffmpeg: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Made once, made again for another rate or another frame, and no reason to render again."""
    write_inputs(tmp_path)
    cheap = {"samples": "1", "depth": "1", "device": "cpu", "no_hand_off": "", "no_detail": ""}
    assert main(arguments(tmp_path, tmp_path / "first", **cheap)) == ExitCode.DONE
    lines, out = tmp_path / "frames.jsonl", tmp_path / "out"

    def go(*rows: dict[str, Any], **flags: str) -> dict[str, Any]:
        lines.write_text("".join(json.dumps(row) + "\n" for row in rows))
        named = {"reuse": str(tmp_path / "first"), "sequence": str(lines), "light": None}
        argv = arguments(tmp_path, out, **{**cheap, **named, **flags})
        assert main(argv) == ExitCode.DONE
        return dict(json.loads((out / "sequence.json").read_text()))

    rows: list[dict[str, Any]] = [{}, {"rotate-y": 20}, {"rotate-y": 40}]
    made = go(*rows)["video"][VIDEO]
    assert made["fps"] == 24.0 and len(made["frames"]) == 3
    _, found = read_video(ffmpeg, out / VIDEO)
    assert found.shape == (3, 32, 48, 3)
    for k in range(3):
        expected = np.asarray(Image.open(out / f"000{k + 1}" / "composite.png"))
        means = found[k].mean(axis=(0, 1)), expected.mean(axis=(0, 1))
        assert np.abs(means[0] - means[1]).max() < ROUNDING
    before, when = digest(out), (out / VIDEO).stat().st_mtime_ns
    assert go(*rows)["video"][VIDEO] == made and digest(out) == before
    assert (out / VIDEO).stat().st_mtime_ns == when, "nothing had changed"
    capsys.readouterr()
    assert go(*rows, fps="12")["video"][VIDEO]["fps"] == 12.0
    assert capsys.readouterr().out.count("done already") == 3
    assert " 12 fps" in read_video(ffmpeg, out / VIDEO)[0]
    # Killed before the new one gets its name, none is there, and the next run makes it.
    replace = os.replace

    def killed(source: Path, target: Path) -> None:
        if Path(target).name == VIDEO:
            raise KeyboardInterrupt
        replace(source, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(AssertionError):
            go(*rows)
    assert not (out / VIDEO).exists()
    assert go(*rows)["video"][VIDEO] == made
    # A file of that name that is somebody's stays, and no ffmpeg is no fault.
    (out / VIDEO).write_bytes(b"mine")
    assert go(*rows)["video"] == {} and (out / VIDEO).read_bytes() == b"mine"
    assert "stays as it is (--overwrite)" in capsys.readouterr().out
    (out / VIDEO).unlink()
    os.unlink(ffmpeg)
    assert shutil.which("ffmpeg") is None and go(*rows)["video"] == {}
    assert "notice: no ffmpeg was found on PATH" in capsys.readouterr().out
    assert not (out / VIDEO).exists()
