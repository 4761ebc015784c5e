"""What a step of each method costs beside one of the 5-state filter, in time and in arithmetic.

The same base, sensors and record interval, silent, with 64 variants a draw. A method that nothing
swept acts on has one, and stands beside the filter with one. Each side in turns.
"""

import common
from derivative import loops_of, operations

from sinsjax.bench.cases import (
    RECORD_S,
    TILES,
    compass_group,
    default_group,
    engine_workload,
    method_group,
    remove_noise,
    select_last_variants,
    shorten_runs,
    trigger_group,
)
from sinsjax.bench.timing import Row, measure_relative_to_base
from sinsjax.engine.batch import compile_program, plan
from sinsjax.engine.lanes import Group, tiles_of
from sinsjax.methods.registry import METHODS

OTHERS = tuple(name for name in METHODS if name not in ("kalman5", "compass"))
QUICK = ("kalman10", "kalman_sincos", "optimisation")
"""The methods beside `kalman5` and `compass`; those of a quick run."""

SHORT = 7
"""Records of a quick run: as many passes no other loop of a program makes."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the others in turns with the 5-state filter; the compass also over a stored tape.

    Returns:
        ``kalman``, then the other methods, ``linearisation`` (a trigger) and ``compass_tape`` with
        their ``ratio`` to it; likewise ``kalman_alone`` and the methods
        with one variant a draw. All have ``operations``, the arithmetic of a step and run, and the
        others their ``operations_ratio``.
    """
    groups = {
        "kalman": default_group(),
        **{name: method_group(name) for name in (QUICK if quick else OTHERS)},
        "linearisation": trigger_group(),
        "compass": compass_group(),
        "compass_tape": compass_group(RECORD_S),
    }
    if quick:
        groups = {name: shorten_runs(group, SHORT) for name, group in groups.items()}
    silent = {name: remove_noise(group) for name, group in groups.items()}
    alone = {name: group for name, group in silent.items() if group.sizes[1] == 1}
    alone = {"kalman_alone": select_last_variants(silent["kalman"], 1), **alone}
    measured = []
    for side in ({k: v for k, v in silent.items() if k not in alone}, alone):
        base, *others = (engine_workload(name, group) for name, group in side.items())
        of_side = measure_relative_to_base(base, others, repeats)
        counts = [arithmetic(group) for group in side.values()]
        for row, count in zip(of_side, counts, strict=True):
            row["operations"] = round(count, 1)
            if "ratio" in row:
                row["operations_ratio"] = round(count / counts[0], 3)
        measured += of_side
    return measured


def arithmetic(group: Group) -> float:
    """Operations of a step and run that the compiled program carries out, see `operations`.

    What is done once a run is left out; what is done once a record is spread over its steps.
    """
    tiles = tiles_of(group, plan(group, tiles_per_chunk=TILES)[0])
    program, loops = compile_program(group, tiles), loops_of(group, tiles)
    records = group.static.records
    over_records = operations(program, loops) - operations(program, loops, without=records)
    steps = records * group.static.record_every
    return over_records / (steps * tiles.params.q.w.size)


if __name__ == "__main__":
    common.main(rows)
