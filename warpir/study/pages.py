"""The pages of a study: static HTML, one file a rater, with images under names that tell nothing.

Style and program stand in the page, so that it works from a disk; the policy in its head allows
them by their sha256 and no request but for the images beside it and, where it is served, for saving
the answers.
"""

import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

from warpir.report.html import source_hash
from warpir.study.pairs import Words
from warpir.study.plan import Plan, Rater

SECONDS_PER_PAIR = 12
"""A guess, for the first page."""
STATIC, SERVED = b'<body data-save="download">', b'<body data-save="server">'
"""How a page begins as a file, and as the server gives it: there it can save answers."""


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
    """Return the page of one rater.

    Args:
        plan: The study.
        rater: Whose page it is.
        images: Of each pair of the plan.
        words: What is read on it.
    """
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
    sheet = {"study": plan.id, "rater": rater.token, "trials": trials}
    style, script = _source("css"), _source("js")
    policy = (
        "default-src 'none'; base-uri 'none'; form-action 'none'; connect-src 'self'; "
        # Of a page on a disk, 'self' is nothing in some browsers.
        f"img-src 'self' file: data:; style-src {source_hash(style.encode())}; "
        f"script-src {source_hash(script.encode())}"
    )
    minutes = max(1, math.ceil(len(trials) * SECONDS_PER_PAIR / 60))
    texts = {
        "title": words.title,
        "instruction": words.instruction,
        "question": words.question,
        "contact": words.contact,
        "token": rater.token,
        "count": str(len(trials)),
        "minutes": str(minutes),
        "policy": policy,
    }
    filled = {name: html.escape(text) for name, text in texts.items()}
    # JSON in a page may hold no end of its element, nor of a comment.
    filled["sheet"] = json.dumps(sheet).replace("<", "\\u003c")
    return _fill(_source("html"), filled | {"style": style, "script": script}).encode()


def _fill(template: str, values: Mapping[str, str]) -> str:
    """Put values in the places of ``{name}``, once: what is put in is not looked at again."""
    parts = template.split("{")
    filled = [parts[0]]
    for part in parts[1:]:
        name, _, rest = part.partition("}")
        filled += [values[name], rest]
    return "".join(filled)


@cache
def _source(kind: str) -> str:
    return (resources.files("warpir.study") / "templates" / f"page.{kind}.in").read_text(
        encoding="utf-8"
    )
