"""Interim analyses of [stop_when]: their draws, their statistics, and a reproducible stop."""

import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.studies import STILL, small_study
from support.sweep_directories import read_manifest_entries, read_parts

from sinsjax.analysis import mean, share
from sinsjax.engine.batch import map_in_threads
from sinsjax.errors import StudyInterrupted
from sinsjax.execution import run as study_run
from sinsjax.execution.results import read_summary
from sinsjax.execution.tasks import (
    Executor,
    TaskRunner,
    interim_columns,
    interim_draws,
    widest_half_width,
)
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)


def make_study(
    statistic: str = "success_rate", half_width: float = 0.1, draws: int = 1000, **changes: Any
) -> Study:
    study = {"draws": draws, "duration_s": 2.0, "record_interval_s": 0.1, "window_s": [0, 2]}
    study |= {"judged_from": "floor", "dwell_s": 0.0, "level_band_arcmin": 600.0}
    study |= changes.pop("study", {})
    stop_when = {"statistic": statistic, "half_width": half_width}
    axes = changes.pop("axes", {"phi_u0_deg": [0.2, 1.0]})
    return small_study(study=study, stop_when=stop_when, axes=axes, motion=STILL, **changes)


@given(st.integers(1, 10**6))
def test_interim_analyses_double_draws_up_to_cap(cap: int) -> None:
    doubled = [64 * 2**i for i in range(20)]
    expected = [n for n in doubled if n < cap] + [cap]
    assert interim_draws(make_study(draws=cap)) == expected
    assert interim_draws(small_study(study={"draws": cap})) == [cap]


@given(
    st.lists(st.floats(0, 900) | st.none(), min_size=6, max_size=120),
    st.integers(1, 3),
    st.integers(0, 3),
    st.floats(0.01, 0.99),
    st.randoms(use_true_random=False),
    st.sampled_from(["floor", "truth"]),
)
def test_interim_analysis_matches_naive_count(
    settle: list[float | None], variants: int, later: int, wanted: float, random: Any, judged: str
) -> None:
    """Of all runs of the first draws, in any order, and of no later one; as the study judges."""
    name = {"floor": "settle_10_s", "truth": "settle_10_truth_s"}[judged]
    draws = len(settle) // variants
    runs = list(range((draws + later) * variants))
    settle = settle[: draws * variants] + [1e6] * (later * variants)
    random.shuffle(runs)
    table = pa.table(
        {
            "run_id": runs,
            "draw_id": [run // variants for run in runs],
            "variant_id": [run % variants for run in runs],
            "status": ["diverged" if settle[run] is None else "ok" for run in runs],
            name: pa.array([settle[run] for run in runs], pa.float64()),
        }
    )
    own = [[settle[d * variants + v] for d in range(draws)] for v in range(variants)]
    shares = [share([s is not None for s in values]) for values in own]
    means = [mean(np.array(values, float)) for values in own]
    axes = {"phi_u0_deg": [float(v) for v in range(variants)]}
    for statistic, widths, half_width in (
        ("success_rate", shares, wanted),
        ("settle_10_s_mean", means, 400 * wanted),
    ):
        study = make_study(statistic, half_width, axes=axes, study={"judged_from": judged})
        rows = table.select(interim_columns(study))
        found = widest_half_width(study, rows, draws)
        halves = [(width.high - width.low) / 2 for width in widths]
        assert found == pytest.approx(max(math.inf if math.isnan(h) else h for h in halves))


# --- in a sweep ---------------------------------------------------------------------------------


def stop_after_one(runner: TaskRunner, tasks: Any, stop: threading.Event) -> Any:
    for task in tasks:
        stop.set()
        yield runner.compute(task)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("statistic", "half_width"), [("success_rate", 0.03), ("settle_60_s_mean", 0.2)]
)
def test_sweep_stops_at_same_draw_despite_chunk_order_or_interruption(
    statistic: str, half_width: float, tmp_path: Path
) -> None:
    sensors = {"gyro_noise_deg_per_h": 200.0, "accel_noise_ug": 200000.0}
    alignment = {"phi_e0_deg": 1.0, "phi_n0_deg": 1.0}
    study = make_study(statistic, half_width, sensors=sensors, alignment=alignment)
    draws, out = 256, tmp_path / "out"
    whole = study_run.run(study, chunk_runs=128)
    assert whole.summary.num_rows == 2 * draws
    assert study_run.run(study).summary.equals(whole.summary)
    before = [n for n in interim_draws(study) if n < draws]
    assert all(widest_half_width(study, whole.summary, n) > half_width for n in before)
    backwards = Executor(lambda shop, tasks: map_in_threads(shop.compute, list(tasks)[::-1], 2), {})
    study_run.run_into(study, tmp_path / "back", chunk_runs=128, executor=backwards)
    stop, interrupted = threading.Event(), 0
    for _ in range(50):  # interrupted after every chunk
        try:
            stop.clear()
            one_by_one = Executor(lambda shop, tasks: stop_after_one(shop, tasks, stop), {})
            options: dict[str, Any] = {"chunk_runs": 128, "resume": True, "stop": stop}
            study_run.run_into(study, out, executor=one_by_one, **options)
            break
        except StudyInterrupted:
            interrupted += 1
    assert interrupted and read_parts(out) == read_parts(tmp_path / "back")
    assert read_summary(out).equals(whole.summary)
    told = read_manifest_entries(out)
    assert (told["state"], told["draws"], told["runs_done"]) == ("complete", draws, 2 * draws)
