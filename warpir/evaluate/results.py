"""Files of an evaluation: the record, the head of the tables, and a contact sheet."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

import warpir
from warpir.app.record import commit, versions
from warpir.core.arrays import CodeArray
from warpir.evaluate import report
from warpir.evaluate.report import Entry
from warpir.evaluate.rows import ROWS
from warpir.evaluate.scenes import Place, Subject
from warpir.evaluate.stage import Bench

FORMAT, VERSION = "warpir-evaluation", 1
DIFFERENCE_GAIN = 4.0
"""Factor on the difference, round mid grey."""
LINE = 14
"""Height of a line of text [px]."""
COLUMNS = ("photo", "{row}", "truth", "{row} - truth, x 4")


@dataclass(frozen=True)
class Panel:
    """One scene of the sheet, 8-bit codes, shape [H, W, 3] each."""

    name: str
    error: float
    """Error by which the scenes are sorted."""
    photo: CodeArray
    image: CodeArray
    truth: CodeArray


def contact_sheet(panels: Sequence[Panel], row: str, count: int = 40) -> CodeArray:
    """Return the sheet, worst scenes first."""
    strips = []
    for panel in sorted(panels, key=lambda p: -p.error)[:count]:
        width = panel.photo.shape[1]
        difference = panel.image.astype(np.float32) - panel.truth.astype(np.float32)
        shown = np.clip(128.0 + DIFFERENCE_GAIN * difference, 0.0, 255.0).astype(np.uint8)
        caption = Image.new("RGB", (4 * width, 2 * LINE), "white")
        draw = ImageDraw.Draw(caption)
        draw.text((2, 1), f"{panel.name}: RMSE of the box {panel.error:.4f}", fill="black")
        for k, words in enumerate(COLUMNS):
            draw.text((k * width + 2, LINE + 1), words.format(row=row), fill="black")
        pictures = np.concatenate([panel.photo, panel.image, panel.truth, shown], axis=1)
        strips += [np.asarray(caption), pictures]
    sheet: CodeArray = np.concatenate(strips, axis=0)
    return sheet


def run_record(
    options: argparse.Namespace,
    bench: Bench,
    scenes: list[tuple[Place, list[Subject]]],
    notices: list[str],
) -> dict[str, Any]:
    """Return versions, settings and inputs of the numbers, as plain values."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "warpir": warpir.__version__,
        "commit": commit(),
        "versions": versions(),
        "device": bench.device,
        "date": time.strftime("%Y-%m-%d"),
        "options": vars(options),
        "weights": bench.digests(),
        "notices": notices,
        "scenes": [
            {
                "name": place.name,
                "panorama": place.panorama,
                "is_sunny": place.is_sunny,
                "azimuth_deg": place.azimuth,
                "pitch_deg": place.pitch,
                "exposure": place.exposure,
                "asset": subjects[0].asset_path.name,
                "asset_to_world": subjects[0].placement.asset_to_world.tolist(),
            }
            for place, subjects in scenes
        ],
    }


def plain_values(value: Any) -> Any:
    """Return values for JSON; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): plain_values(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value if isinstance(value, bool | int | float | str | None) else str(value)


def head_lines(record: dict[str, Any]) -> list[str]:
    """Return the head of the tables, as lines of Markdown."""
    options, panoramas = record["options"], {s["panorama"] for s in record["scenes"]}
    sunny = sum(s["is_sunny"] for s in record["scenes"])
    lines = [
        "# Evaluation",
        "",
        f"{len(record['scenes'])} photographs ({sunny} sunny) of {len(panoramas)} panoramas, seed "
        f"{options['seed']}, {options['width']} pixels wide, response {options['curve']}; "
        f"{record['date']}, {record['device']}, warpir {record['warpir']}, commit "
        f"{record['commit']}.",
        "",
        "Means over scenes with 95 % bootstrap intervals; scenes of one panorama are not",
        "independent (the JSON file has intervals over panoramas too). Angles are in degrees.",
        "",
        *(f"Notice: {notice}." for notice in record["notices"]),
        "",
    ]  # fmt: skip
    if "procedural" in record:
        lines += ["## Made-up photographs never seen", ""]
        lines += [
            f"* {name}: median {s['median_deg']:.1f}, mean {s['mean_deg']:.1f} degrees "
            f"({s['mean_low_deg']:.1f} .. {s['mean_high_deg']:.1f}), {s['count']} photographs"
            for name, s in record["procedural"].items()
        ]
        lines.append("")
    return lines


def summarize(record: dict[str, Any], entries: list[Entry], rows: Sequence[str]) -> list[str]:
    """Add the entries and their summary to the record, and return the tables as lines."""
    starts = {name: row.start for name, row in ROWS.items() if row.start is not None}
    summary, pairs = report.summarize(entries), report.compare(entries, starts)
    record["kinds"] = report.by_kind(entries)
    lines = [
        *head_lines(record),
        *verdict_lines(entries),
        *report.kind_table(record["kinds"]),
        *report.tables(summary, {name: ROWS[name].words for name in rows}),
        # What is known of the truth needs no comparison; the JSON file has it all the same.
        *report.pair_table([p for p in pairs if ROWS[p.row].group != "references"]),
    ]
    record["entries"] = [asdict(entry) for entry in entries]
    record["summary"] = report.as_plain(summary)
    record["pairs"] = [asdict(pair) for pair in pairs]
    return lines


def verdict_lines(entries: list[Entry]) -> list[str]:
    """Return how often the acceptance test passed, by row."""
    verdicts: dict[str, list[bool]] = {}
    for entry in entries:
        acceptance = entry.about.get("record", {}).get("acceptance")
        if acceptance is not None:
            verdicts.setdefault(entry.row, []).append(bool(acceptance["is_accepted"]))
    if not verdicts:
        return []
    lines = ["## What guidance said of its own end", ""]
    lines += [f"* {row}: accepted in {sum(v)} of {len(v)} runs" for row, v in verdicts.items()]
    return [*lines, ""]
