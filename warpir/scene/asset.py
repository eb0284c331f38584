"""What a 3D asset is once it is loaded: triangles, materials and textures as plain arrays.

The readers of `warpir.io.assets` fill these records after checking the file; nothing behind them
checks again. Frame: the asset's own, right-handed, +Y up, front +Z, in
metres.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warpir.core.arrays import CodeArray, Float64Array, FloatArray, IntArray

ABSENT = "absent"
"""In place of a sha256, where grey stands for a file that could not be read."""


@dataclass(frozen=True)
class Texture:
    """An image in memory; whether it is colour or plain numbers is decided by the slot using it."""

    pixels: CodeArray
    """RGBA codes, row 0 at the top (v = 0), shape [height, width, 4]."""
    wrap_u: str = "repeat"
    """``repeat``, ``clamp`` or ``mirror``."""
    wrap_v: str = "repeat"
    """``repeat``, ``clamp`` or ``mirror``."""


@dataclass(frozen=True)
class TextureSlot:
    """How a material reads one texture."""

    texture: int
    """Index into ``Asset.textures``."""
    uv_set: int = 0
    """0 or 1: which texture coordinates of the primitive."""
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
    base_color_texture: TextureSlot | None = None
    """sRGB-encoded RGB, linear alpha."""
    metallic_roughness_texture: TextureSlot | None = None
    """G roughness, B metallic, linear."""
    normal_texture: TextureSlot | None = None
    """Tangent space, linear, +Y up."""
    emission_texture: TextureSlot | None = None
    """sRGB-encoded RGB."""
    specular_texture: TextureSlot | None = None
    """A: factor on `specular`."""
    specular_color_texture: TextureSlot | None = None
    """sRGB-encoded RGB."""
    clearcoat_texture: TextureSlot | None = None
    """R: factor on `clearcoat`."""
    clearcoat_roughness_texture: TextureSlot | None = None
    """G: factor on `clearcoat_roughness`."""
    clearcoat_normal_texture: TextureSlot | None = None
    """As `normal_texture`; without it the coat has the geometry's interpolated normal."""
    sheen_color_texture: TextureSlot | None = None
    """sRGB-encoded RGB."""
    sheen_roughness_texture: TextureSlot | None = None
    """A: factor on `sheen_roughness`."""
    transmission_texture: TextureSlot | None = None
    """R: factor on `transmission`."""

    def texture_slots(self) -> list[TextureSlot]:
        """Return how the material reads its textures, in the order of the fields."""
        return [value for value in vars(self).values() if isinstance(value, TextureSlot)]


@dataclass(frozen=True)
class Primitive:
    """Triangles of one material, already in the asset's frame (node transforms applied)."""

    positions: Float64Array
    """Asset frame [m], shape [vertex, 3]; float64 so that recentring loses nothing."""
    indices: IntArray
    """Counter-clockwise seen from outside, shape [triangle, 3]."""
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
    """What was repaired, assumed or left out, one line each; printed and kept in ``run.json``."""
    hashes: Mapping[str, str] = field(default_factory=dict)
    """sha256 of what was read: of the asset's file as ``""``, of others by their relative names;
    `ABSENT` where grey stands for a file."""

    def bounds(self) -> tuple[Float64Array, Float64Array]:
        """Return the lowest and highest corner of all vertices, asset frame [m], shape [3] each."""
        low = np.min([p.positions.min(axis=0) for p in self.primitives], axis=0)
        high = np.max([p.positions.max(axis=0) for p in self.primitives], axis=0)
        return low, high

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
