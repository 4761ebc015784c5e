"""Memory: what a compiled call needs, and what a whole `sweep` takes at its peak."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import common
from cases import default_group, shorten_runs
from timing import Row

from sinsjax.engine.batch import trace_program
from sinsjax.errors import InputError

TILE_COUNTS = (2, 8, 32)
"""Tiles a compiled call: what a chunk is made of."""

DRAWS = (1, 16, 64)
VARIANTS = 448

_SWEEP = r"""
import json, re, sys
import sinsjax
sinsjax.configure(devices=1)
def peak():
    # Not getrusage: its peak counts the process that started this one.
    return int(re.search(r"VmHWM:\s*(\d+) kB", open("/proc/self/status").read())[1]) * 1024
study = sinsjax.load_study("reset_sweep", json.loads(sys.argv[1]))
before = peak()
sinsjax.run_into(study, sys.argv[2])
print(json.dumps([before, peak()]))
"""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Return ``bytes_per_run`` of calls of N tiles, and ``peak_mib`` of sweeps of N runs."""
    records = 10 if quick else 900
    out = []
    for tiles in TILE_COUNTS[:1] if quick else TILE_COUNTS:
        out += [of_call(tiles, records, curves=curves) for curves in (False, True)]
    return out + [of_sweep(draws, quick) for draws in (DRAWS[:1] if quick else DRAWS)]


def of_call(tiles: int, records: int, *, curves: bool) -> Row:
    """What the compiled function of `sweep` needs for one call."""
    group = shorten_runs(default_group(), records)
    group = group._replace(spec=group.spec._replace(curves=curves))
    layout = group.lay_out(tiles_per_chunk=tiles)
    found = trace_program(group, layout).compiled().memory_analysis()
    total = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    name = f"memory_call_{tiles}_tiles{'_curves' if curves else ''}"
    runs = layout[0].draw.size
    return {"name": name, "runs": runs, "bytes_per_run": round(total / runs)}


def of_sweep(draws: int, quick: bool) -> Row:
    """The peak of a process of its own that sweeps short runs with the default study's numbers."""
    end_s, angles = 10 if quick else 20, [n / 5 for n in range(VARIANTS)]
    study = {"draws": draws, "duration_s": end_s, "window_s": [5, end_s], "judged_from": "truth"}
    study |= {"consistency_after_s": 1.0, "steady_after_s": 5.0}
    changes = {f"study.{key}": value for key, value in study.items()}
    changes |= {"axes.reset_count": {}, "axes.reset_cycle_s": {}, "axes.phi_u0_deg": angles}
    path = os.pathsep.join(filter(None, [str(common.ROOT), os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory(prefix="sinsjax-memory-") as folder:
        command = [sys.executable, "-c", _SWEEP, json.dumps(changes), str(Path(folder) / "out")]
        ended = subprocess.run(
            command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}
        )
    if ended.returncode:
        raise InputError(f"the sweep failed: {ended.stderr.strip().rpartition(chr(10))[2]}")
    before, peak = (round(size / 2**20) for size in json.loads(ended.stdout))
    runs = draws * VARIANTS
    return {"name": f"memory_sweep_{runs}", "runs": runs, "before_mib": before, "peak_mib": peak}


if __name__ == "__main__":
    common.main(rows)
