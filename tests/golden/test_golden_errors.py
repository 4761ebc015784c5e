"""Where the errors of bad studies are: file, section and key of each, not the words."""

import json
from pathlib import Path

import golden_errors


def test_faulty_studies_give_expected_files_sections_and_keys(tmp_path: Path) -> None:
    found = golden_errors.all_errors(tmp_path)
    assert all(found.values())
    assert found == json.loads(golden_errors.EXPECTED.read_text("utf-8"))
