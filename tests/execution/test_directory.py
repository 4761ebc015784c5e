"""A results directory: one writer, no links or pipes, sealed files, and files that may go."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure
from support.studies import small_study
from support.sweep_directories import read_files_and_times

import sinsjax
from sinsjax import plots
from sinsjax.errors import InputError
from sinsjax.execution.directory import (
    SEAL_KEY,
    is_intact,
    remove_other_figures,
    to_sealed_json,
    to_sealed_parquet,
)
from sinsjax.execution.results import Results
from sinsjax.study.load import study_to_toml

pytestmark = pytest.mark.optimised(False)

AXES = {"phi_u0_deg": [5.0, 10.0], "p0_yaw_deg": [20.0, 40.0, 80.0]}
STUDY = small_study(study={"curves": True}, axes=AXES)  # its program is that of `test_results`


def test_figure_drawn_no_longer_is_removed_unless_another_program_wrote_it(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    drawn = plots.render_png(Figure(figsize=(1, 1)))
    for name, content in {
        "a": drawn,
        "b": drawn.replace(b"sinsjax", b"GIMP3.0"),
        "c": drawn,
    }.items():
        (tmp_path / "figures" / f"{name}.png").write_bytes(content)
    remove_other_figures(tmp_path, ["c.png"])
    assert sorted(path.name for path in tmp_path.glob("figures/*")) == ["b.png", "c.png"]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a results directory of a sweep."""
    out = tmp_path_factory.mktemp("results") / "out"
    sinsjax.run_into(STUDY, out)
    return out


def replace_by_link(path: Path) -> None:
    """Replace a file or folder by a link to a copy elsewhere."""
    path.rename(path.with_name(f"{path.name}.moved"))
    path.symlink_to(path.with_name(f"{path.name}.moved"))


def replace_by_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


PLACED: dict[str, Callable[[Path], None]] = {
    "manifest.json": replace_by_pipe,
    "study.toml": replace_by_link,
    ".lock": replace_by_pipe,
    "summary": replace_by_link,
    "reruns": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("name", PLACED)
def test_links_and_pipes_in_results_are_refused_unchanged(
    results: Path, tmp_path: Path, name: str
) -> None:
    out = Path(shutil.copytree(results, tmp_path / "out"))
    PLACED[name](out / name)
    before = read_files_and_times(tmp_path)
    for attempt in (
        lambda: sinsjax.run_into(STUDY, out, resume=True),
        lambda: sinsjax.run_into(STUDY, out, overwrite=True),
        lambda: Results.read(out),
    ):
        with pytest.raises(InputError, match=rf"{name}: is a link or a pipe"):
            attempt()
    assert read_files_and_times(tmp_path) == before


def test_edited_study_of_results_is_named(results: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(results, tmp_path / "out"))
    study = small_study(study={"curves": True}, axes=AXES, sensors={"gyro_bias_deg_per_h": 0.5})
    (out / "study.toml").write_text(study_to_toml(study))
    with pytest.raises(InputError, match=r"study\.toml: .* \[sensors\] gyro_bias_deg_per_h: 0\.1 "):
        Results.read(out)
    sinsjax.run_into(STUDY, out, resume=True)
    assert Results.read(out).study == STUDY


CONTENTS = {
    "parquet": to_sealed_parquet(pa.table({"run_id": [1, 2]}), {"sinsjax.study": "0123"}),
    "json": to_sealed_json({"state": "complete", "warnings": [f'{SEAL_KEY}": "1']}),
}


@pytest.mark.parametrize("kind", CONTENTS)
def test_any_flipped_bit_is_noticed(kind: str) -> None:
    content = CONTENTS[kind]
    assert is_intact(content)
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        assert not is_intact(bytes(flipped)), place
        assert not is_intact(content[:place])


def test_any_flipped_bit_of_results_is_named(results: Path, tmp_path: Path) -> None:
    """Checksums of pages leave footers and page headers out: a flip there can read as nulls."""
    out = Path(shutil.copytree(results, tmp_path / "out"))
    (summary,), (curves,) = out.glob("summary/*.parquet"), out.glob("curves/*.parquet")
    for path in (out / "manifest.json", summary, curves):
        content = path.read_bytes()
        for bit in np.random.default_rng(14).integers(0, 8 * len(content), size=40):
            flipped = bytearray(content)
            flipped[bit // 8] ^= 1 << bit % 8
            path.write_bytes(flipped)
            with pytest.raises(InputError, match=f"{path.name}: has changed since"):
                assert Results.read(out).curves
        path.write_bytes(content)
    assert Results.read(out).runs == 18
