"""Reports of special studies: drawn keys, duplicates, no heading, and unfinished ones."""

import io
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console
from support.stored_results import store_results
from support.studies import STILL, small_study
from support.synthetic_tables import synthetic_summary

from sinsjax import report
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import run
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.run import RunProgress
from sinsjax.execution.tables import replace_column
from sinsjax.report import attitude, axis_figures, monte_carlo
from sinsjax.report.base import Picture, Report, Table

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

SHORT = {"draws": 60, "duration_s": 2.0, "window_s": [0, 2]}


def facts_of(found: Report) -> dict[str, str]:
    return {fact.label: fact.text for fact in found.facts}


def tables_of(found: Report) -> dict[str, Table]:
    return {block.title: block for block in found.blocks if isinstance(block, Table)}


# --- drawn keys, and an axis of lists -----------------------------------------------------------


def test_bins_have_equal_counts_and_few_values_stay_separate() -> None:
    values = np.random.default_rng(0).normal(size=1001)
    medians = axis_figures.bin_medians(values, 8)
    found, sizes = np.unique(medians, return_counts=True)
    assert len(found) == 8 and sizes.min() >= 125 and sizes.max() <= 126
    assert (np.diff(medians[np.argsort(values)]) >= 0).all()
    few = np.array([3.0, 1.0, 3.0, 2.0])
    assert axis_figures.bin_medians(few, 3).tolist() == few.tolist()


def test_drawn_numbers_have_a_table_of_bins_and_a_figure_if_they_act(tmp_path: Path) -> None:
    study = small_study(
        study=SHORT,
        alignment={"phi_u0_deg": None},
        motion={"yaw_center_deg": None},
        sensors={"accel_bias_ug": None},
        drawn={
            "phi_u0_deg": {"uniform": [-10, 10]},
            "yaw_center_deg": {"values": [0, 90, 180]},
            "accel_bias_ug": {"normal": [0, 100]},
        },
        axes={"p0_yaw_deg": [10.0, 40.0]},
    )
    phi, yaw = np.repeat(np.linspace(-10, 10, 60), 2), np.tile([0.0, 0, 90, 90, 180, 180], 20)
    columns = {"phi_u0_deg": phi, "yaw_center_deg": yaw, "accel_bias_ug": [[1.0, 2.0, 3.0]] * 120}
    columns["settle_10_truth_s"] = np.round(phi) + 20.0
    columns |= {"settle_10_s": columns["settle_10_truth_s"], "phi_u_arcmin": np.ones(120)}
    summary = synthetic_summary(study, **columns)
    found = monte_carlo.build_report(Results(study, None, tables={"summary": summary}))
    table = tables_of(found)["Over phi_u0_deg, drawn"]  # a vector has no order
    assert table.header[:3] == ["phi_u0_deg", "p0_yaw_deg", "runs"]
    assert [row[2] for row in table.rows] == ["10"] * 12
    medians = [np.median(part) for part in np.split(phi[::2], 6)]
    assert [float(row[0]) for row in table.rows[::2]] == pytest.approx(medians, rel=1e-2)
    assert "No figure over yaw_center_deg: no effect beyond the intervals." in found.blocks
    (picture,) = (one for one in found.pictures if one.name == "over_phi_u0_deg")
    assert "phi_u0_deg: the median of each bin" in picture.caption
    (line, _) = picture.figure.axes[0].containers
    assert np.allclose(line.lines[0].get_xdata(), medians, atol=0.2)


def test_list_valued_axis_is_plotted_as_categories(tmp_path: Path) -> None:
    times = [[], [0.5], [0.5, 1.0]]
    study = small_study(study=SHORT | {"draws": 4}, axes={"reset_times_s": times})
    source = Results(study, None, tables={"summary": synthetic_summary(study)})
    (picture,) = axis_figures.build_axis_figures(source)
    assert isinstance(picture, Picture)
    axes = picture.figure.axes[-1]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["none", "0.5", "0.5, 1"]
    assert axes.get_xlabel() == "resets at (s)"


# --- duplicate variants -------------------------------------------------------------------------


def test_duplicate_variants_count_once_in_verdict_tables_and_shares() -> None:
    """The runs without resets end right, those with one do not: 3 of 12 runs, not 9 of 18."""
    study = small_study(axes={"reset_count": [0, 1], "reset_cycle_s": [1.0, 2.0, 3.0]})
    right = np.tile([True] * 3 + [False] * 3, 3)
    settle_s = np.where(right, 2.0, np.nan)
    summary = synthetic_summary(
        study,
        phi_u_arcmin=np.where(right, 1.0, 50.0),
        status=list(np.where(right, "ok", "not_settled")),
        settle_10_s=settle_s,
        settle_10_truth_s=settle_s,
    )
    source = Results(study, None, tables={"summary": summary})
    found = monte_carlo.build_report(source)
    assert found.title == "study: 18 runs (12 distinct), none failed"
    assert facts_of(found)["Best"].startswith("no reset: every run settles")
    keys = [row[:3] for row in tables_of(found)["Every variant"].rows]
    assert keys == [["0", "-", "3"], ["1", "1", "3"], ["1", "2", "3"], ["1", "3", "3"]]
    # A quarter of each of 3 draws: 2.5 % quantiles of Beta(3, 1), of the share and of the rest.
    least = 0.025 ** (1 / 3)
    (row,) = monte_carlo.statistics_table(source, [], "All runs").rows
    ends = f"25 [{100 * least / 4:.0f}, {100 * (1 - 3 * least / 4):.0f}]"
    assert row[0] == "12" and ends in row[1]


# --- methods that find no heading, or have no covariance ----------------------------------------


def run_methods(out: Path, *methods: str) -> Results:
    settings = {"curves": True, "report_times_s": [3.0], "draws": 3}
    unbiased = {"accel_bias_ug": 0.0, "gyro_bias_deg_per_h": 0.0} if "compass" in methods else {}
    axes = {"method": [*methods]}
    run.run_into(small_study(study=settings, motion=STILL, axes=axes, sensors=unbiased), out)
    return Results.read(out)


def test_study_of_level_alone_reports_pitch_and_roll(tmp_path: Path) -> None:
    source = run_methods(tmp_path / "out", "level")
    found = monte_carlo.build_report(source)
    facts, table = facts_of(found), found.table
    assert facts["Attitude"].startswith("pitch ") and "(1 sigma 17." in facts["Attitude"]
    assert facts["Attitude"].endswith("(last draw)")
    assert facts["Heading"] == "none: level finds pitch and roll alone"
    assert facts["Accuracy"].endswith("' rms from the truth per angle")
    assert table is not None and len(table.rows) == 3 and "unknown" not in str(table.rows)
    (picture,) = found.pictures
    titles = [axes.get_title(loc="left").partition(", ")[2] for axes in picture.figure.axes]
    assert titles == ["east", "north"]
    nulls = source.summary
    for name in ("pitch_deg", "roll_deg"):
        nulls = replace_column(nulls, name, pa.nulls(nulls.num_rows))
    (fact, *_) = attitude.attitude_verdict(
        Results(source.study, None, tables={"summary": nulls})
    ).facts
    assert fact.is_caution and fact.text == "unknown, the run is not finite"


@pytest.mark.nightly
def test_level_next_to_a_filter_never_settles(tmp_path: Path) -> None:
    found = monte_carlo.build_report(run_methods(tmp_path / "out", "kalman5", "level"))
    facts = facts_of(found)
    assert "kalman5" in facts["Best"] and facts["Others"] == "level: never"
    row = next(row for row in tables_of(found)["Every variant"].rows if row[0] == "level")
    assert row[2].startswith("0") and {"no bias floor", "never", "unknown"} <= {*row}
    # The filter without bias states is explained, whatever `level` assumes.
    assert any("A NEES of 3 cannot be expected here" in str(block) for block in found.blocks)


@pytest.mark.nightly
def test_report_draws_methods_with_and_without_covariance_together(tmp_path: Path) -> None:
    found = monte_carlo.build_report(run_methods(tmp_path / "out", "kalman5", "compass"))
    names = {picture.name for picture in found.pictures}
    assert {"misalignment", "misalignment_level", "consistency"} <= names


# --- unfinished studies: the report is of the draws that are whole, and it says so --------------


def store_interrupted(out: Path, **tables: Any) -> None:
    """Results of a study that was stopped while its first chunk ran."""
    stop = threading.Event()

    def on_progress(progress: RunProgress) -> None:
        if progress.done:
            stop.set()

    study = small_study(study=SHORT | {"draws": 300}, **tables)
    with pytest.raises(StudyInterrupted):
        run.run_into(study, out, chunk_runs=128, on_progress=on_progress, stop=stop)


def store_made_up(out: Path, **tables: Any) -> None:
    """The same of 100 draws and the first variant of another, from numbers that no engine made."""
    study = small_study(study=SHORT | {"draws": 300}, **tables)
    out.mkdir()
    summary = synthetic_summary(study).slice(0, 301)
    store_results(out, study, summary, state="interrupted", wall_s=9.0)


@pytest.mark.parametrize(
    "store", [store_made_up, pytest.param(store_interrupted, marks=pytest.mark.nightly)]
)
def test_unfinished_report_warns_with_share_of_runs(
    store: Callable[..., None], tmp_path: Path
) -> None:
    out, page = tmp_path / "out", tmp_path / "page.html"
    store(out, axes={"p0_yaw_deg": [10.0, 40.0, 60.0]})
    console = Console(file=io.StringIO(), width=2000)
    report.print_reports([out], console, page, full=True)
    lines = [line for line in console.file.getvalue().splitlines() if line]
    whole, there = Results.read(out).draws, read_summary(out).num_rows
    assert 0 < whole < 300 and whole == there // 3
    share = f"unfinished: {there} of 900 runs are done"
    assert lines[0].startswith(f"study: unfinished, {3 * whole} of 900 runs in ")
    warning = next(line for line in lines if line.startswith("  Warning "))
    assert f"{share}; shown are the {whole} draws" in warning
    assert f"<strong>Warning:</strong> {share}" in page.read_text()
    two, study = Results.read(out).summary[:2], Results.read(out).study
    few = store_results(tmp_path / "few", study, two, state="interrupted")
    with pytest.raises(InputError, match=r"unfinished: .* and no draw that every variant has"):
        report.print_reports([few], console)
