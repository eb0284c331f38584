"""Warp kernels: what is computed, per thread.

Frames and units
    World right-handed, +Y up, metres, **recentred on the object** so that float32 keeps its
    precision; directions are unit vectors. ``wo`` points toward the camera, ``wi`` to the light.
    Radiance is linear Rec.709, relative [W/(m^2 sr)]. Densities are per solid angle and 0 outside
    their support.

Two kinds of files
    *Detached* files (``path``, ``receiver``, ``tracing``, ``transport``) trace rays and draw
    samples, with no backward pass; ``light_gradient`` is one, written down. *Attached* files
    (``shade``, ``shadow_ratio``, ``composite``) evaluate what those samples see and are
    differentiated by Warp.

Rules that Warp 1.19 does not enforce, and that give silently wrong gradients when broken
    A func or kernel with a loop ends in its raw sums; only ``+=`` is carried between iterations; no
    ``break`` in a differentiated loop; each output element is written once per launch; whatever is
    optimised is an array argument; no ray query in a differentiated kernel.
"""

if __name__ != "warpir.kernels":
    raise ImportError("this folder is the package warpir.kernels; import it by that name")
