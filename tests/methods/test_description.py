"""What methods say of themselves holds of what computes them."""

from pathlib import Path

import jax
import numpy as np
import pytest
from oracles.in_engine import navigation
from support.studies import small_study

from sinsjax.engine.build import Scenario
from sinsjax.execution import schemas
from sinsjax.methods.base import Options
from sinsjax.methods.description import COMMON_KEYS
from sinsjax.methods.page import render_methods_page
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import COARSE_KEYS, SECTIONS, TUNABLE

methods = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def test_methods_page_is_up_to_date():
    assert (Path(__file__).parents[2] / "docs" / "methods.md").read_text() == render_methods_page()


@methods
def test_methods_name_only_existing_keys(method):
    known = {key for name in TUNABLE for key in SECTIONS[name].model_fields}
    assert {*method.reads} <= known and {*method.without_effect} <= {*method.keys, *COMMON_KEYS}
    assert {*method.refuses} <= {*method.keys, *COARSE_KEYS}
    for pair in method.gyro_bias_keys:
        assert {*pair} <= method.keys
    if relaxed := method.implementation.relaxation:
        followed = {*relaxed.follows, *relaxed.follows.values()}
        assert {*relaxed.changes, *followed, *({relaxed.times} - {None})} <= method.keys


@methods
def test_method_columns_are_in_summary_layout(method):
    study = small_study(alignment={"method": method.name})
    names = [own.column.name for own in method.own_columns(study)]
    assert len({*names}) == len(names)
    assert {*names} <= {column.name for column in schemas.summary_columns(study)}


@methods
def test_has_covariance_flag_matches_initial_covariance(method):
    group = Scenario(small_study(alignment={"method": method.name})).part(0).group
    params = jax.tree.map(lambda a: np.asarray(a)[0], group.variants)
    built = method(Options(0.01))
    nav = navigation(np.eye(3), (0.0, 0.0), 0.5)
    covariance = np.array(built.covariance(built.init(params.method, nav)))
    assert np.isfinite(covariance).all() == method.has_covariance
