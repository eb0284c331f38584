"""How a picture is sampled."""

from dataclasses import dataclass

SEEN_NOISE = 1.5 / 255.0
"""Noise from which on a picture is visibly grainy [1]: that of a clean photo."""


@dataclass(frozen=True)
class Quality:
    """Sampling of a rendering."""

    samples: int
    """Camera samples per pixel, on average."""
    rays: int
    """Rays per camera sample and sampling technique."""
    depth: int
    """Largest number of surface interactions of a path."""
    seed: int
    indirect_limit: float = 0.0
    """Clamp on a path's indirect radiance; 0 for none, which is unbiased."""
    is_denoised: bool = False
    """Whether the noise of object and shadow is taken out (`warpir.look.denoise`)."""
    ground_roughness: float | None = None
    """Of the coat in which the ground shows the object [1]; None: the ground is matt."""
    noise: float | None = None
    """Root mean square noise of object or shadow, as shown, above which each has up to
    `warpir.render.allocation.MOST` times the samples [1]; None: it has as many as stated."""
    white: float = 1.0
    """Radiance that the photo shows as white, where that is not 1 [W/(m^2 sr)], relative."""
