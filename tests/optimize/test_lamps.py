"""Powers of lamps near the object as unknowns of the loop: gradient, bounds, recovery, files."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.builders.loops import SETTINGS, TRACED, Pull, a_frame, bent, values
from tests.statistics import central_differences, compare_gradients
from warpir.app.config import InsertConfig
from warpir.app.settings import OptimizeSettings
from warpir.core.arrays import Float64Array
from warpir.core.errors import InputError
from warpir.io.lamps_file import lamps_of, lamps_to_json
from warpir.lighting.sg_light import LightBounds, narrowest
from warpir.optimize.light import LampPowers, LightOptimization, Unknowns
from warpir.optimize.view import Frame
from warpir.render.near.rows import with_lamps
from warpir.scene.camera import Camera
from warpir.scene.near.lamps import SphereLamp

LAMPS = (
    SphereLamp(np.array([-0.8, 1.4, -3.0]), 0.1, np.array([20.0, 16.0, 12.0])),
    SphereLamp(np.array([0.9, 1.0, -2.8]), 0.05, np.array([3.0, 6.0, 9.0])),
)
BOUNDS = LightBounds(narrowest(12), chroma=1.0, intensity=100.0)
LIT = replace(SETTINGS, recover_lamps=True)


def lit_frame(device: str) -> Frame:
    frame = a_frame(device)
    return replace(frame, renderer=with_lamps(frame.renderer, LAMPS))


def lit_loop(device: str, settings: OptimizeSettings) -> LightOptimization:
    unknowns = bent()
    unknowns.lamps = LampPowers(LAMPS, BOUNDS)
    rows = TRACED if settings.integrator == "transport" else None
    return LightOptimization(lit_frame(device), Pull(), settings, unknowns, transport=rows)


def test_lamps_gradient_against_central_differences(device: str) -> None:
    """Of factors and colours, from raw parameters to the image."""
    loop = lit_loop(device, replace(LIT, steps=3, consistency=0.0, chroma=0.0))
    lamps = loop.unknowns.lamps
    assert lamps is not None and isinstance(loop.guide, Pull)
    with torch.no_grad():
        lamps.chroma.copy_(torch.tensor([[0.3, -0.1, 0.0], [0.0, 0.4, -0.2]]))
    loop.differentiate(1)
    pull = loop.guide.d_image.double()

    for parameter in (lamps.log_factor, lamps.chroma):
        start = parameter.detach().double().cpu().numpy()

        def objective(values: Float64Array, parameter: Tensor = parameter) -> float:
            with torch.no_grad():
                parameter.copy_(torch.from_numpy(values))
                return float((pull * loop.composite(1).image.cpu().double()).sum())

        assert parameter.grad is not None
        read = parameter.grad.double().cpu().numpy()
        match = compare_gradients(read, central_differences(objective, start, 1e-2))
        objective(start)
        assert match.relative_l2 < 0.01, match


class Target(Pull):
    """Half the squared distance to an image: the guide whose answer is known."""

    def gradient(self, image: Tensor, step: int) -> Tensor:
        return image - self.d_image


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["transport", "mis"])
def test_powers_of_lamps_are_found(integrator: str, device: str) -> None:
    """One lamp is twice, one half as bright as said; all else is known and free to move."""
    still = {f"rate_{name}": 0.0 for name in ("axis", "width", "tone", "chroma")}
    settings = replace(LIT, steps=60, integrator=integrator, mis_samples=16, **still)
    settings = replace(settings, consistency=0.0, spread=0.0, chroma=0.0, bend=0.0)
    loop = lit_loop(device, settings)
    lamps = loop.unknowns.lamps
    assert lamps is not None
    truth = torch.tensor([2.0, 0.5]).log()
    with torch.no_grad():
        lamps.log_factor.copy_(truth)
        loop.guide = Target(loop.final_image(1))
        lamps.log_factor.zero_()
        for light in (loop.unknowns.light_fg, loop.unknowns.light_shadow):
            light.log_intensity.add_(0.05)
    loop.run()
    torch.testing.assert_close(lamps.log_factor.detach().cpu(), truth, rtol=0.0, atol=0.05)
    for given, found in zip(LAMPS, lamps.found(), strict=True):
        assert isinstance(found, SphereLamp) and found.radius == given.radius
    written = lamps_to_json(lamps.found())["lamps"]
    powers = ", ".join(f"{lamp['power']:.3g}" for lamp in written)
    assert loop.describe(Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))).endswith(f"power {powers}")
    again = lamps_of(__file__, written)  # type: ignore[arg-type]
    for one, other in zip(again, lamps.found(), strict=True):
        np.testing.assert_allclose(one.power, other.power, rtol=1e-12)


def test_lamps_stay_within_bounds_and_in_the_checkpoint(device: str) -> None:
    loop = lit_loop(device, replace(LIT, steps=2))
    lamps = loop.unknowns.lamps
    assert lamps is not None
    with torch.no_grad():
        lamps.log_factor.copy_(torch.tensor([99.0, -99.0]))
        lamps.chroma.mul_(0.0).add_(torch.tensor([99.0, 0.0, 0.0]))
    loop.project()
    powers = np.stack([lamp.power for lamp in lamps.found()])
    ratio = powers / np.stack([lamp.power for lamp in LAMPS])
    mean = np.exp(np.log(ratio).mean(axis=1))
    np.testing.assert_allclose(mean, [100.0, 0.01], rtol=1e-4)
    assert np.abs(np.log(ratio / mean[:, None])).max() < 1.0 + 1e-4
    names = {name for name in values(loop) if name.startswith("lamps")}
    assert names == {"lamps.log_factor", "lamps.chroma"}
    known = Unknowns.start(None, 0.5, SETTINGS, LAMPS)
    assert known.lamps is None and known.lamp_powers() is None


@pytest.mark.parametrize(
    "changes",
    [
        {"lamp": None},
        {"model": None, "prompt": None},
        {"refine": "tone", "sky": "clear"},
    ],
    ids=["no lamp", "no model", "refined"],
)
def test_recovering_lamps_needs_lamps_and_a_model(changes: dict[str, Any]) -> None:
    given = {"photo": "p.png", "asset": "a.glb", "out": "o", "model": "m", "prompt": "a car"}
    given |= {"lamp": (0.0, 1.0, -2.0, 0.1, 5.0), "recover_lamps": True}
    InsertConfig(**given)
    with pytest.raises(InputError, match="--recover-lamps: needs --lamp"):
        InsertConfig(**{**given, **changes})
