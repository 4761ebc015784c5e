"""Errors of every method: those of the worst initial misalignment."""

import numpy as np
import pytest

from docs.studies.which_alignment_tables.field import worst_start

DRAWS = np.arange(1.0, 65.0)


def test_error_of_several_starts_is_that_of_the_worst() -> None:
    """Seven good starts do not hide a bad one."""
    errors = np.stack([*(DRAWS / 10,) * 7, 100 * DRAWS])
    assert worst_start(errors) == worst_start(errors[-1:])
    assert worst_start(errors).value == pytest.approx(100 * 58)


def test_start_that_never_aligns_makes_the_error_infinite() -> None:
    errors = np.stack([DRAWS, np.full(64, np.inf)])
    assert worst_start(errors).value == np.inf
