"""Tables and figures over drawn keys, in bins, and along an axis with lists as values."""

from pathlib import Path

import numpy as np
import pytest
from support.stored_results import store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax import analysis
from sinsjax.analysis.summaries import read_estimate
from sinsjax.execution import run
from sinsjax.execution.results import Results
from sinsjax.report import axis_figures, monte_carlo
from sinsjax.report.axis_figures import bin_drawn_keys, bin_medians
from sinsjax.report.base import Picture, Table

pytestmark = pytest.mark.optimised(False)

SHORT = {"draws": 60, "duration_s": 2.0, "window_s": [0, 2]}
DRAWN = {
    "phi_u0_deg": {"uniform": [-10, 10]},
    "yaw_center_deg": {"values": [0, 90, 180]},
    "accel_bias_ug": {"normal": [0, 100]},
}


@pytest.fixture(scope="module")
def drawn_source(tmp_path_factory: pytest.TempPathFactory) -> Results:
    study = small_study(
        study=SHORT,
        alignment={"phi_u0_deg": None},
        motion={"yaw_center_deg": None},
        sensors={"accel_bias_ug": None},
        drawn=DRAWN,
        axes={"p0_yaw_deg": [10.0, 40.0]},
    )
    out = tmp_path_factory.mktemp("drawn") / "out"
    run.run_into(study, out)
    return Results.read(out)


def test_bins_have_equal_counts_and_few_values_stay_separate() -> None:
    values = np.random.default_rng(0).normal(size=1001)
    medians = bin_medians(values, 8)
    found, sizes = np.unique(medians, return_counts=True)
    assert len(found) == 8 and sizes.min() >= 125 and sizes.max() <= 126
    order = np.argsort(values)
    assert (np.diff(medians[order]) >= 0).all()
    for median in found:
        assert median == pytest.approx(np.median(values[medians == median]), rel=1e-2)
    few = np.array([3.0, 1.0, 3.0, 2.0])
    assert bin_medians(few, 3).tolist() == few.tolist()


@pytest.mark.nightly
def test_drawn_scalars_are_binned_with_statistics_per_bin(drawn_source: Results) -> None:
    found = bin_drawn_keys(drawn_source)
    assert found.keys() == {"phi_u0_deg", "yaw_center_deg"}  # a vector has no order
    assert found["yaw_center_deg"][1] == (0.0, 90.0, 180.0)
    own, medians = found["phi_u0_deg"]
    assert len(medians) == 6  # ten draws each
    rows = drawn_source.rows(["phi_u0_deg", "phi_u_mean_arcmin", "draw_id"])
    values = analysis.numeric_column(rows, "phi_u0_deg")
    bins = bin_medians(values, 6)
    window = analysis.numeric_column(rows, "phi_u_mean_arcmin")
    table = analysis.summarise(own.summary, ["phi_u0_deg"], ["phi_u_mean_arcmin_mean"]).to_pylist()
    assert [row["phi_u0_deg"] for row in table] == list(medians)
    for row in table:
        mine = bins == row["phi_u0_deg"]
        assert row["n"] == mine.sum() == 20
        estimate = read_estimate(row, "phi_u_mean_arcmin_mean")
        assert estimate.value == pytest.approx(window[mine].mean())
        assert estimate.low < estimate.value < estimate.high


@pytest.mark.nightly
def test_report_has_table_per_drawn_key_and_figure_if_it_acts(drawn_source: Results) -> None:
    *pictures, idle = axis_figures.build_axis_figures(drawn_source)
    assert [getattr(block, "name", "") for block in pictures] == ["along_axis", "over_phi_u0_deg"]
    assert idle == "No figure over yaw_center_deg: no effect beyond the intervals."
    assert isinstance(pictures[1], Picture)
    assert "phi_u0_deg: the median of each bin" in pictures[1].caption
    (line, _) = pictures[1].figure.axes[0].containers
    medians = bin_drawn_keys(drawn_source)["phi_u0_deg"][1]
    assert np.allclose(line.lines[0].get_xdata(), medians, atol=0.2)
    blocks = monte_carlo.build_report(drawn_source).blocks
    titled = {block.title: block for block in blocks if isinstance(block, Table)}
    table = titled["Over phi_u0_deg, drawn"]
    assert table.header[:3] == ["phi_u0_deg", "p0_yaw_deg", "runs"] and len(table.rows) == 12
    assert [row[2] for row in table.rows] == ["10"] * 12


def test_list_valued_axis_is_plotted_as_categories(tmp_path: Path) -> None:
    times = [[], [0.5], [0.5, 1.0]]
    study = small_study(study=SHORT | {"draws": 4}, axes={"reset_times_s": times})
    assert axis_figures.figure_axes(study) == ({"reset_times_s": ((), (0.5,), (0.5, 1.0))}, [])
    source = Results.read(store_results(tmp_path, study, synthetic_summary(study)))
    (figure,) = axis_figures.build_axis_figures(source)
    axes = figure.figure.axes[-1]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["none", "0.5", "0.5, 1"]
    assert axes.get_xlabel() == "resets at (s)"
