"""Draws the figure of the README: ``python docs/figures/hero.py``.

Four methods on a vehicle that sways and on one that also surges: the heading error that 90 % of the
alignments stay below, over the available time. Initial misalignment, heading, sensor biases and
noise are new in every draw. Prints the numbers that the README quotes.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

import sinsjax
from sinsjax import analysis
from sinsjax.plots.style import COLOURS, GREY, render_png, with_style
from sinsjax.study.study import Study

TARGET = Path(__file__).with_name("hero.png")
TIMES_S = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 240.0, 300.0)
BASES = {0.0: "The vehicle sways", 0.1: "It also surges (0.1 m/s rms)"}
METHODS = ("published filter", "resets by the law", "kalman_sincos", "kalman_surge")
SHARE = 0.9
HEADLINE = "Resets rescue the plain Kalman filter on a vehicle that sways, not on one that surges"
LABELS = {
    (0.0, "published filter"): (32.0, 11300.0, "plain Kalman filter, as published"),
    (0.0, "resets by the law"): (
        37.0,
        560.0,
        "the same, its Q the sensors' noise,\nresets by the law",
    ),
    (0.0, "kalman_sincos"): (10.6, 20.0, "sine/cosine\nfilter"),
    (0.0, "kalman_surge"): (23.2, 2500.0, "surge filter"),
    (0.1, "published filter"): (34.0, 11800.0, "plain Kalman filter, as published"),
    (0.1, "resets by the law"): (128.0, 4700.0, "resets by the law"),
    (0.1, "kalman_sincos"): (146.0, 230.0, "sine/cosine filter"),
    (0.1, "kalman_surge"): (78.0, 48.0, "surge filter"),
}
"""Time, error and text of each label, at its line."""


def study() -> Study:
    """Return the study of the figure."""
    published = {"q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_step"}
    published |= {"r_reading": "psd", "feedback_interval_s": 1.0}
    own = {"q_accel_ug": 100.0, "q_gyro_deg_per_h": 0.6, "q_reading": "per_sample"}
    own |= {"r_reading": "per_update", "feedback_interval_s": 0.01}
    cases: list[dict[str, Any]] = [
        {"case": "published filter", "method": "kalman5", "schedule": "none"} | published,
        {"case": "resets by the law", "method": "kalman5", "schedule": "law"} | own,
        {"case": "kalman_sincos", "method": "kalman_sincos", "schedule": "none"} | own,
        {"case": "kalman_surge", "method": "kalman_surge", "schedule": "none"} | own,
    ]
    return sinsjax.study_from_dict(
        {
            "study": {
                **{"name": "hero", "duration_s": 300.0, "rate_hz": 100.0, "draws": 512},
                **{"report_times_s": [*TIMES_S[:-1]], "window_s": [200.0, 300.0]},
            },
            "earth": {"latitude_deg": 45.0},
            "motion": {
                **{"pitch_amplitude_deg": 1.8, "roll_amplitude_deg": 2.4, "yaw_amplitude_deg": 2.8},
                **{"pitch_period_s": 6.0, "roll_period_s": 8.0, "yaw_period_s": 10.0},
                **{"surge_time_s": 5.0, "surge_bandwidth_hz": 1.0},
            },
            "sensors": {"gyro_arw_deg_per_sqrt_h": 0.001, "accel_vrw_ug_per_sqrt_hz": 10.0},
            "drawn": {
                "gyro_bias_deg_per_h": {"normal": [0.0, 0.01]},
                "accel_bias_ug": {"normal": [0.0, 50.0]},
                "yaw_center_deg": {"uniform": [-180.0, 180.0]},
                "phi_e0_deg": {"normal": [0.0, 5.0]},
                "phi_n0_deg": {"normal": [0.0, 5.0]},
                "phi_u0_deg": {"uniform": [-170.0, 170.0]},
            },
            "filter": {
                **{"p0_velocity_m_per_s": 0.1, "p0_level_deg": 15.0, "p0_yaw_deg": 80.0},
                **{"r_velocity_m_per_s": 0.1},
            },
            "resets": {"heading_bound_deg": 170.0},
            "cases": cases,
            "axes": {"surge_m_per_s": [*BASES]},
        }
    )


def reached(table: Any, case: str, surge: float) -> NDArray:
    """Return the error (arcmin) that 90 % stay below with its interval, (times, 3)."""
    rows = table[(table["case"] == case) & (table["surge_m_per_s"] == surge)]
    names = [f"phi_u_at_{time:g}_arcmin" for time in TIMES_S[:-1]] + ["phi_u_arcmin"]
    return np.array([analysis.quantile(rows[name].abs(), SHARE)[:3] for name in names])


@with_style
def draw(table: Any) -> Figure:
    """Return the figure."""
    figure = Figure(figsize=(9.6, 4.6))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (surge, title) in zip(panels, BASES.items(), strict=True):
        for colour, case in zip(COLOURS, METHODS, strict=False):
            value, low, high = reached(table, case, surge).T
            axes.fill_between(TIMES_S, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(TIMES_S, value, color=colour)
            time, error, text = LABELS[surge, case]
            axes.text(time, error, text, color=colour, fontsize=10.5, linespacing=1.05)
        axes.set(xscale="log", yscale="log", xlim=(10, 300), ylim=(2, 18000), title=title)
        axes.xaxis.set_major_locator(FixedLocator([10, 30, 60, 120, 300]))
        axes.yaxis.set_major_locator(FixedLocator([3, 10, 60, 600, 6000]))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_major_formatter(lambda y, _: f"{y:g}'" if y < 60 else f"{y / 60:g}°")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_minor_locator(NullLocator())
            axis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("available time (s)", color=GREY)
    panels[0].set_ylabel("heading error of 90 %, at most")
    figure.suptitle(HEADLINE)
    return figure


def main() -> None:
    """Run the study, draw the figure and print its numbers."""
    results = sinsjax.run(study())
    table = results.summary.to_pandas()
    print(f"{len(table):,} runs in {results.wall_s:.0f} s")
    for surge, title in BASES.items():
        print(title)
        for case in METHODS:
            found = reached(table, case, surge)
            cells = [f"{v:.3g} [{a:.3g}, {b:.3g}]" for v, a, b in found]
            print(f"  {case:18}", *(f"{t:g} s {c}" for t, c in zip(TIMES_S, cells, strict=True)))
    TARGET.write_bytes(render_png(draw(table)))


if __name__ == "__main__":
    main()
