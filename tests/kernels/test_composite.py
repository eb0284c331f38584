"""Shadow ratio, tone stages, composite and encoding: values and gradients (DiPIR, eqs. 5 and 6)."""

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import differentiate, upload
from tests import oracles as o
from tests.statistics import central_differences, compare_gradients
from warpir.kernels.composite import compose, tone_foreground, tone_shadow
from warpir.kernels.shadow_ratio import shadow_ratio

VALUE_ABS = 2e-6
"""float32 values in [0, 1] after a curve, a product and a power."""
GRADIENT_RELATIVE_L2 = 1e-3
"""float32 adjoint against central differences of the float64 oracle."""


def ints(values: np.ndarray, device: str) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)


def empty(count: int, device: str) -> wp.array:
    return wp.zeros(count, dtype=wp.vec3, device=device, requires_grad=True)


class Scene:
    """A 96-pixel photo: object with partial coverage, shaded plane, untouched background."""

    def __init__(
        self, rng: np.random.Generator, raw_scale: float = 0.7, is_reinhard: bool = True
    ) -> None:
        self.is_reinhard = is_reinhard
        self.photo = rng.uniform(0.05, 0.8, (96, 3)).astype(np.float32)
        object_pixels, receiver_pixels = np.arange(0, 40), np.arange(24, 80)
        self.object_index = np.full(96, -1)
        self.object_index[object_pixels] = rng.permutation(40)
        self.receiver_index = np.full(96, -1)
        self.receiver_index[receiver_pixels] = rng.permutation(56)
        self.mask = rng.uniform(0.05, 1.0, 40).astype(np.float32)
        self.mask[::3] = 1.0
        self.foreground = (rng.gamma(1.0, 1.0, (40, 3)) * self.mask[:, None]).astype(np.float32)
        self.unoccluded = rng.uniform(0.5, 3.0, (56, 3)).astype(np.float32)
        self.lit = (self.unoccluded * rng.uniform(0.05, 0.95, (56, 3))).astype(np.float32)
        raw = rng.normal(scale=raw_scale, size=(4, 16))
        self.knots_fg = tuple(k.astype(np.float32) for k in o.spline_knots(raw[:1]))
        self.knots_shadow = tuple(k.astype(np.float32) for k in o.spline_knots(raw[1:]))

    def oracle(
        self,
        foreground: np.ndarray,
        lit: np.ndarray,
        unoccluded: np.ndarray,
        knots_fg: tuple[np.ndarray, ...],
        knots_shadow: tuple[np.ndarray, ...],
    ) -> np.ndarray:
        """Return the encoded image from (M 5), (M 6) and the tone stages of method 2.4."""
        ratio = lit / unoccluded
        ratio = np.stack(
            [o.spline(ratio[:, c], *(k[c] for k in knots_shadow))[0] for c in range(3)], -1
        )
        radiance = foreground / self.mask[:, None]
        shown = o.reinhard(radiance) if self.is_reinhard else radiance
        tone = o.spline(shown, *(k[0] for k in knots_fg))[0]
        on_object, on_proxy = self.object_index >= 0, self.receiver_index >= 0
        mask, ratio_image, tone_image = np.zeros(96), np.ones((96, 3)), np.zeros((96, 3))
        mask[on_object] = self.mask[self.object_index[on_object]]
        tone_image[on_object] = tone[self.object_index[on_object]]
        ratio_image[on_proxy] = ratio[self.receiver_index[on_proxy]]
        return o.encode(o.composite(self.photo, mask, tone_image, ratio_image))

    def free(self) -> list[np.ndarray]:
        return [self.foreground, self.lit, self.unoccluded, *self.knots_fg, *self.knots_shadow]

    def launch(self, device: str) -> tuple[list[wp.array], wp.array, wp.Tape]:
        """Run the four kernels; return the free arrays, the image and the tape."""
        free = [upload(a, wp.vec3, device, True) for a in self.free()[:3]]
        free += [upload(a, float, device, True) for a in self.free()[3:]]
        foreground, lit, unoccluded = free[:3]
        mask = upload(self.mask, float, device)
        ratio, ratio_display = empty(56, device), empty(56, device)
        display, image = empty(40, device), empty(96, device)
        with wp.Tape() as tape:
            wp.launch(shadow_ratio, 56, inputs=[lit, unoccluded], outputs=[ratio], device=device)
            inputs = [ratio, *free[6:], 5]
            wp.launch(tone_shadow, 56, inputs=inputs, outputs=[ratio_display], device=device)
            inputs = [foreground, mask, int(self.is_reinhard), *free[3:6], 5]
            wp.launch(tone_foreground, 40, inputs=inputs, outputs=[display], device=device)
            index = [ints(self.object_index, device), ints(self.receiver_index, device)]
            photo = upload(self.photo, wp.vec3, device)
            inputs = [photo, *index, mask, display, ratio_display]
            wp.launch(compose, 96, inputs=inputs, outputs=[image], device=device)
        return free, image, tape


@pytest.mark.parametrize("is_reinhard", [True, False])
def test_composite_matches_oracle(device: str, rng: np.random.Generator, is_reinhard: bool) -> None:
    """Ratio, curves, composite and encoding together equal the equations."""
    scene = Scene(rng, is_reinhard=is_reinhard)
    _, image, _ = scene.launch(device)
    expected = scene.oracle(
        scene.foreground, scene.lit, scene.unoccluded, scene.knots_fg, scene.knots_shadow
    )
    np.testing.assert_allclose(image.numpy(), expected, atol=VALUE_ABS)


@pytest.mark.parametrize("is_reinhard", [True, False])
def test_composite_gradient(device: str, rng: np.random.Generator, is_reinhard: bool) -> None:
    """Adjoints of radiance, both sums and all knots against central differences of the oracle."""
    scene = Scene(rng, is_reinhard=is_reinhard)
    scene.foreground *= 1.0 if is_reinhard else 0.1  # below the clamp at 1
    free, image, tape = scene.launch(device)
    y = rng.normal(size=(96, 3)).astype(np.float32)
    tape.backward(grads={image: upload(y, wp.vec3, device)})
    values = [a.astype(np.float64) for a in scene.free()]

    def loss(k: int, x: np.ndarray) -> float:
        moved = [x if i == k else v for i, v in enumerate(values)]
        return float(np.sum(y * scene.oracle(*moved[:3], tuple(moved[3:6]), tuple(moved[6:]))))

    names = "foreground lit unoccluded x_fg y_fg slope_fg x_sh y_sh slope_sh"
    for k, name in enumerate(names.split()):
        reference = central_differences(lambda x, k=k: loss(k, x), values[k], 1e-6)
        gradient = free[k].grad.numpy().astype(np.float64)
        if name.startswith("x_"):
            # The outermost x knots are the ends of the interval, never free.
            gradient, reference = gradient[:, 1:-1], reference[:, 1:-1]
        match = compare_gradients(gradient, reference)
        assert match.relative_l2 < GRADIENT_RELATIVE_L2, (name, match)


def test_copies_of_the_curves_count_together(device: str, rng: np.random.Generator) -> None:
    """Threads take turns with equal copies: same image, and their gradients sum up to the same."""
    scene = Scene(rng)
    y = upload(rng.normal(size=(96, 3)), wp.vec3, device)
    alone, image, tape = scene.launch(device)
    tape.backward(grads={image: y})
    scene.knots_fg = tuple(np.tile(k, (4, 1)) for k in scene.knots_fg)
    scene.knots_shadow = tuple(np.tile(k, (4, 1)) for k in scene.knots_shadow)
    free, again, tape = scene.launch(device)
    tape.backward(grads={again: y})
    assert (again.numpy() == image.numpy()).all()
    for one, several in zip(alone, free, strict=True):
        expected, found = one.grad.numpy(), several.grad.numpy()
        summed = found.reshape(-1, *expected.shape).sum(axis=0)
        np.testing.assert_allclose(summed, expected, rtol=1e-4, atol=1e-5)


def test_ratio_of_one_leaves_the_photo_alone(device: str, rng: np.random.Generator) -> None:
    """``lit = unoccluded`` gives bit for bit the pixel of a photo without plane, for any curve."""
    scene = Scene(rng, raw_scale=2.0)
    scene.lit = scene.unoccluded.copy()
    with_plane = scene.launch(device)[1].numpy()
    scene.receiver_index[:] = -1
    assert np.array_equal(with_plane, scene.launch(device)[1].numpy())


def test_full_coverage_hides_the_photo(device: str, rng: np.random.Generator) -> None:
    """Where the object covers a pixel, photo and shadow have no influence (M 6)."""
    scene = Scene(rng)
    covered = np.isin(scene.object_index, np.flatnonzero(scene.mask == 1.0))
    first = scene.launch(device)[1].numpy()
    scene.photo = 1.0 - scene.photo
    scene.lit = 0.5 * scene.lit
    assert np.array_equal(first[covered], scene.launch(device)[1].numpy()[covered])


def test_shadow_ratio_of_special_values(device: str) -> None:
    """No occluder: exactly 1; full occluder: 0; a plane without light: 1, and no NaN gradient."""
    lit = np.array(
        [[1.0, 0.3, 7e4], [0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [1e-30, 0.0, 1e30]], np.float32
    )
    unoccluded = np.array(
        [[1.0, 0.3, 7e4], [1.0, 2.0, 1e9], [0.0, 0.0, 1.0], [1e-30, 0.0, 1e30]], np.float32
    )
    expected = [[1, 1, 1], [0, 0, 0], [1, 1, 0.5], [1, 1, 1]]
    inputs = [upload(x, wp.vec3, device, True) for x in (lit, unoccluded)]
    (ratio,), (d_lit, d_unoccluded) = differentiate(
        shadow_ratio, inputs, np.ones((4, 3)), wp.vec3, device=device
    )
    assert np.array_equal(ratio, expected)
    assert np.all(np.isfinite(d_lit)) and np.all(np.isfinite(d_unoccluded[:3]))
    assert d_lit[2, 2] == 1.0 and d_unoccluded[2, 2] == -0.5
    assert np.all(d_lit[2, :2] == 0.0) and np.all(d_unoccluded[2, :2] == 0.0)


def photo_only(photo: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Encode a photo by the composite kernel without object or plane; its gradient beside it."""
    none = ints(np.full(len(photo), -1), device)
    dummy = upload(np.zeros(1), float, device), *[upload(np.zeros((1, 3)), wp.vec3, device)] * 2
    inputs = [upload(photo, wp.vec3, device, True), none, none, *dummy]
    (image,), (gradient,) = differentiate(
        compose, inputs, np.ones(photo.shape), wp.vec3, device=device
    )
    return image, gradient


def test_encode_every_8_bit_code(device: str) -> None:
    """Decoding and encoding returns each of 256 codes exactly after rounding (``x^2.2``)."""
    code = np.arange(256)
    linear = np.repeat(((code / 255.0) ** 2.2)[:, None], 3, axis=1)
    image = photo_only(linear, device)[0]
    assert np.array_equal(np.round(255.0 * image[:, 0]).astype(int), code)
    assert np.abs(image[:, 0] - code / 255.0).max() < 1e-6


def test_encode_is_finite_and_monotone(device: str) -> None:
    """Black and negative give 0, more than 1 gives 1, slopes stay finite, below half a code too."""
    x = np.concatenate([[-1.0, -1e-9, 0.0], np.geomspace(1e-30, 10.0, 2000)])
    image, gradient = photo_only(np.repeat(x[:, None], 3, axis=1), device)
    y, gradient = image[:, 0], gradient[:, 0]
    assert np.all(y[:3] == 0.0) and y[-1] == 1.0
    assert np.diff(y).min() >= -1e-7
    assert np.all(np.isfinite(gradient)) and np.all(gradient >= 0.0)
