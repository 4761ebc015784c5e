"""How the benchmarks time, count and judge; workloads and clocks are fakes, but for one command."""

import json
import sys
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.batches import batch_of
from support.studies import small_study

from sinsjax.errors import InputError

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import bench
import cases
import gate
import limit
import timing


def fake_workload(name, seconds, calls=None, runs=10, **more):
    left = iter(seconds)

    def call():
        if calls is not None:
            calls.append(name)
        return next(left)

    return timing.Workload(name, runs, 100, 0.5, call, **more)


def test_cases_are_timed_in_turns_and_median_is_reported():
    calls: list[str] = []
    slow = fake_workload("slow", [0.004, 0.1, 0.002], calls)
    fast = fake_workload("fast", [0.001, 0.001, 0.003], calls, runs=1, dtype="float32", devices=2)
    rows = timing.measure_workloads([slow, fast], 3)
    assert calls == [row["name"] for row in rows] * 3 == ["slow", "fast"] * 3
    assert [row["median_s"] for row in rows] == [0.004, 0.001]
    assert [row["ns_per_step_run"] for row in rows] == [4000.0, 10000.0]
    assert [row["spread_s"] for row in rows] == [0.049, 0.001]
    assert [(row["dtype"], row["devices"]) for row in rows] == [("float64", 1), ("float32", 2)]


def test_ratio_is_median_of_per_turn_ratios():
    base = fake_workload("base", [1.0, 2.0, 4.0])
    other = fake_workload("other", [3.0, 4.0, 20.0], runs=20)
    first, second = timing.measure_relative_to_base(base, [other], 3)
    assert "ratio" not in first
    # 1.5, 1 and 2.5 times, where the ratio of the medians would be 1.
    assert second["ratio"] == pytest.approx(1.5)
    assert second["ratio_spread"] == pytest.approx(0.75)


@pytest.fixture(scope="module")
def small_group():
    axes = {"phi_u0_deg": [0.0, 10.0, 20.0, 30.0]}
    group = batch_of(small_study(axes=axes, study={"draws": 64, "duration_s": 20.0}))
    return cases.shorten_runs(group, 2)


@pytest.fixture
def quick_program(monkeypatch):
    """A program that returns at once in place of the engine's."""
    program = SimpleNamespace(compiled=lambda: lambda *_: np.zeros(1))
    monkeypatch.setattr(cases, "trace_program", lambda group, layout: program)


@pytest.mark.usefixtures("quick_program")
@pytest.mark.parametrize(("devices", "elapsed_s"), [(1, 100.0), (2, 1.0)])
def test_engine_is_timed_on_whole_tiles(small_group, monkeypatch, devices, elapsed_s):
    """One device is timed in CPU time, several in wall time: here 1 s with 100 s of CPU time."""
    wall, cpu = count(0.0), count(0.0, 100.0)
    clocks = SimpleNamespace(perf_counter=lambda: next(wall), process_time=lambda: next(cpu))
    monkeypatch.setattr(cases, "time", clocks)
    case = cases.engine_workload("x", small_group, tiles=4, lanes=16, devices=devices)
    runs = 64 * devices
    assert (case.name, case.runs, case.steps, case.devices) == ("x", runs, 200, devices)
    assert case.call() == elapsed_s


@pytest.mark.usefixtures("quick_program")
def test_idle_lanes_are_not_counted_as_runs(small_group):
    few = small_group.select_draws(np.arange(3))
    assert cases.engine_workload("x", few, tiles=4, lanes=16).runs == 3 * 4 < 64


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_command_times_the_engine_and_the_limit_kernel(monkeypatch, capsys, small_group):
    try:
        limit.find_compiler()
    except InputError as error:
        pytest.skip(str(error))
    engine = partial(cases.engine_workload, "engine", small_group, tiles=4, lanes=16, devices=2)
    monkeypatch.setattr(bench, "SHORT", {"engine": engine})
    monkeypatch.setattr(bench, "pin_to_one_core", lambda: None)
    monkeypatch.setattr(sys, "argv", ["bench.py", "--json", "--repeats", "2", "--limit"])
    bench.main()
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["name"] for row in rows] == ["limit_kernel", "engine"]
    assert all(row["compile_s"] > 0 and row["median_s"] > 0 for row in rows)


def test_gate_fails_as_its_worst_set_of_options(monkeypatch):
    results = [gate.judge(ratio, "AVX2", 1.25) for ratio in (1.25, 1.26)]
    assert [result.status for result in results] == [0, 1]
    monkeypatch.setattr(gate, "gate", lambda: results)
    monkeypatch.setattr(sys, "argv", ["gate.py"])
    with pytest.raises(SystemExit) as ended:
        gate.main()
    assert ended.value.code == 1
