"""Materials and textures of glTF 2.0, and the extensions that are honoured.

Textures keep their stored codes: colours and emission are sRGB-encoded, all others are plain
numbers. Occlusion maps are not read, since a path tracer makes its own.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from warpir.core.arrays import PixelArray
from warpir.core.errors import InputError
from warpir.io.gltf.gate import RE_EXPORT_MESH, Entry, GltfFile
from warpir.io.meshes.asset_files import TextureDecoder, grey_pixels, locate, read_uri
from warpir.io.meshes.materials_file import EMISSION_LIMIT
from warpir.scene.asset import Material, Texture, TextureSlot

HONOURED = {
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_volume",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
}
"""Extensions whose meaning reaches the picture."""
BASE_MATERIAL = {f"KHR_materials_{name}" for name in ("diffuse_transmission", "dispersion")}
"""Extensions that refine a material; the material below them is used, with a notice."""
LEFT_OUT = {
    "KHR_animation_pointer": "animations are not played",
    "KHR_materials_variants": "the default variant is used",
    "KHR_lights_punctual": "the lights of the file are not used",
    "KHR_xmp_json_ld": "metadata is not read",
}
"""Extensions that can be ignored even when required, and the notice."""
ADVICE = {
    "EXT_meshopt_compression": RE_EXPORT_MESH,
    "KHR_draco_mesh_compression": RE_EXPORT_MESH,
    "KHR_meshopt_compression": RE_EXPORT_MESH,
    "KHR_texture_basisu": "re-export with PNG or JPEG textures instead of KTX2",
}
"""What to do about an extension that is refused when required."""

SPECULAR_LIMIT = 1e6
"""Largest factor on the reflectance at normal incidence, which is cut at 1 [1]."""
FILM_LIMIT = 1e5
"""Greatest thickness of a film [nm] and of its index; interference is gone long before."""
WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = (9728, 9984, 9986)


def check_extensions(root: Entry, notices: list[str]) -> None:
    """Refuse required extensions that are not honoured; mention the others that are ignored."""
    names = {}
    for key in ("extensionsRequired", "extensionsUsed"):
        listed = root.value.get(key, [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise root.error("type", what=key, expected="a list of names")
        names[key] = dict.fromkeys(listed)
    for name in names["extensionsRequired"]:
        if name not in HONOURED | BASE_MATERIAL and name not in LEFT_OUT:
            advice = ADVICE.get(name, f"re-export without {name}")
            required = Entry(root.path, "/extensionsRequired", listed)
            raise required.error("extension", found=name, advice=advice)
    for name in names["extensionsUsed"]:
        if name in LEFT_OUT:
            notices.append(f"{name}: {LEFT_OUT[name]}")
        elif name not in HONOURED | BASE_MATERIAL:
            notices.append(f"{name} is not supported: what the file holds without it is used")


class MaterialReader:
    """Reads the materials that are drawn, and their textures, each once.

    Missing textures are an ``error`` or ``grey``; ``notices`` receives what was assumed or left
    out. One that ``measures`` only counts pixels, and decodes nothing.
    """

    def __init__(
        self,
        file: GltfFile,
        missing_textures: str,
        notices: list[str],
        measures: bool = False,
    ) -> None:
        self.file = file
        self.missing_textures = missing_textures
        self.notices = notices
        self.materials: list[Material] = []
        self.textures: list[Texture] = []
        self._decoder = TextureDecoder(file.path, notices, file.limits, measures)
        self._material_index: dict[int, int] = {}
        self._texture_index: dict[tuple[int, str, str], int] = {}
        self._roughness_index: dict[tuple[int, float], int] = {}
        """By the texture that holds the glossiness, and its factor."""
        self._is_colored: dict[int, bool] = {}
        self._pixels: dict[int, PixelArray | None] = {}

    def index(self, primitive: Entry) -> int:
        """Return the index in ``materials`` of what a primitive is made of."""
        stated = primitive.integer("material", -1, low=-1)
        if stated not in self._material_index:
            if stated == -1:
                material = Material(name="default")
                self.notices.append("no material: glTF's default (white, fully metallic, rough)")
            else:
                material = self._read(
                    self.file.root.item("materials", stated, primitive, "material")
                )
            self._material_index[stated] = len(self.materials)
            self.materials.append(material)
        return self._material_index[stated]

    def _read(self, entry: Entry) -> Material:
        name = entry.text("name", "") or entry.pointer
        pbr = entry.child("pbrMetallicRoughness")
        *base, alpha = self._factors(pbr, "baseColorFactor", (1.0,) * 4)
        mode = entry.text("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            expected = "OPAQUE, MASK or BLEND"
            raise entry.error("range", what="alphaMode", found=mode, expected=expected)
        strength = entry.extension("KHR_materials_emissive_strength")
        gain = 1.0 if strength is None else strength.number("emissiveStrength", 1.0)
        if gain < 0:
            self.notices.append(f"{entry.pointer}: emissiveStrength {gain:g} clamped to 0")
            gain = 0.0
        red, green, blue = color = self._color(entry, "emissiveFactor", 0.0, math.inf)
        emission = (red * gain, green * gain, blue * gain)
        if max(emission) > EMISSION_LIMIT:
            found = max(emission)
            raise entry.error("range", what="emission", found=found, limit=EMISSION_LIMIT)
        material = Material(
            name=name,
            base_color=(base[0], base[1], base[2]),
            alpha=alpha,
            metallic=self._factor(pbr, "metallicFactor", 1.0),
            roughness=self._factor(pbr, "roughnessFactor", 1.0),
            emission=emission,
            alpha_mode=mode,
            alpha_cutoff=self._factor(entry, "alphaCutoff", 0.5),
            double_sided=entry.flag("doubleSided"),
            normal_scale=entry.child("normalTexture").number("scale", 1.0),
            base_color_texture=self._slot(pbr, "baseColorTexture"),
            metallic_roughness_texture=self._slot(pbr, "metallicRoughnessTexture"),
            normal_texture=self._slot(entry, "normalTexture"),
            emission_texture=self._slot(entry, "emissiveTexture") if any(color) else None,
        )
        if "occlusionTexture" in entry:
            self.notices.append("occlusion textures are not used: occlusion is traced")
        return self._extend(material, entry)

    def _extend(self, material: Material, entry: Entry) -> Material:
        """Apply the material extensions that are honoured; mention those left out."""
        if entry.extension("KHR_materials_unlit") is not None:
            material = replace(
                material,
                metallic=0.0,
                roughness=1.0,
                emission=(0.0, 0.0, 0.0),
                metallic_roughness_texture=None,
                normal_texture=None,
                emission_texture=None,
            )
            self.notices.append(f"material {material.name!r}: unlit, shown as a lit matte surface")
        else:
            glossiness = entry.extension("KHR_materials_pbrSpecularGlossiness")
            if glossiness is not None:  # goes before a metallic fallback
                material = self._from_glossiness(material, glossiness)
            else:
                material = self._add_reflection(material, entry)
            material = self._add_layers(material, entry)
            material = self._add_film(material, entry)
            material = self._add_transmission(material, entry)
        left_out = [name for name in entry.child("extensions").value if name not in HONOURED]
        if left_out:
            self.notices.append(
                f"material {material.name!r}: {', '.join(left_out)} not supported, "
                "its base material is used"
            )
        return material

    def _from_glossiness(self, material: Material, entry: Entry) -> Material:
        """Convert KHR_materials_pbrSpecularGlossiness, as KHR_materials_specular describes it.

        The dielectric's reflectance is the specular colour itself, at an infinite index.
        """
        *diffuse, alpha = self._factors(entry, "diffuseFactor", (1.0,) * 4)
        specular = self._color(entry, "specularFactor", 1.0)
        glossiness = self._factor(entry, "glossinessFactor", 1.0)
        slot = self._slot(entry, "specularGlossinessTexture")
        roughness_slot = None
        if slot is not None:
            # Glossiness is in A, roughness in G.
            key = slot.texture, glossiness
            if key not in self._roughness_index:
                texture = self.textures[slot.texture]
                self._decoder.count(texture.pixels[..., 0].size, f"{entry.pointer}: ")
                codes = np.full_like(texture.pixels, 255)
                codes[..., 1] = np.round(255.0 - glossiness * texture.pixels[..., 3])
                self._roughness_index[key] = len(self.textures)
                self.textures.append(replace(texture, pixels=codes))
            roughness_slot = replace(slot, texture=self._roughness_index[key])
        return replace(
            material,
            base_color=(diffuse[0], diffuse[1], diffuse[2]),
            alpha=alpha,
            metallic=0.0,
            roughness=1.0 - glossiness if slot is None else 1.0,
            ior=0.0,
            specular_color=specular,
            base_color_texture=self._slot(entry, "diffuseTexture"),
            specular_color_texture=slot,
            metallic_roughness_texture=roughness_slot,
        )

    def _add_reflection(self, material: Material, entry: Entry) -> Material:
        """Read KHR_materials_ior and KHR_materials_specular."""
        extensions = entry.child("extensions")
        ior = extensions.child("KHR_materials_ior").number("ior", 1.5)
        if ior != 0.0 and ior < 1.0:
            self.notices.append(f"{entry.pointer}: ior {ior:g} clamped to 1")
            ior = 1.0
        specular = extensions.child("KHR_materials_specular")
        color = self._color(specular, "specularColorFactor", 1.0, SPECULAR_LIMIT)
        return replace(
            material,
            ior=ior,
            specular=self._factor(specular, "specularFactor", 1.0),
            specular_color=color,
            specular_texture=self._slot(specular, "specularTexture"),
            specular_color_texture=self._slot(specular, "specularColorTexture"),
        )

    def _add_layers(self, material: Material, entry: Entry) -> Material:
        """Read KHR_materials_clearcoat, _sheen and _anisotropy; textures of absent ones are not.

        A normal map keeps its own scale.
        """
        extensions = entry.child("extensions")
        coat = extensions.child("KHR_materials_clearcoat")
        clearcoat = self._factor(coat, "clearcoatFactor", 0.0)
        if clearcoat > 0.0:
            material = replace(
                material,
                clearcoat=clearcoat,
                clearcoat_roughness=self._factor(coat, "clearcoatRoughnessFactor", 0.0),
                clearcoat_normal_scale=coat.child("clearcoatNormalTexture").number("scale", 1.0),
                clearcoat_texture=self._slot(coat, "clearcoatTexture"),
                clearcoat_roughness_texture=self._slot(coat, "clearcoatRoughnessTexture"),
                clearcoat_normal_texture=self._slot(coat, "clearcoatNormalTexture"),
            )
        sheen = extensions.child("KHR_materials_sheen")
        color = self._color(sheen, "sheenColorFactor", 0.0)
        if any(color):
            material = replace(
                material,
                sheen_color=color,
                sheen_roughness=self._factor(sheen, "sheenRoughnessFactor", 0.0),
                sheen_color_texture=self._slot(sheen, "sheenColorTexture"),
                sheen_roughness_texture=self._slot(sheen, "sheenRoughnessTexture"),
            )
        stretched = extensions.child("KHR_materials_anisotropy")
        anisotropy = self._factor(stretched, "anisotropyStrength", 0.0)
        if anisotropy > 0.0:
            material = replace(
                material,
                anisotropy=anisotropy,
                anisotropy_rotation=stretched.number("anisotropyRotation", 0.0),
                anisotropy_texture=self._slot(stretched, "anisotropyTexture"),
            )
        return material

    def _add_film(self, material: Material, entry: Entry) -> Material:
        """Read KHR_materials_iridescence."""
        film = entry.child("extensions").child("KHR_materials_iridescence")
        iridescence = self._factor(film, "iridescenceFactor", 0.0)
        if iridescence == 0.0:
            return material
        low = self._within(film, "iridescenceThicknessMinimum", 100.0, 0.0, FILM_LIMIT)
        high = self._within(film, "iridescenceThicknessMaximum", 400.0, 0.0, FILM_LIMIT)
        return replace(
            material,
            iridescence=iridescence,
            iridescence_ior=self._within(film, "iridescenceIor", 1.3, 1.0, FILM_LIMIT),
            iridescence_thickness=(low, high),
            iridescence_texture=self._slot(film, "iridescenceTexture"),
            iridescence_thickness_texture=self._slot(film, "iridescenceThicknessTexture"),
        )

    def _add_transmission(self, material: Material, entry: Entry) -> Material:
        """Read KHR_materials_transmission and _volume; say what thin glass will not do."""
        glass = entry.child("extensions").child("KHR_materials_transmission")
        transmission = self._factor(glass, "transmissionFactor", 0.0)
        volume = self._volume(entry)
        if transmission == 0.0:
            if volume:
                self.notices.append(
                    f"material {material.name!r}: KHR_materials_volume without transmission, "
                    "its base material is used"
                )
            return material
        glassy = replace(
            material,
            transmission=transmission,
            transmission_texture=self._slot(glass, "transmissionTexture"),
            **volume,
        )
        if glassy.is_solid_glass:
            return glassy
        missing = []
        slot = material.base_color_texture
        if slot is not None and slot.texture not in self._is_colored:
            codes = self.textures[slot.texture].pixels[..., :3]
            self._is_colored[slot.texture] = bool(np.ptp(codes, axis=2).any())
        if len(set(material.base_color)) > 1 or (slot and self._is_colored[slot.texture]):
            missing.append("tinted")
        if material.roughness > 0.0:
            missing.append("blurred")
        if missing:
            self.notices.append(
                f"material {material.name!r}: light that passes it is not {' or '.join(missing)}"
            )
        return glassy

    def _volume(self, entry: Entry) -> dict[str, Any]:
        """Read KHR_materials_volume; how thick the body is, its triangles say.

        Raises:
            InputError: Something is to be absorbed on a way that has no length.
        """
        volume = entry.extension("KHR_materials_volume")
        if volume is None:
            return {}
        thickness = volume.number("thicknessFactor", 0.0)
        distance = math.inf
        if "attenuationDistance" in volume:
            distance = volume.number("attenuationDistance", math.inf)
        color = self._color(volume, "attenuationColor", 1.0)
        for name, value, is_right in (
            ("thicknessFactor", thickness, thickness >= 0.0),
            ("attenuationDistance", distance, distance > 0.0),
        ):
            if not is_right:
                raise volume.error("range", what=name, found=value, expected="above 0")
        if thickness == 0.0 and distance < math.inf and min(color) < 1.0:
            raise volume.error(
                "range",
                what="thicknessFactor of glass that absorbs",
                found=thickness,
                expected="above 0",
                advice="set a thickness above 0, or remove attenuationDistance",
            )
        return {
            "thickness": thickness,
            "attenuation_distance": distance,
            "attenuation_color": color,
        }

    def _factor(self, entry: Entry, key: str, default: float) -> float:
        return self._within(entry, key, default, 0.0, 1.0)

    def _within(self, entry: Entry, key: str, default: float, low: float, high: float) -> float:
        value = entry.number(key, default)
        if not low <= value <= high:
            self.notices.append(f"{entry.pointer}: {key} {value:g} clamped to {low:g} ... {high:g}")
        return min(max(value, low), high)

    def _factors(
        self, entry: Entry, key: str, default: tuple[float, ...], high: float = 1.0
    ) -> tuple[float, ...]:
        values = entry.numbers(key, default)
        if any(not 0.0 <= value <= high for value in values):
            self.notices.append(f"{entry.pointer}: {key} clamped to 0 ... {high:g}")
        return tuple(min(max(value, 0.0), high) for value in values)

    def _color(
        self, entry: Entry, key: str, default: float, high: float = 1.0
    ) -> tuple[float, float, float]:
        red, green, blue = self._factors(entry, key, (default,) * 3, high)
        return red, green, blue

    def _slot(self, owner: Entry, key: str) -> TextureSlot | None:
        """Return how ``owner`` reads texture ``key``, or None when it has none."""
        if key not in owner:
            return None
        entry = owner.child(key)
        texture = self._texture(entry, key in ("baseColorTexture", "diffuseTexture"))
        if texture is None:
            return None
        uv_set = entry.integer("texCoord", 0)
        affine = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
        transform = entry.extension("KHR_texture_transform")
        if transform is not None:
            uv_set = transform.integer("texCoord", uv_set)
            ox, oy = transform.numbers("offset", (0.0, 0.0))
            sx, sy = transform.numbers("scale", (1.0, 1.0))
            angle = transform.number("rotation", 0.0)
            c, s = math.cos(angle), math.sin(angle)
            # translation * rotation * scale, as in the extension's own GLSL.
            affine = (c * sx, s * sy, ox, -s * sx, c * sy, oy)
        if uv_set > 1:
            raise entry.error("uv_set", found=uv_set, limit=1)
        return TextureSlot(texture, uv_set, affine)

    def _texture(self, user: Entry, is_base_color: bool) -> int | None:
        """Return the index in ``textures``, or None when a missing image is left out."""
        root = self.file.root
        entry = root.item("textures", user.integer("index"), user, "index")
        webp = entry.extension("EXT_texture_webp")
        source = entry.integer("source", -1, low=-1) if webp is None else webp.integer("source")
        wraps = ["repeat", "repeat"]
        if "sampler" in entry:
            sampler = root.item("samplers", entry.integer("sampler"), entry, "sampler")
            for k, key in enumerate(("wrapS", "wrapT")):
                code = sampler.integer(key, 10497)
                if code not in WRAPS:
                    expected = " or ".join(map(str, WRAPS))
                    raise sampler.error("range", what=key, found=code, expected=expected)
                wraps[k] = WRAPS[code]
            if sampler.integer("magFilter", 9729) in NEAREST:
                self.notices.append(f"{sampler.pointer}: nearest filter replaced by bilinear")
        if source not in self._pixels:
            self._pixels[source] = self._load(source, entry)
        pixels = self._pixels[source]
        if pixels is None and not is_base_color:
            return None
        use = (source, wraps[0], wraps[1])
        if use not in self._texture_index:
            texture = Texture(grey_pixels() if pixels is None else pixels, *wraps)
            self._texture_index[use] = len(self.textures)
            self.textures.append(texture)
        return self._texture_index[use]

    def _load(self, source: int, texture: Entry) -> PixelArray | None:
        """Return the pixels of an image; None when it is missing and that is allowed."""
        if source == -1 and texture.extension("KHR_texture_basisu") is None:
            raise texture.error("missing", what="image source")
        image = texture
        if source != -1:
            image = self.file.root.item("images", source, texture, "source")
        where = f"{image.pointer}: "
        uri = image.text("uri", "")
        if "uri" in image and not uri.startswith("data:"):
            locate(uri, self.file.path, where)  # outside the folder is refused in any case
        try:
            if source == -1:
                advice = ADVICE["KHR_texture_basisu"]
                raise texture.error("texture_format", found="KTX2", advice=advice)
            if "uri" in image:
                file = self.file
                encoded = read_uri(uri, file.path, where, file.limits, file.hashes)
            else:
                encoded = bytes(self.file.view(image.integer("bufferView"), image)[0])
            return self._decoder.decode(encoded, where)
        except InputError as error:
            if self.missing_textures != "grey":
                error.advice = error.advice or "add the image, or pass --missing-textures grey"
                raise
            self.notices.append(f"{error.what}: replaced by grey, or left out where no colour")
            return None
