"""Scripts of the pages on results that no engine made: their tables tell what the rows say."""

import csv
import tomllib
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from support.stored_results import store_results
from support.synthetic_tables import synthetic_curves, synthetic_summary

import sinsjax
from docs.studies import paper1, paper2
from docs.studies.comparison import comparison
from docs.studies.reset_law import reset_law
from docs.studies.turning import turning
from docs.studies.which_alignment import which_alignment
from sinsjax.arena.export import export_study

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).parents[2]
DRAWS = 4


def stored(folder, name, **columns):
    """A directory of a page's study with few draws, and the rows of its summary."""
    (path,) = [*ROOT.glob(f"configs/{name}.toml"), *ROOT.glob(f"docs/studies/*/{name}.toml")]
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    data["study"]["draws"] = DRAWS
    study = sinsjax.study_from_dict(data)
    count = DRAWS * study.n_variants
    rng = np.random.default_rng(len(name))
    given = {"settle_10_s": np.where(rng.random(count) < 0.2, np.nan, rng.uniform(90, 800, count))}
    for key, draw in columns.items():
        given[key] = draw(rng, count)
    curves = synthetic_curves(study) if study.study.curves else None
    summary = synthetic_summary(study, **given)
    return store_results(folder / name, study, summary, curves, wall_s=1.0), summary.to_pylist()


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run a script on directories; return its tables by name, and what it prints."""

    def run_script(script, *arguments):
        words = [script.__name__, *map(str, arguments), "-o", str(tmp_path / "out")]
        monkeypatch.setattr("sys.argv", words)
        script.main()
        tables = {}
        for path in (tmp_path / "out" / "tables").glob("*.csv"):
            with path.open(newline="", encoding="utf-8") as file:
                header, *rows = csv.reader(file)
            tables[path.stem] = {tuple(row): dict(zip(header, row, strict=True)) for row in rows}
        for path in (tmp_path / "out" / "figures").glob("*.png"):
            assert path.read_bytes().startswith(b"\x89PNG")
        return tables, capsys.readouterr().out

    return run_script


def grouped(rows, *keys):
    """The rows by some of their keys."""
    found = defaultdict(list)
    for row in rows:
        found[tuple(row[key] for key in keys)].append(row)
    return found


def test_paper1_judges_each_interpretation_by_its_own_runs(tmp_path, run):
    shares = {"p_above_error_share": lambda rng, count: rng.uniform(0.9, 1.0, count)}
    names = ("paper1_conditions", "paper1_resets", "paper1_readings")
    made = [stored(tmp_path, name, **shares) for name in names]
    tables, _ = run(paper1, *(directory for directory, _ in made))
    runs = grouped(made[2][1], "q_reading", "r_reading", "feedback_interval_s").values()
    verdicts = list(tables["paper1_verdicts"].values())
    for row, rows in zip(verdicts, runs, strict=True):
        first = [one for one in rows if one["case"] == "condition 1"]
        share = np.mean([one["settle_10_s"] is not None for one in first])
        assert row["condition 1 converges"].startswith("yes" if share >= 0.95 else "no")
    assert len({row["condition 1 converges"][:2] for row in verdicts}) == 2


def test_paper2_prints_window_means_next_to_those_of_the_paper(tmp_path, run):
    made = [stored(tmp_path, f"paper2_{base}") for base in ("static", "swing")]
    tables, printed = run(paper2, *(directory for directory, _ in made))
    rows = list(tables["paper2_table_1"].values())
    runs = grouped(made[0][1], "case", "gyro_bias_deg_per_h")
    name, drift = "Scheme 1, level 80 s", 0.02
    (row,) = [r for r in rows if r[""] == name and r["gyro drift (deg/h)"] == f"{drift:g}"]
    means = [-one["phi_u_mean_arcmin"] / 60 for one in runs[name, drift]]
    assert row["heading (deg)"].startswith(f"{np.mean(means):.4f} [")
    assert len(rows) == 2 + len(runs) - 2  # K3 as printed is not shown
    assert "grows: 7.14 times every 77.5 s" in printed and "cycle_leaves: 0.993, 1.010" in printed


LASER = {"laser gyro": turning.SENSORS["laser gyro"]}
AT_300 = {"phi_u_at_300_arcmin": lambda rng, count: 100 * rng.normal(size=count)}
OTHERS = {
    turning: (*turning.GRADES, "turning_scale", "turning_kalman10", "turning_psins"),
    which_alignment: ("which_method", "which_method_published"),
    reset_law: ("reset_law", "reset_law_map")
    + ("reset_own_noise", "reset_surge", "reset_cycle_study", "reset_phase"),
}


@pytest.mark.parametrize("script", OTHERS, ids=lambda script: script.__name__)
def test_script_prints_every_case_of_its_first_study(script, tmp_path, run, monkeypatch):
    monkeypatch.setattr(turning, "SENSORS", LASER)
    made = [
        stored(tmp_path, name, **({} if script is reset_law else AT_300)) for name in OTHERS[script]
    ]
    _, printed = run(script, *(directory for directory, _ in made))
    assert all(f"{row['case']}" in printed for row in made[0][1])


@pytest.mark.optimised(False)
def test_comparison_runs_the_numpy_filter_and_tables_its_errors(tmp_path, run, monkeypatch):
    tables = sinsjax.load_study("arena").to_dict()
    tables["study"] |= {"duration_s": 20.0, "window_s": [10.0, 20.0], "draws": 3}
    tables["study"]["report_times_s"] = [10.0]
    study = sinsjax.study_from_dict(tables | {"cases": tables["cases"][:1]})
    (tmp_path / "arena.toml").write_text(
        (export_study(study, tmp_path / "x") / "study.toml").read_text()
    )
    monkeypatch.setattr(comparison, "STUDY", str(tmp_path / "arena.toml"))
    monkeypatch.setattr(comparison, "JUDGED", {"study.draws": 2})
    monkeypatch.setattr(comparison, "CHOOSING", {"study.draws": 1})
    monkeypatch.setattr(comparison, "find_programs", lambda psins: (["numpy filter"], ["none"]))
    written, _ = run(comparison, tmp_path / "all")
    ours, own = written["comparison_arena"].values()
    (scores,) = (tmp_path / "all" / "judged" / "enu" / "scores").iterdir()
    runs = grouped(
        sinsjax.read_summary(scores).to_pylist(), "method", "pitch_amplitude_deg", "phi_u0_deg"
    )
    # The same filter and noise, but for the order of integration and feedback.
    pair = (runs[method, 0.0, 80.0] for method in ("numpy filter", "kalman5"))
    errors = [[one["phi_u_arcmin"] for one in found] for found in pair]
    np.testing.assert_allclose(*errors, rtol=0.1)
    for row, method in ((ours, "numpy filter"), (own, "kalman5")):
        mean = np.mean([abs(one["phi_u_arcmin"]) for one in runs[method, 0.0, 80.0]])
        assert row["still, (10, 10, 80) deg"].startswith(f"{mean:.1f}")
