"""Normalised innovations of a recorded study, in its summary and its report."""

import numpy as np
import pyarrow as pa
import pytest
from support.studies import small_study, with_paper_values

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.execution import run
from sinsjax.execution.results import Results
from sinsjax.records.reference import StoredRecord
from sinsjax.report.attitude import count_contradictions
from sinsjax.study.load import study_from_dict

pytestmark = pytest.mark.optimised(False)

RECORDED = {
    "study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0, 2]},
    "earth": {"latitude_deg": 32.0},
    "record": {"format": "psins", "start_s": [0.0, 1.0]},
    "coarse": {"coarse_duration_s": 3.0},
}
SMALL = {"p0_velocity_m_per_s": 1e-6, "p0_level_deg": 1e-6, "p0_yaw_deg": 1e-6}
SMALL |= {"q_accel_ug": 0.0, "q_gyro_deg_per_h": 0.0}


@pytest.mark.nightly
def test_nis_scales_inversely_with_r_and_is_null_without_filter() -> None:
    """With P and Q next to nothing, S is R: a hundred times the variance, a hundredth of NIS."""
    cases = [{"method": "kalman5", "r_velocity_m_per_s": r} | SMALL for r in (0.1, 1.0)]
    cases.append(cases[0] | {"method": "compass"})
    stored = StoredRecord(simulated_record(small_study()), None)
    summary = run.run(
        study_from_dict(with_paper_values(RECORDED | {"cases": cases})), stored
    ).summary
    assert summary["innovation_freedom"].to_pylist() == [400.0, 400.0, None] * 2
    one, other, none, *_ = summary["innovation_nis"].to_pylist()
    assert none is None and one / other == pytest.approx(100, rel=1e-3)


def test_innovations_above_their_band_contradict_the_covariance() -> None:
    """Of sums of squares of 200 normal numbers, 2.5 % lie above."""
    sums = (np.random.default_rng(0).normal(size=(20_000, 200)) ** 2).sum(1) / 100
    table = pa.table({"innovation_nis": sums, "innovation_freedom": np.full(len(sums), 200.0)})
    study = study_from_dict(with_paper_values(RECORDED))
    found = count_contradictions(Results(study, None, tables={"summary": table}))
    assert found == pytest.approx(500, abs=90)
