"""Several cores: one against all of them on the same tiles, and the whole `sweep` on all."""

import tempfile
import time
import tomllib
from pathlib import Path

import common
import jax

from sinsjax.bench.cases import default_group, engine_workload, remove_noise, shorten_runs
from sinsjax.bench.timing import (
    Row,
    Workload,
    median_and_spread,
    time_in_turns,
    time_ratios,
    timing_row,
)
from sinsjax.engine.build import parts
from sinsjax.engine.lanes import LANES
from sinsjax.execution import run
from sinsjax.platform.assets import asset_path
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

RESET_COUNTS = [1, 2, 3, 4, 5]
"""With the 8 cycles and 8 misalignments of the default sweep: 320 variants, five tiles a draw."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the engine on 1, 2, 4, ... and all devices, then the whole sweep.

    Returns:
        ``devices_N`` with ``speedup`` over one device, the median over the turns; for each length
        of run ``sweep_Ns`` with ``share``, its throughput over that of ``call_Ns``, the compiled
        call alone on all devices.
    """
    out = scaling(quick, repeats)
    # Longer runs keep more: what follows the call does not grow with them.
    for duration_s, draws in ((9.0, 1),) if quick else ((90.0, 32),):
        out += whole_sweep(duration_s, draws, repeats)
    return out


def scaling(quick: bool, repeats: int) -> list[Row]:
    """Time the same tiles on more and more devices, in turns."""
    most = len(jax.devices())
    counts = [most] if quick else sorted({2**n for n in range(most.bit_length())} | {most})
    tiles = 2 * most * (1 if quick else -(-16 // most))
    group = shorten_runs(remove_noise(default_group()), 2 if quick else 90)
    cases = [engine_workload(f"devices_{n}", group, tiles=tiles // n, devices=n) for n in counts]
    seconds = time_in_turns(cases, repeats)
    out = []
    for case, taken in zip(cases, seconds, strict=True):
        out.append(
            timing_row(case, taken)
            | median_and_spread("speedup", time_ratios(cases[0], case, seconds[0], taken))
        )
    return out


def whole_sweep(duration_s: float, draws: int, repeats: int) -> list[Row]:
    """Time `sweep` into Parquet and the compiled call alone, in turns, both compiled before."""
    study = sweep_study(duration_s, draws)
    (part,) = parts(study)
    devices = len(jax.devices())
    every = study.n_draws * study.n_variants // (LANES * devices)
    alone = engine_workload(f"call_{duration_s:g}s", part.group, tiles=every, devices=devices)
    whole = sweep_case(f"sweep_{duration_s:g}s", study, devices)
    its, taken = time_in_turns([alone, whole], repeats)
    share = median_and_spread("share", time_ratios(alone, whole, its, taken))
    return [timing_row(alone, its), timing_row(whole, taken) | share]


def sweep_study(duration_s: float, draws: int) -> Study:
    """The default sweep with runs of another length, everything in time scaled with it."""
    data = tomllib.loads(asset_path("configs/reset_sweep.toml").read_text(encoding="utf-8"))
    scale = duration_s / data["study"]["duration_s"]
    times = ("duration_s", "consistency_after_s", "steady_after_s")
    data["study"] |= {key: data["study"][key] * scale for key in times}
    data["study"] |= {"window_s": [t * scale for t in data["study"]["window_s"]], "draws": draws}
    data["study"]["judged_from"] = "truth"  # a short run has no limit
    cycles = [round(t * scale, 2) for t in data["axes"]["reset_cycle_s"]]
    data["axes"] |= {"reset_count": RESET_COUNTS, "reset_cycle_s": cycles}
    return study_from_dict(data)


def sweep_case(name: str, study: Study, devices: int) -> Workload:
    """`run.run_into` as a case, called once before so that everything is compiled."""

    def call() -> float:
        with tempfile.TemporaryDirectory(prefix="sinsjax-sweep-") as folder:
            since = time.perf_counter()
            run.run_into(study, Path(folder) / "out")
            return time.perf_counter() - since

    first = call()
    steps = study.records * study.record_every
    return Workload(
        name, study.n_draws * study.n_variants, steps, first - call(), call, "float64", devices
    )


if __name__ == "__main__":
    common.main(rows, one_core=False)
