"""The reset schedule by the law: a point of every search, and what tuning gains over it."""

from pathlib import Path
from typing import Any

import numpy as np
import optax
import pytest
from numpy.typing import NDArray
from support.stored_results import report_text
from support.studies import STILL, small_study

import sinsjax
from sinsjax.methods import reset_law
from sinsjax.study.load import load_study, with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import gradient, search
from sinsjax.tuning.law_point import law_point
from sinsjax.units import ARCMIN, DEG

pytestmark = pytest.mark.optimised(False)

TIMES = [{"low": 1.0, "high": 100.0}, {"low": 1.0, "high": 200.0}]
CYCLE = {"low": 1.0, "high": 100.0}
COUNTED = {"reset_count": 3, "reset_cycle_s": 5.0}


def tuned(variables: dict[str, Any], **changes: Any) -> Study:
    tune = {"searches": ["sobol"], "variables": variables} | changes.pop("tune", {})
    length = {"study": {"duration_s": 300.0, "window_s": [200, 300]}}
    return small_study(tune=tune, **(length | changes))


def value_at(study: Study, number: int = 0) -> dict[str, Any] | None:
    """Return the keys of the law's point, or None."""
    space, box = SearchSpace.from_study(study), law_point(study, number)
    if box is None:
        return None
    assert (box >= 0).all() and (box <= 1).all()
    (point,) = search.points_at(space, number, [box])
    return point.keys(space)


def law_times(study: Study, heading_deg: float, resets: int) -> tuple[float, ...]:
    problem = sinsjax.reset_schedule(study, heading_bound_deg=heading_deg).problem
    found = reset_law.schedule_with(problem, heading_deg * DEG, 10 * ARCMIN, resets)
    return found.times_s


def test_shipped_tuning_has_the_law_within_its_ranges() -> None:
    study = load_study("tune_large")
    assert study.tune is not None
    found, ranges = value_at(study), study.tune.variables["reset_times_s"]
    assert found is not None and isinstance(ranges, tuple)
    filters, heading_deg = with_point(study, study.tune.baseline), max(study.values("phi_u0_deg"))
    times = law_times(filters, heading_deg, len(found["reset_times_s"]))
    clipped = [np.clip(t, r.low, r.high) for t, r in zip(times, ranges, strict=True)]
    assert found["reset_times_s"] == pytest.approx(clipped)


def test_law_point_has_as_many_resets_as_the_candidates_count() -> None:
    study = tuned({"reset_times_s": TIMES, "reset_count": {"candidates": [0, 1, 2]}})
    assert value_at(study, 0) is None
    for number in (1, 2):
        times = law_times(with_point(study, {"reset_times_s": ()}), 30.0, number)
        rounded = pytest.approx(np.maximum(times, 1.0), abs=0.005)  # to samples
        assert value_at(study, number) == {"reset_times_s": rounded}


def test_law_point_of_counted_resets_is_at_their_first_time_and_cycle() -> None:
    large = {"alignment": {"phi_u0_deg": 150.0}}
    first, _, last = law_times(tuned({"p0_yaw_deg": CYCLE}, **large), 150.0, 3)
    first_key = {"reset_first_s": {"low": 0.01, "high": 10.0}}
    cycle = {"reset_cycle_s": {"low": 1.0, "high": 90.0}}
    given = COUNTED | {"reset_first_s": 2.0}
    both = value_at(tuned(cycle | first_key, resets=given, **large))
    assert both == pytest.approx({"reset_first_s": first, "reset_cycle_s": (last - first) / 2})
    assert value_at(tuned(cycle, resets=given, **large)) == pytest.approx(
        {"reset_cycle_s": (last - first) / 2}
    )
    without_first = value_at(tuned(cycle, resets=COUNTED, **large))
    assert without_first == pytest.approx({"reset_cycle_s": last / 3})


def test_law_point_is_that_of_the_slowest_filter_and_of_the_baseline() -> None:
    q_scale = {"q_scale": {"low": 0.1, "high": 0.5}}
    variables = {"reset_times_s": TIMES} | q_scale
    tune = {"tune": {"baseline": {"q_scale": 0.3, "reset_times_s": [5.0]}}}
    found = value_at(tuned(variables, axes={"latitude_deg": [60.0, 0.0]}, **tune))
    slow = tuned(variables, earth={"latitude_deg": 60.0}, **tune)
    assert found == value_at(slow) and found is not None and found["q_scale"] == 0.3
    # With the study's own Q, which lies above the range, it is at the bound.
    again = value_at(tuned(variables))
    assert again is not None and again["q_scale"] == 0.5


@pytest.mark.parametrize(
    ("variables", "changes"),
    [
        ({"p0_yaw_deg": CYCLE}, {}),
        ({"reset_times_s": TIMES}, {"sensors": {"gyro_noise_deg_per_h": 1e5}}),
    ],
)
def test_no_law_point_without_a_schedule(variables: Any, changes: dict[str, Any]) -> None:
    study = tuned(variables, **changes)
    assert law_point(study) is None
    assert study.tune is not None
    assert len(search.design_points(study, "sobol")) == study.tune.sobol_points


SHORT: dict[str, Any] = {
    "study": {
        **{"duration_s": 20.0, "rate_hz": 20.0, "window_s": [10, 20]},
        "settle_bands_arcmin": [600.0],
    },
    "motion": STILL,
    "alignment": {"phi_u0_deg": 30.0},
    "tune": {
        **{"objective_band_arcmin": 600.0, "tune_draws": 2, "evaluation_draws": 4},
        **{"grid_points": 2, "descent_screen": 4, "descent_starts": 2, "descent_steps": 1},
        "objective": "final_error",
    },
}
"""A study whose searches are quick."""

RANGES = {"reset_times_s": [{"low": 0.3, "high": 5.0}, {"low": 2.0, "high": 19.0}]}


@pytest.fixture(scope="module")
def law_values() -> list[float]:
    study = tuned(RANGES, **SHORT)
    box = law_point(study)
    assert box is not None
    return SearchSpace.from_study(study).to_values(box)


def test_descents_screen_the_law_and_evaluate_it(
    monkeypatch: pytest.MonkeyPatch, law_values: list[float]
) -> None:
    """If it is the best of the screen a descent starts there; it is scored on all draws anyway."""

    def slope(self: Any, box: NDArray, draws: Any, softness: Any) -> tuple[NDArray, NDArray]:
        return np.zeros(len(box)), np.ones(box.shape)

    def score(_: Study, __: Any, points: Any, draws: int | None = None) -> search.PointScores:
        scores = [abs(np.subtract(point.values, law_values)).sum() for point in points]
        return search.PointScores(scores, [0])

    monkeypatch.setattr(optax, "adam", lambda rate: optax.scale(0.1))
    monkeypatch.setattr(gradient.Slope, "__call__", slope)
    monkeypatch.setattr(gradient, "score_hard", score)
    found = gradient.descend(tuned(RANGES, **SHORT))
    starts = [e for e in found.evaluations if e.step == 0]
    assert starts[0].values == pytest.approx(law_values) and len(starts) == 2
    ends = [e for e in found.evaluations if e.sharpness is None]
    assert [e.start for e in ends] == [0, 1, None]
    assert ends[-1].values == pytest.approx(law_values) and found.best == ends[-1]


@pytest.mark.parametrize("name", ["grid", "sobol"])
def test_searches_by_points_evaluate_the_law_first(name: str, law_values: list[float]) -> None:
    study = tuned(RANGES, **SHORT)
    law, *others = search.design_points(study, name)
    assert study.tune is not None and law.values == pytest.approx(law_values)
    assert len(others) == (4 if name == "grid" else study.tune.sobol_points)


@pytest.mark.nightly
def test_report_states_gain_over_the_law(tmp_path: Path) -> None:
    """The difference of both on the unused draws, with its interval."""
    tune = SHORT["tune"] | {"searches": ["grid"], "baseline": {"reset_times_s": [1.0, 15.0]}}
    sinsjax.tune(tuned(RANGES, **SHORT | {"tune": tune}), tmp_path / "out")
    made = sinsjax.TuningResults(tmp_path / "out")
    gain = made.difference(made.best_search, "law")
    assert made.law is not None and gain.value == pytest.approx(made.score.value - made.law.value)
    assert ("Law" in report_text(tmp_path / "out")) and gain.low <= gain.value <= gain.high
