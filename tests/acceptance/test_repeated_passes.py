"""Studies of repeated passes, forward and backward: from the study to the rows of its tables."""

import numpy as np
import pyarrow.compute as pc
import pytest
from support.batches import batch_of, batches_of
from support.studies import recorded_study, small_study, swing_deg

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
def test_carried_covariance_is_overconfident_after_repeated_passes():
    """One pass is consistent; N passes count as N times the data, so P_UU is N times too small.

    Truth is what the filter believes but for the repetition: a static base, no biases, white noise
    as Q says, velocity known to 1e-6 m/s, initial errors drawn from P0, and feedback at once.
    """
    sizes = {"phi_e0_deg": 0.05, "phi_n0_deg": 0.05, "phi_u0_deg": 2.0}
    sizes |= {"ve0_m_per_s": 1e-3, "vn0_m_per_s": 1e-3}
    normal = np.random.default_rng(0).normal(size=(4, 5)) * [*sizes.values()]
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
        "axes": {"passes": [1, 4], "turn_covariance": ["carried", "inflated", "reset"]},
    }
    rows = study_run.run(study_from_dict(tables)).summary
    nees, sigma = (rows[key].to_numpy().reshape(64, 4, 2, 3) for key in ("nees", "sigma_u_arcmin"))
    by_draw = nees.mean(axis=1)
    mean, half = by_draw.mean(axis=0), 1.96 * by_draw.std(axis=0, ddof=1) / 8
    assert (np.abs(mean - 3) < 1.5 * half).tolist() == [[True] * 3, [False, True, True]]
    assert mean[1, 0] - half[1, 0] > 6
    once, repeated = sigma[..., 0].mean(axis=(0, 1))
    assert once / repeated == pytest.approx(2, rel=0.02)


def on_record(reference_s, **passes):
    """A study of two starts on a record of 20 s, and the record with a shorter reference."""
    length = {"duration_s": 20.0, "rate_hz": 50.0}
    t = np.arange(0, reference_s + 1e-9, 0.02)
    study = recorded_study(
        study={"duration_s": 12.0, "rate_hz": 50.0, "window_s": [1, 4]},
        record={"start_s": [0.0, 4.0]},
        coarse={"coarse_duration_s": 6.0},
        passes=passes,
        **QUICK,
    )
    record = simulated_record(small_study(study=length))
    return study, StoredRecord(record, Reference(t, swing_deg(t), None))


def test_every_start_time_is_judged_by_reference_of_its_own_passes():
    group = batch_of(*on_record(20.0, stored_s=6.0))
    w, x, y, z = np.moveaxis(np.asarray(group.environment.attitudes)[group.draws.row], -1, 0)
    stored = np.array([1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1, 0])
    t = np.array([[0.0], [4.0]]) + 6.0 + stored
    pitch_deg = np.rad2deg(np.arcsin(2 * (w * x + y * z)))
    expected = swing_deg(t.ravel())[:, 0].reshape(2, -1)
    np.testing.assert_allclose(pitch_deg, expected, rtol=0, atol=1e-4)


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
