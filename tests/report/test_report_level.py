"""Reports on methods that find no heading, alone and next to others."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from support.studies import STILL, small_study

from sinsjax.execution import run
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.tables import replace_column
from sinsjax.report import attitude, monte_carlo
from sinsjax.report.base import Table

pytestmark = pytest.mark.optimised(False)


def run_methods(out: Path, methods: list[str], **tables: Any) -> Results:
    study = small_study(
        study={"curves": True, "report_times_s": [3.0]},
        motion=STILL,
        axes={"method": methods},
        **tables,
    )
    run.run_into(study, out)
    return Results.read(out)


def test_study_of_level_alone_reports_pitch_and_roll(tmp_path: Path) -> None:
    source = run_methods(tmp_path / "out", ["level"])
    report = monte_carlo.build_report(source)
    facts = {fact.label: fact.text for fact in report.facts}
    assert facts["Attitude"].startswith("pitch ") and "(1 sigma 17." in facts["Attitude"]
    assert facts["Attitude"].endswith("(last draw)")
    assert facts["Heading"] == "none: level finds pitch and roll alone"
    assert facts["Accuracy"].endswith("' rms from the truth per angle")
    table = report.table
    assert table is not None and len(table.rows) == 3
    assert "unknown" not in str(table.rows)
    (picture,) = report.pictures
    east, north = (axes.get_ylabel() for axes in picture.figure.axes)
    assert "level error,\neast" in east and "level error,\nnorth" in north


@pytest.mark.nightly
def test_level_next_to_a_filter_never_settles(tmp_path: Path) -> None:
    source = run_methods(tmp_path / "out", ["kalman5", "level"])
    report = monte_carlo.build_report(source)
    facts = {fact.label: fact.text for fact in report.facts}
    assert "kalman5" in facts["Best"] and facts["Others"] == "level: never"
    tables = [block for block in report.blocks if isinstance(block, Table)]
    (every,) = (table for table in tables if table.title == "Every variant")
    row = next(row for row in every.rows if row[0] == "level")
    assert row[2].startswith("0") and {"no bias floor", "never", "unknown"} <= {*row}
    # The filter without bias states is explained, whatever `level` assumes.
    assert any("A NEES of 3 cannot be expected here" in str(block) for block in report.blocks)


def test_run_that_is_not_finite_has_no_level(tmp_path: Path) -> None:
    source = run_methods(tmp_path / "out", ["level"])
    table = read_summary(tmp_path / "out")
    for name in ("pitch_deg", "roll_deg"):
        table = replace_column(table, name, pa.nulls(table.num_rows))
    (fact, *_) = attitude.attitude_verdict(source.with_summary(table)).facts
    assert fact.is_caution and fact.text == "unknown, the run is not finite"
