"""Workloads are replaced by fakes, except the limit kernel: the short set takes long."""

import json
import shutil
import sys
import tempfile
from functools import partial
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from support.studies import small_study

from sinsjax import bench
from sinsjax.bench import Workload, cases, limit, timing
from sinsjax.bench.limit import limit_kernel_workload
from sinsjax.engine import build
from sinsjax.errors import InputError
from sinsjax.platform import xla

HOLDS = {"cpu": "model X", "sinsjax": "1.2", "jax": "0", "platform": "cpu", "options": "all"}
ROWS = ["kalman_shared_record", "kalman_noise_64", "numpy_baseline"]


def fake_workload(name, seconds, calls=None, runs=10, steps=100, **more):
    left = iter(seconds)

    def call():
        if calls is not None:
            calls.append(name)
        return next(left)

    return Workload(name, runs, steps, 0.5, call, **more)


@pytest.fixture
def fake_workloads(monkeypatch, tmp_path):
    """Leave this process unchanged, compile no engine, put temporary files into tmp_path."""
    monkeypatch.setattr(bench, "pin_to_one_core", lambda: None)
    monkeypatch.setattr(bench, "measurement_conditions", lambda: HOLDS)
    faked = {name: partial(Workload, name, 1, 1, 0.0, lambda: 1e-6) for name in ROWS}
    monkeypatch.setattr(bench, "SHORT", faked)
    monkeypatch.setattr(
        bench, "limit_kernel_workload", partial(limit_kernel_workload, steps=200, vectors=1)
    )
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return monkeypatch


def run_and_parse(capsys, **choices):
    """The rows of a run, and what it says on stderr."""
    bench.run_benchmarks(Console(), as_json=True, repeats=2, **choices)
    told = capsys.readouterr()
    return [json.loads(line) for line in told.out.splitlines()], told.err


def write_tool(path, script):
    """An executable that runs a line of Python."""
    path.write_text(f"#!{sys.executable}\n{script}\n")
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def gcc():
    try:
        return limit.find_compiler()
    except InputError as error:
        pytest.skip(str(error))


def test_cases_are_timed_in_turns_and_median_is_reported():
    calls: list[str] = []
    slow = fake_workload("slow", [0.004, 0.1, 0.002], calls)
    fast = fake_workload("fast", [0.001, 0.001, 0.003], calls, runs=1, dtype="float32", devices=2)
    rows = bench.measure_workloads([slow, fast], 3)
    assert calls == ["slow", "fast"] * 3
    assert [row["name"] for row in rows] == ["slow", "fast"]
    assert [row["median_s"] for row in rows] == [0.004, 0.001]
    assert [row["ns_per_step_run"] for row in rows] == [4000.0, 10000.0]
    assert [row["spread_s"] for row in rows] == [0.049, 0.001]
    assert [(row["dtype"], row["devices"]) for row in rows] == [("float64", 1), ("float32", 2)]
    assert all(row["compile_s"] == 0.5 for row in rows)


def test_ratio_is_median_of_per_turn_ratios():
    base = fake_workload("base", [1.0, 2.0, 4.0])
    other = fake_workload("other", [3.0, 4.0, 20.0], runs=20)
    first, second = timing.measure_relative_to_base(base, [other], 3)
    assert "ratio" not in first
    # 1.5, 1 and 2.5 times, where the ratio of the medians would be 1.
    assert second["ratio"] == pytest.approx(1.5)
    assert second["ratio_spread"] == pytest.approx(0.75)


def test_conditions_list_machine_and_software():
    holds = bench.measurement_conditions()
    machine = "cpu family ghz instructions avx512 cores platform device"
    software = "sinsjax jax jaxlib python options"
    assert list(holds) == f"{machine} {software}".split()
    assert holds["platform"] == "cpu"
    json.dumps(holds)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({}, "all"),
        (dict.fromkeys((option.name for option in xla.required_options()), None), "none"),
        ({xla.required_options()[0].name: "other"}, None),
    ],
)
def test_xla_options_that_are_set_are_summarised(values, told):
    options = {option.name: option.value for option in xla.required_options()} | values
    rest = " ".join(option.name.removeprefix("xla_cpu_") for option in xla.required_options()[1:])
    assert timing._describe_options(options) == (told or rest)


@pytest.mark.parametrize("name", ["configs/reset_sweep.toml", "benchmarks/limit_kernel.c"])
def test_assets_are_found(name):
    assert bench.asset_path(name).is_file()


def test_limit_kernel_runs(gcc, tmp_path):
    case = limit_kernel_workload(gcc, str(tmp_path), steps=200, vectors=1)
    assert (case.runs, case.steps) == (8, 200)
    assert case.compile_s > 0
    assert 0 < case.call() < 1


def test_run_with_limit_kernel_leaves_no_temp_files(gcc, fake_workloads, tmp_path, capsys):
    rows, said = run_and_parse(capsys, limit=True)
    assert [row["name"] for row in rows] == ["limit_kernel", *ROWS]
    assert all(HOLDS.items() <= row.items() for row in rows)
    assert said == ""
    assert not list(tmp_path.iterdir())


def test_missing_gcc_warns_and_skips_limit_kernel(fake_workloads, capsys):
    fake_workloads.setattr(shutil, "which", lambda name: None)
    rows, said = run_and_parse(capsys, limit=True)
    without, silent = run_and_parse(capsys, limit=False)
    assert said == "warning: no limit kernel: gcc not found\n"
    assert silent == ""
    assert [row["name"] for row in rows] == [row["name"] for row in without] == ROWS


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("raise SystemExit(1)", "gcc failed: exit status 1"),
        ("pass", "a program built by gcc cannot be started: No such file or directory"),
    ],
)
def test_broken_gcc_warns_and_skips_limit_kernel(fake_workloads, tmp_path, capsys, script, why):
    write_tool(tmp_path / "gcc", script)
    fake_workloads.setenv("PATH", str(tmp_path))
    rows, said = run_and_parse(capsys, limit=True)
    assert said == f"warning: no limit kernel: {why}\n"
    assert [row["name"] for row in rows] == ROWS


def test_missing_compiler_options_warn_only_on_cpu(fake_workloads, capsys):
    for platform, warned in (("cpu", True), ("gpu", False)):
        holds = HOLDS | {"platform": platform, "options": "none"}
        fake_workloads.setattr(bench, "measurement_conditions", lambda holds=holds: holds)
        assert ("compiler options" in run_and_parse(capsys, limit=False)[1]) == warned


def test_table_shows_ratio_to_limit_kernel(gcc, fake_workloads, capsys):
    bench.run_benchmarks(Console(width=80), as_json=False, limit=True, repeats=1)
    told = capsys.readouterr().out
    assert "x limit" in told and "1.00" in told and "model X" in told
    assert max(map(len, told.splitlines())) <= 80


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("raise SystemExit(3)", "gcc failed: exit status 3"),
        ("raise SystemExit('no such option\\nmore')", "gcc failed: no such option"),
    ],
)
def test_failing_compiler_raises_one_line_error(tmp_path, script, why):
    with pytest.raises(InputError) as told:
        limit_kernel_workload(write_tool(tmp_path / "gcc", script), str(tmp_path))
    assert str(told.value) == why


def test_missing_compiler_raises_input_error(tmp_path):
    with pytest.raises(InputError, match="^gcc cannot be started: "):
        limit_kernel_workload(str(tmp_path / "none"), str(tmp_path))


@pytest.mark.parametrize(
    ("script", "why"),
    [("import os; os.kill(os.getpid(), 9)", "signal 9"), ("raise SystemExit(2)", "exit status 2")],
)
def test_failing_limit_kernel_raises_one_line_error(tmp_path, script, why):
    case = limit_kernel_workload(write_tool(tmp_path / "gcc", ""), str(tmp_path))
    write_tool(tmp_path / "limit", script)
    with pytest.raises(InputError) as told:
        case.call()
    assert str(told.value) == f"the limit kernel failed: {why}"


def test_registry_rows_have_their_listed_names(monkeypatch):
    monkeypatch.setattr(cases, "engine_workload", lambda name, group: fake_workload(name, []))
    monkeypatch.setattr(
        cases, "numpy_baseline_workload", lambda group: fake_workload("numpy_baseline", [])
    )
    assert {name: make().name for name, make in cases.SHORT.items()} == {n: n for n in cases.SHORT}


def test_compass_groups_match_kalman_samples_and_sizes():
    kalman, compass, stored = cases.default_group(), *map(cases.compass_group, (None, 80.0))
    for group in (compass, stored):
        assert group.sizes == kalman.sizes
        own = group.environment.sensors.increments
        np.testing.assert_array_equal(own, kalman.environment.sensors.increments[: len(own)])
        assert group.static.method == "compass"
        assert group.static.records == kalman.static.records
    assert (compass.static.passes, stored.static.passes) == ("once", "alternate")
    assert (
        len(stored.environment.sensors.increments) == 8000
        and int(stored.environment.pass_records) == 80
    )
    assert len({tuple(row) for row in np.stack(compass.variants.method.azimuth[:3], 1)}) == 8


@pytest.fixture(scope="module")
def small_group():
    axes = {"phi_u0_deg": [0.0, 10.0, 20.0, 30.0]}
    (part,) = build.parts(small_study(axes=axes, study={"draws": 64, "duration_s": 20.0}))
    return part.group


def test_some_variants_picks_last_variants_with_enough_draws(small_group):
    group = cases.select_last_variants(small_group, 3, min_runs=1000)
    draws, variants = group.sizes
    assert variants == 3 and draws * variants >= 1000
    assert len(set(group.draws.draw_id.tolist())) == draws == len(group.q)
    np.testing.assert_array_equal(group.variants.phi[2], small_group.variants.phi[2][1:])


def test_without_noise_removes_only_noise(small_group):
    fake_workloads = cases.remove_noise(small_group)
    assert (
        not fake_workloads.environment.sensors.errors.gyro_noise.any()
        and not fake_workloads.environment.sensors.errors.accel_noise.any()
    )
    assert fake_workloads.static == small_group.static._replace(
        sensors=small_group.static.sensors._replace(noisy=False)
    )
    np.testing.assert_array_equal(
        fake_workloads.environment.sensors.errors.gyro_bias,
        small_group.environment.sensors.errors.gyro_bias,
    )


@pytest.fixture
def quick_program(monkeypatch):
    """A program that returns at once in place of the engine's."""
    monkeypatch.setattr(cases, "compile_program", lambda group, tiles: lambda *_: np.zeros(1))


@pytest.mark.usefixtures("quick_program")
@pytest.mark.parametrize(("devices", "elapsed_s"), [(1, 100.0), (2, 1.0)])
def test_engine_is_timed_on_whole_tiles(small_group, monkeypatch, devices, elapsed_s):
    """One device is timed in CPU time, several in wall time: here 1 s with 100 s of CPU time."""
    wall, cpu = count(0.0), count(0.0, 100.0)
    clocks = SimpleNamespace(perf_counter=lambda: next(wall), process_time=lambda: next(cpu))
    monkeypatch.setattr(cases, "time", clocks)
    case = cases.engine_workload(
        "x", cases.shorten_runs(small_group, 2), tiles=4, lanes=16, devices=devices
    )
    runs = 64 * devices
    assert (case.name, case.runs, case.steps, case.devices) == ("x", runs, 200, devices)
    assert case.compile_s > 0
    assert case.call() == elapsed_s


@pytest.mark.usefixtures("quick_program")
def test_idle_lanes_are_not_counted_as_runs(small_group):
    few = cases.shorten_runs(small_group.select(np.arange(3), np.arange(4)), 2)
    assert cases.engine_workload("x", few, tiles=4, lanes=16).runs == 3 * 4 < 64


@pytest.mark.slow
@pytest.mark.optimised(False)
def test_engine_workload_runs_program_of_engine(small_group):
    group = cases.shorten_runs(small_group, 2)
    case = cases.engine_workload("x", group, tiles=4, lanes=16, devices=2)
    assert case.compile_s > 0 and case.call() > 0


@pytest.mark.slow
def test_baseline_that_differs_from_engine_is_refused(small_group, monkeypatch):
    wrong = lambda *_: (np.eye(3), np.zeros(5))  # noqa: E731
    monkeypatch.setattr(cases, "align_with_numpy_loop", wrong)
    with pytest.raises(RuntimeError, match="the NumPy baseline and the engine differ"):
        cases.numpy_baseline_workload(cases.remove_noise(small_group))
