"""Every page of docs/studies from results that no engine made: names exist, all are used."""

import csv
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.stored_results import write_part
from support.synthetic_tables import synthetic_curves, synthetic_summary

from sinsjax.analysis import Estimate
from sinsjax.execution.source import Source
from sinsjax.execution.tasks import Job
from sinsjax.report import study_page, tuning_figures
from sinsjax.report.base import Picture
from sinsjax.study.load import study_from_dict
from sinsjax.tuning import results

ROOT = Path(__file__).parents[2]
PAGES = {
    "car_test": ("car_test", "car_batch"),
    "compass_map": ("paper2_map", "compass_80s_search", "compass_80s_best", "compass_car"),
    "paper2": ("paper2_static", "paper2_swing"),
    "reset_sweep": ("reset_sweep",),
    "tuning": (
        *("tune_condition5", "tune_large", "tune_filter", "tune_compass"),
        *("tuned_schedules", "tuned_phase"),
    ),
    "adaptive": ("adaptive_resets", "car_adaptive"),
    "consistency": ("consistency",),
    "kalman_passes": ("kalman_passes",),
    "paper1": ("paper1_conditions", "paper1_resets", "paper1_readings"),
    "reset_law": (
        *("reset_law", "reset_law_map", "reset_own_noise", "reset_surge"),
        *("reset_cycle_study", "reset_phase"),
    ),
    "turning": (
        *("turning_0_01", "turning_0_1", "turning_1"),
        *("turning_scale", "turning_kalman10", "turning_psins"),
    ),
    "which_alignment": ("which_method", "which_method_published"),
    "which_alignment_tables": (
        "which_alignment",
        "which_alignment_tuned",
        "which_alignment_latitude",
        "which_alignment_why",
        "which_alignment_stored",
        "which_alignment_turning",
        "which_alignment_car",
        "which_alignment_psins",
        "which_alignment_surge",
        "which_alignment_fair",
        "which_surge",
        "reset_cycle_study",
        "reset_phase",
    ),
}
"""The studies of each page."""

DRAWS = 4


def made_up(directory: Path, name: str) -> Source:
    """Numbers for every column of a shipped study, with few draws."""
    data = tomllib.loads((ROOT / "configs" / f"{name}.toml").read_text(encoding="utf-8"))
    if "record" not in data:
        data["study"]["draws"] = DRAWS
    data.get("earth", {}).setdefault("latitude_deg", 34.0)
    data["study"].setdefault("rate_hz", 100.0)
    study = study_from_dict(data)
    source = Source(
        directory, study, f"configs/{name}.toml", synthetic_summary(study, all_columns=True)
    )
    if study.study.curves or study.is_recorded:
        times = np.linspace(1.0, study.duration_s, 41).round()
        part = directory / name / "curves" / "part-0000-000000.parquet"
        write_part(part, synthetic_curves(study, times=times), Job(study).identity)
        return replace(source, directory=directory / name)
    return source


def test_every_study_page_is_tested():
    prose = (ROOT / "docs" / "studies").glob("*/page.md.j2")
    assert {path.parent.name for path in prose} == set(PAGES)


@pytest.fixture
def tunings(monkeypatch):
    """Tunings that nothing was searched for: every candidate is the baseline."""

    class MadeUp:
        def __init__(self, source):
            self.study = source.study
            self.tune, self.rival, self.best = source.study.tune, "grid", "grid"
            found = {"grid": 10.0, "sobol": 10.0, "gradient": 2.0, "equal cost": 2.0}
            self.searches = {name: SimpleNamespace(cost=cost) for name, cost in found.items()}
            self.case_numbers = dict.fromkeys(["baseline", "law", *found], 0)
            self.evaluation_study = SimpleNamespace(
                cases=[{"case": "all", "reset_times_s": (1.0, 2.0)}]
            )
            self.run_values = np.ones((1, 2, 8))

        @classmethod
        def from_source(cls, source):
            return cls(source)

        def score(self, name):
            return Estimate(200.0, 190.0, 210.0, 8)

        difference = score

    figure = Figure()
    figure.suptitle("made up")
    figure.subplots()
    monkeypatch.setattr(results, "Tuning", MadeUp)
    seen = Picture("seen", "made up", figure)
    monkeypatch.setattr(tuning_figures, "landscape_pictures", lambda _: [seen])


@pytest.fixture
def few_resamples(monkeypatch):
    """Intervals that nobody reads are not worth a thousand resamples each."""
    monkeypatch.setattr("sinsjax.analysis.estimates.RESAMPLES", 20)


@pytest.fixture
def bounds(monkeypatch):
    """Information bounds of one, whose sums over all samples take seconds."""
    made = "sinsjax.execution.information.heading_bound"
    monkeypatch.setattr(made, lambda times_s, **_: np.ones(len(times_s)))


@pytest.mark.nightly(fast=("paper1", "reset_sweep", "tuning"))
@pytest.mark.usefixtures("tunings", "few_resamples", "bounds")
@pytest.mark.parametrize("name", PAGES)
def test_page_renders_and_uses_all_computed_values(name, tmp_path):
    """Claims are looked at, but made-up numbers need not hold to them."""
    at = ROOT / "docs" / "studies" / name
    page = study_page.compute_page(at, [made_up(tmp_path, study) for study in PAGES[name]])
    text = study_page.render_prose(at, page, enforce_claims=False)
    assert text.startswith("# ")


def test_folded_tables_of_page_are_csv_files(tmp_path):
    at = tmp_path / "docs" / "studies" / "own"
    at.mkdir(parents=True)
    (at / "page.md.j2").write_text("# Own\n\n{{ tables.long }}\n\n{{ tables.short }}\n")
    (at / "page.py").write_text(
        "from sinsjax.report.base import Table\n"
        "from sinsjax.report.study_page import Page\n\n"
        "def page(sources):\n"
        '    rows = [["a, b", "1 [0, 2]\'"]]\n'
        '    long = Table("Long", ["case", "error"], rows, "Its note.", folded=True)\n'
        '    return Page({}, {"long": long, "short": Table("Short", ["x"], [["y"]])})\n'
    )
    path, _ = study_page.write_study_page(at, [])
    text = path.read_text(encoding="utf-8")
    assert "- Table: [Long](tables/own_long.csv). Its note.\n" in text
    assert "| x |" in text and not (path.parent / "tables" / "own_short.csv").exists()
    with (path.parent / "tables" / "own_long.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [["case", "error"], ["a, b", "1 [0, 2]'"]]
