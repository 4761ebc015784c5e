"""The history: a JSON list of rows a version and machine, in ``history/``."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax.bench.timing import Row
from sinsjax.errors import InputError
from sinsjax.platform.files import atomic_write

HISTORY = Path(__file__).parent / "history"


class Machine(NamedTuple):
    """What one version did on one machine.

    Attributes:
        version: of sinsjax.
        name: of the processor, or of the GPU.
        sets: rows by name, by set.
    """

    version: str
    name: str
    sets: Mapping[str, Mapping[str, Row]]

    @classmethod
    def of(cls, rows: Sequence[Row]) -> "Machine":
        """From the rows of a history file."""
        sets: dict[str, dict[str, Row]] = {}
        for row in rows:
            sets.setdefault(row["set"], {})[row["name"]] = row
        first = rows[0]
        name = f"{first['cpu']}{f' ({told})' if (told := set_in_force(first)) else ''}"
        return cls(first["sinsjax"], name if on_cpu(first) else first["device"], sets)

    def row(self, of: str, name: str) -> Row | None:
        """A row of a set; None if it was not measured."""
        return self.sets.get(of, {}).get(name)

    @property
    def on_gpu(self) -> bool:
        """Whether it is a GPU."""
        return "gpu" in self.sets

    @property
    def x_limit(self) -> float | None:
        """Ratio of the engine to the limit kernel, in pairs if they were measured."""
        if pair := self.row("pairs", "kalman_shared_record"):
            return float(pair["ratio"])
        ours, kernel = (self.row("short", n) for n in ("kalman_shared_record", "limit_kernel"))
        return ours["ns_per_step_run"] / kernel["ns_per_step_run"] if ours and kernel else None


def machines(folder: Path = HISTORY) -> list[Machine]:
    """All of the history, oldest version first."""
    found = [Machine.of(rows) for path in sorted(folder.glob("*.json")) if (rows := read(path))]
    return sorted(found, key=lambda m: ([int(n) for n in re.findall(r"\d+", m.version)], m.name))


def on_cpu(row: Row) -> bool:
    """Whether a row was measured on a CPU."""
    return bool(row["platform"] == "cpu")


def set_in_force(row: Row) -> str:
    """The instruction set of a row; nothing where a row of an early version tells of none."""
    return {"AVX512": "AVX-512"}.get(told := row.get("instructions", ""), told) or (
        "AVX-512" if row["avx512"] else ""
    )


def file_name(row: Row) -> str:
    """The file that a row belongs to: version, and processor with its instruction set, or GPU."""
    told = set_in_force(row).replace("-", "")
    words = f"{row['cpu']} {told}" if on_cpu(row) else row["device"]
    plain = re.sub(r"\((r|tm)\)|@.*?hz|\b(cpu|processor)\b", " ", words.lower())
    return f"{row['sinsjax']}_{re.sub(r'[^a-z0-9]+', '-', plain).strip('-')}.json"


def keep(rows: Sequence[Row], sets: Sequence[str], folder: Path = HISTORY) -> list[Path]:
    """Write rows into the history, in place of earlier ones of their sets.

    Args:
        rows: with ``set``; all of their sets.
        sets: names of all sets, in the order in which files list them.
        folder: of the history.

    Returns:
        The files written.

    Raises:
        InputError: a file cannot be read or written.
    """
    files: dict[Path, list[Row]] = {}
    for row in rows:
        files.setdefault(folder / file_name(row), []).append(row)
    place = {name: number for number, name in enumerate(sets)}
    for path, fresh in files.items():
        folder.mkdir(parents=True, exist_ok=True)
        replaced = {row["set"] for row in fresh}
        kept = [row for row in read(path) if row["set"] not in replaced]
        write(path, sorted(kept + fresh, key=lambda row: place.get(row["set"], len(place))))
    return list(files)


def read(path: Path) -> list[Row]:
    """Rows of a file; none where there is no file.

    Raises:
        InputError: the file is no list of rows.
    """
    if not path.exists():
        return []
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path.name}: {error}") from None
    rows = rows if isinstance(rows, list) else [rows]
    if not all(isinstance(row, dict) and {"set", "name"} <= row.keys() for row in rows):
        raise InputError(f"{path.name}: is no list of rows with a set and a name")
    return rows


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write rows, one a line, whole or not at all; numbers keep five digits."""
    lines = [json.dumps({key: _tidy(value) for key, value in row.items()}) for row in rows]
    with atomic_write(path) as file:
        file.write(("[\n" + ",\n".join(lines) + "\n]\n").encode())


def _tidy(value: Any) -> Any:
    if isinstance(value, list):
        return [_tidy(one) for one in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value
