"""Runs of a day: memory of their results, and equality of truth in blocks and at once."""

import numpy as np
import pytest
from support.batches import batch_of
from support.studies import small_study

from sinsjax.engine import samples, scenario
from sinsjax.engine.batch import trace_program
from sinsjax.execution import run

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

DAY_S = 86_400.0


@pytest.mark.parametrize(("specific_force", "most_bytes"), [("measured", 50e6), ("gravity", 3e8)])
def test_day_long_run_allocates_no_large_array(specific_force: str, most_bytes: float) -> None:
    """Curves of 12 MB, and their copy; with gravity, 8 tiles share a covariance.

    A record would have 415 MB, and idle lanes eight times the curves.
    """
    study = small_study(
        study={"duration_s": DAY_S, "draws": 1},
        alignment={"specific_force": specific_force},
    )
    part = batch_of(study, curves=True)
    layout = part.lay_out()
    assert layout.curve_lanes == 1 and part.spec.intervals == DAY_S
    memory = trace_program(part, layout).compiled().memory_analysis()
    assert 6e6 < memory.temp_size_in_bytes + memory.output_size_in_bytes < most_bytes


PASSES = small_study(
    study={"draws": 2, "duration_s": 2.0, "window_s": [0, 2], "curves": True},
    passes={"stored_s": 1.0},
    alignment={"method": "compass"},
)


def test_curves_without_stored_increments_match_stored_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Equal to rounding, forward and backward: the formulas are the same, the loop differs."""
    whole = run.run(PASSES).curves
    monkeypatch.setattr(scenario, "MOST_STORED_SAMPLES", 0)
    monkeypatch.setattr(samples, "SAMPLES_PER_CALL", 30)
    part = batch_of(PASSES)
    assert part.environment.increments is None
    pieces = run.run(PASSES).curves
    assert pieces.num_rows == whole.num_rows == 4
    for name in ("phi_e_arcmin", "phi_n_arcmin", "phi_u_arcmin", "yaw_deg"):
        np.testing.assert_allclose(pieces[name], whole[name], rtol=0, atol=1e-7, err_msg=name)
