"""The Khronos glTF validator, run by Node.js on files that the tests have made.

``.ci/get-gltf-validator`` installs the npm package; ``WARPIR_GLTF_VALIDATOR`` names another place.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

PACKAGE = Path(
    os.environ.get("WARPIR_GLTF_VALIDATOR")
    or Path(__file__).parents[3] / ".ci" / "node_modules" / "gltf-validator"
)
SCRIPT = """
const fs = require("fs"), validator = require(process.argv[1]);
const files = process.argv.slice(2);
Promise.all(files.map(file => validator.validateBytes(
    new Uint8Array(fs.readFileSync(file)), {maxIssues: 0}
))).then(reports => console.log(JSON.stringify(reports.map(report => report.issues.messages))));
"""
SEVERITIES = ("error", "warning", "information", "hint")


def validate(folder: Path, files: dict[str, bytes]) -> dict[str, dict[str, list[str]]]:
    """Return what the validator says of each file: codes and pointers by severity.

    Skips the test where Node.js or the package is absent. ``files`` holds the content of ``.glb``
    files by name; they are put into the folder.
    """
    node = shutil.which("node")
    if node is None or not PACKAGE.is_dir():
        pytest.skip("no Node.js" if node is None else "no gltf-validator: .ci/get-gltf-validator")
    paths = [folder / f"{number}.glb" for number in range(len(files))]
    for path, content in zip(paths, files.values(), strict=True):
        path.write_bytes(content)
    command = [node, "-e", SCRIPT, str(PACKAGE), *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    found: dict[str, dict[str, list[str]]] = {}
    for name, messages in zip(files, json.loads(done.stdout), strict=True):
        found[name] = {severity: [] for severity in SEVERITIES}
        for message in messages:
            line = f"{message['code']} {message.get('pointer', '')}"
            found[name][SEVERITIES[message["severity"]]].append(line)
    return found
