"""Turn the referee's JSON lines into the tables of ``docs/referee.md``.

python -m benchmarks.referee.table docs/referee/*.jsonl
"""

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.measure import table

PERCENT = ("beyond_3", "relative_rmse", "expected_rmse", "display_rmse")


def images(lines: list[dict[str, Any]]) -> str:
    """Return the table of foregrounds and shadow ratios."""
    head = ("scene", "quantity", "samples", "z mean / std", "beyond 3", "block z std / max")
    head += ("relative RMSE (expected from noise)", "display RMSE", "bias")
    rows = []
    for line in lines:
        if line["what"] == "gradient":
            continue
        depth = line.get("depth", 0)
        what = "shadow ratio" + f", bounce of D = {depth}" * bool(depth)
        if line["what"] == "foreground":
            what = f"object, D = {depth}"
        share = {name: f"{100 * line[name]:.2f} %" for name in PERCENT}
        rows.append(
            (
                *(line["scene"], what, str(line["spp"])),
                f"{line['z_mean']:.2f} / {line['z_std']:.2f}",
                share["beyond_3"],
                f"{line['block_z_std']:.2f} / {line['block_z_max']:.1f}",
                f"{share['relative_rmse']} ({share['expected_rmse']})",
                share["display_rmse"],
                f"{line['relative_bias']:+.1e} ± {line['relative_bias_error']:.0e}",
            )
        )
    return table(head, rows)


def gradients(lines: list[dict[str, Any]]) -> str:
    """Return the table of lobe gradients."""
    head = ("scene", "D", "samples", "parameter", "relative L2 (noise of both)", "cosine")
    rows = []
    for line in (line for line in lines if line["what"] == "gradient"):
        for name in ("amplitude", "axis", "sharpness"):
            match = line[name]
            errors = f"{match['relative_l2']:.1e} ({match['noise_l2']:.1e})"
            where = line["scene"], str(line["depth"]), str(line["spp"])
            rows.append((*where, name, errors, f"{match['cosine']:.7f}"))
    return table(head, rows)


if __name__ == "__main__":
    found = [
        json.loads(row) for path in sys.argv[1:] for row in Path(path).read_text().splitlines()
    ]
    print(images(found), gradients(found), sep="\n\n")
