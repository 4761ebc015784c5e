"""Q is the sensors' white noise, R follows the surge, feedback the samples: unless keys say so."""

from typing import Any

import numpy as np
import pytest
from support.batches import batch_of, batches_of
from support.plain_studies import merge_tables
from support.refusals import refusal_line, refusal_lines, refused
from support.studies import BASE, small_study

from sinsjax import study_from_dict
from sinsjax.methods.filters.keys import peak_velocity_density
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import processes
from sinsjax.study.load import fingerprint, with_rate
from sinsjax.study.study import Study

UG, DEG_PER_H = 9.8e-6, np.pi / 180 / 3600
DT = 0.01
FILTERS = [name for name, method in METHODS.items() if "filter" in method.sections]
FOLLOWING = [name for name in FILTERS if name != "kalman_surge"]
RECORDED: dict[str, Any] = {
    "study": {"duration_s": 300.0},
    "record": {"format": "psins", "start_s": [0.0, 300.0]},
}
GIVEN = {"q_accel_ug": 50.0, "q_gyro_deg_per_h": 0.01, "q_reading": "per_sample"}
SURGE = {"surge_m_per_s": 0.02, "surge_time_s": 5.0}
DENSITY = 2 * 0.02**2 * 5.0


def make_study(base: dict[str, Any] = BASE, **changes: Any) -> Study:
    """The study of some sections with keys changed; a key that is None is left out."""
    tables = merge_tables(base, **changes)
    for name in BASE.keys() & tables.keys():
        tables[name] = {key: value for key, value in tables[name].items() if value is not None}
    return study_from_dict(tables)


def parameters(study: Study, name: str) -> np.ndarray:
    """(variants, ...) a parameter of the filters, by variant."""
    rows = {}
    for part in batches_of(study):
        values = np.moveaxis(np.asarray(getattr(part.params.method, name)), -1, 0)
        rows |= dict(zip(part.variant_ids.tolist(), values, strict=True))
    return np.array([rows[variant] for variant in sorted(rows)])


def assert_q(study: Study, velocity: Any, angle: Any) -> None:
    """Compare Q of a step with the variance of one increment, from its sigma in m/s and rad."""
    q = parameters(study, "q")
    np.testing.assert_allclose(q[:, :2], np.outer(np.square(velocity), [1, 1]), rtol=1e-12)
    np.testing.assert_allclose(q[:, 2:5], np.outer(np.square(angle), [1] * 3), rtol=1e-12)


# Q


@pytest.mark.parametrize("rate_hz", [100.0, 200.0])
def test_white_noise_of_sensors_becomes_q_of_one_increment(rate_hz):
    """500 ug over a sample is 500 ug dt; in 1 h a walk of 0.003 deg/sqrt(h) is 0.003 deg."""
    study = {"rate_hz": rate_hz}
    assert_q(make_study(study=study), 500 * UG / rate_hz, 0.1 * DEG_PER_H / rate_hz)
    densities = {"gyro_arw_deg_per_sqrt_h": 0.003, "accel_vrw_ug_per_sqrt_hz": 30.0}
    per_sample = {"gyro_noise_deg_per_h": None, "accel_noise_ug": None}
    made = make_study(study=study, sensors=per_sample | densities)
    assert_q(made, 30 * UG / rate_hz**0.5, np.deg2rad(0.003) / (3600 * rate_hz) ** 0.5)
    # The noisiest axis counts, and each variant.
    axes = {"gyro_noise_deg_per_h": [0.1, [0.1, 0.4, 0.2]], "accel_noise_ug": [500.0, 50.0]}
    made = make_study(study=study, sensors=per_sample, axes=axes)
    gyro = np.array([0.1, 0.1, 0.4, 0.4]) * DEG_PER_H
    assert_q(made, np.array([500, 50, 500, 50]) * UG / rate_hz, gyro / rate_hz)


@pytest.mark.parametrize(
    ("filter_", "accel", "gyro"),
    [
        # The sensors give what is left out; the others' unit is that of q_reading.
        ({"q_reading": "psd"}, 500 * DT, 0.1 * DT),
        ({"q_accel_ug": 50.0, "q_reading": "per_sample"}, 50 * DT, 0.1 * DT),
        ({"q_accel_ug": 50.0, "q_reading": "per_step"}, 50, 0.1 * DT),
        ({"q_accel_ug_per_sqrt_hz": 60.0, "q_reading": "psd"}, 60 * DT**0.5, 0.1 * DT),
        ({"q_gyro_deg_per_h_per_sqrt_hz": 0.18, "q_reading": "psd"}, 500 * DT, 0.18 * DT**0.5),
        ({"q_gyro_arw_deg_per_sqrt_h": 0.003, "q_reading": "psd"}, 500 * DT, 0.18 * DT**0.5),
    ],
)
def test_given_q_is_read_in_its_unit(filter_, accel, gyro):
    study = make_study(filter=filter_)
    assert_q(study, accel * UG, gyro * DEG_PER_H)
    assert fingerprint(study_from_dict(study.to_dict())) == fingerprint(study)


@refused("""
filter = {q_accel_ug = 500.0, q_gyro_deg_per_h = 0.1}
    -> [filter] q_reading: required q_accel_ug q_gyro_deg_per_h 'psd' 'per_sample' 'per_step'
axes.q_gyro_deg_per_h = [0.1, 0.2]           -> [filter] q_reading: required q_gyro_deg_per_h
filter.q_accel_ug = 1.0 & resets.schedule = "law"         -> [filter] q_reading: required q_accel_ug
filter = {q_reading = "psd", q_gyro_deg_per_h = 1.0, q_gyro_deg_per_h_per_sqrt_hz = 0.18}
    -> [filter] q_gyro_deg_per_h: q_gyro_deg_per_h_per_sqrt_hz [filter]
filter.q_gyro_arw_deg_per_sqrt_h = 0.1 & axes.q_reading = ["psd", "per_sample"]
    -> [filter] q_gyro_arw_deg_per_sqrt_h: 'psd' 'per_sample'
axes.q_reading = ["psd", "per_step"]         -> [axes] q_reading: 'per_step' q_
sensors.gyro_noise_deg_per_h = 0.0           -> [filter] q_gyro_deg_per_h: required 'psd'
drawn.surge_m_per_s.uniform = [0.0, 0.1]     -> [filter] r_velocity_m_per_s: required surge_m_per_s
motion.surge_m_per_s = 0.1 & drawn.surge_time_s.values = [2, 8]
    -> [filter] r_velocity_m_per_s: required surge_time_s
""")
def test_noise_that_is_not_known_is_refused(refusal):
    refusal.check(refusal_line(make_study, **refusal.tables))


def test_filter_of_record_requires_q():
    assert len(refusal_lines(make_study, RECORDED)) == 2
    assert make_study(RECORDED, filter=GIVEN).has("filter")
    assert make_study(RECORDED, alignment={"method": "inertial"}).is_recorded


# R


def density(process: processes.Process, frequency_hz: float, dt: float) -> float:
    """Return the two-sided density of the first axis of a process, per Hz."""
    z = np.exp(2j * np.pi * frequency_hz * dt)
    state = np.linalg.solve(z * np.eye(len(process.drive)) - process.transition, process.drive)
    return float(process.scale[0] ** 2 * np.abs(process.output @ state) ** 2 * dt)


def test_density_that_r_follows_is_the_largest_one_of_the_surge():
    """Of a Gauss-Markov surge at zero frequency, of one of third order at 1/(2 pi T) Hz."""
    rms, time_s, dt, peak = np.full(3, 0.3), np.asarray(5.0), 0.01, peak_velocity_density(0.3, 5.0)
    process = processes.gauss_markov_process(rms, time_s, dt)
    assert density(process, 0.0, dt) == pytest.approx(peak, rel=1e-3)
    process = processes.velocity_of_bounded_position(rms, time_s, np.asarray(1.0), dt)
    b = 2 * np.pi * 1.0 * 5.0
    largest = density(process, 1 / (2 * np.pi * 5.0), dt)
    assert largest == pytest.approx(peak * (1 + b / (1 + b * b)), rel=0.01)
    assert density(process, 1e-4, dt) < 0.01 * largest


@pytest.mark.parametrize(
    ("tables", "expected"),
    [
        ({"motion": SURGE, "axes": {"method": FOLLOWING}},
         [0.01 + DENSITY / DT] * len(FOLLOWING)),
        ({"motion": SURGE, "alignment": {"method": "kalman_surge"}}, [0.01]),
        ({"axes": {"surge_m_per_s": [0.0, 0.02, (0.05, 0.0, 9.0)], "surge_time_s": [5.0, 2.0]}},
         0.01 + np.array([0, 0, 0.02**2 * 5, 0.02**2 * 2, 0.05**2 * 5, 0.05**2 * 2]) * 2 / DT),
        ({"motion": SURGE, "axes": {"r_reading": ["per_update", "psd"], "r_scale": [0.25, 4.0]}},
         np.outer([0.01 + DENSITY / DT, (0.01 + DENSITY) / DT], [0.25, 4.0]).ravel()),
        ({"drawn": {"surge_m_per_s": {"uniform": [0.0, 0.1]}},
          "filter": {"r_velocity_m_per_s": 0.2}}, [0.04]),
    ],
)  # fmt: skip
def test_r_follows_surge_unless_given(tables, expected):
    """With the larger horizontal axis; not in the filter that has states of the surge."""
    np.testing.assert_allclose(parameters(small_study(**tables), "r"), expected, rtol=1e-12)


# Feedback


def test_feedback_defaults_to_each_sample():
    rate_hz = 0.7
    settings = {"rate_hz": rate_hz, "duration_s": 600.0, "record_interval_s": 100.0}
    made = make_study(study=settings | {"window_s": None}, axes={"p0_yaw_deg": [80.0, 60.0]})
    assert made.values("feedback_interval_s") == [1 / rate_hz] * 2
    np.testing.assert_array_equal(batch_of(made).params.method.feedback.every, [1.0, 1.0])
    changed = made.replace({"study.rate_hz": 0.5})
    assert changed.alignment.feedback_interval_s == 2.0
    record = make_study(RECORDED, filter=GIVEN)
    assert record.alignment.feedback_interval_s is None
    assert with_rate(record, rate_hz).alignment.feedback_interval_s == 1 / rate_hz
    kept = make_study(alignment={"feedback_interval_s": 1.0}).replace({"study.rate_hz": 200.0})
    assert kept.alignment.feedback_interval_s == 1.0
