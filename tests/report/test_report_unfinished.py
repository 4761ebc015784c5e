"""The report of a study that was interrupted: of the draws that are whole, and it says so."""

import io
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from support.stored_results import store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax import report
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import run
from sinsjax.execution.results import Results
from sinsjax.execution.run import RunProgress

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

SHORT = {"draws": 300, "duration_s": 2.0, "window_s": [0, 2]}


def store_interrupted(out: Path, **tables: Any) -> Path:
    """Results of a study that was stopped while its first chunk ran."""
    stop = threading.Event()

    def on_progress(progress: RunProgress) -> None:
        if progress.done:
            stop.set()

    with pytest.raises(StudyInterrupted):
        run.run_into(
            small_study(study=SHORT, **tables),
            out,
            chunk_runs=128,
            on_progress=on_progress,
            stop=stop,
        )
    return out


def store_made_up(out: Path, **tables: Any) -> Path:
    """The same of 100 draws and the first variant of another, from numbers that no engine made."""
    study = small_study(study=SHORT, **tables)
    out.mkdir()
    return store_results(
        out, study, synthetic_summary(study).slice(0, 301), state="interrupted", wall_s=9.0
    )


def printed_lines(out: Path, page: Path | None = None) -> list[str]:
    console = Console(file=io.StringIO(), width=2000)
    report.print_reports([out], console, page, full=True)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize(
    "store", [store_made_up, pytest.param(store_interrupted, marks=pytest.mark.nightly)]
)
def test_unfinished_report_warns_with_share_of_runs(
    store: Callable[..., Path], tmp_path: Path
) -> None:
    out = store(tmp_path / "out", axes={"p0_yaw_deg": [10.0, 40.0, 60.0]})
    page = tmp_path / "page.html"
    lines = [line for line in printed_lines(out, page) if line]
    source = Results.read(out, whole_draws=True)
    whole = source.draws
    there = Results.read(out).runs
    assert 0 < whole < 300 and whole == there // 3
    assert source.rows(["draw_id"])["draw_id"].to_numpy().tolist() == [
        draw for draw in range(whole) for _ in range(3)
    ]
    share = f"unfinished: {there} of 900 runs are done ({100 * there / 900:.2g} %)"
    assert lines[0].startswith(f"study: unfinished, {3 * whole} of 900 runs in ")
    warning = next(line for line in lines if line.startswith("  Warning "))
    assert f"{share}; shown are the {whole} draws" in warning
    assert f"<strong>Warning:</strong> {share}" in page.read_text()
    with pytest.raises(InputError, match="continue with `--resume`"):
        _ = Results.read(out).draws


@pytest.mark.nightly
def test_report_without_complete_draw_is_refused(tmp_path: Path) -> None:
    out = store_interrupted(tmp_path / "out", axes={"specific_force": ["measured", "gravity"]})
    with pytest.raises(InputError, match=r"unfinished: .* and no draw that every variant has") as e:
        printed_lines(out)
    assert "\n" not in str(e.value)
