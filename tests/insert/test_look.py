"""The look stage end to end: all of it off leaves no trace, and each part reaches the picture."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image
from scipy import ndimage

from tests.builders.image_files import matrix_profile, write_image
from tests.builders.insertions import (
    arguments,
    go,
    read_image,
    read_layers,
    record_of,
    rgb,
    untouched,
)
from tests.builders.outcome import outcome
from tests.look.test_toning import TONES, a_scene
from tests.slow import slow
from warpir.core.color import GAMMA, luminance
from warpir.look.camera_look import CameraLook

OFF = {"response": "off", "sharpness": "off", "grain": "off"}


def write_photographed(path: Path, bits: int) -> None:
    """Write turned squares from black to white behind a blur of 1 px and two codes of grain."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[0:96, 0:144]
    scene = np.full(y.shape, 0.2)
    for value in (0.0, 0.002, 0.02, 0.3, 0.6, 0.05, 0.0, 0.8):
        turn, (cy, cx) = rng.uniform(0.0, np.pi), rng.uniform(0.1, 0.9, 2) * y.shape
        across = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)
        along = (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        scene[(np.abs(across) < 16) & (np.abs(along) < 16)] = value
    shown = np.repeat(ndimage.gaussian_filter(scene, 1.0)[..., None], 3, axis=2) ** (1 / 2.2)
    shown += 2.0 / 255.0 * rng.normal(size=shown.shape)
    codes = np.round((2**bits - 1) * np.clip(shown, 0.0, 1.0))
    buffer = oiio.ImageBuf(codes.astype(np.uint8 if bits == 8 else np.uint16))
    assert buffer.write(str(path)), buffer.geterror()


@pytest.mark.parametrize("bits", [8, 16])
def test_all_off_gives_the_bytes_of_a_run_without_the_stage(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, bits: int
) -> None:
    """Every file is that of a program that has no such stage; untouched pixels keep their codes."""
    photo = tmp_path / "photo.png"
    write_photographed(photo, bits)
    words = {"photo": str(photo), "device": device}
    (tmp_path / "auto").mkdir()
    auto = go(arguments(inputs, tmp_path / "auto" / "out", **words), tmp_path / "auto" / "out")
    outcomes = []
    for name in ("off", "without"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        with monkeypatch.context() as patch:
            if name == "without":
                patch.setattr("warpir.report.result.estimate_look", lambda *_: CameraLook())
                for step in ("sharpened_like_photo", "shown_like_photo"):
                    patch.setattr(CameraLook, step, lambda _, planes, *__: planes)
                patch.setattr(CameraLook, "grain_on", lambda *_: None)
            go(arguments(inputs, "out", **words, **OFF), Path("out"))
        outcomes.append(outcome(Path("out")))
    assert outcomes[0] == outcomes[1]
    # The stage would have changed this picture, by all of its parts.
    look = auto.record["measured"]["look"]
    assert look["blur"]["sigma"] > 0.8 and look["response"]["exponent"] != 1.0
    assert max(max(level) for level in look["grain"]["strength"]) > 1.0 / 255.0
    record = record_of(tmp_path / "off" / "out")
    assert record["measured"]["look"] == {"blur": None, "grain": None}
    before = read_image(photo)[0]
    for folder in ("auto", "off"):
        codes = read_image(tmp_path / folder / "out" / "composite.png")[0]
        assert codes.dtype == before.dtype == (np.uint8 if bits == 8 else np.uint16)
        planes = read_layers(tmp_path / folder / "out" / "layers.exr")
        same = untouched(planes)
        assert 2000 < same.sum() < same.size - 500
        np.testing.assert_array_equal(codes[same], before[same])
    assert (codes != auto.image()).any(axis=-1).sum() > 500


@pytest.mark.parametrize("kind", ["png", *slow("jpg", "p3.png")])
def test_black_and_white_photo_has_a_grey_object(
    inputs: Path, tmp_path: Path, device: str, kind: str
) -> None:
    """Object, shadow and grain have no colour, in picture and layers, unless that is asked for."""
    colored, photo = tmp_path / "colored.png", tmp_path / f"photo.{kind}"
    write_photographed(colored, 8)
    profile = matrix_profile("p3") if kind == "p3.png" else None
    mode = "RGB" if profile else "L"  # of a profile for colours
    Image.open(colored).convert("L").convert(mode).save(photo, icc_profile=profile)
    lamp = {"light": None, "sun": "40,30", "sky": "clear"}
    (tmp_path / "grey").mkdir()
    words = {"photo": str(photo), "device": device, **lamp}
    grey = go(arguments(inputs, tmp_path / "grey" / "out", **words), tmp_path / "grey" / "out")
    assert grey.record["measured"]["look"]["toning"]["offsets"] == [[0.0] * 3] * 9
    assert any("black and white" in line for line in grey.record["assumed"])
    # A code that comes out of a profile and goes back may be rounded either way.
    assert np.ptp(grey.image().astype(int), axis=-1).max() <= (profile is not None)
    planes = read_layers(tmp_path / "grey" / "out" / "layers.exr")
    for name in ("fg", "specular", "shadow", "grain"):
        layer = rgb(planes, f"{name}.")
        assert np.ptp(layer, axis=-1).max() == 0.0 and np.ptp(layer) > 0.0, name
    (tmp_path / "off").mkdir()
    off = tmp_path / "off" / "out"
    colored_run = go(arguments(inputs, off, **words, response="off"), off)
    assert np.ptp(colored_run.image().astype(int), axis=-1).max() > 20


@pytest.mark.slow
def test_toned_photo_has_a_toned_object(inputs: Path, tmp_path: Path, device: str) -> None:
    """All of the picture lies on the photo's curve, unless the object's colours are asked for."""
    photo = tmp_path / "photo.png"
    codes = np.round(255.0 * np.clip(TONES["sepia"](a_scene()), 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(codes).save(photo)
    words = {"photo": str(photo), "device": device, "grain": "off"}
    off_curve = []
    for name, more in (("toned", {}), ("off", {"response": "off"})):
        (tmp_path / name).mkdir()
        out = tmp_path / name / "out"
        run = go(arguments(inputs, out, **words, **more), out)
        says = any("toned black and white" in line for line in run.record["assumed"])
        assert says == ("toning" in run.record["measured"]["look"]) == (not more)
        # Where a pixel shows both, their mean is no longer on the curve.
        matte = read_layers(out / "layers.exr")["fg.A"]
        shown = run.image()[(matte == 1.0) | (matte == 0.0)] / 255.0
        grey = luminance(shown**GAMMA) ** (1.0 / GAMMA)
        toned = TONES["sepia"](np.linspace(0.0, 1.0, 1001))
        nearest = np.searchsorted(luminance(toned**GAMMA) ** (1.0 / GAMMA), grey).clip(0, 1000)
        off_curve.append(np.abs(shown - toned[nearest]).max(axis=-1))
    assert off_curve[0].max() < 3.0 / 255.0 < 20.0 / 255.0 < np.quantile(off_curve[1], 0.97)


@pytest.mark.parametrize("unit", [1.0 / 64.0, 64.0])
def test_look_of_a_plate_is_that_of_every_unit(
    inputs: Path, tmp_path: Path, device: str, unit: float
) -> None:
    """Blur, grain, and the layer of grain over the unit; its draw differs with the plate's bits."""
    write_photographed(tmp_path / "photo.png", 16)
    plate = (read_image(tmp_path / "photo.png")[0] / 65535.0) ** 2.2
    found = []
    for factor in (1.0, unit):
        path = write_image(tmp_path / f"{factor:g}.exr", (factor * plate).astype(np.float32))
        words = {"photo": str(path), "device": device, "exposure": f"{np.log2(factor):g}"}
        run = go(arguments(inputs, tmp_path / f"{factor:g}", **words), tmp_path / f"{factor:g}")
        layer = rgb(read_layers(run.out / "layers.exr"), "grain.")
        found.append((run.record["measured"]["look"], layer[layer != 0.0].std() / factor))
    (one, noise), (other, same_noise) = found
    assert one["blur"]["edges"] == other["blur"]["edges"]
    assert one["blur"]["sigma"] == pytest.approx(other["blur"]["sigma"], rel=1e-3)
    np.testing.assert_allclose(one["grain"]["strength"], other["grain"]["strength"], rtol=1e-3)
    assert noise == pytest.approx(same_noise, rel=0.1) and noise > 1e-3


@pytest.mark.parametrize("grain", ["off", "2", "auto"])
def test_given_values_are_not_assumed(
    inputs: Path, tmp_path: Path, device: str, grain: str
) -> None:
    """Estimates alone are, and the file's blocks, which no value states."""
    write_photographed(tmp_path / "photo.png", 8)
    Image.open(tmp_path / "photo.png").save(tmp_path / "photo.jpg", quality=80)
    words = {"sharpness": "1", "response": "1.1", "grain": grain, "device": device}
    out = tmp_path / "out"
    run = go(arguments(inputs, out, photo=str(tmp_path / "photo.jpg"), **words), out)
    said = " ".join(run.record["assumed"])
    assert "blurred" not in said and "contrast" not in said
    assert ("has grain" in said) == (grain == "auto") and ("a JPEG" in said) == (grain != "off")
    assert run.record["measured"]["look"]["blur"]["sigma"] == 1.0
