"""The pairs of a study as a person lists them: a manifest, or a folder of scenes.

    {"method": "warpir",
     "scenes": {"street": {"group": "sunny", "photo": "street/photo.png",
                           "images": {"warpir": "street/a.png", "pasted": "street/b.png"}}},
     "catches": [{"scene": "yard", "better": "yard/a.png", "worse": "yard/c.png",
                  "how": "the object pasted without shadow"}],
     "title": "...", "instruction": "...", "question": "...", "contact": "..."}

A folder holds one folder a scene, in it an image for each method, named after it, and ``photo.png``
(or ``.jpg`` and so on) where the untouched photo is known. Paths are relative to the manifest.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warpir.app.config import usage
from warpir.core.errors import InputError, raise_all, shown
from warpir.core.strict_json import read_json_object
from warpir.study.plan import ALL, UNGROUPED, Pair

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
PHOTO = "photo"
"""Stem of the untouched photo in a scene's folder."""
LONGEST_NAME = 100
LONGEST_TEXT = 4000
"""Of what raters read [characters]."""

INSTRUCTION = (
    "A program has placed one extra object into a photo; two versions of the picture are shown. "
    "Find the object, zoom in, and compare its highlights, its reflections and its shadow."
)
QUESTION = "Which of the two could more easily be an unedited photograph?"
"""Both in our words, after DiPIR's supplement C.1."""


@dataclass(frozen=True)
class Words:
    """What raters read on the pages, and may be replaced in a manifest."""

    title: str = "Which picture looks real?"
    instruction: str = INSTRUCTION
    question: str = QUESTION
    contact: str = "Ask the person who gave you this link."
    """Who answers for the study."""


@dataclass(frozen=True)
class Shown:
    """A pair and its files."""

    pair: Pair
    a: Path
    b: Path | None
    """None for a catch pair whose worse image is generated from `a` and the photo."""
    photo: Path | None = None
    """The untouched photo, which is shown beside the pair on demand."""


@dataclass(frozen=True)
class Material:
    """Method, pairs and texts of a study."""

    method: str
    """Name of the method that all others are compared with."""
    shown: tuple[Shown, ...]
    words: Words = field(default_factory=Words)


def read_material(source: Path, method: str | None) -> Material:
    """Read a manifest or a folder of scenes.

    Args:
        source: The file or folder.
        method: Of a folder, the stem of the images of the method that is compared with all others.

    Raises:
        InputError: It is missing or wrong, or a file it names is not there; all that is wrong with
            it is listed.
    """
    if os.path.isdir(source):
        if method is None:
            raise usage("--method", "needed with a folder", f"which images in {source} count?")
        return _read_folder(source, method)
    if method is not None:
        raise usage("--method", "a manifest names its method itself", "leave it out")
    return _material(source, source.parent, read_json_object(source))


def _read_folder(folder: Path, method: str) -> Material:
    try:
        scenes = _scenes_of(folder)
    except OSError as error:
        raise InputError(folder, f"cannot be read ({error.strerror})") from error
    return _material(folder, folder, {"method": method, "scenes": scenes})


def _scenes_of(folder: Path) -> dict[str, Any]:
    scenes: dict[str, Any] = {}
    for place in sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")):
        images: dict[str, str] = {}
        for path in sorted(p for p in place.iterdir() if p.suffix.lower() in SUFFIXES):
            if path.stem in images:
                raise InputError(path, f"two images are called {shown(path.stem)}", "keep one")
            images[path.stem] = f"{place.name}/{path.name}"
        photo = images.pop(PHOTO, None)
        scenes[place.name] = {"images": images, **({"photo": photo} if photo else {})}
    return scenes


def _material(where: Path, folder: Path, root: Mapping[str, Any]) -> Material:
    problems: list[InputError] = []
    reader = _Reader(where, folder, problems)
    reader.keys("", root, {"method", "scenes"}, {"catches", *vars(Words())})
    method = reader.name("/method", root.get("method"))
    words = Words(
        **{name: reader.text(f"/{name}", root[name]) for name in vars(Words()) if name in root}
    )
    found: list[Shown] = []
    scenes = reader.mapping("/scenes", root.get("scenes"))
    for scene, content in scenes.items():
        found += reader.scene(scene, content, method)
    catches = root.get("catches", [])
    if not isinstance(catches, list):
        reader.wrong("/catches", "a list expected")
        catches = []
    found += [reader.catch(f"/catches/{k}", content) for k, content in enumerate(catches)]
    if not problems and not any(not s.pair.is_catch for s in found):
        reader.wrong("/scenes", "no pairs (expected a scene with an image of the method and more)")
    raise_all(problems)
    return Material(method, tuple(found), words)


class _Reader:
    """Reads the parts of a manifest and collects what is wrong with them."""

    def __init__(self, where: Path, folder: Path, problems: list[InputError]) -> None:
        self.where = where
        self.folder = folder
        self.problems = problems

    def wrong(self, pointer: str, what: str) -> None:
        self.problems.append(InputError(self.where, f"{pointer}: {what}"))

    def keys(
        self, pointer: str, found: Mapping[str, Any], needed: set[str], more: set[str]
    ) -> None:
        for key in sorted(needed - set(found)):
            self.wrong(pointer or "/", f"{key} is missing")
        for key in sorted(set(found) - needed - more):
            known = ", ".join(sorted(needed | more))
            self.wrong(pointer or "/", f"unknown key {shown(key)} (expected {known})")

    def mapping(self, pointer: str, value: Any) -> dict[str, Any]:
        if isinstance(value, dict):
            return value
        self.wrong(pointer, "an object expected")
        return {}

    def text(self, pointer: str, value: Any, longest: int = LONGEST_TEXT) -> str:
        if isinstance(value, str) and 0 < len(value.strip()) <= longest:
            return value
        self.wrong(pointer, f"a text of 1 to {longest} characters expected")
        return ""

    def name(self, pointer: str, value: Any) -> str:
        return self.text(pointer, value, LONGEST_NAME)

    def file(self, pointer: str, value: Any) -> Path:
        path = self.folder / self.text(pointer, value)
        if isinstance(value, str) and value and not os.path.isfile(path):  # of any name
            self.problems.append(InputError(path, f"no such file ({pointer} of {self.where})"))
        return path

    def scene(self, scene: str, content: Any, method: str) -> list[Shown]:
        pointer = f"/scenes/{scene[:LONGEST_NAME]}"
        self.name(pointer, scene)
        content = self.mapping(pointer, content)
        self.keys(pointer, content, {"images"}, {"group", "photo"})
        group = self.name(f"{pointer}/group", content["group"]) if "group" in content else ""
        if group in (ALL, UNGROUPED):
            self.wrong(f"{pointer}/group", f"{shown(group)} is a row's own name")
        photo = self.file(f"{pointer}/photo", content["photo"]) if "photo" in content else None
        images = {
            self.name(f"{pointer}/images", name): self.file(f"{pointer}/images/{name}", value)
            for name, value in self.mapping(f"{pointer}/images", content.get("images")).items()
        }
        if method not in images:
            self.wrong(f"{pointer}/images", f"no image of the method {shown(method)}")
            return []
        a = images.pop(method)
        return [Shown(Pair(scene, group, name), a, b, photo) for name, b in images.items()]

    def catch(self, pointer: str, content: Any) -> Shown:
        content = self.mapping(pointer, content)
        self.keys(pointer, content, {"scene", "better", "worse", "how"}, {"photo"})
        how = self.text(f"{pointer}/how", content.get("how"))
        pair = Pair(self.name(f"{pointer}/scene", content.get("scene")), "", "", how)
        photo = self.file(f"{pointer}/photo", content["photo"]) if "photo" in content else None
        better, worse = (
            self.file(f"{pointer}/{name}", content.get(name)) for name in ("better", "worse")
        )
        return Shown(pair, better, worse, photo)
