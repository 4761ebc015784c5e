"""Tables and figures of a study, of its attitudes, and of unfinished ones."""

import io

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console
from support.commands import run_python
from support.stored_results import report_text, store_results
from support.studies import STILL, small_study, with_paper_values
from support.synthetic_tables import FLOOR, synthetic_curves, synthetic_summary

from sinsjax import analysis, report
from sinsjax.analysis.labels import format_percent
from sinsjax.errors import InputError
from sinsjax.execution import run
from sinsjax.execution.results import Results
from sinsjax.execution.tables import replace_column
from sinsjax.report.monte_carlo import build_report, paired_difference_table, statistics_table
from sinsjax.report.verdict import build_short_report
from sinsjax.study.load import study_from_dict

pytestmark = [pytest.mark.usefixtures("drawn_on_request"), pytest.mark.optimised(False)]

UNBIASED = {"accel_bias_ug": 0.0, "gyro_bias_deg_per_h": 0.0}


def results_of(study, **columns):
    """Results in memory: synthetic ones, with some columns given."""
    return Results(study, None, tables={"summary": synthetic_summary(study, **columns)})


def facts_of(found):
    return {fact.label: fact.text for fact in found.facts}


def variants_of(found):
    (table,) = (table for table in found.tables if table.title == "Every variant")
    return table.rows


def names_of(directory):
    return {path.stem for path in (directory / "figures").iterdir()}


def test_each_key_of_many_variants_has_a_table(tmp_path):
    axes = {"reset_count": [0, 1, 2], "reset_cycle_s": [1.0, 2.0], "phi_u0_deg": [0, 5, 10, 20]}
    study = small_study(axes=axes, resets={})
    text = report_text(store_results(tmp_path, study, synthetic_summary(study)))
    assert "24 variants: each table has one key" in text and "Every variant, by reset_count" in text
    assert names_of(tmp_path) == {"settling_time", "settling_time_floor", "consistency"}


@pytest.mark.parametrize("axes", [{}, {"reset_count": [1, 2]}])
def test_variants_are_compared_with_first_of_same_conditions_on_same_noise(axes):
    """From 30 deg every run settles 100 s later, and a second reset 7 s later."""
    axes = axes | {"phi_u0_deg": [0.0, 30.0]}
    study = small_study(study={"draws": 40}, axes=axes, resets={"reset_cycle_s": 1.0})
    later = [0.0, 100.0, 7.0, 107.0][: study.n_variants]
    settle = 50.0 + np.add.outer(np.arange(40.0), later).ravel()
    status = ["ok"] * (len(settle) - 1) + ["diverged"]
    source = results_of(study, settle_10_s=settle, status=status)
    table = paired_difference_table(source)
    if study.n_variants == 4:
        assert table.title == "Against number of resets 1, on the same noise"
        assert [row[:2] for row in table.rows] == [["2", "0"], ["2", "30"]]
        assert all("7 [7, 7]" in row for row in table.rows)
        return
    (row,) = table.rows
    share = analysis.proportion_difference(np.arange(40) < 39, np.full(40, True))
    yaw = np.abs(source.summary["phi_u_mean_arcmin"].to_numpy() - FLOOR)
    error = analysis.format_estimate(analysis.mean_difference(yaw[1::2], yaw[::2]))
    assert table.title == "Against initial heading error 0 deg, on the same noise"
    assert row[0] == "30" and {"100 [100, 100]", format_percent(share), error} <= {*row}


def test_duplicate_variants_count_once_in_verdict_tables_and_shares():
    """The runs without resets end right, those with one do not: 3 of 12 runs, not 9 of 18."""
    study = small_study(axes={"reset_count": [0, 1], "reset_cycle_s": [1.0, 2.0, 3.0]})
    right = np.tile([True] * 3 + [False] * 3, 3)
    settle_s = np.where(right, 2.0, np.nan)
    columns = {"settle_10_s": settle_s, "settle_10_truth_s": settle_s}
    columns |= {"status": list(np.where(right, "ok", "not_settled"))}
    source = results_of(study, phi_u_arcmin=np.where(right, 1.0, 50.0), **columns)
    found = build_report(source)
    assert found.title == "study: 18 runs (12 distinct), none failed"
    assert facts_of(found)["Best"].startswith("no reset: every run settles")
    keys = [row[:3] for row in variants_of(found)]
    assert keys == [["0", "-", "3"], ["1", "1", "3"], ["1", "2", "3"], ["1", "3", "3"]]
    # A quarter of each of 3 draws: 2.5 % quantiles of Beta(3, 1), of the share and of the rest.
    least = 0.025 ** (1 / 3)
    (row,) = statistics_table(source, []).rows
    ends = f"25 [{100 * least / 4:.0f}, {100 * (1 - 3 * least / 4):.0f}]"
    assert row[0] == "12" and ends in row[1]


def axes_of(name, study, **columns):
    pictures = build_report(results_of(study, **columns), with_tables=False).pictures
    return next(one for one in pictures if one.name == name).figure.axes


def test_zipped_axes_are_plotted_as_one_axis_and_lists_as_categories():
    level = {"phi_e0_deg": [0.0, 5.0, 10.0], "phi_n0_deg": [0.0, 5.0, 5.0]}
    study = small_study(axes={"level": level, "phi_u0_deg": [0.0, 30.0]})
    settle = np.tile([10.0, 20.0, 30.0, 40.0, 50.0, 60.0], 3)
    axes = axes_of("settling_time", study, settle_10_s=settle)[0]
    assert axes.get_ylabel() == "initial level error about east (deg)"
    assert axes.get_xlabel() == "initial heading error (deg)"
    np.testing.assert_allclose(axes.get_images()[0].get_array(), settle[:6].reshape(3, 2))
    study = small_study(study={"draws": 4}, axes={"reset_times_s": [[], [0.5], [0.5, 1.0]]})
    axes = axes_of("along_axis", study)[-1]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["none", "0.5", "0.5, 1"]
    assert axes.get_xlabel() == "resets at (s)"


def test_misalignment_figure_is_drawn_from_stored_curves(tmp_path):
    study = small_study(sensors=UNBIASED)
    report_text(store_results(tmp_path, study, synthetic_summary(study), synthetic_curves(study)))
    assert names_of(tmp_path) == {"misalignment", "misalignment_level", "consistency"}


@pytest.mark.parametrize(
    ("biases", "title"),
    [
        ({"accel_bias_ug": 500.0}, "Mean NEES of the heading, from the bias floor: 1"),
        (UNBIASED, "Mean NEES 9"),
    ],
)
def test_consistency_with_unmodelled_biases_counts_from_bias_floor(biases, title):
    study = small_study(study={"draws": 8}, axes={"phi_u0_deg": [0.0, 30.0]}, sensors=biases)
    source = results_of(study, nees=np.full(16, 9.0), nis_u=np.ones(16))
    pictures = build_report(source, with_tables=False).pictures
    (picture,) = (one for one in pictures if one.name == "consistency")
    assert picture.figure.get_suptitle().startswith(title)
    assert ("P excludes their floor" in picture.caption) == ("floor" in title)


def test_record_without_reference_reports_attitude_and_sigma(tmp_path):
    settings = {"duration_s": 6.0, "rate_hz": 100.0, "window_s": [2, 6]}
    record = {"format": "psins", "start_s": [0.0, 10.0, 20.0]}
    data = {"study": settings, "earth": {"latitude_deg": 34.0}, "record": record}
    study = study_from_dict(with_paper_values(data))
    summary = synthetic_summary(study, truth=False, yaw_deg=[-90.1234, 1.0, 2.0])
    curves = synthetic_curves(study, truth=False)
    text = report_text(store_results(tmp_path, study, summary, curves))
    assert "-90.1234" in text and "sigma_u_arcmin" in text and " within 10' of " not in text
    assert names_of(tmp_path) == {"attitude"}


def run_methods(out, *methods):
    settings = {"curves": True, "report_times_s": [3.0], "draws": 3}
    run.run_into(small_study(study=settings, motion=STILL, axes={"method": [*methods]}), out)
    return Results.read(out)


def test_study_of_level_alone_reports_pitch_and_roll(tmp_path):
    source = run_methods(tmp_path / "out", "level")
    found = build_report(source)
    facts, table = facts_of(found), found.table
    assert facts["Attitude"].startswith("pitch ") and "(1 sigma 17." in facts["Attitude"]
    assert facts["Attitude"].endswith("(last draw)")
    assert facts["Heading"] == "none: level finds pitch and roll alone"
    assert facts["Accuracy"].endswith("' rms from the truth per angle")
    assert table is not None and len(table.rows) == 3 and "unknown" not in str(table.rows)
    assert [picture.name for picture in found.pictures] == ["misalignment_level"]
    nulls = source.summary
    for name in ("pitch_deg", "roll_deg"):
        nulls = replace_column(nulls, name, pa.nulls(nulls.num_rows))
    (fact, *_) = build_short_report(Results(source.study, None, tables={"summary": nulls})).facts
    assert fact.is_caution and fact.text == "unknown, the run is not finite"


@pytest.mark.nightly
def test_method_without_heading_is_reported_next_to_a_filter(tmp_path):
    found = build_report(run_methods(tmp_path / "level", "kalman5", "level"))
    assert facts_of(found)["Others"] == "level: never"
    row = next(row for row in variants_of(found) if row[0] == "level")
    assert row[2].startswith("0") and {"no bias floor", "never", "unknown"} <= {*row}


def test_stopped_study_reports_reason_for_stopping(tmp_path):
    rule = {"statistic": "success_rate", "half_width": 0.9}
    study = small_study(study={"draws": 100}, stop_when=rule)
    store_results(tmp_path, study, synthetic_summary(study).slice(0, 64), state="complete")
    why = facts_of(build_short_report(Results.read(tmp_path)))["Stopped"]
    assert why == "every half-width of success_rate is at most 0.9"


def test_unfinished_report_warns_with_share_of_runs(tmp_path):
    """Of 100 draws and the first variant of another."""
    out, page, console = tmp_path / "out", tmp_path / "page.html", Console(file=io.StringIO())
    study = small_study(study={"draws": 300}, axes={"p0_yaw_deg": [10.0, 40.0, 60.0]})
    out.mkdir()
    summary = synthetic_summary(study).slice(0, 301)
    store_results(out, study, summary, state="interrupted", wall_s=9.0)
    report.print_reports([out], console, page)
    text = " ".join(console.file.getvalue().split())
    assert text.startswith("study: unfinished, 300 of 900 runs in ")
    share = "unfinished: 301 of 900 runs are done"
    assert f"{share}; shown are the 100 draws" in text
    assert f"<strong>Warning:</strong> {share}" in page.read_text()
    few = store_results(tmp_path / "few", study, summary[:2], state="interrupted")
    with pytest.raises(InputError, match=r"unfinished: .* and no draw that every variant has"):
        report.print_reports([few], console)


def test_report_of_draws_starts_no_backend_of_jax_and_imports_no_statistics(tmp_path):
    study = small_study(axes={"reset_count": [0, 1], "reset_cycle_s": [1.0, 2.0]})
    directory = store_results(tmp_path, study, synthetic_summary(study))
    run_python(
        f"import sys; sys.argv[1:] = ['report', {str(directory)!r}, '--full'];"
        "import sinsjax.plots; from sinsjax.cli import app;"
        "sinsjax.plots.render_png = lambda *_: b'not drawn'; app(standalone_mode=False);"
        "from jax._src import xla_bridge;"
        "sys.exit(bool(xla_bridge._backends) or 'scipy.stats' in sys.modules)"
    )
    assert (directory / "figures").is_dir()
