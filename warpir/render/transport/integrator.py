"""`transport`, the integrator inside the optimisation: trace once, then every step is a product.

Light transport is linear in the light, and geometry, camera and materials are fixed. Tracing
computes for each pixel the radiance per texel of a lat-long map (``T_fg``: object, any depth), or
the share of it that the object blocks from the ground plane (``T_shadow``). A step is then ``T L``
and its gradient ``T^T d``; no ray is cast. The kernels are `warpir.kernels.transport`.

The irradiance of an open plane is one analytic row. If the receiver is a mesh, each pixel has a row
for it (``T_receiver``), and the radiance of the mesh is a constant, as emission is. Each lamp near
the object has a row of its own (`warpir.render.near.rows`).

The numbers are unbiased for the given map, at the resolution of the rows.
"""

from __future__ import annotations

import time
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import warp as wp
from torch import Tensor

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import row_edges
from warpir.core.memory import Need
from warpir.render.glass.rows import glass_rows
from warpir.render.integrator import Radiance
from warpir.render.near.rows import LampRows, lamp_rows, with_lamps
from warpir.render.renderer import Renderer, index_of
from warpir.render.transport.cache import content_key, load_rows, save_rows
from warpir.render.transport.matrix import DenseRows, SparseRows, product
from warpir.render.transport.rows import (
    LOWER_OBJECT,
    LOWER_SHADOW,
    TRACING,
    TransportSettings,
    mesh_rows,
    object_rows,
    plane_rows,
)
from warpir.render.transport.tents import direction_counts, flux_noise, tent_irradiance
from warpir.render.transport.thrown import thrown_rows
from warpir.scene.light import Light, rasterize_lobes


class TransportIntegrator:
    """Light transport as stored rows; gradients to the light and the lamps' powers alone.

    Args:
        renderer: The scene to trace.
        object_pixels: Row-major pixels that may show the object, shape [object_pixel].
        receiver_pixels: Row-major pixels whose plane the object may shade, shape [receiver_pixel].
        depth: Surface interactions of the object's paths.
        settings: Resolution and counts.
        expected: Light that is likely, for putting directions where they matter; what is stored is
            right for every light.
        seed: Base seed of the frozen samples.
        cache: Folder in which traced rows are kept and found again, or None.

    Attributes:
        mask: Coverage of the object pixels [1], shape [object_pixel].
        seconds_traced: Time of tracing, or of reading the cache [s].
        is_cached: Whether the rows came from the cache.
        bytes: Memory that the rows take.

    Raises:
        InputError: The rows need more memory than the settings allow.
    """

    def __init__(
        self,
        renderer: Renderer,
        object_pixels: IntArray,
        receiver_pixels: IntArray,
        depth: int = 5,
        settings: TransportSettings | None = None,
        expected: Light | None = None,
        seed: int = 0,
        cache: Path | None = None,
    ) -> None:
        self.renderer = with_lamps(renderer, ())
        self.object_pixels = object_pixels
        self.receiver_pixels = receiver_pixels
        self.depth = depth
        self.settings = settings or TransportSettings()
        self.device = torch.device(str(wp.device_to_torch(renderer.device)))
        start = time.perf_counter()
        expected = expected or Light(texels=np.ones((8, 16, 3), np.float32))
        self.expected = tuple(
            to_texels(expected, h) for h in (self.settings.height_fg, self.settings.height_shadow)
        )
        self.has_mesh = renderer.scene.receiver.mesh is not None
        above, irradiance = self._open_irradiance()
        self.above = torch.from_numpy(above.astype(np.int64)).to(self.device)
        thrown = np.flatnonzero(self._irradiance(self.settings.height_fg))
        self.above_object = torch.from_numpy(thrown).to(self.device)
        self.irradiance = torch.from_numpy(irradiance).to(self.device)

        file = None
        if cache is not None:
            key = content_key(
                renderer.scene,
                object_pixels,
                receiver_pixels,
                depth,
                self.settings,
                expected,
                seed,
                renderer.is_ordered,
                renderer.bounce_depth,
            )
            file = cache / f"{key}.safetensors"
        stored = None if file is None else load_rows(file, self.device)
        self.is_cached = stored is not None
        if stored is None:
            stored = self._trace(above, seed)
            if file is not None:
                save_rows(file, stored)
        self._hold(stored)
        self.lamps: LampRows | None = None
        if renderer.scene.lamps:
            pixels = object_pixels, receiver_pixels
            self.lamps = lamp_rows(renderer, *pixels, depth, seed, self.device)
        wp.synchronize_device(renderer.device)
        self.seconds_traced = time.perf_counter() - start

    def _irradiance(self, height: int) -> Float64Array:
        """Return what each texel gives the open plane, shape [texel]; 1 with a mesh."""
        if self.has_mesh:
            return np.ones(2 * height * height)
        x, y, z = (float(c) for c in self.renderer.scene.receiver.normal)
        return tent_irradiance((x, y, z), height).reshape(-1)

    def _open_irradiance(self) -> tuple[IntArray, FloatArray]:
        """Return the texels that light the open plane, all with a mesh, and what each gives it."""
        irradiance = self._irradiance(self.settings.height_shadow)
        above = np.flatnonzero(irradiance > 0.0).astype(np.int32)
        return above, irradiance[above].astype(np.float32)

    def _trace(self, above: IntArray, seed: int) -> dict[str, Tensor]:
        """Trace all rows; names are those of the cache's arrays."""
        self._check_memory(0)
        traced = self._trace_mesh(seed) if self.has_mesh else self._trace_plane(above, seed)
        if self.renderer.bounce_depth:
            traced |= self._trace_thrown(seed)
        return self._trace_object(seed) | traced

    def _hold(self, stored: dict[str, Tensor]) -> None:
        """Store traced or cached rows as matrices."""
        self.T_fg = DenseRows(stored["T_fg"])
        self.T_shadow = SparseRows(
            stored["row"],
            stored["column"],
            stored["blocked"],
            (len(self.receiver_pixels), len(self.above)),
        )
        self.T_receiver = DenseRows(stored["T_receiver"]) if self.has_mesh else None
        self.T_thrown = DenseRows(stored["T_thrown"]) if self.renderer.bounce_depth else None
        if self.T_thrown is not None:
            self.emission_thrown = stored["emission_thrown"]
        if self.has_mesh:
            self.bounced, self.bounced_blocked = stored["bounced"]
        self.emission = stored["emission"]
        self.mask = stored["mask"].cpu().numpy()
        rows = (self.T_fg, self.T_shadow, self.T_receiver, self.T_thrown)
        self.bytes = sum(T.bytes for T in rows if T is not None)

    def _check_memory(self, entries: int) -> None:
        """Compare the size of both matrices, with so many sparse entries, with the limit."""
        settings = self.settings
        texels = 2 * settings.height_fg**2
        wide = 2 if settings.dtype == "bfloat16" else 4
        needed = 3 * wide * len(self.object_pixels) * texels + SparseRows.BYTES * entries
        if self.has_mesh:
            needed += wide * len(self.receiver_pixels) * 2 * settings.height_shadow**2
        if self.renderer.bounce_depth:
            needed += 3 * wide * len(self.receiver_pixels) * len(self.above_object)
        if entries == 0:
            rows = Need("the rows of light transport", needed, LOWER_OBJECT)
            self.renderer.memory.require(rows)
        if needed > settings.memory_mib << 20:
            raise InputError(
                "--transport-memory",
                f"light transport of {len(self.object_pixels)} object pixels"
                + (f", {len(self.receiver_pixels)} of --proxy" if self.has_mesh else "")
                + f" and {texels} texels needs {needed / 2**20:.0f} MiB or more, the limit is "
                f"{settings.memory_mib} MiB",
                "raise it (memory_mib), or lower --object-light-height or --guidance-width",
                ExitCode.RESOURCES,
            )

    def _trace_object(self, seed: int) -> dict[str, Tensor]:
        settings, count = self.settings, len(self.object_pixels)
        T_fg = self._new_rows((3, count, 2 * settings.height_fg**2), LOWER_OBJECT)
        emission = torch.empty((count, 3), device=self.device)
        mask = torch.empty(count, device=self.device)
        trace = glass_rows if self.renderer.scene.has_solid_glass else object_rows
        for part in trace(
            self.renderer, self.object_pixels, self.depth, settings, self.expected[0], seed
        ):
            rows = torch.from_numpy(part.rows.astype(np.int64)).to(self.device)
            T, emitted = wp.to_torch(part.T), wp.to_torch(part.emission)
            self._blacken(self.object_pixels[part.rows], "object's transport", T, emitted)
            T_fg[:, rows] = T.permute(2, 0, 1).to(T_fg.dtype)
            emission[rows] = emitted
            mask[rows] = wp.to_torch(part.count).to(torch.float32) / part.subsamples
        return {"T_fg": T_fg, "emission": emission, "mask": mask}

    def _new_rows(self, shape: tuple[int, int, int], lower: str) -> Tensor:
        """Return space for the rows of a matrix a channel, shape [channel, row, column]."""
        dtype = getattr(torch, self.settings.dtype)
        return self.renderer.memory.again(
            lambda: torch.empty(shape, dtype=dtype, device=self.device), TRACING, lower
        )

    def _blacken(self, pixels: IntArray, stage: str, *rows: Tensor) -> None:
        """Set the rows of pixels that are not finite to 0, in place, and count them.

        Raises:
            InputError: They are too many (`ExitCode.NUMERIC`).
        """
        finite = torch.stack([r.isfinite().flatten(1).all(dim=1) for r in rows]).all(dim=0)
        if bool(finite.all()):
            return
        bad = ~finite
        width = self.renderer.scene.camera.width
        self.renderer.bad_pixels.add(bad.cpu().numpy(), pixels, width, stage)
        for row in rows:
            row[bad] = 0.0

    def _may_see_object(self) -> IntArray:
        camera = self.renderer.scene.camera
        index = index_of(self.object_pixels, camera.width * camera.height)
        seen: IntArray = (index[self.receiver_pixels] >= 0).astype(np.int32)
        return seen

    def _trace_plane(self, above: IntArray, seed: int) -> dict[str, Tensor]:
        """Trace the plane and keep nonzero entries: most of it loses little of the sky."""
        entries = _Entries(self.device)
        for share in plane_rows(
            self.renderer,
            self.receiver_pixels,
            self._may_see_object(),
            above,
            self.settings,
            self.expected[1],
            seed,
        ):
            rows = wp.to_torch(share)
            part = slice(entries.row_count, entries.row_count + len(rows))
            self._blacken(self.receiver_pixels[part], "shadow's transport", rows)
            entries.add(rows, self.irradiance)
            self._check_memory(entries.count)
        return entries.tensors()

    def _trace_mesh(self, seed: int) -> dict[str, Tensor]:
        """Store each pixel's received light, and the nonzero entries of the blocked light."""
        settings, count = self.settings, len(self.receiver_pixels)
        entries = _Entries(self.device)
        T = self._new_rows((1, count, 2 * settings.height_shadow**2), LOWER_SHADOW)
        bounced = torch.empty((2, count, 3), device=self.device)
        for part in mesh_rows(
            self.renderer,
            self.receiver_pixels,
            self._may_see_object(),
            settings,
            self.expected[1],
            seed,
        ):
            received, blocked = wp.to_torch(part.received), wp.to_torch(part.blocked)
            rows = slice(entries.row_count, entries.row_count + len(received))
            sent, kept = wp.to_torch(part.bounced), wp.to_torch(part.bounced_blocked)
            pixels = self.receiver_pixels[rows]
            self._blacken(pixels, "receiver's transport", received, blocked, sent, kept)
            T[0, rows] = received.to(T.dtype)
            # The part of what is stored, so that rounding leaves a dark point dark.
            share = blocked / received.clamp(min=1e-30)
            entries.add(share * T[0, rows].to(torch.float32))
            bounced[0, rows], bounced[1, rows] = sent, kept
            self._check_memory(entries.count)
        return entries.tensors() | {"T_receiver": T, "bounced": bounced}

    def _trace_thrown(self, seed: int) -> dict[str, Tensor]:
        """Store what the object throws onto the receiver, of the map that lights the object."""
        settings, count = self.settings, len(self.receiver_pixels)
        T = self._new_rows((3, count, len(self.above_object)), LOWER_SHADOW)
        emission = torch.empty((count, 3), device=self.device)
        start = 0
        for part, emitted in thrown_rows(
            self.renderer,
            self.receiver_pixels,
            self._may_see_object(),
            settings,
            self.expected[0],
            seed,
        ):
            rows = slice(start, start + len(emitted))
            traced, constant = wp.to_torch(part), torch.from_numpy(emitted).to(self.device)
            self._blacken(self.receiver_pixels[rows], "bounce's transport", traced, constant)
            T[:, rows] = traced[:, self.above_object].permute(2, 0, 1).to(T.dtype)
            emission[rows] = constant
            start = rows.stop
        return {"T_thrown": T, "emission_thrown": emission}

    def staleness(self, light_fg: Light, light_shadow: Light) -> float:
        """Return the noise of the rows under these lights over that under the expected one [1].

        1 for an unchanged light. A sun that has moved to texels of one direction each has the
        square root of its former number of directions. Trace again when this is large.
        """
        budget, worst = self.settings.bright_directions, 0.0
        for light, expected in zip((light_fg, light_shadow), self.expected, strict=True):
            counts = direction_counts(expected, budget)
            texels = to_texels(light, len(expected))
            own = direction_counts(texels, budget)
            worst = max(worst, flux_noise(texels, counts) / max(flux_noise(texels, own), 1e-30))
        return worst

    def radiance(
        self,
        light_fg: Tensor,
        light_shadow: Tensor,
        seed: int,
        *,
        lamp_powers: Tensor | None = None,
    ) -> Radiance:
        """Render the object under ``light_fg`` and the plane under ``light_shadow``, and the lamps.

        ``seed`` is unused: the stored rows are fixed, and hold the scene's own materials.
        """
        settings = self.settings
        texels = self._texels(light_fg, settings.height_fg)
        foreground = product(self.T_fg, texels) + self.emission
        falling = self._texels(light_shadow, settings.height_shadow)[self.above]
        blocked = product(self.T_shadow, falling)
        if self.T_receiver is None:
            unoccluded = (self.irradiance @ falling).expand(len(self.receiver_pixels), 3)
        else:
            unoccluded = product(self.T_receiver, falling) + self.bounced
            blocked = blocked + self.bounced_blocked
        # Rounding alone may take more than there is.
        lit = (unoccluded - blocked).clamp(min=0.0)
        if self.T_thrown is not None:
            texels = self._texels(light_shadow, settings.height_fg)[self.above_object]
            lit = lit + product(self.T_thrown, texels) + self.emission_thrown
        where = light_fg.device
        whole = Radiance(foreground.to(where), lit.to(where), unoccluded.to(where))
        return whole if self.lamps is None else self.lamps.added(whole, lamp_powers)

    def _texels(self, light: Tensor, height: int) -> Tensor:
        """Return a map at ``height`` rows on our device, shape [texel, 3]; differentiable."""
        return resize(light.to(self.device), height).reshape(-1, 3)


class _Entries:
    """Gathers the entries of a sparse matrix that are not zero, chunk by chunk of rows."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        none = torch.zeros(0, dtype=torch.int32, device=device)
        self.parts = [(none, none, none.to(torch.float32))]
        self.row_count = 0
        self.count = 0

    def add(self, dense: Tensor, by_column: Tensor | None = None) -> None:
        """Append rows, each column times its factor."""
        row, column = torch.nonzero(dense, as_tuple=True)
        values = dense[row, column]
        if by_column is not None:
            values = values * by_column[column]
        self.parts.append(((row + self.row_count).to(torch.int32), column.to(torch.int32), values))
        self.row_count += len(dense)
        self.count += len(row)

    def tensors(self) -> dict[str, Tensor]:
        """Return the entries sorted by row."""
        names = ("row", "column", "blocked")
        return {n: torch.cat(p) for n, p in zip(names, zip(*self.parts, strict=True), strict=True)}


def to_texels(light: Light, height: int) -> FloatArray:
    """Return a light as a map, shape [height, 2 height, 3]."""
    texels = np.zeros((height, 2 * height, 3), np.float32)
    if light.texels is not None:
        texels += resize(torch.from_numpy(np.ascontiguousarray(light.texels)), height).numpy()
    if light.lobes is not None:
        texels += rasterize_lobes(light.lobes, height, 2 * height)
    return texels


def resize(texels: Tensor, height: int) -> Tensor:
    """Resample a map to ``height`` rows: each texel is the mean over its solid angle.

    The differentiable twin of `warpir.core.latlong.resize_map`.

    Args:
        texels: Lat-long radiance, shape [He, We, 3].
        height: Rows wanted; columns become twice as many.
    """
    rows, columns = texels.shape[:2]
    if (rows, columns) == (height, 2 * height):
        return texels

    by_row, by_column = _shares(rows, columns, height, texels.device, texels.dtype)
    # One after the other: all three at once go through a matrix of both sizes squared.
    coarse = torch.einsum("ai,ijc->ajc", by_row, texels)
    return torch.einsum("bj,ajc->abc", by_column, coarse)


@lru_cache(maxsize=8)
def _shares(
    rows: int, columns: int, height: int, device: torch.device, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Return the share of each old row in each new one, and the same of columns."""

    def overlaps(old: Float64Array, new: Float64Array) -> Tensor:
        """Share of each old interval in each new one, between rising edges."""
        low = np.maximum(new[:-1, None], old[None, :-1])
        high = np.minimum(new[1:, None], old[None, 1:])
        share = np.maximum(high - low, 0.0) / np.diff(new)[:, None]
        return torch.from_numpy(share.astype(np.float32)).to(device, dtype)

    by_column = overlaps(np.linspace(0, 1, columns + 1), np.linspace(0, 1, 2 * height + 1))
    return overlaps(-row_edges(rows), -row_edges(height)), by_column
