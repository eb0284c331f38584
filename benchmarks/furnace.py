"""How much energy does the glTF 2.0 material create or lose in a white furnace?

Appendix B of the specification couples its lobes by ``(1 - F)`` with F at the half vector, so
the diffuse lobe does not give up what the specular lobe really reflects. This module integrates
``E(cos_o) = integral of f cos_i over the hemisphere`` in float64 by products of Gauss-Legendre and
periodic trapezoid rules, without Mitsuba and without warpir. Run as
``python -m benchmarks.furnace``; prints the largest E over angle per roughness.
"""

import numpy as np

from warpir.core.arrays import Float64Array

NODES = 96
"""Along each axis."""


def directional_albedo(cos_o: float, roughness: float, base_color: float, metallic: float) -> float:
    """Return ``E(cos_o)`` of one channel [1], with the perceptual roughness."""
    f0 = 0.04 + (base_color - 0.04) * metallic
    c_diff = base_color * (1.0 - metallic)
    wo = np.array([np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    node, weight = np.polynomial.legendre.leggauss(NODES)
    node, weight = 0.5 * (node + 1.0), 0.5 * weight
    phi = 2.0 * np.pi * (np.arange(NODES) + 0.5) / NODES
    specular = specular_ring(wo, max(roughness**2, 1e-3), f0, node, phi) @ weight
    return float(specular + c_diff * (diffuse_ring(wo, node, phi) @ weight))


def schlick(cosine: Float64Array, f0: float) -> Float64Array:
    """Return Schlick's Fresnel factor [1]."""
    return f0 + (1.0 - f0) * (1.0 - np.abs(cosine)) ** 5


def specular_ring(
    wo: Float64Array, alpha: float, f0: float, node: Float64Array, phi: Float64Array
) -> Float64Array:
    """Return the mean of ``F G2 / G1`` over visible normals at each node, shape [node].

    Normals are drawn by spherical caps (Dupuy and Benyoub 2023), over which the integrand is smooth
    at any roughness.
    """

    def smith(cosine: Float64Array | float) -> Float64Array:
        return np.sqrt(alpha**2 + (1.0 - alpha**2) * np.square(cosine))

    cos_o, shape = wo[2], (len(node), len(phi))
    stretched = np.array([alpha * wo[0], 0.0, cos_o])
    stretched /= np.linalg.norm(stretched)
    z = (1.0 - node)[:, None] * (1.0 + stretched[2]) - stretched[2]
    r = np.sqrt(np.maximum(1.0 - z**2, 0.0))
    x, y = alpha * (r * np.cos(phi) + stretched[0]), alpha * r * np.sin(phi)
    wm = np.stack([x, y, np.broadcast_to(z + stretched[2], shape)], axis=-1)
    wm /= np.maximum(np.linalg.norm(wm, axis=-1, keepdims=True), 1e-300)
    cos_h = wm @ wo
    cos_i = 2.0 * cos_h * wm[..., 2] - cos_o
    both = np.where(cos_i > 0.0, cos_i * smith(cos_o) + cos_o * smith(cos_i), 1.0)
    ratio = cos_i * (cos_o + smith(cos_o)) / both
    return np.asarray(np.where(cos_i > 0.0, schlick(cos_h, f0) * ratio, 0.0).mean(axis=1))


def diffuse_ring(wo: Float64Array, node: Float64Array, phi: Float64Array) -> Float64Array:
    """Return the mean of ``1 - F`` over a cosine-weighted hemisphere at each node, shape [node]."""
    cos_i = np.sqrt(node)[:, None]
    sine = np.sqrt(1.0 - cos_i**2)
    z = np.broadcast_to(cos_i, (len(node), len(phi)))
    wm = np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1) + wo
    wm /= np.linalg.norm(wm, axis=-1, keepdims=True)
    return np.asarray((1.0 - schlick(wm @ wo, 0.04)).mean(axis=1))


def main() -> None:
    """Print the largest and smallest E over angle for white dielectric and white metal."""
    cosines = np.concatenate([np.geomspace(1e-4, 0.05, 40), np.linspace(0.06, 1.0, 95)])
    print("roughness  dielectric max E   at cos_o   E(1.0)   E(0.1)   E(0.01)   metal max E")
    for roughness in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0):
        dielectric = [directional_albedo(c, roughness, 1.0, 0.0) for c in cosines]
        metal = [directional_albedo(c, roughness, 1.0, 1.0) for c in cosines]
        at = int(np.argmax(dielectric))
        special = [directional_albedo(c, roughness, 1.0, 0.0) for c in (1.0, 0.1, 0.01)]
        print(
            f"{roughness:9.1f}  {dielectric[at]:16.4f}  {cosines[at]:9.4f}  "
            + "  ".join(f"{e:7.4f}" for e in special)
            + f"  {max(metal):12.4f}"
        )


if __name__ == "__main__":
    main()
