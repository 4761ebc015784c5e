"""Other instruction sets, in place of other CPUs, give the same rows to a tolerance."""

import os
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from support.studies import small_study

from sinsjax.execution import run
from sinsjax.execution.results import read_summary
from sinsjax.study.load import study_to_toml

TOLERANCES = {"arcmin": (0, 1e-6), "deg": (0, 1e-8)}


@pytest.mark.nightly
def test_rows_agree_between_instruction_sets(tmp_path):
    """With SSE4.2, which has half the vector of AVX2 and no fused multiply-add."""
    study = small_study(
        study={"duration_s": 60.0, "window_s": [20, 60], "draws": 4},
        compass={"level_time_s": 20.0},
        axes={"method": ["kalman5", "compass"], "phi_u0_deg": [0.0, 30.0]},
    )
    (tmp_path / "study.toml").write_text(study_to_toml(study))
    words = [sys.executable, *"-m sinsjax sweep study.toml -o out --devices 1".split()]
    flags = {"XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2"}
    subprocess.run(words, cwd=tmp_path, env=os.environ | flags, check=True)
    here, there = run.run(study).summary, read_summary(tmp_path / "out")
    assert here.num_rows == 16 and here.column_names == there.column_names
    for name, one, other in zip(here.column_names, here.columns, there.columns, strict=True):
        if not pa.types.is_floating(one.type) or name.startswith("settle"):
            assert one.equals(other), name
            continue
        relative, absolute = TOLERANCES.get(name.rpartition("_")[2], (1e-6, 1e-9))
        a, b = one.to_numpy(), other.to_numpy()
        np.testing.assert_allclose(a, b, rtol=relative, atol=absolute, err_msg=name)
    assert here["phi_u_arcmin"] != there["phi_u_arcmin"]  # or the flag did nothing
