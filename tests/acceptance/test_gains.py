"""Designs of `sinsjax gains`."""

import io
import re

import numpy as np
import pytest
from rich.console import Console

from sinsjax.cli import loop_gains

PAPER = {"gravity": 9.8, "radius": 6378165.0}


def test_design_gives_gains_and_roots_of_paper_loops():
    made, roots = loop_gains.gain_tables(0.02, 0.01, 0.5**0.5, **PAPER)
    k1, k2, k3, k4 = made.rows
    assert k1 == ["K1", "0.06", "1/s", "0.02", "1/s"] and k4[1:4] == ["-", "-", "0.02"]
    assert k2[1::2] == ["1040", "259.3"]
    assert float(k3[1]) == pytest.approx(2 * 0.02**3 / 9.8, rel=5e-4)
    assert roots.rows[0][1] == "-0.02, -0.02 +- 0.02j"
    assert roots.rows[1][1:] == ["-0.01 +- 0.01j (double)", "299.6", "628.3"]


@pytest.mark.parametrize("factor", [0.1, 1.0, 300.0])
def test_roots_are_shown_at_any_scale(factor: float) -> None:
    _, roots = loop_gains.gain_tables(0.02 * factor, 0.01 * factor, 0.8, **PAPER)
    numbers = [[float(x) for x in re.findall(r"-?[\d.]+(?:e-?\d+)?", row[1])] for row in roots.rows]
    sigma = np.array([0.02, 0.01]) * factor
    assert numbers[0] == pytest.approx([-sigma[0], -sigma[0], 0.75 * sigma[0]], rel=5e-4)
    assert numbers[1] == pytest.approx([-sigma[1], 0.75 * sigma[1]], rel=5e-4)


def test_print_gains_shows_roots_and_damping():
    console = Console(record=True, width=80, file=io.StringIO(), force_terminal=True)
    loop_gains.print_gains(console, 0.05, 0.02, 0.7, **PAPER)
    text = console.export_text()
    assert "Roots" in text and "damping 0.7" in text
    assert text.count("5 % left after") == 1  # not broken over lines, but for its unit
