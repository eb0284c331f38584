"""The metallic-roughness material of glTF 2.0 as a Mitsuba 3 BSDF.

Written from appendix B of the specification alone (https://registry.khronos.org/glTF/specs/2.0,
"BRDF implementation"): GGX, height-correlated Smith, Schlick, and a Lambert lobe damped by the
same Fresnel term. Names follow warpir: ``wo`` toward the camera, ``wi`` toward the light;
Mitsuba's arguments are the other way round and are renamed at the border of each method.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from warpir.asset import Asset, Material, Primitive, Texture, TextureSlot

MIN_ALPHA = 1e-3


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
    c_diff: Any
    """Diffuse albedo [1]."""
    f0: Any
    """Reflectance at normal incidence [1]."""
    alpha: Any
    """GGX width, perceptual roughness squared [1]."""


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

        self.indices = mi.UInt32(_wound(primitive, linear).astype(np.uint32).ravel())
        self.uvs = [
            None if uv is None else mi.Float(np.ascontiguousarray(uv).ravel())
            for uv in (primitive.uv0, primitive.uv1)
        ]
        self.colors = None
        if primitive.colors is not None:
            self.colors = mi.Float(np.ascontiguousarray(primitive.colors).ravel())
        self.vertex_tangents = self.face_tangents = None
        if self.normal_image is not None:
            if primitive.tangents is not None:
                turned = primitive.tangents.astype(np.float64)
                turned[:, :3] = turned[:, :3] @ linear.T
                # A mirroring matrix turns the handedness of (n, t, b) around
                turned[:, 3] *= np.sign(np.linalg.det(linear))
                self.vertex_tangents = mi.Float(turned.astype(np.float32).ravel())
            else:
                self.face_tangents = mi.Float(
                    face_tangents(primitive, self.normal_image.slot.uv_set, linear).ravel()
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
        frame = mi.Frame3f(surface.n)
        wo = frame.to_local(surface.wo)
        wm = sample_visible_normal(wo, surface.alpha, sample2)
        reflected = 2.0 * dr.dot(wo, wm) * wm - wo
        diffuse = mi.warp.square_to_cosine_hemisphere(sample2)
        wi = frame.to_world(
            dr.select(sample1 < self._specular_share(surface, wo.z), reflected, diffuse)
        )
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
        """Share of light that passes straight through: 1 - coverage."""
        if self.material.alpha_mode == "OPAQUE":
            return mi.Color3f(0.0)
        alpha = mi.Float(self.material.alpha)
        if self.base_color_image is not None:
            alpha *= self._read(self.base_color_image, si, active).w
        if self.colors is not None:
            alpha *= self._interpolate(self.colors, mi.Vector4f, si, active).w
        if self.material.alpha_mode == "MASK":
            alpha = dr.select(alpha >= self.material.alpha_cutoff, mi.Float(1.0), 0.0)
        return mi.Color3f(1.0 - dr.clip(alpha, 0.0, 1.0)) & active

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
        return emission & active

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
        if self.base_color_image is not None:
            base_color *= _rgb(self._read(self.base_color_image, si, active))
        if self.colors is not None:
            base_color *= _rgb(self._interpolate(self.colors, mi.Vector4f, si, active))
        metallic, roughness = mi.Float(material.metallic), mi.Float(material.roughness)
        if self.metallic_roughness_image is not None:
            texel = self._read(self.metallic_roughness_image, si, active)
            roughness *= texel.y
            metallic *= texel.z

        # Both normals turn to the viewer; where the shading normal still faces away, ng
        wo = si.to_world(si.wi)
        n, ng = self._shading_normal(si, active), mi.Vector3f(si.n)
        side = dr.select(dr.dot(ng, wo) < 0.0, mi.Float(-1.0), 1.0)
        n, ng = n * side, ng * side
        n = dr.select(dr.dot(n, wo) > 0.0, n, ng)
        return Surface(
            wo,
            n,
            ng,
            base_color * (1.0 - metallic),
            dr.lerp(mi.Color3f(0.04), base_color, metallic),
            dr.maximum(dr.square(roughness), MIN_ALPHA),
        )

    def _shading_normal(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Vector3f:
        """Unit normal after the normal map, on the side the triangle's winding gives."""
        n = mi.Vector3f(si.sh_frame.n)
        if self.normal_image is None:
            return n
        texel = self._read(self.normal_image, si, active) * 2.0 - 1.0
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
        mapped = (t * texel.x + b * texel.y) * self.material.normal_scale + n * texel.z
        size = dr.norm(mapped)
        usable &= size > 1e-6
        return dr.select(usable, mapped / dr.select(usable, size, 1.0), n)

    @staticmethod
    def _specular_share(surface: Surface, cos_o: mi.Float) -> mi.Float:
        """Probability of sampling the GGX lobe: its rough share of the reflected energy."""
        fresnel = dr.max(schlick(surface.f0, cos_o))
        diffuse = (1.0 - fresnel) * dr.max(surface.c_diff)
        share = dr.clip(fresnel / dr.maximum(fresnel + diffuse, 1e-6), 0.1, 1.0)
        return dr.select(dr.max(surface.c_diff) > 0.0, share, 1.0)

    def _eval_pdf(self, surface: Surface, wi: mi.Vector3f) -> tuple[mi.Color3f, mi.Float]:
        """Return ``f cos_i`` and the mixture density for a world direction [1/sr]."""
        frame = mi.Frame3f(surface.n)
        wo_local, wi_local = frame.to_local(surface.wo), frame.to_local(wi)
        cos_o, cos_i = wo_local.z, wi_local.z
        valid = (cos_o > 0.0) & (cos_i > 0.0)
        valid &= (dr.dot(surface.ng, surface.wo) > 0.0) & (dr.dot(surface.ng, wi) > 0.0)
        wm = dr.normalize(wo_local + wi_local)
        fresnel = schlick(surface.f0, dr.abs(dr.dot(wo_local, wm)))

        # GGX from tangents: 1 - cos^2 would lose the narrow lobes to rounding
        alpha2 = dr.square(surface.alpha)
        slope = (dr.square(wm.x) + dr.square(wm.y)) / alpha2 + dr.square(wm.z)
        D = dr.rcp(dr.pi * alpha2 * dr.square(slope))
        root_o = dr.sqrt(alpha2 + (1.0 - alpha2) * dr.square(cos_o))
        root_i = dr.sqrt(alpha2 + (1.0 - alpha2) * dr.square(cos_i))
        visibility = 0.5 / (cos_i * root_o + cos_o * root_i)

        # The base receives what the dielectric's Fresnel term leaves, whatever the metallic
        rest = 1.0 - schlick(mi.Color3f(0.04), dr.abs(dr.dot(wo_local, wm)))
        f = rest * surface.c_diff * dr.inv_pi + fresnel * D * visibility
        share = self._specular_share(surface, cos_o)
        # G1(wo) D / (4 cos_o), with G1 = 2 cos_o / (cos_o + root_o)
        pdf = share * D * 0.5 / (cos_o + root_o) + (1.0 - share) * cos_i * dr.inv_pi
        return dr.select(valid, f * cos_i, 0.0), dr.select(valid, pdf, 0.0)


def schlick(f0: mi.Color3f, cosine: mi.Float) -> mi.Color3f:
    """Fresnel reflectance, ``f0 + (1 - f0) (1 - cos)^5`` [1]."""
    x = dr.clip(1.0 - cosine, 0.0, 1.0)
    x2 = x * x
    return f0 + (1.0 - f0) * (x2 * x2 * x)


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
