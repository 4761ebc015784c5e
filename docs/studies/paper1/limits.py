"""The limit accuracy of paper 1, section 2.4.1: as printed, in closed form, and as simulated."""

import pyarrow as pa

from sinsjax import analysis
from sinsjax.analysis import format_estimate
from sinsjax.report.base import Table, only
from sinsjax.study.study import Study

from ..loops.runs import limits_of

PAPER_LIMITS_ARCMIN = {"e": -1.7189, "n": 1.7189, "u": -27.0248}
"""Limit accuracy as section 2.4.1 prints it: pitch, roll, yaw."""

_PAPER_RATE_DEG_PER_H = 15.0  # the Earth rate that gives the paper's yaw limit to all digits


def compared(
    study: Study, runs: pa.Table
) -> tuple[dict[str, str], dict[str, Table], dict[str, bool]]:
    """Paper, closed form and simulation side by side, and what they differ by.

    Args:
        study: whose runs.
        runs: those of condition 1, with ``floor_arcmin``.
    """
    here, paper_rate = limits_of(study), limits_of(study, _PAPER_RATE_DEG_PER_H)
    limits = here._asdict()
    start, end = study.study.window_s
    names = {"e": "phi_e (pitch)", "n": "phi_n (roll)", "u": "phi_u (yaw)"}
    forms = {"e": "-nabla_N/g", "n": "nabla_E/g", "u": "-eps_E/omega_N + (nabla_E/g) tan L"}
    found = {a: analysis.mean(analysis.numbers(runs, f"phi_{a}_mean_arcmin")) for a in "enu"}
    apart = {a: found[a].value - limits[a] for a in "enu"}
    rows = [
        [
            name,
            f"{PAPER_LIMITS_ARCMIN[a]:.4f}",
            forms[a],
            f"{limits[a]:.4f}",
            format_estimate(found[a], digits=3),
        ]
        for a, name in names.items()
    ]
    judged = float(analysis.numbers(runs, "floor_arcmin")[0])
    exact = "-atan2(eps_E, omega_N + eps_N) + (nabla_E/g) tan L"
    rows.append(["phi_u, biases not small", "-", exact, f"{judged:.4f}", "as above"])
    rate = f"{only(study, 'earth_rate_deg_per_h'):g}"
    yaw = [
        [f"{shown} deg/h", f"{p.gyro:.4f}", f"{p.accel:+.4f}", f"{p.gyro + p.accel:.4f}"]
        for shown, p in ((f"{_PAPER_RATE_DEG_PER_H:g}", paper_rate), (rate, here))
    ]
    latitude = only(study, "latitude_deg")
    tables = {
        "limit": Table(
            "What the misalignment settles to, arcmin",
            ["", "paper", "closed form", "value", f"simulated, {start:g} to {end:g} s"],
            rows,
        ),
        "yaw_limit": Table(
            f"The heading limit by its parts, at latitude {latitude:g} deg, arcmin",
            ["Earth rate", "-eps_E/omega_N", "(nabla_E/g) tan L", "both"],
            yaw,
        ),
    }
    values = {
        "paper": f"{PAPER_LIMITS_ARCMIN['u']:.4f} arcmin",
        "rate": f"{_PAPER_RATE_DEG_PER_H:g} deg/h",
        "first": f"{paper_rate.gyro:.5f} arcmin",
        "second": f"{here.accel:+.4f} arcmin",
        "north_off": f"{apart['n']:+.2f}",
        "up_off": f"{apart['u']:+.2f} arcmin",
    }
    claims = {
        "the paper's limit is its first term alone, with 15 deg/h": (
            abs(paper_rate.gyro - PAPER_LIMITS_ARCMIN["u"]) < 1e-3
        ),
        "the simulation does not end at the closed form": abs(apart["u"]) > 0.1,
    }
    return values, tables, claims
