from functools import partial

import jax
import numpy as np
import pytest
from oracles.in_engine import PAPER1, PAPER2, motion, place
from oracles.naive import DEG, PAPER, WGS84, Swing
from scipy.integrate import quad_vec

from sinsjax.strapdown import base_motion

pytestmark = pytest.mark.optimised(False)

increments = jax.jit(base_motion.ideal_increments, static_argnums=3)

STATIC = Swing(np.array([3.0, -5.0, 200.0]) * DEG, np.zeros(3), np.ones(3), np.ones(3))
ODD = Swing(
    np.array([-20.0, 35.0, 137.0]) * DEG,
    np.array([4.0, 9.0, 25.0]) * DEG,
    np.array([1.5, 0.9, 4.0]),
    np.array([0.3, -2.0, 5.0]),
)


AS_SHIPPED = pytest.mark.optimised(True), pytest.mark.nightly


@pytest.mark.parametrize(
    "with_axes",
    [
        pytest.param(False, marks=AS_SHIPPED),
        pytest.param(True, marks=AS_SHIPPED),
        pytest.param(True, id="least optimised"),
    ],
)
def test_increments_in_blocks_match_whole_record_bit_for_bit(with_axes):
    n, block = 5001, 4000
    given = motion(ODD), place(WGS84, 0.5), 100.0
    plain = partial(base_motion.ideal_increments, with_axes=with_axes)
    rows = jax.jit(plain, static_argnums=3)
    blocks = [rows(*given, block, k * 1.0 * block) for k in (0, 1)]
    np.testing.assert_array_equal(np.concatenate(blocks)[:n], rows(*given, n))


@pytest.mark.parametrize(
    ("swing", "planet", "latitude_deg", "rate_hz"),
    [
        (PAPER1, PAPER, 32.0, 100.0),
        (PAPER2, WGS84, 32.057313, 200.0),
        (STATIC, WGS84, -41.3, 100.0),
        (ODD, WGS84, -63.0, 100.0),
        (ODD, PAPER, 5.0, 20.0),
    ],
)
def test_increments_are_integrals_over_each_sample(swing, planet, latitude_deg, rate_hz):
    latitude = latitude_deg * DEG
    both = lambda t: np.concatenate(swing.rate_and_force(t, planet, latitude))  # noqa: E731
    # More than one batch of the map, and a last partial one.
    n = 2003
    rows = np.array(increments(motion(swing), place(planet, latitude), rate_hz, n))
    assert rows.shape == (n, 6)
    for k in (0, 1, 7, 500, 999, 1000, 1234, 1999, 2000, 2002):
        ends = k / rate_hz, (k + 1) / rate_hz
        exact, _ = quad_vec(both, *ends, epsabs=1e-17, epsrel=1e-14, quadrature="gk21")
        np.testing.assert_allclose(rows[k, :3], exact[:3], rtol=0, atol=2e-14)
        np.testing.assert_allclose(rows[k, 3:], exact[3:], rtol=0, atol=1e-13)
