"""The winning trigger on the recorded car, beside fixed resets."""

from typing import NamedTuple

import numpy as np

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate
from sinsjax.report.base import Picture, Source, Table
from sinsjax.report.grids import Grid, median
from sinsjax.report.output import counted

TRUTH = "settle_10_truth_s"


class OnRecord(NamedTuple):
    """The runs on the record: settled or not, and when, by case and misalignment."""

    footer: str
    grid: Grid
    cases: tuple[str, ...]
    yaws: tuple[float, ...]

    @classmethod
    def of(cls, source: Source) -> "OnRecord":
        """Lays out the runs of the study."""
        study = source.study
        grid = Grid.of(source, (TRUTH,), case=study.values("case"), yaw=study.values("phi_u0_deg"))
        return cls(counted(source), grid, grid.axes["case"], tuple(map(float, grid.axes["yaw"])))

    def settled(self, case: str, yaw: float) -> float:
        """Share of the start times that settle."""
        return float(np.isfinite(self.grid.at(TRUTH, case=case, yaw=yaw)).mean())

    def time_s(self, case: str, yaw: float) -> float:
        """Median settling time."""
        return float(median(self.grid.at(TRUTH, case=case, yaw=yaw)))


def figure(car: OnRecord, names: dict[float, str]) -> Picture:
    """Settling time along the misalignment."""
    bare = Estimate(0.0, float("nan"), float("nan"), car.grid.draws)
    panels = {
        "median settling time (s)": {
            case: [bare._replace(value=car.time_s(case, yaw)) for yaw in car.yaws]
            for case in car.cases
        },
    }
    drawn = plots.along_axis(
        "phi_u0_deg", car.yaws, panels, title="On the record: heading within 10' of the reference"
    )
    starts = ", ".join(names.values())
    caption = (
        f"{car.grid.draws} start times on one record, misaligned by {starts} deg about east,"
        f" north and up. {analysis.NO_INTERVAL}"
    )
    return Picture("on_record", caption, drawn, car.footer)


def table(car: OnRecord, names: dict[float, str]) -> Table:
    """The same in numbers."""
    rows = []
    for case in car.cases:
        cells = []
        for yaw in car.yaws:
            time = car.time_s(case, yaw)
            shown = f"{time:.0f} s" if np.isfinite(time) else "never"
            cells.append(f"{100 * car.settled(case, yaw):.0f} %, {shown}")
        rows.append([case, *cells])
    header = ["resets", *(f"from {names[yaw]} deg" for yaw in car.yaws)]
    note = f"Start times of {car.grid.draws} that settle, and median settling time."
    return Table("On the record", header, rows, note)
