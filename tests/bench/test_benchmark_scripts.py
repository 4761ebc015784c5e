"""The scripts of ``benchmarks/``: faked timings, and their quick path on a real engine."""

import csv
import json
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sinsjax.bench import limit
from sinsjax.bench.timing import Row, Workload
from sinsjax.errors import InputError
from sinsjax.methods.registry import METHODS

FOLDER = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import answer  # noqa: E402
import common  # noqa: E402
import derivative  # noqa: E402
import devices  # noqa: E402
import first_command  # noqa: E402
import gate  # noqa: E402
import gpu  # noqa: E402
import instructions  # noqa: E402
import memory  # noqa: E402
import methods  # noqa: E402
import noise  # noqa: E402
import page  # noqa: E402
import pairs  # noqa: E402
import record  # noqa: E402
import resolve  # noqa: E402
import single_precision  # noqa: E402
import store  # noqa: E402
import throughput  # noqa: E402
from targets import judged  # noqa: E402

HOLDS: Row = {
    "cpu": "AMD EPYC 9999 64-Core Processor",
    "avx512": True,
    "cores": 2,
    "platform": "cpu",
    "device": "cpu",
    "sinsjax": "0.1.0",
    "jax": "0.10.2",
    "jaxlib": "0.10.2",
    "python": "3.11.7",
    "options": "all",
}


def fake_row(of: str, name: str, ns: float, **more: object) -> Row:
    """A row of the history."""
    sizes = {"runs": 128, "steps": 90000, "dtype": "float64", "devices": 1, "compile_s": 1.5}
    seconds = {"median_s": round(ns * 128 * 9e-5, 5), "spread_s": 0.012}
    row = {"set": of, "date": "2025-01-02", "name": name, "ns_per_step_run": ns}
    return row | sizes | seconds | HOLDS | more


def history_rows(version: str = "0.1.0", factor: float = 1.0, **changes: object) -> list[Row]:
    """Rows of every set but the GPU's, with numbers that are easy to find on a page."""
    ns = {"limit_kernel": 10.0, "kalman_shared_record": 14.2 * factor, "kalman_noise_64": 15.1}
    ns |= {"kalman_noise_6": 17.3, "kalman_noise_1": 24.9, "numpy_baseline": 448286.3}
    rows = [fake_row("short", name, value) for name, value in ns.items()]
    spread = {"ratio_spread": 0.03}
    rows += [
        fake_row("pairs", "limit_kernel", 10.0),
        fake_row(
            "pairs",
            "kalman_shared_record",
            14.2 * factor,
            ratio=1.42 * factor,
            ratios=[1.4, 1.42, 1.45],
            **spread,
        ),
    ]
    lanes = {16: 40.1, 32: 22.0, 48: 17.2, 64: 14.2, 80: 13.9, 96: 14.8, 128: 18.0, 256: 33.3}
    rows += [fake_row("throughput", f"lanes_{n}", x * factor, lanes=n) for n, x in lanes.items()]
    rows += [
        fake_row("throughput", f"tiles_{n}", 14.2 + n / 50, tiles=n) for n in (2, 4, 8, 16, 32)
    ]
    variants = {1: 24.9, 2: 20.0, 4: 18.1, 8: 16.9, 16: 15.9, 32: 15.4, 64: 15.1}
    rows += [fake_row("throughput", f"variants_{n}", x, variants=n) for n, x in variants.items()]
    rows += [fake_row("throughput", "curves_off", 14.2), fake_row("throughput", "curves_on", 14.9)]
    rows += [fake_row("noise", "noise_off", 14.2)]
    ratios = {64: 1.06, 6: 1.22, 1: 1.75}
    rows += [
        fake_row("noise", f"noise_{n}", 14.2 * x, ratio=x, variants=n, **spread)
        for n, x in ratios.items()
    ]
    rows += [
        fake_row("devices", f"devices_{n}", 14.2 / s, devices=n, speedup=s, speedup_spread=0.02)
        for n, s in ((1, 1.0), (2, 1.87))
    ]
    rows += [fake_row("devices", "call_900s", 7.6, devices=2)]
    rows += [fake_row("devices", "sweep_900s", 8.3, devices=2, share=0.91, share_spread=0.01)]
    rows += [fake_row("loops", "numba_loop", 6200.0)]
    rows += [
        {k: v for k, v in fake_row("memory", name, 0.0, **more).items() if k != "ns_per_step_run"}
        for name, more in (
            ("memory_call_2_tiles", {"bytes_per_run": 21000, "temp_bytes": 5}),
            ("memory_sweep_448", {"before_mib": 240, "peak_mib": 1510}),
        )
    ]
    return [row | {"sinsjax": version} | changes for row in rows]


def all_rows(folder: Path, machine: str = "*amd*") -> list[dict[str, str]]:
    """Rows of a machine's CSV file, which the page links to."""
    (path,) = (folder / "tables").glob(f"performance_{machine}.csv")
    assert f"](tables/{path.name})" in "".join(page.read_text() for page in folder.glob("*.md"))
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_history(folder: Path, *pieces: list[Row]) -> list[store.Machine]:
    for rows in pieces:
        store.keep(rows, record.SETS, folder)
    return store.machines(folder)


# -- the gate ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measured", "status", "line"),
    [
        (1.25, 0, "passed: 1.25 x the limit with AVX2 is within the bound of 1.25"),
        (1.26, 1, "failed: 1.26 x the limit with AVX2 is above the bound of 1.25"),
    ],
)
def test_gate_passes_or_fails_by_ratio(measured, status, line):
    assert gate.judge(measured, "AVX2", 1.25) == (status, f"gate {line}")


@pytest.fixture
def fake_gate(monkeypatch):
    """A gate that measures 1.42 with each set, on a machine that has both; the sets asked for."""
    asked: list[str] = []

    def row(instructions: str) -> Row:
        asked.append(instructions)
        (found,) = (r for r in history_rows() if r["set"] == "pairs" and "ratio" in r)
        return found | {"kernel_ns": 10.0}

    monkeypatch.setattr(gate, "measured", row)
    monkeypatch.setattr(gate, "find_compiler", lambda: "gcc")
    monkeypatch.setattr(gate.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(gate.machine, "instruction_set", lambda limit="": "AVX512")
    return monkeypatch, asked


def test_gate_measures_each_available_instruction_set(fake_gate, capsys):
    patch, asked = fake_gate
    assert [verdict.status for verdict in gate.gate()] == [0, 1]
    assert asked == ["AVX512", "AVX2"]
    assert f"ratios of {gate.PAIRS} pairs: 1.40, 1.42, 1.45; median 1.42" in capsys.readouterr().out
    lines = []
    for largest in ("AVX2", "SSE4_2"):
        patch.setattr(gate.machine, "instruction_set", lambda limit="", largest=largest: largest)
        lines += [verdict.line for verdict in gate.gate()]
    assert lines == [
        "gate passed: 1.42 x the limit with AVX2 is within the bound of 1.50",
        "gate failed: 1.42 x the limit with SSE4_2 is above the bound of 1.25",
    ]
    assert asked[2:] == ["AVX2", "SSE4_2"]


def test_gate_exits_with_worst_status(fake_gate, capsys):
    patch, _ = fake_gate
    patch.setattr(sys, "argv", ["gate.py"])
    with pytest.raises(SystemExit) as ended:
        gate.main()
    assert ended.value.code == 1
    told = capsys.readouterr().out.splitlines()[-2:]
    assert told[0].startswith("gate passed") and told[1].startswith("gate failed")


@pytest.mark.parametrize(
    ("what", "answer", "why"),
    [
        ("gcc", "", "gcc not found"),
        ("gcc", "exit 1", "gcc failed: exit status 1"),
        ("machine", "arm64", "the limit kernel is for x86-64"),
    ],
)
def test_gate_is_skipped_if_limit_kernel_cannot_be_built(fake_gate, fake_tools, what, answer, why):
    patch, asked = fake_gate
    if what == "gcc":
        patch.setattr(gate, "find_compiler", limit.find_compiler)
        fake_tools(gcc=answer)
    else:
        patch.setattr(gate.platform, what, lambda: answer)
    (verdict,) = gate.gate()
    assert verdict.status == 0 and verdict.line.startswith(f"gate skipped: {why}")
    assert asked == []


def test_gate_reports_failed_measurement_in_one_line(fake_gate, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(sys, "executable", "false")
    with pytest.raises(InputError, match="no ratio with AVX2: exit status 1"):
        gate.measured("AVX2")


# -- scripts -------------------------------------------------------------------------------------


@pytest.fixture
def fake_tools(monkeypatch, tmp_path):
    """Make the only programs there are: shell scripts by name; an empty one is not there."""

    def make(**scripts: str) -> None:
        folder = tmp_path / "bin"
        folder.mkdir()
        for name, script in scripts.items():
            if script:
                (folder / name).write_text(f"#!/bin/sh\n{script}\n")
                (folder / name).chmod(0o755)
        monkeypatch.setenv("PATH", str(folder))

    return make


@pytest.fixture
def unpinned(monkeypatch):
    monkeypatch.setattr(common, "pin_to_one_core", lambda: None)
    monkeypatch.setattr(common.runtime, "configure", lambda: None)
    monkeypatch.setattr(common, "measurement_conditions", lambda: HOLDS)


def test_script_passes_flags_on_and_adds_conditions_to_rows(unpinned, capsys):
    asked = []

    def rows(quick: bool, repeats: int) -> list[Row]:
        asked.append((quick, repeats))
        return [{"name": "a", "platform": "mine"}]

    common.main(rows, ["--json", "--quick", "--repeats", "3"])
    common.main(rows, ["--json"], one_core=False, repeats=2)
    assert asked == [(True, 3), (False, 2)]
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines == [HOLDS | {"name": "a", "platform": "mine"}] * 2


def test_script_prints_table_of_rows(unpinned, capsys):
    common.main(
        lambda quick, repeats: [fake_row("x", "one", 14.2, ratio=1.5, ratio_spread=0.1)], []
    )
    out = capsys.readouterr().out
    assert "one" in out and "1.5 +- 0.1" in out and HOLDS["cpu"] in out


def test_input_error_in_script_is_reported_in_one_line(unpinned, capsys):
    def rows(quick: bool, repeats: int) -> list[Row]:
        raise InputError("no gcc here")

    with pytest.raises(SystemExit) as ended:
        common.main(rows, [])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "error: no gcc here\n"


def test_gpu_script_without_gpu_reports_no_gpu(capsys):
    assert gpu.rows(True, 1) == []
    assert capsys.readouterr().err == "no GPU: JAX has cpu only\n"


@pytest.mark.parametrize(("script", "why"), [("", "gcc not found"), ("exit 1", "gcc failed")])
def test_pairs_script_raises_without_working_gcc(fake_tools, script, why):
    fake_tools(gcc=script)
    with pytest.raises(InputError, match=why):
        pairs.rows(True, 1)


@pytest.mark.parametrize("duration_s", [9.0, 90.0, 900.0])
def test_sweep_study_keeps_its_size_at_any_duration(duration_s):
    study = devices.sweep_study(duration_s, 32)
    assert study.n_draws * study.n_variants == 10240
    assert study.study.window_s[1] == pytest.approx(duration_s)
    assert len(set(study.values("reset_cycle_s"))) == 8


def test_speedup_is_relative_to_one_device_in_same_repeat(monkeypatch):
    taken = {1: iter([8.0, 9.0, 8.0]), 2: iter([4.0, 6.0, 5.0])}

    def engine(name: str, group: Any, *, tiles: int, devices: int) -> Workload:
        assert tiles % (2 * devices) == 0
        runs = 64 * tiles * devices
        return Workload(name, runs, 9000, 0.0, lambda: next(taken[devices]), devices=devices)

    monkeypatch.setattr(devices, "engine_workload", engine)
    one, two = devices.scaling(False, 3)
    assert (one["name"], one["speedup"]) == ("devices_1", 1.0)
    assert (two["name"], two["devices"]) == ("devices_2", 2)
    assert (two["speedup"], two["speedup_spread"]) == (1.6, 0.25)


@cache
def quick_rows(script: ModuleType) -> list[Row]:
    """Rows of a script's quick path."""
    rows: list[Row] = script.rows(True, 1)
    return rows


@pytest.mark.slow
@pytest.mark.optimised(False)
@pytest.mark.parametrize(
    "script", [pairs, throughput, noise, methods, answer, devices, derivative, single_precision]
)
def test_quick_path_of_script_returns_valid_rows(script):
    if script is pairs and (why := gate.unable()):
        pytest.skip(why)
    rows = quick_rows(script)
    keys = "name ns_per_step_run runs steps dtype devices compile_s median_s spread_s".split()
    assert all(set(keys) <= row.keys() for row in rows)
    assert all(0 < row["ns_per_step_run"] < 1e6 for row in rows)
    assert len({row["name"] for row in rows}) == len(rows) > 0
    json.dumps(rows)


@pytest.mark.slow
def test_resolve_script_is_timed_and_judged_against_targets(tmp_path):
    rows = resolve.rows(True, 1)
    assert [row["name"] for row in rows] == ["resolve_6000", "part_6000"]
    assert all(0 < row["median_s"] < 10 for row in rows)
    slow = [
        fake_row("resolve", n, 0.0, median_s=0.3, spread_s=0.0) for n in ("resolve_6", "part_6")
    ]
    (machine,) = write_history(tmp_path, slow)
    assert [(row.target, row.measured, row.reached) for row in judged(machine)] == [
        ("< 500 ms", "300 ± 0 ms", True),
        ("< 50 ms", "300 ± 0 ms", False),
    ]


@pytest.mark.slow
@pytest.mark.optimised(False)
def test_memory_script_reports_bytes_per_run_and_peak():
    plain, curves, sweep = memory.rows(True, 1)
    assert 0 < plain["bytes_per_run"] < curves["bytes_per_run"]
    assert sweep["before_mib"] < sweep["peak_mib"] < 2000


@pytest.mark.slow
def test_instructions_script_reports_counts_if_available(capsys):
    rows = instructions.rows(True, 1)
    if not rows:
        pytest.skip(capsys.readouterr().err.strip())
    assert all(0 < row[key] < 1e5 for row in rows for key in ("instructions", "loads", "stores"))


PERFS = {
    "": "perf cannot be started: No such file or directory",
    "exit 1": "perf stat: exit status 1",
    "echo \"event syntax error: '..ld_dispatch:u'\" >&2; exit 129": (
        "perf stat: event syntax error: '..ld_dispatch:u'"
    ),
    "echo Error: >&2; echo Access is limited. >&2; echo More >&2; exit 255": (
        "perf stat: Access is limited."
    ),
    'for e in a b c d; do echo "<not supported>;;$e:u;0;100.00;;" >&2; done': (
        "perf stat: a:u: not supported"
    ),
}
"""Fake perf programs that cannot count, and the reported reasons."""


@pytest.mark.parametrize(("script", "why"), PERFS.items())
def test_perf_that_cannot_count_gives_warning_and_no_rows(
    monkeypatch, fake_tools, capsys, script, why
):
    monkeypatch.setattr(instructions.machine, "cpu_info", lambda: {"vendor_id": "AuthenticAMD"})
    monkeypatch.setattr(instructions, "find_compiler", lambda: "gcc")
    fake_tools(perf=script)
    assert instructions.rows(True, 1) == []
    assert capsys.readouterr().err == f"warning: nothing is counted: {why}\n"


def test_unknown_cpu_vendor_gives_warning_and_no_rows(monkeypatch, capsys):
    monkeypatch.setattr(instructions.machine, "cpu_info", dict)
    assert instructions.rows(True, 1) == []
    expected = "warning: nothing is counted: only the counters of AMD and Intel are known\n"
    assert capsys.readouterr().err == expected


def test_counts_per_step_are_difference_of_long_and_short_run():
    few, many = {"instructions": 100, "stores": 30}, {"instructions": 400, "stores": 130}
    expected = {"name": "x", "step_runs": 50, "instructions": 6.0, "stores": 2.0}
    assert instructions.row("x", few, many, 50) == expected


@pytest.mark.slow
def test_script_starts_from_any_directory(tmp_path):
    path = os.pathsep.join([str(FOLDER.parent), os.environ.get("PYTHONPATH", "")])
    ended = subprocess.run(
        [sys.executable, str(FOLDER / "gpu.py"), "--quick", "--json", "--repeats", "1"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"},
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "no GPU: JAX has cpu only\n")


# -- the history ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({}, "0.1.0_amd-epyc-9999-64-core-avx512.json"),
        ({"cpu": "AMD EPYC", "avx512": False}, "0.1.0_amd-epyc.json"),
        (
            {"cpu": "Intel(R) Xeon(R) Platinum 8481C CPU @ 2.70GHz"},
            "0.1.0_intel-xeon-platinum-8481c-avx512.json",
        ),
        (
            {"platform": "gpu", "device": "NVIDIA H100 80GB HBM3"},
            "0.1.0_nvidia-h100-80gb-hbm3.json",
        ),
    ],
)
def test_history_file_is_named_after_version_and_machine(changes, name):
    assert store.file_name(HOLDS | changes) == name


def test_repeated_measurement_replaces_only_rows_of_its_set(tmp_path):
    store.keep(history_rows(), record.SETS, tmp_path)
    (path,) = store.keep([fake_row("noise", "noise_off", 99.123456789)], record.SETS, tmp_path)
    rows = store.read(path)
    assert [r["ns_per_step_run"] for r in rows if r["set"] == "noise"] == [99.123]
    rest = [(r["set"], r["name"]) for r in history_rows() if r["set"] != "noise"]
    rest.sort(key=lambda row: record.SETS.index(row[0]))
    assert [(r["set"], r["name"]) for r in rows if r["set"] != "noise"] == rest
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert len(path.read_text().splitlines()) == len(rows) + 2


@pytest.mark.parametrize("text", ["{", '["a"]', '[{"name": "x"}]', "3"])
def test_invalid_history_file_is_reported_by_name(tmp_path, text):
    path = tmp_path / "0.1.0_x.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"^0\.1\.0_x\.json: "):
        store.read(path)


def test_machines_are_sorted_by_version(tmp_path):
    found = write_history(
        tmp_path, history_rows("0.10.0"), history_rows("0.9.0"), history_rows("0.2.1", avx512=False)
    )
    assert [machine.version for machine in found] == ["0.2.1", "0.9.0", "0.10.0"]
    assert [machine.x_limit for machine in found] == [1.42] * 3


def test_ratio_without_pairs_is_read_from_short_set(tmp_path):
    rows = [row for row in history_rows() if row["set"] == "short"]
    (machine,) = write_history(tmp_path, rows)
    assert machine.x_limit == pytest.approx(1.42)


def test_record_script_stores_version_date_and_set(tmp_path, monkeypatch, capsys):
    commands = []

    def run(command, **_):
        commands.append(command)
        rows = [fake_row("?", "noise_off", 5.0, sinsjax="0+source"), fake_row("?", "noise_64", 6.0)]
        told_lines = "\n".join(json.dumps(row) for row in rows)
        return subprocess.CompletedProcess(command, 0, told_lines)

    monkeypatch.setattr(record.subprocess, "run", run)
    with pytest.raises(SystemExit) as ended:
        record.main(["--only", "noise,short", "--repeats", "2"], tmp_path)
    assert ended.value.code == 0
    assert [Path(commands[0][1]).name, *commands[0][2:]] == ["noise.py", "--json", "--repeats", "2"]
    assert commands[1][1:] == "-m sinsjax bench --limit --json --repeats 2".split()
    (path,) = tmp_path.iterdir()
    rows = store.read(path)
    assert [row["set"] for row in rows] == ["short"] * 2 + ["noise"] * 2
    assert all(row["sinsjax"] == common.source_version() for row in rows)
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d", row["date"]) for row in rows)


def test_failing_set_does_not_stop_other_sets(monkeypatch, capsys, tmp_path):
    def measured(name, repeats):
        if name == "noise":
            raise InputError("noise: failed with exit status 1")
        return []

    monkeypatch.setattr(record, "measured", measured)
    with pytest.raises(SystemExit) as ended:
        record.main(["--only", "noise,gpu"], tmp_path)
    out, err = capsys.readouterr()
    assert ended.value.code == 1
    assert err == "error: noise: failed with exit status 1\n"
    assert "gpu: 0 rows to nothing" in out


def test_unknown_benchmark_set_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        record.main(["--only", "noize"])
    assert ended.value.code == 2
    assert "no set noize" in capsys.readouterr().err


def test_every_measuring_script_is_registered_as_set():
    scripts = [p.stem for p in FOLDER.glob("*.py") if "\n    common.main(rows" in p.read_text()]
    assert set(scripts) <= set(record.SCRIPTS)


# -- the page ------------------------------------------------------------------------------------


def test_targets_are_judged_from_history_rows(tmp_path):
    (machine,) = write_history(tmp_path, history_rows())
    found = {row.what: row for row in judged(machine)}
    reached = [row.reached for row in found.values()]
    assert reached == [True, True, True, False, True, True]
    pair = found["`kalman_shared_record`, times the limit kernel"]
    assert (pair.target, pair.measured) == ("≤ 1.45", "1.42 ± 0.03")
    drawn = found["`kalman_noise_1`, times the limit kernel"]
    assert (drawn.target, drawn.measured) == ("≤ 3.2", "2.49")
    assert pair.conditions.startswith("3 alternating pairs")


@pytest.mark.parametrize(("ratio", "reached"), [(0.99, True), (1.01, False)])
def test_target_of_limit_ratio_depends_on_instruction_set(tmp_path, ratio, reached):
    more = {"ratio": ratio, "ratio_spread": 0.01, "ratios": [ratio] * 7, "avx512": False}
    rows = [fake_row("pairs", name, 15.0, **more) for name in ("kalman_shared_record",)]
    rows.append(fake_row("pairs", "kalman_shared_covariance", 8.0, **more))  # has none for this set
    (machine,) = write_history(tmp_path, rows)
    (record_row,) = judged(machine)
    assert (record_row.target, record_row.reached) == ("≤ 1", reached)


@pytest.mark.parametrize(("operations", "most"), [(3.4, "4.1"), (2.0, "3.6")])
def test_derivative_target_is_larger_of_two_bounds(tmp_path, operations, most):
    more = {"ratio": 4.0, "ratio_spread": 0.1, "operations_ratio": operations}
    (machine,) = write_history(tmp_path, [fake_row("derivative", "derivative_p1", 57.0, **more)])
    (row,) = judged(machine)
    assert row.target == f"≤ {most}"
    assert row.reached == (most == "4.1")


@pytest.mark.parametrize(("ratio", "reached"), [(4.9, True), (5.1, False)])
def test_target_of_tuning_gradient_is_its_counted_cost(tmp_path, ratio, reached):
    more = {"ratio": ratio, "ratio_spread": 0.1, "operations_ratio": 4.0, "counted": 5}
    rows = [fake_row("derivative", "tune_plain", 50.0)]
    rows.append(fake_row("derivative", "tune_gradient_p2", 250.0, **more))
    machines = write_history(tmp_path / "history", rows)
    (row,) = judged(machines[0])
    assert (row.target, row.reached) == ("≤ 5", reached)
    page.write(tmp_path / "p.md", machines, "")
    shown = f"{ratio:.2f} ± 0.10" if reached else f"**{ratio:.2f} ± 0.10**"
    assert f"| {row.what} | {row.target} | {shown} |" in (tmp_path / "p.md").read_text()


@pytest.mark.parametrize(("ns", "reached"), [(119.0, True), (121.0, False)])
def test_target_of_drawn_base_motion_is_120_ns(tmp_path, ns, reached):
    rows = [fake_row("noise", "silent_2", 25.0), fake_row("noise", "noise_2", 34.0)]
    row = fake_row("noise", "base_2", ns, ratio=8.0, ratio_spread=0.1, variants=2)
    rows.append(row | noise.split([*rows, row]))
    machines = write_history(tmp_path / "history", rows)
    (judgement,) = judged(machines[0])
    assert (judgement.target, judgement.reached) == ("≤ 120 ns", reached)
    page.write(tmp_path / "p.md", machines, "")
    text = (tmp_path / "p.md").read_text()
    shown = f"{ns:.0f} ns" if reached else f"**{ns:.0f} ns**"
    assert f"| {judgement.what} | ≤ 120 ns | {shown} |" in text
    (measured,) = (cells for cells in all_rows(tmp_path) if cells["row"] == "base_2")
    parts = f"increments_ns {ns - 34:.1f}; noise_ns 9.0; rest_ns 25.0"
    assert parts in measured["more"]


@pytest.mark.slow
@pytest.mark.optimised(False)
def test_tuning_gradient_is_timed_next_to_plain_runs():
    *_, plain, gradient = quick_rows(derivative)
    assert [row["name"] for row in (plain, gradient)] == ["tune_plain", "tune_gradient_p2"]
    assert (gradient["runs"], gradient["steps"]) == (plain["runs"], plain["steps"]) == (128, 400)
    assert gradient["counted"] == 5 and 2 < gradient["operations_ratio"] < 6


@pytest.mark.parametrize(("ratio", "reached"), [(0.28, True), (0.29, False)])
def test_target_of_time_per_operation_is_relative_to_kalman5(tmp_path, ratio, reached):
    beside = {"ratio": ratio, "ratio_spread": 0.02, "operations": 145.3, "operations_ratio": 0.228}
    rows = [fake_row("methods", "kalman", 46.0, operations=638.1)]
    rows.append(fake_row("methods", "compass", 10.0, **beside))
    machines = write_history(tmp_path / "history", rows)
    (row,) = judged(machines[0])
    assert (row.what, row.target) == (
        "`compass`, time per operation, times that of `kalman5`",
        "≤ 1.25",
    )
    assert (row.measured, row.reached) == (f"{ratio / 0.228:.2f} ± 0.09", reached)
    page.write(tmp_path / "p.md", machines, "")
    text = (tmp_path / "p.md").read_text()
    assert "## Methods" in text
    result = "all targets reached" if reached else f"targets missed by `compass` ({row.measured})"
    assert f"10.0 ns (`compass`) to 46.0 ns (`kalman`) per step per run; {result}.\n" in text
    plain, compass = all_rows(tmp_path)
    cells = [cells["time per operation, relative"] for cells in (plain, compass)]
    assert cells == ["", row.measured]
    assert plain["more"].endswith("; operations 638.1")
    assert f"ratio {ratio}; ratio_spread 0.02; operations 145.3;" in compass["more"]


@pytest.mark.slow
@pytest.mark.optimised(False)
def test_operation_counts_of_methods_are_in_expected_ranges():
    """XLA counts the same operations at either level, before LLVM."""
    shipped = {name for name in METHODS if not METHODS[name].is_external}
    assert {*methods.OTHERS} == shipped - {"kalman5", "compass"}
    rows = {row["name"]: row for row in quick_rows(methods)}
    beside = {"kalman", "kalman_alone", "linearisation", "compass", "compass_tape"}
    assert {*methods.QUICK, *beside} == {*rows}
    of = {name: row.get("operations_ratio") for name, row in rows.items()}
    assert 400 < rows["kalman"]["operations"] < rows["kalman_alone"]["operations"] < 1000
    assert 1.5 < of["linearisation"] < of["kalman10"] < 6
    assert 0.1 < of["compass"] < of["compass_tape"] < 0.4
    # Its covariance is that of several draws.
    assert 0.2 < of["kalman_sincos"] < 0.6
    assert 0.1 < of["optimisation"] < 0.5


@pytest.mark.parametrize(("double", "reached"), [(105e3, True), (200e3, False)])
def test_derivative_memory_must_not_grow_with_steps(tmp_path, double, reached):
    more = {"ratio": 4.0, "ratio_spread": 0.1, "operations_ratio": 5.0}
    more |= {"temp_bytes_half": 100e3, "temp_bytes": 101e3, "temp_bytes_double": double}
    (machine,) = write_history(tmp_path, [fake_row("derivative", "derivative_p4", 57.0, **more)])
    _, row = judged(machine)
    assert row.measured == f"100, 101, {double / 1e3:.0f} kB"
    assert row.reached == reached


def test_cold_start_is_judged_and_listed_by_phase(tmp_path):
    told_row = fake_row("cold_start", "cold_start_first_result", 0.0, median_s=5.91, spread_s=0.2)
    phase = fake_row("cold_start", "cold_start_compile", 0.0, median_s=2.5, spread_s=0.1)
    for row in (told_row, phase):
        for key in ("ns_per_step_run", "compile_s"):
            del row[key]
    machines = write_history(tmp_path / "history", [told_row, phase])
    (row,) = judged(machines[0])
    assert (row.target, row.measured, row.reached) == ("< 4.5 s", "5.9 ± 0.2 s", False)
    page.write(tmp_path / "p.md", machines, "")
    assert "s: compile 2.50 ± 0.10." in (tmp_path / "p.md").read_text()


@pytest.mark.parametrize(("more_s", "cpu_s", "reached"), [(2.9, 1.9, True), (3.1, 2.1, False)])
def test_first_command_is_judged_beside_its_compiled_calls(tmp_path, more_s, cpu_s, reached):
    more = {"median_s": 13.9, "spread_s": 0.2, "calls_s": 10.0, "more_s": more_s}
    first = fake_row("first_command", "first_command", 0.0, **more)
    report = fake_row(
        "first_command", "report_command", 0.0, median_s=2.0, spread_s=0.1, cpu_s=cpu_s
    )
    for row in (first, report):
        for key in ("ns_per_step_run", "compile_s"):
            del row[key]
    (machine,) = write_history(tmp_path, [first, report])
    assert [row.reached for row in judged(machine)] == [reached, reached]


def test_time_of_overlapping_calls_counts_once():
    assert first_command.covered([[4.0, 5.0], [0.0, 2.0], [1.0, 3.0], [1.5, 1.6]]) == 4.0
    with pytest.raises(InputError, match="no compiled call was timed"):
        first_command.covered([])


@pytest.fixture
def undrawn(monkeypatch):
    """Lays out no figure of a page, which takes most of its time."""
    monkeypatch.setattr(page, "render_png", lambda figure: b"not drawn")


def test_performance_page_shows_history_rows(tmp_path):
    older = (history_rows(f"0.0.{version}", 1.3) for version in range(6, 10))
    machines = write_history(tmp_path / "history", *older, history_rows())
    page.write(tmp_path / "performance.md", machines, "float32: the reason.")
    text = (tmp_path / "performance.md").read_text()
    headings = re.findall("^## (.*)$", text, re.MULTILINE)
    assert headings == [
        "Machines",
        "Targets",
        "All rows",
        "Cost model",
        "History",
        "Left out",
    ]
    assert "| two devices on two cores, times one | ≥ 1.8 | 1.87 ± 0.02 |" in text
    assert "throughput | ≥ 0.85 | 0.91 ± 0.01 |" in text
    # 60e9 ns a minute over 90,000 steps of 14.2 ns.
    assert "- AMD EPYC 9999 64-Core Processor (AVX-512): 46,948, 44,291, 38,482, 26,828." in text
    assert "80 are best with 13.9 ns, the engine's 64 take 14.2 ns" in text
    assert "a run takes 21,000 bytes in calls of 128 runs" in text
    assert "sweeps of 128 runs into Parquet peak at 1,510 MiB (240 before)" in text
    rows = {cells["row"]: cells for cells in all_rows(tmp_path)}
    assert len(rows) == len({row["name"] for row in history_rows()})
    numba = rows["numba_loop"]
    assert (numba["ns per step per run"], numba["times the limit kernel"]) == ("6200", "620.00")
    assert rows["lanes_16"]["ns per step per run"] == "40.1"
    assert "| 0.0.9 | AMD EPYC 9999 64-Core Processor (AVX-512) | 18.5 | 1.85 |" in text
    assert text.rstrip().endswith("float32: the reason.")
    pictures = re.findall(r"!\[.+\]\((figures/\w[\w-]*\.png)\)", text)
    assert len(pictures) == 3
    for name in pictures:
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        assert (tmp_path / name).stat().st_size < 300_000


@pytest.mark.usefixtures("undrawn")
def test_history_of_few_versions_is_left_out(tmp_path):
    machines = write_history(tmp_path / "history", history_rows("0.0.9", 1.3), history_rows())
    page.write(tmp_path / "p.md", machines, "")
    text = (tmp_path / "p.md").read_text()
    assert "## History" not in text and "history.png" not in text


@pytest.mark.usefixtures("undrawn")
def test_page_omits_sections_without_measurements(tmp_path):
    rows = [row for row in history_rows() if row["set"] == "short"]
    page.write(tmp_path / "p.md", write_history(tmp_path / "history", rows), "")
    headings = re.findall("^## (.*)$", (tmp_path / "p.md").read_text(), re.MULTILINE)
    assert headings == ["Machines", "Targets", "All rows"]


@pytest.mark.usefixtures("undrawn")
def test_gpu_rows_get_page_section(tmp_path):
    row = fake_row("gpu", "gpu_silent_1000", 0.9, lanes=1000, runs_per_s=12345)
    row |= {"platform": "gpu", "device": "NVIDIA H100"}
    page.write(tmp_path / "p.md", write_history(tmp_path / "history", history_rows(), [row]), "")
    text = (tmp_path / "p.md").read_text()
    assert "## On a GPU" in text and "12,345 runs of 90,000 steps per second" in text
    assert "NVIDIA H100, ns per step per run with 1,000 runs:\n\n- silent: 0.9\n" in text
    (measured,) = all_rows(tmp_path, "nvidia-h100")
    assert measured["more"].endswith("lanes 1000; runs_per_s 12345")


@pytest.mark.usefixtures("undrawn")
def test_derivatives_share_one_row_of_targets(tmp_path):
    spread = {"ratio_spread": 0.1}
    rows = [
        fake_row("derivative", f"derivative_p{p}", 50.0, ratio=ratio, **spread)
        for p, ratio in ((1, 3.0), (2, 13.0))
    ]
    page.write(tmp_path / "p.md", write_history(tmp_path / "history", history_rows(), rows), "")
    text = (tmp_path / "p.md").read_text()
    assert "times a plain run | ≤ 3.6, 6.0 | 3.00 ± 0.10, **13.00 ± 0.10** |\n" in text


@pytest.mark.usefixtures("undrawn")
def test_two_machines_share_one_figure(tmp_path):
    machines = write_history(
        tmp_path / "history", history_rows(), history_rows(cpu="Other", avx512=False)
    )
    page.write(tmp_path / "p.md", machines, "")
    text = (tmp_path / "p.md").read_text()
    assert text.count(": 46,948, 44,291, 38,482, 26,828.") == 2
    assert text.count("bends.png)") == 1


def test_empty_history_is_refused(tmp_path):
    with pytest.raises(InputError, match="run benchmarks/record.py first"):
        page.write(tmp_path / "p.md", [], "")
    assert not (tmp_path / "p.md").exists()
