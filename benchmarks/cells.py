"""What an answer costs: the expected settling time of a cell, to 2 s, by each `estimate`."""

import time
import tomllib
from typing import Any

import common
import numpy as np
import pyarrow as pa

import sinsjax
from sinsjax.bench.timing import Row
from sinsjax.study.study import Study

HALF_WIDTH_S = 2.0
"""Of the 95 % interval of each cell's mean settling time."""

MOST_DRAWS = 4096
SAMPLES = 1024
SCHEDULES = ([10.0, 60.0], [12.0, 60.0], [15.0, 60.0], [20.0, 60.0])
SCHEDULES += tuple([first, 75.0] for first, _ in SCHEDULES)
HEADINGS = (1.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0)
"""Initial heading errors, deg, beside level errors of 5 deg."""


def study_of(estimate: str, quick: bool) -> Study:
    """Eight heading errors by eight schedules of two resets, which all settle."""
    data = tomllib.loads((common.ROOT / "configs/reset_sweep.toml").read_text(encoding="utf-8"))
    given: dict[str, Any] = {"estimate": estimate, "settle_bands_arcmin": [10.0]}
    data["study"].pop("draws", None)
    if quick:
        given |= {"duration_s": 120.0, "window_s": [60.0, 120.0], "steady_after_s": 60.0}
    if estimate == "covariance":
        given["estimate_samples"] = 16 if quick else SAMPLES
    else:
        given["draws"] = 2 if quick else MOST_DRAWS
        data["stop_when"] = {"statistic": "settle_10_s_mean", "half_width": HALF_WIDTH_S}
    data["study"] |= given
    data["axes"] = {
        "phi_u0_deg": list(HEADINGS),
        "reset_times_s": [[4.0]] if quick else list(SCHEDULES),
    }
    return sinsjax.study_from_dict(data)


def rows(quick: bool, repeats: int) -> list[Row]:
    """CPU time a cell by draws and by covariance analysis.

    Returns:
        One row each, with the draws that it took, the widest interval and the time of a cell.
    """
    told = [_row(estimate, quick) for estimate in ("draws", "covariance")]
    return [row | {"ratio": round(row["cell_ms"] / told[0]["cell_ms"], 3)} for row in told]


def _row(estimate: str, quick: bool) -> Row:
    study = study_of(estimate, quick)
    run = sinsjax.run if estimate == "draws" else sinsjax.estimate
    run(study)  # compiles
    since = time.process_time()
    made = run(study)
    taken = time.process_time() - since
    table = made if isinstance(made, pa.Table) else made.summary
    draws, half = _interval(estimate, table, study)
    return {
        "name": estimate,
        "cells": study.n_variants,
        "draws": draws,
        "half_width_s": round(half, 2),
        "cell_ms": round(taken / study.n_variants * 1e3, 2),
    }


def _interval(estimate: str, table: pa.Table, study: Study) -> tuple[int, float]:
    """Draws of a cell, and the widest half of an interval of its mean settling time, s."""
    if estimate == "draws":
        draws = table.num_rows // study.n_variants
        seconds = table["settle_10_s"].fill_null(study.duration_s).to_numpy()
        error = seconds.reshape(draws, -1).std(axis=0, ddof=1) / draws**0.5
        return draws, float(1.96 * error.max())
    return 0, float(1.96 * np.max(table["settle_10_mean_error_s"].to_numpy()))


if __name__ == "__main__":
    common.main(rows)
