"""Each promised 95 % interval contains the truth in 93 of 100 samples or more (fixed seeds)."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from sinsjax.analysis import Estimate

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import interval_coverage as measured


@pytest.mark.slow
@pytest.mark.parametrize("variants", measured.VARIANTS)
@pytest.mark.parametrize("draws", [16, 64])
def test_share_intervals_reach_promised_coverage(draws, variants):
    cells = list(measured.of_shares(draws, variants, 600))
    assert all(cell.promised for cell in cells)
    assert min(cell.percent for cell in cells) >= measured.LEAST, cells


@pytest.mark.slow
@pytest.mark.parametrize("law", measured.LAWS, ids=lambda law: law.name)
@pytest.mark.parametrize("variants", [1, 12])
def test_intervals_of_values_reach_promised_coverage(law, variants):
    cells = [cell for cell in measured.of_values(32, variants, 1500, [law]) if cell.promised]
    names = {cell.name.partition(",")[0] for cell in cells}
    assert names == {"median", "90 % quantile"} | ({"mean", "rms"} if law.promised else set())
    assert min(cell.percent for cell in cells) >= measured.LEAST, cells


@pytest.mark.slow
@pytest.mark.parametrize("draws", [16, 64])
def test_intervals_of_paired_differences_reach_promised_coverage(draws):
    cells = list(measured.of_pairs(draws, 300))
    assert min(cell.percent for cell in cells) >= measured.LEAST, cells


@pytest.mark.parametrize("law", measured.LAWS, ids=lambda law: law.name)
def test_laws_have_the_numbers_that_they_state(law):
    """Compared with integrals over the normal score."""
    mean, square = (
        stats.norm.expect(lambda x, p=p: float(law.value(np.array(x))) ** p, lb=-8, ub=8)
        for p in (1, 2)
    )
    assert law.truth["mean"] == pytest.approx(mean, abs=1e-6)
    assert law.truth["rms"] ** 2 == pytest.approx(square, rel=1e-4)
    assert law.truth["standard deviation"] ** 2 == pytest.approx(square - mean**2, rel=1e-4)
    for name, q in (("median", 0.5), ("90 % quantile", 0.9)):
        assert law.truth[name] == pytest.approx(float(law.value(stats.norm.ppf(q))), abs=1e-9)


@pytest.mark.parametrize("correlation", measured.CORRELATIONS)
def test_scores_have_the_correlation_within_a_draw(correlation):
    samples = np.concatenate(list(measured.scores(50, 2, correlation, 100)))
    assert np.corrcoef(samples.T)[0, 1] == pytest.approx(correlation, abs=0.03)
    assert samples.std(axis=0) == pytest.approx([1.0, 1.0], abs=0.03)


def test_table_has_lowest_coverage_over_correlations():
    cells = [
        measured.Cell("0.9", 16, 12, correlation, percent, promised=True)
        for correlation, percent in ((0.0, 99.0), (0.5, 95.04), (0.95, 96.0))
    ]
    rows = measured.lowest(cells, lambda c: {"draws": c.draws}, lambda c: c.name)
    assert rows == [{"draws": 16, "0.9": 95.0}]


def test_promised_cell_below_93_percent_fails(monkeypatch, capsys):
    cell = measured.Cell("0.9", 16, 12, 0.5, 92.9, promised=True)
    kept = cell._replace(draws=8, percent=80.0, promised=False)
    monkeypatch.setattr(measured, "measure", lambda quick, repetitions: ([cell, kept], [], []))
    monkeypatch.setattr(sys, "argv", ["interval_coverage.py"])
    with pytest.raises(SystemExit, match="1"):
        measured.main()
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 1 and "below 93 %" in errors[0]


def test_unbounded_interval_end_covers_any_value():
    assert measured.covers(Estimate(1.0, float("nan"), 2.0, 3), -9.0)
    assert not measured.covers(Estimate(1.0, float("nan"), 2.0, 3), 2.1)
