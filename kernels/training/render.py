"""Small pictures of many made-up scenes at once, for training: one thread per pixel and scene.

Nothing is drawn at random here. All pixels of a picture share the same directions, so that its
light is exact up to a smooth error: grain would give an inserted object away at once.
"""

import warp as wp

from warpir.kernels.training.scene import (
    FAR,
    GroundTable,
    LightTable,
    MapTable,
    ObjectTable,
    OccluderTable,
    ViewTable,
    blurred,
    fresnel_mix,
    ground_albedo,
    irradiance_among_solids,
    is_open,
    misses_object,
    nearest_solid,
    piece_of_panorama,
    seen_sky,
    sun_highlight,
    turned,
)

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.14159265358979)
SUBSETS = wp.constant(4)
"""Each point of a pixel asks every fourth direction; neighbouring points ask different ones."""


@wp.struct
class Pixels:
    """What is written, one value per pixel, all scenes."""

    background: wp.array[wp.vec3]
    """Radiance without the object."""
    object: wp.array[wp.vec3]
    """The object's radiance times its coverage."""
    coverage: wp.array[float]
    albedo: wp.array[wp.vec3]
    """Times the coverage."""
    normal: wp.array[wp.vec3]
    """Camera frame (x right, y up, z toward the camera), times the coverage."""
    ratio: wp.array[wp.vec3]
    """Shadow ratio of what is not covered."""
    solid: wp.array[float]
    """Share that shows solids."""


@wp.kernel
def render_scenes(
    width: int,
    height: int,
    side: int,
    blur_min: wp.array[float],
    views: ViewTable,
    light: LightTable,
    object_light: LightTable,
    maps: MapTable,
    solids: OccluderTable,
    ground: GroundTable,
    objects: ObjectTable,
    out: Pixels,
):
    """Render a pixel from ``side`` times ``side`` points, each with a quarter of the directions.

    Args:
        width: Of the picture [px].
        height: Of the picture [px].
        side: Rows and columns of points in a pixel: 1 or 2.
        blur_min: Least blur of what an object reflects, by scene.
        views: Cameras.
        light: What lights the scene.
        object_light: What lights the object and casts its shadow.
        maps: Lat-long maps.
        solids: What stands in the scene.
        ground: What it stands on.
        objects: What is inserted.
        out: What is written.
    """
    thread = wp.tid()
    scene = thread // (width * height)
    pixel = thread % (width * height)
    column = pixel % width
    row = pixel // width
    points = side * side
    origin = views.origin[scene]
    window = views.window[scene]
    right = views.right[scene]
    up = views.up[scene]
    back = views.back[scene]
    place = objects.place[scene]
    turn = objects.yaw[scene]
    scale = objects.scale[scene]
    has_object = objects.mesh[scene] != wp.uint64(0)
    background = wp.vec3(0.0, 0.0, 0.0)
    inserted = wp.vec3(0.0, 0.0, 0.0)
    albedo_sum = wp.vec3(0.0, 0.0, 0.0)
    normal_sum = wp.vec3(0.0, 0.0, 0.0)
    ratio_sum = wp.vec3(0.0, 0.0, 0.0)
    covered = float(0.0)
    solid_share = float(0.0)
    for k in range(points):
        first = k % SUBSETS
        if points == 1:
            first = 2 * (column % 2) + row % 2
        across = (float(column) + (float(k % side) + 0.5) / float(side)) / float(width)
        down = (float(row) + (float(k // side) + 0.5) / float(side)) / float(height)
        d = wp.normalize(
            right * (window[0] + across * window[2]) - up * (window[1] + down * window[3]) - back
        )
        # The scene itself.
        ground_t = float(FAR)
        if d[1] < -1.0e-4:
            ground_t = -origin[1] / d[1]
        hit = nearest_solid(solids, scene, origin, d)
        ground_point = origin + d * ground_t
        lifted = ground_point + wp.vec3(0.0, 1.0e-4 * origin[1], 0.0)
        shows_ground = ground_t < FAR and ground_t < hit.t
        radiance = wp.vec3(0.0, 0.0, 0.0)
        if hit.t < FAR and not shows_ground:
            solid_share = solid_share + 1.0
            p = origin + d * hit.t + hit.normal * (1.0e-3 * origin[1])
            e = irradiance_among_solids(light, solids, scene, first, SUBSETS, p, hit.normal, 1.0)
            albedo = solids.albedo[scene, hit.index]
            if solids.texture[scene, hit.index] >= 0:
                spread = 0.4 / wp.max(solids.half[scene, hit.index][1], 0.1 * origin[1])
                state = wp.rand_init(hit.index, scene)
                albedo = piece_of_panorama(
                    maps, solids.texture[scene, hit.index],
                    wp.vec2(wp.randf(state), wp.randf(state)),
                    wp.vec2((p[0] + p[2]) * spread, p[1] * spread),
                )  # fmt: skip
            radiance = wp.cw_mul(albedo, e) / PI
        elif shows_ground and ground.is_seen[scene] == 1:
            n = wp.vec3(0.0, 1.0, 0.0)
            e = irradiance_among_solids(light, solids, scene, first, SUBSETS, lifted, n, 1.0)
            radiance = wp.cw_mul(ground_albedo(maps, ground, scene, ground_point), e) / PI
            c = 1.0 + d[1]
            gloss = ground.wetness[scene] * (0.02 + 0.98 * c * c * c * c * c)
            radiance = radiance * (1.0 - gloss)
            radiance = (
                radiance + blurred(maps, light, scene, wp.vec3(d[0], -d[1], d[2]), 0.0) * gloss
            )
        else:
            radiance = seen_sky(maps, light, ground, scene, d)
            if shows_ground and solids.count[scene] > 0:
                # The panorama's own ground, in the shadow of what was put there.
                n = wp.vec3(0.0, 1.0, 0.0)
                lit = irradiance_among_solids(light, solids, scene, first, SUBSETS, lifted, n, 1.0)
                all_of_it = irradiance_among_solids(
                    light, solids, scene, first, SUBSETS, lifted, n, 0.0
                )
                radiance = wp.cw_mul(
                    radiance, wp.cw_div(lit, all_of_it + wp.vec3(1.0e-9, 1.0e-9, 1.0e-9))
                )
        background = background + radiance
        # The object.
        is_covered = False
        if has_object:
            lo = turned(origin - place, -turn) / scale
            ld = turned(d, -turn)
            sphere = objects.sphere[scene]
            to = wp.vec3(sphere[0], sphere[1], sphere[2]) - lo
            along = wp.dot(to, ld)
            if along * along > wp.dot(to, to) - sphere[3] * sphere[3]:
                query = wp.mesh_query_ray(objects.mesh[scene], lo, ld, 1.0e3)
                if query.result:
                    is_covered = True
                    covered = covered + 1.0
                    face = objects.first_face[scene] + query.face
                    shading = (
                        objects.normals[3 * face] * query.u
                        + objects.normals[3 * face + 1] * query.v
                        + objects.normals[3 * face + 2] * (1.0 - query.u - query.v)
                    )
                    flat = query.normal
                    if wp.dot(flat, ld) > 0.0:
                        flat = -flat
                    if wp.dot(shading, flat) < 0.0:
                        shading = -shading
                    local_n = wp.normalize(shading + flat * 1.0e-3)
                    local_p = lo + ld * query.t
                    start = local_p + flat * 2.0e-3
                    n = turned(local_n, turn)
                    base = objects.albedos[face] * (1.0 - objects.recolour[scene])
                    base = base + objects.tint[scene] * objects.recolour[scene]
                    checker = int(
                        wp.floor(local_p[0] * 6.0)
                        + wp.floor(local_p[1] * 6.0)
                        + wp.floor(local_p[2] * 6.0)
                    )
                    if checker % 2 != 0:
                        base = base * (1.0 - objects.pattern[scene])
                    metallic = objects.metallic[scene]
                    roughness = objects.roughness[scene]
                    # Diffuse.
                    e = wp.vec3(0.0, 0.0, 0.0)
                    for j in range(first, object_light.direction.shape[1], SUBSETS):
                        w = object_light.direction[scene, j]
                        cosine = wp.dot(n, w)
                        if cosine > 0.0:
                            if misses_object(objects, scene, start, turned(w, -turn)) > 0.0:
                                e = e + object_light.flux[scene, j] * (cosine * float(SUBSETS))
                    sun_count = float(object_light.sun_direction.shape[1]) / float(SUBSETS)
                    sun_seen = float(0.0)
                    for j in range(first, object_light.sun_direction.shape[1], SUBSETS):
                        w = object_light.sun_direction[scene, j]
                        cosine = wp.dot(n, w)
                        if cosine > 0.0:
                            if misses_object(objects, scene, start, turned(w, -turn)) > 0.0:
                                e = e + object_light.sun[scene] * (cosine / sun_count)
                                sun_seen = sun_seen + cosine / sun_count
                    shown = wp.cw_mul(base, e) * ((1.0 - metallic) / PI)
                    # Specular.
                    f0 = wp.vec3(0.04, 0.04, 0.04) * (1.0 - metallic) + base * metallic
                    facing = wp.max(-wp.dot(n, d), 0.02)
                    reflected = d + n * (2.0 * facing)
                    blur = wp.max(2.5 * roughness, blur_min[scene])
                    mirror = blurred(maps, object_light, scene, reflected, blur)
                    if misses_object(objects, scene, start, turned(reflected, -turn)) == 0.0:
                        mirror = wp.cw_mul(base, e) / PI
                    shown = shown + wp.cw_mul(mirror, fresnel_mix(f0, roughness, facing))
                    glint = sun_highlight(
                        n, -d, object_light.sun_axis[scene], f0, roughness,
                        object_light.sun_sigma[scene],
                    )  # fmt: skip
                    shown = shown + wp.cw_mul(glint, object_light.sun[scene]) * sun_seen
                    inserted = inserted + shown
                    albedo_sum = albedo_sum + base
                    normal_sum = normal_sum + wp.vec3(
                        wp.dot(n, right), wp.dot(n, up), wp.dot(n, back)
                    )
        if not is_covered:
            shade = wp.vec3(1.0, 1.0, 1.0)
            if has_object and shows_ground:
                lit = wp.vec3(1.0e-9, 1.0e-9, 1.0e-9)
                total = wp.vec3(1.0e-9, 1.0e-9, 1.0e-9)
                start = turned(lifted - place, -turn) / scale
                for j in range(first, object_light.direction.shape[1], SUBSETS):
                    w = object_light.direction[scene, j]
                    if w[1] > 0.0:
                        part = object_light.flux[scene, j] * (w[1] * float(SUBSETS))
                        total = total + part
                        lit = lit + part * misses_object(objects, scene, start, turned(w, -turn))
                sun_count = float(object_light.sun_direction.shape[1]) / float(SUBSETS)
                for j in range(first, object_light.sun_direction.shape[1], SUBSETS):
                    w = object_light.sun_direction[scene, j]
                    if w[1] > 0.0:
                        part = object_light.sun[scene] * (w[1] / sun_count)
                        total = total + part
                        lit = lit + part * misses_object(objects, scene, start, turned(w, -turn))
                shade = wp.cw_div(lit, total)
            ratio_sum = ratio_sum + shade
    count = float(points)
    open_count = wp.max(count - covered, 1.0)
    out.background[thread] = background / count
    out.object[thread] = inserted / count
    out.coverage[thread] = covered / count
    out.albedo[thread] = albedo_sum / count
    out.normal[thread] = normal_sum / count
    out.solid[thread] = solid_share / count
    if covered < count:
        out.ratio[thread] = ratio_sum / open_count
    else:
        out.ratio[thread] = wp.vec3(1.0, 1.0, 1.0)


@wp.kernel
def sun_reaches(
    solids: OccluderTable,
    point: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    reached: wp.array[float],
):
    """Tell by scene whether no solid stands between a point and the sun: 1, else 0."""
    scene = wp.tid()
    reached[scene] = is_open(solids, scene, point[scene], axis[scene])
