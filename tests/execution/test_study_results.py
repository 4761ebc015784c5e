"""Results in Python: in memory and from a directory, as pandas and xarray objects."""

from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
from support.studies import small_study

import sinsjax
from sinsjax.execution.frames import to_dataset
from sinsjax.execution.results import Results

pytestmark = pytest.mark.optimised(False)

AXES = {"phi_u0_deg": [5.0, 10.0], "p0_yaw_deg": [20.0, 40.0, 80.0]}


@pytest.fixture(scope="module")
def results() -> Results:
    return sinsjax.run(small_study(study={"curves": True}, axes=AXES))


def test_results_of_a_directory_are_read_from_it(tmp_path: Path, results: Results) -> None:
    stored = sinsjax.run_into(results.study, tmp_path / "out")
    assert stored.summary.equals(results.summary.cast(stored.summary.schema))
    assert stored.curves.num_rows == results.curves.num_rows
    assert stored.directory == tmp_path / "out"
    assert str(tmp_path)[:20] in repr(stored) and "18 runs, " in repr(stored)
    again = Results.read(tmp_path / "out")
    assert again.summary.equals(stored.summary) and again.study == results.study
    assert again.wall_s > 0 and stored.wall_s > 0
    with pytest.raises(sinsjax.InputError, match="contains no results"):
        Results.read(tmp_path)


def test_failed_runs_are_counted(results: Results) -> None:
    status = ["ok"] * 3 + ["diverged", "nonfinite"] + ["not_settled"] * 13
    place = results.summary.column_names.index("status")
    table = results.summary.set_column(place, results.summary.schema.field("status"), [status])
    shown = Results(results.study, 1.0, tables={"summary": table, "curves": results.curves})
    assert "18 runs, 2 diverged or not finite" in repr(shown)
    fewer = Results(results.study, 1.0, tables={"summary": table.slice(0, 12)})
    assert "12 of 18 runs, 2 diverged" in repr(fewer)


def test_pandas_frame_has_rows_units_and_meanings(results: Results) -> None:
    pytest.importorskip("pandas")
    frame = results.to_pandas()
    np.testing.assert_array_equal(frame["phi_u_arcmin"], results.summary["phi_u_arcmin"])
    assert frame.attrs["units"]["phi_u_arcmin"] == "arcmin"
    assert frame.attrs["units"]["phi_u0_deg"] == "deg" and frame.attrs["units"]["status"] == ""
    assert "misalignment" in frame.attrs["meanings"]["phi_u_arcmin"]
    assert len(results.to_pandas(curves=True)) == results.curves.num_rows


def test_xarray_has_a_dimension_per_axis_and_units(results: Results) -> None:
    pytest.importorskip("xarray")
    dataset = results.to_xarray()
    assert dict(dataset.sizes) == {"draw": 3, "phi_u0_deg": 2, "p0_yaw_deg": 3}
    for row in results.summary.to_pylist():
        place = {key: row[key] for key in AXES} | {"draw": row["draw_id"]}
        run = dataset.sel(place)
        assert run["phi_u_arcmin"].item() == row["phi_u_arcmin"]
        assert run["status"].item() == row["status"] and run["run_id"].item() == row["run_id"]
        assert bool(run["ok_truth"]) == row["ok_truth"]
        settled = np.nan if row["settle_60_s"] is None else row["settle_60_s"]
        np.testing.assert_equal(run["settle_60_s"].item(), settled)
    assert dataset["phi_u_arcmin"].attrs["units"] == "arcmin"
    assert dataset["phi_u0_deg"].attrs["units"] == dataset["p0_yaw_deg"].attrs["units"] == "deg"
    assert "misalignment" in dataset["phi_u_arcmin"].attrs["long_name"]
    assert "units" not in dataset["status"].attrs
    assert dataset.attrs["title"] == results.study.name
    assert not {"draw_id", "variant_id", *AXES} & {*dataset.data_vars}


@pytest.mark.nightly
def test_xarray_has_keys_that_vary_together_on_one_dimension_or_variants() -> None:
    pytest.importorskip("xarray")
    cases = [{"case": "a", "phi_e0_deg": 1.0}, {"case": "b", "phi_e0_deg": 2.0}]
    labelled = sinsjax.run(small_study(cases=cases, axes={"reset_times_s": [[], [2.0, 3.0]]}))
    dataset = labelled.to_xarray()
    assert dict(dataset.sizes) == {"draw": 3, "case": 2, "reset_times_s": 2}
    assert dataset["phi_e0_deg"].sel(case="b").item() == 2.0
    assert dataset["reset_times_s"].values.tolist() == ["[]", "[2, 3]"]
    last = labelled.summary.filter(pc.equal(labelled.summary["run_id"], 11))["phi_u_arcmin"][0]
    found = dataset["phi_u_arcmin"].sel(draw=2, case="b", reset_times_s="[2, 3]")
    assert found.item() == last.as_py()
    together = {"start": {"phi_e0_deg": [1.0, 1.0, 2.0], "phi_n0_deg": [1.0, 2.0, 1.0]}}
    dataset = sinsjax.run(small_study(axes=together)).to_xarray()
    assert dict(dataset.sizes) == {"draw": 3, "variant": 3}
    assert dataset["phi_n0_deg"].dims == ("variant",)
    assert dataset["phi_n0_deg"].values.tolist() == [1.0, 2.0, 1.0]


def test_xarray_refuses_runs_without_some_variants(results: Results) -> None:
    pytest.importorskip("xarray")
    with pytest.raises(sinsjax.InputError, match="some variants are missing .17 runs of 3 draws"):
        to_dataset(results.study, results.summary.slice(1))
    assert dict(to_dataset(results.study, results.summary.slice(6)).sizes)["draw"] == 2
