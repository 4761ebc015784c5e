"""Design of the compass loops: gains from decay rates, and the resulting roots."""

import math

import numpy as np
from rich.console import Console

from sinsjax.methods import compass_design as loops
from sinsjax.report.base import Table
from sinsjax.report.terminal import print_table


def gain_tables(
    level_sigma: float, azimuth_sigma: float, damping: float, *, gravity: float, radius: float
) -> list[Table]:
    """Return the gains and roots of both loops, [P2] eqs (17), (18), (22) and (23).

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
        ["K1", f"{level.k1:.4g}", "1/s", f"{azimuth.k1:.4g}", "1/s"],
        ["K2", f"{level.k2:.4g}", "-", f"{azimuth.k2:.4g}", "-"],
        ["K3", f"{level.k3:.4g}", "rad/(m s)", f"{azimuth.k3:.4g}", "rad/(m s^2)"],
        ["K4", "-", "-", f"{azimuth.k4:.4g}", "1/s"],
    ]
    found = [
        _loop_row("level", level_sigma, damping, loops.level_matrix(level, **earth)),
        _loop_row("azimuth", azimuth_sigma, damping, loops.azimuth_matrix(azimuth, **earth)),
    ]
    return [
        Table(
            "Gains",
            ["", "level", "unit", "azimuth", "unit"],
            gains,
            f"g = {gravity:g} m/s^2, R = {radius:.0f} m, damping {damping:.4g}.",
        ),
        Table(
            "Roots",
            ["loop", "roots (1/s)", "5 % left after (s)", "period (s)"],
            found,
            "5 % left: of exp(-sigma t). Period: of the damped oscillation.",
        ),
    ]


def _loop_row(name: str, sigma: float, damping: float, matrix: np.ndarray) -> list[str]:
    period = 2 * math.pi * damping / (sigma * math.sqrt(1 - damping**2))
    return [name, _format_roots(matrix), f"{math.log(20) / sigma:.4g}", f"{period:.4g}"]


def _format_roots(matrix: np.ndarray) -> str:
    """Return the roots, conjugate pairs together, with the multiplicity of double ones."""
    found = loops.roots(matrix)
    size = np.abs(found).max()
    # Double roots are found to half of the digits only.
    rounded = [(round(r.real / size, 6), round(r.imag / size, 6)) for r in found]
    upper = sorted(root for root in rounded if root[1] >= 0)
    texts = []
    for real, imag in dict.fromkeys(upper):
        pair = f" +- {imag * size:.4g}j" if imag else ""
        double = " (double)" if upper.count((real, imag)) > 1 else ""
        texts.append(f"{real * size:.4g}{pair}{double}")
    return ", ".join(texts)


def print_gains(console: Console, *args: float, **earth: float) -> None:
    """Print the tables of `gain_tables`, with its arguments."""
    for table in gain_tables(*args, **earth):
        print_table(table, console)
