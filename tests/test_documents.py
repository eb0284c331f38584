"""Links of the documents lead somewhere, their commands exist, and README lists every page."""

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / name for name in ("README.md", "SECURITY.md", "diffusion/weights/MODEL_CARD.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
PAST = {"benchmarks.light.probe"}
"""Commands of a page that says at which commit they run."""


def anchors(page: Path) -> set[str]:
    """Return the names that GitHub gives the headings of a page."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    heads = (re.sub(r"\]\([^)]*\)", "", head) for head in re.findall(r"^#+ (.*)$", text, re.M))
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def links(page: Path) -> list[tuple[Path, str]]:
    """Return the file and the anchor of every link that stays in the repository."""
    text = page.read_text(encoding="utf-8")
    found = (link.partition("#") for link in re.findall(r"\]\(([^)\s]+)\)", text))
    own = ((file, anchor) for file, _, anchor in found if ":" not in file)
    return [((page.parent / file).resolve() if file else page, anchor) for file, anchor in own]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_documents_lead_somewhere(page: Path) -> None:
    """Files, headings and modules are there."""
    for file, anchor in links(page):
        assert file.exists(), file
        assert not anchor or anchor in anchors(file), (file.name, anchor)
    commands = re.findall(
        r"python -m ((?:warpir|benchmarks|tools)[\w.]*\w)", page.read_text("utf-8")
    )
    assert [name for name in {*commands} - PAST if find_spec(name) is None] == []


def test_readme_lists_every_page() -> None:
    """Nobody finds a page that no line of the README names."""
    listed = {file for file, _ in links(ROOT / "README.md")}
    assert [page.name for page in PAGES[3:] if page not in listed] == []
