"""How runs end: from the truth and from the bias floor, in their bands, for long enough."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.chunks import chunk
from support.studies import STILL, small_study

from sinsjax import analysis
from sinsjax.errors import InputError
from sinsjax.execution import run, tables
from sinsjax.study import success

pytestmark = pytest.mark.optimised(False)

AXES = {"phi_u0_deg": [0.0, 1.0]}


def judged(*, draws_from: dict[str, Any], **settings: Any) -> dict[str, list[Any]]:
    """The verdict columns of two runs of 6 s, which end at the floor or at the truth as told."""
    study = small_study(study=settings, motion=STILL, axes=AXES)
    table = tables.TableBuilder(study).summary_table(chunk(**draws_from), np.arange(2))
    return table.select(["ok_floor", "ok_truth", "status", "has_floor"]).to_pydict()


AT_THE_FLOOR = {
    "phi_u_arcmin": [-20.0, 1.0],
    "outside_until": [[0.0, 1.0, 2.0], [6.0, 6.0, 6.0]],
    "from_truth": [[0.0, 6.0, 6.0], [1.0, 2.0, 3.0]],
}
"""The first run ends at its bias floor, the second at the truth; both have a floor of -20'."""


@pytest.mark.parametrize(
    ("judged_from", "status"),
    [
        ("floor", ["ok", "not_settled"]),
        ("truth", ["not_settled", "ok"]),
        (None, ["not_settled", "ok"]),
    ],
)
def test_status_follows_judged_from(judged_from: str | None, status: list[str]) -> None:
    found = judged(draws_from=AT_THE_FLOOR, **({"judged_from": judged_from} if judged_from else {}))
    assert found["ok_floor"] == [True, False] and found["ok_truth"] == [False, True]
    assert found["status"] == status and found["has_floor"] == [True, True]


@pytest.mark.parametrize(
    ("dwell_s", "ok"), [(0.0, True), (4.9, True), (5.0, True), (5.1, False), (5.9, False)]
)
def test_success_requires_dwell_in_band(dwell_s: float, ok: bool) -> None:
    """The first run is within 10' of its bias floor from 1 s to its end at 6 s."""
    assert judged(draws_from=AT_THE_FLOOR, dwell_s=dwell_s)["ok_floor"] == [ok, False]


@pytest.mark.parametrize(("end_s", "dwell_s"), [(6.0, 0.6), (300.0, 30.0), (900.0, 30.0)])
def test_default_dwell_is_tenth_of_duration_up_to_30_s(end_s: float, dwell_s: float) -> None:
    assert success.success_criteria(small_study()).dwell(np.array([end_s])) == pytest.approx(
        dwell_s
    )


@pytest.mark.parametrize(
    ("band", "level_arcmin", "ok_floor", "ok_truth"),
    [
        # About floors of 1' (east) and -1' (north); from the truth 1.5' more than the band.
        (10.0, 8.9, True, True),
        (10.0, 9.1, False, True),
        (10.0, 11.4, False, True),
        (10.0, 11.6, False, False),
        (10.0, 179 * 60.0, False, False),
        (180.0, 170.0, True, True),
    ],
)
def test_level_error_outside_band_is_not_ok(
    band: float, level_arcmin: float, ok_floor: bool, ok_truth: bool
) -> None:
    """The heading is right in the first run about the bias floor, in the second about the truth."""
    found = judged(draws_from=AT_THE_FLOOR | {"level_arcmin": level_arcmin}, level_band_arcmin=band)
    assert found["ok_floor"] == [ok_floor, False] and found["ok_truth"] == [False, ok_truth]


def test_no_north_run_fails_with_status_no_north() -> None:
    found = judged(draws_from=AT_THE_FLOOR | {"no_north": True})
    assert found["status"] == ["no_north"] * 2
    assert found["ok_floor"] == found["ok_truth"] == [False, False]


def test_method_without_heading_has_no_success() -> None:
    """Even with errors as small as these, and on a base without a bias floor."""
    study = small_study(
        motion=STILL, alignment={"method": "level"}, axes={"yaw_center_deg": [0, 1]}
    )
    table = tables.TableBuilder(study).summary_table(
        chunk([0.0, 1.0], [[0.0] * 3] * 2), np.arange(2)
    )
    assert table["status"].to_pylist() == ["no_north"] * 2


@pytest.mark.parametrize(("diverged_deg", "status"), [(None, "diverged"), (12.0, "not_settled")])
def test_run_beyond_diverged_deg_is_diverged(diverged_deg: float | None, status: str) -> None:
    off = AT_THE_FLOOR | {"phi_u_arcmin": [-20.0 + 11 * 60, 0.0]}
    off["outside_until"] = off["from_truth"] = [[6.0] * 3] * 2
    settings = {} if diverged_deg is None else {"diverged_deg": diverged_deg}
    assert judged(draws_from=off, **settings)["status"][0] == status


def test_success_band_is_added_to_settling_bands() -> None:
    study = small_study(study={"success_band_arcmin": 30.0}, motion=STILL, axes=AXES)
    assert success.settling_bands(study) == (60.0, 10.0, 3.0, 30.0)
    table = tables.TableBuilder(study).summary_table(
        chunk([-20.0, -20.0], [[0.0, 6.0, 6.0, 1.0], [0.0, 1.0, 1.0, 6.0]]), np.arange(2)
    )
    assert table["ok_floor"].to_pylist() == [True, False]
    assert table["settle_30_s"].to_pylist() == [1.0, None]
    assert [yard.description for yard in success.success_measures(study)] == [
        "within 30' of true north",
        "within 30' of its bias floor",
    ]


SWAYING = {"judged_from": "truth"}


def test_floor_columns_are_null_without_bias_floor() -> None:
    """A biased base that sways more slowly than the run is long; null is not never."""
    study = small_study(study=SWAYING, axes=AXES)
    table = tables.TableBuilder(study).summary_table(chunk(**AT_THE_FLOOR), np.arange(2))
    assert table["has_floor"].to_pylist() == [False, False]
    for name in ("floor_arcmin", "settle_10_s", "nis_u", "p_above_floor_error_share", "ok_floor"):
        assert table[name].null_count == 2, name
    assert table["settle_10_truth_s"].to_pylist() == [None, 2.0]
    assert table["status"].to_pylist() == ["not_settled", "ok"]
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row["no_floor"] == 2 and row["success_truth_rate"] == 0.5
    assert row["success_floor_rate"] is row["settle_10_s_median"] is row["never_settled_10"] is None
    assert row["never_settled_10_truth"] == 1 and row["settle_10_truth_s_median"] == 2.0


@pytest.mark.parametrize("method", ["kalman5", "kalman10", "level"])
def test_judging_from_missing_bias_floor_is_refused(method: str) -> None:
    study = small_study(study={"judged_from": "floor"}, alignment={"method": method})
    with pytest.raises(InputError, match=f"judged_from: 'floor' .*'{method}'"):
        run.run(study)


def test_success_rates_match_hand_computed_shares() -> None:
    table = pa.table(
        {
            "status": ["ok"] * 4 + ["not_settled"] * 4,
            "phi_u_arcmin": np.arange(8.0),
            "has_floor": [True] * 6 + [False] * 2,
            "ok_floor": [True, True, True, False, False, False, None, None],
            "ok_truth": [False, True, False, False, True, False, False, False],
        }
    )
    names = ["success_rate", "success_floor_rate", "success_truth_rate"]
    (row,) = analysis.summarise(table, [], names).to_pylist()
    for name, k, n in zip(names, (4, 3, 2), (8, 6, 8), strict=True):
        share = analysis.proportion(k, n)
        assert (row[name], row[f"{name}_low"], row[f"{name}_high"]) == share[:3]


def test_success_rate_differences_are_paired() -> None:
    flags = {"ok_floor": [True] * 20, "ok_truth": [True] * 5 + [False] * 15}
    common = {"draw_id": np.arange(20), "phi_u_mean_arcmin": np.zeros(20)}
    common |= {"status": ["ok"] * 20, "phi_u_arcmin": np.zeros(20), "floor_arcmin": np.zeros(20)}
    other = {"ok_floor": [False] * 10 + [True] * 10, "ok_truth": [False] * 20}
    parts = [
        pa.table(common | {"case": [case] * 20} | own) for case, own in (("a", flags), ("b", other))
    ]
    (row,) = analysis.compare_with_baseline(
        pa.concat_tables(parts), ["case"], {"case": "b"}
    ).to_pylist()
    for name in ("floor", "truth"):
        pair = [np.array(own[f"ok_{name}"]) for own in (flags, other)]
        expected = analysis.proportion_difference(*pair)
        assert row[f"success_{name}_rate_difference"] == expected.value
        assert row[f"success_{name}_rate_difference_low"] == expected.low
