"""What a study of very many variants takes before it runs: its columns, and a part's arguments."""

import time
import tomllib

import common

from sinsjax.bench.timing import Row
from sinsjax.engine.batch import plan
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import tiles_of
from sinsjax.execution.tables import TableBuilder
from sinsjax.platform.assets import asset_path
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time what is done once for a study, and once for a block of draws of a part.

    Returns:
        ``resolve_N`` with N variants: a scenario and the columns of the tables; ``part_N``: the
        part's arguments for one draw, and the tiles of its first call. The truth is left out.
    """
    first = 10 if quick else 1000
    size = {"runs": 600 * first, "steps": 0, "dtype": "float64", "devices": 1}
    scenarios, arguments = [], []
    for _ in range(repeats + 1):
        study = many_variants(first)
        since = time.perf_counter()
        scenario = Scenario(study)
        TableBuilder(study)
        scenarios.append(time.perf_counter() - since)
        since = time.perf_counter()
        group = scenario.part(0, range(1), blank=True).group
        tiles_of(group, plan(group)[0])
        arguments.append(time.perf_counter() - since)
    return [
        common.seconds(f"resolve_{600 * first}", scenarios[1:]) | size,  # the first one compiles
        common.seconds(f"part_{600 * first}", arguments[1:]) | size,
    ]


def many_variants(first: int) -> Study:
    """The default sweep over 100 cycles, 6 counts and some initial heading errors."""
    data = tomllib.loads(asset_path("configs/reset_sweep.toml").read_text(encoding="utf-8"))
    data["study"] |= {"draws": 1, "judged_from": "truth"}
    data["axes"] |= {
        "reset_cycle_s": [10.0 + i for i in range(100)],
        "reset_count": [0, 1, 2, 3, 4, 5],
        "phi_u0_deg": [90.0 * i / first for i in range(first)],
    }
    return study_from_dict(data)


if __name__ == "__main__":
    common.main(rows, one_core=True, repeats=5)
