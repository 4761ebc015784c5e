"""Paper 1's statements under every reading of what the paper does not print."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from sinsjax import analysis, plots
from sinsjax.report.base import (
    Block,
    Picture,
    Report,
    Section,
    Source,
    Table,
    Text,
    name_of,
    value_text,
    yardstick,
)
from sinsjax.report.statements import STATEMENTS, Meaning, StatementVerdict, judge
from sinsjax.study.study import Study

CONCLUSIONS = ("S8", "S10", "S11", "S12")
"""What the paper's abstract concludes: failure, its reason, the cure, its accuracy."""

TOGETHER = ("S5", "S8", "S10")
"""What the paper explains failure by: condition 4 converges, 5 does not, and P is too small."""

_MARKS = {(True, False): "+", (True, True): "+~", (False, False): "-", (False, True): "-~"}


class Judged(NamedTuple):
    """One reading with its verdicts.

    Attributes:
        reading: value by key of the study's axes.
        verdicts: one for each of `STATEMENTS`.
    """

    reading: Mapping[str, Any]
    verdicts: Sequence[StatementVerdict]

    @property
    def held(self) -> int:
        """How many statements hold."""
        return sum(v.holds for v in self.verdicts)

    @property
    def conclusions(self) -> int:
        """How many of `CONCLUSIONS` hold."""
        return sum(v.holds for v in self.verdicts if v.statement_id in CONCLUSIONS)

    @property
    def clear(self) -> int:
        """How many statements are decided by their whole interval."""
        return sum(not v.straddles for v in self.verdicts)


def report(source: Source) -> Report:
    """Every statement under every reading, and the reading that fits best."""
    meaning = meaning_of(source.study)
    judged = [
        Judged(reading, judge(_conditions(rows), meaning))
        for reading, rows in analysis.groups(source.summary, list(source.study.axes))
    ]
    best = best_of(judged)
    ties = [j for j in judged if j.held == best.held]
    n = len(STATEMENTS)
    headline = (
        f"Of {n} statements under {len(judged)} readings, the most that hold is {best.held}. The"
        f" reading that fits best: {name_of(best.reading)}. It is inferred; the paper prints none."
    )
    everywhere, nowhere = (
        [
            f"{text} ({name})"
            for i, (name, (text, _)) in enumerate(STATEMENTS.items())
            if all(j.verdicts[i].holds is held for j in judged)
        ]
        for held in (True, False)
    )
    universal = f"Hold under every reading: {_list(everywhere)}. Under none: {_list(nowhere)}."
    return Report(
        [headline, _apart(judged), universal],
        [
            Section("What the words mean", [_meaning_table(source.study, meaning)]),
            Section("The reading that fits best", [Text(_choice(best, ties)), _best_table(best)]),
            Section(
                "Every statement under every reading",
                [
                    Picture("verdicts", _CAPTION, _figure(judged, best)),
                    _mark_table(judged),
                    _number_table(judged),
                ],
            ),
        ],
    )


_CAPTION = (
    "A column a statement of the paper, a line a reading of what it does not print. Blue: the"
    " statement holds; ~: its 95 % interval reaches across the threshold."
)


def meaning_of(study: Study) -> Meaning:
    """What the paper's words mean in this study."""
    return Meaning(
        **study.statements.model_dump(),
        covariance_after_s=study.study.consistency_after_s,
        steady_after_s=study.study.steady_after_s,
    )


def best_of(judged: Sequence[Judged]) -> Judged:
    """The reading under which most statements hold.

    Ties go to the one with more of `CONCLUSIONS`, then with more statements decided by their whole
    interval, then to the first.
    """
    return max(judged, key=lambda j: (j.held, j.conclusions, j.clear))


def _apart(judged: Sequence[Judged]) -> str:
    """Whether any reading makes hold together what the paper says of conditions 4 and 5."""
    texts = "; ".join(f"{STATEMENTS[name][0]} ({name})" for name in TOGETHER)
    held = [{v.statement_id for v in j.verdicts if v.holds} for j in judged]
    whole = sum(set(TOGETHER) <= here for here in held)
    pairs = ", ".join(
        f"{one} and {other} under {sum({one, other} <= here for here in held)}"
        for one, other in combinations(TOGETHER, 2)
    )
    found = f"{whole} of {len(judged)} readings make" if whole else "No reading makes"
    return f"{found} these hold together: {texts}. Two of them at a time: {pairs}."


def _conditions(rows: pa.Table) -> dict[str, pa.Table]:
    groups = analysis.groups(rows, ["case"])
    return {key["case"].removeprefix("condition "): table for key, table in groups}


def _list(names: Sequence[str]) -> str:
    return "; ".join(names) or "none"


def _choice(best: Judged, ties: Sequence[Judged]) -> str:
    others = [name_of(j.reading) for j in ties if j is not best]
    text = (
        f"**{name_of(best.reading)}**: {best.held} of {len(STATEMENTS)} hold. This is inferred"
        " from the paper's statements; the paper prints none of the three."
    )
    if others:
        text += (
            f" As many hold under {len(others)} other readings: {'; '.join(others)}. Ties go to the"
            f" reading with more of the abstract's conclusions ({', '.join(CONCLUSIONS)}), then to"
            " the one with fewer intervals across a threshold; this order was set after a trial"
            " with 16 draws a case."
        )
    failing = [v for v in best.verdicts if not v.holds]
    if failing:
        listed = "; ".join(f"{v.text} ({v.statement_id})" for v in failing)
        text += f" It does not say what the paper says here: {listed}."
    return text


def _best_table(best: Judged) -> Table:
    rows = [
        [
            v.statement_id,
            v.text,
            v.where,
            _word(v),
            v.told(1 if v.unit == "s" else 3),
            v.measure,
        ]
        for v in best.verdicts
    ]
    header = ["", "statement", "paper", "verdict", "number [95 % interval]", "what is measured"]
    return Table(f"Every statement: {name_of(best.reading)}", header, rows)


def _word(verdict: StatementVerdict) -> str:
    word = "holds" if verdict.holds else "does not hold"
    return f"{word} ~" if verdict.straddles else word


def _cells(judged: Judged) -> list[str]:
    return [value_text(value) for value in judged.reading.values()]


def _mark_table(judged: Sequence[Judged]) -> Table:
    rows = [
        [*_cells(j), str(j.held), *(_MARKS[v.holds, v.straddles] for v in j.verdicts)]
        for j in judged
    ]
    header = [*judged[0].reading, "held", *STATEMENTS]
    note = (
        "`+` holds, `-` does not, `~` its 95 % interval reaches across the threshold. The verdict"
        " follows the number."
    )
    return Table("Verdicts", header, rows, note)


def _number_table(judged: Sequence[Judged]) -> Table:
    rows = []
    for j in judged:
        numbers = (
            f"{_MARKS[v.holds, v.straddles]} {v.told(0 if v.unit == 's' else 2)}"
            for v in j.verdicts
        )
        rows.append([*_cells(j), *numbers])
    header = [*judged[0].reading, *STATEMENTS]
    title = "Numbers behind the verdicts, with 95 % intervals"
    return Table(title, header, rows, "Shares and ratios have no unit.", folded=True)


def _meaning_table(study: Study, meaning: Meaning) -> Block:
    start, end = study.study.window_s
    rows = [
        ["converges", f"at least {meaning.converges_share:g} of the draws settle to 10 arcmin"],
        ["in a short time", f"median settling time at most {meaning.short_time_s:g} s"],
        ["longer", "median settling time larger; the interval of the difference lies above 0"],
        [
            "larger errors",
            f"mean heading error from its limit, {start:g} to {end:g} s, larger in size; the"
            " interval of the difference lies above 0",
        ],
        ["cannot converge", f"under {meaning.cannot_share:g} of the draws settle to 10 arcmin"],
        [
            "as precise",
            f"mean phi_u over {start:g} to {end:g} s no further apart than"
            f" {meaning.as_precise_arcmin:g} arcmin, interval included",
        ],
        [
            "P larger throughout",
            "the filter's yaw variance is above the squared yaw error in at least"
            f" {meaning.covariance_share:g} of the records after {meaning.covariance_after_s:g} s",
        ],
        [
            "P smaller when steady",
            "the filter's yaw variance is above the squared yaw error in at most"
            f" {1 - meaning.covariance_share:g} of the records after {meaning.steady_after_s:g} s",
        ],
        ["about equal", "the filter's 1 sigma of yaw at the end within 10 %"],
    ]
    note = (
        f"Fixed in the study before its first result; {study.n_draws} draws a case."
        f" {yardstick(study)} A verdict on a yaw error says nothing about true north."
    )
    return Table("The paper's words as numbers", ["words", "meaning"], rows, note)


def _figure(judged: Sequence[Judged], best: Judged) -> Figure:
    verdicts = plots.Verdicts(
        readings=[", ".join(_cells(j)) for j in judged],
        statements=list(STATEMENTS),
        holds=np.array([[v.holds for v in j.verdicts] for j in judged]),
        straddles=np.array([[v.straddles for v in j.verdicts] for j in judged]),
        best=next(i for i, j in enumerate(judged) if j is best),
    )
    return plots.verdict_matrix(verdicts, "Which statement of the paper holds under which reading?")
