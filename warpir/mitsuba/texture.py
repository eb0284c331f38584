"""Textures and tangents of a glTF primitive for Mitsuba 3, by glTF 2.0's rules.

Texels are decoded before they are filtered, read bilinearly, and wrapped by glTF's three modes.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from warpir.scene.asset import Primitive, Texture, TextureSlot


def srgb_decode(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear values of sRGB codes (IEC 61966-2-1), same shape [1]."""
    x = np.arange(256) / 255.0
    table = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[codes]


class Image:
    """A texture on the device, read bilinearly between texel centres."""

    def __init__(self, texture: Texture, slot: TextureSlot, is_color: bool) -> None:
        """Decode before filtering: RGB as sRGB where ``is_color``, alpha always linear."""
        texels = texture.pixels.astype(np.float32) / np.float32(255.0)
        if is_color:
            texels[..., :3] = srgb_decode(texture.pixels[..., :3])
        self.height, self.width = texels.shape[:2]
        self.texels = mi.Float(texels.ravel())
        self.wrap_u, self.wrap_v = texture.wrap_u, texture.wrap_v
        self.slot = slot

    def read(self, uv: mi.Point2f, active: mi.Bool) -> mi.Vector4f:
        """RGBA at untransformed texture coordinates, v down from the image's top."""
        a, b, c, d, e, f = self.slot.transform
        x = (a * uv.x + b * uv.y + c) * self.width - 0.5
        y = (d * uv.x + e * uv.y + f) * self.height - 0.5
        left, top = dr.floor(x), dr.floor(y)
        x -= left
        y -= top
        column, row = mi.Int32(left), mi.Int32(top)

        def texel(i: mi.Int32, j: mi.Int32) -> mi.Vector4f:
            index = _wrap(i, self.height, self.wrap_v) * self.width
            index += _wrap(j, self.width, self.wrap_u)
            return dr.gather(mi.Vector4f, self.texels, mi.UInt32(index), active)

        upper = texel(row, column) * (1.0 - x) + texel(row, column + 1) * x
        lower = texel(row + 1, column) * (1.0 - x) + texel(row + 1, column + 1) * x
        return upper * (1.0 - y) + lower * y


def _wrap(i: mi.Int32, size: int, mode: str) -> mi.Int32:
    """Texel index inside ``[0, size)`` of an index anywhere, by glTF wrap mode."""
    if mode == "clamp":
        return dr.clip(i, 0, size - 1)
    period = 2 * size if mode == "mirror" else size
    i = i % period
    i = dr.select(i < 0, i + period, i)
    return dr.select(i < size, i, period - 1 - i)


def face_tangents(
    primitive: Primitive, slot: TextureSlot, linear: NDArray[np.float64]
) -> NDArray[np.float32]:
    """World tangent and handedness of each triangle from its texture coordinates.

    glTF's v runs down the image and its normal maps have +Y up, so the bitangent points
    against ``dp_dv``: ``w = sign(dot(cross(n, t), -dp_dv))``.

    Args:
        primitive: Triangles, asset frame.
        slot: Whose texture coordinates count, as it transforms them.
        linear: Asset-to-world linear part, shape [3, 3].

    Returns:
        Direction of increasing u and handedness, 0 where the mapping is degenerate,
        shape [triangle, 4].
    """
    indices = wound(primitive, linear)
    tangents = np.zeros((len(indices), 4), dtype=np.float32)
    uv = (primitive.uv0, primitive.uv1)[slot.uv_set]
    if uv is None:
        return tangents
    p = (primitive.positions @ linear.T)[indices]
    st = (uv.astype(np.float64) @ np.reshape(slot.transform, (2, 3))[:, :2].T)[indices]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    s1, s2 = st[:, 1] - st[:, 0], st[:, 2] - st[:, 0]
    det = s1[:, 0] * s2[:, 1] - s2[:, 0] * s1[:, 1]
    good = np.abs(det) > 1e-20
    inverse = np.where(good, 1.0 / np.where(good, det, 1.0), 0.0)[:, None]
    dp_du = (e1 * s2[:, 1:] - e2 * s1[:, 1:]) * inverse
    dp_dv = (e2 * s1[:, :1] - e1 * s2[:, :1]) * inverse
    n = np.cross(e1, e2)
    length = np.linalg.norm(dp_du, axis=1, keepdims=True)
    tangents[:, :3] = dp_du / np.where(length > 0.0, length, 1.0)
    tangents[:, 3] = np.sign(np.einsum("ij,ij->i", np.cross(n, dp_du), -dp_dv))
    return tangents


def wound(primitive: Primitive, linear: NDArray[np.float64]) -> NDArray[np.int32]:
    """Triangle indices, reversed where the matrix mirrors, so that outside stays outside."""
    return primitive.indices if np.linalg.det(linear) > 0.0 else primitive.indices[:, ::-1]
