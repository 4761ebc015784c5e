"""The spread of runs by linear covariance analysis, against runs with noise."""

from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from oracles.in_engine import record_world, site
from oracles.naive import PAPER
from scipy import stats
from support.studies import small_study

from sinsjax.covariance import analysis, linear_draws
from sinsjax.covariance.analysis import ErrorCovariance
from sinsjax.covariance.coloured_noise import ColouredInputs
from sinsjax.engine import batch, build
from sinsjax.engine.environment import Static
from sinsjax.engine.lanes import Group
from sinsjax.methods.base import Options
from sinsjax.types import Vec3
from sinsjax.units import ARCMIN

pytestmark = pytest.mark.optimised(False)

METHODS = ("kalman5", "kalman10", "kalman_sincos", "ekf_azimuth", "invariant", "unscented")
WATCHED = ("kalman5", "kalman10")
"""Without and with states that are no part of the solution; methods tell their linear parts to the
covariance as they do to companions."""

DRAWS = 192


SMALL = {
    **{"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0},
    **{"gyro_noise_deg_per_h": 0.01, "accel_noise_ug": 50.0},
}
"""Errors that leave filters linear: A(t) and gains hardly follow them."""

QUIET = {"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0}


def study_of(method: str, **changes: Any) -> Any:
    """A minute from small misalignments, a reset within."""
    return small_study(
        **{
            "study": {"duration_s": 60.0, "draws": DRAWS, "window_s": [30, 60], "curves": True},
            "alignment": {
                "method": method,
                **{"phi_e0_deg": 0.001, "phi_n0_deg": -0.001, "phi_u0_deg": 0.03},
                "feedback_interval_s": 1.0,
            },
            "sensors": SMALL,
            "cases": [{"reset_times_s": []}, {"reset_times_s": [20.5]}],
        }
        | changes
    )


def group_of(study: Any) -> Group:
    (part,) = build.parts(study, curves=True)
    return part.group


def first_draw_of(group: Group) -> Group:
    draws, variants = group.sizes
    return group.select(np.arange(1), np.arange(variants))


def spread_of(group: Group, samples: int = 512) -> tuple[ErrorCovariance, Any]:
    """The spread of each variant, and outcomes of the noise-free runs."""
    (chunk,) = batch.run_chunks(analysis.analysis_group(first_draw_of(group), samples))
    return chunk.curves, chunk.outcome


def runs_of(group: Group) -> np.ndarray:
    """(variants, draws, 3, records) misalignments."""
    chunks = list(batch.run_chunks(group))
    out = np.zeros((*group.sizes[::-1], 3, group.static.records))
    for chunk in chunks:
        place = np.searchsorted(group.draws.draw_id, chunk.draw)
        out[chunk.variant, place] = np.stack(chunk.curves.phi, axis=1)
    return out


class Made(NamedTuple):
    group: Group
    phi: np.ndarray


@cache
def made(method: str) -> Made:
    """A group of a method, and (variants, draws, 3, records) misalignments of its companions."""
    group = group_of(study_of(method))
    return Made(group, np.moveaxis(linear_draws.linear_misalignments(group), (2, 3), (0, 1)))


@cache
def told(method: str) -> ErrorCovariance:
    """What is told of their spread."""
    return spread_of(made(method).group)[0]


@pytest.mark.nightly
@pytest.mark.parametrize("name", METHODS)
def test_companion_matches_run_of_its_draw_for_small_errors(name: str) -> None:
    group, companion = made(name)
    # Sigma points follow the estimate, and gains with them.
    share = 0.35 if name == "unscented" else 0.05
    axes, first = slice(None), 10
    if name == "kalman_sincos":
        # Sine and cosine show no heading at first, which turns the level error of that time.
        axes, first = slice(2, None), 40
    companion, run = (phi[:, :, axes, first:] for phi in (companion, runs_of(group)))
    rms = np.sqrt(np.mean((companion - run) ** 2, axis=1)) / companion.std(axis=1, ddof=1)
    assert rms.max() < share, rms


@pytest.mark.nightly
@pytest.mark.parametrize("name", WATCHED)
def test_variance_of_companions_matches_covariance_analysis(name: str) -> None:
    """Within the chi-square interval of each, at 99.9 % over all that is compared."""
    spread, companion = told(name), made(name).phi
    records = [39, 49, 59]
    count = companion.shape[1]
    ratio = companion[..., records].var(axis=1, ddof=1) / spread.sigma[..., records] ** 2
    tail = 0.0005 / ratio.size
    low, high = stats.chi2.ppf([tail, 1 - tail], count - 1) / (count - 1)
    assert (ratio > low).all() and (ratio < high).all(), ratio


F = np.array([[0.8, 0.2, -0.1], [0.1, 0.7, 0.2], [0.0, -0.2, 0.9]])
BANDS, FLOOR, DT, RECORDS = np.array([4.0, 2.0]), 0.5, 0.5, 30
MEAN = 8 * 0.8 ** np.arange(RECORDS)
"""A growth of three errors, made up, the last of which is that of the heading."""


def spread_of_growth(noise: np.ndarray) -> ErrorCovariance:
    """Its spread about the mean, with 512 sampled errors."""
    zero, angles = (0.0,) * 3, np.eye(3)
    matrices = tuple(map(tuple, F)), tuple(noise[np.triu_indices(3)]), tuple(map(tuple, angles))
    rows = [
        jax.tree.leaves((Vec3(0.0, 0.0, phi), Vec3(*zero), zero, *matrices))
        for phi in MEAN.tolist()
    ]
    runs = record_world(np.zeros((1, 6)), site(PAPER, 0.5), pass_records=1)
    runs = runs._replace(criteria=runs.criteria._replace(bands=BANDS))
    spread = analysis.propagate_over_records(
        Static("kalman5", Options(DT), 1, RECORDS, curves=True),
        analysis.AnalysisEnvironment(runs, None, ColouredInputs(), None),
        np.array(rows)[:, :, None],
        np.array([FLOOR]),
        512,
        3,
    )
    return jax.tree.map(lambda a: np.asarray(a)[..., 0], spread)


def test_sigma_and_settling_times_are_those_of_errors_drawn_in_numpy() -> None:
    """Means of settling times within four standard errors; the noise is correlated."""
    root = np.array([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [-0.7, 0.9, 0.4]])
    spread, count = spread_of_growth(root @ root.T), 4000
    rng = np.random.default_rng(0)
    e, covariance, outside = np.zeros((count, 3)), np.zeros((3, 3)), np.zeros((2, 2, count))
    for k, phi in enumerate(MEAN):
        e = e @ F.T + rng.normal(size=(count, 3)) @ root.T
        covariance = F @ covariance @ F.T + root @ root.T
        np.testing.assert_allclose(spread.sigma[:, k], np.sqrt(np.diag(covariance)), rtol=1e-12)
        off = np.abs(np.stack([phi + e[:, 2] - FLOOR, phi + e[:, 2]]))[:, None]
        outside[off > BANDS[:, None]] = DT * (k + 1)
    a, b = spread.outside_until, outside
    assert np.ptp(a, axis=-1).min() > 3
    error = np.sqrt(a.var(-1) / a.shape[-1] + b.var(-1) / count)
    assert (np.abs(a.mean(-1) - b.mean(-1)) < 4 * error).all(), (a.mean(-1), b.mean(-1), error)


def test_spread_of_growth_without_noise_is_zero() -> None:
    spread = spread_of_growth(np.zeros((3, 3)))
    assert (spread.sigma == 0).all() and np.ptp(spread.outside_until, axis=-1).max() == 0


@pytest.mark.nightly
@pytest.mark.parametrize("name", WATCHED)
def test_settling_times_of_sampled_errors_match_companions(name: str) -> None:
    """Means of settling times within four standard errors of both."""
    spread, group, phi_u = told(name), made(name).group, made(name).phi[:, :, 2]
    (outcome,) = (chunk.outcome for chunk in batch.run_chunks(first_draw_of(group)))
    floor = np.asarray(outcome.floor.phi.z)[:, None, None]
    bands = np.asarray(group.environment.criteria.bands)[:, None]
    errors = np.stack([phi_u - floor, phi_u], axis=2)[:, :, :, None]
    times = np.arange(1.0, phi_u.shape[-1] + 1)  # s, one record per second
    # The end of the last record interval outside the band, (variants, draws, 2, B).
    outside = np.max((np.abs(errors) > bands) * times, axis=-1)
    sampled = np.asarray(spread.outside_until)  # (variants, 2, B, samples)
    a, b = sampled.mean(-1), np.moveaxis(outside, 1, -1).mean(-1)
    spread_ = np.sqrt(sampled.var(-1) / (sampled.shape[-1]) + outside.var(1) / outside.shape[1])
    assert (np.abs(a - b) <= 4 * spread_ + 1e-9).all(), (a, b, spread_)


@pytest.mark.nightly
def test_noise_free_run_equals_run_of_study_without_noise() -> None:
    group = group_of(study_of("kalman5"))
    plain = group_of(study_of("kalman5", sensors=SMALL | QUIET))
    spread, outcome = spread_of(group)
    np.testing.assert_allclose(spread.phi, runs_of(plain)[:, 0], rtol=0, atol=1e-9 * ARCMIN)
    first = next(iter(batch.run_chunks(plain))).outcome
    np.testing.assert_array_equal(outcome.outside_until, first.outside_until[:2])


@pytest.mark.nightly
def test_error_covariance_without_noise_is_zero() -> None:
    spread, _ = spread_of(group_of(study_of("kalman5", sensors=SMALL | QUIET)))
    assert (np.asarray(spread.sigma) == 0).all()
    assert np.ptp(spread.outside_until, axis=-1).max() == 0
