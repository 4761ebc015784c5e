"""Numbers of the page on which alignment to use: the best method per vehicle, and all of them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.execution.source import Source
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page, Sources

SHARE = 0.9
TIMES = {"60 s": "phi_u_at_60_arcmin", "300 s": "phi_u_at_300_arcmin", "600 s": "phi_u_arcmin"}
VEHICLES = ("still", "sways", "sways and surges", "the same, with lever arm and vibration")
PLAIN = ("plain filter, as published", "plain filter, resets by the law")


class Errors(NamedTuple):
    """Magnitudes of the heading error by method and time.

    Attributes:
        cases: methods, as in the study.
        values: (times, vehicles, methods, draws), arcmin; infinite for a run that failed.
    """

    cases: list[str]
    values: NDArray

    @classmethod
    def read(cls, source: Source) -> "Errors":
        """Read the errors of a study whose cases come before its vehicles."""
        cases = [str(case["case"]) for case in source.study.cases]
        columns = source.rows(TIMES.values())
        arrays = [np.abs(analysis.numeric_column(columns, name)) for name in TIMES.values()]
        shape = (len(TIMES), source.draws, len(cases), len(VEHICLES))
        values = np.where(np.isnan(arrays), np.inf, arrays).reshape(shape)
        return cls(cases, values.transpose(0, 3, 2, 1))

    def reached(self, time: int, vehicle: int, method: int, draws: slice = slice(None)) -> Estimate:
        """Return the error that 90 % of the runs stay below, arcmin."""
        return analysis.quantile(self.values[time, vehicle, method, draws], SHARE)

    def best(self, vehicle: int) -> int:
        """Return the method with the least error at 300 s on every other draw."""
        found = [self.reached(1, vehicle, m, slice(0, None, 2)).value for m in self.candidates]
        return self.candidates[int(np.argmin(found))]

    @property
    def candidates(self) -> list[int]:
        """The methods other than the plain filter."""
        return [i for i, case in enumerate(self.cases) if case not in PLAIN]


def page(sources: Sources) -> Page:
    """Which method on which vehicle."""
    source = sources["which_method"]
    errors = Errors.read(source)
    best = [errors.best(vehicle) for vehicle in range(len(VEHICLES))]
    published, law = (errors.cases.index(case) for case in PLAIN)
    simple = errors.cases.index("inertial")

    def at_300(vehicle: int, method: int) -> Estimate:
        return errors.reached(1, vehicle, method)

    values = {
        "runs": f"{source.runs:,}",
        "published": {"sway": angle(at_300(1, published)), "surge": angle(at_300(2, published))},
        "law": {"sway": angle(at_300(1, law)), "surge": angle(at_300(2, law))},
        "inertial": {"surge": angle(at_300(2, simple))},
        "surge": {"method": errors.cases[best[2]], "error": angle(at_300(2, best[2]))},
    }
    claims = {
        "one method or another is within a degree at 300 s": all(
            at_300(vehicle, method).high < 60 for vehicle, method in enumerate(best)
        ),
        "a fit is within a tenth of the best on still and swaying vehicles": all(
            at_300(v, errors.cases.index("gravity_fit")).value < 1.1 * at_300(v, best[v]).value
            for v in (0, 1)
        ),
        "resets rescue on sway": at_300(1, law).high < 0.1 * at_300(1, published).low,
        "and not on surge": at_300(2, law).low > 10 * at_300(2, best[2]).high,
        "the surge filter leads on surge": errors.cases[best[2]] == "kalman_surge",
    }
    tables = {"best": _best_table(errors, best), "all": _all_table(errors)}
    return Page(values, tables, claims=claims)


def angle(estimate: Estimate) -> str:
    """Return an error as text: arcmin below a degree, else degrees."""
    unit, factor = ("'", 1.0) if estimate.value < 60 else (" deg", 60.0)
    if not np.isfinite(estimate.value):
        return "none"
    value, low, high = (
        f"{x / factor:.0f}" if x >= 9.95 * factor else f"{x / factor:.1f}" for x in estimate[:3]
    )
    return f"{value} [{low}, {high}]{unit}"


def _best_table(errors: Errors, best: list[int]) -> Table:
    judged = slice(1, None, 2)
    rows = [
        [
            name,
            f"`{errors.cases[method]}`",
            *(angle(errors.reached(t, vehicle, method, judged)) for t in range(len(TIMES))),
        ]
        for vehicle, (name, method) in enumerate(zip(VEHICLES, best, strict=True))
    ]
    note = (
        "Heading error from true north that 90 % of the alignments stay below, with its 95 %"
        " interval. Every other draw chose the method at 300 s, the others are shown."
    )
    return Table("What to use", ["the vehicle is", "use", *TIMES], rows, note)


def _all_table(errors: Errors) -> Table:
    rows = [
        [case, *(angle(errors.reached(1, v, method)) for v in range(len(VEHICLES)))]
        for method, case in enumerate(errors.cases)
    ]
    return Table("Every method after 300 s", ["method", *VEHICLES], rows)
