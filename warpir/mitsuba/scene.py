"""Export of an insertion as a scene of Mitsuba 3, in the folder ``mitsuba`` of a run.

``scene.xml`` needs nothing but Mitsuba: meshes, camera, our light on Mitsuba's rows, and materials
as its ``principled``, the nearest of its own to glTF's; emission is left out. ``render.py`` renders
the same insertion with glTF's own material, shadow and tone curves (`warpir.mitsuba.render`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

import warpir
from warpir.app.inputs import Inputs
from warpir.core.arrays import CodeArray, Float64Array, FloatArray, IntArray
from warpir.core.color import linear_to_srgb, srgb_to_linear
from warpir.core.latlong import interpolate
from warpir.io.export import OBJECT
from warpir.io.images.writers import png_bytes
from warpir.io.results import OutputFolder
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import Camera, mitsuba_sensor

FOLDER = "mitsuba"
LEAST_ROWS, FINE_ROWS = 512, 2048
"""Least and greatest rows of a refined map, which otherwise has twice its own: irradiance is then
right to 2e-5."""


def write_mitsuba(
    output: OutputFolder, inputs: Inputs, texels: FloatArray, depth: int, bounce_depth: int
) -> None:
    """Stage the folder.

    Args:
        output: Output folder; ``render.py`` reads the files of the hand-off beside the new one.
        inputs: Camera, and the object with its place.
        texels: The light on the object, relative [W/(m^2 sr)], shape [He, 2 He, 3].
        depth: Surface interactions of the longest path.
        bounce_depth: Interactions of light that the object throws on the ground; 0 for none.

    Raises:
        InputError: The disk is full (exit 5).
    """
    rows = mitsuba_rows(texels)
    output.write_exr(f"{FOLDER}/envmap.exr", {c: rows[..., k] for k, c in enumerate("RGB")})
    scene = _Scene(output, inputs.asset, inputs.placement.asset_to_world)
    text = scene.xml(inputs.camera, depth)
    output.write_bytes(f"{FOLDER}/scene.xml", text.encode())
    ground = tuple(float(c) for c in inputs.placement.ground)
    program = _RENDER.format(ground=ground, depth=depth, bounce_depth=bounce_depth)
    output.write_bytes(f"{FOLDER}/render.py", program.encode())


_RENDER = '''\
"""Render this insertion with Mitsuba 3: python render.py --samples 256

Needs ``pip install warpir mitsuba`` and, on the CPU, an LLVM that Mitsuba finds (22 is tried; the
variable DRJIT_LIBLLVM_PATH names its library). Writes composite.png and composite.exr here.
"""

from pathlib import Path

from warpir.mitsuba.render import main

run = Path(__file__).resolve().parent.parent
main(run, ground={ground}, depth={depth}, bounce_depth={bounce_depth})
'''


def mitsuba_rows(texels: FloatArray) -> FloatArray:
    """Return our map on the rows of Mitsuba's ``envmap``, which run from pole to pole.

    Ours lie at texel centres, theirs (3.9.1) at latitude ``pi / 2 - pi i / (rows - 1)``; columns
    are at texel centres in both. Both read bilinearly.

    Args:
        texels: Radiance in our orientation, shape [He, 2 He, 3].
    """
    height = texels.shape[0]
    rows = max(height, min(max(2 * height, LEAST_ROWS), FINE_ROWS))
    columns = 2 * rows
    v = np.arange(rows) / (rows - 1) * height - 0.5
    u = (np.arange(columns) + 0.5) / columns * 2 * height - 0.5
    across, down = np.meshgrid(u, v)
    return interpolate(texels, across, down).astype(np.float32)


def ply_bytes(
    positions: Float64Array,
    indices: IntArray,
    normals: Float64Array | None,
    uv: FloatArray | None,
) -> bytes:
    """Return a mesh as a binary PLY.

    Args:
        positions: Shape [vertex, 3].
        indices: Shape [triangle, 3].
        normals: Unit, shape [vertex, 3].
        uv: Shape [vertex, 2].
    """
    columns = [*zip("xyz", positions.T, strict=True)]
    if normals is not None:
        columns += zip(("nx", "ny", "nz"), normals.T, strict=True)
    if uv is not None:
        columns += zip("uv", uv.T, strict=True)
    vertices = np.stack([column for _, column in columns], axis=1).astype("<f4")
    faces = np.empty(len(indices), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, indices
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(positions)}",
        *(f"property float {name}" for name, _ in columns),
        f"element face {len(indices)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes()


@dataclass
class _Scene:
    """Builder of ``scene.xml``, which stages meshes and textures."""

    output: OutputFolder
    asset: Asset
    asset_to_world: Float64Array
    textures: int = 0
    lines: list[str] = field(default_factory=list)

    def xml(self, camera: Camera, depth: int) -> str:
        """Return the whole text."""
        view = mitsuba_sensor(camera)
        self.lines = [
            f"<!-- warpir {warpir.__version__}: the object of ../{OBJECT} alone, over nothing; "
            "without its own emission, as Mitsuba hides what emits together with the sky. -->",
            '<scene version="3.0.0">',
            '<default name="spp" value="256"/>',
            '<integrator type="path">',
            f'    <integer name="max_depth" value="{depth + 1}"/>',
            '    <boolean name="hide_emitters" value="true"/>',
            "</integrator>",
            '<sensor type="perspective">',
            f'    <transform name="to_world"><matrix value="{_numbers(view["to_world"])}"/>'
            "</transform>",
            '    <string name="fov_axis" value="x"/>',
            f'    <float name="fov" value="{view["fov_deg"]!r}"/>',
            *(
                f'    <float name="{name}" value="{view[name]!r}"/>'
                for name in ("principal_point_offset_x", "principal_point_offset_y")
            ),
            '    <film type="hdrfilm">',
            f'        <integer name="width" value="{camera.width}"/>',
            f'        <integer name="height" value="{camera.height}"/>',
            '        <string name="pixel_format" value="rgba"/>',
            '        <rfilter type="box"/>',
            "    </film>",
            '    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>',
            "</sensor>",
            '<emitter type="envmap">',
            '    <string name="filename" value="envmap.exr"/>',
            "</emitter>",
        ]
        for k, primitive in enumerate(self.asset.primitives):
            self._shape(k, primitive)
        return "\n".join([*self.lines, "</scene>"]) + "\n"

    def _shape(self, index: int, primitive: Primitive) -> None:
        linear, offset = self.asset_to_world[:3, :3], self.asset_to_world[:3, 3]
        material = self.asset.materials[primitive.material]
        normals = None
        if primitive.normals is not None:
            normals = primitive.normals.astype(np.float64) @ np.linalg.inv(linear)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        name = f"mesh_{index:03d}.ply"
        uv = primitive.uv0
        if material.base_color_texture is not None and material.base_color_texture.uv_set == 1:
            uv = primitive.uv1
        mirrored = np.linalg.det(linear) < 0.0
        corners = primitive.indices[:, ::-1] if mirrored else primitive.indices
        content = ply_bytes(primitive.positions @ linear.T + offset, corners, normals, uv)
        self.output.write_bytes(f"{FOLDER}/{name}", content)
        self.lines += ['<shape type="ply">', f'    <string name="filename" value="{name}"/>']
        if normals is None:
            self.lines.append('    <boolean name="face_normals" value="true"/>')
        self._material(material)
        self.lines.append("</shape>")

    def _material(self, material: Material) -> None:
        """Write the nearest ``principled``, under a mask and a normal map if there are any."""
        open_tags = 1
        self.lines.append(f"    <!-- {_comment(material.name)} -->")
        if material.alpha_mode != "OPAQUE":
            self.lines.append('    <bsdf type="mask">')
            self._opacity(material)
            open_tags += 1
        self.lines.append('    <bsdf type="twosided">')
        if material.normal_texture is not None:
            self.lines.append('    <bsdf type="normalmap">')
            self._bitmap(
                "normalmap", self._pixels(material.normal_texture)[..., :3], material.normal_texture
            )
            open_tags += 1
        self.lines.append('    <bsdf type="principled">')
        base = material.base_color_texture
        if base is None:
            value = " ".join(repr(float(c)) for c in material.base_color)
            self.lines.append(f'    <rgb name="base_color" value="{value}"/>')
        else:
            linear = srgb_to_linear(self._pixels(base)[..., :3] / 255.0) * material.base_color
            codes = np.round(linear_to_srgb(np.clip(linear, 0.0, 1.0)) * 255.0).astype(np.uint8)
            self._bitmap("base_color", codes, base, is_color=True)
        shared = material.metallic_roughness_texture
        self._value("roughness", shared, 1, material.roughness)
        self._value("metallic", shared, 2, material.metallic)
        self.lines += ["    </bsdf>"] * (open_tags + 1)

    def _opacity(self, material: Material) -> None:
        """Write the coverage, cut where the material says so."""
        slot, alpha = material.base_color_texture, material.alpha
        if material.alpha_mode != "MASK":
            self._value("opacity", slot, 3, alpha)
        elif slot is None:
            self._value("opacity", None, 3, float(alpha >= material.alpha_cutoff))
        else:
            is_there = self._pixels(slot)[..., 3] / 255.0 * alpha >= material.alpha_cutoff
            self._bitmap("opacity", np.where(is_there, 255, 0).astype(np.uint8), slot)

    def _value(self, name: str, slot: TextureSlot | None, channel: int, factor: float) -> None:
        """Write a number, or a factor times one channel of a texture as a grey picture."""
        if slot is None:
            self.lines.append(f'    <float name="{name}" value="{factor!r}"/>')
            return
        codes = np.round(self._pixels(slot)[..., channel] * factor).astype(np.uint8)
        self._bitmap(name, codes, slot)

    def _bitmap(
        self, name: str, codes: CodeArray, slot: TextureSlot, is_color: bool = False
    ) -> None:
        file = f"texture_{self.textures:03d}.png"
        self.textures += 1
        self.output.write_bytes(f"{FOLDER}/{file}", png_bytes(codes, None, False, ""))
        texture: Texture = self.asset.textures[slot.texture]
        a, b, c, d, e, f = slot.transform
        uv = np.array([[a, b, 0.0, c], [d, e, 0.0, f], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        self.lines += [
            f'    <texture type="bitmap" name="{name}">',
            f'        <string name="filename" value="{file}"/>',
            f'        <boolean name="raw" value="{str(not is_color).lower()}"/>',
            f'        <string name="wrap_mode" value="{texture.wrap_u}"/>',
            f'        <transform name="to_uv"><matrix value="{_numbers(uv)}"/></transform>',
            "    </texture>",
        ]

    def _pixels(self, slot: TextureSlot) -> CodeArray:
        return self.asset.textures[slot.texture].pixels


def _comment(text: str) -> str:
    """Return a name from a file as XML allows it in a comment: it cannot end the comment."""
    return re.sub("-{2,}", "-", "".join(c if c.isprintable() else " " for c in text))[:200]


def _numbers(matrix: Float64Array) -> str:
    return " ".join(repr(float(v) + 0.0) for v in matrix.ravel())
