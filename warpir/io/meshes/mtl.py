"""Reads the material files of OBJ (MTL) into `Material`.

Physically based keys are used where the file has them (``Pr Pm Ke norm`` and their maps; ``Pc Pcr
Ps Ni`` without maps; as in https://benhouston3d.com/blog/extended-wavefront-obj-mtl-for-pbr/).
``bsdf pbr`` (nvdiffrec) makes ``Ks`` mean (occlusion, roughness, metallic). What older files leave
open is assumed and noted. OBJ knows no back faces, so all materials are double-sided.
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from warpir.core.arrays import CodeArray
from warpir.core.errors import Faults, InputError, shown
from warpir.core.limits import Limits
from warpir.io.meshes.asset_files import (
    GREY,
    TextureDecoder,
    grey_pixels,
    inside,
    plain_material,
    read_regular,
)
from warpir.io.meshes.materials_file import EMISSION_LIMIT
from warpir.scene.asset import Material, Texture, TextureSlot

MTL = Faults(
    "mtl",
    {
        "map": "map without a file name",
        "number": "{found!r}, expected {expected}",
        "range": "Ke {found:g}, expected at most {limit:g}",
    },
)
"""What a file may have wrong; ``pointer`` is the file and the line, or the material."""
ROUGHNESS = 0.5
"""Roughness where the file states none."""
OPTION_WIDTHS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1,
    "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-type": 1,
}  # fmt: skip
"""How many values follow an option of a map, at most."""
NUMBERS = ("kd", "ks", "ke", "ns", "ni", "d", "tr", "pr", "pm", "pc", "pcr", "ps")
"""Statements whose numbers are read."""
MAPS = ("map_kd", "map_d", "map_pr", "map_pm", "map_ke", "map_bump", "norm")
"""Maps that are read; ``bsdf pbr`` has map_Ks too."""
MEANINGLESS = ("ka", "illum", "sharpness")
"""Statements that say nothing to a path tracer."""
HONOURED_OPTIONS = {"-bm", "-clamp", "-o", "-s", "-type"}


@dataclass(frozen=True)
class MapStatement:
    """One ``map_...`` line: a file and how it is laid on the surface."""

    name: str
    """File name as written, ``/`` between folders, relative to the OBJ's folder."""
    clamp: bool = False
    bump: float = 1.0
    """Factor of ``-bm`` [1]."""
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    def slot(self, texture: int) -> TextureSlot:
        """Return the slot that reads ``texture`` this way; v is turned from up to down."""
        (su, sv), (ou, ov) = self.scale, self.offset
        return TextureSlot(texture, 0, (su, 0.0, ou, 0.0, sv, 1.0 - sv - ov))


@dataclass
class MtlEntry:
    """The statements of one ``newmtl``."""

    numbers: dict[str, tuple[float, ...]] = field(default_factory=dict)
    maps: dict[str, MapStatement] = field(default_factory=dict)
    is_pbr: bool = False
    """Whether ``bsdf pbr`` was stated."""
    left_out: list[str] = field(default_factory=list)
    """Other statements, which may matter to the picture."""

    def number(self, key: str, default: float) -> float:
        """Return the first number of a statement."""
        return self.numbers.get(key, (default,))[0]


@dataclass(frozen=True)
class Layer:
    """What one map adds to a texture that is made of several."""

    statement: MapStatement
    pixels: CodeArray
    """RGBA codes, shape [height, width, 4]."""
    to: int | slice
    """Channels that are written."""
    of: int | slice
    """Channels of the map that they come from."""


class MaterialLibrary:
    """The materials of one OBJ file; only those asked for are built.

    Missing textures are an ``error``, or ``grey``. ``notices`` receives what was assumed or left
    out, ``hashes`` the sha256 of every file that is read.
    """

    def __init__(
        self,
        path: Path,
        missing_textures: str,
        notices: list[str],
        hashes: dict[str, str],
        limits: Limits,
    ) -> None:
        self.path = path
        self.missing_textures = missing_textures
        self.notices = notices
        self.hashes = hashes
        self.materials: list[Material] = []
        self.textures: list[Texture] = []
        self._entries: dict[str, MtlEntry] = {}
        self._index: dict[str, int] = {}
        self._limits = limits
        self._decoder = TextureDecoder(path, notices, limits)
        self._pixels: dict[str, CodeArray | None] = {}
        self._is_grey: dict[str, bool] = {}
        self._texture_index: dict[tuple[str, ...], int] = {}
        """By what a texture is for, the maps that it is made of, and how it is repeated."""

    def add(self, names: str) -> None:
        """Read the files of an ``mtllib`` line: one name with spaces, or several names.

        Raises:
            InputError: A file is missing (unless missing textures are allowed), outside the
                folder, or damaged.
        """
        names = names.replace("\\", "/")
        whole = inside(names, self.path, "mtllib ")
        for name in [names] if os.path.exists(whole) else names.split():
            file = inside(name, self.path, "mtllib ")
            try:
                content = read_regular(file, self.path, self._limits, "mtllib ", hashes=self.hashes)
            except InputError as error:
                if self.missing_textures != "grey":
                    error.advice = "add it, or pass --missing-textures grey"
                    raise
                self.notices.append(f"{error.what}: its materials are grey")
                continue
            self._parse(content, name)

    def index(self, name: str, white: bool = False) -> int:
        """Return the index in ``materials`` of a ``usemtl`` name, empty when the OBJ states none.

        An unstated material is grey, or ``white`` where vertex colours are.
        """
        if name not in self._index:
            entry = self._entries.get(name)
            if entry is None:
                grey = (1.0, 1.0, 1.0) if white else GREY
                material = plain_material(name or "grey", grey)
                self.notices.append(
                    f"no material {name!r}: base colour {grey[0]:g}, metallic 0, roughness 0.5"
                )
            else:
                material = self._build(name, entry)
            self._index[name] = len(self.materials)
            self.materials.append(material)
        return self._index[name]

    def _parse(self, content: bytes, file: str) -> None:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
        entry = MtlEntry()
        for line, raw in enumerate(text.splitlines(), 1):
            where = f"{file} line {line}"
            words = raw.partition("#")[0].split()
            if not words:
                continue
            key = words[0].lower()
            # Names may hold blanks and "#" (3ds Max: "Material #1").
            rest = raw.strip()[len(key) :].strip()
            if key == "newmtl":
                if rest in self._entries:
                    self.notices.append(
                        f"{where}: {rest[:60]!r} defined again, the last one counts"
                    )
                entry = self._entries[rest] = MtlEntry()
            elif key == "bsdf":
                entry.is_pbr = words[1:2] == ["pbr"]
            elif key.startswith("map_") or key in ("norm", "bump"):
                key = "map_bump" if key == "bump" else key
                entry.maps[key] = self._parse_map(rest, where, str(PurePosixPath(file).parent))
            elif key in NUMBERS:
                values = words[2:] if words[1:2] == ["-halo"] else words[1:]
                if key[0] == "k" and (len(values) == 2 or values[:1] in (["spectral"], ["xyz"])):
                    raise self._bad_number(where, raw, "RGB")
                numbers = self._numbers(values[:3], where, raw)
                # One number stands for three, as in Kd 0.5.
                entry.numbers[key] = numbers * 3 if key[0] == "k" and len(numbers) == 1 else numbers
            elif key not in MEANINGLESS:
                entry.left_out.append(words[0])

    def _numbers(self, words: list[str], where: str, raw: str) -> tuple[float, ...]:
        try:
            numbers = tuple(float(word) for word in words)
        except ValueError:
            numbers = ()
        if any("_" in word for word in words):  # Python reads 1_0 as 10
            numbers = ()
        if not numbers or not all(math.isfinite(number) for number in numbers):
            raise self._bad_number(where, raw, "finite numbers")
        return numbers

    def _bad_number(self, where: str, raw: str, expected: str) -> InputError:
        found = raw.strip()[:60]
        return MTL.error(self.path, "number", pointer=where, found=found, expected=expected)

    def _parse_map(self, rest: str, where: str, folder: str) -> MapStatement:
        """Read options and file name; the name may contain spaces."""
        options: dict[str, list[str]] = {}
        while (option := first_word(rest)[0].lower()) in OPTION_WIDTHS:
            _, rest = first_word(rest)
            values: list[str] = []
            while rest and len(values) < OPTION_WIDTHS[option]:
                word, tail = first_word(rest)
                # -s, -o, -t take one to three numbers; the name follows.
                if values and not is_number(word):
                    break
                values.append(word)
                rest = tail
            options[option] = values
            if option not in HONOURED_OPTIONS:
                self.notices.append(f"{where}: {option} {' '.join(values)} ignored")
        if not rest:
            raise MTL.error(self.path, "map", pointer=where)
        name = rest.replace("\\", "/")

        def pair(option: str, default: float) -> tuple[float, float]:
            values = options.get(option)
            if values is None:
                return default, default
            numbers = self._numbers(values, where, f"{option} {' '.join(values)}")
            return numbers[0], numbers[1] if len(numbers) > 1 else default

        return MapStatement(
            name=name if name.startswith("/") or folder == "." else f"{folder}/{name}",
            clamp=options.get("-clamp") == ["on"],
            bump=pair("-bm", 1.0)[0],
            scale=pair("-s", 1.0),
            offset=pair("-o", 0.0),
        )

    def _build(self, name: str, entry: MtlEntry) -> Material:
        maps = entry.maps
        base = self._base_slot(name, entry)
        roughness, metallic, surface = self._surface(name, entry)
        normal = maps.get("norm", maps.get("map_bump"))
        emission = self._color(name, entry, "ke", (0.0,) * 3)
        if max(emission) > EMISSION_LIMIT:
            where, found = f"material {shown(name)}", max(emission)
            raise MTL.error(self.path, "range", pointer=where, found=found, limit=EMISSION_LIMIT)
        color = self._color(name, entry, "kd", GREY)
        red, green, blue = (min(max(value, 0.0), 1.0) for value in color)
        if (red, green, blue) != color:
            self.notices.append(f"material {name!r}: Kd clamped to 0 ... 1")
        read = (*MAPS, "map_ks") if entry.is_pbr else MAPS
        left_out = [*entry.left_out, *(key for key in maps if key not in (*read, "map_ka"))]
        if left_out:
            self.notices.append(f"material {name!r}: {', '.join(left_out)[:80]} ignored")
        specular = entry.numbers.get("ks", (0.0,))
        if not entry.is_pbr and (np.ptp(specular) > 0.05 or max(specular) > 0.0 == max(color)):
            shown_ks = " ".join(f"{value:g}" for value in specular)
            self.notices.append(f"material {name!r}: Ks {shown_ks} ignored, a plain gloss is shown")
        sheen = self._share(name, "Ps", entry.number("ps", 0.0))
        if sheen > 0.0:
            self.notices.append(f"material {name!r}: sheen of roughness {ROUGHNESS} assumed")
        alpha = self._share(name, "opacity", self._opacity(name, entry))
        return Material(
            name=name,
            base_color=(red, green, blue),
            alpha=alpha,
            metallic=min(max(metallic, 0.0), 1.0),
            roughness=min(max(roughness, 0.0), 1.0),
            emission=(max(emission[0], 0.0), max(emission[1], 0.0), max(emission[2], 0.0)),
            # A cut at .5 of what is half there already would leave nothing.
            alpha_mode="BLEND" if alpha < 1 else "MASK" if "map_d" in maps else "OPAQUE",
            double_sided=True,
            normal_scale=1.0 if normal is None else normal.bump,
            ior=self._ior(name, entry),
            clearcoat=self._share(name, "Pc", entry.number("pc", 0.0)),
            clearcoat_roughness=self._share(name, "Pcr", entry.number("pcr", 0.0)),
            sheen_color=(sheen, sheen, sheen),
            sheen_roughness=ROUGHNESS if sheen > 0.0 else 0.0,
            base_color_texture=base,
            metallic_roughness_texture=surface,
            normal_texture=self._normal_slot(name, normal),
            emission_texture=self._whole_slot(maps.get("map_ke")),
        )

    def _color(
        self, name: str, entry: MtlEntry, key: str, default: tuple[float, ...]
    ) -> tuple[float, ...]:
        """Return a colour; with a map, an absent or black one means that the map alone counts."""
        value = entry.numbers.get(key)
        if f"map_{key}" in entry.maps and not any(value or ()):
            if value is not None:
                self.notices.append(f"material {name!r}: {key.title()} 0 with a map read as 1")
            return (1.0, 1.0, 1.0)
        if value is None and key == "kd":
            self.notices.append(f"material {name!r}: no Kd, grey {default[0]:g} assumed")
        return default if value is None else value

    def _share(self, name: str, what: str, value: float) -> float:
        """Return a number clamped to 0 ... 1, with a notice where that changes it."""
        if not 0.0 <= value <= 1.0:
            self.notices.append(f"material {name!r}: {what} {value:g} clamped to 0 ... 1")
        return min(max(value, 0.0), 1.0)

    def _opacity(self, name: str, entry: MtlEntry) -> float:
        """Return d, or else 1 - Tr; a Tr of 1 alone is how MeshLab and scanners write opaque."""
        transparency = entry.number("tr", 0.0)
        if transparency == 1.0 and "d" not in entry.numbers:
            self.notices.append(f"material {name!r}: Tr 1 without d read as opaque")
            return 1.0
        return entry.number("d", 1.0 - transparency)

    def _ior(self, name: str, entry: MtlEntry) -> float:
        """Return the index of refraction; exporters write 1 (and 0) for materials without one."""
        ior = entry.number("ni", 1.5)
        if ior > 1.0:
            return ior
        if ior not in (0.0, 1.0):
            self.notices.append(f"material {name!r}: Ni {ior:g} ignored, 1.5 is used")
        return 1.5

    def _surface(self, name: str, entry: MtlEntry) -> tuple[float, float, TextureSlot | None]:
        """Return roughness, metallic and the texture of both (G roughness, B metallic)."""
        numbers, maps = entry.numbers, entry.maps
        if entry.is_pbr:
            slot = self._whole_slot(maps.get("map_ks"))
            if slot is not None:
                return 1.0, 1.0, slot
            _, roughness, metallic = numbers.get("ks", (0.0, ROUGHNESS, 0.0))
            return roughness, metallic, None
        rough = self._layer(maps.get("map_pr"), 1)
        metal = self._layer(maps.get("map_pm"), 2)
        if "pr" in numbers and (numbers["pr"][0] or rough is None):
            roughness = numbers["pr"][0]
        elif rough is not None:
            roughness = 1.0
        elif "ns" in numbers:
            # Walter et al. 2007: a Blinn-Phong exponent Ns is about alpha = sqrt(2 / (Ns + 2)).
            roughness = (2.0 / (max(numbers["ns"][0], 0.0) + 2.0)) ** 0.25
            self.notices.append(f"material {name!r}: roughness {roughness:.2f} assumed from Ns")
        else:
            roughness = ROUGHNESS
            self.notices.append(f"material {name!r}: roughness {ROUGHNESS} assumed")
        metallic = entry.number("pm", 0.0)
        if metal is not None and metallic == 0.0:
            metallic = 1.0
        if rough and metal and rough.statement.slot(0) != metal.statement.slot(0):
            self.notices.append(f"material {name!r}: map_Pm laid on as map_Pr is")
        return roughness, metallic, self._combined(name, "surface", rough, metal)

    def _base_slot(self, name: str, entry: MtlEntry) -> TextureSlot | None:
        """Return the base colour texture, its alpha taken from ``map_d`` alone."""
        color_map, mask_map = entry.maps.get("map_kd"), entry.maps.get("map_d")
        color = self._layer(color_map, slice(0, 3), slice(0, 3))
        if color_map is not None and color is None:
            color = Layer(color_map, grey_pixels(), slice(0, 3), slice(0, 3))
        mask = self._layer(mask_map, 3)
        if mask is not None and bool((mask.pixels[..., 3] < 255).any()):
            # A mask inside the colour file is its alpha channel; a file of its own is grey.
            mask = replace(mask, of=3)
        return self._combined(name, "base colour", color, mask)

    def _normal_slot(self, name: str, statement: MapStatement | None) -> TextureSlot | None:
        """Return the normal map, None where the file is a height map."""
        pixels = self._load(statement)
        if statement is None or pixels is None:
            return None
        if statement.name not in self._is_grey:
            self._is_grey[statement.name] = not np.ptp(pixels[..., :3], axis=2).any()
        if self._is_grey[statement.name]:
            self.notices.append(f"material {name!r}: {statement.name} is a height map, left out")
            return None
        return self._whole_slot(statement)

    def _whole_slot(self, statement: MapStatement | None) -> TextureSlot | None:
        """Return the texture of one map, all its channels as they are."""
        pixels = self._load(statement)
        if statement is None or pixels is None:
            return None
        return self._slot(statement, ("plain", statement.name), lambda: pixels)

    def _layer(
        self, statement: MapStatement | None, to: int | slice, of: int | slice = 0
    ) -> "Layer | None":
        """Return what a map adds to a texture, None where there is none."""
        pixels = self._load(statement)
        if statement is None or pixels is None:
            return None
        return Layer(statement, pixels, to, of)

    def _combined(self, name: str, purpose: str, *parts: "Layer | None") -> TextureSlot | None:
        """Return the texture that some maps make together, white where none says anything."""
        layers = [part for part in parts if part is not None]
        if not layers:
            return None

        def combine() -> CodeArray:
            height = max(layer.pixels.shape[0] for layer in layers)
            width = max(layer.pixels.shape[1] for layer in layers)
            self._decoder.count(height * width, f"material {shown(name)}: ")
            texels = np.full((height, width, 4), 255, dtype=np.uint8)
            for layer in layers:
                texels[..., layer.to] = resized(layer.pixels, height, width)[..., layer.of]
            return texels

        names = ("" if part is None else part.statement.name for part in parts)
        return self._slot(layers[0].statement, (purpose, *names), combine)

    def _slot(
        self, statement: MapStatement, key: tuple[str, ...], make: Callable[[], CodeArray]
    ) -> TextureSlot:
        """Return how a texture is laid on, made once for all materials that use these maps."""
        wrap = "clamp" if statement.clamp else "repeat"
        key = (wrap, *key)
        if key not in self._texture_index:
            self._texture_index[key] = len(self.textures)
            self.textures.append(Texture(make(), wrap, wrap))
        return statement.slot(self._texture_index[key])

    def _load(self, statement: MapStatement | None) -> CodeArray | None:
        """Return the pixels of a map; None where none is stated, or it may be missing and is."""
        if statement is None:
            return None
        name = statement.name
        if name not in self._pixels:
            where = f"{name}: "
            file = inside(name, self.path)
            try:
                encoded = read_regular(
                    file, self.path, self._limits, "texture ", hashes=self.hashes
                )
                self._pixels[name] = self._decoder.decode(encoded, where)
            except InputError as error:
                if self.missing_textures != "grey":
                    error.advice = error.advice or "add the image, or pass --missing-textures grey"
                    raise
                self.notices.append(f"{error.what}: replaced by grey, or left out where no colour")
                self._pixels[name] = None
        return self._pixels[name]


def first_word(text: str) -> tuple[str, str]:
    """Return the first word of a text and what follows it, either may be empty."""
    word, *rest = text.split(maxsplit=1) or [""]
    return word, "".join(rest)


def is_number(word: str) -> bool:
    """Return whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def resized(pixels: CodeArray, height: int, width: int) -> CodeArray:
    """Repeat or drop texels to reach a size, shape [height, width, 4]."""
    rows = np.arange(height) * pixels.shape[0] // height
    columns = np.arange(width) * pixels.shape[1] // width
    scaled: CodeArray = pixels[rows][:, columns]
    return scaled
