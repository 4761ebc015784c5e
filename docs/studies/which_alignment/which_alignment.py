"""Tables, figure and numbers of docs/which_alignment.md.

    python -m docs.studies.which_alignment.which_alignment DIR DIR [-o FOLDER]

The directories have the results of which_method and which_method_published.
"""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray
from scipy import special

import sinsjax
from docs.studies.common import GREY, Page, Runs, read_arguments
from sinsjax import analysis, plots
from sinsjax.analysis import Estimate
from sinsjax.plots.style import with_style

SHARE = 0.9
TIMES_S = (10, 15, 20, 30, 45, 60, 90, 120, 180, 240, 300, 600)
VEHICLES = ("still", "sways", "sways and surges", "the same, with lever arm and vibration")
PUBLISHED, LAW = "plain filter, as published", "plain filter, resets by the law"
EVEN, ODD, ALL = slice(0, None, 2), slice(1, None, 2), slice(None)
LINES = (PUBLISHED, LAW, "kalman_sincos", "kalman_surge")
HEADLINE = (
    "Resets by the law rescue the plain Kalman filter, later than others on a surging vehicle"
)
PANELS = {1: "The vehicle sways", 2: "It also surges (0.1 m/s rms)"}
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
"""Time, error and text of each label, at its line, by vehicle and method."""


class Errors(NamedTuple):
    """Magnitudes of the heading error from true north by method and time.

    Attributes:
        cases: methods.
        values: (times, vehicles, methods, draws), arcmin; infinite for a run that failed.
    """

    cases: list[str]
    values: NDArray

    @classmethod
    def read(cls, published: Runs, own: Runs) -> "Errors":
        """Read the errors of the plain filter as published, and of all other methods."""
        cases = [PUBLISHED, *dict.fromkeys(own.study.values("case"))]
        parts = []
        for runs in (published, own):
            names = [*(f"phi_u_at_{time}_arcmin" for time in TIMES_S[:-1]), "phi_u_arcmin"]
            values = np.abs([runs.column(name) for name in names])
            values = values.reshape(len(names), -1, len(VEHICLES), runs.draws)
            parts.append(np.where(np.isnan(values), np.inf, values).transpose(0, 2, 1, 3))
        return cls(cases, np.concatenate(parts, axis=2))

    def at(self, time_s: float, vehicle: int, case: str, draws: slice = ALL) -> Estimate:
        """Return the error that 90 % of the alignments stay below, arcmin."""
        values = self.values[TIMES_S.index(int(time_s)), vehicle, self.cases.index(case), draws]
        return analysis.quantile(values, SHARE)

    def best(self, vehicle: int) -> str:
        """Return the method with the least error at 300 s on every other draw."""
        others = [case for case in self.cases if case not in (PUBLISHED, LAW)]
        return min(others, key=lambda case: self.at(300, vehicle, case, EVEN).value)


def bounds_of(own: Runs) -> list[float]:
    """Return the information bound at 300 s per vehicle, of 90 % of the headings, arcmin.

    It knows the sensors' biases by their sigma. The mean heading does not change it.
    """
    tables = own.study.to_dict()
    given = {key: tables[key] for key in ("study", "earth", "motion", "sensors", "axes")}
    given["motion"] = given["motion"] | {"yaw_center_deg": 0.0}
    given["alignment"] = {"method": "inertial"}
    given["drawn"] = {key: law for key, law in tables["drawn"].items() if "bias" in key}
    rows = sinsjax.information_bound(sinsjax.study_from_dict(given)).to_pylist()
    sigmas = {row["variant_id"]: row["bound_u_arcmin"] for row in rows if row["time_s"] == 300.0}
    quantile = np.sqrt(2) * special.erfinv(SHARE)
    return [float(quantile * sigmas[vehicle]) for vehicle in range(len(VEHICLES))]


def angle(one: Estimate) -> str:
    """Return an error as text: arcmin below a degree, else degrees."""
    unit, factor = ("'", 1.0) if one.value < 60 else (" deg", 60.0)
    if not np.isfinite(one.value):
        return "none"
    value, low, high = (
        f"{x / factor:.0f}" if x >= 9.95 * factor else f"{x / factor:.1f}" for x in one[:3]
    )
    return f"{value} [{low}, {high}]{unit}"


@with_style
def draw_reached(errors: Errors) -> Figure:
    """Draw the error over the available time, on a vehicle that sways and one that also surges."""
    figure = Figure(figsize=(9.6, 4.6))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (vehicle, title) in zip(panels, PANELS.items(), strict=True):
        for colour, case in zip(plots.COLOURS, LINES, strict=False):
            value, low, high = np.array([errors.at(t, vehicle, case)[:3] for t in TIMES_S]).T
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


def main() -> None:
    """Print the tables and numbers, and write the figure."""
    studies = ("which_method", "which_method_published")
    runs, page = read_arguments(__doc__, studies)
    own, published = (runs[name] for name in studies)
    errors = Errors.read(published, own)
    show(errors, bounds_of(own), page)
    page.print_numbers(
        alignments=f"{own.count + published.count:,}",
        published=f"{angle(errors.at(300, 1, PUBLISHED))}, {angle(errors.at(300, 2, PUBLISHED))}",
        law=f"{angle(errors.at(300, 1, LAW))}, {angle(errors.at(300, 2, LAW))}",
        law_later=angle(errors.at(600, 2, LAW)),
        inertial_on_surge=angle(errors.at(300, 2, "inertial")),
        kalman_surge_under_vibration=angle(errors.at(300, 3, "kalman_surge")),
        best_on_all_draws=[angle(errors.at(300, v, errors.best(v))) for v in range(len(VEHICLES))],
    )
    footer = "; ".join(one.footer for one in (own, published))
    page.figure("which_alignment_reached", draw_reached(errors), footer)


def show(errors: Errors, bounds: list[float], page: Page) -> None:
    """Print the best method per vehicle, and every method after 300 s."""
    times = {"60 s": 60, "300 s": 300, "600 s": 600}
    rows = []
    for vehicle, name in enumerate(VEHICLES):
        case = errors.best(vehicle)
        cells = [angle(errors.at(time, vehicle, case, ODD)) for time in times.values()]
        rows.append([name, f"`{case}`", *cells, f"{bounds[vehicle]:.1f}'"])
    page.show("What to use", ["the vehicle is", "use", *times, "bound"], rows)
    rows = [
        [case, *(angle(errors.at(300, v, case)) for v in range(len(VEHICLES)))]
        for case in errors.cases
    ]
    page.show("Every method after 300 s", ["method", *VEHICLES], rows)


if __name__ == "__main__":
    main()
