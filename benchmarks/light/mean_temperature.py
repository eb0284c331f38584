r"""Calibrate the direction of the mean of several networks on places that none has learned from.

    python -m benchmarks.light.mean_temperature HELD_OUT --asset FILE [--scenes 90] [--seed 31] \
        [--write FILE]

Each network is calibrated alone, but the mean of their logits is flatter than each of them, so its
68 % region is too wide. One temperature of the mean corrects that. The command prints the region's
coverage at every place by a temperature of the other places (what a new place may expect), then the
one of all places, which ``--write`` puts into the weights.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import torch
from torch import Tensor

from warpir.evaluate.scenes import PANORAMA_SUFFIXES, Places, find_files
from warpir.evaluate.stage import unseen_by
from warpir.lighting.regression import regress, yaw_to_world
from warpir.scene.light import Light, axis_from_angles, summarize
from warpir.train.networks.regressor import read_regressor, save_regressor
from warpir.train.validation import COVERAGE, calibrated_temperature, region_mass


def main() -> None:
    """Print the coverage of each place, and write the temperature where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("panoramas", type=Path, nargs="+", help="held out of every training")
    parser.add_argument("--asset", type=Path, required=True, help="any object; it is not rendered")
    parser.add_argument("--scenes", type=int, default=90, help="photographs (default: 90)")
    parser.add_argument("--seed", type=int, default=31, help="seed (default: 31)")
    parser.add_argument("--write", type=Path, help="the weights file to change")
    options = parser.parse_args()
    trained = read_regressor(options.write)
    trained.temperature.fill_(1.0)
    network = trained.regressor()
    directions = trained.directions.double()
    logits, axes = defaultdict[str, list[Tensor]](list), defaultdict[str, list[Tensor]](list)
    files = find_files(options.panoramas, PANORAMA_SUFFIXES, "panoramas")
    for place, _ in Places(files, [options.asset], options.seed).make(options.scenes):
        if unseen_by(network, place.panorama) is not network:
            parser.error(f"{place.panorama}: a network has learned from it")
        peak = summarize(Light(texels=place.texels))
        axis = axis_from_angles(peak.azimuth_deg, peak.elevation_deg)
        estimate = regress(network, place.photo, place.camera)
        # The logarithm of a softmax is the logits up to a constant, which no softmax sees.
        logits[place.panorama].append(torch.from_numpy(estimate.probability).log())
        axes[place.panorama].append(torch.from_numpy(axis @ yaw_to_world(place.camera)))
    sets = {name: (torch.stack(logits[name]), torch.stack(axes[name])) for name in logits}

    def coverage(name: str, temperature: float) -> float:
        logit, axis = sets[name]
        mass = region_mass(directions, (logit / temperature).softmax(1), axis)
        return float((mass <= COVERAGE).double().mean())

    for name in sets:
        others = [pair for other, pair in sets.items() if other != name]
        found = calibrated_temperature(directions, others)
        own, plain = (100 * coverage(name, temperature) for temperature in (found, 1.0))
        told = f"{own:3.0f} % of {len(sets[name][0])} photographs (1.00: {plain:3.0f} %)"
        print(f"{name:28s} {found:5.2f} of the others: {told}")
    best = calibrated_temperature(directions, list(sets.values()))
    print(f"all: {best:.2f}")
    if options.write is not None:
        trained.temperature.fill_(best)
        save_regressor(trained, options.write, {**trained.record, "mean_calibrated_on": list(sets)})


if __name__ == "__main__":
    main()
