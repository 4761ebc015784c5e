"""Numbers of the page on which method to use: the best method per vehicle, and all of them."""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray
from scipy import special

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.execution.source import Source
from sinsjax.plots.style import COLOURS, GREY, with_style
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources
from sinsjax.study.study import Study

SHARE = 0.9
TIMES_S = (10, 15, 20, 30, 45, 60, 90, 120, 180, 240, 300, 600)
SHOWN = {"60 s": TIMES_S.index(60), "300 s": TIMES_S.index(300), "600 s": TIMES_S.index(600)}
CHOSEN_AT = TIMES_S.index(300)
VEHICLES = ("still", "sways", "sways and surges", "the same, with lever arm and vibration")
PUBLISHED, LAW = "plain filter, as published", "plain filter, resets by the law"


class Errors(NamedTuple):
    """Magnitudes of the heading error by method and time.

    Attributes:
        cases: methods.
        values: (times, vehicles, methods, draws), arcmin; infinite for a run that failed.
    """

    cases: list[str]
    values: NDArray

    @classmethod
    def read(cls, published: Source, own: Source) -> "Errors":
        """Read the errors of the plain filter as published, and of all other methods."""
        cases = [PUBLISHED, *(str(case["case"]) for case in own.study.cases)]
        return cls(cases, np.concatenate([_read(published), _read(own)], axis=2))

    def reached(self, time: int, vehicle: int, method: int, draws: slice = slice(None)) -> Estimate:
        """Return the error that 90 % of the runs stay below, arcmin."""
        return analysis.quantile(self.values[time, vehicle, method, draws], SHARE)

    def best(self, vehicle: int) -> int:
        """Return the method with the least error at 300 s on every other draw."""
        found = [
            self.reached(CHOSEN_AT, vehicle, m, slice(0, None, 2)).value for m in self.candidates
        ]
        return self.candidates[int(np.argmin(found))]

    @property
    def candidates(self) -> list[int]:
        """The methods other than the plain filter."""
        return [i for i, case in enumerate(self.cases) if case not in (PUBLISHED, LAW)]


def _read(source: Source) -> NDArray:
    """Return the errors of a study, (times, vehicles, cases, draws), arcmin."""
    names = [*(f"phi_u_at_{time}_arcmin" for time in TIMES_S[:-1]), "phi_u_arcmin"]
    columns = source.rows(names)
    arrays = [np.abs(analysis.numeric_column(columns, name)) for name in names]
    values = np.where(np.isnan(arrays), np.inf, arrays)
    shape = (len(names), source.draws, -1, len(VEHICLES))
    return values.reshape(shape).transpose(0, 3, 2, 1)


def heading_bounds(study: Study) -> list[float]:
    """Return the information bound at 300 s per vehicle, of 90 % of the headings, arcmin.

    It knows the sensors' biases by their sigma. The mean heading does not change it.
    """
    tables = study.to_dict()
    given = {key: tables[key] for key in ("study", "earth", "motion", "sensors", "axes")}
    drawn = {key: law for key, law in tables["drawn"].items() if "bias" in key}
    motion = {"motion": given["motion"] | {"yaw_center_deg": 0.0}}
    made = sinsjax.study_from_dict(
        given | motion | {"alignment": {"method": "inertial"}, "drawn": drawn}
    )
    rows = sinsjax.information_bound(made).to_pylist()
    sigma = {row["variant_id"]: row["bound_u_arcmin"] for row in rows if row["time_s"] == 300.0}
    quantile = np.sqrt(2) * special.erfinv(SHARE)
    return [float(quantile * sigma[vehicle]) for vehicle in range(len(VEHICLES))]


def page(sources: Sources) -> Page:
    """Which method on which vehicle."""
    published_source, source = sources["which_method_published"], sources["which_method"]
    errors = Errors.read(published_source, source)
    best = [errors.best(vehicle) for vehicle in range(len(VEHICLES))]
    published, law = errors.cases.index(PUBLISHED), errors.cases.index(LAW)
    simple = errors.cases.index("inertial")

    def at_300(vehicle: int, method: int) -> Estimate:
        return errors.reached(CHOSEN_AT, vehicle, method)

    later = errors.reached(SHOWN["600 s"], 2, law)
    values = {
        "runs": f"{source.runs + published_source.runs:,}",
        "published": {"sway": angle(at_300(1, published)), "surge": angle(at_300(2, published))},
        "law": {
            "sway": angle(at_300(1, law)),
            "surge": angle(at_300(2, law)),
            "later": angle(later),
        },
        "inertial": {"surge": angle(at_300(2, simple))},
        "vibration": {"method": errors.cases[best[3]], "error": angle(at_300(3, best[3]))}
        | {"filter": angle(at_300(3, errors.cases.index("kalman_surge")))},
        "surge": {"method": errors.cases[best[2]], "error": angle(at_300(2, best[2]))},
    }
    claims = {
        "without vibration all others are within half a degree at 300 s": all(
            at_300(vehicle, method).high < 30
            for vehicle in range(3)
            for method in errors.candidates
        ),
        "a fit is within a tenth of the best on still and swaying vehicles": all(
            at_300(v, errors.cases.index("gravity_fit")).value < 1.1 * at_300(v, best[v]).value
            for v in (0, 1)
        ),
        "resets rescue on sway": at_300(1, law).high < 0.1 * at_300(1, published).low,
        "and later on surge": at_300(2, law).low > 10 * at_300(2, best[2]).high and later.high < 30,
        "fits lead under vibration": errors.cases[best[3]] in ("inertial", "optimisation_position"),
        "the surge filter leads on surge": errors.cases[best[2]] == "kalman_surge",
    }
    bounds = heading_bounds(source.study)
    tables = {"best": _best_table(errors, best, bounds), "all": _all_table(errors)}
    caption = "90 % of the alignments stay below; shaded: 95 % interval."
    picture = Picture("reached", caption, draw_reached(errors))
    return Page(values, tables, {"reached": picture}, claims)


@with_style
def draw_reached(errors: Errors) -> Figure:
    """Draw the error over the available time, on a vehicle that sways and one that also surges."""
    figure = Figure(figsize=(9.6, 4.6))
    panels = figure.subplots(1, 2, sharey=True)
    titles = {1: "The vehicle sways", 2: "It also surges (0.1 m/s rms)"}
    for axes, (vehicle, title) in zip(panels, titles.items(), strict=True):
        for colour, case in zip(COLOURS, LINES, strict=False):
            method = errors.cases.index(case)
            found = [errors.reached(t, vehicle, method)[:3] for t in range(len(TIMES_S))]
            value, low, high = np.array(found).T
            axes.fill_between(TIMES_S, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(TIMES_S, value, color=colour)
            time, error, text = LABELS[vehicle, case]
            axes.text(time, error, text, color=colour, fontsize=10.5, linespacing=1.05)
        axes.set(xscale="log", yscale="log", xlim=(10, 600), ylim=(3, 18000), title=title)
        axes.xaxis.set_major_locator(FixedLocator([10, 30, 60, 120, 300, 600]))
        axes.yaxis.set_major_locator(FixedLocator([10, 60, 600, 6000]))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_major_formatter(lambda y, _: f"{y:g}'" if y < 60 else f"{y / 60:g}°")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_minor_locator(NullLocator())
        axes.set_xlabel("available time (s)", color=GREY)
    panels[0].set_ylabel("heading error of 90 %, at most")
    figure.suptitle(HEADLINE)
    return figure


LINES = (PUBLISHED, LAW, "kalman_sincos", "kalman_surge")
HEADLINE = (
    "Resets by the law rescue the plain Kalman filter, later than others on a surging vehicle"
)
LABELS = {
    (1, PUBLISHED): (32.0, 11300.0, "plain Kalman filter, as published"),
    (1, LAW): (36.0, 560.0, "the same, its Q the sensors' noise,\nresets by the law"),
    (1, "kalman_sincos"): (10.6, 20.0, "sine/cosine\nfilter"),
    (1, "kalman_surge"): (23.2, 2500.0, "surge filter"),
    (2, PUBLISHED): (34.0, 11800.0, "plain Kalman filter, as published"),
    (2, LAW): (195.0, 3000.0, "resets\nby the law"),
    (2, "kalman_sincos"): (150.0, 190.0, "sine/cosine\nfilter"),
    (2, "kalman_surge"): (78.0, 48.0, "surge filter"),
}
"""Time, error and text of each label, at its line."""


def angle(estimate: Estimate) -> str:
    """Return an error as text: arcmin below a degree, else degrees."""
    unit, factor = ("'", 1.0) if estimate.value < 60 else (" deg", 60.0)
    if not np.isfinite(estimate.value):
        return "none"
    value, low, high = (
        f"{x / factor:.0f}" if x >= 9.95 * factor else f"{x / factor:.1f}" for x in estimate[:3]
    )
    return f"{value} [{low}, {high}]{unit}"


def _best_table(errors: Errors, best: list[int], bounds: list[float]) -> Table:
    judged = slice(1, None, 2)
    rows = [
        [
            name,
            f"`{errors.cases[method]}`",
            *(angle(errors.reached(t, vehicle, method, judged)) for t in SHOWN.values()),
            f"{bounds[vehicle]:.1f}'",
        ]
        for vehicle, (name, method) in enumerate(zip(VEHICLES, best, strict=True))
    ]
    note = (
        "Heading error from true north that 90 % of the alignments stay below [95 %"
        " interval]. Every other draw selected the method at 300 s, the others are shown here, all"
        " draws below. The bound is what the data allow after 300 s: no unbiased method that knows"
        " the sigma of the biases keeps 90 % of its headings below less."
    )
    return Table("What to use", ["the vehicle is", "use", *SHOWN, "bound"], rows, note)


def _all_table(errors: Errors) -> Table:
    rows = [
        [case, *(angle(errors.reached(CHOSEN_AT, v, method)) for v in range(len(VEHICLES)))]
        for method, case in enumerate(errors.cases)
    ]
    return Table("Every method after 300 s", ["method", *VEHICLES], rows)
