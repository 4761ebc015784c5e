"""The files in a results directory that sinsjax wrote; it never removes any others."""

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.platform.files import replacing

WHOLE = ("summary", "estimates")
"""Datasets of one row a run, or a variant, written last: a part implies its like in the others."""

DATASETS = (*WHOLE, "curves")
RERUN = ("summary.parquet", "curve.parquet", "curve.png")
"""Files of a repeated run."""

FIGURES = ".figures.json"
"""List of the figures drawn, in the results directory."""


def check_name(directory: Path) -> None:
    """Refuse a results directory that Arrow cannot open, whose name is not UTF-8.

    Raises:
        InputError: it has such a name, or lies in a folder that has.
    """
    try:
        os.fspath(directory).encode()
    except UnicodeEncodeError:
        text = "results cannot be kept under a name that is not UTF-8 (rename it)"
        raise InputError(f"{directory}: {text}") from None


def is_part(path: Path) -> bool:
    """Whether a file is named like a part, which no user's file is by chance."""
    return re.fullmatch(r"part-\d{4,}-\d{6,}\.parquet", path.name) is not None


def left_behind(directory: Path) -> list[Path]:
    """Temporary files left by processes killed while writing results or a tuning run."""
    names = [".manifest.json", ".study.toml", f".{FIGURES}", "figures/.*.png"]
    names += [".tuned.toml", ".history.parquet"]
    patterns = (f"{name}.*.tmp" for name in names)
    parts = (f"{name}/.part-*.tmp" for name in DATASETS)
    found = (path for pattern in (*patterns, *parts) for path in directory.glob(pattern))
    return [path for path in found if re.search(r"\.\d+\.tmp$", path.name)]


def made_here(directory: Path) -> list[Path]:
    """Files in a directory that sinsjax wrote, identified by name, and figures by their list.

    This excludes files added by the user, and figures changed since they were drawn.
    """
    parts = (p for name in DATASETS for p in directory.glob(f"{name}/*.parquet") if is_part(p))
    again = (
        path
        for number in directory.glob("reruns/*")
        if re.fullmatch(r"\d+", number.name)
        for path in (number / name for name in RERUN)
        if path.is_file()
    )
    study = (path for path in (directory / "study.toml",) if path.is_file())
    return [*parts, *again, *study, *_figures(directory)]


def list_figures(images: Mapping[str, bytes], directory: Path) -> None:
    """Add figures to the list of those drawn in a directory.

    Args:
        images: contents of PNG files by file name.
        directory: results directory.

    Raises:
        InputError: the list cannot be written.
    """
    listed = _listed(directory) | {name: _sha256(content) for name, content in images.items()}
    with replacing(directory / FIGURES) as file:
        file.write((json.dumps(listed, indent=1) + "\n").encode())


def _figures(directory: Path) -> Iterator[Path]:
    """Listed figures that have not changed since they were drawn, and the list itself."""
    for name, sha in _listed(directory).items():
        path = directory / "figures" / Path(name).name
        with suppress(OSError):
            if _sha256(path.read_bytes()) == sha:
                yield path
    if (directory / FIGURES).is_file():
        yield directory / FIGURES


def _listed(directory: Path) -> dict[str, str]:
    try:
        listed = json.loads((directory / FIGURES).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return {str(k): str(v) for k, v in listed.items()} if isinstance(listed, dict) else {}


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
