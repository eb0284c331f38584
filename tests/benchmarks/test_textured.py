"""The heap of textured balls: what it holds, and that runs and files keep it."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.speed.textured import TEXELS, textured_heap
from warpir.io.assets import load_asset
from warpir.io.gltf.writer import write_glb
from warpir.scene.asset import Asset


@pytest.fixture(scope="module")
def heap() -> Asset:
    """One for all tests, none of which changes it."""
    return textured_heap()


def test_it_holds_as_much_as_it_promises(heap: Asset) -> None:
    assert sum(len(p.positions) for p in heap.primitives) == 50_000
    assert sum(len(p.indices) for p in heap.primitives) == 97_020
    assert len(heap.materials) == 5
    used = [slot.texture for material in heap.materials for slot in material.texture_slots()]
    assert sorted(used) == list(range(15)) and len(heap.textures) == 15
    assert {t.pixels.shape for t in heap.textures} == {(TEXELS, TEXELS, 4)}
    assert len({t.pixels.tobytes() for t in heap.textures}) == 15


def test_it_stands_on_the_ground_and_faces_outward(heap: Asset) -> None:
    assert heap.bounds()[0][1] == pytest.approx(0.0, abs=1e-12)
    for primitive in heap.primitives:
        a, b, c = (primitive.positions[primitive.indices[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        assert (np.linalg.norm(normal, axis=1) > 0.0).all()
        assert primitive.normals is not None
        assert (np.sum(normal * primitive.normals[primitive.indices[:, 0]], axis=1) > 0.0).all()


def test_it_is_the_same_each_time(heap: Asset) -> None:
    other = textured_heap()
    assert other.materials == heap.materials
    for one, two in zip(heap.textures, other.textures, strict=True):
        np.testing.assert_array_equal(one.pixels, two.pixels)
    for one, two in zip(heap.primitives, other.primitives, strict=True):
        np.testing.assert_array_equal(one.positions, two.positions)
        np.testing.assert_array_equal(one.indices, two.indices)


def test_a_file_keeps_it(heap: Asset, tmp_path: Path) -> None:
    path = tmp_path / "textured.glb"
    path.write_bytes(write_glb(heap, np.eye(4)))
    read = load_asset(path)
    assert sum(len(p.positions) for p in read.primitives) == 50_000
    assert [len(p.indices) for p in read.primitives] == [len(p.indices) for p in heap.primitives]
    assert [m.name for m in read.materials] == [m.name for m in heap.materials]
    for one, two in zip(heap.primitives, read.primitives, strict=True):
        slots = (a.materials[p.material].texture_slots() for a, p in ((heap, one), (read, two)))
        for ours, theirs in zip(*slots, strict=True):
            np.testing.assert_array_equal(
                heap.textures[ours.texture].pixels, read.textures[theirs.texture].pixels
            )
