"""How well does one photo tell its camera's contrast?

    python -m benchmarks.response --panoramas DIR [--fit]

Photographs are crops of panoramas through the cameras that the regressor trains with
(`warpir.train.photo_look`): exposure, white balance, contrast, shoulder, gamma 2.2 or sRGB, and
faults. Places are halved by the checksum of their names; ``--fit`` prints the coefficients of
`warpir.look.response` that one half gives, and the other half is judged: mean distance of the
curves in codes of 255, at radiances from blacks to half of white.
"""

import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.measure import flags
from benchmarks.scenes import is_for_fitting, panoramas_of
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import GAMMA, expose
from warpir.evaluate.scenes import CAMERA_HEIGHT, crop_camera, crop_radiance
from warpir.io.images.photos import read_envmap
from warpir.look.response import PLACED, Response, estimate_response, statistics
from warpir.train.photo_look import Look, draw_faults, draw_looks

WIDTH, HEIGHT = 320, 216
CROPS, CAMERAS = 6, 4
"""Crops of a place, and cameras of a crop."""
LEVELS = np.array([0.003, 0.01, 0.03, 0.1, 0.5])
"""Radiances at which curves are compared, mid grey at .18 [1]."""
RAMP = np.geomspace(0.002, 0.6, 24)
"""Radiances at which the best curve is fitted to a camera [1]."""
EXPONENTS, TOES = np.linspace(0.75, 1.6, 35), (0.0, 0.001, 0.002, 0.004, 0.006, 0.009, 0.013)
"""Of the best curve."""
RIDGE = 10.0
"""Weight of a coefficient's square, of standardised statistics."""


def crops(path: Path) -> Iterator[FloatArray]:
    """Yield radiance that cameras see of a panorama, exposed, [H, W, 3]."""
    texels = read_envmap(path)
    rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
    for _ in range(CROPS):
        fov, azimuth, pitch = rng.uniform((45, 0, -18), (80, 360, 8))
        camera = crop_camera(WIDTH, HEIGHT, fov, azimuth, pitch, CAMERA_HEIGHT)
        seen = crop_radiance(texels, camera)
        if seen.any():
            yield (seen * 2.0 ** expose(seen)[1]).astype(np.float32)


def codes_of(look: Look, radiance: Float64Array) -> Float64Array:
    """Return what one camera shows as grey, without its exposure, in codes of 255."""
    plain = replace(look, gain=torch.ones_like(look.gain))
    grey = torch.from_numpy(radiance.astype(np.float32)).expand(1, 3, 1, -1)
    return 255.0 * plain.show(grey)[0, 0, 0].numpy().astype(np.float64)


def curve(response: Response, radiance: Float64Array) -> Float64Array:
    """Return what a response shows, in codes of 255."""
    shown = response.colour(radiance)
    return 255.0 * shown.astype(np.float64) ** (1.0 / GAMMA)


def judge(found: list[Response], truth: Float64Array) -> str:
    """Return mean distances of some curves from the true ones, in words."""
    errors = np.abs(np.stack([curve(c, LEVELS) for c in found]) - truth)
    within = float((errors[:, 0] < 3.0).mean())
    return "  ".join(f"{e:5.2f}" for e in errors.mean(axis=0)) + f"   {within:.2f}"


def main() -> None:
    """Print the fit and a table."""
    parser = flags(__doc__, "panoramas")
    parser.add_argument("--fit", action="store_true", help="print new coefficients")
    options = parser.parse_args()
    generator = torch.Generator().manual_seed(5)
    curves = [Response(e, t) for e in EXPONENTS.tolist() for t in TOES]
    table = np.stack([curve(c, RAMP) for c in curves])
    placed = np.array(PLACED)
    rows, best, shown, own, fits, wanted = [], [], [], [], [], []
    for path in panoramas_of(options):
        for radiance in crops(path):
            seen = torch.from_numpy(radiance).permute(2, 0, 1)[None]
            for _ in range(CAMERAS):
                look = draw_looks(seen, generator)
                photo = draw_faults(look.show(seen), generator)[0].permute(1, 2, 0).numpy()
                linear = (np.round(255.0 * photo) / 255.0) ** GAMMA
                distance = np.abs(table - codes_of(look, RAMP)).mean(axis=1)
                rows.append(statistics(linear))
                best.append(curves[distance.argmin()])
                shown.append(codes_of(look, LEVELS))
                wanted.append(codes_of(look, placed) / 255.0)
                own.append(estimate_response(linear))
                fits.append(is_for_fitting(path.stem))
    values, truth, is_fit, targets = map(np.array, (rows, shown, fits, wanted))
    if options.fit:
        mean, spread = values[is_fit].mean(axis=0), values[is_fit].std(axis=0)
        design = (values[is_fit] - mean) / spread
        gram = design.T @ design + RIDGE * np.eye(len(mean))
        centred = targets[is_fit] - targets[is_fit].mean(axis=0)
        factors = (np.linalg.solve(gram, design.T @ centred) / spread[:, None]).T
        constants = targets[is_fit].mean(axis=0) - factors @ mean
        table = np.concatenate([constants[:, None], factors], axis=1)
        print("COEFFICIENTS =", tuple(tuple(row) for row in table.round(4).tolist()))
    judged = np.flatnonzero(~is_fit)
    told = [k for k in judged if own[k] is not None]
    plain = Response(1.0)
    off, auto = [plain] * len(own), [r or plain for r in own]
    print(f"{len(judged)} photos of places not fitted, {len(told)} of them with blacks")
    levels = "  ".join(f"{x:5g}" for x in LEVELS)
    print(f"codes at           {levels}   within 3 in the blacks")
    for name, guess in (("off", off), ("auto", auto), ("best curve", best)):
        print(f"{name:18s} {judge([guess[k] for k in judged], truth[judged])}")
    for name, guess in (("off, with blacks", off), ("auto, with blacks", auto)):
        print(f"{name:18s} {judge([guess[k] for k in told], truth[told])}")


if __name__ == "__main__":
    main()
