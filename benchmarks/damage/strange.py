"""What valid but strange photos, assets and options do: a run each, of a few pixels.

    python -m benchmarks.damage.strange --minutes 15 --seed 1 [--only photos]

Nothing here is damaged, but all is unusual: modes, sizes, tags and profiles of photos; shapes,
sizes, materials and trees of assets; values of options. Right is a whole run whose numbers are
finite, or one ``error:`` line with the exit code of its class (`benchmarks.damage.reader`).
"""

import argparse
import io
import json
import shutil
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.damage.__main__ import Reader, fault_of
from benchmarks.damage.draws import NOT_FINITE, SIZES, Photos, run_of, shown
from benchmarks.damage.formats import Format
from tests.builders.gltf_files import Builder
from tests.builders.insertions import write_inputs
from warpir.app.config import DEFAULTS

SECONDS = 60.0
"""Longest a run may take."""
CODES = {"photos": (3,), "assets": (3,), "lamps": (2, 3), "options": (2, 3, 4, 5, 7)}
"""Exit codes of a refusal, by kind."""
MATERIALS = {
    "transmission": "transmissionFactor", "ior": "ior", "dispersion": "dispersion",
    "volume": "thicknessFactor attenuationDistance attenuationColor",
    "clearcoat": "clearcoatFactor clearcoatRoughnessFactor",
    "emissive_strength": "emissiveStrength",
    "sheen": "sheenColorFactor sheenRoughnessFactor",
    "specular": "specularFactor specularColorFactor",
    "anisotropy": "anisotropyStrength anisotropyRotation",
    "iridescence": "iridescenceFactor iridescenceIor iridescenceThicknessMaximum",
}  # fmt: skip
"""Members of the extensions of a glTF material: numbers, and colours."""


class Inputs(Photos):
    """Draws the other inputs."""

    # ---------------------------------------------------------------------------------- assets

    def assets(self, folder: Path) -> list[str]:
        """Write an asset and return a command line."""
        suffix = self.one(("glb", "glb", "glb", "obj", "ply", "stl"))
        points, faces = self._mesh()
        path = folder / f"asset.{suffix}"
        getattr(self, f"_{suffix}")(path, points, faces)
        changes: dict[str, str | None] = {"asset": str(path)}
        if self.odd(0.6):
            changes["size"] = str(self.one(("1", "0.5", "1e-3", "3")))
        if self.odd(0.2):
            changes["asset_up"] = self.one(("+z", "-y", "-x", "+x"))
        if self.odd(0.2):
            changes["missing_textures"] = "grey"
        if self.odd(0.1):
            changes.update(asset=None, proxy=str(path), demo=None)
            changes["asset"] = str(folder / "box.glb")
        return run_of(folder, **changes)

    def _mesh(self) -> tuple[np.ndarray, np.ndarray]:
        count = int(self.one((3, 4, 8, 30)))
        points = self.rng.normal(size=(count, 3))
        faces = self.rng.integers(0, count, (int(self.one((1, 2, 12, 60))), 3))
        if self.odd(0.4):  # a whole box, inside out half of the time
            points = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
            faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                              [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7],
                              [1, 7, 3]])  # fmt: skip
            faces = faces[:, ::-1] if self.odd(0.5) else faces
        if self.odd(0.3):
            faces = np.concatenate([faces, faces[:1], faces[:1, ::-1], faces[:1, [0, 0, 1]]])
        if self.odd(0.15):
            points[:, int(self.rng.integers(3))] = 0.0
        if self.odd(0.25):
            points = points * float(self.one((1e30, 1e-30, 1e12, 1e-12, 1e19, 1e-20, 1e5, -1.0)))
        if self.odd(0.1):
            points = points + float(self.one((1e6, 1e30, -1e12)))
        if self.odd(0.15):
            value = self.one(NOT_FINITE) if self.odd(0.3) else self.number()
            points[tuple(self.rng.integers(points.shape))] = value
        if self.odd(0.03):
            return points[:0], faces[:0]
        return points, faces

    def _obj(self, path: Path, points: np.ndarray, faces: np.ndarray) -> None:
        (path.parent / "odd.mtl").write_text(
            f"newmtl a\nKd {self.number()} .5 .5\nNs {self.number()}\nd {self.number()}\n"
            f"Ke {self.number()} 0 0\nNi {self.number()}\nPr {self.number()}\nPm {self.number()}\n"
        )
        lines = ["mtllib odd.mtl", "usemtl a"] if self.odd(0.5) else ["o", "g a b", "s off"]
        lines += ["v " + " ".join(map(repr, point)) for point in points.tolist()]
        lines += [f"vt {self.number()} {self.number()}", "vn 0 0 0", "vn 1e30 0 0", "p 1", "l 1 2"]
        form = self.one(("{0}", "{0}/1", "{0}//1", "{0}/1/2"))
        lines += ["f " + " ".join(form.format(k + 1) for k in face) for face in faces.tolist()]
        path.write_text("\n".join(lines) + "\n")

    def _ply(self, path: Path, points: np.ndarray, faces: np.ndarray) -> None:
        kind, letter = self.one((("float", "f"), ("double", "d")))
        more = self.one(("", "property uchar red\nproperty uchar green\nproperty uchar blue\n"))
        head = (f"ply\nformat binary_little_endian 1.0\ncomment é\nelement vertex {len(points)}\n"
                + "".join(f"property {kind} {axis}\n" for axis in "xyz") + more
                + f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
                + "end_header\n")  # fmt: skip
        with np.errstate(over="ignore"):
            rows = [p.astype(letter).tobytes() + b"\xff\x80\0" * bool(more) for p in points]
        rows += [struct.pack("<B3i", 3, *face) for face in faces.tolist()]
        path.write_bytes(head.encode() + b"".join(rows))

    def _stl(self, path: Path, points: np.ndarray, faces: np.ndarray) -> None:
        with np.errstate(over="ignore"):
            corners = points.astype("f4")[faces] if len(faces) else np.zeros((0, 3, 3), "f4")
        normal = struct.pack("<3f", 0, 0, float(np.float32(self.one(NOT_FINITE))))
        body = b"".join(normal + c.tobytes() + b"\0\0" for c in corners)
        path.write_bytes(b"\0" * 80 + struct.pack("<I", len(corners)) + body)

    def _glb(self, path: Path, points: np.ndarray, faces: np.ndarray) -> None:
        file = Builder()
        if len(points):
            with np.errstate(over="ignore"):
                file.attribute("POSITION", points.astype("f"))
            file.primitive["indices"] = file.accessor(faces.ravel().astype("I"))
            for name, columns in (("NORMAL", 3), ("TEXCOORD_0", 2), ("TANGENT", 4), ("COLOR_0", 4)):
                file.primitive["attributes"].pop(name, None)
                if self.odd(0.4):
                    values = self.rng.normal(size=(len(points), columns))
                    values *= self.one((1.0, 1.0, 0.0, 1e30, 1e-30))
                    file.attribute(name, values.astype("f"))
        elif self.odd(0.5):
            file.json["meshes"][0]["primitives"] = []
        self._material(file)
        self._tree(file)
        path.write_bytes(file.glb())

    def _material(self, file: Builder) -> None:
        def number() -> float:
            return self.number() if self.odd(0.4) else float(self.rng.random())

        if self.odd(0.5):
            file.pbr["baseColorFactor"] = [number() for _ in range(4)]
            file.pbr["roughnessFactor"], file.pbr["metallicFactor"] = number(), number()
            file.material["emissiveFactor"] = [number() for _ in range(3)]
            file.material["alphaMode"] = self.one(("OPAQUE", "MASK", "BLEND"))
            file.material["alphaCutoff"] = number()
            file.material["doubleSided"] = self.odd(0.5)
        if self.odd(0.4):
            stream = io.BytesIO()
            mode = self.one(("1", "L", "LA", "P", "RGB", "RGBA", "I;16"))
            self._picture(mode, self.one(SIZES)).save(stream, "PNG")
            image = {"bufferView": file.view(stream.getvalue()), "mimeType": "image/png"}
            texture: dict[str, Any] = {"index": file.texture(image)}
            if self.odd(0.3):
                texture["texCoord"] = int(self.one((0, 1, 7)))
            where = self.one(("baseColorTexture", "metallicRoughnessTexture", "normalTexture",
                              "occlusionTexture", "emissiveTexture"))  # fmt: skip
            (file.pbr if where[0] in "bm" else file.material)[where] = texture
        names = ("transmission", "ior", "volume", "clearcoat", "sheen", "specular", "iridescence",
                 "anisotropy", "emissive_strength", "unlit", "dispersion", "variants")  # fmt: skip
        if self.odd(0.5):
            extensions: dict[str, Any] = {}
            for name in names if self.odd(0.3) else (self.one(names),):
                full = {k: [number() for _ in range(3)] if "Color" in k else number()
                        for k in MATERIALS.get(name, "").split()}  # fmt: skip
                extensions[f"KHR_materials_{name}"] = full if self.odd(0.7) else {}
            file.material["extensions"] = extensions
            file.json["extensionsUsed"] = list(extensions)

    def _tree(self, file: Builder) -> None:
        kind = self.one(("plain", "plain", "scale", "matrix", "deep", "many", "cycle", "shared"))
        nodes: list[dict[str, Any]] = file.json["nodes"]
        if kind == "scale":
            sizes = (1.0, -1.0, 2.0, 1e-6, 0.0)
            nodes[0]["scale"] = [self.one((*sizes, self.number())) for _ in "xyz"]
            turns = ([0, 0, 0, 1], [0, 0, 0, 0], [1, 1, 1, 1], [0, 0, 0, -1])
            nodes[0]["rotation"] = self.one(turns)
            nodes[0]["translation"] = [self.number() if self.odd(0.2) else 0.0 for _ in "xyz"]
        elif kind == "matrix":
            matrix = np.eye(4)
            matrix[:3, :3] += self.rng.normal(size=(3, 3)) * self.one((0.0, 0.3, 3.0))
            matrix[3, int(self.rng.integers(4))] = self.one((1.0, 0.0, 0.5))
            nodes[0]["matrix"] = matrix.T.ravel().tolist()
        elif kind == "deep":
            depth = int(self.one((10, 500, 3000)))
            scale = self.one((1.0, 0.9, 1.1, -1.0))
            nodes[:] = [{"children": [k + 1], "scale": [scale] * 3} for k in range(depth)]
            nodes.append({"mesh": 0})
        elif kind == "many":
            count = int(self.one((2, 100, 5000)))
            nodes[:] = [{"mesh": 0, "translation": [float(k), 0, 0]} for k in range(count)]
            file.json["scenes"] = [{"nodes": list(range(count))}]
        elif kind == "cycle":
            nodes[:] = [{"mesh": 0, "children": [1]}, {"children": [self.one((0, 1))]}]
        elif kind == "shared":
            nodes[:] = [{"children": [2]}, {"children": [2]}, {"mesh": 0}]
            file.json["scenes"] = [{"nodes": [0, 1]}]

    # ----------------------------------------------------------------------------------- lamps

    def lamps(self, folder: Path) -> list[str]:
        """Write lamps near the object, or give one, and return a command line."""
        kind = self.one(("json", "json", "glb", "flag"))
        if kind == "flag":
            numbers = [self.near() for _ in range(self.one((5, 8)))]
            return [*run_of(folder), "--lamp=" + shown(numbers)]
        path = folder / f"lamps.{kind}"
        rows = [self._lamp(kind) for _ in range(self.one((1, 1, 2, 9, 70)))]
        if kind == "json":
            path.write_text(json.dumps({"format": "warpir-lamps", "version": 1, "lamps": rows}))
            return [*run_of(folder), "--lamps", str(path)]
        file = Builder()
        file.json["extensions"] = {"KHR_lights_punctual": {"lights": rows}}
        file.json["extensionsUsed"] = ["KHR_lights_punctual"]
        self._tree(file)
        for node in file.json["nodes"]:
            light = int(self.rng.integers(len(rows)))
            node["extensions"] = {"KHR_lights_punctual": {"light": light}}
        path.write_bytes(file.glb())
        changes = {"asset": str(path)} if self.odd(0.3) else {}
        return [*run_of(folder, **changes), "--lamps", str(path)]

    def near(self) -> Any:
        """Return a number as a lamp near the object has it; some are of any size, or none."""
        return self.number() if self.odd(0.1) else float(self.one((0.1, 1, -4, 1e-6, 500, 0)))

    def _lamp(self, kind: str) -> dict[str, Any]:
        vectors = {name: [self.near() for _ in "xyz"] for name in ("center", "edge_x", "edge_y")}
        color = [abs(self.near()) for _ in "rgb"]
        if kind == "glb":
            lamp = {"type": self.one(("point", "spot", "directional", "x")), "color": color,
                    "intensity": self.near(), "range": self.near()}  # fmt: skip
        else:
            lamp = {**vectors, "power": abs(self.near()), "color": color}
            if self.odd(0.5):
                radius = abs(self.near())
                lamp = {"center": lamp["center"], "radius": radius, "power": lamp["power"]}
        if self.odd(0.1):
            lamp[self.one(tuple(lamp))] = self.value()
        return lamp

    # --------------------------------------------------------------------------------- options

    def options(self, folder: Path) -> list[str]:
        """Return a command line, or one of a configuration, whose values are strange."""
        names = [name for name in DEFAULTS if name not in ("out", "model", "device", "demo")]
        chosen = {self.one(names): self.value() for _ in range(int(self.rng.integers(1, 4)))}
        argv = run_of(folder)
        if self.odd(0.5):
            (folder / "odd.yaml").write_text(json.dumps(chosen))
            argv += ["--config", str(folder / "odd.yaml")]
        else:
            for name, value in chosen.items():
                argv += [f"--{name.replace('_', '-')}={shown(value)}"]
        # A whole run where no value may make it long.
        return argv if self.odd(0.5) and not set(chosen) & LONG else [*argv, "--validate"]


LONG = {"samples", "rays", "depth", "width", "steps", "threads", "light_height", "fit_lobes",
        "lobes", "sequence", "guidance", "guidance_width", "object_light_height", "resume",
        "prompt",
        "refine", "class_images", "lora_steps", "mitsuba", "usd", "reuse", "fov"}  # fmt: skip
"""Options that may make a run long, or another one."""


def survey(kind: str, minutes: float, seed: int, keep: Path | None) -> dict[str, Any]:
    """Make runs for some minutes and return what became of them."""
    draw = Inputs(seed)
    make: Callable[[Path], list[str]] = getattr(draw, kind)
    codes: Counter[int] = Counter()
    faults: list[str] = []
    longest = 0.0
    with tempfile.TemporaryDirectory(prefix="warpir-strange-") as temporary, Reader() as reader:
        folder = Path(temporary)
        write_inputs(folder)
        form = Format(kind, "insert", "argv.json", b"", None, codes=CODES[kind])  # type: ignore[arg-type]
        (folder / "argv.json").write_text(json.dumps(run_of(folder)))
        ended = reader.warm(form, folder)
        assert ended.get("status") == 0 and not ended["err"], ended
        start = time.monotonic()
        while time.monotonic() - start < 60.0 * minutes:
            shutil.rmtree(folder / "out", ignore_errors=True)
            (folder / "argv.json").write_text(json.dumps(make(folder)))
            ended = reader.warm(form, folder)
            codes[ended.get("status", -1)] += 1
            longest = max(longest, ended.get("seconds", SECONDS))
            fault = fault_of(form, ended)
            if fault and fault[:60] not in [other[:60] for other in faults]:
                faults.append(fault)
                print(f"    {fault[:600]}", flush=True)
                if keep is not None:
                    kept = keep / f"{kind}-{seed}-{len(faults)}"
                    shutil.rmtree(kept, ignore_errors=True)
                    shutil.copytree(folder, kept)
    minutes = round((time.monotonic() - start) / 60.0, 1)
    return {"kind": kind, "seed": seed, "inputs": codes.total(), "minutes": minutes,
            "ends": {str(code): count for code, count in sorted(codes.items())},
            "longest_seconds": round(longest, 1), "faults": len(faults)}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Survey each kind; 1 when there was a fault."""
    name = "python -m benchmarks.damage.strange"
    parser = argparse.ArgumentParser(prog=name, description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=tuple(CODES), help="one kind")
    parser.add_argument("--keep", type=Path, help="folder for inputs that make a fault")
    options = parser.parse_args(argv)
    rows = []
    for kind in CODES if options.only is None else (options.only,):
        rows.append(survey(kind, options.minutes, options.seed, options.keep))
        print(json.dumps(rows[-1]), flush=True)
    return int(any(row["faults"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
