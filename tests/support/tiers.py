"""Two tiers of tests: those of every change, and those marked `nightly`."""

import pytest


def keep_fast_cases(items, *, whole_files):
    """Take the marker ``nightly(fast=...)`` off the cases that it names.

    Args:
        items: The collected tests.
        whole_files: Whether all cases of each test were collected, not single ones by name.

    Raises:
        pytest.UsageError: a marker names a case that does not exist.
    """
    absent = {}
    for item in items:
        for mark in [m for m in item.iter_markers("nightly") if "fast" in m.kwargs]:
            case, fast = item.callspec.id, mark.kwargs["fast"]
            absent.setdefault(item.nodeid.partition("[")[0], set(fast)).discard(case)
            if case in fast:
                item.own_markers.remove(mark)
    for test, cases in absent.items():
        if cases and whole_files:
            raise pytest.UsageError(f"{test}: no such fast cases: {sorted(cases)}")
