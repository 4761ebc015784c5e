"""A long hunt for studies and records that end in anything but a result or one line.

It makes what `tests/fuzzing` makes, with other numbers each time, for as long as is asked, and
looks at the time and the memory of every case too. Exit status 1 where anything was found.
"""

import argparse
import faulthandler
import re
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import common
import hypothesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Flaky

import sinsjax

sys.path.insert(0, str(common.ROOT / "tests"))

from fuzzing.targets import Target, limit_time, make_targets  # noqa: E402
from support.memory import process_bytes  # noqa: E402

ROUND = 250
"""Cases of a target, before the next one has its turn."""

MAX_S, MAX_BYTES = 2.0, 500e6
"""Longest time, s, and largest memory of a case."""

_SHOWN = 3000


def error_signature(error: BaseException) -> str:
    """Return the signature of an error: its kind and where it was raised."""
    cause = error.__cause__ or error
    package = Path(sinsjax.__file__).parent
    frames = traceback.extract_tb(cause.__traceback__)
    frames = [frame for frame in frames if Path(frame.filename).is_relative_to(package)]
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "no line of ours"
    message = re.sub(r"[\d.]+", "N", str(error))[:40] if isinstance(error, AssertionError) else ""
    return f"{type(error).__name__} {message} at {place}"


def measure_case(check: Callable[[Any], None], case: Any) -> None:
    """Check a case; raise an error if it takes too long, or too much memory."""
    with suppress(OSError):  # resets the peak
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before, since = process_bytes("VmRSS"), time.process_time()
    with limit_time(10 * MAX_S):
        check(case)
    taken, grown = time.process_time() - since, process_bytes("VmHWM") - before
    if taken > MAX_S or grown > MAX_BYTES:
        raise AssertionError(f"takes {taken:.1f} s of a core and {grown / 1e6:.0f} MB")


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
