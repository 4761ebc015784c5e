"""Values of drawn keys: distributions, streams, Sobol points, lists."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from support.plain_studies import (
    SIMULATED,
    build_study,
    merge_tables,
    refusal_line,
)
from support.refusals import refused

from sinsjax.study import values
from sinsjax.study.study import Study

MANY = 1 << 14
BASE = merge_tables(SIMULATED, study={"duration_s": 9, "draws": 3})
LAWS: dict[str, Any] = {
    "phi_e0_deg": {"uniform": [-5, 5]},
    "phi_n0_deg": {"uniform": [-5, 5]},
    "phi_u0_deg": {"normal": [2, 10]},
    "gyro_bias_deg_per_h": {"normal": [0, 0.01]},
    "accel_misalignment_arcsec": {"uniform": [0, 1]},
    "pitch_center_deg": {"values": [0, 30, 60]},
}


def make_study(laws: dict[str, Any], **changes: Any) -> Study:
    return build_study(BASE, drawn=laws, **changes)


def drawn(laws: dict[str, Any], count: int = MANY, **changes: Any) -> dict[str, np.ndarray]:
    return values.drawn_values(make_study(laws, **changes), count)


SOBOL = {"sampling": "sobol"} | LAWS
BOTH = pytest.mark.parametrize("laws", [LAWS, SOBOL], ids=["random", "sobol"])


# Distributions


@BOTH
def test_drawn_values_follow_their_distributions(laws):
    values = drawn(laws)
    for key, law in (
        ("phi_e0_deg", stats.uniform(-5, 10)),
        ("phi_n0_deg", stats.uniform(-5, 10)),
        ("phi_u0_deg", stats.norm(2, 10)),
        ("gyro_bias_deg_per_h", stats.norm(0, 0.01)),
        ("accel_misalignment_arcsec", stats.uniform(0, 1)),
    ):
        for column in values[key].reshape(MANY, -1).T:
            assert stats.kstest(column, law.cdf).pvalue > 1e-3, key


@BOTH
def test_drawn_values_are_uncorrelated_across_keys_axes_and_draws(laws):
    """Of other keys, of the other axes of a vector, and of the draw before."""
    values = drawn(laws)
    columns = np.column_stack([rows for key, rows in values.items() if key != "pitch_center_deg"])
    n = columns.shape[1]
    found = np.corrcoef(columns[:-1], columns[1:], rowvar=False)[:n] - np.eye(n, 2 * n)
    if "sampling" in laws:
        found = found[:, :n]  # a Sobol point avoids the one before it
    assert np.abs(found).max() < 4.5 / np.sqrt(MANY)


@pytest.mark.parametrize("end", [0.0, 1 - 2.0**-30])
def test_extreme_sobol_points_give_finite_values(end, monkeypatch):
    """The lowest and the highest point that the sequence has."""
    monkeypatch.setattr(stats.qmc.Sobol, "random", lambda self, n: np.full((n, self.d), end))
    values = drawn(SOBOL, 4)
    assert np.abs(values["phi_u0_deg"] - 2) == pytest.approx(10 * stats.norm.isf(2.0**-31))
    assert np.all(np.abs(values["phi_e0_deg"]) < 5)


# Streams


@BOTH
@given(first=st.integers(0, 70), count=st.integers(0, 70))
def test_draws_do_not_depend_on_block(laws, first, count):
    study = make_study(laws | {"roll_center_deg": {"values": [0, 10]}})
    whole = values.drawn_values(study, 140)
    for key, rows in values.drawn_values(study, count, first=first).items():
        np.testing.assert_array_equal(rows, whole[key][first : first + count])


def test_adding_drawn_keys_keeps_values_of_others():
    alone = drawn({"phi_e0_deg": LAWS["phi_e0_deg"]}, 100)["phi_e0_deg"]
    later = dict(reversed(LAWS.items()))
    np.testing.assert_array_equal(drawn(later, 100)["phi_e0_deg"], alone)


@BOTH
def test_drawn_values_match_frozen_reference(laws):
    """Stored results rest on them."""
    values = drawn(laws, 3, study={"seed": 1})
    level = [-3.034434542285841, -3.3844064925443593, 4.990089562075395]
    heading = [5.91668242042428, 5.098483037369475, 2.98800778190141]
    if "sampling" in laws:
        level = [-2.1383083751425147, 4.9912525760009885, 0.2523040445521474]
        heading = [4.233272388687993, 1.438813417016906, 20.259318624579052]
    np.testing.assert_allclose(values["phi_e0_deg"], level, rtol=1e-14)
    np.testing.assert_allclose(values["phi_u0_deg"], heading, rtol=1e-12)


# Lists


def test_value_list_is_cycled_over_draws():
    values = drawn(LAWS, 8)["pitch_center_deg"]
    np.testing.assert_array_equal(values, [0, 30, 60, 0, 30, 60, 0, 30])
    laws = {"gyro_bias_deg_per_h": {"values": [0.5, [1, 2, 3]]}}
    rows = [[0.5, 0.5, 0.5], [1, 2, 3], [0.5, 0.5, 0.5]]
    np.testing.assert_array_equal(drawn(laws, 3)["gyro_bias_deg_per_h"], rows)


# What a study refuses to draw


@refused("""
cases = [{phi_e0_deg = 1.0}]                 -> [drawn] phi_e0_deg: [cases]
drawn = {sampling = "sobol"}                 -> [drawn]
drawn.reset_at_feedback.values = [true]      -> [drawn] reset_at_feedback
drawn.phi_e0_deg.unifrom = [0, 1]            -> [drawn] phi_e0_deg.unifrom: uniform
drawn.phi_e0_deg.sigma = 3                   -> [drawn] phi_e0_deg.sigma: normal uniform
drawn.phi_e0_deg.uniform = [2, 1]            -> [drawn] phi_e0_deg.uniform: low high 2 1
drawn.phi_e0_deg.values = [0, 200]           -> [drawn] phi_e0_deg.values[1]: 180 200
# Lists that the draws do not reach.
drawn.phi_u0_deg.values = [1, 2, 3, 4]       -> [drawn] phi_u0_deg.values: 4 3
""")
def test_invalid_drawn_tables_are_refused(refusal):
    law = {} if "drawn" in refusal.tables else {"drawn": {"phi_e0_deg": {"uniform": [0, 1]}}}
    refusal.check(refusal_line(BASE, **refusal.tables | law))


@BOTH
@pytest.mark.parametrize(
    ("key", "law", "bound"),
    [
        ("phi_u0_deg", {"uniform": [170, 190]}, "180"),
        ("gyro_arw_deg_per_sqrt_h", {"normal": [1, 1]}, "0"),
        ("accel_scale_ppm", {"normal": [1e12, 1]}, "1000000000000"),
    ],
)
def test_draw_out_of_bounds_is_refused(laws, key, law, bound):
    table = {"sampling": laws.get("sampling", "random"), key: law}
    line = refusal_line(BASE, drawn=table, study={"draws": 1000, "unchecked": True})
    assert re.fullmatch(rf"\[drawn\] {key}: may be drawn as \S+: must .*{bound}", line)
