"""With its defaults `kalman5` settles from large misalignments without resets, at [P1]'s base."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sinsjax

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

CONFIG = Path(__file__).parents[2] / "configs" / "paper1_resets.toml"
EXPECTED_S = {(5, 5, 30): 110.0, (20, 20, 120): 480.0, (0, 0, 170): 394.0, (5, 5, 150): 376.0}
"""Mean settling time of 64 draws to 10' about the bias floor, by initial Euler angles, deg."""
DRAWS = 16


def settling_times(**filter_: Any) -> dict[tuple[int, int, int], np.ndarray]:
    """Settling times of every draw, s, infinite if a run never settles, by initial misalignment.

    Args:
        filter_: sections that differ from a study without Q and feedback.
    """
    data = tomllib.loads(CONFIG.read_text("utf-8"))
    keys = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg")
    starts = {key: [float(start[i]) for start in EXPECTED_S] for i, key in enumerate(keys)}
    settings = {key: data["study"][key] for key in ("duration_s", "rate_hz", "judged_from")}
    tables = {
        **{name: data[name] for name in ("earth", "motion", "sensors")},
        "study": settings | {"draws": DRAWS},
        "alignment": {"misalignment": "euler"},
        "axes": {"start": starts},
    }
    assert settings["duration_s"] == 900.0
    summary = sinsjax.run(sinsjax.study_from_dict(tables | filter_)).summary
    times = summary["settle_10_s"].fill_null(np.inf).to_numpy().reshape(DRAWS, -1)
    return dict(zip(EXPECTED_S, times.T, strict=True))


def test_default_filter_settles_without_resets() -> None:
    for start, times in settling_times().items():
        assert np.isfinite(times).all(), start
        error = times.std(ddof=1) / DRAWS**0.5
        assert abs(times.mean() - EXPECTED_S[start]) < 4 * error + 5, start


def test_paper1_filter_never_settles_without_resets() -> None:
    data = tomllib.loads(CONFIG.read_text("utf-8"))
    alignment = {"misalignment": "euler", "feedback_interval_s": 1.0}
    for start, times in settling_times(filter=data["filter"], alignment=alignment).items():
        assert np.isinf(times).all(), start
