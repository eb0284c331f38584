"""Photo and assets of the tests of placing."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.builders.programs.placing import HEIGHT, WIDTH
from warpir.place.worker import Worker


@pytest.fixture
def worker() -> Iterator[Worker]:
    """A process that estimates and renders; it is ended with the test."""
    made = Worker()
    yield made
    made.stop()


def write_wedge(path: Path) -> None:
    """An object without any symmetry, off its origin, with a corner cut off."""
    box = trimesh.creation.box(extents=(1.0, 0.6, 2.0))
    fin = trimesh.creation.box(extents=(0.2, 0.9, 0.5))
    fin.apply_translation((0.35, 0.5, -0.6))
    both = trimesh.util.concatenate([box, fin])
    both.apply_translation((3.0, 0.2, -1.0))
    both.export(path)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo with bright ground, and assets of two kinds."""
    folder = tmp_path_factory.mktemp("place")
    rows = np.linspace(90, 190, HEIGHT)[:, None, None]
    codes = np.broadcast_to(rows, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    Image.fromarray(codes).save(folder / "photo.png")
    write_wedge(folder / "wedge.glb")
    write_wedge(folder / "wedge's <b>.stl")
    return folder
