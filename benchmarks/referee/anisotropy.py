"""Does brushed metal reflect light as Mitsuba's own anisotropic conductor does?

    python -m benchmarks.referee.anisotropy --spp 4096

Mitsuba's scene is its own: its meshes, whose texture coordinates give the tangents, and
``roughconductor`` with ``alpha_u`` and ``alpha_v``, without a Fresnel term. Its masking and
shadowing are independent of each other, glTF's are correlated in height: a factor made of
Mitsuba's own ``smith_g1`` turns one into the other. All faces are flat.
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.referee.glass import mesh_of, pictures_of, rendered
from benchmarks.referee.ours import Runs
from benchmarks.referee.sheet import Pair, compare_cases
from benchmarks.referee.subjects import ball
from warpir.core.arrays import Float64Array, FloatArray
from warpir.mitsuba.light import LatlongEmitter
from warpir.scene.asset import Asset, Material, Primitive
from warpir.scene.camera import Camera


@dataclass(frozen=True)
class Case:
    """Bodies of one white metal."""

    bodies: tuple[Primitive, ...]
    roughness: float
    anisotropy: float
    is_turned: bool = False
    """Whether the lobe is wider along the bitangent."""
    depth: int = 1

    def asset(self) -> Asset:
        """Return what warpir renders."""
        turn = 0.5 * np.pi if self.is_turned else 0.0
        metal = Material(
            roughness=self.roughness, anisotropy=self.anisotropy, anisotropy_rotation=turn
        )
        return Asset("brushed", self.bodies, (metal,))

    def alphas(self) -> tuple[float, float]:
        """Return the widths along u and v."""
        across = self.roughness**2
        along = across + (1.0 - across) * self.anisotropy**2
        return (across, along) if self.is_turned else (along, across)


def cases() -> dict[str, Case]:
    """Return what is compared, by name."""
    body = replace(ball(24), normals=None)
    small = body.positions * 0.6
    pair = tuple(replace(body, positions=small + np.array([x, 0.0, 0.0])) for x in (-0.65, 0.65))
    return {
        "isotropic": Case((body,), 0.4, 0.0),
        "brushed": Case((body,), 0.3, 0.6),
        "turned": Case((body,), 0.3, 0.6, is_turned=True),
        "thread": Case((body,), 0.15, 1.0),
        "pair": Case(pair, 0.35, 0.8, depth=6),
    }


class Conductor(mi.BSDF):
    """Mitsuba's ``roughconductor`` with glTF's masking."""

    def __init__(self, alphas: tuple[float, float]) -> None:
        """Take the widths along the axes of the shading frame."""
        super().__init__(mi.Properties())
        names = {"alpha_u": alphas[0], "alpha_v": alphas[1]}
        self.inner = mi.load_dict(
            {"type": "roughconductor", "material": "none", "distribution": "ggx"} | names
        )
        self.normals = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, *alphas, True)
        self.m_components = [self.inner.flags()]
        self.m_flags = self.inner.flags()

    def _correlated(self, wo: mi.Vector3f, wi: mi.Vector3f) -> mi.Float:
        m = dr.normalize(wo + wi)
        a, b = self.normals.smith_g1(wo, m), self.normals.smith_g1(wi, m)
        return dr.select((a > 0.0) & (b > 0.0), dr.rcp(a + b - a * b), 0.0)

    def sample(
        self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Draw a direction as Mitsuba does."""
        bs, weight = self.inner.sample(ctx, si, sample1, sample2, active)
        return bs, weight * self._correlated(si.wi, bs.wo)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the value times the cosine [1/sr]."""
        return self.inner.eval(ctx, si, wo, active) * self._correlated(si.wi, wo)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density of `sample` [1/sr]."""
        return self.inner.pdf(ctx, si, wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Return both."""
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def to_string(self) -> str:
        """Name the material in scene dumps."""
        return "Conductor[]"


def theirs(case: Case, view: Camera, texels: Float64Array, spp: int) -> Runs:
    """Render by Mitsuba's path tracer."""
    parts = {"type": "scene", "light": LatlongEmitter(texels)}
    for k, body in enumerate(case.bodies):
        properties = mi.Properties()
        properties["material"] = Conductor(case.alphas())
        name = f"body_{k}"
        parts[name] = mesh_of(name, body.positions, body.indices, properties, body.uv0)
    kind = {"type": "path", "max_depth": case.depth + 1, "rr_depth": 96, "hide_emitters": True}
    return rendered(mi.load_dict(parts), mi.load_dict(kind), view, spp)


def both(case: Case, view: Camera, texels: FloatArray, spp: int) -> Pair:
    """Return our picture and theirs."""
    ours = pictures_of(case.asset(), view, texels, spp, case.depth)
    return ours, theirs(case, view, texels, spp)


if __name__ == "__main__":
    compare_cases(__doc__, cases(), both)
