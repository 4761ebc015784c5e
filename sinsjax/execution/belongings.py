"""Which files in a directory of results were made here: nothing else in it is ever removed."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from sinsjax.platform.files import replacing

DATASETS = ("summary", "curves")
RERUN = ("summary.parquet", "curve.parquet", "curve.png")
"""What is kept of a run done again."""

FIGURES = ".figures.json"
"""The list of the figures that were drawn, beside their folder."""


def is_part(path: Path) -> bool:
    """Whether a file has the name of a part, which no other file of a user has by chance."""
    return re.fullmatch(r"part-\d{4,}-\d{6,}\.parquet", path.name) is not None


def left_behind(directory: Path) -> list[Path]:
    """What killed processes left of files of ours that were not yet whole, a tuning's too."""
    names = [".manifest.json", ".study.toml", f".{FIGURES}", "figures/.*.png"]
    names += [".tuned.toml", ".history.parquet"]
    patterns = (f"{name}.*.tmp" for name in names)
    parts = (f"{name}/.part-*.tmp" for name in DATASETS)
    found = (path for pattern in (*patterns, *parts) for path in directory.glob(pattern))
    return [path for path in found if re.search(r"\.\d+\.tmp$", path.name)]


def made_here(directory: Path) -> list[Path]:
    """The files in a directory that were made here: by their names, figures by their list.

    Not what a person has put beside them, nor a figure that is no longer as it was drawn.
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
    """Notes which figures of a directory were drawn here, beside those noted before.

    Args:
        images: PNG files by their names.
        directory: of the results.

    Raises:
        InputError: it cannot be written.
    """
    told = _listed(directory) | {name: _sha256(content) for name, content in images.items()}
    with replacing(directory / FIGURES) as file:
        file.write((json.dumps(told, indent=1) + "\n").encode())


def _figures(directory: Path) -> Iterator[Path]:
    """The figures that were drawn here and are as they were, and their list."""
    for name, sha in _listed(directory).items():
        path = directory / "figures" / Path(name).name
        with suppress(OSError):
            if _sha256(path.read_bytes()) == sha:
                yield path
    if (directory / FIGURES).is_file():
        yield directory / FIGURES


def _listed(directory: Path) -> dict[str, str]:
    try:
        told = json.loads((directory / FIGURES).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return {str(k): str(v) for k, v in told.items()} if isinstance(told, dict) else {}


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
