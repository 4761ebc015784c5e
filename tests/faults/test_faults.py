"""The list of faults applies to today's package, and its recorded outcomes hold."""

import ast
import random
import tempfile
from collections import Counter
from pathlib import Path

import pytest

from faults import run
from faults.patches import Fault, load

REPOSITORY = Path(__file__).parents[2]
FAULTS = load()
OUTCOMES = run.known_outcomes(run.OUTCOME)

SPOT_CHECKS = 2
"""Faults tried again in CI, drawn by a fixed seed; `run.py` tries all."""


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault_applies_and_is_one_line_of_valid_python(fault: Fault) -> None:
    sound = (REPOSITORY / fault.file).read_text()
    changed = fault.patched(sound)
    assert "\n" not in fault.old + fault.new
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(sound))
    assert all((REPOSITORY / test).is_file() for test in fault.tests)


def test_list_covers_every_folder_of_the_package() -> None:
    folders = {path.parent.name for path in (REPOSITORY / "sinsjax").glob("*/__init__.py")}
    counts = Counter(fault.folder for fault in FAULTS)
    assert {folder: counts[folder] for folder in folders if counts[folder] < 4} == {}
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 60


def test_every_fault_has_an_outcome_and_most_are_killed_by_fast_tests() -> None:
    assert OUTCOMES.keys() == {fault.name for fault in FAULTS}
    tiers = Counter(row["tier"] for row in OUTCOMES.values() if run.killers(row))
    assert sum(tiers.values()) >= 0.9 * len(FAULTS)
    assert tiers["fast"] >= 0.8 * len(FAULTS)


def test_recorded_killers_exist() -> None:
    killers = [killer for row in OUTCOMES.values() for killer in run.killers(row)]
    missing = []
    for killer in filter(lambda name: "::" in name, killers):
        file, function = killer.partition("[")[0].split("::", 1)
        if f"def {function}(" not in (REPOSITORY / file).read_text():
            missing.append(killer)
    assert missing == []


@pytest.mark.nightly
def test_recorded_killers_pass_without_their_fault_and_fail_with_it() -> None:
    killers = {fault: next(iter(run.killers(OUTCOMES[fault.name])), "") for fault in FAULTS}
    faults = [fault for fault, killer in killers.items() if "::" in killer]
    drawn = random.Random(7).sample(faults, SPOT_CHECKS)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        run.copy_tree(REPOSITORY, copy)
        assert run.failures(copy, [killers[fault] for fault in drawn]) == []
        for fault in drawn:
            file = copy / fault.file
            sound = file.read_text()
            file.write_text(fault.patched(sound))
            assert run.failures(copy, ["-x", killers[fault]])[0].startswith(killers[fault])
            file.write_text(sound)
