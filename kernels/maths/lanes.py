"""Sums over threads that share a pixel's samples: as many as 32, neighbours in a CUDA warp.

They add up by shuffles, in the same order whenever their number is the same. On the CPU a pixel has
one thread.
"""

import warp as wp

LANES_MAX = 32
"""Threads of a pixel at most: those of a warp."""

_SUM = """
#if defined(__CUDA_ARCH__)
const unsigned first = (threadIdx.x & 31u) & ~(unsigned(lanes) - 1u);
const unsigned lane_mask = lanes == 32 ? ~0u : ((1u << lanes) - 1u) << first;
for (int step = lanes / 2; step > 0; step /= 2)
    for (int c = 0; c < 3; ++c)
        value[c] += __shfl_xor_sync(lane_mask, value[c], step);
#endif
return value;
"""


@wp.func_native(_SUM)
def lane_sum(value: wp.vec3, lanes: int) -> wp.vec3:
    """Return the sum of the ``value`` of a pixel's threads.

    All of a pixel's threads must call this. ``lanes``, their number, is a power of two, and the
    last dimension of the launch.
    """
    ...
