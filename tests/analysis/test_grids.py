"""The runs of a table laid out over two of its keys."""

import numpy as np
import pyarrow as pa
import pytest

from sinsjax.analysis.grids import CellOutcomes, split_into_panels
from sinsjax.errors import InputError

NEVER = np.inf


def test_panels_hold_each_run_at_its_keys_in_order_of_draws():
    points = [(d, m, a, b) for d in range(3) for m in "xy" for a in (2, 1) for b in "pq"]
    draw, m, a, b = zip(*points, strict=True)
    value = [100.0 * d + 10 * a + (b == "q") + (m == "y") / 2 for d, m, a, b in points]
    table = pa.table({"draw_id": draw, "a": a, "b": b, "m": m, "value": value})
    mixed = table.take(np.random.default_rng(0).permutation(24)).sort_by("draw_id")
    axes, panels = split_into_panels(mixed, "a", "b", ["m"])
    assert {*axes["a"]} == {1, 2} and {*axes["b"]} == {"p", "q"}
    assert sorted(panel.point["m"] for panel in panels) == ["x", "y"]
    for panel in panels:
        for d, i, j in np.ndindex(3, 2, 2):
            late = (panel.point["m"] == "y") / 2
            expected = 100 * d + 10 * axes["a"][i] + (axes["b"][j] == "q") + late
            assert panel.column_values("value")[d, i, j] == expected


def test_runs_that_are_no_full_grid_are_refused():
    table = pa.table({"a": [1, 1, 2], "b": [1, 2, 1]})
    with pytest.raises(InputError, match="a, b: the runs form no full grid of these keys"):
        split_into_panels(table, "a", "b")


def test_cells_have_share_of_successes_and_median_time():
    ok = np.array([[[1, 1, 0]], [[1, 1, 1]]], bool)
    settle = np.array([[[9.0, 5.0, NEVER]], [[9.0, 5.0, 1.0]]])
    cells = CellOutcomes(ok, np.zeros_like(ok), settle)
    np.testing.assert_array_equal(cells.success_share, [[1.0, 1.0, 0.5]])
    np.testing.assert_array_equal(cells.median_s, [[9.0, 5.0, 1.0]])


def test_cell_with_most_successes_off_bias_floor_is_not_converged():
    ok = np.array([[1, 1, 1, 0], [1, 1, 1, 0], [0, 1, 1, 0]], bool)[:, None]
    off = np.array([[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], bool)[:, None]
    found = CellOutcomes(ok, off, np.zeros(ok.shape)).not_converged
    assert found.tolist() == [[False, True, False, False]]  # half of them are not most
