"""What each part of a scene costs its kernel on a card: registers, spills and code.

    python -m benchmarks.registers [--arch 90] [--ptxas FILE]

`warpir.kernels.path.foreground_kernel` is compiled for a CUDA architecture in each variant that a
scene may need, by Warp and NVIDIA's ptxas (of the package ``nvidia-cuda-nvcc``); no card is needed.
"""

import argparse
import re
import subprocess
import tempfile
from pathlib import Path

import warp as wp

from warpir.kernels.path import Viewer, foreground_kernel
from warpir.kernels.types import ANISOTROPY, IRIDESCENCE, LAYERS
from warpir.render.device import start_warp

ALL_LAYERS = int(LAYERS | ANISOTROPY | IRIDESCENCE)
VARIANTS = {
    "plain": (0, False, Viewer.CAMERA, False, False, False),
    "coats, cloth, thin glass": (int(LAYERS), False, Viewer.CAMERA, False, False, True),
    "the same, brushed metal, thin films": (ALL_LAYERS, False, Viewer.CAMERA, False, False, True),
    "plain, triangles that let rays pass": (0, False, Viewer.CAMERA, False, False, True),
    "plain, a mesh as receiver": (0, True, Viewer.CAMERA, False, False, False),
    "plain, lamps": (0, False, Viewer.CAMERA, True, False, False),
    "solid glass": (int(LAYERS), False, Viewer.CAMERA, False, True, True),
    "what is thrown on the ground, plain": (0, False, Viewer.GROUND, False, False, False),
    "what a glossy ground mirrors, plain": (0, False, Viewer.MIRROR, False, False, False),
}
"""Arguments of `foreground_kernel` by what the scene has."""


def main() -> None:
    """Print a table of all variants."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--arch", type=int, default=90, help="90 is an H100 or H200 (default)")
    parser.add_argument("--ptxas", default="ptxas", help="the assembler")
    options = parser.parse_args()
    start_warp()
    print("| scene | registers | spilled, stores / loads [byte] | code [KiB] |\n|---|---|---|---|")
    for name, variant in VARIANTS.items():
        with tempfile.TemporaryDirectory() as folder:
            module = foreground_kernel(*variant).module
            wp.compile_aot_module(module, arch=options.arch, module_dir=folder, use_ptx=True)
            (ptx,) = Path(folder).glob("*.ptx")
            ptx.write_bytes(ptx.read_bytes().rstrip(b"\0"))  # as C ends its text
            cubin = Path(folder, "cubin")
            command = [options.ptxas, "-v", f"-arch=sm_{options.arch}", str(ptx), "-o", str(cubin)]
            said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
            used = re.findall(r"Used (\d+) registers", said)
            stores, loads = re.findall(r"(\d+) bytes spill (?:stores|loads)", said)[:2]
            size = cubin.stat().st_size // 1024
        print(f"| {name} | {', '.join(used)} | {stores} / {loads} | {size} |", flush=True)


if __name__ == "__main__":
    main()
