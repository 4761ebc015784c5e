"""Intervals and verdicts of the script on the accuracy of covariance analysis."""

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats
from support.bootstrap import bootstrap_intervals

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import covariance_accuracy as accuracy


def test_bootstrap_interval_of_sigma_matches_normal_theory() -> None:
    draws = np.random.default_rng(3).normal(5.0, 2.0, (1024, 3))
    low, high = bootstrap_intervals(draws, 0.05, seed=1) / draws.std(axis=0, ddof=1)
    expected = np.sqrt(1023 / stats.chi2.ppf([0.975, 0.025], 1023))
    np.testing.assert_allclose(low, expected[0], atol=0.012)
    np.testing.assert_allclose(high, expected[1], atol=0.012)


@pytest.mark.parametrize(("share", "misses"), [(0.5, 0), (0.62, 0), (0.8, 2)])
def test_share_counts_as_miss_if_interval_lies_beyond_tolerance(share: float, misses: int) -> None:
    """Half of 64 draws of two variants are within, at one earlier time and at the end."""
    size = accuracy.QUICK._replace(draws=64, times_s=(1, 2))
    error = np.tile([0.0, 0.0, 50.0, 50.0], 32)
    names = ("phi_u_at_1_arcmin", "phi_u_arcmin")
    summary = pa.table(
        {name: error - 25.0 for name in names} | {"floor_arcmin": np.full(128, -25.0)}
    )
    at_times = {"within_10_at_1_share": [0.5, 0.5], "within_10_share": [share, share]}
    row = accuracy.shares(size, summary, pa.table(at_times))
    assert row["compared"] == 4 and row["misses"] == misses and row["kept"] == (misses == 0)
    assert row["greatest"] == pytest.approx(share - 0.5)
