"""Ways to the focal length in `benchmarks.camera.witnesses`: each finds one that is known."""

import math

import pytest
import torch

from benchmarks.camera.witnesses import fitted, joined
from warpir.calibration.network import NUMBERS
from warpir.train.camera.crops import DrawnCameras


@pytest.mark.parametrize(
    ("pitch", "roll", "focal"), [(0.0, 0.0, 0.9), (-20.0, 10.0, 1.4), (15, -5, 0.6)]
)
def test_camera_is_fitted_to_its_elevations(pitch: float, roll: float, focal: float) -> None:
    up, turn = (torch.tensor([math.radians(angle)]) for angle in (pitch, roll))
    middle, none = torch.tensor([0.5]), torch.zeros(1)
    camera = DrawnCameras(
        up, turn, torch.tensor([focal]), middle, middle, torch.tensor([1.5]), none
    )
    found = fitted(camera.field()[0, :, 2], 1.5, 0.0)
    assert found == pytest.approx(math.log(focal), abs=0.01)


def test_histogram_of_a_part_tells_the_whole() -> None:
    bins = NUMBERS["focal"]
    whole = torch.zeros(1, bins.number)
    whole[0, 30] = 1.0
    centre = float(bins.centres(whole)[30])
    part = torch.zeros(1, bins.number)
    part[0, 40] = 1.0
    size = math.exp(-10 * (bins.high - bins.low) / bins.number)
    assert joined([(part, size)]) == pytest.approx(centre, abs=0.01)
    assert joined([(whole, 1.0), (part, size)]) == pytest.approx(centre, abs=0.01)
