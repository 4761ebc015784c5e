"""Designs of `sinsjax gains`."""

import pytest

from sinsjax.cli import loop_gains
from sinsjax.study.schema import EARTH_CONSTANTS

PAPER = {"gravity": 9.8, "radius": 6378165.0}


def test_design_gives_gains_and_roots_of_paper_loops():
    made, roots = loop_gains.gain_tables(0.02, 0.01, 0.5**0.5, **PAPER)
    k1, k2, k3, k4 = made.rows
    assert k1 == ["K1", "0.06", "1/s", "0.02", "1/s"] and k4[1:4] == ["-", "-", "0.02"]
    assert k2[1::2] == ["1040", "259.3"]
    assert float(k3[1]) == pytest.approx(2 * 0.02**3 / 9.8, rel=5e-4)
    assert roots.rows[0][1] == "-0.02, -0.02 +- 0.02j"
    assert roots.rows[1][1:] == ["-0.01 +- 0.01j (double)", "299.6", "628.3"]


def test_command_has_the_radius_of_the_earth_section(sinsjax):
    code, told, _ = sinsjax("gains")
    assert code == 0 and f"R = {EARTH_CONSTANTS['radius_m']:.0f} m" in told
