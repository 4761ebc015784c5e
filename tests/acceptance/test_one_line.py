"""What used to end in a traceback: one line, whatever stands in a file or becomes of the output."""

import copy
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import tomli_w
from support.commands import command_line
from support.stored import store
from support.studies import BASE, small_study

from sinsjax import cli, console
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import resume, run
from sinsjax.messages import one_line
from sinsjax.platform import runtime
from sinsjax.study.keys import SECTIONS
from sinsjax.study.load import load_study, study_from_dict, study_to_toml

Command = Callable[..., tuple[int, str]]


@pytest.fixture
def sinsjax(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs a command line in this process; gives exit code and error output."""

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
@pytest.mark.parametrize("value", [{"a": 1}, {}, [{"a": 1}], [["a"]]])
def test_a_table_where_a_word_belongs(section: str, key: str, value: Any) -> None:
    data = copy.deepcopy(BASE)
    data.setdefault(section, {})[key] = value
    assert refused(data).startswith(f"swing.toml: [{section}] {key}")


ODD: list[Any] = [{"a": 1}, {}, [{"a": 1}], [{}], [[1]], [[[]]], "x" * 10_000, 10**400, "\x1b[2J"]


@pytest.mark.parametrize("value", ODD, ids=[repr(value)[:12] for value in ODD])
def test_an_odd_value_of_any_key_is_a_short_line(value: Any) -> None:
    for section, model in SECTIONS.items():
        for key in model.model_fields:
            data = copy.deepcopy(BASE)
            data.get(section, {}).pop(key, None)
            for swept in (
                {section: data.get(section, {}) | {key: value}},
                {"axes": {key: [value]}},
                {"cases": [{"case": "a", key: value}]},
                {"drawn": {key: {"values": [value]}}},
            ):
                try:
                    study_from_dict(data | swept)
                except InputError as error:
                    assert str(error).isprintable() and len(str(error)) < 500, (section, key)


def test_a_long_name_is_not_echoed_whole() -> None:
    for data in ({"x" * 10_000: {}}, BASE | {"study": {"x" * 10_000: 1}}):
        line = refused(data)
        assert " ... " in line and ": unknown " in line
    assert one_line("a\nb\x1b[2J\u202e") == r"a b\x1b[2J\u202e"


# --- nesting ----------------------------------------------------------------------------------

DEEP = 20_000
NESTED = {
    "lists": "x = " + "[" * DEEP + "]" * DEEP,
    "tables": "x = " + "{a = " * DEEP + "1" + "}" * DEEP,
    "keys": "x." * 3000 + "x = 1",
}


@pytest.mark.parametrize("how", NESTED)
def test_a_study_that_is_nested_too_deeply(
    how: str, tmp_path: Path, sinsjax: Command
) -> None:
    out = store(tmp_path / "out", small_study(), pa.table({"run_id": [0]}))
    path = out / "study.toml"
    path.write_text(NESTED[how])
    with pytest.raises(InputError, match=r"study.toml: is nested too deeply$"):
        load_study(path)
    for words in (("report", out), ("rerun", out, "--run-id", 0), ("run", path, "-o", out)):
        assert sinsjax(*words) == (2, f"error: {path}: is nested too deeply\n")
    assert resume._kept_study(out) is None  # resume asks the parts whose they are


def test_a_table_that_is_nested_too_deeply() -> None:
    deep: Any = []
    for _ in range(DEEP):
        deep = [deep]
    assert refused({"study": {"window_s": deep}}) == "swing.toml: is nested too deeply"


def test_a_manifest_that_is_nested_too_deeply(
    tmp_path: Path, sinsjax: Command
) -> None:
    out = store(tmp_path / "out", small_study(), pa.table({"run_id": [0]}))
    for text in ("[" * DEEP, '{"a":' * DEEP, '{"chunks":' + "[" * DEEP):
        (out / "manifest.json").write_text(text)
        for words in (("report", out), ("rerun", out, "--run-id", 0)):
            code, error = sinsjax(*words)
            assert code == 2 and error.startswith(f"error: {out}: holds no readable manifest.json")
            assert error.count("\n") == 1
        assert resume.manifest(out) is None  # resume asks the parts


# --- parts ------------------------------------------------------------------------------------


def test_curves_in_place_of_a_summary_are_no_row(tmp_path: Path, sinsjax: Command) -> None:
    curves = pa.table({"run_id": [0, 0, 1, 1], "time_s": [1.0, 2.0, 1.0, 2.0]})
    out = store(tmp_path / "out", small_study(), curves)
    code, error = sinsjax("rerun", out, "--run-id", 1)
    assert code == 2 and error.startswith(f"error: {out}/summary: has 2 rows of run 1: a part")
    assert error.count("\n") == 1


# --- where output goes ------------------------------------------------------------------------


def test_what_was_closed_before_the_start_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a daemon, whose standard streams are None in Python."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    with pytest.raises(SystemExit) as stop, console.lasting():
        print("lost")
        sys.stdout.flush()
    assert stop.value.code == 0


def test_a_reader_that_leaves_does_not_end_the_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What ``| head -1`` does: the sweep goes on to its end, and so do figures and tables."""
    reading, writing = os.pipe()
    os.close(reading)
    done = []

    def finished(*_: Any, **options: Any) -> None:
        for runs in range(1, 4):
            options["tell"](run.RunProgress(runs, 3, 0, 0))
        done.append("runs")

    config = tmp_path / "swing.toml"
    config.write_text(tomli_w.dumps(BASE))
    monkeypatch.setattr(run, "run_into", finished)
    monkeypatch.setattr("sinsjax.report.summarise", lambda *_, **__: done.append("report"))
    monkeypatch.setattr(sys, "argv", ["sinsjax", "sweep", str(config), "-o", str(tmp_path / "o")])
    with open(writing, "w", buffering=1) as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert sys.stdout is closed
    assert done == ["runs", "report"] and not stop.value.code


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_under_the_output_is_one_line(
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


def test_another_end_of_the_work_keeps_its_code() -> None:
    for code in (0, 1, 130):
        with pytest.raises(SystemExit) as stop, console.lasting():
            raise SystemExit(code)
        assert stop.value.code == code
    with pytest.raises(ZeroDivisionError), console.lasting():
        print(1 / 0)


def test_a_platform_that_is_not_there_is_one_line() -> None:
    """In a process of its own: JAX starts once."""
    done = subprocess.run(
        [sys.executable, "-m", "sinsjax", "info"],
        env={**os.environ, "JAX_PLATFORMS": "foo"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: JAX_PLATFORMS=foo: JAX does not start: ")
    runtime.require_backend()


# --- interrupted, and continued -----------------------------------------------------------------


def test_an_interrupted_sweep_names_the_command_that_continues_it(
    sinsjax: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise StudyInterrupted("1 of 3 runs are in out")

    config = tmp_path / "my study.toml"
    config.write_text(tomli_w.dumps(BASE))
    monkeypatch.setattr(run, "run_into", interrupted)
    words = ["sweep", config, "-o", tmp_path / "out", "--draws", 48]
    again = f"sinsjax sweep '{config}' -o {tmp_path / 'out'} --draws 48 --resume"
    for more in ("--overwrite", "--resume"):
        told = f"interrupted: 1 of 3 runs are in out (continue: {again})\n"
        assert sinsjax(*words, more) == (130, told)


def test_ctrl_c_outside_of_the_runs_is_one_line(
    sinsjax: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sinsjax.study.load.load_study", interrupted)
    told = "interrupted: what is stored is kept\n"
    assert sinsjax("sweep", "reset_sweep", "-o", tmp_path / "out") == (130, told)


def test_nothing_is_forecast_of_a_study_that_cannot_be_continued(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    command, out = command_line(monkeypatch, capsys), tmp_path / "out"
    config = tmp_path / "study.toml"
    config.write_text(tomli_w.dumps(BASE))
    out.mkdir()
    (out / "study.toml").write_text(study_to_toml(small_study(study={"draws": 48})))
    (out / "manifest.json").write_text('{"fingerprint": ""}')
    code, told, error = command("sweep", config, "-o", out, "--resume")
    assert (code, told) == (2, "")
    assert error.endswith("(there can be more, not fewer: go on with --draws 48)\n")


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


def test_what_extension_modules_do_at_the_end_does_not_matter() -> None:
    """Exit code and output stand, whatever the objects that are left would do when destroyed."""
    ended = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert ended.stderr.startswith("error: no_such_key: no section, key or method")
    assert ended.stdout.splitlines() == ["threads end", "handlers run"]
