"""Memory that runs out: what a run needs, the second attempt in halves, and how a run ends then.

What is made in halves is the same to the bit where pixels are cut, and to rounding where a
network's batch is: libraries sum in another order then.
"""

import errno
import json
import resource
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
import warp as wp
from PIL import Image

from tests.builders.faults import run_case, snapshot
from tests.builders.guided_runs import guided_flags
from tests.builders.insertions import arguments, write_inputs
from tests.builders.loops import SETTINGS, STATM, TRACED, a_loop, bent, growth, values
from tests.builders.shapes import camera, ground, placed, sphere
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.core import memory as memory_module
from warpir.core.errors import ExitCode, InputError
from warpir.core.memory import SHORT, Memory, Need, free_host, is_shortage, lacked_memory
from warpir.diffusion.guidance import Guidance
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.class_images import make_class_images
from warpir.diffusion.personalization.lora_files import initial_lora
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import GuidanceSettings, ModelSettings, PersonalizeSettings
from warpir.insert import main
from warpir.render.device_light import light_args
from warpir.render.device_scene import Scene
from warpir.render.mis import samples
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.transport import rows as transport_rows
from warpir.render.transport.integrator import TransportIntegrator
from warpir.scene.asset import Material
from warpir.scene.light import Light

pytestmark = pytest.mark.usefixtures("one_thread")

ADDRESS_SPACE = 2 << 30
"""Room for Python and Warp with its kernels, which a small photo's run just fits into; the layers
of 12 megapixels take as much again (3.9 GB resident without a limit)."""
GROWTH_BYTES = 6 << 20
"""Of 180 steps: what an allocator rounds up and keeps, not what each step would add."""
CUDA_ROUNDING = 1e-4
"""Of the largest value, after sums in another order (float32) and up to three steps of Adam."""


def short(*_: object, **__: object) -> NoReturn:
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")


def warp_short(*_: object, **__: object) -> NoReturn:
    raise RuntimeError("Failed to allocate 21474836480 bytes on device 'cuda:0'")


def failing(
    monkeypatch: pytest.MonkeyPatch,
    owner: object,
    name: str,
    times: int,
    fail: Callable[..., NoReturn] = short,
    when: Callable[..., bool] = lambda *_, **__: True,
) -> None:
    """Let the first calls of a function that fulfil a condition lack memory."""
    original, left = getattr(owner, name), [times]

    def planted(*args: Any, **kwargs: Any) -> Any:
        if left[0] and when(*args, **kwargs):
            left[0] -= 1
            fail()
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, planted)


# ------------------------------------------------------------------------ how it is told


def while_cleaning_up() -> None:
    try:
        short()
    finally:
        raise RuntimeError("CUDA error: operation failed due to a previous error during capture")


@pytest.mark.parametrize(
    "fail",
    [
        pytest.param(short, id="R7-torch-cuda"),
        pytest.param(lambda: torch.empty(10**15), id="R7-torch-cpu"),
        pytest.param(lambda: np.empty(10**15), id="R7-numpy"),
        pytest.param(warp_short, id="R7-warp-cuda"),
        pytest.param(
            lambda: wp.empty((2**24, 2**24), dtype=wp.vec3, device="cpu"), id="R7-warp-cpu"
        ),
        pytest.param(while_cleaning_up, id="R7-recording"),
    ],
)
def test_shortages_are_known(fail: Callable[[], None]) -> None:
    """The words of every library, taken from the library where this machine can make it fail."""
    with pytest.raises((MemoryError, RuntimeError)) as caught:
        fail()
    assert is_shortage(caught.value)


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("shape mismatch"),
        ValueError("out of memory"),
        InputError("--width", "not enough memory"),
        OSError(errno.ENOSPC, "No space left on device"),
    ],
)
def test_other_errors_are_no_shortage(error: Exception) -> None:
    assert not is_shortage(error)
    assert is_shortage(OSError(errno.ENOMEM, "Cannot allocate memory"))


def test_other_cards_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp makes a context on whatever card is to be waited for, or fails where it may not."""
    used, other = (SimpleNamespace(has_context=has) for has in (True, False))
    waited: list[SimpleNamespace] = []
    fake = SimpleNamespace(
        is_cuda_available=lambda: True,
        get_cuda_devices=lambda: [other, used],
        synchronize_device=waited.append,
    )
    monkeypatch.setitem(sys.modules, "warp", fake)
    memory_module.release()
    assert waited == [used]


# -------------------------------------------------------------------- the second attempt


class Making:
    """Makes numbers from a range, and lacks memory for more than some at once."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.asked: list[tuple[int, int]] = []

    def __call__(self, start: int, stop: int) -> list[int]:
        self.asked.append((start, stop))
        if stop - start > self.room:
            raise MemoryError
        return [*range(start, stop)]


@pytest.mark.parametrize(
    ("count", "room", "asked"),
    [
        pytest.param(7, 7, [(0, 7)], id="R7-fits"),
        pytest.param(7, 4, [(0, 7), (0, 4), (4, 7)], id="R7-halves"),
        pytest.param(0, 0, [(0, 0)], id="R7-nothing"),
    ],
)
def test_chunks_hold_everything_once(count: int, room: int, asked: list[tuple[int, int]]) -> None:
    said: list[str] = []
    memory, making = Memory(say=said.append), Making(room)
    made = [n for part in memory.in_chunks(making, count, "numbers", "--width") for n in part]
    assert made == [*range(count)] and making.asked == asked
    assert memory.retries == ({"numbers": 1} if len(asked) > 1 else {})
    assert len(said) == len(list(memory.notices())) == len(memory.retries)


@pytest.mark.parametrize(
    ("count", "room", "words", "attempts"),
    [
        pytest.param(8, 3, "in one piece and in halves", 2, id="R7-halves-too-large"),
        pytest.param(1, 0, "tried twice", 2, id="R7-one-too-large"),
    ],
)
def test_one_retry_then_the_flag(count: int, room: int, words: str, attempts: int) -> None:
    """Exit code 5 with what to lower and what is free, after exactly one smaller attempt."""
    making = Making(room)
    with pytest.raises(InputError, match=words) as caught:
        list(Memory().in_chunks(making, count, "numbers", "--width"))
    assert len(making.asked) == attempts
    assert caught.value.code == ExitCode.RESOURCES and caught.value.where == "--width"
    assert caught.value.reason == SHORT and lacked_memory(caught.value)
    assert "MiB of the host" in caught.value.what and "--width" in caught.value.advice
    assert caught.value.__suppress_context__


def test_other_errors_are_not_tried_again() -> None:
    calls = []

    def fail(start: int, stop: int) -> None:
        calls.append(start)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(Memory().in_chunks(fail, 4, "numbers", "--width"))
    assert calls == [0]


def test_first_attempt_is_freed_before_the_second() -> None:
    """What the first attempt had made would take the memory that the second needs."""

    class Large:
        alive = 0

        def __init__(self) -> None:
            Large.alive += 1

        def __del__(self) -> None:
            Large.alive -= 1

    seen = []

    def make(start: int, stop: int) -> None:
        seen.append(Large.alive)
        held = Large()
        if stop - start == 4:
            raise MemoryError(str(held))

    list(Memory().in_chunks(make, 4, "numbers", "--width"))
    assert seen == [0, 0, 0]


# ----------------------------------------------------------------------- before the work


def test_needs_beyond_doubt_are_refused() -> None:
    """Up to twice the free memory an estimate may be wrong; beyond it the run cannot work."""
    said: list[str] = []
    memory, free = Memory(say=said.append), free_host()
    memory.require(Need("photo", free // 4, "--photo"), on_host=True)
    assert not said and not memory.doubts
    memory.require(Need("photo", free + free // 4, "--photo"), Need("mesh", 9, "--asset"))
    assert len(said) == 1 and "--photo" in said[0] and "MiB" in said[0]
    assert [*memory.notices()] == memory.doubts
    with pytest.raises(InputError, match="MiB") as caught:
        memory.require(Need("photo", free, "--photo"), Need("mesh", 2 * free, "--asset"))
    assert caught.value.code == ExitCode.RESOURCES and caught.value.where == "--asset"
    assert lacked_memory(caught.value)
    assert not lacked_memory(InputError("out", "no memory card", code=ExitCode.RESOURCES))


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        pytest.param({}, None, id="R7-no-system-to-ask"),
        pytest.param({"meminfo": "MemTotal: 9 kB\nMemAvailable: 3000 kB\n"}, 3000, id="R7-system"),
        pytest.param(
            {
                "meminfo": "MemAvailable: 3000 kB\n",
                "self/cgroup": "0::/a/b\n",
                "groups/a/memory.max": f"{2000 << 10}\n",
                "groups/a/memory.current": f"{1500 << 10}\n",
                "groups/a/memory.stat": f"file 7\ninactive_file {100 << 10}\n",
                "groups/a/b/memory.max": "max\n",
            },
            600,
            id="R7-group-above-v2",
        ),
        pytest.param(
            {
                "meminfo": "MemAvailable: 3000 kB\n",
                "self/cgroup": "9:cpu:/x\n4:memory:/a\n0::/\n",
                "groups/memory/memory.limit_in_bytes": f"{700 << 10}\n",
                "groups/memory/memory.usage_in_bytes": f"{800 << 10}\n",
            },
            0,
            id="R7-group-v1-container",
        ),
    ],
)
def test_free_memory_is_the_least_that_is_told(
    files: dict[str, str], expected: int | None, tmp_path: Path
) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    free = free_host(tmp_path, tmp_path / "groups")
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    assert limit == resource.RLIM_INFINITY, "this test's process has no limit of its own"
    assert free > 1 << 60 if expected is None else free == expected << 10


def test_preflight_refuses_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A photo of 3072 pixels whose layers do not fit by far: numbers and flag, no output folder."""
    write_inputs(tmp_path)
    before = snapshot(tmp_path)
    monkeypatch.setattr(memory_module, "free_host", lambda: 1000)
    assert main(arguments(tmp_path, tmp_path / "out")) == ExitCode.RESOURCES
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("error: --photo") and "MiB" in lines[0] and len(lines) == 2
    assert snapshot(tmp_path) == before


# ------------------------------------------------------------------ rendering in halves


def a_scene(device: str) -> Renderer:
    ball = placed(
        sphere((0.0, 0.5, -3.5), 0.5, detail=3), Material(base_color=(0.7, 0.5, 0.4), roughness=0.3)
    )
    view = camera(36, 24, 50.0, (0.0, 1.2, 0.0), pitch=-12.0)
    return Renderer(Scene([ball], view, ground(0.0), device))


def sky(seed: int = 0) -> Light:
    texels = np.random.default_rng(seed).uniform(0.1, 2.0, (12, 24, 3))
    return Light(texels=texels.astype(np.float32))


def render_all(renderer: Renderer) -> list[np.ndarray[Any, Any]]:
    """Return everything that the renderer traces of a scene."""
    light = light_args(sky(), renderer.device)
    gbuffer = renderer.gbuffer(1)
    seen = renderer.foreground(light, gbuffer.object_pixels, 8, 1, 3, 1)
    shaded = shaded_pixels(renderer, light, 1)
    plane = renderer.receiver(light, shaded, np.zeros(len(shaded), np.int32), 8, 1, 1)
    groups = (gbuffer, seen, plane)
    return [shaded, *(array for group in groups for array in vars(group).values())]


@pytest.mark.parametrize("fail", [short, warp_short], ids=["R7-torch", "R7-warp"])
@pytest.mark.parametrize("stage", ["geometry", "object", "shadow"])
def test_rendering_in_halves_is_the_same(
    device: str, stage: str, fail: Callable[[], NoReturn], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every number of a picture depends on its pixel and sample alone: equal to the bit."""
    expected = render_all(a_scene(device))
    renderer = a_scene(device)
    failing(monkeypatch, renderer, "launch", 1, fail, lambda *args: args[4] == stage)
    found = render_all(renderer)
    assert sum(renderer.memory.retries.values()) == 1
    assert stage in next(iter(renderer.memory.retries))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("stage", ["geometry", "object", "shadow"])
def test_rendering_fails_with_the_flag(
    device: str, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    renderer = a_scene(device)
    failing(monkeypatch, renderer, "launch", 2, short, lambda *args: args[4] == stage)
    with pytest.raises(InputError, match=stage) as caught:
        render_all(renderer)
    assert caught.value.code == ExitCode.RESOURCES and caught.value.where == "--width"


def transported(device: str) -> TransportIntegrator:
    renderer = a_scene(device)
    objects = renderer.gbuffer(1).object_pixels
    proxies = shaded_pixels(renderer, light_args(sky(), renderer.device), 1)
    return TransportIntegrator(renderer, objects, proxies, 2, TRACED, sky(), 1)


def same(found: torch.Tensor, expected: torch.Tensor, tolerance: float = 0.0) -> None:
    """Compare; on CUDA threads add in any order, which rounds a few of float32's last bits."""
    if expected.is_cuda:
        tolerance = max(tolerance, CUDA_ROUNDING)
    scale = float(expected.abs().max()) if expected.numel() else 0.0
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance * scale)


@pytest.mark.case("R7")
@pytest.mark.parametrize(
    "name", ["trace_direct", "trace_paths", "trace_blocked"], ids=lambda n: f"R7-{n}"
)
@pytest.mark.slow
def test_tracing_in_halves_is_the_same(
    device: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of light transport, traced in two halves: equal to the bit where sums have an order."""
    expected = transported(device)
    kernel = getattr(transport_rows, name)
    failing(monkeypatch, Renderer, "launch", 1, warp_short, lambda *args: args[1] is kernel)
    found = transported(device)
    assert found.renderer.memory.retries == {transport_rows.TRACING: 1}
    same(found.T_fg.T, expected.T_fg.T)
    same(found.emission, expected.emission)
    same(found.T_shadow.by_row.to_dense(), expected.T_shadow.by_row.to_dense())


# ----------------------------------------------------------------------- optimisation


@pytest.mark.case("R7")
@pytest.mark.parametrize(
    ("owner", "name", "integrator"),
    [
        pytest.param(torch.autograd, "backward", "transport", id="R7-tape"),
        pytest.param(torch.autograd, "backward", "mis", id="R7-tape-mis"),
        pytest.param(samples, "new_light_record", "mis", id="R7-records"),
    ],
)
def test_step_is_taken_again(
    device: str, owner: object, name: str, integrator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step that is rendered and differentiated once more leads to the same unknowns."""
    settings = replace(SETTINGS, steps=3, integrator=integrator)
    ends = []
    for times in (0, 1):
        loop = a_loop(device, settings=settings, unknowns=bent())
        failing(monkeypatch, owner, name, times)
        loop.run()
        monkeypatch.undo()
        assert sum(loop.memory.retries.values()) == times
        ends.append(values(loop))
    if device != "cpu":  # Adam makes steps of rounding errors, where a gradient is nothing else
        return
    for key, value in ends[0].items():
        # A record in two parts is summed part by part.
        same(ends[1][key], value, 1e-5 if name == "new_light_record" else 0.0)


@pytest.mark.case("R7")
def test_step_without_memory_changes_nothing(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two attempts, then exit code 5 with the flag; unknowns and counts are those of before."""
    loop = a_loop(device, unknowns=bent())
    loop.step()
    before, state = values(loop), replace(loop.state)
    failing(monkeypatch, torch.autograd, "backward", 2)
    with pytest.raises(InputError, match="gradient") as caught:
        loop.step()
    assert (caught.value.code, caught.value.where) == (ExitCode.RESOURCES, "--guidance-width")
    assert all(torch.equal(value, before[name]) for name, value in values(loop).items())
    assert loop.state == state


@pytest.mark.slow
@pytest.mark.skipif(not STATM.exists(), reason="the system does not tell a process its memory")
@pytest.mark.case("R7")
@pytest.mark.parametrize("integrator", ["transport", "mis"])
def test_memory_is_flat_over_200_steps(device: str, integrator: str) -> None:
    """Resident memory after step 200 is that after step 20."""
    settings = replace(SETTINGS, steps=200, integrator=integrator, score_every=20)
    steps, host, on_device = growth(device, settings)
    assert steps == 200 and host < GROWTH_BYTES and on_device <= GROWTH_BYTES


# ---------------------------------------------------------------------------- the model


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_stable_diffusion(tmp_path_factory.mktemp("model"))


def watched(folder: Path, device: str) -> tuple[StableDiffusion, Memory]:
    settings = ModelSettings(model=str(folder), precision="fp32", vae_precision="fp32")
    memory = Memory()
    return load_stable_diffusion(settings, device, memory.in_chunks), memory


@pytest.mark.case("R7")
def test_guidance_in_halves_is_the_same(
    device: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The UNet lacks memory for four noises: twice two, and the VAE keeps less from then on."""
    image = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(1)).to(device)
    mask = torch.zeros(64, 64)
    mask[20:40, 20:44] = 1.0
    settings = GuidanceSettings(loss="csd", noises=4)
    found = []
    for times in (0, 1):
        prior, memory = watched(folder, device)
        guide = Guidance(prior, "a box", settings, mask, 10, 0, None)
        failing(monkeypatch, prior.unet, "forward", times)
        found.append(guide.gradient(image, 3))
        assert memory.retries == ({"guidance": 1} if times else {})
        assert prior.vae.encoder.gradient_checkpointing is bool(times)
    expected, halved = (d_image for d_image in found if d_image is not None)
    scale = float(expected.abs().max())
    tolerance = 1e-3 if device == "cuda" else 1e-4  # convolutions of other sizes, in TF32
    torch.testing.assert_close(halved, expected, rtol=tolerance, atol=tolerance * scale)


@pytest.mark.case("R7")
def test_guidance_without_memory_names_noises(
    device: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prior, _ = watched(folder, device)
    mask = torch.ones(64, 64)
    settings = GuidanceSettings(loss="csd", noises=2)
    guide = Guidance(prior, "a box", settings, mask, 10, 0, None)
    failing(monkeypatch, prior.unet, "forward", 2)
    with pytest.raises(InputError, match="guidance") as caught:
        guide.gradient(torch.rand(1, 3, 64, 64, device=device), 0)
    assert caught.value.code == ExitCode.RESOURCES and "--noises" in caught.value.where


@pytest.mark.case("R7")
def test_class_images_in_halves_are_the_same(
    device: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch of four pictures, then two of two; rounding may move a code by one."""
    settings = PersonalizeSettings(class_images=4, class_steps=2, class_batch=4)
    prompts = make_prompts("a red box", settings)
    made = []
    for times in (0, 1):
        prior, memory = watched(folder, device)
        failing(monkeypatch, prior.unet, "forward", times)
        made.append(make_class_images(prior, prompts, settings, 0, None).images.int())
        assert memory.retries == ({"pictures of the class": 1} if times else {})
    assert int((made[0] - made[1]).abs().max()) <= 1


@pytest.mark.case("R7")
def test_lora_step_in_parts_is_the_same(device: str, folder: Path) -> None:
    """The photo's sample and the class' one after the other: losses and gradient are the same."""
    settings = PersonalizeSettings(lora_steps=1, lora_class_batch=3)
    random = torch.Generator().manual_seed(2)
    photo, classes = (torch.randn(3, 4, 8, 8, generator=random) for _ in range(2))
    ends = []
    for parts in (1, 4):
        prior, _ = watched(folder, device)
        embeddings = prior.embed(["a photo", "a box"])
        lora = initial_lora(prior, settings.lora_layers, settings.lora_rank, 0)
        with LoraTraining(prior, lora, photo, classes, embeddings, settings, 0) as training:
            training.part_count = parts
            training.prepare(0)
            training.update()
            training.count_step()
            gradients = [p.grad for p in training.parameters.values() if p.grad is not None]
            ends.append((torch.cat([g.flatten() for g in gradients]), training.losses()))
    (whole, losses), (parted, losses_parted) = ends
    # On CUDA the training computes in bf16.
    tolerance = 1e-5 if device == "cpu" else 2e-2
    assert float(whole.norm()) > 0.0
    assert float((parted - whole).norm() / whole.norm()) < tolerance
    torch.testing.assert_close(losses_parted, losses, rtol=tolerance, atol=0.0)


# ---------------------------------------------------------------------------- whole runs


@pytest.mark.slow
@pytest.mark.skipif(wp.is_cuda_available(), reason="CUDA's libraries alone take more than that")
@pytest.mark.case("R7")
def test_address_space_of_2_gb_ends_with_5(guided_inputs: Path, tmp_path: Path) -> None:
    """Doubted before the work, then one line, and nothing is left of the run."""
    photo = tmp_path / "large.png"
    Image.new("RGB", (4096, 3072)).save(photo)
    before = snapshot(tmp_path)
    flags = arguments(guided_inputs, tmp_path / "out", photo=str(photo), width="64")
    ended = run_case(flags, tmp_path, address_space=ADDRESS_SPACE)
    assert ended.status == ExitCode.RESOURCES, ended
    lines = ended.err.splitlines()
    assert [line for line in lines if line.startswith("error:")] == lines[:1]
    assert "memory" in lines[0] and "MiB" in lines[0] and "Traceback" not in ended.err
    assert "memory may be short" in ended.out
    assert snapshot(tmp_path) == before and not ended.children


@pytest.mark.slow
@pytest.mark.case("R7")
@pytest.mark.parametrize(
    ("owner", "name", "words"),
    [
        pytest.param(Renderer, "launch", "the object", id="R7-render"),
        pytest.param(wp, "Mesh", "the scene", id="R7-BVH"),
    ],
)
def test_short_run_leaves_the_old_result_whole(
    guided_inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    owner: object,
    name: str,
    words: str,
) -> None:
    """Once too little: the same picture, counted in run.json. Twice: exit code 5, all as it was."""
    out = tmp_path / "out"
    flags = [*arguments(guided_inputs, out), "--overwrite"]
    assert main(flags) == ExitCode.DONE
    before = snapshot(tmp_path)

    def when(*args: object, **_: object) -> bool:
        return owner is not Renderer or args[5] == "object"

    failing(monkeypatch, owner, name, 9, warp_short, when)
    capsys.readouterr()
    assert main(flags) == ExitCode.RESOURCES
    lines = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("error:") for line in lines) == 1
    assert words in lines[0] and lines[0].startswith("error: --") and "MiB" in lines[0]
    assert snapshot(tmp_path) == before
    monkeypatch.undo()
    # The preview's renderer is the first that lacks memory; the last render is another one.
    failing(monkeypatch, owner, name, 1, warp_short, when)
    assert main(flags) == ExitCode.DONE
    run = json.loads((out / "run.json").read_text())
    assert sum(run["measured"]["memory_retries"].values()) == 1
    assert any("memory was short" in notice for notice in run["notices"])
    after = snapshot(tmp_path)
    told = ("run.json", "report.html")  # that it was tried again
    assert {k: v for k, v in after.items() if not k.endswith(told)} == {
        k: v for k, v in before.items() if not k.endswith(told)
    }


@pytest.mark.slow
@pytest.mark.case("R7")
def test_short_guided_run_keeps_its_checkpoint(
    guided_inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Out of memory in step 3 of 4: exit code 5, and --resume goes on from step 2."""
    monkeypatch.setenv("WARPIR_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "out"
    unadapted = {"loss": "csd", "no_personalize": ""}  # so that all steps are the light's
    flags = guided_flags(guided_inputs, out, steps="4", checkpoint_every="2", **unadapted)
    calls = [0]

    def later(*_: object, **__: object) -> bool:
        calls[0] += 1
        return calls[0] > 2

    failing(monkeypatch, torch.autograd, "backward", 9, short, later)
    assert main(flags) == ExitCode.RESOURCES
    captured = capsys.readouterr()
    assert "kept:" in captured.out and "--guidance-width" in captured.err
    assert len(list((out / "checkpoints").glob("*-optimize-2/manifest.json"))) == 1
    assert not (out / "run.json").exists()
    monkeypatch.undo()
    monkeypatch.setenv("WARPIR_CACHE", str(tmp_path / "cache"))
    assert main([*flags, "--resume"]) == ExitCode.DONE
    assert "resumed: optimize, step 2" in capsys.readouterr().out
