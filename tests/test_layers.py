"""One direction: which room may import which, lazy imports included, and no cycle."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# A room imports itself and rooms of earlier rows.
DIRECTION = (
    {"core"},
    {"scene"},
    {"io"},
    {"look"},
    {"app"},
    {"demo"},
    {"render", "calibration"},
    {"lighting"},
    {"optimize", "report"},
    {"sequence", "place", "mitsuba", "train"},
    {"insert"},
    {"batch", "evaluate", "study"},
    {"check_model"},
)
RANK = {room: rank for rank, rooms in enumerate(DIRECTION) for room in rooms}
KERNELS_IN = {"render", "train"}
"""Who launches kernels; `warpir.kernels` itself sees Warp and nothing else."""
NETWORKS_IN = {"optimize"}
"""Who drives the networks of `warpir.diffusion`, which itself sees `warpir.core` alone."""
PLAIN = {"settings", "prompts", "model_error", "model_folder", "hub", "weight_files"}
"""Modules of `warpir.diffusion` for every room: words, settings and files; torch is not loaded."""
PACKAGES = {
    "warp": {"kernels", *KERNELS_IN},
    "torch": {
        "diffusion",
        "render",
        "lighting",
        "optimize",
        "train",
        "evaluate",
        "insert",
    },
    "diffusers": {"diffusion"},
    "transformers": {"diffusion"},
    "peft": {"diffusion"},
    "mitsuba": {"mitsuba"},
    "drjit": {"mitsuba"},
    "OpenImageIO": {"io"},
    "OpenEXR": {"io"},
    "pxr": {"io"},
    "trimesh": {"io", "train"},
    "yaml": {"app"},
    "ray": {"batch"},
}
"""Where a library may be imported at all."""


def sources(*folders: str) -> list[Path]:
    """Return the Python files below these folders of the checkout."""
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def name_of(path: Path) -> str:
    """Return the dotted name under which a file is imported."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "warpir" else ("warpir", *parts)
    return ".".join(parts).removesuffix(".__init__")


MODULES = {name_of(path): path for path in sources("warpir", "kernels", "diffusion")}


def imports(path: Path) -> list[tuple[int, str]]:
    """Return (line, module) of every import that can run, wherever it stands."""
    found: list[tuple[int, str]] = []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for block in ast.walk(tree):
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            block.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            inner = [f"{module}.{alias.name}" for alias in node.names]
            found += [(node.lineno, name if name in MODULES else module) for name in inner]
    return found


def room_of(module: str) -> str:
    """Return the room of a module of ours: ``warpir.io.gltf.reader`` is in ``io``."""
    return [*module.split("."), ""][1]


@pytest.mark.parametrize("module", sorted(MODULES))
def test_layers_imports_go_one_way(module: str) -> None:
    """Rooms import earlier rooms, kernels Warp alone, diffusion the core alone."""
    here = room_of(module)
    for line, target in imports(MODULES[module]):
        top, there = target.split(".")[0], room_of(target)
        where = f"{module}, line {line}: {target}"
        assert top not in ("kernels", "diffusion"), f"{where}: import it as warpir.{top}"
        assert here in PACKAGES.get(top, {here}), f"{where}: {top} belongs in {PACKAGES[top]}"
        assert here != "kernels" or top not in ("numpy", "torch"), (
            f"{where}: kernels see no arrays but Warp's"
        )
        if top != "warpir" or there in ("", here) or here in ("", "__main__"):
            continue
        if here == "kernels":
            raise AssertionError(f"{where}: kernels see kernels alone")
        if here == "diffusion":
            assert there == "core", f"{where}: diffusion sees the core alone"
        elif there == "kernels":
            assert here in KERNELS_IN, f"{where}: kernels are launched in {KERNELS_IN}"
        elif there == "diffusion":
            plain = target.split(".")[-1] in PLAIN
            assert plain or here in NETWORKS_IN, f"{where}: networks run in {NETWORKS_IN}"
        else:
            assert RANK[there] < RANK[here], f"{where}: {here} comes before {there}"


def test_layers_have_no_cycle() -> None:
    """Between modules of one room neither, lazy imports counted."""
    graph = {
        module: {target for _, target in imports(path) if target in MODULES} - {module}
        for module, path in MODULES.items()
    }
    TopologicalSorter(graph).prepare()


def test_layers_rooms_are_small_and_say_what_they_are() -> None:
    """At most a dozen modules a folder, and a head that says what is inside and what it ignores."""
    installed = {path.parent for path in sources("warpir", "diffusion", "kernels")}
    for folder in installed | {path.parent for path in sources("benchmarks", "tests")}:
        modules = [p for p in folder.glob("*.py") if not p.stem.startswith("__")]
        assert len(modules) <= 12, f"{folder.name}: {len(modules)} modules"
    for folder in installed:
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text())), folder
    assert {p.stem for p in (ROOT / "warpir").glob("*.py")} == {
        *("__init__", "__main__", "insert", "check_model"),
    }


def test_layers_plain_modules_need_no_torch() -> None:
    """Command line and file checks answer without torch, in functions too."""
    plain = [path for path in sources("diffusion") if path.stem in PLAIN - {"prompts"}]
    for path in [*plain, *sources("warpir/core", "warpir/scene", "warpir/io", "warpir/app")]:
        tops = {target.split(".")[0] for _, target in imports(path)}
        assert not tops & {"torch", "warp", "diffusers", "transformers", "peft"}, path
