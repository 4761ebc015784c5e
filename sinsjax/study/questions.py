"""Open questions of a study: keys with "?" in place of a value, as `init record` writes them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sinsjax.errors import ErrorCollector
from sinsjax.study.files import OPEN, QUESTION, find_study_file


def reject_open_questions(tables: Mapping[str, Any], path: str | Path | None = None) -> None:
    """Refuse a study with open questions.

    Args:
        tables: sections by name.
        path: its file, whose comments have the evidence; None without one.

    Raises:
        InputError: a line for each open question, with its evidence and the way to answer it.
    """
    sections = {name: table for name, table in tables.items() if isinstance(table, Mapping)}
    places = [(name, k) for name, table in sections.items() for k, v in table.items() if v == OPEN]
    evidence = _read_evidence(path) if places and path is not None else {}
    errors = ErrorCollector()
    for section, key in places:
        text = evidence.get(key, "it has no value")
        way = f"answer it there, or by --set {section}.{key}=VALUE"
        errors.add(f"[{section}] {key}: an open question: {text} ({way})")
    errors.raise_all()


def _read_evidence(path: str | Path) -> dict[str, str]:
    """Return the comment about each open key of a study file, in one line."""
    evidence, comment = dict[str, str](), list[str]()
    for line in find_study_file(path).read_text("utf-8-sig").splitlines():
        if line.startswith(QUESTION):
            comment = [line.removeprefix(QUESTION).strip()]
        elif line.startswith("#") and comment:
            comment.append(line.lstrip("# "))
        else:
            if comment and "=" in line:
                evidence[line.partition("=")[0].strip()] = " ".join(comment)
            comment = []
    return evidence
