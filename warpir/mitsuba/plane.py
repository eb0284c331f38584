"""The referee's plane: white, lit with and without the object, and by it."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from warpir.core.arrays import Float64Array
from warpir.mitsuba.path import RAY_OFFSET, GltfPath, intersect


@dataclass(frozen=True)
class ObjectScene:
    """A Mitsuba scene with its sensor, integrator and normalisation."""

    scene: mi.Scene
    sensor: mi.Sensor
    integrator: GltfPath
    center: Float64Array
    """World position that became the origin [m], shape [3]."""
    radius: float
    """World length that became 1 [m]."""


def trace_plane(
    setup: ObjectScene,
    normal: Float64Array,
    offset: float,
    seed: int,
    spp: int,
    bounce: ObjectScene | None = None,
) -> tuple[mi.Color3f, mi.Color3f, mi.Bool]:
    """Sample radiance of the plane ``dot(normal, x) = offset``, 0 where it is not seen.

    ``bounce`` is the scene with the plane in it, in which the object lights it.

    Returns:
        With the object, without it, and whether the plane is seen.
    """
    scene, integrator = setup.scene, setup.integrator
    sampler, _ = integrator.prepare(setup.sensor, seed, spp)
    ray, _, _ = integrator.sample_rays(scene, setup.sensor, sampler)
    ray = mi.Ray3f(ray)
    has_alpha = integrator.has_alpha
    n = mi.Normal3f(normal)
    it, seen = _plane_points(setup, ray, n, offset, sampler)
    frame = mi.Frame3f(it.n)

    def visible(d: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        start = mi.Ray3f(it.p + n * RAY_OFFSET, d)
        return ~intersect(scene, start, sampler, False, has_alpha, active).is_valid()

    ds, em_weight = scene.sample_emitter_direction(it, sampler.next_2d(), False, seen)
    cos_i = dr.maximum(dr.dot(n, ds.d), 0.0)
    by_light = em_weight * cos_i * dr.inv_pi * mis_weight(ds.pdf, cos_i * dr.inv_pi)
    active = seen & (cos_i > 0.0)
    by_light = dr.select(active, by_light, 0.0)
    unblocked_light = visible(ds.d, active)

    d = frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    cos_i = dr.maximum(dr.dot(n, d), 0.0)
    ds = dr.zeros(mi.DirectionSample3f, dr.width(seen))
    ds.d = d
    ds.emitter = mi.EmitterPtr(scene.environment())
    by_cosine = scene.eval_emitter_direction(it, ds, seen) * mis_weight(
        cos_i * dr.inv_pi, scene.pdf_emitter_direction(it, ds, seen)
    )
    by_cosine = dr.select(seen & (cos_i > 0.0), by_cosine, 0.0)
    unblocked_cosine = visible(d, seen)
    lit = dr.select(unblocked_light, by_light, 0.0) + dr.select(unblocked_cosine, by_cosine, 0.0)
    if bounce is not None:
        thrown, *_ = bounce.integrator.sample(
            dr.ADMode.Primal,
            bounce.scene,
            sampler,
            mi.Ray3f(it.p + n * RAY_OFFSET, d),
            active=seen & (cos_i > 0.0),
            is_camera=False,
        )
        lit += dr.select(seen, thrown, 0.0)
    return lit, by_light + by_cosine, seen


def _plane_points(
    setup: ObjectScene, ray: mi.Ray3f, normal: mi.Normal3f, offset: float, sampler: mi.Sampler
) -> tuple[mi.SurfaceInteraction3f, mi.Bool]:
    """Return where rays meet the plane, and whether it comes before the object."""
    t = (offset - dr.dot(normal, ray.o)) / dr.dot(normal, ray.d)
    meets = (t > 0.0) & dr.isfinite(t)
    has_alpha = setup.integrator.has_alpha
    si = intersect(setup.scene, ray, sampler, True, has_alpha, mi.Bool(True))
    nearer = si.is_valid() & (dr.dot(si.p - ray.o, ray.d) < t)
    seen = meets & ~nearer
    it = dr.zeros(mi.SurfaceInteraction3f, dr.width(t))
    it.p = ray(dr.select(seen, t, 0.0))
    it.p += normal * (offset - dr.dot(normal, it.p))
    it.n = normal
    return it, seen
