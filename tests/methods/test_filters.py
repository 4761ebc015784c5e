"""Any filter in closed loop: one of two states, made up here, against plain numbers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import navigation, site, step_and_close
from oracles.naive import PAPER

from sinsjax.methods.filters import kalman
from sinsjax.methods.filters.kalman import Belief
from sinsjax.methods.filters.loop import Filter, FilterParams, FilterState, closed_loop
from sinsjax.methods.filters.triggers import TriggerParams
from sinsjax.methods.method import Options
from sinsjax.methods.schedules import CovarianceReset, FeedbackSchedule, Resets, reset_covariance
from sinsjax.types import Quat, Sample, Vec3

SAMPLES, SENSED = 200, 0.3
P0, Q, R = (4.0, 2.0), (0.02, 0.03), 0.5
EVERY, GAIN, RESETS, THRESHOLD, REFRACTORY = 7, 0.4, (60.0, 140.0), 3.0, 11
HALF = CovarianceReset(0.5, 0.5, 1.0, 1.0)
INFLATED = CovarianceReset(3.0, 3.0, 0.0, 0.0)


def made_up():
    """Velocity errors alone, on a base whose accelerometers say how velocity drifts."""

    def propagate(params, site, state, sample):
        nav = state.nav._replace(ve=state.nav.ve + sample.dv.x, vn=state.nav.vn + sample.dv.y)
        return state._replace(nav=nav, belief=kalman.propagate(state.belief, {(0, 1): 0.1}))

    def update(params, state):
        measured = state.nav.ve, state.nav.vn
        innovation = kalman.innovation(state.belief, (0, 1), measured, params.r)
        belief = kalman.update(state.belief, (0, 1), measured, params.r)
        return state._replace(belief=belief), innovation

    def feed_back(state, share):
        e, n = (share * x for x in state.belief.x)
        left = Belief((state.belief.x[0] - e, state.belief.x[1] - n), state.belief.p)
        nav = state.nav._replace(ve=state.nav.ve - e, vn=state.nav.vn - n)
        return state._replace(nav=nav, belief=left), nothing(state)

    def reverse(state):
        nav = state.nav._replace(ve=-state.nav.ve, vn=-state.nav.vn)
        belief = Belief(tuple(-x for x in state.belief.x), state.belief.p)
        return state._replace(nav=nav, belief=belief)

    def nothing(state):
        zero = jnp.zeros_like(state.nav.ve)
        return Vec3(zero, zero, zero)

    return Filter(
        init=lambda params, nav: FilterState(
            nav, kalman.initial_belief(params.p0), (), params.feedback.every
        ),
        propagate=propagate,
        update=update,
        feed_back=feed_back,
        reset=partial(reset_covariance, heading=()),
        reverse=reverse,
        place=lambda site, nav: site.place,
        at_rest=lambda nav, place: {},
        misalignment=nothing,
        attitude=lambda state: state.nav.q,
        covariance=lambda state: state.belief.p,
    )


def numbers():
    number = partial(jax.tree.map, np.float64)
    return FilterParams(
        p0=number(P0),
        q=number(Q),
        r=np.float64(R),
        feedback=FeedbackSchedule(np.float64(EVERY), np.float64(GAIN)),
        resets=Resets(np.array(RESETS), number(HALF)),
        reset_to=number(P0),
        reversal=number(INFLATED),
        trigger=number(TriggerParams(THRESHOLD, 1.0, float(REFRACTORY), 100.0, np.inf)),
    )


def drifts():
    return SENSED * np.random.default_rng(3).normal(size=(SAMPLES, 2))


def engine(trigger, reversals):
    """Velocity, x and P after every sample; what is told at the end."""
    options = Options(dt=1.0, trigger=trigger, innovations=True)
    method, filt = closed_loop(made_up(), options), numbers()
    zero = np.zeros(SAMPLES)
    samples = Sample(Quat(zero + 1, zero, zero, zero), Vec3(*drifts().T, zero))
    here = site(PAPER, 0.5)

    @jax.jit
    def run(samples):
        def step(state, xs):
            sample, n, reversal = xs
            turned = method.passes.reverse(filt, here, state)
            state = jax.tree.map(partial(jnp.where, reversal), turned, state)
            state = step_and_close(method, filt, here, state, sample, n)
            return state, (state.nav.ve, state.nav.vn, *state.belief.x, *state.belief.p)

        n = 1.0 + np.arange(SAMPLES)
        start = method.init(filt, navigation(np.eye(3), (1.0, -2.0), 0.5))
        state, rows = jax.lax.scan(step, start, (samples, n, np.isin(n, reversals)))
        return jnp.stack(rows, axis=1), method.results(here, state)

    return run(samples)


def plain(watched, reversals):
    """The same with matrices; the samples of called resets, and the squares of innovations."""
    v, x, p = np.array([1.0, -2.0]), np.zeros(2), np.diag(P0)
    rows, called, squares, since, phi = [], [], [], 0, np.array([[1.0, 0.1], [0.0, 1.0]])
    for n, drift in enumerate(drifts(), 1):
        if n in reversals:
            v, x, p = -v, -x, 3 * p
        v, x, p = v + drift, phi @ x, phi @ p @ phi.T + np.diag(Q)
        r, s = v - x, p + R * np.eye(2)
        gain = p @ np.linalg.inv(s)
        x, p = x + gain @ r, p - gain @ p
        squares.append(r @ np.linalg.solve(s, r))
        if watched and squares[-1] > THRESHOLD and n - since >= REFRACTORY:
            called.append(n)
        reset = n in RESETS or n in called[-1:]
        share = 1.0 if reset else GAIN if n % EVERY == 0 else 0.0
        v, x = v - share * x, x - share * x
        if reset:
            p, since = 0.5 * p + np.diag(P0), n
        rows.append([*v, *x, p[0, 0], p[0, 1], p[1, 1]])
    return np.array(rows), called, squares


@pytest.mark.parametrize("trigger", ["none", "innovation"])
@pytest.mark.parametrize("reversals", [(), (50, 120)])
def test_shared_filter_stages_match_naive_two_state_filter(trigger, reversals):
    """Of whatever states; they come with its stages."""
    rows, results = engine(trigger, np.array(reversals, float))
    expected, called, squares = plain(trigger == "innovation", reversals)
    np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-12)
    assert results.innovations.count == SAMPLES
    assert results.innovations.sum == pytest.approx(np.sum(squares), rel=1e-9)
    if trigger == "none":
        assert results.trigger_counts is None
    else:
        assert len(called) > 3 and not {*called} & {*RESETS}
        assert tuple(results.trigger_counts) == (len(called), called[0], called[-1])
