"""Paper 1's statements under every reading of what the paper does not print."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from sinsjax import analysis, plots
from sinsjax.report.base import Picture, Source, Table
from sinsjax.report.output import counted

from .statements import STATEMENTS, Meaning, StatementVerdict, judge

CONCLUSIONS = ("S8", "S10", "S11", "S12")
"""What the paper's abstract concludes: failure, its reason, the cure, its accuracy."""

TOGETHER = ("S5", "S8", "S10")
"""What the paper explains failure by: condition 4 converges, 5 does not, and P is too small."""

SHORT = {
    "S1a": "1 converges",
    "S1b": "2 converges",
    "S2a": "1 in a short time",
    "S2b": "2 in a short time",
    "S3": "3 converges",
    "S4a": "3 longer than 2",
    "S4b": "3 longer than 1",
    "S5": "4 converges",
    "S6a": "4 longer than 2",
    "S6b": "4 longer than 1",
    "S7a": "4 worse than 2",
    "S7b": "4 worse than 1",
    "S8": "5 cannot converge",
    "S9": "1: P larger throughout",
    "S10": "5: P smaller when steady",
    "S11": "5 with resets converges",
    "S12": "5 with resets as precise",
    "S13": "5 with resets: P larger",
    "S14": "5 with resets: P as 1's",
}
"""Each statement as the figure names it; numbers are the paper's conditions."""

Q_WORDS = {"per_step": "as printed", "psd": "density", "per_sample": "sample"}
R_WORDS = {"per_update": "per update", "psd": "density"}
_MARKS = {(True, False): "+", (True, True): "+~", (False, False): "-", (False, True): "-~"}


class Judged(NamedTuple):
    """One reading (value by key) with its verdicts, one for each of `STATEMENTS`."""

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

    @property
    def words(self) -> list[str]:
        """The reading in words: Q, R and feedback interval."""
        q, r, feedback = (
            self.reading[key] for key in ("q_reading", "r_reading", "feedback_interval_s")
        )
        return [Q_WORDS[q], R_WORDS[r], f"{feedback:g} s"]

    def holds(self, *names: str) -> bool:
        """Whether some statements hold, all of them."""
        return all(v.holds for v in self.verdicts if v.statement_id in names)


def judge_all(source: Source) -> list[Judged]:
    """Every reading of the study, judged."""
    settings = source.study.study
    meaning = Meaning(settings.consistency_after_s, settings.steady_after_s)
    found = []
    for reading, rows in analysis.groups(source.summary, list(source.study.axes)):
        cases = analysis.groups(rows, ["case"])
        conditions = {key["case"].removeprefix("condition "): table for key, table in cases}
        found.append(Judged(reading, judge(conditions, meaning)))
    return found


def best_of(judged: Sequence[Judged]) -> Judged:
    """The reading under which most statements hold.

    Ties go to the one with more of `CONCLUSIONS`, then with more statements decided by their whole
    interval, then to the first.
    """
    return max(judged, key=lambda j: (j.held, j.conclusions, j.clear))


def told(judged: Sequence[Judged]) -> tuple[dict[str, Any], dict[str, bool]]:
    """Numbers and claims about all readings."""
    best = best_of(judged)
    n, failing = len(STATEMENTS), [v.text for v in best.verdicts if not v.holds]
    everywhere, nowhere = (
        [
            text
            for i, (text, _) in enumerate(STATEMENTS.values())
            if all(j.verdicts[i].holds is held for j in judged)
        ]
        for held in (True, False)
    )
    pairs = {
        f"{one}_{other}": str(sum(j.holds(one, other) for j in judged))
        for one, other in combinations(TOGETHER, 2)
    }
    values = {
        "statements": str(n),
        "readings": str(len(judged)),
        "held": str(best.held),
        "ties": str(sum(j.held == best.held for j in judged) - 1),
        "least": str(min(j.held for j in judged)),
        "best": {name: word for name, word in zip(("q", "r", "feedback"), best.words, strict=True)},
        "failing": "; ".join(failing),
        "everywhere": "; ".join(everywhere),
        "nowhere": "; ".join(nowhere),
        "pairs": pairs,
    }
    claims = {
        "the best reading is Q as printed, R as a density, feedback every second": (
            best.words == ["as printed", "density", "1 s"]
        ),
        "no reading makes the paper's explanation hold together": not any(
            j.holds(*TOGETHER) for j in judged
        ),
        "the cure and its accuracy hold under every reading": all(
            j.holds("S11", "S12") for j in judged
        ),
        "failure and its cure hold under the best reading": best.holds("S8", "S11", "S12"),
    }
    return values, claims


def figure(judged: Sequence[Judged], source: Source) -> Picture:
    """The verdicts, a cell each."""
    best = best_of(judged)
    verdicts = plots.Verdicts(
        readings=[", ".join(j.words) for j in judged],
        statements=list(SHORT.values()),
        holds=np.array([[v.holds for v in j.verdicts] for j in judged]),
        straddles=np.array([[v.straddles for v in j.verdicts] for j in judged]),
        best=next(i for i, j in enumerate(judged) if j is best),
    )
    drawn = plots.verdict_matrix(verdicts, "Which statement holds under which reading?")
    caption = (
        f"{source.study.n_draws} draws a condition, heading from its limit; numbers name the"
        " paper's conditions. The reading that fits best is in bold."
    )
    return Picture("verdicts", caption, drawn, counted(source))


def best_table(best: Judged) -> Table:
    """Every statement under the reading that fits best."""
    rows = [
        [
            v.text,
            v.where,
            ("yes" if v.holds else "no") + (" ~" if v.straddles else ""),
            v.told(1 if v.unit == "s" else 3),
            v.measure,
        ]
        for v in best.verdicts
    ]
    header = ["statement", "paper", "holds", "number [95 % interval]", "what is measured"]
    note = "~: the interval reaches across the threshold. Shares and ratios have no unit."
    return Table("Every statement under the best reading", header, rows, note, folded=True)


def number_table(judged: Sequence[Judged]) -> Table:
    """Every number behind the verdicts."""
    rows = [
        [
            ", ".join(j.words),
            str(j.held),
            *(
                f"{_MARKS[v.holds, v.straddles]} {v.told(0 if v.unit == 's' else 2)}"
                for v in j.verdicts
            ),
        ]
        for j in judged
    ]
    note = "`+` holds, `-` does not, `~` its 95 % interval reaches across the threshold."
    header = ["Q, R, feedback", "held", *SHORT.values()]
    return Table("Every number under every reading", header, rows, note, folded=True)


def meaning_table() -> Table:
    """What the paper's words mean."""
    m = Meaning(10.0, 300.0)
    rows = [
        ["converges", f"at least {m.converges_share:g} of the draws settle to 10 arcmin"],
        ["in a short time", f"median settling time at most {m.short_time_s:g} s"],
        ["longer", "median settling time larger, interval of the difference above 0"],
        ["worse", "mean heading further from its limit, interval of the difference above 0"],
        ["cannot converge", f"under {m.cannot_share:g} of the draws settle to 10 arcmin"],
        [
            "as precise",
            f"mean heading no further apart than {m.as_precise_arcmin:g} arcmin, with interval",
        ],
        [
            "P larger throughout",
            f"heading variance above the squared error in at least {m.covariance_share:g} of the"
            f" records after {m.covariance_after_s:g} s",
        ],
        [
            "P smaller when steady",
            f"the same in at most {1 - m.covariance_share:g} of the records after"
            f" {m.steady_after_s:g} s",
        ],
        ["P as condition 1's", "heading sigma at the end within 10 %"],
    ]
    return Table("The paper's words as numbers", ["words", "meaning"], rows, folded=True)
