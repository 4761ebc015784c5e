"""Effects of keys as their sections declare them, compared with results of the engine."""

from typing import Any

import jax
import numpy as np
import pytest
from support.studies import small_study

from sinsjax.engine.batch import run_chunks
from sinsjax.engine.build import Scenario
from sinsjax.study.keys import has_effect

pytestmark = pytest.mark.optimised(False)

COMPASS = {"alignment": {"method": "compass"}}
PASSES = {"passes": {"stored_s": 3.0}}
SILENT: dict[str, tuple[dict[str, Any], str, list[Any]]] = {
    "cycle of no reset": ({"resets": {"reset_count": 0}}, "reset_cycle_s", [1.0, 2.0]),
    "cycle of one reset with a time": (
        {"resets": {"reset_count": 1, "reset_first_s": 2.0}},
        "reset_cycle_s",
        [1.0, 2.0],
    ),
    "first of no reset": ({"resets": {"reset_count": 0}}, "reset_first_s", [1.0, 2.0]),
    "kind of no reset": ({}, "reset_kind", ["full", "yaw"]),
    "scale of a full reset": (
        {"resets": {"reset_count": 1, "reset_cycle_s": 1.0}},
        "reset_scale",
        [2.0, 3.0],
    ),
    "level of a reset of yaw": (
        {"resets": {"reset_count": 1, "reset_cycle_s": 1.0, "reset_kind": "yaw"}},
        "reset_level_deg",
        [2.0, 3.0],
    ),
    "waiting of no reset": ({}, "reset_at_feedback", [False, True]),
    "new clock of no reset": ({}, "reset_restarts_feedback", [False, True]),
    "new clock of a reset that waits": (
        {"resets": {"reset_count": 1, "reset_cycle_s": 1.37, "reset_at_feedback": True}},
        "reset_restarts_feedback",
        [False, True],
    ),
    "bias of a filter without": ({}, "p0_gyro_bias_deg_per_h", [0.1, 1.0]),
    "remainder of a period": (
        {"compass": {"azimuth_adjustment_s": 100.0}, **COMPASS},
        "adjustment_remainder",
        [0.1, 0.2],
    ),
    "smoothing without reflection": (
        {**COMPASS, "passes": {"stored_s": 3.0, "turn": "keep"}},
        "turn_smoothing_s",
        [1.0, 2.0],
    ),
    "inflation of what is carried": (PASSES, "turn_inflation", [2.0, 3.0]),
    "period of no sway": (
        {"motion": {"yaw_amplitude_deg": 0.0}},
        "yaw_period_s",
        [3.0, 4.0],
    ),
    "reading of no angle": (
        {"alignment": {"phi_e0_deg": 0.0, "phi_n0_deg": 0.0, "phi_u0_deg": 0.0}},
        "misalignment",
        ["vector", "euler"],
    ),
}
ACTING: dict[str, tuple[dict[str, Any], str, list[Any]]] = {
    "cycle of a reset": ({"resets": {"reset_count": 1}}, "reset_cycle_s", [1.0, 2.0]),
    "scale": (
        {"resets": {"reset_count": 1, "reset_cycle_s": 1.0, "reset_kind": "scale"}},
        "reset_scale",
        [2.0, 3.0],
    ),
    "waiting": (
        {"resets": {"reset_count": 1, "reset_cycle_s": 1.37}},
        "reset_at_feedback",
        [False, True],
    ),
    "new clock": (
        {"resets": {"reset_count": 1, "reset_cycle_s": 1.37}},
        "reset_restarts_feedback",
        [False, True],
    ),
    "bias of a filter with": (
        {"alignment": {"method": "kalman10"}},
        "p0_gyro_bias_deg_per_h",
        [0.1, 1.0],
    ),
    "reading of angles": ({}, "misalignment", ["vector", "euler"]),
    "smoothing of a reflection": ({**COMPASS, **PASSES}, "turn_smoothing_s", [1.0, 2.0]),
    "period of a sway": ({}, "yaw_period_s", [3.0, 4.0]),
    "assumed bias of a level": (
        {"alignment": {"method": "level"}},
        "level_accel_bias_ug",
        [1000.0, 5000.0],
    ),
}


def outcomes(tables: dict[str, Any], key: str, values: list[Any]) -> list[Any]:
    """Return every number of the outcome of the first draw, for each value."""
    study = small_study(**tables, axes={key: values})
    found: dict[int, Any] = {}
    scenario = Scenario(study, curves=False)
    for number, ids in enumerate(scenario.variant_ids):
        for chunk in run_chunks(scenario.part(number, range(1)).group):
            for row, place in enumerate(chunk.variant):
                found[int(ids[place])] = [
                    np.asarray(a)[row] for a in jax.tree.leaves(chunk.outcome)
                ]
    return [found[variant] for variant in range(study.n_variants)]


@pytest.mark.representative("cycle of no reset", "reading of no angle")
@pytest.mark.parametrize("name", SILENT)
def test_inactive_key_changes_no_outcome(name):
    tables, key, values = SILENT[name]
    assert len(set(small_study(**tables, axes={key: values}).duplicate_of)) == 1
    one, other = outcomes(tables, key, values)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.representative(
    "cycle of a reset",
    "scale",
    "waiting",
    "reading of angles",
)
@pytest.mark.parametrize("name", ACTING)
def test_active_key_changes_outcome(name):
    tables, key, values = ACTING[name]
    assert len(set(small_study(**tables, axes={key: values}).duplicate_of)) == 2
    one, other = outcomes(tables, key, values)
    assert any(not np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


def test_level_damping_acts_only_for_compass_without_level_gains():
    assert not has_effect("level_damping", {"method": "kalman5", "level_gains": None})
    assert has_effect("level_damping", {"method": "compass", "level_gains": None})
    assert not has_effect("level_damping", {"method": "compass", "level_gains": (1.0, 1.0, 1.0)})
