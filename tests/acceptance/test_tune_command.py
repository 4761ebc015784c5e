"""`sinsjax tune` as a user types it: its files, its report, resuming, and mistakes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from support.stored_results import report_text
from support.studies import BASE, recorded_study, write_swing_record
from support.sweep_directories import read_files_and_times

from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution.directory import lock_directory
from sinsjax.execution.results import Results, read_summary
from sinsjax.study.load import load_study, study_to_toml, with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.tuning import gradient, history, run_tuning, search
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.results import TuningResults

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]


TIMES = {"low": 1.0, "high": 10.0}, {"low": 2.0, "high": 19.0}
TUNE = {
    **{"objective": "final_error", "objective_across": "worst", "searches": ["grid", "gradient"]},
    **{"tune_draws": 3, "evaluation_draws": 4, "grid_points": 3},
    "variables": {"reset_times_s": TIMES, "reset_count": {"candidates": [1, 2]}},
}
STUDY = {
    **BASE,
    "study": {"name": "swing", "duration_s": 20.0, "rate_hz": 20.0, "window_s": [10, 20]},
    "resets": {"reset_count": 2, "reset_cycle_s": 5.0},
    "axes": {"phi_u0_deg": [5.0, 30.0]},
    "tune": TUNE,
}
COST = 3 * 2 * 400  # steps a point


def descend(study, stored, *, on_progress):
    """Return descents without running anything: two starts, the second of which ends best."""
    relaxed = [
        Evaluation(step, 1, [2.0 + step, 9.0], 9.0 - step, 4 * COST, start, 9.0, 2)
        for step in range(3)
        for start in range(2)
    ]
    ends = [Evaluation(3, 1, [5.0 + n, 12.0], 1e6 - n, 5 * COST, n) for n in range(2)]
    return SearchResult("gradient", [*relaxed, *ends])


@pytest.fixture(scope="module", autouse=True)
def faked():
    """Replace the gradient search by `descend`; nobody reads intervals, so resamples are few."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gradient, "descend", descend)
        patch.setattr("sinsjax.analysis.estimates.RESAMPLES", 50)
        yield


@pytest.fixture(scope="module")
def made(faked, tmp_path_factory):
    """Return the directory of a tuning run by grid and gradient, next to its study file."""
    folder = tmp_path_factory.mktemp("tune")
    (folder / "swing.toml").write_text(tomli_w.dumps(STUDY))
    run_tuning.tune(folder / "swing.toml", folder / "out")
    return folder / "out"


@pytest.fixture
def out(made, tmp_path):
    """Return a copy of that directory, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "out"))


def test_tuning_writes_searches_evaluation_and_tuned_study(made):
    """The tuned study has the best point, and draws that neither tuned nor evaluated."""
    study, tuned = load_study(made / "study.toml"), load_study(made / "tuned.toml")
    assert study == load_study(made.parent / "swing.toml")
    space = SearchSpace.from_study(study)
    grid, gradient = history.read_searches(made, space)
    # The law's points of one reset and of two come first; both lie on this grid.
    assert [e.candidate for e in grid.evaluations] == [0, 1] + [0] * 3 + [1] * 9
    assert grid.cost == 12 * COST and gradient.cost == 5 * COST
    times = {r["case"]: r["reset_times_s"] for r in read_summary(made / "evaluation").to_pylist()}
    assert list(times) == ["baseline", "grid, law", "gradient"]
    assert (times["baseline"], times["gradient"]) == ([5.0, 10.0], [6.0, 12.0])
    point = grid.point(space)
    assert grid.best.objective < gradient.best.objective
    assert tuned == with_point(study, point).replace({"study.seed": tuned.seed})
    runs = [load_study(made / name / "study.toml") for name in ("grid", "evaluation")]
    assert [(one.seed, one.n_draws) for one in runs] == [(1, 3), (2, 4)]
    assert tuned.seed not in (1, 2) and tuned.n_draws == study.n_draws


def test_results_have_objectives_on_draws_that_did_not_tune(made):
    found, errors = TuningResults(made), dict[tuple[str, float], list[float]]()
    for row in read_summary(made / "evaluation").to_pylist():
        errors.setdefault((row["case"], row["phi_u0_deg"]), []).append(row["phi_u_arcmin"])
    rms = {key: np.sqrt(np.mean(np.square(values))) for key, values in errors.items()}
    for case, score in (("grid, law", found.score), ("baseline", found.baseline)):
        assert score.value == pytest.approx(max(rms[case, 5.0], rms[case, 30.0]))
        assert score.low < score.value < score.high and score.n == 4
    assert found.search == "grid" and found.study == load_study(made / "tuned.toml")
    assert found.best == {"reset_times_s": [*found.study.reset_times()[0]]}


def test_tuning_report_is_built_from_stored_files(out, tmp_path):
    said = report_text(out, html=tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    for text in (said, page):
        assert "on 4 unused draws" in text and "evaluations on 3 Monte Carlo runs" in text
        assert "41.7 %" in text and "5, 10" in text  # cost of the grid, times of the baseline
    assert [path.name for path in (out / "figures").iterdir()] == ["descent.png"]


@pytest.mark.parametrize("name", ["history.parquet", "tuned.toml"])
def test_damaged_file_is_named_and_made_again_by_resume(made, out, name):
    """Nothing else is computed again."""
    parts = read_files_and_times(out / "evaluation" / "summary")
    content = bytearray((out / name).read_bytes())
    content[len(content) // 2] ^= 4
    (out / name).write_bytes(content)
    for read in (report_text, lambda out: TuningResults(out).study):
        with pytest.raises(InputError, match=f"{name}: "):
            read(out)
    if name == "tuned.toml":
        (out / name).unlink()
    run_tuning.tune(load_study(out / "study.toml"), out, resume=True)
    assert (out / "tuned.toml").read_bytes() == (made / "tuned.toml").read_bytes()
    assert history.read_history(out).equals(history.read_history(made))
    assert read_files_and_times(out / "evaluation" / "summary") == parts


@pytest.mark.nightly
def test_any_flipped_bit_of_a_tuning_is_named_or_changes_nothing(out):
    def read_all():
        found = TuningResults(out)
        return [found.best, found.score, found.study, Results.read(out / "grid").summary]

    expected, random = read_all(), np.random.default_rng(3)
    files = sorted(path for path in out.rglob("*") if path.is_file() and path.name != ".lock")
    for number in range(200):
        path = files[number % len(files)]
        content = path.read_bytes()
        flipped, bit = bytearray(content), random.integers(8 * len(content))
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            assert read_all() == expected, (path, bit)
        except InputError as error:
            assert len(error.lines) == 1 and f"{path}" in str(error), (path, bit)
        path.write_bytes(content)


def test_resumed_tuning_descends_if_only_the_grid_is_complete(out):
    study = load_study(out / "study.toml")
    grid, descents = history.read_searches(out, SearchSpace.from_study(study))
    history.write_history(out, study, [grid])
    run_tuning.tune(study, out, resume=True)
    found = history.read_searches(out, SearchSpace.from_study(study))
    assert [one.search for one in found] == [grid.search, descents.search]


def test_mistake_is_one_line_and_changes_nothing(made, sinsjax, tmp_path):
    config = made.parent / "swing.toml"
    before = read_files_and_times(made)
    other = tmp_path / "other.toml"
    other.write_text(tomli_w.dumps(STUDY | {"tune": TUNE | {"grid_points": 4}}))
    for words, text in (
        (("tune", config, "-o", made), "already holds a tuning run"),
        (("sweep", config, "--overwrite", "-o", made), "is not a result"),
        (("tune", other, "--resume", "-o", made), "of another study: [tune] grid_points"),
        (("rerun", made, "--run-id", 1), f"give a folder of its runs: {made / 'evaluation'}"),
        (("tune", config, "-o", "new", "--set", "tune={}"), "swing: has no [tune] section (`"),
    ):
        code, _, error = sinsjax(*words)
        assert (code, error.count("\n")) == (2, 1) and text in error
        assert error.startswith(f"error: {made}: ") == (made in words)
    assert not Path("new").exists() and read_files_and_times(made) == before


def test_stopped_overwrite_is_not_complete_and_leaves_no_temporary_files(out, monkeypatch):
    """Only temporary files of its own are removed, no file of a person."""

    def stopped(*_, **__):
        raise StudyInterrupted("no further")

    for name in (".study.toml.12.tmp", ".history.parquet.3456.tmp", "notes.tmp"):
        (out / name).write_text("half of")
    monkeypatch.setattr(search, "run_job", stopped)
    with pytest.raises(StudyInterrupted):
        run_tuning.tune(load_study(out / "study.toml"), out, overwrite=True)
    assert [path.name for path in out.glob("*.tmp")] == ["notes.tmp"]
    assert not (out / "tuned.toml").exists() and history.read_history(out).num_rows == 0
    with pytest.raises(InputError, match="out: holds a tuning run that is not complete"):
        report_text(out)


def test_tuning_beside_another_writer_is_refused(out):
    """No results are written between two searches either."""
    held, before = lock_directory(out), read_files_and_times(out)
    with pytest.raises(InputError, match=r"out: another process is writing there"):
        run_tuning.tune(load_study(out / "study.toml"), out, resume=True)
    held.release()
    assert read_files_and_times(out) == before


@pytest.mark.nightly
def test_tune_on_stored_record_splits_start_times(tmp_path, sinsjax):
    """Every other start time tunes, the rest evaluate."""
    write_swing_record(tmp_path)
    tune = {"searches": ["grid"], "objective": "final_error"}
    tune |= {"variables": {"p0_yaw_deg": {"candidates": [10.0, 80.0]}}}
    study = recorded_study(record={"start_s": [0.0, 0.5, 1.0]}, tune=tune)
    (tmp_path / "car.toml").write_text(study_to_toml(study))
    words = ["tune", "car.toml", "-o", "out", "--record", "swing.imu"]
    code, _, error = sinsjax(*words)
    assert code == 2 and "reference" in error
    assert sinsjax(*words, "--reference", "true.csv")[0] == 0
    for name, starts in (("grid", {0.0, 1.0}), ("evaluation", {0.5})):
        assert set(read_summary(Path("out", name))["start_s"].to_pylist()) == starts
