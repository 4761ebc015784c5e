"""Columns of a study, compared with the written-out product of its dimensions."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.studies import small_study

from sinsjax.study.sweep_columns import Dimension, SweepColumns
from sinsjax.study.variants import Variants

VALUES = st.sampled_from([None, 0.0, 1.5, "full", (1.0, 2.0), ()])


@st.composite
def sweeps(draw: st.DrawFn) -> list[Dimension]:
    """A few dimensions of one or two keys, with values that may repeat."""
    sweep, names = [], iter("abcdefgh")
    for _ in range(draw(st.integers(0, 3))):
        length = draw(st.integers(1, 4))
        column = st.tuples(*[VALUES] * length)
        sweep.append({next(names): draw(column) for _ in range(draw(st.integers(1, 2)))})
    return sweep


def expand_variants(sweep: list[Dimension]) -> list[dict[str, Any]]:
    """The variants, the last dimension fastest; "z" is in none and always 7."""
    points = [
        [dict(zip(dimension, row, strict=True)) for row in zip(*dimension.values(), strict=True)]
        for dimension in sweep
    ]
    return [
        {"z": 7} | {k: v for point in row for k, v in point.items()} for row in product(*points)
    ]


@given(sweeps())
def test_columns_match_product_of_dimensions(sweep):
    resolved, variants = SweepColumns(sweep, {"z": 7}.__getitem__), expand_variants(sweep)
    assert resolved.n_variants == len(variants)
    for key in variants[0]:
        column = resolved.column(key)
        assert column.to_list() == [variant[key] for variant in variants]
        assert len(set(column.choices)) == len(column.choices)
    with pytest.raises(KeyError):
        resolved.column("nowhere")


@given(sweeps(), st.randoms(use_true_random=False))
def test_joint_columns_have_only_occurring_combinations(sweep, random):
    resolved, variants = SweepColumns(sweep, {"z": 7}.__getitem__), expand_variants(sweep)
    keys = random.sample(sorted(variants[0]), random.randint(1, len(variants[0])))
    keys = keys if len(keys) > 1 else [*keys, "z"]
    column, whole = resolved.column(*keys), [tuple(v[key] for key in keys) for v in variants]
    assert column.to_list() == whole
    assert sorted(map(repr, column.choices)) == sorted(map(repr, set(whole)))


def test_variants_select_rows_of_study_columns():
    study = small_study(axes={"phi_u0_deg": [0, 10, 20], "feedback_interval_s": [1, 2]})
    some = Variants(study, np.array([1, 2, 5]))
    assert some.coded("feedback_interval_s").to_list() == [2, 1, 2]
    np.testing.assert_array_equal(some.column("phi_u0_deg", 2.0), [0.0, 20.0, 40.0])
    assert some.common("phi_e0_deg") == study.values("phi_e0_deg")[0]


def test_changed_study_copy_recomputes_columns():
    study = small_study(axes={"phi_u0_deg": [0, 10, 20]})
    assert study.values("phi_u0_deg") == [0.0, 10.0, 20.0]
    other = study.model_copy(update={"axes": {"phi_u0_deg": (5.0,)}})
    assert other.values("phi_u0_deg") == [5.0]
    assert study.coded("phi_u0_deg") is study.coded("phi_u0_deg")
