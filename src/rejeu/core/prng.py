"""JAX's random numbers, bit for bit, computed several times faster on a CPU.

JAX uses the Threefry hash (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"), whose rounds XLA runs
on a CPU as a loop of many small kernels, which takes longer than the actor of a small agent. Unrolled, they are one
kernel. Keys of this module unroll it and give the same numbers as JAX's; all functions of ``jax.random`` accept them.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.random import define_prng_impl

from rejeu.core.types import Scalar

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA
"""The constants of the hash (table 2 and section 3.3 of the paper)."""


def nth(key: Array, n: Scalar) -> Array:
    """Returns the key that ``fold_in`` derives from ``key`` ``uint32[2]`` and ``n``, ``uint32[]`` or an int."""
    return jax.random.fold_in(jax.random.wrap_key_data(key, impl=IMPLEMENTATION), n)


def below(bits: Array, n: Array) -> Array:
    """Returns ``floor(n * bits / 2^32)``, ``int32``: a whole number in [0, n) from random bits ``uint32``.

    It equals ``int(u * n)`` of the 64-bit number ``u = bits / 2^32``, as the replay buffers of the host draw.

    >>> below(jnp.uint32(2**31), jnp.int32(7)).tolist()
    3
    """
    n = jnp.asarray(n).astype(jnp.uint32)
    low, high, n_low, n_high = bits & 0xFFFF, bits >> 16, n & 0xFFFF, n >> 16
    low_high, high_low = low * n_high, high * n_low
    middle = ((low * n_low) >> 16) + (low_high & 0xFFFF) + (high_low & 0xFFFF)
    return (high * n_high + (low_high >> 16) + (high_low >> 16) + (middle >> 16)).astype(jnp.int32)


@jax.jit
def threefry(key: Array, low: Array) -> tuple[Array, Array]:
    """Returns the hash of the numbers ``(0, low)``, 32 bits each, under ``key``, ``uint32[2]``: 20 rounds."""
    schedule = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(PARITY))
    x, y = jnp.broadcast_to(schedule[0], low.shape), low + schedule[1]
    for group in range(5):
        for rotation in ROTATIONS[group % 2]:
            x = x + y
            y = ((y << jnp.uint32(rotation)) | (y >> jnp.uint32(32 - rotation))) ^ x
        x = x + schedule[(group + 1) % 3]
        y = y + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    return x, y


def _hashes(key: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    return threefry(key, jnp.arange(math.prod(shape), dtype=jnp.uint32).reshape(shape))


def _seed(seed: Array) -> Array:
    return jax.random.key_data(jax.random.key(seed, impl="threefry2x32"))


def _split(key: Array, shape: tuple[int, ...]) -> Array:
    return _stored(jnp.stack(_hashes(key, shape), axis=-1))


def _fold_in(key: Array, data: Scalar) -> Array:
    return _stored(jnp.stack(threefry(key, jnp.asarray(data, jnp.uint32))))


def _stored(keys: Array) -> Array:
    """Returns derived keys such that XLA does not compute them again for each number that is drawn with them.

    Where it does, in JAX 0.11.2 and 0.12, LLVM's loop vectorizer follows every path through the rounds
    (``onlyFirstLaneUsed``), whose number doubles with each: compiling never ends (docs/installation.md).
    """
    return jax.lax.optimization_barrier(keys)


def _random_bits(key: Array, bit_width: int, shape: tuple[int, ...]) -> Array:
    high, low = _hashes(key, shape)
    if bit_width == 64:  # with ``jax_enable_x64``
        return (high.astype(jnp.uint64) << jnp.uint64(32)) | low
    # XLA would recompute ``high ^ low``, and so the hash, in every kernel that reads the bits: nine times in an update of
    # SAC, which took twice as long to compile. It computes a reduction once.
    words = jnp.where(jnp.arange(2) == 0, high[..., None], low[..., None])
    return jax.lax.reduce_xor(words, axes=(len(shape),)).astype(f"uint{bit_width}")


IMPLEMENTATION = define_prng_impl(
    key_shape=(2,), seed=_seed, split=_split, random_bits=_random_bits, fold_in=_fold_in, name="rejeu", tag="rj"
)
"""For ``jax.random.key(seed, impl=IMPLEMENTATION)``."""
