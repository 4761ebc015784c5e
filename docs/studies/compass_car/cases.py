"""The cases of a compass study on a record: their data, their turn, their heading errors."""

from collections.abc import Sequence
from typing import NamedTuple

import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.report.base import Source, name_of, shown_keys
from sinsjax.study.study import Study


class Case(NamedTuple):
    """The runs of one variant, one a start time.

    Attributes:
        name: in words.
        variant: its number.
        method: alignment method.
        tape_s: length of the data, s.
        passes: over the data; the last one may be part of one.
        turn: what compass loops do at a turn; empty where there is none.
        smoothing_s: of the specific force that a turn reflects by, s.
        rows: of the summary.
        errors: (starts,) heading error phi_u at the end, arcmin; NaN if unknown.
    """

    name: str
    variant: int
    method: str
    tape_s: float
    passes: int
    turn: str
    smoothing_s: float
    rows: pa.Table
    errors: NDArray

    @property
    def is_compass(self) -> bool:
        """Whether the compass loops align."""
        return self.method == "compass"

    @property
    def kind(self) -> str:
        """What figures tell cases apart by."""
        if not self.is_compass:
            return "Kalman"
        words = {"reflect": "tilt reflected", "velocity": "velocity flipped", "": "one pass"}
        return f"compass, {words.get(self.turn, self.turn)}"

    @property
    def runs(self) -> list[int]:
        """Numbers of its runs, one a start time."""
        return self.rows["run_id"].to_pylist()


def cases_of(source: Source) -> list[Case]:
    """The runs by variant, in the study's order."""
    study, found = source.study, []
    for key, rows in analysis.groups(source.summary, [*shown_keys(study), "variant_id"]):
        variant = key.pop("variant_id")
        tape_s, passes = _data(study, variant)
        method = rows["method"][0].as_py()
        turned = method == "compass" and passes > 1
        found.append(
            Case(
                name=name_of(key),
                variant=variant,
                method=method,
                tape_s=tape_s,
                passes=passes,
                turn=study.values("turn")[variant] if turned else "",
                smoothing_s=study.values("turn_smoothing_s")[variant] if turned else 0.0,
                rows=rows,
                errors=analysis.numbers(rows, "phi_u_arcmin"),
            )
        )
    return found


def _data(study: Study, variant: int) -> tuple[float, int]:
    """Length of a variant's data, s, and how many passes over them begin."""
    span = study.spans[variant]
    return span.pass_records * study.record_every / study.rate_hz, -(
        -span.records // span.pass_records
    )


def partner(cases: Sequence[Case], case: Case) -> Case | None:
    """The filter that goes once over the same data; None without one, or for itself."""
    same = (c for c in cases if not c.is_compass and c.passes == 1 and c.tape_s == case.tape_s)
    found = next(same, None)
    return None if found is case else found


def turned_by(cases: Sequence[Case], turn: str) -> list[Case]:
    """Compass cases over stored tapes that turn by one rule."""
    return [case for case in cases if case.turn == turn]


def first_of_kinds_by_tape(cases: Sequence[Case]) -> list[Case]:
    """The first case of each kind and number of passes over each length of data."""
    first: dict[tuple[float, str, int], Case] = {}
    for case in cases:
        first.setdefault((case.tape_s, case.kind, case.passes), case)
    return list(first.values())
