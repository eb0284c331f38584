"""The attached half of `mis`: recorded samples times light and material, for the tape.

Samples, densities, MIS weights and visibility are constants here (detached sampling), so gradients
flow through the light's radiance and the BRDF's value alone, as in path replay (Vicini et al.
2021).
One launch per path vertex: Warp does not replay what a loop multiplies.
"""

import warp as wp

from warpir.kernels.brdf import brdf_eval
from warpir.kernels.frame import basis, to_local
from warpir.kernels.latlong import bilinear_tap, direction_to_uv, map_radiance
from warpir.kernels.path import PathRecord
from warpir.kernels.proxy import ProxyRecord
from warpir.kernels.sg import sg_radiance


@wp.func
def light_radiance(
    wi: wp.vec3,
    amplitude: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    lobe_count: int,
    texels: wp.array2d[wp.vec3],
    map_height: int,
    map_width: int,
) -> wp.vec3:
    """Radiance from direction ``wi``: lobes plus map; differentiable in both."""
    L = sg_radiance(wi, amplitude, axis, sharpness, lobe_count)
    if map_height > 0:
        tap = bilinear_tap(direction_to_uv(wi), map_height, map_width)
        L = L + map_radiance(texels, tap)
    return L


@wp.kernel
def shade_vertex(
    record: PathRecord,
    k: int,
    base_color: wp.array[wp.vec3],
    metallic: wp.array[float],
    roughness: wp.array[float],
    emission: wp.array[wp.vec3],
    amplitude: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    lobe_count: int,
    texels: wp.array2d[wp.vec3],
    map_height: int,
    map_width: int,
    throughput: wp.array[wp.vec3],
    contribution: wp.array[wp.vec3],
    throughput_next: wp.array[wp.vec3],
):
    """Evaluate vertex ``k`` of every recorded path.

    Args:
        record: Detached samples, shape [depth + 1, path].
        k: Which vertex.
        base_color: Factor of each material, linear RGB [1], shape [material].
        metallic: Factor [1], shape [material].
        roughness: Factor [1], shape [material].
        emission: Radiance factor, relative [W/(m^2 sr)], shape [material].
        amplitude: Lobes of the light, shape [lobe].
        axis: Unit lobe axes, shape [lobe].
        sharpness: Lobe concentration, shape [lobe].
        lobe_count: Number of lobes.
        texels: Map of the light, shape [He, We].
        map_height: He, or 0 without a map.
        map_width: We.
        throughput: Of the path up to this vertex [1], shape [path].
        contribution: Output: radiance that this vertex adds, shape [path].
        throughput_next: Output: throughput behind this vertex, shape [path].
    """
    path = wp.tid()
    m = record.material[k, path]
    if m < 0:
        contribution[path] = wp.vec3(0.0)
        throughput_next[path] = wp.vec3(0.0)
        return
    color = wp.cw_mul(base_color[m], record.texture_color[k, path])
    metal = metallic[m] * record.texture_metallic[k, path]
    rough = roughness[m] * record.texture_roughness[k, path]
    frame = basis(record.n[k, path])
    wo = to_local(record.wo[k, path], frame)
    gathered = wp.cw_mul(emission[m], record.texture_emission[k, path])

    weight_light = record.weight_light[k, path]
    if weight_light > 0.0:
        wi = record.wi_light[k, path]
        f_light = brdf_eval(wo, to_local(wi, frame), color, metal, rough)
        L_light = light_radiance(
            wi, amplitude, axis, sharpness, lobe_count, texels, map_height, map_width
        )
        gathered = gathered + wp.cw_mul(f_light.diffuse + f_light.specular, L_light) * weight_light

    weight_brdf = record.weight_brdf[k, path]
    weight_next = record.weight_next[k, path]
    onward = wp.vec3(0.0)
    if weight_brdf > 0.0 or weight_next > 0.0:
        wi2 = record.wi_brdf[k, path]
        f_brdf = brdf_eval(wo, to_local(wi2, frame), color, metal, rough)
        f = f_brdf.diffuse + f_brdf.specular
        onward = f * weight_next
        if weight_brdf > 0.0:
            L_brdf = light_radiance(
                wi2, amplitude, axis, sharpness, lobe_count, texels, map_height, map_width
            )
            gathered = gathered + wp.cw_mul(f, L_brdf) * weight_brdf
    contribution[path] = wp.cw_mul(throughput[path], gathered)
    throughput_next[path] = wp.cw_mul(throughput[path], onward)


@wp.kernel
def sum_paths(
    contribution: wp.array[wp.vec3],
    paths_per_pixel: int,
    scale: float,
    foreground: wp.array[wp.vec3],
):
    """Add the mean contribution of a pixel's paths to its radiance; one launch per vertex."""
    i = wp.tid()
    total = wp.vec3(0.0)
    for p in range(paths_per_pixel):
        total += contribution[i * paths_per_pixel + p] * scale
    foreground[i] += total


@wp.kernel
def shade_proxy(
    record: ProxyRecord,
    paths_per_pixel: int,
    amplitude: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    lobe_count: int,
    texels: wp.array2d[wp.vec3],
    map_height: int,
    map_width: int,
    lit: wp.array[wp.vec3],
    unoccluded: wp.array[wp.vec3],
):
    """Radiance of a white plane with (``lit``) and without the object, shape [proxy_pixel] each."""
    i = wp.tid()
    sum_lit = wp.vec3(0.0)
    sum_all = wp.vec3(0.0)
    for p in range(paths_per_pixel):
        path = i * paths_per_pixel + p
        from_light = record.weight[0, path] * light_radiance(
            record.wi[0, path],
            amplitude,
            axis,
            sharpness,
            lobe_count,
            texels,
            map_height,
            map_width,
        )
        from_cosine = record.weight[1, path] * light_radiance(
            record.wi[1, path],
            amplitude,
            axis,
            sharpness,
            lobe_count,
            texels,
            map_height,
            map_width,
        )
        sum_all += from_light + from_cosine
        sum_lit += from_light * record.visible[0, path] + from_cosine * record.visible[1, path]
    lit[i] = sum_lit
    unoccluded[i] = sum_all
