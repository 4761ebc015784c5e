import subprocess
import sys

import numpy as np
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


def results_of(study, **columns):
    """Results in memory: synthetic ones, with some columns given."""
    return Results(study, None, tables={"summary": synthetic_summary(study, **columns)})


def test_table_shows_success_settling_and_heading_statistics():
    study = small_study(study={"draws": 40}, axes={"phi_u0_deg": [0.0, 30.0]})
    settle = np.where(np.arange(80) % 4 == 1, np.nan, 20.0 + np.arange(80))
    ok = np.where(np.isnan(settle), "not_settled", "ok")
    source = results_of(study, settle_10_s=settle, status=list(ok))
    _, row = report.monte_carlo.statistics_table(source, study.keys_shown, "").rows
    share, median = analysis.proportion(20, 40), analysis.quantile(settle[1::2])
    error = analysis.rms(source.summary["phi_u_arcmin"].to_numpy()[1::2])
    cells = [format_percent(share), analysis.format_estimate(median, digits=0)]
    assert row[:6] == ["30", "40", cells[0], cells[0], cells[1], cells[1]]
    assert row[6] == analysis.format_estimate(error)
    pooled = format_percent(analysis.share(ok == "ok", np.repeat(np.arange(40), 2)))
    assert f"{pooled} % of the runs" in build_report(source).facts[1].text


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
def test_variants_are_compared_with_first_of_same_conditions_on_same_noise(axes):
    """From 30 deg every run settles 100 s later, and a second reset 7 s later."""
    axes = axes | {"phi_u0_deg": [0.0, 30.0]}
    study = small_study(study={"draws": 40}, axes=axes, resets={"reset_cycle_s": 1.0})
    later = [0.0, 100.0, 7.0, 107.0][: study.n_variants]
    settle = 50.0 + np.add.outer(np.arange(40.0), later).ravel()
    status = ["ok"] * (len(settle) - 1) + ["diverged"]
    source = results_of(study, settle_10_s=settle, status=status)
    table = report.monte_carlo.first_variant_comparison_table(source)
    assert ("variants also differ from it in phi_u0_deg" in table.note) == (study.n_variants == 2)
    if study.n_variants == 4:
        title = "Against number of resets 1 with the same phi_u0_deg, on the same noise"
        assert table.title == title and [row[:2] for row in table.rows] == [["2", "0"], ["2", "30"]]
        assert all("7 [7, 7]" in row for row in table.rows)
        return
    (row,) = table.rows
    share = analysis.proportion_difference(np.arange(40) < 39, np.full(40, True))
    yaw = np.abs(source.summary["phi_u_mean_arcmin"].to_numpy() - FLOOR)
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
    data = {
        "study": {"duration_s": 6.0, "rate_hz": 100.0, "window_s": [2, 6], "name": "car"},
        "earth": {"latitude_deg": 34.0},
        "record": {"format": "psins", "start_s": [0.0, 10.0, 20.0]},
    }
    study = study_from_dict(with_paper_values(data))
    summary = synthetic_summary(study, truth=False, yaw_deg=[-90.1234, 1.0, 2.0])
    curves = synthetic_curves(study, truth=False)
    text = report_text(store_results(tmp_path, study, summary, curves))
    assert "-90.1234" in text and "sigma_u_arcmin" in text and " within 10' of " not in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"attitude.png"}


def test_headings_too_far_east_are_not_within_the_band_at_the_end():
    study = small_study(study={"judged_from": "floor"}, axes={"phi_u0_deg": [0.0, 30.0]})
    source = results_of(study)
    assert (source.summary["phi_u_arcmin"].to_numpy() < -20).all()
    texts = [fact.text for fact in build_report(source).facts]
    assert any("every heading error from 0 to 30 deg settles" in text for text in texts)
    assert any(text.endswith(", 0 [0, 71] % of north") for text in texts)


def test_heading_error_table_shows_rms_and_quantile_per_time():
    """Headings to the left and right do not cancel."""
    size, sign = np.linspace(200.0, 400.0, 64), np.tile([1.0, -1.0], 32)
    study = small_study(study={"draws": 64, "report_times_s": [3]})
    errors = {"phi_u_arcmin": sign * size, "phi_u_at_3_arcmin": 2 * sign * size}
    table = report.monte_carlo.heading_error_table(results_of(study, **errors), [], "Heading error")
    rms, q90 = np.sqrt(np.mean(size**2)), np.sort(size)[57]
    for row, at, factor in zip(table.rows, ("3 s", "the end"), (2, 1), strict=True):
        assert row[:2] == ["64", at] and row[2].startswith(f"{factor * rms:.0f} [")
        assert row[3].startswith(f"{factor * q90:.0f} [")
    few = results_of(small_study(study={"draws": 16}))
    note = report.monte_carlo.heading_error_table(few, [], "Heading error").note
    assert "'few draws': too few to bound it" in note


def test_impossible_covariance_of_plugin_is_a_caution(monkeypatch):
    sigma = {f"sigma_{axis}_arcmin": np.ones(4) for axis in "en"}
    sigma["sigma_u_arcmin"] = np.array([1.0, np.nan, 1.0, np.nan])
    status = ["ok", "ok", "ok", "nonfinite"]
    study, nees = small_study(study={"draws": 4}), np.array([3.0, 3, -1, np.nan])
    source = results_of(study, status=status, nees=nees, **sigma)
    assert not [*covariance_cautions(source)]
    monkeypatch.setitem(registry.PACKAGES, "kalman5", ("bringing", "1.1"))
    (fact,) = covariance_cautions(source)
    line = "the covariance of kalman5 is negative or not finite at the end of 2 of 3 runs"
    assert fact.is_caution and fact.text == line and fact in build_report(source).facts


@pytest.mark.parametrize(
    ("biases", "nis_u", "title"),
    [
        ({"accel_bias_ug": 500.0}, 1.0, "Mean NEES of the heading, from the bias floor: 1"),
        ({"accel_bias_ug": 500.0}, np.nan, None),  # without a floor there is no such figure
        (UNBIASED, 1.0, "Mean NEES 9"),
    ],
)
def test_consistency_with_unmodelled_biases_counts_from_bias_floor(biases, nis_u, title):
    study = small_study(study={"draws": 8}, axes={"phi_u0_deg": [0.0, 30.0]}, sensors=biases)
    source = results_of(study, nees=np.full(16, 9.0), nis_u=np.full(16, nis_u))
    pictures = [b for b in consistency_blocks(source) if isinstance(b, base.Picture)]
    assert len(pictures) == (title is not None)
    for picture in pictures:
        assert picture.figure.get_suptitle().startswith(title)
        assert ("heading error from the bias floor" in picture.caption) == ("floor" in title)


@pytest.mark.parametrize(("method", "explains"), [("kalman5", True), ("kalman10", False)])
def test_drawn_unmodelled_biases_explain_high_nees(method, explains):
    study = small_study(
        study={"draws": 8},
        drawn={"gyro_bias_deg_per_h": {"normal": [0.0, 0.5]}},
        alignment={"method": method},
        sensors={"accel_bias_ug": 0.0, "gyro_bias_deg_per_h": None},
    )
    runs = {"floor_arcmin": -12.0, "phi_u_arcmin": 13.5, "sigma_u_arcmin": 5.0, "nees": 1.8e4}
    columns = {name: np.full(8, number) for name, number in runs.items()}
    biases = [[0.0, 0.3, -0.7512]] * 8
    source = results_of(study, gyro_bias_deg_per_h=biases, **columns)
    text = " ".join(block for block in consistency_blocks(source) if isinstance(block, str))
    for part in (
        "A NEES of 3 cannot be expected here",
        "gyros up to 0.751 deg/h, accelerometers up to 0 ug",
        "in quadrature: 13.0 arcmin. The heading errors found are 13.5",
    ):
        assert (part in text) == explains


def test_stopped_study_reports_reason_for_stopping(tmp_path):
    """The reason follows from the rows alone, with the numbers of the rule."""
    rule = {"statistic": "success_rate", "half_width": 0.9}
    study = small_study(study={"draws": 100}, stop_when=rule)
    summary = synthetic_summary(study).slice(0, 64)
    source = Results.read(store_results(tmp_path, study, summary, state="complete"))
    (why,) = (fact.text for fact in build_report(source).facts if fact.label == "Stopped")
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
