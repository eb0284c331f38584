"""Simplified assets for the browser."""

from dataclasses import replace

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray
from warpir.scene.asset import Asset, Primitive, Texture

TRIANGLES = 300_000
"""Largest number of triangles for the browser: without a GPU, more are slow to drag."""
TEXTURE_SIDE = 1024
"""Longest side of a texture for the browser [px]."""
FINEST = 1024
"""Initial number of grid cells along the asset's longest side."""


def preview_asset(asset: Asset, triangles: int = TRIANGLES) -> Asset:
    """Return an asset with fewer triangles and smaller textures, or the same where it is small.

    Triangles are thinned by clustering vertices in the cells of a grid (Rossignac and Borrel 1993):
    each cell keeps one of its vertices with all its attributes, and triangles that fall together
    are left out. No vertex moves by more than the diagonal of a cell.
    """
    cells = FINEST
    low, high = asset.bounds()
    thin = asset
    while triangle_count(thin) > triangles and cells > 1:
        width = float((high - low).max()) / cells
        parts = (_clustered(p, low, width) for p in asset.primitives)
        thin = replace(asset, primitives=tuple(p for p in parts if len(p.indices)))
        cells //= 2
    return replace(thin, textures=tuple(map(_shrunk, thin.textures)))


def triangle_count(asset: Asset) -> int:
    """Return the number of an asset's triangles."""
    return sum(len(p.indices) for p in asset.primitives)


def _clustered(p: Primitive, low: Float64Array, width: float) -> Primitive:
    cell = np.floor((p.positions - low) / width).astype(np.int64)
    # FINEST cells and one more at the far side: eleven bits per axis hold them.
    key = (cell[:, 0] << 22) | (cell[:, 1] << 11) | cell[:, 2]
    _, kept, of_vertex = np.unique(key, return_index=True, return_inverse=True)
    indices = of_vertex.astype(np.int32)[p.indices]
    a, b, c = indices.T
    indices = indices[(a != b) & (b != c) & (c != a)]

    def of_kept(array: FloatArray | None) -> FloatArray | None:
        return None if array is None else array[kept]

    return replace(
        p,
        positions=p.positions[kept],
        indices=indices,
        normals=of_kept(p.normals),
        tangents=of_kept(p.tangents),
        uv0=of_kept(p.uv0),
        uv1=of_kept(p.uv1),
        colors=of_kept(p.colors),
    )


def _shrunk(texture: Texture) -> Texture:
    height, width = texture.pixels.shape[:2]
    factor = TEXTURE_SIDE / max(height, width)
    if factor >= 1.0:
        return texture
    from PIL import Image

    size = max(1, round(width * factor)), max(1, round(height * factor))
    small = Image.fromarray(texture.pixels).resize(size, Image.Resampling.BOX)
    return replace(texture, pixels=np.asarray(small))
