"""Filters of any heading over repeated passes of a stored record, against naive ones."""

import numpy as np
import pytest
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    UG,
    filter_params,
    measured,
    one_run,
    record_world,
    site,
    trail,
)
from oracles.naive import DEG, PAPER, Filter, exp, of_quaternion
from oracles.naive_filters import EXTENDED, INVARIANT, SINCOS, closed_loop, surging

from sinsjax.engine.environment import Static
from sinsjax.methods.base import Options
from sinsjax.methods.sincos.method import SurgeParams

pytestmark = pytest.mark.optimised(False)

RATE, SAMPLES, EVERY, LATITUDE = 100, 300, 50, 32 * DEG
NAIVE = {
    "kalman_sincos": SINCOS,
    "kalman_surge": surging(2.0),
    "ekf_azimuth": EXTENDED,
    "invariant": INVARIANT,
}


def numbers(name, **changes):
    heading = [0.5**0.5] * 2 if name in ("kalman_sincos", "kalman_surge") else [80 * DEG]
    p0 = np.array([0.1, 0.1, 15 * DEG, 15 * DEG, *heading]) ** 2
    q = (np.array([500 * UG] * 2 + [0.1 * DEG_PER_H] * (len(p0) - 2)) / RATE) ** 2
    if name == "kalman_surge":
        p0, q = np.r_[p0, 0.04, 0.04, 0.01, 0.01], np.r_[q, 0.0, 0.0, 1e-4, 1e-4]
    return Filter(p0, q, 0.1**2, **changes)


@pytest.mark.representative("kalman_surge-carried")
@pytest.mark.parametrize("turn", ["carried", "rewind"])
@pytest.mark.parametrize("name", NAIVE)
def test_three_passes_match_naive_filter_loop(name, turn):
    """With feedback over the direction reversals, and a reset; or all three forward."""
    phi, v = np.array([1.0, -2.0, 15.0]) * DEG, np.array([0.3, -0.2])
    rows = measured(PAPER, LATITUDE, SAMPLES)
    filt = numbers(name, every=130, resets=(250, 750), turn=turn)
    about = {"latitude": LATITUDE, "c": exp(-phi) @ PAPER1.matrix(0.0), "v": v, "filt": filt}
    naive = closed_loop(
        NAIVE[name], rows, 1 / RATE, PAPER, stored=SAMPLES, count=3 * SAMPLES, **about
    )
    params = filter_params(filt)
    if name == "ekf_azimuth":
        params = params._replace(extra=np.float64(1.0))
    if name == "kalman_surge":
        params = params._replace(extra=SurgeParams(np.float64(0.5)))
    records = 3 * SAMPLES // EVERY
    static = Static(name, Options(1 / RATE), EVERY, records, False, passes="alternate")
    static = static._replace(passes="rewind" if turn == "rewind" else "alternate")
    environment = record_world(rows, site(PAPER, LATITUDE), pass_records=SAMPLES // EVERY)
    state = trail(static, environment, one_run(PAPER1.matrix(0.0), phi, v, params))
    at = np.arange(EVERY, 3 * SAMPLES + 1, EVERY) - 1
    c = of_quaternion(np.stack(state.nav.q, axis=1))
    np.testing.assert_allclose(c, naive.c[at], rtol=0, atol=1e-8)
    got = np.stack([state.nav.ve, state.nav.vn], axis=1)
    np.testing.assert_allclose(got, naive.v[at, :2], rtol=0, atol=1e-7)
    np.testing.assert_allclose(np.stack(state.belief.x, axis=1), naive.x[at], rtol=0, atol=1e-7)
