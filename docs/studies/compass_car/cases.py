"""The cases of a compass study on a record: their data, their turn, their heading errors."""

from collections.abc import Sequence
from typing import NamedTuple

from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.report.base import Source
from sinsjax.report.grids import Grid

HEADING, SIGMA = "phi_u_arcmin", "sigma_u_arcmin"
_TURNS = {"reflect": "tilt reflected", "velocity": "velocity flipped", "": "one pass"}


class Case(NamedTuple):
    """The runs of one variant, one a start time.

    Attributes:
        name: in words.
        variant: its number.
        is_compass: whether the compass loops align; a Kalman filter otherwise.
        data_s: length of the data, s.
        passes: over the data; the last one may be part of one.
        turn: what compass loops do at a turn; empty where there is none.
        errors: (starts,) heading error phi_u at the end, arcmin; NaN if unknown.
        sigma: (starts,) what a filter believes of it, arcmin; NaN of compass loops.
    """

    name: str
    variant: int
    is_compass: bool
    data_s: float
    passes: int
    turn: str
    errors: NDArray
    sigma: NDArray

    @property
    def kind(self) -> str:
        """What figures tell cases apart by."""
        return f"compass, {_TURNS[self.turn]}" if self.is_compass else "Kalman"

    @property
    def rms(self) -> float:
        """Rms heading error over the start times, arcmin."""
        return analysis.rms(self.errors).value


def cases_of(source: Source) -> list[Case]:
    """The runs by variant, in the study's order."""
    study = source.study
    grid = Grid.of(source, (HEADING, SIGMA), case=study.values("case"))
    found = []
    for variant, (name, span) in enumerate(zip(grid.axes["case"], study.spans, strict=True)):
        is_compass = study.values("method")[variant] == "compass"
        passes = -(-span.records // span.pass_records)
        found.append(
            Case(
                name=name,
                variant=variant,
                is_compass=is_compass,
                data_s=span.pass_records * study.record_every / study.rate_hz,
                passes=passes,
                turn=study.values("turn")[variant] if is_compass and passes > 1 else "",
                errors=grid.at(HEADING, case=name),
                sigma=grid.at(SIGMA, case=name),
            )
        )
    return found


def partner(cases: Sequence[Case], case: Case) -> Case:
    """The filter that goes once over the same data."""
    return next(c for c in cases if not c.is_compass and c.passes == 1 and c.data_s == case.data_s)


def first_of_kinds(cases: Sequence[Case]) -> list[Case]:
    """The first case of each kind and number of passes over each length of data."""
    keys = [(case.data_s, case.kind, case.passes) for case in cases]
    return [case for i, case in enumerate(cases) if keys.index(keys[i]) == i]
