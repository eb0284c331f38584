"""Pictures by the model before and after it was adapted, for a person to judge by looking.

As in figures S1 and S2 of DiPIR (Liang et al. 2024): without class images the adapted model ignores
added words and paints the object in the photo's colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.class_images import Report, to_bytes
from warpir.diffusion.personalization.personalize import personalize
from warpir.diffusion.prompts import Prompts
from warpir.diffusion.settings import PersonalizeSettings

# Neither is part of the other: diffusers would look for the one among the weights of the other.
WITH_CLASS, WITHOUT_CLASS = "scene", "no-class"
TITLES = {
    None: "before",
    WITH_CLASS: "adapted, with class images",
    WITHOUT_CLASS: "adapted, without class images",
}
LABEL_SIZE = 14
"""Height of the letters [px]."""
MARGIN = 6
LABEL_WIDTH = 180
"""Width of the column with the prompts [px]."""


def show_personalization(
    prior: StableDiffusion,
    photo: Tensor,
    prompts: Prompts,
    settings: PersonalizeSettings,
    seed: int,
    cache: Path | None,
    shown: Sequence[str],
    seeds: Sequence[int],
    report: Report | None = None,
) -> NDArray[np.uint8]:
    """Adapt the model to a photo with and without class images, and show what each has learnt.

    A row for each prompt in ``shown``, a column for the model as it was and for each adapter. A
    cell has one picture per seed, side by side; the same seed starts from the same noise in every
    cell. The prior has the adapters `WITH_CLASS` and `WITHOUT_CLASS` afterwards. The photo is as
    for `personalize`; ``report`` is told "samples", the number done and the number in all.

    Returns:
        The labelled sheet, shape [H, W, 3].

    Raises:
        ModelError: As `personalize`.
        NonFiniteError: A picture is not finite.
    """
    without = replace(settings, class_images=0, lora=None)
    for name, chosen in ((WITH_CLASS, settings), (WITHOUT_CLASS, without)):
        personalize(prior, photo, prompts, chosen, seed, cache, name=name, report=report)
    asked, noises = [prompt for prompt in shown for _ in seeds], [*seeds] * len(shown)
    columns = []
    for place, adapter in enumerate(TITLES):
        sample = partial(
            prior.sample, asked, noises, steps=settings.class_steps, scale=settings.class_scale,
            adapter=adapter, batch=settings.class_batch,
        )  # fmt: skip
        made = prior.finite(sample, "pictures")
        columns.append(to_bytes(made).reshape(len(shown), len(seeds), *made.shape[1:]))
        if report:
            report("samples", (place + 1) * len(asked), len(TITLES) * len(asked))
    return contact_sheet(columns, [*TITLES.values()], shown)


def contact_sheet(
    columns: Sequence[Tensor], titles: Sequence[str], prompts: Sequence[str]
) -> NDArray[np.uint8]:
    """Return a sheet with a row per prompt, its text on the left, and titles above the columns.

    Pictures of a column are uint8, shape [prompt, seed, 3, R, R].
    """
    rows, seeds, _, side, _ = columns[0].shape
    font = ImageFont.load_default(LABEL_SIZE)
    cell = seeds * side + MARGIN
    titled = [_wrapped(title, font, cell - MARGIN) for title in titles]
    labels = [_wrapped(prompt, font, LABEL_WIDTH - 2 * MARGIN) for prompt in prompts]
    line = round(LABEL_SIZE * 1.4)
    head = MARGIN + line * max(text.count("\n") + 1 for text in titled)
    height = max(side, *(line * (text.count("\n") + 1) for text in labels)) + MARGIN
    sheet = Image.new("RGB", (LABEL_WIDTH + len(columns) * cell, head + rows * height), "white")
    draw = ImageDraw.Draw(sheet)
    for place, title in enumerate(titled):
        draw.multiline_text((LABEL_WIDTH + place * cell, 2), title, "black", font)
    for row, label in enumerate(labels):
        top = head + row * height
        draw.multiline_text((MARGIN, top), label, "black", font)
        for place, column in enumerate(columns):
            for seed in range(seeds):
                pixels = column[row, seed].permute(1, 2, 0).contiguous().numpy()
                left = LABEL_WIDTH + place * cell + seed * side
                sheet.paste(Image.fromarray(pixels), (left, top))
    return np.array(sheet)


def _wrapped(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int) -> str:
    """Break a text into lines of at most ``width`` pixels, between words."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font.getlength(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return "\n".join(lines)
