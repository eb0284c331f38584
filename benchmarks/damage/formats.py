"""A small valid file of every format that warpir reads, and how it may be damaged."""

import hashlib
import io
import json
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import yaml
from hypothesis import strategies as st
from PIL import Image

from benchmarks.damage.mutations import (
    Bytes,
    damaged,
    damaged_exr,
    damaged_glb,
    damaged_json,
    damaged_png,
    damaged_safetensors,
    damaged_text,
)
from benchmarks.damage.reader import PHOTO_SIZE
from tests.builders.gltf_files import Builder
from tests.builders.image_files import icc_profile, matrix_profile, table_profile, write_image
from tests.io.test_camera_files import calibration, gltf_scene, transforms
from tests.scene.test_camera import fspy_parameters
from warpir.core.color import primaries_to_xyz
from warpir.io.images.color_profile import D50
from warpir.scene.camera import Camera, exr_matrices

WIDTH, HEIGHT = PHOTO_SIZE
INPUT, USAGE, MODEL = 3, 2, 4


@dataclass(frozen=True)
class Format:
    """One format, in one of its uses."""

    name: str
    reader: str
    """Of `benchmarks.damage.reader.READERS`."""
    file: str
    """Name of the file that is damaged; folders are made."""
    sound: bytes
    """What it holds when it is valid."""
    damage: Bytes
    beside: Mapping[str, bytes] = field(default_factory=dict)
    """What lies beside it."""
    codes: tuple[int, ...] = (INPUT,)
    """Exit codes of a refusal."""
    seal: Callable[[bytes], Mapping[str, bytes]] = lambda content: {}
    """What lies beside a damaged file, made from it."""
    target: str = ""
    """What the reader is given in place of the file."""


def formats() -> list[Format]:
    """Return all formats that are read without torch."""
    images = (*_photos(), *_lights_and_masks(), *_metadata())
    return [*images, *_gltf(), *_meshes(), *_cameras(), *_records()]


def _codes(channels: int = 3, dtype: type = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(7)
    ramp = np.linspace(0, 0.8, WIDTH)[None, :, None] * np.linspace(0.2, 1, HEIGHT)[:, None, None]
    noisy = ramp * (1.0 + 0.02 * rng.random((HEIGHT, WIDTH, channels)))
    return (noisy * np.iinfo(dtype).max).astype(dtype)


def _written(name: str, pixels: np.ndarray, **attributes: Any) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return write_image(Path(folder) / name, pixels, **attributes).read_bytes()


def _saved(kind: str, codes: np.ndarray | None = None, **options: Any) -> bytes:
    stream = io.BytesIO()
    picture = Image.fromarray(_codes()[::2, ::2] if codes is None else codes)
    picture.save(stream, kind, **options)
    return stream.getvalue()


def _exr(channels: Mapping[str, np.ndarray], **header: Any) -> bytes:
    stream = io.BytesIO()
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, dict(channels)).write(stream)
    return stream.getvalue()


def _exif() -> bytes:
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "maker"
    inner = exif.get_ifd(0x8769)
    inner[0xA405], inner[0xA001] = 28, 65535
    place = exif.get_ifd(0x8825)
    place[1], place[2] = "N", (48.0, 51.0, 29.0)
    return exif.tobytes()


def _both(sound: bytes, structured: Callable[[bytes], Bytes]) -> Bytes:
    return st.one_of(damaged(sound), structured(sound))


def _image(name: str, reader: str, kind: str, sound: bytes, damage: Bytes) -> Format:
    return Format(name, reader, f"file.{kind}", sound, damage)


def _plate() -> np.ndarray:
    """Return a linear picture, float32, shape [height, width, 3]."""
    return np.asarray(_codes().astype(np.float32) / np.float32(255))


def _planes(dtype: type) -> dict[str, np.ndarray]:
    return {c: np.ascontiguousarray(_plate()[..., k], dtype) for k, c in enumerate("RGB")}


def _photos() -> Iterator[Format]:
    photo, plate, half = _codes(), _plate(), _planes(np.float16)
    flat = _written("p.hdr", plate[:16, :32])
    p3 = matrix_profile("p3")
    png = _saved("PNG", photo[::2, ::2], icc_profile=p3)
    deep = _written("p.png", _codes(dtype=np.uint16)[::4, ::4])
    palette = _saved("PNG", np.asarray(Image.fromarray(photo).quantize(16)))
    yield _image("photo PNG 8 bits", "photo", "png", png, _both(png, damaged_png))
    yield _image("photo PNG 16 bits", "photo", "png", deep, _both(deep, damaged_png))
    yield _image("photo PNG palette", "photo", "png", palette, _both(palette, damaged_png))
    for name, kind, options in (
        ("JPEG", "jpg", {"exif": _exif(), "icc_profile": p3}),
        ("JPEG progressive", "jpg", {"progressive": True}),
        ("WebP", "webp", {"lossless": True, "exif": _exif(), "icc_profile": p3}),
        ("WebP lossy", "webp", {"quality": 80}),
        ("TIFF LZW", "tif", {"compression": "tiff_lzw", "icc_profile": p3}),
        ("TIFF deflate", "tif", {"compression": "tiff_adobe_deflate"}),
    ):
        saved = _saved({"jpg": "JPEG", "webp": "WEBP", "tif": "TIFF"}[kind], **options)
        yield _image(f"photo {name}", "photo", kind, saved, damaged(saved))
    float_tiff = _written("p.tif", plate[:12, :16], compression="zip")
    yield _image("photo TIFF float", "photo", "tif", float_tiff, damaged(float_tiff))
    for compression in ("ZIP", "PIZ", "DWAA", "RLE", "B44", "ZSTD"):
        sound = _exr(half, compression=getattr(OpenEXR, f"{compression}_COMPRESSION"))
        yield _image(f"photo EXR {compression}", "photo", "exr", sound, _both(sound, damaged_exr))
    size = OpenEXR.TileDescription()
    size.xSize = size.ySize = 16
    tiles = _exr(half, type=OpenEXR.tiledimage, tiles=size)
    yield _image("photo EXR tiles", "photo", "exr", tiles, _both(tiles, damaged_exr))
    yield _image("photo HDR", "photo", "hdr", flat, st.one_of(damaged(flat), damaged_text(flat)))


def _lights_and_masks() -> Iterator[Format]:
    photo = _codes()
    flat = _written("p.hdr", _plate()[:16, :32])
    sky = {c: plane[:16, :32] for c, plane in _planes(np.float16).items()}
    sound = _exr(sky)
    yield _image("light EXR", "envmap", "exr", sound, _both(sound, damaged_exr))
    yield _image("light HDR", "envmap", "hdr", flat, st.one_of(damaged(flat), damaged_text(flat)))
    sound = _saved("PNG", photo[:16, :32])
    yield _image("light PNG", "envmap", "png", sound, _both(sound, damaged_png))
    sound = _saved("PNG", photo[..., 0])
    yield _image("mask PNG", "mask", "png", sound, _both(sound, damaged_png))
    sound = _exr({"Y": _planes(np.float32)["G"]})
    yield _image("mask EXR", "mask", "exr", sound, _both(sound, damaged_exr))


def _metadata() -> Iterator[Format]:
    photo, p3 = _codes(), matrix_profile("p3")
    primaries = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)
    tables = table_profile(primaries_to_xyz(primaries, D50))
    curve = b"curv\0\0\0\0" + struct.pack(">IHxx", 1, 460)
    of_grey = icc_profile(b"GRAY", {b"kTRC": curve})
    tiny = photo[::8, ::8]
    for name, profile, codes in (
        ("matrix", p3, tiny),
        ("tables", tables, tiny),
        ("grey", of_grey, tiny[..., 0]),
    ):

        def with_profile(profile: bytes, codes: np.ndarray = codes) -> bytes:
            return _saved("PNG", codes, icc_profile=profile or b"\0")

        damage = damaged(profile).map(with_profile)
        yield _image(f"profile ICC {name}", "photo", "png", with_profile(profile), damage)

    def with_exif(exif: bytes) -> bytes:
        return _saved("JPEG", exif=exif[:60_000])

    exif = _exif()
    yield _image("tags EXIF", "photo", "jpg", with_exif(exif), damaged(exif).map(with_exif))


def _gltf() -> Iterator[Format]:
    builder = Builder()
    builder.base_color()
    builder.attribute("COLOR_0", np.full((4, 4), 200, np.uint8), normalized=True)
    glb = builder.glb()
    yield Format("mesh GLB", "asset", "asset.glb", glb, damaged_glb(glb))
    text = json.loads(builder.gltf())
    text["buffers"][0]["uri"] = "asset.bin"
    binary = bytes(builder.binary)
    sound, beside = json.dumps(text).encode(), {"asset.bin": binary}
    yield Format("mesh glTF", "asset", "asset.gltf", sound, damaged_json(text), beside)
    beside, content = {"asset.gltf": sound}, damaged(binary)
    yield Format("mesh glTF buffer", "asset", "asset.bin", binary, content, beside,
                 target="asset.gltf")  # fmt: skip

    picture = _saved("PNG", _codes()[:4, :4])

    def with_texture(picture: bytes) -> bytes:
        builder = Builder()
        builder.base_color({"bufferView": builder.view(picture or b"\0"), "mimeType": "image/png"})
        return builder.glb()

    damage = st.one_of(damaged(picture), damaged_png(picture)).map(with_texture)
    yield Format("mesh GLB texture", "asset", "asset.glb", with_texture(picture), damage)


def _meshes() -> Iterator[Format]:
    picture = _saved("PNG", _codes()[:4, :4])
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.5)]
    obj = "mtllib asset.mtl\no square\nusemtl red\n"
    obj += "".join(f"v {x} {y} {z} 0.5 0.5 0.5\n" for x, y, z in corners)
    obj += "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\ns 1\nf 1/1/1 2/2/1 3/3/1 4/1/1\nf -4 -3 -2\n"
    mtl = "newmtl red\nKd 0.8 0.1 0.1\nKs 0.1 0.1 0.1\nNs 40\nd 1\nmap_Kd -s 2 2 1 t.png\nPr 0.4\n"
    files = {"asset.obj": obj.encode(), "asset.mtl": mtl.encode(), "t.png": picture}
    for name in ("asset.obj", "asset.mtl"):
        beside = {other: content for other, content in files.items() if other != name}
        yield Format(f"mesh {name[-3:].upper()}", "asset", name, files[name],
                     damaged_text(files[name]), beside, target="asset.obj")  # fmt: skip

    header = "format {}\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\n"
    header = f"ply\n{header}property float z\nproperty uchar red\nproperty uchar green\n"
    header += "property uchar blue\nelement face 2\nproperty list uchar int vertex_indices\n"
    header += "end_header\n"
    rows = "".join(f"{x} {y} {z} 9 8 7\n" for x, y, z in corners) + "3 0 1 2\n4 0 1 2 3\n"
    ply = header.format("ascii 1.0") + rows
    packed = b"".join(struct.pack("<3f3B", *corner, 9, 8, 7) for corner in corners)
    packed += struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
    packed = header.format("binary_little_endian 1.0").encode() + packed
    for name, sound in (("ascii", ply.encode()), ("binary", packed)):
        yield Format(f"mesh PLY {name}", "asset", "a.ply", sound, damaged_text(sound))
        yield Format(f"points PLY {name}", "points", "a.ply", sound, damaged_text(sound))
    cloud = "".join(f"{x}, {y}, {z}\n" for x, y, z in corners).encode()
    yield Format("points text", "points", "a.xyz", cloud, damaged_text(cloud))

    facets = [(corners[0], corners[1], corners[2]), (corners[0], corners[2], corners[3])]
    stl = bytes(80) + struct.pack("<I", 2)
    words = "solid a\n"
    for facet in facets:
        stl += struct.pack("<12fH", 0, 0, 1, *(x for corner in facet for x in corner), 0)
        inner = "".join(f"vertex {x} {y} {z}\n" for x, y, z in facet)
        words += f"facet normal 0 0 1\nouter loop\n{inner}endloop\nendfacet\n"
    yield Format("mesh STL binary", "asset", "a.stl", stl, damaged(stl))
    sound = f"{words}endsolid a\n".encode()
    yield Format("mesh STL ascii", "asset", "a.stl", sound, damaged_text(sound))


def _cameras() -> Iterator[Format]:
    def json_camera(name: str, content: Any, file: str = "camera.json") -> Format:
        return Format(f"camera {name}", "camera", file, json.dumps(content).encode(),
                      damaged_json(content))  # fmt: skip

    pose = np.eye(4)
    pose[:3, 3] = 1.0, 1.6, 2.0
    own = {"fx": 40.0, "fy": 40.0, "cx": 24.0, "cy": 16.0, "w": WIDTH, "h": HEIGHT}
    yield json_camera("warpir", {**own, "c2w": pose.tolist()})
    parameters = fspy_parameters(WIDTH, HEIGHT, pose)
    yield json_camera("fSpy JSON", parameters)
    state = {"cameraParameters": parameters}

    def project(text: bytes) -> bytes:
        return b"fspy" + struct.pack("<3I", 1, len(text), 3) + text + b"png"

    sound = project(json.dumps(state).encode())
    damage = st.one_of(damaged(sound), damaged_json(state, project))
    yield Format("camera fSpy project", "camera", "camera.fspy", sound, damage)
    bends = {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": 0.0}
    yield json_camera("nerfstudio", transforms(pose, **bends))
    angle = {"camera_angle_x": 0.7, "camera_angle_y": 0.5, "aabb_scale": 4}
    frame = {"file_path": "./images/2.png", "sharpness": 3, "transform_matrix": pose.tolist()}
    yield json_camera("Instant-NGP", {**angle, "w": WIDTH, "h": HEIGHT, "frames": [frame]})
    yield json_camera("Waymo", {"camera_calibrations": [calibration(pose)]})
    scene = gltf_scene(pose)
    scene["cameras"], scene["nodes"] = scene["cameras"][1:], scene["nodes"][:2]
    scene["nodes"][1]["camera"], scene["scenes"] = 0, [{"nodes": [0]}]
    yield json_camera("glTF", scene, "camera.gltf")
    to_camera, to_ndc = exr_matrices(Camera(WIDTH, HEIGHT, 40.0, 40.0, 24.0, 16.0, pose))
    matrices = {"worldToCamera": to_camera, "worldToNDC": to_ndc}
    header = {name: np.array(matrix, np.float32, order="C") for name, matrix in matrices.items()}
    sound = _exr({"Y": np.zeros((HEIGHT, WIDTH), np.float16)}, **header)
    damage = st.one_of(damaged(sound), damaged_exr(sound))
    yield Format("camera EXR", "camera", "camera.exr", sound, damage)

    pinhole = "# Cameras\n7 OPENCV 480 360 400.0 400.0 240.5 160.25 -0.1 0.02 0.001 0.0\n"
    images = "# Images\n1 1.0 0.0 0.0 0.0 1.5 2.5 3.5 7 a/2.png\n1.5 2.5 -1 3.0 4.0 12\n"
    points = "# Points\n1 0.5 0.25 2.0 10 20 30 0.5 1 0\n2 1.5 0.25 2.0 10 20 30 0.5 1 1\n"
    text = {"cameras.txt": pinhole, "images.txt": images, "points3D.txt": points}
    files = {name: content.encode() for name, content in text.items()}
    binary = {
        "cameras.bin": struct.pack("<QIiQQ8d", 1, 7, 4, 480, 360, 400.0, 400.0, 240.5, 160.25,
                                   -0.1, 0.02, 0.001, 0.0),
        "images.bin": struct.pack("<QI7dI", 1, 1, 1.0, 0.0, 0.0, 0.0, 1.5, 2.5, 3.5, 7)
        + b"a/2.png\0" + struct.pack("<QddQ", 1, 1.5, 2.5, 2**64 - 1),
        "points3D.bin": struct.pack("<Q", 1)
        + struct.pack("<Q3d3BdQ2I", 1, 0.5, 0.25, 2.0, 1, 2, 3, 0.5, 1, 1, 0),
    }  # fmt: skip
    for kind, content in (("text", files), ("binary", binary)):
        for name, sound in content.items():
            others = {other: text for other, text in content.items() if other != name}
            reader = "points" if name.startswith("points") else "camera"
            damage = damaged_text(sound) if kind == "text" else damaged(sound)
            yield Format(f"{reader} COLMAP {name}", reader, name, sound, damage, others)


def _records() -> Iterator[Format]:
    lobe = {"amplitude": [30, 28, 25], "axis": [0.5, 0.8, 0.3], "sharpness": 60}
    lobes = {"format": "warpir-lobes", "version": 1, "lobes": [lobe, {**lobe, "sharpness": 0.5}]}

    def as_json(name: str, reader: str, file: str, content: Any, **options: Any) -> Format:
        sound = json.dumps(content).encode()
        return Format(name, reader, file, sound, damaged_json(content), **options)

    yield as_json("lobes.json", "lobes", "lobes.json", lobes)
    knots: dict[str, list[Any]] = {"x": [[0, 0.5, 1]], "y": [[0, 0.6, 1]], "slope": [[1, 1, 1]]}
    curves = {"format": "warpir-curves", "version": 1, "tone": "linear", "foreground": knots,
              "shadow_ratio": {name: rows * 3 for name, rows in knots.items()}}  # fmt: skip
    yield as_json("curves.json", "curves", "curves.json", curves)
    glb = Builder().glb()
    factors = {"base_color": [0.5, 0.5, 0.5], "metallic": 0, "roughness": 1, "emission": [0, 0, 0]}
    materials = {"format": "warpir-materials", "version": 1,
                 "materials": [{"name": _material_name(), **factors}]}  # fmt: skip
    yield as_json("materials.json", "materials", "m.json", materials, beside={"asset.glb": glb})

    config = {"photo": "p.png", "asset": "a.glb", "out": "out", "place": [-1, 0, -3], "fov": 60,
              "sun": "30,40,2", "samples": 16, "plane": True, "seed": 1, "size": 1, "prompt": "car",
              "horizon": None, "personalize": False, "lora_layers": ["to_q", "to_k"]}  # fmt: skip
    yield as_json("config JSON", "config", "config.json", config, codes=(USAGE,))
    text = yaml.safe_dump(config).encode() + b"camera_height: &h 1.5\nexposure: *h\n"
    tree = st.one_of(
        damaged_text(text), damaged_json(config), damaged_text(b"---\n" + text + b"...\n")
    )
    yield Format("config YAML", "config", "config.yaml", text, tree, codes=(USAGE,))
    record = {"format": 1, "config": config, "files": {}, "inputs": {}, "assumed": []}
    yield as_json("run.json as config", "config", "run.json", record, codes=(USAGE,))

    run = _run(config, curves)
    yield Format("run.json to reuse", "run", "run.json", run["run.json"],
                 damaged_json(json.loads(run["run.json"])), run)  # fmt: skip
    for name in ("envmap.exr", "curves.json", "camera.json"):

        def sealed(content: bytes, name: str = name) -> Mapping[str, bytes]:
            return {"run.json": _sealed(run, {name: content})}

        damage = damaged(run[name]) if name.endswith("exr") else damaged_text(run[name])
        yield Format(f"run's {name}", "run", name, run[name], damage, run, seal=sealed)

    photo = _saved("PNG", _codes())
    lines = [{"photo": "photo.png", "place": [0, 0, -4 - k], "fov": 60} for k in range(2)]
    sound = "".join(json.dumps(line) + "\n" for line in lines).encode()
    inner = damaged_json(lines[0]).map(lambda line: line + b"\n" + sound)
    beside = {f"run/{name}": content for name, content in run.items()}
    beside |= {"photo.png": photo, "asset.glb": glb}
    damage = st.one_of(inner, damaged_text(sound))
    yield Format("sequence", "sequence", "frames.jsonl", sound, damage, beside,
                 codes=(USAGE, INPUT))  # fmt: skip


@cache
def _material_name() -> str:
    from warpir.io.assets import load_asset

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "asset.glb"
        path.write_bytes(Builder().glb())
        return load_asset(path).materials[0].name


def _run(config: Mapping[str, Any], curves: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files of a finished run, as far as --reuse looks at them."""
    sky = np.full((8, 16), 0.5, np.float32)
    files = {
        "envmap.exr": _exr(dict.fromkeys("RGB", sky)),
        "curves.json": json.dumps(curves).encode(),
        "camera.json": json.dumps({"c2w": np.eye(4).tolist()}).encode(),
    }
    files["run.json"] = json.dumps({"format": 1, "config": config, "files": {}}).encode()
    return {**files, "run.json": _sealed(files, {})}


def _sealed(run: Mapping[str, bytes], changed: Mapping[str, bytes]) -> bytes:
    """Return a ``run.json`` whose sha256 are those of changed files."""
    files = {name: content for name, content in {**run, **changed}.items() if name != "run.json"}
    record = json.loads(run["run.json"])
    record["files"] = {name: hashlib.sha256(text).hexdigest() for name, text in files.items()}
    return json.dumps(record).encode()


def weights() -> Iterator[Format]:
    """Yield the formats that are read with torch."""
    import torch
    from safetensors.torch import save

    from warpir.core.atomic import Checkpoints
    from warpir.train.networks.regressor import RegressorConfig, random_regressor, save_regressor

    def file(name: str, reader: str, sound: bytes) -> Format:
        damage = damaged_safetensors(sound)
        return Format(name, reader, f"{reader}.safetensors", sound, damage, codes=(MODEL,))

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "w.safetensors"
        tiny = RegressorConfig(channels=(8, 8, 8), blocks=(1, 1), depth=1, heads=1, directions=20)
        save_regressor(random_regressor(1, tiny), path, {"steps": 1})
        yield file("regressor", "regressor", path.read_bytes())
        checkpoints = Checkpoints(Path(folder), {"config": {"seed": 1}})
        checkpoints.save("optimize", 50, {"light": torch.ones(3), "history": [{"loss": 0.5}]})
        (found,) = (Path(folder) / "checkpoints").iterdir()
        manifest, state = ((found / n).read_bytes() for n in ("manifest.json", "state.safetensors"))
    place = f"checkpoints/{found.name}"
    record = json.loads(manifest)

    def sealed(state: bytes) -> Mapping[str, bytes]:
        digest = hashlib.sha256(state).hexdigest()
        return {f"{place}/manifest.json": json.dumps({**record, "sha256": digest}).encode()}

    yield Format("checkpoint state", "checkpoint", f"{place}/state.safetensors", state,
                 damaged_safetensors(state), seal=sealed)  # fmt: skip
    yield Format("checkpoint manifest", "checkpoint", f"{place}/manifest.json", manifest,
                 damaged_json(record), {f"{place}/state.safetensors": state})  # fmt: skip
    layer = "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q"
    parts = {"lora_A": torch.ones(2, 8), "lora_B": torch.ones(8, 2)}
    tensors = {f"unet.{layer}.{name}.weight": part for name, part in parts.items()}
    about = {"lora_adapter_metadata": json.dumps({"unet.r": 2, "unet.lora_alpha": 4})}
    yield file("LoRA of diffusers", "lora", save(tensors, about))
    kohya = f"lora_unet_{layer.replace('.', '_')}"
    tensors = {f"{kohya}.lora_down.weight": parts["lora_A"],
               f"{kohya}.lora_up.weight": parts["lora_B"],
               f"{kohya}.alpha": torch.tensor(2.0)}  # fmt: skip
    yield file("LoRA of kohya", "lora", save(tensors))
