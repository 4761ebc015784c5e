"""Studies become arrays: units, readings, schedules, environments; by hand-computed numbers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.studies import BASE, small_study, with_paper_values

from sinsjax.engine import build
from sinsjax.engine.lanes import Group
from sinsjax.engine.truth import reference_attitudes
from sinsjax.errors import InputError
from sinsjax.records import Record, Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict

DEG = np.pi / 180
DEG_PER_H = DEG / 3600


def group_of(**changes: object) -> Group:
    (part,) = build.parts(small_study(**changes))
    return part.group


def test_paper_parameters_are_converted_to_si() -> None:
    group = group_of()
    environment, method = group.environment, group.variants.method
    np.testing.assert_allclose(environment.sensors.errors.gyro_bias, 0.1 * DEG_PER_H)
    np.testing.assert_allclose(environment.sensors.errors.accel_bias, 500e-6 * 9.8)
    # Standard deviations a sample are of a rate; an increment is dt times it.
    np.testing.assert_allclose(environment.sensors.errors.gyro_noise, 0.1 * DEG_PER_H * 0.01)
    np.testing.assert_allclose(environment.sensors.errors.accel_noise, 500e-6 * 9.8 * 0.01)
    np.testing.assert_allclose(
        [p[0] for p in method.p0], [0.01, 0.01, *np.square([15 * DEG] * 2), (80 * DEG) ** 2]
    )
    np.testing.assert_allclose(method.r, 0.01)
    np.testing.assert_allclose(method.q[0], (500e-6 * 9.8) ** 2)
    np.testing.assert_allclose(method.q[4], (0.1 * DEG_PER_H) ** 2)
    assert group.static.records == 6 and group.static.record_every == 100


def test_noise_densities_scale_with_square_root_of_sample_time() -> None:
    data = BASE | {
        "sensors": {
            "gyro_arw_deg_per_sqrt_h": 0.003,
            "accel_vrw_ug_per_sqrt_hz": [10.0, 20.0, 30.0],
        }
    }
    (part,) = build.parts(study_from_dict(data))
    errors = part.group.environment.sensors.errors
    np.testing.assert_allclose(errors.gyro_noise, 0.003 * DEG / 60 * np.sqrt(0.01))
    np.testing.assert_allclose(errors.accel_noise, np.array([10, 20, 30]) * 9.8e-6 * 0.1)


def test_r_as_density_is_divided_by_sample_time() -> None:
    assert group_of(filter={"r_reading": "psd"}).variants.method.r == pytest.approx(1.0)


def test_wgs84_micro_g_uses_standard_gravity() -> None:
    group = group_of(earth={"earth": "wgs84"})
    np.testing.assert_allclose(group.environment.sensors.errors.accel_bias, 500e-6 * 9.80665)
    assert group.environment.site.place.gravity == pytest.approx(9.79484, abs=1e-5)


def test_euler_misalignment_is_rotation_rz_rx_ry() -> None:
    """C_n'^n = Rz(U) Rx(E) Ry(N), [P1] section 1; phi is its rotation vector."""
    phi = group_of(alignment={"misalignment": "euler"}).variants.phi
    want = Rotation.from_euler("ZXY", [30, 5, 5], degrees=True).as_rotvec()
    np.testing.assert_allclose(np.array(phi).ravel(), want, atol=1e-15)


def test_feedback_interval_and_time_constant_set_every_and_gain() -> None:
    feedback = group_of(
        alignment={"feedback_interval_s": 0.5, "feedback_time_constant_s": 2.0}
    ).variants.method.feedback
    assert feedback.every == 50
    assert feedback.gain == pytest.approx(1 - np.exp(-0.25))
    assert group_of().variants.method.feedback.gain == 1


def test_reset_times_and_kinds_become_schedule_arrays() -> None:
    group = group_of(
        axes={"reset_times_s": [[], [1.0], [0.5, 2.34]], "reset_kind": ["full", "yaw", "scale"]},
        resets={"reset_scale": 7.0},
    )
    resets = group.variants.method.resets
    np.testing.assert_array_equal(resets.samples[0], [np.inf, np.inf])
    np.testing.assert_array_equal(resets.samples[3], [100, np.inf])
    np.testing.assert_array_equal(resets.samples[6], [50, 234])
    got = np.stack(resets.covariance_reset, axis=1)
    np.testing.assert_array_equal(got[:3], [[0, 0, 1, 1], [1, 0, 0, 1], [7, 7, 0, 0]])


def test_parts_split_by_environment_and_program_cover_all_variants() -> None:
    study = small_study(
        axes={
            "phi_u0_deg": [0.0, 30.0],
            "yaw_center_deg": [0.0, 90.0],
            "specific_force": ["measured", "gravity"],
        }
    )
    parts = list(build.parts(study))
    assert len(parts) == 4
    np.testing.assert_array_equal(np.sort(np.concatenate([p.variant_ids for p in parts])), range(8))
    for part in parts:
        values = {key: {study.values(key)[i] for i in part.variant_ids} for key in study.axis_keys}
        assert len(values["yaw_center_deg"]) == len(values["specific_force"]) == 1
        assert part.group.static.options.specific_force in values["specific_force"]


def test_parts_split_by_stored_length_share_one_program() -> None:
    """Variants that read the record alike run together; truth is that of the place on it."""
    study = small_study(
        alignment={"method": "compass"},
        axes={
            "stored_s": [2.0, 3.0],
            "turn": ["reflect", "keep"],
            "azimuth_sigma_per_s": [0.1, 0.2],
        },
    )
    parts = list(build.parts(study))
    np.testing.assert_array_equal([p.variant_ids for p in parts], [range(4), range(4, 8)])
    assert parts[0].group.static == parts[1].group.static
    assert parts[0].group.static.passes == "alternate"
    assert group_of().static.passes == "once"
    environments = [part.group.environment for part in parts]
    assert [int(environment.pass_records) for environment in environments] == [2, 3]
    np.testing.assert_array_equal(
        environments[0].sensors.increments, environments[1].sensors.increments
    )
    assert len(environments[0].sensors.increments) == 300
    whole = group_of().environment
    np.testing.assert_allclose(
        environments[0].sensors.increments, whole.sensors.increments[:300], rtol=0, atol=1e-18
    )
    true = np.concatenate([whole.truth.attitudes[0, :1] * np.nan, whole.truth.attitudes[0]])
    for environment, places in zip(
        environments, ([1, 2, 1, 0, 1, 2], [1, 2, 3, 2, 1, 0]), strict=True
    ):
        known = np.array(places) > 0
        np.testing.assert_allclose(
            environment.truth.attitudes[0][known], true[places][known], rtol=0, atol=1e-15
        )


def test_recorded_study_without_record_is_refused() -> None:
    tables = {"study": {"duration_s": 6.0, "rate_hz": 100.0}, "record": {"format": "psins"}}
    study = study_from_dict(with_paper_values(tables))
    with pytest.raises(InputError, match="reads a record"):
        build.parts(study)


def attitude_at(times: list[float], *missing: tuple[float, float]) -> np.ndarray:
    """Of a base that turns by 6 deg/s, from a reference of a second's steps with gaps, 0 to 200."""
    time_s = np.arange(201.0)
    for after, before in missing:
        time_s = time_s[(time_s <= after) | (time_s >= before)]
    heading = np.stack([0 * time_s, 0 * time_s, 6 * time_s], axis=1)
    record = Record(dtheta=np.zeros((1, 3)), dv=np.zeros((1, 3)), rate_hz=100.0)
    return reference_attitudes(
        StoredRecord(record, Reference(time_s, heading, None)), np.asarray(times)
    )


@pytest.mark.parametrize(
    ("missing", "times", "gap"),
    [
        ((100, 109.5), [105.5, 120], 10),
        ((100, 109.5), [80, 104], 10),
        ((100, 109.5), [120, 103], 10),
        ((100, 106), [104, 120], 6),
    ],
)
def test_reference_gap_touching_needed_span_is_refused(missing, times, gap):
    """A sample within the span is not enough: the ends lie between two, which may be far apart."""
    with pytest.raises(InputError, match=f"has a gap of {gap} s where the study needs it"):
        attitude_at(times, missing)


@pytest.mark.parametrize("times", [[110, 120], [80, 100], [20, 30], [0, 100], [110, 200]])
def test_reference_gap_outside_needed_span_is_accepted(times):
    turned = attitude_at(times, (100, 109.5), (5, 10))
    expected = Rotation.from_rotvec(np.outer(times, [0, 0, 6 * DEG]))
    left = expected.inv() * Rotation.from_quat(turned, scalar_first=True)
    np.testing.assert_allclose(left.magnitude(), 0, atol=1e-12)
