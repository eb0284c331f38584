"""How much energy does the glTF 2.0 material create or lose in a white furnace?

    python -m benchmarks.furnace

Appendix B of the specification couples its lobes by ``(1 - F)`` with F at the half vector, so
the diffuse lobe does not give up what the specular lobe really reflects. Prints the largest
``E(cos_o) = integral of f cos_i over the hemisphere`` over angle per roughness, in float64 by
`tests.oracles.gltf_albedo`, without Mitsuba and without warpir.
"""

import numpy as np

from tests.oracles import gltf_albedo


def main() -> None:
    """Print the largest and smallest E over angle for white dielectric and white metal."""
    cosines = np.concatenate([np.geomspace(1e-4, 0.05, 40), np.linspace(0.06, 1.0, 95)])
    print("roughness  dielectric max E   at cos_o   E(1.0)   E(0.1)   E(0.01)   metal max E")
    for roughness in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0):
        dielectric = [gltf_albedo(c, 1.0, 0.0, roughness, 256) for c in cosines]
        metal = [gltf_albedo(c, 1.0, 1.0, roughness, 256) for c in cosines]
        at = int(np.argmax(dielectric))
        special = [gltf_albedo(c, 1.0, 0.0, roughness) for c in (1.0, 0.1, 0.01)]
        print(
            f"{roughness:9.1f}  {dielectric[at]:16.4f}  {cosines[at]:9.4f}  "
            + "  ".join(f"{e:7.4f}" for e in special)
            + f"  {max(metal):12.4f}"
        )


if __name__ == "__main__":
    main()
