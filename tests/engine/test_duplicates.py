"""Variants with the same runs are computed once, and every one of them has its row."""

from typing import Any

import pytest
from support.studies import small_study

from sinsjax.engine import batch
from sinsjax.execution.results import Results
from sinsjax.execution.run import run
from sinsjax.execution.tasks import Job, TaskRunner

pytestmark = pytest.mark.optimised(False)

CYCLES = [0.1 * n for n in range(1, 41)]
SWEPT: dict[str, Any] = {
    "study": {"duration_s": 4.0, "draws": 6, "window_s": [1, 4]},
    "axes": {"reset_cycle_s": CYCLES, "reset_count": [0, 1], "phi_u0_deg": [10.0, 30.0]},
}
"""160 variants of which 82 differ: without resets no cycle acts."""


@pytest.mark.nightly(fast=("False",))
@pytest.mark.parametrize("curves", [False, True])
def test_deduplicated_rows_equal_rows_of_all_variants_computed(
    curves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All runs are counted, but they take half as many chunks."""
    study = small_study(**SWEPT)

    def compute() -> tuple[list[int], Results]:
        (tasks,) = TaskRunner(Job(study, chunk_runs=128)).all_tasks_by_stage()
        return [task.runs for task in tasks], run(study, curves=curves, chunk_runs=128)

    counts, together = compute()
    monkeypatch.setattr(batch, "LEAST_SAVED", 1.0)
    all_counts, singly = compute()
    assert together.summary.equals(singly.summary) and together.curves.equals(singly.curves)
    runs = study.n_draws * study.n_variants
    assert together.summary.num_rows == sum(counts) == sum(all_counts) == runs
    assert 2 * len(counts) <= len(all_counts)
