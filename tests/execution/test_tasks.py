"""A study divided into tasks: equal rows for any division, equal bytes on any machine."""

import random
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.studies import PAPER, small_study
from support.sweep_directories import STUDIES, make_study, read_parts

from sinsjax.arena.export import simulated_record
from sinsjax.engine.batch import LANES, map_in_threads
from sinsjax.execution import run as study_run
from sinsjax.execution.results import read_curves, read_summary
from sinsjax.execution.tasks import Executor, Job, TaskRunner
from sinsjax.records import Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict

# What is compiled as shipped has its bits compared in tests of the engine and of repeated passes.
pytestmark = pytest.mark.optimised(False)


@pytest.mark.nightly(fast=("drawn",))
@pytest.mark.parametrize("name", STUDIES)
def test_rows_do_not_depend_on_chunks_tasks_or_later_draws(name: str, tmp_path: Path) -> None:
    """Chunks of the smallest and largest size; shuffled tasks, each with a separate runner."""
    study = make_study(name)
    reference = study_run.run(study)
    summary, curves = reference.summary, reference.curves
    for chunk_runs in (2, 10**6) if name == "worlds" else (2,):
        again = study_run.run(study, chunk_runs=chunk_runs)
        assert again.summary.equals(summary) and again.curves.equals(curves)

    def elsewhere(runner: TaskRunner, tasks: Any) -> Any:
        todo = list(tasks)
        random.Random(3).shuffle(todo)
        for task in todo:
            yield TaskRunner(runner.job).compute(task)

    here, there = tmp_path / "here", tmp_path / "there"
    study_run.run_into(study, there, chunk_runs=128)
    study_run.run_into(study, here, chunk_runs=128, executor=Executor(elsewhere, {}))
    assert read_parts(here) == read_parts(there)
    assert read_summary(here).cast(summary.schema).equals(summary)
    assert read_curves(here).cast(curves.schema).equals(curves)

    runs, lengths = np.arange(study.n_draws * study.n_variants), study.lengths.to_list()
    np.testing.assert_array_equal(summary["run_id"], runs)
    np.testing.assert_array_equal(summary["draw_id"], runs // study.n_variants)
    np.testing.assert_array_equal(summary["variant_id"], runs % study.n_variants)
    records = [lengths[run % study.n_variants].records for run in runs]
    np.testing.assert_array_equal(curves["run_id"], np.repeat(runs, records))

    fewer = study_run.run(make_study(name, study.n_draws - 17))
    count = fewer.summary.num_rows
    assert fewer.summary.equals(summary.slice(0, count))
    assert fewer.curves.equals(curves.filter(pa.compute.less(curves["run_id"], count)))


@settings(max_examples=15)
@given(st.integers(1, 3000), st.integers(1, 30), st.none() | st.integers(1, 5000))
def test_tasks_are_deterministic_and_cover_every_run(
    draws: int, variants: int, chunk_runs: int | None
) -> None:
    study = small_study(
        study={"draws": draws}, axes={"p0_yaw_deg": [float(i + 1) for i in range(variants)]}
    )
    (tasks,) = TaskRunner(Job(study, None, None, chunk_runs)).plan_tasks()
    assert (tasks,) == tuple(TaskRunner(Job(study, None, None, chunk_runs)).plan_tasks())
    assert sum(task.runs for task in tasks) == draws * variants
    assert [task.call for task in tasks] == list(range(len(tasks)))
    assert sorted({task.name for task in tasks}) == [task.name for task in tasks]
    if chunk_runs is not None:
        assert all(task.runs <= max(2 * LANES, chunk_runs + LANES) for task in tasks)


def test_job_identity_depends_on_study_record_and_reference() -> None:
    tables = {
        "study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0, 2]},
        "record": {"format": "psins", "start_s": [0.0, 1.0]},
        "coarse": {"coarse_duration_s": 3.0},
        "filter": PAPER,
    }
    study, record = study_from_dict(tables), simulated_record(small_study())
    time_s = np.arange(0, 6.01, 0.01)
    level = Reference(time_s, np.zeros((len(time_s), 3)), "true.csv")
    records = [
        StoredRecord(record, None),
        StoredRecord(record._replace(dtheta=record.dtheta * (1 + 1e-15)), None),
        StoredRecord(record._replace(rate_hz=100.0000001), None),
        StoredRecord(record, level),
        StoredRecord(record, level._replace(attitude_deg=level.attitude_deg + 1e-12)),
        StoredRecord(record, level._replace(time_s=time_s + 1e-9)),
    ]
    known = [Job(study, stored).identity for stored in records]
    known += [Job(small_study()).identity, Job(small_study(study={"seed": 2})).identity]
    assert len(set(known)) == len(known)
    moved = StoredRecord(record._replace(source="elsewhere"), level._replace(source="elsewhere"))
    assert Job(study, moved).identity == Job(study, records[3]).identity
    assert Job(small_study(study={"name": "other"}), None, True, 64).identity == known[-2]


def test_threads_compile_each_program_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """More threads than compilers take all tasks while the last program has not begun."""
    compile_program, made = TaskRunner._compile, list[int]()

    def slow(self: TaskRunner, program: int, draws: range) -> None:
        made.append(program)
        time.sleep(0.2)
        compile_program(self, program, draws)

    monkeypatch.setattr(TaskRunner, "_compile", slow)
    monkeypatch.setattr(jax, "devices", lambda: [None])
    runner = TaskRunner(Job(make_study("worlds"), None, None, 128))
    (tasks,) = runner.plan_tasks()
    compiled: list[object] = []
    runner.compile(tasks, compiled.append)
    found = list(map_in_threads(runner.compute, tasks, len(tasks)))
    runner.close()
    assert [result.task for result in found] == tasks and made == [0, 1]
    assert len(compiled) == 2
