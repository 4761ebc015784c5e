"""Other instruction sets, in place of other CPUs, give the same rows to a tolerance."""

import os
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from support.studies import small_study

from sinsjax.execution import run
from sinsjax.execution.results import read_summary
from sinsjax.study.load import study_to_toml

TOLERANCE_ARCMIN, TOLERANCE_DEG = 1e-6, 1e-8
METHODS = ["kalman5", "compass"]


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> tuple[pa.Table, pa.Table]:
    """Rows of both methods, of this machine and of one with SSE4.2.

    It has half the vector of AVX2 and no fused multiply-add.
    """
    folder = tmp_path_factory.mktemp("machines")
    study = small_study(
        study={"duration_s": 60.0, "window_s": [20, 60], "draws": 4},
        compass={"level_time_s": 20.0},
        axes={"method": METHODS, "phi_u0_deg": [0.0, 30.0]},
    )
    here = run.run(study).summary
    (folder / "study.toml").write_text(study_to_toml(study))
    flags = "--xla_cpu_max_isa=SSE4_2"
    code = "import sys, sinsjax; sinsjax.configure(devices=1)\n"
    code += "sinsjax.run_into(sinsjax.load_study(sys.argv[1]), sys.argv[2])"
    subprocess.run(
        [sys.executable, "-c", code, folder / "study.toml", folder / "out"],
        env=os.environ | {"XLA_FLAGS": flags},
        check=True,
    )
    return here, read_summary(folder / "out")


@pytest.mark.nightly
@pytest.mark.parametrize("method", METHODS)
def test_rows_agree_between_instruction_sets(
    method: str, tables: tuple[pa.Table, pa.Table]
) -> None:
    here, there = (table.filter(pc.equal(table["method"], method)) for table in tables)
    assert here.num_rows == 8
    assert there.column_names == here.column_names
    worst = 0.0
    for name in here.column_names:
        one, other = here[name], there[name]
        assert one.null_count == other.null_count
        if not pa.types.is_floating(one.type) or name.startswith("settle"):
            assert one.equals(other), name
            continue
        a, b = (c.to_numpy() for c in (one, other))
        if name.endswith(("_arcmin", "_deg")):
            tolerance = TOLERANCE_ARCMIN if name.endswith("_arcmin") else TOLERANCE_DEG
            np.testing.assert_allclose(a, b, rtol=0, atol=tolerance, err_msg=name)
            worst = max(worst, float(np.nanmax(np.abs(a - b), initial=0.0)))
        else:
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9, err_msg=name)
    assert worst > 0  # or the flag did nothing, and this shows nothing
