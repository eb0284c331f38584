"""Light that the object throws onto the receiver: closed forms, furnaces, and both integrators."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.builders.insertions import arguments, go, read_layers, rgb, write_inputs
from tests.builders.shapes import all_pixels, box, camera, constant, ground, lobe, placed, quad
from tests.oracles import sg_irradiance
from tests.render.test_transport import (
    EXACT,
    FLOOR,
    HEIGHT,
    RUNS,
    both_ways,
    check_equal,
    check_light_gradient,
    check_map_gradient,
    lights,
    pixels_of,
    ratios_of,
    scene_of,
)
from tests.slow import slow
from warpir.core.arrays import Float64Array
from warpir.io.images.writers import exr_bytes
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.launches import THROWN_SHARE
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.transport.integrator import TransportIntegrator
from warpir.scene.asset import Material
from warpir.scene.light import Light
from warpir.scene.receiver import mesh_of

VIEW = camera(24, 16, 30.0, (0.0, 2.0, 0.0), pitch=-25.0)
COLOR = np.array([0.8, 0.5, 0.1])
LAMBERT = Material(base_color=tuple(COLOR), metallic=0.0, specular=0.0, roughness=1.0)
"""Without a specular lobe the dielectric is Lambert's."""
BLOCK = box((0.0, 0.5, -4.0), (1.0, 1.0, 1.0))
"""It stands on the ground: only its upright faces are seen from there."""
WALL = quad((0.0, 0.75, -4.0), (1.0, 0.0, 0.0), (0.0, 0.75, 0.0))
RUN_COUNT = 24
"""Independent seeds behind a standard error."""
STANDARD_ERRORS = 4.5
"""Of a sum over pixels that must match; with 24 runs, 2 in 10 000 are beyond."""
SIDE = 4
"""Side of the blocks of pixels that are added up [px]: single ones have too few samples."""
BLOCK_ORDER = all_pixels(VIEW).reshape(16 // SIDE, SIDE, 24 // SIDE, SIDE).swapaxes(1, 2).ravel()
DARK = constant((0.0, 0.0, 0.0))


class Runs:
    """The receiver's radiance under a light with independent seeds, shape [run, pixel, 3] each."""

    def __init__(
        self,
        thing: Placed,
        light: Light,
        depth: int,
        device: str,
        receiver: Receiver | None = None,
    ) -> None:
        scene = Scene([thing], VIEW, receiver or ground(0.0), device)
        args, pixels = light_args(light, scene.device), all_pixels(VIEW)
        sees = np.ones(len(pixels), np.int32)
        whole, direct = (
            [
                Renderer(scene, bounce_depth=d).receiver(args, pixels, sees, 64, 1, seed)
                for seed in range(RUN_COUNT)
            ]
            for d in (depth, 0)
        )
        self.unoccluded = np.stack([r.unoccluded for r in direct]).astype(np.float64)
        self.blocked = self.unoccluded - np.stack([r.lit for r in direct])
        self.thrown = np.stack([r.lit for r in whole]) - (self.unoccluded - self.blocked)


def assert_zero(difference: Float64Array) -> None:
    """Runs of a difference have mean 0 in each block of pixels, and over all of them."""
    runs = len(difference)
    blocks = difference[:, BLOCK_ORDER].reshape(runs, -1, SIDE * SIDE, 3).sum(axis=2)
    for part in (blocks, difference.sum(axis=1)):
        error = part.std(axis=0, ddof=1) / np.sqrt(runs) + FLOOR
        z = part.mean(axis=0) / error
        assert (np.abs(z) < STANDARD_ERRORS).all(), z


@pytest.mark.parametrize("depth", [1, 3])
def test_bounce_of_an_upright_block_under_an_even_sky(device: str, depth: int) -> None:
    """A Lambert face sees half the sky and sends back half its albedo: closed, in each channel."""
    found = Runs(placed(BLOCK, LAMBERT), constant(), depth, device)
    assert found.thrown.mean(0).max() > 0.1
    assert_zero(found.thrown - 0.5 * COLOR * found.blocked)


def test_bounce_of_a_mirror_gives_back_what_it_hides(device: str) -> None:
    """An upright white mirror shows the ground the sky: the ratio is 1 (furnace)."""
    found = Runs(placed(BLOCK, Material(roughness=0.0)), constant(), 1, device)
    assert found.blocked.mean(0).max() > 0.2
    assert_zero(found.thrown - found.blocked)


@pytest.mark.parametrize("normal", [(0.2, 1.0, 0.15), *slow((0.0, 1.0, 0.0))])
def test_bounce_of_what_glows(device: str, normal: tuple[float, float, float]) -> None:
    """In darkness each point of the ground gets the object's radiance times what it covers."""
    glow = np.array([2.0, 1.0, 0.5])
    n = np.array(normal) / np.linalg.norm(normal)
    floor = Receiver(n, float(n @ [0.0, 0.0, -4.0]))
    thing = placed(BLOCK, Material(emission=tuple(glow)))
    found, sky = (Runs(thing, light, 1, device, floor) for light in (DARK, constant()))
    assert found.thrown.mean(0).max() > 0.2
    assert_zero(found.thrown - glow * sky.blocked)


@pytest.mark.parametrize("sunk", [0.45, *slow(0.9)])
def test_bounce_of_what_is_sunk_is_that_of_what_stands_out(device: str, sunk: float) -> None:
    """The ground sees the part above it alone: no light that is thrown or blocked is missed."""
    standing = 1.0 - sunk
    glows = Material(emission=(1.0, 1.0, 1.0))
    shapes = (
        box((0.0, 0.5 - sunk, -4.0), (1.0, 1.0, 1.0)),
        box((0.0, 0.5 * standing, -4.0), (1.0, standing, 1.0)),
    )
    whole, upper = (Runs(placed(shape, glows), constant(), 1, device) for shape in shapes)
    assert upper.thrown.mean(0).max() > 0.02
    assert_zero(whole.thrown - upper.thrown)
    assert_zero(whole.blocked - upper.blocked)


@pytest.mark.slow
def test_bounce_of_a_sunlit_wall_exceeds_one(device: str) -> None:
    """Before a Lambert wall in the sun the ground gains; behind it, in its shadow, nothing."""
    axis, sharpness = np.array([0.2, 0.45, 0.9]), 300.0
    sun = lobe(axis, sharpness, (50.0, 50.0, 50.0))
    thing = placed(WALL, LAMBERT)
    found, sky = (Runs(thing, light, 1, device) for light in (sun, constant()))
    on_wall = 50.0 * sg_irradiance((0.0, 0.0, 1.0), axis / np.linalg.norm(axis), sharpness)
    before, behind = ground_z(0.0) > -4.0, ground_z(1.0) < -4.0
    difference = found.thrown - COLOR * on_wall / np.pi * sky.blocked
    assert_zero(difference * before[:, None])
    assert before.any() and behind.any() and (found.thrown[:, behind] == 0.0).all()
    gain = ((found.thrown - found.blocked)[:, before] / found.unoccluded[:, before]).mean(axis=0)
    assert gain[:, 0].max() > 0.2 and gain[:, 2].max() < 0.1


def ground_z(down: float) -> Float64Array:
    """Where the upper or lower edge of each pixel meets the ground, along Z [m], shape [pixel]."""
    x = np.arange(VIEW.width) + 0.5
    y = np.arange(VIEW.height) + down
    u, v = np.meshgrid((x - VIEW.cx) / VIEW.fx, -(y - VIEW.cy) / VIEW.fy)
    d = np.stack([u, v, -np.ones_like(u)], axis=-1) @ VIEW.c2w[:3, :3].T
    t = np.where(d[..., 1] < 0.0, -VIEW.c2w[1, 3] / np.minimum(d[..., 1], -1e-9), np.inf)
    z: Float64Array = (t * d[..., 2]).reshape(-1)
    return z


def test_bounce_leaves_the_contact_dark(device: str) -> None:
    """Light from below ends at the ground: a white slab close above it does not light it."""
    slab = box((0.0, 0.06, -4.0), (2.0, 0.1, 2.0))
    white = Material(metallic=0.0, specular=0.0, roughness=1.0)
    low = camera(4, 4, 10.0, (0.0, 0.005, -3.9), pitch=-60.0)
    scene = Scene([placed(slab, white)], low, ground(0.0), device)
    args, pixels = light_args(constant(), scene.device), all_pixels(low)
    found = Renderer(scene, bounce_depth=4).receiver(
        args, pixels, np.zeros(len(pixels), np.int32), 256, 1, 0
    )
    ratio = found.lit / found.unoccluded
    assert (found.unoccluded > 0.5).all() and ratio.max() < 0.02, ratio


@pytest.mark.slow
def test_bounce_onto_a_mesh_is_that_onto_the_plane(device: str) -> None:
    """A dark floor of two triangles gains what the plane in its place gains."""
    floor = quad((0.0, 0.0, -4.0), (60.0, 0.0, 0.0), (0.0, 0.0, -60.0))
    mesh = Receiver(np.array([0.0, 1.0, 0.0]), 0.0, mesh_of(placed(floor).asset), is_plane=False)
    # The floor ends at 60 m, where light from below the horizon would pass.
    light = lobe((0.3, 0.6, 0.6), 60.0)
    on_plane, on_mesh = (
        Runs(placed(BLOCK, LAMBERT), light, 2, device, receiver) for receiver in (None, mesh)
    )
    # Of the plane's pixels those that the mesh fills.
    filled = (on_mesh.unoccluded.mean(0) > 0.99 * on_plane.unoccluded.mean(0)).all(axis=-1)
    assert filled.sum() > 200
    assert_zero((on_plane.thrown - on_mesh.thrown) * filled[:, None])


def test_bounce_is_looked_for_where_nothing_is_shaded(device: str) -> None:
    """The pilot pass finds ground that gains light, and more of it than the shadow covers."""
    thing = placed(BLOCK, Material(emission=(3.0, 0.0, 0.0)))
    high = camera(48, 32, 24.0, (0.0, 8.0, -4.0), pitch=-89.0)
    scene = Scene([thing], high, ground(0.0), device)
    args = light_args(constant((0.2, 0.2, 0.2)), scene.device)
    glowing, without = (shaded_pixels(Renderer(scene, bounce_depth=d), args, 0) for d in (1, 0))
    assert set(without) < set(glowing)
    all_of_it = Renderer(scene, bounce_depth=1)
    pixels = all_pixels(high)
    found = all_of_it.receiver(args, pixels, np.ones(len(pixels), np.int32), 256, 1, 1)
    gained = np.flatnonzero(all_of_it.ratio(found)[:, 0] > 1.01)
    assert set(gained) <= set(glowing)


def bouncing(device: str, depth: int, **about: object) -> Renderer:
    """A ball and a box on the ground that light it."""
    return Renderer(scene_of(device, **about).scene, bounce_depth=depth)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize(("roughness", "sun"), [((0.5, 0.8), 60.0), ((0.2, 1.0), 6.0)])
def test_bounce_of_transport_agrees_with_mis(
    device: str, roughness: tuple[float, float], sun: float
) -> None:
    """Rows of recorded directions have the expectation of `mis`: each pixel, and their sum."""
    # As many samples of what is thrown as the object has.
    runs = THROWN_SHARE * RUNS
    own, other = both_ways(bouncing(device, 2, roughness=roughness), 1, sun, runs)
    check_equal(ratios_of(own), ratios_of(other), 2)


@pytest.mark.slow
def test_bounce_gradient_of_transport_agrees_with_mis(device: str) -> None:
    """Of the ratio alone, through light that the object throws onto the ground."""
    renderer = bouncing(device, 2, roughness=(0.5, 0.8))
    check_light_gradient(renderer, 1, tracings=16, runs=24, of_object=False)


def test_bounce_gradient_of_transport_matches_central_differences(device: str) -> None:
    """Gradients of texels, bounce included, are those of the very function that is computed."""
    renderer = bouncing(device, 2)
    objects, proxies = pixels_of(renderer)
    made = TransportIntegrator(renderer, objects, proxies, 1, EXACT, Light(lobes=lights(20.0)))

    def loss(texels: torch.Tensor) -> torch.Tensor:
        out = made.radiance(texels, texels, 0)
        return ((out.lit / out.unoccluded).double() ** 3).sum()

    check_map_gradient(loss, lights(20.0))


def test_bounce_of_transport_adds_what_glows(device: str) -> None:
    """In darkness the rows hold what the object emits, and what the ball reflects of the box."""
    renderer = bouncing(device, 2, emission=(2.0, 1.0, 0.5), roughness=(0.5, 0.8))
    objects, proxies = pixels_of(renderer)
    dark = torch.zeros(HEIGHT, 2 * HEIGHT, 3)
    settings = replace(EXACT, subsamples=64, paths=512)
    own = TransportIntegrator(renderer, objects, proxies, 1, settings).radiance(dark, dark, 0)
    reference = MisIntegrator(renderer, objects, proxies, spp=512, rays=1, depth=1)
    truth = reference.radiance(dark, dark, 1)
    assert float(truth.lit.max()) > 0.2 and bool((truth.unoccluded == 0.0).all())
    assert float(own.lit.sum()) == pytest.approx(float(truth.lit.sum()), rel=0.02)


@pytest.mark.slow
def test_light_on_ground_of_a_plate_does_not_depend_on_its_unit(tmp_path: Path) -> None:
    """In numbers 1000 times as large, a plate keeps what the object throws and reflects."""
    write_inputs(tmp_path)
    values = np.random.default_rng(5).uniform(0.2, 1.0, (32, 48, 3)).astype(np.float32)
    found = []
    for unit, flags in ((2.0, {}), (2000.0, {}), (2.0, {"no_bounce": ""})):
        out = tmp_path / f"{unit:.0f}{''.join(flags)}"
        plate = tmp_path / f"{unit:.0f}.exr"
        planes = {name: unit * values[..., k] for k, name in enumerate("RGB")}
        plate.write_bytes(exr_bytes(plate, planes))
        more = {"samples": "64", "sharpness": "off", "grain": "off", "tone": "linear"}
        go(arguments(tmp_path, out, photo=str(plate), **more, **flags), out)
        layers = read_layers(out / "layers.exr")
        found.append((rgb(layers, "shadow."), rgb(layers, "fg.") / unit))
    *thrown, (blocked, _) = found
    for small, large in zip(*thrown, strict=True):
        np.testing.assert_allclose(large, small, atol=2e-3)
    assert (thrown[0][0] - blocked).mean() > 1e-3  # there is such light: .0045
