"""Variants with the same runs are reported once."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.stored_results import store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax import analysis
from sinsjax.execution import run as study_run
from sinsjax.execution.results import Results
from sinsjax.report import monte_carlo

pytestmark = pytest.mark.optimised(False)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Results:
    study = small_study(axes={"reset_count": [0, 1], "reset_cycle_s": [1.0, 2.0, 3.0]})
    directory = tmp_path_factory.mktemp("alike")
    whole = synthetic_summary(study)
    same = np.arange(study.n_draws)[:, None] * study.n_variants + study.duplicate_of
    summary = whole.take(same.ravel())
    for name in ("run_id", "variant_id", "reset_cycle_s"):
        summary = summary.set_column(summary.column_names.index(name), name, whole[name])
    return Results.read(store_results(directory, study, summary))


def test_variant_table_lists_duplicate_variants_once(source: Results) -> None:
    table = monte_carlo.statistics_table(source, ["reset_count", "reset_cycle_s"], "Every variant")
    assert [row[:3] for row in table.rows] == [
        ["0", "-", "3"],
        ["1", "1", "3"],
        ["1", "2", "3"],
        ["1", "3", "3"],
    ]


def test_verdict_and_shares_count_duplicate_variants_once(source: Results) -> None:
    """The runs without resets end right, those with one do not: 3 of 12 runs, not 9 of 18."""
    table = source.summary
    right = analysis.numeric_column(table, "reset_count") == 0
    columns = {
        "phi_u_arcmin": np.where(right, 1.0, 50.0),
        "ok_truth": right,
        "ok_floor": right,
        "status": np.where(right, "ok", "not_settled"),
        "settle_10_s": np.where(right, 2.0, np.nan),
        "settle_10_truth_s": np.where(right, 2.0, np.nan),
    }
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    changed = Results(source.study, None, tables={"summary": table})
    found = monte_carlo.build_report(changed, with_tables=False)
    assert found.title == "study: 18 runs (12 distinct), none failed"
    assert found.facts[1].text.startswith("no reset: every run settles")
    # A quarter of each of 3 draws: 2.5 % quantiles of Beta(3, 1), of the share and of the rest.
    least = 0.025 ** (1 / 3)
    ends = f"25 [{100 * least / 4:.0f}, {100 * (1 - 3 * least / 4):.0f}]"
    (row,) = monte_carlo.statistics_table(changed, [], "All runs").rows
    assert row[0] == "12" and ends in row[1]


@pytest.mark.nightly
def test_report_draws_methods_with_and_without_covariance_together(tmp_path: Path) -> None:
    study = small_study(
        study={"curves": True, "draws": 2},
        axes={"alignment": {"method": ["kalman5", "compass"]}},
        sensors={"accel_bias_ug": 0.0, "gyro_bias_deg_per_h": 0.0},
    )
    study_run.run_into(study, tmp_path / "results")
    report = monte_carlo.build_report(Results.read(tmp_path / "results"))
    names = [picture.name for picture in report.pictures]
    assert {"misalignment", "misalignment_level", "consistency"} <= {*names}
