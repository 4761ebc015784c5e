"""What is timed is faked here, but for the limit kernel: the short set itself takes long."""

import json
import shutil
import sys
import tempfile

import pytest
from rich.console import Console

from sinsjax import bench, runtime
from sinsjax.bench import Case
from sinsjax.types import InputError

FACTS = {"cpu": "model X", "sinsjax": "1.2", "jax": "0", "fused_loop": True}


def fake(name, seconds, calls, runs=10, steps=100):
    left = iter(seconds)

    def call():
        calls.append(name)
        return next(left)

    return Case(name, runs, steps, 0.5, call)


@pytest.fixture
def quiet(monkeypatch, tmp_path):
    """Nothing of this process is changed, no engine is compiled, temporary files go to tmp_path."""
    monkeypatch.setattr(bench.os, "sched_setaffinity", lambda *_: None, raising=False)
    monkeypatch.setattr(runtime, "configure", lambda **_: None)
    monkeypatch.setattr(runtime, "info", lambda: FACTS)
    monkeypatch.setattr(bench, "default_group", lambda: None)
    monkeypatch.setattr(bench, "without_noise", lambda group: group)
    monkeypatch.setattr(bench, "some_variants", lambda group, count: group)
    monkeypatch.setattr(bench, "engine", lambda name, group: Case(name, 1, 1, 0.0, lambda: 1e-6))
    monkeypatch.setattr(
        bench, "numpy_baseline", lambda group: Case("numpy_baseline", 1, 1, 0.0, lambda: 1e-3)
    )
    monkeypatch.setattr(bench, "_KERNEL_SIZE", (200, 1))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return monkeypatch


def timed(capsys, **choices):
    """The rows of a run, and what it says on stderr."""
    bench.run(Console(), as_json=True, repeats=2, **choices)
    told = capsys.readouterr()
    return [json.loads(line) for line in told.out.splitlines()], told.err


def tool(path, script):
    """An executable that runs a line of Python."""
    path.write_text(f"#!{sys.executable}\n{script}\n")
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def gcc():
    found = shutil.which("gcc")
    if found is None:
        pytest.skip("no gcc")
    return found


def test_cases_are_timed_in_turns_and_the_median_is_told():
    calls: list[str] = []
    slow = fake("slow", [0.004, 0.1, 0.002], calls)
    fast = fake("fast", [0.001, 0.001, 0.003], calls, runs=1)
    rows = bench.measure([slow, fast], 3)
    assert calls == ["slow", "fast"] * 3
    assert [row["name"] for row in rows] == ["slow", "fast"]
    assert [row["median_s"] for row in rows] == [0.004, 0.001]
    assert [row["ns_per_step_run"] for row in rows] == [4000.0, 10000.0]
    assert [row["spread_s"] for row in rows] == [0.049, 0.001]
    assert all(row["compile_s"] == 0.5 for row in rows)


@pytest.mark.parametrize("name", ["configs/reset_sweep.toml", "benchmarks/limit_kernel.c"])
def test_assets_are_found(name):
    assert bench.asset(name).is_file()


def test_limit_kernel_runs(gcc, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "_KERNEL_SIZE", (200, 1))
    case = bench.limit_kernel(gcc, str(tmp_path))
    assert (case.runs, case.steps) == (8, 200)
    assert case.compile_s > 0
    assert 0 < case.call() < 1


def test_a_run_with_the_kernel_leaves_nothing_behind(gcc, quiet, tmp_path, capsys):
    rows, said = timed(capsys, limit=True)
    assert rows[0]["name"] == "limit_kernel" and len(rows) == 6
    assert all((row["cpu"], row["sinsjax"]) == ("model X", "1.2") for row in rows)
    assert said == ""
    assert not list(tmp_path.iterdir())


def test_without_gcc_it_says_so_and_goes_on(quiet, capsys):
    quiet.setattr(shutil, "which", lambda name: None)
    rows, said = timed(capsys, limit=True)
    without, silent = timed(capsys, limit=False)
    assert said == "warning: no limit kernel: there is no gcc here to build it\n"
    assert silent == ""
    assert [row["name"] for row in rows] == [row["name"] for row in without]
    assert len(rows) == 5


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("raise SystemExit(3)", "gcc failed: exit status 3"),
        ("raise SystemExit('no such option\\nmore')", "gcc failed: no such option"),
    ],
)
def test_a_failing_compiler_is_told_in_one_line(tmp_path, script, why):
    with pytest.raises(InputError) as told:
        bench.limit_kernel(tool(tmp_path / "gcc", script), str(tmp_path))
    assert str(told.value) == f"--limit: {why}"


def test_a_compiler_that_does_not_start_is_told(tmp_path):
    with pytest.raises(InputError, match="^--limit: gcc cannot be started: "):
        bench.limit_kernel(str(tmp_path / "none"), str(tmp_path))


@pytest.mark.parametrize(
    ("script", "why"),
    [("import os; os.kill(os.getpid(), 9)", "signal 9"), ("raise SystemExit(2)", "exit status 2")],
)
def test_a_kernel_that_dies_is_told_in_one_line(tmp_path, script, why):
    case = bench.limit_kernel(tool(tmp_path / "gcc", ""), str(tmp_path))
    tool(tmp_path / "limit", script)
    with pytest.raises(InputError) as told:
        case.call()
    assert str(told.value) == f"--limit: the limit kernel failed: {why}"
