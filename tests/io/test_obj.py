"""The OBJ, PLY and STL readers against small files written by the test, faults included.

The ids are the rows of the project's fault table (M20, M21). Files of the development data are
read where they exist.
"""

import io
import struct
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.builders.refusals import unreadable
from tests.development_data import MESHES, needs_shared
from warpir.core.errors import InputError
from warpir.core.limits import Limits
from warpir.io.assets import load_asset
from warpir.io.meshes.triangles import clip_ears
from warpir.scene.asset import Asset

SQUARE = """\
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
"""
FACES = "f 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"


def png(path: Path, color: tuple[int, ...], size: int = 2) -> None:
    """Write an image of one colour."""
    Image.new({1: "L", 3: "RGB", 4: "RGBA"}[len(color)], (size, size), color).save(path)


def write(folder: Path, text: str | bytes, name: str = "asset.obj") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


fails = partial(unreadable, load_asset)


def area(asset: Asset) -> np.ndarray:
    """Return the area vectors of all triangles, shape [triangle, 3]."""
    corners = [p.positions[p.indices].transpose(1, 0, 2) for p in asset.primitives]
    return np.concatenate([np.cross(b - a, c - a) / 2 for a, b, c in corners])


def test_square_loads(tmp_path: Path) -> None:
    """Positions, winding, normals, v turned down, and grey where nothing is stated."""
    asset = load_asset(write(tmp_path, SQUARE + FACES))
    (square,) = asset.primitives
    np.testing.assert_array_equal(area(asset), [[0, 0, 0.5]] * 2)
    assert square.positions.dtype == np.float64 and len(square.positions) == 4
    np.testing.assert_array_equal(square.normals, [[0, 0, 1]] * 4)
    np.testing.assert_array_equal(square.uv0, [[0, 1], [1, 1], [1, 0], [0, 0]])
    (material,) = asset.materials
    assert (material.base_color, material.metallic, material.roughness) == ((0.8,) * 3, 0.0, 0.5)
    assert material.double_sided
    assert any("0.8" in notice and "0.5" in notice for notice in asset.notices)


SAME: dict[str, Callable[[str], str]] = {
    "M20-bom": lambda t: "\ufeff" + t,
    "M20-crlf": lambda t: t.replace("\n", "\r\n"),
    "M20-cr": lambda t: t.replace("\n", "\r"),
    "M20-comments": lambda t: "# a\n\n" + t.replace("\nf", " # b\n  f"),
    "M20-continued-lines": lambda t: t.replace("f 1/1/1 ", "f 1/1/1 \\\n"),
    "M20-negative-indices": lambda t: SQUARE + "f -4/-4/-1 -3/-3/-1 -2/-2/-1 -1/-1/-1\n",
    "M20-quad": lambda t: SQUARE + "f 1/1/1 2/2/1 3/3/1 4/4/1\n",
    "M20-groups": lambda t: t.replace("f 1", "o a b\ng c\ns 1\nf 1"),
    "M20-extra-numbers": lambda t: t.replace("v 0 0 0", "v 0 0 0 1").replace("vt 0 0", "vt 0 0 0"),
    "M20-exponents": lambda t: t.replace("v 1 0 0", "v 1e0 -0.0 +0"),
}


@pytest.mark.parametrize("case", SAME)
def test_spellings_of_the_square_agree(case: str, tmp_path: Path) -> None:
    """Byte-order marks, line ends, negative indices and polygons change nothing."""
    asset = load_asset(write(tmp_path, SAME[case](SQUARE + FACES)))
    np.testing.assert_array_equal(area(asset), [[0, 0, 0.5]] * 2)
    (square,) = asset.primitives
    assert square.indices.flags.c_contiguous
    assert len(square.positions) == 4 and square.normals is not None
    assert square.uv0 is not None
    np.testing.assert_array_equal(square.uv0[:, 1], 1 - square.positions[:, 1])


FAULTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "M20-index-0": (SQUARE + "f 0 1 2\n", ("line 10", "'0'", "start at 1")),
    "M20-index-too-large": (SQUARE + "f 1 2 3\nf 1 2 5\n", ("line 11", "'5'", "4 v")),
    "M20-uv-index-too-large": (SQUARE + "f 1/9 2/1 3/1\n", ("line 10", "'1/9'", "4 vt")),
    "M20-normal-index-0": (SQUARE + "f 1//0 2//1 3//1\n", ("line 10", "'1//0'", "1 vn")),
    "M20-negative-too-far": (SQUARE + "f -5 -1 -2\n", ("line 10", "-5", "4 v")),
    "M20-index-minus-0": (SQUARE + "f -0 -1 -2\n", ("line 10", "corner -0", "4 v")),
    "M20-index-of-4000-digits": (
        SQUARE + f"f -1 -2 -{'9' * 4000}\n",
        ("line 10", f"corner -{'9' * 19}, but 4 v"),
    ),
    "M20-decimal-comma": ("v 0,5 0 0\n" + SQUARE + FACES, ("line 1", "0,5", "decimal points")),
    "M20-nan": (SQUARE.replace("v 1 1 0", "v 1 nan 0") + FACES, ("line 3", "numbers up to")),
    "M20-inf-uv": (SQUARE.replace("vt 1 1", "vt 1 inf") + FACES, ("line 7", "numbers up to")),
    "M20-1e300": (
        SQUARE.replace("v 1 1 0", "v 1 1e300 0") + FACES,
        ("line ", "1e300", "up to 3e+38"),
    ),
    "M20-seven-numbers": (  # a weight before the colour, or an opacity behind it: nobody knows
        SQUARE.replace("v 1 1 0", "v 1 1 0 1 0.1 0.2 0.3") + FACES,
        ("line 3: v with 7 numbers",),
    ),
    # Python passes over a _ in a number; no other program does.
    "M20-position-1_0": ("v 1_0 1 0\n" + SQUARE + FACES, ("line 1: 'v 1_0 1 0'",)),
    "M20-index-0_1": (SQUARE + "f 0_1/1/1 2/2/1 3/3/1\n", ("corner '0_1",)),
    "M20-short-vertex": (SQUARE.replace("v 1 1 0", "v 1 1") + FACES, ("line 3", "3 numbers")),
    "M20-two-corners": (SQUARE + "f 1 2\n", ("line 10", "2 corners")),
    "M20-word-as-index": (SQUARE + "f a b c\n", ("line 10", "'a'")),
    "M20-missing-mtl": ("mtllib gone.mtl\n" + SQUARE + FACES, ("gone.mtl", "--missing-textures")),
    "M20-mtllib-outside": ("mtllib ../x.mtl\n" + SQUARE + FACES, ("outside the asset folder",)),
    "M20-mtllib-absolute": ("mtllib /etc/x.mtl\n" + SQUARE + FACES, ("outside the asset folder",)),
    "M12-no-faces": (SQUARE, ("nothing to render",)),
    "M12-lines-only": (SQUARE + "l 1 2\np 1\n", ("nothing to render",)),
    "M13-only-zero-area": (SQUARE + "f 1 1 2\n", ("nothing to render",)),
    "M21-text": ("hello\n", ("not an OBJ file", "convert it to GLB")),
}


@pytest.mark.parametrize("case", FAULTS)
def test_fault_is_refused_with_its_line(case: str, tmp_path: Path) -> None:
    text, words = FAULTS[case]
    (tmp_path / "asset").mkdir()
    (tmp_path / "x.mtl").write_text("newmtl a\n")
    fails(write(tmp_path / "asset", text), *words)


@pytest.mark.case("M21")
@pytest.mark.parametrize("name", ["asset.obj", "asset.ply", "asset.stl"])
@pytest.mark.parametrize("content", ["png", "empty", "noise"])
def test_M21_other_content_is_refused(name: str, content: str, tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "PNG")
    noise = np.random.default_rng(1).bytes(300)
    path = write(tmp_path, {"png": stream.getvalue(), "empty": b"", "noise": noise}[content], name)
    fails(path, *(["empty file"] if content == "empty" else []))


@pytest.mark.case("M20")
def test_M20_concave_polygon_is_cut_by_ears(tmp_path: Path) -> None:
    """An L-shape keeps its area, seen from every side: no triangle lies outside or is turned."""
    shape = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=float)
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (1, 0, 2), (0, 2, 1), (2, 1, 0)):
        for start in range(6):
            points = np.column_stack([np.roll(shape, start, axis=0), np.zeros(6)])[:, axes]
            lines = ["v {} {} {}".format(*p) for p in points] + ["f 1 2 3 4 5 6"]
            asset = load_asset(write(tmp_path, "\n".join(lines)))
            areas = area(asset)
            normal = areas.sum(axis=0)
            assert np.linalg.norm(normal) == pytest.approx(3.0)
            assert (areas @ normal > 0).all() and len(areas) == 4
            assert any("1 concave" in notice for notice in asset.notices)


@pytest.mark.case("M20")
def test_clip_ears_survives_a_crossing_polygon() -> None:
    """A self-intersecting polygon ends in some triangulation, never in a loop."""
    bow_tie = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0], [0.5, 2, 0]])
    assert clip_ears(bow_tie).shape == (3, 3)


@pytest.mark.parametrize(
    "corners", [pytest.param(2000, id="M14-star"), pytest.param(1999, id="M14-tangle")]
)
def test_polygon_of_many_corners_is_cut_at_once(corners: int) -> None:
    """2000 corners take a moment, simple or crossing; the area is that of the star."""
    turn = np.arange(corners) * (2 * np.pi / corners)
    radius = np.where(np.arange(corners) % 2, 1.0, 0.5)
    points = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn])
    if corners % 2:
        points = np.random.default_rng(0).permutation(points)
    start = time.perf_counter()
    triangles = clip_ears(points)
    assert time.perf_counter() - start < 5.0
    a, b, c = (points[triangles[:, k]] for k in range(3))
    assert len(a) == corners - 2
    if not corners % 2:
        areas = np.cross(b - a, c - a)[:, 2] / 2
        assert (areas > 0).all()
        assert areas.sum() == pytest.approx(0.25 * corners * np.sin(2 * np.pi / corners))


@pytest.mark.case("M14")
def test_M14_concave_polygons_of_too_many_corners(tmp_path: Path) -> None:
    """What would take minutes to cut is refused before."""
    radius = np.where(np.arange(10_002) % 2, 1.0, 0.5)
    turn = np.arange(10_002) * (2 * np.pi / 10_002)
    rows = zip(radius * np.cos(turn), radius * np.sin(turn), strict=True)
    text = "".join(f"v {x:.9f} {y:.9f} 0\n" for x, y in rows)
    text += "f " + " ".join(map(str, range(1, 10_003)))
    fails(write(tmp_path, text), "concave", "10002", "10000", "triangulate")


@pytest.mark.case("M20")
def test_M20_vertex_colors_are_decoded_and_noted(tmp_path: Path) -> None:
    """``v x y z r g b`` is sRGB, as Blender and three.js have it, and becomes linear on white."""
    text = SQUARE.replace("v 1 1 0", "v 1 1 0 0.5 0.25 1") + FACES
    asset = load_asset(write(tmp_path, text))
    colors = asset.primitives[0].colors
    linear = [0.2140411, 0.0508761, 1, 1]
    np.testing.assert_allclose(colors, [[1, 1, 1, 1]] * 2 + [linear, [1, 1, 1, 1]], rtol=1e-6)
    assert asset.materials[0].base_color == (1.0, 1.0, 1.0)
    assert any("sRGB" in notice for notice in asset.notices)


@pytest.mark.case("M20")
def test_M20_polypaint_of_zbrush(tmp_path: Path) -> None:
    """``#MRGB`` holds mask and colour of each vertex, up to 64 a line; too few are not read."""
    corner, lines = "ff3366ff", "#MRGB {0}{0}\n#MRGB {0}{0}\n"
    asset = load_asset(write(tmp_path, SQUARE + lines.format(corner) + FACES))
    assert asset.primitives[0].colors is not None
    linear = [[0.0331048, 0.1328683, 1, 1]] * 4
    np.testing.assert_allclose(asset.primitives[0].colors, linear, rtol=2e-6)
    asset = load_asset(write(tmp_path, SQUARE + f"#MRGB {corner}\n" + FACES))  # not of all
    assert asset.primitives[0].colors is None
    assert any("polypaint" in notice for notice in asset.notices)


@pytest.mark.case("M20")
def test_M20_vertex_colors_of_8_bits(tmp_path: Path) -> None:
    """Whole numbers up to 255 are divided by 255; what is cut is noted."""
    text = SQUARE.replace("v 1 1 0", "v 1 1 0 255 102 0") + FACES
    asset = load_asset(write(tmp_path, text))
    assert asset.primitives[0].colors is not None
    np.testing.assert_allclose(asset.primitives[0].colors[2], [1, 0.1328683, 0, 1], atol=1e-6)
    assert any("divided" in notice for notice in asset.notices)
    np.testing.assert_array_equal(asset.primitives[0].colors[1], [1, 1, 1, 1])
    asset = load_asset(write(tmp_path, text.replace("102", "0.4")))
    assert any("clamped" in notice for notice in asset.notices)


def with_mtl(folder: Path, mtl: str) -> Asset:
    (folder / "asset.mtl").write_text("newmtl a b\n" + mtl)
    return load_asset(write(folder, "mtllib asset.mtl\n" + SQUARE + "usemtl a b\n" + FACES))


NAMES = {
    "M20-hash-in-name": ("newmtl Material #1", "usemtl Material #1"),
    "M20-two-blanks-in-name": ("newmtl  a  b ", "usemtl a  b"),
    "M20-name-like-a-comment": ("newmtl #1", "usemtl #1"),
}


@pytest.mark.parametrize("case", NAMES)
def test_names_of_materials_are_kept_whole(case: str, tmp_path: Path) -> None:
    """A name is the rest of its line in both files, so no two materials are merged."""
    first, use = NAMES[case]
    (tmp_path / "asset.mtl").write_text(f"{first}\nKd 1 0 0 # red\nnewmtl Material #2\nKd 0 1 0\n")
    half = "f 1 2 3\n", "f 1 3 4\n"
    text = f"mtllib asset.mtl\n{SQUARE}{use}\n{half[0]}usemtl Material #2\n{half[1]}"
    asset = load_asset(write(tmp_path, text))
    assert [m.base_color for m in asset.materials] == [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]


@pytest.mark.parametrize(
    "name",
    [pytest.param("my  c.png", id="M20-two-blanks"), pytest.param("c#1 #.png", id="M20-hash")],
)
def test_names_of_textures_are_kept_whole(name: str, tmp_path: Path) -> None:
    """What follows the options of a map is the file's name, blanks and all."""
    png(tmp_path / name, (200, 100, 50))
    asset = with_mtl(tmp_path, f"map_Kd -clamp on  {name}\nPr 1\n")
    assert asset.textures[0].pixels[0, 0].tolist() == [200, 100, 50, 255]


@pytest.mark.case("M20")
def test_M20_material_defined_again_is_noted(tmp_path: Path) -> None:
    """The last definition of a name counts, whole, and a notice says so."""
    asset = with_mtl(tmp_path, "Kd 1 0 0\nPr 1\nPm 1\nnewmtl a b\nKd 0 1 0\nPr 1\n")
    assert (asset.materials[0].base_color, asset.materials[0].metallic) == ((0.0, 1.0, 0.0), 0.0)
    assert asset.notices == ("asset.mtl line 5: 'a b' defined again, the last one counts",)


@pytest.mark.case("M20")
def test_M20_texture_coordinate_of_one_number(tmp_path: Path) -> None:
    """Its v is 0; the others keep theirs."""
    asset = load_asset(write(tmp_path, SQUARE.replace("vt 1 0\n", "vt 1\n") + FACES))
    np.testing.assert_array_equal(asset.primitives[0].uv0, [[0, 1], [1, 1], [1, 0], [0, 0]])


def test_mtl_pbr_keys(tmp_path: Path) -> None:
    """Kd, Pr, Pm, Ke and d are taken as they stand."""
    asset = with_mtl(tmp_path, "Kd 0.1 0.2 0.3\nPr 0.4\nPm 0.5\nKe 6 7 8\nd 0.9\n")
    (material,) = asset.materials
    assert material.name == "a b"
    assert material.base_color == (0.1, 0.2, 0.3)
    assert (material.roughness, material.metallic, material.alpha) == (0.4, 0.5, 0.9)
    assert material.emission == (6.0, 7.0, 8.0)
    assert (material.alpha_mode, material.double_sided) == ("BLEND", True)
    assert asset.notices == ()


def test_mtl_coat_sheen_and_index(tmp_path: Path) -> None:
    """Pc, Pcr, Ps and Ni are coat, its roughness, sheen and index; Ni 1 means none."""
    asset = with_mtl(tmp_path, "Kd 1 1 1\nPr 0.5\nNi 1.8\nPc 0.75\nPcr 2\nPs 0.25\n")
    (material,) = asset.materials
    assert (material.ior, material.clearcoat, material.clearcoat_roughness) == (1.8, 0.75, 1.0)
    assert material.sheen_color == (0.25, 0.25, 0.25)
    assert any("Pcr 2 clamped" in notice for notice in asset.notices)
    assert any("sheen of roughness 0.5 assumed" in notice for notice in asset.notices)
    for statement, noted in (("Ni 1", False), ("Ni 0.5", True)):
        asset = with_mtl(tmp_path, f"Kd 1 1 1\nPr 0.5\n{statement}\n")
        assert asset.materials[0].ior == 1.5
        assert any("Ni 0.5 ignored" in notice for notice in asset.notices) == noted


def test_mtl_says_what_it_leaves_out(tmp_path: Path) -> None:
    """Statements and maps that could matter and are not read give one notice."""
    png(tmp_path / "c.png", (1, 2, 3))
    text = "Kd 1 1 1\nKa 1 1 1\nillum 2\nPr 1\nPsr 0.5\naniso 0.1\nmap_Ks c.png\nmap_Ka c.png\n"
    assert with_mtl(tmp_path, text).notices == ("material 'a b': Psr, aniso, map_ks ignored",)


def test_mtl_roughness_from_the_exponent(tmp_path: Path) -> None:
    """Ns gives roughness^2 = sqrt(2 / (Ns + 2)) where there is no Pr, and is noted as assumed."""
    asset = with_mtl(tmp_path, "Kd 1 1 1\nNs 30\n")
    assert asset.materials[0].roughness == pytest.approx((2 / 32) ** 0.25)
    assert any("assumed from Ns" in notice for notice in asset.notices)
    asset = with_mtl(tmp_path, "Kd 1 1 1\nTr 0.25\n")
    assert (asset.materials[0].roughness, asset.materials[0].alpha) == (0.5, 0.75)
    assert any("roughness 0.5 assumed" in notice for notice in asset.notices)


def test_M20_tr_1_alone_is_opaque(tmp_path: Path) -> None:
    """MeshLab and scanners write Tr 1 for opaque; beside a d it says nothing."""
    asset = with_mtl(tmp_path, "Kd 1 1 1\nTr 1.000000\nillum 2\nNs 0.000000\n")
    (material,) = asset.materials
    assert (material.alpha, material.alpha_mode) == (1.0, "OPAQUE")
    assert any("Tr 1 without d" in notice for notice in asset.notices)
    assert with_mtl(tmp_path, "Kd 1 1 1\nTr 1\nd 0.5\n").materials[0].alpha == 0.5


def test_mtl_nvdiffrec_pbr(tmp_path: Path) -> None:
    """``bsdf pbr``: Ks is (occlusion, roughness, metallic), map_Ks its texture."""
    png(tmp_path / "c.png", (200, 100, 50))
    asset = with_mtl(tmp_path, "bsdf pbr\nKs 0 0.25 1\nmap_Kd c.png\n")
    (material,) = asset.materials
    assert (material.roughness, material.metallic) == (0.25, 1.0)
    assert material.base_color == (1.0, 1.0, 1.0)
    assert asset.textures[0].pixels[0, 0].tolist() == [200, 100, 50, 255]
    asset = with_mtl(tmp_path, "bsdf pbr\nKd 1 1 1\nmap_Ks c.png\n")
    (material,) = asset.materials
    assert (material.roughness, material.metallic) == (1.0, 1.0)
    assert material.metallic_roughness_texture is not None


@pytest.mark.case("M20")
def test_M20_map_options(tmp_path: Path) -> None:
    """-s, -o and -clamp reach the slot; texture row 0 is the top."""
    png(tmp_path / "a c.png", (200, 100, 50))
    asset = with_mtl(tmp_path, "map_Kd -s 2 3 1 -o 0.1 0.2 -clamp on a c.png\nPr 1\n")
    slot = asset.materials[0].base_color_texture
    assert slot is not None and asset.textures[slot.texture].wrap_u == "clamp"
    a, b, c, d, e, f = slot.transform
    u, v = 0.3, 0.6  # v up, as OBJ means it
    assert a * u + b * (1 - v) + c == pytest.approx(2 * u + 0.1)
    assert d * u + e * (1 - v) + f == pytest.approx(1 - (3 * v + 0.2))


def test_mtl_roughness_and_metallic_maps_are_packed(tmp_path: Path) -> None:
    """map_Pr goes to G and map_Pm to B, at the larger size."""
    png(tmp_path / "r.png", (80,), size=2)
    png(tmp_path / "m.png", (160,), size=4)
    asset = with_mtl(tmp_path, "Kd 1 1 1\nmap_Pr r.png\nmap_Pm m.png\n")
    (material,) = asset.materials
    assert (material.roughness, material.metallic) == (1.0, 1.0)
    slot = material.metallic_roughness_texture
    assert slot is not None
    pixels = asset.textures[slot.texture].pixels
    assert pixels.shape == (4, 4, 4) and pixels[3, 3].tolist() == [255, 80, 160, 255]


@pytest.mark.case("M14")
def test_M14_materials_of_the_same_maps_share_them(tmp_path: Path) -> None:
    """30 materials of the same files make each texture once."""
    for name in ("c", "d", "r", "m"):
        png(tmp_path / f"{name}.png", (80,), size=4)
    maps = "map_Kd c.png\nmap_d d.png\nmap_Pr r.png\nmap_Pm m.png\n"
    (tmp_path / "asset.mtl").write_text("".join(f"newmtl m{k}\n{maps}" for k in range(30)))
    faces = "".join(f"usemtl m{k}\n{FACES}" for k in range(30))
    path = write(tmp_path, "mtllib asset.mtl\n" + SQUARE + faces)
    asset = load_asset(path, limits=Limits(texture_pixels=6 * 16))
    assert (len(asset.materials), len(asset.textures)) == (30, 2)
    with pytest.raises(InputError, match="too many texture pixels"):
        load_asset(path, limits=Limits(texture_pixels=5 * 16))


def test_mtl_mask_becomes_alpha(tmp_path: Path) -> None:
    """map_d fills the alpha of the base colour and switches to MASK; without it alpha is opaque."""
    png(tmp_path / "c.png", (200, 100, 50, 7))
    png(tmp_path / "d.png", (30,))
    asset = with_mtl(tmp_path, "map_Kd c.png\nPr 1\n")
    assert asset.materials[0].alpha_mode == "OPAQUE"
    assert asset.textures[0].pixels[0, 0].tolist() == [200, 100, 50, 255]
    asset = with_mtl(tmp_path, "map_Kd c.png\nmap_d d.png\nPr 1\n")
    assert asset.materials[0].alpha_mode == "MASK"
    assert asset.textures[0].pixels[0, 0].tolist() == [200, 100, 50, 30]
    asset = with_mtl(tmp_path, "map_Kd c.png\nmap_d c.png\nPr 1\n")
    assert asset.textures[0].pixels[0, 0].tolist() == [200, 100, 50, 7]


def test_mtl_normal_and_height_maps(tmp_path: Path) -> None:
    """A coloured map_Bump is a normal map with -bm as scale; a grey one is left out."""
    png(tmp_path / "n.png", (128, 128, 255))
    png(tmp_path / "h.png", (99,))
    asset = with_mtl(tmp_path, "Kd 1 1 1\nPr 1\nmap_Bump -bm 0.5 n.png\n")
    assert asset.materials[0].normal_texture is not None
    assert asset.materials[0].normal_scale == 0.5
    asset = with_mtl(tmp_path, "Kd 1 1 1\nPr 1\nbump h.png\n")
    assert asset.materials[0].normal_texture is None
    assert any("height map" in notice for notice in asset.notices)


MTL_FAULTS = {
    "M3-missing-texture": ("map_Kd gone.png\n", ("gone.png", "--missing-textures grey")),
    "M4-texture-outside": ("map_Kd ../c.png\n", ("outside the asset folder",)),
    "M4-texture-absolute": ("map_Kd /etc/c.png\n", ("outside the asset folder",)),
    "M4-texture-url": ("map_Kd http://127.0.0.1/c.png\n", ("outside the asset folder",)),
    "M18-nan": ("Kd nan 0 0\n", ("asset.mtl line 2", "finite")),
    "M18-emission": ("Ke 1e30 0 0\n", ("'a b': Ke 1e+30", "at most 1e+12")),
    "M18-two-numbers": ("Kd 1 2\n", ("asset.mtl line 2", "RGB")),
    "M18-spectral": ("Kd spectral x.rfl\n", ("asset.mtl line 2", "RGB")),
    "M20-number-1_0": ("Kd 1_0 0 0\n", ("expected finite numbers",)),
    "M18-decimal-comma": ("Pr 0,5\n", ("asset.mtl line 2", "finite")),
    "M18-map-without-name": ("map_Kd -s 1 1 1\n", ("asset.mtl line 2", "file name")),
}


@pytest.mark.parametrize("case", MTL_FAULTS)
def test_mtl_fault_is_refused(case: str, tmp_path: Path) -> None:
    mtl, words = MTL_FAULTS[case]
    folder = tmp_path / "asset"
    folder.mkdir()
    png(tmp_path / "c.png", (1, 2, 3))
    with pytest.raises(InputError) as caught:
        with_mtl(folder, mtl)
    for word in words:
        assert word in f"{caught.value.what} / {caught.value.advice}"


@pytest.mark.case("M3")
def test_M3_missing_files_become_grey_on_request(tmp_path: Path) -> None:
    """A missing texture is one grey texel, a missing library a grey material, both noted."""
    (tmp_path / "asset.mtl").write_text("newmtl a\nmap_Kd gone.png\nPr 1\n")
    path = write(tmp_path, "mtllib asset.mtl\n" + SQUARE + "usemtl a\n" + FACES)
    asset = load_asset(path, missing_textures="grey")
    assert asset.textures[0].pixels.shape == (1, 1, 4)
    (tmp_path / "asset.mtl").unlink()
    asset = load_asset(path, missing_textures="grey")
    assert asset.textures == () and asset.materials[0].base_color == (0.8, 0.8, 0.8)
    assert any("asset.mtl" in notice for notice in asset.notices)


def test_one_primitive_per_material(tmp_path: Path) -> None:
    """Faces are gathered by material name, whatever the groups."""
    (tmp_path / "asset.mtl").write_text("newmtl a\nPr 0.1\nnewmtl b\nPr 0.2\n")
    text = "mtllib asset.mtl\n" + SQUARE
    for name, corners in (("a", "1 2 3"), ("b", "1 3 4"), ("a", "1 2 4")):
        text += f"usemtl {name}\ng x\nf {corners}\n"
    asset = load_asset(write(tmp_path, text))
    assert [len(p.indices) for p in asset.primitives] == [2, 1]
    assert [asset.materials[p.material].roughness for p in asset.primitives] == [0.1, 0.2]
    assert asset.primitives[0].normals is None


PLY_FORMATS = {"ascii": "ascii", "little": "binary_little_endian", "big": "binary_big_endian"}
PLY_CODES = {"float": "f", "double": "d", "uchar": "B", "ushort": "H", "int": "i"}


def ply_text(
    kind: str,
    vertices: list[tuple[float, ...]],
    faces: list[tuple[int, ...]],
    extra: str = "",
    of_faces: str = "",
    comment: str = "",
) -> bytes:
    """Return a PLY file.

    Args:
        kind: A key of `PLY_FORMATS`.
        vertices: Numbers of each vertex: x, y, z and ``extra``.
        faces: Corners of each face.
        extra: Further properties of vertices, such as ``uchar red, uchar green``.
        of_faces: Properties of faces after the corners; their values are all 7.
        comment: A comment of the header.
    """
    properties = ["float x", "float y", "float z", *filter(None, extra.split(", "))]
    header = f"ply\nformat {PLY_FORMATS[kind]} 1.0\n" + (f"comment {comment}\n" if comment else "")
    header += f"element vertex {len(vertices)}\n"
    header += "".join(f"property {text}\n" for text in properties)
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    more = [*filter(None, of_faces.split(", "))]
    header += "".join(f"property {text}\n" for text in more) + "end_header\n"
    rows = [*vertices, *((len(face), *face, *[7] * len(more)) for face in faces)]
    if kind == "ascii":
        return (header + "".join(" ".join(map(str, row)) + "\n" for row in rows)).encode()
    order = "<" if kind == "little" else ">"
    codes = "".join(PLY_CODES[text.split()[0]] for text in properties)
    tail = "".join(PLY_CODES[text.split()[0]] for text in more)
    body = b"".join(struct.pack(order + codes, *row) for row in vertices)
    for face in faces:
        body += struct.pack(f"{order}B{len(face)}i{tail}", len(face), *face, *[7] * len(more))
    return header.encode() + body


def ply(kind: str) -> bytes:
    """Return the square with normals and colours."""
    rows = [(x, y, 0.0, 0.0, 0.0, 1.0, 51, 102, 255) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    extra = "float nx, float ny, float nz, uchar red, uchar green, uchar blue"
    return ply_text("little" if kind == "binary" else kind, rows, [(0, 1, 2), (0, 2, 3)], extra)


def areas(asset: Asset) -> float:
    return float(np.linalg.norm(area(asset), axis=1).sum())


@pytest.mark.parametrize("kind", PLY_FORMATS)
@pytest.mark.parametrize("case", ["quad", "mixed", "pentagon", "concave", "one-corner"])
def test_ply_polygons_keep_their_area(kind: str, case: str, tmp_path: Path) -> None:
    """Faces of any number of corners, mixed ones too, in every encoding."""
    corners, faces, expected = {
        "quad": ([(0, 0), (1, 0), (1, 1), (0, 1)], [(0, 1, 2, 3)], 1.0),
        "mixed": (
            [(0, 0), (1, 0), (1, 1), (0, 1), (2, 0)], [(0, 1, 2, 3), (1, 4, 2)], 1.5
        ),
        "pentagon": ([(0, 0), (1, 0), (1.5, 1), (0.5, 2), (-0.5, 1)], [(0, 1, 2, 3, 4)], 2.5),
        # A fan from its first corner would cover 3.8.
        "concave": ([(0, 0), (2, 0), (2, 2), (1.9, 0.1)], [(0, 1, 2, 3)], 0.2),
        "one-corner": ([(0, 0), (1, 0), (1, 1)], [(0, 1, 2), (1,)], 0.5),
    }[case]  # fmt: skip
    vertices = [(*corner, 0.0) for corner in corners]
    content = ply_text(kind, vertices, faces, of_faces="uchar flags, float quality")
    asset = load_asset(write(tmp_path, content, "asset.ply"))
    assert areas(asset) == pytest.approx(expected, rel=1e-6)
    assert (area(asset)[:, 2] > 0).all()
    said = any("1 faces of fewer than 3" in notice for notice in asset.notices)
    assert said == (case == "one-corner")


@pytest.mark.parametrize("kind", PLY_FORMATS)
@pytest.mark.parametrize(
    ("extra", "values", "expected"),
    [
        ("uchar red, uchar green, uchar blue", (51, 102, 255), (0.2, 0.4, 1, 1)),
        ("ushort red, ushort green, ushort blue", (13107, 1, 65535), (0.2, 1 / 65535, 1, 1)),
        ("float red, float green, float blue", (0.123, 0.4, 1), (0.123, 0.4, 1, 1)),
        ("uchar red, uchar green, uchar blue, uchar alpha", (0, 0, 0, 51), (0, 0, 0, 0.2)),
        ("uchar diffuse_red, uchar diffuse_green, uchar diffuse_blue", (0, 51, 0), (0, 0.2, 0, 1)),
    ],
    ids=["u8", "u16", "float", "alpha", "diffuse"],
)
def test_ply_colors_keep_their_precision(
    kind: str, extra: str, values: tuple[float, ...], expected: tuple[float, ...], tmp_path: Path
) -> None:
    """Vertex colours of every type, sRGB, become linear RGBA, not rounded to 8 bits."""
    vertices = [(*corner, *values) for corner in ((0, 0, 0), (1, 0, 0), (1, 1, 0))]
    content = ply_text(kind, vertices, [(0, 1, 2)], extra)
    colors = load_asset(write(tmp_path, content, "asset.ply")).primitives[0].colors
    assert colors is not None
    linear = [x / 12.92 if x < 0.04 else ((x + 0.055) / 1.055) ** 2.4 for x in expected[:3]]
    np.testing.assert_allclose(colors, [(*linear, expected[3])] * 3, rtol=1e-6)


def test_ply_says_what_it_does_not_read(tmp_path: Path) -> None:
    """Textures and colours of faces give a notice."""
    vertices = [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
    of_faces = "uchar red, uchar green, uchar blue"
    content = ply_text("ascii", vertices, [(0, 1, 2)], "", of_faces, "TextureFile a.png")
    asset = load_asset(write(tmp_path, content, "asset.ply"))
    assert any("colours of faces" in notice for notice in asset.notices)
    assert any("texture" in notice for notice in asset.notices)


@pytest.mark.case("M7")
def test_M7_ply_index_that_is_no_whole_number(tmp_path: Path) -> None:
    """A list of floats may hold indices, and nothing between them."""
    text = (
        "ply\nformat ascii 1.0\ncomment no end_header here\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty float z\nelement face 1\n"
        "property list uchar float vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
    )
    assert len(load_asset(write(tmp_path, text + "3 0 1 2\n", "a.ply")).primitives) == 1
    fails(write(tmp_path, text + "3 0 1.7 2\n", "a.ply"), "index 1.7 is no whole number")


@pytest.mark.case("M12")
def test_M12_point_cloud_has_nothing_to_render(tmp_path: Path) -> None:
    content = ply_text("little", [(0, 0, 0), (1, 0, 0), (1, 1, 0)], [])
    fails(write(tmp_path, content, "asset.ply"), "nothing to render", "3 vertex", "--ground-points")


PLY_FAULTS: dict[str, tuple[Callable[[str], str], tuple[str, ...]]] = {
    "no-header-end": (lambda t: t.replace("end_header", "end"), ("no end_header",)),
    "format-2": (lambda t: t.replace("ascii 1.0", "ascii 2.0"), ("line 2", "PLY 1.0")),
    "unknown-type": (lambda t: t.replace("float y", "half y"), ("line 5", "half y")),
    "float-length": (lambda t: t.replace("list uchar", "list float"), ("line 8", "list float")),
    "element-twice": (lambda t: t.replace("element face", "element vertex"), ("line 7",)),
    "no-z": (lambda t: t.replace("float z", "float w"), ("no x, y and z",)),
    "negative-index": (lambda t: t.replace("3 0 1 2", "3 0 1 -2"), ("index -2, but 3 vertices",)),
    "negative-length": (lambda t: t.replace("3 0 1 2", "-3 0 1 2"), ("within its 1 face",)),
    "decimal-comma": (lambda t: t.replace("0.5", "0,5"), ("damaged PLY", "0,5")),
    "numbers-left-over": (lambda t: t.replace("0.5", "0.5 0.5"), ("damaged PLY",)),
    "M20-number-1_0": (lambda t: t.replace("1 0 0", "1_0 0 0"), ("a number with _",)),
    "fraction-as-index": (lambda t: t.replace("3 0 1 2", "3 0 1 1.5"), ("1.5",)),
    "colour-256": (
        lambda t: t.replace("property float z\n", "property float z\nproperty uchar red\n")
        .replace("0 0\n", "0 0 256\n")
        .replace("0.5\n", "0.5 7\n"),
        ("vertex red 256",),
    ),
    "float-colours-to-255": (
        lambda t: t.replace("float x", "float red").replace("float y", "float green")
        .replace("float z\n", "float blue\nproperty float x\nproperty float y\nproperty float z\n")
        .replace("0 0\n", "0 255 1 2 3\n").replace("0.5\n", "0.5 4 4 3\n"),
        ("colours from 0 to 255",),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", PLY_FAULTS)
def test_ply_fault_is_named(case: str, tmp_path: Path) -> None:
    damage, words = PLY_FAULTS[case]
    text = ply_text("ascii", [(0, 0, 0), (1, 0, 0), (1, 1, 0.5)], [(0, 1, 2)]).decode()
    assert damage(text) != text
    fails(write(tmp_path, damage(text), "asset.ply"), *words)


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_ply_square(kind: str, tmp_path: Path) -> None:
    asset = load_asset(write(tmp_path, ply(kind), "asset.ply"))
    (square,) = asset.primitives
    np.testing.assert_array_equal(area(asset), [[0, 0, 0.5]] * 2)
    np.testing.assert_array_equal(square.normals, [[0, 0, 1]] * 4)
    assert square.colors is not None
    np.testing.assert_allclose(square.colors[0], [0.0331048, 0.1328683, 1, 1], rtol=2e-6)
    assert asset.materials[0].double_sided
    assert any("size 1 x 1 x 0" in notice for notice in asset.notices)


@pytest.mark.parametrize("kind", ["ascii", "binary"])
@pytest.mark.parametrize("fault", ["cut", "count", "index", "nan", "points"])
def test_ply_faults(kind: str, fault: str, tmp_path: Path) -> None:
    content = ply(kind)
    if fault == "cut":
        content = content[:-14]
    elif fault == "count":
        content = content.replace(b"element vertex 4", b"element vertex 2147483648")
    elif fault == "index":
        old, new = {
            "ascii": (b"3 0 2 3", b"3 0 2 9"),
            "binary": (struct.pack("<B3i", 3, 0, 2, 3), struct.pack("<B3i", 3, 0, 2, 9)),
        }[kind]
        content = content.replace(old, new)
    elif fault == "nan":
        old, new = {
            "ascii": (b"\n1 1 0.0", b"\n1 nan 0.0"),
            "binary": (struct.pack("<2f", 1, 1), struct.pack("<2f", 1, np.nan)),
        }[kind]
        content = content.replace(old, new)
    else:
        content = content.replace(b"element face 2", b"element face 0")
    fails(write(tmp_path, content, "asset.ply"))


def stl() -> bytes:
    """Return the square as binary STL."""
    triangles = [(0, 0, 0, 1, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, 0, 0, 1, 0)]
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *t, 0) for t in triangles)
    return bytes(80) + struct.pack("<I", 2) + body


def test_stl_square(tmp_path: Path) -> None:
    """A binary STL is flat, grey and of unknown unit."""
    asset = load_asset(write(tmp_path, stl(), "asset.STL"))
    np.testing.assert_array_equal(area(asset), [[0, 0, 0.5]] * 2)
    assert asset.primitives[0].normals is None
    assert any("no unit" in notice for notice in asset.notices)
    assert any("grey 0.8" in notice for notice in asset.notices)


def ascii_stl(name: str = "a") -> str:
    """Return the square as ASCII STL."""
    facets = "".join(
        f"  facet normal 0 0 1\n outer loop\n{corners} endloop\n endfacet\n"
        for corners in (
            "vertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\n",
            "vertex 0 0 0\nvertex 1 1 0\nvertex 0 1 0\n",
        )
    )
    return f"solid {name}\n{facets}endsolid {name}\n"


STL_SAME: dict[str, bytes] = {
    "ascii": ascii_stl().encode(),
    "upper-case": ascii_stl().upper().encode(),
    "crlf": ascii_stl().replace("\n", "\r\n").encode(),
    "names-like-statements": ascii_stl("facet normal 1 2").encode(),
    "two-solids": ascii_stl()
    .replace("endfacet\n  facet", "endfacet\nendsolid a\nsolid b\nfacet")
    .encode(),
    "binary-that-begins-with-solid": b"solid made by a tool".ljust(80) + stl()[80:],
    "binary-with-a-tail": stl() + b"tail",
    "M8-numbers-of-40-characters": ascii_stl()
    .replace("vertex 1 0 0", f"vertex 10.{'0' * 35}e-1 0 0")
    .encode(),
}


@pytest.mark.parametrize("case", STL_SAME)
def test_stl_spellings_agree(case: str, tmp_path: Path) -> None:
    asset = load_asset(write(tmp_path, STL_SAME[case], "asset.stl"))
    np.testing.assert_array_equal(area(asset), [[0, 0, 0.5]] * 2)
    assert any("bytes after" in notice for notice in asset.notices) == ("tail" in case)


STL_FAULTS = {
    "two-corners": (ascii_stl().replace("vertex 1 0 0\n", ""), "facet 0 is not one"),
    "word-for-a-number": (ascii_stl().replace("vertex 1 0 0", "vertex 1 x 0"), "x"),
    "cut": (ascii_stl()[:-30], "1 solid and 0 endsolid"),
    "cut-inside": (ascii_stl().replace(" endfacet\nendsolid", "endsolid"), "facet 1 is not one"),
    "M8-word-of-1000-characters": (
        ascii_stl().replace("1 0 0", f"1{'0' * 999} 0 0"), "(found 1000; limit 64)"),
    "inf": (ascii_stl().replace("vertex 1 0 0", "vertex 1 inf 0"), "NaN or infinite"),
    "binary-cut": (stl()[:-9], ""),
    "binary-count": (stl()[:80] + struct.pack("<I", 2**31) + stl()[84:], ""),
    "binary-nan": (
        stl().replace(struct.pack("<3f", 1, 1, 0), struct.pack("<3f", 1, np.nan, 0)), ""),
    "binary-empty": (bytes(84), ""),
}  # fmt: skip


@pytest.mark.parametrize("case", STL_FAULTS)
def test_stl_fault_is_named(case: str, tmp_path: Path) -> None:
    text, words = STL_FAULTS[case]
    fails(write(tmp_path, text, "asset.stl"), words)


REAL = {  # triangles, textures
    "spot/spot.obj": (5856, 1),
    "hard/negative_indices.obj": (12, 0),
    "hard/featuretype.STL": (3476, 0),
    "hard/soup.stl": (100, 0),
}


@needs_shared
@pytest.mark.parametrize("name", REAL)
def test_real_file_has_the_published_counts(name: str) -> None:
    asset = load_asset(MESHES / name)
    assert all(p.indices.flags.c_contiguous for p in asset.primitives)
    counts = sum(len(p.indices) for p in asset.primitives), len(asset.textures)
    assert counts == REAL[name]
    if name == "spot/spot.obj":
        (material,) = asset.materials
        assert (material.roughness, material.metallic) == (0.25, 0.0)


def test_mtl_share_and_mask_together_are_blended(tmp_path: Path) -> None:
    """A cut at .5 of what is .4 everywhere would leave nothing of the object."""
    Image.new("L", (2, 2), 255).save(tmp_path / "d.png")
    Image.new("RGB", (2, 2)).save(tmp_path / "c.png")
    (material,) = with_mtl(tmp_path, "map_Kd c.png\nmap_d d.png\nd 0.4\n").materials
    assert material.alpha_mode == "BLEND" and material.alpha == 0.4


@pytest.mark.parametrize(
    ("lines", "is_told"),
    [
        ("Kd 0 0 0\nKs 1 .8 .3\nPr .5\n", True),
        ("Kd 0 0 0\nKs 1 1 1\nPr .5\n", True),
        ("Kd .5 .5 .5\nKs .5 .5 .5\nPr .5\n", False),
        ("Kd 0 0 0\nKs 0 0 0\nPr .5\n", False),
    ],
)
def test_mtl_specular_color_that_matters_is_told(tmp_path: Path, lines: str, is_told: bool) -> None:
    """Gold by Phong's Ks would be black plastic without a word."""
    assert any("Ks" in notice for notice in with_mtl(tmp_path, lines).notices) == is_told
