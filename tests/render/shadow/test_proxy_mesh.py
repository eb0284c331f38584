"""The place's mesh: closed forms of shadow and bounce, both integrators, the flags around it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from tests.builders.insertions import arguments, go, write_inputs
from tests.builders.records import plane_sums
from tests.builders.shapes import box, camera, constant, ground, lobe, placed, quad, sphere
from tests.oracles import (
    half_plane_ratio,
    half_plane_ratio_lobe,
    rectangle_ratio,
    sg_irradiance,
)
from tests.render.test_render import DOWN, foot, render, shadow
from tests.render.test_transport import check_equal, objects_of, ratios_of
from tests.statistics import compare_gradients
from warpir.app.command import parse
from warpir.app.config import InsertConfig
from warpir.app.inputs import read_inputs
from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.core.color import luminance
from warpir.core.errors import ExitCode, InputError
from warpir.insert import main
from warpir.lighting.scene_light import make_light
from warpir.render.bridge import host_light
from warpir.render.composite import make_picture
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Scene
from warpir.render.integrator import MaterialTensors
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.mis.samples import ReceiverSamples
from warpir.render.picture.photo_scene import scene_of
from warpir.render.picture.quality import Quality
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.transport.integrator import TransportIntegrator
from warpir.render.transport.rows import TransportSettings
from warpir.report.result import NO_MASK_HANDED_OVER, NO_MESH_HANDED_OVER
from warpir.scene import receiver
from warpir.scene.asset import Material, Primitive
from warpir.scene.camera import Camera
from warpir.scene.lamps import lamp_axes, without_lamps
from warpir.scene.light import Light, Lobes, as_map, axis_from_angles, plain_sky, sun_lobe
from warpir.scene.placement import place_asset
from warpir.scene.receiver import ReceiverMesh, first_hit, is_in_view
from warpir.scene.tone_curves import Curves

LINEAR = Curves.identity("linear")

SPP = 1024
NOISE = 4.5 * np.sqrt(0.25 / SPP)
"""Largest error of a few dozen binomial ratios."""
HEIGHT = 8
SETTINGS = TransportSettings(
    height_fg=HEIGHT,
    height_shadow=HEIGHT,
    subsamples=8,
    paths=32,
    bright_directions=64,
    dtype="float32",
)


def mesh(*parts: Primitive) -> ReceiverMesh:
    """Several primitives as one mesh of the place."""
    offsets = np.cumsum([0, *(len(p.positions) for p in parts)])
    indices = [p.indices + o for p, o in zip(parts, offsets[:-1], strict=True)]
    return ReceiverMesh(
        np.concatenate([p.positions for p in parts]), np.concatenate(indices).astype(np.int32)
    )


def make(
    objects: Placed | list[Placed],
    view: Camera,
    device: str,
    place: ReceiverMesh,
    height: float | None = 0.0,
    photo: float | FloatArray | None = None,
) -> Renderer:
    """A renderer of objects in a place; ``height`` None: no plane; ``photo``: its radiance."""
    if isinstance(photo, float):
        photo = np.full((view.height, view.width, 3), photo, np.float32)
    proxy = replace(ground(height or 0.0), mesh=place, radiance=photo, is_plane=height is not None)
    several = objects if isinstance(objects, list) else [objects]
    return Renderer(Scene(several, view, proxy, device))


# ------------------------------------------------------------------------ against closed forms


def test_place_shades_the_plane_as_an_object_does(device: str) -> None:
    """A roof over half the sky, in a constant sky and under a lobe: what the plane receives."""
    reach = 60.0
    roof = mesh(quad((reach, 1.0, 0), (reach, 0, 0), (0, 0, -reach)))
    # From below the roof; from above the camera would see it instead of the ground.
    view = camera(9, 1, 0.5 / 0.4, (0.0, 0.5, 0.0), DOWN)
    renderer = make([], view, device, roof)
    x = foot(view)[:, :1] + 0.2 * np.array([-1.0, 1.0]) / np.sqrt(3.0)
    axis = np.array([-0.6, 0.8, 0.0])
    slanted = [half_plane_ratio_lobe(float(v), 1.0, axis, 100.0) for v in x.flat]
    irradiance = sg_irradiance([0.0, 1.0, 0.0], axis, 100.0)
    for light, whole, truth in (
        (constant(), np.pi, half_plane_ratio(x, 1.0)),
        (lobe(axis, 100.0), irradiance, np.reshape(slanted, x.shape)),
    ):
        ratio, _, unoccluded = shadow(renderer, light, SPP)
        np.testing.assert_array_equal(ratio, 1.0)
        error = unoccluded[:, 0] * np.pi / whole - truth.mean(axis=1)
        assert np.abs(error).max() < NOISE


def test_wall_receives_the_shadow_of_a_square(device: str) -> None:
    """A wall under a constant sky: one minus the square's form factor, and 1 without a square."""
    wall = mesh(quad((0, 0, -8.0), (40.0, 0, 0), (0, 40.0, 0)))
    card = placed(quad((0, 0, -7.0), (1.5, 0, 0), (0, 1.5, 0)))
    view = camera(8, 5, 8.0 / 0.6)
    ratio, _, unoccluded = shadow(make(card, view, device, wall, None), constant(), SPP)
    x = (np.arange(8 * 8) + 0.5) / 8 * 0.6 - 2.4
    y = (np.arange(5 * 8) + 0.5) / 8 * 0.6 - 1.5
    truth = rectangle_ratio(*np.meshgrid(x, y), 1.0, 1.5).reshape(5, 8, 8, 8).mean(axis=(1, 3))
    assert np.abs(ratio[:, 0] - truth.ravel()).max() < NOISE
    np.testing.assert_allclose(unoccluded, 1.0, atol=0.02)


@pytest.mark.parametrize("size", [1.0, 60.0, 3000.0])
def test_place_does_not_shade_itself(device: str, size: float) -> None:
    """Slanted walls of any size, far from the origin, meet no ray that leaves them."""
    rng = np.random.default_rng(4)
    right, up = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2] * 3.0 * size
    wall = mesh(quad(np.array([0.3, 0.2, -1.0]) * 2.0 * size, right, up))
    view = camera(24, 24, 24.0)
    # All that the wall could send to itself is what would be received.
    small = placed(sphere((50.0, 0.0, 50.0), 0.5, 1))
    renderer = make(small, view, device, wall, None, 1.0)
    _, _, unoccluded = shadow(renderer, constant((0.0, 0.0, 0.0)), 256)
    np.testing.assert_array_equal(unoccluded, 0.0)
    _, _, unoccluded = shadow(renderer, constant(), 64)
    assert (unoccluded[:, 0] > 0.9).sum() > 400


def test_ratio_is_exactly_one_where_nothing_is_blocked(device: str) -> None:
    """An object below the plane, beside a wall that shades and bounces."""
    # Also behind the wall: the plane is no occluder, and a wall's rays go down through it.
    below = placed(box((5.0, -2.0, -9.0), (1.0, 1.0, 1.0)))
    wall = mesh(quad((1.0, 1.0, -5.0), (1.0, 0.0, 1.0), (0, 1.0, 0)))
    view = camera(24, 16, 24.0, (0.0, 1.0, 0.0), -8.0)
    renderer = make(below, view, device, wall, 0.0, 0.6)
    light = Light(lobe((-0.5, 0.6, 0.2), 30.0).lobes, plain_sky((0.4,) * 3, (0.1,) * 3))
    ratio, lit, unoccluded = shadow(renderer, light, sees=1)
    np.testing.assert_array_equal(ratio, 1.0)
    np.testing.assert_array_equal(lit, unoccluded)
    assert unoccluded.max() > 0.0
    assert shaded_pixels(renderer, light_args(light, renderer.device), 0).size == 0
    assert render(renderer, light).mask.max() == 0.0


SUN = sun_lobe(0.0, 45.0, (3.0, 3.0, 3.0))
"""From behind the wall of `shaded_yard`."""


def shaded_yard(device: str, photo: float | None = None) -> Renderer:
    """A box on the ground in the shadow of a wall behind it, seen from above."""
    wall = mesh(box((0.0, 1.0, -8.0), (30.0, 6.0, 0.2)))
    thing = placed(box((0.0, 0.5, -6.0), (1.0, 1.0, 1.0)), Material(metallic=0.0))
    return make(thing, camera(24, 16, 20.0, (0.0, 3.0, 0.0), -25.0), device, wall, 0.0, photo)


def test_no_lamp_reaches_what_a_wall_shades(device: str) -> None:
    """Object and ground in the wall's shadow: black under the sun alone, and no second shadow."""
    renderer = shaded_yard(device)
    sky = Light(texels=plain_sky((0.5,) * 3, (0.2,) * 3))
    out = render(renderer, Light(SUN), 32, depth=3)
    assert out.mask.max() == 1.0 and out.radiance.max() == 0.0
    both = render(renderer, Light(SUN, sky.texels), 256, depth=2).radiance
    alone = render(renderer, sky, 256, depth=2).radiance
    assert both.sum() == pytest.approx(alone.sum(), rel=0.02)
    ratio, _, _ = shadow(renderer, Light(SUN, sky.texels), 256, sees=1)
    expected, _, _ = shadow(renderer, sky, 256, sees=1)
    assert expected.min() < 0.8, "the sky's own shadow is there"
    assert np.abs(ratio - expected).max() < 4.5 * np.sqrt(0.25 / 256)
    # In front of the shadow the sun is back.
    assert shadow(renderer, Light(SUN), 32)[2].max() > 0.5


def test_room_lights_what_stands_in_it(device: str) -> None:
    """In a closed room no light enters: all that is seen is what the photo shows of its walls."""
    room = mesh(box((0.0, 0.0, 0.0), (8.0, 8.0, 8.0)))
    ball = placed(sphere((0.0, 0.0, -2.0), 0.5, 4), Material(metallic=1.0, roughness=0.3))
    view = camera(16, 16, 24.0, (0.0, 0.0, 2.0))
    renderer = make(ball, view, device, room, None, 0.5)
    bright, dark = (render(renderer, constant((k,) * 3), 1024, depth=2) for k in (100.0, 0.0))
    np.testing.assert_array_equal(bright.radiance, dark.radiance)
    seen = dark.mask == 1.0
    open_air = make(ball, view, device, mesh(quad((0, 0, 90.0), (1, 0, 0), (0, 1, 0))), None)
    # Pixels share the directions that are drawn from the light, so seeds are averaged.
    furnace = [
        render(open_air, constant((0.5,) * 3), 256, depth=2, seed=seed).radiance[seen].mean()
        for seed in range(16)
    ]
    assert dark.radiance[seen].mean() == pytest.approx(np.mean(furnace), rel=1e-3)
    _, lit, unoccluded = shadow(renderer, constant(), 64)
    np.testing.assert_allclose(unoccluded, 0.5, rtol=1e-5)
    assert lit.min() < 0.5 and bool((lit <= unoccluded).all())


def test_place_sends_what_the_photo_shows(device: str) -> None:
    """A mirror floor shows the wall's two colours; a mirror toward the camera their mean."""
    view = camera(32, 32, 32.0)
    photo = np.full((16, 16, 3), 0.9, np.float32)
    photo[:, :8] = (0.2, 0.4, 0.6)
    wall = quad((0.0, 0.0, -6.0), (4.0, 0, 0), (0, 4.0, 0))
    unseen = quad((0.0, 0.0, 3.0), (9.0, 0, 0), (0, 9.0, 0))
    mirror = Material(metallic=1.0, roughness=0.0)
    floor = placed(quad((0.0, -1.0, -3.5), (2.0, 0, 0), (0, 0, -1.0)), mirror)
    front = placed(quad((0.0, 1.0, -4.0), (0.5, 0, 0), (0, 0.5, 0)), mirror)
    renderer = make([floor, front], view, device, mesh(wall, unseen), None, photo)
    mean = 0.5 * (photo[0, 0] + photo[0, -1])
    np.testing.assert_allclose(list(renderer.scene.receiver_args.elsewhere), mean, atol=1e-6)
    out = render(renderer, constant((7.0,) * 3), 16)
    shown, whole = out.radiance.reshape(32, 32, 3), out.mask.reshape(32, 32) == 1.0
    for rows, columns, color in (
        (slice(24, 27), slice(8, 14), photo[0, 0]),
        (slice(24, 27), slice(18, 24), photo[0, -1]),
        (slice(7, 10), slice(14, 18), mean),
    ):
        assert whole[rows, columns].all()
        np.testing.assert_allclose(
            shown[rows, columns], np.broadcast_to(color, shown[rows, columns].shape), rtol=2e-3
        )


def test_place_hides_the_object_from_the_camera(device: str) -> None:
    """A wall in front hides, one behind does not, and a sheet on a table is seen whole."""
    thing = placed(box((0.0, 0.0, -5.0), (1.0, 1.0, 1.0)))
    view = camera(16, 16, 40.0)
    for z, coverage in ((-3.0, 0.0), (-8.0, 1.0)):
        wall = mesh(quad((0.0, 0.0, z), (3.0, 0, 0), (0, 3.0, 0)))
        renderer = make(thing, view, device, wall, None)
        assert render(renderer, constant()).mask.reshape(16, 16)[8, 8] == coverage
        assert (renderer.gbuffer(0).coverage.max(initial=0.0) > 0.0) == bool(coverage)
    above = camera(16, 16, 40.0, (0.0, 2.0, 0.0), -26.0)
    table = mesh(quad((0.0, 0.7, -3.0), (2.0, 0, 0), (0, 0, -2.0)))
    sheet = placed(quad((0.0, 0.7, -3.0), (0.3, 0, 0), (0, 0, -0.3)))
    mask = render(make(sheet, above, device, table, 0.0), constant(), 64).mask
    assert mask.max() == 1.0 and (mask == 1.0).sum() > 8
    assert ((mask > 0.0) & (mask < 0.2)).sum() < 20, "no speckle"


# ----------------------------------------------------------------------- both integrators


def corner(device: str, is_black: bool = False) -> Renderer:
    """A ball before a wall of uneven photo, or black, on the ground, which shades part of it."""
    wall = mesh(quad((0.7, 0.6, -4.6), (0.8, 0, 0.5), (0, 0.9, 0)))
    ball = placed(
        sphere((0.0, 0.5, -4.0), 0.5, 3), Material(base_color=(0.8, 0.6, 0.4), metallic=0.2)
    )
    view = camera(20, 14, 30.0, (0.3, 1.5, 0.0), -14.0)
    photo = np.random.default_rng(1).uniform(0.1, 0.9, (14, 20, 3)).astype(np.float32)
    return make(ball, view, device, wall, 0.0, None if is_black else photo)


def some_lobes() -> Lobes:
    """A sun that comes over the wall, and a broad lobe."""
    axis = np.array([[0.6, 0.7, -0.5], [-0.4, 0.6, 0.5]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return Lobes(
        np.array([[9.0, 8.0, 7.0], [0.5, 0.6, 0.8]], np.float32),
        axis.astype(np.float32),
        np.array([40.0, 2.0], np.float32),
    )


def pixels_of(renderer: Renderer) -> tuple[IntArray, IntArray]:
    """Object pixels, and those that the place fills for the better part."""
    seen = renderer.gbuffer(0, spp=64)
    covered = seen.object_pixels[seen.coverage > 0.5]
    every = np.arange(renderer.scene.camera.width * renderer.scene.camera.height)
    _, _, unoccluded = shadow(renderer, constant(), 16)
    place = every[unoccluded[:, 0] > 0.0]
    return seen.object_pixels, np.setdiff1d(place, covered).astype(np.int32)


def test_transport_agrees_with_mis_in_a_place(device: str) -> None:
    """Object and ratio have one expectation, and so have the light's gradients."""
    renderer = corner(device)
    objects, proxies = pixels_of(renderer)
    texels = torch.tensor(as_map(Light(some_lobes()), HEIGHT), requires_grad=True)
    light = texels
    expected = Light(texels=texels.detach().numpy())
    own, own_gradients, other, other_gradients = [], [], [], []
    rng = np.random.default_rng(3)
    weight_fg, weight_ratio = (
        torch.tensor(rng.uniform(0.5, 1.5, (len(p), 3)), dtype=torch.float32)
        for p in (objects, proxies)
    )

    def gradient(out: object) -> Float64Array:
        ratio = out.lit / out.unoccluded.clamp(min=1e-6)  # type: ignore[attr-defined]
        loss = (out.foreground.cpu() * weight_fg).sum()  # type: ignore[attr-defined]
        loss = loss + (ratio.cpu() * weight_ratio).sum()
        return torch.autograd.grad(loss, texels)[0].double().numpy()

    for seed in range(24):
        made = TransportIntegrator(renderer, objects, proxies, 2, SETTINGS, expected, seed)
        own.append(made.radiance(light, light, 0))
        own_gradients.append(gradient(own[-1]))
    reference = MisIntegrator(renderer, objects, proxies, spp=128, rays=1, depth=2)
    for seed in range(12):
        other.append(reference.radiance(light, light, 1000 + seed))
        other_gradients.append(gradient(other[-1]))
    check_equal(objects_of(own), objects_of(other), 2, widened=2.0)
    check_equal(ratios_of(own), ratios_of(other), 2, widened=2.0)
    match = compare_gradients(np.mean(own_gradients, axis=0), np.mean(other_gradients, axis=0))
    assert match.cosine > 0.99 and abs(match.signed_bias) < 0.02, match
    assert made.bounced.max() > 0.0 and made.bytes > made.T_fg.bytes + made.T_shadow.bytes
    with pytest.raises(InputError, match="--proxy"):
        settings = replace(SETTINGS, memory_mib=1)
        TransportIntegrator(renderer, objects, np.tile(proxies, 99), 2, settings)


def test_transport_in_a_place_stays_exact_at_both_ends(device: str) -> None:
    """bfloat16 rows: ratio 1 where nothing is kept, dark where everything is."""
    renderer = corner(device)
    objects, proxies = pixels_of(renderer)
    settings = replace(SETTINGS, dtype="bfloat16")
    made = TransportIntegrator(renderer, objects, proxies, 1, settings)
    sun = torch.from_numpy(as_map(Light(some_lobes()), HEIGHT))
    out = made.radiance(sun, sun, 0)
    ratio = (out.lit / out.unoccluded).cpu()
    free = (made.T_shadow.by_row.crow_indices().diff() == 0).cpu()
    free &= (made.bounced_blocked == 0.0).all(dim=1).cpu()
    assert bool(free.any()) and bool((ratio[free] == 1.0).all())
    assert float(ratio.max()) <= 1.0 and float(ratio.min()) < 0.6
    assert made.T_receiver is not None
    kept = made.T_shadow.by_row.to_dense().cpu() / made.T_receiver.T[0].float().cpu().clamp(
        min=1e-30
    )
    assert float(kept.max()) <= 1.0 + 1e-6


def test_transport_gradient_in_a_place_matches_differences(device: str) -> None:
    """Of object and ratio along one direction of the light, constants of the mesh included."""
    renderer = corner(device)
    objects, proxies = pixels_of(renderer)
    made = TransportIntegrator(renderer, objects, proxies, 2, SETTINGS)
    texels = torch.tensor(as_map(Light(some_lobes()), HEIGHT), requires_grad=True)
    toward = torch.rand(texels.shape, generator=torch.Generator().manual_seed(1))

    def loss(light: torch.Tensor) -> torch.Tensor:
        out = made.radiance(light, light, 0)
        seen = out.unoccluded > 1e-3
        ratio = torch.where(seen, out.lit / out.unoccluded.clamp(min=1e-3), 1.0)
        return (out.foreground.double() ** 2).sum() + (ratio.double() ** 3).sum()

    (d_texels,) = torch.autograd.grad(loss(texels), texels)
    step, origin = 2e-3, texels.detach()
    sides = [float(loss(origin + sign * step * toward)) for sign in (1.0, -1.0)]
    numeric = (sides[0] - sides[1]) / (2.0 * step)
    assert float((d_texels * toward).sum()) == pytest.approx(numeric, rel=0.01)


def test_mis_gradients_match_central_differences(device: str) -> None:
    """Of light and material, over the recorded samples; what the mesh sends is a constant."""
    renderer = corner(device)
    objects, proxies = pixels_of(renderer)
    mis = MisIntegrator(renderer, objects, proxies, spp=16, rays=2, depth=2)
    texels = torch.tensor(as_map(Light(some_lobes()), HEIGHT), requires_grad=True)
    args = light_args(host_light(texels), renderer.device)
    samples = ReceiverSamples(mis, args, 5, (True,))
    drawn = samples.render()
    # On CUDA several threads share a pixel, each with a row of the record.
    lit, unoccluded = (
        rows.reshape(len(proxies), -1, 3).sum(dim=1) for rows in plane_sums(samples.kept[0], texels)
    )
    black = MisIntegrator(corner(device, is_black=True), objects, proxies, 16, 2, 2)
    dark = ReceiverSamples(black, args, 5, (False,)).render()
    np.testing.assert_allclose(lit.detach(), dark.lit, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(unoccluded.detach(), dark.unoccluded, rtol=1e-4, atol=1e-6)
    assert (drawn.unoccluded - dark.unoccluded).max() > 0.05
    found = samples.gradient(np.ones_like(drawn.lit), -2.0 * np.ones_like(drawn.lit))
    (expected,) = torch.autograd.grad((lit - 2.0 * unoccluded).sum(), texels)
    assert found[0] is not None
    assert compare_gradients(found[0], expected.double().numpy()).relative_l2 < 1e-4

    # A black light: all that the object shows comes from the wall, in proportion to a Lambertian
    # colour where it is seen once.
    color = torch.tensor([[0.5, 0.5, 0.5]], requires_grad=True)
    fixed = torch.zeros(4, 8, 3)
    metallic = torch.tensor([1.0])
    matte = MaterialTensors(base_color=color, metallic=metallic, roughness=torch.tensor([1.0]))
    once = MisIntegrator(renderer, objects, proxies, spp=16, rays=2, depth=1)
    rough = once.radiance(fixed, fixed, 5, matte).foreground.double().sum()
    (d_color,) = torch.autograd.grad(rough, color)
    sides = []
    for step in (0.01, -0.01):
        moved = replace(matte, base_color=(color + step).detach())
        sides.append(float(once.radiance(fixed, fixed, 5, moved).foreground.double().sum()))
    numeric = (sides[0] - sides[1]) / 0.02
    assert numeric > 0.0 and float(d_color.sum()) == pytest.approx(numeric, rel=2e-3)


# ---------------------------------------------------------------------- on the host


def test_first_hit_is_that_of_the_kernels(device: str) -> None:
    """Distances in float64 against the camera's reach; and which triangle it was."""
    ball = mesh(sphere((0.0, 0.0, -5.0), 1.0, 3), quad((0, 0, -9.0), (9, 0, 0), (0, 9, 0)))
    view = camera(16, 12, 20.0)
    uv = np.stack(np.meshgrid(np.arange(16) + 0.5, np.arange(12) + 0.5), axis=-1).reshape(-1, 2)
    rays = np.array([view.ray(*p)[1] for p in uv])
    distance, triangle = first_hit(ball, np.zeros_like(rays), rays)
    along = rays @ np.array([0.0, 0.0, -5.0])
    inside = along**2 - 24.0
    on_ball = along - np.sqrt(np.maximum(inside, 0.0))
    seen = inside > 0.2
    assert seen.sum() > 10
    np.testing.assert_allclose(distance[seen], on_ball[seen], atol=0.03)
    np.testing.assert_allclose(distance[inside < -0.2], 9.0 / -rays[inside < -0.2, 2], rtol=1e-12)
    assert (triangle[inside < -0.2] >= len(ball.indices) - 2).all()
    assert np.isinf(first_hit(ball, np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))[0]).all()


@pytest.mark.parametrize("count", [1, 16, 17, 700])
def test_first_hit_is_the_nearest_of_all_triangles(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Corners on a lattice: rays run within sides of boxes, and meet triangles at shared edges."""
    monkeypatch.setattr(receiver, "CHUNK", 8 * receiver.WIDTH)  # as of more rays and triangles
    rng = np.random.default_rng(count)
    corners = rng.integers(-3, 4, (30, 3)).astype(np.float64)
    soup = ReceiverMesh(corners, rng.integers(0, 30, (count, 3)).astype(np.int32))
    origins = rng.integers(-4, 5, (90, 3)).astype(np.float64)
    directions = np.concatenate([np.tile(np.eye(3), (10, 1)), rng.normal(size=(60, 3))])
    distance, triangle = first_hit(soup, origins, directions)
    every = np.tile(np.arange(count), 90)
    met = receiver._reach(soup, every, *(np.repeat(a, count, 0) for a in (origins, directions)))
    np.testing.assert_array_equal(distance, met.reshape(90, count).min(axis=1))
    is_met = np.isfinite(distance)
    assert is_met.any() and not is_met.all()
    np.testing.assert_array_equal(triangle[is_met], met.reshape(90, count).argmin(axis=1)[is_met])


def test_first_hit_looks_at_few_triangles(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan of a place has a million, in any order; all for each ray took 5 s of 64 rays."""
    rows, columns = np.indices((80, 80)).reshape(2, -1)
    corners = np.stack([columns, np.sin(rows) * 0.1, rows], axis=1).astype(np.float64)
    first = (rows * 80 + columns)[(rows < 79) & (columns < 79)]
    faces = np.concatenate([first[:, None] + (0, 80, 1), first[:, None] + (1, 80, 81)])
    place = ReceiverMesh(corners, np.random.default_rng(0).permutation(faces).astype(np.int32))
    tested, reach = [], receiver._reach
    monkeypatch.setattr(receiver, "_reach", lambda *a: tested.append(len(a[1])) or reach(*a))
    toward = np.stack([np.linspace(1, 78, 64), np.full(64, -5.0), np.linspace(78, 1, 64)], axis=1)
    eye = np.array([40.0, 5.0, 40.0])
    distance = first_hit(place, np.tile(eye, (64, 1)), toward - eye + (0.01, 0.0, 0.02))[0]
    assert np.isfinite(distance).all()
    assert sum(tested) < 0.02 * 64 * len(faces)


def test_view_of_a_place() -> None:
    """A mesh that contains the camera is in view; one behind or beside it is not."""
    view = camera(16, 12, 20.0)
    assert is_in_view(mesh(box((0, 0, 0), (4.0, 4.0, 4.0))), view)
    assert is_in_view(mesh(quad((0, 0, -5.0), (90.0, 0, 0), (0, 90.0, 0))), view)
    assert not is_in_view(mesh(box((0, 0, 5.0), (1.0, 1.0, 1.0))), view)
    assert not is_in_view(mesh(box((30.0, 0, -5.0), (1.0, 1.0, 1.0))), view)


def test_object_stands_on_what_the_camera_sees_first() -> None:
    """On the table, on the plane beside it, not moved without a plane; refused in the sky."""
    low, high = np.array([-0.5, 0.0, -0.5]), np.array([0.5, 1.0, 0.5])
    view = camera(64, 48, 60.0, (0.0, 1.6, 0.0), -20.0)
    table = mesh(quad((0.0, 0.7, -3.0), (1.0, 0, 0), (0, 0, -1.0)))

    def stand(**how: object) -> Float64Array:
        found = place_asset(low, high, view, scale=0.2, mesh=table, **how)  # type: ignore[arg-type]
        return np.asarray((found.asset_to_world @ [0.0, 0.0, 0.0, 1.0])[:3])

    u, v = view.project(np.array([[0.1, 0.7, -3.0], [1.5, 0.0, -2.5]]))
    np.testing.assert_allclose(stand(at=tuple(u)), [0.1, 0.7, -3.0], atol=1e-12)
    np.testing.assert_allclose(stand(at=tuple(v)), [1.5, 0.0, -2.5], atol=1e-12)
    np.testing.assert_allclose(stand(place=(0.0, 0.7, -3.0)), [0.0, 0.0, -3.0], atol=1e-12)
    lifted = stand(place=(0.0, 0.7, -3.0), is_plane=False)
    np.testing.assert_allclose(lifted, [0.0, 0.7, -3.0], atol=1e-12)
    for how in ({"at": tuple(v), "is_plane": False}, {"at": (32.0, 0.5)}):
        with pytest.raises(InputError, match="shows"):
            stand(**how)
    wall = mesh(quad((0.0, 1.0, -3.0), (1.0, 0, 0), (0, 1.0, 0)))
    found = place_asset(low, high, view, scale=0.2, mesh=wall, at=(32.0, 20.0))
    assert any("steep" in line for line in found.warnings)


def test_lamps_and_the_rest_are_the_light() -> None:
    """A sun as lobe or in a map is taken by its share; what is broad stays."""
    sky = plain_sky((0.4, 0.5, 0.8), (0.2, 0.2, 0.2))
    as_lobe = Light(SUN, sky)
    as_texels = Light(texels=(as_map(as_lobe, 64)))
    axis = axis_from_angles(0.0, 45.0)
    for light in (as_lobe, as_texels):
        assert np.degrees(np.arccos(lamp_axes(light)[0] @ axis)) < 2.0
        for share in (0.3, 1.0):
            rest = as_map(without_lamps(light, share), 64)
            expected = sky + (1.0 - share) * (as_map(as_lobe, 64) - sky)
            np.testing.assert_allclose(luminance(rest), luminance(expected), rtol=2e-3)
    broad = Light(Lobes(SUN.amplitude, SUN.axis, np.array([20.0], np.float32)), sky)
    assert without_lamps(broad) is broad and len(lamp_axes(broad)) == 0


# ------------------------------------------------------------------------------ whole runs


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Inputs of a small run, a wall, and masks."""
    folder = tmp_path_factory.mktemp("place")
    write_inputs(folder)
    wall = trimesh.creation.box(extents=(20.0, 6.0, 0.2))
    wall.apply_translation((0.0, 3.0, -7.0))
    wall.export(folder / "wall.glb")
    wall.apply_translation((0.0, 0.0, 30.0))
    wall.export(folder / "behind.ply")
    (folder / "bad.glb").write_bytes(b"glTF")
    grey = np.zeros((32, 48), np.uint8)
    Image.fromarray(grey).save(folder / "black.png")
    Image.fromarray(grey + 255).save(folder / "white.png")
    Image.fromarray(np.full((32, 48), 128 * 257, np.uint16)).save(folder / "half.png")
    Image.fromarray(grey[:30, :40]).save(folder / "small.png")
    Image.fromarray(np.stack([grey, grey, grey + 9], axis=-1)).save(folder / "colour.png")
    return folder


COMMON = {"sun": "0,40", "light": None, "exposure": "0", "sky": "clear"}


def config_of(files: Path, **flags: str | None) -> InsertConfig:
    """The configuration of a small run."""
    return parse(arguments(files, files / "out", **{**COMMON, **flags})).config


@pytest.mark.slow
def test_run_with_place_and_mask(files: Path, tmp_path: Path) -> None:
    """The run names both by their hashes, and says what they are and do."""
    flags = {"proxy": str(files / "wall.glb"), "shadow_mask": str(files / "half.png")}
    run = go(arguments(files, tmp_path / "a", **COMMON, **flags), tmp_path / "a")
    assert set(run.record["inputs"]) >= {"proxy", "shadow_mask"}
    measured = run.record["measured"]
    assert measured["proxy_triangles"] == 12
    assert measured["shadow_mask_at_object"] == pytest.approx(128 / 255)
    (kept,) = [line for line in run.record["assumed"] if "--shadow-mask" in line]
    assert kept.startswith("50 % of the light of the sun and of far lamps")  # not of --lamp's
    assert not any("no lamp" in line for line in run.record["notices"])
    assert not any("material" in line and "wall" in line for line in run.record["notices"])


def test_picture_of_a_shaded_place(files: Path, device: str) -> None:
    """A wall and a white mask keep the sun from object and ground; a grey one a share of it."""

    def ratio_and_object(sun: float = 1.0, **flags: str | None) -> tuple[FloatArray, float]:
        inputs = read_inputs(config_of(files, **flags))
        # Of 16 bits: the layers of an 8-bit photo are halves.
        photo = replace(inputs.photo, codes=inputs.photo.codes.astype(np.uint16))
        light = Light(SUN, plain_sky((0.45, 0.62, 1.0), (0.2, 0.2, 0.2)))
        light = without_lamps(light, 1.0 - sun)
        picture = make_picture(
            Renderer(scene_of(inputs, inputs.camera, device, LINEAR)), light, light, photo,
            Quality(16, 1, 2, 3), LINEAR, shadow_mask=inputs.shadow_mask,
        )  # fmt: skip
        layers = picture.layers
        return layers.shadow_ratio, float(layers.foreground[..., :3].sum())

    plain, lit = ratio_and_object()
    black, same = ratio_and_object(shadow_mask=str(files / "black.png"))
    np.testing.assert_array_equal(black, plain)
    assert same == lit
    white, dim = ratio_and_object(shadow_mask=str(files / "white.png"))
    half, _ = ratio_and_object(shadow_mask=str(files / "half.png"))
    dimmed, _ = ratio_and_object(sun=127 / 255)
    walled, dark = ratio_and_object(proxy=str(files / "wall.glb"))
    # Of the ground that the sun reaches in the open, not of the object's sides.
    deep = plain[..., 0] < 0.5
    deep[:18] = False
    assert deep.sum() > 10
    # Each ratio counts as much as the open ground's light that it is of.
    sunny = Light(SUN, plain_sky((0.45, 0.62, 1.0), (0.2, 0.2, 0.2)))
    up, share = np.array([0.0, 1.0, 0.0]), 128 / 255
    kept = share * without_lamps(sunny).irradiance(up) / sunny.irradiance(up)
    share = kept / (1.0 - share + kept)
    np.testing.assert_allclose(half, plain + share * (white - plain), atol=1e-5)
    np.testing.assert_allclose(half[deep].mean(axis=0), dimmed[deep].mean(axis=0), atol=0.012)
    for ratio, light in ((white, dim), (walled, dark)):
        assert ratio[deep].mean() > plain[deep].mean() + 0.3 and light < 0.95 * lit


@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        ({"proxy": "none.glb"}, ExitCode.INPUT, ["none.glb"]),
        ({"proxy": "bad.glb"}, ExitCode.INPUT, ["bad.glb"]),
        ({"shadow_mask": "small.png"}, ExitCode.INPUT, ["40 x 30", "48 x 32"]),
        ({"shadow_mask": "colour.png"}, ExitCode.INPUT, ["colour.png", "three channels"]),
        ({"shadow_mask": "box.glb"}, ExitCode.INPUT, ["not an image"]),
        ({"no_plane": ""}, ExitCode.USAGE, ["--no-plane", "--proxy"]),
        ({"shadow_mask": "black.png", "light": None, "model": "any"}, ExitCode.USAGE, ["--reuse"]),
    ],
    ids=str,
)
def test_bad_places_and_masks(
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flags: dict[str, str | None],
    code: ExitCode,
    words: list[str],
) -> None:
    """One line that names file or flag, the right status, and nothing written."""
    paths = {k: str(files / v) if v and "." in v else v for k, v in flags.items()}
    assert main(arguments(files, tmp_path / "out", **paths)) == code
    error = capsys.readouterr().err
    assert error.count("error:") == 1 and all(word in error for word in words), error
    assert not (tmp_path / "out").exists()


def test_notices_of_a_place(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mesh out of view, and one that hides the object, are told."""
    argv = arguments(files, tmp_path / "o", proxy=str(files / "behind.ply"))
    assert main([*argv, "--validate"]) == ExitCode.DONE
    assert "in view" in capsys.readouterr().out
    argv = arguments(files, tmp_path / "o", proxy=str(files / "wall.glb"), place="0,0,-9")
    assert main([*argv, "--validate"]) == ExitCode.DONE
    assert "hides the object" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "lines"),
    [
        ({"proxy": "wall.glb"}, [NO_MESH_HANDED_OVER]),
        ({"occluder_mask": "half.png"}, [NO_MASK_HANDED_OVER]),
        ({"shadow_mask": "half.png", "no_hand_off": ""}, []),
    ],
    ids=str,
)
def test_what_files_for_other_tools_leave_out_is_told(
    files: Path, tmp_path: Path, flags: dict[str, str], lines: list[str]
) -> None:
    """The mesh of the place and the photo's masks."""
    out, paths = tmp_path / "o", {k: v and str(files / v) for k, v in flags.items()}
    run = go(arguments(files, out, samples="1", **paths), out)
    assert [n for n in run.record["notices"] if n.startswith("the files for")] == lines


def test_exposure_looks_at_ground_that_the_sun_reaches(files: Path) -> None:
    """Where the foot is in shadow, the photo's level is that of the light without the sun."""

    def exposure(**flags: str) -> float:
        config = config_of(files, exposure=None, place="0,0,-6.2", **flags)
        light = make_light(read_inputs(config), config.light, config.tone_operator)
        assert light is not None
        return light.exposure

    open_air = exposure()
    assert exposure(proxy=str(files / "behind.ply")) == pytest.approx(open_air, abs=0.5)
    for flags in ({"proxy": "wall.glb"}, {"shadow_mask": "white.png"}):
        assert exposure(**{k: str(files / v) for k, v in flags.items()}) > open_air + 1.0
    black = exposure(shadow_mask=str(files / "black.png"))
    assert black == open_air
