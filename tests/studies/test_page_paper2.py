import math
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.stored_results import store_results

from docs.studies.loops.runs import limits_of
from docs.studies.paper2 import page as paper2
from sinsjax import analysis
from sinsjax.execution.source import Source
from sinsjax.methods.compass import design as loops
from sinsjax.study.load import load_study, select_variant, study_from_dict

CONFIGS = Path(__file__).parents[2] / "configs"
DRAWS = 4
K3_CASE = "Scheme 1, K3 as printed"


@pytest.fixture(autouse=True)
def _not_drawn(monkeypatch):
    monkeypatch.setattr("sinsjax.plots.render_png", lambda *_: b"not drawn")


def study_of(base: str, **changes):
    """A study of the page with few draws; ``changes`` replace whole sections."""
    data = tomllib.loads((CONFIGS / f"paper2_{base}.toml").read_text())
    data["study"]["draws"] = DRAWS
    return study_from_dict(data | changes)


def summary_of(study, errors):
    """A summary that no engine made: ``errors`` (deg) of every run as pitch, roll, heading."""
    count = study.n_variants * DRAWS
    run = np.arange(count)
    floors = [limits_of(select_variant(study, v)).u for v in range(study.n_variants)]
    columns = {
        "run_id": run,
        "draw_id": run // study.n_variants,
        "variant_id": run % study.n_variants,
        "floor_arcmin": np.tile(floors, DRAWS),
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
    return store_results(directory, study, summary, curves_of(study, **shape) if curves else None)


def variant_of(study, label, drift=0.02):
    values = study.variant_values()
    points = list(zip(values["case"], values["gyro_bias_deg_per_h"], strict=True))
    return points.index((label, drift))


# --- the studies --------------------------------------------------------------------------------


def test_paper2_configs_match_printed_conditions():
    static, swing = (load_study(CONFIGS / f"paper2_{base}.toml") for base in ("static", "swing"))
    for study, name in ((static, "static"), (swing, "swing")):
        assert study.name == f"paper2_{name}"
        assert (study.duration_s, study.rate_hz) == (600.0, 200.0)
        assert study.study.window_s == (550.0, 600.0) and study.n_draws >= 256
        assert study.earth.latitude_deg == 32.057313
        assert set(study.values("gyro_bias_deg_per_h")) == {0.02, 0.006}
        assert study.sensors.gyro_noise_deg_per_h == 0.006
        assert (study.sensors.accel_bias_ug, study.sensors.accel_noise_ug) == (50.0, 50.0)
        assert set(study.values("stored_s")) == {600.0, 80.0}
    motion = swing.motion
    for angle, size, hertz in (("pitch", 8.0, 0.15), ("roll", 6.0, 0.2), ("yaw", 5.0, 0.125)):
        assert getattr(motion, f"{angle}_amplitude_deg") == size
        assert 1 / getattr(motion, f"{angle}_period_s") == pytest.approx(hertz, rel=1e-12)
    same = {"study": {"name", "curves"}, "motion": True, "cases": True}
    assert static.model_dump(exclude=same) == swing.model_dump(exclude=same)
    assert all(case in static.cases for case in swing.cases)


def test_level_gains_follow_formula_except_printed_k3():
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


def test_page_errors_are_minus_phi(tmp_path):
    study = study_of("static")
    source = Source.read(write(tmp_path, study))
    case = paper2.cases_of(source)[0]
    assert (case.scheme, case.drift) == (1, 0.02)
    assert (case["case"], case.name) == ("Scheme 1, level 150 s", "level 150 s")
    phi = analysis.numeric_column(case.rows, "phi_u_mean_arcmin")
    np.testing.assert_allclose(case.means("heading"), -phi / 60)
    assert case.heading[1].shape == (DRAWS, 300)
    np.testing.assert_allclose(case.from_floor(551.0), 0.1 - case.limit)
