"""`sinsjax.tune` returns the best point and its objective on draws not used for tuning."""

from pathlib import Path

import pytest
import tomli_w
from support.studies import small_study

import sinsjax
from sinsjax.study.load import load_study

pytestmark = pytest.mark.optimised(False)


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> sinsjax.TuningResults:
    variables = {"p0_yaw_deg": {"candidates": [0.01, 80.0]}}
    tune = {"searches": ["grid"], "tune_draws": 2, "evaluation_draws": 8, "variables": variables}
    tune |= {"objective": "final_error", "baseline": {"p0_yaw_deg": 0.01}}
    return sinsjax.tune(small_study(tune=tune), tmp_path_factory.mktemp("tuned") / "out")


def test_tune_returns_the_best_point_and_the_study_with_it(tuned: sinsjax.TuningResults) -> None:
    assert tuned.best == {"p0_yaw_deg": 80.0} and tuned.search == "grid"
    assert tuned.study.filter.p0_yaw_deg == 80.0 and tuned.study.tune is None
    assert tuned.study == load_study(tuned.directory / "tuned.toml")
    assert tuned.study.seed == small_study().seed + 2  # the evaluation has the next one


def test_tune_returns_objectives_on_fresh_draws(tuned: sinsjax.TuningResults) -> None:
    summary = sinsjax.read_summary(tuned.directory / "evaluation")
    errors = {key: [] for key in ("grid", "baseline")}
    for row in summary.to_pylist():
        errors[row["case"]].append(row["phi_u_arcmin"])
    rms = {key: (sum(x * x for x in values) / len(values)) ** 0.5 for key, values in errors.items()}
    assert tuned.score.value == pytest.approx(rms["grid"])
    assert tuned.baseline.value == pytest.approx(rms["baseline"]) and tuned.baseline.n == 8
    assert tuned.score.low < tuned.score.value < tuned.score.high < tuned.baseline.low
    assert "arcmin" in tuned.objective


def test_tune_takes_a_file_and_names_it_in_manifests(tmp_path: Path) -> None:
    variables = {"p0_yaw_deg": {"candidates": [20.0, 80.0]}}
    tune = {"searches": ["grid"], "tune_draws": 2, "evaluation_draws": 2, "variables": variables}
    (tmp_path / "mine.toml").write_text(tomli_w.dumps(small_study(tune=tune).to_dict()))
    assert sinsjax.tune(tmp_path / "mine.toml", tmp_path / "out").study.n_draws == 3
    assert sinsjax.read_manifest(tmp_path / "out" / "grid")["config"] == "mine.toml"
