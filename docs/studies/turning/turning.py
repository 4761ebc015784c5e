"""Table, figure and numbers of docs/turning.md.

    python -m docs.studies.turning.turning DIR... [-o FOLDER]

The directories have the results of turning_0_01, turning_0_1, turning_1, turning_scale,
turning_kalman10 and turning_psins. Bounds and plans are computed here.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

import sinsjax
from docs.studies.common import Page, Runs, read_arguments
from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.plots.style import with_style

PARKED, HALF, CAROUSEL = "parked", "one half turn", "reversing carousel"
ONE_WAY, FOUR, TWO = "one-way carousel", "four positions", "two positions"
OFF_AXIS, UNKNOWN = "half turn, 6 cm off the axis", "half turn, 6 cm off the axis, unknown"
TILTED, TILT_DEG = "half turn, axis tilted by 5 deg", 5.0
GRADES = {"turning_0_01": "0.01 deg/h", "turning_0_1": "0.1 deg/h", "turning_1": "1 deg/h"}
SHOWN_S, SPANS_S, LATITUDE_DEG = 300.0, (300.0, 600.0), 45.0
TURN_S, SHORTEST_S = 150.0, 40.0  # middle of the half turn; shortest span that has room for one
CURVE_S = [30, 35, 42, 50, 60, 72, 85, 100, 120, 140, 145, 150, 155, 160, 165, 172, 180, 195]
CURVE_S += [210, 230, 255, 280, 300, 340, 390, 450, 520]
EARTH_RATE_DEG_PER_H = 15.041067
ERROR_TICKS = (1, 3, 10, 30, 100, 300)  # arcmin
SCALE = {"gyro_scale_ppm": 300.0, "gyro_misalignment_arcsec": 206.265}
ALLAN_DEG_PER_H, REACHED_MRAD, IRVINE_DEG = 0.2, 4.0, 33.64
"""Prikhodko et al., What is MEMS Gyrocompassing? (2013), abstract; Irvine's latitude."""


class Sensors(NamedTuple):
    """Sensors of the table."""

    gyro_bias_deg_per_h: float
    gyro_arw_deg_per_sqrt_h: float
    accel_bias_ug: float
    accel_vrw_ug_per_sqrt_hz: float


SENSORS = {
    "laser gyro": Sensors(0.003, 0.001, 25.0, 10.0),
    "navigation grade": Sensors(0.01, 0.001, 50.0, 10.0),
    "fibre-optic gyro": Sensors(0.1, 0.005, 200.0, 30.0),
    "tactical grade": Sensors(1.0, 0.02, 500.0, 50.0),
    "MEMS": Sensors(10.0, 0.15, 1000.0, 120.0),
}


def errors_of(runs: Runs, case: str, time_s: float) -> NDArray:
    """Return heading errors of a case at a time, (draws,), arcmin."""
    at = "" if time_s == runs.end_s else f"_at_{time_s:g}"
    return runs.grid(f"phi_u{at}_arcmin", case="case").at(case=case)


def rms_of(runs: Runs, case: str, time_s: float) -> Estimate:
    """Return the rms heading error of a case at a time, arcmin."""
    return analysis.rms(errors_of(runs, case, time_s))


def arcmin(one: Estimate, digits: int = 1) -> str:
    """Return an estimate as text."""
    return format_estimate(one, "arcmin", digits)


def bounds_of(runs: Runs, times_s: Sequence[float] = ()) -> dict[str, dict[float, float]]:
    """Return the information bound by case and time, arcmin."""
    changes = {"study.report_times_s": [*times_s]} if times_s else {}
    rows = sinsjax.information_bound(runs.study.replace(changes)).to_pylist()
    names, bounds = runs.study.values("case"), dict[str, dict[float, float]]()
    for row in rows:
        bounds.setdefault(names[row["variant_id"]], {})[row["time_s"]] = row["bound_u_arcmin"]
    return bounds


def over_time(grades: Mapping[str, Runs], page: Page) -> None:
    """Print what turns gain and how far the fit is from its bound, and draw both."""
    squares = []
    for runs in grades.values():
        bound = bounds_of(runs)
        squares += [
            (errors_of(runs, case, runs.end_s) / bound[case][runs.end_s]) ** 2
            for case in (PARKED, HALF, CAROUSEL)
        ]
    tactical = grades["turning_1"]
    page.print_numbers(
        **{case: arcmin(rms_of(tactical, case, SHOWN_S), 0) for case in (PARKED, HALF, CAROUSEL)},
        over_bound=format_estimate(analysis.rms(np.sqrt(np.concatenate(squares))), digits=2),
    )
    footer = f"{len(grades)} studies, {tactical.draws} Monte Carlo runs per point"
    page.figure("turning_errors", draw_errors(grades), footer)


@with_style
def draw_errors(grades: Mapping[str, Runs]) -> Figure:
    """Draw bounds as lines and measured errors as points, in a panel per grade."""
    figure = Figure(figsize=(9.5, 4.0))
    figure.suptitle("One half turn breaks the bias floor, a carousel never meets it")
    panels = figure.subplots(1, len(grades), sharex=True, sharey=True)
    for axes, (name, runs) in zip(panels, grades.items(), strict=True):
        bounds = bounds_of(runs, CURVE_S)
        for case, colour in zip((PARKED, HALF, CAROUSEL), plots.COLOURS, strict=False):
            axes.plot([*bounds[case]], [*bounds[case].values()], color=colour, label=case)
            for time_s in (*(runs.study.study.report_times_s or ()), runs.end_s):
                if case == HALF and time_s < TURN_S:
                    continue  # parked until then
                rms = rms_of(runs, case, time_s)
                reach = [[rms.value - rms.low], [rms.high - rms.value]]
                style = {"fmt": "o", "markersize": 4, "linewidth": 1.2, "color": colour}
                axes.errorbar(time_s, rms.value, reach, **style)
        axes.set(xscale="log", yscale="log", xlabel="time (s)", title=GRADES[name])
        for axis, ticks in ((axes.xaxis, (30, 60, 120, 300, 600)), (axes.yaxis, ERROR_TICKS)):
            axis.set_major_locator(FixedLocator(ticks))
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    panels[0].set_ylabel("heading error, 1 sigma (arcmin)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@cache
def plan(name: str, duration_s: float, *, scale: bool = False) -> sinsjax.TurnChoice:
    """Return the planned turns of sensors: parked, one half turn and others."""
    known = SENSORS[name]._asdict() | (SCALE if scale else {})
    return sinsjax.plan_turns(**known, latitude_deg=LATITUDE_DEG, duration_s=duration_s)


def pays_from(name: str) -> float:
    """Return the time from which a half turn is better than a parked base, s, to 10 s."""
    low, high = SHORTEST_S, 1000.0
    while high - low > 10:
        middle = 10.0 * round((low + high) / 20)
        parked, half = plan(name, middle).options[:2]
        low, high = (low, middle) if half.sigma_arcmin < parked.sigma_arcmin else (middle, high)
    return high


def planned(page: Page) -> None:
    """Write what parked bases, half turns and the best turns leave, and when a turn pays."""

    def digits(sigma_arcmin: float) -> str:
        return f"{sigma_arcmin:.1f}" if sigma_arcmin < 10 else f"{sigma_arcmin:.0f}"

    short, rows = [], []
    for name, sensors in SENSORS.items():
        cells = []
        for span in SPANS_S:
            choices = plan(name, span), plan(name, span, scale=True)
            for k in (0, 1):
                cells.append("/".join(digits(one.options[k].sigma_arcmin) for one in choices))
            cells.append(digits(choices[1].best.sigma_arcmin))
        title = f"{name}, {sensors.gyro_bias_deg_per_h:g} deg/h"
        pays = f"{pays_from(name):.0f} s"
        short.append([title, *cells[:3], pays])
        rows.append([title, *(f"{value:g}" for value in sensors[1:]), *cells, pays])
    motions = ("parked", "half turn", "best*")
    page.show(f"Five sensors, {SHOWN_S:g} s", ["gyros", *motions, "pays from"], short)
    header = ["gyros", "gyro ARW (deg/sqrt(h))", "accel bias (ug)", "accel VRW (ug/sqrt(Hz))"]
    header += [f"{motion}, {span:g} s" for span in SPANS_S for motion in motions]
    page.table("turning_sensors", [*header, "half turn pays from"], rows)
    laser = [f"{one.sigma_arcmin:.1f}" for one in plan("laser gyro", 60.0).options[:2]]
    best = {plan(name, span, scale=True).best.name for name in SENSORS for span in SPANS_S}
    page.print_numbers(best_of_all=", ".join(best), laser_60_s=" parked, ".join(laser) + " turned")


def mounting(grades: Mapping[str, Runs], page: Page) -> None:
    """Print what a lever arm costs, known to the fit or not, and a tilted axis."""
    fog = {case: rms_of(grades["turning_0_1"], case, SHOWN_S) for case in (HALF, OFF_AXIS, UNKNOWN)}
    bound = bounds_of(grades["turning_1"])
    rate = EARTH_RATE_DEG_PER_H * math.cos(math.radians(LATITUDE_DEG))
    page.print_numbers(
        lever_none=arcmin(fog[HALF]),
        lever_ignored=arcmin(fog[OFF_AXIS], 0),
        lever_unknown=arcmin(fog[UNKNOWN]),
        tilt_adds=f"{60 * math.degrees(math.sin(math.radians(TILT_DEG)) / rate):.0f}",
        tilt_bounds=f"{bound[HALF][SHOWN_S]:.0f} to {bound[TILTED][SHOWN_S]:.0f}",
        tilt_measured=arcmin(rms_of(grades["turning_1"], TILTED, SHOWN_S), 0),
    )


def others(scale: Runs, kalman10: Runs, psins: Runs, page: Page) -> None:
    """Print what scale factors cost, the filter on these bases, and the two references."""
    bound, away, end = bounds_of(scale), 285.0, scale.end_s
    page.print_numbers(
        scale_end=f"{arcmin(rms_of(scale, CAROUSEL, end))}, bound {bound[CAROUSEL][end]:.1f}",
        scale_away=f"{arcmin(rms_of(scale, CAROUSEL, away))}, bound {bound[CAROUSEL][away]:.1f}",
        scale_one_way=arcmin(rms_of(scale, ONE_WAY, end), 0),
        scale_bounds=f"half turn {bound[HALF][end]:.1f}, four positions {bound[FOUR][end]:.1f}",
    )
    bound, end = bounds_of(kalman10), kalman10.end_s
    page.print_numbers(
        kalman10_half=f"{arcmin(rms_of(kalman10, HALF, end))}, bound {bound[HALF][end]:.1f}",
        kalman10_carousel=arcmin(rms_of(kalman10, CAROUSEL, end), 0),
    )
    bound, end = bounds_of(psins), psins.end_s
    rate = EARTH_RATE_DEG_PER_H * math.cos(math.radians(IRVINE_DEG))
    half_mrad, mrad = 1e3 * ALLAN_DEG_PER_H / (math.sqrt(2) * rate), 60 * math.degrees(1e-3)
    page.print_numbers(
        psins_bounds=f"parked {bound[PARKED][end]:.1f}, turned {bound[TWO][end]:.2f}",
        psins_measured=arcmin(rms_of(psins, TWO, end), 2),
        irvine=f"{REACHED_MRAD * mrad:.0f} arcmin, one half turn {half_mrad * mrad:.0f}",
    )


def main() -> None:
    """Write the table and the figure."""
    more = ("turning_scale", "turning_kalman10", "turning_psins")
    runs, page = read_arguments(__doc__, (*GRADES, *more))
    scale, kalman10, psins = (runs[name] for name in more)
    grades = {name: runs[name] for name in GRADES}
    over_time(grades, page)
    planned(page)
    mounting(grades, page)
    others(scale, kalman10, psins, page)


if __name__ == "__main__":
    main()
