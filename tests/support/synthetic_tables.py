"""Synthetic result tables, column by column."""

import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.execution import tables

FLOOR = -25.9
TIMES = np.arange(1.0, 7.0)


TRUE = ("phi_", "settle", "ok_", "has_", "floor", "status", "nis", "nees", "p_above")
"""How the names of columns begin that need a reference."""


def synthetic_summary(study, *, truth=True, **given_columns):
    """Return a synthetic summary: the ``given_columns``, and plain numbers in the others."""
    v, d = study.n_variants, study.n_draws
    draw, variant = np.repeat(np.arange(d), v), np.tile(np.arange(v), d)
    noise = np.random.default_rng(5).normal(size=v * d)
    swept = {k: [x[i] for i in variant] for k, x in study.variant_values().items()}
    resets = study.values("reset_times_s") if study.has("resets") else [()] * v
    starts = study.record.start_s if study.record else [0.0] * d
    values = {
        "run_id": np.arange(v * d),
        "draw_id": draw,
        "variant_id": variant,
        "method": ["kalman5"] * (v * d),
        "start_s": np.asarray(starts)[draw],
        "reset_count": [len(t or ()) for t in resets] * d,
        "reset_times_s": [list(t or ()) for t in resets] * d,
        "floor_arcmin": np.full(v * d, FLOOR),
        "phi_u_arcmin": FLOOR + noise,
        "phi_u_mean_arcmin": FLOOR + noise,
        "settle_10_s": 50.0 + noise,
        "status": ["ok"] * (v * d),
        "has_floor": [True] * (v * d),
        **swept,
        **given_columns,
    }
    ok = [status == "ok" for status in values["status"]]
    values = {"ok_floor": ok, "ok_truth": ok, "settle_10_truth_s": values["settle_10_s"]} | values
    arrays, layout = [], tables.summary_columns(study)
    for column in layout:
        absent = not truth and column.name.startswith(TRUE) and column.name not in swept
        default = abs(noise).astype(int) if column.dtype != pa.float64() else noise
        if absent or pa.types.is_list(column.dtype) and column.name not in values:
            default = [None] * (v * d)
        cells = default if absent else values.get(column.name, default)
        arrays.append(pa.array(cells, column.dtype, from_pandas=True))
    return pa.Table.from_arrays(arrays, schema=columns.arrow_schema(layout))


def synthetic_curves(study, *, truth=True):
    """Return synthetic curves of all runs."""
    runs = study.n_variants * study.n_draws
    run, time = np.repeat(np.arange(runs), TIMES.size), np.tile(TIMES, runs)
    noise = np.random.default_rng(6).normal(size=run.size)
    layout = tables.curve_columns(study)
    values = {c.name: noise for c in layout}
    if not truth:
        values |= {f"phi_{a}_arcmin": np.full(run.size, np.nan) for a in "enu"}
    values |= {"run_id": run, "time_s": time, "update_time_s": time, "pass": np.ones(run.size, int)}
    arrays = [pa.array(values[c.name], c.dtype, from_pandas=True) for c in layout]
    return pa.Table.from_arrays(arrays, schema=columns.arrow_schema(layout))
