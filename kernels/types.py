"""Structs that carry the scene into kernels and samples out of them; no field is differentiated."""

import warp as wp


@wp.struct
class CameraArgs:
    """Pinhole camera in the recentred world."""

    origin: wp.vec3
    """Camera centre [m]."""
    rotation: wp.mat33
    """Camera axes as columns: right, up, backward."""
    fx: float
    fy: float
    cx: float
    cy: float
    """Intrinsics [px]."""
    width: int
    """Image width [px]."""


@wp.struct
class ReceiverArgs:
    """The receiver, on which the object's shadow falls: a ground plane, a mesh, or both."""

    normal: wp.vec3
    """Of the plane ``dot(normal, x) = offset``, analytic and unbounded: unit normal, toward the
    side that receives light; 0 when there is no plane."""
    offset: float
    """Distance from the recentred origin along ``normal`` [m]."""
    tolerance: float
    """How far below plane and mesh the object still counts as lying on them [m]."""
    mesh: wp.uint64
    """Handle of the receiver's ``wp.Mesh``; 0 when there is none, and nothing below is read."""
    epsilon: float
    """Ray offset that depends on the mesh's size alone [m]."""
    positions: wp.array[wp.vec3]
    """Shape [vertex]."""
    indices: wp.array[int]
    """Vertex of each corner, shape [3 * triangle]."""
    eye: wp.vec3
    """Centre of the photo's camera [m]."""
    to_image: wp.mat33
    """Takes ``x - eye`` to (column, row, 1) of `radiance` times the depth."""
    radiance: wp.array2d[wp.vec3]
    """What the photo shows, before its tone operator, shape [height, width]."""
    elsewhere: wp.vec3
    """Radiance of the mesh where the photo does not show it."""
    shines: int
    """0 leaves out what the mesh sends; it still blocks light."""
    is_solid: int
    """1 lets the plane, too, end the rays that leave the object; kernels set it."""


@wp.struct
class MeshArgs:
    """All triangles of the object, with their attributes."""

    id: wp.uint64
    """Handle of the ``wp.Mesh`` of the triangles that stop every ray; 0 when there are none."""
    passing: wp.uint64
    """The same of those that may let rays pass, by their alpha or as glass."""
    passing_start: int
    """First triangle of `passing`; all that follow are of it."""
    embree: wp.uint64
    embree_passing: wp.uint64
    """Embree's scenes of the same triangles; 0 on CUDA and where Embree is not installed."""
    embree_intersect: wp.uint64
    embree_occluded: wp.uint64
    """Addresses of ``rtcIntersect1`` and ``rtcOccluded1``."""
    epsilon: float
    """Ray offset that depends on the scene's size alone [m]."""
    low: wp.vec3
    high: wp.vec3
    """Corners of the bounding box, wider by `epsilon`, recentred [m]."""
    indices: wp.array[int]
    """Vertex of each corner, shape [3 * triangle]."""
    positions: wp.array[wp.vec3]
    """Shape [vertex]."""
    normals: wp.array[wp.vec3]
    """Unit shading normals, shape [vertex]."""
    tangents: wp.array[wp.vec4]
    """Unit tangents and handedness; w = 0 where they follow from the UVs. Shape [vertex]."""
    uv0: wp.array[wp.vec2]
    uv1: wp.array[wp.vec2]
    """Texture coordinates, v down, shape [vertex]."""
    colors: wp.array[wp.vec4]
    """Linear RGBA factors, shape [vertex]."""
    face_material: wp.array[int]
    """Shape [triangle]."""


@wp.struct
class Layers:
    """What glTF's extensions add to metallic-roughness at one point, as seen from ``wo``.

    What depends on ``wo`` alone is worked out once, by `warpir.kernels.bsdf.layers_toward`.
    """

    present: int
    """1 where any of it differs from the plain model; the rest is not read otherwise."""
    f0: wp.vec3
    """Reflectance of the dielectric at normal incidence, strength included [1]."""
    f90: float
    """The same at grazing incidence [1]."""
    matte: float
    """Share of what enters the dielectric that its diffuse base gets [1]."""
    base_scale: float
    """Factor on the base below sheen and coat [1]."""
    emission_scale: float
    """Factor on what shines from below the coat [1]."""
    sheen_color: wp.vec3
    """Factor on the sheen's lobe, coat included [1]."""
    sheen_roughness: float
    sheen_albedo: float
    """Share of light that the lobe reflects toward ``wo`` [1]."""
    coat_weight: float
    """Factor on the coat's lobe, its Fresnel term included [1]."""
    coat_roughness: float
    coat_n: wp.vec3
    """Unit normal of the coat, in the shading normal's frame (`maths.frame.basis`)."""
    anisotropy: float
    """Squared strength of the base's anisotropy [1]; 0: its lobe is as wide in all directions."""
    stretch: wp.vec2
    """Unit direction in which that lobe is wider, in the x and y of the same frame."""
    iridescence: float
    """Share of the base that has a thin film [1]; 0: what else is said of it is not read."""
    film_ior: float
    """Index of refraction."""
    film_thickness: float
    """Of the film [nm]."""


@wp.struct
class Extensions:
    """What glTF's extensions say of a material, or of one point of it."""

    present: int
    """1 where any of it differs from the plain model."""
    f0: wp.vec3
    """Reflectance of the dielectric at normal incidence, colour included, before clamping [1]."""
    specular: float
    """Strength of the dielectric's reflection [1]."""
    clearcoat: float
    """Share of the surface that the coat covers [1]."""
    clearcoat_roughness: float
    clearcoat_normal_scale: float
    sheen_color: wp.vec3
    sheen_roughness: float
    transmission: float
    """Share of what enters the dielectric that leaves on the other side [1]."""
    anisotropy: float
    """Strength [1]."""
    stretch: wp.vec2
    """Cosine and sine of its rotation, from the tangent toward the bitangent."""
    iridescence: float
    """Share of the base that has a thin film [1]."""
    film_ior: float
    """Index of refraction."""
    film_minimum: float
    film_thickness: float
    """Thickness where its texture is 0, and where it is 1 or absent; at one point, its own [nm]."""


LAYERS = wp.constant(1)
ANISOTROPY = wp.constant(2)
IRIDESCENCE = wp.constant(4)
"""Flags of `MaterialArgs.any_layers`: some material has extensions; among them is that one."""


@wp.struct
class MaterialArgs:
    """Material factors and texture slots; `warpir.kernels.tracing.texture` numbers the slots."""

    base_color: wp.array[wp.vec3]
    metallic: wp.array[float]
    roughness: wp.array[float]
    emission: wp.array[wp.vec3]
    alpha: wp.array[float]
    alpha_mode: wp.array[int]
    """0 opaque, 1 mask, 2 blend."""
    alpha_cutoff: wp.array[float]
    double_sided: wp.array[int]
    normal_scale: wp.array[float]
    """All of shape [material]."""
    extensions: wp.array[Extensions]
    """Shape [material]; in one array, since functions take these arguments by value."""
    sheen_albedo: wp.array2d[float]
    """From `warpir.scene.sheen.sheen_albedo_table`."""
    slot_texture: wp.array2d[int]
    """Texture index or -1, shape [material, slot]."""
    slot_uv_set: wp.array2d[int]
    """0 or 1, shape [material, slot]."""
    slot_u: wp.array2d[wp.vec3]
    slot_v: wp.array2d[wp.vec3]
    """Rows of the affine UV transform, shape [material, slot]."""
    any_layers: int
    """What extensions some material has: 0 without any, else `LAYERS`, and what it adds."""
    any_culled: int
    """1 when some material is single sided."""
    any_emission: int
    """1 when some material emits."""


@wp.struct
class TextureArgs:
    """All textures, packed behind each other."""

    texels: wp.array[wp.uint32]
    """RGBA codes, R in the lowest byte, row-major, shape [sum of sizes]."""
    offset: wp.array[int]
    width: wp.array[int]
    height: wp.array[int]
    wrap_u: wp.array[int]
    wrap_v: wp.array[int]
    """0 repeat, 1 clamp, 2 mirror; all of shape [texture]."""
    decode: wp.array[float]
    """sRGB code to linear value, shape [256]."""


@wp.struct
class DrawnLight:
    """A direction that was drawn from the light, what comes from there, and its density.

    32 bytes, so that looking one up at random reads one line of the cache.
    """

    wi: wp.vec3
    """Unit, world frame."""
    pdf: float
    """Per solid angle."""
    radiance: wp.vec3
    padding: float


@wp.struct
class LightArgs:
    """Light at infinity: a sum of spherical Gaussians and of one lat-long map, either may be empty.

    The proposal draws a lobe with ``lobe_prob``, the map's bright texels with ``bright_prob``, or
    its others; the sum is 1. A number in [0, 1) picks them in the order bright, others, lobes.
    """

    lobe_count: int
    amplitude: wp.array[wp.vec3]
    axis: wp.array[wp.vec3]
    sharpness: wp.array[float]
    lobe_prob: wp.array[float]
    """Probability of each lobe, shape [lobe]."""
    lobe_pdf_peak: wp.array[float]
    """Density of a lobe's own sampler at its axis [1/sr], shape [lobe]."""
    map_prob: float
    """Probability of sampling the map; 0 without a map or for a black one."""
    bright_prob: float
    """Part of it that its bright texels have."""
    map_height: int
    map_width: int
    texels: wp.array2d[wp.vec3]
    """Radiance, shape [He, We]."""
    texel_prob: wp.array2d[float]
    """Probability of each texel, shape [He, We]; the sum is ``map_prob``."""
    row_cdf: wp.array2d[float]
    """Of the texels that are not bright and of those that are, shape [2, He + 1]."""
    column_cdf: wp.array2d[float]
    """Within each row, bright texels below the others, shape [2 He, We + 1]."""
    drawn: wp.array2d[DrawnLight]
    """Directions drawn for one launch (`warpir.render.device_light.drawn`), shape [cell, cell]."""


@wp.struct
class LampArgs:
    """Lamps near the object, all of shape [lamp]; they shine and block nothing."""

    count: int
    """0: there is none, and nothing else is read."""
    is_rectangle: wp.array[int]
    """1 for a rectangle, 0 for a sphere."""
    center: wp.array[wp.vec3]
    """Of the sphere, or the rectangle's corner [m], recentred."""
    radius: wp.array[float]
    """Of the sphere [m]."""
    edge_x: wp.array[wp.vec3]
    edge_y: wp.array[wp.vec3]
    """The rectangle's edges from its corner, at right angles [m]; it shines toward the side of
    their cross product."""
    radiance: wp.array[wp.vec3]
    """Of every point of the lamp, in all directions."""
    brightness: wp.array[float]
    """Luminance of `radiance`, by which lamps are picked."""


@wp.struct
class GlassArgs:
    """Solid glass (`warpir.kernels.dielectric`), shape [material] each; no arrays without any."""

    share: wp.array[float]
    """Share of a material's dielectric part that is solid glass [1]; 0: none of it."""
    ior: wp.array[float]
    """Index of refraction."""
    absorption: wp.array[wp.vec3]
    """Absorption coefficient [1/m]."""


@wp.struct
class LightRecord:
    """How each pixel depends on the light: ``radiance = sum_j weight[j] * L(wi[j])``.

    Rows are pixels, or the threads that share one; the first ``count`` entries of a row are filled.
    Without arrays nothing is recorded.
    """

    count: wp.array[int]
    """Shape [pixel]."""
    wi: wp.array2d[wp.vec3]
    """Directions that saw the light, world frame, shape [pixel, capacity]."""
    weight: wp.array2d[wp.vec3]
    """Of the object: RGB. Of the plane: (lit, unoccluded, 0). Shape [pixel, capacity]."""


@wp.struct
class VertexRecord:
    """The vertices of a pixel's paths as the attached pass needs them; the light is a constant.

    Rows are pixels; vertex k of path p is at ``k * path_count + p`` of ``depth + 1`` times
    ``path_count``. Without arrays nothing is recorded.
    """

    material: wp.array2d[int]
    """Material index, or -1 where the path has ended."""
    n: wp.array2d[wp.vec3]
    """Shading normal, world frame; so are the directions."""
    wo: wp.array2d[wp.vec3]
    texture_color: wp.array2d[wp.vec3]
    texture_metallic: wp.array2d[float]
    texture_roughness: wp.array2d[float]
    texture_emission: wp.array2d[wp.vec3]
    wi_light: wp.array2d[wp.vec3]
    incident_light: wp.array2d[wp.vec3]
    """``L cos visible mis / pdf`` of the light's direction, without f."""
    wi_bsdf: wp.array2d[wp.vec3]
    incident_bsdf: wp.array2d[wp.vec3]
    """The same of the BSDF's direction; 0 when it met the object."""
    cos_over_pdf: wp.array2d[float]
    """``cos / pdf`` of the BSDF's direction when it met the object, else 0."""
    layers: wp.array2d[Layers]
    """Without columns where no material is layered."""
