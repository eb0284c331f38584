"""What a hard case is: a measurement against float64, its bound, and Mitsuba's error on it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from tests.builders.shapes import DEEP, constant, ground
from warpir.core.arrays import Float64Array
from warpir.kernels.types import LightArgs
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Scene
from warpir.render.renderer import Renderer
from warpir.scene.camera import Camera
from warpir.scene.light import Light
from warpir.scene.near.lamps import Lamp

MAX_RELATIVE = "max relative"
MAX_ABSOLUTE = "max absolute"
RELATIVE = "relative"
SHARE = "share"


@dataclass(frozen=True)
class Measured:
    """What one run of a case gave."""

    error: float
    """Against float64, in the case's measure."""
    is_finite: bool
    """Whether every value and gradient was a finite number."""
    gradient_error: float | None = None
    """``|g - r| / |r|`` against central differences in float64, where the case has gradients."""


@dataclass(frozen=True)
class Case:
    """One row of the table; `run` measures it."""

    group: str
    name: str
    """What is hard about it."""
    quantity: str
    """What is computed."""
    measure: str
    """How `Measured.error` is formed."""
    run: Callable[[str], Measured]
    """Takes the Warp device."""
    bound: float
    """What the error may be; the constants of each module say why."""
    gradient_bound: float | None = None
    mitsuba: Callable[[], float] | str = ""
    """Mitsuba's error in the same measure, or why it cannot run the case."""
    is_slow: bool = False
    """Whether it takes up to a minute, not a few seconds at most."""

    @property
    def id(self) -> str:
        """Name for test reports."""
        return f"{self.group}-{self.name}-{self.quantity}".replace(" ", "_")


class Quantity(NamedTuple):
    """What is measured on each input of a `table`; its functions take the input's values."""

    name: str
    measure: str
    run: Callable[..., Measured]
    """Takes the Warp device, then the input's values."""
    bound: float | Callable[..., float]
    mitsuba: Callable[..., float] | str
    gradient_bound: float | None = None


def table(
    group: str, inputs: Mapping[str, tuple[Any, ...]], *quantities: Quantity, is_slow: bool = False
) -> list[Case]:
    """Return a case for each quantity on each input, whose name stands beside its values."""
    return [
        Case(
            group,
            name,
            quantity.name,
            quantity.measure,
            lambda device, quantity=quantity, values=values: quantity.run(device, *values),
            quantity.bound(*values) if callable(quantity.bound) else quantity.bound,
            quantity.gradient_bound,
            partial(quantity.mitsuba, *values) if callable(quantity.mitsuba) else quantity.mitsuba,
            is_slow,
        )
        for name, values in inputs.items()
        for quantity in quantities
    ]


def lit(
    device: str,
    objects: Sequence[Placed],
    view: Camera,
    light: Light | None = None,
    *,
    height: float = DEEP,
    lamps: Sequence[Lamp] = (),
) -> tuple[Renderer, LightArgs]:
    """Return objects over the ground ``y = height``, and a light for them; the constant one."""
    renderer = Renderer(Scene(objects, view, ground(height), device, lamps))
    return renderer, light_args(light or constant(), renderer.device)


def upload(values: ArrayLike, dtype: Any, device: str, grad: bool = False) -> wp.array:
    """Return a float32 Warp array of ``values``."""
    plain = np.ascontiguousarray(values, np.float32)
    return wp.array(plain, dtype=dtype, device=device, requires_grad=grad)


def download(array: wp.array) -> Float64Array:
    """Return a Warp array's values in float64."""
    return np.asarray(array.numpy(), np.float64)


def launch(
    kernel: wp.Kernel, count: int, inputs: list[Any], *dtypes: Any, device: str
) -> list[Float64Array]:
    """Run a kernel of ``count`` threads; return an output of ``count`` values for each type."""
    outputs = [wp.zeros(count, dtype=dtype, device=device) for dtype in dtypes]
    wp.launch(kernel, count, inputs=inputs, outputs=outputs, device=device)
    return [download(output) for output in outputs]


def differentiate(
    kernel: wp.Kernel, inputs: list[Any], y: ArrayLike, dtype: Any, *others: Any, device: str
) -> tuple[list[Float64Array], list[Float64Array]]:
    """Run a kernel forward and backward, whose thread i writes element i of every output.

    ``y`` weighs the elements of the first output, of type ``dtype``, in the loss; the other outputs
    are not differentiated.

    Returns:
        The outputs, and the gradients of the input arrays that have ``requires_grad``.
    """
    weights = upload(y, dtype, device)
    count = len(weights)
    outputs = [wp.zeros(count, dtype=dtype, device=device, requires_grad=True)]
    outputs += [wp.zeros(count, dtype=other, device=device) for other in others]
    with wp.Tape() as tape:
        wp.launch(kernel, count, inputs=inputs, outputs=outputs, device=device)
    tape.backward(grads={outputs[0]: weights})
    free = [a for a in inputs if isinstance(a, wp.array) and a.requires_grad]
    return [download(output) for output in outputs], [download(a.grad) for a in free]


def to_mitsuba(vectors: ArrayLike) -> Any:
    """Return Mitsuba's vectors of an array [n, 3]."""
    import mitsuba as mi

    return mi.Vector3f(np.ascontiguousarray(np.transpose(vectors), np.float32))


def from_mitsuba(vectors: Any) -> Float64Array:
    """Return Mitsuba's vectors as an array [n, 3]."""
    return np.array(vectors).T.astype(np.float64)


def finite(*values: ArrayLike) -> bool:
    """Say whether all numbers are finite."""
    return all(bool(np.all(np.isfinite(np.asarray(v, np.float64)))) for v in values)


def max_relative(found: ArrayLike, truth: ArrayLike, floor: float = 0.0) -> float:
    """Return the largest ``|found - truth| / max(|truth|, floor)``; 0 / 0 counts as 0."""
    found, truth = np.asarray(found, np.float64), np.asarray(truth, np.float64)
    scale = np.maximum(np.abs(truth), floor)
    difference = np.abs(found - truth)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(difference == 0.0, 0.0, difference / scale)
    return float(np.max(ratio, initial=0.0))


def relative_l2(found: ArrayLike, truth: ArrayLike) -> float:
    """Return ``|found - truth| / |truth|`` of flat vectors."""
    f, t = np.ravel(np.asarray(found, np.float64)), np.ravel(np.asarray(truth, np.float64))
    size = float(np.linalg.norm(t))
    difference = float(np.linalg.norm(f - t))
    if size == 0.0:
        return 0.0 if difference == 0.0 else float("inf")
    return difference / size


def worst_l2(found: list[Float64Array], truth: list[Float64Array]) -> float:
    """Return the largest `relative_l2` over several parameters; NaN stays NaN."""
    return float(np.max([relative_l2(f, t) for f, t in zip(found, truth, strict=True)]))
