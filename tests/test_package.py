"""What the wheel holds; .ci/check-wheel also installs, imports and types it elsewhere."""

import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

from warpir.core.moved import MOVED

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Build the wheel from a copy, so that no stale build/ folder adds to it."""
    if not (ROOT / "pyproject.toml").is_file():
        pytest.skip("needs the checkout: pyproject.toml is not beside tests/")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("warpir", "kernels", "diffusion"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    built = subprocess.run([*command, str(source)], capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return zipfile.ZipFile(next(folder.glob("warpir-*.whl")))


@pytest.mark.slow
def test_wheel_holds_only_warpir(wheel: zipfile.ZipFile) -> None:
    """Hugging Face's kernels owns that top-level name, so ours is inside warpir/."""
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"warpir"}


@pytest.mark.slow
def test_wheel_holds_every_module(wheel: zipfile.ZipFile) -> None:
    """Nothing that the checkout imports is left behind, the licence and py.typed included."""
    names = set(wheel.namelist())
    for folder, prefix in (("warpir", ""), ("kernels", "warpir/"), ("diffusion", "warpir/")):
        for path in (ROOT / folder).rglob("*.py"):
            assert prefix + path.relative_to(ROOT).as_posix() in names
    assert "warpir/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)


@pytest.mark.slow
def test_wheel_holds_the_weights_and_their_card(wheel: zipfile.ZipFile) -> None:
    """What a photo is read with is in the package: at most 30 MB, of which 8 MB for the camera."""
    sizes = {
        info.filename: info.file_size for info in wheel.infolist() if "weights/" in info.filename
    }
    names = {
        "warpir/diffusion/weights/calibrator.safetensors",
        "warpir/diffusion/weights/regressor.safetensors",
        "warpir/diffusion/weights/texture.safetensors",
        "warpir/diffusion/weights/MODEL_CARD.md",
    }
    assert names <= set(sizes)
    assert sizes["warpir/diffusion/weights/calibrator.safetensors"] <= 8_000_000
    assert sum(sizes.values()) <= 30_000_000


@pytest.mark.slow
def test_wheel_holds_the_page(wheel: zipfile.ZipFile) -> None:
    """What warpir.place serves, three.js and its licence included."""
    page = ROOT / "warpir" / "place" / "page"
    files = {f"warpir/place/page/{p.relative_to(page)}" for p in page.rglob("*") if p.is_file()}
    assert len(files) > 8 and files <= set(wheel.namelist())


@pytest.mark.slow
def test_wheel_installs_the_commands(wheel: zipfile.ZipFile) -> None:
    """``warpir-insert`` is the same program as ``python -m warpir.insert``, and so is place."""
    entry = next(name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    for name, module in (("insert", "insert"), ("place", "place.command")):
        assert f"warpir-{name} = warpir.{module}:main" in wheel.read(entry).decode()


def test_former_names_are_the_same_modules() -> None:
    """Scripts that import what documents showed before the rooms get the very same module."""
    for former, present in MOVED.items():
        moved = import_module(f"warpir.{former}")
        assert moved is import_module(f"warpir.{present}")
        assert moved.__name__ == moved.__spec__.name == f"warpir.{present}"
    with pytest.raises(ModuleNotFoundError):
        import_module("warpir.nothing")


def test_constraints_fit_the_requirements() -> None:
    """Every direct requirement is pinned once, without a local version suffix."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    names = [pin.split("==")[0].lower() for pin in pins]
    assert len(names) == len(set(names))
    assert not any("+" in pin for pin in pins)
    extras = project["optional-dependencies"]
    (own,) = (entry for entry in extras["dev"] if entry.startswith("warpir["))
    named = own.removeprefix("warpir[").removesuffix("]").split(",")
    wanted = [*project["dependencies"], *(set(extras["dev"]) - {own})]
    for requirement in [*wanted, *(entry for name in named for entry in extras[name])]:
        assert requirement.split(">")[0].lower() in names, requirement
