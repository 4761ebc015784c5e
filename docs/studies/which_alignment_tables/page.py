"""Numbers of the tables behind the choice of a method, and of the recommended settings."""

from collections.abc import Mapping
from typing import Any

from sinsjax.analysis import Estimate
from sinsjax.report.base import Picture
from sinsjax.report.study_page import Page, Sources

from . import better, cost, evidence, fair, why
from .field import TIMES_S, Base, Cell, Field, Start, brief, reach
from .figure import reached
from .recommended import recommended

GRADE = 0.01
"""Gyro bias of the sensor grade of the answer, deg/h."""

STUDIES = ("which_alignment", "which_alignment_tuned", "which_alignment_surge")
"""Published settings, tuned ones, and what came of the search for something better."""

INERTIAL, OPTIMISATION = "inertial", "optimisation"
SINCOS, SAMPLE = "kalman_sincos", "kalman_sincos, Q of a sample"
WIDE, BOTH = "kalman5, wide prior", "kalman5, wide prior, two resets"
BASES = {
    "sway": "sway",
    "surge": "sway and surge",
    "all": "all of these",
}
"""Vehicle motions as the prose names them."""

RESETS = ("kalman5, one reset", "kalman5, two resets", "kalman5, three resets")

FIGURE = (
    INERTIAL,
    SAMPLE,
    "kalman_surge",
    OPTIMISATION,
    SINCOS,
    "kalman5, triggered resets, tuned",
    "kalman5, three resets",
    "kalman5",
)


def known(field: Field) -> Mapping[str, tuple[Start, ...]]:
    """Initial misalignments by prior knowledge of the attitude."""
    fair = tuple(one for one in field.starts if max(one) <= 30)
    return {"heading to 30 deg, level to 5 deg": fair, "none": field.starts}


def page(sources: Sources) -> Page:
    """What to use, by prior knowledge, vehicle motion and available time; and why."""
    studies = [sources[name] for name in STUDIES]
    field = Field(*studies)
    classes = known(field)
    tables = {
        "grades": evidence.decisions(field, classes),
        "bases": evidence.by_base(field, field.starts, GRADE, 300),
        "floors": evidence.from_floor(field, field.starts, GRADE, 300),
        "starts": evidence.by_start(field, "sway", GRADE, 300),
        "settled": evidence.settled(field, field.starts, "sway", GRADE),
        "latitudes": evidence.by_latitude(sources["which_alignment_latitude"]),
        "settings": evidence.settings(studies),
        "cost": cost.table(field, field.starts, "sway", GRADE),
    }
    runs = f"{sum(one.runs for one in studies):,}"
    picture = Picture(
        "reached",
        "Eight misalignments up to (20, 20, 120) and (0, 0, 170) deg, all headings, gyro bias"
        f" {GRADE:g} deg/h; shading: 95 % interval.",
        reached(
            field,
            [arm for arm in FIGURE if arm in field.arms],
            field.starts,
            GRADE,
            "Heading error from true north, nothing known of the attitude",
        ),
        f"{', '.join(STUDIES)}: {runs} runs",
    )
    values: dict[str, Any] = {
        "runs": runs,
        "arms": len(field.arms),
        "draws": field.draws,
        **_told(field),
    }
    return Page.merge(
        Page(values, tables, {"reached": picture}, _claims(field)),
        _experiments(sources, field),
    )


def _told(field: Field) -> dict[str, Any]:
    """Numbers of the first sentences, and of those on resets."""

    def error(arm: str, base: str, time_s: int, starts: tuple[Start, ...] = field.starts) -> str:
        return brief(reach(field.errors(arm, Cell(starts, field.bases[base], GRADE, time_s))))

    told = {
        "inertial": (INERTIAL, ("sway", "all")),
        "sample": (SAMPLE, ("sway", "all")),
        "three": (RESETS[-1], ("sway", "surge")),
        "two": (RESETS[1], ("sway",)),
        "plain": ("kalman5", ("sway",)),
        "wide": (WIDE, ("sway",)),
        "both": (BOTH, ("sway",)),
        "trigger": ("kalman5, triggered resets, tuned", ("sway", "surge")),
    }
    return {
        name: {base: error(arm, BASES[base], 300) for base in on}
        for name, (arm, on) in told.items()
    }


def _experiments(sources: Sources, field: Field) -> Page:
    """What was run to answer one question each."""
    resets = why.resets(sources["which_alignment_why"])
    return Page.merge(
        resets,
        why.passes(sources["which_alignment_stored"], field, GRADE),
        why.turning(sources["which_alignment_turning"]),
        why.car(sources["which_alignment_car"]),
        why.psins(sources["which_alignment_psins"]),
        better.bounded(sources["which_surge"]),
        fair.at_their_best(sources["which_alignment_fair"]),
        recommended(sources),
    )


def _claims(field: Field) -> dict[str, bool]:
    """What the first sentences say."""

    def most(arm: str, base: str) -> Estimate:
        return reach(field.errors(arm, Cell(field.starts, field.bases[base], GRADE, 300)))

    on = {base: {arm: most(arm, base) for arm in field.at(GRADE)} for base in field.bases}
    sway, surge = on["sway"], on["sway and surge"]

    def best(starts: tuple[Start, ...], base: Base, time_s: int) -> Estimate:
        return field.best(Cell(starts, base, GRADE, time_s)).errors[0]

    return {
        "from 120 s on prior knowledge gains nothing": all(
            max(one.low for one in pair) <= min(one.high for one in pair)
            for base in field.bases.values()
            for t in TIMES_S
            if t >= 120
            for pair in [[best(starts, base, t) for starts in known(field).values()]]
        ),
        "inertial is within two fifths of the best everywhere": all(
            arms[INERTIAL].value < 1.4 * min(one.value for one in arms.values())
            for arms in on.values()
        ),
        "so is the filter with Q of a sample": all(
            arms[SAMPLE].value < 1.4 * min(one.value for one in arms.values())
            for arms in on.values()
        ),
        "resets repair the plain filter on a swaying base": all(
            10 * sway[arm].high < sway["kalman5"].low for arm in RESETS[1:]
        ),
        "two resets and a wide prior are as good as the best on a swaying base": (
            sway[BOTH].value < 1.2 * min(one.value for one in sway.values())
        ),
        "neither alone is, and nothing that moves more is borne": all(
            one.low > 60
            for one in (
                sway[WIDE],
                sway[RESETS[1]],
                surge[BOTH],
                on["sway with a lever arm"][BOTH],
            )
        ),
        "under surge resets fail, tuned and triggered as well": all(
            one.low > 5 * 60
            for arm, one in surge.items()
            if "reset" in arm and "gravity" not in arm
        ),
    }
