"""Normalised innovations of a recorded study, in its summary and its report."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.studies import small_study, with_paper_values

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.execution import run
from sinsjax.execution.results import Results
from sinsjax.execution.tables import TableBuilder
from sinsjax.records.reference import StoredRecord
from sinsjax.report.attitude import describe_innovations
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

RECORDED: dict[str, Any] = {
    "study": {"duration_s": 2.0, "draws": None, "window_s": [0, 2]},
    "motion": None,
    "sensors": None,
    "record": {"format": "psins", "start_s": [0.0, 1.0]},
    "coarse": {"coarse_duration_s": 3.0},
}


def recorded(cases: list[dict[str, Any]] | None = None, **changes: Any) -> Study:
    sections = RECORDED | changes
    base = small_study()
    data = base.model_dump(exclude_none=True, include={"study", "earth", "alignment"})
    for name, section in sections.items():
        data[name] = None if section is None else data.get(name, {}) | section
    data["study"].pop("draws")
    kept = {name: {k: v for k, v in s.items() if v is not None} for name, s in data.items() if s}
    return study_from_dict(with_paper_values(kept | ({"cases": cases} if cases else {})))


@pytest.fixture(scope="module")
def stored() -> StoredRecord:
    return StoredRecord(simulated_record(small_study()), None)


KEYS = ("p0_velocity_m_per_s", "p0_level_deg", "p0_yaw_deg", "q_accel_ug", "q_gyro_deg_per_h")
USUAL = dict(zip(KEYS, (0.1, 15.0, 80.0, 500.0, 0.1), strict=True))
SMALL = dict(zip(KEYS, (1e-6, 1e-6, 1e-6, 0.0, 0.0), strict=True))


@pytest.fixture(scope="module")
def summary(stored: StoredRecord) -> pa.Table:
    """Of both starts: a filter, two that know next to all but R, and a compass."""
    some = (("kalman5", USUAL, 0.1), ("kalman5", SMALL, 0.1), ("kalman5", SMALL, 1.0))
    every = (*some, ("compass", USUAL, 0.1))
    cases = [{"method": m, "r_velocity_m_per_s": r} | beliefs for m, beliefs, r in every]
    return run.run(recorded(cases=cases), stored).summary


@pytest.mark.nightly
def test_innovation_columns_exist_only_in_recorded_studies(summary: pa.Table) -> None:
    assert summary["innovation_freedom"].to_pylist() == [400.0, 400.0, 400.0, None] * 2
    mean = summary["innovation_nis"].to_pylist()
    assert mean[3] is None and mean[7] is None
    assert all(0 < value < 10 for value in mean[::4])
    assert "innovation_nis" not in [
        column.name for column in TableBuilder(small_study()).summary_columns
    ]


@pytest.mark.nightly
def test_nis_scales_inversely_with_r(summary: pa.Table) -> None:
    """With P and Q next to nothing, S is R: a hundred times the variance, a hundredth of NIS."""
    one, other = summary["innovation_nis"].to_pylist()[1:3]
    assert one / other == pytest.approx(100, rel=1e-3)


@pytest.mark.parametrize(
    ("mean", "says", "not_says"),
    [
        ([0.001, 0.002], "2 lie below: R is larger than the noise", "contradict what"),
        ([2.9, 2.0], "1 lie above: their data contradict", "below"),
        ([2.0, 2.01], "2 to 2.01 in 2 runs", " lie "),
    ],
)
def test_only_nis_above_band_is_reported_as_contradiction(
    tmp_path: Any, mean: list[float], says: str, not_says: str
) -> None:
    table = pa.table({"innovation_nis": mean, "innovation_freedom": [2000.0, 2000.0]})
    text = describe_innovations(Results(recorded(), None, tables={"summary": table}))
    assert says in text and not_says not in text


def test_nis_band_holds_95_percent_of_chi_square(tmp_path: Any) -> None:
    """Of sums of squares of 200 normal numbers, 95 % lie inside; to three digits of 1e5 sums."""
    sums = (np.random.default_rng(0).normal(size=(20_000, 200)) ** 2).sum(1) / 100
    table = pa.table({"innovation_nis": sums, "innovation_freedom": np.full(20_000, 200.0)})
    text = describe_innovations(Results(recorded(), None, tables={"summary": table}))
    above, below = (int(text.split(" lie ")[i].split()[-1].replace(",", "")) for i in (0, 1))
    assert above == pytest.approx(500, abs=90) and below == pytest.approx(500, abs=90)
