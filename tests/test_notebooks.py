"""The notebooks are kept clean, and run top to bottom."""

import ast
import json
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EXTERNAL = {"matplotlib", "numpy", "torch", "warpir"}
LONGEST_CELL = 16
"""Lines of code that a cell may have, imports and empty lines not counted."""
RUN = """
import sys
import nbclient, nbformat

notebook = nbformat.read(sys.argv[1], as_version=4)
where = {"metadata": {"path": sys.argv[2]}}
nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources=where).execute()
nbformat.write(notebook, sys.argv[3])
"""
"""In a process of its own: a kernel is spoken to through sockets."""


def read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def code_of(notebook: dict[str, Any]) -> list[str]:
    return ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]


def test_notebooks_are_those_of_the_design() -> None:
    """So that the tests below do not pass for want of notebooks."""
    names = ["01_insert_an_object", "02_light_and_shadow", "03_check_the_gradients"]
    assert [path.stem for path in NOTEBOOKS] == [*names, "04_your_photo_to_blender"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_is_stripped(path: Path) -> None:
    """Neither outputs, nor counts, nor traces of who ran it where."""
    notebook = read(path)
    for cell in notebook["cells"]:
        assert cell["metadata"] == {}
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    assert notebook["metadata"] == {"kernelspec": kernel, "language_info": {"name": "python"}}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_uses_what_a_user_has(path: Path) -> None:
    """The package without its kernels, NumPy, Matplotlib, torch, the standard library; no magic."""
    for source in code_of(read(path)):
        lines = [line for line in source.splitlines() if line.strip()]
        imports = (ast.Import, ast.ImportFrom)
        spent = [n for n in ast.parse(source).body if isinstance(n, imports)]
        of_imports = sum((n.end_lineno or n.lineno) - n.lineno + 1 for n in spent)
        assert len(lines) - of_imports <= LONGEST_CELL, source
        for node in ast.walk(ast.parse(source)):  # a magic is no Python
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names:
                assert name.split(".")[0] in EXTERNAL | set(sys.stdlib_module_names), name
                assert not name.startswith("warpir.kernels"), name


@pytest.mark.slow
@pytest.mark.skipif(find_spec("nbclient") is None, reason="needs the extra dev")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path: Path, tmp_path: Path) -> None:
    """Top to bottom in a folder of its own, without a warning; its claims it asserts itself."""
    folder, done = tmp_path / "notebooks", tmp_path / "done.ipynb"
    folder.mkdir()
    shutil.copytree(ROOT / "docs" / "speed", tmp_path / "docs" / "speed")
    command = [sys.executable, "-c", RUN, str(path), str(folder), str(done)]
    child = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr[-3000:]
    outputs = [o for cell in read(done)["cells"] for o in cell.get("outputs", ())]
    assert [o["text"] for o in outputs if o.get("name") == "stderr"] == []
    pictures = [o for o in outputs if "image/png" in o.get("data", {})]
    assert len(pictures) >= 7
