"""Stateless low-discrepancy numbers: Owen-scrambled Sobol' points, in shuffled pairs of dimensions.

Burley 2020, "Practical Hash-based Owen Scrambling" (JCGT 9(4)), with the Laine-Karras permutation.
A number depends on (seed, sample index, pair) only, so results do not depend on threads or tiles.
"""

import warp as wp

# Literals above 2^31 would pass through a signed integer in the generated code.
MIX_1 = wp.constant(wp.uint32(0x7FEB352D))
MIX_2 = wp.constant(wp.uint32(0x846CA68B))
GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
MASK_8_HIGH = wp.constant(wp.uint32(0xFF00FF00))
MASK_4_HIGH = wp.constant(wp.uint32(0xF0F0F0F0))
MASK_2_HIGH = wp.constant(wp.uint32(0xCCCCCCCC))
MASK_1_HIGH = wp.constant(wp.uint32(0xAAAAAAAA))
LK_1 = wp.constant(wp.uint32(0x3D20ADEA))
LK_2 = wp.constant(wp.uint32(0x05526C56))
LK_3 = wp.constant(wp.uint32(0x53A22864))


@wp.func
def hash_uint(x: wp.uint32) -> wp.uint32:
    """Mix the bits of ``x`` (lowbias32, Wellons 2018)."""
    x = x ^ (x >> wp.uint32(16))
    x = x * MIX_1
    x = x ^ (x >> wp.uint32(15))
    x = x * MIX_2
    x = x ^ (x >> wp.uint32(16))
    return x


@wp.func
def hash_pair(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """Combine two numbers into one hash."""
    return hash_uint(a ^ (hash_uint(b) + GOLDEN + (a << wp.uint32(6))))


_REVERSE = """
#if defined(__CUDA_ARCH__)
return __brev(x);
#else
return __builtin_bitreverse32(x);
#endif
"""


@wp.func_native(_REVERSE)
def reverse_bits(x: wp.uint32) -> wp.uint32:
    """Reverse the 32 bits of ``x``: one instruction on CUDA."""
    ...


@wp.func
def laine_karras(x: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Permute so that each bit depends on the lower bits only (Vegdahl's constants)."""
    x = x ^ (x * LK_1)
    x = x + seed
    x = x * ((seed >> wp.uint32(16)) | wp.uint32(1))
    x = x ^ (x * LK_2)
    x = x ^ (x * LK_3)
    return x


@wp.func
def pascal(x: wp.uint32) -> wp.uint32:
    """Multiply the bits of an index by Pascal's triangle modulo 2, lowest bit first.

    That is the generator matrix of the second Sobol' dimension, in five steps in place of one per
    bit (Ahmed 2024, "An Implementation Algorithm of 2D Sobol Sequence Fast, Elegant, and Compact").
    """
    x = x ^ (x >> wp.uint32(16))
    x = x ^ ((x & MASK_8_HIGH) >> wp.uint32(8))
    x = x ^ ((x & MASK_4_HIGH) >> wp.uint32(4))
    x = x ^ ((x & MASK_2_HIGH) >> wp.uint32(2))
    x = x ^ ((x & MASK_1_HIGH) >> wp.uint32(1))
    return x


@wp.func
def to_unit(x: wp.uint32) -> float:
    """Turn 32 bits into a float in [0, 1)."""
    return float(x >> wp.uint32(8)) * 5.9604644775390625e-08


@wp.func
def sobol_pair(index: int, seed: wp.uint32, pair: int) -> wp.vec2:
    """Return point ``index`` of the pair of dimensions number ``pair``, in [0, 1)^2.

    Any aligned run of 2^k indices is a (0, k, 2)-net in each pair; different pairs are shuffled
    independently, so they are uncorrelated.

    Owen scrambling of a fraction is the Laine-Karras permutation of its reversed bits. The reversed
    bits of the first coordinate are the index itself, those of the second are `pascal` of it.
    """
    return sobol_point(sobol_shuffled(index, seed, pair), seed, pair)


@wp.func
def sobol_shuffled(index: int, seed: wp.uint32, pair: int) -> wp.uint32:
    """Return which unshuffled point of a pair of dimensions an index stands for.

    Where an index takes k points together, a power of two, the points ``k n`` to ``k n + k - 1`` of
    its n are as good as those of shuffled ``k index`` and on, and are shuffled once.
    """
    # Scrambling the index as an integer lets each bit depend on the higher bits only, which maps
    # every aligned block of 2^k indices onto an aligned block.
    key = hash_pair(seed, wp.uint32(pair))
    return reverse_bits(laine_karras(reverse_bits(wp.uint32(index)), key))


@wp.func
def sobol_point(shuffled: wp.uint32, seed: wp.uint32, pair: int) -> wp.vec2:
    """Return an unshuffled point of a pair of dimensions, in [0, 1)^2."""
    key = hash_pair(seed, wp.uint32(pair))
    first = laine_karras(shuffled, hash_uint(key ^ MIX_1))
    second = laine_karras(pascal(shuffled), hash_uint(key ^ MIX_2))
    return wp.vec2(to_unit(reverse_bits(first)), to_unit(reverse_bits(second)))


@wp.func
def pixel_seed(seed: int, pixel: int) -> wp.uint32:
    """Return the key of a pixel's sequences."""
    return hash_pair(wp.uint32(seed), wp.uint32(pixel))
