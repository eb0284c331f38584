"""Small pictures of many made-up scenes at once, for training: one thread per pixel and scene.

Nothing is drawn at random here. All pixels of a picture share the same directions, so that its
light is exact up to a smooth error.
"""

import warp as wp

from warpir.kernels.training.scene import (
    FAR,
    GroundTable,
    LightTable,
    MapTable,
    OccluderTable,
    ViewTable,
    ground_albedo,
    irradiance_among_solids,
    nearest_solid,
    piece_of_panorama,
    seen_sky,
    without_sun,
)

wp.set_module_options({"enable_backward": False})

SUBSETS = wp.constant(4)
"""Each point of a pixel asks every fourth direction; neighbouring points ask different ones."""


@wp.kernel
def render_scenes(
    width: int,
    height: int,
    side: int,
    views: ViewTable,
    light: LightTable,
    maps: MapTable,
    solids: OccluderTable,
    ground: GroundTable,
    radiance_out: wp.array[wp.vec3],
    solid_out: wp.array[float],
):
    """Render a pixel from ``side`` times ``side`` points, each with a quarter of the directions.

    Args:
        width: Of the picture [px].
        height: Of the picture [px].
        side: Rows and columns of points in a pixel: 1 or 2.
        views: Cameras.
        light: What lights the scene.
        maps: Lat-long maps.
        solids: What stands in the scene.
        ground: What it stands on.
        radiance_out: Radiance, one value per pixel, all scenes.
        solid_out: Share of each pixel that shows solids.
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
    radiance_sum = wp.vec3(0.0, 0.0, 0.0)
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
            radiance = wp.cw_mul(albedo, e) / wp.PI
        elif shows_ground and ground.is_seen[scene] == 1:
            n = wp.vec3(0.0, 1.0, 0.0)
            e = irradiance_among_solids(light, solids, scene, first, SUBSETS, lifted, n, 1.0)
            radiance = wp.cw_mul(ground_albedo(maps, ground, scene, ground_point), e) / wp.PI
            c = 1.0 + d[1]
            gloss = ground.wetness[scene] * (0.02 + 0.98 * c * c * c * c * c)
            radiance = radiance * (1.0 - gloss)
            mirrored = wp.vec3(d[0], -d[1], d[2])
            radiance = radiance + without_sun(maps, light, scene, mirrored) * gloss
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
        radiance_sum = radiance_sum + radiance
    radiance_out[thread] = radiance_sum / float(points)
    solid_out[thread] = solid_share / float(points)
