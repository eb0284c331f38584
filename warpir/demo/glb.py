"""Writes an asset as a binary glTF 2.0 file."""

import io
import json
import struct
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from PIL import Image

from warpir.asset import Asset, Material, TextureSlot

FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


def _texture(slot: TextureSlot) -> dict[str, int]:
    return {"index": slot.texture, "texCoord": slot.uv_set}


def _material(material: Material) -> dict[str, Any]:
    pbr: dict[str, Any] = {
        "baseColorFactor": [*material.base_color, material.alpha],
        "metallicFactor": material.metallic,
        "roughnessFactor": material.roughness,
    }
    if material.base_color_texture is not None:
        pbr["baseColorTexture"] = _texture(material.base_color_texture)
    entry: dict[str, Any] = {"name": material.name, "pbrMetallicRoughness": pbr}
    if any(material.emission):
        entry["emissiveFactor"] = list(material.emission)
    if material.alpha_mode != "OPAQUE":
        entry["alphaMode"] = material.alpha_mode
    if material.double_sided:
        entry["doubleSided"] = True
    return entry


def write_glb(asset: Asset, path: Path) -> None:
    """Write an asset of factors, base-colour textures and one UV set.

    Args:
        asset: What to write; one mesh with one primitive per entry.
        path: The ``.glb`` file, replaced when it exists.
    """
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []
    binary = bytearray()

    def add_view(content: bytes, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)}
        if target is not None:
            view["target"] = target
        views.append(view)
        binary.extend(content + b"\0" * (-len(content) % 4))
        return len(views) - 1

    def add_accessor(array: NDArray[Any], kind: str, component: int, target: int) -> int:
        accessor: dict[str, Any] = {
            "bufferView": add_view(array.tobytes(), target),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if kind == "VEC3":
            accessor["min"] = array.min(axis=0).tolist()
            accessor["max"] = array.max(axis=0).tolist()
        accessors.append(accessor)
        return len(accessors) - 1

    primitives = []
    for p in asset.primitives:
        attributes = {"POSITION": (p.positions.astype("<f4"), "VEC3")}
        if p.normals is not None:
            attributes["NORMAL"] = (p.normals.astype("<f4"), "VEC3")
        if p.uv0 is not None:
            attributes["TEXCOORD_0"] = (p.uv0.astype("<f4"), "VEC2")
        short = len(p.positions) < 65535
        indices = p.indices.ravel().astype("<u2" if short else "<u4")
        primitives.append(
            {
                "attributes": {
                    name: add_accessor(array, kind, FLOAT, ARRAY_BUFFER)
                    for name, (array, kind) in attributes.items()
                },
                "indices": add_accessor(
                    indices,
                    "SCALAR",
                    UNSIGNED_SHORT if short else UNSIGNED_INT,
                    ELEMENT_ARRAY_BUFFER,
                ),
                "material": p.material,
            }
        )
    images = []
    for texture in asset.textures:
        encoded = io.BytesIO()
        Image.fromarray(texture.pixels).save(encoded, "PNG", optimize=True)
        images.append({"bufferView": add_view(encoded.getvalue()), "mimeType": "image/png"})

    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "warpir.demo"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": asset.name}],
        "meshes": [{"name": asset.name, "primitives": primitives}],
        "materials": [_material(m) for m in asset.materials],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    if images:
        document |= {
            "images": images,
            "samplers": [{}],
            "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, total)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + bytes(binary)
    )
