"""Seeded noise for the demo's textures and clouds."""

import numpy as np

from warpir.core.arrays import Float64Array

LATTICE = 256
"""Value noise repeats after so many cells."""


def value_noise(a: Float64Array, b: Float64Array, seed: int) -> Float64Array:
    """Interpolate random numbers of a square lattice with smooth steps.

    Args:
        a: First coordinate [cell], any shape.
        b: Second coordinate [cell], same shape.
        seed: Which lattice.

    Returns:
        Numbers from 0 to 1.
    """
    lattice = np.random.default_rng(seed).random((LATTICE, LATTICE))
    i, j = np.floor(a).astype(int), np.floor(b).astype(int)
    s, t = a - i, b - j
    s, t = s * s * (3.0 - 2.0 * s), t * t * (3.0 - 2.0 * t)
    i0, i1, j0, j1 = i % LATTICE, (i + 1) % LATTICE, j % LATTICE, (j + 1) % LATTICE
    value: Float64Array = (lattice[i0, j0] * (1.0 - s) + lattice[i1, j0] * s) * (1.0 - t) + (
        lattice[i0, j1] * (1.0 - s) + lattice[i1, j1] * s
    ) * t
    return value


def blurred_noise(size: int, width: float, seed: int) -> Float64Array:
    """Return white noise smoothed by a Gaussian, that tiles, shape [size, size].

    Its mean is 0, its standard deviation 1; ``width`` is the Gaussian's standard deviation [px], 0
    leaves the noise white.
    """
    white = np.random.default_rng(seed).standard_normal((size, size))
    row = np.fft.fftfreq(size)[:, None]
    column = np.fft.rfftfreq(size)[None, :]
    keep = np.exp(-2.0 * (np.pi * width) ** 2 * (row**2 + column**2))
    smooth = np.fft.irfft2(np.fft.rfft2(white) * keep, s=(size, size))
    level: Float64Array = (smooth - smooth.mean()) / smooth.std()
    return level
