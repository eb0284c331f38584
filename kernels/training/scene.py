"""Made-up scenes for training: their tables, solids, ground and sky.

A scene is a ground plane, a few boxes, ellipsoids and cylinders, and a distant light.

Frame: +Y up, ground ``y = 0``, the camera looks toward -Z (camera-yaw frame).
"""

import warp as wp

from warpir.kernels.maths.latlong import bilinear_tap, direction_to_uv

FAR = wp.constant(1.0e6)
BOX = wp.constant(0)
ELLIPSOID = wp.constant(1)
CYLINDER = wp.constant(2)
NO_HIT = wp.constant(-1)
TILES = wp.constant(1)
STRIPES = wp.constant(2)
PLANKS = wp.constant(3)
PHOTO = wp.constant(4)


@wp.struct
class ViewTable:
    """Cameras, one per scene."""

    origin: wp.array[wp.vec3]
    """Position [m]."""
    right: wp.array[wp.vec3]
    up: wp.array[wp.vec3]
    back: wp.array[wp.vec3]
    window: wp.array[wp.vec4]
    """Left, top, width and height of the picture on the plane at distance 1 (v grows downward)."""


@wp.struct
class LightTable:
    """Distant lights, one per scene."""

    map: wp.array[int]
    """Index of the map of everything but the sun."""
    yaw: wp.array[float]
    """Turn from the world to the map about +Y [rad]."""
    mirror: wp.array[float]
    """-1: the map is mirrored in x, else 1."""
    gain: wp.array[wp.vec3]
    """Factor on the map [1]."""
    direction: wp.array2d[wp.vec3]
    """Unit directions, shape [scene, direction]."""
    flux: wp.array2d[wp.vec3]
    """Radiance times solid angle of each, gain included, shape [scene, direction]."""
    sun_direction: wp.array2d[wp.vec3]
    """Unit directions over the sun, of equal flux, shape [scene, sample]."""
    sun_axis: wp.array[wp.vec3]
    sun: wp.array[wp.vec3]
    """Irradiance of a surface that faces the sun, gain included."""
    sun_sigma: wp.array[float]
    """Angular standard deviation of the sun [rad]."""


@wp.struct
class MapTable:
    """Lat-long maps by index."""

    light: wp.array3d[wp.vec3]
    """Lights without their suns."""
    seen: wp.array3d[wp.vec3]
    """Panoramas as a camera sees them, sun included."""


@wp.struct
class OccluderTable:
    """Solids that stand in the scene, shape [scene, solid]."""

    kind: wp.array2d[int]
    """`BOX`, `ELLIPSOID` or `CYLINDER`; negative: none."""
    centre: wp.array2d[wp.vec3]
    half: wp.array2d[wp.vec3]
    """Half sizes along the solid's own axes [m]."""
    turn: wp.array2d[wp.vec2]
    """Cosine and sine of the solid's turn about +Y."""
    count: wp.array[int]
    """Solids of each scene: those behind are not looked at, shape [scene]."""
    albedo: wp.array2d[wp.vec3]
    texture: wp.array2d[int]
    """Panorama of which a piece covers the solid; negative: none."""


@wp.struct
class GroundTable:
    """Grounds, one per scene."""

    is_seen: wp.array[int]
    """0: the background is a panorama, whose own ground only catches shadows."""
    seen: wp.array[int]
    """Index of the panorama that is seen, negative: the light's own map and sun."""
    albedo: wp.array[wp.vec3]
    second: wp.array[wp.vec3]
    """Albedo of the pattern's other part."""
    pattern: wp.array[int]
    texture: wp.array[int]
    """Panorama of which a piece covers the ground where the pattern is `PHOTO`."""
    size: wp.array[float]
    """Of the pattern [m]."""
    turn: wp.array[float]
    """Of the pattern [rad]."""
    roughen: wp.array[float]
    """Amplitude of the noise on the albedo [1]."""
    wetness: wp.array[float]
    """Share of a mirror's Fresnel reflection [1]."""


@wp.struct
class Solid:
    """A hit with a solid."""

    index: int
    t: float
    normal: wp.vec3


@wp.func
def turned(v: wp.vec3, yaw: float) -> wp.vec3:
    """Turn about +Y."""
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    return wp.vec3(c * v[0] + s * v[2], v[1], c * v[2] - s * v[0])


@wp.func
def turned_by(v: wp.vec3, turn: wp.vec2) -> wp.vec3:
    """Turn about +Y by an angle of which cosine and sine are known."""
    return wp.vec3(turn[0] * v[0] + turn[1] * v[2], v[1], turn[0] * v[2] - turn[1] * v[0])


@wp.func
def is_near(centre: wp.vec3, half: wp.vec3, o: wp.vec3, d: wp.vec3) -> bool:
    """Return whether a ray meets the sphere around a solid: most rays do not."""
    to = centre - o
    along = wp.dot(to, d)
    distance2 = wp.dot(to, to)
    reach2 = wp.dot(half, half)
    return distance2 < reach2 or (along > 0.0 and distance2 - along * along < reach2)


@wp.func
def solid_t(kind: int, o: wp.vec3, d: wp.vec3, half: wp.vec3) -> float:
    """Return the distance to a solid at the origin from outside, `FAR` if it is missed."""
    if kind == BOX:
        near = float(-FAR)
        far = float(FAR)
        for k in range(3):
            inverse = 1.0 / wp.where(wp.abs(d[k]) < 1.0e-8, 1.0e-8, d[k])
            a = (-half[k] - o[k]) * inverse
            b = (half[k] - o[k]) * inverse
            near = wp.max(near, wp.min(a, b))
            far = wp.min(far, wp.max(a, b))
        if near < far and near > 0.0:
            return near
        return FAR
    so = wp.cw_div(o, half)
    sd = wp.cw_div(d, half)
    if kind == CYLINDER:
        # The curved side between both caps, and the upper cap; the lower one stands on the ground.
        a = sd[0] * sd[0] + sd[2] * sd[2]
        b = so[0] * sd[0] + so[2] * sd[2]
        c = so[0] * so[0] + so[2] * so[2] - 1.0
        best = float(FAR)
        disc = b * b - a * c
        if disc > 0.0 and a > 1.0e-12:
            t = (-b - wp.sqrt(disc)) / a
            y = so[1] + t * sd[1]
            if t > 0.0 and wp.abs(y) < 1.0:
                best = t
        if sd[1] < 0.0:
            t = (1.0 - so[1]) / sd[1]
            x = so[0] + t * sd[0]
            z = so[2] + t * sd[2]
            if t > 0.0 and x * x + z * z < 1.0:
                best = wp.min(best, t)
        return best
    a = wp.dot(sd, sd)
    b = wp.dot(so, sd)
    c = wp.dot(so, so) - 1.0
    disc = b * b - a * c
    if disc > 0.0:
        t = (-b - wp.sqrt(disc)) / a
        if t > 0.0:
            return t
    return FAR


@wp.func
def solid_normal(kind: int, p: wp.vec3, half: wp.vec3) -> wp.vec3:
    """Return the outward normal of a solid at the origin in a point of its surface."""
    q = wp.cw_div(p, half)
    if kind == ELLIPSOID:
        return wp.normalize(wp.cw_div(q, half))
    if kind == CYLINDER:
        if q[1] > 0.9999:
            return wp.vec3(0.0, 1.0, 0.0)
        return wp.normalize(wp.vec3(q[0] / half[0], 0.0, q[2] / half[2]))
    a = wp.vec3(wp.abs(q[0]), wp.abs(q[1]), wp.abs(q[2]))
    if a[0] >= a[1] and a[0] >= a[2]:
        return wp.vec3(wp.sign(q[0]), 0.0, 0.0)
    if a[1] >= a[2]:
        return wp.vec3(0.0, wp.sign(q[1]), 0.0)
    return wp.vec3(0.0, 0.0, wp.sign(q[2]))


@wp.func
def nearest_solid(solids: OccluderTable, scene: int, o: wp.vec3, d: wp.vec3) -> Solid:
    """Return the nearest solid that a ray meets."""
    hit = Solid()
    hit.index = NO_HIT
    hit.t = FAR
    for k in range(solids.count[scene]):
        half = solids.half[scene, k]
        centre = solids.centre[scene, k]
        if is_near(centre, half, o, d):
            kind = solids.kind[scene, k]
            turn = solids.turn[scene, k]
            back = wp.vec2(turn[0], -turn[1])
            lo = turned_by(o - centre, back)
            ld = turned_by(d, back)
            t = solid_t(kind, lo, ld, half)
            if t < hit.t:
                hit.t = t
                hit.index = k
                hit.normal = turned_by(solid_normal(kind, lo + ld * t, half), turn)
    return hit


@wp.func
def is_open(solids: OccluderTable, scene: int, o: wp.vec3, d: wp.vec3) -> float:
    """Return 1 if no solid stands in the way, else 0."""
    for k in range(solids.count[scene]):
        half = solids.half[scene, k]
        centre = solids.centre[scene, k]
        if is_near(centre, half, o, d):
            turn = solids.turn[scene, k]
            back = wp.vec2(turn[0], -turn[1])
            lo = turned_by(o - centre, back)
            if solid_t(solids.kind[scene, k], lo, turned_by(d, back), half) < FAR:
                return 0.0
    return 1.0


@wp.func
def map_at(maps: wp.array3d[wp.vec3], index: int, d: wp.vec3) -> wp.vec3:
    """Interpolate a map in a direction of its own frame."""
    tap = bilinear_tap(direction_to_uv(d), maps.shape[1], maps.shape[2])
    top = maps[index, tap.i0, tap.j0] * (1.0 - tap.wj) + maps[index, tap.i0, tap.j1] * tap.wj
    low = maps[index, tap.i1, tap.j0] * (1.0 - tap.wj) + maps[index, tap.i1, tap.j1] * tap.wj
    return top * (1.0 - tap.wi) + low * tap.wi


@wp.func
def into_map(lights: LightTable, scene: int, d: wp.vec3) -> wp.vec3:
    """Turn a world direction into the frame of the light's map."""
    return turned(wp.vec3(lights.mirror[scene] * d[0], d[1], d[2]), lights.yaw[scene])


@wp.func
def without_sun(maps: MapTable, lights: LightTable, scene: int, d: wp.vec3) -> wp.vec3:
    """Return the radiance of the light's map, without its sun."""
    radiance = map_at(maps.light, lights.map[scene], into_map(lights, scene, d))
    return wp.cw_mul(radiance, lights.gain[scene])


@wp.func
def seen_sky(
    maps: MapTable, lights: LightTable, ground: GroundTable, scene: int, d: wp.vec3
) -> wp.vec3:
    """Return what the camera sees where no surface is."""
    panorama = ground.seen[scene]
    if panorama >= 0:
        m = into_map(lights, scene, d)
        return wp.cw_mul(map_at(maps.seen, panorama, m), lights.gain[scene])
    sigma = wp.max(lights.sun_sigma[scene], 0.005)
    away = (1.0 - wp.dot(d, lights.sun_axis[scene])) / (sigma * sigma)
    disc = lights.sun[scene] * (wp.exp(-away) / (2.0 * wp.PI * sigma * sigma))
    return without_sun(maps, lights, scene, d) + disc


@wp.func
def fbm(seed: wp.uint32, p: wp.vec2) -> float:
    """Return noise of three octaves, about in [-1, 1]."""
    total = float(0.0)
    scale = float(1.0)
    for _k in range(3):
        total = total + wp.noise(seed, p * scale) / scale
        scale = scale * 2.7
    return total


@wp.func
def to_and_fro(x: float) -> float:
    """Fold a number into [0, 1], back and forth, so that a repeated piece has no seams."""
    return wp.abs(x - 2.0 * wp.floor(0.5 * x + 0.5))


@wp.func
def piece_of_panorama(maps: MapTable, panorama: int, place: wp.vec2, p: wp.vec2) -> wp.vec3:
    """Return the albedo of a surface that a piece of a panorama's lower half is spread over.

    Its radiance becomes an albedo between 0 and 1; what the sun drew on it stays, as stains.

    Args:
        maps: Holds the panoramas, of mean luminance 1.
        panorama: Which of them.
        place: Where the piece begins, in [0, 1]^2.
        p: Point on the surface, in sizes of the piece.
    """
    height = maps.seen.shape[1]
    width = maps.seen.shape[2]
    side = float(height) * 0.22
    x = (place[0] * float(width) + to_and_fro(p[0]) * side) % float(width)
    y = float(height) * (0.56 + 0.16 * place[1]) + to_and_fro(p[1]) * side
    column = wp.clamp(int(x), 0, width - 1)
    row = wp.clamp(int(y), 0, height - 1)
    t = maps.seen[panorama, row, column]
    return wp.vec3(t[0] / (t[0] + 0.7), t[1] / (t[1] + 0.7), t[2] / (t[2] + 0.7))


@wp.func
def ground_albedo(maps: MapTable, ground: GroundTable, scene: int, p: wp.vec3) -> wp.vec3:
    """Return the ground's albedo in a point."""
    seed = wp.rand_init(17, scene)
    size = ground.size[scene]
    q = turned(p, ground.turn[scene]) / size
    share = float(0.0)
    pattern = ground.pattern[scene]
    x = q[0] - wp.floor(q[0])
    z = q[2] - wp.floor(q[2])
    if pattern == TILES:
        if x < 0.06 or z < 0.06:
            share = 1.0
    elif pattern == STRIPES:
        if x < 0.12:
            share = 1.0
    elif pattern == PLANKS:
        share = wp.randf(wp.rand_init(scene, int(wp.floor(q[0]))))
    elif pattern == PHOTO:
        place = wp.vec2(wp.randf(seed), wp.randf(seed))
        return piece_of_panorama(maps, ground.texture[scene], place, wp.vec2(q[0], q[2]) * 0.3)
    else:
        share = wp.clamp(0.5 + 0.9 * fbm(seed, wp.vec2(q[0], q[2])), 0.0, 1.0)
    base = ground.albedo[scene] * (1.0 - share) + ground.second[scene] * share
    grain = wp.noise(seed, wp.vec2(q[0] * 9.0, q[2] * 9.0))
    grain = grain + 0.6 * wp.noise(seed, wp.vec2(q[0] * 31.0, q[2] * 31.0))
    return base * wp.clamp(1.0 + ground.roughen[scene] * grain, 0.2, 2.0)


@wp.func
def irradiance_among_solids(
    lights: LightTable,
    solids: OccluderTable,
    scene: int,
    first: int,
    stride: int,
    p: wp.vec3,
    n: wp.vec3,
    is_blocked: float,
) -> wp.vec3:
    """Return the irradiance that every ``stride``-th direction stands for.

    Args:
        lights: Which light.
        solids: What stands in its way.
        scene: Index of the scene.
        first: First direction.
        stride: Step between directions.
        p: Point, lifted off its surface.
        n: Normal.
        is_blocked: 1: solids cast shadows, 0: they do not.
    """
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(first, lights.direction.shape[1], stride):
        d = lights.direction[scene, k]
        cosine = wp.dot(n, d)
        if cosine > 0.0:
            if is_blocked == 0.0 or is_open(solids, scene, p, d) > 0.0:
                total = total + lights.flux[scene, k] * (cosine * float(stride))
    count = float(lights.sun_direction.shape[1]) / float(stride)
    for k in range(first, lights.sun_direction.shape[1], stride):
        d = lights.sun_direction[scene, k]
        cosine = wp.dot(n, d)
        if cosine > 0.0:
            if is_blocked == 0.0 or is_open(solids, scene, p, d) > 0.0:
                total = total + lights.sun[scene] * (cosine / count)
    return total
