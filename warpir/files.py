"""Every file that is written: one staged folder, whole or not at all.

`OutputFolder` stages everything and renames at the end, `run.json` last. What is read is in
`warpir.photo_files`. The image libraries are imported inside the functions that need them, to keep
start-up short.
"""

import errno
import fcntl
import hashlib
import io
import json
import os
import re
import shutil
import socket
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warpir
from warpir import color
from warpir.camera import Camera, exr_matrices
from warpir.errors import ExitCode, InputError
from warpir.image_decoder import FloatArray, Pixels, decode_image, library_error, one_line
from warpir.strict_json import read_json_object

UNFINISHED = ("checkpoints", "progress")
"""Folders of an output folder that hold what a run needs, or shows, before it has results."""

HALF_MAX = 65504.0
"""Largest finite half-precision number."""

BACKGROUND_DEPTH = 1e10
"""``Z`` where no object is [m]."""

_PLAIN_NAME = re.compile(r"(?:[A-Za-z0-9][A-Za-z0-9_.-]{0,99}/)?[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
"""A file, or a file in a folder of the output folder."""
_RUN_JSON = "run.json"

_XMP = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about=""
    xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/">
   <Iptc4xmpExt:DigitalSourceType>\
http://cv.iptc.org/newscodes/digitalsourcetype/compositeSynthetic\
</Iptc4xmpExt:DigitalSourceType>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""


class OutputFolder:
    """The folder a run writes: all of it, or nothing.

    A context manager. Files are staged in ``.partial-<pid>/`` inside the folder, so on the same
    file system; leaving the block without an exception renames them into place, ``run.json``
    last. A folder with ``run.json`` therefore holds a complete result, and after a failure the
    earlier files are what they were, byte for byte. ``.lock`` keeps a second run out; the
    kernel releases it with the process, so it is never stale.
    """

    def __init__(self, path: str | Path, overwrite: bool = False) -> None:
        """Name the folder; nothing is touched before the block is entered.

        Args:
            path: The folder; made when missing.
            overwrite: Whether results that are already there are replaced.
        """
        self.path = Path(path)
        self.overwrite = overwrite
        self._staging = self.path / f".partial-{os.getpid()}"
        self._lock = -1
        self._made = False
        self._hashes: dict[str, str] = {}
        self._run: dict[str, Any] = {}

    def __enter__(self) -> "OutputFolder":
        """Make and lock the folder.

        Raises:
            InputError: Locked or holding results (exit 7), or not writable (exit 5).
        """
        self._make()
        try:
            self._take_lock()
            for abandoned in self.path.glob(".partial-*"):  # of killed runs: the lock is ours
                shutil.rmtree(abandoned, ignore_errors=True)
            self._refuse_results()
            try:
                self._staging.mkdir()
            except OSError as error:
                raise self._disk_error(self._staging.name, error) from error
        except BaseException:
            self._release()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        """Move the staged files into place, or on an exception remove them."""
        try:
            if kind is None:
                self._commit()
        finally:
            shutil.rmtree(self._staging, ignore_errors=True)
            self._release()

    # What is written. Each writer ends in `write_bytes` or does the same checks.

    def write_bytes(self, name: str, content: bytes) -> None:
        """Stage one file and see that all of it reached the disk."""
        path = self._staged(name)
        try:
            with path.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            written = path.stat().st_size
        except OSError as error:
            raise self._disk_error(name, error) from error
        if written != len(content):
            raise InputError(
                self.path / name,
                f"written incompletely (found {written} bytes; expected {len(content)})",
                code=ExitCode.RESOURCES,
            )
        self._hashes[name] = hashlib.sha256(content).hexdigest()

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Stage a JSON file; ``run.json`` gets the sha256 of all others and is written last.

        Raises:
            ValueError: A number is not finite.
        """
        if name == _RUN_JSON:
            self._run = dict(content)
            _json_bytes(self._run)
        else:
            self.write_bytes(name, _json_bytes(content))

    def write_png(
        self,
        name: str,
        codes: Pixels,
        *,
        icc: bytes | None = None,
        mark: bool = True,
        description: str = "",
    ) -> None:
        """Stage a PNG.

        Args:
            name: File name inside the folder.
            codes: uint8 or uint16, shape [H, W, 3], or [H, W] for grey.
            icc: Profile the codes are in; sRGB is stated when absent.
            mark: Whether to say in XMP that the picture is a composite (IPTC digital source
                type ``compositeSynthetic``).
            description: Text for the ``Description`` field.
        """
        self.write_bytes(name, png_bytes(codes, icc, mark, description))

    def write_preview(self, step: int, codes: Pixels, icc: bytes | None = None) -> Path:
        """Write a picture of the way to the result, at once and outside of what is staged.

        Args:
            step: Of the optimisation; 0 is its start.
            codes: As of `write_png`.
            icc: Profile the codes are in.

        Returns:
            The file, in ``progress/``; never seen half written.

        Raises:
            InputError: The disk is full or the folder is not writable (exit 5).
        """
        path = self.path / "progress" / f"preview-{step:06d}.png"
        staged = self._staging / path.name
        try:
            path.parent.mkdir(exist_ok=True)
            staged.write_bytes(png_bytes(codes, icc, False, ""))
            os.replace(staged, path)
        except OSError as error:
            raise self._disk_error(f"progress/{path.name}", error) from error
        return path

    def write_exr(
        self, name: str, channels: Mapping[str, Pixels], header: Mapping[str, Any] | None = None
    ) -> None:
        """Stage a single-part scanline EXR with ZIP compression.

        Args:
            name: File name inside the folder.
            channels: One plane per full channel name (``shadow.R``), shape [H, W]; float16
                planes become half channels, float32 planes float channels.
            header: Attributes; text, numbers, tuples, or float32 arrays for matrices.

        Raises:
            InputError: A value is not finite (exit 6), or the disk is full (exit 5).
        """
        import OpenEXR

        planes = {}
        for channel, plane in channels.items():
            if plane.dtype not in (np.float16, np.float32) or plane.ndim != 2:
                raise ValueError(
                    f"{channel}: float16 or float32 planes [H, W] are needed, got "
                    f"{plane.dtype} {plane.shape}"
                )
            bad = int(plane.size - np.isfinite(plane).sum())
            if bad:
                raise InputError(
                    self.path / name,
                    f"channel {channel} is not finite (found {bad} bad values)",
                    code=ExitCode.NUMERIC,
                )
            planes[channel] = np.ascontiguousarray(plane)
        attributes: dict[str, Any] = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
        }
        for key, value in (header or {}).items():
            # OpenEXR reads a matrix's memory in order, whatever its strides say.
            is_array = isinstance(value, np.ndarray)
            attributes[key] = np.ascontiguousarray(value) if is_array else value
        # In memory first: a stream cannot run full, and the size to check is known.
        stream = io.BytesIO()
        OpenEXR.File(attributes, planes).write(stream)
        self.write_bytes(name, stream.getvalue())

    def write_envmap(self, texels: FloatArray, stem: str = "envmap") -> None:
        """Stage an environment map: ``.exr`` (float32), ``.hdr`` (RGBE) and ``_preview.png``.

        Args:
            texels: Radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3].
            stem: First part of the names.

        Raises:
            InputError: A value is negative or not finite (exit 6), or the disk is full (exit 5).
        """
        import OpenEXR

        if texels.ndim != 3 or texels.shape[2] != 3 or texels.shape[1] != 2 * texels.shape[0]:
            raise ValueError(f"texels [He, 2 He, 3] are needed, got {texels.shape}")
        if not bool((np.isfinite(texels) & (texels >= 0.0)).all()):
            raise InputError(
                self.path / f"{stem}.exr",
                "the light is negative or not finite",
                code=ExitCode.NUMERIC,
            )
        texels = np.ascontiguousarray(texels, dtype=np.float32)
        self.write_exr(
            f"{stem}.exr",
            {c: texels[..., k] for k, c in enumerate("RGB")},
            {**_color_header(), "envmap": OpenEXR.ENVMAP_LATLONG},
        )
        self.write_hdr(f"{stem}.hdr", texels)
        # A person expects the viewing direction -Z, our seam, in the middle.
        seen = np.roll(texels, texels.shape[1] // 2, axis=1)
        white = float(np.percentile(color.luminance(seen), 95.0)) / 0.8
        shown = color.linear_to_srgb(np.clip(seen / np.float32(white or 1.0), 0.0, 1.0))
        self.write_png(
            f"{stem}_preview.png",
            np.round(shown * 255.0).astype(np.uint8),
            mark=False,
            description="Preview: rolled by half its width, so that -Z is in the "
            "middle; scaled and clipped to 8 bits",
        )

    def write_hdr(self, name: str, texels: FloatArray) -> None:
        """Stage a Radiance file; the library's last flush is unchecked, so it is read back.

        Args:
            name: File name inside the folder.
            texels: Finite and not negative, shape [height, width, 3].

        Raises:
            InputError: The disk is full (exit 5).
        """
        import OpenImageIO as oiio

        path = self._staged(name)
        height, width = texels.shape[:2]
        spec = oiio.ImageSpec(width, height, 3, oiio.FLOAT)
        spec.attribute("DateTime", "")
        writer = oiio.ImageOutput.create(str(path))
        assert writer is not None, "OpenImageIO is built with Radiance HDR"
        done = writer.open(str(path), spec) and writer.write_image(texels)
        text = library_error(writer)
        done = writer.close() and done and not text
        try:
            if not done:
                raise InputError(path, text)
            decode_image(path, width * height, kinds=("hdr",))
            with path.open("rb+") as stream:
                os.fsync(stream.fileno())
                self._hashes[name] = hashlib.file_digest(stream, "sha256").hexdigest()
        except (InputError, OSError) as error:
            raise InputError(
                self.path / name,
                f"cannot be written ({one_line(str(error))})",
                "free some disk space",
                ExitCode.RESOURCES,
            ) from error

    # How it is kept whole.

    def _staged(self, name: str) -> Path:
        """Return where a file is staged; names are ours, never a path that leads out."""
        if not _PLAIN_NAME.fullmatch(name):
            raise ValueError(f"not a plain file name: {name!r}")
        path = self._staging / name
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise self._disk_error(name, error) from error
        return path

    def _make(self) -> None:
        if self.path.resolve() == Path(self.path.resolve().anchor):
            raise InputError(
                "--out", f"{self.path} is the root of the file system", code=ExitCode.USAGE
            )
        try:
            self._made = not self.path.exists()
            self.path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            self._made = False
            raise InputError(
                self.path,
                "not a folder (found a file in its place)",
                "choose another --out",
                ExitCode.OUTPUT,
            ) from error
        except OSError as error:
            self._made = False
            raise InputError(
                self.path, f"cannot be made ({error.strerror})", code=ExitCode.RESOURCES
            ) from error

    def _take_lock(self) -> None:
        path = self.path / ".lock"
        while True:
            try:
                lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
            except OSError as error:
                raise self._disk_error(path.name, error) from error
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_ino == os.stat(path).st_ino:
                    break  # else the holder before us removed this file after we opened it
                os.close(lock)
            except FileNotFoundError:
                os.close(lock)
            except BlockingIOError as error:
                holder = os.read(lock, 200).decode("utf-8", "replace").strip() or "unknown"
                os.close(lock)
                raise InputError(
                    self.path,
                    f"locked by pid {holder}",
                    "wait for that run, or choose another --out",
                    ExitCode.OUTPUT,
                ) from error
            except OSError as error:
                os.close(lock)
                raise self._disk_error(path.name, error) from error
        self._lock = lock
        try:
            os.ftruncate(lock, 0)
            os.write(lock, f"{os.getpid()} on {socket.gethostname()}\n".encode())
        except OSError as error:
            raise self._disk_error(path.name, error) from error

    def _release(self) -> None:
        if self._lock >= 0:
            with suppress(OSError):
                (self.path / ".lock").unlink()
            os.close(self._lock)
            self._lock = -1
        if self._made:
            with suppress(OSError):
                self.path.rmdir()  # only succeeds when nothing was written

    def _refuse_results(self) -> None:
        """Refuse a folder in use; hidden files and an unfinished run's do not count as results."""
        found = sorted(
            entry.name
            for entry in self.path.iterdir()
            if not entry.name.startswith(".") and entry.name not in UNFINISHED
        )
        if found and not self.overwrite:
            shown = _RUN_JSON if _RUN_JSON in found else found[0]
            raise InputError(
                self.path,
                f"already holds files (found {shown}"
                f"{f' and {len(found) - 1} more' if len(found) > 1 else ''}; "
                "expected an empty folder)",
                "pass --overwrite to replace results",
                ExitCode.OUTPUT,
            )

    def _commit(self) -> None:
        """Move the old results away and the new ones in; undo all of it if a step fails."""
        names = sorted(self._hashes)
        leftover = [name for name in self._old_results() if name not in self._hashes]
        self.write_bytes(_RUN_JSON, _json_bytes({**self._run, "files": dict(self._hashes)}))
        old = self._staging / "old"
        moved: list[tuple[Path, Path]] = []

        def move(source: Path, target: Path) -> None:
            target.parent.mkdir(exist_ok=True)
            if target.parent != self.path and target.parent.is_symlink():
                raise NotADirectoryError(errno.ENOTDIR, "found a link in place of its folder")
            source.rename(target)
            moved.append((source, target))

        try:
            _sync_folder(self._staging)
            old.mkdir()
            for name in (_RUN_JSON, *names, *leftover):
                if (self.path / name).exists():
                    move(self.path / name, old / name)
            for name in names:
                move(self._staging / name, self.path / name)
            for folder in {(self.path / name).parent for name in names} | {self.path}:
                _sync_folder(folder)
            move(self._staging / _RUN_JSON, self.path / _RUN_JSON)
            _sync_folder(self.path)
        except BaseException as error:
            for source, target in reversed(moved):
                target.rename(source)
            self._remove_empty_folders([*names, *leftover])
            if isinstance(error, OSError):
                raise self._disk_error("results", error) from error
            raise
        self._remove_empty_folders(leftover)

    def _remove_empty_folders(self, names: list[str]) -> None:
        """Remove the folders of files that are gone, as far as nothing else is in them."""
        for folder in {(self.path / name).parent for name in names} - {self.path}:
            with suppress(OSError):
                folder.rmdir()

    def _old_results(self) -> list[str]:
        """Return the files of the result being replaced, as far as nobody has changed them."""
        try:
            listed = read_json_object(self.path / _RUN_JSON).get("files")
        except InputError:
            return []
        unchanged = []
        for name, digest in listed.items() if isinstance(listed, dict) else ():
            path = self.path / name
            if _PLAIN_NAME.fullmatch(name) and path.is_file() and not path.is_symlink():
                with path.open("rb") as stream:
                    if hashlib.file_digest(stream, "sha256").hexdigest() == digest:
                        unchanged.append(name)
        return unchanged

    def _disk_error(self, name: str, error: OSError) -> InputError:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        return InputError(
            self.path / name,
            f"cannot be written ({error.strerror})",
            "free some disk space" if full else "check the folder's permissions",
            ExitCode.RESOURCES,
        )


def _sync_folder(path: Path) -> None:
    """Make renames in a folder survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _json_bytes(content: Mapping[str, Any]) -> bytes:
    """Serialise as strict JSON; NumPy scalars and arrays and paths become plain values."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.generic | np.ndarray):
            return value.tolist()
        if isinstance(value, Path):
            return str(value)
        raise TypeError(f"{type(value).__name__} does not belong in JSON")

    return (json.dumps(content, indent=2, allow_nan=False, default=plain) + "\n").encode()


def png_bytes(codes: Pixels, icc: bytes | None, mark: bool, description: str) -> bytes:
    """Serialise a PNG.

    Written out here because Pillow has no 16-bit RGB, and OpenImageIO states sRGB beside any
    profile and adds EXIF.
    """
    if (
        codes.dtype not in (np.uint8, np.uint16)
        or codes.ndim not in (2, 3)
        or (codes.ndim == 3 and codes.shape[2] != 3)
    ):
        raise ValueError(
            f"uint8 or uint16 codes [H, W, 3] or [H, W] are needed, got {codes.dtype} {codes.shape}"
        )
    height, width = codes.shape[:2]
    # Samples are big-endian; each row is preceded by its filter: 2, difference to the row above.
    big_endian = np.ascontiguousarray(codes, dtype=codes.dtype.newbyteorder(">"))
    rows = big_endian.view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])

    def chunk(name: bytes, content: bytes) -> bytes:
        body = name + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(
        ">IIBBBBB", width, height, 8 * codes.dtype.itemsize, 2 if codes.ndim == 3 else 0, 0, 0, 0
    )
    parts = [b"\x89PNG\r\n\x1a\n", chunk(b"IHDR", header)]
    if icc is not None:
        parts.append(chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(icc)))
    else:
        parts.append(chunk(b"sRGB", b"\0"))
    texts = {"XML:com.adobe.xmp": _XMP if mark else "", "Description": description}
    for keyword, text in texts.items():
        if text:
            parts.append(chunk(b"iTXt", keyword.encode() + b"\0\0\0\0\0" + text.encode()))
    parts += [chunk(b"IDAT", zlib.compress(filtered.data, 6)), chunk(b"IEND", b"")]
    return b"".join(parts)


def _color_header() -> dict[str, Any]:
    """Return the EXR attributes that state our working space."""
    return {
        "chromaticities": color.REC709_CHROMATICITIES,
        "colorInteropID": "lin_rec709_scene",
        "software": f"warpir {warpir.__version__}",
    }


@dataclass(frozen=True)
class Layers:
    """What ``layers.exr`` holds, all linear Rec.709; buffers that a run has not made are absent."""

    composite: Pixels
    """``foreground.rgb + (1 - foreground.a) * plate * shadow_ratio`` [1], shape [H, W, 3]."""
    foreground: Pixels
    """Object alone, premultiplied by coverage [1], shape [H, W, 4]."""
    shadow_ratio: Pixels
    """Multiplies the plate; 1 where the object changes nothing [1], shape [H, W, 3]."""
    plate: Pixels
    """Linearised photograph [1], shape [H, W, 3]."""
    matte: Pixels
    """Object coverage, 0 to 1, shape [H, W]."""
    depth: Pixels | None = None
    """Distance along the viewing axis [m], infinite on the background, shape [H, W]."""
    position: Pixels | None = None
    """World position [m], shape [H, W, 3]."""
    normal: Pixels | None = None
    """World unit normal, shape [H, W, 3]."""
    albedo: Pixels | None = None
    """Base colour [1], shape [H, W, 3]."""
    roughness: Pixels | None = None
    """Perceptual roughness [1], shape [H, W]."""
    emission: Pixels | None = None
    """Part of `foreground` that the object emits [1], shape [H, W, 3]."""
    diffuse: Pixels | None = None
    """Part of `foreground` reflected diffusely [1], shape [H, W, 3]."""
    specular: Pixels | None = None
    """Part of `foreground` reflected specularly [1], shape [H, W, 3]."""


def write_layers(
    folder: OutputFolder,
    layers: Layers,
    camera: Camera,
    *,
    is_deep: bool = False,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> int:
    """Stage ``layers.exr``: half channels, float32 for depth, position and normal.

    The composite recomposes exactly. Of a photograph of 8 bits the layers hold halves to begin with
    (`warpir.picture`), so nothing is lost here, and the composite is stored rounded to half. A
    deeper one has codes that halves cannot tell apart: its composite and its layers are float32.

    Args:
        folder: Where.
        layers: The image planes.
        camera: The camera that made them, at their resolution.
        is_deep: Whether the photograph has more than 8 bits (`Photo.is_deep`).
        config: Resolved configuration, kept as JSON in the attribute ``warpir/config``.
        inputs: sha256 of the input files by name, kept as JSON in ``warpir/inputs``.

    Returns:
        How many values were beyond the half range and clamped; for ``run.json``.

    Raises:
        ValueError: Shapes disagree, or the composite is not what its layers compute.
        InputError: A value is not finite (exit 6), or the disk is full (exit 5).
    """
    height, width = camera.height, camera.width
    recomputed = (
        layers.foreground[..., :3]
        + (1.0 - layers.foreground[..., 3:]) * layers.plate * layers.shadow_ratio
    )
    if not np.allclose(layers.composite, recomputed, rtol=2e-3, atol=2e-3, equal_nan=True):
        worst = float(np.nanmax(np.abs(layers.composite - recomputed)))
        raise ValueError(f"composite differs from fg + (1 - a) plate shadow by up to {worst:g}")

    channels: dict[str, Pixels] = {}
    clamped = 0

    def add(prefix: str, suffixes: str, plane: Pixels | None, whole_floats: bool = False) -> None:
        nonlocal clamped
        if plane is None:
            return
        plane = plane[..., None] if plane.ndim == 2 else plane
        if plane.shape != (height, width, len(suffixes)):
            raise ValueError(
                f"layer {prefix or 'composite'}: shape {plane.shape}, expected "
                f"{(height, width, len(suffixes))}"
            )
        if not whole_floats:
            clamped += int((np.isfinite(plane) & (np.abs(plane) > HALF_MAX)).sum())
            # NaN and Inf pass through, and the writer refuses them.
            plane = np.where(np.isfinite(plane), np.clip(plane, -HALF_MAX, HALF_MAX), plane)
        for k, suffix in enumerate(suffixes):
            name = f"{prefix}.{suffix}" if prefix else suffix
            channels[name] = plane[..., k].astype(np.float32 if whole_floats else np.float16)

    add("", "RGB", layers.composite, is_deep)
    add("", "A", np.ones((height, width), np.float32))
    add("fg", "RGBA", layers.foreground, is_deep)
    add("shadow", "RGB", layers.shadow_ratio, is_deep)
    add("plate", "RGB", layers.plate, is_deep)
    add("matte", "A", layers.matte, is_deep)
    if layers.depth is not None:
        depth = np.where(np.isposinf(layers.depth), BACKGROUND_DEPTH, layers.depth)
        add("", "Z", depth, whole_floats=True)
    add("position", "XYZ", layers.position, whole_floats=True)
    add("normal", "XYZ", layers.normal, whole_floats=True)
    add("albedo", "RGB", layers.albedo)
    add("roughness", "Y", layers.roughness)
    add("emission", "RGB", layers.emission)
    add("diffuse", "RGB", layers.diffuse)
    add("specular", "RGB", layers.specular)

    world_to_camera, world_to_ndc = exr_matrices(camera)
    folder.write_exr(
        "layers.exr",
        channels,
        {
            **_color_header(),
            "worldToCamera": world_to_camera.astype(np.float32),
            "worldToNDC": world_to_ndc.astype(np.float32),
            "warpir/formula": "RGB = fg.RGB + (1 - fg.A) * plate.RGB * shadow.RGB",
            "warpir/config": json.dumps(config or {}, sort_keys=True, default=str),
            "warpir/inputs": json.dumps(inputs or {}, sort_keys=True),
        },
    )
    return clamped
