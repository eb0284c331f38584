"""Kinds of photos and of light maps, end to end: what of them is in the files that are written."""

import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image, PngImagePlugin

from tests.builders.faults import PEAK_BYTES, SECONDS, assert_fails, run_case
from tests.builders.image_files import matrix_profile, write_image
from tests.builders.insertions import (
    Run,
    arguments,
    go,
    read_image,
    read_layers,
    rgb,
    untouched,
    write_photo,
)
from warpir.core.errors import ExitCode
from warpir.insert import main
from warpir.io.cameras.reader import read_camera
from warpir.io.images.envmap_conventions import from_ours
from warpir.io.images.photos import read_envmap

SIZE = (48, 32)
PYTHON_BYTES = 1e8
"""What Python and its libraries take."""
TURNED_BACK = {  # how an upright image lies in a file: mirrored, turned, both
    2: lambda a: a[:, ::-1],
    6: lambda a: np.rot90(a, 1),
    7: lambda a: np.rot90(a, 2).swapaxes(0, 1),
}


@pytest.fixture(scope="module")
def plain(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run that the others differ from in one thing."""
    out = tmp_path_factory.mktemp("plain") / "out"
    return go(arguments(inputs, out, exposure="0"), out)


@pytest.mark.parametrize("orientation", TURNED_BACK, ids="I7-orientation-{}".format)
def test_orientations_give_one_composite(
    inputs: Path, plain: Run, tmp_path: Path, orientation: int
) -> None:
    """The same bytes as from the upright file; the camera is the upright photo's too."""
    codes = read_image(inputs / "photo.png")[0]
    exif = Image.Exif()
    exif[0x0112] = orientation
    lying = np.ascontiguousarray(TURNED_BACK[orientation](codes))
    Image.fromarray(lying).save(tmp_path / "p.png", exif=exif)
    out = tmp_path / "out"
    go(arguments(inputs, out, photo=str(tmp_path / "p.png"), exposure="0"), out)
    assert (out / "composite.png").read_bytes() == (plain.out / "composite.png").read_bytes()


@pytest.mark.parametrize(
    "case", ["I8-P3-8-bit", "I8-P3-16-bit", "I9-grey", "I9-grey-16-bit", "I9-palette", "I9-1-bit"]
)
def test_untouched_pixels_keep_their_codes(inputs: Path, tmp_path: Path, case: str) -> None:
    """In their own depth and profile; grey and palettes come out as RGB of the same codes."""
    codes = write_photo(tmp_path / "p.png", 16 if "16" in case else 8)
    path, icc = tmp_path / "p.tif", matrix_profile("p3") if "P3" in case else None
    if icc is not None:
        write_image(path, codes, ICCProfile=icc)
    elif "grey" in case:
        codes = codes[..., :1]
        write_image(path, codes)
    else:
        picture = Image.fromarray(codes).convert("P" if "palette" in case else "1")
        path = tmp_path / "p.png"
        picture.save(path)
        codes = np.asarray(picture.convert("RGB"))
    done = go(arguments(inputs, tmp_path / "out", photo=str(path)), tmp_path / "out")
    found = done.image()
    kept = untouched(read_layers(done.out / "layers.exr"))
    assert found.shape == (*SIZE[::-1], 3) and found.dtype == codes.dtype
    assert 200 < kept.sum() < kept.size - 100
    np.testing.assert_array_equal(found[kept], np.broadcast_to(codes, found.shape)[kept])
    with Image.open(done.out / "composite.png") as picture:
        assert picture.info.get("icc_profile") == icc


@pytest.mark.parametrize("case", ["I12-exr", "I12-hdr", "I12-tif"])
def test_linear_plates_survive_in_the_layers(inputs: Path, tmp_path: Path, case: str) -> None:
    """layers.exr is the float composite, brighter than white; composite.png its sRGB, clipped."""
    plate = np.random.default_rng(2).uniform(0.0, 4.0, (*SIZE[::-1], 3)).astype(np.float32)
    path = write_image(tmp_path / f"p.{case[4:]}", plate)
    done = go(arguments(inputs, tmp_path / "out", photo=str(path)), tmp_path / "out")
    planes = read_layers(done.out / "layers.exr")
    kept = untouched(planes)
    rounding = 2.0**-7 if case == "I12-hdr" else 2.0**-11  # RGBE of the largest channel; half
    np.testing.assert_allclose(rgb(planes)[kept], plate[kept], rtol=rounding, atol=4 * rounding)
    assert rgb(planes)[kept].max() > 3.9 and kept.sum() > 200
    shown = np.clip(rgb(planes), 0.0, 1.0).astype(np.float64)
    srgb = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    assert done.image().dtype == np.uint16
    np.testing.assert_allclose(done.image() / 65535.0, srgb, atol=1e-3)
    assert any("composite.png clips" in notice for notice in done.record["notices"])


def test_response_is_not_for_a_linear_plate(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its curve is of photographs: a plate of ten times the unit had a twentieth of the effect."""
    plate = np.full((*SIZE[::-1], 3), 0.2, np.float32)
    path = write_image(tmp_path / "p.exr", plate)
    argv = arguments(inputs, tmp_path / "out", photo=str(path), response="1.5")
    assert main([*argv, "--validate"]) == ExitCode.USAGE
    assert "--response: a scene-linear plate has none" in capsys.readouterr().err


@pytest.mark.case("E8")
def test_e8_layer_is_used_and_recorded(inputs: Path, tmp_path: Path) -> None:
    """--layer reaches the reader; without it the run ends with the layers' names."""
    plane = np.random.default_rng(2).uniform(0.1, 0.9, SIZE[::-1]).astype(np.float32)
    path = str(tmp_path / "p.exr")
    OpenEXR.File({}, {f"beauty.{c}": plane for c in "RGB"}).write(path)
    argv = arguments(inputs, tmp_path / "out", photo=path)
    assert main(argv) == ExitCode.INPUT
    done = go([*argv, "--layer", "beauty"], tmp_path / "out")
    assert done.record["config"]["layer"] == "beauty"
    np.testing.assert_allclose(
        read_layers(done.out / "layers.exr")["plate.G"], plane, atol=2.0**-11
    )


@pytest.mark.parametrize("name", ["blender", "diffusionlight"], ids="E-light-{}".format)
def test_light_conventions_give_one_light(
    inputs: Path, plain: Run, tmp_path: Path, name: str
) -> None:
    """A map that another tool made of our light lights as ours does."""
    ours = read_envmap(plain.out / "envmap.exr")
    pose = read_camera(plain.out / "camera.json", SIZE).c2w
    path = write_image(tmp_path / "theirs.exr", from_ours(ours, name, pose))
    changes = {"light": str(path), "light_convention": name, "exposure": "0"}
    theirs = go(arguments(inputs, tmp_path / "out", **changes), tmp_path / "out")
    found = read_envmap(theirs.out / "envmap.exr")
    assert theirs.record["config"]["light_convention"] == name
    if name == "diffusionlight":  # two turns by the camera's pitch blur a map of 16 rows
        sun = [np.unravel_index(m.sum(axis=-1).argmax(), m.shape[:2]) for m in (found, ours)]
        assert np.abs(np.subtract(*sun)).max() <= 1
        np.testing.assert_allclose(found.mean(), ours.mean(), rtol=0.05)
    else:
        np.testing.assert_array_equal(found, ours)
        np.testing.assert_array_equal(theirs.image(), plain.image())


@pytest.mark.case("I20")
def test_i20_occluder_mask_end_to_end(inputs: Path, plain: Run, tmp_path: Path) -> None:
    """The masked half is the photo's, the other as without a mask; its sha256 is recorded."""
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[:, :24] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    changes = {"occluder_mask": str(tmp_path / "mask.png"), "exposure": "0"}
    done = go(arguments(inputs, tmp_path / "out", **changes), tmp_path / "out")
    photo = read_image(inputs / "photo.png")[0]
    assert (plain.image()[:, :24] != photo[:, :24]).any()
    np.testing.assert_array_equal(done.image()[:, :24], photo[:, :24])
    np.testing.assert_array_equal(done.image()[:, 24:], plain.image()[:, 24:])
    assert len(done.record["inputs"]["occluder_mask"]) == 64
    mask[:], mask[0, 0] = 255, 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    hidden = go(arguments(inputs, tmp_path / "hidden", **changes), tmp_path / "hidden")
    (line,) = [n for n in hidden.record["notices"] if "not seen" in n]
    assert "white stays in front" in line


@pytest.mark.parametrize(
    "size", [(1, 1), (7, 5), (3, 4000), (4000, 3)], ids="I14-{0[0]}x{0[1]}".format
)
def test_odd_sizes_are_whole_runs(inputs: Path, tmp_path: Path, size: tuple[int, int]) -> None:
    """From the photo to the files: nothing is divided by zero, all is finite and of that size."""
    width, height = size
    rng = np.random.default_rng(4)
    codes = rng.integers(50, 200, (height, width, 3), dtype=np.uint8)
    Image.fromarray(codes).save(tmp_path / "p.png")
    changes = {"photo": str(tmp_path / "p.png"), "camera_height": "1.5", "place": "0,0,-3"}
    done = go(arguments(inputs, tmp_path / "out", **changes), tmp_path / "out")
    planes = read_layers(done.out / "layers.exr")
    assert done.image().shape == codes.shape
    assert all(np.isfinite(plane).all() for plane in planes.values())
    kept = untouched(planes)
    np.testing.assert_array_equal(done.image()[kept], codes[kept])


@pytest.mark.slow
@pytest.mark.parametrize("level", [0, 255], ids=["I16-black", "I16-white"])
def test_photos_without_signal_are_whole_runs(inputs: Path, tmp_path: Path, level: int) -> None:
    """The run says so, also where the light is read off the photo, and holds no NaN."""
    Image.fromarray(np.full((*SIZE[::-1], 3), level, np.uint8)).save(tmp_path / "p.png")
    for light in (str(inputs / "sky.hdr"), None):
        out = tmp_path / f"out-{light is None}"
        done = go(arguments(inputs, out, photo=str(tmp_path / "p.png"), light=light), out)
        assert any("no signal" in notice for notice in done.record["notices"])
        planes = read_layers(done.out / "layers.exr")
        assert all(np.isfinite(plane).all() for plane in planes.values())
        assert np.isfinite(read_envmap(done.out / "envmap.exr")).all()
        assert planes["matte.A"].max() == 1.0 and (done.image()[0, 0] == level).all()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("na\u00efve \u5199\u771f", id="I17-non-ASCII"),
        pytest.param("a b  c", id="I17-spaces"),
        pytest.param("quo'te\"", id="I17-quotes"),
        pytest.param("x" * 251, id="I17-255-bytes"),
        pytest.param("\u5199" * 83 + "xx", id="I17-255-bytes-of-UTF-8"),
        pytest.param("-x", id="I17-leading-minus"),
        pytest.param("--place", id="I17-like-a-flag"),
        pytest.param("line\nbreak", id="I17-newline"),
        pytest.param("%04d#?[*]$HOME;", id="I17-wildcards"),
    ],
)
def test_names_do_not_matter_to_a_run(inputs: Path, tmp_path: Path, name: str) -> None:
    """Photo, asset, light and camera of one name, given relative to the working directory."""
    for source, suffix in (("photo.png", "png"), ("box.glb", "glb"), ("sky.hdr", "hdr")):
        shutil.copy(inputs / source, tmp_path / f"{name}.{suffix}")
    changes = {"photo": f"{name}.png", "asset": f"{name}.glb", "light": f"{name}.hdr"}
    argv = [*arguments(inputs, "out", **changes), "--validate"]
    if name.startswith("--"):  # a value that looks like a flag needs the equals sign
        texts = {f"--{flag}": f"--{flag}={value}" for flag, value in changes.items()}
        argv = [texts.get(a, a) for a in argv if a not in changes.values()]
    ended = run_case(argv, tmp_path)
    assert (ended.status, ended.err) == (ExitCode.DONE, ""), ended
    assert ended.out.splitlines()[-1] == "inputs are valid"


@pytest.mark.case("I17")
def test_a_name_of_many_kinds_is_written_and_read_again(inputs: Path, tmp_path: Path) -> None:
    """A whole run into such a folder, from such files; run.json repeats their names."""
    folder = tmp_path / "na\u00efve \u5199 'q\" -x\nnew"
    folder.mkdir()
    for name in ("photo.png", "box.glb", "sky.hdr"):
        shutil.copy(inputs / name, folder / f"-{name}")
    changes = {"photo": "-photo.png", "asset": "-box.glb", "light": "-sky.hdr"}
    changes = {flag: str(folder / name) for flag, name in changes.items()}
    done = go(arguments(inputs, folder / "out", **changes), folder / "out")
    assert done.record["config"]["photo"] == changes["photo"]
    again = ["--config", str(folder / "out" / "run.json"), "--out", str(folder / "again")]
    assert main(again) == ExitCode.DONE
    first, second = (folder / n / "composite.png" for n in ("out", "again"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("kind", ["jpg", "png", "webp"], ids="I19-{}".format)
def test_huge_metadata_costs_nothing(inputs: Path, tmp_path: Path, kind: str) -> None:
    """8 MB of XMP (in JPEG, whose segments end at 64 kB, as much as fits), 60 kB of EXIF, GPS."""
    exif = Image.Exif()
    exif[0x9286] = "x" * 60_000
    exif.get_ifd(0x8825)[29] = "2026:01:01"
    size = 60_000 if kind == "jpg" else 8_000_000
    xmp = f"<x:xmpmeta xmlns:x='adobe:ns:meta/'>{'y' * size}</x:xmpmeta>".encode()
    path = tmp_path / f"p.{kind}"
    picture = Image.fromarray(read_image(inputs / "photo.png")[0])
    if kind == "png":
        info = PngImagePlugin.PngInfo()
        info.add_itxt("XML:com.adobe.xmp", xmp.decode(), zip=False)
        picture.save(path, exif=exif, pnginfo=info)
    else:
        picture.save(path, exif=exif, xmp=xmp)
    assert path.stat().st_size > size
    ended = run_case([*arguments(inputs, "out", photo=str(path)), "--validate"], tmp_path)
    assert (ended.status, ended.err) == (ExitCode.DONE, ""), ended
    assert ended.peak_bytes < PEAK_BYTES and ended.seconds < SECONDS


@pytest.mark.slow
@pytest.mark.case("I5")
def test_real_photo_of_100_megapixels(inputs: Path, tmp_path: Path) -> None:
    """Refused at the default limit; within a larger one its memory is that of its arrays."""
    Image.new("RGB", (10_000, 10_000), (90, 120, 60)).save(tmp_path / "p.png", compress_level=1)
    argv = [*arguments(inputs, "out", photo="p.png"), "--validate"]
    assert_fails(argv, ExitCode.INPUT, "10000 x 10000", "--max-pixels", cwd=tmp_path)
    ended = run_case([*argv, "--max-pixels", "100000000"], tmp_path)
    assert (ended.status, ended.err) == (ExitCode.DONE, ""), ended
    # 3 codes and 3 floats a pixel stay; the floats are made by way of a second array.
    assert ended.peak_bytes - PYTHON_BYTES < 1e8 * (3 + 2 * 12 + 4)
