"""Result tables: how runs end, from the truth and from the bias floor, and which cells are null."""

import jax
import numpy as np
import pytest
from support.chunks import chunk
from support.studies import STILL, small_study

import sinsjax
from sinsjax import analysis
from sinsjax.errors import InputError
from sinsjax.execution.tables import TableBuilder

pytestmark = pytest.mark.optimised(False)

FROM_FLOOR = {"judged_from": "floor", "dwell_s": 0.0}
AT_THE_FLOOR = {
    "phi_u_arcmin": [-20.0, 1.0],
    "outside_until": [[0.0, 1.0, 2.0], [6.0, 6.0, 6.0]],
    "from_truth": [[0.0, 6.0, 6.0], [1.0, 2.0, 3.0]],
}
"""The first run ends at its bias floor, the second at the truth; both have a floor of -20'."""


def summary_of(rows=AT_THE_FLOOR, *, has_truth=True, **sections):
    """The summary of two runs of 6 s on a still base, by default of those at the floor."""
    study = small_study(**{"motion": STILL, "axes": {"phi_u0_deg": [0.0, 1.0]}} | sections)
    builder = TableBuilder(study, has_truth=has_truth)
    return builder.summary_table(chunk(**rows), np.arange(study.n_variants))


@pytest.mark.parametrize(
    ("settings", "level_arcmin", "status", "ok_floor", "ok_truth"),
    [
        ({}, 2.0, ["not_settled", "ok"], True, True),
        ({"judged_from": "truth"}, 2.0, ["not_settled", "ok"], True, True),
        ({"judged_from": "floor"}, 2.0, ["ok", "not_settled"], True, True),
        # The first run is within 10' of its bias floor from 1 s to its end at 6 s.
        ({"judged_from": "floor", "dwell_s": 5.0}, 2.0, ["ok", "not_settled"], True, False),
        ({"judged_from": "floor", "dwell_s": 5.1}, 2.0, ["not_settled"] * 2, False, False),
        # About floors of 1' (east) and -1' (north); from the truth 1.5' more than the band.
        ({"level_band_arcmin": 10.0}, 8.9, ["not_settled", "ok"], True, True),
        ({"level_band_arcmin": 10.0}, 9.1, ["not_settled", "ok"], False, True),
        ({"level_band_arcmin": 10.0}, 11.4, ["not_settled", "ok"], False, True),
        ({"level_band_arcmin": 10.0}, 11.6, ["not_settled"] * 2, False, False),
        ({"level_band_arcmin": 180.0}, 170.0, ["not_settled", "ok"], True, True),
    ],
)
def test_success_needs_heading_level_and_dwell(settings, level_arcmin, status, ok_floor, ok_truth):
    """The heading is right in the first run about the bias floor, in the second about the truth."""
    found = summary_of(AT_THE_FLOOR | {"level_arcmin": level_arcmin}, study=settings).to_pydict()
    assert found["ok_floor"] == [ok_floor, False] and found["ok_truth"] == [False, ok_truth]
    assert found["status"] == status and found["has_floor"] == [True, True]


@pytest.mark.parametrize("hidden", [True, False], ids=["by a large bias", "from the method"])
def test_run_without_north_is_no_success(hidden):
    """Even with errors as small as these."""
    other = {"alignment": {"method": "level"}, "axes": {"yaw_center_deg": [0, 1]}}
    found = summary_of(AT_THE_FLOOR | {"no_north": hidden}, **{} if hidden else other).to_pydict()
    assert found["status"] == ["no_north"] * 2
    assert not any(found["ok_truth"] + found["ok_floor"])


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("settings", "status"), [({}, "diverged"), ({"diverged_deg": 12.0}, "not_settled")]
)
def test_run_beyond_diverged_deg_is_diverged(settings, status, side):
    off = {"phi_u_arcmin": [-20.0 + side * 11 * 60, 0.0], "outside_until": [[6.0] * 3] * 2}
    assert summary_of(off, study=settings)["status"][0].as_py() == status


def test_floor_columns_are_null_without_bias_floor():
    """A biased base that sways more slowly than the run is long; null is not never."""
    table = summary_of(study={"judged_from": "truth"}, motion={})
    assert table["has_floor"].to_pylist() == [False, False]
    for name in ("floor_arcmin", "settle_10_s", "nis_u", "p_above_floor_error_share", "ok_floor"):
        assert table[name].null_count == 2, name
    assert table["settle_10_truth_s"].to_pylist() == [None, 2.0]
    assert table["status"].to_pylist() == ["not_settled", "ok"]
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row["no_floor"] == 2 and row["success_truth_rate"] == 0.5
    assert row["success_floor_rate"] is row["settle_10_s_median"] is row["never_settled_10"] is None
    assert row["never_settled_10_truth"] == 1 and row["settle_10_truth_s_median"] == 2.0


def test_settling_time_is_reported_in_update_time_and_data_time():
    """The data that was there: what had been recorded by then, and no more than the record."""
    passes = {"stored_s": 2.0}
    # The first two runs end after 2 s, the others after 6 s.
    outside = [[0.0, 1.0, 2.0], [2.0, 2.0, 2.0], [1.0, 2.0, 5.0], [3.0, 4.0, 6.0]]
    rows = {"phi_u_arcmin": [-21.0] * 4, "outside_until": outside}
    axes = {"passes": [1, 3], "phi_u0_deg": [0.0, 1.0]}
    table = summary_of(rows, study=FROM_FLOOR, passes=passes, axes=axes)
    for band, settled, data in (
        (60, [0.0, None, 1.0, 3.0], [0.0, None, 1.0, 2.0]),
        (10, [1.0, None, 2.0, 4.0], [1.0, None, 2.0, 2.0]),
        (3, [None, None, 5.0, None], [None, None, 2.0, None]),
    ):
        assert table[f"settle_{band}_s"].to_pylist() == settled
        assert table[f"settle_{band}_data_s"].to_pylist() == data
    assert table["status"].to_pylist() == ["ok", "not_settled", "ok", "ok"]


def test_broken_runs_are_nonfinite_and_unknown_errors_null():
    table = summary_of(AT_THE_FLOOR | {"phi_u_arcmin": [np.nan, 1.0]})
    assert table["phi_u_arcmin"].null_count == 1
    broken = summary_of(AT_THE_FLOOR | {"yaw": np.nan})
    assert broken["status"].to_pylist() == ["nonfinite"] * 2


def test_cells_that_need_the_truth_are_null_without_it():
    table = summary_of(passes={"stored_s": 2.0}, has_truth=False)
    needing = ("phi_u_arcmin", "phi_u_mean_arcmin", "settle_10_data_s", "floor_arcmin", "nees")
    assert all(table[name].null_count == 2 for name in (*needing, "settle_10_s", "status"))
    left = ("pitch_deg", "yaw_mean_deg", "yaw_std_deg", "sigma_u_arcmin")
    assert not any(table[name].null_count for name in left)


@pytest.mark.parametrize("method", ["kalman5", "kalman10", "level"])
def test_judging_from_missing_bias_floor_is_refused(method):
    study = small_study(study={"judged_from": "floor"}, alignment={"method": method})
    with pytest.raises(InputError, match=f"judged_from: 'floor' .*'{method}'"):
        sinsjax.run(study)


def test_single_precision_is_refused():
    with jax.enable_x64(False), pytest.raises(InputError, match="double precision"):
        sinsjax.run(small_study())
