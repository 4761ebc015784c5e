"""Synthetic result tables, column by column."""

import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.execution import tables

FLOOR = -25.9
TIMES = np.arange(1.0, 7.0)


def synthetic_summary(study, *, truth=True, all_columns=False, **given_columns):
    """Return a synthetic summary: the ``given_columns``, and plain numbers in the others.

    With ``all_columns`` it has all columns of such a study, else those that most reports read.
    """
    v, d = study.n_variants, study.n_draws
    draw, variant = np.repeat(np.arange(d), v), np.tile(np.arange(v), d)
    noise = np.random.default_rng(5).normal(size=v * d)
    swept = study.variant_values()
    extra = [columns.axis_column(k, values, "") for k, values in swept.items()]
    known = {c.name for c in columns.IDENTITY}
    layout = [
        *columns.IDENTITY,
        *(c for c in extra if c.name not in known),
        *columns.OBSERVED,
        columns.settle_column(10.0),
        columns.settle_column(10.0, truth=True),
        *columns.JUDGED,
    ]
    names = {column.name for column in layout}
    extra_columns = (
        [c for c in tables.summary_columns(study) if c.name not in names] if all_columns else []
    )
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
        **{k: [values[i] for i in variant] for k, values in swept.items()},
        **given_columns,
    }
    values = {"settle_10_truth_s": values["settle_10_s"], "has_floor": [True] * (v * d)} | values
    ok = [status == "ok" for status in values["status"]]
    values = {"ok_floor": ok, "ok_truth": ok} | values
    if not truth:
        truth_prefixes = (
            "phi_",
            "settle",
            "ok_",
            "has_",
            "floor",
            "status",
            "nis",
            "nees",
            "p_above",
        )
        values = {k: x for k, x in values.items() if not k.startswith(truth_prefixes) or k in swept}
    arrays = []
    for column in [*layout, *extra_columns]:
        default = noise if column.dtype == pa.float64() and truth else None
        default = abs(noise).astype(int) if column in extra_columns and default is None else default
        default = noise if column.name.startswith(("pitch", "roll", "yaw", "sigma")) else default
        default = None if pa.types.is_list(column.dtype) else default
        cells = values.get(column.name, [None] * (v * d) if default is None else default)
        arrays.append(pa.array(cells, column.dtype, from_pandas=True))
    return pa.Table.from_arrays(arrays, schema=columns.arrow_schema((*layout, *extra_columns)))


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
