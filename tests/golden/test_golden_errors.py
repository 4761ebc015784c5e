"""Where the errors of bad studies are: file, section and key of each, not the words."""

import json
from pathlib import Path

import golden_errors
import pytest


def test_faulty_studies_give_expected_files_sections_and_keys(tmp_path: Path) -> None:
    old = json.loads(golden_errors.EXPECTED.read_text("utf-8"))
    found = golden_errors.differences(old, golden_errors.all_errors(tmp_path))
    if found:
        pytest.fail("\n".join([f"{len(found)} differences:", *found]), pytrace=False)


def test_every_faulty_study_has_an_error() -> None:
    old = json.loads(golden_errors.EXPECTED.read_text("utf-8"))
    assert old.keys() == golden_errors.bad_studies().keys()
    assert all(old.values())
