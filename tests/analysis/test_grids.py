"""The runs of a table laid out over axes."""

import numpy as np
import pyarrow as pa
import pytest

from sinsjax.analysis.grids import Grid
from sinsjax.errors import InputError


def test_grid_holds_each_run_at_its_points_in_order_of_draws():
    points = [(d, m, a, b) for d in range(3) for m in "xy" for a in (2, 1) for b in "pq"]
    draw, m, a, b = zip(*points, strict=True)
    value = [100.0 * d + 10 * a + (b == "q") + (m == "y") / 2 for d, m, a, b in points]
    table = pa.table({"draw_id": draw, "a": a, "b": b, "m": m, "value": value})
    mixed = table.take(np.random.default_rng(0).permutation(24)).sort_by("draw_id")
    grid = Grid.from_table(mixed, ["m"], ["a", "b"])
    assert {*grid.axes["m",]} == {("x",), ("y",)} and len(grid.axes["a", "b"]) == 4
    for (i, (m,)), (j, (a, b)), d in [
        (one, other, draw)
        for one in enumerate(grid.axes["m",])
        for other in enumerate(grid.axes["a", "b"])
        for draw in range(3)
    ]:
        expected = 100 * d + 10 * a + (b == "q") + (m == "y") / 2
        assert grid.column("value")[i, j, d] == expected


def test_runs_that_are_no_full_grid_are_refused():
    table = pa.table({"a": [1, 1, 2], "b": [1, 2, 1]})
    with pytest.raises(InputError, match="a, b: the runs form no full grid of these keys"):
        Grid.from_table(table, ["a"], ["b"])
