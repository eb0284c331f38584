"""Draw what more places bring: errors of the light on held-out places over places learned from.

    python -m benchmarks.light.places_curve docs/light_places.json docs/light_places.png

The file holds the number of places of each training (`python -m warpir.train regressor --places N
--fold 0/5`) and, by name, what its validation found.
"""

import argparse
import json
from pathlib import Path


def main() -> None:
    """Draw one panel for each error."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("measured", type=Path)
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    measured = json.loads(options.measured.read_text(encoding="utf-8"))
    places, about = measured.pop("places"), measured.pop("about")
    figure, panels = plt.subplots(1, len(measured), figsize=(10.0, 3.2), layout="constrained")
    for panel, (name, values) in zip(panels, measured.items(), strict=True):
        panel.plot(places, values, "o-", color="black")
        panel.set_xscale("log", base=2)
        panel.set_xticks(places, [str(count) for count in places])
        panel.minorticks_off()
        panel.set_xlabel("places learned from")
        panel.set_title(name, fontsize=10)
        panel.set_ylim(0.0, 1.15 * max(values))
        panel.grid(alpha=0.3)
    figure.suptitle(about, fontsize=9)
    figure.savefig(options.picture, dpi=100)


if __name__ == "__main__":
    main()
