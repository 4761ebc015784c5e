"""Variants with the same runs are computed once, and every one of them has its row."""

from typing import Any

import pytest
from support.studies import small_study

from sinsjax.engine import duplicates
from sinsjax.execution import run as study_run
from sinsjax.execution.tasks import Job, TaskRunner
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

CYCLES = [0.1 * n for n in range(1, 41)]
SWEPT: dict[str, Any] = {
    "study": {"duration_s": 4.0, "draws": 6, "window_s": [1, 4]},
    "axes": {"reset_cycle_s": CYCLES, "reset_count": [0, 1], "phi_u0_deg": [10.0, 30.0]},
}
"""160 variants of which 82 differ: without resets no cycle acts."""


@pytest.fixture(scope="module")
def study() -> Study:
    return small_study(**SWEPT)


def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes every variant be computed."""
    monkeypatch.setattr(duplicates, "LEAST_SAVED", 1.0)


@pytest.mark.nightly(fast=("False",))
@pytest.mark.parametrize("curves", [False, True])
def test_deduplicated_rows_equal_rows_of_all_variants_computed(
    study: Study, curves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = study_run.run(study, curves=curves, chunk_runs=128)
    apart(monkeypatch)
    singly = study_run.run(study, curves=curves, chunk_runs=128)
    for one, other in zip(together, singly, strict=True):
        assert one.equals(other)
    assert together.summary.num_rows == study.n_draws * study.n_variants


def test_duplicate_variants_are_computed_once_but_all_runs_counted(study: Study) -> None:
    runner = TaskRunner(Job(study))
    (computed,) = [same.computed for same in runner._duplicates if same is not None]
    assert len(computed) == 2 * (1 + len(CYCLES))
    (tasks,) = runner.plan_tasks()
    assert sum(task.runs for task in tasks) == study.n_draws * study.n_variants
    for task in tasks:
        assert runner.compute_tables(task).tables["summary"].num_rows == task.runs
