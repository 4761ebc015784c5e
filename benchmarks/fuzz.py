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
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

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


class Find(NamedTuple):
    """What went wrong.

    Attributes:
        target: what was asked.
        signature: what tells it from others.
        text: of the error.
        case: the smallest with which it happens.
    """

    target: str
    signature: str
    text: str
    case: Any


def hunt(all_: list[Target], minutes: float, seed: int) -> tuple[Counter[str], list[Find]]:
    """Gives cases to all targets in turn; the numbers of cases, and one find of each kind."""
    counts: Counter[str] = Counter()
    finds: dict[str, Find] = {}
    until = time.monotonic() + 60 * minutes
    number = 0
    while time.monotonic() < until:
        for target in all_:
            if found := one_round(target, seed + number, until, counts, finds):
                finds[found.signature] = found
                show(found)
        number += 1
    return counts, list(finds.values())


def one_round(
    target: Target, seed: int, until: float, counts: Counter[str], known: dict[str, Find]
) -> Find | None:
    """Some cases of a target; the first find that is new, made small."""
    last: list[Any] = [None, None]

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
        if time.monotonic() > until + 60:
            return
        counts[target.name] += 1
        try:
            measure_case(target.check, case)
        except Exception as error:
            if error_signature(error) in known:
                return
            last[:] = error, case
            raise

    try:
        check()
    except Flaky:
        pass  # told by what it was when it was
    except Exception as error:
        if last[0] is None:
            raise error
    if last[0] is None:
        return None
    return Find(target.name, error_signature(last[0]), str(last[0]), last[1])


def show(found: Find) -> None:
    """Prints a find."""
    case = repr(found.case)
    more = f"... ({len(case)} characters)" if len(case) > _SHOWN else ""
    print(f"FIND in {found.target}: {found.signature}\n  {found.text[:500]}", flush=True)
    print(f"  with {case[:_SHOWN]}{more}", flush=True)


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
    seed = flags.seed or time.time_ns() // 10**9
    with tempfile.TemporaryDirectory(prefix="sinsjax-fuzz-") as folder:
        all_ = [t for t in make_targets(Path(folder)) if flags.target in (None, t.name)]
        if not all_:
            parser.error(f"--target: there is no {flags.target}")
        since = time.monotonic()
        counts, finds = hunt(all_, flags.minutes, seed)
    told = ", ".join(f"{count:,} {name}" for name, count in counts.items())
    minutes = (time.monotonic() - since) / 60
    print(f"seed {seed}, {minutes:.1f} minutes: {told}; {len(finds)} finds")
    for found in finds:
        print(f"  {found.target}: {found.signature}: {found.text[:200]}")
    sys.exit(1 if finds else 0)


if __name__ == "__main__":
    main()
