"""Comparison of each group of runs with a reference group."""

import pyarrow as pa
import pytest
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax.analysis.references import compare_with_first_group

AXES = {"reset_count": [0, 1, 2], "phi_u0_deg": [5.0, 30.0]}
RATE = "success_rate_difference"


def summary_table() -> pa.Table:
    """All runs with one reset fail; without resets, those from 30 deg fail."""
    study = small_study(study={"draws": 6}, axes=AXES, resets={"reset_cycle_s": 1.0})
    status = ["ok", "diverged", "diverged", "diverged", "ok", "ok"] * 6
    return synthetic_summary(study, status=status)


def difference_by_key(rows: list) -> dict:
    return {(row["reset_count"], row["phi_u0_deg"]): round(row[RATE]) for row in rows}


def test_groups_compare_with_first_group_of_same_conditions():
    first, rows = compare_with_first_group(
        summary_table(), ["reset_count", "phi_u0_deg"], ["phi_u0_deg"]
    )
    assert first == {"reset_count": 0}
    assert difference_by_key(rows) == {(1, 5.0): -1, (2, 5.0): 0, (1, 30.0): 0, (2, 30.0): 1}


@pytest.mark.parametrize("without", [(), (0, 30.0)])
def test_one_reference_serves_all_groups_without_first_per_condition(without):
    table, given = summary_table(), []
    if without:
        kept = [(r["reset_count"], r["phi_u0_deg"]) != without for r in table.to_pylist()]
        table, given = table.filter(pa.array(kept)), ["phi_u0_deg"]
    first, rows = compare_with_first_group(table, ["reset_count", "phi_u0_deg"], given)
    assert first == {"reset_count": 0, "phi_u0_deg": 5.0}
    assert len(rows) == (4 if without else 5) and difference_by_key(rows)[(1, 30.0)] == -1


def test_conditions_alone_compare_with_first_condition():
    table = summary_table().slice(0, 2)
    first, rows = compare_with_first_group(table, ["phi_u0_deg"], ["phi_u0_deg"])
    assert first == {"phi_u0_deg": 5.0} and [row["phi_u0_deg"] for row in rows] == [30.0]
