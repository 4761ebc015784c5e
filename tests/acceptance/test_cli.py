"""Commands as a user types them: their results, their end, and one line for every mistake."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import tomli_w
from support.commands import Command
from support.studies import small_tables, swing_deg, write_swing_record
from support.sweep_directories import read_files_and_times

from sinsjax.errors import StudyInterrupted
from sinsjax.execution import run
from sinsjax.execution.results import read_curves, read_summary

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

TWO: dict[str, Any] = {"axes": {"phi_u0_deg": [0.0, 30.0]}, "resets": {"reset_times_s": [2.5]}}
"""Two variants, 6 runs: tests share the compiled program."""


def write_study(name: str = "study.toml", **changes: Any) -> Path:
    """Write a small study file with sections changed; one set to None is left out."""
    tables = {key: table for key, table in small_tables(**changes).items() if table is not None}
    Path(name).write_text(tomli_w.dumps(tables), encoding="utf-8")
    return Path(name)


def write_recorded_study() -> Path:
    """Write a study of a record of the simulated swing, the record, and its reference."""
    write_swing_record(Path())
    return write_study(
        "recorded.toml",
        study={"duration_s": 2.0, "draws": None, "window_s": [0, 2]},
        motion=None,
        sensors=None,
        record={"format": "psins", "start_s": [0.0, 1.0]},
        coarse={"coarse_duration_s": 3.0},
    )


def test_run_writes_results_and_figures_and_prints_table(sinsjax: Command) -> None:
    out = Path("out")
    code, told, _ = sinsjax("run", write_study(**TWO), "-o", out)
    assert code == 0
    summary, curves = read_summary(out), read_curves(out)
    assert summary["run_id"].to_pylist() == list(range(6))
    assert summary["phi_u0_deg"].to_pylist() == [0.0, 30.0] * 3
    assert curves.num_rows == 6 * 6
    last = curves.filter(pa.compute.equal(curves["time_s"], 6.0))
    np.testing.assert_array_equal(last["phi_u_arcmin"], summary["phi_u_arcmin"])
    assert list((out / "figures").glob("*.png"))
    assert "Settling" in told and "phi_u0_deg" not in told
    code, told, _ = sinsjax("report", out, "--full")
    assert code == 0 and "phi_u0_deg" in told
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["runs"] == manifest["runs_done"] == 6 and manifest["seed"] == 1
    assert (manifest["state"], manifest["config"]) == ("complete", "study.toml")
    assert manifest["devices"] == 2
    assert manifest["versions"].keys() >= {"sinsjax", "jaxlib", "pyarrow"}


def test_existing_results_are_overwritten_only_on_request(sinsjax: Command) -> None:
    words, out = ("sweep", write_study(**TWO), "-o", "out"), Path("out")
    assert sinsjax(*words)[0] == 0
    before = (out / "manifest.json").read_bytes()
    code, _, error = sinsjax(*words)
    assert (code, error.count("\n")) == (2, 1) and "out" in error and "--overwrite" in error
    assert (out / "manifest.json").read_bytes() == before
    (out / "notes.txt").write_text("mine")
    assert sinsjax(*words, "--overwrite")[0] == 0
    assert (out / "notes.txt").read_text() == "mine"


def test_resume_computes_only_missing_runs(sinsjax: Command) -> None:
    words = ("sweep", write_study(**TWO, study={"draws": 100}), "-o", "out", "--resume")
    code, told, _ = sinsjax(*words, "--chunk-runs", 64)
    assert code == 0 and "out: no results to resume, all runs are new." in told
    before = read_files_and_times(Path("out/summary"))
    lost, kept = sorted(before)
    Path("out/summary", lost).unlink()
    code, told, _ = sinsjax(*words)
    assert code == 0 and "study: 72 of 200 runs, already done" in told
    after = read_files_and_times(Path("out/summary"))
    assert after[lost][0] == before[lost][0] and after[kept] == before[kept]


@pytest.mark.nightly
def test_align_with_reference_reports_true_misalignment(sinsjax: Command) -> None:
    """The reference is the true attitude of the simulated swing, so phi is the true error."""
    words = ("align", "swing.imu", write_recorded_study(), "--reference", "true.csv")
    assert sinsjax(*words, "-o", "out")[0] == 0
    summary = read_summary("out")
    error = np.array(summary["yaw_deg"]) - swing_deg(np.array([5.0, 6.0]))[:, 2]
    # phi is the vector of C_true C_hat^T: about minus the error in yaw for small level angles.
    np.testing.assert_allclose(-np.array(summary["phi_u_arcmin"]) / 60, error, rtol=0.02)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("sweep wrong.toml", "wrong.toml: [alignment] phi_u0_degs:"),
        ("sweep no.toml", "no.toml"),
        ("sweep recorded.toml", "align"),
        ("sweep study.toml --devices 4096", "--devices: 4096"),
        ("sweep study.toml --devices 1 --scheduler tcp://127.0.0.1:1", "--devices: conflicts"),
        ("align swing.imu study.toml", "[record]"),
        ("align nan.imu recorded.toml", "nan.imu: row 300"),
        ("align short.imu recorded.toml", "short.imu: has 4.96 s"),
    ],
)
def test_mistake_is_refused_in_one_line_and_leaves_no_results(
    sinsjax: Command, words: str, named: str
) -> None:
    write_study()
    write_study("wrong.toml", alignment={"phi_u0_degs": 3})
    write_recorded_study()
    lines = Path("swing.imu").read_text().splitlines(keepends=True)
    Path("short.imu").write_text("".join(lines[:500]))
    Path("nan.imu").write_text("".join([*lines[:299], "1 2 nan 4 5 6 7\n", *lines[300:]]))
    code, _, error = sinsjax(*words.split(), "-o", "out")
    (line,) = [line for line in error.splitlines() if not line.startswith("Warning: ")]
    assert code == 2 and line.startswith("error: ") and named in line
    assert not Path("out").exists()


def test_unwritable_output_is_refused_in_one_line(sinsjax: Command) -> None:
    Path("file").write_text("in the way")
    for out in ("file", "file/below", "x" * 300):
        code, _, error = sinsjax("sweep", write_study(), "-o", out)
        assert code == 2 and error.splitlines()[-1].startswith(f"error: {out}")
    assert Path("file").read_text() == "in the way"


# --- where output goes, and how a command ends ---------------------------------------------------


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_full_disk_on_standard_output_is_reported_in_one_line() -> None:
    words = [sys.executable, "-m", "sinsjax", "--help"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("error: ") and "No space left on device" in done.stderr


@pytest.mark.nightly
def test_unavailable_jax_platform_is_reported_in_one_line() -> None:
    """In a separate process, since JAX starts once."""
    words, environment = [sys.executable, "-m", "sinsjax", "info"], {"JAX_PLATFORMS": "foo"}
    done = subprocess.run(words, env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: JAX_PLATFORMS=foo: JAX does not start: ")


@pytest.mark.parametrize("error", [StudyInterrupted("1 of 3 runs are in out"), KeyboardInterrupt()])
def test_interrupted_sweep_prints_resume_command(
    sinsjax: Command, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise error

    write_study("my study.toml", study={"success_band_arcmin": 1000.0})
    monkeypatch.setattr(run, "run_job", interrupted)
    again = "sinsjax sweep 'my study.toml' -o out --draws 48 --resume"
    line = f"{error} (continue: {again})" if str(error) else "stored results are kept"
    for more in ("--overwrite", "--resume"):
        code, _, told = sinsjax("sweep", "my study.toml", "-o", "out", "--draws", 48, more)
        assert (code, told) == (130, f"interrupted: {line}\n")


ENDING = """
import atexit, os, sys, threading, time

class Held:
    def __del__(self):
        os.abort()

held = Held()
atexit.register(print, "handlers run")
threading.Thread(target=lambda: (time.sleep(0.2), print("threads end"))).start()
sys.argv = ["sinsjax", "keys", "no_such_key"]
from sinsjax.__main__ import command
command()
"""


def test_abort_at_teardown_does_not_change_exit_code_or_output() -> None:
    """Exit code and output are right, whatever the remaining objects do when destroyed."""
    ended = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert ended.stderr.startswith("error: no_such_key: unknown section, key or method")
    assert ended.stdout.splitlines() == ["threads end", "handlers run"]
