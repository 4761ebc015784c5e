"""The gains and conditions that the second paper prints."""

import math
from pathlib import Path

import numpy as np

from docs.studies import paper2
from sinsjax.methods import compass as loops
from sinsjax.study.load import load_study

CONFIGS = Path(__file__).parents[2] / "configs"
K3_CASE = "Scheme 1, K3 as printed"


def test_level_gains_follow_formula_except_printed_k3():
    formula = loops.level_gains(0.02, math.sqrt(0.5), gravity=9.8, radius=6378165.0)
    study = load_study(CONFIGS / "paper2_static.toml")
    for case in study.cases:
        unlike = case["case"] == K3_CASE
        expected = formula._replace(k3=0.000081632653) if unlike else formula
        np.testing.assert_allclose(case["level_gains"], expected, rtol=1e-11)
        signs = {np.sign(case[f"phi_{axis}0_deg"]) for axis in "enu"}
        assert signs == ({1.0} if "errors negative" in case["case"] else {-1.0})


def test_printed_k3_makes_level_loop_unstable():
    earth = {"gravity": 9.8, "radius": paper2.RADIUS}
    formula = loops.level_gains(0.02, loops.PAPER_DAMPING, **earth)
    printed = formula._replace(k3=float(paper2.LEVEL_K3))
    found = [
        np.roots([1, k1, (1 + k2) * 9.8 / paper2.RADIUS, 9.8 * k3])
        for k1, k2, k3 in (printed, formula)
    ]
    assert sorted(found[0].real.round(4)) == [-0.1108, 0.0254, 0.0254]
    assert sorted(found[1].real.round(4)) == [-0.02, -0.02, -0.02]
