"""The short set: time of the engine's step on one core, in ns per step per run."""

import sys
import tempfile

import common
from cases import SHORT
from limit import find_compiler, limit_kernel_workload
from timing import Row, Workload, measure_workloads, measurement_conditions, pin_to_one_core

from sinsjax.errors import InputError
from sinsjax.platform import runtime


def short_workloads(limit_folder: str | None) -> list[Workload]:
    """Return the short set, compiled; with a folder also the limit kernel, if gcc works."""
    out = []
    if limit_folder:
        try:
            out.append(limit_kernel_workload(find_compiler(), limit_folder))
        except InputError as error:
            print(f"warning: no limit kernel: {error}", file=sys.stderr)
    return out + [make() for make in SHORT.values()]


def measure(*, limit: bool, repeats: int) -> list[Row]:
    """Time the short set on one core."""
    pin_to_one_core()
    runtime.start_jax_on_chosen_platform()
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        return measure_workloads(short_workloads(folder if limit else None), repeats)


def main() -> None:
    """Time the short set and print it."""
    parser = common.parser(__doc__ or "", repeats=7)
    parser.add_argument("--limit", action="store_true", help="also the limit kernel (needs gcc)")
    flags = parser.parse_args()
    rows = common.or_exit(lambda: measure(limit=flags.limit, repeats=flags.repeats))
    conditions = measurement_conditions()
    if conditions["platform"] == "cpu" and conditions["options"] != "all":
        print("warning: not all compiler options are set, see `sinsjax info`", file=sys.stderr)
    common.show(rows, conditions, as_json=flags.json)


if __name__ == "__main__":
    main()
