"""What damaged files do: every format that warpir reads, damaged some thousand times.

    python -m benchmarks.damage --count 5000 [--only WORD] [--json docs/byte_flips.json]

Only two ends are right: the file is still read, or one ``error:`` line with the exit code of its
class, within 10 s and 500 MB, with nothing else on standard error. The reading happens in a
process of its own (`benchmarks.damage.reader`); the damage is `hypothesis`'s, the same in every
run of one version.
"""

import argparse
import json
import select
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings

from benchmarks.damage.formats import Format, formats, weights
from benchmarks.measure import write_json
from warpir.core.errors import ExitCode

SECONDS = 10.0
"""Longest a reading may take."""
FIRST_SECONDS = 120.0
"""Longest for a format's first file, with all imports."""
BYTES = 500e6
"""Most memory it may touch beyond what its process has."""
FAULTS_SHOWN = 5


@dataclass
class Row:
    """What became of one format's damaged files."""

    name: str
    tried: int = 0
    codes: Counter[int] = field(default_factory=Counter)
    seconds: float = 0.0
    """The longest."""
    bytes: int = 0
    """The most."""
    faults: list[str] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "format": self.name,
            "mutations": self.tried,
            "exit_codes": {str(code): count for code, count in sorted(self.codes.items())},
            "longest_seconds": round(self.seconds, 2),
            "most_megabytes": round(self.bytes / 1e6, 1),
            "faults": len(self.faults),
        }


class Reader:
    """The process that reads; another one takes its place when it dies or hangs."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def warm(self, form: Format, folder: Path) -> dict[str, Any]:
        """Read the sound file, which imports what the others need."""
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.damage.reader"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                cwd=Path(__file__).parents[2],
            )
        return self._ask({**_request(form, folder), "first": True}, FIRST_SECONDS)

    def read(self, form: Format, folder: Path) -> dict[str, Any]:
        """Return how the reading of a folder's file ended; ``end`` names an end of the process."""
        if self.process is None:
            write(form, form.sound, folder / "sound")
            self.warm(form, folder / "sound")
        return self._ask({**_request(form, folder), "first": False}, SECONDS + 2.0)

    def _ask(self, request: Mapping[str, Any], seconds: float) -> dict[str, Any]:
        process = self.process
        assert process is not None and process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        if select.select([process.stdout], [], [], seconds)[0]:
            answer = process.stdout.readline()
            if answer:
                return dict(json.loads(answer))
            status = process.wait()
            self._stop()
            return {"end": f"the process died (status {status})"}
        self._stop()
        return {"end": f"no end after {seconds:g} s"}

    def _stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


def _request(form: Format, folder: Path) -> dict[str, Any]:
    return {"reader": form.reader, "path": str(folder / (form.target or form.file))}


def write(form: Format, content: bytes, folder: Path) -> None:
    """Write a format's file with some content, and what lies beside it."""
    for name, other in {**form.beside, **form.seal(content), form.file: content}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(other)


def fault_of(form: Format, ended: Mapping[str, Any]) -> str:
    """Return what is wrong with how a reading ended, or an empty text."""
    if "end" in ended:
        return str(ended["end"])
    status, lines = ended["status"], ended["err"].splitlines()
    if ended["seconds"] > SECONDS:
        return f"{ended['seconds']:.1f} s"
    if ended["bytes"] > BYTES:
        return f"{ended['bytes'] / 1e6:.0f} MB"
    if status == ExitCode.BUG:
        return " | ".join(lines[-6:])
    if status not in (ExitCode.DONE, *form.codes):
        return f"exit code {status}: {ended['err'][:300]}"
    if status == ExitCode.DONE:
        return f"noise: {ended['err'][:300]}" if lines else ""
    # The error, one line of advice where there is some, further problems.
    rest = [line for line in lines[1:] if not line.startswith("also: ")]
    if not lines or not lines[0].startswith("error: ") or len(rest) > 1:
        return f"not one error line: {ended['err'][:300]}"
    return ""


def tried(count: int) -> settings:
    """Return the settings of so many draws, the same in every run."""
    return settings(
        max_examples=count,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],  # all faults of a run are told, none is made smaller
        suppress_health_check=list(HealthCheck),
    )


def survey(form: Format, count: int, reader: Reader, keep: Path | None = None) -> Row:
    """Damage a format's file and read it, so many times; keep what makes a fault in a folder."""
    row = Row(form.name)
    with tempfile.TemporaryDirectory(prefix="warpir-flips-") as temporary:
        folder = Path(temporary)
        write(form, form.sound, folder / "sound")
        first = reader.warm(form, folder / "sound")
        if first.get("status") != ExitCode.DONE or first.get("err"):
            row.faults.append(f"the sound file is not read: {first}")
            return row

        @tried(count)
        @given(form.damage)
        def meet(content: bytes) -> None:
            write(form, content, folder / "damaged")
            ended = reader.read(form, folder / "damaged")
            row.tried += 1
            row.codes[ended.get("status", -1)] += 1
            row.seconds = max(row.seconds, ended.get("seconds", SECONDS))
            row.bytes = max(row.bytes, ended.get("bytes", 0))
            fault = fault_of(form, ended)
            if fault and fault not in row.faults:
                row.faults.append(fault)
                if keep is not None:
                    name = f"{form.name.replace(' ', '_').replace('/', '_')}-{len(row.faults)}"
                    write(form, content, keep / name)

        meet()
    return row


def main(argv: Sequence[str] | None = None) -> int:
    """Survey all formats and print a table; 1 when there was a fault."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.damage", description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="damaged files of each format")
    parser.add_argument("--only", default="", help="formats with this word in their names")
    parser.add_argument("--json", type=Path, help="where the table is written")
    parser.add_argument("--keep", type=Path, help="folder for files that make a fault")
    options = parser.parse_args(argv)
    rows = []
    print(f"{'format':26} {'tried':>6} {'s':>6} {'MB':>6}  exit codes")
    with Reader() as reader:
        for form in [*formats(), *weights()]:
            if options.only not in form.name:
                continue
            row = survey(form, options.count, reader, options.keep)
            rows.append(row.record())
            codes = ", ".join(f"{code}: {count}" for code, count in sorted(row.codes.items()))
            print(f"{row.name:26} {row.tried:6} {row.seconds:6.2f} {row.bytes / 1e6:6.1f}  {codes}",
                  flush=True)  # fmt: skip
            for fault in row.faults[:FAULTS_SHOWN]:
                print(f"    {fault}", flush=True)
    write_json(options.json, {"count": options.count, "formats": rows})
    return int(any(row["faults"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
