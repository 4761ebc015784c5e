"""Commands as a user types them: their results, and how they end."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import tomli_w
from support.studies import small_tables
from support.sweep_directories import read_manifest_entries

from sinsjax.cli import loop_gains
from sinsjax.errors import StudyInterrupted
from sinsjax.execution import run
from sinsjax.execution.results import read_curves, read_summary
from sinsjax.study.schema import EARTH_CONSTANTS

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]


def write_study(name="study.toml", **changes):
    """Write a small study file with sections changed."""
    Path(name).write_text(tomli_w.dumps(small_tables(**changes)), encoding="utf-8")
    return name


def test_run_writes_results_and_figures_and_prints_table(sinsjax):
    out, axes = Path("out"), {"phi_u0_deg": [0.0, 30.0]}
    code, told, _ = sinsjax("run", write_study(axes=axes), "-o", out)
    assert code == 0 and "Settling" in told and "phi_u0_deg" not in told
    summary, curves = read_summary(out), read_curves(out)
    assert summary["run_id"].to_pylist() == list(range(6))
    assert summary["phi_u0_deg"].to_pylist() == [0.0, 30.0] * 3
    last = curves.filter(pa.compute.equal(curves["time_s"], 6.0))
    np.testing.assert_array_equal(last["phi_u_arcmin"], summary["phi_u_arcmin"])
    assert list((out / "figures").glob("*.png"))
    assert "phi_u0_deg" in sinsjax("report", out, "--full")[1]
    manifest = read_manifest_entries(out)
    assert manifest["runs"] == manifest["runs_done"] == 6 and manifest["seed"] == 1
    assert (manifest["state"], manifest["config"]) == ("complete", "study.toml")
    assert manifest["versions"].keys() >= {"sinsjax", "jaxlib", "pyarrow"}


def ended(*words, **options):
    """Run Python; return exit code, output and error output."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    done = subprocess.run([sys.executable, *words], **options)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_full_disk_on_standard_output_is_reported_in_one_line():
    with open("/dev/full", "w") as full:
        code, _, error = ended("-m", "sinsjax", "--help", stdout=full)
    assert (code, error.count("\n")) == (2, 1)
    assert error.startswith("error: ") and "No space left on device" in error


@pytest.mark.nightly
def test_unavailable_jax_platform_is_reported_in_one_line():
    code, _, error = ended("-m", "sinsjax", "info", env=os.environ | {"JAX_PLATFORMS": "foo"})
    assert (code, error.count("\n")) == (2, 1)
    assert error.startswith("error: JAX_PLATFORMS=foo: JAX does not start: ")


def test_interrupted_sweep_prints_resume_command(sinsjax, monkeypatch):
    def interrupted(*_, **__):
        raise StudyInterrupted("1 of 3 runs are in out")

    write_study("my study.toml", study={"success_band_arcmin": 1000.0})
    monkeypatch.setattr(run, "run_job", interrupted)
    again = "sinsjax sweep 'my study.toml' -o out --draws 48 --resume"
    for more in ("--overwrite", "--resume"):
        code, _, told = sinsjax("sweep", "my study.toml", "-o", "out", "--draws", 48, more)
        assert (code, told) == (130, f"interrupted: 1 of 3 runs are in out (continue: {again})\n")


def test_abort_at_teardown_does_not_change_exit_code_or_output():
    """Exit code and output are right, whatever the remaining objects do when destroyed."""
    script = """
import atexit, os, sys
held = type("Held", (), {"__del__": lambda self: os.abort()})()
atexit.register(print, "handlers run")
sys.argv = ["sinsjax", "keys", "no_such_key"]
from sinsjax.__main__ import command
command()
"""
    code, told, error = ended("-c", script)
    assert (code, told) == (2, "handlers run\n")
    assert error.startswith("error: no_such_key: unknown section, key or method")


def test_design_gives_gains_and_roots_of_paper_loops(sinsjax):
    made, roots = loop_gains.gain_root_tables(0.02, 0.01, 0.5**0.5, gravity=9.8, radius=6378165.0)
    k1, k2, k3, k4 = made.rows
    assert k1 == ["K1", "0.06", "1/s", "0.02", "1/s"] and k4[1:4] == ["-", "-", "0.02"]
    assert k2[1::2] == ["1040", "259.3"]
    assert float(k3[1]) == pytest.approx(2 * 0.02**3 / 9.8, rel=5e-4)
    assert roots.rows[0][1] == "-0.02, -0.02 +- 0.02j"
    assert roots.rows[1][1:] == ["-0.01 +- 0.01j (double)", "299.6", "628.3"]
    assert f"R = {EARTH_CONSTANTS['radius_m']:.0f} m" in sinsjax("gains")[1]
