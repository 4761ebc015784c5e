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

pytestmark = pytest.mark.optimised(False)

AXES = {"phi_u0_deg": [0.0, 1.0]}

AT_THE_FLOOR = {
    "phi_u_arcmin": [-20.0, 1.0],
    "outside_until": [[0.0, 1.0, 2.0], [6.0, 6.0, 6.0]],
    "from_truth": [[0.0, 6.0, 6.0], [1.0, 2.0, 3.0]],
}
"""The first run ends at its bias floor, the second at the truth; both have a floor of -20'."""


def summary_of(results: dict[str, Any] = AT_THE_FLOOR, **sections: Any) -> pa.Table:
    """The summary of two runs of 6 s on a still base."""
    study = small_study(**{"motion": STILL, "axes": AXES} | sections)
    return tables.TableBuilder(study).summary_table(chunk(**results), np.arange(2))


@pytest.mark.parametrize(
    ("judged_from", "status"),
    [
        ("floor", ["ok", "not_settled"]),
        ("truth", ["not_settled", "ok"]),
        (None, ["not_settled", "ok"]),
    ],
)
def test_status_follows_judged_from(judged_from: str | None, status: list[str]) -> None:
    found = summary_of(study={"judged_from": judged_from} if judged_from else {}).to_pydict()
    assert found["ok_floor"] == [True, False] and found["ok_truth"] == [False, True]
    assert found["status"] == status and found["has_floor"] == [True, True]


@pytest.mark.parametrize(
    ("dwell_s", "ok"), [(0.0, True), (4.9, True), (5.0, True), (5.1, False), (5.9, False)]
)
def test_success_requires_dwell_in_band(dwell_s: float, ok: bool) -> None:
    """The first run is within 10' of its bias floor from 1 s to its end at 6 s."""
    assert summary_of(study={"dwell_s": dwell_s})["ok_floor"].to_pylist() == [ok, False]


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
    results = AT_THE_FLOOR | {"level_arcmin": level_arcmin}
    found = summary_of(results, study={"level_band_arcmin": band}).to_pydict()
    assert found["ok_floor"] == [ok_floor, False] and found["ok_truth"] == [False, ok_truth]


@pytest.mark.parametrize("why", ["bias above Earth rate", "method without heading"])
def test_run_without_north_is_no_success(why: str) -> None:
    """Even with errors as small as these."""
    hidden = why == "bias above Earth rate"
    other = {"alignment": {"method": "level"}, "axes": {"yaw_center_deg": [0, 1]}}
    found = summary_of(AT_THE_FLOOR | {"no_north": hidden}, **{} if hidden else other).to_pydict()
    assert found["status"] == ["no_north"] * 2 and not any(found["ok_truth"])
    assert not any(found["ok_floor"])


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("diverged_deg", "status"), [(None, "diverged"), (12.0, "not_settled")])
def test_run_beyond_diverged_deg_is_diverged(
    diverged_deg: float | None, status: str, side: int
) -> None:
    """To either side."""
    off = {"phi_u_arcmin": [-20.0 + side * 11 * 60, 0.0], "outside_until": [[6.0] * 3] * 2}
    settings = {} if diverged_deg is None else {"diverged_deg": diverged_deg}
    assert summary_of(off, study=settings)["status"][0].as_py() == status


def test_floor_columns_are_null_without_bias_floor() -> None:
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


@pytest.mark.parametrize("method", ["kalman5", "kalman10", "level"])
def test_judging_from_missing_bias_floor_is_refused(method: str) -> None:
    study = small_study(study={"judged_from": "floor"}, alignment={"method": method})
    with pytest.raises(InputError, match=f"judged_from: 'floor' .*'{method}'"):
        run.run(study)
