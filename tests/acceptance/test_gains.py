"""What `sinsjax gains` designs."""

import io

import pytest
from rich.console import Console

from sinsjax.cli import loop_gains

PAPER = {"gravity": 9.8, "radius": 6378165.0}


def test_design_gives_gains_and_roots_of_paper_loops():
    made, roots = loop_gains.design(0.02, 0.01, 0.5**0.5, **PAPER)
    level, azimuth = made.rows
    assert level[:3] == ["level", "0.06", "1040.33306122"]
    assert float(level[3]) == pytest.approx(2 * 0.02**3 / 9.8, rel=1e-5)
    assert azimuth[1] == azimuth[4] == "0.02" and azimuth[2] == "259.333265306"
    assert roots.rows[0][1] == "-0.0200 +0.0200j, -0.0200, -0.0200 -0.0200j"
    assert roots.rows[1][2:] == ["299.6", "628.3"]


def test_print_gains_shows_roots_and_damping():
    console = Console(record=True, width=120, file=io.StringIO())
    loop_gains.print_gains(console, 0.05, 0.02, 0.7, **PAPER)
    text = console.export_text()
    assert "Roots" in text and "damping 0.7" in text
