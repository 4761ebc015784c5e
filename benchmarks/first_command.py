"""What `sinsjax sweep reset_sweep` costs beyond its compiled calls, and its report.

Every repeat runs the sweep in two fresh processes, one with nothing cached and one with its
programs cached, and then `sinsjax report` on the results. The compiled calls are timed within the
same run: the time in which at least one device computes.
"""

import json
import resource
import tempfile
from pathlib import Path

import common
from cold_start import command
from targets import FIRST_RATIO

from sinsjax.bench.timing import Row
from sinsjax.errors import InputError
from sinsjax.platform import runtime

QUICK = ("--set", "axes.reset_count=[0, 1]", "--set", "axes.phi_u0_deg=[0, 30]", "--draws", "2")

_TIMED = """
import json, sys, time
import jax
from sinsjax import cli
from sinsjax.engine import batch
spans, compiles = [], []
def listen(name, seconds, **about):
    if name.endswith("/backend_compile_duration"):
        compiles.append(seconds)
jax.monitoring.register_event_duration_secs_listener(listen)
class Timed:
    def __init__(self, program):
        self._program = program
    def __call__(self, *arguments):
        begun = time.perf_counter()
        made = jax.block_until_ready(self._program(*arguments))
        spans.append((begun, time.perf_counter()))
        return made
compiled = batch.Program.compiled
batch.Program.compiled = lambda program: Timed(compiled(program))
sys.argv = ["sinsjax", *sys.argv[1:]]
try:
    cli.main()
except SystemExit as end:
    if end.code:
        raise
print(json.dumps([spans, sum(compiles)]), file=sys.stderr)
"""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the sweep and its report, each in fresh processes.

    Returns:
        ``first_command``: ``median_s`` of the sweep with its programs cached, ``calls_s`` in
        compiled calls, ``more_s`` beyond `FIRST_RATIO` times that,
        ``ratio`` of the two times, ``cold_s`` with nothing cached and ``compile_s`` of it. Then
        ``report_command``: ``cpu_s`` of user and system of ``sinsjax report``.
    """
    whole, calls, cold, compiles, reports, cpu = ([] for _ in range(6))
    with tempfile.TemporaryDirectory(prefix="sinsjax-first-") as folder:
        out = str(Path(folder) / "out")
        sweep = ["sweep", "reset_sweep", "-o", out, "--overwrite", *(QUICK if quick else ())]
        for number in range(repeats):
            cache = str(Path(folder) / f"cache{number}")
            taken, told = command(["-c", _TIMED, *sweep], cache)
            cold.append(taken)
            compiles.append(json.loads(told.splitlines()[-1])[1])
            taken, told = command(["-c", _TIMED, *sweep], cache)
            whole.append(taken)
            calls.append(covered(json.loads(told.splitlines()[-1])[0]))
            before = _cpu_of_children()
            reports.append(command(["-m", "sinsjax", "report", out])[0])
            cpu.append(_cpu_of_children() - before)
    size: Row = {"dtype": "float64", "devices": runtime.usable_cores()}
    first = common.seconds("first_command", whole) | size
    called, compiled, begun = (common.seconds("", x)["median_s"] for x in (calls, compiles, cold))
    first |= {
        "calls_s": called,
        "more_s": round(first["median_s"] - FIRST_RATIO * called, 3),
        "ratio": round(first["median_s"] / called, 3),
        "cold_s": begun,
        "compile_s": compiled,
    }
    report = common.seconds("report_command", reports) | size
    return [first, report | {"cpu_s": common.seconds("", cpu)["median_s"]}]


def covered(spans: list[list[float]]) -> float:
    """The time, s, in which at least one of some spans (begin, end) is under way.

    Raises:
        InputError: there are none.
    """
    if not spans:
        raise InputError("first_command: no compiled call was timed")
    total, end = 0.0, -float("inf")
    for begun, ended in sorted(spans):
        total += max(0.0, ended - max(begun, end))
        end = max(end, ended)
    return total


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    common.main(rows, one_core=False, repeats=3)
