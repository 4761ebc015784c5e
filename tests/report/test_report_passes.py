"""What the page on a filter over one tape says of a single pass."""

from pathlib import Path

import pytest

from sinsjax.analysis import Estimate
from sinsjax.report import pass_consistency
from sinsjax.report.base import Source
from sinsjax.study.load import load_study

CONFIG = Path(__file__).parents[2] / "configs" / "kalman_passes.toml"


@pytest.mark.parametrize(
    ("mean", "draws", "where", "by_chance"),
    [(2.69, 256, "outside", True), (3.0, 256, "inside", True), (2.69, 255, "outside", False)],
)
def test_a_single_pass_against_the_band_of_its_mean(mean, draws, where, by_chance):
    study = load_study(CONFIG)
    point = pass_consistency.Point(
        1, Estimate(mean, mean - 0.3, mean + 0.3, draws), Estimate(0.9, 0.8, 1.0, draws), 0.9
    )
    said = pass_consistency._single(Source(Path("results"), study, CONFIG.name), "small", point)
    # 3 +- 1.96 sqrt(6 / 256), skewed a little
    assert "between 2.71 and 3.31" in said if draws == 256 else "255 draws" in said
    assert f"It is {where}." in said
    assert ("is chance" in said) == (by_chance and where == "outside")
