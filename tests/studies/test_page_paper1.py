import math

import numpy as np
import pyarrow as pa
import pytest

from docs.studies.paper1.statements import (
    CONCLUSIONS,
    CONDITIONS,
    RESET,
    STATEMENTS,
    Finding,
    Judged,
    best_of,
    judge,
)
from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.errors import InputError

DRAWS = 128
FLOOR = -27.0


def condition(settle, *, error=0.0, above=1.0, steady=1.0, sigma=12.0, n=DRAWS):
    """One condition's runs: ``error`` of the window mean from the floor."""
    noise = np.random.default_rng(8).normal(size=n)
    times = np.full(n, np.nan if settle is None else settle) + 3 * noise
    return pa.table(
        {
            "draw_id": np.arange(n),
            "settle_10_s": pa.array(times, from_pandas=True),
            "phi_u_mean_arcmin": FLOOR + error + noise,
            "floor_arcmin": np.full(n, FLOOR),
            "sigma_u_arcmin": np.full(n, sigma) + 0.1 * noise,
            "p_above_error_share": np.full(n, above),
            "p_above_error_steady_share": np.full(n, steady),
        }
    )


def as_the_paper():
    """Runs that do what the paper says."""
    return {
        "1": condition(60.0, sigma=40.0),
        "2": condition(80.0),
        "3": condition(300.0),
        "4": condition(600.0, error=8.0),
        "5": condition(None, error=400.0, above=0.2, steady=0.0),
        RESET: condition(250.0, error=0.3, sigma=41.0),
    }


def replaced(name, column, values):
    runs = as_the_paper()
    place = runs[name].column_names.index(column)
    runs[name] = runs[name].set_column(place, column, pa.array(values, from_pandas=True))
    return judge(runs)


def test_all_statements_hold_for_runs_matching_paper():
    verdicts = judge(as_the_paper())
    assert list(verdicts) == list(STATEMENTS)
    for name, verdict in verdicts.items():
        assert verdict.holds and not verdict.straddles, name
        assert verdict.number.n == DRAWS


def test_statement_numbers_match_analysis_functions():
    runs = as_the_paper()
    found = {name: one.number for name, one in judge(runs).items()}
    settle = {name: table["settle_10_s"].to_numpy() for name, table in runs.items()}
    yaw = {name: table["phi_u_mean_arcmin"].to_numpy() for name, table in runs.items()}
    assert found["S1a"] == analysis.proportion(DRAWS, DRAWS)
    assert found["S2b"] == analysis.quantile(settle["2"])
    assert found["S4a"] == analysis.quantile_difference(settle["3"], settle["2"])
    assert found["S6b"] == analysis.quantile_difference(settle["4"], settle["1"])
    assert found["S8"] == analysis.proportion(0, DRAWS)
    assert found["S12"].value == pytest.approx(0.3)
    errors = np.abs(yaw["4"] - FLOOR), np.abs(yaw["2"] - FLOOR)
    assert found["S7a"] == analysis.mean_difference(*errors)
    assert found["S14"].value == pytest.approx(41 / 40, rel=1e-4)


def test_no_statement_holds_for_contradicting_runs():
    runs = {
        "1": condition(None, above=0.1, sigma=5.0, error=50.0),
        "2": condition(None, error=50.0),
        "3": condition(None),
        "4": condition(None),
        "5": condition(30.0),
        RESET: condition(None, above=0.1),
    }
    verdicts = judge(runs)
    assert {name for name, v in verdicts.items() if v.holds} == set()
    # Two that never settle show no difference: its interval has both ends at the threshold.
    assert {name for name, v in verdicts.items() if v.straddles} == {"S4a", "S4b", "S6a", "S6b"}


@pytest.mark.parametrize(
    ("settled", "holds", "straddles"),
    [(128, True, False), (123, True, True), (121, False, True), (110, False, False)],
)
def test_convergence_statement_uses_settled_share(settled, holds, straddles):
    values = np.where(np.arange(DRAWS) < settled, 60.0, np.nan)
    verdict = replaced("3", "settle_10_s", values)["S3"]
    assert (verdict.holds, verdict.straddles) == (holds, straddles)
    assert verdict.number.value == settled / DRAWS


@pytest.mark.parametrize(
    ("settled", "holds", "straddles"),
    [(0, True, False), (6, True, True), (7, False, True), (20, False, False)],
)
def test_non_convergence_statement_uses_settled_share(settled, holds, straddles):
    values = np.where(np.arange(DRAWS) < settled, 60.0, np.nan)
    verdict = replaced("5", "settle_10_s", values)["S8"]
    assert (verdict.holds, verdict.straddles) == (holds, straddles)


def test_share_interval_of_64_draws_straddles_95_percent():
    runs = {name: table.slice(0, 64) for name, table in as_the_paper().items()}
    found = judge(runs)
    assert found["S1a"].holds and found["S1a"].straddles


def test_short_time_statement_holds_up_to_threshold():
    assert replaced("2", "settle_10_s", np.full(DRAWS, 200.0))["S2b"].holds
    assert not replaced("2", "settle_10_s", np.full(DRAWS, 201.0))["S2b"].holds


def test_longer_settling_requires_interval_above_zero():
    settle = as_the_paper()["2"]["settle_10_s"].to_numpy()
    slower = np.where(np.arange(DRAWS) % 2, settle + 0.5, settle - 0.4)
    verdict = replaced("3", "settle_10_s", slower)["S4a"]
    assert not verdict.holds and verdict.straddles
    assert verdict.number.low <= 0 <= verdict.number.high
    assert replaced("3", "settle_10_s", np.full(DRAWS, np.nan))["S4a"].number.value == math.inf


@pytest.mark.parametrize(
    ("shift", "holds", "straddles"),
    [(0.99, True, False), (-0.99, True, False), (1.2, False, False), (-1.2, False, False)],
)
def test_as_precise_statement_holds_within_threshold(shift, holds, straddles):
    yaw = as_the_paper()["1"]["phi_u_mean_arcmin"].to_numpy()
    verdict = replaced(RESET, "phi_u_mean_arcmin", yaw + shift)["S12"]
    assert (verdict.holds, verdict.straddles) == (holds, straddles)
    assert verdict.number[:3] == pytest.approx((shift,) * 3)


def test_as_precise_statement_fails_with_wide_interval():
    yaw = as_the_paper()["1"]["phi_u_mean_arcmin"].to_numpy()
    spread = np.random.default_rng(9).normal(0.9, 5.0, DRAWS)
    verdict = replaced(RESET, "phi_u_mean_arcmin", yaw + spread)["S12"]
    assert not verdict.holds and verdict.straddles


def test_as_precise_statement_fails_with_missing_value():
    yaw = as_the_paper()[RESET]["phi_u_mean_arcmin"].to_numpy().copy()
    yaw[0] = np.nan
    verdict = replaced(RESET, "phi_u_mean_arcmin", yaw)["S12"]
    assert not verdict.holds and verdict.number.n == DRAWS - 1


def test_covariance_share_counts_all_records():
    share = np.where(np.arange(DRAWS) % 4, 1.0, 0.9)
    verdict = replaced("1", "p_above_error_share", share)["S9"]
    assert verdict.holds and verdict.number.value == pytest.approx(0.975)
    share[:8] = np.nan  # records of runs that are not finite count against it
    found = replaced("1", "p_above_error_share", share)["S9"].number
    assert found.value == pytest.approx(np.nansum(share) / DRAWS)
    assert 0 <= found.low < found.high <= 1


@pytest.mark.parametrize(
    ("share", "holds", "straddles"),
    [(0.0, True, False), (0.04, True, False), (0.06, False, False), (np.nan, False, False)],
)
def test_smaller_when_steady_statement_holds_below_five_percent(share, holds, straddles):
    verdict = replaced("5", "p_above_error_steady_share", np.full(DRAWS, share))["S10"]
    assert (verdict.holds, verdict.straddles) == (holds, straddles)
    assert verdict.number.value == pytest.approx(np.nan_to_num(share, nan=1.0))


def test_smaller_when_steady_share_counts_all_records():
    share = np.where(np.arange(DRAWS) % 16, 0.0, 0.8)
    verdict = replaced("5", "p_above_error_steady_share", share)["S10"]
    assert verdict.holds and verdict.straddles and verdict.number.value == pytest.approx(0.05)


@pytest.mark.parametrize(("ratio", "holds"), [(0.91, True), (1.09, True), (0.89, False), (1.2, 0)])
def test_equal_final_sigma_holds_within_ten_percent(ratio, holds):
    sigma = as_the_paper()["1"]["sigma_u_arcmin"].to_numpy()
    verdict = replaced(RESET, "sigma_u_arcmin", ratio * sigma)["S14"]
    assert verdict.holds == bool(holds) and not verdict.straddles


def test_single_draw_findings_are_marked_as_straddling():
    runs = {name: table.slice(0, 1) for name, table in as_the_paper().items()}
    found = judge(runs)
    assert not found["S4a"].holds and found["S4a"].straddles
    assert found["S9"].holds and found["S9"].straddles


def test_judge_refuses_missing_conditions_draws_or_columns():
    runs = as_the_paper()
    for name in CONDITIONS:
        with pytest.raises(InputError, match=f"condition {name}$"):
            judge({k: v for k, v in runs.items() if k != name})
    with pytest.raises(InputError, match="no runs of condition 3"):
        judge(runs | {"3": runs["3"].slice(0, 0)})
    with pytest.raises(InputError, match="draws differ"):
        judge(runs | {"3": runs["3"].slice(1)})
    with pytest.raises(InputError, match="column settle_10_s is missing"):
        judge(runs | {"3": runs["3"].drop_columns(["settle_10_s"])})


def verdicts(held, clear=()):
    number = Estimate(0.5, 0.4, 0.6, 8)
    return {name: Finding(name in held, name not in clear, number) for name in STATEMENTS}


def test_best_of_breaks_ties_by_conclusions_intervals_and_order():
    plain = Judged({"n": 0}, verdicts(["S1a", "S1b"]))
    concluding = Judged({"n": 1}, verdicts(["S1a", CONCLUSIONS[0]]))
    clear = Judged({"n": 2}, verdicts(["S2a", CONCLUSIONS[1]], clear=["S3"]))
    again = Judged({"n": 3}, verdicts(["S2a", CONCLUSIONS[1]], clear=["S4a"]))
    most = Judged({"n": 4}, verdicts(["S1a", "S1b", "S3"]))
    assert best_of([plain, concluding]) is concluding
    assert best_of([plain, concluding, clear, again]) is clear
    assert best_of([plain, concluding, clear, most]) is most
