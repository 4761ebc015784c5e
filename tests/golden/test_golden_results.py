"""Results of small studies, number by number: the net under changes that should move none.

Where numbers are meant to change, `remake.py` makes the expected files anew.
"""

import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from golden_studies import (
    ENVIRONMENT,
    HERE,
    NAMES,
    REPORT,
    STUDIES,
    as_json,
    differences,
    expected,
    expected_file,
    run_alone,
)

from sinsjax.methods.registry import METHODS, PACKAGES

SAME_JAXLIB, OTHER_JAXLIB = 1e-11, 1e-6
"""Tolerances relative to the largest number of a column.

Expected files have 12 digits, which the jaxlib that they were made with gives again; the filter's
update, multiplied out, moves them by 3e-12 at most. Another jaxlib may order sums and products
differently, and what that changes in the last bits grows over a run.
"""

OPTIMISED = 1e-7
"""Tolerance of optimised programs.

Their instruction set is that of the expected files: with AVX2, products fused with sums change the
sensors' noise, which is in single precision, in its last bits, and a heading by up to 4e-7.
"""

OPTIMISED_STUDIES = ("compass_passes", "drawn_disturbed", "inertial", "kalman10_sway", "recorded")
OPTIMISED_STUDIES += ("large_heading", "sincos_triggers", "without_start")
"""Studies that have every method between them; optimised, each takes some times longer."""


def methods_of(study: dict) -> Iterator[str]:
    """Yield every method that a study names."""
    for table in (*study.get("cases", ()), study.get("axes", {}), study.get("alignment", {})):
        named = table.get("method", [])
        yield from [named] if isinstance(named, str) else named


@pytest.mark.parametrize("names", [STUDIES, OPTIMISED_STUDIES], ids=["all", "optimised"])
def test_every_method_is_in_a_golden_study(names: Sequence[str]) -> None:
    files = [HERE / "studies" / f"{name}.toml" for name in names]
    found = {method for file in files for method in methods_of(tomllib.loads(file.read_text()))}
    here = {name for name, method in METHODS.items() if not method.is_external} - {*PACKAGES}
    assert found == here


@pytest.mark.nightly(fast=("kalman5_resets", "large_heading", "without_start", "advice", "score"))
@pytest.mark.parametrize("name", NAMES)
def test_golden_study_gives_expected_results(name: str, tmp_path: Path) -> None:
    old, new = expected(name), run_alone(name, tmp_path)
    tolerance = SAME_JAXLIB if old["jaxlib"] == new["jaxlib"] else OTHER_JAXLIB
    found = differences(old, new, tolerance)
    assert not found, "\n".join(found)


@pytest.mark.nightly
@pytest.mark.optimised(True)
@pytest.mark.parametrize("name", OPTIMISED_STUDIES)
def test_optimised_program_gives_expected_results(name: str, tmp_path: Path) -> None:
    """Not those of its report, whose rounded numbers may turn at the last digit."""
    optimised = ENVIRONMENT | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
    old, new = expected(name), run_alone(name, tmp_path, environment=optimised)
    for recorded in (old, new):
        del recorded["tables"][REPORT]
    found = differences(old, new, OPTIMISED)
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", NAMES)
def test_expected_files_are_in_canonical_form(name: str) -> None:
    assert as_json(expected(name)) == expected_file(name).read_text("utf-8")
