"""Turn the referee's JSON lines into the tables of ``docs/referee.md``.

python -m benchmarks.referee.table docs/referee/*.jsonl
"""

import json
import sys
from pathlib import Path
from typing import Any


def images(lines: list[dict[str, Any]]) -> str:
    """Return the table of foregrounds and shadow ratios."""
    rows = [
        "| scene | quantity | samples | z mean / std | beyond 3 | block z std / max "
        "| relative RMSE (expected from noise) | display RMSE | bias |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for line in lines:
        if line["what"] == "gradient":
            continue
        what = f"object, D = {line['depth']}"
        if line["what"] == "shadow_ratio":
            bounce = line.get("depth", 0)
            what = "shadow ratio" + f", bounce of D = {bounce}" * bool(bounce)
        rows.append(
            f"| {line['scene']} | {what} | {line['spp']} | {line['z_mean']:.2f} / "
            f"{line['z_std']:.2f} | {100 * line['beyond_3']:.2f} % | {line['block_z_std']:.2f} / "
            f"{line['block_z_max']:.1f} | {100 * line['relative_rmse']:.2f} % "
            f"({100 * line['expected_rmse']:.2f} %) | {100 * line['display_rmse']:.2f} % | "
            f"{line['relative_bias']:+.1e} ± {line['relative_bias_error']:.0e} |"
        )
    return "\n".join(rows)


def gradients(lines: list[dict[str, Any]]) -> str:
    """Return the table of lobe gradients."""
    rows = [
        "| scene | D | samples | parameter | relative L2 (noise of both) | cosine |",
        "|---|---|---|---|---|---|",
    ]
    for line in lines:
        if line["what"] != "gradient":
            continue
        for name in ("amplitude", "axis", "sharpness"):
            match = line[name]
            rows.append(
                f"| {line['scene']} | {line['depth']} | {line['spp']} | {name} | "
                f"{match['relative_l2']:.1e} ({match['noise_l2']:.1e}) | {match['cosine']:.7f} |"
            )
    return "\n".join(rows)


if __name__ == "__main__":
    found = [
        json.loads(row) for path in sys.argv[1:] for row in Path(path).read_text().splitlines()
    ]
    print(images(found), gradients(found), sep="\n\n")
