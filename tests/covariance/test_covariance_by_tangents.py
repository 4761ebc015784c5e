"""Covariance analysis against derivatives of the methods' own steps, and those against draws."""

from typing import Any

import jax
import numpy as np
import pytest
from oracles import tangents
from scipy import stats
from support.studies import small_study

from sinsjax.covariance import analysis
from sinsjax.engine import batch, build
from sinsjax.engine.lanes import Group

pytestmark = pytest.mark.optimised(False)

DRAWS = 256
TIMES = (20, 35, 59)
"""Records that are compared. The compass levels at the first; none comes soon after a reset, where
gains change within a block."""

STUDIES: dict[str, dict[str, Any]] = {
    "kalman5": {
        "alignment": {"feedback_interval_s": 1.0},
        "cases": [{"reset_times_s": []}, {"reset_times_s": [10.5]}],
    },
    "compass": {
        "compass": {"level_time_s": 25.0, "azimuth_sigma_per_s": 0.05},
        "cases": [{"azimuth_damping": 0.7}, {"azimuth_damping": 0.9}],
    },
}
SMALL = {
    **{"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0},
    **{"gyro_noise_deg_per_h": [0.01, 0.02, 0.01], "accel_noise_ug": 50.0},
}
"""Errors of which P takes no notice; axes differ, so that noise has to be turned."""


@pytest.fixture(scope="module", params=STUDIES)
def case(request: pytest.FixtureRequest) -> tuple[Group, tangents.Spread]:
    name = request.param
    starts = {"phi_e0_deg": 0.001, "phi_n0_deg": -0.001, "phi_u0_deg": 0.03, "method": name}
    given = STUDIES[name]
    study = small_study(
        study={"duration_s": 60.0, "draws": DRAWS, "window_s": [30, 60], "curves": True},
        sensors=SMALL,
        **given | {"alignment": starts | given.get("alignment", {})},
    )
    (part,) = build.parts(study, curves=True)
    return part.group, tangents.spread(part.group)


@pytest.mark.nightly
def test_covariance_analysis_sigma_matches_tangents(case: tuple[Group, tangents.Spread]) -> None:
    """Where errors are small: blocks of noise tell 0.3 %, and the rest is what P makes of them."""
    group, expected = case
    one = group._replace(draws=jax.tree.map(lambda a: a[:1] if np.ndim(a) else a, group.draws))
    (chunk,) = batch.run_chunks(analysis.analysis_group(one, 2))
    phi, sigma = (np.moveaxis(a, 1, 2) for a in chunk.curves[:2])
    np.testing.assert_allclose(phi, expected.phi, rtol=0, atol=1e-10)
    np.testing.assert_allclose(sigma[:, TIMES], expected.sigma[:, TIMES], rtol=0.01)


@pytest.mark.nightly
def test_tangent_sigma_matches_variance_of_draws(case: tuple[Group, tangents.Spread]) -> None:
    """Variances within the chi-square interval of each, at 99.9 % over all that is compared."""
    group, expected = case
    curves = np.zeros((*group.sizes, group.static.records, 3))
    for chunk in batch.run_chunks(group):
        place = np.searchsorted(group.draws.draw_id, chunk.draw)
        curves[place, chunk.variant] = np.stack(chunk.curves.phi, axis=-1)
    ratio = curves[:, :, TIMES].var(0, ddof=1) / expected.sigma[:, TIMES] ** 2
    tail = 0.0005 / ratio.size
    low, high = stats.chi2.ppf([tail, 1 - tail], DRAWS - 1) / (DRAWS - 1)
    assert (ratio > low).all() and (ratio < high).all(), ratio
