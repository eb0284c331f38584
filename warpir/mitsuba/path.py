"""A path tracer in Mitsuba 3 with the rules glTF adds to a plain one.

Mitsuba's ``path`` counts a null interaction as a bounce, blocks shadow rays at transparent
surfaces and knows no culling. Here coverage is stochastic on every ray and costs no depth, and
single-sided back faces are invisible to camera rays only. On opaque, closed meshes the
integrator has the expectation of ``path`` and ``prb`` with ``hide_emitters``.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import RBIntegrator, mis_weight

# Scenes are scaled to unit radius: float32 hits are right to about 1e-6 there. Mitsuba's own
# offset, 9e-5 (1 + |p|), would swallow contact details.
RAY_OFFSET = 1e-5


def spawn(si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Ray3f:
    """Return the ray from ``si`` along unit direction ``d``, clear of the surface it leaves."""
    return mi.Ray3f(si.p + si.n * dr.mulsign(mi.Float(RAY_OFFSET), dr.dot(si.n, d)), d)


@dr.syntax
def intersect(
    scene: mi.Scene,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    camera: bool,
    has_alpha: bool,
    active: mi.Bool,
) -> mi.SurfaceInteraction3f:
    """First surface that the ray sees, alpha decided at random.

    All materials are `GltfBSDF`. Rays of the camera pass the back faces of single-sided ones. The
    sampler is advanced only where ``has_alpha`` says that any material is transparent.
    """
    ray = mi.Ray3f(ray)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
    searching = mi.Bool(active)
    if dr.hint(not camera and not has_alpha, mode="scalar"):
        si = scene.ray_intersect(ray, mi.RayFlags.All, False, active=searching)
    else:
        while dr.hint(searching, label="transparency and culling"):
            si = scene.ray_intersect(ray, mi.RayFlags.All, False, active=searching)
            hit = searching & si.is_valid()
            bsdf = si.bsdf(ray)
            skip = mi.Bool(False)
            if dr.hint(camera, mode="scalar"):
                single_sided = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide)
                skip |= single_sided & (dr.dot(si.n, ray.d) > 0.0)
            if dr.hint(has_alpha, mode="scalar"):
                through = bsdf.eval_null_transmission(si, hit)[0]
                skip |= sampler.next_1d(hit) < through
            searching = hit & skip
            ray = dr.select(searching, spawn(si, ray.d), ray)
    return si


class GltfPath(RBIntegrator):
    """Unidirectional path tracer, one emitter and one BSDF sample per vertex, power heuristic.

    Differentiable in the environment's radiance only (path replay); no Russian roulette.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.hide_emitters = True
        self.has_alpha = bool(props.get("has_alpha", False))

    @dr.syntax
    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        active: mi.Bool,
        **kwargs: Any,
    ) -> Any:
        """Trace paths of at most ``max_depth - 1`` surface interactions; see `RBIntegrator`.

        Its ``state_in`` is not needed: no parameter but the light is differentiated. With
        ``is_camera`` False the first rays are not those of a camera, and see all back faces.
        """
        primal = mode == dr.ADMode.Primal
        context = mi.BSDFContext()
        L = mi.Spectrum(0.0)
        d_L = kwargs.get("δL")
        d_L = mi.Spectrum(d_L if d_L is not None else 0.0)
        throughput = mi.Spectrum(1.0)
        depth = mi.UInt32(0)
        ray = mi.Ray3f(dr.detach(ray))
        is_camera = kwargs.get("is_camera", True)
        si = intersect(scene, ray, sampler, is_camera, self.has_alpha, mi.Bool(active))
        seen = mi.Bool(active) & si.is_valid()
        active = mi.Bool(seen)
        while dr.hint(active, max_iterations=self.max_depth, label=f"gltf path ({mode.name})"):
            bsdf = si.bsdf(ray)
            emitted = throughput * bsdf.eval_attribute_3("emission", si, active)
            bounce = active & (depth + 1 < self.max_depth)
            direct = self._direct(scene, sampler, si, throughput, bounce, primal)

            # Sample the BSDF: the next vertex, or the light
            bs, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), bounce)
            throughput = dr.select(bounce, throughput * weight, 0.0)
            bounce &= dr.max(throughput) > 0.0
            ray = spawn(si, si.to_world(bs.wo))
            previous = si
            si = intersect(scene, ray, sampler, False, self.has_alpha, bounce)
            escaped = bounce & ~si.is_valid()
            ds = mi.DirectionSample3f(scene, si, previous)
            light_pdf = scene.pdf_emitter_direction(previous, ds, escaped)
            with dr.resume_grad(when=not primal):
                reached = dr.select(
                    escaped,
                    throughput * mis_weight(bs.pdf, light_pdf) * ds.emitter.eval(si, escaped),
                    0.0,
                )
                Lo = emitted + direct + reached
                if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                    dr.backward_from(d_L * Lo)
                elif dr.hint(mode == dr.ADMode.Forward, mode="scalar"):
                    d_L += dr.forward_to(Lo)
            L += dr.detach(Lo)
            depth += 1
            active = bounce & si.is_valid()
        return L if primal else d_L, seen, [], L

    def _direct(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        si: mi.SurfaceInteraction3f,
        throughput: mi.Spectrum,
        active: mi.Bool,
        primal: bool,
    ) -> mi.Spectrum:
        """Radiance of one emitter sample; attached to the light unless ``primal``."""
        ds, em_weight = scene.sample_emitter_direction(si, sampler.next_2d(), False, active)
        ray = spawn(si, ds.d)
        lit = active & (ds.pdf > 0.0)
        if self.has_alpha:
            lit &= ~intersect(scene, ray, sampler, False, True, lit).is_valid()
        else:
            lit &= ~scene.ray_test(ray, False, active=lit)
        f_cos, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), lit)
        with dr.resume_grad(when=not primal):
            if not primal:
                em_weight = scene.eval_emitter_direction(si, ds, lit) / ds.pdf
            return dr.select(lit, throughput * f_cos * mis_weight(ds.pdf, pdf) * em_weight, 0.0)


mi.register_integrator("gltf_path", lambda props: GltfPath(props))
