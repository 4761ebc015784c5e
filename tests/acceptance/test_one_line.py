"""Former tracebacks are one line, whatever a file contains or happens to the output."""

import copy
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import tomli_w
from support.stored_results import store_results
from support.studies import BASE, small_study, small_tables

from sinsjax import cli, console
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import resume, run
from sinsjax.execution.directory import Manifest
from sinsjax.execution.tasks import Job
from sinsjax.messages import to_one_line
from sinsjax.platform import runtime
from sinsjax.study.load import load_study, study_from_dict

pytestmark = pytest.mark.optimised(False)

Command = Callable[..., tuple[int, str]]


@pytest.fixture
def sinsjax(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command line in this process; gives exit code and error output."""

    def call(*words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["sinsjax", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        return int(stop.value.code or 0), capsys.readouterr().err

    return call


def refused(data: Any) -> str:
    with pytest.raises(InputError) as error:
        study_from_dict(data, "swing.toml")
    line = str(error.value)
    assert line.startswith("swing.toml: ") and line.isprintable() and len(line) <= 1000
    return line


# --- what stands where something else belongs -------------------------------------------------


@pytest.mark.parametrize(
    ("section", "key"),
    [("alignment", "method"), ("earth", "earth"), ("resets", "reset_trigger")],
)
@pytest.mark.parametrize(
    "value",
    [{"a": 1}, [["a"]], 10**400, "\x1b[2J" + "x" * 10_000],
    ids=["table", "list", "large", "long"],
)
def test_odd_value_in_place_of_string_is_refused(section: str, key: str, value: Any) -> None:
    data = copy.deepcopy(BASE)
    data.setdefault(section, {})[key] = value
    assert refused(data).startswith(f"swing.toml: [{section}] {key}")


def test_long_unknown_name_is_shortened_in_error() -> None:
    for data in ({"x" * 10_000: {}}, BASE | {"study": {"x" * 10_000: 1}}):
        line = refused(data)
        assert " ... " in line and ": unknown " in line
    assert to_one_line("a\nb\x1b[2J\u202e") == r"a b\x1b[2J\u202e"


# --- nesting ----------------------------------------------------------------------------------

DEEP = 20_000
NESTED = {
    "lists": "x = " + "[" * DEEP + "]" * DEEP,
    "tables": "x = " + "{a = " * DEEP + "1" + "}" * DEEP,
    "keys": "x." * 3000 + "x = 1",
    "header": "[" + "x." * 50_000 + "x]",
    "few": "x = " + "[" * 60 + "]" * 60,  # a parser takes that many
}
NESTED_MANIFESTS = {
    "lists": "[" * DEEP,
    "few": '{"config":' + "[" * 60 + "]" * 60 + "}",
}


@pytest.mark.nightly(fast=("few", "tables", "lists", "keys"))
@pytest.mark.parametrize("how", NESTED)
def test_study_nested_too_deeply_is_refused_in_one_line(
    how: str, tmp_path: Path, sinsjax: Command
) -> None:
    out = store_results(tmp_path / "out", small_study(), pa.table({"run_id": [0]}))
    path = out / "study.toml"
    path.write_text(NESTED[how])
    with pytest.raises(InputError, match=r"study.toml: is nested too deeply$"):
        load_study(path)
    commands = ("report", out), ("rerun", out, "--run-id", 0), ("run", path, "-o", out)
    for words in (*commands, ("validate", path)):
        assert sinsjax(*words) == (2, f"error: {path}: is nested too deeply\n")
    job = Job(small_study(), directory=out)
    assert resume.continue_job(job).identity == job.identity  # resume asks the parts whose they are


@pytest.mark.parametrize("place", ["study.window_s", "study" + ".x" * 50_000])
@pytest.mark.parametrize("depth", [60, DEEP])
def test_change_nested_too_deeply_is_refused_in_one_line(
    place: str, depth: int, sinsjax: Command
) -> None:
    for words in (("validate", "reset_sweep"), ("run", "reset_sweep", "-o", "out")):
        code, error = sinsjax(*words, "--set", f"{place}={'[' * depth}{']' * depth}")
        assert code == 2 and error.endswith(": is nested too deeply\n") and error.count("\n") == 1


@pytest.mark.parametrize("command", ["report", "rerun"])
@pytest.mark.parametrize("how", NESTED_MANIFESTS)
def test_manifest_nested_too_deeply_is_refused_in_one_line(
    how: str, command: str, tmp_path: Path, sinsjax: Command
) -> None:
    out = store_results(tmp_path / "out", small_study(), pa.table({"run_id": [0]}))
    (out / "manifest.json").write_text(NESTED_MANIFESTS[how])
    code, error = sinsjax(command, out, *(["--run-id", 0] if command == "rerun" else []))
    assert code == 2 and error.startswith(f"error: {out}/manifest.json: has changed")
    assert error.endswith("(`--resume` writes it again)\n")
    assert error.count("\n") == 1
    assert not (out / "reruns").exists()
    assert Manifest.find(out) is None  # resume asks the parts


# --- parts ------------------------------------------------------------------------------------


def test_rerun_refuses_summary_with_two_rows_of_one_run(tmp_path: Path, sinsjax: Command) -> None:
    curves = pa.table({"run_id": [0, 0, 1, 1], "time_s": [1.0, 2.0, 1.0, 2.0]})
    out = store_results(tmp_path / "out", small_study(), curves)
    code, error = sinsjax("rerun", out, "--run-id", 1)
    assert code == 2 and error.startswith(
        f"error: {out}/summary: has 2 rows of run 1: a foreign part"
    )
    assert error.count("\n") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="file names are text elsewhere")
def test_results_directory_whose_name_is_not_utf8_is_refused_before_any_run(
    tmp_path: Path, sinsjax: Command
) -> None:
    out = tmp_path / os.fsdecode(b"o\xff")
    refused = (
        rf"{tmp_path}/o\udcff: results cannot be stored under a name that is not UTF-8 (rename it)"
    )
    for words in (("sweep", "reset_sweep"), ("tune", "tune_condition5")):
        assert sinsjax(*words, "-o", out) == (2, f"error: {refused}\n")
    with pytest.raises(InputError, match=re.escape(refused)):
        run.run_into(small_study(), out)
    assert not out.exists()
    store_results(tmp_path / "out", small_study(), pa.table({"run_id": [0]})).rename(out)
    for words in (("report", out), ("rerun", out, "--run-id", 0)):
        assert sinsjax(*words) == (2, f"error: {refused}\n")


# --- where output goes ------------------------------------------------------------------------


def test_missing_standard_streams_are_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon's standard streams are None in Python."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    with pytest.raises(SystemExit) as stop, console.tolerate_broken_pipe():
        print("lost")
        sys.stdout.flush()
    assert stop.value.code == 0


def test_sweep_and_report_finish_after_broken_pipe(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As with ``| head -1``: the sweep continues to its end, with figures and tables."""
    reading, writing = os.pipe()
    os.close(reading)
    done = []

    def finished(*_: Any, **options: Any) -> None:
        for runs in range(1, 4):
            options["on_progress"](run.RunProgress(runs, 3, 0, 0))
        done.append("runs")

    config = tmp_path / "swing.toml"
    config.write_text(tomli_w.dumps(small_tables()))
    monkeypatch.setattr(run, "run_job", finished)
    monkeypatch.setattr("sinsjax.report.print_reports", lambda *_, **__: done.append("report"))
    monkeypatch.setattr(sys, "argv", ["sinsjax", "sweep", str(config), "-o", str(tmp_path / "o")])
    with open(writing, "w", buffering=1) as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert sys.stdout is closed
    assert done == ["runs", "report"] and not stop.value.code


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_full_disk_on_standard_output_is_reported_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["info"], ["gains"], ["--help"], ["sweep", "--help"]):
        monkeypatch.setattr(sys, "argv", ["sinsjax", *words])
        with open("/dev/full", "w") as full, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", full)
            with pytest.raises(SystemExit) as stop:
                cli.main()
        assert stop.value.code == 2
        line = "error: standard output: cannot be written: No space left on device\n"
        assert capsys.readouterr().err == line


@pytest.mark.nightly
def test_unavailable_jax_platform_is_reported_in_one_line() -> None:
    """In a separate process, since JAX starts once."""
    done = subprocess.run(
        [sys.executable, "-m", "sinsjax", "info"],
        env={**os.environ, "JAX_PLATFORMS": "foo"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: JAX_PLATFORMS=foo: JAX does not start: ")
    runtime.start_backend()


# --- interrupted, and continued -----------------------------------------------------------------


def test_interrupted_sweep_prints_resume_command(
    sinsjax: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise StudyInterrupted("1 of 3 runs are in out")

    config = tmp_path / "my study.toml"
    config.write_text(tomli_w.dumps(small_tables(study={"success_band_arcmin": 1000.0})))
    monkeypatch.setattr(run, "run_job", interrupted)
    words = ["sweep", config, "-o", tmp_path / "out", "--draws", 48]
    again = f"sinsjax sweep '{config}' -o {tmp_path / 'out'} --draws 48 --resume"
    for more in ("--overwrite", "--resume"):
        told = f"interrupted: 1 of 3 runs are in out (continue: {again})\n"
        assert sinsjax(*words, more) == (130, told)


def test_keyboard_interrupt_outside_runs_is_reported_in_one_line(
    sinsjax: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sinsjax.execution.prepare.load_study", interrupted)
    told = "interrupted: stored results are kept\n"
    assert sinsjax("sweep", "reset_sweep", "-o", tmp_path / "out") == (130, told)


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
