"""A long hunt for studies, manifests and records that end in anything but a result or one line.

It makes what `tests/acceptance/test_fuzzing.py` makes, with other numbers each time, for as long as
is asked, and looks at the time and the memory of every case too. Exit status 1 where anything was
found.
"""

import argparse
import faulthandler
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import common
import hypothesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Flaky

import sinsjax

sys.path.insert(0, str(common.ROOT / "tests"))

from fuzzing.targets import Target, error_signature, make_targets, measure_case  # noqa: E402

ROUND = 250
"""Cases of a target, before the next one has its turn."""

_SHOWN = 3000


def hunt_one_round(target: Target, seed: int, until: float, known: set[str]) -> int:
    """Give a target some cases; print a find that is new, made small; the number of cases."""
    last: list[Any] = []
    count = 0

    @hypothesis.seed(seed)
    @settings(
        max_examples=ROUND,
        deadline=None,
        database=None,
        report_multiple_bugs=False,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
        verbosity=hypothesis.Verbosity.quiet,
    )
    @given(target.cases)
    def check(case: Any) -> None:
        nonlocal count
        if time.monotonic() > until + 60:
            return
        count += 1
        try:
            measure_case(target.check, case)
        except Exception as error:
            if error_signature(error) not in known:
                last[:] = error, case
                raise

    try:
        with suppress(Flaky):  # the error itself is in `last`
            check()
    except Exception as error:
        if not last:
            raise error
    if last:
        known.add(error_signature(last[0]))
        print(f"FIND in {target.name}: {error_signature(last[0])}\n  {str(last[0])[:500]}")
        print(f"  with {repr(last[1])[:_SHOWN]}", flush=True)
    return count


def main() -> None:
    """Hunt, and tell."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=1.0, help="how long (1)")
    parser.add_argument("--seed", type=int, default=0, help="of the cases; 0 takes the time's")
    parser.add_argument("--target", help="only this one")
    flags = parser.parse_args()
    faulthandler.enable()
    sinsjax.configure(devices=1)
    warnings.simplefilter("error")  # as in the tests: an overflow is a find
    seed, number, count = flags.seed or time.time_ns() // 10**9, 0, 0
    found: set[str] = set()
    with tempfile.TemporaryDirectory(prefix="sinsjax-fuzz-") as folder:
        targets = [t for t in make_targets(Path(folder)) if flags.target in (None, t.name)]
        if not targets:
            parser.error(f"--target: there is no {flags.target}")
        until = time.monotonic() + 60 * flags.minutes
        while time.monotonic() < until:
            for target in targets:
                count += hunt_one_round(target, seed + number, until, found)
            number += 1
    print(f"seed {seed}: {count:,} cases; {len(found)} finds")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
