"""What does a sample of `mis` cost, forward and forward + backward?

    python -m benchmarks.mis [--assets DIR] [--device cpu|cuda] [--threads N] [--json FILE]

A ball of 64k triangles and ToyCar, 256 x 384, under maps of 64 x 128 texels: a sun with 31 broad
lobes, and noise with a lamp. A sample is one path of the object, or one point of the plane, with a
direction of each technique per vertex.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
import trimesh

from benchmarks.measure import context, peak_mib, report, seconds
from warpir.core.arrays import IntArray
from warpir.io.assets import load_asset
from warpir.render.device import choose_device
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.integrator import MaterialTensors
from warpir.render.mis import MisIntegrator
from warpir.render.renderer import Renderer
from warpir.scene.asset import Asset, Material, Primitive
from warpir.scene.camera import camera_from_fov
from warpir.scene.light import Light, Lobes, as_map
from warpir.scene.placement import place_asset

WIDTH, HEIGHT = 384, 256
LOBE_COUNT = 32
SUN_SHARPNESS = 2.0e4
MAP_HEIGHT = 64


def ball() -> Asset:
    """A smooth sphere of 64k triangles, red and half glossy."""
    mesh = trimesh.creation.uv_sphere(radius=0.5, count=[180, 180])
    vertices = np.asarray(mesh.vertices, np.float64)
    primitive = Primitive(
        vertices,
        np.asarray(mesh.faces, np.int32),
        0,
        normals=(vertices / np.linalg.norm(vertices, axis=1, keepdims=True)).astype(np.float32),
    )
    material = Material(base_color=(0.7, 0.3, 0.2), metallic=0.0, roughness=0.4)
    return Asset("ball", (primitive,), (material,))


def sun_and_sky() -> Lobes:
    """A sun at 40 degrees and 31 broad lobes with twice its flux."""
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(LOBE_COUNT, 3))
    axis[0] = [0.5, 0.75, 0.3]
    axis[1:, 1] = np.abs(axis[1:, 1])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    sharpness = np.geomspace(1.0, 30.0, LOBE_COUNT)
    sharpness[0] = SUN_SHARPNESS
    flux = np.full(LOBE_COUNT, 2.0 / (LOBE_COUNT - 1))
    flux[0] = 1.0
    peak = flux * sharpness / (2.0 * np.pi * -np.expm1(-2.0 * sharpness))
    tint = rng.uniform(0.6, 1.0, (LOBE_COUNT, 3))
    return Lobes(
        (peak[:, None] * tint).astype(np.float32),
        axis.astype(np.float32),
        sharpness.astype(np.float32),
    )


def lights() -> dict[str, Light]:
    """The lights that are measured, by name."""
    texels = np.random.default_rng(1).uniform(0.2, 1.0, (MAP_HEIGHT, 2 * MAP_HEIGHT, 3))
    texels[20, 40] = 500.0
    return {"lobes": Light(sun_and_sky()), "map": Light(texels=texels.astype(np.float32))}


def material_tensors(renderer: Renderer) -> MaterialTensors:
    """Return the scene's base colour and roughness as free parameters."""
    material = renderer.scene.material_args
    return MaterialTensors(
        base_color=torch.tensor(material.base_color.numpy(), requires_grad=True),
        roughness=torch.tensor(material.roughness.numpy(), requires_grad=True),
    )


def renderer(asset: Asset, device: str, threads: int) -> Renderer:
    """Set an asset of 1 m on the ground, filling about half of the view."""
    camera = camera_from_fov(WIDTH, HEIGHT, 40.0, -12.0, 0.7)
    placement = place_asset(
        *asset.bounds(), camera, None, place=(0.0, 0.0, -2.4), rotate_y=-35.0, size=1.0
    )
    ground = placement.ground
    scene = Scene(
        [Placed(asset, placement.asset_to_world)],
        camera,
        Receiver(ground[:3], -float(ground[3])),
        device,
    )
    return Renderer(scene, threads)


def main() -> None:
    """Measure every scene, light and part."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--assets", type=Path, default=Path("../shared/data"))
    parser.add_argument("--device", default=None)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", default=None)
    options = parser.parse_args()
    device = choose_device(options.device)
    none: IntArray = np.zeros(0, np.int32)
    for scene_name, asset in (
        ("ball", ball()),
        ("ToyCar", load_asset(options.assets / "mesh/ToyCar.glb")),
    ):
        render = renderer(asset, device, options.threads)
        objects = render.gbuffer(0).object_pixels
        for light_name, light in lights().items():
            shaded = render.shaded_pixels(light_args(light, render.device), 0)
            texels = as_map(light, MAP_HEIGHT)
            fixed, free = torch.tensor(texels), torch.tensor(texels, requires_grad=True)
            for part, pixels, depth, materials in (
                ("object", (objects, none), 1, False),
                ("object", (objects, none), 5, False),
                ("object", (objects, none), 5, True),
                ("plane", (none, shaded), 1, False),
            ):
                mis = MisIntegrator(render, *pixels, options.samples, 1, depth)
                factors = material_tensors(render) if materials else None

                def forward(mis: MisIntegrator = mis, fixed: torch.Tensor = fixed) -> None:
                    with torch.no_grad():
                        mis.radiance(fixed, fixed, 0)

                def both(
                    mis: MisIntegrator = mis,
                    free: torch.Tensor = free,
                    factors: MaterialTensors | None = factors,
                ) -> None:
                    out = mis.radiance(free, free, 0, factors)
                    (out.foreground.sum() + (out.lit / (out.unoccluded + 1e-6)).sum()).backward()

                count = (len(pixels[0]) + len(pixels[1])) * options.samples
                once, once_spread = seconds(forward, render.device, options.repeats)
                twice, twice_spread = seconds(both, render.device, options.repeats)
                report(
                    {
                        "question": "mis",
                        "scene": scene_name,
                        "light": light_name,
                        "part": part,
                        "free": "light and materials" if materials else "light",
                        "depth": depth,
                        "samples": count,
                        "forward_ns": round(1e9 * once / count),
                        "forward_backward_ns": round(1e9 * twice / count),
                        "spread_ns": [
                            round(1e9 * once_spread / count),
                            round(1e9 * twice_spread / count),
                        ],
                        "peak_mib": round(peak_mib(render.device)),
                        **context(render.device, render.threads),
                    },
                    options.json,
                )


if __name__ == "__main__":
    main()
