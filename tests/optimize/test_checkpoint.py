"""Checkpoints: what is written comes back, damage is passed over, another run is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from warpir.core.atomic import FORMAT, MANIFEST, STATE, Checkpoints
from warpir.core.errors import ExitCode, InputError
from warpir.io.unfinished import remove_unfinished

IDENTITY = {"config": {"steps": 10, "sun": (1.0, 2.0)}, "inputs": {"photo": "ab"}}


def a_state(value: float) -> dict[str, object]:
    tensor = torch.full((2, 3), value)
    return {
        "adam": {"0": {"exp_avg": tensor, "step": torch.tensor(7.0)}},
        "same": tensor,  # shares memory
        "half": tensor.to(torch.bfloat16),
        "history": [{"gradient": 0.1 + 0.2}],
        "best": None,
        "empty": {},
    }


def names(out: Path) -> list[str]:
    return sorted(p.name for p in (out / "checkpoints").iterdir())


def test_checkpoint_round_trip(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, IDENTITY)
    checkpoints.save("optimize", 50, a_state(0.1))
    found = Checkpoints(tmp_path, IDENTITY).load(pytest.fail)
    assert (found.stage, found.step) == ("optimize", 50)
    expected = a_state(0.1)
    assert set(found.state) == set(expected)
    assert torch.equal(found.state["same"], expected["same"])
    assert torch.equal(found.state["adam"]["0"]["exp_avg"], torch.full((2, 3), 0.1))
    assert found.state["half"].dtype is torch.bfloat16
    assert found.state["history"] == expected["history"]
    assert found.state["best"] is None and found.state["empty"] == {}


def test_checkpoint_keeps_two_and_the_newest_is_the_last_written(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, IDENTITY)
    for stage, step in (("personalize", 900), ("optimize", 50), ("optimize", 100)):
        checkpoints.save(stage, step, a_state(step))
    assert names(tmp_path) == ["000002-optimize-50", "000003-optimize-100"]
    assert checkpoints.newest == "000003-optimize-100"
    # A resumed run writes an earlier step again: it is the newest all the same.
    checkpoints.save("optimize", 75, a_state(75))
    assert checkpoints.load(pytest.fail).step == 75


def rewritten(manifest: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """A manifest whose content was changed."""
    content = json.loads(manifest)
    change(content)
    return json.dumps(content).encode()


DAMAGES: dict[str, tuple[str, Callable[[bytes], bytes | None]]] = {
    "cut": (STATE, lambda held: held[: len(held) // 2]),
    "flip": (STATE, lambda held: held[:-1] + bytes([held[-1] ^ 1])),
    "no-state": (STATE, lambda held: None),
    "manifest-cut": (MANIFEST, lambda held: held[:-20]),
    "no-key": (MANIFEST, lambda held: rewritten(held, lambda m: m.pop("state"))),
    "no-manifest": (MANIFEST, lambda held: None),
    "newer-format": (MANIFEST, lambda held: rewritten(held, lambda m: m.update(format=FORMAT + 1))),
}


@pytest.mark.parametrize("damage", DAMAGES, ids="R3-{}".format)
def test_checkpoint_damaged_is_passed_over(tmp_path: Path, damage: str) -> None:
    checkpoints = Checkpoints(tmp_path, IDENTITY)
    checkpoints.save("optimize", 50, a_state(1))
    checkpoints.save("optimize", 100, a_state(2))
    name, spoil = DAMAGES[damage]
    file = tmp_path / "checkpoints" / "000002-optimize-100" / name
    spoilt = spoil(file.read_bytes())
    file.unlink()
    if spoilt is not None:
        file.write_bytes(spoilt)
    notices: list[str] = []
    assert checkpoints.load(notices.append).step == 50
    assert len(notices) == 1 and "000002-optimize-100" in notices[0]


def test_checkpoint_of_another_run_names_every_field(tmp_path: Path) -> None:
    Checkpoints(tmp_path, IDENTITY).save("optimize", 50, a_state(1))
    other = {"config": {"steps": 20, "sun": [1.0, 2.0]}, "inputs": {"photo": "cd", "asset": "ef"}}
    with pytest.raises(InputError) as caught:
        Checkpoints(tmp_path, other).load(pytest.fail)
    message = caught.value.what
    for words in (
        "config.steps: was 10, is 20",
        'inputs.photo: was "ab", is "cd"',
        'inputs.asset: was "absent", is "ef"',
    ):
        assert words in message
    assert "sun" not in message


def test_checkpoint_all_damaged_says_so(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, IDENTITY)
    checkpoints.save("optimize", 50, a_state(1))
    only = tmp_path / "checkpoints" / "000001-optimize-50"
    (only / STATE).write_bytes(b"")
    with pytest.raises(InputError, match="its sha256 is not the one"):
        checkpoints.load(pytest.fail)
    (only / MANIFEST).unlink()
    with pytest.raises(InputError, match="000001-optimize-50 cannot be used: no such file"):
        checkpoints.load(pytest.fail)


def test_checkpoint_abandoned_parts_are_removed(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, IDENTITY)
    abandoned = tmp_path / "checkpoints" / ".partial-1"
    abandoned.mkdir(parents=True)
    checkpoints.save("optimize", 50, a_state(1))
    assert not abandoned.exists()


def test_checkpoint_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").write_text("in the way")
    with pytest.raises(InputError, match="cannot be written") as caught:
        Checkpoints(tmp_path, IDENTITY).save("optimize", 50, a_state(1))
    assert caught.value.code == ExitCode.RESOURCES


def test_checkpoint_remove(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, IDENTITY)
    checkpoints.save("optimize", 50, a_state(1))
    remove_unfinished(checkpoints.folder)
    assert checkpoints.newest is None and list(tmp_path.iterdir()) == []


@pytest.mark.case("R3")
@pytest.mark.parametrize("key", ["stage", "step", "identity", "state"])
def test_checkpoint_with_an_edited_manifest_is_passed_over(tmp_path: Path, key: str) -> None:
    """One digit of a step is enough for another result: the manifest has a sha256 of its own."""
    checkpoints = Checkpoints(tmp_path, {"seed": 3})
    checkpoints.save("optimize", 3, {"step": 3})
    path = tmp_path / "checkpoints" / "000001-optimize-3" / "manifest.json"
    other = {"stage": "lora", "step": 7, "identity": {"seed": 4}, "state": {"plain": 7}}
    path.write_bytes(rewritten(path.read_bytes(), lambda m: m.update({key: other[key]})))
    with pytest.raises(InputError, match="sha256"):
        checkpoints.load(print)


def test_checkpoint_removal_leaves_what_is_not_ours(tmp_path: Path) -> None:
    """A folder of that name is what every training project has."""
    checkpoints = Checkpoints(tmp_path, {})
    checkpoints.save("optimize", 3, {})
    (tmp_path / "checkpoints" / "model.safetensors").write_text("three days")
    remove_unfinished(checkpoints.folder)
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["model.safetensors"]
