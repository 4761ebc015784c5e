"""`sinsjax tune` as a user types it: its files, its report, resuming, and every mistake."""

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import tomli_w
from support.commands import Command
from support.stored_results import report_text, write_part
from support.studies import BASE, PAPER, write_swing_record
from support.sweep_directories import read_files_and_times

from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution.directory import lock_directory, read_manifest
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.run import RunProgress
from sinsjax.execution.tasks import Job
from sinsjax.study.load import load_study, with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import gradient, history, run_tuning, search
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.results import TuningResults

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]


TIMES = {"low": 1.0, "high": 10.0}, {"low": 2.0, "high": 19.0}
TUNE: dict[str, Any] = {
    **{"objective": "final_error", "objective_across": "worst", "searches": ["grid", "gradient"]},
    **{"tune_draws": 3, "evaluation_draws": 4, "grid_points": 3},
    "variables": {"reset_times_s": TIMES, "reset_count": {"candidates": [1, 2]}},
}
STUDY: dict[str, Any] = {
    **BASE,
    "study": {"name": "swing", "duration_s": 20.0, "rate_hz": 20.0, "window_s": [10, 20]},
    "resets": {"reset_count": 2, "reset_cycle_s": 5.0},
    "axes": {"phi_u0_deg": [5.0, 30.0]},
    "tune": TUNE,
}
COST = 3 * 2 * 400  # steps a point


def write(path: Path, **changes: Any) -> Path:
    """Write the file of `STUDY` with sections replaced; None omits a section."""
    data = {k: v for k, v in (STUDY | changes).items() if v is not None}
    path.write_text(tomli_w.dumps(data), encoding="utf-8")
    return path


def descend(study: Study, stored: Any, *, on_progress: Any) -> SearchResult:
    """Return descents without running anything: two starts, the second of which ends best."""
    steps = [
        Evaluation(
            step, 1, [2.0 + step + start, 9.0 - step], 9.0 - step - start, 4 * COST, start, 9.0, 2
        )
        for step in range(3)
        for start in range(2)
    ]
    ends = [Evaluation(3, 1, [5.0 + n, 12.0], 1e6 - n, 5 * COST, n) for n in range(2)]
    return SearchResult("gradient", [*steps, *ends])


@pytest.fixture(scope="module", autouse=True)
def faked() -> Iterator[None]:
    """Replace the gradient search by `descend`; nobody reads intervals, so resamples are few."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gradient, "descend", descend)
        patch.setattr("sinsjax.analysis.estimates.RESAMPLES", 50)
        yield


@pytest.fixture(scope="module")
def made(faked: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a tuning run by grid and gradient, next to its study file."""
    folder = tmp_path_factory.mktemp("tune")
    run_tuning.tune(write(folder / "swing.toml"), folder / "out")
    return folder / "out"


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    """Return a copy of that directory, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "out"))


def test_tuning_writes_study_history_and_evaluation(made: Path) -> None:
    names = {"study.toml", "tuned.toml", "history.parquet", "grid", "evaluation"}
    assert {path.name for path in made.iterdir()} == names | {".lock"}
    study = load_study(made / "study.toml")
    assert study == load_study(made.parent / "swing.toml")
    grid, gradient = history.read_searches(made, SearchSpace.from_study(study))
    assert [result.search for result in (grid, gradient)] == ["grid", "gradient"]
    # The law's points of one reset and of two come first; both lie on this grid.
    assert [e.candidate for e in grid.evaluations] == [0, 1] + [0] * 3 + [1] * 9
    assert grid.cost == 12 * COST and gradient.cost == 5 * COST
    times = {r["case"]: r["reset_times_s"] for r in read_summary(made / "evaluation").to_pylist()}
    assert list(times) == ["baseline", "grid, law", "gradient"]
    assert (times["baseline"], times["gradient"]) == ([5.0, 10.0], [6.0, 12.0])
    assert read_manifest(made / "grid")["config"] == "swing.toml"


def test_tuned_study_has_best_point_and_draws_that_neither_tuned_nor_evaluated(made: Path) -> None:
    study, tuned = load_study(made / "study.toml"), load_study(made / "tuned.toml")
    space = SearchSpace.from_study(study)
    best = min(history.read_searches(made, space), key=lambda result: result.best.objective)
    assert best.search != "gradient"
    assert tuned == with_point(study, best.point(space)).replace({"study.seed": tuned.seed})
    assert tuned.tune is None and (tuned.axes, tuned.n_draws) == (study.axes, study.n_draws)
    runs = {name: load_study(made / name / "study.toml") for name in ("grid", "evaluation")}
    assert {name: (one.seed, one.n_draws) for name, one in runs.items()} == {
        "grid": (1, 3),
        "evaluation": (2, 4),
    }
    assert tuned.seed not in (1, 2)
    assert (made / "tuned.toml").read_text().startswith("# The seed is new: ")


def test_results_have_objectives_on_draws_that_did_not_tune(made: Path) -> None:
    found, errors = TuningResults(made), dict[tuple[str, float], list[float]]()
    for row in read_summary(made / "evaluation").to_pylist():
        errors.setdefault((row["case"], row["phi_u0_deg"]), []).append(row["phi_u_arcmin"])
    rms = {key: np.sqrt(np.mean(np.square(values))) for key, values in errors.items()}
    for case, score in (("grid, law", found.score), ("baseline", found.baseline)):
        assert score.value == pytest.approx(max(rms[case, 5.0], rms[case, 30.0]))
        assert score.low < score.value < score.high and score.n == 4
    assert found.search == "grid" and found.study == load_study(made / "tuned.toml")
    assert found.best == {"reset_times_s": [*found.study.reset_times()[0]]}
    assert "arcmin" in found.objective and "grid" in repr(found)


def test_tuning_report_is_built_from_stored_files(made: Path, tmp_path: Path) -> None:
    said = report_text(made, html=tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    for text in (said, page):
        assert "root mean square heading error at the end, worst over 2 variants" in text
        assert "on 4 unused draws" in text and "evaluations on 3 Monte Carlo runs" in text
        assert "41.7 %" in text  # of the cost of the grid
        assert "5, 10" in text and "Candidates on the unused draws" in text
    assert "<h1>swing" in page and page.count("data:image/png;base64,") == 1
    pictures = {path.name for path in (made / "figures").iterdir()}
    assert pictures == {"descent.png"}
    shutil.rmtree(made / "figures")


@pytest.mark.parametrize("name", ["history.parquet", "tuned.toml"])
def test_damaged_file_is_named_by_report_and_made_again_by_resume(
    made: Path, out: Path, name: str
) -> None:
    content = bytearray((out / name).read_bytes())
    content[len(content) // 2] ^= 4
    (out / name).write_bytes(content)
    for read in (report_text, lambda out: TuningResults(out).study):
        with pytest.raises(InputError, match=f"{name}: "):
            read(out)
    if name == "tuned.toml":
        (out / name).unlink()
    run_tuning.tune(load_study(out / "study.toml"), out, resume=True)
    for file in ("study.toml", "tuned.toml"):
        assert (out / file).read_bytes() == (made / file).read_bytes()
    assert history.read_history(out).equals(history.read_history(made))


def test_report_refuses_evaluation_with_missing_runs(out: Path) -> None:
    (part,) = (out / "evaluation" / "summary").iterdir()
    write_part(part, pq.read_table(part).slice(1), read_manifest(out / "evaluation")["identity"])
    with pytest.raises(InputError, match=r"evaluation/summary: .* 23 of 24 runs are there"):
        report_text(out)


@pytest.mark.nightly
def test_any_flipped_bit_of_a_tuning_is_named_or_changes_nothing(out: Path) -> None:
    def read_all() -> list[object]:
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


def test_resumed_tuning_repeats_only_missing_parts(made: Path, out: Path) -> None:
    (out / "tuned.toml").unlink()
    whole = {name: read_files_and_times(out / name / "summary") for name in ("grid", "evaluation")}
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(gradient, "descend")
        run_tuning.tune(load_study(out / "study.toml"), out, resume=True)
    assert {name: read_files_and_times(out / name / "summary") for name in whole} == whole
    assert (out / "tuned.toml").read_bytes() == (made / "tuned.toml").read_bytes()


def test_resumed_tuning_descends_if_only_the_grid_is_complete(out: Path) -> None:
    study = load_study(out / "study.toml")
    grid, descents = history.read_searches(out, SearchSpace.from_study(study))
    history.write_history(out, study, [grid])
    run_tuning.tune(study, out, resume=True)
    found = history.read_searches(out, SearchSpace.from_study(study))
    assert [one.search for one in found] == [grid.search, descents.search]


def test_existing_tuning_directory_is_not_silently_overwritten(
    made: Path, sinsjax: Command, tmp_path: Path
) -> None:
    config = made.parent / "swing.toml"
    before = read_files_and_times(made / "evaluation")
    other = write(tmp_path / "other.toml", tune=TUNE | {"grid_points": 4})
    for words, text in (
        (("tune", config, "-o", made), "already holds a tuning run"),
        (("sweep", config, "--overwrite", "-o", made), "is not a result"),
        (("tune", other, "--resume", "-o", made), "of another study: [tune] grid_points"),
        (("rerun", made, "--run-id", 1), f"give a folder of its runs: {made / 'evaluation'}"),
        (("tune", config, "--overwrite", "-o", config), f"{config}: is a file, not a directory"),
        (("tune", config, "-o", "new", "--set", "tune={}"), "swing: has no [tune] section"),
        (("tune", config, "-o", "new", "--record", "x.imu"), "no [record] section to read x.imu"),
    ):
        code, _, error = sinsjax(*words)
        assert (code, error.count("\n")) == (2, 1) and text in error
        assert error.startswith(f"error: {made}: ") == (made in words)
    assert not Path("new").exists()
    assert read_files_and_times(made / "evaluation") == before


@pytest.mark.parametrize("how", ["resume", "overwrite"])
def test_stopped_tuning_is_not_complete_and_leaves_no_temporary_files(
    out: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Only temporary files of its own are removed, no file of a person."""
    for name in (".study.toml.12.tmp", ".history.parquet.3456.tmp", "notes.tmp"):
        (out / name).write_text("half of")

    def stopped(job: Job, **options: Any) -> None:
        assert (job.resume, job.overwrite) == (how == "resume", how == "overwrite")
        raise StudyInterrupted("no further")

    monkeypatch.setattr(search, "run_job", stopped)
    with pytest.raises(StudyInterrupted):
        run_tuning.tune(load_study(out / "study.toml"), out, **{how: True})
    assert [path.name for path in out.glob("*.tmp")] == ["notes.tmp"]
    if how == "overwrite":
        assert not (out / "tuned.toml").exists() and history.read_history(out).num_rows == 0
        with pytest.raises(InputError, match="out: holds a tuning run that is not complete"):
            report_text(out)


def test_concurrent_tunings_in_one_directory_are_refused(out: Path) -> None:
    """No results are written between two searches either."""
    held, before = lock_directory(out), read_files_and_times(out)
    for how in ("resume", "overwrite"):
        with pytest.raises(InputError, match=r"out: another process is writing there"):
            run_tuning.tune(load_study(out / "study.toml"), out, **{how: True})
    held.release()
    assert read_files_and_times(out) == before


def test_interrupted_tuning_raises_study_interrupted(tmp_path: Path) -> None:
    study, stop = load_study(write(tmp_path / "swing.toml")), threading.Event()
    stop.set()
    with pytest.raises(StudyInterrupted, match=r"0 of 72 runs are in .*grid"):
        run_tuning.tune(study, tmp_path / "out", stop=stop)
    alone = study.replace({"tune.searches": ["gradient"]})
    with pytest.MonkeyPatch.context() as patch:
        progress = RunProgress(0, 1, 0, 0)
        patch.setattr(gradient, "descend", lambda *_, on_progress: on_progress(progress))
        with pytest.raises(StudyInterrupted, match="the complete searches are in"):
            run_tuning.tune(alone, tmp_path / "alone", stop=stop)


def test_folder_that_is_a_link_is_refused(out: Path, tmp_path: Path) -> None:
    """Otherwise --overwrite would delete the parts of another results directory."""
    (out / "grid").rename(tmp_path / "other")
    (out / "grid").symlink_to(tmp_path / "other")
    before = read_files_and_times(tmp_path)
    with pytest.raises(InputError, match="out/grid: is a link"):
        run_tuning.tune(load_study(out / "study.toml"), out, overwrite=True)
    assert read_files_and_times(tmp_path) == before


@pytest.mark.nightly
def test_tune_warns_if_every_point_fails(tmp_path: Path, sinsjax: Command) -> None:
    """A gyro bias whose floor lies far outside the band, judged from the truth."""
    tune = {"objective": "settle_mean", "searches": ["grid"], "tune_draws": 2}
    tune |= {"evaluation_draws": 2, "variables": {"p0_yaw_deg": {"candidates": [20.0, 80.0]}}}
    sensors = BASE["sensors"] | {"gyro_bias_deg_per_h": [5.0, 0.0, 0.0]}
    config = write(tmp_path / "x.toml", tune=tune, sensors=sensors, resets=None)
    code, out, _ = sinsjax("tune", config, "-o", tmp_path / "out")
    assert code == 0 and "every point fails" in out and "judged_from" in out


@pytest.mark.nightly
def test_tune_on_stored_record_splits_start_times(tmp_path: Path, sinsjax: Command) -> None:
    """Every other start time tunes, the rest evaluate; `align` accepts the tuned study."""
    write_swing_record(tmp_path)
    variables = {"p0_yaw_deg": {"candidates": [10.0, 80.0]}}
    data = {
        "study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0, 2]},
        "record": {"format": "psins", "start_s": [0.0, 0.5, 1.0]},
        "coarse": {"coarse_duration_s": 3.0},
        "filter": PAPER,
        "tune": {"searches": ["grid"], "variables": variables, "objective": "final_error"},
    }
    (tmp_path / "car.toml").write_text(tomli_w.dumps(data))
    words = ["tune", "car.toml", "-o", "out"]
    for record in ([], ["--record", "swing.imu"]):
        code, _, error = sinsjax(*words, *record)
        assert code == 2 and ("reference" if record else "[record]") in error
    code, said, error = sinsjax(*words, *record, "--reference", "true.csv")
    assert code == 0 and error.count("\n") == error.count("cannot be determined") == 1
    said = " ".join(said.split())
    assert "on 1 unused start time" in said and "evaluations on 2 start times (grid)" in said
    for name, starts in (("grid", {0.0, 1.0}), ("evaluation", {0.5})):
        assert set(read_summary(Path("out", name))["start_s"].to_pylist()) == starts
    tuned_study = load_study("out/tuned.toml")
    assert tuned_study.record is not None and len(tuned_study.record.start_s) == 3
