"""Light on one device, with the proposal distribution of its samples."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import texel_solid_angles
from warpir.kernels.types import LightArgs
from warpir.scene.light import Light, Lobes


def light_args(light: Light, device: wp.Device) -> LightArgs:
    """Upload a light with its proposal: lobes and texels by their share of the luminous flux.

    Raises:
        ValueError: The light has neither lobes nor a map, or negative values.
        InputError: It has values that are not finite (`ExitCode.NUMERIC`).
    """
    lobes = light.lobes if light.lobes is not None and len(light.lobes.sharpness) else None
    if light.texels is None and lobes is None:
        raise ValueError("a light needs lobes or a map")
    args = LightArgs()
    flux = _upload_lobes(args, lobes, device)
    map_flux = _upload_map(args, light.texels, device)
    total = float(flux.sum()) + map_flux
    if total > 0.0:
        lobe_prob, args.map_prob = flux / total, map_flux / total
    elif args.lobe_count:
        lobe_prob, args.map_prob = np.full(args.lobe_count, 1.0 / args.lobe_count), 0.0
    else:
        lobe_prob, args.map_prob = flux, 1.0
    prob32 = lobe_prob.astype(np.float32) if len(lobe_prob) else np.zeros(1, np.float32)
    args.lobe_prob = wp.array(prob32, dtype=float, device=device)
    return args


def _upload_lobes(args: LightArgs, lobes: Lobes | None, device: wp.Device) -> AnyFloatArray:
    """Fill in the lobes, or none; return their luminous flux, shape [lobe]."""
    if lobes is None:
        args.lobe_count = 0
        args.amplitude = wp.zeros(1, dtype=wp.vec3, device=device)
        args.axis = wp.zeros(1, dtype=wp.vec3, device=device)
        args.sharpness = wp.zeros(1, dtype=float, device=device)
        args.lobe_pdf_peak = wp.zeros(1, dtype=float, device=device)
        return np.zeros(0)
    values = np.concatenate([lobes.amplitude.reshape(-1), lobes.axis.reshape(-1), lobes.sharpness])
    _require_finite(values, "lobes")
    if lobes.amplitude.min() < 0.0:
        raise ValueError("lobes must have amplitudes >= 0")
    s = lobes.sharpness.astype(np.float64)
    peak = s / (2.0 * np.pi * -np.expm1(-2.0 * s))
    args.lobe_count = len(s)
    args.amplitude = wp.array(lobes.amplitude, dtype=wp.vec3, device=device)
    args.axis = wp.array(lobes.axis, dtype=wp.vec3, device=device)
    args.sharpness = wp.array(lobes.sharpness, dtype=float, device=device)
    args.lobe_pdf_peak = wp.array(peak.astype(np.float32), dtype=float, device=device)
    flux: AnyFloatArray = luminance(lobes.flux())
    return flux


def _upload_map(args: LightArgs, texels: FloatArray | None, device: wp.Device) -> float:
    """Fill in the map and its tables, or none; return its luminous flux.

    The tables are normalised in float64; densities are taken from the float32 tables that the
    sampler searches, so both agree exactly.
    """
    if texels is None:
        args.map_height = args.map_width = 0
        args.texels = wp.zeros((1, 1), dtype=wp.vec3, device=device)
        args.texel_prob = wp.zeros((1, 1), dtype=float, device=device)
        args.row_cdf = wp.zeros(2, dtype=float, device=device)
        args.column_cdf = wp.zeros((1, 2), dtype=float, device=device)
        return 0.0
    _require_finite(texels, "map")
    if texels.min() < 0.0:
        raise ValueError("a light's map must be >= 0")
    height, width = texels.shape[:2]
    weight = luminance(texels.astype(np.float64)) * texel_solid_angles(height, width)[:, None]
    flux = float(weight.sum())
    if flux <= 0.0:
        weight = np.broadcast_to(texel_solid_angles(height, width)[:, None], (height, width))
    row_cdf, column_cdf = _cumulated(weight)
    prob = np.diff(row_cdf.astype(np.float64))[:, None] * np.diff(
        column_cdf.astype(np.float64), axis=1
    )
    args.map_height, args.map_width = height, width
    args.texels = wp.array(np.ascontiguousarray(texels), dtype=wp.vec3, device=device)
    args.texel_prob = wp.array(prob.astype(np.float32), dtype=float, device=device)
    args.row_cdf = wp.array(row_cdf, dtype=float, device=device)
    args.column_cdf = wp.array(column_cdf, dtype=float, device=device)
    return flux


def _cumulated(weight: Float64Array) -> tuple[FloatArray, FloatArray]:
    """Return the cumulated probabilities of rows [He + 1] and within each row [He, We + 1]."""
    row = weight.sum(axis=1)
    row_cdf = np.concatenate([[0.0], np.cumsum(row) / row.sum()])
    column = np.where(row[:, None] > 0.0, weight, 1.0)
    column_cdf = np.concatenate(
        [np.zeros((len(row), 1)), np.cumsum(column, axis=1) / column.sum(axis=1, keepdims=True)],
        axis=1,
    )
    row_cdf = np.minimum(row_cdf, 1.0).astype(np.float32)
    column_cdf = np.minimum(column_cdf, 1.0).astype(np.float32)
    row_cdf[-1] = 1.0
    column_cdf[:, -1] = 1.0
    return row_cdf, column_cdf


def _require_finite(values: AnyFloatArray, what: str) -> None:
    bad = int(values.size - np.isfinite(values).sum())
    if bad:
        what_is_bad = f"{bad} of the {values.size} values of its {what} are not finite"
        raise InputError("light", what_is_bad, code=ExitCode.NUMERIC)
