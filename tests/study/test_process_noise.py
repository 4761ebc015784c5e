"""Q is the white noise of the sensors unless its keys are given with their unit."""

import tomllib
from typing import Any

import numpy as np
import pytest
from support.batches import batch_of, batches_of
from support.refusals import assert_named, refused
from support.studies import BASE

from sinsjax.errors import InputError
from sinsjax.methods.registry import METHODS
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_toml, with_rate
from sinsjax.study.study import Study

UG, DEG_PER_H = 9.8e-6, np.pi / 180 / 3600
RECORDED: dict[str, Any] = {
    "study": {"duration_s": 300.0},
    "record": {"format": "psins", "start_s": [0.0, 300.0]},
}
GIVEN = {"q_accel_ug": 50.0, "q_gyro_deg_per_h": 0.01, "q_reading": "per_sample"}


def make_study(base: dict[str, Any] = BASE, **changes: Any) -> Study:
    """The study of some sections with keys changed; a key that is None is left out."""
    tables = base | changes
    for name in base.keys() & changes.keys():
        merged = base[name] | changes[name]
        tables[name] = {key: value for key, value in merged.items() if value is not None}
    return study_from_dict(tables)


def compute_q(study: Study) -> np.ndarray:
    """(variants, 2) Q of a step for velocity and attitude, (m/s)^2 and rad^2."""
    rows = {}
    for part in batches_of(study):
        if part.spec.method.startswith("kalman"):
            q = np.array(part.params.method.q)
            np.testing.assert_array_equal(q[0], q[1])
            np.testing.assert_array_equal(q[2], q[4])
            rows |= dict(zip(part.variant_ids.tolist(), q[[0, 2]].T, strict=True))
    return np.array([rows[variant] for variant in sorted(rows)])


def white_noise_q(velocity: Any, angle: Any) -> np.ndarray:
    """(variants, 2) from standard deviations of one increment, m/s and rad."""
    return np.stack(np.broadcast_arrays(np.square(velocity), np.square(angle)), axis=-1)


def refusal_lines(base: dict[str, Any] = BASE, **changes: Any) -> list[str]:
    with pytest.raises(InputError) as caught:
        make_study(base, **changes)
    return [line.removeprefix("study: ") for line in caught.value.lines]


def refusal_line(base: dict[str, Any] = BASE, **changes: Any) -> str:
    (line,) = refusal_lines(base, **changes)
    return line


# Q of the sensors


@pytest.mark.parametrize("rate_hz", [100.0, 200.0])
def test_noise_per_sample_becomes_q_of_one_increment(rate_hz):
    """A constant error of 500 ug over one sample is a velocity of 500 ug dt."""
    made = compute_q(make_study(study={"rate_hz": rate_hz}))
    expected = white_noise_q(500 * UG / rate_hz, 0.1 * DEG_PER_H / rate_hz)
    np.testing.assert_allclose(made, expected[None], rtol=1e-12)


@pytest.mark.parametrize("rate_hz", [100.0, 200.0])
def test_noise_density_becomes_q_of_one_increment(rate_hz):
    """After an hour of a random walk of 0.003 deg/sqrt(h) the angle is off by 0.003 deg."""
    densities = {"gyro_arw_deg_per_sqrt_h": 0.003, "accel_vrw_ug_per_sqrt_hz": 30.0}
    per_sample = {"gyro_noise_deg_per_h": None, "accel_noise_ug": None}
    made = compute_q(make_study(study={"rate_hz": rate_hz}, sensors=per_sample | densities))
    samples = 3600 * rate_hz
    np.testing.assert_allclose(
        made[0] * samples, white_noise_q(30 * UG * 60, np.deg2rad(0.003)), 1e-12
    )


def test_noise_of_noisiest_axis_counts():
    sensors = {
        **{"gyro_noise_deg_per_h": [0.1, 0.3, 0.2], "accel_noise_ug": None},
        "accel_vrw_ug_per_sqrt_hz": [30.0, 0.0, 10.0],
    }
    expected = white_noise_q(30 * UG * 0.1, 0.3 * DEG_PER_H * 0.01)
    np.testing.assert_allclose(compute_q(make_study(sensors=sensors)), expected[None], rtol=1e-12)


def test_swept_noise_gives_each_variant_its_own_q():
    noise = {"gyro_noise_deg_per_h": [0.1, 0.4], "accel_noise_ug": [500.0, [50.0, 20.0, 10.0]]}
    made = compute_q(
        make_study(sensors={"gyro_noise_deg_per_h": None, "accel_noise_ug": None}, axes=noise)
    )
    velocity = np.array([500, 50, 500, 50]) * UG / 100
    angle = np.array([0.1, 0.1, 0.4, 0.4]) * DEG_PER_H / 100
    np.testing.assert_allclose(made, white_noise_q(velocity, angle), rtol=1e-12)


@pytest.mark.parametrize("reading", ["psd", "per_sample", "per_step"])
def test_sensors_give_key_that_is_left_out_whatever_unit_of_other(reading):
    factor = {"psd": 0.01, "per_sample": 1e-4, "per_step": 1.0}[reading]
    made = compute_q(make_study(filter={"q_accel_ug": 50.0, "q_reading": reading}))
    expected = [[(50 * UG) ** 2 * factor, (0.1 * DEG_PER_H / 100) ** 2]]
    np.testing.assert_allclose(made, expected, rtol=1e-12)


@pytest.mark.parametrize("unit", ["q_gyro_deg_per_h_per_sqrt_hz", "q_gyro_arw_deg_per_sqrt_h"])
def test_densities_give_same_q_in_any_unit(unit):
    """An angle random walk of N deg/sqrt(h) adds N^2 t/3600 deg^2 in t seconds."""
    old = {"q_reading": "psd", "q_gyro_deg_per_h": 0.18, "q_accel_ug": 60.0}
    gyro = {"q_gyro_deg_per_h_per_sqrt_hz": 0.18, "q_gyro_arw_deg_per_sqrt_h": 0.003}[unit]
    new = {"q_reading": "psd", "q_accel_ug_per_sqrt_hz": 60.0, unit: gyro}
    made = compute_q(make_study(filter=new))
    np.testing.assert_allclose(made, compute_q(make_study(filter=old)), rtol=1e-12)
    expected = [[(60e-6 * 9.8) ** 2 * 0.01, np.deg2rad(0.003) ** 2 / 3600 * 0.01]]
    np.testing.assert_allclose(made, expected, rtol=1e-12)
    assert fingerprint(study_from_dict(make_study(filter=new).to_dict())) == fingerprint(
        make_study(filter=new)
    )


@pytest.mark.parametrize(
    "method", [name for name, method in METHODS.items() if "filter" in method.sections]
)
def test_all_filters_read_noise_of_sensors(method):
    own = make_study(alignment={"method": method, "phi_u0_deg": 5.0})
    filter_ = {"q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_sample"}
    given = make_study(alignment={"method": method, "phi_u0_deg": 5.0}, filter=filter_)
    made, expected = batch_of(own), batch_of(given)
    np.testing.assert_allclose(
        np.array(made.params.method.q),
        np.array(expected.params.method.q),
        rtol=1e-12,
    )


def test_resolved_study_without_q_reloads_equal_and_has_own_fingerprint():
    made = make_study()
    text = study_to_toml(made)
    assert "q_" not in text
    again = study_from_dict(tomllib.loads(text))
    assert again == made and fingerprint(again) == fingerprint(made)
    for change in (
        {"sensors": {"gyro_noise_deg_per_h": 0.2}},
        {"filter": GIVEN},
        {"filter": {"q_scale": 2.0}},
    ):
        assert fingerprint(make_study(**change)) != fingerprint(made)


# What is refused


@refused("""
filter = {q_accel_ug = 500.0, q_gyro_deg_per_h = 0.1}
    -> [filter] q_reading: required q_accel_ug q_gyro_deg_per_h 'psd' 'per_sample' 'per_step'
axes.q_gyro_deg_per_h = [0.1, 0.2]           -> [filter] q_reading: required q_gyro_deg_per_h
filter = {q_gyro_arw_deg_per_sqrt_h = 0.01, q_reading = "per_step"}
    -> [filter] q_gyro_arw_deg_per_sqrt_h: 'psd' 'per_step'
filter = {q_reading = "psd", q_gyro_deg_per_h = 1.0, q_gyro_deg_per_h_per_sqrt_hz = 0.18}
    -> [filter] q_gyro_deg_per_h: q_gyro_deg_per_h_per_sqrt_hz [filter]
filter.q_gyro_arw_deg_per_sqrt_h = 0.1 & axes.q_reading = ["psd", "per_sample"]
    -> [filter] q_gyro_arw_deg_per_sqrt_h: 'psd' 'per_sample'
filter.q_reading = "per_step"                -> [filter] q_reading: 'per_step' q_
axes.q_reading = ["psd", "per_step"]         -> [axes] q_reading: 'per_step' q_
""")
def test_q_and_its_unit_are_refused_without_each_other(refusal):
    refusal.check(refusal_line(**refusal.tables))


REQUIRES_UNIT = ("[filter] q_reading", "required", "q_accel_ug")


def test_cases_with_q_need_its_unit():
    cases = [{"q_accel_ug": 1.0}, {"q_accel_ug": 2.0}]
    assert_named(refusal_line(cases=cases), *REQUIRES_UNIT)
    made = make_study(cases=[case | {"q_reading": "psd"} for case in cases])
    np.testing.assert_allclose(
        compute_q(made)[:, 0], (np.array([1, 2]) * UG) ** 2 * 0.01, rtol=1e-12
    )


def test_unit_of_densities_alone_is_accepted():
    np.testing.assert_array_equal(
        compute_q(make_study(filter={"q_reading": "psd"})), compute_q(make_study())
    )


NONE = {"gyro_noise_deg_per_h": None, "accel_noise_ug": None}


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"sensors": NONE}, "q_accel_ug"),
        ({"sensors": {"gyro_noise_deg_per_h": 0.0}}, "q_gyro_deg_per_h"),
        (
            {
                "sensors": {"gyro_noise_deg_per_h": None},
                "axes": {"gyro_arw_deg_per_sqrt_h": [0.01, 0.0]},
            },
            "q_gyro_deg_per_h",
        ),
        (
            {
                "sensors": {"accel_noise_ug": None},
                "drawn": {"accel_noise_ug": {"uniform": [10.0, 20.0]}},
            },
            "q_accel_ug",
        ),
    ],
)
def test_filter_without_noise_of_sensors_requires_q(changes, key):
    assert_named(refusal_lines(**changes)[0], f"[filter] {key}", "required", "'psd'")
    assert make_study(**changes, filter=GIVEN).has("filter")
    axes = changes.get("axes", {})
    assert make_study(**(changes | {"axes": axes | {"method": ["inertial", "compass"]}}))


def test_filter_of_record_requires_q():
    accel, gyro = refusal_lines(RECORDED)
    assert_named(accel, "[filter] q_accel_ug", "required", "accelerometers")
    assert_named(gyro, "[filter] q_gyro_deg_per_h", "required", "gyros")
    assert refusal_line(RECORDED, filter={"q_accel_ug": 5.0, "q_reading": "psd"}) == gyro
    assert make_study(RECORDED, filter=GIVEN).has("filter")
    assert make_study(RECORDED, alignment={"method": "inertial"}).is_recorded


# Feedback


@pytest.mark.parametrize("rate_hz", [100.0, 200, 3.0, 0.7])
def test_feedback_defaults_to_each_sample(rate_hz):
    settings = {"rate_hz": rate_hz, "duration_s": 600.0, "record_interval_s": 100.0}
    made = make_study(study=settings | {"window_s": None}, axes={"p0_yaw_deg": [80.0, 60.0]})
    assert made.alignment.feedback_interval_s == 1 / rate_hz
    assert made.values("feedback_interval_s") == [1 / rate_hz] * 2
    part = batch_of(made)
    np.testing.assert_array_equal(part.params.method.feedback.every, [1.0, 1.0])
    assert study_from_dict(tomllib.loads(study_to_toml(made))) == made


def test_feedback_of_recorded_study_waits_for_rate_of_record():
    made = make_study(RECORDED, filter=GIVEN)
    assert made.alignment.feedback_interval_s is None
    for rate_hz in (100.0, 199.8):
        assert with_rate(made, rate_hz).alignment.feedback_interval_s == 1 / rate_hz
    given = make_study(RECORDED, filter=GIVEN, alignment={"feedback_interval_s": 1.0})
    assert with_rate(given, 100.0).alignment.feedback_interval_s == 1.0


def test_default_feedback_follows_changed_rate():
    changed = make_study().replace({"study.rate_hz": 200.0})
    assert changed.alignment.feedback_interval_s == 0.005
    kept = make_study(alignment={"feedback_interval_s": 1.0}).replace({"study.rate_hz": 200.0})
    assert kept.alignment.feedback_interval_s == 1.0


def test_reset_at_default_feedback_is_not_delayed():
    made = make_study(resets={"reset_at_feedback": True, "reset_times_s": [1.23, 6.0]})
    part = batch_of(made)
    np.testing.assert_array_equal(part.params.method.resets.samples, [[123.0, 600.0]])
