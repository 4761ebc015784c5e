"""Numbers of the page on turning bases: bounds, the fit against them, what mounting costs."""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.bounds.turn_planner import TurnChoice
from sinsjax.execution.source import Source
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources
from sinsjax.study.study import Study

from ..common.grids import grid_of
from ..common.words import arcmin
from .figures import Curve, draw_errors

PARKED, HALF, CAROUSEL = "parked", "one half turn", "reversing carousel"
MOTIONS = (PARKED, HALF, CAROUSEL)
OFF_AXIS, OFF_AXIS_UNKNOWN = "half turn, 6 cm off the axis", "half turn, 6 cm off the axis, unknown"
TILTED, TILT_DEG = "half turn, axis tilted by 5 deg", 5.0
GRADES = {"turning_0_01": "0.01 deg/h", "turning_0_1": "0.1 deg/h", "turning_1": "1 deg/h"}
SHOWN_S = 300.0
TURN_S = 150.0  # middle of the half turn
CURVE_S: tuple[int, ...] = (
    30,
    35,
    42,
    50,
    60,
    72,
    85,
    100,
    120,
    140,
    145,
    150,
    155,
    160,
    165,
    172,
    180,
)
CURVE_S += (195, 210, 230, 255, 280, 300, 340, 390, 450, 520)
EARTH_RATE_DEG_PER_H = 15.041067
MRAD = 60 * math.degrees(1e-3)  # arcmin


class Sensors(NamedTuple):
    """Sensors of the table."""

    name: str
    gyro_bias_deg_per_h: float
    gyro_arw_deg_per_sqrt_h: float
    accel_bias_ug: float
    accel_vrw_ug_per_sqrt_hz: float


SENSORS = (
    Sensors("laser gyro", 0.003, 0.001, 25.0, 10.0),
    Sensors("navigation grade", 0.01, 0.001, 50.0, 10.0),
    Sensors("fibre-optic gyro", 0.1, 0.005, 200.0, 30.0),
    Sensors("tactical grade", 1.0, 0.02, 500.0, 50.0),
    Sensors("MEMS", 10.0, 0.15, 1000.0, 120.0),
)
LATITUDE_DEG = 45.0
SPANS_S = (300.0, 600.0)
SHORTEST_S = 40.0  # of a half turn at 10 deg/s with its ramps, and as long before and after
SCALE = {"gyro_scale_ppm": 300.0, "gyro_misalignment_arcsec": 206.265}

ALLAN_DEG_PER_H, UC_MRAD, UC_POINTS, IRVINE_DEG = 0.2, 4.0, 100, 33.64
"""Prikhodko et al., What is MEMS Gyrocompassing? (2013), abstract; Irvine's latitude."""


def page(sources: Sources) -> Page:
    """The three grades over time, five sensors planned, mounting, scale factors and two anchors."""
    grades = {name: _measured(sources[name]) for name in GRADES}
    return Page.merge(
        _over_time(sources, grades),
        _planned(),
        _mounting(sources, grades),
        _scale(sources["turning_scale"]),
        _kalman10(sources["turning_kalman10"]),
        _psins(sources["turning_psins"]),
        _uc_irvine(),
    )


def _measured(source: Source) -> dict[str, dict[float, Estimate]]:
    """Return the rms heading error by case and time, the end included, arcmin."""
    study = source.study
    times = {time: f"phi_u_at_{time:g}_arcmin" for time in study.report_times_s}
    times[study.duration_s] = "phi_u_arcmin"
    grid = grid_of(source, tuple(times.values()), case="case")
    return {
        case: {time: analysis.rms(grid.at(name, case=case)) for time, name in times.items()}
        for case in grid.axes["case"]
    }


def _bounds(study: Study, times_s: Sequence[float] = ()) -> dict[str, NDArray]:
    """Return the information bound by case, (times and end,), arcmin."""
    study = study.replace({"study.report_times_s": list(times_s)}) if times_s else study
    columns = sinsjax.information_bound(study).to_pydict()
    variants = np.array(columns["variant_id"])
    bounds = np.array(columns["bound_u_arcmin"])
    return {case: bounds[variants == k] for k, case in enumerate(study.values("case"))}


def _over_time(
    sources: Sources, grades: Mapping[str, Mapping[str, Mapping[float, Estimate]]]
) -> Page:
    """The figure, and how far the fit is from the bound."""
    panels, squares = {}, []
    for name, title in GRADES.items():
        study = sources[name].study
        bound = _bounds(study, CURVE_S)
        at = _bounds(study)
        panels[title] = [Curve(case, bound[case], _points(grades[name], case)) for case in MOTIONS]
        for case in MOTIONS:
            errors = _final_errors(sources[name], case)
            squares.append((errors / at[case][-1]) ** 2)
    ratio = analysis.rms(np.sqrt(np.concatenate(squares)))
    tactical = grades["turning_1"]
    values = {
        "parked": arcmin(tactical[PARKED][SHOWN_S], 0),
        "half": arcmin(tactical[HALF][SHOWN_S], 0),
        "carousel": arcmin(tactical[CAROUSEL][SHOWN_S], 0),
        "ratio": f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]",
    }
    claims = {
        "a half turn is far better than parked": (
            tactical[PARKED][SHOWN_S].low > 8 * tactical[HALF][SHOWN_S].high
        ),
        "the fit attains the bound": ratio.low < 1.02 and ratio.high < 1.15,
    }
    caption = (
        "Lines: information bound, biases drawn with the 1 sigma above each panel. Points: rms of"
        f" `gravity_fit` over {sources['turning_1'].draws} draws, 95 % interval. The half turn"
        " begins at 140.5 s; latitude 45 deg."
    )
    times = np.array([*CURVE_S, sources["turning_1"].study.duration_s])
    figure = draw_errors(times, panels)
    text = f"{len(GRADES)} studies, {sources['turning_1'].draws} Monte Carlo runs per point"
    return Page(values, figures={"errors": Picture("errors", caption, figure, text)}, claims=claims)


def _points(measured: Mapping[str, Mapping[float, Estimate]], case: str) -> dict[float, Estimate]:
    """Return the points of a case to draw: before its turn it is the parked base."""
    return {t: rms for t, rms in measured[case].items() if case != HALF or t > TURN_S}


def _final_errors(source: Source, case: str) -> NDArray:
    """Return the heading errors at the end, (draws,), arcmin."""
    return grid_of(source, ("phi_u_arcmin",), case="case").at("phi_u_arcmin", case=case)


@cache
def _plan(sensors: Sensors, duration_s: float, *, scale: bool = False) -> TurnChoice:
    return sinsjax.plan_turns(
        **{key: value for key, value in sensors._asdict().items() if key != "name"},
        latitude_deg=LATITUDE_DEG,
        duration_s=duration_s,
        **(SCALE if scale else {}),
    )


def _planned() -> Page:
    """Five sensors: parked, half turn and the best, and when a half turn begins to pay."""
    rows, full_rows, pays = [], [], {}
    for sensors in SENSORS:
        cells = []
        for span in SPANS_S:
            plain, full = _plan(sensors, span), _plan(sensors, span, scale=True)
            for k in (0, 1):
                both = [_digits(choice.options[k].sigma_arcmin) for choice in (plain, full)]
                cells.append("/".join(both))
            cells.append(_digits(full.best.sigma_arcmin))
        pays[sensors.name] = _pays_from(sensors)
        shortest = f"{pays[sensors.name]:.0f} s"
        name = f"{sensors.name}, {sensors.gyro_bias_deg_per_h:g} deg/h"
        noise = [f"{value:g}" for value in sensors[2:]]
        rows.append([name, *cells, shortest])
        full_rows.append([name, *noise, *cells, shortest])
    motions = ("parked", "half turn", "best*")
    short = ["gyros", *motions, "pays from"]
    kept = [0, *range(1, 1 + len(motions)), -1]
    note = (
        "Least heading error, 1 sigma, arcmin, at 45 deg: scale factors and axes known/unknown to"
        f" 300 ppm and 1 mrad. *Of five motions, unknown: the {CAROUSEL}."
    )
    table = Table(
        f"Five sensors, {SHOWN_S:g} s", short, [[row[k] for k in kept] for row in rows], note
    )
    header = [
        *("gyros", "gyro ARW (deg/sqrt(h))", "accel bias (ug)", "accel VRW (ug/sqrt(Hz))"),
        *(f"{motion}, {span:g} s" for span in SPANS_S for motion in motions),
        "half turn pays from",
    ]
    title = f"{SPANS_S[-1]:g} s too, and the noise"
    sensors_table = Table(title, header, full_rows, folded=True)
    laser, fog = SENSORS[0], SENSORS[2]
    at_60_s = [option.sigma_arcmin for option in _plan(laser, 60.0).options]
    values = {
        "laser": {
            "parked": f"{at_60_s[0]:.1f}",
            "half": f"{at_60_s[1]:.1f}",
        },
    }
    best = {_plan(s, t, scale=True).best.name for s in SENSORS for t in SPANS_S}
    claims = {
        "the laser gyro's half turn does not pay at 60 s": at_60_s[0] < at_60_s[1],
        "with a fibre-optic gyro a half turn pays after a minute": pays[fog.name] <= 60,
        "the reversing carousel is the best of all": best == {CAROUSEL},
    }
    return Page(values, {"planned": table, "sensors": sensors_table}, claims=claims)


def _pays_from(sensors: Sensors) -> float:
    """Return the time from which a half turn is better than a parked base, s, to 10 s."""
    low, high = SHORTEST_S, 1000.0
    while high - low > 10:
        middle = 10.0 * round((low + high) / 20)
        parked, half = _plan(sensors, middle).options[:2]
        low, high = (low, middle) if half.sigma_arcmin < parked.sigma_arcmin else (middle, high)
    return high


def _digits(sigma_arcmin: float) -> str:
    return f"{sigma_arcmin:.1f}" if sigma_arcmin < 10 else f"{sigma_arcmin:.0f}"


def _mounting(
    sources: Sources, grades: Mapping[str, Mapping[str, Mapping[float, Estimate]]]
) -> Page:
    """A lever arm, known to the fit or not, and a tilted axis."""
    fog = {case: by_time[SHOWN_S] for case, by_time in grades["turning_0_1"].items()}
    factor = fog[OFF_AXIS].value / fog[HALF].value
    rate = EARTH_RATE_DEG_PER_H * math.cos(math.radians(LATITUDE_DEG))
    added = 60 * math.degrees(math.sin(math.radians(TILT_DEG)) / rate)
    tilted = grades["turning_1"][TILTED][SHOWN_S]
    index = list(sources["turning_1"].study.report_times_s).index(SHOWN_S)
    bound = _bounds(sources["turning_1"].study)
    values = {
        "lever": {
            "none": arcmin(fog[HALF]),
            "ignored": arcmin(fog[OFF_AXIS], 0),
            "unknown": arcmin(fog[OFF_AXIS_UNKNOWN]),
        },
        "tilt": {
            "level": f"{bound[HALF][index]:.0f}",
            "tilted": f"{bound[TILTED][index]:.0f}",
            "added": f"{added:.0f}",
            "measured": arcmin(tilted, 0),
        },
    }
    claims = {
        "a lever arm that the fit does not know costs a factor of three": factor > 3,
        "as an unknown it costs little": (fog[OFF_AXIS_UNKNOWN].value < 1.25 * fog[HALF].value),
        "the bias along a tilted axis adds as predicted": (
            abs(math.hypot(bound[HALF][index], added) / bound[TILTED][index] - 1) < 0.05
        ),
    }
    return Page(values, claims=claims)


def _scale(source: Source) -> Page:
    """Scale factors: in the mean direction, half a turn from it, and without reversing."""
    measured, bound = _measured(source), _bounds(source.study)
    away, end = source.study.report_times_s[0], source.study.duration_s
    one_way = "one-way carousel"
    values = {
        "scale": {
            "end": arcmin(measured[CAROUSEL][end]),
            "away": arcmin(measured[CAROUSEL][away]),
            "end_bound": f"{bound[CAROUSEL][-1]:.1f}",
            "away_bound": f"{bound[CAROUSEL][0]:.1f}",
            "one_way": arcmin(measured[one_way][end], 0),
            "four": f"{bound['four positions'][-1]:.1f}",
            "half": f"{bound[HALF][-1]:.1f}",
        }
    }
    claims = {
        "the mean direction is the better end": bound[CAROUSEL][-1] < 0.95 * bound[CAROUSEL][0],
        "a carousel must reverse": measured[one_way][end].low > measured[CAROUSEL][end].high,
    }
    return Page(values, claims=claims)


def _kalman10(source: Source) -> Page:
    """The filter with bias states on the same bases."""
    measured, bound = _measured(source), _bounds(source.study)
    end = source.study.duration_s
    values = {
        "kalman10": {
            "half": arcmin(measured[HALF][end]),
            "bound": f"{bound[HALF][-1]:.1f}",
            "carousel": arcmin(measured[CAROUSEL][end], 0),
        }
    }
    claims = {
        "kalman10 bears one half turn": measured[HALF][end].value < 1.7 * bound[HALF][-1],
        "kalman10 fails on a carousel with scale factors": (
            measured[CAROUSEL][end].low > 3 * bound[CAROUSEL][-1]
        ),
    }
    return Page(values, claims=claims)


def _psins(source: Source) -> Page:
    """PSINS's example of two positions."""
    measured, bound = _measured(source), _bounds(source.study)
    end = source.study.duration_s
    values = {
        "psins": {
            "parked": f"{bound['parked'][-1]:.1f}",
            "bound": f"{bound['two positions'][-1]:.2f}",
            "measured": arcmin(measured["two positions"][end], 2),
        }
    }
    ratio = measured["two positions"][end].value / bound["two positions"][-1]
    return Page(values, claims={"the fit attains the bound of PSINS's example": ratio < 1.25})


def _uc_irvine() -> Page:
    """What the published Allan deviation allows one half turn, and what their carousel reached."""
    rate = EARTH_RATE_DEG_PER_H * math.cos(math.radians(IRVINE_DEG))
    half_turn = 1e3 * ALLAN_DEG_PER_H / (math.sqrt(2) * rate)
    values = {
        "irvine": {
            "reached": f"{UC_MRAD * MRAD:.0f}",
            "half": f"{half_turn * MRAD:.0f}",
            "points": UC_POINTS,
            "allan": f"{ALLAN_DEG_PER_H:g}",
        }
    }
    return Page(values, claims={"a half turn alone does not reach 4 mrad": half_turn > UC_MRAD})
