"""Memory: what a compiled call needs, and what a whole `sweep` takes at its peak."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import common

from sinsjax.bench.cases import default_group, shorten_runs
from sinsjax.bench.timing import Row
from sinsjax.engine.batch import compile_program, plan
from sinsjax.engine.lanes import tiles_of
from sinsjax.errors import InputError
from sinsjax.platform.assets import asset_path

TILE_COUNTS = (2, 8, 32)
"""Tiles a compiled call: what a chunk is made of."""

DRAWS = (1, 16, 64)
"""Of a sweep over as many variants as the default study has."""

VARIANTS = 448

_SWEEP = r"""
import json, re, sys
import sinsjax
from sinsjax.study.load import study_from_dict
import tomllib
sinsjax.configure(devices=1)
def peak():
    # Not getrusage: its peak counts the process that started this one.
    return int(re.search(r"VmHWM:\s*(\d+) kB", open("/proc/self/status").read())[1]) * 1024
data = tomllib.load(open(sys.argv[1], "rb"))
data["study"] |= json.loads(sys.argv[2]) | {"judged_from": "truth"}
data["axes"] = {"phi_u0_deg": [n / 5 for n in range(int(sys.argv[4]))]}
before = peak()
sinsjax.run_into(study_from_dict(data), sys.argv[3])
print(json.dumps([before, peak()]))
"""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Ask the compiler and the operating system; nothing is timed, so nothing is repeated.

    Returns:
        ``memory_call_N_tiles`` and the same with ``_curves``: ``bytes_per_run`` in arguments,
        results and temporaries of a call of N tiles, and ``temp_bytes``. ``memory_sweep_N``:
        ``peak_mib`` of a process that sweeps N runs into Parquet, and ``before_mib``, what it had
        taken before.
    """
    records = 10 if quick else 900
    out = []
    for tiles in TILE_COUNTS[:1] if quick else TILE_COUNTS:
        out += [of_call(tiles, records, curves=curves) for curves in (False, True)]
    if not Path("/proc/self/status").exists():
        print("warning: no memory_sweep: there is no /proc to read the peak from", file=sys.stderr)
        return out
    return out + [of_sweep(draws, quick) for draws in (DRAWS[:1] if quick else DRAWS)]


def of_call(tiles: int, records: int, *, curves: bool) -> Row:
    """What the compiled function of `sweep` needs for one call."""
    group = shorten_runs(default_group(), records)
    group = group._replace(static=group.static._replace(curves=curves))
    places = plan(group, tiles_per_chunk=tiles)[0]
    found = compile_program(group, tiles_of(group, places)).memory_analysis()
    runs = places.draw.size
    total = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    return {
        "name": f"memory_call_{tiles}_tiles{'_curves' if curves else ''}",
        "runs": runs,
        "steps": records * group.static.record_every,
        "dtype": "float64",
        "devices": 1,
        "bytes_per_run": round(total / runs),
        "temp_bytes": int(found.temp_size_in_bytes),
    }


def of_sweep(draws: int, quick: bool) -> Row:
    """The peak of a process of its own that sweeps short runs with the default study's numbers.

    Raises:
        InputError: the sweep failed.
    """
    seconds = 10 if quick else 20
    study = {"draws": draws, "duration_s": seconds, "window_s": [5, seconds]}
    study |= {"consistency_after_s": 1.0, "steady_after_s": 5.0}
    path = os.pathsep.join(filter(None, [str(common.ROOT), os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory(prefix="sinsjax-memory-") as folder:
        config, out = str(asset_path("configs/reset_sweep.toml")), str(Path(folder) / "out")
        ended = subprocess.run(
            [sys.executable, "-c", _SWEEP, config, json.dumps(study), out, str(VARIANTS)],
            capture_output=True,
            text=True,
            env=os.environ | {"PYTHONPATH": path},
        )
    if ended.returncode:
        raise InputError(f"the sweep failed: {ended.stderr.strip().rpartition(chr(10))[2]}")
    before, peak = json.loads(ended.stdout)
    runs = draws * VARIANTS
    return {
        "name": f"memory_sweep_{runs}",
        "runs": runs,
        "steps": seconds * 100,
        "dtype": "float64",
        "devices": 1,
        "before_mib": round(before / 2**20),
        "peak_mib": round(peak / 2**20),
    }


if __name__ == "__main__":
    common.main(rows)
