"""Writes an asset, as it stands in the photo's world, as binary glTF 2.0 (``.glb``).

The counterpart of `warpir.io.gltf.reader`: what that module reads from a file of this one are the
same arrays. Positions are stored as float32, everything else as the `Asset` holds it; textures
become PNG inside the file. Equal assets give equal bytes. Layout and limits:
https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

import io
import json
import math
import struct
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import warpir
from warpir.core.arrays import (
    CodeArray,
    Float64Array,
    FloatArray,
    PixelArray,
    affine_matrix,
    on_cores,
)
from warpir.core.errors import InputError
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import Camera

FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
LINEAR, LINEAR_MIPMAP_LINEAR = 9729, 9987
GLB_BYTES = (1 << 32) - 1
"""Largest ``.glb`` [byte]: its length is a 32-bit number."""
FAR = 64.0
"""An object this many times its own size away from its origin loses digits in float32 [1]."""
NEAR = 0.01
"""Near plane of the written camera [m]; glTF demands one, rays have none."""
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
Members = dict[str, Any]


def write_glb(asset: Asset, asset_to_world: Float64Array, camera: Camera | None = None) -> bytes:
    """Return an asset as one binary glTF 2.0 file.

    The scene has a node for the object and, with ``camera``, one for it. ``asset.extras`` of the
    file holds the asset's name and what its reader repaired, assumed or left out.

    Args:
        asset: What to write: one mesh, with one primitive per entry of ``asset.primitives``.
        asset_to_world: From the asset's frame to the world: translation, rotation and scale,
            column vectors [m], shape [4, 4].
        camera: The photo's camera. glTF knows no principal point: the picture is centred, and the
            camera's ``extras`` hold all its numbers.

    Raises:
        InputError: The file would be longer than the format allows.
    """
    file = _Glb()
    center = float32_center(asset)
    placed = asset_to_world @ affine_matrix(np.eye(3), center)
    nodes = [{"name": asset.name, "mesh": 0} | _matrix(placed)]
    document: Members = {
        "asset": {
            "version": "2.0",
            "generator": f"warpir {warpir.__version__}",
            "extras": {"object": asset.name, "notices": list(asset.notices)},
        },
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [
            {
                "name": asset.name,
                "primitives": [_primitive(file, asset, p, center) for p in asset.primitives],
            }
        ],
        "materials": [_material(file, _in_world(m, asset_to_world)) for m in asset.materials],
    }
    if camera is not None:
        document["cameras"] = [_camera(camera)]
        document["scenes"][0]["nodes"].append(1)
        nodes.append({"name": "camera", "camera": 0} | _matrix(camera.c2w))
    if asset.textures:
        document |= _textures(file, asset.textures)
    if file.extensions:
        document["extensionsUsed"] = sorted(file.extensions)
    return file.pack(document, asset.name)


def _in_world(m: Material, asset_to_world: Float64Array) -> Material:
    """Return a material whose attenuation distance is one of the world, as glTF's is.

    The renderer's is one of the asset and grows with it; the thickness is one of the mesh in both.
    """
    scale = float(np.linalg.norm(asset_to_world[:3, 0]))
    return replace(m, attenuation_distance=m.attenuation_distance * scale)


def float32_center(asset: Asset) -> Float64Array:
    """Return what is subtracted from the positions so that float32 keeps them, shape [3].

    Zero unless the object is far from its origin; the object's node adds it again.
    """
    low, high = asset.bounds()
    farthest = float(np.maximum(np.abs(low), np.abs(high)).max())
    if farthest <= FAR * float((high - low).max()):
        return np.zeros(3)
    center: Float64Array = (low + high) / 2.0
    return center


@dataclass
class _Glb:
    """The binary chunk as it grows, what refers to it, and the extensions in use."""

    parts: list[bytes] = field(default_factory=list)
    length: int = 0
    views: list[Members] = field(default_factory=list)
    accessors: list[Members] = field(default_factory=list)
    extensions: set[str] = field(default_factory=set)

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes, aligned to 4, and return the index of their buffer view."""
        view = {"buffer": 0, "byteOffset": self.length, "byteLength": len(content)}
        self.views.append(view if target is None else view | {"target": target})
        padding = b"\0" * (-len(content) % 4)
        self.parts += [content, padding]
        self.length += len(content) + len(padding)
        return len(self.views) - 1

    def accessor(self, elements: PixelArray, target: int = ARRAY_BUFFER, **more: Any) -> int:
        """Append an array, shape [count] or [count, width], and return its accessor's index."""
        width = elements.shape[1] if elements.ndim == 2 else 1
        component = {"f": FLOAT, "u": UNSIGNED_SHORT if elements.itemsize == 2 else UNSIGNED_INT}
        accessor = {
            "bufferView": self.view(elements.tobytes(), target),
            "componentType": component[elements.dtype.kind],
            "count": len(elements),
            "type": "SCALAR" if width == 1 else f"VEC{width}",
        }
        self.accessors.append(accessor | more)
        return len(self.accessors) - 1

    def extension(self, name: str, members: Members) -> Members:
        """Return the extension as a member of ``extensions``; nothing when it says nothing."""
        if not members:
            return {}
        self.extensions.add(name)
        return {name: members}

    def pack(self, document: Members, name: str) -> bytes:
        """Return the whole file."""
        document |= {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self.length
        if total > GLB_BYTES:
            raise InputError(
                name, f"too large for .glb (found {total} bytes; limit {GLB_BYTES})", "decimate it"
            )
        return b"".join(
            (
                struct.pack("<4sII", b"glTF", 2, total),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", self.length, b"BIN\0"),
                *self.parts,
            )
        )


def _matrix(matrix: Float64Array) -> Members:
    """Return a node's ``matrix`` (columns first); glTF asks to leave the identity out."""
    if np.array_equal(matrix, np.eye(4)):
        return {}
    return {"matrix": matrix.T.ravel().tolist()}


def _camera(camera: Camera) -> Members:
    extras = {key: value for key, value in camera.record().items() if key != "c2w"}
    if (camera.cx, camera.cy) != (camera.width / 2.0, camera.height / 2.0):
        extras["note"] = "the principal point (cx, cy) [px] is off the centre; glTF cannot say that"
    return {
        "name": "camera",
        "type": "perspective",
        "perspective": {
            "yfov": 2.0 * math.atan(camera.height / 2.0 / camera.fy),
            "aspectRatio": (camera.width / camera.fx) / (camera.height / camera.fy),
            "znear": NEAR,
        },
        "extras": extras,
    }


def _primitive(file: _Glb, asset: Asset, p: Primitive, center: Float64Array) -> Members:
    vertex_count = len(p.positions)
    positions = (p.positions - center).astype("<f4")
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {"POSITION": file.accessor(positions, **bounds)}
    # Without normals the specification ignores tangents.
    uvs = {f"TEXCOORD_{k}": uv for k, uv in enumerate(_uv_sets(asset, p))}
    tangents = None if p.normals is None else p.tangents
    for name, stored in {
        "NORMAL": p.normals,
        "TANGENT": tangents,
        **uvs,
        "COLOR_0": p.colors,
    }.items():
        if stored is not None:
            attributes[name] = file.accessor(stored.astype("<f4", copy=False))
    # The highest value of each integer type means "restart" and is not an index.
    indices = p.indices.ravel().astype("<u2" if vertex_count <= 65535 else "<u4")
    return {
        "attributes": attributes,
        "indices": file.accessor(indices, ELEMENT_ARRAY_BUFFER),
        "material": p.material,
    }


def _uv_sets(asset: Asset, p: Primitive) -> list[FloatArray | None]:
    """Return both sets of texture coordinates; zero where glTF demands one that is absent.

    It does for a set that the material reads, and for the first where there is a second.
    """
    needed = {slot.uv_set for slot in asset.materials[p.material].texture_slots()}
    if p.uv1 is not None or 1 in needed:
        needed.add(0)
    zero = np.zeros((len(p.positions), 2), dtype=np.float32)
    sets = (p.uv0, p.uv1)
    return [zero if uv is None and k in needed else uv for k, uv in enumerate(sets)]


def _material(file: _Glb, m: Material) -> Members:
    pbr = {
        "baseColorFactor": [*m.base_color, m.alpha],
        "metallicFactor": m.metallic,
        "roughnessFactor": m.roughness,
        **_texture(file, m, "base_color", "baseColorTexture"),
        **_texture(file, m, "metallic_roughness", "metallicRoughnessTexture"),
    }
    # A power of two, so that factor times strength is the emission to the last bit.
    strength = 2.0 ** max(math.ceil(math.log2(max(*m.emission, 1.0))), 0)
    emission: Members = {}
    if any(m.emission):
        emission = {"emissiveFactor": [e / strength for e in m.emission]}
        emission |= _texture(file, m, "emission", "emissiveTexture")
    return {
        **_unless("", name=m.name),
        "pbrMetallicRoughness": pbr,
        **_texture(file, m, "normal", "normalTexture", scale=m.normal_scale),
        **emission,
        **_unless("OPAQUE", alphaMode=m.alpha_mode),
        **({"alphaCutoff": m.alpha_cutoff} if m.alpha_mode == "MASK" else {}),
        **_unless(False, doubleSided=m.double_sided),
        **_unless({}, extensions=_material_extensions(file, m, strength)),
    }


def _material_extensions(file: _Glb, m: Material, strength: float) -> Members:
    """Return what of a material differs from the defaults of its extensions."""
    extensions = {
        "KHR_materials_emissive_strength": _unless(1.0, emissiveStrength=strength),
        "KHR_materials_ior": _unless(1.5, ior=m.ior),
        "KHR_materials_specular": _unless(1.0, specularFactor=m.specular)
        | _unless([1.0] * 3, specularColorFactor=list(m.specular_color))
        | _texture(file, m, "specular", "specularTexture")
        | _texture(file, m, "specular_color", "specularColorTexture"),
        "KHR_materials_clearcoat": _unless(0.0, clearcoatFactor=m.clearcoat)
        | _unless(0.0, clearcoatRoughnessFactor=m.clearcoat_roughness)
        | _texture(file, m, "clearcoat", "clearcoatTexture")
        | _texture(file, m, "clearcoat_roughness", "clearcoatRoughnessTexture")
        | _texture(
            file, m, "clearcoat_normal", "clearcoatNormalTexture", scale=m.clearcoat_normal_scale
        ),
        "KHR_materials_sheen": _unless([0.0] * 3, sheenColorFactor=list(m.sheen_color))
        | _unless(0.0, sheenRoughnessFactor=m.sheen_roughness)
        | _texture(file, m, "sheen_color", "sheenColorTexture")
        | _texture(file, m, "sheen_roughness", "sheenRoughnessTexture"),
        "KHR_materials_transmission": _unless(0.0, transmissionFactor=m.transmission)
        | _texture(file, m, "transmission", "transmissionTexture"),
        "KHR_materials_anisotropy": _unless(0.0, anisotropyStrength=m.anisotropy)
        | _unless(0.0, anisotropyRotation=m.anisotropy_rotation)
        | _texture(file, m, "anisotropy", "anisotropyTexture"),
        "KHR_materials_iridescence": _unless(0.0, iridescenceFactor=m.iridescence)
        | _unless(1.3, iridescenceIor=m.iridescence_ior)
        | _unless(100.0, iridescenceThicknessMinimum=m.iridescence_thickness[0])
        | _unless(400.0, iridescenceThicknessMaximum=m.iridescence_thickness[1])
        | _texture(file, m, "iridescence", "iridescenceTexture")
        | _texture(file, m, "iridescence_thickness", "iridescenceThicknessTexture"),
        "KHR_materials_volume": _unless(0.0, thicknessFactor=m.thickness)
        | _unless(math.inf, attenuationDistance=m.attenuation_distance)
        | _unless([1.0] * 3, attenuationColor=list(m.attenuation_color)),
    }
    used: Members = {}
    for name, members in extensions.items():
        used |= file.extension(name, members)
    return used


def _unless(default: Any, **member: Any) -> Members:
    """Return a member where it differs from its default."""
    return {key: value for key, value in member.items() if value != default}


def _texture(file: _Glb, m: Material, slot: str, key: str, **more: float) -> Members:
    """Return the member of the texture that a material reads as ``slot``, if it has one."""
    texture: TextureSlot | None = getattr(m, f"{slot}_texture")
    return {} if texture is None else {key: _texture_info(file, texture, m.name) | more}


def _texture_info(file: _Glb, slot: TextureSlot, name: str) -> Members:
    info: Members = {"index": slot.texture}
    if slot.uv_set:
        info["texCoord"] = slot.uv_set
    if slot.transform != IDENTITY:
        a, b, c, d, e, f = slot.transform
        # As the reader composes it: a = cos sx, b = sin sy, d = -sin sx, e = cos sy.
        angle = 0.0 if b == d == 0.0 else math.atan2(-d, a) if a or d else math.atan2(b, e)
        sine, cosine = math.sin(angle), math.cos(angle)
        scale = [a, e] if angle == 0.0 else [a * cosine - d * sine, b * sine + e * cosine]
        if abs(a * b + d * e) > 1e-6 * (abs(a) + abs(d)) * (abs(b) + abs(e)):
            raise ValueError(f"material {name!r}: texture coordinates are sheared, glTF cannot")
        members: Members = {"offset": [c, f], "rotation": angle, "scale": scale}
        defaults: Members = {"offset": [0.0, 0.0], "rotation": 0.0, "scale": [1.0, 1.0]}
        stated = {key: value for key, value in members.items() if value != defaults[key]}
        info["extensions"] = file.extension("KHR_texture_transform", stated)
    return info


def _textures(file: _Glb, textures: tuple[Texture, ...]) -> Members:
    """Return images, samplers and textures; equal ones are written once."""
    pixels = {id(texture.pixels): texture.pixels for texture in textures}
    views = [file.view(image) for image in on_cores(png, pixels.values())]
    image_of = {key: k for k, key in enumerate(pixels)}
    samplers: dict[tuple[str, str], int] = {}
    entries: list[Members] = []
    for texture in textures:
        wraps = texture.wrap_u, texture.wrap_v
        sampler = samplers.setdefault(wraps, len(samplers))
        entries.append({"source": image_of[id(texture.pixels)], "sampler": sampler})
    filters = {"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR}
    return {
        "images": [{"bufferView": view, "mimeType": "image/png"} for view in views],
        "samplers": [filters | {"wrapS": WRAPS[u], "wrapT": WRAPS[v]} for u, v in samplers],
        "textures": entries,
    }


def png(pixels: CodeArray) -> bytes:
    """Return RGBA codes, shape [height, width, 4], as PNG; without alpha where all is opaque."""
    from PIL import Image

    stream = io.BytesIO()
    opaque = bool((pixels[..., 3] == 255).all())
    # A third of the default level's time for a fifth more bytes.
    Image.fromarray(pixels[..., :3] if opaque else pixels).save(stream, "PNG", compress_level=1)
    return stream.getvalue()
