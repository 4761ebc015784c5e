"""Numbers of the page on which alignment to use."""

from collections.abc import Mapping
from typing import Any

from sinsjax.analysis import Estimate
from sinsjax.report.base import Picture
from sinsjax.report.folder import Page, Sources

from . import better, evidence, why
from .field import TIMES_S, Cell, Field, Start, angle, reach
from .figure import reached

GRADE = 0.01
"""Gyro bias (deg/h) of the grade that the answer is told for."""

STUDIES = ("which_alignment", "which_alignment_tuned", "which_alignment_surge")
"""Published settings, tuned ones, and what came of the search for something better."""

FIGURE = (
    "kalman_sincos, Q of a sample",
    "kalman_surge",
    "inertial",
    "optimisation",
    "kalman_sincos",
    "kalman10",
    "kalman5, gravity",
    "kalman5, two resets",
    "kalman5, three resets",
    "kalman5",
)


def known(field: Field) -> Mapping[str, tuple[Start, ...]]:
    """Initial misalignments by what is known of the attitude."""
    fair = tuple(one for one in field.starts if max(one) <= 30)
    return {"heading to 30 deg, level to 5 deg": fair, "nothing": field.starts}


INERTIAL, OPTIMISATION, SINCOS, SAMPLE = "inertial", "optimisation", "kalman_sincos", "kalman_sincos, Q of a sample"
RESETS = ("kalman5, one reset", "kalman5, two resets", "kalman5, three resets")


def page(sources: Sources) -> Page:
    """What to use, by what is known, what moves and the time there is; and why."""
    studies = [sources[name] for name in STUDIES]
    field = Field(*studies)
    classes = known(field)
    tables = {
        "decision": evidence.decisions(field, classes, GRADE, folded=False),
        "bases": evidence.by_base(field, field.starts, GRADE, 300),
        "starts": evidence.by_start(field, "sway", GRADE, 300),
        "settled": evidence.settled(field, field.starts, "sway", GRADE),
        "latitudes": evidence.by_latitude(sources["which_alignment_latitude"]),
        "settings": evidence.settings(studies),
    }
    for grade in field.grades:
        if grade != GRADE:
            name = f"grade_{grade:g}".replace(".", "_")
            tables[name] = evidence.decisions(field, classes, grade, folded=True)
    picture = Picture(
        "reached",
        f"What 95 % of the runs stay below, from eight misalignments up to (20, 20, 120) and"
        f" (0, 0, 170) deg, all headings, gyro bias {GRADE:g} deg/h; shading: 95 % interval,"
        f" {field.draws} draws.",
        reached(
            field,
            [arm for arm in FIGURE if arm in field.arms],
            field.starts,
            GRADE,
            "Heading error from true north, nothing known of the attitude",
        ),
    )
    values: dict[str, Any] = {
        "runs": f"{sum(one.runs for one in studies):,}",
        "arms": len(field.arms),
        "draws": field.draws,
        **_told(field),
    }
    return Page.joined(
        Page(values, tables, {"reached": picture}, _claims(field)),
        _experiments(sources),
    )


def _told(field: Field) -> dict[str, Any]:
    """Numbers of the first sentences, and of those on resets."""

    def error(arm: str, base: str, time_s: int, starts: tuple[Start, ...] = field.starts) -> str:
        return angle(reach(field.errors(arm, Cell(starts, field.bases[base], GRADE, time_s))))

    told = {
        "inertial": (INERTIAL, ("sway", "surge")),
        "optimisation": (OPTIMISATION, ("sway", "surge")),
        "sincos": (SINCOS, ("surge",)),
        "sample": (SAMPLE, ("sway", "surge", "all")),
        "three": (RESETS[-1], ("sway", "surge")),
        "two": (RESETS[1], ("sway",)),
        "plain": ("kalman5", ("sway",)),
    }
    bases = {"sway": "sway", "surge": "sway and surge", "all": "all of these"}
    return {
        name: {base: error(arm, bases[base], 300) for base in on}
        for name, (arm, on) in told.items()
    }


def _experiments(sources: Sources) -> Page:
    """What was run to answer one question each."""
    resets = why.resets(sources["which_alignment_why"])
    return Page.joined(
        resets,
        why.passes(sources["which_alignment_stored"]),
        why.turning(sources["which_alignment_turning"]),
        why.car(sources["which_alignment_car"]),
        why.psins(sources["which_alignment_psins"]),
        better.bounded(sources["which_surge"]),
    )


def _claims(field: Field) -> dict[str, bool]:
    """What the first sentences say."""

    def most(arm: str, base: str) -> Estimate:
        return reach(field.errors(arm, Cell(field.starts, field.bases[base], GRADE, 300)))

    sway = {arm: most(arm, "sway") for arm in field.at(GRADE)}
    surge = {arm: most(arm, "sway and surge") for arm in field.at(GRADE)}
    published = [arm for arm in surge if not arm.endswith("tuned")]
    choices = [
        field.best(Cell(starts, base, grade, t)).arms[0]
        for starts in known(field).values()
        for base in field.bases.values()
        for grade in field.grades
        for t in TIMES_S
    ]
    return {
        "on a swaying base the methods without a start are as good as any": all(
            sway[arm].low <= min(one.high for one in sway.values())
            for arm in (INERTIAL, OPTIMISATION)
        ),
        "under surge inertial is the best of those with published settings": (
            min(published, key=lambda arm: surge[arm].value) == INERTIAL
        ),
        "resets repair the plain filter on a swaying base": all(
            10 * sway[arm].high < sway["kalman5"].low for arm in RESETS[1:]
        ),
        "under surge resets fail": surge[RESETS[-1]].low > 60 * 5,
        "no choice is a filter with resets": not any("reset" in arm for arm in choices),
    }
