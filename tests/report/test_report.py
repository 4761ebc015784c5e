import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from support.stored_results import report_text, store_results
from support.studies import small_study, with_paper_values
from support.synthetic_tables import FLOOR, synthetic_curves, synthetic_summary

from sinsjax import analysis, report
from sinsjax.analysis.formats import format_percent
from sinsjax.execution.results import Results
from sinsjax.methods import registry
from sinsjax.report import axis_figures, base
from sinsjax.report.consistency import consistency_blocks, covariance_cautions
from sinsjax.report.monte_carlo import build_report
from sinsjax.study.load import study_from_dict

pytestmark = [pytest.mark.usefixtures("drawn_on_request"), pytest.mark.optimised(False)]


UNBIASED = {"accel_bias_ug": 0.0, "gyro_bias_deg_per_h": 0.0}


def recorded_study(**changes):
    data = {
        "study": {"duration_s": 6.0, "rate_hz": 100.0, "window_s": [2, 6], "name": "car"},
        "earth": {"latitude_deg": 34.0},
        "record": {"format": "psins", "start_s": [0.0, 10.0, 20.0]},
        **changes,
    }
    return study_from_dict(with_paper_values(data))


def test_table_shows_success_settling_and_heading_statistics(tmp_path):
    study = small_study(study={"draws": 40}, axes={"phi_u0_deg": [0.0, 30.0]})
    settle = np.where(np.arange(80) % 4 == 1, np.nan, 20.0 + np.arange(80))
    ok = np.where(np.isnan(settle), "not_settled", "ok")
    summary = synthetic_summary(study, settle_10_s=settle, status=list(ok))
    text = report_text(store_results(tmp_path, study, summary))
    rows = summary.filter(summary["phi_u0_deg"].combine_chunks().cast(pa.int64()).to_numpy() == 30)
    share = analysis.proportion(rows["status"].to_pylist().count("ok"), 40)
    median = analysis.quantile(rows["settle_10_s"].to_numpy())
    error = analysis.rms(rows["phi_u_arcmin"].to_numpy())
    most = analysis.quantile(np.abs(rows["phi_u_arcmin"].to_numpy()), 0.9)
    for cell in (
        f"{100 * share.value:.0f} [{100 * share.low:.0f}, {100 * share.high:.0f}]",
        analysis.format_estimate(median, digits=0),
        analysis.format_estimate(error),
        analysis.format_estimate(most),
    ):
        assert cell in text
    assert (
        f"{format_percent(analysis.share(ok == 'ok', np.repeat(np.arange(40), 2)))} % of the runs"
        in text
    )


def test_pooled_variants_have_intervals_counted_by_draws(tmp_path):
    axes = {"reset_count": [0, 1, 2], "reset_cycle_s": [1.0, 2.0], "phi_u0_deg": [0, 5, 10, 20]}
    study = small_study(axes=axes, resets={})
    text = report_text(store_results(tmp_path, study, synthetic_summary(study)))
    assert "study: 72 runs (60 distinct), none failed" in text
    assert "24 variants: each table has one key" in text
    assert "4 of the 24 variants repeat another one, because reset_cycle_s has no effect" in text
    assert "count repeated variants once: 60 of 72 runs." in text
    table = text.partition("By reset_count")[2].partition("By reset_cycle_s")[0]
    assert [line.split()[:2] for line in table.splitlines()[5:8]] == [
        ["0", "12"],  # no cycle acts without resets
        ["1", "24"],
        ["2", "24"],
    ]
    # 3 draws of 8 variants per row, all of which end well: as 3 runs, 0.025 ** (1 / 3).
    assert table.count("100 [29, 100]") == 6  # from the truth and from the bias floor
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {
        "settling_time",
        "settling_time_floor",
        "consistency",
    }


@pytest.mark.parametrize("axes", [{}, {"reset_count": [1, 2]}])
def test_variants_are_compared_with_first_of_same_conditions_on_same_noise(tmp_path, axes):
    """From 30 deg every run settles 100 s later, and a second reset 7 s later."""
    axes = axes | {"phi_u0_deg": [0.0, 30.0]}
    study = small_study(study={"draws": 40}, axes=axes, resets={"reset_cycle_s": 1.0})
    later = [0.0, 100.0, 7.0, 107.0][: study.n_variants]
    settle = 50.0 + np.add.outer(np.arange(40.0), later).ravel()
    status = ["ok"] * (len(settle) - 1) + ["diverged"]
    summary = synthetic_summary(study, settle_10_s=settle, status=status)
    source = Results(study, None, tables={"summary": summary})
    table = report.monte_carlo.first_variant_comparison_table(source)
    is_mixed = study.n_variants == 2
    assert (
        "is a reference only: variants also differ from it in phi_u0_deg" in table.note
    ) == is_mixed
    if not is_mixed:
        title = "Against number of resets 1 with the same phi_u0_deg, on the same noise"
        assert table.title == title and [row[:2] for row in table.rows] == [["2", "0"], ["2", "30"]]
        assert all("7 [7, 7]" in row for row in table.rows)
        return
    (row,) = table.rows
    share = analysis.proportion_difference(np.arange(40) < 39, np.full(40, True))
    yaw = np.abs(summary["phi_u_mean_arcmin"].to_numpy() - FLOOR)
    error = analysis.format_estimate(analysis.mean_difference(yaw[1::2], yaw[::2]))
    assert table.title == "Against initial heading error 0 deg, on the same noise"
    assert row[0] == "30" and {"100 [100, 100]", format_percent(share), error} <= {*row}


def test_zipped_axes_are_plotted_as_one_axis(tmp_path):
    level = {"phi_e0_deg": [0.0, 5.0, 10.0], "phi_n0_deg": [0.0, 5.0, 5.0]}
    study = small_study(axes={"level": level, "phi_u0_deg": [0.0, 30.0]})
    assert study.axes_shown == {("phi_e0_deg",): (0.0, 5.0, 10.0), ("phi_u0_deg",): (0.0, 30.0)}
    settle = np.tile([10.0, 20.0, 30.0, 40.0, 50.0, 60.0], 3)
    source = Results(
        study,
        None,
        tables={"summary": synthetic_summary(study, settle_10_s=settle)},
        directory=tmp_path,
    )
    blocks = {block.name: block for block in axis_figures.build_axis_figures(source)}
    axes = blocks["settling_time"].figure.axes[0]
    assert (axes.get_ylabel(), axes.get_xlabel()) == (
        "initial level error about east (deg)",
        "initial heading error (deg)",
    )
    np.testing.assert_allclose(axes.get_images()[0].get_array(), settle[:6].reshape(3, 2))


def test_misalignment_figure_is_drawn_from_stored_curves(tmp_path):
    study = small_study(sensors=UNBIASED)
    report_text(store_results(tmp_path, study, synthetic_summary(study), synthetic_curves(study)))
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"misalignment.png", "misalignment_level.png", "consistency.png"}


def test_record_without_reference_reports_attitude_and_sigma(tmp_path):
    study = recorded_study()
    summary = synthetic_summary(study, truth=False, yaw_deg=[-90.1234, 1.0, 2.0])
    text = report_text(
        store_results(tmp_path, study, summary, synthetic_curves(study, truth=False))
    )
    assert "-90.1234" in text and "sigma_u_arcmin" in text and " within 10' of " not in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"attitude.png"}


def test_headings_too_far_east_are_not_within_the_band_at_the_end(tmp_path):
    study = small_study(study={"judged_from": "floor"}, axes={"phi_u0_deg": [0.0, 30.0]})
    summary = synthetic_summary(study)
    assert (summary["phi_u_arcmin"].to_numpy() < -20).all()
    text = report_text(store_results(tmp_path, study, summary))
    assert (
        "every heading error from 0 to 30 deg settles" in text and ", 0 [0, 71] % of north" in text
    )


def test_heading_error_table_shows_rms_and_quantile_per_time(tmp_path):
    """Headings to the left and right do not cancel, and the window mean is not shown."""
    sign = np.tile([1.0, -1.0], 32)
    size = np.linspace(200.0, 400.0, 64)
    study = small_study(study={"draws": 64, "report_times_s": [3]})
    summary = synthetic_summary(
        study, all_columns=True, phi_u_arcmin=sign * size, phi_u_at_3_arcmin=2 * sign * size
    )
    text = report_text(store_results(tmp_path, study, summary))
    table = text.partition("Heading error from true north, arcmin")[2].partition("Every var")[0]
    rms, q90 = np.sqrt(np.mean(size**2)), np.sort(size)[57]
    early, last = (line.split() for line in table.splitlines()[4:6])
    assert early[:4] == ["64", "3", "s", f"{2 * rms:.0f}"] and f"{2 * q90:.0f}" in early
    assert last[:4] == ["64", "the", "end", f"{rms:.0f}"] and f"{q90:.0f}" in last
    assert "unknown" not in table and "window mean" not in text
    few = small_study(study={"draws": 16})
    assert (
        "'few draws': too few to bound it"
        in report.monte_carlo.heading_error_table(
            Results(few, None, tables={"summary": synthetic_summary(few)}),
            [],
            "Heading error",
        ).note
    )


def test_impossible_covariance_of_plugin_is_a_caution(tmp_path, monkeypatch):
    study = small_study(study={"draws": 4})
    sigma = {f"sigma_{axis}_arcmin": np.array([1.0, 1.0, 1.0, 1.0]) for axis in "en"}
    sigma["sigma_u_arcmin"] = np.array([1.0, np.nan, 1.0, np.nan])
    status = ["ok", "ok", "ok", "nonfinite"]
    summary = synthetic_summary(study, status=status, nees=np.array([3.0, 3, -1, np.nan]), **sigma)
    source = Results(study, None, tables={"summary": summary})
    assert not [*covariance_cautions(source)]
    monkeypatch.setitem(registry.PACKAGES, "kalman5", ("bringing", "1.1"))
    (fact,) = covariance_cautions(source)
    line = "the covariance of kalman5 is negative or not finite at the end of 2 of 3 runs"
    assert fact.is_caution and fact.text == line
    facts = build_report(source).facts
    assert fact in facts


@pytest.mark.parametrize(
    ("biases", "nis_u", "title"),
    [
        ({"accel_bias_ug": 500.0}, 1.0, "Mean NEES of the heading, from the bias floor: 1"),
        ({"accel_bias_ug": 500.0}, np.nan, None),  # without a floor there is no such figure
        (UNBIASED, 1.0, "Mean NEES 9"),
    ],
)
def test_consistency_with_unmodelled_biases_counts_from_bias_floor(tmp_path, biases, nis_u, title):
    study = small_study(study={"draws": 8}, axes={"phi_u0_deg": [0.0, 30.0]}, sensors=biases)
    numbers = {"nees": np.full(16, 9.0), "nis_u": np.full(16, nis_u)}
    source = Results(
        study, None, tables={"summary": synthetic_summary(study, **numbers)}, directory=tmp_path
    )
    pictures = [b for b in consistency_blocks(source) if isinstance(b, base.Picture)]
    assert len(pictures) == (title is not None)
    for picture in pictures:
        assert picture.figure.get_suptitle().startswith(title)
        assert ("heading error from the bias floor" in picture.caption) == ("floor" in title)


@pytest.mark.parametrize(("method", "told_of"), [("kalman5", True), ("kalman10", False)])
def test_drawn_unmodelled_biases_explain_high_nees(tmp_path, method, told_of):
    drawn = {"gyro_bias_deg_per_h": {"normal": [0.0, 0.5]}}
    study = small_study(
        study={"draws": 8},
        drawn=drawn,
        alignment={"method": method},
        sensors={"accel_bias_ug": 0.0, "gyro_bias_deg_per_h": None},
    )
    of_filter = {"sigma_u_arcmin": np.full(8, 5.0), "nees": np.full(8, 1.8e4)}
    biases = [[0.0, 0.3, -0.7512]] * 8
    runs = {"floor_arcmin": np.full(8, -12.0), "phi_u_arcmin": np.full(8, 13.5), **of_filter}
    summary = synthetic_summary(study, all_columns=True, gyro_bias_deg_per_h=biases, **runs)
    text = report_text(store_results(tmp_path, study, summary))
    assert ("A NEES of 3 cannot be expected here" in text) == told_of
    assert ("gyros up to 0.751 deg/h, accelerometers up to 0 ug" in text) == told_of
    assert ("in quadrature: 13.0 arcmin. The heading errors found are 13.5" in text) == told_of


def test_stopped_study_reports_reason_for_stopping(tmp_path):
    """The reason follows from the rows alone, with the numbers of the rule."""
    study = small_study(
        study={"draws": 100},
        stop_when={"statistic": "success_rate", "half_width": 0.9},
    )
    summary = synthetic_summary(study).slice(0, 64)
    source = Results.read(store_results(tmp_path, study, summary))
    assert source.draws == 64
    (why,) = (
        fact.text
        for fact in report.monte_carlo.build_report(source).facts
        if fact.label == "Stopped"
    )
    assert "after 64 draws" in why and ", narrow enough" in why and "0.9" in why


def test_report_of_draws_starts_no_backend_of_jax_and_imports_no_statistics(tmp_path):
    study = small_study(axes={"reset_count": [0, 1], "reset_cycle_s": [1.0, 2.0]})
    directory = store_results(tmp_path, study, synthetic_summary(study))
    script = (
        "import sys; import sinsjax.plots; from sinsjax.cli import app;"
        "sinsjax.plots.render_png = lambda *_: b'not drawn'; app(standalone_mode=False);"
        "from jax._src import xla_bridge;"
        "sys.exit(bool(xla_bridge._backends) or 'scipy.stats' in sys.modules)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script, "report", str(directory), "--full"], capture_output=True
    )
    assert not ended.returncode, ended.stderr
    assert (directory / "figures").is_dir()
