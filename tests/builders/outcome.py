"""What a run made, apart from what a clock decides: the one place that knows where that stands.

Two runs of one command are compared by this. In ``run.json`` seconds, the number of threads and the
most memory are left out, and with them the sha256 of the one file that shows them; in
``report.html`` what stands between its marks. All else is compared to the byte.
"""

import hashlib
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from warpir.report.page import CLOCK, END, REPORT

CLOCKED = ("seconds", "threads", "peak_mib")
"""Keys of ``run.json``, at any depth."""
SHOWN = re.compile(f"{re.escape(CLOCK)}.*?{re.escape(END)}".encode(), re.DOTALL)


def without_clock(path: Path) -> bytes:
    """A file's content without what a clock decides; of other files all of it."""
    content = path.read_bytes()
    if path.name == REPORT:
        content, count = SHOWN.subn(b"", content)
        assert count == 1, f"{path}: {count} places show seconds"
    if path.name == "run.json":
        record = _without(json.loads(content))
        record["files"].pop(REPORT, None)
        content = json.dumps(record, sort_keys=True).encode()
    return content


def outcome(folder: Path) -> dict[str, str]:
    """Sha256 of every file below a folder, by its name in it."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink())
    return outcome_of(folder, [str(path.relative_to(folder)) for path in paths])


def outcome_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Sha256 of some files of a folder."""
    return {name: hashlib.sha256(without_clock(folder / name)).hexdigest() for name in names}


def _without(record: Any) -> Any:
    if isinstance(record, dict):
        return {k: _without(v) for k, v in record.items() if k not in CLOCKED}
    return record
