"""The metallic-roughness material of glTF 2.0 as a Mitsuba 3 BSDF.

Written from appendix B of the specification alone (https://registry.khronos.org/glTF/specs/2.0,
"BRDF implementation"): GGX, height-correlated Smith, Schlick, and a Lambert lobe damped by the
same Fresnel term; and from the README of each KHR_materials extension: ior, specular, clearcoat,
sheen (the form whose albedo scaling depends on the view alone), thin transmission, whose light goes
straight on with the luminance of its tint, anisotropy and iridescence. Names follow warpir: ``wo``
toward the camera, ``wi`` toward the light; Mitsuba's arguments are the other way round and are
renamed at the border of each method.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from warpir.mitsuba.lobes import (
    MIN_ALPHA,
    charlie,
    film_reflectance,
    ggx,
    read_sheen_table,
    sample_visible_normal,
    schlick_weight,
    sheen_table,
)
from warpir.mitsuba.texture import Image, face_tangents, wound
from warpir.scene.asset import Asset, Primitive, TextureSlot

IS_COLOR = {
    "base_color": True,
    "metallic_roughness": False,
    "normal": False,
    "emission": True,
    "specular": False,
    "specular_color": True,
    "clearcoat": False,
    "clearcoat_roughness": False,
    "clearcoat_normal": False,
    "sheen_color": True,
    "sheen_roughness": False,
    "transmission": False,
    "anisotropy": False,
    "iridescence": False,
    "iridescence_thickness": False,
}
"""Textures of a `Material` by name, and whether their RGB is sRGB."""


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
    frame: Any
    """Of the shading normal; its x is the direction of anisotropy."""
    alpha: Any
    """GGX widths along x and y of `frame` [1]."""
    dielectric_f0: Any
    """Reflectance of the dielectric at normal incidence [1]."""
    dielectric_f90: Any
    """Reflectance of the dielectric at grazing incidence [1]."""
    film: Any
    """Share with a thin film [1], its index and thickness [nm]; None without any."""
    transmission: Any
    """Share of what enters the dielectric that goes through [1]."""
    sheen_color: Any
    sheen_alpha: Any
    sheen_scale: Any
    """Factor on the base below the sheen [1]."""
    coat: Any
    """Clear coat times its Fresnel term [1]."""
    coat_alpha: Any
    coat_frame: Any
    """Of the coat's unit normal, which is on the side of ``wo``."""
    stopped: Any
    """Share of rays that the surface does not let through [1]."""

    def reflectance(self, cosine: Any) -> tuple[Any, Any]:
        """Fresnel terms of the dielectric and of the whole base [1]."""
        weight = schlick_weight(cosine)
        dielectric = dr.lerp(self.dielectric_f0, mi.Color3f(self.dielectric_f90), weight)
        metal = dr.lerp(self.base_color, mi.Color3f(1.0), weight)
        if self.film is not None:
            share, *film = self.film
            filmed = film_reflectance(self.dielectric_f0, *film, cosine)
            dielectric = dr.lerp(dielectric, filmed, share)
            metal = dr.lerp(metal, film_reflectance(self.base_color, *film, cosine), share)
        return dielectric, dr.lerp(dielectric, metal, self.metallic)


class GltfBSDF(mi.BSDF):
    """One primitive's material, with the vertex attributes it reads.

    The mesh must carry no texture coordinates of its own: Mitsuba then leaves the barycentric
    coordinates in ``si.uv``, and all interpolation happens here.
    """

    def __init__(self, asset: Asset, primitive: Primitive, linear: NDArray[np.float64]) -> None:
        """Copy attributes and textures of a primitive, and of the asset that has it, to the device.

        ``linear`` is the asset-to-world linear part, shape [3, 3]; it turns tangents.
        """
        super().__init__(mi.Properties())
        material = asset.materials[primitive.material]
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        if material.double_sided:
            flags = flags | mi.BSDFFlags.BackSide
        self.m_components = [flags]
        self.m_flags = flags
        self.material = material
        textures = {name: getattr(material, f"{name}_texture") for name in IS_COLOR}
        self.images = {
            name: Image(asset.textures[slot.texture], slot, IS_COLOR[name])
            for name, slot in textures.items()
            if slot is not None
        }
        has_sheen = max(material.sheen_color) > 0.0
        self.sheen_table = mi.Float(sheen_table().ravel()) if has_sheen else None

        self.indices = mi.UInt32(wound(primitive, linear).astype(np.uint32).ravel())
        self.uvs = [_uploaded(uv) for uv in (primitive.uv0, primitive.uv1)]
        self.colors = _uploaded(primitive.colors)
        self.vertex_tangents = None
        self.face_tangents: dict[str, mi.Float] = {}
        maps = ("normal", "clearcoat_normal", "anisotropy")
        slots = {name: self.images[name].slot for name in maps if name in self.images}
        if material.anisotropy > 0.0:
            slots.setdefault("anisotropy", slots.get("normal", TextureSlot(0)))
        if slots and primitive.tangents is not None:
            turned = primitive.tangents.astype(np.float64)
            turned[:, :3] = turned[:, :3] @ linear.T
            # A mirroring matrix turns the handedness of (n, t, b) around
            turned[:, 3] *= np.sign(np.linalg.det(linear))
            self.vertex_tangents = _uploaded(turned.astype(np.float32))
        else:
            self.face_tangents = {
                name: _uploaded(face_tangents(primitive, slot, linear))
                for name, slot in slots.items()
            }

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

        def mirrored(frame: mi.Frame3f, alpha: mi.Vector2f) -> mi.Vector3f:
            wo = frame.to_local(surface.wo)
            wm = sample_visible_normal(wo, alpha, sample2)
            return frame.to_world(2.0 * dr.dot(wo, wm) * wm - wo)

        diffuse = mi.Frame3f(surface.n).to_world(mi.warp.square_to_cosine_hemisphere(sample2))
        wi = dr.select(
            sample1 < coat + (1.0 - coat) * specular,
            mirrored(surface.frame, surface.alpha),
            diffuse,
        )
        wi = dr.select(sample1 < coat, mirrored(surface.coat_frame, surface.coat_alpha), wi)
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
            alpha *= self._factor("alpha", "base_color", 3, si, active)
            if self.colors is not None:
                alpha *= self._interpolate(self.colors, mi.Vector4f, si, active).w
        if self.material.alpha_mode == "MASK":
            alpha = dr.select(alpha >= self.material.alpha_cutoff, mi.Float(1.0), 0.0)
        alpha = dr.clip(alpha, 0.0, 1.0)
        if self.material.transmission > 0.0:
            alpha *= self._surface(si, active).stopped
        return mi.Color3f(1.0 - alpha) & active

    def has_attribute(self, name: str, active: mi.Bool = True) -> mi.Bool:
        """Return whether the attribute is ``emission``, the only one."""
        return name == "emission"

    def eval_attribute_3(
        self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool = True
    ) -> mi.Color3f:
        """Emitted radiance, the same in all directions, relative [W/(m^2 sr)]."""
        surface = self._surface(si, active)
        return self._color("emission", si, active) * (1.0 - surface.coat) / surface.stopped & active

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

    def _read(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Vector4f:
        """RGBA of a texture at the hit, white where the material has none [1]."""
        image = self.images.get(name)
        if image is None:
            return mi.Vector4f(1.0)
        uv = self.uvs[image.slot.uv_set]
        if uv is None:
            return image.read(mi.Point2f(0.0), active)
        return image.read(self._interpolate(uv, mi.Point2f, si, active), active)

    def _color(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """A colour of the material times its texture, linear RGB."""
        return mi.Color3f(*getattr(self.material, name)) * _rgb(self._read(name, si, active))

    def _factor(
        self, name: str, texture: str, channel: int, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.Float:
        """A factor of the material times one channel of a texture [1]."""
        return getattr(self.material, name) * self._read(texture, si, active)[channel]

    def _surface(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Surface:
        """Textured material and oriented normals at the hit."""
        material, hit = self.material, (si, active)
        base_color = self._color("base_color", *hit)
        if self.colors is not None:
            base_color *= _rgb(self._interpolate(self.colors, mi.Vector4f, *hit))
        roughness = self._factor("roughness", "metallic_roughness", 1, *hit)
        metallic = self._factor("metallic", "metallic_roughness", 2, *hit)
        wo = si.to_world(si.wi)
        n, coat_n, ng = self._oriented_normals(wo, *hit)

        # KHR_materials_anisotropy
        frame, strength = self._stretch(n, *hit)
        across = dr.maximum(dr.square(roughness), MIN_ALPHA)
        alpha = mi.Vector2f(dr.lerp(across, 1.0, dr.square(strength)), across)

        # KHR_materials_ior, _specular
        f0 = ((1.0 - material.ior) / (1.0 + material.ior)) ** 2
        f0 = f0 * self._color("specular_color", *hit)
        f90 = self._factor("specular", "specular", 3, *hit)
        f0 = dr.minimum(f0, 1.0) * f90

        # KHR_materials_clearcoat, _sheen
        clearcoat = self._factor("clearcoat", "clearcoat", 0, *hit)
        coat = clearcoat * (0.04 + 0.96 * schlick_weight(dr.abs(dr.dot(wo, coat_n))))
        coat_roughness = self._factor("clearcoat_roughness", "clearcoat_roughness", 1, *hit)
        sheen = self._color("sheen_color", *hit)
        sheen_roughness = self._factor("sheen_roughness", "sheen_roughness", 3, *hit)
        sheen_scale = mi.Float(1.0)
        if self.sheen_table is not None:
            E = read_sheen_table(self.sheen_table, dr.dot(n, wo), sheen_roughness)
            sheen_scale = 1.0 - dr.max(sheen) * E

        surface = Surface(
            wo=wo,
            n=n,
            ng=ng,
            base_color=base_color,
            metallic=metallic,
            frame=frame,
            alpha=alpha,
            dielectric_f0=f0,
            dielectric_f90=f90,
            film=self._film(*hit),
            transmission=self._factor("transmission", "transmission", 0, *hit),
            sheen_color=sheen,
            sheen_alpha=dr.maximum(dr.square(sheen_roughness), MIN_ALPHA),
            sheen_scale=sheen_scale,
            coat=coat,
            coat_alpha=mi.Vector2f(dr.maximum(dr.square(coat_roughness), MIN_ALPHA)),
            coat_frame=mi.Frame3f(coat_n),
            stopped=None,
        )
        surface.stopped = 1.0 - self._passing(surface, si, clearcoat, sheen_roughness)
        return surface

    def _passing(
        self,
        surface: Surface,
        si: mi.SurfaceInteraction3f,
        clearcoat: mi.Float,
        sheen_roughness: mi.Float,
    ) -> mi.Float:
        """Share that passes (KHR_materials_transmission), by the normal before any map."""
        cosine = dr.abs(dr.dot(si.sh_frame.n, surface.wo))
        enters = 1.0 - dr.max(surface.reflectance(cosine)[0])
        enters *= 1.0 - clearcoat * (0.04 + 0.96 * schlick_weight(cosine))
        if self.sheen_table is not None:
            E = read_sheen_table(self.sheen_table, cosine, sheen_roughness)
            enters *= 1.0 - dr.max(surface.sheen_color) * E
        tint = mi.luminance(surface.base_color)
        return surface.transmission * (1.0 - surface.metallic) * tint * enters

    def _film(
        self, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Float, float, mi.Float] | None:
        """Share with a thin film [1], its index and thickness [nm] (KHR_materials_iridescence)."""
        material = self.material
        if material.iridescence <= 0.0:
            return None
        low, high = material.iridescence_thickness
        thickness = dr.lerp(low, high, self._read("iridescence_thickness", si, active).y)
        # Thinner than 0.03 nm it fades out
        x = dr.clip(thickness / 0.03, 0.0, 1.0)
        share = self._factor("iridescence", "iridescence", 0, si, active)
        return share * x * x * (3.0 - 2.0 * x), material.iridescence_ior, thickness

    def _oriented_normals(
        self, wo: mi.Vector3f, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]:
        """Normals of the base, the coat and the triangle, turned to the viewer.

        Where a shading normal still faces away, the triangle's takes its place.
        """
        ng = mi.Vector3f(si.n)
        side = dr.select(dr.dot(ng, wo) < 0.0, mi.Float(-1.0), 1.0)
        ng = ng * side

        def oriented(name: str, scale: float) -> mi.Vector3f:
            n = self._shading_normal(name, scale, si, active) * side
            return dr.select(dr.dot(n, wo) > 0.0, n, ng)

        n = oriented("normal", self.material.normal_scale)
        return n, oriented("clearcoat_normal", self.material.clearcoat_normal_scale), ng

    def _shading_normal(
        self, name: str, scale: float, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.Vector3f:
        """Unit normal after a normal map, on the side the triangle's winding gives."""
        n = mi.Vector3f(si.sh_frame.n)
        if name not in self.images:
            return n
        texel = self._read(name, si, active) * 2.0 - 1.0
        t, b, usable = self._tangents(name, n, si, active)
        mapped = (t * texel.x + b * texel.y) * scale + n * texel.z
        size = dr.norm(mapped)
        usable &= size > 1e-6
        return dr.select(usable, mapped / dr.select(usable, size, 1.0), n)

    def _stretch(
        self, n: mi.Vector3f, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Frame3f, mi.Float]:
        """Frame about ``n`` whose x is the direction of anisotropy, and its strength, 0 without."""
        frame = mi.Frame3f(n)
        if self.material.anisotropy <= 0.0:
            return frame, mi.Float(0.0)
        t, b, usable = self._tangents("anisotropy", mi.Vector3f(si.sh_frame.n), si, active)
        x, y = mi.Float(1.0), mi.Float(0.0)
        if "anisotropy" in self.images:
            texel = self._read("anisotropy", si, active) * 2.0 - 1.0
            x, y = texel.x, texel.y
        s, c = dr.sincos(mi.Float(self.material.anisotropy_rotation))
        stretch = t * (c * x - s * y) + b * (s * x + c * y)
        stretch = stretch - n * dr.dot(n, stretch)
        length = dr.norm(stretch)
        usable &= length > 1e-6
        frame.s = dr.select(usable, stretch / dr.select(usable, length, 1.0), frame.s)
        frame.t = dr.cross(n, frame.s)
        strength = self._factor("anisotropy", "anisotropy", 2, si, active)
        return frame, dr.select(usable, strength, 0.0)

    def _tangents(
        self, name: str, n: mi.Vector3f, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Vector3f, mi.Bool]:
        """Tangent and bitangent of a map at right angles to ``n``, and whether they are known.

        Those that the mesh lacks are along the map's own coordinates.
        """
        if self.vertex_tangents is not None:
            tangent = self._interpolate(self.vertex_tangents, mi.Vector4f, si, active)
        else:
            tangent = dr.gather(mi.Vector4f, self.face_tangents[name], si.prim_index, active)
        t = mi.Vector3f(tangent.x, tangent.y, tangent.z)
        t = t - n * dr.dot(n, t)
        length = dr.norm(t)
        usable = length > 1e-6
        t = t / dr.select(usable, length, 1.0)
        return t, dr.cross(n, t) * dr.select(tangent.w < 0.0, mi.Float(-1.0), 1.0), usable

    @staticmethod
    def _shares(surface: Surface) -> tuple[mi.Float, mi.Float]:
        """Probabilities of sampling the coat, and else the base's GGX lobe: rough shares."""
        cos_o = dr.dot(surface.n, surface.wo)
        dielectric, whole = surface.reflectance(cos_o)
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
        dielectric, fresnel = surface.reflectance(dr.abs(dr.dot(wo, wm)))
        matte = (1.0 - surface.metallic) * (1.0 - surface.transmission)
        matte *= 1.0 - dr.max(dielectric)
        lobe, density = ggx(surface.frame, surface.alpha, wo, wi)
        f_cos = (matte * surface.base_color * dr.inv_pi + fresnel * lobe) * cos_i
        f_cos *= surface.sheen_scale
        if self.sheen_table is not None:
            f_cos += surface.sheen_color * charlie(
                dr.dot(surface.n, wm), cos_o, cos_i, surface.sheen_alpha
            )
        coat_lobe, coat_density = ggx(surface.coat_frame, surface.coat_alpha, wo, wi)
        coat_cos = dr.maximum(dr.dot(surface.coat_frame.n, wi), 0.0)
        f_cos = dr.lerp(f_cos, mi.Color3f(coat_lobe * coat_cos), surface.coat)
        coat, specular = self._shares(surface)
        pdf = dr.lerp(cos_i * dr.inv_pi, density, specular)
        pdf = dr.lerp(pdf, coat_density, coat)
        return dr.select(valid, f_cos / surface.stopped, 0.0), dr.select(valid, pdf, 0.0)


def _uploaded(attribute: NDArray[np.float32] | None) -> mi.Float | None:
    """Copy an attribute of the vertices or triangles to the device."""
    return None if attribute is None else mi.Float(np.ascontiguousarray(attribute).ravel())


def _rgb(v: mi.Vector4f) -> mi.Color3f:
    """First three channels."""
    return mi.Color3f(v.x, v.y, v.z)
