"""The filter with states of a surge: its model, a naive one, and what it is without one."""

import jax
import numpy as np
import pytest
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    UG,
    filter_params,
    measured,
    navigation,
    place,
    runner,
    site,
)
from oracles.naive import DEG, PAPER, WGS84, Filter, exp, of_quaternion
from oracles.naive_filters import closed_loop, surging
from scipy.linalg import expm
from support.studies import refusal_line, small_study

from sinsjax.engine.build import Scenario
from sinsjax.maths.algebra import entries_as_numbers, triangle_index
from sinsjax.methods.sincos import method as surge
from sinsjax.methods.sincos.method import SurgeParams
from sinsjax.strapdown import processes

pytestmark = pytest.mark.optimised(False)

RATE, SAMPLES, LATITUDE, TIME = 100, 1500, 32 * DEG, 2.0
STILL = {
    "p0": np.array([0.1, 0.1, 15 * DEG, 15 * DEG, 0.5**0.5, 0.5**0.5]) ** 2,
    "q": (np.array([500 * UG] * 2 + [0.1 * DEG_PER_H] * 4) / RATE) ** 2,
    "r": 1e-3**2,
}
PHI0, V0 = np.array([10.0, -15.0, 120.0]) * DEG, np.array([0.3, -0.2])


def believing(rms, **changes):
    """A filter that believes in a surge, whose states are in one order here and there."""
    own = np.array([rms * TIME, rms * TIME, rms, rms]) ** 2
    driven = 2 * rms**2 / TIME / RATE
    return Filter(
        np.r_[STILL["p0"], own], np.r_[STILL["q"], 0, 0, driven, driven], STILL["r"], **changes
    )


def run(name, filt):
    params = filter_params(filt)
    if name == "kalman_surge":
        params = params._replace(extra=SurgeParams(np.float64(1 / TIME)))
    nav = navigation(exp(-PHI0) @ PAPER1.matrix(0.0), V0, LATITUDE)
    rows = measured(PAPER, LATITUDE, SAMPLES)
    return runner(name)(params, site(PAPER, LATITUDE), nav, rows)


def test_surge_model_autocovariance_matches_bounded_velocity():
    """Whose acceleration is bounded far above what the filter samples: its autocovariance."""
    a = np.zeros((10, 10))
    for entry, value in entries_as_numbers(
        surge.surge_transition(place(WGS84, LATITUDE), SurgeParams(1 / TIME), 1.0)
    ).items():
        a[entry] = value
    dt, rms = 0.05, 0.3
    whole = processes.bounded_velocity_process(np.full(3, rms), TIME, 1e3, 1e-3)
    stationary = whole.begin @ whole.begin.T
    axis = np.ix_([surge.PLACE_E, surge.SURGE_E], [surge.PLACE_E, surge.SURGE_E])
    own = np.diag([(rms * TIME) ** 2, rms**2])
    for later in range(0, 100, 10):
        expected = (
            rms**2
            * whole.output
            @ (
                np.linalg.matrix_power(whole.transition, round(later * dt / 1e-3))
                @ stationary
                @ whole.output
            )
        )
        found = (expm(a[axis] * later * dt) @ own)[1, 1]
        assert found == pytest.approx(expected, abs=2e-3 * rms**2)
    np.testing.assert_array_equal(a[:6, 6:], 0.0)
    np.testing.assert_array_equal(a[6:, :6], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "schedule",
    [
        {},
        {"every": 100, "resets": (333, 700)},
        {"every": 10, "gain": 0.3, "resets": (250,), "kind": "yaw"},
    ],
    ids=["every sample", "resets", "in part"],
)
def test_kalman_surge_matches_naive_closed_loop(schedule):
    filt = believing(0.1, **schedule)
    about = {"c": exp(-PHI0) @ PAPER1.matrix(0.0), "v": V0, "filt": filt, "latitude": LATITUDE}
    rows = measured(PAPER, LATITUDE, SAMPLES)
    naive = closed_loop(surging(TIME), rows, 1 / RATE, PAPER, **about)
    state, attitude, _ = run("kalman_surge", filt)
    index = triangle_index(10)
    order = np.array([[index[i, j] for j in range(10)] for i in range(10)])
    p = np.moveaxis(np.array(state.belief.p)[order], -1, 0)
    np.testing.assert_allclose(np.stack(state.belief.x, axis=1), naive.x, rtol=0, atol=1e-8)
    np.testing.assert_allclose(p, naive.p, rtol=1e-7, atol=1e-11)
    c = of_quaternion(np.stack(attitude, axis=1))
    np.testing.assert_allclose(c, naive.corrected, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_kalman_surge_without_surge_equals_kalman_sincos():
    _, still, _ = run("kalman_sincos", Filter(**STILL, every=100))
    _, found, _ = run("kalman_surge", believing(0.0, every=100))
    np.testing.assert_allclose(np.array(found), np.array(still), rtol=0, atol=1e-10)


def test_surge_keys_of_study_set_filter_parameters():
    study = small_study(
        alignment={"method": "kalman_surge"},
        filter={"q_reading": "per_sample"},
        surge={"r_surge_m_per_s": 0.3, "r_surge_time_s": 4.0},
    )
    params = Scenario(study).part(0).group.variants.method
    p0, q = np.array(params.p0)[:, 0], np.array(params.q)[:, 0]
    np.testing.assert_allclose(p0[6:], [1.44, 1.44, 0.09, 0.09], rtol=1e-12)
    np.testing.assert_allclose(q[6:], [0, 0, 4.5e-4, 4.5e-4], rtol=1e-12)
    np.testing.assert_array_equal(params.reset_to, params.p0)
    assert params.extra.rate == 0.25


@pytest.mark.slow
def test_kalman_surge_covariance_does_not_depend_on_initial_state():
    filt = filter_params(believing(0.1, every=100))._replace(extra=SurgeParams(np.float64(0.5)))
    here, rows = site(PAPER, LATITUDE), measured(PAPER, LATITUDE, SAMPLES)
    beliefs = [
        runner("kalman_surge")(filt, here, navigation(c, v, LATITUDE), rows)[0].belief.p
        for c, v in ((PAPER1.matrix(0.0), [0.0, 0.0]), (exp(-PHI0), V0))
    ]
    jax.tree.map(np.testing.assert_array_equal, *beliefs)


def test_kalman_surge_refuses_triggers_and_covariance_analysis():
    line = refusal_line(
        alignment={"method": "kalman_surge"},
        resets={"reset_trigger": "nis", "trigger_threshold": 3.0},
    )
    assert line == (
        "[resets] reset_trigger: does not apply to method kalman_surge (use"
        " reset_times_s or reset_count)"
    )
    line = refusal_line(alignment={"method": "kalman_surge"}, study={"estimate": "covariance"})
    assert "covariance analysis has no linear model of kalman_surge" in line
