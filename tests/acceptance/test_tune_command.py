"""`sinsjax tune` as a user types it: its files, its report, resuming, and every mistake."""

import re
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w
from support.commands import Command, command_line
from support.stored_results import report_text, write_part
from support.studies import BASE, PAPER, small_study
from support.sweep_directories import read_files_and_times

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError, StudyInterrupted, StudyWarning
from sinsjax.execution.directory import lock_directory, read_manifest
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.run import RunProgress
from sinsjax.execution.run import run as run_study
from sinsjax.execution.tasks import Job
from sinsjax.plots import descents
from sinsjax.records import write_psins
from sinsjax.study.load import load_study, study_from_dict, with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import (
    from_python,
    gradient,
    history,
    objective,
    run_tuning,
    search,
)
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.results import Tuning

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Intervals that nobody reads are not worth a thousand resamples each."""
    monkeypatch.setattr("sinsjax.analysis.estimates.RESAMPLES", 50)


TUNE: dict[str, Any] = {
    "objective": "final_error",
    "objective_across": "worst",
    "searches": ["grid", "gradient"],
    "tune_draws": 3,
    "evaluation_draws": 4,
    "grid_points": 3,
    "variables": {
        "reset_times_s": [{"low": 1.0, "high": 10.0}, {"low": 2.0, "high": 19.0}],
        "reset_count": {"candidates": [1, 2]},
    },
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


@pytest.fixture
def sinsjax_(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command line in this process; return exit code, output and error output."""
    return command_line(monkeypatch, capsys)


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


@pytest.fixture(scope="module")
def faked() -> Iterator[pytest.MonkeyPatch]:
    """Replace the gradient search by `descend`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gradient, "descend", descend)
        yield patch


@pytest.fixture(scope="module")
def made(faked: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a tuning run by grid and gradient, next to its study file."""
    folder = tmp_path_factory.mktemp("tune")
    config = write(folder / "swing.toml")
    from_python.tune(load_study(config), folder / "out", source=config)
    return folder / "out"


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
    evaluation = read_summary(made / "evaluation")
    evaluated = load_study(made / "evaluation" / "study.toml")
    assert (evaluated.study.seed, evaluated.n_draws, evaluated.tune) == (2, 4, None)
    times = {row["case"]: row["reset_times_s"] for row in evaluation.to_pylist()}
    assert list(times) == ["baseline", "grid, law", "gradient"]
    assert times["baseline"] == [5.0, 10.0]
    assert times["gradient"] == [6.0, 12.0]
    assert read_manifest(made / "grid")["config"] == "swing.toml"


def test_tuned_study_has_best_point_of_tuning_draws(made: Path) -> None:
    study = load_study(made / "study.toml")
    space = SearchSpace.from_study(study)
    best = min(history.read_searches(made, space), key=lambda result: result.best.objective)
    tuned_study = load_study(made / "tuned.toml")
    assert best.search != "gradient"
    assert tuned_study == with_point(study, best.point(space)).replace(
        {"study.seed": tuned_study.seed}
    )
    assert tuned_study.tune is None and tuned_study.axes == study.axes
    assert tuned_study.n_draws == study.n_draws


def test_tuned_study_has_draws_that_neither_tuned_nor_evaluated(made: Path) -> None:
    folders = (
        made / "study.toml",
        made / "grid" / "study.toml",
        made / "evaluation" / "study.toml",
    )
    seeds = [load_study(file).seed for file in folders]
    assert seeds == [1, 1, 2]
    assert load_study(made / "tuned.toml").seed not in seeds
    assert (made / "tuned.toml").read_text().startswith("# The seed is new: ")


@pytest.mark.nightly
def test_sweep_and_rerun_do_not_silently_ignore_tuning(
    made: Path, sinsjax_: Command, tmp_path: Path
) -> None:
    note = "[tune] is ignored: the study runs as it is (`sinsjax tune` searches)."
    draws = ("--set", "study.draws=1")
    code, said, _ = sinsjax_("sweep", made.parent / "swing.toml", "-o", tmp_path / "a", *draws)
    assert code == 0 and note in said.splitlines()
    study = load_study(made.parent / "swing.toml").replace({"study.draws": 1})
    with pytest.warns(StudyWarning, match=re.escape(note)):
        run_study(study)
    code, _, error = sinsjax_("rerun", made, "--run-id", "1")
    text = f"holds a tuning run (give a folder of its runs: {made / 'evaluation'})"
    assert (code, error) == (2, f"error: {made}: {text}\n")


def test_tuning_report_is_built_from_stored_files(made: Path, tmp_path: Path) -> None:
    said = report_text(made, html=tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    for text in (said, page):
        assert "root mean square heading error at the end, worst over 2 variants" in text
        assert "on 4 unused draws" in text and "evaluations on 3 Monte Carlo runs" in text
        assert "at 41.7 % of its cost" in text
        assert "5, 10" in text and "Candidates on the unused draws" in text
    assert "<h1>swing" in page and page.count("data:image/png;base64,") == 1
    pictures = {path.name for path in (made / "figures").iterdir()}
    assert pictures == {"descent.png"}
    shutil.rmtree(made / "figures")


def test_report_refuses_evaluation_with_missing_runs(made: Path, tmp_path: Path) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    (part,) = (out / "evaluation" / "summary").iterdir()
    shorter = pq.read_table(part).slice(1)
    pq.write_table(shorter, part)
    with pytest.raises(InputError, match="part-0000-000000.parquet: has changed since it was wri"):
        report_text(out)
    write_part(part, shorter, read_manifest(out / "evaluation")["identity"])
    with pytest.raises(InputError, match=r"evaluation/summary: .* 23 of 24 runs are there"):
        report_text(out)


def test_edited_tuned_study_is_named(made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    text = (out / "tuned.toml").read_text()
    (out / "tuned.toml").write_text(text.replace("p0_level_deg = 15.0", "p0_level_deg = 16.0"))
    line = r"tuned.toml: has changed since .*: \[filter\] p0_level_deg: 15.0 in the tuning, 16.0 in"
    for read in (report_text, lambda out: from_python.TuningResults(out).study):
        with pytest.raises(InputError, match=line):
            read(out)


@pytest.mark.nightly
def test_any_flipped_bit_of_a_tuning_is_named_or_changes_nothing(
    made: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))

    def read_all() -> list[object]:
        found = from_python.TuningResults(out)
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


def test_scores_and_differences_use_common_draws(made: Path) -> None:
    tuning = Tuning.read(made)
    runs, grid_runs = (tuning.run_values[tuning.case_numbers[n]] for n in ("gradient", "grid"))
    rows = read_summary(made / "evaluation").to_pylist()
    errors = [abs(row["phi_u_arcmin"]) for row in rows if row["case"] == "gradient"]
    assert runs.shape == (2, 4) and sorted(runs.ravel()) == pytest.approx(sorted(errors))
    worst = [np.sqrt(np.mean(values**2, axis=1)).max() for values in (runs, grid_runs)]
    score, difference = tuning.score("gradient"), tuning.difference("gradient")
    assert score.value == pytest.approx(worst[0]) and score.low <= score.value <= score.high
    assert difference.value == pytest.approx(worst[0] - worst[1])
    assert tuning.difference("grid")[:3] == (0, 0, 0)


def test_resumed_tuning_repeats_only_missing_parts(made: Path, tmp_path: Path, faked: Any) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    (out / "tuned.toml").unlink()
    study = load_study(out / "study.toml")
    whole = {name: read_files_and_times(made / name / "summary") for name in ("grid", "evaluation")}
    runs = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(gradient, "descend")
        before = search.run_job

        def counted(job: Job, **options: Any) -> None:
            seen: list[int] = []
            before(job, **options | {"on_progress": lambda p: seen.append(p.done - p.done_before)})
            assert job.directory is not None
            runs[job.directory.name] = seen[-1]

        patch.setattr(search, "run_job", counted)
        from_python.tune(study, out, resume=True)
    assert runs == {"grid": 0, "evaluation": 0}
    assert {name: read_files_and_times(out / name / "summary") for name in whole} == whole
    assert (out / "tuned.toml").read_bytes() == (made / "tuned.toml").read_bytes()


def test_existing_tuning_directory_is_not_silently_overwritten(
    made: Path, sinsjax_: Command, tmp_path: Path
) -> None:
    config = made.parent / "swing.toml"
    before = read_files_and_times(made / "evaluation")
    code, _, error = sinsjax_("tune", config, "-o", made)
    assert code == 2
    assert error == (
        f"error: {made}: already holds a tuning run (give --resume to continue it, or --overwrite"
        " to replace it; in Python resume=True or overwrite=True)\n"
    )
    code, _, error = sinsjax_("sweep", config, "-o", made, "--overwrite")
    assert code == 2 and "is not a result" in error
    assert read_files_and_times(made / "evaluation") == before
    other = write(tmp_path / "swing.toml", tune=TUNE | {"grid_points": 4})
    code, _, error = sinsjax_("tune", other, "-o", made, "--resume")
    assert (code, error) == (
        2,
        f"error: {made}: holds a tuning run of another study: [tune] grid_points\n",
    )
    changed = write(tmp_path / "swing.toml", resets={"reset_count": 1, "reset_cycle_s": 5.0})
    code, _, error = sinsjax_("tune", changed, "-o", made, "--resume")
    text = "holds a tuning run of another study: [resets] reset_count: 2 there, 1 here"
    assert (code, error) == (2, f"error: {made}: {text}\n")


def test_overwrite_removes_previous_tuning_results(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(made, tmp_path / "out")

    def stopped(job: Job, **options: Any) -> None:
        assert job.overwrite and not job.resume
        raise StudyInterrupted("no further")

    monkeypatch.setattr(search, "run_job", stopped)
    with pytest.raises(StudyInterrupted):
        from_python.tune(load_study(out / "study.toml"), out, overwrite=True)
    assert not (out / "tuned.toml").exists() and history.read_history(out).num_rows == 0
    with pytest.raises(InputError, match="out: holds a tuning run that is not complete"):
        report_text(out)
    assert run_tuning.is_tuning(out)


def test_resume_removes_temporary_files_of_killed_tuning(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only its temporary files are removed, no file of a person."""
    out = shutil.copytree(made, tmp_path / "out")
    names = (".study.toml.12.tmp", ".history.parquet.3456.tmp", ".tuned.toml.7.tmp")
    for name in (*names, "notes.tmp", ".tuned.toml.mine.tmp"):
        (out / name).write_text("half of")

    def stopped(*args: Any, **options: Any) -> None:
        raise StudyInterrupted("no further")

    monkeypatch.setattr(search, "run_job", stopped)
    with pytest.raises(StudyInterrupted):
        from_python.tune(load_study(out / "study.toml"), out, resume=True)
    left = {path.name for path in out.glob("*.tmp")}
    assert left == {"notes.tmp", ".tuned.toml.mine.tmp"}


@pytest.mark.parametrize("how", ["resume", "overwrite"])
def test_concurrent_tunings_in_one_directory_are_refused(
    made: Path, tmp_path: Path, how: str
) -> None:
    """No results are written between two searches either."""
    out = shutil.copytree(made, tmp_path / "out")
    held = lock_directory(out)
    before = read_files_and_times(out)
    try:
        with pytest.raises(InputError, match=r"out: another process is writing there"):
            from_python.tune(load_study(out / "study.toml"), out, **{how: True})
    finally:
        held.release()
    assert read_files_and_times(out) == before


def test_interrupted_tuning_raises_study_interrupted(tmp_path: Path, faked: Any) -> None:
    study, stop = load_study(write(tmp_path / "swing.toml")), threading.Event()
    stop.set()
    with pytest.raises(StudyInterrupted, match=r"0 of 72 runs are in .*grid"):
        from_python.tune(study, tmp_path / "out", stop=stop)
    with pytest.raises(InputError, match=r"out: holds a tuning run that is not complete \(`sinsj"):
        report_text(tmp_path / "out")
    alone = load_study(write(tmp_path / "swing.toml", tune=TUNE | {"searches": ["gradient"]}))
    with pytest.MonkeyPatch.context() as patch:
        progress = RunProgress(0, 1, 0, 0)
        patch.setattr(gradient, "descend", lambda *_, on_progress: on_progress(progress))
        with pytest.raises(StudyInterrupted, match="the complete searches are in"):
            from_python.tune(alone, tmp_path / "alone", stop=stop)


@pytest.mark.nightly(fast=("flipped",))
@pytest.mark.parametrize("damage", ["flipped", "emptied", "gone"])
def test_damaged_history_is_refused_by_report_and_made_again_by_resume(
    made: Path, tmp_path: Path, faked: Any, damage: str
) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    whole = history.read_history(out)
    content = bytearray((out / "history.parquet").read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 4
    (out / "history.parquet").unlink()
    if damage != "gone":
        (out / "history.parquet").write_bytes(content if damage == "flipped" else b"")
    words = "there is no such file" if damage == "gone" else "has changed since .*tune --resume"
    with pytest.raises(InputError, match=rf"history\.parquet: {words}"):
        report_text(out)
    from_python.tune(load_study(out / "study.toml"), out, resume=True)
    assert history.read_history(out).equals(whole)
    assert (out / "tuned.toml").read_bytes() == (made / "tuned.toml").read_bytes()


@pytest.mark.nightly(fast=("edited",))
@pytest.mark.parametrize("damage", ["emptied", "edited", "gone"])
def test_damaged_study_of_tuning_is_named_and_restored_by_resume(
    made: Path, tmp_path: Path, faked: Any, damage: str
) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    study, text = load_study(out / "study.toml"), (out / "study.toml").read_text()
    (out / "study.toml").unlink()
    if damage != "gone":
        changed = text.replace("\ngyro_bias_deg_per_h = 0.1", "\ngyro_bias_deg_per_h = 9.0")
        assert changed != text
        (out / "study.toml").write_text(changed if damage == "edited" else "")
    named = {
        "edited": r"is not the study of the history: \[sensors\] gyro_bias_deg_per_h: 0\.1 in the"
        r" history, 9\.0 in the file \(delete it: `sinsjax tune --resume` writes",
        "emptied": r".* \(delete it: `sinsjax tune --resume` writes it again\)",
        "gone": r".* \(delete it: `sinsjax tune --resume` writes it again\)",
    }
    with pytest.raises(InputError, match=rf"out/study\.toml: {named[damage]}"):
        report_text(out)
    from_python.tune(study, out, resume=True)
    assert (out / "study.toml").read_text() == text
    assert "swing" in report_text(out)


def test_search_folder_that_is_a_link_is_refused(made: Path, tmp_path: Path) -> None:
    """Otherwise --overwrite would delete the parts of another results directory."""
    out, other = (shutil.copytree(made, tmp_path / name) for name in ("out", "other"))
    shutil.rmtree(out / "grid")
    (out / "grid").symlink_to(other / "grid")
    before = read_files_and_times(tmp_path)
    for attempt in (
        lambda: from_python.tune(load_study(out / "study.toml"), out, overwrite=True),
        lambda: report_text(out),
    ):
        with pytest.raises(InputError, match=r"out/grid: is a link"):
            attempt()
    assert read_files_and_times(tmp_path) == before


def test_report_draws_no_figures_through_a_link(made: Path, tmp_path: Path) -> None:
    out, other = shutil.copytree(made, tmp_path / "out"), tmp_path / "other"
    shutil.rmtree(out / "figures", ignore_errors=True)
    other.mkdir()
    (out / "figures").symlink_to(other)
    with pytest.raises(InputError, match=r"out/figures: is a link"):
        report_text(out)
    assert not list(other.iterdir())


MISTAKES: dict[str, tuple[dict[str, Any], list[str], str]] = {
    "nothing to tune": (
        {"tune": None},
        [],
        "swing: has no [tune] section",
    ),
    "two minds": ({}, ["--resume", "--overwrite"], "--resume: conflicts with --overwrite"),
    "a record for nothing": ({}, ["--record", "x.imu"], "has no [record] section to read x.imu"),
    "no record": (
        {
            "motion": None,
            "sensors": None,
            "axes": None,
            "record": {"format": "psins", "start_s": [0, 1]},
            "filter": PAPER,
            "tune": {"variables": {"p0_yaw_deg": {"fixed": 3.0}}, "searches": ["grid"]},
        },
        [],
        "[record]: the study needs a record (`sinsjax align RECORD`, `sinsjax tune --record`",
    ),
    "devices that are not there": ({}, ["--devices", "1000"], "--devices: 1000 exceeds the"),
}


@pytest.mark.nightly
def test_tune_warns_if_every_point_fails(tmp_path: Path, sinsjax_: Command) -> None:
    """A gyro bias whose floor lies far outside the band, judged from the truth."""
    tune = {
        "objective": "settle_mean",
        "searches": ["grid"],
        "tune_draws": 2,
        "evaluation_draws": 2,
        "variables": {"p0_yaw_deg": {"candidates": [20.0, 80.0]}},
    }
    sensors = BASE["sensors"] | {"gyro_bias_deg_per_h": [5.0, 0.0, 0.0]}
    axes = {"phi_u0_deg": [30.0, 40.0]}
    config = write(tmp_path / "x.toml", tune=tune, sensors=sensors, axes=axes, resets=None)
    code, out, _ = sinsjax_("tune", config, "-o", tmp_path / "out")
    assert code == 0
    assert "every point fails" in out and "judged_from" in out


@pytest.mark.parametrize("name", MISTAKES)
def test_tune_input_error_is_one_line(name: str, tmp_path: Path, sinsjax_: Command) -> None:
    changes, words, text = MISTAKES[name]
    config = write(tmp_path / "swing.toml", **changes)
    code, _, error = sinsjax_("tune", config, "-o", tmp_path / "out", *words)
    assert (code, error.count("\n")) == (2, 1) and text in error
    assert not (tmp_path / "out").exists()


def test_tune_refuses_output_path_with_foreign_files(tmp_path: Path, sinsjax_: Command) -> None:
    config = write(tmp_path / "swing.toml")
    (tmp_path / "figures").mkdir()
    code, _, error = sinsjax_("tune", config, "-o", tmp_path, "--overwrite")
    assert code == 2 and "holds a figures that is not of a tuning run (give another" in error
    code, _, error = sinsjax_("tune", config, "-o", config)
    assert code == 2 and f"{config}: is a file, not a directory" in error


def test_equal_points_are_evaluated_once_under_joined_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the study's value as only candidate, the grid finds the baseline."""
    tune = TUNE | {"searches": ["grid"], "variables": {"reset_count": {"fixed": 2}}}
    study = load_study(write(tmp_path / "swing.toml", tune=tune))
    seen: list[Study] = []

    monkeypatch.setattr(search, "run_job", lambda job, **options: seen.append(job.study))
    monkeypatch.setattr(search.results, "read_summary", lambda *_: pa.table({}))
    monkeypatch.setattr(
        objective, "run_values", lambda _, derived, __: np.ones((derived.n_variants, 2))
    )
    from_python.tune(study, tmp_path / "out")
    assert [case["case"] for case in seen[-1].cases] == ["baseline, grid"]


@pytest.mark.nightly
def test_tune_on_stored_record_splits_start_times(tmp_path: Path, sinsjax_: Command) -> None:
    """Every other start time tunes, the rest evaluate; `align` accepts the tuned study."""
    write_psins(simulated_record(small_study()), tmp_path / "swing.imu")
    times = np.arange(0, 6.01, 0.01)
    angles = zip((1.8, 2.4, 2.8), (6, 8, 10), (0, 0, 10), strict=True)
    swing = [mean + a * np.sin(2 * np.pi * times / period) for a, period, mean in angles]
    header = "time_s,pitch_deg,roll_deg,yaw_deg"
    rows = np.column_stack([times, *swing])
    np.savetxt(tmp_path / "true.csv", rows, delimiter=",", header=header, comments="")
    variables = {"p0_yaw_deg": {"candidates": [10.0, 80.0]}}
    tune = {"searches": ["grid"], "variables": variables, "objective": "final_error"}
    data = {
        "study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0, 2]},
        "record": {"format": "psins", "start_s": [0.0, 0.5, 1.0]},
        "coarse": {"coarse_duration_s": 3.0},
        "filter": PAPER,
        "tune": tune,
    }
    assert study_from_dict(data)
    config = tmp_path / "car.toml"
    config.write_text(tomli_w.dumps(data))
    words = ["tune", config, "-o", tmp_path / "out", "--record", tmp_path / "swing.imu"]
    code, _, error = sinsjax_(*words)
    assert code == 2 and "[tune]: tuning on a record needs a reference (give it with --ref" in error
    code, said, error = sinsjax_(*words, "--reference", tmp_path / "true.csv")
    assert code == 0 and error.count("\n") == error.count("cannot be determined") == 1
    said = " ".join(said.split())
    assert "on 1 unused start time" in said and "evaluations on 2 start times (grid)" in said
    grid = read_summary(tmp_path / "out" / "grid")
    assert sorted(set(grid["start_s"].to_pylist())) == [0.0, 1.0]
    judged = read_summary(tmp_path / "out" / "evaluation")
    assert set(judged["start_s"].to_pylist()) == {0.5}
    tuned_study = load_study(tmp_path / "out" / "tuned.toml")
    assert tuned_study.record is not None and len(tuned_study.record.start_s) == 3


def test_descent_map_places_objective_at_grid_points() -> None:
    sides = [descents.VariableAxis(f"x{i}", i == 1) for i in range(2)]
    axes = np.linspace(1, 100, 4), np.geomspace(1, 100, 4)
    values = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    scores = 10 * values[:, 0] + values[:, 1]
    scores[0] = np.inf
    points = descents.Points("time (s)", values, scores)
    figure = descents.draw_descents(sides, points, [], [], "swing", grid_points=4)
    (mesh,) = figure.axes[0].collections
    shown = np.ma.masked_invalid(mesh.get_array()).reshape(4, 4)
    assert shown.mask[0, 0] and shown.mask.sum() == 1
    assert shown[0, 3] == pytest.approx(1000 + 1) and shown[3, 0] == pytest.approx(10 + 100)
    corner = mesh.get_coordinates()[0, 0]
    np.testing.assert_allclose(corner, [1 - 33 / 2, 100 ** (-1 / 6)])
