"""The attached half of `mis`: recorded vertices times materials, differentiated by Warp.

Directions, densities, MIS weights, visibility and the light are constants here (detached sampling),
so gradients flow through the BSDF's value and the emission alone, as in path replay (Vicini et al.
2021); the light's own gradient is `warpir.kernels.light_gradient`. One launch per path vertex: Warp
does not replay what a loop multiplies.
"""

import warp as wp

from warpir.kernels.bsdf import bsdf_f, bsdf_of
from warpir.kernels.maths.frame import basis, to_local
from warpir.kernels.types import Layers, VertexRecord


@wp.func
def layers_of(record: VertexRecord, i: int, j: int) -> Layers:
    """Return the extensions at a vertex."""
    if record.layers.shape[1] > 0:
        return record.layers[i, j]
    layers = Layers()
    layers.present = 0
    return layers


@wp.kernel
def shade_vertex(
    record: VertexRecord,
    path_count: int,
    k: int,
    base_color: wp.array[wp.vec3],
    metallic: wp.array[float],
    roughness: wp.array[float],
    emission: wp.array[wp.vec3],
    throughput: wp.array[wp.vec3],
    contribution: wp.array[wp.vec3],
    throughput_next: wp.array[wp.vec3],
):
    """Evaluate vertex ``k`` of every recorded path.

    Path ``p`` of pixel ``i`` is thread ``i * path_count + p``.

    Args:
        record: Detached samples, rows are pixels.
        path_count: Paths of a pixel.
        k: Which vertex.
        base_color: Factor of each material, linear RGB [1], shape [material].
        metallic: Factor [1], shape [material].
        roughness: Factor [1], shape [material].
        emission: Radiance factor, relative [W/(m^2 sr)], shape [material].
        throughput: Of the path up to this vertex [1], shape [path].
        contribution: Output: radiance that this vertex adds, shape [path].
        throughput_next: Output: throughput behind this vertex, shape [path].
    """
    path = wp.tid()
    i = path // path_count
    j = k * path_count + path % path_count
    m = record.material[i, j]
    if m < 0:
        contribution[path] = wp.vec3(0.0)
        throughput_next[path] = wp.vec3(0.0)
        return
    color = wp.cw_mul(base_color[m], record.texture_color[i, j])
    metal = metallic[m] * record.texture_metallic[i, j]
    rough = roughness[m] * record.texture_roughness[i, j]
    frame = basis(record.n[i, j])
    wo = to_local(record.wo[i, j], frame)
    bsdf = bsdf_of(wo, color, metal, rough, layers_of(record, i, j))
    gathered = wp.cw_mul(emission[m], record.texture_emission[i, j])

    # The emitter's direction
    incident_light = record.incident_light[i, j]
    if wp.max(incident_light) > 0.0:
        f_light = bsdf_f(bsdf, to_local(record.wi_light[i, j], frame))
        gathered = gathered + wp.cw_mul(f_light.diffuse + f_light.specular, incident_light)

    # The BSDF's direction, along which the path goes on
    incident_bsdf = record.incident_bsdf[i, j]
    cos_over_pdf = record.cos_over_pdf[i, j]
    onward = wp.vec3(0.0)
    if wp.max(incident_bsdf) > 0.0 or cos_over_pdf > 0.0:
        f_bsdf = bsdf_f(bsdf, to_local(record.wi_bsdf[i, j], frame))
        f = f_bsdf.diffuse + f_bsdf.specular
        onward = f * cos_over_pdf
        gathered = gathered + wp.cw_mul(f, incident_bsdf)
    contribution[path] = wp.cw_mul(throughput[path], gathered)
    throughput_next[path] = wp.cw_mul(throughput[path], onward)
