"""Result tables: their columns, the conditions for nulls, and reading them from a directory."""

import jax
import numpy as np
import pyarrow as pa
import pytest
from support.chunks import chunk
from support.studies import STILL, small_study

from sinsjax.engine.batch import Chunk
from sinsjax.errors import InputError
from sinsjax.execution import run, tables
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN, DEG

FROM_FLOOR = {"judged_from": "floor", "dwell_s": 0.0}
"""A study that judges from the bias floor."""


def summary_of(study: Study, rows: Chunk, *, has_truth: bool = True) -> pa.Table:
    """Return the summary of a chunk of results."""
    builder = tables.TableBuilder(study, has_truth=has_truth)
    return builder.summary_table(rows, np.arange(study.n_variants))


def test_summary_gives_settling_times_and_status_per_run() -> None:
    study = small_study(
        study=FROM_FLOOR, motion=STILL, axes={"phi_u0_deg": [float(i) for i in range(4)]}
    )
    # Bands 60, 10, 3 arcmin; the run ends at 6 s.
    outside = [[0.0, 1.0, 6.0], [2.0, 6.0, 6.0], [6.0, 6.0, 6.0], [6.0, 6.0, 6.0]]
    table = summary_of(study, chunk([-21.0, -5.0, 700.0, np.nan], outside))
    assert table["settle_60_s"].to_pylist() == [0.0, 2.0, None, None]
    assert table["settle_10_s"].to_pylist() == [1.0, None, None, None]
    assert table["status"].to_pylist() == ["ok", "not_settled", "diverged", "not_settled"]
    assert table["phi_u_arcmin"].null_count == 1
    assert table["phi_n_arcmin"].to_pylist() == pytest.approx([2.0] * 4)
    assert table["yaw_deg"].to_pylist() == pytest.approx([1 / DEG] * 4)
    broken = summary_of(study, chunk([0.0], [[6.0, 6.0, 6.0]], yaw=np.nan))
    assert broken["status"].to_pylist() == ["nonfinite"]


def test_window_statistics_of_attitude_are_in_degrees() -> None:
    """Those of the heading error are in arcmin, with other numbers for each axis and angle."""
    rows = chunk([0.0], [[0.0] * 3])
    mean, std = (
        tuple(np.array([of * (i + 1) * unit]) for i, unit in enumerate([ARCMIN] * 3 + [DEG] * 3))
        for of in (1.0, 0.1)
    )
    rows = rows._replace(outcome=rows.outcome._replace(mean=mean, std=std))
    table = summary_of(small_study(), rows)
    names = ("phi_e{}_arcmin", "phi_n{}_arcmin", "phi_u{}_arcmin")
    names += ("pitch{}_deg", "roll{}_deg", "yaw{}_deg")
    for suffix, of in (("_mean", 1.0), ("_std", 0.1)):
        found = [table[name.format(suffix)][0].as_py() for name in names]
        assert found == pytest.approx([of * (i + 1) for i in range(6)])


def test_settling_time_is_reported_in_update_time_and_data_time() -> None:
    """The data that was there: what had been recorded by then, and no more than the record."""
    axes = {"passes": [1, 3], "phi_u0_deg": [0.0, 1.0]}
    study = small_study(study=FROM_FLOOR, motion=STILL, passes={"stored_s": 2.0}, axes=axes)
    # The first two runs end after 2 s, the others after 6 s.
    outside = [[0.0, 1.0, 2.0], [2.0, 2.0, 2.0], [1.0, 2.0, 5.0], [3.0, 4.0, 6.0]]
    table = summary_of(study, chunk([-21.0] * 4, outside))
    for band, settled, data in (
        (60, [0.0, None, 1.0, 3.0], [0.0, None, 1.0, 2.0]),
        (10, [1.0, None, 2.0, 4.0], [1.0, None, 2.0, 2.0]),
        (3, [None, None, 5.0, None], [None, None, 2.0, None]),
    ):
        assert table[f"settle_{band}_s"].to_pylist() == settled
        assert table[f"settle_{band}_data_s"].to_pylist() == data
    assert table["status"].to_pylist() == ["ok", "not_settled", "ok", "ok"]
    study = small_study(passes={"stored_s": 2.0})
    table = summary_of(study, chunk([0.0], [[0.0] * 3]), has_truth=False)
    assert table["settle_10_data_s"].null_count == 1
    needing = ("phi_u_arcmin", "phi_u_mean_arcmin", "settle_10_s", "floor_arcmin", "nees", "status")
    assert all(table[name].null_count == 1 for name in needing)
    left = ("pitch_deg", "yaw_mean_deg", "yaw_std_deg", "sigma_u_arcmin")
    assert not any(table[name].null_count for name in left)


def test_single_precision_is_refused() -> None:
    with jax.enable_x64(False), pytest.raises(InputError, match="double precision"):
        run.run(small_study())
