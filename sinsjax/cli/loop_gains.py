"""Design of the compass loops: gains from decay rates, and the resulting roots."""

import math
from typing import Annotated, Any

import typer

from sinsjax.errors import InputError
from sinsjax.messages import plain_console


def gain_root_tables(
    level_sigma: float, azimuth_sigma: float, damping: float, *, gravity: float, radius: float
) -> list[Any]:
    """Return tables of the gains and roots of both loops, [P2] eqs (17), (18), (22) and (23).

    Of the decay rates of levelling and azimuth, 1/s, and their damping ratio; gravity in m/s^2 and
    the Earth's radius in m.
    """
    import numpy as np

    from sinsjax.methods import compass as loops
    from sinsjax.report.document import Table

    earth = {"gravity": gravity, "radius": radius}
    level = loops.level_gains(level_sigma, damping, **earth)
    azimuth = loops.azimuth_gains(azimuth_sigma, damping, **earth)

    def tilt(found: Any) -> list[float]:
        """Return the last two coefficients of s^2 + K1 s + (1 + K2) g/R."""
        return [found.k1, (1 + found.k2) * gravity / radius]

    azimuth_polynomial = np.polymul([1, azimuth.k4, 0], [1, *tilt(azimuth)])
    azimuth_polynomial[-1] += gravity * azimuth.k3
    gains = [
        ["K1", f"{level.k1:.4g}", "1/s", f"{azimuth.k1:.4g}", "1/s"],
        ["K2", f"{level.k2:.4g}", "-", f"{azimuth.k2:.4g}", "-"],
        ["K3", f"{level.k3:.4g}", "rad/(m s)", f"{azimuth.k3:.4g}", "rad/(m s^2)"],
        ["K4", "-", "-", f"{azimuth.k4:.4g}", "1/s"],
    ]
    found = [
        _loop_row("level", level_sigma, damping, np.roots([1, *tilt(level), gravity * level.k3])),
        _loop_row("azimuth", azimuth_sigma, damping, np.roots(azimuth_polynomial)),
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


def _loop_row(name: str, sigma: float, damping: float, roots: Any) -> list[str]:
    period = 2 * math.pi * damping / (sigma * math.sqrt(1 - damping**2))
    return [name, _format_roots(roots), f"{math.log(20) / sigma:.4g}", f"{period:.4g}"]


def _format_roots(roots: Any) -> str:
    """Return the roots, conjugate pairs together, with the multiplicity of double ones."""
    size = max(map(abs, roots))
    # Double roots are found to half of the digits only.
    rounded = [(round(r.real / size, 6), round(r.imag / size, 6)) for r in roots]
    upper = sorted(root for root in rounded if root[1] >= 0)
    texts = []
    for real, imag in dict.fromkeys(upper):
        pair = f" +- {imag * size:.4g}j" if imag else ""
        double = " (double)" if upper.count((real, imag)) > 1 else ""
        texts.append(f"{real * size:.4g}{pair}{double}")
    return ", ".join(texts)


def gains(
    level_sigma: Annotated[
        float, typer.Option(help="Decay rate of levelling, 1/s.", metavar="X")
    ] = 0.02,
    azimuth_sigma: Annotated[
        float, typer.Option(help="Decay rate in azimuth, 1/s.", metavar="X")
    ] = 0.01,
    damping: Annotated[
        float, typer.Option(help="Damping ratio of both, above 0, below 1.", metavar="X")
    ] = 0.5**0.5,
    gravity: Annotated[float, typer.Option(help="Gravity, m/s^2.", metavar="X")] = 9.8,
    radius: Annotated[float, typer.Option(help="Earth radius, m.", metavar="X")] = 6378137.0,
) -> None:
    """Design the compass loops: gains from decay rates, the resulting roots and settling times.

    Example: sinsjax gains --azimuth-sigma 0.025
    """
    numbers = {
        "--level-sigma": level_sigma,
        "--azimuth-sigma": azimuth_sigma,
        "--damping": damping,
        "--gravity": gravity,
        "--radius": radius,
    }
    for option, value in numbers.items():
        if not 0 < value < (1 if option == "--damping" else math.inf):
            below = " and below 1" if option == "--damping" else ""
            raise InputError(f"{option}: must be above 0{below}, not {value:g}")
    from sinsjax.report.document import print_table

    tables = gain_root_tables(level_sigma, azimuth_sigma, damping, gravity=gravity, radius=radius)
    for table in tables:
        print_table(table, plain_console())
