"""Fusion of the foreground's and the shadow's light into one, without a division by luminance.

DiPIR (Liang et al. 2024, https://arxiv.org/abs/2408.09702), supplement, eq. S1-S3 and S6-S7. With
the luminances ``F`` and ``S`` of a texel in both maps and ``M = max F`` over the map, S1-S3 become

    L_fused = L_fg + (L_fg / M) (S / (F + S)) (S - F),

which divides by nothing that is small: no channel of ``L_fg / M`` exceeds 1 / 0.0722, and the
second factor lies in [0, 1]. The factor on ``L_fg`` is at least ``2 sqrt(2) - 2``.
"""

import torch
from torch import Tensor

from warpir.lighting.latlong_tensors import luminance


def fused_light(texels_fg: Tensor, texels_shadow: Tensor) -> Tensor:
    """Return ``L_fused``, the foreground's map lifted to where the shadow's map shines (S 1-3).

    A texel that is black in both maps keeps the foreground's value, and so does the whole map when
    the foreground is black. The brightest foreground texel is differentiated too; where several
    share that luminance, each gets an equal part of the gradient.

    Args:
        texels_fg: Lat-long radiance >= 0, relative [W/(m^2 sr)], world frame, shape [He, We, 3].
        texels_shadow: The same for the shadow.

    Returns:
        Lat-long radiance >= 0, shape [He, We, 3]; chroma is the foreground's.
    """
    F, S = luminance(texels_fg), luminance(texels_shadow)
    peak = torch.amax(F)
    # Below this a quotient's derivative leaves the float range, and so little light is no light.
    # Both branches of `where` are differentiated: the unused one must be finite as well.
    dark = 64.0 * torch.finfo(F.dtype).tiny
    one = torch.ones_like(F)
    share = S / torch.where(F + S > dark, F + S, one)
    rise = torch.where(F + S > dark, share * (S - F), torch.zeros_like(F))
    relative = texels_fg / torch.where(peak > dark, peak, torch.ones_like(peak))
    return texels_fg + (peak > dark).to(F.dtype) * relative * rise[..., None]


def fuse(texels_fg: Tensor, texels_shadow: Tensor, scale: float | Tensor) -> tuple[Tensor, Tensor]:
    """Return both lights, blended toward the fused one (S 6, S 7): ``L'_fg`` and ``L'_shadow``.

    Differentiable in both maps, with finite gradients where a map or a texel is black.

    Args:
        texels_fg: Lat-long radiance >= 0 of the object's light, relative [W/(m^2 sr)], world frame,
            shape [He, We, 3].
        texels_shadow: The same for the shadow's light.
        scale: ``s_fuse``, 0 two separate lights to 1 one light [1]; the value of a tensor, which
            may be on a device, is not looked at.

    Returns:
        The two primed maps, shape [He, We, 3] each; exactly the given ones at scale 0, equal to
        each other at scale 1.

    Raises:
        ValueError: The maps differ in shape or are not maps, or ``scale`` is outside [0, 1].
    """
    if texels_fg.shape != texels_shadow.shape or texels_fg.ndim != 3 or texels_fg.shape[2] != 3:
        raise ValueError(
            "two maps of one shape [He, We, 3] are fused, got "
            f"{tuple(texels_fg.shape)} and {tuple(texels_shadow.shape)}"
        )
    if not isinstance(scale, Tensor) and not 0.0 <= scale <= 1.0:
        raise ValueError(f"scale: from 0 to 1, got {scale}")
    fused = fused_light(texels_fg, texels_shadow)
    return (
        scale * fused + (1.0 - scale) * texels_fg,
        scale * fused + (1.0 - scale) * texels_shadow,
    )
