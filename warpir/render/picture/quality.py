"""How a picture is sampled."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Quality:
    """Sampling of a rendering."""

    samples: int
    """Camera samples per pixel."""
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
