"""The files of weights, checked by themselves: no torch, no network, seconds before either.

What is read here is what a safetensors file says of itself: its header, whose lengths and offsets
the library checks against the file, and the values of the small networks that we ship. Whether
weights fit a network that was built of them is checked again when they are loaded.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from warpir.diffusion.models.model_error import ModelError

SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the weights that are part of the package."""
REGRESSOR_FORMAT = "warpir-regressor-2"
CALIBRATOR_FORMAT = "warpir-calibrator-1"
Sizes = Mapping[str, tuple[int, int, type, float, float]]
REGRESSOR_SIZES: Sizes = {
    "channels": (3, 3, int, 8, 512),
    "blocks": (2, 2, int, 0, 16),
    "depth": (1, 1, int, 0, 16),
    "heads": (1, 1, int, 1, 64),
    "directions": (1, 1, int, 8, 10_000),
    "dropout": (1, 1, float, 0, 0.99),
    "skipped": (1, 1, float, 0, 0.99),
    "hidden": (1, 1, float, 0, 0.99),
    "members": (1, 1, int, 1, 16),
}
"""Of each field of a `warpir.train.networks.regressor.RegressorConfig`: the least and the greatest
count of numbers, which are a list where there may be several; their kind, and the least and the
greatest."""
CALIBRATOR_SIZES: Sizes = {
    name: REGRESSOR_SIZES[name]
    for name in ("channels", "blocks", "depth", "heads", "dropout", "skipped")
}
"""The same of a `warpir.train.networks.calibrator.CalibratorConfig`."""

EXPONENTS = {
    "F16": ("<u2", 0x7C00),
    "BF16": ("<u2", 0x7F80),
    "F32": ("<u4", 0x7F80_0000),
    "F64": ("<u8", 0x7FF0_0000_0000_0000),
}
"""How a kind of number is stored, and the bits that are all set where it is NaN or infinite."""
OURS = ("F16", "F32", "F64")
"""Kinds of number of the networks that we ship."""
NUMBERS_MAX = 2**27
"""Of such a network; ours have less than a tenth."""
PIECE = 2**22
"""What is looked at in one go [byte]."""

_LORA_PART = re.compile(r"(.*?)[._]lora(?:_linear_layer)?[._](down|up|A|B)(?:\.weight)?")
_FOR_TEXT = ("text_encoder", "lora_te_", "lora_te1_", "lora_te2_")
"""How the names of a LoRA begin that adapts a text encoder."""


@dataclass(frozen=True)
class WeightFile:
    """What the header of a safetensors file says."""

    path: Path
    about: dict[str, str]
    """Texts beside the tensors."""
    shapes: dict[str, tuple[int, ...]]
    """Shape of each tensor by name."""
    kinds: dict[str, str]
    """Kind of number of each: ``F16``, ``BF16``, ``F32``, ``I64`` and so on."""


def read_header(path: Path) -> WeightFile:
    """Read the header of a safetensors file.

    Raises:
        ModelError: It is not there, or not a whole safetensors file.
    """
    if path.is_dir():
        raise ModelError(path, "is a folder (expected a safetensors file)")
    if not path.is_file():
        what = "not a regular file" if path.exists() else "no such file"
        raise ModelError(path, f"{what} (expected a safetensors file)")
    try:
        with safe_open(path, framework="np") as content:
            slices = {name: content.get_slice(name) for name in content.keys()}
            return WeightFile(
                path,
                dict(content.metadata() or {}),
                {name: tuple(part.get_shape()) for name, part in slices.items()},
                {name: part.get_dtype() for name, part in slices.items()},
            )
    except (SafetensorError, OSError, RuntimeError, ValueError) as error:
        raise ModelError(path, *fault_of(path)) from error


POINTER = ("a Git LFS pointer, not the file itself", "run `git lfs pull` in its folder")


def is_pointer(start: bytes) -> bool:
    """Return whether a file that starts so is what git leaves in place of a large one."""
    return start.startswith(b"version https://git-lfs")


def fault_of(path: Path) -> tuple[str, str]:
    """Return what is wrong with a file that is not safetensors, and what to do."""
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        return f"cannot be read ({error.strerror})", ""
    if start.startswith((b"PK\x03\x04", b"\x80")):
        what = "is a pickle, which may run code (expected a safetensors file)"
        return what, "convert it with the program that made it"
    if is_pointer(start):
        return POINTER
    if not start:
        return "an empty file (expected a safetensors file)", "fetch or write it again"
    return "not a whole safetensors file (cut or damaged)", ""


def check_regressor(path: Path | None) -> WeightFile:
    """Check the weights of the light regressor.

    Args:
        path: The file; None: the one that is part of the package.

    Returns:
        Its header; ``config`` in it is a JSON object whose numbers are within their ranges.

    Raises:
        ModelError: Not there, damaged, or something else.
    """
    file = _check_photo_network(path, "regressor", REGRESSOR_FORMAT, REGRESSOR_SIZES)
    temperature, directions = (_value(file, name) for name in ("temperature", "directions"))
    if temperature is None or temperature.shape != () or not temperature > 0.0:
        raise ModelError(file.path, "temperature: not a number above 0")
    if (
        directions is None
        or directions.ndim != 2
        or not np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-3)
    ):
        raise ModelError(file.path, "directions: not of length 1")
    return file


def check_calibrator(path: Path | None) -> WeightFile:
    """Check the weights of the network that estimates cameras; see `check_regressor`."""
    file = _check_photo_network(path, "calibrator", CALIBRATOR_FORMAT, CALIBRATOR_SIZES)
    spread = _value(file, "spread")
    if spread is None or spread.ndim != 1 or not (spread > 0.0).all():
        raise ModelError(file.path, "spread: not numbers above 0")
    return file


def _check_photo_network(path: Path | None, name: str, format_: str, sizes: Sizes) -> WeightFile:
    """Check the header and the values of one of our networks that see a photo.

    Without a path it is the one of that name that is part of the package.
    """
    shipped = SHIPPED / f"{name}.safetensors"
    file = read_header(path or shipped)
    where = file.path
    if file.about.get("format") != format_:
        found = str(file.about.get("format"))[:40]
        label = {"regressor": "light regressor", "calibrator": "camera network"}[name]
        what = f"no weights of the {label} (found {found!r})"
        raise ModelError(where, what, f"expected {format_!r}")
    config = _object(where, file.about.get("config", ""))
    _object(where, file.about.get("record", ""))
    _check_sizes(where, config, sizes)
    if any(width % 8 for width in config["channels"]) or config["channels"][2] % config["heads"]:
        what = f"network: channels {config['channels']} of {config['heads']} heads"
        raise ModelError(where, f"{what} (expected multiples of 8, the last of the heads too)")
    if path is not None and shipped.is_file():
        ours = read_header(shipped)
        if _object(shipped, ours.about["config"]) == config:
            _check_shapes(file, ours)
    _check_written(file, file.about.get("weights"), file.about["config"])
    _check_built(file, config)
    return file


def _check_built(file: WeightFile, config: Mapping[str, Any]) -> None:
    """Check that the weights are of a network of these sizes, by their names and widths.

    The answers' own sizes are checked when the weights are read.
    """
    members = {name.split(".")[1] for name in file.shapes if name.startswith("members.")}
    fine, middle = config["blocks"]
    expected = {"fine": fine, "middle": middle, "blocks": config["depth"]}
    fits = len(members) == config.get("members", 0)
    for prefix in [f"members.{k}." for k in members] or [""]:
        own = [name for name in file.shapes if name.startswith(prefix)]
        parts = [name.removeprefix(prefix).split(".") for name in own]
        found = {kind: len({p[1] for p in parts if p[0] == kind}) for kind in expected}
        layers = (f"{prefix}{layer}.bias" for layer in ("stem", "down1", "down2"))
        widths = [file.shapes.get(layer) for layer in layers]
        fits = fits and found == expected and widths == [(w,) for w in config["channels"]]
    if not fits:
        what = "damaged (the weights are not those of its network)"
        raise ModelError(file.path, what)


def _check_sizes(where: Path, config: Mapping[str, Any], sizes: Sizes) -> None:
    """Check what a header says of its network, before one is built."""
    if set(config) != set(sizes):
        raise ModelError(where, "its header is damaged (other sizes of a network than expected)")
    for name, (fewest, most, kind, low, high) in sizes.items():
        numbers = config[name] if most > 1 else [config[name]]
        if (
            not isinstance(numbers, list)
            or not fewest <= len(numbers) <= most
            or any(type(n) not in (int, kind) or not low <= n <= high for n in numbers)
        ):
            count = f"{fewest} to {most}" if fewest < most else f"{fewest}"
            expected = f"a list of {count} numbers" if most > 1 else "one number"
            found = f"network: {name} {config[name]!r:.60}"
            raise ModelError(where, f"{found} (expected {expected} from {low} to {high})")


def check_lora(path: Path, embedding_width: int | None) -> None:
    """Check by its names and shapes that a file holds a LoRA of a UNet, and of this base model.

    Args:
        path: The file, with keys of diffusers, kohya or peft.
        embedding_width: Channels of the base model's prompts; None: it is not known yet.

    Raises:
        ModelError: Damaged, something else, of rank 0, or made for another base.
    """
    file = read_header(path)
    named = {key.removeprefix("base_model.model."): s for key, s in file.shapes.items()}
    if any(key.startswith(_FOR_TEXT) for key in named):
        what = "adapts the text encoder too, which stays as it is here"
        raise ModelError(path, what, "give a LoRA of the UNet alone")
    layers: dict[str, dict[str, tuple[int, ...]]] = {}
    odd = []
    for key, shape in named.items():
        if (found := _LORA_PART.fullmatch(key)) is not None:
            part = {"down": "A", "up": "B"}.get(found[2], found[2])
            layers.setdefault(found[1], {})[part] = shape
        elif not key.endswith(".alpha"):
            odd.append(key)
        elif math.prod(shape) != 1:
            raise ModelError(path, f"{key}: shape {list(shape)} (expected one number)")
    if odd or not layers:
        raise not_a_lora(path, odd, len(named))
    for layer, parts in layers.items():
        if set(parts) != {"A", "B"}:
            what = f"{layer}: only one of its two parts is there; the file is not whole"
            raise ModelError(path, what)
        a, b = parts["A"], parts["B"]
        if len(a) not in (2, 4) or len(a) != len(b) or a[0] != b[1]:
            what = f"{layer}: its parts do not fit (found {list(a)}, {list(b)}; expected [r, i], "
            raise ModelError(path, f"{what}[o, r])")
        if a[0] == 0:
            raise ModelError(path, f"{layer}: rank 0 (expected at least 1)")
        is_cross = re.search(r"attn2[._](?:processor\.)?to_[kv]$", layer) is not None
        if is_cross and embedding_width not in (None, a[1]):
            what = f"made for another base model (found cross-attention {a[1]}; expected "
            advice = "give a LoRA that was trained on this model"
            raise ModelError(path, f"{what}{embedding_width})", advice)
    _check_finite(file)


def beside_lora(path: Path) -> Path | None:
    """Return peft's configuration where it lies beside a LoRA that peft wrote: its alpha counts."""
    beside = path.parent / "adapter_config.json"  # "/" and "." have no name to replace
    return beside if path.name == "adapter_model.safetensors" and beside.is_file() else None


def not_a_lora(path: Path, odd: list[str], count: int) -> ModelError:
    """Return the error for a file with `count` keys, of which `odd` are no LoRA's."""
    found = f"{len(odd)} of {count} keys are foreign, such as {odd[0]!r:.80}" if odd else "no keys"
    what = f"not a LoRA of a UNet (found {found}; expected diffusers, kohya or peft keys)"
    return ModelError(path, what)


def values_hash(values: Mapping[str, NDArray[Any]], about: str = "") -> str:
    """Return the sha256 of weights as they are written: names and values in order.

    Args:
        values: In the kind of number of the file.
        about: A text of the header that the weights mean nothing without.
    """
    digest = hashlib.sha256(about.encode())
    for name in sorted(values):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values[name]).tobytes())
    return digest.hexdigest()


def _check_written(file: WeightFile, expected: object, about: str = "") -> None:
    """Check that one of our networks has not too many values, all finite, of this `values_hash`."""
    count = sum(map(math.prod, file.shapes.values()))
    if count > NUMBERS_MAX:
        raise ModelError(file.path, f"{count} weights (expected at most {NUMBERS_MAX})")
    for name, kind in file.kinds.items():
        if kind not in OURS:
            raise ModelError(file.path, f"{name}: values are not finite numbers (found {kind})")
    _check_finite(file)
    digest, before = hashlib.sha256(about.encode()), None
    for name, piece in _pieces(file):
        digest.update(name.encode() if name != before else b"")
        digest.update(piece)
        before = name
    if digest.hexdigest() != expected:
        raise ModelError(file.path, "damaged (its weights are not those that were written)")


def _check_finite(file: WeightFile) -> None:
    """Check that a file's values are finite, in any kind of number that weights have."""
    for name, piece in _pieces(file):
        if file.kinds[name] in EXPONENTS:
            stored, bits = EXPONENTS[file.kinds[name]]
            mask = np.array(bits, stored)
            if bool(((np.frombuffer(piece, stored) & mask) == mask).any()):
                raise ModelError(file.path, f"{name}: values are not finite numbers")


def _pieces(file: WeightFile) -> Iterator[tuple[str, bytes]]:
    """Yield what tensors hold, by name in order, in pieces of whole numbers: at least one each."""
    try:
        with file.path.open("rb") as stream:
            start = 8 + int.from_bytes(stream.read(8), "little")
            header = json.loads(stream.read(start - 8))
            for name in sorted(file.shapes):
                first, last = header[name]["data_offsets"]
                stream.seek(start + first)
                for place in range(first, max(last, first + 1), PIECE):
                    piece = stream.read(min(PIECE, last - place))
                    if len(piece) < min(PIECE, last - place):
                        raise EOFError
                    yield name, piece
    except (EOFError, OSError, ValueError, LookupError) as error:  # somebody else has changed it
        raise ModelError(file.path, *fault_of(file.path)) from error


def _value(file: WeightFile, name: str) -> NDArray[Any] | None:
    """Return one tensor of a file that was checked; None: it is not there."""
    if name not in file.shapes:
        return None
    try:
        with safe_open(file.path, framework="np") as content:
            value: NDArray[Any] = content.get_tensor(name)
            return value
    except (SafetensorError, OSError, RuntimeError, TypeError, ValueError) as error:
        raise ModelError(file.path, *fault_of(file.path)) from error


def _check_shapes(file: WeightFile, ours: WeightFile) -> None:
    """Check names and shapes against those of the file that we ship for the same network."""
    names: Iterable[str] = sorted({*file.shapes, *ours.shapes})
    for name in names:
        found, expected = file.shapes.get(name), ours.shapes.get(name)
        if found != expected:
            what = f"{name}: shape {found} (expected {expected})"
            raise ModelError(file.path, f"the weights do not fit the network; {what}")


def _object(where: Path, text: str) -> dict[str, Any]:
    """Return a JSON object of the header."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ModelError(where, "its header is damaged (not JSON)") from error
    if not isinstance(content, dict):
        raise ModelError(where, "its header is damaged (not a JSON object)")
    return content
