import math
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa

from docs.studies.compass_map.static import rank, settling
from sinsjax import analysis
from sinsjax.execution.source import Source
from sinsjax.study.load import load_study, study_from_dict

CONFIGS = Path(__file__).parents[2] / "configs"
DRAWS = 40
NEVER = math.inf


def ordered(*schedules):
    """The rule over schedules (name, to the wide band, to the narrow one, s)."""
    names, wide, narrow = zip(*schedules, strict=True)
    order, tied = rank(*(np.array([np.full(DRAWS, t) for t in times]) for times in (wide, narrow)))
    return [names[i] for i in order], tied


def test_rank_prefers_fastest_settling_to_narrow_band():
    names = ordered(("a", 90.0, 300.0), ("b", 200.0, 250.0), ("c", 50.0, 400.0))
    assert names == (["b", "a", "c"], 1)


def test_rank_breaks_ties_by_settling_to_wide_band():
    spread = np.linspace(200, 400, DRAWS)  # medians 298 and 308, and wide intervals
    assert analysis.quantile(spread).high > analysis.quantile(spread + 10).low
    schedules = ("a", 90.0, spread), ("b", 80.0, spread + 10), ("c", 10.0, spread + 500)
    assert ordered(*schedules) == (["b", "a", "c"], 2)


def test_rank_breaks_remaining_ties_by_narrow_band_then_order():
    spread = np.linspace(200, 400, DRAWS)
    schedules = ((n, 90.0, spread + more) for n, more in (("a", 10), ("b", 0), ("c", 0)))
    assert ordered(*schedules)[0] == ["b", "c", "a"]


def test_rank_counts_unsettled_runs_as_infinite():
    most_never = np.where(np.arange(DRAWS) < DRAWS * 0.8, NEVER, 10.0)
    assert ordered(("a", 90.0, most_never), ("b", 90.0, 590.0)) == (["b", "a"], 1)
    assert ordered(("a", 9.0, NEVER), ("b", 8.0, NEVER)) == (["b", "a"], 2)


def test_rank_ties_schedules_with_unknown_interval_end():
    wide, narrow = np.array([[90.0], [80.0]]), np.array([[100.0], [900.0]])
    assert math.isnan(analysis.quantile(narrow[0]).low)
    assert rank(wide, narrow) == ([1, 0], 2)


def test_settling_times_are_grouped_by_variant():
    data = tomllib.loads((CONFIGS / "compass_80s_search.toml").read_text())
    data["study"]["draws"] = 3
    data["cases"] = data["cases"][:1]
    data["axes"] = {"azimuth_sigma_per_s": [0.02, 0.03], "turn_smoothing_s": [10.0, 20.0, 30.0]}
    study = study_from_dict(data)
    wide = 100.0 + np.arange(18).reshape(3, 6)
    summary = {
        "draw_id": np.repeat(np.arange(3), 6),
        "settle_6_s": wide.ravel(),
        "settle_1.2_s": pa.nulls(18, pa.float64()),
    }
    found = settling(Source(Path("results"), study, "search.toml", pa.table(summary)))
    np.testing.assert_array_equal(found[0], wide.T)
    np.testing.assert_array_equal(found[1], np.full((6, 3), NEVER))


def test_best_schedule_study_uses_point_of_search():
    search, best = (load_study(CONFIGS / f"compass_80s_{name}.toml") for name in ("search", "best"))
    keys = [*search.axes, "sigma_factors", "sigma_times_s"]
    points = set(zip(*map(search.values, keys), strict=True))
    own = dict(zip(best.values("case"), zip(*map(best.values, keys), strict=True), strict=True))
    assert own["80 s tape, best schedule"] in points
    assert own["80 s tape, best schedule"] == own["600 s, best schedule"]
    alike = {"study": {"name", "draws", "seed"}, "passes": True, "compass": True, "cases": True}
    alike |= {"axes": True}
    assert search.model_dump(exclude=alike) == best.model_dump(exclude=alike)
    assert search.study.seed != best.study.seed  # scored on noise that the search has not seen
    records, turns = best.values("stored_s"), best.values("turn")
    assert records == [600.0, 80.0, 600.0, 80.0] and turns[1] == "velocity"
    scheme_1 = {key: best.values(key)[0] for key in ("level_sigma_per_s", "level_time_s")}
    assert scheme_1 == {"level_sigma_per_s": 0.02, "level_time_s": 150.0}
    assert best.values("azimuth_sigma_per_s")[:2] == [0.01, 0.01]
