"""Tables of the experiments: why resets fail on a moving base, where they win, who loses when."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis import Estimate, mean
from sinsjax.analysis.formats import format_degrees
from sinsjax.execution.source import Source
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page

from ..common.grids import Grid, grid_of
from ..common.words import arcmin
from .field import (
    MOST,
    STORED_S,
    Base,
    Cell,
    Field,
    Start,
    angle,
    bases_of,
    brief,
    reach,
    start_samples,
)

HALF = 0.5


class Experiment:
    """The cases of a study over starts and bases, by heading error."""

    def __init__(self, source: Source, *columns: str, **axes: Sequence[object]) -> None:
        self.source = source
        self.grid: Grid = grid_of(
            source, [*columns, "floor_arcmin"], case="case", start=start_samples(source), **axes
        )

    def errors(self, column: str, *, from_floor: bool = False, **points: object) -> NDArray:
        """Heading errors (..., draws) from truth or from the bias floor, arcmin."""
        error = self.grid.at(column, **points)
        if from_floor:
            error = error - self.grid.at("floor_arcmin", **points)
        return np.nan_to_num(np.abs(error), nan=np.inf)

    def reach(
        self, column: str, share: float = HALF, *, from_floor: bool = False, **points: object
    ) -> Estimate:
        """What a share of some runs stays below, arcmin."""
        return reach(self.errors(column, from_floor=from_floor, **points), share)


MODEST: Start = (5.0, 5.0, 30.0)
LARGE: Start = (20.0, 20.0, 120.0)
SHIFTS = ("three resets", *(f"three resets, {shift} s later" for shift in (0.25, 0.5, 0.75)))


def resets(source: Source) -> Page:
    """Variations of three resets on four bases: force, what is reset, and when."""
    run = Experiment(source, "phi_u_at_300_arcmin", base=bases_of(source))
    bases: dict[str, Base] = {base.words: base for base in run.grid.axes["base"]}

    def median(case: str, base: str, start: Start) -> Estimate:
        return run.reach(
            "phi_u_at_300_arcmin", from_floor=True, case=case, base=bases[base], start=start
        )

    starts = run.grid.axes["start"]
    rows = [
        [case, *(angle(median(case, base, start)) for start in starts for base in bases)]
        for case in run.grid.axes["case"]
    ]
    header = [f"{base}, {format_degrees(*start)}" for start in starts for base in bases]
    note = "Median from the bias floor."
    title = "All resets"
    table = Table(title, ["resets", *header], rows, note, folded=True)
    surge = {
        name: median(case, "sway and surge", MODEST)
        for name, case in {
            "three": "three resets",
            "gravity_three": "three resets, gravity",
            "gravity": "no reset, gravity",
            "level": "three resets, level to 0.1 deg",
            "sincos": "kalman_sincos",
            "sincos_three": "kalman_sincos, three resets",
        }.items()
    }
    shifted = [median(case, "sway with a lever arm", MODEST) for case in SHIFTS]
    large = [median(case, "sway", LARGE) for case in SHIFTS]
    still, moving = (
        median(f"three resets, {when}", "sway with a lever arm", MODEST)
        for when in ("still", "moving")
    )
    wide = {
        name: median("wide prior, triggered resets", base, MODEST)
        for name, base in {
            "sway": "sway",
            "lever": "sway with a lever arm",
            "surge": "sway and surge",
        }.items()
    }
    claims = {
        "a trigger with a wide prior fails when the base moves": (
            wide["sway"].high < 10 < 60 < min(wide["lever"].low, wide["surge"].low)
        ),
        "under surge resets fail by the force in A(t) and by the P they reopen": (
            surge["three"].low > 3 * surge["gravity_three"].high
            and surge["gravity_three"].low > 2 * surge["gravity"].high
        ),
        "resets ruin the filter that needs none": surge["sincos_three"].low > surge["sincos"].high,
        "a small level reset hardly helps": surge["level"].value > surge["three"].value / 2,
        "resets while still are no cure": still.low > moving.high,
        "the phase decides with a lever arm": (
            max(one.low for one in shifted) > 5 * min(one.high for one in shifted)
        ),
        "the phase decides from a large misalignment": (
            max(one.low for one in large) > 5 * min(one.high for one in large)
        ),
    }
    values = {
        "surge": {name: brief(one) for name, one in surge.items() if name != "level"},
        "shifted": {
            "least": brief(min(shifted)),
            "most": brief(max(shifted)),
            "large_least": brief(min(large)),
            "large_most": brief(max(large)),
        },
    }
    return Page({"why": values}, {"resets": table}, claims=claims)


def passes(source: Source, field: Field, grade: float) -> Page:
    """Passes over a stored record, and one pass of methods that need no start."""
    run = Experiment(source, "phi_u_arcmin", base=bases_of(source))
    bases: dict[str, Base] = {base.words: base for base in run.grid.axes["base"]}

    def ends(case: str, base: str) -> Estimate:
        return run.reach("phi_u_arcmin", MOST, case=case, base=bases[base])

    starts = run.grid.axes["start"]
    rows = [[case, *(angle(ends(case, base)) for base in bases)] for case in run.grid.axes["case"]]
    note = f"90 % of the runs, {len(starts)} misalignments."
    title = "All passes"
    table = Table(title, ["record and method", *bases], rows, note, folded=True)
    stored = f"{STORED_S} s: "
    rewound = [ends(f"{stored}kalman5, {n} passes, rewound, P reset", "sway") for n in (2, 3, 4)]
    once = ends(f"{stored}kalman5, 1 pass", "sway")
    sincos = ends(f"{stored}kalman_sincos, 1 pass", "sway")
    cell = Cell(tuple(starts), field.bases["sway"], grade, STORED_S)
    optimised = reach(field.errors("optimisation", cell))
    claims = {
        "passes repair the plain filter": rewound[-1].high < once.low,
        "after them it is near the filter that needs none": rewound[-1].low < 2 * sincos.high,
    }
    values = {
        "once": brief(once),
        "four": brief(rewound[-1]),
        "sincos": brief(sincos),
        "optimisation": angle(optimised),
    }
    return Page({"stored": values}, {"stored": table}, claims=claims)


LONG_S = (60, 120, 300, 600, 1200, 1800)


def turning(source: Source) -> Page:
    """Bias states on a vehicle that turns, for half an hour."""
    study = source.study
    run = Experiment(
        source,
        *(f"phi_u_at_{t}_arcmin" for t in LONG_S),
        turns=[value > 0 for value in study.values("yaw_amplitude_deg")],
        wanders=[float(np.max(value)) > 0 for value in study.values("gyro_instability_deg_per_h")],
    )

    def median(case: str, time_s: int, *, turns: bool) -> Estimate:
        return run.reach(f"phi_u_at_{time_s}_arcmin", case=case, turns=turns, wanders=True)

    rows = [
        [
            case,
            "turns" if turns else "parked",
            *(angle(median(case, t, turns=turns)) for t in LONG_S),
        ]
        for case in run.grid.axes["case"]
        for turns in (False, True)
    ]
    note = "Median from true north, with bias instability."
    header = ["method", "vehicle", *(f"{t} s" for t in LONG_S)]
    table = Table("Bias states", header, rows, note, folded=True)
    primed, sincos = "kalman10, primed, matched", "kalman_sincos"
    claims = {
        "on a vehicle that turns, bias states pay": (
            median(primed, 1800, turns=True).high < median(sincos, 1800, turns=True).low
        ),
        "on a parked one they do not": (
            median("kalman10", 1800, turns=False).high > median(sincos, 1800, turns=False).low
        ),
        "a matched filter with bias states loses its heading when parked": (
            median(primed, 1800, turns=False).low > median(sincos, 1800, turns=False).high
        ),
    }
    values = {
        "primed": brief(median(primed, 1800, turns=True)),
        "sincos": brief(median(sincos, 1800, turns=True)),
        "optimisation": brief(median("optimisation", 1800, turns=True)),
        "lost": brief(median(primed, 1800, turns=False)),
    }
    return Page({"turning": values}, {"turning": table}, claims=claims)


CAR_S = 300


def car(source: Source) -> Page:
    """Every method on the recorded car; no interval, the runs share one record."""
    column = f"phi_u_at_{CAR_S}_arcmin"
    run = Experiment(source, column)

    def median(case: str, start: Start) -> Estimate:
        errors = run.errors(column, case=case, start=start)
        return Estimate(float(np.median(errors)), np.nan, np.nan, errors.size)

    starts = run.grid.axes["start"]
    rows = [
        [case, *(angle(median(case, start)) for start in starts)] for case in run.grid.axes["case"]
    ]
    note = (
        f"Median from a smoother on the same record after {CAR_S} s, {run.grid.draws} start times,"
        " misaligned on purpose after 60 s of coarse alignment."
    )
    header = ["method", *(format_degrees(*start) for start in starts)]
    table = Table("All methods", header, rows, note, folded=True)
    cases = {
        "three": "kalman5, three resets",
        "sincos": "kalman_sincos",
        "position": "optimisation_position",
    }
    modest, large = (
        {name: angle(median(case, start)) for name, case in cases.items()}
        for start in (MODEST, LARGE)
    )
    plain = {
        "modest": angle(median("kalman5", MODEST)),
        "large": angle(median("kalman5", LARGE)),
    }
    claims = {"on the car only the plain filter depends on the start": modest == large}
    return Page({"car": {"plain": plain, **modest}}, {"car": table}, claims=claims)


PSINS = {
    "inertial": ("aligni0", "26.3", "26.3"),
    "optimisation": ("alignWahba", "26.2", "26.2"),
    "ekf_azimuth": ("alignvn_ekf", "26.1", "26.1"),
    "compass": ("aligncmps", "23.2", "23.0"),
}
"""What published functions gave: mean heading error from 800 to 900 s, still and swinging, arcmin.

PSINS 2024.11.09 (commit c1706f13) in Octave 7.3, one noise seed; its sign is that of the estimate.
"""


def psins(source: Source) -> Page:
    """The same conditions as those functions were run on."""
    sway = [value > 0 for value in source.study.values("pitch_amplitude_deg")]
    grid = grid_of(source, ["phi_u_mean_arcmin"], case="case", sways=sway)
    rows = []
    for case in grid.axes["case"]:
        name, *theirs = PSINS.get(case, ("-", "-", "-"))
        ours = (
            arcmin(mean(-grid.at("phi_u_mean_arcmin", case=case, sways=sways)))
            for sways in (False, True)
        )
        rows.append([case, *ours, name, *theirs])
    scatter = float(np.std(grid.at("phi_u_mean_arcmin", case="compass", sways=False), ddof=1))
    header = ["here", "still", "swinging", "PSINS", "still (arcmin)", "swinging (arcmin)"]
    note = (
        "Mean error (estimate less truth) from 800 to 900 s, paper 1's conditions, (5, 5, 30) deg,"
        f" {grid.draws} draws; PSINS one draw, its alignvn with another prior of bias states, the"
        f" compass with times of 20, 30 and 300 s; single runs scatter by {scatter:.1f} arcmin."
    )
    table = Table("All functions", header, rows, note, folded=True)
    return Page({}, {"psins": table})
