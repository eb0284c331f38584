"""How long assets take to load, and how many acceptance cases of the readers pass.

    python -m benchmarks.assets FOLDER      every mesh below a folder: time, size, or the refusal
    python -m benchmarks.assets --cases     the cases G1 to G29 and M1 to M22 that the tests carry

Both print a table; the last line is the same as one line of JSON.
"""

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from benchmarks.measure import table
from warpir.core.errors import InputError
from warpir.io.assets import load_asset

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
CASES = (*(f"G{k}" for k in range(1, 30)), *(f"M{k}" for k in range(1, 23)))
"""Rows of the project's tables of glTF cases and of mesh faults."""
TESTS = ("gltf", "obj", "placement", "render", "command", "faults")
"""Where the tests of the cases are."""


def measure(path: Path, repeats: int) -> dict[str, Any]:
    """Return what an asset holds and the median time of loading it [s], or why it is refused."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        try:
            asset = load_asset(path)
        except InputError as error:
            return {"refused": f"{error.what}; {error.advice}"}
        seconds.append(time.perf_counter() - start)
    return {
        "seconds": round(statistics.median(seconds), 3),
        "triangles": sum(len(p.indices) for p in asset.primitives),
        "primitives": len(asset.primitives),
        "megapixels": round(sum(t.pixels.size for t in asset.textures) / 4e6, 1),
        "textures": len(asset.textures),
        "notices": len(asset.notices),
    }


def loads(folder: Path, repeats: int) -> dict[str, Any]:
    """Measure all meshes below a folder and print a table."""
    found = {
        path.relative_to(folder).as_posix(): measure(path, repeats)
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in SUFFIXES
    }
    columns = ("seconds", "triangles", "primitives", "textures", "megapixels", "notices")
    rows = []
    for name, row in found.items():
        if "seconds" in row:
            shown = [f"{row['seconds']:.3f}", *(str(row[key]) for key in columns[1:])]
        else:
            shown = [row["refused"], *[""] * (len(columns) - 1)]
        rows.append([name, *shown])
    print(table(("asset", *columns), rows))
    return found


def cases() -> dict[str, Any]:
    """Run the tests that carry a case's id and print how many of each pass."""
    root = Path(__file__).resolve().parents[1]
    files = [str(path) for name in TESTS for path in root.glob(f"tests/*/test_{name}.py")]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
        command += ["-k", " or ".join(CASES), f"--junitxml={report}"]
        subprocess.run(command, cwd=root, stdout=subprocess.DEVNULL, check=False)
        tests = list(ET.parse(report).getroot().iter("testcase"))
    counts = {case: [0, 0, 0] for case in CASES}
    for test in tests:
        name = test.attrib["name"]
        kind = 2 if test.find("skipped") is not None else 0 if len(test) == 0 else 1
        for case in set(re.findall(r"(?<![A-Za-z0-9])([GM]\d+)(?![0-9])", name.replace("_", " "))):
            if case in counts:
                counts[case][kind] += 1
    rows = ([case, *map(str, numbers)] for case, numbers in counts.items())
    print(table(("case", "passed", "failed", "skipped"), rows))
    passed = [case for case, (good, bad, _) in counts.items() if good and not bad]
    return {
        "cases_passed": len(passed),
        "cases": len(CASES),
        "variants_passed": sum(good for good, _, _ in counts.values()),
        "not_passed": [case for case in CASES if case not in passed],
    }


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", help="meshes to load")
    parser.add_argument("--repeats", type=int, default=5, help="loads of each mesh")
    parser.add_argument("--cases", action="store_true", help="count the acceptance cases")
    options = parser.parse_args()
    if options.cases == (options.folder is not None):
        parser.error("name a folder, or pass --cases")
    print(json.dumps(cases() if options.cases else loads(options.folder, options.repeats)))


if __name__ == "__main__":
    main()
