"""A record that is rewound: the attitude at its beginning, and what a method begins again with."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    UG,
    filter_params,
    loops,
    measured,
    one_run,
    record_world,
    site,
    swing_increments,
    trail,
)
from oracles.naive import DEG, PAPER, Filter, Loops, exp, log, of_quaternion, quaternion, wound_back

from sinsjax.engine.environment import Static
from sinsjax.methods import passes
from sinsjax.methods.compass import REVERSALS
from sinsjax.methods.method import Options
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import sensors
from sinsjax.types import Quat, Vec3

pytestmark = pytest.mark.optimised(False)

RATE, EVERY, STORED, LATITUDE = 100, 50, 12, 32 * DEG
FREE = loops(Loops((0.0, 0.0, 0.0), ((np.inf, (0.0, 0.0, 0.0, 0.0)),)), REVERSALS["keep"])


def trail_of(name, rows, start, params, passes=1):
    """States after every record of some passes that begin with an attitude (3, 3) at rest."""
    static = Static(name, Options(1 / RATE), EVERY, passes * STORED, False, passes="alternate")
    environment = record_world(rows, site(PAPER, LATITUDE), pass_records=STORED)
    static = static._replace(passes="rewind")
    return trail(static, environment, one_run(start, np.zeros(3), np.zeros(2), params))


def test_noise_free_rewound_passes_repeat_first_pass():
    rows = swing_increments(PAPER1, PAPER, LATITUDE, rate=RATE, samples=STORED * EVERY)
    nav = trail_of("compass", rows, PAPER1.matrix(0.0), FREE, passes=3).nav
    first, *later = np.split(of_quaternion(np.stack(nav.q, axis=1)), 3)
    for again in later:
        assert np.abs(log(again @ np.swapaxes(first, 1, 2))).max() < 1e-13
    velocity = np.stack([nav.ve, nav.vn]).reshape(2, 3, STORED)
    np.testing.assert_allclose(
        velocity[:, 1:], velocity[:, :1] + np.zeros((2, 2, STORED)), atol=1e-12
    )


@cache
def some_filter(name):
    p0 = np.array([0.1, 0.1, 15 * DEG, 15 * DEG, 80 * DEG]) ** 2
    q = (np.array([500 * UG] * 2 + [0.1 * DEG_PER_H] * 3) / RATE) ** 2
    params = filter_params(Filter(p0, q, 0.01**2, every=100))
    own = None if name in ("kalman5", "invariant") else np.float64(1)
    return params._replace(extra=own)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["kalman5", "invariant", "ekf_azimuth", "unscented"])
def test_rewound_pass_equals_run_started_at_rewound_attitude(name):
    """Its P, estimate and velocity are those of a start, and so are feedbacks after it."""
    rows, params = measured(PAPER, LATITUDE, STORED * EVERY), some_filter(name)
    start = exp(np.array([1.0, -2.0, 15.0]) * DEG) @ PAPER1.matrix(0.0)
    both = trail_of(name, rows, start, params, passes=2)
    method = METHODS[name](Options(1 / RATE))
    ended = jax.tree.map(lambda a: a[STORED - 1], both)
    c = of_quaternion(np.array(method.attitude(ended)))
    again = wound_back(c, rows, 1 / RATE, PAPER, LATITUDE)
    alone = trail_of(name, rows, again, params)
    for a, b in zip(
        jax.tree.leaves((both.nav, both.belief)),
        jax.tree.leaves((alone.nav, alone.belief)),
        strict=True,
    ):
        np.testing.assert_allclose(a[STORED:], b, rtol=1e-9, atol=1e-11)


@jax.jit
def wind_back(rows, bias):
    samples = sensors.compensate_record(rows, rows[0])
    turn = passes.accumulate_rotation(
        passes.identity_rotation(jnp.zeros(()), with_bias=True), samples, 1 / RATE
    )
    q, place = Quat(*quaternion(PAPER1.matrix(3.0))), site(PAPER, LATITUDE).place
    return passes.rewind_attitude(q, turn, place, len(rows) / RATE, Vec3(*bias))


@pytest.mark.parametrize(("bias_deg_per_h", "left"), [(0.0, 1e-12), (1.0, 1e-8), (10.0, 1e-6)])
def test_rewound_attitude_corrects_known_gyro_bias(bias_deg_per_h, left):
    """To the second order in the angle that it makes over the record, 1e-4 rad for 1 deg/h."""
    bias = np.array([1.0, -0.5, 0.8]) * bias_deg_per_h * DEG_PER_H
    rows = measured(PAPER, LATITUDE, 20 * RATE)
    c = of_quaternion(np.array(wind_back(rows, bias)))
    expected = wound_back(PAPER1.matrix(3.0), rows, 1 / RATE, PAPER, LATITUDE, bias)
    off = np.abs(log(c @ expected.T)).max()
    assert off < left and (bias_deg_per_h == 0 or off > left / 1e3)
