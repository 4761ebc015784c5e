import math
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats
from support.stored import store

from docs.studies.compass_map import scores as schedule_scores
from docs.studies.compass_map.scores import Scored
from docs.studies.loops.runs import bound_arcmin
from sinsjax import analysis
from sinsjax.report.base import Source
from sinsjax.study.load import load_study, study_from_dict

CONFIGS = Path(__file__).parents[2] / "configs"
DRAWS = 40
NEVER = math.inf


@pytest.fixture(autouse=True)
def _not_drawn(monkeypatch):
    monkeypatch.setattr("sinsjax.plots.png", lambda *_: b"not drawn")


def study_of(name, **changes):
    data = tomllib.loads((CONFIGS / f"compass_80s_{name}.toml").read_text())
    data["study"] |= {"draws": DRAWS} | changes.pop("study", {})
    return study_from_dict(data | changes)


def search_study(**changes):
    axes = {"azimuth_sigma_per_s": [0.02, 0.03], "turn_smoothing_s": [10.0, 20.0, 30.0]}
    cases = [{"case": "constant", "sigma_factors": [1.0], "sigma_times_s": []}]
    return study_of("search", axes=axes, cases=cases, **changes)


def source_of(study, wide, narrow, errors=0.5):
    """Results that no engine made: settling times to 6' and 1.2' that broadcast to runs."""
    shape = (study.n_draws, study.n_variants)
    run = np.arange(shape[0] * shape[1])
    swept = study.variant_values()
    shown = {"case": swept["case"]} | {key: swept[key] for key in study.axes}
    summary = {
        "run_id": run,
        "draw_id": run // shape[1],
        "variant_id": run % shape[1],
        **{key: values * shape[0] for key, values in shown.items()},
        "phi_u_arcmin": np.broadcast_to(errors, shape).ravel() - 5.0,
        "floor_arcmin": np.full(run.size, -5.0),
    }
    for band, times in (("6", wide), ("1.2", narrow)):
        flat = np.broadcast_to(times, shape).astype(float).ravel()
        summary[f"settle_{band}_s"] = pa.array(flat, mask=np.isinf(flat))
    return Source(Path("results"), study, "search.toml", pa.table(summary))


def write(directory, source):
    return store(directory, source.study, source.summary)


def blocks(made, kind):
    return [b for section in made.sections for b in section.blocks if isinstance(b, kind)]


def scored(label, wide, narrow, **changes):
    times = (np.broadcast_to(np.asarray(t, float), DRAWS) for t in (wide, narrow))
    plain = Scored({"case": label}, 0, 80.0, *times, np.zeros(DRAWS), 600.0, 0.2)
    return plain._replace(**changes)


def ordered(*schedules):
    found = schedule_scores.rank(schedules)
    return [s.key["case"] for s in found.ordered], found.tied


# --- the rule -----------------------------------------------------------------------------------


def test_the_fastest_to_the_narrow_band_wins():
    names = ordered(scored("a", 90, 300), scored("b", 200, 250), scored("c", 50, 400))
    assert names == (["b", "a", "c"], 1)


def test_ties_go_to_the_fastest_to_the_wide_band():
    spread = np.linspace(200, 400, DRAWS)  # medians 298 and 308, and wide intervals
    first, second = scored("a", 90, spread), scored("b", 80, spread + 10)
    third = scored("c", 10, spread + 500)
    assert first.narrow.high > second.narrow.low
    assert ordered(first, second, third) == (["b", "a", "c"], 2)


def test_then_to_the_narrow_band_again_and_then_to_the_order():
    spread = np.linspace(200, 400, DRAWS)
    a, b, c = (scored(n, 90, spread + more) for n, more in (("a", 10), ("b", 0), ("c", 0)))
    assert ordered(a, b, c)[0] == ["b", "c", "a"]


def test_never_counts_as_infinite():
    most_never = np.where(np.arange(DRAWS) < DRAWS * 0.8, NEVER, 10.0)
    assert scored("a", 90, most_never).narrow.value == NEVER
    assert ordered(scored("a", 90, most_never), scored("b", 90, 590.0)) == (["b", "a"], 1)
    assert ordered(scored("a", 9, NEVER), scored("b", 8, NEVER)) == (["b", "a"], 2)


def test_an_unknown_end_of_an_interval_is_no_bound():
    few = [
        scored(n, w, w, narrow_s=np.array([t])) for n, w, t in (("a", 90, 100.0), ("b", 80, 900.0))
    ]
    assert math.isnan(few[0].narrow.low)
    assert [s.key["case"] for s in schedule_scores.rank(few).ordered] == ["b", "a"]


def test_the_last_cycle_is_the_last_two_passes():
    times = np.array([100.0, 440.0, 441.0, NEVER])
    assert scored("a", 0, 0, narrow_s=times).last_cycle == analysis.proportion(2, 4)
    assert scored("a", 0, 0, narrow_s=times, tape_s=600.0).last_cycle is None


def test_scores_hold_the_runs_of_their_variant():
    study = search_study()
    wide = 100.0 + np.arange(6)
    found = schedule_scores.scored_of(source_of(study, wide, NEVER, errors=np.arange(6.0)))
    assert [s.variant for s in found] == list(range(6))
    assert [s.wide.value for s in found] == list(wide)
    assert (
        found[4].name
        == "constant, sigma of the azimuth loop 0.03 1/s, smoothing of the force at a turn 20 s"
    )
    np.testing.assert_allclose(found[4].errors, 4.0)
    assert (found[4].tape_s, found[4].end_s) == (80.0, 600.0)
    sigma = float(bound_arcmin(study, 80.0))
    assert found[4].outside == pytest.approx(2 * stats.norm.sf(1.2 / sigma))
    assert found[4].outside == pytest.approx(0.208, abs=1e-3)


# --- a search -----------------------------------------------------------------------------------


# --- a comparison -------------------------------------------------------------------------------


# --- the studies --------------------------------------------------------------------------------


def test_the_best_schedule_is_a_point_of_the_search():
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
    tapes, turns = best.values("tape_s"), best.values("turn")
    assert tapes == [600.0, 80.0, 600.0, 80.0] and turns[1] == "velocity"
    scheme_1 = {key: best.values(key)[0] for key in ("level_sigma_per_s", "level_time_s")}
    assert scheme_1 == {"level_sigma_per_s": 0.02, "level_time_s": 150.0}
    assert best.values("azimuth_sigma_per_s")[:2] == [0.01, 0.01]
