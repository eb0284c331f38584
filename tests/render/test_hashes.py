"""Hashes of modules, by which Warp finds what it has compiled."""

import warp as wp
import warp._src.context as warp_context

from warpir.kernels.composite import tone_foreground
from warpir.kernels.path import Viewer, foreground_kernel
from warpir.kernels.receiver import trace_receiver
from warpir.render.device import SharedHasher


def test_shared_hashes_are_those_of_warp() -> None:
    """Of kernels that have most of their functions in common, in this order."""
    (own,) = SharedHasher.__bases__
    kernels = [tone_foreground, trace_receiver, foreground_kernel(0, False, Viewer.CAMERA, False)]
    for module in (kernel.module for kernel in kernels):
        options = module.resolve_options(wp.config, block_dim=1)
        live = module._get_live_kernels()
        assert SharedHasher(live, options).get_hash() == own(live, options).get_hash()


def test_functions_of_others_are_hashed_anew() -> None:
    """One may get an overload after it was hashed."""

    @wp.func
    def twice(x: float) -> float:
        return 2.0 * x

    SharedHasher([], {}).hash_function(twice)
    assert twice not in SharedHasher.known
    assert isinstance(twice, warp_context.Function)
