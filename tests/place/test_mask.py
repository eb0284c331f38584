"""The mask of what stands in front of the object, painted on the placing page."""

import base64
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.builders.image_files import png_chunk
from tests.builders.programs.browser import needs_chromium
from tests.builders.programs.placing import (
    HEIGHT,
    STATE,
    WIDTH,
    box_of,
    command,
    drag,
    placing,
    press,
    save,
    settle,
)
from warpir.core.errors import InputError
from warpir.place.session import mask_png
from warpir.place.work import render_preview


def encoded(picture: Image.Image, kind: str = "PNG") -> str:
    """The picture's file in base64."""
    stream = io.BytesIO()
    picture.save(stream, kind)
    return base64.b64encode(stream.getvalue()).decode()


def promising(side: int) -> str:
    """A PNG in base64 whose header promises a square of this side [px]."""
    header = struct.pack(">II", side, side) + b"\x08\0\0\0\0"
    content = base64.b64decode(encoded(Image.new("L", (4, 4))))
    return base64.b64encode(content[:8] + png_chunk(b"IHDR", header) + content[33:]).decode()


def test_preview_has_the_shadow_mask_of_its_configuration(inputs: Path, tmp_path: Path) -> None:
    """At the preview's size too: the ground is in shadow already, so no sun is taken away there."""
    codes = np.full((HEIGHT, WIDTH), 255, np.uint8)
    codes[-1] = 0
    Image.fromarray(codes).save(tmp_path / "shaded.png")
    picture = tmp_path / "preview.png"
    config = {"photo": str(inputs / "photo.png"), "asset": str(inputs / "wedge.glb"), "out": "x"}
    config |= {"fov": 60.0, "pitch": -15.0, "place": (0.0, 0.0, -6.0)}
    config |= {"sun": (-60.0, 30.0, 3.0), "sky": "overcast", "exposure": 0.0}
    darkest = []
    for mask in ({}, {"shadow_mask": str(tmp_path / "shaded.png")}):
        job = {"config": config | mask, "width": 64, "picture": str(picture)}
        render_preview(job, lambda said: None)
        shown = np.asarray(Image.open(picture))
        darkest.append(int(shown[len(shown) // 2 :, 40:].min()))  # right of the object
    assert darkest[1] > darkest[0] + 20


def test_mask_gets_the_size_of_the_photo() -> None:
    """Half of the page's mask is half of the photo's; one in which all is erased is none."""
    codes = np.zeros((20, 30), np.uint8)
    codes[:, :15] = 255
    content = mask_png((120, 80), {"mask": encoded(Image.fromarray(codes).convert("RGBA"))})
    assert content is not None
    mask = np.asarray(Image.open(io.BytesIO(content)))
    assert mask.shape == (80, 120) and mask.dtype == np.uint8
    assert (mask[:, :56] == 255).all() and (mask[:, 64:] == 0).all()
    assert mask_png((120, 80), {}) is None
    assert mask_png((120, 80), {"mask": encoded(Image.new("L", (30, 20)))}) is None


@pytest.mark.case("N21")
@pytest.mark.parametrize(
    "mask",
    [
        *(5, "?", base64.b64encode(b"no picture").decode()),
        encoded(Image.new("L", (4, 4)), "GIF"),
        promising(5000),
        promising(60_000),  # Pillow itself refuses it, by an error of another kind
    ],
)
def test_mask_that_is_none_is_refused(mask: object) -> None:
    """Whatever is no PNG in base64 is one line."""
    with pytest.raises(InputError, match="mask"):
        mask_png((8, 8), {"mask": mask})


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("width", [1000, 390])
def test_page_paints_and_saves_what_stands_in_front(
    inputs: Path, tmp_path: Path, width: int
) -> None:
    """A stroke hides the object, the eraser takes it back, undo both; the file is the photo's."""
    out = tmp_path / "out"
    with placing(command(inputs, out), width, 800, known="willReadFrequently") as opened:
        page = opened.page
        before = page.evaluate(STATE)
        page.click("#paint")
        box = box_of(opened, "#photo")
        scale = box["width"] / WIDTH

        def stroke(*points: tuple[float, float]) -> None:
            """Drag over these pixels of the photo."""
            at = [(box["x"] + scale * u, box["y"] + scale * v) for u, v in points]
            page.mouse.move(*at[0])
            page.mouse.down()
            for place in at[1:]:
                page.mouse.move(*place, steps=5)
            page.mouse.up()
            settle(opened)

        alpha = """([u, v]) => {
          const front = document.getElementById('front');
          const [x, y] = [u, v].map(Math.round);
          return front.getContext('2d').getImageData(x, y, 1, 1).data[3];
        }"""
        page.locator("#brush-width").fill("30")
        stroke((100.0, 200.0), (300.0, 200.0))
        assert page.evaluate(alpha, [200.0, 200.0]) == 255
        assert page.evaluate(alpha, [200.0, 200.0 + 25.0 / scale]) == 0
        assert page.evaluate(STATE)["stand"] == before["stand"]
        page.click("#eraser")
        stroke((220.0, 120.0), (220.0, 280.0))
        assert page.evaluate(alpha, [220.0, 200.0]) == 0
        assert page.evaluate(alpha, [120.0, 200.0]) == 255
        press(opened, "Control+z")
        assert page.evaluate(alpha, [220.0, 200.0]) == 255
        press(opened, "Control+Shift+z")
        assert page.evaluate(alpha, [220.0, 200.0]) == 0
        page.click("#paint")
        save(opened)
        saved = json.loads((out / "insert.json").read_text())
        assert saved["occluder_mask"] == str(out / "occluder.png")
        first = page.evaluate(STATE)
        mask = np.asarray(Image.open(out / "occluder.png"))
        assert mask.shape == (HEIGHT, WIDTH)
        assert mask[200, 120] == 255 and mask[200, 220] == 0 and mask[40, 200] == 0
    # Another session goes on with it, and replaces it.
    (out / "insert.json").write_text(json.dumps(saved | {"samples": 3}))
    again = ["--config", str(out / "insert.json"), "--no-browser", "--out", str(out)]
    with placing(again, width, 800, known="willReadFrequently") as opened:
        page = opened.page
        found = page.evaluate(STATE)
        for name in ("camera", "stance", "stand", "size", "turn"):
            assert found[name] == pytest.approx(first[name])
        assert page.evaluate(alpha, [120.0, 200.0]) == 255
        assert page.evaluate(alpha, [220.0, 200.0]) == 0
        save(opened)
        assert json.loads((out / "insert.json").read_text()) == saved | {"samples": 3}
        # A placement without a mask leaves none behind.
        page.click("#paint")
        page.click("#clear-mask")
        save(opened)
        assert "occluder_mask" not in json.loads((out / "insert.json").read_text())
        assert not (out / "occluder.png").exists()
        # The test reads the canvas; the page does not.


@needs_chromium
@pytest.mark.slow
def test_other_tools_show_their_handles(inputs: Path, tmp_path: Path) -> None:
    """Vanishing lines can be dragged though a mask was painted, or the handles were hidden."""
    with placing(command(inputs, tmp_path / "out"), 1000, 700) as opened:
        page = opened.page
        for hiding in ("#paint", "#guides"):
            page.click(hiding)
            assert page.locator("#handles").is_hidden()
            page.click("#lines")
            settle(opened)
            before = page.evaluate(STATE)
            drag(opened, "a00", (20.0, 10.0))
            after = page.evaluate(STATE)
            assert after["lines"] != before["lines"] and after["mask"] == []
            page.click("#lines")
