"""The pages of a study: static HTML, one file a rater, with images under random names.

Style and program stand in the page, so that it works from a disk; its content security policy
allows no request but for the images beside it. Answers leave it as a file that the rater saves.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from warpir.report.html import render_page
from warpir.study.pairs import Words
from warpir.study.plan import Plan, Rater

SECONDS_PER_PAIR = 12
"""A guess, for the first page."""


@dataclass(frozen=True)
class Images:
    """The files of a pair, in the folder of the pages."""

    a: str
    b: str
    photo: str | None
    width: int
    height: int
    """Of each [px]."""


def page(plan: Plan, rater: Rater, images: Sequence[Images], words: Words) -> bytes:
    """Return the page of one rater."""
    trials = []
    for trial in rater.trials:
        files = images[trial.pair]
        sides = (files.a, files.b) if trial.a_side == 1 else (files.b, files.a)
        trials.append(
            {
                "id": trial.id,
                "images": sides,
                "photo": files.photo,
                "width": files.width,
                "height": files.height,
            }
        )
    return render_page(
        "rater",
        package="warpir.study",
        style="rater",
        images="'self' file: data:",  # of a page on a disk, 'self' is nothing in some browsers
        title=words.title,
        instruction=words.instruction,
        question=words.question,
        contact=words.contact,
        token=rater.token,
        count=len(trials),
        minutes=max(1, math.ceil(len(trials) * SECONDS_PER_PAIR / 60)),
        sheet={"study": plan.id, "rater": rater.token, "trials": trials},
    )
