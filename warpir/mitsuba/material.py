"""The metallic-roughness material of glTF 2.0 as a Mitsuba 3 BSDF.

Written from appendix B of the specification alone (https://registry.khronos.org/glTF/specs/2.0,
"BRDF implementation"): GGX, height-correlated Smith, Schlick, and a Lambert lobe damped by the
same Fresnel term; and from the README of each KHR_materials extension: ior, specular, clearcoat,
sheen (the form whose albedo scaling depends on the view alone) and thin transmission, whose light
goes straight on with the luminance of its tint. Names follow warpir: ``wo`` toward the camera,
``wi`` toward the light; Mitsuba's arguments are the other way round and are renamed at the border
of each method.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot

MIN_ALPHA = 1e-3
SHEEN_ROWS, SHEEN_COLUMNS = 64, 96
"""Of the table of the sheen's albedo, by roughness and by the square root of the cosine."""


def srgb_decode(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear values of sRGB codes (IEC 61966-2-1), same shape [1]."""
    x = np.arange(256) / 255.0
    table = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[codes]


class Image:
    """A texture on the device, read bilinearly between texel centres."""

    def __init__(self, texture: Texture, slot: TextureSlot, is_color: bool) -> None:
        """Decode before filtering: RGB as sRGB where ``is_color``, alpha always linear."""
        texels = texture.pixels.astype(np.float32) / np.float32(255.0)
        if is_color:
            texels[..., :3] = srgb_decode(texture.pixels[..., :3])
        self.height, self.width = texels.shape[:2]
        self.texels = mi.Float(texels.ravel())
        self.wrap_u, self.wrap_v = texture.wrap_u, texture.wrap_v
        self.slot = slot

    def read(self, uv: mi.Point2f, active: mi.Bool) -> mi.Vector4f:
        """RGBA at untransformed texture coordinates, v down from the image's top."""
        a, b, c, d, e, f = self.slot.transform
        x = (a * uv.x + b * uv.y + c) * self.width - 0.5
        y = (d * uv.x + e * uv.y + f) * self.height - 0.5
        left, top = dr.floor(x), dr.floor(y)
        x -= left
        y -= top
        column, row = mi.Int32(left), mi.Int32(top)

        def texel(i: mi.Int32, j: mi.Int32) -> mi.Vector4f:
            index = _wrap(i, self.height, self.wrap_v) * self.width
            index += _wrap(j, self.width, self.wrap_u)
            return dr.gather(mi.Vector4f, self.texels, mi.UInt32(index), active)

        upper = texel(row, column) * (1.0 - x) + texel(row, column + 1) * x
        lower = texel(row + 1, column) * (1.0 - x) + texel(row + 1, column + 1) * x
        return upper * (1.0 - y) + lower * y


def _wrap(i: mi.Int32, size: int, mode: str) -> mi.Int32:
    """Texel index inside ``[0, size)`` of an index anywhere, by glTF wrap mode."""
    if mode == "clamp":
        return dr.clip(i, 0, size - 1)
    period = 2 * size if mode == "mirror" else size
    i = i % period
    i = dr.select(i < 0, i + period, i)
    return dr.select(i < size, i, period - 1 - i)


@dataclass
class Surface:
    """Geometry and material at hits, world frame."""

    wo: Any
    """Unit direction toward the camera."""
    n: Any
    """Unit shading normal, on the side of ``wo``."""
    ng: Any
    """Unit geometric normal, on the side of ``wo``."""
    base_color: Any
    metallic: Any
    alpha: Any
    """GGX width, perceptual roughness squared [1]."""
    dielectric_f0: Any
    """Reflectance of the dielectric at normal incidence [1]."""
    dielectric_f90: Any
    """The same at grazing incidence [1]."""
    transmission: Any
    """Share of what enters the dielectric that goes through [1]."""
    sheen_color: Any
    sheen_alpha: Any
    sheen_scale: Any
    """What the sheen leaves to the base [1]."""
    coat: Any
    """Clear coat times its Fresnel term [1]."""
    coat_alpha: Any
    coat_n: Any
    """Unit normal of the coat, on the side of ``wo``."""
    stopped: Any
    """Share of rays that the surface does not let through [1]."""

    def reflectance(self, weight: Any) -> tuple[Any, Any]:
        """Fresnel terms of the dielectric and of the whole base at Schlick's ``weight`` [1]."""
        dielectric = dr.lerp(self.dielectric_f0, mi.Color3f(self.dielectric_f90), weight)
        metal = dr.lerp(self.base_color, mi.Color3f(1.0), weight)
        return dielectric, dr.lerp(dielectric, metal, self.metallic)


class GltfBSDF(mi.BSDF):
    """One primitive's material, with the vertex attributes it reads.

    The mesh must carry no texture coordinates of its own: Mitsuba then leaves the barycentric
    coordinates in ``si.uv``, and all interpolation happens here.
    """

    def __init__(self, asset: Asset, primitive: Primitive, linear: NDArray[np.float64]) -> None:
        """Copy attributes and textures to the device.

        Args:
            asset: Owner of materials and textures.
            primitive: Triangles that carry the material.
            linear: Asset-to-world linear part, shape [3, 3]; turns tangents.
        """
        super().__init__(mi.Properties())
        material: Material = asset.materials[primitive.material]
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        if material.double_sided:
            flags = flags | mi.BSDFFlags.BackSide
        self.m_components = [flags]
        self.m_flags = flags
        self.material = material

        def image(slot: TextureSlot | None, is_color: bool) -> Image | None:
            return None if slot is None else Image(asset.textures[slot.texture], slot, is_color)

        self.base_color_image = image(material.base_color_texture, True)
        self.metallic_roughness_image = image(material.metallic_roughness_texture, False)
        self.normal_image = image(material.normal_texture, False)
        self.emission_image = image(material.emission_texture, True)
        self.specular_image = image(material.specular_texture, False)
        self.specular_color_image = image(material.specular_color_texture, True)
        self.clearcoat_image = image(material.clearcoat_texture, False)
        self.clearcoat_roughness_image = image(material.clearcoat_roughness_texture, False)
        self.clearcoat_normal_image = image(material.clearcoat_normal_texture, False)
        self.sheen_color_image = image(material.sheen_color_texture, True)
        self.sheen_roughness_image = image(material.sheen_roughness_texture, False)
        self.transmission_image = image(material.transmission_texture, False)
        has_sheen = max(material.sheen_color) > 0.0
        self.sheen_table = mi.Float(sheen_table().ravel()) if has_sheen else None

        self.indices = mi.UInt32(_wound(primitive, linear).astype(np.uint32).ravel())
        self.uvs = [
            None if uv is None else mi.Float(np.ascontiguousarray(uv).ravel())
            for uv in (primitive.uv0, primitive.uv1)
        ]
        self.colors = None
        if primitive.colors is not None:
            self.colors = mi.Float(np.ascontiguousarray(primitive.colors).ravel())
        self.vertex_tangents = self.face_tangents = None
        mapped = self.normal_image or self.clearcoat_normal_image
        if mapped is not None:
            if primitive.tangents is not None:
                turned = primitive.tangents.astype(np.float64)
                turned[:, :3] = turned[:, :3] @ linear.T
                # A mirroring matrix turns the handedness of (n, t, b) around
                turned[:, 3] *= np.sign(np.linalg.det(linear))
                self.vertex_tangents = mi.Float(turned.astype(np.float32).ravel())
            else:
                self.face_tangents = mi.Float(
                    face_tangents(primitive, mapped.slot.uv_set, linear).ravel()
                )

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Color3f]:
        """Draw ``wi`` from visible normals or a cosine; return it and ``f cos_i / pdf``."""
        surface = self._surface(si, active)
        coat, specular = self._shares(surface)

        def mirrored(n: mi.Vector3f, alpha: mi.Float) -> mi.Vector3f:
            frame = mi.Frame3f(n)
            wo = frame.to_local(surface.wo)
            wm = sample_visible_normal(wo, alpha, sample2)
            return frame.to_world(2.0 * dr.dot(wo, wm) * wm - wo)

        diffuse = mi.Frame3f(surface.n).to_world(mi.warp.square_to_cosine_hemisphere(sample2))
        wi = dr.select(
            sample1 < coat + (1.0 - coat) * specular, mirrored(surface.n, surface.alpha), diffuse
        )
        wi = dr.select(sample1 < coat, mirrored(surface.coat_n, surface.coat_alpha), wi)
        wi = dr.normalize(wi)
        f_cos, pdf = self._eval_pdf(surface, wi)
        pdf = dr.select(active, pdf, 0.0)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = si.to_local(wi)
        bs.pdf = pdf
        bs.eta = 1.0
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        bs.sampled_component = mi.UInt32(0)
        return bs, dr.select(pdf > 0.0, f_cos / pdf, 0.0)

    def eval_pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> tuple[mi.Color3f, mi.Float]:
        """Return ``f cos_i`` [1/sr] and the density of `sample` over solid angle [1/sr]."""
        f_cos, pdf = self._eval_pdf(self._surface(si, active), si.to_world(wo))
        return f_cos & active, pdf & active

    def eval(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> mi.Color3f:
        """Return ``f cos_i`` [1/sr]."""
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> mi.Float:
        """Density of `sample` over solid angle, 0 outside its support [1/sr]."""
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_null_transmission(
        self, si: mi.SurfaceInteraction3f, active: mi.Bool = True
    ) -> mi.Color3f:
        """Share of light that passes straight through: 1 - coverage, and what glass transmits."""
        alpha = mi.Float(1.0)
        if self.material.alpha_mode != "OPAQUE":
            alpha *= self.material.alpha
            if self.base_color_image is not None:
                alpha *= self._read(self.base_color_image, si, active).w
            if self.colors is not None:
                alpha *= self._interpolate(self.colors, mi.Vector4f, si, active).w
        if self.material.alpha_mode == "MASK":
            alpha = dr.select(alpha >= self.material.alpha_cutoff, mi.Float(1.0), 0.0)
        alpha = dr.clip(alpha, 0.0, 1.0)
        if self.material.transmission > 0.0:
            alpha *= self._surface(si, active).stopped
        return mi.Color3f(1.0 - alpha) & active

    def has_attribute(self, name: str, active: mi.Bool = True) -> mi.Bool:
        """Say which attributes exist: ``emission``."""
        return name == "emission"

    def eval_attribute_3(
        self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool = True
    ) -> mi.Color3f:
        """Emitted radiance, the same in all directions, relative [W/(m^2 sr)]."""
        emission = mi.Color3f(*self.material.emission)
        if self.emission_image is not None:
            emission *= _rgb(self._read(self.emission_image, si, active))
        surface = self._surface(si, active)
        return emission * (1.0 - surface.coat) / surface.stopped & active

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose nothing: materials are fixed here."""

    def to_string(self) -> str:
        """Name the material in scene dumps."""
        return f"GltfBSDF[{self.material.name}]"

    def _corners(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Vector3u:
        """Vertex indices of the hit triangle."""
        return dr.gather(mi.Vector3u, self.indices, si.prim_index, active)

    def _interpolate(
        self, attribute: mi.Float, kind: type, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> Any:
        """Vertex attribute at the hit, barycentric."""
        corner = self._corners(si, active)
        first, second, third = (dr.gather(kind, attribute, corner[k], active) for k in range(3))
        return first * (1.0 - si.uv.x - si.uv.y) + second * si.uv.x + third * si.uv.y

    def _read(self, image: Image, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Vector4f:
        """Texture of one slot at the hit, RGBA [1]."""
        uv = self.uvs[image.slot.uv_set]
        if uv is None:
            return image.read(mi.Point2f(0.0), active)
        return image.read(self._interpolate(uv, mi.Point2f, si, active), active)

    def _surface(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Surface:
        """Textured material and oriented normals at the hit."""
        material = self.material
        base_color = mi.Color3f(*material.base_color)
        base_color *= self._tint(self.base_color_image, si, active)
        if self.colors is not None:
            base_color *= _rgb(self._interpolate(self.colors, mi.Vector4f, si, active))
        metallic, roughness = mi.Float(material.metallic), mi.Float(material.roughness)
        if self.metallic_roughness_image is not None:
            texel = self._read(self.metallic_roughness_image, si, active)
            roughness *= texel.y
            metallic *= texel.z

        # Both normals turn to the viewer; where the shading normal still faces away, ng
        wo = si.to_world(si.wi)
        ng = mi.Vector3f(si.n)
        side = dr.select(dr.dot(ng, wo) < 0.0, mi.Float(-1.0), 1.0)
        ng = ng * side

        def oriented(image: Image | None, scale: float) -> mi.Vector3f:
            n = self._shading_normal(si, image, scale, active) * side
            return dr.select(dr.dot(n, wo) > 0.0, n, ng)

        n = oriented(self.normal_image, material.normal_scale)
        coat_n = oriented(self.clearcoat_normal_image, material.clearcoat_normal_scale)

        # KHR_materials_ior, _specular
        f0 = ((1.0 - material.ior) / (1.0 + material.ior)) ** 2
        f0 = f0 * mi.Color3f(*material.specular_color)
        f0 *= self._tint(self.specular_color_image, si, active)
        f90 = self._factor(material.specular, self.specular_image, 3, si, active)
        f0 = dr.minimum(f0, 1.0) * f90

        # KHR_materials_clearcoat, _sheen
        clearcoat = self._factor(material.clearcoat, self.clearcoat_image, 0, si, active)
        coat = clearcoat * (0.04 + 0.96 * schlick_weight(dr.abs(dr.dot(wo, coat_n))))
        coat_roughness = self._factor(
            material.clearcoat_roughness, self.clearcoat_roughness_image, 1, si, active
        )
        sheen = mi.Color3f(*material.sheen_color)
        sheen *= self._tint(self.sheen_color_image, si, active)
        sheen_roughness = self._factor(
            material.sheen_roughness, self.sheen_roughness_image, 3, si, active
        )
        sheen_scale = mi.Float(1.0)
        if self.sheen_table is not None:
            E = read_sheen_table(self.sheen_table, dr.dot(n, wo), sheen_roughness)
            sheen_scale = 1.0 - dr.max(sheen) * E

        # KHR_materials_transmission, at the angle with the normal before any map
        transmission = self._factor(material.transmission, self.transmission_image, 0, si, active)
        weight = schlick_weight(dr.abs(dr.dot(si.sh_frame.n, wo)))
        enters = 1.0 - dr.max(f0 + (f90 - f0) * weight)
        enters *= 1.0 - clearcoat * (0.04 + 0.96 * weight)
        passes = transmission * (1.0 - metallic) * mi.luminance(base_color) * enters

        return Surface(
            wo=wo,
            n=n,
            ng=ng,
            base_color=base_color,
            metallic=metallic,
            alpha=dr.maximum(dr.square(roughness), MIN_ALPHA),
            dielectric_f0=f0,
            dielectric_f90=f90,
            transmission=transmission,
            sheen_color=sheen,
            sheen_alpha=dr.maximum(dr.square(sheen_roughness), MIN_ALPHA),
            sheen_scale=sheen_scale,
            coat=coat,
            coat_alpha=dr.maximum(dr.square(coat_roughness), MIN_ALPHA),
            coat_n=coat_n,
            stopped=1.0 - passes,
        )

    def _tint(
        self, image: Image | None, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.Color3f:
        """Read a colour texture at the hit; white without one."""
        return mi.Color3f(1.0) if image is None else _rgb(self._read(image, si, active))

    def _factor(
        self,
        factor: float,
        image: Image | None,
        channel: int,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> mi.Float:
        """Factor times one channel of its texture [1]."""
        if image is None:
            return mi.Float(factor)
        return factor * self._read(image, si, active)[channel]

    def _shading_normal(
        self, si: mi.SurfaceInteraction3f, image: Image | None, scale: float, active: mi.Bool
    ) -> mi.Vector3f:
        """Unit normal after a normal map, on the side the triangle's winding gives."""
        n = mi.Vector3f(si.sh_frame.n)
        if image is None:
            return n
        texel = self._read(image, si, active) * 2.0 - 1.0
        if self.vertex_tangents is not None:
            tangent = self._interpolate(self.vertex_tangents, mi.Vector4f, si, active)
        else:
            tangent = dr.gather(mi.Vector4f, self.face_tangents, si.prim_index, active)
        t = mi.Vector3f(tangent.x, tangent.y, tangent.z)
        t = t - n * dr.dot(n, t)
        length = dr.norm(t)
        usable = length > 1e-6
        t = t / dr.select(usable, length, 1.0)
        b = dr.cross(n, t) * dr.select(tangent.w < 0.0, mi.Float(-1.0), 1.0)
        mapped = (t * texel.x + b * texel.y) * scale + n * texel.z
        size = dr.norm(mapped)
        usable &= size > 1e-6
        return dr.select(usable, mapped / dr.select(usable, size, 1.0), n)

    @staticmethod
    def _shares(surface: Surface) -> tuple[mi.Float, mi.Float]:
        """Probabilities of sampling the coat, and else the base's GGX lobe: rough shares."""
        cos_o = dr.dot(surface.n, surface.wo)
        dielectric, whole = surface.reflectance(schlick_weight(cos_o))
        fresnel = dr.max(whole) * surface.sheen_scale
        matte = (1.0 - surface.metallic) * (1.0 - surface.transmission)
        diffuse = matte * (1.0 - dr.max(dielectric)) * dr.max(surface.base_color)
        diffuse += 0.2 * dr.max(surface.sheen_color)
        base = dr.maximum(fresnel + diffuse, 1e-6)
        specular = dr.select(diffuse > 0.0, dr.clip(fresnel / base, 0.1, 0.9), 1.0)
        coat = dr.clip(surface.coat / (surface.coat + (1.0 - surface.coat) * base), 0.15, 0.85)
        return dr.select(surface.coat > 0.0, coat, 0.0), specular

    def _eval_pdf(self, surface: Surface, wi: mi.Vector3f) -> tuple[mi.Color3f, mi.Float]:
        """Return ``f cos_i`` and the mixture density for a world direction [1/sr]."""
        wo = surface.wo
        cos_o, cos_i = dr.dot(surface.n, wo), dr.dot(surface.n, wi)
        valid = (cos_o > 0.0) & (cos_i > 0.0)
        valid &= (dr.dot(surface.ng, wo) > 0.0) & (dr.dot(surface.ng, wi) > 0.0)
        wm = dr.normalize(wo + wi)

        # The base receives what the dielectric's Fresnel term leaves, whatever the metallic
        dielectric, fresnel = surface.reflectance(schlick_weight(dr.abs(dr.dot(wo, wm))))
        matte = (1.0 - surface.metallic) * (1.0 - surface.transmission)
        matte *= 1.0 - dr.max(dielectric)
        lobe, density = ggx(surface.n, surface.alpha, wo, wi)
        f_cos = (matte * surface.base_color * dr.inv_pi + fresnel * lobe) * cos_i
        f_cos *= surface.sheen_scale
        if self.sheen_table is not None:
            f_cos += surface.sheen_color * charlie(
                dr.dot(surface.n, wm), cos_o, cos_i, surface.sheen_alpha
            )
        coat_lobe, coat_density = ggx(surface.coat_n, surface.coat_alpha, wo, wi)
        coat_cos = dr.maximum(dr.dot(surface.coat_n, wi), 0.0)
        f_cos = dr.lerp(f_cos, mi.Color3f(coat_lobe * coat_cos), surface.coat)
        coat, specular = self._shares(surface)
        pdf = dr.lerp(cos_i * dr.inv_pi, density, specular)
        pdf = dr.lerp(pdf, coat_density, coat)
        return dr.select(valid, f_cos / surface.stopped, 0.0), dr.select(valid, pdf, 0.0)


def schlick_weight(cosine: mi.Float) -> mi.Float:
    """Schlick's ``(1 - cos)^5`` [1]."""
    x = dr.clip(1.0 - cosine, 0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


def ggx(
    n: mi.Vector3f, alpha: mi.Float, wo: mi.Vector3f, wi: mi.Vector3f
) -> tuple[mi.Float, mi.Float]:
    """GGX lobe about ``n`` without Fresnel term, and the density of reflecting at visible normals.

    The value is 0 where either direction is below ``n``; visible normals also draw directions below
    it, so the density is not. Both [1/sr].
    """
    frame = mi.Frame3f(n)
    wm = dr.normalize(frame.to_local(wo) + frame.to_local(wi))
    cos_o, cos_i = dr.dot(n, wo), dr.dot(n, wi)
    # From tangents: 1 - cos^2 would lose the narrow lobes to rounding
    alpha2 = dr.square(alpha)
    slope = (dr.square(wm.x) + dr.square(wm.y)) / alpha2 + dr.square(wm.z)
    D = dr.select(wm.z > 0.0, dr.rcp(dr.pi * alpha2 * dr.square(slope)), 0.0)
    root_o = dr.sqrt(alpha2 + (1.0 - alpha2) * dr.square(cos_o))
    root_i = dr.sqrt(alpha2 + (1.0 - alpha2) * dr.square(cos_i))
    visibility = 0.5 / (cos_i * root_o + cos_o * root_i)
    value = dr.select((cos_o > 0.0) & (cos_i > 0.0), D * visibility, 0.0)
    # G1(wo) D / (4 cos_o), with G1 = 2 cos_o / (cos_o + root_o)
    return value, dr.select(cos_o > 0.0, D * 0.5 / (cos_o + root_o), 0.0)


def charlie(cos_m: mi.Float, cos_o: mi.Float, cos_i: mi.Float, alpha: mi.Float) -> mi.Float:
    """Sheen lobe times ``cos_i``: Charlie's distribution and its visibility [1/sr]."""
    inverse = dr.rcp(alpha)
    sin2 = dr.maximum(1.0 - dr.square(cos_m), 0.0)
    D = (2.0 + inverse) * sin2 ** (0.5 * inverse) * (0.5 * dr.inv_pi)
    return D / (4.0 * cos_o * (1.0 + fibre_lambda(cos_o, alpha) + fibre_lambda(cos_i, alpha)))


def fibre_lambda(cosine: Any, alpha: Any) -> Any:
    """``lambda_sheen`` of KHR_materials_sheen, for Dr.Jit and NumPy alike."""
    is_array = isinstance(cosine, np.ndarray)
    exp, where = (np.exp, np.where) if is_array else (dr.exp, dr.select)
    t = (1.0 - alpha) * (1.0 - alpha)
    a = 21.5473 + (25.3245 - 21.5473) * t
    b = 3.82987 + (3.32435 - 3.82987) * t
    c = 0.19823 + (0.16801 - 0.19823) * t
    d = -1.97760 + (-1.27393 + 1.97760) * t
    e = -4.32054 + (-4.85967 + 4.32054) * t
    near = abs(where(cosine < 0.5, cosine, 1.0 - cosine))
    curve = a / (1.0 + b * near**c) + d * near + e
    middle = a / (1.0 + b * 0.5**c) + d * 0.5 + e
    return exp(where(cosine < 0.5, curve, 2.0 * middle - curve))


@cache
def sheen_table() -> NDArray[np.float32]:
    """Albedo of the sheen's lobe by midpoint sums, at most 1, shape [roughness, sqrt(cosine)]."""
    cosine = np.maximum(np.linspace(0.0, 1.0, SHEEN_COLUMNS) ** 2, 1e-5)
    steps = (np.arange(200) + 0.5) / 200.0
    cos_i, phi = (steps**3)[:, None], (np.pi * steps**2)[None, :]
    area = 2.0 * (3.0 * steps**2)[:, None] * (2.0 * np.pi * steps)[None, :] / 200.0**2
    table = np.zeros((SHEEN_ROWS, SHEEN_COLUMNS))
    for row, roughness in enumerate(np.linspace(0.0, 1.0, SHEEN_ROWS)):
        alpha = max(roughness**2, MIN_ALPHA)
        shade = 1.0 + fibre_lambda(cos_i, alpha)
        for column, cos_o in enumerate(cosine):
            dot = cos_o * cos_i - np.sqrt((1.0 - cos_o**2) * (1.0 - cos_i**2)) * np.cos(phi)
            sin2 = np.clip(1.0 - (cos_o + cos_i) ** 2 / (2.0 + 2.0 * dot), 0.0, 1.0)
            D = (2.0 + 1.0 / alpha) * sin2 ** (0.5 / alpha) / (2.0 * np.pi)
            masked = shade + fibre_lambda(np.array(cos_o), alpha)
            table[row, column] = np.sum(D / (4.0 * cos_o * masked) * area)
    return np.minimum(table, 1.0).astype(np.float32)


def read_sheen_table(table: mi.Float, cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """Bilinear lookup of `sheen_table`."""
    x = dr.sqrt(dr.clip(cosine, 0.0, 1.0)) * (SHEEN_COLUMNS - 1)
    y = dr.clip(roughness, 0.0, 1.0) * (SHEEN_ROWS - 1)
    column = dr.minimum(mi.UInt32(x), SHEEN_COLUMNS - 2)
    row = dr.minimum(mi.UInt32(y), SHEEN_ROWS - 2)
    x, y = x - mi.Float(column), y - mi.Float(row)

    def at(i: mi.UInt32, j: mi.UInt32) -> mi.Float:
        return dr.gather(mi.Float, table, i * SHEEN_COLUMNS + j)

    low = dr.lerp(at(row, column), at(row, column + 1), x)
    high = dr.lerp(at(row + 1, column), at(row + 1, column + 1), x)
    return dr.lerp(low, high, y)


def sample_visible_normal(wo: mi.Vector3f, alpha: mi.Float, u: mi.Point2f) -> mi.Vector3f:
    """Draw a GGX normal visible from ``wo`` (Dupuy and Benyoub 2023, spherical caps)."""
    stretched = dr.normalize(mi.Vector3f(wo.x * alpha, wo.y * alpha, wo.z))
    z = dr.fma(1.0 - u.y, 1.0 + stretched.z, -stretched.z)
    sin_phi, cos_phi = dr.sincos(dr.two_pi * u.x)
    r = dr.safe_sqrt((1.0 - z) * (1.0 + z))
    h = mi.Vector3f(r * cos_phi, r * sin_phi, z) + stretched
    return dr.normalize(mi.Vector3f(h.x * alpha, h.y * alpha, dr.maximum(h.z, 1e-9)))


def face_tangents(
    primitive: Primitive, uv_set: int, linear: NDArray[np.float64]
) -> NDArray[np.float32]:
    """World tangent and handedness of each triangle from its texture coordinates.

    glTF's v runs down the image and its normal maps have +Y up, so the bitangent points
    against ``dp_dv``: ``w = sign(dot(cross(n, t), -dp_dv))``.

    Args:
        primitive: Triangles, asset frame.
        uv_set: 0 or 1.
        linear: Asset-to-world linear part, shape [3, 3].

    Returns:
        Direction of increasing u and handedness, 0 where the mapping is degenerate,
        shape [triangle, 4].
    """
    indices = _wound(primitive, linear)
    tangents = np.zeros((len(indices), 4), dtype=np.float32)
    uv = (primitive.uv0, primitive.uv1)[uv_set]
    if uv is None:
        return tangents
    p = (primitive.positions @ linear.T)[indices]
    st = uv.astype(np.float64)[indices]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    s1, s2 = st[:, 1] - st[:, 0], st[:, 2] - st[:, 0]
    det = s1[:, 0] * s2[:, 1] - s2[:, 0] * s1[:, 1]
    good = np.abs(det) > 1e-20
    inverse = np.where(good, 1.0 / np.where(good, det, 1.0), 0.0)[:, None]
    dp_du = (e1 * s2[:, 1:] - e2 * s1[:, 1:]) * inverse
    dp_dv = (e2 * s1[:, :1] - e1 * s2[:, :1]) * inverse
    n = np.cross(e1, e2)
    length = np.linalg.norm(dp_du, axis=1, keepdims=True)
    tangents[:, :3] = dp_du / np.where(length > 0.0, length, 1.0)
    tangents[:, 3] = np.sign(np.einsum("ij,ij->i", np.cross(n, dp_du), -dp_dv))
    return tangents


def _wound(primitive: Primitive, linear: NDArray[np.float64]) -> NDArray[np.int32]:
    """Triangle indices, reversed where the matrix mirrors, so that outside stays outside."""
    return primitive.indices if np.linalg.det(linear) > 0.0 else primitive.indices[:, ::-1]


def _rgb(v: mi.Vector4f) -> mi.Color3f:
    """First three channels."""
    return mi.Color3f(v.x, v.y, v.z)
