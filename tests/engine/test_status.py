"""Status of whole runs."""

import pytest
from support.studies import STILL, small_study

import sinsjax


@pytest.mark.optimised(False)
def test_runs_diverge_to_either_side() -> None:
    study = {"duration_s": 2.0, "window_s": [0.0, 2.0], "draws": 1}
    starts = {"phi_u0_deg": [60.0, -60.0]}
    filter_ = {"p0_yaw_deg": 0.1, "p0_level_deg": 0.1}
    runs = sinsjax.run(small_study(study=study, motion=STILL, axes=starts, filter=filter_))
    assert runs.summary["status"].to_pylist() == ["diverged", "diverged"]
