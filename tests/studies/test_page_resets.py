"""What the pages on resets compute, against plain definitions."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from studies.test_pages import ROOT, made_up

from docs.studies.adaptive import scores as adaptive
from docs.studies.reset_cycle import grid as reset_cycle
from sinsjax import analysis
from sinsjax.study.load import load_study


@given(arrays.arrays(bool, st.tuples(st.integers(2, 4), st.integers(2, 4), st.integers(1, 3))))
def test_variance_is_split_as_by_least_squares(failed):
    parts = reset_cycle.failed_by_level_and_yaw(failed)
    levels, yaws, draws = failed.shape
    cells = list(itertools.product(range(levels), range(yaws)))
    design = (
        np.array([[level == i for i in range(levels)] for level, _ in cells], float),
        np.array([[yaw == i for i in range(yaws)] for _, yaw in cells], float),
    )
    expected = []
    for draw in range(draws):
        y = failed[..., draw].ravel().astype(float)
        if whole := np.sum((y - y.mean()) ** 2):
            fits = (dummies @ np.linalg.lstsq(dummies, y, rcond=None)[0] for dummies in design)
            explained = [1 - np.sum((y - fit) ** 2) / whole for fit in fits]
            expected.append([*explained, 1 - sum(explained)])
    if expected:
        found = [part.value for part in parts]
        np.testing.assert_allclose(found, np.mean(expected, axis=0), atol=1e-12)
    else:
        assert all(part.n == 0 for part in parts)


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    return adaptive.Scores(made_up(tmp_path_factory.mktemp("r"), "adaptive_resets"))


def test_alarms_are_those_of_the_definition(scores):
    """Each healthy run by itself, with settling times that no engine made."""
    grid, random = scores.grid, np.random.default_rng(3)
    shape = grid.columns["settle_10_s"].shape
    times = random.choice([40.0, 44.5, 46.0, 100.0, 105.5, np.inf], size=shape)
    grid.columns["settle_10_s"][:] = times
    grid.columns["triggered_count"][:] = random.integers(0, 2, size=shape)
    policy = scores.triggered[0]
    place, none = (grid.axes["policy"].index(one) for one in (policy, adaptive.NONE))
    false, draws = [], []
    for q, f, s, d in np.ndindex(*shape[:3], shape[-1]):
        if grid.axes["start"][s].is_healthy:
            one, other = times[q, f, s, place, d], times[q, f, s, none, d]
            later = 0.0 if one == other else one - other
            acted = grid.columns["triggered_count"][q, f, s, place, d] > 0
            share = later > 0 and (other == np.inf or later > 0.1 * other)
            false.append(acted and (share or later > 5))
            draws.append(d)
    assert any(false) and not all(false)
    assert scores.alarms(policy).false == analysis.share(false, draws)


def test_cells_within_are_counted_with_their_intervals(scores):
    policy = scores.triggered[0]
    ratios, (low, high) = scores.ratios(policy), scores.intervals(policy)
    found = scores.within(policy)
    assert found.n == 135 and found.value == (ratios <= 1.1).sum()
    assert (found.low, found.high) == (
        min((high <= 1.1).sum(), found.value),
        max((low <= 1.1).sum(), found.value),
    )
    each = [scores.within(policy, feedback) for feedback in (0.01, 1.0, 10.0)]
    assert sum(one.value for one in each) == found.value


@pytest.mark.parametrize("name", ["reset_cycle_study", "adaptive_resets"])
def test_sensors_motion_and_filter_are_those_of_the_default_sweep(name):
    configs = Path(ROOT / "configs")
    study, default = (load_study(configs / f"{one}.toml") for one in (name, "reset_sweep"))
    swept = {*study.axis_keys, *default.axis_keys}
    assert study.earth == default.earth and study.motion == default.motion
    for section in ("sensors", "alignment", "filter"):
        mine, other = (getattr(one, section).model_dump() for one in (study, default))
        assert {k: v for k, v in mine.items() if k not in swept} == {
            k: v for k, v in other.items() if k not in swept
        }
