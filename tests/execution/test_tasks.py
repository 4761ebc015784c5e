"""A study divided into tasks: equal rows for any division, equal bytes on any machine."""

import random

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.studies import add_true_reference, recorded_study, small_study
from support.sweep_directories import STUDIES, make_study, read_parts

import sinsjax
from sinsjax.engine.batch import LANES
from sinsjax.execution.tasks import Executor, Job, TaskRunner
from sinsjax.records.reference import StoredRecord

# What is compiled as shipped has its bits compared in tests of the engine and of repeated passes.
pytestmark = pytest.mark.optimised(False)


@pytest.mark.nightly(fast=("drawn",))
@pytest.mark.parametrize("name", STUDIES)
def test_rows_do_not_depend_on_chunks_tasks_or_later_draws(name, tmp_path):
    """Chunks of the smallest and largest size; shuffled tasks, each with a separate runner."""
    study = make_study(name)
    reference = sinsjax.run(study)
    summary, curves = reference.summary, reference.curves
    for chunk_runs in (2, 10**6) if name == "worlds" else (2,):
        again = sinsjax.run(study, chunk_runs=chunk_runs)
        assert again.summary.equals(summary) and again.curves.equals(curves)

    def elsewhere(runner, tasks):
        todo = list(tasks)
        random.Random(3).shuffle(todo)
        for task in todo:
            yield TaskRunner(runner.job).compute(task)

    here, there = tmp_path / "here", tmp_path / "there"
    sinsjax.run_into(study, there, chunk_runs=128)
    stored = sinsjax.run_into(study, here, chunk_runs=128, executor=Executor(elsewhere, {}))
    assert read_parts(here) == read_parts(there)
    assert stored.summary.cast(summary.schema).equals(summary)
    assert stored.curves.cast(curves.schema).equals(curves)

    runs, lengths = np.arange(study.n_draws * study.n_variants), study.lengths.to_list()
    np.testing.assert_array_equal(summary["run_id"], runs)
    np.testing.assert_array_equal(summary["draw_id"], runs // study.n_variants)
    np.testing.assert_array_equal(summary["variant_id"], runs % study.n_variants)
    records = [lengths[run % study.n_variants].records for run in runs]
    np.testing.assert_array_equal(curves["run_id"], np.repeat(runs, records))

    fewer = sinsjax.run(make_study(name, study.n_draws - 17))
    count = fewer.summary.num_rows
    assert fewer.summary.equals(summary.slice(0, count))
    assert fewer.curves.equals(curves.filter(pa.compute.less(curves["run_id"], count)))


@settings(max_examples=15)
@given(st.integers(1, 3000), st.integers(1, 30), st.none() | st.integers(1, 5000))
def test_tasks_are_deterministic_and_cover_every_run(draws, variants, chunk_runs):
    axes = {"p0_yaw_deg": [float(i + 1) for i in range(variants)]}
    job = Job(small_study(study={"draws": draws}, axes=axes), None, None, chunk_runs)
    (tasks,), again = TaskRunner(job).all_tasks_by_stage(), TaskRunner(job).all_tasks_by_stage()
    assert [tasks] == again
    assert sum(task.runs for task in tasks) == draws * variants
    assert [task.call for task in tasks] == list(range(len(tasks)))
    assert sorted({task.name for task in tasks}) == [task.name for task in tasks]
    if chunk_runs is not None:
        assert all(task.runs <= max(2 * LANES, chunk_runs + LANES) for task in tasks)


def test_input_hash_depends_on_study_record_and_reference():
    study = recorded_study()
    record, level = add_true_reference(sinsjax.simulated_record(small_study()))
    jobs = [Job(small_study()), Job(small_study(study={"seed": 2}))]
    for one, other in (
        (record, level),
        (record, None),
        (record._replace(dtheta=record.dtheta * (1 + 1e-15)), level),
        (record._replace(rate_hz=100.0000001), level),
        (record, level._replace(attitude_deg=level.attitude_deg + 1e-12)),
        (record, level._replace(time_s=level.time_s + 1e-9)),
    ):
        jobs.append(Job(study, StoredRecord(one, other)))
    assert len({job.input_hash for job in jobs}) == len(jobs)
    moved = StoredRecord(record._replace(source="elsewhere"), level)
    assert Job(study, moved).input_hash == jobs[2].input_hash
    assert Job(small_study(study={"name": "new"}), None, True, 64).input_hash == jobs[0].input_hash
