"""What a step of each method costs beside one of the 5-state filter.

The same base, sensors and record interval, silent, with 64 variants a draw. A method that nothing
swept acts on has one, and stands beside the filter with one. Each side in turns.
"""

import common
from cases import (
    RECORD_S,
    compass_group,
    default_group,
    engine_workload,
    method_group,
    remove_noise,
    select_last_variants,
    shorten_runs,
)
from timing import Row, measure_relative_to_base

from sinsjax.methods.registry import METHODS

OTHERS = tuple(name for name in METHODS if name not in ("kalman5", "compass"))
QUICK = ("kalman10", "optimisation")
"""The methods beside `kalman5` and `compass`; those of a quick run."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the others in turns with the 5-state filter; the compass also over a stored tape.

    Returns:
        ``kalman``, then the other methods and ``compass_tape`` with their ``ratio`` to it; likewise
        ``kalman_alone`` and the methods with one variant a draw.
    """
    groups = {
        "kalman": default_group(),
        **{name: method_group(name) for name in (QUICK if quick else OTHERS)},
        "compass": compass_group(),
        "compass_tape": compass_group(RECORD_S),
    }
    if quick:
        groups = {name: shorten_runs(group, 7) for name, group in groups.items()}
    silent = {name: remove_noise(group) for name, group in groups.items()}
    alone = {name: group for name, group in silent.items() if group.n_variants == 1}
    alone = {"kalman_alone": select_last_variants(silent["kalman"], 1), **alone}
    measured = []
    for side in ({k: v for k, v in silent.items() if k not in alone}, alone):
        base, *others = (engine_workload(name, group) for name, group in side.items())
        measured += measure_relative_to_base(base, others, repeats)
    return measured


if __name__ == "__main__":
    common.main(rows)
