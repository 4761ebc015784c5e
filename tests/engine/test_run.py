from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import (
    ARCMIN,
    DEG_PER_H,
    PAPER1,
    UG,
    navigation,
    paper_filter,
    params,
    runner,
    site,
    swing_increments,
)
from oracles.naive import (
    DEG,
    PAPER,
    closed_loop,
    exp,
    judge,
    log,
    of_quaternion,
    quaternion,
    wound_back,
)
from scipy.spatial.transform import Rotation
from support.alone import measure_alone, run_alone

from sinsjax.engine.environment import (
    CoarseStage,
    Draw,
    Environment,
    RunParams,
    SensorModel,
    SensorProgram,
    Static,
    Truth,
)
from sinsjax.engine.metrics import Criteria
from sinsjax.methods.floors import MeanBiases
from sinsjax.methods.method import Options
from sinsjax.strapdown import sensors
from sinsjax.types import Quat, Vec3

pytestmark = pytest.mark.optimised(False)

RATE, LATITUDE, SEED = 100, 32 * DEG, 11
PHI0, V0 = np.array([2.0, -3.0, 10.0]) * DEG, (0.1, -0.2)
BIAS = np.array([0.1 * DEG_PER_H] * 3 + [500 * UG] * 3)
NOISE = BIAS / RATE
FLOOR = -20 * ARCMIN
BANDS = np.array([600.0, 60.0, 10.0]) * ARCMIN
WINDOW, AFTER = (2.0, 6.0), (1.0, 1.0, 4.0)
WHOLE, DRAW = 900, 5

run = jax.jit(run_alone, static_argnums=0)


def static(every, records, repeats=False):
    return Static(
        "kalman5",
        Options(1 / RATE),
        every,
        records,
        True,
        SensorProgram(noisy=True, distorted=True),
        "alternate" if repeats else "once",
    )


@cache
def ideal():
    """Ideal increments of [P1]'s swing; two extra rows in front belong to no run."""
    rows = swing_increments(PAPER1, PAPER, LATITUDE, rate=RATE, samples=WHOLE)
    return np.concatenate([np.full((2, 6), 1e3), rows])


def environment(every, records, noise=NOISE, stored=None):
    times = stored_times_of(records, stored or records) * every / RATE
    truth = np.array([quaternion(PAPER1.matrix(t)) for t in times])
    errors = sensors.SensorErrors(
        BIAS[:3], BIAS[3:], noise[:3], noise[3:], np.zeros((3, 3)), np.zeros((3, 3))
    )
    criteria = Criteria(BANDS, *map(np.float64, (*WINDOW, AFTER[0], AFTER[2])))
    # The first row of truth belongs to another draw.
    truth = np.stack([np.full_like(truth, np.nan), truth])
    here = site(PAPER, LATITUDE)
    east, zero = -np.tan(FLOOR) * here.place.rate_n, np.float64(0.0)
    return Environment(
        here,
        SensorModel(ideal(), errors, np.asarray(SEED)),
        Truth(truth),
        criteria,
        MeanBiases(Vec3(east, zero, zero), Vec3(zero, zero, zero), zero),
        np.asarray(stored or records),
    )


def stored_times_of(records, stored):
    """Where on its record a run is after each record, in records: 1 2 3 2 1 0 1 2 3 ..."""
    way = [*range(1, stored + 1), *reversed(range(stored))]
    return np.array((way * records)[:records])


def one_run(filt):
    q = Quat(*map(np.float64, quaternion(PAPER1.matrix(0.0))))
    return RunParams(q, Vec3(*PHI0), *map(np.float64, V0), params(filt))


def draw(number=DRAW):
    return Draw(np.asarray(number), np.asarray(2), np.asarray(1))


def naive_measured():
    """Ideal increments, bias and the draw's own numbers."""
    numbers = sensors.draw_normal_numbers(np.asarray(SEED), np.asarray(DRAW), np.arange(WHOLE))
    normal = np.stack([*numbers.dtheta, *numbers.dv], axis=1).astype(float)
    return ideal()[2:] + BIAS / RATE + NOISE * normal


@pytest.mark.nightly(fast=("30-23-7",))
@pytest.mark.parametrize(
    ("every", "records", "stored"),
    [(30, 23, None), (70, 9, None), (30, 23, 7), (30, 23, 23)],
)
def test_run_matches_naive_loop_and_metrics(every, records, stored):
    """Forward over the data once, or over a record of some records forward and backward."""
    filt = paper_filter(5, every=40, resets=(215, 400))
    here = environment(every, records, stored=stored)
    rows = naive_measured()[: every * (stored or records)]
    c, v = exp(-PHI0) @ PAPER1.matrix(0.0), np.array(V0)
    case = {"latitude": LATITUDE, "c": c, "v": v, "filt": filt, "count": every * records}
    naive = closed_loop(rows, 1 / RATE, PAPER, **case)
    at = np.arange(1, records + 1) * every
    corrected = Rotation.from_rotvec(naive.x[:, 2:5]).as_matrix() @ naive.c
    values, sigma = [], []
    for k, place in zip(at, stored_times_of(records, stored or records), strict=True):
        yaw, pitch, roll = Rotation.from_matrix(corrected[k - 1]).as_euler("ZXY")
        phi = log(PAPER1.matrix(place * every / RATE) @ corrected[k - 1].T)
        values.append([*phi, pitch, roll, yaw])
        sigma.append(np.sqrt(np.diagonal(naive.p[k - 1])[2:5]))
    values, sigma = np.array(values), np.array(sigma)
    expected = judge(
        at / RATE,
        values,
        sigma[:, 2],
        p=naive.p[-1][2:5, 2:5],
        floor=FLOOR,
        bands=BANDS,
        window=WINDOW,
        after=AFTER,
    )

    program = static(every, records, repeats=stored is not None)
    outcome, curves = run(program, here, draw(), one_run(filt))

    close = {"rtol": 0, "atol": 1e-9}
    got = np.stack([*curves.phi, curves.pitch, curves.roll, curves.yaw], axis=1)
    np.testing.assert_allclose(got, values, **close)
    np.testing.assert_allclose(np.stack(curves.sigma, axis=1), sigma, **close)
    np.testing.assert_array_equal(outcome.outside_until, expected.outside_until)
    np.testing.assert_allclose(outcome.mean, expected.mean, **close)
    np.testing.assert_allclose(outcome.std, expected.std, **close)
    np.testing.assert_allclose(outcome.above_share, expected.above_share, rtol=1e-12)
    np.testing.assert_allclose(outcome.nees, expected.nees, rtol=1e-6)
    np.testing.assert_allclose(outcome.nis_u, expected.nis_u, rtol=1e-6)


@pytest.mark.nightly
@pytest.mark.parametrize("replays", [False, True])
def test_run_after_coarse_alignment_matches_naive_loop(replays):
    """At rest and with P0; before, its attitude is the coarse method's own."""
    every, records, first = 30, 23, 7
    begin = first * every
    filt = paper_filter(5, every=70, resets=(350,))
    # Without noise, whose last bits differ: a heading of 2 s magnifies them.
    rows = ideal()[2:][: every * records] + BIAS / RATE
    here = environment(every, records, noise=0 * NOISE)
    nav = navigation(np.eye(3), (0.0, 0.0), LATITUDE)
    _, found, _ = runner("inertial")((), site(PAPER, LATITUDE), nav, rows[:begin])
    found = of_quaternion(np.stack(found, axis=1)[every - 1 :: every])
    c = wound_back(found[-1], rows[:begin], 1 / RATE, PAPER, LATITUDE) if replays else found[-1]
    naive = closed_loop(
        rows,
        1 / RATE,
        PAPER,
        latitude=LATITUDE,
        c=c,
        v=np.zeros(2),
        filt=filt,
        first=1 if replays else begin + 1,
    )
    x, p, of_filter = (a[0 if not replays else begin :] for a in (naive.x, naive.p, naive.c))
    corrected = Rotation.from_rotvec(x[:, 2:5]).as_matrix() @ of_filter
    at = np.arange(1, records + 1) * every - 1
    expected = np.concatenate([found, corrected[at[first:] - begin]])
    truth = np.array([PAPER1.matrix((k + 1) / RATE) for k in at])
    phi = log(truth @ np.swapaxes(expected, 1, 2))
    program = static(every, records)._replace(coarse=CoarseStage("inertial", first, replays))

    outcome, curves = run(program, here, draw(), one_run(filt))

    np.testing.assert_allclose(np.stack(curves.phi, axis=1), phi, rtol=0, atol=1e-8)
    sigma = np.sqrt(np.diagonal(p, axis1=1, axis2=2))[:, 2:5]
    got = np.stack(curves.sigma, axis=1)
    assert np.all(np.isnan(got[:first]))
    np.testing.assert_allclose(got[first:], sigma[at[first:] - begin], rtol=0, atol=1e-9)
    error = np.abs(phi[:, 2] - FLOOR)
    late = [max((n for n, e in zip(at, error, strict=True) if e > b), default=-1) for b in BANDS]
    np.testing.assert_array_equal(outcome.outside_until[0], (np.array(late) + 1) / RATE)
    settings = one_run(filt)._replace(phi=Vec3(*np.zeros(3)), ve=np.float64(0.0))
    other, _ = run(program, here, draw(), settings)
    np.testing.assert_array_equal(other.mean, outcome.mean)


def test_measured_increments_do_not_depend_on_requested_stretch():
    """Any stretch gives the same numbers; another draw or seed gives others."""
    here = environment(100, 9)
    whole = measure(here, draw(), 0, 900)
    # The last bits of a single-precision normal number are worth 1e-6 of the noise.
    rounding = {"rtol": 0, "atol": 3e-6 * NOISE.max()}
    np.testing.assert_allclose(whole, naive_measured(), **rounding)
    cuts = (0, 277, 554, 831)
    parts = [measure(here, draw(), a, b - a) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    np.testing.assert_allclose(np.concatenate(parts), whole[: cuts[-1]], **rounding)
    assert not np.any(measure(here, draw(6), 0, 900) == whole)
    other = here._replace(sensors=here.sensors._replace(seed=np.asarray(12)))
    assert not np.any(measure(other, draw(), 0, 900) == whole)


def measure(here, draw, first, samples):
    now = _measure(here, draw, first, samples)
    return np.stack([*now.dtheta, *now.dv], axis=1)


@partial(jax.jit, static_argnums=3)
def _measure(here, draw, first, samples):
    program, numbers = static(100, 9), first + jnp.arange(samples)
    return measure_alone(program, here, draw, numbers)


@pytest.mark.nightly
def test_derivatives_by_p0_and_q_match_secants():
    """Forward mode through the whole closed loop, by P0 of the yaw and by a scale of Q."""
    filt = paper_filter(5, every=40, resets=(215,))
    here, program = environment(50, 12), static(50, 12)

    def smooth(yaw, q):
        start = one_run(filt)
        method = start.method
        changed = method._replace(
            p0=(*method.p0[:4], method.p0[4] * yaw), q=tuple(q * value for value in method.q)
        )
        outcome, _ = run_alone(program, here, draw(), start._replace(method=changed))
        return (1 / ARCMIN) * jnp.stack(
            [*outcome.mean[:3], *outcome.std[:3], *outcome.last.phi, *outcome.last.sigma]
        )

    @jax.jit
    def value_and_derivative(point, direction):
        return jax.jvp(smooth, tuple(point), tuple(direction))

    step = 1e-4
    for direction in np.eye(2):
        _, derivative = value_and_derivative(np.ones(2), direction)
        up, _ = value_and_derivative(1 + step * direction, direction)
        down, _ = value_and_derivative(1 - step * direction, direction)
        secant = (up - down) / (2 * step)
        assert np.abs(secant).min() > 1e-6
        np.testing.assert_allclose(derivative, secant, rtol=1e-5, atol=1e-6)
