"""Counter-based random numbers: no state, independent of order and block size.

Threefry-2x32 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), the generator
behind `jax.random`, for a single counter. `jax.random` splits keys and draws arrays; doing so for
every sample of every draw costs ten times as much as generating the numbers.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from sinsjax.types import Array, Count, Scalar, Word

ROUNDS = 13
"""Rounds of Threefry-2x32: the fewest with published test vectors, reported as Crush-resistant.

`jax.random` uses 20, a safety margin that sensor noise does not need and every sample would pay
for.
"""

_DISTANCES = (13, 15, 26, 6, 17, 29, 16, 24)
_PARITY = 0x1BD11BDA


def threefry(
    key: tuple[Word, Word], counter: tuple[Word, Word], rounds: int = ROUNDS
) -> tuple[Word, Word]:
    """Threefry-2x32: two random words of 32 bits for a key and a counter."""
    keys = (*key, key[0] ^ key[1] ^ jnp.uint32(_PARITY))
    a, b = counter[0] + keys[0], counter[1] + keys[1]
    for n in range(rounds):
        distance = _DISTANCES[n % 8]
        a = a + b
        b = a ^ (b << jnp.uint32(distance) | b >> jnp.uint32(32 - distance))
        if n % 4 == 3:
            injection = n // 4 + 1
            a = a + keys[injection % 3]
            b = b + keys[(injection + 1) % 3] + jnp.uint32(injection)
    return a, b


def normal_pair(words: tuple[Word, Word]) -> tuple[Scalar, Scalar]:
    """Two independent standard normal numbers in single precision, by the Box-Muller transform.

    The radius is taken from 24 bits, so no number exceeds sqrt(50 log 2) = 5.89. Cosine and sine
    are power series of the half angle, doubled: XLA's own are library calls for one number at a
    time.

    Args:
        words: two uniformly distributed words.
    """
    single = jnp.float32
    # (k + 1/2) / 2^24 is never 0, where the logarithm is infinite.
    uniform = ((words[0] >> jnp.uint32(8)).astype(jnp.int32).astype(single) + 0.5) * 2.0**-24
    radius = jnp.sqrt(-2 * jnp.log(uniform))
    # The mantissa of a number in [1, 2), mapped to [-1, 1): the half angle over pi / 2.
    mantissa = words[1] >> jnp.uint32(9) | jnp.uint32(0x3F800000)
    half = (math.pi / 2) * (2 * jax.lax.bitcast_convert_type(mantissa, single) - 3)
    square = -half * half
    cos, sin = 1 / math.factorial(14), 1 / math.factorial(13)
    for n in reversed(range(7)):
        cos = cos * square + 1 / math.factorial(2 * n)
        if n < 6:
            sin = sin * square + 1 / math.factorial(2 * n + 1)
    sin = sin * half
    return radius * (1 - 2 * sin * sin), radius * (2 * sin * cos)


def binomial_triad(words: tuple[Word, Word]) -> tuple[Scalar, Scalar, Scalar]:
    """Three independent numbers of mean 0 and variance 1: how many of 16 bits are set, scaled.

    For what drives a process: white as those of `normal_pair`, at a third of their cost, and what a
    process makes of a few of them is normal.

    Args:
        words: two uniformly distributed words.
    """
    halves = words[0] & jnp.uint32(0xFFFF), words[0] >> jnp.uint32(16), words[1] >> jnp.uint32(16)
    bits = (jax.lax.population_count(half).astype(jnp.int32) for half in halves)
    first, second, third = (0.5 * (count.astype(jnp.float32) - 8) for count in bits)
    return first, second, third


def random_numbers(
    of: Callable[[tuple[Word, Word]], tuple[Scalar, ...]],
    seed: Count,
    draw_id: Array,
    counters: Array,
    *,
    apart: int = 0,
) -> tuple[Array, ...]:
    """Independent numbers, a function of seed, draw and counter alone.

    All are generated in one row, to fill the vector units.

    Args:
        of: what is made of the two words of a counter, `normal_pair` or `binomial_triad`.
        seed: below 2^63.
        draw_id: () or (draws,), below 2^32.
        counters: below 2^32.
        apart: 0, or 1 for numbers independent of those.

    Returns:
        What is made, each of shape (*counters, *draws).
    """
    wide = jnp.asarray(seed).astype(jnp.uint64)
    # No seed has the highest bit.
    high = (wide >> 32).astype(jnp.uint32) | jnp.uint32(apart << 31)
    key = (high, wide.astype(jnp.uint32))
    draw = jnp.asarray(draw_id)
    shape = (*counters.shape, *draw.shape)
    counter = counters.reshape(*counters.shape, *(1 for _ in draw.shape))
    row = (jnp.broadcast_to(a, shape).astype(jnp.uint32).reshape(-1) for a in (draw, counter))
    made = jax.vmap(lambda *counter: of(threefry(key, counter)))(*row)
    return tuple(a.reshape(shape) for a in made)
