"""What the first paper's words mean: runs that do as it says, and runs that do the opposite."""

import numpy as np
import pyarrow as pa

from docs.studies.paper1 import RESET, STATEMENTS, judge

DRAWS = 128


def condition(settle, *, error=0.0, above=1.0, steady=1.0, sigma=12.0):
    """One condition's runs: ``error`` of the window mean from the floor."""
    noise = np.random.default_rng(8).normal(size=DRAWS)
    times = np.full(DRAWS, np.nan if settle is None else settle) + 3 * noise
    return pa.table(
        {
            "draw_id": np.arange(DRAWS),
            "settle_10_s": pa.array(times, from_pandas=True),
            "phi_u_mean_arcmin": -27.0 + error + noise,
            "floor_arcmin": np.full(DRAWS, -27.0),
            "sigma_u_arcmin": np.full(DRAWS, sigma) + 0.1 * noise,
            "p_above_error_share": np.full(DRAWS, above),
            "p_above_error_steady_share": np.full(DRAWS, steady),
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


def test_all_statements_hold_for_runs_that_do_as_the_paper_says():
    for text, (holds, straddles, number) in zip(STATEMENTS, judge(as_the_paper()), strict=True):
        assert holds and not straddles and number.n == DRAWS, text


def test_no_statement_holds_for_runs_that_contradict_it():
    runs = {
        "1": condition(None, above=0.1, sigma=5.0, error=50.0),
        "2": condition(None, error=50.0),
        "3": condition(None),
        "4": condition(None),
        "5": condition(30.0),
        RESET: condition(None, above=0.1),
    }
    found = dict(zip(STATEMENTS, judge(runs), strict=True))
    assert [text for text, (holds, *_) in found.items() if holds] == []
    # Two that never settle show no difference: its interval has both ends at the bound.
    assert all("longer" in text for text, (_, straddles, _) in found.items() if straddles)
