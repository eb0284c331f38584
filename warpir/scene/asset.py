"""A loaded 3D asset: triangles, materials and textures as plain arrays.

The readers of `warpir.io.assets` fill these records after checking the file; later stages rely on
those checks. Frame: the asset's own, right-handed, +Y up, front +Z, in metres.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warpir.core.arrays import CodeArray, Float64Array, FloatArray, IntArray

ABSENT = "absent"
"""Replaces the sha256 of a texture file that could not be read; grey replaces its texels."""


@dataclass(frozen=True)
class Texture:
    """An image in memory; the slot that uses it decides whether it is colour or plain numbers."""

    pixels: CodeArray
    """RGBA codes, row 0 at the top (v = 0), shape [height, width, 4]."""
    wrap_u: str = "repeat"
    """``repeat``, ``clamp`` or ``mirror``."""
    wrap_v: str = "repeat"
    """``repeat``, ``clamp`` or ``mirror``."""


@dataclass(frozen=True)
class TextureSlot:
    """Texture of a material, with its coordinates and transform."""

    texture: int
    """Index into ``Asset.textures``."""
    uv_set: int = 0
    """Set of the primitive's texture coordinates, 0 or 1."""
    transform: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    """Affine map (a, b, c, d, e, f): ``u' = a u + b v + c``, ``v' = d u + e v + f``."""


@dataclass(frozen=True)
class Material:
    """glTF 2.0 metallic-roughness, with its defaults; textures multiply the factors."""

    name: str = ""
    base_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear Rec.709 reflectance [1]."""
    alpha: float = 1.0
    """Opacity factor [1]."""
    metallic: float = 1.0
    """0 dielectric to 1 metal [1]."""
    roughness: float = 1.0
    """Perceptual roughness [1]."""
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Emitted radiance, ``emissiveStrength`` included, relative [W/(m^2 sr)]."""
    alpha_mode: str = "OPAQUE"
    """``OPAQUE``, ``MASK`` or ``BLEND``."""
    alpha_cutoff: float = 0.5
    """Coverage threshold of ``MASK`` [1]."""
    double_sided: bool = False
    """When false, back faces are invisible to camera rays (solid to all other rays)."""
    normal_scale: float = 1.0
    """Factor on the x and y of the normal map [1]."""
    ior: float = 1.5
    """Index of refraction of the dielectric (KHR_materials_ior); 0 stands for infinity."""
    specular: float = 1.0
    """Strength of the dielectric's reflection (KHR_materials_specular) [1]."""
    specular_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Colour of the dielectric's reflection at normal incidence, linear; may exceed 1."""
    clearcoat: float = 0.0
    """Share covered by a clear coat of index 1.5 (KHR_materials_clearcoat) [1]."""
    clearcoat_roughness: float = 0.0
    """Perceptual roughness of the coat [1]."""
    clearcoat_normal_scale: float = 1.0
    """Factor on the x and y of the coat's normal map [1]."""
    sheen_color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Linear colour of the sheen of cloth (KHR_materials_sheen); black for none."""
    sheen_roughness: float = 0.0
    """Perceptual roughness of the sheen [1]."""
    transmission: float = 0.0
    """Share of the light that is not reflected and passes a thin wall (KHR_materials_transmission)
    instead of reaching the diffuse base [1]."""
    thickness: float = 0.0
    """Above 0 the triangles bound a body of glass (KHR_materials_volume), whose true thickness
    counts; 0: thin walls that do not bend light [m]."""
    attenuation_distance: float = math.inf
    """Way in that body after which `attenuation_color` is left of white light [m]."""
    attenuation_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear [1]."""
    anisotropy: float = 0.0
    """Strength by which the base's specular lobe is wider in one direction than its roughness says
    (KHR_materials_anisotropy) [1]."""
    anisotropy_rotation: float = 0.0
    """Of that direction, from the tangent toward the bitangent [rad]."""
    iridescence: float = 0.0
    """Share of the base covered by a thin film (KHR_materials_iridescence) [1]."""
    iridescence_ior: float = 1.3
    """Index of refraction of the film."""
    iridescence_thickness: tuple[float, float] = (100.0, 400.0)
    """Thickness of the film where its texture is 0, and where it is 1 or absent [nm]."""
    base_color_texture: TextureSlot | None = None
    """Factor on `base_color` and `alpha`: sRGB-encoded RGB, linear alpha."""
    metallic_roughness_texture: TextureSlot | None = None
    """Factors on `roughness` (G) and `metallic` (B), linear."""
    normal_texture: TextureSlot | None = None
    """Normal map in tangent space, linear, +Y up."""
    emission_texture: TextureSlot | None = None
    """sRGB-encoded RGB."""
    specular_texture: TextureSlot | None = None
    """Factor on `specular` in its alpha."""
    specular_color_texture: TextureSlot | None = None
    """sRGB-encoded RGB."""
    clearcoat_texture: TextureSlot | None = None
    """Factor on `clearcoat` in its red channel."""
    clearcoat_roughness_texture: TextureSlot | None = None
    """Factor on `clearcoat_roughness` in its green channel."""
    clearcoat_normal_texture: TextureSlot | None = None
    """Normal map of the coat; without it the coat has the geometry's interpolated normal."""
    sheen_color_texture: TextureSlot | None = None
    """sRGB-encoded RGB."""
    sheen_roughness_texture: TextureSlot | None = None
    """Factor on `sheen_roughness` in its alpha."""
    transmission_texture: TextureSlot | None = None
    """Factor on `transmission` in its red channel."""
    anisotropy_texture: TextureSlot | None = None
    """That direction in tangent space before its rotation (R, G), factor on `anisotropy` (B)."""
    iridescence_texture: TextureSlot | None = None
    """Factor on `iridescence` in its red channel."""
    iridescence_thickness_texture: TextureSlot | None = None
    """Where between its bounds the thickness is, in its green channel."""

    @property
    def is_solid_glass(self) -> bool:
        """Whether light enters a body of this material and is bent."""
        return self.transmission > 0.0 and self.thickness > 0.0

    @property
    def may_be_passed(self) -> bool:
        """Whether some rays that meet this material go on behind it."""
        return self.transmission > 0.0 or self.alpha_mode != "OPAQUE"

    def texture_slots(self) -> list[TextureSlot]:
        """Return the slot of each texture, in the order of the fields."""
        return [value for value in vars(self).values() if isinstance(value, TextureSlot)]


@dataclass(frozen=True)
class Primitive:
    """Triangles of one material, already in the asset's frame (node transforms applied)."""

    positions: Float64Array
    """Vertex positions, asset frame [m], shape [vertex, 3]; float64 so that recentring is exact."""
    indices: IntArray
    """Vertices of each triangle, counter-clockwise from outside, shape [triangle, 3]."""
    material: int
    """Index into ``Asset.materials``."""
    normals: FloatArray | None = None
    """Unit shading normals, asset frame, shape [vertex, 3]; absent means flat."""
    tangents: FloatArray | None = None
    """Unit tangent xyz and handedness w, shape [vertex, 4]; absent means from the UVs."""
    uv0: FloatArray | None = None
    """First texture coordinates, v down from the image's top, shape [vertex, 2]."""
    uv1: FloatArray | None = None
    """Second texture coordinates, shape [vertex, 2]."""
    colors: FloatArray | None = None
    """Linear RGBA that multiplies base colour and alpha, shape [vertex, 4]."""


@dataclass(frozen=True)
class Asset:
    """One loaded asset."""

    name: str
    primitives: tuple[Primitive, ...]
    materials: tuple[Material, ...]
    textures: tuple[Texture, ...] = ()
    notices: tuple[str, ...] = field(default=())
    """Repairs, assumptions and omissions, one line each; printed and kept in ``run.json``."""
    hashes: Mapping[str, str] = field(default_factory=dict)
    """sha256 of the files read: the asset's as ``""``, others by their relative names;
    `ABSENT` where a file is missing."""

    def bounds(self) -> tuple[Float64Array, Float64Array]:
        """Return the lowest and highest corner of all vertices, asset frame [m], shape [3] each."""
        low = np.min([p.positions.min(axis=0) for p in self.primitives], axis=0)
        high = np.max([p.positions.max(axis=0) for p in self.primitives], axis=0)
        return low, high

    def corners(self) -> Float64Array:
        """Return the vertices that triangles use, asset frame [m], shape [vertex, 3]."""
        return np.concatenate([p.positions[np.unique(p.indices)] for p in self.primitives])

    def turned(self, rotation: Float64Array) -> "Asset":
        """Return the same turned about its origin.

        Args:
            rotation: From this asset's frame to the new one, shape [3, 3].
        """
        rotation32 = rotation.astype(np.float32)

        def turn(p: Primitive) -> Primitive:
            tangents = p.tangents
            if tangents is not None:
                tangents = np.column_stack([tangents[:, :3] @ rotation32.T, tangents[:, 3]])
            return replace(
                p,
                positions=p.positions @ rotation.T,
                normals=None if p.normals is None else p.normals @ rotation32.T,
                tangents=tangents,
            )

        return replace(self, primitives=tuple(turn(p) for p in self.primitives))

    def materials_named(self, names: Sequence[str] | None) -> list[int]:
        """Return the indices of the materials that have one of these names; None: of all."""
        return [i for i, m in enumerate(self.materials) if names is None or m.name in names]
