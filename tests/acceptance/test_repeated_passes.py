"""Studies of repeated passes, forward and backward: from the study to the rows of its tables."""

import numpy as np
import pyarrow.compute as pc
import pytest
from support.batches import batch_of, batches_of
from support.studies import BASE, small_study, swing_deg, with_paper_values

from sinsjax.arena.export import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import run as study_run
from sinsjax.records import Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict

pytestmark = pytest.mark.optimised(False)

QUICK = {
    "alignment": {"method": "compass", "phi_e0_deg": 0.1, "phi_n0_deg": -0.1, "phi_u0_deg": 1.0},
    "compass": {"level_sigma_per_s": 0.5, "level_time_s": 2.0, "azimuth_sigma_per_s": 0.05},
}


def repeating(**tables):
    """Return a study of two draws of 8 s with curves."""
    settings = {"duration_s": 8.0, "draws": 2, "window_s": [1, 3], "curves": True}
    return small_study(study=settings, **tables)


def test_stored_times_and_pass_numbers_follow_passes():
    """Times by hand."""
    for passes, times, numbers in (
        ({"stored_s": 3.0}, [1, 2, 3, 2, 1, 0, 1, 2], [1, 1, 1, 2, 2, 2, 3, 3]),
        ({"stored_s": 2.0, "passes": 2}, [1, 2, 1, 0], [1, 1, 2, 2]),
        ({"stored_s": 2.0, "ending": "forward"}, [1, 2, 1, 0, 1, 2], [1, 1, 2, 2, 3, 3]),
        ({"stored_s": 5.0, "ending": "forward"}, [1, 2, 3, 4, 5], [1] * 5),
        ({}, [*range(1, 9)], [1] * 8),
    ):
        study = repeating(passes=passes, **QUICK)
        (span,) = set(study.lengths.to_list())
        assert study.stored_times(span).tolist() == times
        assert span.pass_numbers().tolist() == numbers


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_single_pass_of_full_duration_gives_identical_results():
    """The program that could turn gives what the one that cannot does, for any method."""
    methods = {"axes": {"method": ["compass", "kalman5"]}, "compass": QUICK["compass"]}
    plain = study_run.run(repeating(**methods))
    over = study_run.run(repeating(passes={"stored_s": 8.0}, **methods))
    for a, b in ((plain.summary, over.summary), (plain.curves, over.curves)):
        assert b.select(a.column_names).equals(a)


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_swept_stored_durations_give_same_rows_as_each_alone():
    """Every bit is equal, though the parts share a record of one length."""
    together = study_run.run(repeating(passes={}, axes={"stored_s": [3.0, 4.0]}, **QUICK))
    alone = study_run.run(repeating(passes={"stored_s": 3.0}, **QUICK))
    for all_rows, own in ((together.summary, alone.summary), (together.curves, alone.curves)):
        first = all_rows.filter(pc.equal(pc.bit_wise_and(all_rows["run_id"], 1), 0))
        names = [n for n in own.column_names if n not in ("run_id", "variant_id")]
        assert first.select(names).equals(own.select(names))


@pytest.mark.nightly
@pytest.mark.parametrize("method", ["compass", "kalman10"])
def test_error_free_run_keeps_true_attitude_over_every_pass(method):
    """The reference of a run is the attitude at its place in the record, also backward."""
    start = {"method": method, "phi_e0_deg": 0.0, "phi_n0_deg": 0.0, "phi_u0_deg": 0.0}
    loops = {"compass": QUICK["compass"]} if method == "compass" else {}
    sensors = dict.fromkeys(BASE["sensors"], 0.0)
    study = repeating(sensors=sensors, alignment=start, passes={"stored_s": 3.0}, **loops)
    curves = study_run.run(study).curves
    for axis in "enu":
        assert np.abs(np.array(curves[f"phi_{axis}_arcmin"])).max() < 1e-3
    angles = np.transpose([curves[f"{name}_deg"] for name in ("pitch", "roll", "yaw")])
    expected = swing_deg(curves["stored_time_s"].to_numpy())
    np.testing.assert_allclose(angles, expected, rtol=0, atol=1e-5)


@pytest.mark.nightly
def test_carried_covariance_is_overconfident_after_repeated_passes():
    """One pass is consistent; N passes count as N times the data, so P_UU is N times too small.

    The error itself stays: repetition adds no information. Truth is what the filter believes but
    for the repetition: a static base, no biases, white noise as Q says, velocity known to 1e-6 m/s,
    initial errors drawn from P0, and feedback at once, so that A(t) is that of the true attitude.
    """
    sizes = {"phi_e0_deg": 0.05, "phi_n0_deg": 0.05, "phi_u0_deg": 2.0}
    sizes |= {"ve0_m_per_s": 1e-3, "vn0_m_per_s": 1e-3}
    normal = np.random.default_rng(0).normal(size=(4, 5)) * [*sizes.values()]
    turns = ["carried", "inflated", "reset"]
    tables = {
        "study": {"duration_s": 160.0, "rate_hz": 50.0, "draws": 64, "window_s": [0, 40]},
        "earth": {"latitude_deg": 32.0},
        "motion": {"yaw_center_deg": 0.0},
        "sensors": {"gyro_noise_deg_per_h": 0.1, "accel_noise_ug": 50.0},
        "alignment": {"method": "kalman5", "feedback_interval_s": 0.02},
        "filter": {
            **{"p0_velocity_m_per_s": 1e-3, "p0_level_deg": 0.05, "p0_yaw_deg": 2.0},
            **{"q_accel_ug": 50.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_sample"},
            "r_velocity_m_per_s": 1e-6,
        },
        "passes": {"stored_s": 40.0},
        "cases": [dict(zip(sizes, row, strict=True)) for row in normal.tolist()],
        "axes": {"passes": [1, 4], "turn_covariance": turns},
    }
    rows = study_run.run(study_from_dict(tables)).summary

    def mean_and_half_width(key, passes, turn):
        """The mean over all runs and its 95 % half-width over the draws."""
        own = (pc.field("passes") == passes) & (pc.field("turn_covariance") == turn)
        values = np.array(rows.filter(own).sort_by("draw_id")[key]).reshape(64, -1).mean(axis=1)
        return values.mean(), 1.96 * values.std(ddof=1) / 8

    for passes, turn in ((1, "carried"), (1, "reset"), (4, "inflated"), (4, "reset")):
        mean, half = mean_and_half_width("nees", passes, turn)
        assert abs(mean - 3) < 1.5 * half
    error, sigma, nis = (
        {n: mean_and_half_width(key, n, "carried")[0] for n in (1, 4)}
        for key in ("phi_u_arcmin", "sigma_u_arcmin", "nis_u")
    )
    assert sigma[1] / sigma[4] == pytest.approx(2, rel=0.02)
    assert nis[4] / nis[1] == pytest.approx(4, rel=0.1)
    assert error[4] == pytest.approx(error[1], abs=0.2)
    mean, half = mean_and_half_width("nees", 4, "carried")
    assert mean - half > 6


# Records

SWING = {"pitch_amplitude_deg": 4.0, "pitch_period_s": 7.0, "yaw_center_deg": 10.0}


def on_record(reference_s, **passes):
    """Return a study of two starts on a record of 20 s, and the record with a shorter reference."""
    times = {"duration_s": 20.0, "rate_hz": 50.0, "draws": 1}
    tables = {"study": times, "earth": {"latitude_deg": 32.0}, "motion": SWING}
    record = simulated_record(study_from_dict(with_paper_values(tables)))
    t = np.arange(0, reference_s + 1e-9, 0.02)
    angles = np.stack([4 * np.sin(2 * np.pi * t / 7), 0 * t, 10 + 0 * t], axis=1)
    tables = {
        "study": {"duration_s": 12.0, "rate_hz": 50.0, "window_s": [1, 4], "curves": True},
        "record": {"format": "psins", "start_s": [0.0, 4.0]},
        "coarse": {"coarse_duration_s": 6.0},
        "passes": passes,
    }
    return study_from_dict(tables | QUICK), StoredRecord(record, Reference(t, angles, None))


def test_every_start_time_is_judged_by_reference_of_its_own_passes():
    group = batch_of(*on_record(20.0, stored_s=6.0))
    w, x, y, z = np.moveaxis(np.asarray(group.environment.attitudes)[group.draws.row], -1, 0)
    stored = np.array([1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1, 0])
    t = np.array([[0.0], [4.0]]) + 6.0 + stored
    pitch_deg = np.rad2deg(np.arcsin(2 * (w * x + y * z)))
    np.testing.assert_allclose(pitch_deg, 4 * np.sin(2 * np.pi * t / 7), rtol=0, atol=1e-4)


def test_record_and_reference_must_cover_a_stored_pass():
    """With two passes a run ends at the beginning of its record, which the reference covers."""
    with pytest.raises(InputError, match="has 20 s, but from start_s = 4 the study needs 17 s"):
        batches_of(*on_record(20.0, stored_s=11.0))
    with pytest.raises(InputError, match="covers 0 to 13 s, but the study needs 10 to 16 s"):
        batches_of(*on_record(13.0, stored_s=6.0, passes=2))


def test_only_needed_part_of_record_is_loaded():
    """A run begins where its fine alignment does on the record."""
    study, stored = on_record(20.0, stored_s=6.0)
    part = batch_of(study.replace({"record.start_s": [4.0]}), stored)
    whole = np.hstack([stored.record.dtheta, stored.record.dv])
    np.testing.assert_array_equal(part.environment.increments, whole[200:800])
    np.testing.assert_array_equal(part.draws.start, [300])
