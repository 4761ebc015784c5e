import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.stored import store, told

from sinsjax import analysis
from sinsjax.alignment.compass import design as loops
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.errors import InputError
from sinsjax.report import paper2, paper2_loops
from sinsjax.report.base import Source
from sinsjax.report.linear import heading_from_limit, limits_of, loops_of, one_variant
from sinsjax.study.load import load_study, study_from_dict

CONFIGS = Path(__file__).parents[2] / "configs"
DRAWS = 4
K3_CASE = "Scheme 1, K3 as printed"


@pytest.fixture(autouse=True)
def _not_drawn(monkeypatch):
    monkeypatch.setattr("sinsjax.plots.png", lambda *_: b"not drawn")


def study_of(base: str, **changes):
    """A study of the page with few draws; ``changes`` replace whole sections."""
    data = tomllib.loads((CONFIGS / f"paper2_{base}.toml").read_text())
    data["study"]["draws"] = DRAWS
    return study_from_dict(data | changes)


def summary_of(study, errors):
    """A summary that no engine made: ``errors`` (deg) of every run as pitch, roll, heading."""
    count = study.n_variants * DRAWS
    run = np.arange(count)
    floors = [limits_of(one_variant(study, v)).heading for v in range(study.n_variants)]
    columns = {
        "run_id": run,
        "draw_id": run // study.n_variants,
        "variant_id": run % study.n_variants,
        "floor_arcmin": -60 * np.tile(floors, DRAWS),
        "status": ["diverged"] * count,
    }
    for column, axis in enumerate("enu"):
        columns[f"phi_{axis}_mean_arcmin"] = -60 * errors[:, column]
        columns[f"phi_{axis}_std_arcmin"] = np.full(count, 0.6)
    for band in study.study.settle_bands_arcmin:
        columns[f"settle_{band:g}_s"] = np.where(run // study.n_variants, 100.0, np.nan)
    return pa.table(columns)


def curves_of(study, error=lambda variant, time: 0.1 + 0 * time):
    """Curves with the same error (deg) of all angles in all draws of a variant."""
    time = np.arange(1, study.records + 1) * study.study.record_interval_s
    runs = np.arange(study.n_variants * DRAWS)
    values = np.concatenate([-60.0 * error(int(run) % study.n_variants, time) for run in runs])
    columns = {"run_id": np.repeat(runs, time.size), "time_s": np.tile(time, runs.size)}
    return pa.table(columns | {f"phi_{axis}_arcmin": values for axis in "enu"})


def write(directory, study, errors=None, curves=True, **shape):
    count = study.n_variants * DRAWS
    noise = np.random.default_rng(3).normal(size=(count, 3))
    summary = summary_of(study, noise if errors is None else errors)
    return store(directory, study, summary, curves_of(study, **shape) if curves else None)


def variant_of(study, label, drift=0.02):
    values = study.variant_values()
    points = list(zip(values["case"], values["gyro_bias_deg_per_h"], strict=True))
    return points.index((label, drift))


# --- the studies --------------------------------------------------------------------------------


def test_the_configs_are_what_the_paper_prints():
    static, swing = (load_study(CONFIGS / f"paper2_{base}.toml") for base in ("static", "swing"))
    for study, name in ((static, "static"), (swing, "swing")):
        assert (study.name, study.report.layout) == (f"paper2_{name}", "paper2")
        assert (study.duration_s, study.rate_hz) == (600.0, 200.0)
        assert study.study.window_s == (550.0, 600.0) and study.n_draws >= 256
        assert study.earth.latitude_deg == 32.057313
        assert set(study.values("gyro_bias_deg_per_h")) == {0.02, 0.006}
        assert study.sensors.gyro_noise_deg_per_h == 0.006
        assert (study.sensors.accel_bias_ug, study.sensors.accel_noise_ug) == (50.0, 50.0)
        assert set(study.values("tape_s")) == {600.0, 80.0}
    motion = swing.motion
    for angle, size, hertz in (("pitch", 8.0, 0.15), ("roll", 6.0, 0.2), ("yaw", 5.0, 0.125)):
        assert getattr(motion, f"{angle}_amplitude_deg") == size
        assert 1 / getattr(motion, f"{angle}_period_s") == pytest.approx(hertz, rel=1e-12)
    same = {"study": {"name", "curves"}, "motion": True, "cases": True}
    assert static.model_dump(exclude=same) == swing.model_dump(exclude=same)
    assert all(case in static.cases for case in swing.cases)


def test_levelling_gains_are_the_formulas_but_for_the_printed_k3():
    formula = loops.level_gains(0.02, math.sqrt(0.5), gravity=9.8, radius=6378165.0)
    study = load_study(CONFIGS / "paper2_static.toml")
    for case in study.cases:
        unlike = case["case"] == K3_CASE
        expected = formula._replace(k3=0.000081632653) if unlike else formula
        np.testing.assert_allclose(case["level_gains"], expected, rtol=1e-11)
        assert case["allow_unstable"] == unlike
        signs = {np.sign(case[f"phi_{axis}0_deg"]) for axis in "enu"}
        assert signs == ({1.0} if "errors negative" in case["case"] else {-1.0})


# --- the layout ---------------------------------------------------------------------------------


def test_the_table_holds_the_errors_beside_the_printed_ones(tmp_path):
    study = study_of("static")
    errors = np.random.default_rng(1).normal(size=(study.n_variants * DRAWS, 3))
    text = told(write(tmp_path, study, errors))
    table = text.partition("Table 1")[2].partition("Number [")[0]
    assert "0.00261" in table and "-0.00208" in table and "0.0236" in table
    variant = variant_of(study, "Scheme 2, V flipped", 0.006)
    row = next(
        line
        for line in table.splitlines()
        if line.startswith(" Scheme 2, V flipped  ") and "0.006" in line
    )
    means = analysis.mean(errors[variant :: study.n_variants, 2])
    assert format_estimate(means, digits=4) in row
    assert format_estimate(analysis.mean(errors[variant :: study.n_variants, 0]), digits=5) in row
    assert "0.0252" in row  # the limit with 0.006 deg/h
    assert "0.0100 [0.0100, 0.0100]" in row  # 0.6 arcmin inside the window
    assert K3_CASE not in table


def test_figures_of_one_directory(tmp_path):
    told(write(tmp_path, study_of("static")))
    names = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert names == {"fig3", "fig4", "turns", "k3"}


def test_a_page_of_both_bases(tmp_path):
    places = [write(tmp_path / base, study_of(base)) for base in ("static", "swing")]
    page = tmp_path / "docs" / "paper2.md"
    told(*places, page=page)
    text = page.read_text()
    assert text.splitlines()[0].count("paper2_static.toml") == 1
    assert "# Paper 2, reproduced" in text and str(tmp_path) not in text
    assert "Not on this page" not in text
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings[0] == "## Static base: Figs 3 and 4, Table 1"
    assert headings[1] == "## Swing base: Figs 5 and 6, Table 2"
    assert "## Static and swing base" in headings
    assert headings[-2:] == ["## The printed gains", "## What the words mean"]
    names = {path.name for path in (page.parent / "figures").iterdir()}
    assert names == {
        *(f"paper2_static_{name}.png" for name in ("fig3", "fig4", "turns", "k3")),
        *(f"paper2_swing_{name}.png" for name in ("fig5", "fig6")),
    }


def test_bases_are_compared_on_the_same_noise(tmp_path):
    static, swing = study_of("static"), study_of("swing")
    errors = np.random.default_rng(2).normal(size=(static.n_variants * DRAWS, 3))
    moved = np.empty((swing.n_variants * DRAWS, 3))
    for variant, case in enumerate(swing.variant_values()["case"]):
        drift = swing.values("gyro_bias_deg_per_h")[variant]
        here = errors[variant_of(static, case, drift) :: static.n_variants]
        moved[variant :: swing.n_variants] = here + [0.1, 0.2, 0.3]
    text = told(write(tmp_path / "a", static, errors), write(tmp_path / "b", swing, moved))
    table = text.partition("Mean error of paper2_swing minus")[2]
    row = next(line for line in table.splitlines() if line.startswith(" Scheme 2, reflected"))
    assert "0.100000 [0.100000, 0.100000]" in row
    assert "0.30000 [0.30000, 0.30000]" in row
    assert "0.3000 to 0.3000 deg apart" in text


def test_the_drift_behind_the_printed_heading(tmp_path):
    text = told(write(tmp_path, study_of("static")))
    omega_n = math.radians(15.041067) * math.cos(math.radians(32.057313))  # rad/h
    second = math.degrees(50e-6) * math.tan(math.radians(32.057313))
    drift = math.degrees(math.radians(0.0251 + second) * omega_n)
    assert drift == pytest.approx(0.006, abs=2e-5)
    assert f"drifts of {drift:.4f} and" in text
    assert f"{math.radians(0.00261) * 1e6:.1f}" == "45.6" and "45.6" in text


def test_a_run_that_is_not_settled(tmp_path):
    study = study_of("static")
    shape = lambda variant, time: time / 1000  # noqa: E731
    text = told(write(tmp_path, study, error=shape))
    assert "still moves by 0.050 to 0.050 deg" in text
    table = text.partition("Heading error from its limit, gyro drift")[2]
    row = next(line for line in table.splitlines() if line.startswith(" Scheme 1, level 150 s  "))
    at = 0.55 - limits_of(one_variant(study, 0)).heading
    assert format_estimate(Estimate(at, at, at, DRAWS), digits=4) in row
    assert "75 [" in row  # all draws but the first


def test_a_turn_and_its_predicted_factor(tmp_path):
    study = study_of("static")

    def halving(variant, time):
        limit = limits_of(one_variant(study, variant)).heading
        return limit + 2.0 ** (-time / 160)

    text = told(write(tmp_path, study, error=halving))
    table = text.partition("What a cycle of one reversed")[2]
    row = next(line for line in table.splitlines() if line.startswith(" V flipped"))
    assert "0.9930" in row and "0.5000 [0.5000, 0.5000]" in row and "0.80" in row
    row = next(line for line in table.splitlines() if line.startswith(" reflected"))
    assert f"{math.exp(-1.6):.4f}" in row  # an exact turn; what is made leaves somewhat more
    factor = float(re.search(r"reflected (0\.\d+), so that half of it is gone", text)[1])
    assert math.exp(-1.6) < factor < 0.4
    assert "flipped 1.0103, so that it doubles after 3.0 h" in text


def test_growth_by_the_printed_k3(tmp_path):
    study = study_of("static")
    unstable = one_variant(study, variant_of(study, K3_CASE))
    model = loops_of(unstable)
    root = loops.roots(loops.level_polynomial(model.params.level, **model.earth))[0]
    assert root == pytest.approx(0.0254 + 0.0811j, abs=5e-5)

    def growing(variant, time):
        limits = limits_of(one_variant(study, variant))
        return limits.pitch + 1e-3 * (np.exp(root * time)).real

    source = Source.read(write(tmp_path, study, error=growing))
    case = next(c for c in paper2.cases_of(source) if c.label == K3_CASE)
    curves = paper2.curves_of(source, [case])[0]
    period = 2 * math.pi / root.imag
    found = paper2_loops._growth(case, curves, "pitch", period, 150.0)
    assert found == pytest.approx(math.exp(root.real * period), rel=1e-2)
    assert "multiply a tilt by 7.1" in told(tmp_path)


def test_a_study_that_the_layout_cannot_show(tmp_path):
    study = study_of("static", cases=[{"tape_s": 600.0}, {"tape_s": 80.0}])
    with pytest.raises(InputError, match="layout 'paper2' needs"):
        told(write(tmp_path, study))


def test_curves_are_needed(tmp_path):
    with pytest.raises(InputError, match="needs curves"):
        told(write(tmp_path, study_of("static"), curves=False))


def test_a_study_with_less_in_it_says_less(tmp_path):
    study = study_of("swing")
    cases = [dict(case) for case in study.cases if "Scheme 1" in case["case"]]
    text = told(write(tmp_path, study_of("swing", cases=cases)))
    assert "Table 2" in text and "Not settled" in text
    assert "a cycle" not in text and "printed K3 the levelling" not in text
    names = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert names == {"fig5"}


def test_the_reading_of_the_initial_errors_is_compared(tmp_path):
    study = study_of("static")
    errors = np.random.default_rng(2).normal(size=(study.n_variants * DRAWS, 3))
    text = told(write(tmp_path, study, errors))
    means = [
        analysis.mean(errors[variant_of(study, label) :: study.n_variants, 2]).value
        for label in ("Scheme 2, V flipped", "Scheme 2, V flipped, Euler angles")
    ]
    said = f"V flipped would end at {means[1]:.4f} instead of {means[0]:.4f} deg"
    assert said in text
    labels = {case.label for case in paper2.cases_of(Source.read(tmp_path))}
    assert "Scheme 2, V flipped" in labels and not any("Euler" in one for one in labels)


def test_errors_are_minus_phi(tmp_path):
    study = study_of("static")
    source = Source.read(write(tmp_path, study))
    case = paper2.cases_of(source)[0]
    assert case.starts_as_stated and case.is_stable and case.scheme == 1
    assert (case.label, case.name) == ("Scheme 1, level 150 s", "level 150 s")
    phi = analysis.numbers(case.rows, "phi_u_mean_arcmin")
    np.testing.assert_allclose(case.mean_errors("heading"), -phi / 60)
    curves = paper2.curves_of(source, [case])[0]
    assert curves.errors["roll"].shape == (DRAWS, 300)
    np.testing.assert_allclose(curves.at("heading", 551.0), 0.1)


def test_linear_loops_start_at_the_stated_error():
    one = one_variant(study_of("static"), 0)
    before = heading_from_limit(one, np.array([2.0, 150.0]))
    np.testing.assert_allclose(before, 1.5 - limits_of(one).heading, rtol=1e-9)
