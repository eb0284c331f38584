"""LPIPS: a learned distance of two pictures (Zhang et al. 2018, https://arxiv.org/abs/1801.03924).

AlexNet's features, version 0.1. The weights are not part of warpir: the file is what

    state = lpips.LPIPS(net="alex").state_dict()
    alone = {name: value for name, value in state.items() if not name.startswith("lins.")}
    safetensors.torch.save_file(alone, "lpips.safetensors")

writes on a machine that has the authors' package ``lpips`` and torchvision's AlexNet; ``lins`` are
the same weights by other names.
"""

from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from warpir.core.arrays import FloatArray
from warpir.core.errors import ExitCode, InputError

LAYERS = (
    ("net.slice1.0", 4, 2, False),
    ("net.slice2.3", 1, 2, True),
    ("net.slice3.6", 1, 1, True),
    ("net.slice4.8", 1, 1, False),
    ("net.slice5.10", 1, 1, False),
)
"""Name, stride, padding, and whether a 3 x 3 maximum of stride 2 comes first."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and scale of ImageNet's colours on [-1, 1]."""
SIDE_MIN = 64
"""Least side of a picture, by AlexNet's strides [px]."""


class Lpips:
    """LPIPS distance with weights from a file.

    Args:
        path: State dict of the authors' ``LPIPS(net="alex")``, a safetensors file.

    Raises:
        InputError: The file is absent, damaged or of another kind (`ExitCode.MODEL`).
    """

    def __init__(self, path: Path) -> None:
        about = "warpir/evaluate/lpips.py says how the file is made"
        if not path.is_file():
            raise InputError(path, "no such file", about, ExitCode.MODEL)
        try:
            state = load_file(path)
        except (SafetensorError, OSError) as error:
            what = f"not a whole safetensors file ({' '.join(str(error).split())[:120]})"
            raise InputError(path, what, about, ExitCode.MODEL) from error
        try:
            self.convolutions = [
                (state[f"{name}.weight"].float(), state[f"{name}.bias"].float())
                for name, *_ in LAYERS
            ]
            self.weights = [
                state[f"lin{k}.model.1.weight"].float().reshape(1, -1, 1, 1)
                for k in range(len(LAYERS))
            ]
            # One pass over a small picture: shapes that do not follow on each other fail in it.
            self(*np.zeros((2, SIDE_MIN, SIDE_MIN, 3), np.float32))
        except (KeyError, RuntimeError) as error:
            what = f"no weights of LPIPS with AlexNet ({type(error).__name__}: {error})"[:160]
            raise InputError(path, " ".join(what.split()), about, ExitCode.MODEL) from error
        parts = [*self.weights, *(part for pair in self.convolutions for part in pair)]
        if not all(bool(torch.isfinite(part).all()) for part in parts):
            raise InputError(path, "damaged (values are not finite)", about, ExitCode.MODEL)

    def __call__(self, image: FloatArray, truth: FloatArray) -> float:
        """Return the distance of two pictures in [0, 1], shape [H, W, 3], of 64 pixels or more."""
        if min(image.shape[:2]) < SIDE_MIN:
            raise ValueError(f"LPIPS needs {SIDE_MIN} pixels or more, found {image.shape[:2]}")
        with torch.no_grad():
            pair = [self._features(x) for x in (image, truth)]
            distance = torch.zeros(())
            for a, b, weight in zip(*pair, self.weights, strict=True):
                distance += ((a - b).square() * weight).sum(dim=1).mean()
        return float(distance)

    def _features(self, picture: FloatArray) -> list[Tensor]:
        """Return the five layers, each pixel's features of length 1."""
        x = torch.from_numpy(np.array(picture, np.float32)).permute(2, 0, 1)[None]
        x = (2.0 * x - 1.0 - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[
            :, None, None
        ]
        features = []
        for (_, stride, padding, is_pooled), (weight, bias) in zip(
            LAYERS, self.convolutions, strict=True
        ):
            x = max_pool2d(x, 3, 2) if is_pooled else x
            x = conv2d(x, weight, bias, stride, padding).relu()
            features.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return features
