"""Numbers of the page on tuned reset schedules and gains."""

from collections.abc import Mapping
from typing import Any

from sinsjax.report import tuned_figures, tuned_results
from sinsjax.report.base import Picture, Table, value_text
from sinsjax.report.folder import Page, Sources
from sinsjax.report.output import counted
from sinsjax.report.tuned_results import Tuning
from sinsjax.report.words import seconds
from sinsjax.tuning.carry_out import GRADIENT

STUDIES = {"small": "tune_condition5", "large": "tune_large", "compass": "tune_compass"}
QUESTIONS = {
    "small": "paper 1's condition 5",
    "large": "eight large misalignments",
    "compass": "compass gains",
}
EQUAL, BASELINE = "equal cost", "baseline"


def page(sources: Sources) -> Page:
    """What each tuning found, judged on draws that tuned nothing."""
    tunings = {name: tuned_results.Tuning.of(sources[study]) for name, study in STUDIES.items()}
    figures: dict[str, Picture] = {}
    for name, tuning in tunings.items():
        told = counted(sources[STUDIES[name]])
        (seen,) = tuned_figures.landscape(tuning)
        course = tuned_figures.course(tuning)
        figures[f"{name}_seen"] = seen._replace(name=f"{name}_seen", rests_on=told)
        figures[f"{name}_course"] = course._replace(name=f"{name}_course", rests_on=told)
    values: dict[str, Any] = {name: _told(tuning) for name, tuning in tunings.items()}
    return Page(values, {"expected": _expected(tunings)}, figures, _claims(tunings))


def _told(tuning: Tuning) -> dict[str, str]:
    gradient, rival = tuning.found[GRADIENT], tuning.found[tuning.rival]
    return {
        "best": seconds(tuning.score(tuning.best)),
        "baseline": seconds(tuning.score(BASELINE)),
        "gradient": seconds(tuning.difference(GRADIENT), 1),
        "equal": seconds(tuning.difference(EQUAL), 1),
        "cost": f"{100 * gradient.cost / rival.cost:.0f} %",
        "tuned_on": str(tuning.tune.tune_draws),
        "judged_on": str(tuning.runs.shape[2]),
    }


def _claims(tunings: Mapping[str, Tuning]) -> dict[str, bool]:
    apart = {name: one.difference(GRADIENT) for name, one in tunings.items()}
    return {
        "every tuning beats its baseline": all(
            one.score(one.best).high < one.score(BASELINE).low for one in tunings.values()
        ),
        "the gradient is better than the grid with two reset times": apart["small"].high < 0,
        "with more variables the gradient falls behind": (
            apart["large"].low > 0 and apart["compass"].low > 0
        ),
        "the gradient costs a fifth": all(
            one.found[GRADIENT].cost < 0.21 * one.found[one.rival].cost for one in tunings.values()
        ),
        "a search of the same cost does as well where the gradient falls behind": all(
            tunings[name].difference(EQUAL).value < apart[name].value
            for name in ("large", "compass")
        ),
    }


def _expected(tunings: Mapping[str, Tuning]) -> Table:
    """The best of each tuning beside its baseline."""
    rows = []
    for name, tuning in tunings.items():
        for label, candidate in (("before", BASELINE), ("tuned", tuning.best)):
            case = tuning.judged.cases[tuning.places[candidate]]
            settings = "; ".join(
                f"`{key} = {_shown(value)}`" for key, value in case.items() if key != "case"
            )
            rows.append([QUESTIONS[name], label, settings, seconds(tuning.score(candidate))])
    note = (
        "First two: mean time until the heading stays within 10 arcmin of its limit; compass: the"
        " time by which 90 % are within 3 arcmin. [95 % interval over draws that tuned nothing.]"
    )
    return Table("What to set, and what to expect", ["", "", "settings", "time"], rows, note)


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(_shown(one) for one in value)}]"
    return f"{value:.3g}" if isinstance(value, float) else value_text(value)
