"""What the pages on resets compute, against plain definitions."""

from pathlib import Path

import numpy as np
import pytest
from studies.test_pages import ROOT, made_up

from docs.studies.adaptive import scores as adaptive
from sinsjax import analysis
from sinsjax.study.load import load_study


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    return adaptive.Scores(made_up(tmp_path_factory.mktemp("r"), "adaptive_resets"))


def test_alarm_share_matches_plain_definition(scores):
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
    assert scores.alarms(policy) == analysis.share(false, draws)


def test_cells_within_ratio_are_counted_with_interval(scores):
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


@pytest.mark.parametrize("name", ["reset_cycle_study", "reset_phase", "adaptive_resets"])
def test_reset_study_settings_match_default_sweep(name):
    configs = Path(ROOT / "configs")
    study, default = (load_study(configs / f"{one}.toml") for one in (name, "reset_sweep"))
    swept = {*study.axis_keys, *default.axis_keys}
    assert study.earth == default.earth and study.motion == default.motion
    for section in ("sensors", "alignment", "filter"):
        mine, other = (getattr(one, section).model_dump() for one in (study, default))
        assert {k: v for k, v in mine.items() if k not in swept} == {
            k: v for k, v in other.items() if k not in swept
        }
