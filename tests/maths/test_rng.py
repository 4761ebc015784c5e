import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sinsjax.maths.rng import normal_pair, threefry

words = st.integers(0, 2**32 - 1)
SINGLE = 6 * 2**-20
"""Eight units in the last place of the largest numbers, in single precision."""


def word(*values):
    return tuple(jnp.asarray(v, jnp.uint32) for v in values)


ONES, PI = (2**32 - 1,) * 2, ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3))


@pytest.mark.parametrize(
    ("rounds", "key", "counter", "expected"),
    [
        (13, (0, 0), (0, 0), (0x9D1C5EC6, 0x8BD50731)),
        (13, ONES, ONES, (0xFD36D048, 0x2D17272C)),
        (13, *PI, (0xBA3E4725, 0xF27D669E)),
        (20, (0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        (20, ONES, ONES, (0x1CB996FC, 0xBB002BE7)),
        (20, *PI, (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_matches_random123_test_vectors(rounds, key, counter, expected):
    """From the file kat_vectors of Random123."""
    assert tuple(map(int, threefry(word(*key), word(*counter), rounds))) == expected


def box_muller(a, b):
    """In double precision, with the library's functions, of a single-precision uniform number."""
    uniform = np.float32(np.asarray(a) // 2**8 + 0.5) / 2**24
    radius = np.sqrt(-2 * np.log(uniform.astype(float)))
    angle = np.pi * (2 * (np.asarray(b) // 2**9) / 2**23 - 1)
    return radius * np.cos(angle), radius * np.sin(angle)


@given(words, words)
def test_normal_pair_matches_box_muller(a, b):
    x, y = normal_pair(word(a, b))
    np.testing.assert_allclose([x, y], box_muller(a, b), rtol=0, atol=SINGLE)


def test_normal_pair_is_finite_for_extreme_words():
    ends = np.array([0, 2**8 - 1, 2**31, 2**32 - 1])
    a, b = map(np.ravel, np.meshgrid(ends, ends))
    pairs = np.stack(jax.vmap(lambda *w: normal_pair(w))(*word(a, b)))
    np.testing.assert_allclose(pairs, box_muller(a, b), rtol=0, atol=SINGLE)
    assert np.abs(pairs).max() < 5.89
