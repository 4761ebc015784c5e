"""What passes between typing ``sinsjax sweep`` and its end: 64 runs of 60 s.

Every repeat starts three fresh processes: the plain command with nothing cached, whose wall time is
the result, one that also notes when its phases end, and the command with its programs cached.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common

from sinsjax.bench.timing import Row
from sinsjax.errors import InputError
from sinsjax.platform import compile_cache, runtime

STUDY = """
[study]
name = "first_result"
duration_s = {duration_s}
rate_hz = 100.0
record_interval_s = 1.0
draws = 16
window_s = [{window_s}, {duration_s}]
[earth]
latitude_deg = 32.0
[motion]
yaw_center_deg = 0.0
pitch_amplitude_deg = 1.8
pitch_period_s = 6.0
roll_amplitude_deg = 2.4
roll_period_s = 8.0
yaw_amplitude_deg = 2.8
yaw_period_s = 10.0
[sensors]
gyro_bias_deg_per_h = 0.1
gyro_noise_deg_per_h = 0.1
accel_bias_ug = 500.0
accel_noise_ug = 500.0
[alignment]
phi_e0_deg = 5.0
phi_n0_deg = 5.0
[axes]
phi_u0_deg = [0, 10, 20, 30]
"""

RUNS, RATE_HZ = 64, 100

PHASES = ("import", "prepare", "trace", "compile", "run_and_write", "report", "exit")
"""Python and the imports; the study's environment and its small programs; tracing and lowering the
engine; compiling it; running it and writing Parquet; tables and figures; the end of Python."""

_NOTED = """
import json, sys, threading, time
since = float(sys.argv[1])
from sinsjax.execution import run as campaign
from sinsjax import cli
from sinsjax.study import load as config
import jax
imported = time.time()
programs = []
def listen(name, seconds, **about):
    if name.startswith("/jax/core/compile/"):
        programs.append((name.rsplit("/", 1)[1], about.get("fun_name", ""), seconds, time.time()))
jax.monitoring.register_event_duration_secs_listener(listen)
import_module, reported = cli.import_module, []
def noted(name):
    module = import_module(name)
    if threading.current_thread() is threading.main_thread():
        reported.append(time.time())
    return module
cli.import_module = noted
sys.argv = ["sinsjax", *sys.argv[2:]]
try:
    cli.main()
except SystemExit as end:
    if end.code:
        raise
print(json.dumps([since, imported, reported[0], time.time(), programs]), file=sys.stderr)
"""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time whole commands, each in a fresh process.

    Returns:
        ``cold_start_first_result`` with ``best_s`` and ``programs``, how many XLA compiles;
        ``cold_start_cached``, the same with them cached; then a row a phase of the first, whose
        times add up to about the whole.
    """
    duration_s = 6 if quick else 60
    with tempfile.TemporaryDirectory(prefix="sinsjax-cold-") as folder:
        study = Path(folder) / "first_result.toml"
        text = STUDY.format(duration_s=duration_s, window_s=duration_s // 2)
        study.write_text(text, encoding="utf-8")
        sweep = ["sweep", str(study), "-o", str(Path(folder) / "out"), "--overwrite"]
        # The first one fills the disk's cache and Python's bytecode.
        command(["-m", "sinsjax", *sweep])
        cache = str(Path(folder) / "cache")
        command(["-m", "sinsjax", *sweep], cache)
        whole, noted, cached = [], [], []
        for _ in range(repeats):
            whole.append(command(["-m", "sinsjax", *sweep])[0])
            noted.append(phases(sweep))
            cached.append(command(["-m", "sinsjax", *sweep], cache)[0])
    size = {
        "runs": RUNS,
        "steps": duration_s * RATE_HZ,
        "dtype": "float64",
        "devices": runtime.usable_cores(),
    }
    more = {"best_s": round(min(whole), 3), "programs": noted[0][1]}
    return [
        common.seconds("cold_start_first_result", whole) | size | more,
        common.seconds("cold_start_cached", cached) | size,
        *(
            common.seconds(f"cold_start_{phase}", [times[phase] for times, _ in noted]) | size
            for phase in PHASES
        ),
    ]


def command(arguments: list[str], cache: str = "0") -> tuple[float, str]:
    """Run Python with arguments: the seconds it took, and its standard error.

    Args:
        arguments: of Python.
        cache: folder of compiled programs; 0 for none.

    Raises:
        InputError: it failed.
    """
    # An installed package has its bytecode; here the first command writes it.
    left_out = ("JAX_COMPILATION_CACHE_DIR", "PYTHONDONTWRITEBYTECODE")
    environment = {k: v for k, v in os.environ.items() if k not in left_out}
    path = os.pathsep.join(filter(None, [str(common.ROOT), os.environ.get("PYTHONPATH")]))
    since = time.perf_counter()
    ended = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        env=environment | {"PYTHONPATH": path, compile_cache.VARIABLE: cache},
    )
    taken = time.perf_counter() - since
    if ended.returncode:
        raise InputError(f"sinsjax sweep failed: {ended.stderr.strip().rpartition(chr(10))[2]}")
    return taken, ended.stderr


def phases(sweep: list[str]) -> tuple[dict[str, float], int]:
    """The seconds of each phase of one command, and how many programs XLA compiled."""
    _, told = command(["-c", _NOTED, str(time.time()), *sweep])
    gone = time.time()
    since, imported, reported, ended, programs = json.loads(told.splitlines()[-1])
    engine = [event for event in programs if "run_tiles" in event[1]]
    compile_s = sum(s for kind, _, s, _ in engine if kind == "backend_compile_duration")
    trace_s = sum(s for _, _, s, _ in engine) - compile_s
    begun = min(end - seconds for _, _, seconds, end in engine)
    compiled = max(end for *_, end in engine)
    seconds = {
        "import": imported - since,
        "prepare": begun - imported,
        "trace": trace_s,
        "compile": compile_s,
        "run_and_write": reported - compiled,
        "report": ended - reported,
        "exit": gone - ended,
    }
    return seconds, sum(kind == "backend_compile_duration" for kind, *_ in programs)


if __name__ == "__main__":
    common.main(rows, one_core=False, repeats=5)
