"""Draws the figures of docs/concepts: ``python docs/figures/concepts.py [NAME...]``.

Each is a small study of its own, of seconds, in one plain figure.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

import sinsjax
from sinsjax.plots.style import GREY, add_legend_below, line_colour, render_png, with_style
from sinsjax.study.study import Study

_WIDE, _HIGH = 8.4, 3.7  # in


def _paper1(**sections: dict[str, Any]) -> Study:
    """Base, sensors and filter of paper 1, with other values or sections."""
    shipped = sinsjax.load_study("paper1_resets")
    data = {
        "study": {"name": "concept", "duration_s": 300.0, "rate_hz": 100.0, "draws": 1},
        "earth": shipped.earth.model_dump(exclude_none=True),
        "motion": shipped.motion.model_dump(exclude_none=True),
        "sensors": {
            "gyro_bias_deg_per_h": 0.1,
            "gyro_noise_deg_per_h": 0.1,
            "accel_bias_ug": 500.0,
            "accel_noise_ug": 500.0,
        },
        "alignment": {"method": "kalman5", "feedback_interval_s": 1.0},
        "filter": {
            "p0_velocity_m_per_s": 0.1,
            "p0_level_deg": 15.0,
            "p0_yaw_deg": 80.0,
            "q_accel_ug": 500.0,
            "q_gyro_deg_per_h": 0.1,
            "q_reading": "per_step",
            "r_velocity_m_per_s": 0.1,
            "r_reading": "psd",
        },
    }
    for section, values in sections.items():
        data[section] = data.get(section, {}) | values
    return sinsjax.study_from_dict(data)


def _over_time(table: pa.Table, name: str, variants: int) -> tuple[np.ndarray, np.ndarray]:
    """Record times, and a column as (draws, variants, times)."""
    times = np.unique(table["time_s"].to_numpy())
    return times, table[name].to_numpy().reshape(-1, variants, len(times))


def _logarithmic(axes: Axes, ticks: list[float]) -> None:
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(FixedLocator(ticks))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


@with_style
def frames_and_signs() -> Figure:
    """From above: yaw, heading and a positive heading error."""
    figure = Figure(figsize=(_WIDE, 3.7))
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        axes.set(xlim=(-2.7, 2.7), ylim=(-1.1, 2.5), aspect="equal")
        axes.set_axis_off()
        _arrow(axes, 0.0, "north", GREY)
    _arrow(left, -90.0, "east", GREY)
    left.set_title("Attitude: front at yaw +35 deg", loc="center")
    _body(left, 35.0, "#e6e6e6")
    _arrow(left, 35.0, "front", line_colour(0))
    left.add_patch(Arc((0, 0), 2.8, 2.8, theta1=90, theta2=125, color=line_colour(1), lw=2))
    left.text(-0.55, 1.58, "yaw", color=line_colour(1), ha="center")
    left.add_patch(Arc((0, 0), 1.9, 1.9, theta1=125, theta2=450, color=line_colour(2), lw=2))
    left.text(0.95, -0.8, "heading 325 deg", color=line_colour(2), ha="left")
    right.set_title("Misalignment: phi_u = +35 deg", loc="center")
    _body(right, 55.0, "#e6e6e6")
    _arrow(right, 55.0, "true front", line_colour(0), (-0.3, 0.0))
    _arrow(right, 20.0, "computed front", line_colour(3), (-0.6, 0.05))
    right.add_patch(Arc((0, 0), 3.4, 3.4, theta1=110, theta2=145, color=line_colour(1), lw=2))
    right.text(-0.83, 1.02, "phi_u", color=line_colour(1), ha="center")
    return figure


def _arrow(
    axes: Axes, yaw_deg: float, word: str, shade: str, aside: tuple[float, float] = (0.0, 0.0)
) -> None:
    tip = 2.0 * np.array([-np.sin(np.radians(yaw_deg)), np.cos(np.radians(yaw_deg))])
    style = {"arrowstyle": "-|>", "lw": 2.0, "color": shade, "mutation_scale": 15}
    axes.annotate("", tip, (0, 0), arrowprops=style)
    axes.text(*(1.16 * tip + aside), word, ha="center", va="center", color=shade)


def _body(axes: Axes, yaw_deg: float, shade: str) -> None:
    yaw = np.radians(yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    outline = np.array([(-0.35, -0.7), (0.35, -0.7), (0.35, 0.5), (0.0, 0.85), (-0.35, 0.5)])
    axes.add_patch(Polygon(outline @ turn.T, fc=shade, ec=GREY, lw=0.8, zorder=0))


@with_style
def misalignment() -> Figure:
    """What the sensors show of it, beside what a linear model says."""
    figure = Figure(figsize=(_WIDE, _HIGH))
    left, right = figure.subplots(1, 2)
    level, heading = np.linspace(0, 30, 61), np.linspace(0, 180, 181)
    rate_n = 15.041067 * np.cos(np.radians(45.0))  # deg/h
    left.plot(level, np.radians(level), "--", color=GREY, label="small angles")
    left.plot(level, np.sin(np.radians(level)), color=line_colour(0), label="in fact")
    left.set(xlabel="level error (deg)", ylabel="false horizontal force (g)")
    right.plot(heading, rate_n * np.radians(heading), "--", color=GREY, label="small angles")
    right.plot(heading, rate_n * np.sin(np.radians(heading)), color=line_colour(1), label="in fact")
    right.set(xlabel="heading error (deg)", ylabel="Earth rate about east (deg/h)")
    right.set(xlim=(0, 180), ylim=(0, 26), xticks=range(0, 181, 30))
    left.set(xlim=(0, 30), ylim=(0, 0.55))
    for axes, title in ((left, "Level: gravity shows it"), (right, "Heading: Earth rate does")):
        axes.set_title(title)
        axes.legend(loc="upper left")
    return figure


@with_style
def why_p_lies() -> Figure:
    """One run without noise: heading error and sigma, by the force in the model."""
    study = _paper1(
        alignment={"phi_e0_deg": 5.0, "phi_n0_deg": 5.0, "phi_u0_deg": 30.0},
        study={"duration_s": 120.0, "curves": True},
        sensors={"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0},
        axes={"specific_force": ["measured", "gravity"]},
    )
    curves = sinsjax.run(study).curves
    time_s, error = _over_time(curves, "phi_u_arcmin", 2)
    _, sigma = _over_time(curves, "sigma_u_arcmin", 2)
    figure = Figure(figsize=(_WIDE, 4.1))
    titles = ("Measured force in the model", "Gravity in the model")
    for variant, (axes, title) in enumerate(
        zip(figure.subplots(1, 2, sharey=True), titles, strict=True)
    ):
        axes.plot(
            time_s, np.abs(error[0, variant]) / 60, color=line_colour(0), label="heading error"
        )
        axes.plot(
            time_s,
            sigma[0, variant] / 60,
            color=line_colour(1),
            label="1 sigma that the filter believes",
        )
        _logarithmic(axes, [0.3, 1, 3, 10, 30, 100])
        axes.set(title=title, xlabel="time (s)", xlim=(0, 120), ylim=(0.2, 120))
    figure.axes[0].set_ylabel("heading (deg)")
    add_legend_below(figure, figure.axes[0])
    return figure


@with_style
def resets_and_triggers() -> Figure:
    """The same draw of noise without resets, with two, and with a trigger."""
    none: dict[str, Any] = {"reset_times_s": [], "reset_trigger": "none", "trigger_threshold": 0.0}
    ways = {
        "no reset": none,
        "at 10 and 60 s": none | {"reset_times_s": [10.0, 60.0]},
        "by the linearisation trigger": none
        | {"reset_trigger": "linearisation", "trigger_threshold": 1.2},
    }
    study = _paper1(
        alignment={"phi_e0_deg": 5.0, "phi_n0_deg": 5.0, "phi_u0_deg": 60.0},
        study={"curves": True},
        resets={"trigger_refractory_s": 2.0, "trigger_until_s": 150.0},
        axes={"way": {key: [one[key] for one in ways.values()] for key in none}},
    )
    results = sinsjax.run(study)
    time_s, error = _over_time(results.curves, "phi_u_arcmin", 3)
    _, sigma = _over_time(results.curves, "sigma_u_arcmin", 3)
    figure = Figure(figsize=(_WIDE, 4.1))
    left, right = figure.subplots(1, 2)
    for number, label in enumerate(ways):
        left.plot(time_s, np.abs(error[0, number]) / 60, color=line_colour(number), label=label)
        right.plot(time_s, sigma[0, number] / 60, color=line_colour(number))
    for axes, word in ((left, "Heading error (deg)"), (right, "1 sigma in P (deg)")):
        axes.set(title=word, xlabel="time (s)", xlim=(0, 300))
        _logarithmic(axes, [0.3, 1, 3, 10, 30, 100])
        axes.set_ylim(0.2, 120)
    add_legend_below(figure, left)
    return figure


@with_style
def truth_limit_and_bound() -> Figure:
    """Heading errors of 6 draws, the bias floor that they share, and the bound about it."""
    times = [20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 240.0, 300.0]
    study = sinsjax.study_from_dict(
        {
            "study": {
                "duration_s": 300.0,
                "rate_hz": 100.0,
                "draws": 6,
                "curves": True,
                "report_times_s": times[:-1],
            },
            "earth": {"earth": "wgs84", "latitude_deg": 45.0},
            "motion": {"yaw_center_deg": 0.0},
            "sensors": {
                "gyro_bias_deg_per_h": 0.05,
                "gyro_arw_deg_per_sqrt_h": 0.002,
                "accel_bias_ug": 50.0,
                "accel_vrw_ug_per_sqrt_hz": 20.0,
            },
            "alignment": {"method": "inertial"},
        }
    )
    results = sinsjax.run(study)
    bound = sinsjax.information_bound(study)
    floor = results.summary["floor_arcmin"][0].as_py()
    sigma = bound["bound_u_arcmin"].to_numpy()
    figure = Figure(figsize=(_WIDE, _HIGH))
    axes = figure.subplots()
    time_s, errors = _over_time(results.curves, "phi_u_arcmin", 1)
    label = "heading error, 6 draws"
    for error in errors[:, 0]:
        axes.plot(time_s[29:], error[29:], color=line_colour(0), lw=0.8, label=label)
        label = ""
    axes.fill_between(
        times, floor - 2 * sigma, floor + 2 * sigma, color=line_colour(4), alpha=0.35, lw=0,
        label="bias floor ± 2 sigma of the information bound",
    )  # fmt: skip
    axes.axhline(floor, color=line_colour(1), label="bias floor")
    axes.axhline(0.0, color="black", lw=1.2, ls="--", label="true north")
    axes.set(xlabel="time (s)", ylabel="heading error phi_u (arcmin)")
    axes.set(xlim=(30, 300), ylim=(-60, 30))
    add_legend_below(figure, axes)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    one.__name__: one
    for one in (
        frames_and_signs,
        misalignment,
        why_p_lies,
        resets_and_triggers,
        truth_limit_and_bound,
    )
}


def main(names: list[str]) -> None:
    """Writes the figures with these names, by default all."""
    sinsjax.configure()
    for name in names or FIGURES:
        Path(__file__).with_name(f"concept_{name}.png").write_bytes(render_png(FIGURES[name]()))


if __name__ == "__main__":
    main(sys.argv[1:])
