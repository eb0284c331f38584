"""The photo's share in what an object reflects: where it comes from, and what it leaves alone."""

from dataclasses import replace

import numpy as np
import pytest

from tests.builders.shapes import view_rays
from warpir.core.latlong import map_directions
from warpir.evaluate.scenes import crop_camera, crop_radiance
from warpir.lighting.detail import HEIGHT, seen_from, with_detail
from warpir.scene.camera import camera_from_fov
from warpir.scene.light import Light, sun_lobe
from warpir.scene.tone_curves import Curves, ToneKnots

GROUND = np.array([0.0, 1.0, 0.0, 0.0])


def smooth_map(height: int = 64) -> np.ndarray:
    """Return a map whose colours say where they are."""
    return (1.2 + map_directions(height, 2 * height)).astype(np.float32) / 4.0


def test_far_directions_are_those_of_the_panorama() -> None:
    """A crop put back into the sphere is the panorama, above the horizon, whatever the camera."""
    texels = smooth_map()
    camera = crop_camera(200, 140, 70.0, 130.0, 12.0, 1.6)
    detail = seen_from(
        np.array([3.0, 0.5, 2.0]), crop_radiance(texels, camera).astype(np.float32), camera, GROUND
    )
    directions = map_directions(HEIGHT, 2 * HEIGHT)
    seen = (detail.weight > 0.5) & (directions[..., 1] > 0.02)
    expected = (1.2 + directions) / 4.0
    assert seen.sum() > 10_000
    np.testing.assert_allclose(detail.radiance[seen], expected[seen], atol=0.004)


def test_photo_that_was_made_smaller_is_not_made_smaller_again() -> None:
    """The camera is that of the photo as it was taken; what is sharp in the copy stays sharp."""
    camera = camera_from_fov(512, 340, 60.0, 10.0, 1.6)
    u = np.arange(512) + 0.5
    stripes = np.broadcast_to(0.5 + 0.4 * np.sin(2.0 * np.pi * u / 16.0), (340, 512))
    photo = np.repeat(stripes[..., None], 3, axis=2).astype(np.float32)
    point = np.array([0.0, 0.5, -5.0])
    small = seen_from(point, photo, camera, GROUND)
    large = seen_from(point, photo, camera.scaled(4096, 2720), GROUND)
    assert np.ptp(small.radiance[small.weight > 0.99]) > 0.6
    np.testing.assert_allclose(large.radiance, small.radiance, atol=1e-3)


def test_the_ground_is_seen_where_it_lies() -> None:
    """A chequered plane, painted into the photo, is seen from the object as the same plane."""
    camera = camera_from_fov(640, 480, 60.0, -20.0, 1.6)
    rays = view_rays(camera).reshape(480, 640, 3)
    t = np.where(rays[..., 1] < -1e-3, 1.6 / np.maximum(-rays[..., 1], 1e-3), 0.0)
    point = camera.c2w[:3, 3] + t[..., None] * rays
    photo = np.where(t[..., None] > 0.0, 0.5 + 0.4 * np.sin(2.0 * point), 0.0).astype(np.float32)
    viewpoint = np.array([0.3, 0.5, -4.0])
    detail = seen_from(viewpoint, photo, camera, GROUND)
    directions = map_directions(HEIGHT, 2 * HEIGHT)
    steep = (detail.weight > 0.99) & (directions[..., 1] < -0.3)
    hit = viewpoint + (0.5 / -directions[..., 1][steep])[:, None] * directions[steep]
    assert steep.sum() > 5_000
    np.testing.assert_allclose(detail.radiance[steep], 0.5 + 0.4 * np.sin(2.0 * hit), atol=0.03)


def test_unseen_directions_and_lamps_stay() -> None:
    """Behind the camera nothing changes, and a sun inside the photo keeps its flux."""
    camera = camera_from_fov(120, 80, 60.0, 20.0, 1.6)
    photo = np.full((80, 120, 3), 0.25, np.float32)
    detail = seen_from(np.array([0.0, 0.5, -5.0]), photo, camera, GROUND)
    sky = Light(texels=np.full((16, 32, 3), 0.5, np.float32))
    result = with_detail(sky, detail).texels
    assert result is not None
    unseen = detail.weight == 0.0
    np.testing.assert_array_equal(result[unseen], 0.5)
    np.testing.assert_allclose(result[detail.weight == 1.0], 0.25, rtol=1e-6)
    assert 0.02 < detail.seen < 0.5
    sun = replace(sky, lobes=sun_lobe(0.0, 30.0, (3.0, 3.0, 3.0)))
    normal = np.array([0.0, 0.6, -0.8])
    gained = with_detail(sun, detail).irradiance(normal) - with_detail(sky, detail).irradiance(
        normal
    )
    np.testing.assert_allclose(gained, 3.0 * (0.6 * 0.5 + 0.8 * np.sqrt(0.75)), rtol=0.01)


@pytest.mark.parametrize("tone", ["linear", "reinhard"])
def test_curves_are_inverted(tone: str) -> None:
    """Radiance that a bent curve shows comes back; what is clipped is at least so bright."""
    knots = ToneKnots(
        np.array([[0.0, 0.3, 0.7, 1.0]], np.float32),
        np.array([[0.0, 0.5, 0.8, 1.0]], np.float32),
        np.array([[2.0, 1.0, 0.6, 0.3]], np.float32),
    )
    curves = replace(Curves.identity(tone), foreground=knots)
    at_knots = curves.radiance(np.array([0.0, 0.5, 0.8]))
    expected = np.array([0.0, 0.3, 0.7])
    if tone == "reinhard":
        expected = expected / (1.0 - expected)
    np.testing.assert_allclose(at_knots, expected, atol=1e-6)
    y = np.linspace(0.0, 0.98, 500)
    x = knots.invert(y)
    assert (np.diff(x) > 0.0).all()
    # The spline at its own inverse (Durkan et al. 2019, eq. 4).
    k = np.clip(np.searchsorted(knots.x[0], x, side="right") - 1, 0, 2)
    x0, y0 = knots.x[0][k], knots.y[0][k]
    w, h = np.diff(knots.x[0])[k], np.diff(knots.y[0])[k]
    q, m = (x - x0) / w, h / w
    d0, d1 = knots.slope[0][k], knots.slope[0][k + 1]
    r = q * (1 - q)
    again = y0 + h * (m * q * q + d0 * r) / (m + (d0 + d1 - 2 * m) * r)
    np.testing.assert_allclose(again, y, atol=1e-6)
    top = curves.radiance(np.array([1.0]))
    assert top == pytest.approx(0.97 / 0.03 if tone == "reinhard" else 1.0)
    plate = curves.radiance(np.array([4.0]))
    assert plate == pytest.approx(0.97 / 0.03 if tone == "reinhard" else 4.0)
