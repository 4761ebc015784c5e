"""Two tiers of tests: fast ones for every change, and slow ones that CI runs after them."""

import pytest


def mark_slow_cases(items: list[pytest.Item], *, whole_files: bool) -> None:
    """Mark the cases of a parametrised test slow that its `representative` marker does not list.

    Args:
        items: The collected tests.
        whole_files: Whether all cases of each test were collected, not single ones by name.

    Raises:
        pytest.UsageError: a marker lists a case that does not exist.
    """
    absent: dict[str, set[str]] = {}
    for item in items:
        if (mark := item.get_closest_marker("representative")) is None:
            continue
        case = item.callspec.id  # a test without parameters has no cases to choose from
        absent.setdefault(item.nodeid.partition("[")[0], set(mark.args)).discard(case)
        if case not in mark.args:
            item.add_marker(pytest.mark.slow)
    for test, cases in absent.items():
        if cases and whole_files:
            raise pytest.UsageError(f"{test}: no such representative cases: {sorted(cases)}")
