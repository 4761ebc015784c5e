"""Remake expected results: ``python tests/golden/remake.py [NAME...]``.

NAME is one of ``golden_studies.NAMES`` (a study of ``studies/``, or what else has results), or
``errors``; without one all are remade. The changes of each file are printed.

The rule: expected files change only in a commit that says which of them change, and why.
"""

import json
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))  # this checkout's package, not an installed one

import golden_errors  # noqa: E402
import golden_studies  # noqa: E402

ERRORS = "errors"


def main(names: list[str]) -> None:
    """Remake the expected files of some studies, or of all."""
    known = [*golden_studies.NAMES, ERRORS]
    if unknown := sorted({*names} - {*known}):
        sys.exit(f"no golden study: {', '.join(unknown)} (there are {', '.join(known)})")
    for name in names or known:
        with tempfile.TemporaryDirectory() as folder:
            changes = (_errors if name == ERRORS else _study)(name, Path(folder))
        print(f"{name}: {len(changes)} changes")
        for line in changes:
            print(f"  {line}")


def _study(name: str, folder: Path) -> list[str]:
    """Remake the results of a study; return its changes, one line per column."""
    file, new = golden_studies.expected_file(name), golden_studies.run_alone(name, folder)
    old = golden_studies.expected(name) if file.exists() else {"tables": {}}
    file.write_text(golden_studies.as_json(new), "utf-8")
    return golden_studies.differences(old, new, tolerance=0.0)


def _errors(name: str, folder: Path) -> list[str]:
    """Remake the places of errors; return the studies that changed."""
    file, new = golden_errors.EXPECTED, golden_errors.all_errors(folder)
    old = json.loads(file.read_text("utf-8")) if file.exists() else {}
    file.write_text(golden_errors.as_json(new), "utf-8")
    return [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]


if __name__ == "__main__":
    main(sys.argv[1:])
