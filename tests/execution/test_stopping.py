"""Interim analyses of [stop_when]: their draws, their statistics, and a reproducible stop."""

import math
import threading

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.studies import STILL, small_study
from support.sweep_directories import read_parts

import sinsjax
from sinsjax.analysis import mean, share
from sinsjax.engine.batch import map_in_threads
from sinsjax.errors import StudyInterrupted
from sinsjax.execution.tasks import (
    Executor,
    interim_analysis_columns,
    interim_draws,
    widest_half_width,
)

pytestmark = pytest.mark.optimised(False)


def make_study(statistic="success_rate", half_width=0.1, study=None, **changes):
    settings = {"draws": 1000, "duration_s": 2.0, "record_interval_s": 0.1, "window_s": [0, 2]}
    settings |= {"judged_from": "floor", "dwell_s": 0.0, "level_band_arcmin": 600.0}
    stop_when = {"statistic": statistic, "half_width": half_width}
    changes = {"axes": {"phi_u0_deg": [0.2, 1.0]}, "motion": STILL} | changes
    return small_study(study=settings | (study or {}), stop_when=stop_when, **changes)


@given(st.integers(1, 10**6))
def test_interim_analyses_double_draws_up_to_cap(cap):
    doubled = [64 * 2**i for i in range(20)]
    expected = [n for n in doubled if n < cap] + [cap]
    assert interim_draws(make_study(study={"draws": cap})) == expected
    assert interim_draws(small_study(study={"draws": cap})) == [cap]


@pytest.mark.parametrize("judged", ["floor", "truth"])
@pytest.mark.parametrize("unsettled", [0, 3])
def test_interim_analysis_matches_naive_count(judged, unsettled):
    """Of all runs of the first draws, in any order, and of no later one; as the study judges."""
    rng, draws, all_draws, variants = np.random.default_rng(1), 20, 23, 3
    settle = rng.uniform(0, 900, (all_draws, variants))
    settle[:unsettled, 1], settle[draws:] = np.nan, 1e6
    runs = rng.permutation(settle.size)
    status = np.where(np.isnan(settle), "diverged", "ok").ravel()[runs]
    name = {"floor": "settle_10_s", "truth": "settle_10_truth_s"}[judged]
    table = pa.table({"run_id": runs, "draw_id": runs // variants, "variant_id": runs % variants})
    table = table.append_column("status", [status])
    table = table.append_column(name, pa.array(settle.ravel()[runs], from_pandas=True))
    columns = settle[:draws].T
    for statistic, widths in (
        ("success_rate", [share(~np.isnan(column)) for column in columns]),
        ("settle_10_s_mean", [mean(column) for column in columns]),
    ):
        axes = {"phi_u0_deg": [0.0, 1.0, 2.0]}
        study = make_study(statistic, 0.5, {"judged_from": judged}, axes=axes)
        rows = table.select(interim_analysis_columns(study))
        halves = [(width.high - width.low) / 2 for width in widths]
        expected = max(math.inf if math.isnan(half) else half for half in halves)
        assert widest_half_width(study, rows, draws) == pytest.approx(expected)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("statistic", "half_width"), [("success_rate", 0.03), ("settle_60_s_mean", 0.2)]
)
def test_sweep_stops_at_same_draw_despite_chunk_order_or_interruption(
    statistic, half_width, tmp_path
):
    sensors = {"gyro_noise_deg_per_h": 200.0, "accel_noise_ug": 200000.0}
    alignment = {"phi_e0_deg": 1.0, "phi_n0_deg": 1.0}
    study = make_study(statistic, half_width, sensors=sensors, alignment=alignment)
    draws, out, stop = 256, tmp_path / "out", threading.Event()
    whole = sinsjax.run(study, chunk_runs=128).summary
    assert whole.num_rows == 2 * draws and sinsjax.run(study).summary.equals(whole)
    before = [n for n in interim_draws(study) if n < draws]
    assert all(widest_half_width(study, whole, n) > half_width for n in before)
    backwards = Executor(lambda shop, tasks: map_in_threads(shop.compute, list(tasks)[::-1], 2), {})
    sinsjax.run_into(study, tmp_path / "back", chunk_runs=128, executor=backwards)

    def stop_after_one(runner, tasks):
        for task in tasks:
            stop.set()
            yield runner.compute(task)

    interrupted = 0
    while True:  # after every chunk
        try:
            stop.clear()
            options = {"executor": Executor(stop_after_one, {}), "resume": True, "stop": stop}
            told = sinsjax.run_into(study, out, chunk_runs=128, **options).manifest.entries
            break
        except StudyInterrupted:
            interrupted += 1
    assert interrupted and read_parts(out) == read_parts(tmp_path / "back")
    assert sinsjax.read_summary(out).equals(whole)
    assert (told["state"], told["draws"], told["runs_done"]) == ("complete", draws, 2 * draws)
