"""Runs whose base and sensors are disturbed from sample to sample."""

from functools import partial
from typing import Any

import jax
import numpy as np
import pytest
from support.alone import measure_alone, run_alone
from support.studies import BASE, PAPER, STILL, small_study

from sinsjax.engine import batch, build
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study
from sinsjax.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H, HOUR, micro_g

ALL: dict[str, dict[str, Any]] = {
    "motion": {
        "surge_m_per_s": [0.1, 0.2, 0.05],
        "lever_arm_m": [1.0, -0.5, 2.0],
        "vibration_ug_rms": 5000.0,
        "vibration_deg_per_h_rms": 30.0,
    },
    "sensors": {
        "gyro_instability_deg_per_h": 0.05,
        "gyro_instability_time_s": 3.0,
        "accel_instability_ug": [20.0, 30.0, 10.0],
        "gyro_rrw_deg_per_h_per_sqrt_h": 1.0,
        "accel_rrw_ug_per_sqrt_h": 100.0,
        "gyro_quantisation_arcsec": 0.1,
        "accel_quantisation_um_per_s": [10.0, 0.0, 50.0],
    },
}
PASSES = {"stored_s": 2.0, "passes": 3}
DRAWN = {
    "surge_m_per_s": {"uniform": [0.0, 0.2]},
    "surge_time_s": {"uniform": [2.0, 8.0]},
    "lever_arm_m": {"normal": [0.0, 1.0]},
    "gyro_instability_deg_per_h": {"values": [0.01, 0.1]},
    "accel_quantisation_um_per_s": {"uniform": [0.0, 50.0]},
}
AXES = {"phi_u0_deg": [0.0, 30.0, 90.0]}


def disturbed(**changes: Any) -> Study:
    """A small study with everything that disturbs, less what is drawn."""
    motion, sensors = (
        {key: value for key, value in ALL[name].items() if key not in changes.get("drawn", {})}
        for name in ("motion", "sensors")
    )
    filter_ = {"r_velocity_m_per_s": 0.1}  # required if the surge is drawn
    return small_study(**{"motion": motion, "sensors": sensors, "filter": filter_} | changes)


def group_of(study: Study):
    (part,) = build.parts(study)
    return part.group


def all_runs(group, **options):
    pieces = list(batch.run_chunks(group, **options))
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
    order = np.lexsort((whole.variant, whole.draw))
    return jax.tree.map(lambda a: a[order], (whole.outcome, whole.curves))


@pytest.mark.optimised(False)
def test_disturbed_runs_do_not_depend_on_their_neighbours():
    """Whole, and the last draws alone: other tiles, lanes and calls of the same program."""
    length = {"draws": 70, "duration_s": 2.0, "window_s": [0, 2]}
    method = {"method": "level"}  # programs with a filter take twice as long to compile
    study = disturbed(study=length, alignment=method, filter={}, axes=AXES, drawn=DRAWN)
    group, first = group_of(study), 31
    whole, _ = all_runs(group, devices=2, tiles_per_chunk=2)
    last, _ = all_runs(group.select(np.arange(first, 70), np.arange(3)), tiles_per_chunk=2)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(last), strict=True):
        np.testing.assert_array_equal(a[3 * first :], b)
    assert np.unique(whole.last.phi.x).size == 70


@pytest.mark.nightly
@pytest.mark.optimised(False)
@pytest.mark.parametrize(
    "changes",
    [
        {"axes": AXES},
        {"axes": AXES, "drawn": DRAWN},
        {"passes": PASSES, "axes": AXES},
        {"passes": PASSES, "drawn": DRAWN, "alignment": {"specific_force": "gravity"}},
        {"motion": ALL["motion"] | STILL | {"surge_model": "gauss_markov"}},
    ],
    ids=["three", "drawn", "passes", "drawn passes", "still"],
)
def test_disturbed_runs_match_single_runs_and_any_chunking(changes):
    study = disturbed(study={"draws": 70, "curves": True, "duration_s": 6.0}, **changes)
    group = group_of(study)
    whole = all_runs(group)
    again = all_runs(group, devices=2, tiles_per_chunk=2)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    alone = jax.jit(lambda d, p: run_alone(group.static, group.environment, d, p))
    for run in (0, study.n_draws * group.sizes[1] - 1):
        draw, variant = divmod(run, group.sizes[1])
        params = jax.tree.map(lambda a, v=variant: np.asarray(a)[v], group.variants)
        params = params._replace(q=type(params.q)(*group.q[draw]))
        own = jax.tree.map(lambda a, d=draw: a[d] if np.ndim(a) else a, group.draws)
        one = alone(own, params)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(whole), strict=True):
            np.testing.assert_allclose(a, b[run], rtol=1e-9, atol=1e-9)


def rows(study: Study, draw: int = 0):
    record = build.simulated_record(study, draw)
    return np.concatenate([record.dtheta, record.dv], axis=1)


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_surge_and_sensor_disturbances_add_independently():
    """What surge adds is the same whatever else there is, and so is what the rest adds."""
    surge = {key: ALL["motion"][key] for key in ("surge_m_per_s", "lever_arm_m")}
    rest = {key: value for key, value in ALL["sensors"].items() if "quantisation" not in key}
    both = rows(small_study(motion=surge, sensors=rest))
    none = rows(small_study())
    alone = rows(small_study(motion=surge)), rows(small_study(sensors=rest))
    np.testing.assert_allclose(both - alone[1], alone[0] - none, rtol=0, atol=1e-15)
    assert np.abs(alone[0] - none).max() > 1e-4
    other = rows(small_study(motion=surge), 1) - rows(small_study(), 1)
    assert not np.allclose(other, alone[0] - none, rtol=0, atol=1e-5)


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_record_samples_are_independent_of_duration_and_passes():
    whole = rows(disturbed())
    np.testing.assert_array_equal(rows(disturbed(passes=PASSES)), whole[:200])
    np.testing.assert_array_equal(
        rows(disturbed(study={"duration_s": 3.0, "window_s": [1, 3]})), whole[:300]
    )


ROCKING = {"vibration_deg_per_h_rms": 18_000.0, "vibration_ug_rms": 0.0}
"""A housing that rotates by 1.6' about each axis, and does not move."""


@pytest.mark.nightly(fast=("once",))
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"passes": PASSES},
        {"passes": PASSES | {"direction": "rewind"}},
        {"motion": {}, "drawn": {"vibration_deg_per_h_rms": {"uniform": [15e3, 20e3]}}},
    ],
    ids=["once", "alternate", "rewind", "drawn"],
)
@pytest.mark.optimised(False)
def test_runs_are_judged_by_the_attitude_of_the_housing(changes):
    """From the true start and without sensor errors, the heading stays within 2 arcsec of truth."""
    none = dict.fromkeys(("gyro_bias_deg_per_h", "accel_bias_ug"), 0.0)
    none |= dict.fromkeys(("gyro_noise_deg_per_h", "accel_noise_ug"), 0.0)
    start = dict.fromkeys(("phi_e0_deg", "phi_n0_deg", "phi_u0_deg"), 0.0)
    study = small_study(
        **{"study": {"curves": True}, "motion": ROCKING, "sensors": none, "alignment": start}
        | changes
    )
    outcome, curves = all_runs(group_of(study))
    assert np.abs(np.stack(curves.phi)).max() < 2 * ARCSEC
    assert np.abs(np.stack(outcome.last.phi)).max() > 0


def test_unused_disturbance_keys_are_absent_from_program():
    group = group_of(small_study(motion={"surge_time_s": 3.0, "lever_arm_m": 1.0} | STILL))
    assert group.environment.sensors.disturbances == Disturbances()
    assert group.environment.sensors.axes is None
    assert group.environment.sensors.errors.gyro_quantum is None and not group.static.sensors.kept


RATE, LONG, AVERAGED = 5.0, 3600.0, 12
TIMES = np.unique(np.round(np.geomspace(1, LONG * RATE / 5, AVERAGED)).astype(int))


def allan_variances(increments):
    """(draws, times) mean over axes of the non-overlapping Allan variance of a rate."""
    angle = np.concatenate([np.zeros((*increments.shape[:-1], 1)), np.cumsum(increments, -1)], -1)
    out = []
    for m in TIMES:
        means = np.diff(angle[..., ::m], axis=-1) * RATE / m
        out.append(0.5 * (np.diff(means, axis=-1) ** 2).mean(axis=-1).mean(axis=1))
    return np.stack(out, axis=1)


def white(density):
    return lambda t: density**2 / t


def gauss_markov(rms, time):
    def variance(t):
        r = t / time
        return 2 * rms**2 / r * (1 - (3 - 4 * np.exp(-r) + np.exp(-2 * r)) / (2 * r))

    return variance


def random_walk(density):
    return lambda t: density**2 * t / 3


def quanta(quantum):
    return lambda t: quantum**2 / (4 * t * t)


UG = micro_g(9.8)


@partial(jax.jit, static_argnums=0)
def records(static, environment, draws, numbers):
    """Measured increments of draws, leaves (draws, samples)."""

    def record(draw_id):
        draw = draws._replace(draw_id=draw_id, row=0)
        return measure_alone(static, environment, draw, numbers)

    return jax.vmap(record)(draws.draw_id)


@pytest.mark.optimised(False)
def test_drift_of_each_draw_is_driven_by_independent_noise() -> None:
    """A draw's gyro drift, sample by sample, is uncorrelated with that of every other draw."""
    quiet = dict.fromkeys(("gyro_noise_deg_per_h", "accel_noise_ug"), 0.0)
    drift = {"gyro_instability_deg_per_h": 0.1, "gyro_instability_time_s": 0.1}
    group = group_of(small_study(study={"draws": 4}, sensors=quiet | drift, motion=STILL))
    made = records(group.static, group.environment, group.draws, np.arange(600))
    drifts = np.diff(np.asarray(made.dtheta.x))
    assert (drifts.std(axis=1) > 0).all()
    correlations = np.corrcoef(drifts) - np.eye(4)
    assert np.abs(correlations).max() < 5 / np.sqrt(600)


@pytest.mark.nightly
@pytest.mark.optimised(False)
@pytest.mark.parametrize(
    ("keys", "gyro", "accel"),
    [
        (
            {"gyro_arw_deg_per_sqrt_h": 0.01, "accel_vrw_ug_per_sqrt_hz": 20.0},
            [white(0.01 * DEG_PER_SQRT_H)],
            [white(20 * UG)],
        ),
        (
            {
                "gyro_instability_deg_per_h": 0.02,
                "gyro_instability_time_s": 40.0,
                "accel_instability_ug": 5.0,
                "accel_instability_time_s": 2.0,
            },
            [gauss_markov(0.02 * DEG_PER_H, 40.0)],
            [gauss_markov(5 * UG, 2.0)],
        ),
        (
            {"gyro_rrw_deg_per_h_per_sqrt_h": 0.1, "accel_rrw_ug_per_sqrt_h": 30.0},
            [random_walk(0.1 * DEG_PER_H / np.sqrt(HOUR))],
            [random_walk(30 * UG / np.sqrt(HOUR))],
        ),
        (  # the noise of a sample spreads over the quanta
            {
                "gyro_arw_deg_per_sqrt_h": 0.05,
                "gyro_quantisation_arcsec": 1.0,
                "accel_vrw_ug_per_sqrt_hz": 20.0,
                "accel_quantisation_um_per_s": 100.0,
            },
            [white(0.05 * DEG_PER_SQRT_H), quanta(ARCSEC)],
            [white(20 * UG), quanta(1e-4)],
        ),
    ],
    ids=["white", "instability", "walk", "quanta"],
)
def test_allan_variances_match_closed_forms(keys, gyro, accel):
    """128 draws of an hour at 12 averaging times, each within three standard errors.

    Of 24 true figures one is beyond in one seed of 15.
    """
    group = group_of(
        study_from_dict(
            BASE
            | {
                "study": {"duration_s": LONG, "rate_hz": RATE, "draws": 128, "seed": 2},
                "motion": {"yaw_center_deg": 30.0},
                "sensors": keys,
                "filter": PAPER,
            }
        )
    )

    numbers = np.arange(round(LONG * RATE))
    made = records(group.static, group.environment, group.draws, numbers)
    for triad, forms in ((made.dtheta, gyro), (made.dv, accel)):
        found = allan_variances(np.stack(triad, axis=1))
        expected = sum(form(TIMES / RATE) for form in forms)
        error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
        off = (found.mean(axis=0) - expected) / error
        assert np.abs(off).max() < 3, off


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_surge_heading_errors_are_independent_of_sample_rate():
    """Heading errors of 128 draws at 100 and at 200 Hz: their means and spreads agree."""
    settings = {"duration_s": 60.0, "draws": 128, "window_s": [30, 60]}
    motion = {"surge_m_per_s": 0.1, "lever_arm_m": [1.0, 1.0, 1.0]}
    found = []
    for rate in (100.0, 200.0):
        study = small_study(
            study=settings | {"rate_hz": rate},
            motion=motion,
            sensors={"gyro_noise_deg_per_h": rate, "accel_noise_ug": 0.0},
            alignment={"method": "kalman_sincos"},
        )
        found.append(np.asarray(all_runs(group_of(study))[0].last.phi.z))
    means, stds = np.mean(found, axis=1), np.std(found, axis=1, ddof=1)
    assert abs(np.diff(means)[0]) < 3 * np.hypot(*stds) / np.sqrt(128)
    assert abs(np.diff(np.log(stds))[0]) < 3 / np.sqrt(128)
