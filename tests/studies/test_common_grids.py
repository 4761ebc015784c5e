"""Runs as arrays over the axes that a page names, and choices told by unused draws."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from docs.studies.common import grids
from docs.studies.common.grids import held_out, soonest
from sinsjax.execution.source import Source

NEVER = np.inf
AXES = {"reset_count": [0, 1, 2], "phi_u0_deg": [5.0, 30.0]}


def source_of(axes=AXES, **given):
    study = small_study(study={"draws": 4}, axes=axes, resets={"reset_cycle_s": 1.0})
    return Source(Path("results"), study, "x.toml", synthetic_summary(study, **given))


def grid_of(source, columns=("settle_10_s",)):
    return grids.grid_of(source, columns, yaw="phi_u0_deg", count="reset_count")


@pytest.mark.parametrize("axes", [AXES, dict(reversed(AXES.items()))])
def test_grid_places_every_run_at_its_axis_values(axes):
    settle = np.arange(24.0)
    settle[[3, 17]] = np.nan
    source = source_of(axes, settle_10_s=settle)
    grid = grid_of(source)
    assert grid.axes == {"yaw": (5.0, 30.0), "count": (0, 1, 2)} and grid.draws == 4
    for yaw, count in itertools.product(*grid.axes.values()):
        rows = source.summary.to_pylist()
        expected = [
            NEVER if row["settle_10_s"] is None else row["settle_10_s"]
            for row in rows
            if (row["phi_u0_deg"], row["reset_count"]) == (yaw, count)
        ]
        assert grid.at("settle_10_s", yaw=yaw, count=count).tolist() == expected


def naive_held_out(settle):
    """Draw by draw, the setting that is best on the draws of the other half."""
    chosen = []
    for draw in range(settle.shape[1]):
        seen = [d for d in range(settle.shape[1]) if d % 2 != draw % 2]
        scores = []
        for place, runs in enumerate(settle):
            times = sorted(runs[d] for d in seen)
            scores.append((times.count(NEVER), times[(len(times) - 1) // 2], place))
        chosen.append(min(scores)[2])
    return chosen


@given(
    arrays.arrays(
        float,
        st.tuples(st.integers(2, 5), st.integers(2, 9)),
        elements=st.sampled_from([10.0, 20.0, 30.0, NEVER]),
    )
)
def test_held_out_choice_matches_naive_cross_validation(settle):
    choice = held_out(settle, soonest)
    expected = naive_held_out(settle)
    np.testing.assert_array_equal(choice.places, expected)
    np.testing.assert_array_equal(choice.values, settle[expected, np.arange(settle.shape[1])])
