"""Light on one device, the proposal distribution of its samples, and what a launch draws from it.

Searching a map's tables, evaluating lobes and interpolating texels takes longer than a ray; looking
up what was drawn does not. Every pixel visits the strata of the table in an order of its own, so
pixels stay independent but for the table's own error: of the irradiance of a map of 256 rows with a
sun 1e-4 with `SIDE`, of 32 lobes 1e-3, and a third of either with `FINE_SIDE`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray, in_bands
from warpir.core.color import luminance
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import directions_at, latitudes, longitudes, texel_solid_angles
from warpir.kernels.sampling import draw_light, sum_plane
from warpir.kernels.types import DrawnLight, LampArgs, LightArgs
from warpir.render.device import Launcher, Rows, copied
from warpir.scene.light import Light, Lobes
from warpir.scene.near.lamps import Lamp, RectangleLamp

STRATA = 16
"""Probabilities of the strong parts of a light are multiples of one over this: that many samples
hold exactly that share of each, and a sun is no noisier than its extent makes it."""
BRIGHT = 8.0
"""Luminance over the map's mean above which a texel belongs to its bright part."""
LEAST_COSINE = 0.1
"""Cosine that a lobe's axis counts with at least: its flanks may stand above the plane."""
SIDE, FINE_SIDE = 128, 256
"""Strata along each axis of the table; the coarse one fits into a core's cache."""
FINE_FROM = 256
"""Samples of a pixel from which on the fine table is worth its time."""


def light_args(light: Light, device: wp.Device) -> LightArgs:
    """Upload a light with its proposal.

    Raises:
        ValueError: The light has neither lobes nor a map, or negative values.
        InputError: It has values that are not finite (`ExitCode.NUMERIC`).
    """
    lobes = light.lobes if light.lobes is not None and len(light.lobes.sharpness) else None
    if light.texels is None and lobes is None:
        raise ValueError("a light needs lobes or a map")
    args = LightArgs()
    _upload_lobes(args, lobes, device)
    _upload_map(args, light.texels, device)
    propose(args)
    return args


def propose(args: LightArgs, normal: Float64Array | None = None) -> None:
    """Fill in the proposal: lobes and texels by luminous flux, strong ones in strata of their own.

    Args:
        args: Lobes and map, on any device.
        normal: Unit normal of the one plane that is lit, shape [3]: the cosine counts, and nothing
            comes from behind. None: all directions count alike.
    """
    device = args.texels.device
    flux = np.zeros(0)
    if args.lobe_count:
        lobes = Lobes(args.amplitude.numpy(), args.axis.numpy(), args.sharpness.numpy())
        flux = luminance(lobes.flux()).astype(np.float64)
        if normal is not None:
            flux *= np.maximum(lobes.axis @ normal, LEAST_COSINE)
    height, width = args.map_height, args.map_width
    part = np.zeros(2)
    if height:
        row, columns = _cumulated(_weights_of(args.texels.numpy(), normal), height, width)
        part = row.sum(axis=1)
    prob = _stratified(np.concatenate([part, flux]))
    if height and not args.lobe_count and part.sum() <= 0.0:
        # A black map is looked at evenly.
        sr = np.zeros((2, height, 1))
        sr[0, :, 0] = texel_solid_angles(height, width)
        row, columns = _cumulated(lambda rows: sr[:, rows].repeat(width, axis=2), height, width)
        prob = np.array([1.0, 0.0])
    args.bright_prob, args.map_prob = float(prob[1]), float(prob[:2].sum())
    if height:
        rows = np.stack([_row_table(sums) for sums in row])
        texel_prob = _texel_prob(rows, columns, prob)
        args.texel_prob = wp.array(texel_prob, dtype=float, device=device)
        args.row_cdf = wp.array(rows, dtype=float, device=device)
        args.column_cdf = wp.array(columns.reshape(2 * height, -1), dtype=float, device=device)
    lobe_prob = prob[2:] if args.lobe_count else np.zeros(1)
    args.lobe_prob = wp.array(lobe_prob, dtype=float, device=device)


def _stratified(flux: Float64Array) -> Float64Array:
    """Return the probability of each part: by the root of its flux if strong, else by its flux.

    The root takes samples from a sun, which is the same from everywhere, for the sky. The first two
    parts are the map's.
    """
    total = flux.sum()
    if total <= 0.0:
        return np.concatenate([np.zeros(2), np.full(len(flux) - 2, 1.0 / max(len(flux) - 2, 1))])
    share = flux / total
    is_strong = share >= 1.0 / STRATA
    shares = np.append(share[is_strong], share[~is_strong].sum())
    root = np.sqrt(shares)
    slots = np.maximum(np.round(STRATA * root / root.sum()), shares > 0.0)
    slots[np.argmax(slots)] += max(STRATA - slots.sum(), 0.0)
    while slots.sum() > STRATA:  # one at a time, so that each part keeps one
        slots[np.argmax(slots)] -= 1.0
    prob = share / max(shares[-1], 1e-300) * slots[-1] / STRATA
    prob[is_strong] = slots[:-1] / STRATA
    return np.asarray(prob)


class PlaneLight:
    """A light as it is drawn for the one plane that it lights: times the cosine.

    That of the last light is kept, since it takes seconds where a map has thousands of rows.

    Args:
        normal: Unit normal of the plane, shape [3].
    """

    def __init__(self, normal: Float64Array) -> None:
        self.normal = normal
        self._last: tuple[LightArgs, LightArgs] | None = None

    def of(self, light: LightArgs) -> LightArgs:
        """Return the light with the plane's proposal in place of its own."""
        if self._last is None or self._last[0] is not light:
            self._last = None  # its tables go before others come
            own: LightArgs = copied(light)
            propose(own, self.normal)
            self._last = light, own
        return self._last[1]


def drawn(launcher: Launcher, light: LightArgs, seed: int, samples: int) -> LightArgs:
    """Return the light with a table of directions that are drawn from its proposal.

    Args:
        launcher: Its device.
        light: From `light_args` or `PlaneLight`.
        seed: Base seed; another one draws other directions.
        samples: How many of them a pixel takes.
    """
    out: LightArgs = copied(light)
    side = FINE_SIDE if samples >= FINE_FROM else SIDE
    count = side * side
    table = launcher.zeros(count, DrawnLight)
    cells = Rows(launcher.upload(np.arange(count, dtype=np.int32), wp.int32))
    launcher.launch(draw_light, count, [cells, out, seed, side, Rows(table)], 1, "")
    out.drawn = table.reshape((side, side))
    return out


def plane_radiance(launcher: Launcher, light: LightArgs, normal: Float64Array) -> Float64Array:
    """Return the radiance of an open white plane under a drawn light, shape [3]."""
    side = light.drawn.shape[0]
    sums = launcher.zeros(side, wp.vec3d)
    normal_args = wp.vec3(*map(float, normal))
    launcher.launch(sum_plane, side, [Rows(light.drawn), normal_args, Rows(sums)], side, "")
    return np.asarray(sums.numpy().sum(axis=0) / light.drawn.size)


def lamp_args(lamps: Sequence[Lamp], origin: Float64Array, device: wp.Device) -> LampArgs:
    """Upload lamps near the object.

    Args:
        lamps: May be none.
        origin: World point that becomes the origin [m], shape [3].
        device: Where to.
    """
    args = LampArgs()
    args.count = len(lamps)
    if not lamps:
        return args
    none = np.zeros(3)
    kinds, centers, radii, edges_x, edges_y = zip(
        *(
            (1, lamp.corner, 0.0, lamp.edge_x, lamp.edge_y)
            if isinstance(lamp, RectangleLamp)
            else (0, lamp.center, lamp.radius, none, none)
            for lamp in lamps
        ),
        strict=True,
    )
    radiance = np.array([lamp.radiance for lamp in lamps])
    args.is_rectangle = wp.array(kinds, dtype=wp.int32, device=device)
    args.radius = wp.array(radii, dtype=float, device=device)
    args.brightness = wp.array(luminance(radiance).astype(np.float32), dtype=float, device=device)
    for name, rows in (
        ("center", np.array(centers) - origin),
        ("edge_x", np.array(edges_x)),
        ("edge_y", np.array(edges_y)),
        ("radiance", radiance),
    ):
        setattr(args, name, wp.array(rows.astype(np.float32), dtype=wp.vec3, device=device))
    return args


def _upload_lobes(args: LightArgs, lobes: Lobes | None, device: wp.Device) -> None:
    """Fill in the lobes, strongest first so that strata are side by side, or none."""
    if lobes is None:
        args.lobe_count = 0
        args.amplitude = wp.zeros(1, dtype=wp.vec3, device=device)
        args.axis = wp.zeros(1, dtype=wp.vec3, device=device)
        args.sharpness = wp.zeros(1, dtype=float, device=device)
        args.lobe_pdf_peak = wp.zeros(1, dtype=float, device=device)
        return
    values = np.concatenate([lobes.amplitude.reshape(-1), lobes.axis.reshape(-1), lobes.sharpness])
    _require_finite(values, "lobes")
    if lobes.amplitude.min() < 0.0:
        raise ValueError("lobes must have amplitudes >= 0")
    order = np.argsort(-luminance(lobes.flux()), kind="stable")
    s = lobes.sharpness[order].astype(np.float64)
    peak = s / (2.0 * np.pi * -np.expm1(-2.0 * s))
    args.lobe_count = len(s)
    args.amplitude = wp.array(lobes.amplitude[order], dtype=wp.vec3, device=device)
    args.axis = wp.array(lobes.axis[order], dtype=wp.vec3, device=device)
    args.sharpness = wp.array(lobes.sharpness[order], dtype=float, device=device)
    args.lobe_pdf_peak = wp.array(peak.astype(np.float32), dtype=float, device=device)


def _upload_map(args: LightArgs, texels: FloatArray | None, device: wp.Device) -> None:
    """Fill in the map, or none."""
    if texels is None:
        args.map_height = args.map_width = 0
        args.texels = wp.zeros((1, 1), dtype=wp.vec3, device=device)
        args.texel_prob = wp.zeros((1, 1), dtype=float, device=device)
        args.row_cdf = wp.zeros((2, 2), dtype=float, device=device)
        args.column_cdf = wp.zeros((2, 2), dtype=float, device=device)
        return
    _require_finite(texels, "map")
    if texels.min() < 0.0:
        raise ValueError("a light's map must be >= 0")
    args.map_height, args.map_width = texels.shape[:2]
    args.texels = wp.array(np.ascontiguousarray(texels), dtype=wp.vec3, device=device)


def _weights_of(texels: FloatArray, normal: Float64Array | None) -> Callable[[slice], Float64Array]:
    """Return what weighs the texels of some rows, the bright ones apart, shape [2, row, We].

    The arguments are as of `propose`.
    """
    height, width = texels.shape[:2]
    sr = texel_solid_angles(height, width)[:, None]
    flux = np.empty(height)

    def shining(rows: slice) -> AnyFloatArray:
        values = luminance(texels[rows].astype(np.float64))
        # What became NaN on the device is found when it is looked up, not by where it is drawn.
        values[~np.isfinite(values)] = 0.0
        return values

    def add(rows: slice) -> None:
        flux[rows] = (shining(rows) * sr[rows]).sum(axis=1)

    in_bands(add, height, width)
    bright = BRIGHT * float(flux.sum()) / (4.0 * np.pi)

    def weights(rows: slice) -> Float64Array:
        values = shining(rows)
        is_bright = values > bright
        values *= sr[rows]
        if normal is not None:
            # A texel's light reaches one texel further.
            reach = np.sin(1.5 * np.pi / height)
            directions = directions_at(latitudes(height)[rows], longitudes(width))
            values *= np.maximum(directions @ normal + reach, 0.0)
        return np.stack([np.where(is_bright, 0.0, values), np.where(is_bright, values, 0.0)])

    return weights


def _cumulated(
    weights: Callable[[slice], Float64Array], height: int, width: int
) -> tuple[Float64Array, FloatArray]:
    """Return the rows' sums [2, He] and the cumulated probabilities within each [2, He, We + 1].

    In bands, as in float64 the tables of a map of thousands of rows would take gigabytes.
    """
    sums = np.empty((2, height))
    columns = np.zeros((2, height, width + 1), np.float32)

    def fill(rows: slice) -> None:
        weight = weights(rows)
        sums[:, rows] = row = weight.sum(axis=2)
        column = np.where(row[..., None] > 0.0, weight, 1.0)
        share = np.cumsum(column, axis=2) / column.sum(axis=2, keepdims=True)
        columns[:, rows, 1:] = np.minimum(share, 1.0)
        columns[:, rows, -1] = 1.0

    in_bands(fill, height, width)
    return sums, columns


def _row_table(row: Float64Array) -> FloatArray:
    """Return the cumulated probabilities of rows by their sums, shape [He + 1]."""
    cdf = np.concatenate([[0.0], np.cumsum(row) / max(row.sum(), 1e-300)])
    table: FloatArray = np.minimum(cdf, 1.0).astype(np.float32)
    table[-1] = 1.0
    return table


def _texel_prob(rows: FloatArray, columns: FloatArray, prob: Float64Array) -> FloatArray:
    """Return the probability of each texel, shape [He, We].

    From the float32 tables that the sampler searches, so that both agree exactly.
    """
    height, width = columns.shape[1], columns.shape[2] - 1
    texel_prob = np.empty((height, width), np.float32)
    of_row = np.diff(rows.astype(np.float64))[..., None]

    def fill(band: slice) -> None:
        within = of_row[:, band] * np.diff(columns[:, band].astype(np.float64))
        texel_prob[band] = (within * prob[:2, None, None]).sum(axis=0)

    in_bands(fill, height, width)
    return texel_prob


def _require_finite(values: AnyFloatArray, what: str) -> None:
    bad = int(values.size - np.isfinite(values).sum())
    if bad:
        what_is_bad = f"{bad} of the {values.size} values of its {what} are not finite"
        raise InputError("light", what_is_bad, code=ExitCode.NUMERIC)
