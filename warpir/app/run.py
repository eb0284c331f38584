"""One run: what all of its stages share, and what it needs of disk and memory."""

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import warpir
from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs
from warpir.app.record import RUN_FORMAT, Timings, versions
from warpir.core.cache import take_notices
from warpir.core.errors import ExitCode, InputError
from warpir.core.memory import (
    PHOTO_BYTES,
    Memory,
    Need,
    needs_of_scene,
    peak_mib,
    share_device,
)
from warpir.core.progress import Log, StepProgress
from warpir.io.results import OutputFolder

LAYER_BYTES = 18
"""Of ``layers.exr`` per pixel of an 8-bit photo: the half floats of composite, plate and shadow
without compression. The others are constant but for the object, and shrink to next to nothing (the
demo's file has 8 bytes a pixel)."""
TEXEL_BYTES = 22
"""Of a map: floats in EXR, RGBE, a preview, without compression."""
VERTEX_BYTES, TRIANGLE_BYTES = 48, 12
"""Of ``object.glb``: position, normal, tangent, texture coordinates; three indices."""
MAP_TEXELS = 512 * 1024
"""Of a map that is made from lobes or recovered."""
REST_BYTES = 4 * 2**20
"""Of everything whose size does not depend on the inputs, and of a small picture's headers."""
RANK_BYTES = 0.8 * 2**20
"""Of a LoRA for Stable Diffusion, per rank."""
LORA_COPIES = 2 + 3 * 3
"""Two files; three checkpoints, one being written, of weights and both moments of the optimiser."""


@dataclass(frozen=True)
class Run:
    """What is asked, what was read for it, where it goes, and the records that stages add to."""

    config: InsertConfig
    inputs: Inputs
    output: OutputFolder
    log: Log = field(default_factory=Log)
    timings: Timings = field(default_factory=Timings)
    memory: Memory = field(default_factory=Memory)
    """Counts what was tried again where memory was short."""
    progress: StepProgress = field(default_factory=lambda: StepProgress(lambda _: None))
    """Of long stages."""
    device: str = "cpu"
    """Warp device, once it is chosen; torch uses the same."""

    def require_room(self) -> None:
        """Compare what will be written, and the host's part of the work, with what is free.

        Raises:
            InputError: Disk or memory do not suffice (`ExitCode.RESOURCES`).
        """
        of_photo, of_scene = memory_needs(self.inputs)
        require_space(self.output.path, needed_bytes(self.config, self.inputs))
        self.memory.require(of_photo, *of_scene, on_host=True)

    def on_device(self, device: str) -> "Run":
        """Return the run on a device; Warp is loaded.

        Raises:
            InputError: The scene is certain not to fit (`ExitCode.RESOURCES`).
        """
        self.memory.device = device
        share_device(device)
        if device != "cpu":
            self.memory.require(*memory_needs(self.inputs)[1])
        self.log.say(f"device: {device} (the first run compiles the kernels)")
        return replace(self, device=device)

    def with_ground_coat(self) -> "Run":
        """Return the run with the ground's roughness, where the photo is to tell it."""
        if self.config.render.ground_roughness != "auto":
            return self
        from warpir.look.ground_coat import estimate_coat  # loads SciPy

        inputs = self.inputs
        up = np.asarray(inputs.placement.ground, np.float64)[:3]
        coat = estimate_coat(inputs.photo.linear(), inputs.camera, up / np.linalg.norm(up))
        self.log.assume(coat.line)
        return replace(
            self,
            config=self.config.changed(
                ground_roughness="off" if coat.roughness is None else coat.roughness
            ),
            inputs=replace(inputs, measured=inputs.measured | {"ground_coat": coat.record()}),
        )

    def take_cache_notices(self) -> None:
        """Add what a cache has had to say since the last call."""
        self.log.notice(*take_notices())

    def record(
        self, asked: Mapping[str, Any], device: str, measured: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the content of ``run.json``; ``--config run.json`` runs it again.

        Args:
            asked: What was asked for, from `InsertConfig.flat`; how the folder was found is left
                out, as a resumed run leaves what an uninterrupted one does. The demo's files are no
                part of it.
            device: Name of what computed it, such as ``cpu`` or that of a card.
            measured: Plain numbers about the result, such as photometry and clamped pixels.
        """
        return {
            "format": RUN_FORMAT,
            "warpir": warpir.__version__,
            "config": {**asked, "resume": False, "overwrite": False},
            "inputs": dict(self.inputs.hashes),
            "assumed": list(self.log.assumed),
            "notices": list(self.log.notices),
            "measured": dict(measured),
            "device": device,
            "versions": versions(),
            "seconds": self.timings.rounded(),
            "peak_mib": peak_mib(),
        }


def needed_bytes(config: InsertConfig, inputs: Inputs) -> int:
    """Estimate what a run writes [byte]; old results stay until the new ones are whole."""
    photo, asset = inputs.photo, inputs.asset
    pixels = photo.codes.shape[0] * photo.codes.shape[1]
    png = 3 * (2 if photo.is_deep else 1)
    total = float(REST_BYTES) + pixels * (png + LAYER_BYTES * (2 if photo.is_deep else 1))
    texels = MAP_TEXELS
    if inputs.light is not None and inputs.light.texels is not None:
        texels = max(texels, inputs.light.texels.shape[0] * inputs.light.texels.shape[1])
    total += texels * TEXEL_BYTES * (2 if config.is_guided else 1)
    mesh = sum(
        VERTEX_BYTES * len(p.positions) + TRIANGLE_BYTES * len(p.indices) for p in asset.primitives
    )
    mesh += sum(3 * t.pixels.shape[0] * t.pixels.shape[1] for t in asset.textures)
    if config.output.hand_off:
        total += pixels * png + texels * 4 + mesh
    if config.output.mitsuba:
        total += texels * 12 + mesh
    if config.output.usd:
        total += texels * TEXEL_BYTES + mesh
    if config.is_guided and config.adapter.personalize:
        total += config.adapter.lora_rank * RANK_BYTES * LORA_COPIES
    return int(total)


def require_space(out: str | Path, needed: int) -> None:
    """Check that there is room for a run's files.

    Raises:
        InputError: There is less (`ExitCode.RESOURCES`).
    """
    folder = Path(out).absolute()
    while not os.path.lexists(folder):
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(
            out,
            f"not enough disk space (found {free / 2**20:.0f} MiB free; expected about "
            f"{needed / 2**20:.0f} MiB for the results)",
            "free some, or name an --out on another disk",
            ExitCode.RESOURCES,
        )


def memory_needs(inputs: Inputs) -> tuple[Need, tuple[Need, ...]]:
    """Return what photo and layers need of the host, and the scene of the renderer's device."""
    height, width = inputs.photo.codes.shape[:2]
    asset = inputs.asset
    scene = needs_of_scene(
        sum(len(part.positions) for part in asset.primitives),
        sum(len(part.indices) for part in asset.primitives),
        sum(texture.pixels[..., 0].size for texture in asset.textures),
    )
    return Need("photo and layers", PHOTO_BYTES * height * width, "--photo (fewer pixels)"), scene
