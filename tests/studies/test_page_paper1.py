import numpy as np
import pyarrow as pa
import pytest

from docs.studies.paper1.statements import (
    RESET,
    STATEMENTS,
    Finding,
    judge,
)
from sinsjax import analysis
from sinsjax.analysis import Estimate

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


def verdicts(held, clear=()):
    number = Estimate(0.5, 0.4, 0.6, 8)
    return {name: Finding(name in held, name not in clear, number) for name in STATEMENTS}
