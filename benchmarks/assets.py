"""How long do assets take to load?

    python -m benchmarks.assets FOLDER

Prints a table of every mesh below the folder: time and size, or the refusal; the last line is the
same as one line of JSON.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

from benchmarks.measure import table
from warpir.core.errors import InputError
from warpir.evaluate.scenes import ASSET_SUFFIXES
from warpir.io.assets import load_asset


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
        if path.suffix.lower() in ASSET_SUFFIXES
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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="meshes to load")
    parser.add_argument("--repeats", type=int, default=5, help="loads of each mesh")
    options = parser.parse_args()
    print(json.dumps(loads(options.folder, options.repeats)))


if __name__ == "__main__":
    main()
