"""The index of nonlinearity from a few draws, and many draws if it is large."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.studies import STILL, small_study

from sinsjax.covariance import linear_draws
from sinsjax.engine import build
from sinsjax.execution import linearity
from sinsjax.execution import run as study_run
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN

pytestmark = pytest.mark.optimised(False)

STARTS, RUN_S = [0.5, 170.0], 40.0
DRAWS = 20


def make_study(**settings: Any) -> Study:
    """40 s at rest, from a small error and from nearly the opposite heading."""
    common = {
        **{"duration_s": RUN_S, "record_interval_s": 4.0, "window_s": [20, RUN_S]},
        **{"report_times_s": [20.0], "settle_bands_arcmin": [60.0, 10.0]},
    }
    if settings.get("estimate"):
        common |= {"estimate_samples": 4096}
    return small_study(
        study=common | settings,
        motion=STILL,
        alignment={"feedback_interval_s": 1.0, "phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
        axes={"phi_u0_deg": STARTS, "reset_times_s": [[], [10.0]]},
    )


@pytest.fixture(scope="module")
def made() -> pa.Table:
    return study_run.estimate(make_study(estimate="covariance", draws=DRAWS))


@pytest.fixture(scope="module")
def drawn() -> pa.Table:
    return study_run.run(make_study(draws=DRAWS)).summary


@pytest.mark.nightly
def test_nonlinearity_index_is_rms_difference_from_companions_over_sigma(made: pa.Table) -> None:
    """In standard deviations of the true error, over the first eight draws."""
    study = make_study(draws=8)
    summary = study_run.run(study).summary
    (part,) = build.parts(study, curves=False)
    linear = linear_draws.linear_misalignments(part.group, np.array([4, 9]))[2] / ARCMIN
    for at, beside in zip(("_at_20", ""), linear.swapaxes(1, 2), strict=True):
        run = summary[f"phi_u{at}_arcmin"].to_numpy().reshape(8, 4)
        index = made[f"nonlinearity{at}"].to_numpy()
        sigma = made[f"true_sigma_u{at}_arcmin"].to_numpy()
        rms = np.sqrt(np.mean((run - beside) ** 2, axis=0))
        # The sigma of what draws fill is theirs; the index is of that before.
        kept = ~made["filled_by_draws"].to_numpy(zero_copy_only=False)
        np.testing.assert_allclose(index[kept], (rms / sigma)[kept], rtol=1e-6)


@pytest.mark.nightly
def test_small_errors_keep_estimate_and_large_ones_use_draws(made: pa.Table) -> None:
    assert made["filled_by_draws"].to_pylist() == [False, False, True, True]
    index = np.maximum(made["nonlinearity"], made["nonlinearity_at_20"])
    assert (index[:2] < 0.3).all() and (index[2:] > 0.5).all()


@pytest.mark.nightly
def test_filled_columns_equal_statistics_of_draws(made: pa.Table, drawn: pa.Table) -> None:
    rows, limited = slice(2, 4), drawn["floor_arcmin"].to_numpy().reshape(DRAWS, 4)
    for at in ("_at_20", ""):
        phi = drawn[f"phi_u{at}_arcmin"].to_numpy().reshape(DRAWS, 4)[:, rows]
        sigma = drawn[f"sigma_u{at}_arcmin"].to_numpy().reshape(DRAWS, 4)[:, rows]
        expected = {
            f"phi_u{at}_arcmin": phi.mean(0),
            f"true_sigma_u{at}_arcmin": phi.std(0, ddof=1),
            f"sigma_u{at}_arcmin": np.sqrt(np.mean(sigma**2, axis=0)),
            f"within_60_truth{at}_share": (np.abs(phi) <= 60).mean(0),
            f"within_60{at}_share": (np.abs(phi - limited[:, rows]) <= 60).mean(0),
        }
        for name, values in expected.items():
            np.testing.assert_allclose(made[name].to_numpy()[rows], values, rtol=1e-9)
    seconds = drawn["settle_60_truth_s"].fill_null(RUN_S).to_numpy().reshape(DRAWS, 4)[:, rows]
    np.testing.assert_allclose(made["settle_60_truth_mean_s"].to_numpy()[rows], seconds.mean(0))
    error = seconds.std(0, ddof=1) / np.sqrt(DRAWS)
    np.testing.assert_allclose(made["settle_60_truth_mean_error_s"].to_numpy()[rows], error)


@pytest.mark.nightly
def test_check_does_not_depend_on_variants_per_call(made: pa.Table, monkeypatch: Any) -> None:
    monkeypatch.setattr(linearity, "_VARIANTS_PER_CHECK", 3)  # 3 of the 4, then 1
    monkeypatch.setattr(linearity, "_VARIANTS_PER_FILL", 1)
    cut = study_run.estimate(make_study(estimate="covariance", draws=DRAWS))
    assert cut["filled_by_draws"].equals(made["filled_by_draws"])
    for name in ("nonlinearity", "nonlinearity_at_20", "phi_u_arcmin", "true_sigma_u_arcmin"):
        np.testing.assert_allclose(cut[name].to_numpy(), made[name].to_numpy(), rtol=1e-6)


@pytest.mark.nightly
def test_nonlinearity_columns_absent_without_check_linearity() -> None:
    alone = study_run.estimate(make_study(estimate="covariance", check_linearity=False))
    assert not [name for name in alone.column_names if "linear" in name or "filled" in name]
