"""Does solid glass bend, reflect and absorb light as Mitsuba's own dielectrics do?

    python -m benchmarks.referee.glass --spp 4096

Mitsuba's scene is its own: its meshes, ``dielectric`` or ``roughdielectric``, a homogeneous medium
that absorbs alone, and ``volpath``; only the light is that of `warpir.mitsuba`. All faces are flat:
what interpolated normals do at an interface is a convention that differs.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from benchmarks.referee.ours import SEED_COUNT, Runs, over_seeds
from benchmarks.referee.sheet import Pair, compare_cases
from benchmarks.scenes import on_the_ground
from tests.builders.shapes import all_pixels
from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.kernels.dielectric.glass import GLASS_DEPTH
from warpir.mitsuba.light import LatlongEmitter
from warpir.mitsuba.render import passes, sensor_of
from warpir.render.device_light import light_args
from warpir.scene.asset import Asset, Material, Primitive
from warpir.scene.camera import Camera
from warpir.scene.light import Light

LENGTH = int(GLASS_DEPTH) + 1
"""Of a path that ends at the light, after as many interfaces as ours meets."""
DEPTH = 24
"""Interactions with what is not glass; a matte card in glass gets light that often."""
MATTE = (0.6, 0.3, 0.2)


@dataclass(frozen=True)
class Case:
    """Bodies of one glass, and a matte one."""

    glass: tuple[trimesh.Trimesh, ...]
    ior: float = 1.5
    roughness: float = 0.0
    absorption: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Coefficient [1/m]."""
    matte: trimesh.Trimesh | None = None

    def asset(self) -> Asset:
        """Return what warpir renders."""
        material = Material(
            metallic=0.0,
            roughness=self.roughness,
            transmission=1.0,
            ior=self.ior,
            thickness=1.0,
            attenuation_distance=1.0,
            attenuation_color=tuple(np.exp(-np.array(self.absorption))),
        )
        paper = Material(base_color=MATTE, metallic=0.0, roughness=1.0, specular=0.0)
        parts = [_primitive(body, 0) for body in self.glass]
        parts += [] if self.matte is None else [_primitive(self.matte, 1)]
        return Asset("glass", tuple(parts), (material, paper))


def _primitive(body: trimesh.Trimesh, material: int) -> Primitive:
    return Primitive(np.array(body.vertices), np.array(body.faces, np.int32), material)


def tumbler() -> trimesh.Trimesh:
    """Return a wall around an inside that is open above."""
    h, outer, wall = 0.8, 0.6, 0.12
    r = outer - wall
    profile = [[0, -h], [outer, -h], [outer, h], [r, h], [r, wall - h], [0, wall - h]]
    body = trimesh.creation.revolve(np.array(profile), sections=24)
    body.fix_normals()
    body.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    return body


def cases() -> dict[str, Case]:
    """Return what is compared, by name."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    box = trimesh.creation.box((1.2, 1.2, 1.2))
    box.apply_transform(trimesh.transformations.rotation_matrix(0.5, [0.2, 1.0, 0.1]))
    lens = trimesh.creation.icosphere(subdivisions=3)
    lens.apply_scale([1.0, 1.0, 0.3])
    card = trimesh.creation.box((1.6, 1.6, 0.05))
    card.apply_translation([0.0, 0.0, -0.9])
    core = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    green = (0.9, 0.15, 0.7)
    return {
        "ball": Case((ball,)),
        "absorbing_ball": Case((ball,), absorption=green),
        "diamond_box": Case((box,), ior=2.4),
        "lens_before_card": Case((lens,), matte=card),
        "card_in_ball": Case((ball,), absorption=green, matte=core),
        "tumbler": Case((tumbler(),), absorption=green),
        "rough_ball": Case((ball,), roughness=0.45),
        "rough_box": Case((box,), roughness=0.7, ior=1.33, absorption=green),
    }


def mesh_of(
    name: str,
    positions: Float64Array,
    indices: IntArray,
    properties: mi.Properties,
    uv: FloatArray | None = None,
) -> mi.Mesh:
    """Return Mitsuba's mesh with flat faces, and texture coordinates where they are given."""
    properties["face_normals"] = True
    has_uv = uv is not None
    mesh = mi.Mesh(name, len(positions), len(indices), properties, has_vertex_texcoords=has_uv)
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32(np.array(indices, np.uint32).ravel())
    parameters["vertex_positions"] = mi.Float(np.array(positions, np.float32).ravel())
    if uv is not None:
        parameters["vertex_texcoords"] = mi.Float(uv.ravel())
    parameters.update()
    return mesh


def mitsuba_scene(case: Case, texels: Float64Array) -> mi.Scene:
    """Return Mitsuba's own scene of a case."""
    parts = {"type": "scene", "light": LatlongEmitter(texels)}
    for k, body in enumerate(case.glass):
        glass = {"type": "dielectric", "int_ior": case.ior, "ext_ior": 1.0}
        if case.roughness > 0.0:
            alpha = case.roughness**2
            glass |= {"type": "roughdielectric", "distribution": "ggx", "alpha": alpha}
        properties = mi.Properties()
        properties["material"] = mi.load_dict(glass)
        if any(case.absorption):
            sigma_t = {"type": "rgb", "value": list(case.absorption)}
            interior = {"type": "homogeneous", "albedo": 0.0, "sigma_t": sigma_t}
            properties["interior"] = mi.load_dict(interior)
        parts[f"glass_{k}"] = mesh_of(f"glass_{k}", body.vertices, body.faces, properties)
    if case.matte is not None:
        properties = mi.Properties()
        paper = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(MATTE)}}
        properties["material"] = mi.load_dict(paper)
        matte = case.matte
        parts["matte"] = mesh_of("matte", matte.vertices, matte.faces, properties)
    return mi.load_dict(parts)


def theirs(case: Case, view: Camera, texels: Float64Array, spp: int) -> Runs:
    """Render by Mitsuba's volumetric path tracer."""
    kind = "volpathmis" if any(case.absorption) else "path"
    integrator = mi.load_dict(
        {"type": kind, "max_depth": LENGTH, "rr_depth": 96, "hide_emitters": True}
    )
    return rendered(mitsuba_scene(case, texels), integrator, view, spp)


def rendered(scene: mi.Scene, integrator: mi.Integrator, view: Camera, spp: int) -> Runs:
    """Render Mitsuba's scene by its integrator in independent runs."""
    sensor, each = sensor_of(view, np.zeros(3), 1.0), spp // SEED_COUNT
    given = {"sensor": sensor, "integrator": integrator}

    def picture(seed: int) -> Float64Array:
        total = np.zeros((view.height, view.width, 3))
        for own, count in passes(view, each, 7 + seed):
            with dr.suspend_grad():
                shot = mi.render(scene, **given, seed=own, spp=count)
            total += count * np.array(shot, np.float64)[..., :3]
        return total / each

    return over_seeds(view, picture)


def pictures_of(asset: Asset, view: Camera, texels: FloatArray, spp: int, depth: int) -> Runs:
    """Render an asset by ours in as many runs."""
    r = on_the_ground(asset, np.eye(4), view, height=-1e3)
    light = light_args(Light(texels=texels), r.device)
    pixels, each = all_pixels(view), spp // SEED_COUNT
    return over_seeds(view, lambda seed: r.foreground(light, pixels, each, 1, depth, seed).radiance)


def both(case: Case, view: Camera, texels: FloatArray, spp: int) -> Pair:
    """Return our picture and theirs."""
    ours = pictures_of(case.asset(), view, texels, spp, DEPTH)
    return ours, theirs(case, view, texels, spp)


if __name__ == "__main__":
    compare_cases(__doc__, cases(), both)
