"""How far are the hard cases from float64, and how far is Mitsuba 3 on the same case?

    python -m benchmarks.stability [--device cpu|cuda] [--json FILE] [--docs FILE]

Lobes, materials, geometry, light, tone and fusion at the ends of their ranges. Truth comes from the
float64 oracles of the tests, closed forms and quadrature, never from the kernels.
`tests/benchmarks/test_stability.py` asserts the bounds of the same cases. Mitsuba's part is left
out, and says so, where it is not installed.
"""

import math
import time
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.measure import context, flags, report, table
from benchmarks.stability import brdf, geometry, light, lobes, near
from benchmarks.stability.case import Case
from warpir.render.device import choose_device


def cases() -> list[Case]:
    """Return all cases, in the table's order."""
    groups = (lobes, brdf, geometry, light, near)
    return [case for group in groups for case in group.cases()]


def measure(case: Case, device: str, has_mitsuba: bool) -> dict[str, Any]:
    """Return the record of one case."""
    start = time.perf_counter()
    measured = case.run(device)
    seconds = time.perf_counter() - start
    mitsuba: float | str
    if isinstance(case.mitsuba, str):
        mitsuba = case.mitsuba
    elif has_mitsuba:
        error = case.mitsuba()
        mitsuba = error if math.isfinite(error) else "numbers that are not finite"
    else:
        mitsuba = "not installed"
    return {
        "group": case.group,
        "case": case.name,
        "quantity": case.quantity,
        "measure": case.measure,
        "error": measured.error,
        "bound": case.bound,
        "gradient_error": measured.gradient_error,
        "gradient_bound": case.gradient_bound,
        "finite": measured.is_finite,
        "mitsuba": mitsuba,
        "seconds": round(seconds, 3),
    }


def is_kept(record: dict[str, Any]) -> bool:
    """Say whether a record is finite and within its bounds; NaN is not."""
    gradient, bound = record["gradient_error"], record["gradient_bound"]
    return bool(
        record["finite"]
        and record["error"] <= record["bound"]
        and (gradient is None or gradient <= bound)
    )


def number(x: float | None) -> str:
    """Write an error for the table."""
    if x is None:
        return ""
    return "0" if x == 0.0 else f"{x:.1e}"


PAGE = """# Numerical stability: hard cases against float64

Measured on {date} with warp-lang {warp} on {device}{theirs}.

    {command}

How to read it: *error* is ours against float64, formed as *measure* says; *gradient* is
the relative L2 distance of our gradient, the worst parameter's, from central
differences in float64. After the slash stands the bound that
`tests/benchmarks/test_stability.py` asserts, together with the absence of NaN and
infinity; the constants in `benchmarks/stability/` say where each bound comes from.
Mitsuba's error is formed in the same way against the
formula that Mitsuba implements. For hits and needles an
error of 1 is a ray that met another triangle than in float64, or none. Rows on shadows
and white planes are sampled, so their errors are mostly noise; ours averages whole
pixels with two techniques, Mitsuba's are single points with one sequence of directions,
so only errors far above 1e-3 differ in precision. Mitsuba takes the scene in float32
world coordinates, so an object 100 km from the origin is 8 mm coarse, and it moves the
start of a ray by about 9e-5 (1 + |p|) m, a tenth of a scene of 1 mm.

{count} cases, {kept} within their bounds and finite. Nearest to its bound: {worst}.

{table}
"""


def document(records: list[dict[str, Any]], where: dict[str, Any], command: str) -> str:
    """Return ``docs/stability.md``: one table of all records."""
    head = ("group", "case", "quantity", "measure", "error / bound", "gradient / bound", "finite")
    rows = []
    for r in records:
        gradient = ""
        if r["gradient_error"] is not None:
            gradient = f"{number(r['gradient_error'])} / {number(r['gradient_bound'])}"
        mitsuba = r["mitsuba"] if isinstance(r["mitsuba"], str) else number(r["mitsuba"])
        rows.append(
            (
                *(r["group"], r["case"], r["quantity"], r["measure"]),
                *(f"{number(r['error'])} / {number(r['bound'])}", gradient),
                *("yes" if r["finite"] else "**no**", mitsuba.replace("|", "/")),
            )
        )
    worst = max((r for r in records if r["bound"] > 0.0), key=lambda r: r["error"] / r["bound"])
    version_of = where["mitsuba"]
    return PAGE.format(
        **where,
        theirs=f"; Mitsuba {version_of} (`llvm_ad_rgb`)" if version_of else "",
        command=command,
        count=len(records),
        kept=sum(map(is_kept, records)),
        worst=f"{worst['case']}, {worst['quantity']}",
        table=table((*head, "Mitsuba"), rows),
    )


def main() -> None:
    """Run the cases, print one JSON line each, and write the table."""
    parser = flags(__doc__, "device", "json")
    parser.add_argument("--docs", type=Path, help="write the table to this file")
    args = parser.parse_args()
    device = choose_device(args.device)
    has_mitsuba = find_spec("mitsuba") is not None
    if has_mitsuba:
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
    where = context(wp.get_device(device), 1)
    where["mitsuba"] = version("mitsuba") if has_mitsuba else None
    records = []
    for case in cases():
        record = measure(case, device, has_mitsuba)
        report({**record, "commit": where["commit"], "device": where["device"]}, args.json)
        records.append(record)
    if args.docs is not None:
        command = f"python -m benchmarks.stability --device {device} --docs FILE"
        args.docs.write_text(document(records, where, command), encoding="utf-8")
    outside = [f"{r['group']}: {r['case']}, {r['quantity']}" for r in records if not is_kept(r)]
    print(f"{len(records)} cases, {len(outside)} outside their bounds", *outside, sep="\n")


if __name__ == "__main__":
    main()
