"""Scripts of the pages on results that no engine made: their tables tell what the rows say."""

import csv
import math
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


def mean_time(rows, end_s):
    """The mean settling time as text, with the whole run for never."""
    times = [end_s if row["settle_10_s"] is None else row["settle_10_s"] for row in rows]
    return f"{np.mean(times):.0f}"


def test_paper1_judges_each_interpretation_by_its_own_runs(tmp_path, run):
    shares = {"p_above_error_share": lambda rng, count: rng.uniform(0.9, 1.0, count)}
    names = ("paper1_conditions", "paper1_resets", "paper1_readings")
    made = [stored(tmp_path, name, **shares) for name in names]
    tables, printed = run(paper1, *(directory for directory, _ in made))
    words = {"per_step": "as printed", "per_sample": "sample", "per_update": "per update"}
    runs = grouped(made[2][1], "q_reading", "r_reading", "feedback_interval_s")
    verdicts = list(tables["paper1_verdicts"].values())
    assert len(verdicts) == len(runs) == 42
    for row, ((q, r, feedback), rows) in zip(verdicts, runs.items(), strict=True):
        reading = (words.get(q, "density"), words.get(r, "density"), f"{feedback:g} s")
        assert (row["Q"], row["R"], row["feedback"]) == reading
        first = [one for one in rows if one["case"] == "condition 1"]
        share = np.mean([one["settle_10_s"] is not None for one in first])
        assert row["condition 1 converges"].startswith("yes" if share >= 0.95 else "no")
    assert len({row["condition 1 converges"][:2] for row in verdicts}) == 2
    ends = [one for one in made[0][1] if one["case"] == "condition 3"]
    mean = np.mean([one["phi_u_mean_arcmin"] - one["floor_arcmin"] for one in ends])
    (line,) = [line for line in printed.splitlines() if line.startswith("| 3: 5, 5, 10 |")]
    assert f" {mean:.1f} [" in line


def test_paper2_prints_window_means_next_to_those_of_the_paper(tmp_path, run):
    made = [stored(tmp_path, f"paper2_{base}") for base in ("static", "swing")]
    tables, printed = run(paper2, *(directory for directory, _ in made))
    rows = list(tables["paper2_table_1"].values())
    runs = grouped(made[0][1], "case", "gyro_bias_deg_per_h")
    for name, drift in runs:
        if name == "Scheme 1, level 80 s":
            (row,) = [r for r in rows if r[""] == name and r["gyro drift (deg/h)"] == f"{drift:g}"]
            means = [-one["phi_u_mean_arcmin"] / 60 for one in runs[name, drift]]
            assert row["heading (deg)"].startswith(f"{np.mean(means):.4f} [")
            rate = math.radians(15.041067) * math.cos(math.radians(32.057313))
            floor = drift * math.radians(1) / rate
            floor = math.degrees(floor - 50e-6 * math.tan(math.radians(32.057313)))
            assert row["bias floor (deg)"] == f"{floor:.4f}"
    assert len(rows) == 2 + len(runs) - 2  # K3 as printed is not shown
    assert "grows: 7.14 times every 77.5 s" in printed and "cycle_leaves: 0.993, 1.010" in printed


def test_turning_prints_rms_errors_and_the_planned_turns(tmp_path, run, monkeypatch):
    monkeypatch.setattr(turning, "SENSORS", {"laser gyro": turning.SENSORS["laser gyro"]})
    names = (*turning.GRADES, "turning_scale", "turning_kalman10", "turning_psins")
    errors = {"phi_u_at_300_arcmin": lambda rng, count: 100 * rng.normal(size=count)}
    made = {
        name: stored(tmp_path, name, **errors if name in turning.GRADES else {}) for name in names
    }
    _, printed = run(turning, *(directory for directory, _ in made.values()))
    runs = grouped(made["turning_1"][1], "case")
    for case in ("parked", "reversing carousel"):
        rms = math.hypot(*(one["phi_u_at_300_arcmin"] for one in runs[case,])) / math.sqrt(DRAWS)
        assert f"\n{case}: {rms:.0f} arcmin" in f"\n{printed}"


def test_which_alignment_prints_what_nine_tenths_stay_below(tmp_path, run):
    columns = {"phi_u_at_300_arcmin": lambda rng, count: rng.normal(size=count) * 20}
    made = [stored(tmp_path, f"which_method{end}", **columns) for end in ("", "_published")]
    _, printed = run(which_alignment, *(directory for directory, _ in made))
    runs = grouped(made[0][1], "case", "surge_m_per_s", "lever_arm_m")
    lines = printed[printed.index("Every method") :].splitlines()
    for case in ("kalman_sincos", "gravity_fit"):
        (line,) = [line for line in lines if line.startswith(f"| {case} |")]
        error = max(abs(one["phi_u_at_300_arcmin"]) for one in runs[case, 0.1, 2.0])
        error = f"{error:.0f}" if error >= 9.95 else f"{error:.1f}"  # of four runs, all but none
        assert line.split(" | ")[4].startswith(f"{error} [")


def test_reset_law_tables_are_means_and_medians_of_their_runs(tmp_path, run):
    names = ("reset_own_noise", "reset_surge", "reset_cycle_study", "reset_phase")
    made = {name: stored(tmp_path, name) for name in ("reset_law", "reset_law_map", *names)}
    tables, printed = run(reset_law, *(directory for directory, _ in made.values()))
    runs = grouped(made["reset_law"][1], "case")
    for case, rows in runs.items():
        settled = 100 * np.mean([one["settle_10_s"] is not None for one in rows])
        (line,) = [line for line in printed.splitlines() if line.startswith(f"| {case[0]} |")]
        assert f"| {settled:.0f} [" in line and f"| {mean_time(rows, 1800.0)} [" in line
    starts = grouped(made["reset_own_noise"][1], "case", "phi_u0_deg")
    times = [
        sorted(one["settle_10_s"] or math.inf for one in rows)[DRAWS // 2 - 1]
        for (case, _), rows in starts.items()
        if case == "kalman_sincos"
    ]
    (row,) = [r for r in tables["reset_law_own"].values() if r["filter"] == "kalman_sincos"]
    assert row["no reset"] == f"{min(times):.0f} to {max(times):.0f}"


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
    for row, method in ((ours, "numpy filter"), (own, "kalman5")):
        mean = np.mean([abs(one["phi_u_arcmin"]) for one in runs[method, 0.0, 80.0]])
        assert row["still, (10, 10, 80) deg"].startswith(f"{mean:.1f}")
