"""Searches: points of designs, the studies of points, objectives, histories and results."""

from itertools import product

import numpy as np
import pyarrow as pa
import pytest
from support.studies import small_study

import sinsjax
from sinsjax.methods import reset_law
from sinsjax.study.load import with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.tuning import history, objective, search
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.search import reset_law_schedule_in_unit_box
from sinsjax.units import ARCMIN, DEG

pytestmark = pytest.mark.optimised(False)

TIMES = [{"low": 1.0, "high": 3.0}, {"low": 1.0, "high": 3.0}]
YAW = {"low": 10.0, "high": 90.0}


def tuned(variables, *, changes=None, **tune):
    tune = {"searches": ["sobol"], "variables": variables, "tune_draws": 2} | tune
    return small_study(tune=tune, **(changes or {}))


COUNTED = tuned({"reset_times_s": TIMES, "reset_count": {"candidates": [0, 1, 2]}})


def positions(study, name):
    """Return the points of a design by candidate and positions, 0 to 1; the law's come first."""
    space, points = SearchSpace.from_study(study), search.grid_or_sobol_points(study, name)
    laws = [search.points_at(space, n, [reset_law_schedule_in_unit_box(study, n)]) for n in (1, 2)]
    np.testing.assert_array_equal([p.values for p in points[:2]], [p.values for (p,) in laws])
    return np.array([[p.candidate, *space.to_box(p.values)] for p in points[2:]])


def test_grid_has_every_point_of_every_combination():
    found, places = positions(COUNTED.replace({"tune.grid_points": 3}), "grid"), [0.0, 0.5, 1.0]
    ones = [[1.0, place, np.nan] for place in places]
    twos = [[2.0, *both] for both in product(places, places)]
    np.testing.assert_array_equal(found, [[0.0, np.nan, np.nan], *ones, *twos])


def test_sobol_points_are_determined_by_seed_and_search():
    few, more = (
        positions(COUNTED.replace({"tune.sobol_points": count}), "sobol") for count in (4, 9)
    )
    assert few[:, 0].tolist() == [0, *[1] * 4, *[2] * 4]
    inside = few[5:, 1:]
    assert (inside >= 0).all() and (inside <= 1).all()
    np.testing.assert_array_equal(few[5:], more[10:14])
    assert not np.isclose(search.sobol_box_points(COUNTED, "gradient", 2, 4), inside).any()


def test_derived_study_runs_all_variants_per_search_point():
    cases = [{"case": "near", "phi_u0_deg": 5.0}, {"case": "far", "phi_u0_deg": 50.0}]
    changes = {"cases": cases, "axes": {"p0_yaw_deg": [40.0, 80.0]}, "study": {"seed": 2**63 - 1}}
    study = tuned({"reset_times_s": TIMES}, changes=changes, evaluation_draws=5)
    points = {"grid 0": {"reset_times_s": (1.0,)}, "grid 4": {"reset_times_s": (1.0, 2.0)}}
    derived = search.derive_study(study, points, name="derived")
    assert (derived.tune, derived.n_draws, derived.study.seed) == (None, 2, study.seed)
    assert derived.values("case") == ["grid 0"] * 4 + ["grid 4"] * 4
    assert derived.reset_times() == [(1.0,)] * 4 + [(1.0, 2.0)] * 4
    assert derived.values("phi_u0_deg") == 2 * study.values("phi_u0_deg")
    evaluated = search.derive_study(study, points, name="derived", evaluation=True)
    assert (evaluated.n_draws, evaluated.study.seed) == (5, 0)  # the next, after the largest


TEN, SIXTY = [6.0, None, 4.0, 3.0, None, 1.0], [None, 5.0, 4.0, 3.0, 2.0, 1.0]
ROWS = pa.table(
    {"run_id": [5, 4, 3, 2, 1, 0], "phi_u_arcmin": [6.0, 5.0, None, 3.0, 2.0, 1.0]}
    | {"floor_arcmin": [2.0] * 6, "settle_10_s": TEN, "settle_60_s": SIXTY}
)


@pytest.mark.parametrize(
    ("tune", "values", "score"),
    [
        ({}, [[1, 3, 6], [6, 4, 6]], (10 / 3 + 16 / 3) / 2),
        ({"objective_across": "worst"}, [[1, 3, 6], [6, 4, 6]], 16 / 3),
        ({"objective": "settle_quantile", "objective_quantile": 0.6}, None, (3 + 6) / 2),
        ({"objective_band_arcmin": 60.0}, [[1, 3, 5], [2, 4, 6]], 3.5),
        ({"objective": "failure_rate"}, [[0, 0, 1], [1, 0, 0]], 1 / 3),
        ({"objective": "final_error"}, [[1, 1, 3], [0, np.inf, 4]], np.inf),
    ],
)
def test_objective_is_computed_from_summary_rows(tune, values, score):
    """Two variants and three draws of a study of 6 s; rows in no order."""
    changes = {"axes": {"phi_u0_deg": [0.0, 5.0]}, "study": {"judged_from": "floor"}}
    study = tuned({"p0_yaw_deg": YAW}, changes=changes, **tune)
    table = ROWS.select(objective.summary_columns(study.tune, study))
    found = objective.run_values(study.tune, study, table)
    assert values is None or found.tolist() == values
    assert objective.score(study.tune, found) == pytest.approx(score)


def test_history_round_trips_through_parquet(tmp_path):
    space = SearchSpace.from_study(COUNTED)
    none, best = Evaluation(0, 0, [np.nan] * 2, 3.0, 7), Evaluation(1, 2, [1.5, 2.5], np.inf, 14)
    relaxed = Evaluation(0, 2, [2.5, 1.5], 1.0, 20, 0, 20.0, 2.0)
    hard = Evaluation(1, 2, [2.5, 1.0], 3.5, 30, 1)
    searched = [SearchResult("grid", [none, best]), SearchResult("gradient", [relaxed, hard])]
    history.write_history(tmp_path, COUNTED, searched)
    again = history.read_searches(tmp_path, space)
    for written, read in zip(searched, again, strict=True):
        assert written.search == read.search
        for a, b in zip(written.evaluations, read.evaluations, strict=True):
            np.testing.assert_array_equal(a.values, b.values)
            assert a._replace(values=[]) == b._replace(values=[])
    grid, gradient = again
    assert (grid.best.step, grid.cost, grid.point(space)) == (0, 14, {"reset_times_s": ()})
    assert (gradient.best.start, gradient.cost) == (1, 30)  # the best that is not relaxed
    assert gradient.point(space) == {"reset_times_s": (1.0, 2.5)}
    table = sinsjax.read_history(tmp_path)
    assert table["reset_times_s[0]"].to_pylist() == [None, 1.5, 2.5, 2.5]
    assert table.schema.field("reset_times_s[0]").metadata[b"unit"] == b"s"


def test_points_with_equal_keys_are_one_case_and_cost_nothing():
    """Reset times are sorted, so mirrored points are equal."""
    study = tuned({"reset_times_s": TIMES}, objective="final_error")
    points = search.points_at(SearchSpace.from_study(study), 0, [[0, 1], [0, 0], [1, 0], [1, 1]])

    def run_cases(derived):
        assert [case["case"] for case in derived.cases] == ["grid 0", "grid 1", "grid 3"]
        runs = 3 * derived.n_draws
        return pa.table({"run_id": range(runs), "phi_u_arcmin": [1.0, 2.0, 3.0] * derived.n_draws})

    scored = search.score_points(study, "grid", points, run_cases)
    assert scored.scores == [1.0, 2.0, 1.0, 3.0]
    assert scored.costs == [2 * 600 * count for count in (1, 2, 2, 3)]


LONG_TIMES = [{"low": 1.0, "high": 100.0}, {"low": 1.0, "high": 200.0}]


def long(variables, tune=None, **changes):
    length = {"study": {"duration_s": 300.0, "window_s": [200, 300]}}
    return tuned(variables, changes=length | changes, **(tune or {}))


def value_at(study, number=0):
    """Return the keys of the law's point, or None."""
    space, box = SearchSpace.from_study(study), reset_law_schedule_in_unit_box(study, number)
    return None if box is None else search.points_at(space, number, [box])[0].keys(space)


def law_times(study, heading_deg, resets):
    problem = sinsjax.reset_schedule(study, heading_bound_deg=heading_deg).problem
    return reset_law.schedule_with(problem, heading_deg * DEG, 10 * ARCMIN, resets).times_s


def test_law_point_has_as_many_resets_as_the_candidates_count():
    study = long({"reset_times_s": LONG_TIMES, "reset_count": {"candidates": [0, 1, 2]}})
    times = law_times(with_point(study, {"reset_times_s": ()}), 30.0, 2)
    rounded = pytest.approx(np.maximum(times, 1.0), abs=0.005)  # to samples
    assert value_at(study, 0) is None and value_at(study, 2) == {"reset_times_s": rounded}


def test_law_point_of_counted_resets_is_at_their_first_time_and_cycle():
    large = {"alignment": {"phi_u0_deg": 150.0}}
    first, _, last = law_times(long({"p0_yaw_deg": YAW}, **large), 150.0, 3)
    given = {"reset_count": 3, "reset_cycle_s": 5.0}
    cycle = {"reset_cycle_s": {"low": 1.0, "high": 90.0}}
    both = cycle | {"reset_first_s": {"low": 0.01, "high": 10.0}}
    found = value_at(long(both, resets=given | {"reset_first_s": 2.0}, **large))
    assert found == pytest.approx({"reset_first_s": first, "reset_cycle_s": (last - first) / 2})
    found = value_at(long(cycle, resets=given, **large))
    assert found == pytest.approx({"reset_cycle_s": last / 3})


def test_law_point_is_that_of_the_slowest_filter_and_of_the_baseline():
    variables = {"reset_times_s": LONG_TIMES, "q_scale": {"low": 0.1, "high": 0.5}}
    tune = {"tune": {"baseline": {"q_scale": 0.3, "reset_times_s": [5.0]}}}
    found = value_at(long(variables, axes={"latitude_deg": [60.0, 0.0]}, **tune))
    slow = long(variables, earth={"latitude_deg": 60.0}, **tune)
    assert found == value_at(slow) and found is not None and found["q_scale"] == 0.3
