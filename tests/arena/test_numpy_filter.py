"""A filter of plain NumPy as a program outside sinsjax."""

from pathlib import Path

import numpy as np
import pytest

import sinsjax
from sinsjax.arena.export import export_study
from sinsjax.arena.score import score_results
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

ROOT = Path(__file__).parents[2]


def short_study() -> Study:
    """The study of the page, with two draws of 20 s and its first method."""
    tables = sinsjax.load_study("arena").to_dict()
    tables["study"] |= {"duration_s": 20.0, "window_s": [10.0, 20.0], "draws": 2}
    tables["study"]["report_times_s"] = [10.0]
    return sinsjax.study_from_dict(tables | {"cases": tables["cases"][:1]})


@pytest.fixture
def draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return export_study(short_study(), tmp_path / "draws", format="psins")


@pytest.mark.nightly
def test_numpy_filter_finds_north_and_is_scored(draws: Path) -> None:
    script = ROOT / "docs" / "studies" / "comparison" / "numpy_filter.py"
    text = script.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 61 and "sinsjax" not in text.split('"""')[2]
    names: dict[str, object] = {"__name__": "filter"}
    exec(compile(text, str(script), "exec"), names)
    names["main"](draws, "results.csv")  # type: ignore[operator]
    score = score_results(draws, "results.csv", name="numpy filter")
    assert score.missing == [] and score.warnings == []
    rows = sinsjax.read_summary(score.directory).to_pandas()
    ours = rows[rows["method"] == "numpy filter"]["phi_u_arcmin"].to_numpy()
    own = rows[rows["case"] == "kalman5"]["phi_u_arcmin"].to_numpy()
    # The same filter and noise, but for the order of integration and feedback.
    np.testing.assert_allclose(ours, own, rtol=0.1)
    assert np.median(np.abs(ours)) < 1500  # from 30 and 80 deg, after 20 s
