"""Any study or record is accepted or rejected in one line.

`python benchmarks/fuzz.py --minutes N` hunts for longer, and looks at time and memory too.
"""

from pathlib import Path

import pytest
from fuzzing.targets import limit_time, make_targets
from hypothesis import HealthCheck, Phase, given, settings

LATE_S = 60
"""Limit for hanging cases only; a case may take two seconds on an idle machine."""


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["studies", "records"])
def test_fuzzed_input_is_accepted_or_refused_in_one_line(name: str, tmp_path: Path):
    (target,) = (target for target in make_targets(tmp_path) if target.name == name)

    @settings(
        max_examples=1000,
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(target.cases)
    def check(case: object) -> None:
        with limit_time(LATE_S):
            target.check(case)

    check()
