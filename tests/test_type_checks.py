"""While tests run, calls of sinsjax are checked against annotations, those of arrays too."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from support import type_checks

from sinsjax.maths import rotations

MADE_UP = """
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from nowhere import Absent

class Pair(NamedTuple):
    one: float

@dataclass
class Given:
    one: float

    @property
    def wrong(self) -> str:
        return self.one

    def itself(self) -> "Given":
        return self

def of_static_checkers(given: "Absent") -> "Absent":
    return given

def inner(value: float) -> float:
    def told() -> int:
        return value
    return float(told())

def add(first: float):
    def total(second: float, *, third: float = 0.0) -> float:
        return first + second + third
    return total
"""


@pytest.fixture
def made_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    (tmp_path / "made_up_package.py").write_text(MADE_UP)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", sys.meta_path.copy())
    monkeypatch.setattr(sys, "modules", sys.modules.copy())
    type_checks.install("made_up_package")
    return importlib.import_module("made_up_package")


def test_arguments_results_and_fields_are_checked(made_up: ModuleType) -> None:
    given = made_up.Given(1.0)
    assert given.itself() is given
    for call in (
        lambda: made_up.Given(1),
        lambda: given.wrong,
        lambda: made_up.inner(1),
        lambda: made_up.inner(1.0),
    ):
        with pytest.raises(BeartypeCallHintViolation):
            call()


def test_functions_made_at_each_call_are_checked_and_keep_their_own_values(
    made_up: ModuleType,
) -> None:
    one, two = made_up.add(1.0), made_up.add(2.0)
    assert (one(10.0), two(10.0, third=0.5), one.__name__) == (11.0, 12.5, "total")
    for call in (lambda: one(10), lambda: two("x"), lambda: one(1.0, third=1)):
        with pytest.raises(BeartypeCallHintViolation):
            call()


def test_uncheckable_annotations_are_ignored(made_up: ModuleType) -> None:
    assert made_up.Pair("leaf").one == "leaf"  # as JAX fills it
    assert made_up.of_static_checkers(1) == 1


def test_scalar_annotation_accepts_only_float_scalars() -> None:
    for given in (1, np.zeros(2), jnp.zeros(2), np.array(True), "x"):
        with pytest.raises(BeartypeCallHintViolation):
            rotations.sin_cos(given)
    for good in (1.0, np.float64(1.0), jnp.asarray(1.0)):
        rotations.sin_cos(good)
    jax.eval_shape(jax.vmap(rotations.sin_cos), np.zeros(3))
    with pytest.raises(BeartypeCallHintViolation):
        jax.eval_shape(rotations.sin_cos, np.zeros(3))
