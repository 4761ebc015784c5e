"""Results directories with an error in the manifest, the study or a part."""

import functools
import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import strategies as st
from support.studies import small_study

import sinsjax
from fuzzing.edits import HiddenValue, edit_tables, mangle_bytes
from sinsjax.execution.sealed import SEAL_KEY

STUDY = small_study(
    study={"duration_s": 2.0, "window_s": [0, 2], "curves": True, "success_band_arcmin": 6000.0}
)
MANIFEST, TEXT = "manifest.json", "study.toml"


class Case(NamedTuple):
    """Changed files of a directory by name; the others remain."""

    files: dict[str, bytes | None]


@functools.cache
def _results_of_study() -> dict[str, bytes]:
    """Run `STUDY` once; return the files of its results by name."""
    with tempfile.TemporaryDirectory() as folder:
        sinsjax.run_into(STUDY, folder)
        found = [Path(folder, MANIFEST), Path(folder, TEXT), *Path(folder).glob("*/*.parquet")]
        return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def write_results(directory: Path) -> dict[str, bytes]:
    """Write the results of `STUDY`; return the files."""
    files = dict(_results_of_study())
    for name, content in files.items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_bytes(content)
    return files


def _seal_any_json(data: dict[str, Any]) -> bytes:
    """Seal JSON of any values, including NaN, which sinsjax does not write."""
    blank = "0" * 64
    others = {key: value for key, value in data.items() if key != SEAL_KEY}
    text = json.dumps({**others, SEAL_KEY: blank}, default=str).encode()
    head, tail = text.rsplit(blank.encode(), 1)
    return head + hashlib.sha256(text).hexdigest().encode() + tail


@st.composite
def manifest_cases(draw: st.DrawFn, files: HiddenValue) -> Case:
    """Draw a directory in which one or two files are changed, cut or removed."""
    parts = sorted(name for name in files.value if name.endswith(".parquet"))
    changed: dict[str, bytes | None] = {}
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from([MANIFEST] * 6 + [TEXT, *parts]))
        kind = draw(st.sampled_from(["edit"] * 5 + ["mangle"] * 2 + ["remove"]))
        if kind == "remove":
            changed[name] = None
        elif kind == "edit" and name == MANIFEST:
            data = draw(edit_tables(HiddenValue(json.loads(files.value[MANIFEST]))))
            is_sealed = isinstance(data, dict) and draw(st.booleans())  # reaches its entries
            changed[name] = (
                _seal_any_json(data) if is_sealed else json.dumps(data, default=str).encode()
            )
        else:
            changed[name] = draw(mangle_bytes(HiddenValue(files.value[name])))
    return Case(changed)
