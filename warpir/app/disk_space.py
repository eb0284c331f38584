"""How much disk a run will write, and whether there is room for it, before anything heavy loads."""

import os
import shutil
from pathlib import Path

from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs
from warpir.core.errors import ExitCode, InputError

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
    if config.guided_by == "stable-diffusion" and config.settled().adapter.personalize:
        total += config.adapter.lora_rank * RANK_BYTES * LORA_COPIES
    return int(total)


def require_space(out: str | Path, needed: int) -> None:
    """Check that there is room for a run's files.

    Args:
        out: The output folder, which need not be there yet.
        needed: From `needed_bytes`.

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
