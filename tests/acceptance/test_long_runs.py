"""Runs of a day: memory of their results, and equality of truth in blocks and at once."""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest
from support.batches import batch_of
from support.studies import small_study

from sinsjax.engine import samples, scenario
from sinsjax.engine.run import map_tiles, run_tile
from sinsjax.execution import run

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

DAY_S = 86_400.0
MOST_BYTES = 60e6
"""Bytes of one array in the program of a day's run; curves: 6 MB, of 8 sets of lanes 50 MB."""


@pytest.fixture
def without_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenario, "MOST_STORED_SAMPLES", 0)
    monkeypatch.setattr(samples, "SAMPLES_PER_CALL", 30)


def arrays(jaxpr: Any) -> Iterator[tuple[int, str]]:
    """Yield bytes and shape of every array of a program."""
    for equation in jaxpr.eqns:
        for variable in (*equation.invars, *equation.outvars):
            if isinstance(aval := getattr(variable, "aval", None), jax.core.ShapedArray):
                yield aval.size * aval.dtype.itemsize, f"{equation.primitive} {aval.shape}"
        for inner in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda a: hasattr(a, "eqns")
        ):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from arrays(inner)


@pytest.mark.parametrize("specific_force", ["measured", "gravity"])
def test_day_long_run_allocates_no_large_array(specific_force: str) -> None:
    """No record and no idle lanes; with gravity, tiles share a covariance."""
    study = small_study(
        study={"duration_s": DAY_S, "draws": 1},
        alignment={"specific_force": specific_force},
    )
    part = batch_of(study, curves=True)
    spec, layout = part.spec, part.lay_out()
    shown, tiles = layout.curve_lanes, layout.tiles_of(part, 0)
    assert shown == 1 and spec.intervals == DAY_S

    def program(environment: Any, tiles: Any) -> Any:
        def one(tiles: Any) -> Any:
            return run_tile(spec, environment, tiles, shown)

        return map_tiles(spec, one, tiles, layout.blocks(0))

    traced = jax.make_jaxpr(program)(part.environment, tiles)
    size, what = max(arrays(traced.jaxpr))
    assert 6e6 < size < MOST_BYTES, what


PASSES = small_study(
    study={"draws": 2, "duration_s": 2.0, "window_s": [0, 2], "curves": True},
    passes={"stored_s": 1.0},
    alignment={"method": "compass"},
)


def test_curves_without_stored_increments_match_stored_ones(request: pytest.FixtureRequest) -> None:
    """Equal to rounding, forward and backward: the formulas are the same, the loop differs."""
    whole = run.run(PASSES).curves
    request.getfixturevalue("without_records")
    part = batch_of(PASSES)
    assert part.environment.increments is None
    pieces = run.run(PASSES).curves
    assert pieces.num_rows == whole.num_rows == 4
    for name in ("phi_e_arcmin", "phi_n_arcmin", "phi_u_arcmin", "yaw_deg"):
        np.testing.assert_allclose(pieces[name], whole[name], rtol=0, atol=1e-7, err_msg=name)
