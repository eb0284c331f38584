"""`transport`, the integrator inside the optimisation: trace once, then every step is a product.

Light transport is linear in the light, and geometry, camera and materials stand still. `trace`
writes for each pixel what each texel of a lat-long map sends into it (``T_fg``: object, any depth)
or how much of it the object keeps from the ground plane (``T_shadow``). A step is then
``T L`` and its gradient ``T^T d``; no ray is cast. The kernels are `warpir.kernels.transport`.

What the numbers are unbiased for is the map they are handed: lobes are averaged over its texels
first. `edge_width` says what that costs a shadow's edge; lobes too narrow for the texels can be
left to `warpir.mis` (`TransportSettings.sharp_samples`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from warpir.bridge import rasterize
from warpir.color import luminance
from warpir.integrator import LightTensors, MaterialTensors, Radiance
from warpir.kernels import transport as kernels
from warpir.light import Light, as_map, map_directions, texel_solid_angles
from warpir.mis import MisIntegrator
from warpir.render import Renderer, Rows, index_of, light_args

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float32]
Float64Array = NDArray[np.float64]

CHUNK_BYTES = 64 << 20
"""Memory of the rows that are traced at once, before they are stored in the small type."""


@dataclass(frozen=True)
class TransportSettings:
    """How finely light transport is traced and stored."""

    height_fg: int = 32
    """Rows of the map that lights the object; it is twice as wide."""
    height_shadow: int = 32
    """Rows of the map that casts the shadow."""
    subsamples: int = 32
    """Positions within each pixel."""
    paths: int = 64
    """Paths per pixel, for narrow specular lobes and for all light of two or more interactions."""
    bright_directions: int = 1024
    """Directions per pixel and map that are shared out by where light is expected, on top of one
    per texel."""
    sharp_samples: int = 0
    """Camera samples per step with which `warpir.mis` adds lobes narrower than half a texel; with 0
    they are averaged over their texels like all others."""
    dtype: torch.dtype = torch.bfloat16
    """Type in which the rows are stored."""


class TransportIntegrator:
    """Light transport as stored rows; gradients to the light alone.

    Args:
        renderer: The scene to trace.
        object_pixels: Row-major pixels that may show the object, shape [object_pixel].
        proxy_pixels: Row-major pixels whose plane the object may shade, shape [proxy_pixel].
        depth: Surface interactions of the object's paths.
        settings: Resolution and counts.
        expected: Light that is likely, for putting directions where they matter; what is stored is
            right for every light.
        seed: Base seed of the frozen samples.

    Attributes:
        mask: Coverage of the object pixels [1], shape [object_pixel].
        seconds_traced: What tracing took [s].
        bytes: Memory that the rows take.
    """

    differentiates = frozenset({"light"})

    def __init__(
        self,
        renderer: Renderer,
        object_pixels: IntArray,
        proxy_pixels: IntArray,
        depth: int = 5,
        settings: TransportSettings | None = None,
        expected: Light | None = None,
        seed: int = 0,
    ) -> None:
        self.renderer = renderer
        self.object_pixels = object_pixels
        self.proxy_pixels = proxy_pixels
        self.depth = depth
        self.settings = settings or TransportSettings()
        self.device = _torch_device(renderer.device)
        start = time.perf_counter()
        self._trace(expected or Light(texels=np.ones((8, 16, 3), np.float32)), seed)
        wp.synchronize_device(renderer.device)
        self.seconds_traced = time.perf_counter() - start
        self.bytes = self.T_fg.bytes + self.T_shadow.bytes

    def _trace(self, expected: Light, seed: int) -> None:
        settings = self.settings
        objects, height = len(self.object_pixels), settings.height_fg
        T_fg = torch.empty(
            (3, objects, 2 * height * height), dtype=settings.dtype, device=self.device
        )
        self.T_fg = DenseRows(T_fg)
        self.emission = torch.empty((objects, 3), device=self.device)
        self.mask = np.zeros(objects, np.float32)
        for rows, T, emission, mask in _object_rows(
            self.renderer, self.object_pixels, self.depth, settings, expected, seed
        ):
            T_fg[:, rows] = wp.to_torch(T).permute(2, 0, 1)
            self.emission[rows] = wp.to_torch(emission)
            self.mask[rows] = mask

        # Of the plane only texels above its horizon and pixels that lose some light are kept.
        scene, height = self.renderer.scene, settings.height_shadow
        irradiance = tent_irradiance(scene.proxy.normal, height).reshape(-1)
        above = np.flatnonzero(irradiance > 0.0)
        self.above = torch.from_numpy(above).to(self.device)
        self.irradiance = torch.from_numpy(irradiance[above].astype(np.float32)).to(self.device)
        index = index_of(self.object_pixels, scene.camera.width * scene.camera.height)
        may_see_object = (index[self.proxy_pixels] >= 0).astype(np.int32)
        chunks = []
        first = 0
        for blocked in _proxy_rows(
            self.renderer,
            self.proxy_pixels,
            may_see_object,
            above.astype(np.int32),
            settings,
            expected,
            seed,
        ):
            share = wp.to_torch(blocked)
            row, column = torch.nonzero(share, as_tuple=True)
            values = share[row, column] * self.irradiance[column]
            chunks.append(((row + first).to(torch.int32), column.to(torch.int32), values))
            first += len(share)
        self.T_shadow = SparseRows(chunks, (len(self.proxy_pixels), len(above)), self.device)
        self.sharp = MisIntegrator(
            self.renderer,
            self.object_pixels,
            self.proxy_pixels,
            spp=max(settings.sharp_samples, 1),
            rays=1,
            depth=self.depth,
        )

    def radiance(
        self,
        light_fg: LightTensors,
        light_shadow: LightTensors,
        seed: int,
        materials: MaterialTensors | None = None,
    ) -> Radiance:
        """Render the object under ``light_fg`` and the plane under ``light_shadow``.

        ``seed`` only matters to lobes that are left to `warpir.mis`; the stored rows are frozen.

        Raises:
            ValueError: Materials are given: the stored rows hold the scene's own.
        """
        if materials is not None and materials != MaterialTensors():
            raise ValueError("transport is frozen for the scene's materials: use mis")
        settings = self.settings
        sharp_fg, broad_fg = self._split(light_fg, settings.height_fg)
        sharp_shadow, broad_shadow = self._split(light_shadow, settings.height_shadow)
        texels = self._texels(broad_fg, settings.height_fg)
        foreground = product(self.T_fg, texels) + self.emission
        falling = self._texels(broad_shadow, settings.height_shadow)[self.above]
        unoccluded = (self.irradiance @ falling).expand(len(self.proxy_pixels), 3)
        blocked = product(self.T_shadow, falling)
        # Rounding alone may take more than there is.
        lit = (unoccluded - blocked).clamp(min=0.0)
        if sharp_fg is not None or sharp_shadow is not None:
            dark = _dark(light_fg)
            own = self.sharp.radiance(sharp_fg or dark, sharp_shadow or dark, seed)
            foreground = foreground + own.foreground
            lit, unoccluded = lit + own.lit, unoccluded + own.unoccluded
        where = _device_of(light_fg)
        return Radiance(foreground.to(where), lit.to(where), unoccluded.to(where))

    def _split(self, light: LightTensors, height: int) -> tuple[LightTensors | None, LightTensors]:
        """Separate the lobes that the texels cannot hold, where `warpir.mis` is to add them."""
        if light.sharpness is None or self.settings.sharp_samples == 0:
            return None, light
        assert light.amplitude is not None and light.axis is not None
        is_sharp = light.sharpness.detach() > sharpness_limit(height)
        if not bool(is_sharp.any()):
            return None, light

        def part(chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            assert light.amplitude is not None and light.axis is not None
            assert light.sharpness is not None
            return light.amplitude[chosen], light.axis[chosen], light.sharpness[chosen]

        return LightTensors(*part(is_sharp)), LightTensors(*part(~is_sharp), light.texels)

    def _texels(self, light: LightTensors, height: int) -> Tensor:
        """Return the whole light as one map on our device, shape [texel, 3]; differentiable."""
        texels = torch.zeros((2 * height * height, 3), device=self.device)
        if light.texels is not None:
            texels = texels + resize(light.texels.to(self.device), height).reshape(-1, 3)
        if light.sharpness is not None and len(light.sharpness):
            assert light.amplitude is not None and light.axis is not None
            name = str(self.renderer.device.alias)
            lobes = rasterize(light.amplitude, light.axis, light.sharpness, height, name)
            texels = texels + lobes.to(self.device).reshape(-1, 3)
        return texels


def sharpness_limit(height: int) -> float:
    """Return the sharpness whose standard deviation is half a texel of a map of that height."""
    return 4.0 * (height / np.pi) ** 2


def edge_width(sharpness: float, height: int) -> tuple[float, float]:
    """Return the standard deviation of a lobe and of its image on a map [rad].

    A texel's mean adds the variance of a texel's width, interpolation that of a tent: together
    ``(pi / He)^2 / 4`` per axis. A shadow's edge widens by the same factor.
    """
    texel = np.pi / height
    return 1.0 / np.sqrt(sharpness), float(np.sqrt(1.0 / sharpness + 0.25 * texel * texel))


def tent_solid_angles(height: int) -> Float64Array:
    """Return the solid angle of a texel's tent in each row [sr], shape [height].

    That is what bilinear interpolation weighs a texel with; all texels sum to 4 pi. Within the map
    ``2 (1 - cos d) / d sin(theta)``, in the polar rows the lookup is clamped.
    """
    step = np.pi / height
    centre = (np.arange(height) + 0.5) * step
    rows = np.sin(centre) * 2.0 * (1.0 - np.cos(step)) / step
    polar = 1.0 - np.cos(0.5 * step)
    beyond = np.cos(0.5 * step) - (np.sin(1.5 * step) - np.sin(0.5 * step)) / step
    rows[0] = rows[-1] = polar + beyond
    return rows * np.pi / height


def tent_irradiance(normal: Float64Array, height: int) -> Float64Array:
    """Return what a texel of radiance 1 makes a white plane reflect [1], shape [height, 2 height].

    ``integral of tent cos / pi`` by quadrature; all texels of a constant sky sum to 1.
    """
    side = max(4, 1024 // height)
    fine = side * height
    cosine = np.maximum(map_directions(fine, 2 * fine) @ normal, 0.0) / np.pi
    cosine *= texel_solid_angles(fine, 2 * fine)[:, None]

    def tents(count: int, wraps: bool) -> Float64Array:
        """Interpolation weights of ``side * count`` positions, shape [side * count, count]."""
        x = (np.arange(side * count) + 0.5) / side - 0.5
        low = np.floor(x).astype(int)
        weight = x - low
        first, second = low % count, (low + 1) % count
        if not wraps:
            first, second = np.clip(low, 0, count - 1), np.clip(low + 1, 0, count - 1)
        matrix = np.zeros((side * count, count))
        np.add.at(matrix, (np.arange(side * count), first), 1.0 - weight)
        np.add.at(matrix, (np.arange(side * count), second), weight)
        return matrix

    irradiance: Float64Array = tents(height, False).T @ cosine @ tents(2 * height, True)
    return irradiance


def resize(texels: Tensor, height: int) -> Tensor:
    """Resample a map to ``height`` rows: each texel is the mean over its solid angle.

    The differentiable twin of `warpir.light.resize_map`.

    Args:
        texels: Lat-long radiance, shape [He, We, 3].
        height: Rows wanted; columns become twice as many.
    """
    rows, columns = texels.shape[:2]
    if (rows, columns) == (height, 2 * height):
        return texels

    def overlaps(old: Float64Array, new: Float64Array) -> Tensor:
        """Share of each old interval in each new one, between rising edges."""
        low = np.maximum(new[:-1, None], old[None, :-1])
        high = np.minimum(new[1:, None], old[None, 1:])
        share = np.maximum(high - low, 0.0) / np.diff(new)[:, None]
        return torch.from_numpy(share.astype(np.float32)).to(texels.device, texels.dtype)

    def heights(count: int) -> Float64Array:
        # Solid angle is proportional to the height on the sphere (Archimedes).
        return -np.cos(np.pi * np.arange(count + 1) / count)

    by_row = overlaps(heights(rows), heights(height))
    by_column = overlaps(np.linspace(0, 1, columns + 1), np.linspace(0, 1, 2 * height + 1))
    return torch.einsum("ai,bj,ijc->abc", by_row, by_column, texels)


def direction_counts(expected: Light, height: int, budget: int) -> NDArray[np.int32]:
    """Return how many directions each texel gets: one, and more where light is expected.

    A texel's noise is proportional to its flux, so equal-cost directions are best shared out in
    proportion to it (Neyman's allocation); powers of two keep the sequences stratified.
    """
    flux = luminance(as_map(expected, height).astype(np.float64))
    flux = flux * tent_solid_angles(height)[:, None]
    share = budget * flux / max(float(flux.sum()), 1e-30)
    counts = np.exp2(np.floor(np.log2(np.maximum(share, 1.0)))).astype(np.int32)
    flat: NDArray[np.int32] = counts.reshape(-1)
    return flat


class SparseRows:
    """A float32 matrix that is mostly zero, stored by rows and, for the transpose, by columns.

    Args:
        parts: Row, column (int32) and value of the entries, sorted by row, then column.
        shape: Rows and columns.
        device: Where to keep them.
    """

    def __init__(
        self,
        parts: list[tuple[Tensor, Tensor, Tensor]],
        shape: tuple[int, int],
        device: torch.device,
    ) -> None:
        empty = torch.zeros(0, dtype=torch.int32), torch.zeros(0, dtype=torch.int32), torch.zeros(0)
        columns_of = zip(*(parts or [empty]), strict=True)
        row, column, values = (torch.cat(c).to(device) for c in columns_of)
        self.by_row = _csr(row, column, values, shape)
        order = torch.argsort(column, stable=True)
        self.by_column = _csr(column[order], row[order], values[order], shape[::-1])

    @property
    def bytes(self) -> int:
        """Memory of both copies."""
        parts = [
            part
            for m in (self.by_row, self.by_column)
            for part in (m.values(), m.crow_indices(), m.col_indices())
        ]
        return sum(part.numel() * part.element_size() for part in parts)

    def times(self, x: Tensor) -> Tensor:
        """Return the product with ``x``, shape [column, k]."""
        return self.by_row @ x

    def transposed_times(self, d: Tensor) -> Tensor:
        """Return the transpose's product with ``d``, shape [row, k]."""
        return self.by_column @ d


def _csr(rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    """Build a CSR matrix from entries sorted by row; int32 indices are what MKL is fast with."""
    start = torch.zeros(shape[0] + 1, dtype=torch.int32, device=values.device)
    start[1:] = torch.cumsum(torch.bincount(rows, minlength=shape[0]), 0)
    return torch.sparse_csr_tensor(start, columns, values, shape, check_invariants=False)


class DenseRows:
    """A matrix per channel in a small type.

    Args:
        T: Shape [3, row, column].
    """

    def __init__(self, T: Tensor) -> None:
        self.T = T

    @property
    def bytes(self) -> int:
        """Memory."""
        return self.T.numel() * self.T.element_size()

    def times(self, x: Tensor) -> Tensor:
        """Return each channel's product with its column of ``x``, shape [column, 3]."""
        columns = [_multiply(self.T[c], x[:, c : c + 1]) for c in range(3)]
        return torch.cat(columns, dim=1)

    def transposed_times(self, d: Tensor) -> Tensor:
        """Return the transposes' products with the columns of ``d``, shape [row, 3]."""
        columns = [_multiply(self.T[c].t(), d[:, c : c + 1]) for c in range(3)]
        return torch.cat(columns, dim=1)


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, T: DenseRows | SparseRows, x: Tensor) -> Tensor:
        ctx.T = T
        return T.times(x)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        return None, ctx.T.transposed_times(d_outputs[0].contiguous())


def product(T: DenseRows | SparseRows, x: Tensor) -> Tensor:
    """Return ``T x`` in float32; the gradient reaches ``x`` alone.

    Args:
        T: Stored rows.
        x: float32, shape [column, 3].
    """
    out: Tensor = _Product.apply(T, x)  # type: ignore[no-untyped-call]
    return out


def _multiply(T: Tensor, x: Tensor) -> Tensor:
    """Multiply a matrix of small type with float32 columns.

    Two columns of the small type hold a float32 number to 16 bits, so that rounding the light does
    not scale a whole picture; reading ``T`` is what takes the time.
    """
    if T.dtype == torch.float32:
        return T @ x
    high = x.to(T.dtype)
    low = (x - high.to(x.dtype)).to(T.dtype)
    both = (T @ torch.cat([high, low], dim=1)).to(x.dtype)
    return both[:, : x.shape[1]] + both[:, x.shape[1] :]


def _torch_device(device: wp.Device) -> torch.device:
    return torch.device(str(wp.device_to_torch(device)))


def _device_of(light: LightTensors) -> torch.device:
    tensors = (light.amplitude, light.texels)
    return next(t.device for t in tensors if t is not None)


def _dark(like: LightTensors) -> LightTensors:
    """Return a light of no radiance."""
    where = _device_of(like)
    return LightTensors(
        torch.zeros((1, 3), device=where),
        torch.tensor([[0.0, 1.0, 0.0]], device=where),
        torch.ones(1, device=where),
    )


def _texel_args(counts: NDArray[np.int32], height: int, device: wp.Device) -> kernels.TexelArgs:
    args = kernels.TexelArgs()
    args.height, args.width = height, 2 * height
    args.d_omega = wp.array(
        tent_solid_angles(height).astype(np.float32), dtype=float, device=device
    )
    args.direction_count = wp.array(counts, dtype=int, device=device)
    return args


def _object_rows(
    renderer: Renderer,
    pixels: IntArray,
    depth: int,
    settings: TransportSettings,
    expected: Light,
    seed: int,
) -> Iterator[tuple[slice, wp.array, wp.array, FloatArray]]:
    """Trace the object's rows chunk by chunk: rows, T [row, texel], emission, coverage."""
    scene, device, height = renderer.scene, renderer.device, settings.height_fg
    counts = direction_counts(expected, height, settings.bright_directions)
    texels = _texel_args(counts, height, device)
    texel_count = 2 * height * height
    # Half of the later vertices' directions look for the expected light, half everywhere.
    map_ = as_map(expected, height)
    flux = luminance(map_.astype(np.float64))
    mean = float((flux * texel_solid_angles(height, 2 * height)[:, None]).sum()) / (4.0 * np.pi)
    flat = 0.5 + 0.5 * flux / mean if mean > 0.0 else np.ones_like(flux)
    proposal = light_args(
        Light(texels=np.repeat(flat[..., None], 3, axis=2).astype(np.float32)), device
    )
    size = max(1, CHUNK_BYTES // (12 * texel_count))
    for start in range(0, len(pixels), size):
        chunk = pixels[start : start + size]
        count = len(chunk)
        rows = Rows(wp.array(chunk, dtype=wp.int32, device=device))
        geometry = (scene.mesh_args, scene.material_args, scene.texture_args)
        points = kernels.SurfacePoints()
        shape = (count, settings.subsamples)
        points.count = wp.zeros(count, dtype=int, device=device)
        for name in ("position", "ng", "n", "wo", "base_color"):
            setattr(points, name, wp.empty(shape, dtype=wp.vec3, device=device))
        for name in ("metallic", "roughness"):
            setattr(points, name, wp.empty(shape, dtype=float, device=device))
        emission = wp.zeros(count, dtype=wp.vec3, device=device)
        T = wp.empty((count, texel_count), dtype=wp.vec3, device=device)
        renderer.launch(
            kernels.trace_points,
            count,
            [
                rows,
                scene.camera_args,
                *geometry,
                scene.proxy_args,
                settings.subsamples,
                seed,
                Rows(points),
                Rows(emission),
            ],
            settings.subsamples,
            "transport",
        )
        renderer.launch(
            kernels.trace_direct,
            count,
            [
                rows,
                Rows(points),
                *geometry,
                texels,
                settings.subsamples,
                settings.paths,
                seed,
                Rows(T),
            ],
            int(counts.sum()),
            "transport",
            texel_count,
        )
        if settings.paths > 0:
            renderer.launch(
                kernels.trace_paths,
                count,
                [
                    rows,
                    Rows(points),
                    *geometry,
                    texels,
                    proposal,
                    settings.subsamples,
                    settings.paths,
                    depth,
                    seed,
                    Rows(T),
                    Rows(emission),
                ],
                settings.paths * depth,
                "transport",
                settings.paths,
            )
        coverage = points.count.numpy().astype(np.float32) / settings.subsamples
        yield slice(start, start + count), T, emission, coverage


def _proxy_rows(
    renderer: Renderer,
    pixels: IntArray,
    may_see_object: IntArray,
    columns: IntArray,
    settings: TransportSettings,
    expected: Light,
    seed: int,
) -> Iterator[wp.array]:
    """Trace the plane's rows chunk by chunk: blocked share, shape [row, column]."""
    scene, device, height = renderer.scene, renderer.device, settings.height_shadow
    counts = direction_counts(expected, height, settings.bright_directions)
    texels = _texel_args(counts, height, device)
    centres = map_directions(height, 2 * height).reshape(-1, 3)[columns].astype(np.float32)
    low, high = (b - scene.origin for b in scene.bounds)
    margin = scene.mesh_args.epsilon
    corners = (
        wp.vec3(*(low - margin).astype(np.float32)),
        wp.vec3(*(high + margin).astype(np.float32)),
    )
    radius = 0.5 * scene.diagonal + 2.0 * margin
    reach = 1.5 * np.pi / height
    size = max(1, CHUNK_BYTES // (4 * len(columns)))
    if scene.triangle_count == 0:
        return
    geometry = (scene.mesh_args, scene.material_args, scene.texture_args, scene.proxy_args)
    wp_columns = wp.array(columns, dtype=int, device=device)
    wp_centres = wp.array(centres, dtype=wp.vec3, device=device)
    for start in range(0, len(pixels), size):
        chunk = pixels[start : start + size]
        count = len(chunk)
        rows = Rows(wp.array(chunk, dtype=wp.int32, device=device))
        may_see = wp.array(may_see_object[start : start + size], dtype=int, device=device)
        filled = wp.zeros(count, dtype=int, device=device)
        position = wp.empty((count, settings.subsamples), dtype=wp.vec3, device=device)
        cone = wp.zeros(count, dtype=wp.vec4, device=device)
        renderer.launch(
            kernels.trace_proxy_points,
            count,
            [
                rows,
                Rows(may_see),
                scene.camera_args,
                *geometry,
                radius,
                reach,
                settings.subsamples,
                seed,
                Rows(filled),
                Rows(position),
                Rows(cone),
            ],
            settings.subsamples,
            "transport",
        )
        blocked = wp.empty((count, len(columns)), dtype=float, device=device)
        renderer.launch(
            kernels.trace_blocked,
            count,
            [
                rows,
                Rows(filled),
                Rows(position),
                Rows(cone),
                *geometry,
                *corners,
                texels,
                wp_columns,
                wp_centres,
                seed,
                Rows(blocked),
            ],
            len(columns) // 4,
            "transport",
            len(columns),
        )
        yield blocked
