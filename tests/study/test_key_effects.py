"""Effects of keys as sections and methods declare them, compared with results of the engine."""

import tomllib
from typing import Any

import jax
import numpy as np
import pytest
from support.batches import run_chunks
from support.studies import BASE, small_study

from sinsjax.engine.scenario import Scenario
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import SECTION_OF, SECTIONS, accepted_words, reading_methods
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

SILENT = {
    "cycle of no reset": "resets.reset_count = 0 & axes.reset_cycle_s = [1.0, 2.0]",
    "cycle of one reset with a time": (
        "resets = {reset_count = 1, reset_first_s = 2.0} & axes.reset_cycle_s = [1.0, 2.0]"
    ),
    "first of no reset": "resets.reset_count = 0 & axes.reset_first_s = [1.0, 2.0]",
    "kind of no reset": "axes.reset_kind = ['full', 'yaw']",
    "scale of a full reset": (
        "resets = {reset_count = 1, reset_cycle_s = 1.0} & axes.reset_scale = [2.0, 3.0]"
    ),
    "level of a reset of yaw": (
        "resets = {reset_count = 1, reset_cycle_s = 1.0, reset_kind = 'yaw'}"
        " & axes.reset_level_deg = [2.0, 3.0]"
    ),
    "waiting of no reset": "axes.reset_at_feedback = [false, true]",
    "new clock of no reset": "axes.reset_restarts_feedback = [false, true]",
    "new clock of a reset that waits": (
        "resets = {reset_count = 1, reset_cycle_s = 1.37, reset_at_feedback = true}"
        " & axes.reset_restarts_feedback = [false, true]"
    ),
    "bias of a filter without": "axes.p0_gyro_bias_deg_per_h = [0.1, 1.0]",
    "remainder of a period": (
        "alignment.method = 'compass' & compass.azimuth_adjustment_s = 100.0"
        " & axes.adjustment_remainder = [0.1, 0.2]"
    ),
    "smoothing without reflection": (
        "alignment.method = 'compass' & passes = {stored_s = 3.0, turn = 'keep'}"
        " & axes.turn_smoothing_s = [1.0, 2.0]"
    ),
    "inflation of what is carried": "passes.stored_s = 3.0 & axes.turn_inflation = [2.0, 3.0]",
    "period of no sway": "motion.yaw_amplitude_deg = 0.0 & axes.yaw_period_s = [3.0, 4.0]",
    "reading of no angle": (
        "alignment = {phi_e0_deg = 0.0, phi_n0_deg = 0.0, phi_u0_deg = 0.0}"
        " & axes.misalignment = ['vector', 'euler']"
    ),
}
ACTING = {
    "cycle of a reset": "resets.reset_count = 1 & axes.reset_cycle_s = [1.0, 2.0]",
    "scale": (
        "resets = {reset_count = 1, reset_cycle_s = 1.0, reset_kind = 'scale'}"
        " & axes.reset_scale = [2.0, 3.0]"
    ),
    "waiting": (
        "resets = {reset_count = 1, reset_cycle_s = 1.37} & axes.reset_at_feedback = [false, true]"
    ),
    "new clock": (
        "resets = {reset_count = 1, reset_cycle_s = 1.37}"
        " & axes.reset_restarts_feedback = [false, true]"
    ),
    "bias of a filter with": (
        "alignment.method = 'kalman10' & axes.p0_gyro_bias_deg_per_h = [0.1, 1.0]"
    ),
    "reading of angles": "axes.misalignment = ['vector', 'euler']",
    "smoothing of a reflection": (
        "alignment.method = 'compass' & passes.stored_s = 3.0 & axes.turn_smoothing_s = [1.0, 2.0]"
    ),
    "period of a sway": "axes.yaw_period_s = [3.0, 4.0]",
    "assumed bias of a level": (
        "alignment.method = 'level' & axes.level_accel_bias_ug = [1000.0, 5000.0]"
    ),
}
SILENT_SOMEWHERE = sorted({key for method in METHODS.values() for key in method.idle_keys})
"""Keys without effect on a method that takes them."""


def outcomes(study: Study) -> list[list[np.ndarray]]:
    """Return every number of the outcome of the first draw, for each variant."""
    found: dict[int, list[np.ndarray]] = {}
    scenario = Scenario(study, curves=True)
    for number, ids in enumerate(scenario.variant_ids):
        for chunk in run_chunks(scenario.batch(number, range(1))):
            leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(chunk.outcome)]
            for row, place in enumerate(chunk.variant):
                found[int(ids[place])] = [leaf[row] for leaf in leaves]
    return [found[variant] for variant in range(study.n_variants)]


def are_equal(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


def study_of(text: str) -> Study:
    return small_study(**tomllib.loads(text.replace(" & ", "\n")))


@pytest.mark.nightly(fast=("cycle of no reset", "reading of no angle"))
@pytest.mark.parametrize("name", SILENT)
def test_inactive_key_changes_no_outcome(name):
    study = study_of(SILENT[name])
    assert len(set(study.duplicate_of)) == 1
    assert are_equal(*outcomes(study))


@pytest.mark.nightly(fast=("cycle of a reset", "scale", "waiting", "reading of angles"))
@pytest.mark.parametrize("name", ACTING)
def test_active_key_changes_outcome(name):
    study = study_of(ACTING[name])
    assert len(set(study.duplicate_of)) == 2
    assert not are_equal(*outcomes(study))


# Keys and methods


def own_keys(method: str) -> list[str]:
    """The keys of `SILENT_SOMEWHERE` that a method takes."""
    return [key for key in SILENT_SOMEWHERE if key in {*METHODS[method].keys, "position"}]


def two_values(key: str) -> tuple[Any, Any]:
    words = accepted_words(SECTIONS[SECTION_OF[key]].model_fields[key].annotation)
    return (words[0], words[1]) if words else (5.0, 20.0)


def silent_and_changing_keys(method: str) -> tuple[set[str], set[str]]:
    """Return the keys that change no bit of a run, and the others; each is changed separately."""
    keys = own_keys(method)
    first = {key: two_values(key)[0] for key in keys}
    tables: dict[str, Any] = {"alignment": {"method": method} | dict.fromkeys(BASE["alignment"])}
    if "resets" in METHODS[method].sections:
        tables["resets"] = {"reset_times_s": [2.37]}
    cases = [first, *(first | {key: two_values(key)[1]} for key in keys)]
    before, *after = outcomes(small_study(**tables, cases=cases))
    silent = {key for key, other in zip(keys, after, strict=True) if are_equal(before, other)}
    return silent, {*keys} - silent


@pytest.mark.nightly
@pytest.mark.parametrize("method", METHODS)
def test_keys_idle_keys_are_those_that_change_no_bit_of_a_run(method):
    silent, changing = silent_and_changing_keys(method)
    assert silent == {*METHODS[method].idle_keys}
    assert changing == {key for key in own_keys(method) if method in reading_methods(key)}
