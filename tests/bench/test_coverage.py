"""Each promised 95 % interval contains the truth in 93 of 100 samples or more (fixed seeds)."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import interval_coverage as measured


@pytest.mark.nightly
@pytest.mark.parametrize("variants", measured.VARIANTS)
@pytest.mark.parametrize("draws", [16, 64])
def test_share_intervals_reach_promised_coverage(draws, variants):
    cells = list(measured.of_shares(draws, variants, 600))
    assert all(cell.promised for cell in cells)
    assert min(cell.percent for cell in cells) >= measured.LEAST, cells


@pytest.mark.nightly
@pytest.mark.parametrize("law", measured.LAWS, ids=lambda law: law.name)
@pytest.mark.parametrize("variants", [1, 12])
def test_intervals_of_values_reach_promised_coverage(law, variants):
    cells = [cell for cell in measured.of_values(32, variants, 1500, [law]) if cell.promised]
    names = {cell.name.partition(",")[0] for cell in cells}
    assert names == {"median", "90 % quantile"} | ({"mean", "rms"} if law.promised else set())
    assert min(cell.percent for cell in cells) >= measured.LEAST, cells


@pytest.mark.nightly
@pytest.mark.parametrize("draws", [16, 64])
def test_intervals_of_paired_differences_reach_promised_coverage(draws):
    cells = list(measured.of_pairs(draws, 300))
    assert min(cell.percent for cell in cells) >= measured.LEAST, cells
