"""A small valid glTF file, to be made wrong in one place."""

import base64
import io
import json
import struct
from typing import Any

import numpy as np
from PIL import Image

CODES = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}


TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


# A square in the plane z = 0, seen from +Z; corners counter-clockwise from the lower left.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype="f")


UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype="f")


NORMALS = np.tile(np.array([0, 0, 1], dtype="f"), (4, 1))


TWO = np.array([0, 1, 2, 0, 2, 3], dtype="H")


def png(color: tuple[int, ...] = (200, 100, 50), size: int = 2, kind: str = "PNG") -> bytes:
    """Return an encoded image of one colour."""
    stream = io.BytesIO()
    mode = "RGBA" if len(color) == 4 else "RGB"
    Image.new(mode, (size, size), color).save(
        stream, kind, **({"lossless": True} if kind == "WEBP" else {})
    )
    return stream.getvalue()


def pack_glb(text: bytes, binary: bytes) -> bytes:
    """Return a GLB with lengths that are right."""
    text, binary = text + b" " * (-len(text) % 4), binary + b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


class Builder:
    """A correct one-square glTF file; a test changes ``json`` or ``binary`` to plant a fault."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{"byteLength": 0}],
            "materials": [{"pbrMetallicRoughness": {}}],
        }
        self.primitive: dict[str, Any] = {
            "attributes": {
                "POSITION": self.accessor(CORNERS),
                "NORMAL": self.accessor(NORMALS),
                "TEXCOORD_0": self.accessor(UVS),
            },
            "indices": self.accessor(TWO),
            "material": 0,
        }
        self.json["meshes"].append({"primitives": [self.primitive]})

    def view(self, content: bytes, stride: int = 0) -> int:
        """Append bytes and return the index of their buffer view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        self.json["bufferViews"].append(view | ({"byteStride": stride} if stride else {}))
        self.binary += content
        self.json["buffers"][0]["byteLength"] = len(self.binary)
        return len(self.json["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, normalized: bool = False, stride: int = 0) -> int:
        """Append an array and return the index of its accessor."""
        rows = array.reshape(len(array), -1)
        content = rows.tobytes()
        if stride:
            content = b"".join(r.tobytes().ljust(stride, b"\xee") for r in rows)
        accessor = {
            "bufferView": self.view(content, stride),
            "componentType": CODES[array.dtype.char],
            "count": len(rows),
            "type": TYPES[rows.shape[1]],
        }
        if np.isfinite(array).all():  # NaN is not JSON
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.json["accessors"].append(accessor | ({"normalized": True} if normalized else {}))
        return len(self.json["accessors"]) - 1

    def attribute(self, name: str, array: np.ndarray, **options: Any) -> None:
        """Set a vertex attribute."""
        self.primitive["attributes"][name] = self.accessor(array, **options)

    def texture(self, image: dict[str, Any] | None = None, **sampler: Any) -> int:
        """Append a texture and return its index; its image is a PNG in the buffer by default."""
        image = image or {"bufferView": self.view(png()), "mimeType": "image/png"}
        for key in ("images", "textures", "samplers"):
            self.json.setdefault(key, [])
        self.json["images"].append(image)
        self.json["samplers"].append(sampler)
        self.json["textures"].append(
            {"source": len(self.json["images"]) - 1, "sampler": len(self.json["samplers"]) - 1}
        )
        return len(self.json["textures"]) - 1

    @property
    def material(self) -> dict[str, Any]:
        """The material of the square."""
        material: dict[str, Any] = self.json["materials"][0]
        return material

    @property
    def pbr(self) -> dict[str, Any]:
        """Its metallic-roughness block."""
        pbr: dict[str, Any] = self.material["pbrMetallicRoughness"]
        return pbr

    def base_color(self, image: dict[str, Any] | None = None, **sampler: Any) -> dict[str, Any]:
        """Give the material a base colour texture and return its texture info."""
        self.pbr["baseColorTexture"] = {"index": self.texture(image, **sampler)}
        info: dict[str, Any] = self.pbr["baseColorTexture"]
        return info

    def glb(self) -> bytes:
        """Return the file as ``.glb``."""
        return pack_glb(json.dumps(self.json).encode(), bytes(self.binary))

    def gltf(self) -> str:
        """Return the file as ``.gltf`` with its buffer inside."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.binary).decode()
        buffers = [self.json["buffers"][0] | {"uri": uri}]
        return json.dumps(self.json | {"buffers": buffers})
