"""The figures of a study as a person reads them: a table on the screen, and Markdown."""

import sys
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from warpir.study.plan import ALL

HEADINGS = (
    "against",
    "scenes",
    "images preferred [%]",
    "votes [%]",
    "scenes, all runs",
    "exact 95 %",
    "Wilson 95 %",
    "p",
    "kappa",
)
FILE_WIDTH = 150
"""Of the table where there is no terminal [characters]."""
NOTE = (
    "Images preferred by majority vote and single votes: mean +- sample standard deviation over "
    "runs. Scenes: majority of the votes of all runs; intervals and the two-sided exact test "
    "against one half are over scenes and leave out ties. A tie counts as half an image."
)


def rows_of(figures: Mapping[str, Any]) -> list[list[str]]:
    """Return a row of the table for each comparison, in the order of `HEADINGS`."""
    rows = []
    for c in figures["comparisons"]:
        scenes = c["scenes_preferred"]
        p_value = scenes["p_value"]
        rows.append(
            [
                _name(c),
                str(c["scenes"]),
                _spread(c["images_preferred"]),
                _spread(c["votes_preferred"]),
                _count(scenes),
                _interval(scenes["clopper_pearson"]),
                _interval(scenes["wilson"]),
                "-" if p_value is None else f"{p_value:.3f}",
                _number(c["kappa"], 3),
            ]
        )
    return rows


def lines_of(figures: Mapping[str, Any]) -> list[str]:
    """Return what is said of some raters below their table."""
    repeats, side = figures["repeats_consistent"], figures["side_1_chosen"]
    catches, zoomed = figures["catches_right"], figures["zoomed_share"]
    lines = [f"Fleiss' kappa of all pairs: {_number(figures['kappa'], 3)}"]
    lines.append(f"same choice on repeated pairs: {_with_interval(repeats)}")
    lines.append(f"catch pairs right: {_with_interval(catches)}")
    p_value = side["p_value"]
    tested = "" if p_value is None else f", p = {p_value:.3f} (two-sided, exact)"
    lines.append(f"image 1 chosen: {_with_interval(side)}{tested}")
    lines.append(f"median response: {_number(figures['median_seconds'], 1)} s")
    lines.append(f"zoomed: {'-' if zoomed is None else f'{100.0 * zoomed:.0f} %'} of the pairs")
    grouped = {c["baseline"] for c in figures["comparisons"] if c["group"] != ALL}
    for c in figures["comparisons"]:
        is_sum = c["group"] == ALL and c["baseline"] in grouped
        if c["scenes_without_votes"] and not is_sum:
            lines.append(f"no votes yet: {c['scenes_without_votes']} scenes against {_name(c)}")
    return lines


def parts_of(report: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return (heading, figures): those who are kept, and everybody where somebody is not."""
    sheets = report["sheets"]
    excluded = len(sheets["excluded"])
    if not excluded:
        return [(f"all {sheets['found']} raters (nobody is excluded)", report["kept"])]
    return [
        (f"{report['kept']['raters']} raters, without the {excluded} excluded", report["kept"]),
        (f"all {sheets['found']} raters, with the {excluded} excluded", report["everybody"]),
    ]


def heading_lines(report: Mapping[str, Any]) -> list[str]:
    """Return what stands above the tables; the first line warns of answers that are nobody's."""
    sheets = report["sheets"]
    return [
        *([report["warning"]] if "warning" in report else []),
        f"{printable(report['title'])} (study {report['study']}): "
        f"{printable(report['method'])} against each baseline",
        f"answers: {sheets['found']} of {sheets['expected']} raters",
        report["exclusion"],
    ]


def print_report(report: Mapping[str, Any]) -> None:
    """Print the figures on standard output."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    width = None if sys.stdout.isatty() else FILE_WIDTH
    console = Console(markup=False, highlight=False, emoji=False, width=width)
    for line in heading_lines(report):
        console.print(line, soft_wrap=True)
    for heading, figures in parts_of(report):
        table = Table(title=heading, title_justify="left")
        for k, name in enumerate(HEADINGS):
            name_width = 12 if k == 0 else None
            justify: Literal["left", "right"] = "right" if k else "left"
            table.add_column(name, justify=justify, overflow="fold", min_width=name_width)
        for row in rows_of(figures):
            table.add_row(*map(Text, row))
        console.print()
        console.print(table)
        for line in lines_of(figures):
            console.print(line, soft_wrap=True)
    console.print()
    console.print(NOTE, soft_wrap=True)


def markdown_of(report: Mapping[str, Any]) -> str:
    """Return the figures as Markdown."""
    first, *rest = heading_lines(report)
    is_warning = "warning" in report
    lines = [f"**{_markdown(first)}**" if is_warning else f"# {_markdown(first)}", ""]
    if is_warning:
        lines += [f"# {_markdown(rest.pop(0))}", ""]
    lines += [f"{_markdown(line)}  " for line in rest]
    for heading, figures in parts_of(report):
        lines += ["", f"## {heading[0].upper()}{heading[1:]}", "", _row(HEADINGS)]
        lines.append("|---|" + "--:|" * (len(HEADINGS) - 1))
        lines += [_row(row) for row in rows_of(figures)]
        lines += ["", *(f"* {_markdown(line)}" for line in lines_of(figures))]
    return "\n".join([*lines, "", NOTE, ""])


def printable(text: str) -> str:
    """Return a name without line breaks and control characters, which would break a table."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _name(comparison: Mapping[str, Any]) -> str:
    """Return what a row is called: the baseline, and the group where it is not all scenes."""
    baseline, group = comparison["baseline"], comparison["group"]
    return printable(baseline if group == ALL else f"{baseline}, {group}")


def _markdown(text: str) -> str:
    """Escape what Markdown or HTML would take for its own."""
    escaped = text.replace("&", "&amp;").replace("<", "&lt;")
    return "".join(f"\\{c}" if c in "\\`*_[]|#" else c for c in escaped)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(map(_markdown, cells))} |"


def _spread(found: Mapping[str, float | None]) -> str:
    mean, sd = found["mean"], found["sd"]
    if mean is None:
        return "-"
    return f"{100.0 * mean:.1f}" + ("" if sd is None else f" +- {100.0 * sd:.1f}")


def _count(found: Mapping[str, Any]) -> str:
    ties = found["ties"]
    wins = round(found["count"] - 0.5 * ties)
    return f"{wins} of {found['total']}" + (f", {ties} tied" if ties else "")


def _interval(ends: Sequence[float] | None) -> str:
    return "-" if ends is None else f"{100.0 * ends[0]:.1f} to {100.0 * ends[1]:.1f}"


def _with_interval(found: Mapping[str, Any]) -> str:
    if found["share"] is None:
        return "none"
    ends = _interval(found["clopper_pearson"])
    share = 100.0 * found["share"]
    return f"{_count(found)}, {share:.1f} % (exact 95 %: {ends})"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
