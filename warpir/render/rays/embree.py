"""Embree's tree of a scene's triangles, for rays on the CPU.

Kernels call Embree's C functions by their addresses (`warpir.kernels.tracing.triangles`), so only
the tree is made here. The library is the one that `embreex` brings; where that has no wheel, the
CPU uses Warp's tree as CUDA does.
"""

from __future__ import annotations

import ctypes
import weakref
from ctypes import c_char_p, c_int, c_size_t, c_uint, c_void_p
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from warpir.core.arrays import FloatArray, IntArray

TRIANGLES, INDEX_BUFFER, VERTEX_BUFFER = 0, 0, 1
UINT3, FLOAT3 = 0x5003, 0x9003
ROBUST = 1 << 2
"""Scene flag: no ray passes between two triangles that share an edge."""
OUT_OF_MEMORY = 4
SIGNATURES = {
    "rtcNewDevice": (c_void_p, [c_char_p]),
    "rtcGetDeviceError": (c_int, [c_void_p]),
    "rtcReleaseDevice": (None, [c_void_p]),
    "rtcNewScene": (c_void_p, [c_void_p]),
    "rtcSetSceneFlags": (None, [c_void_p, c_int]),
    "rtcAttachGeometry": (c_uint, [c_void_p, c_void_p]),
    "rtcCommitScene": (None, [c_void_p]),
    "rtcReleaseScene": (None, [c_void_p]),
    "rtcNewGeometry": (c_void_p, [c_void_p, c_int]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [c_void_p, c_int, c_uint, c_int, c_void_p, c_size_t, c_size_t, c_size_t],
    ),
    "rtcCommitGeometry": (None, [c_void_p]),
    "rtcReleaseGeometry": (None, [c_void_p]),
}
"""Result and arguments of the functions of ``embree4/rtcore.h`` that are called here."""


@dataclass(frozen=True)
class Embree:
    """The loaded library, with the addresses that kernels call."""

    functions: ctypes.CDLL
    intersect: int
    occluded: int


@cache
def library() -> Embree | None:
    """Load Embree 4; None where it is not installed."""
    spec = find_spec("embreex")
    if spec is None or spec.origin is None:
        return None
    package = Path(spec.origin).parent
    # Where the tools that repair wheels for Linux, Windows and macOS put libraries.
    folders = (package.parent / "embreex.libs", package / ".dylibs", package)
    files = [f for folder in folders for f in sorted(folder.glob("*embree4*"))]
    if not files:
        return None
    functions = ctypes.CDLL(str(files[0]))
    for name, (result, arguments) in SIGNATURES.items():
        function = getattr(functions, name)
        function.restype, function.argtypes = result, arguments
    intersect, occluded = (
        ctypes.cast(getattr(functions, name), c_void_p).value or 0
        for name in ("rtcIntersect1", "rtcOccluded1")
    )
    return Embree(functions, intersect, occluded)


class EmbreeScene:
    """Triangles in Embree's tree, released with this object.

    Args:
        embree: The library.
        positions: Corners [m], shape [vertex, 3].
        indices: Vertex of each corner, shape [3 * triangle].

    Attributes:
        handle: The ``RTCScene``.

    Raises:
        MemoryError: The tree does not fit into memory.
        RuntimeError: Embree refuses the triangles.
    """

    def __init__(self, embree: Embree, positions: FloatArray, indices: IntArray) -> None:
        call = embree.functions
        # Embree reads 16 bytes of each vertex, also of the last.
        padded = np.zeros((len(positions) + 1, 3), np.float32)
        padded[:-1] = positions
        corners = np.ascontiguousarray(indices, np.uint32)
        device = call.rtcNewDevice(None)
        self.handle: int = call.rtcNewScene(device)
        call.rtcSetSceneFlags(self.handle, ROBUST)
        geometry = call.rtcNewGeometry(device, TRIANGLES)
        for kind, layout, array, count in (
            (VERTEX_BUFFER, FLOAT3, padded, len(positions)),
            (INDEX_BUFFER, UINT3, corners, len(corners) // 3),
        ):
            call.rtcSetSharedGeometryBuffer(
                geometry, kind, 0, layout, array.ctypes.data, 0, 12, count
            )
        call.rtcCommitGeometry(geometry)
        call.rtcAttachGeometry(self.handle, geometry)
        call.rtcReleaseGeometry(geometry)
        call.rtcCommitScene(self.handle)
        error = call.rtcGetDeviceError(device)
        self._release = weakref.finalize(self, _release, call, self.handle, device, padded, corners)
        if error == OUT_OF_MEMORY:
            raise MemoryError("Embree's tree of the triangles")
        if error:
            raise RuntimeError(f"Embree: error {error} over {len(corners) // 3} triangles")


def _release(call: ctypes.CDLL, scene: int, device: int, *buffers: np.ndarray) -> None:
    """Release a scene; ``buffers`` are those that it has read until now."""
    call.rtcReleaseScene(scene)
    call.rtcReleaseDevice(device)
