"""Gains of the compass loops from their decay rates, and the roots that they give: a design."""

import math

import numpy as np
from rich.console import Console

from sinsjax.alignment.compass import design as loops
from sinsjax.report.base import Table
from sinsjax.report.terminal import print_table


def design(
    level_sigma: float, azimuth_sigma: float, damping: float, *, gravity: float, radius: float
) -> list[Table]:
    """Gains and roots of both loops, [P2] eqs (17), (18), (22) and (23).

    Args:
        level_sigma: decay rate of the levelling loop, 1/s.
        azimuth_sigma: of the azimuth loop, 1/s.
        damping: ratio of both, between 0 and 1.
        gravity: m/s^2.
        radius: of the Earth, m.
    """
    earth = {"gravity": gravity, "radius": radius}
    level = loops.level_gains(level_sigma, damping, **earth)
    azimuth = loops.azimuth_gains(azimuth_sigma, damping, **earth)
    gains = [
        ["level", f"{level.k1:.6g}", f"{level.k2:.12g}", f"{level.k3:.6g}", "-"],
        ["azimuth", *(f"{k:.12g}" for k in (azimuth.k1, azimuth.k2, azimuth.k3, azimuth.k4))],
    ]
    found = [
        _times("level", level_sigma, damping, loops.level_polynomial(level, **earth)),
        _times("azimuth", azimuth_sigma, damping, loops.azimuth_polynomial(azimuth, **earth)),
    ]
    header = ["loop", "roots (1/s)", "exp(-sigma t) = 5 % after (s)", "damped period (s)"]
    return [
        Table(
            "Gains",
            ["loop", "K1 (1/s)", "K2", "K3 (level: rad/(m s), azimuth: rad/(m s^2))", "K4 (1/s)"],
            gains,
            f"g = {gravity:g} m/s^2, R = {radius:.0f} m, damping {damping:.4g}.",
        ),
        Table("Roots", header, found),
    ]


def _times(name: str, sigma: float, damping: float, polynomial: np.ndarray) -> list[str]:
    # Equal real parts differ in their last digit, which no order may hang on.
    found = sorted(loops.roots(polynomial), key=lambda root: (-round(root.real, 6), -root.imag))
    shown = ", ".join(
        f"{root.real:+.4f}" + (f" {root.imag:+.4f}j" if abs(root.imag) > 1e-9 else "")
        for root in found
    )
    period = 2 * math.pi * damping / (sigma * math.sqrt(1 - damping**2))
    return [name, shown, f"{math.log(20) / sigma:.1f}", f"{period:.1f}"]


def print_gains(console: Console, *args: float, **earth: float) -> None:
    """Prints the tables of `design`, whose arguments it takes."""
    for table in design(*args, **earth):
        print_table(table, console)
