"""Whole runs against loops and metrics in plain NumPy."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from oracles.in_engine import ARCMIN, PAPER1, paper_filter
from oracles.naive import DEG, FIVE, PAPER, closed_loop, euler_matrix, exp, judge, log, wound_back
from scipy.spatial.transform import Rotation
from support.batches import records_of
from support.studies import small_study

import sinsjax

pytestmark = pytest.mark.optimised(False)

RATE, LATITUDE = 100, 32 * DEG
START = {"phi_e0_deg": 2.0, "phi_n0_deg": -3.0, "phi_u0_deg": 10.0}
START |= {"ve0_m_per_s": 0.1, "vn0_m_per_s": -0.2}
NOISELESS = dict.fromkeys(("gyro_noise_deg_per_h", "accel_noise_ug"), 0.0)
AXES = ("phi_e", "phi_n", "phi_u", "pitch", "roll", "yaw")
BANDS = (600.0, 60.0, 10.0)


def swinging(seconds: float, interval_s: float = 1.0, **tables: Any) -> Any:
    """A study of one run of [P1]'s filter on its swinging base, with biases of the sensors."""
    study = {"duration_s": seconds, "record_interval_s": interval_s, "draws": 1, "curves": True}
    study |= {"window_s": [2, 6], "consistency_after_s": 1.0, "steady_after_s": 4.0}
    study |= {"settle_bands_arcmin": BANDS, "success_band_arcmin": 60.0}
    feedback = {"feedback_interval_s": 0.4, "feedback_time_constant_s": 2.0}
    still = {"motion": {"yaw_center_deg": 0.0}, "alignment": START | feedback}
    return small_study(**{"study": study} | still | tables)


def angles(table: Any, *names: str) -> np.ndarray:
    """Columns of angles, rad."""
    units = {name: "arcmin" if name.startswith(("phi", "sigma")) else "deg" for name in names}
    columns = [table[f"{name}_{unit}"].to_numpy() for name, unit in units.items()]
    return np.stack(columns, axis=1) * [{"arcmin": ARCMIN, "deg": DEG}[u] for u in units.values()]


class Way(NamedTuple):
    """How a run reads its data; lengths in record intervals of so many samples."""

    every: int
    records: int
    stored: int | None = None
    coarse: int = 0
    replays: bool = False
    resets: str = "full"


WAYS = {
    "once": Way(30, 23, resets="yaw"),
    "seldom recorded": Way(70, 9, resets="scale"),
    "passes": Way(30, 23, stored=7),
    "one pass": Way(30, 23, stored=23),
    "coarse": Way(30, 23, coarse=7),
    "coarse and replayed": Way(30, 23, coarse=7, replays=True),
}


@pytest.mark.nightly(fast=("passes",))
@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_run_matches_naive_loop_and_metrics(way: Way) -> None:
    """From its start, or at rest and with P0 from what the coarse method has found.

    That has no noise, whose last bits differ: a heading of 2 s magnifies them.
    """
    every, records, begin = way.every, way.records, way.coarse * way.every
    resets = {"reset_times_s": [2.15, 4.0], "reset_kind": way.resets, "reset_scale": 7.0}
    tables: dict[str, Any] = {"resets": resets}
    if way.stored:
        tables["passes"] = {"stored_s": way.stored * every / RATE}
    if begin:
        then = "replay" if way.replays else "hand_over"
        tables["coarse"] = {"coarse_duration_s": begin / RATE, "coarse_then": then}
        tables["sensors"] = NOISELESS
    study = swinging(every * records / RATE, every / RATE, **tables)
    runs, rows = sinsjax.run(study), records_of(study)[0]
    found = angles(runs.curves, *AXES)
    c = exp(-np.array([2.0, -3.0, 10.0]) * DEG) @ PAPER1.matrix(0.0)
    if begin:
        c = euler_matrix(*found[way.coarse - 1, 3:])
    if way.replays:
        c = wound_back(c, rows[:begin], 1 / RATE, PAPER, LATITUDE)
    naive = closed_loop(
        FIVE,
        rows,
        1 / RATE,
        PAPER,
        paper_filter(
            5, every=40, gain=1 - np.exp(-0.2), resets=(215, 400), kind=way.resets, factor=7.0
        ),
        (c, np.zeros(2) if begin else np.array([0.1, -0.2]), LATITUDE),
        count=every * records,
        first=1 if way.replays else begin + 1,
    )
    at = np.arange(way.coarse + 1, records + 1) * every
    rows = at - 1 - (0 if way.replays else begin)
    corrected = naive.corrected[rows]
    stored = way.stored or records
    places = [*range(1, stored + 1), *reversed(range(stored))] * records
    truth = np.stack([PAPER1.matrix(places[k // every - 1] * every / RATE) for k in at])
    yaw, pitch, roll = Rotation.from_matrix(corrected).as_euler("ZXY").T
    phi = log(truth @ np.swapaxes(corrected, 1, 2))
    values = np.column_stack([phi, pitch, roll, yaw])
    sigma = np.sqrt(np.diagonal(naive.p, axis1=1, axis2=2))[rows, 2:5]
    close = {"rtol": 0, "atol": 1e-8 if begin else 1e-9}
    np.testing.assert_allclose(found[way.coarse :], values, **close)
    sigmas = angles(runs.curves, "sigma_e", "sigma_n", "sigma_u")
    np.testing.assert_allclose(sigmas[way.coarse :], sigma, **close)
    assert np.isnan(sigmas[: way.coarse]).all()
    if begin:
        return

    expected = judge(
        at / RATE,
        values,
        sigma[:, 2],
        p=naive.p[-1][2:5, 2:5],
        floor=np.nan,
        bands=np.array(BANDS) * ARCMIN,
        window=(2.0, 6.0),
        after=(1.0, 1.0, 4.0),
    )
    for statistic in ("mean", "std"):
        got = angles(runs.summary, *(f"{axis}_{statistic}" for axis in AXES))
        np.testing.assert_allclose(got[0], getattr(expected, statistic), **close)
    (row,) = runs.summary.to_pylist()
    settled = [None if time == at[-1] / RATE else time for time in expected.outside_until[1]]
    assert [row[f"settle_{band:g}_truth_s"] for band in BANDS] == pytest.approx(settled)
    assert row["p_above_error_share"] == pytest.approx(expected.above_share[0])
    assert row["p_above_error_steady_share"] == pytest.approx(expected.above_share[2])
    assert row["nees"] == pytest.approx(expected.nees, rel=1e-6)
