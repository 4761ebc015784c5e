"""Result tables: the columns that others read by name, and what is null when."""

from pathlib import Path

import jax
import numpy as np
import pyarrow as pa
import pytest
from studies import small_study

from sinsjax import campaign, columns, results, scenario
from sinsjax.batch import Chunk
from sinsjax.metrics import Observation, Outcome
from sinsjax.types import InputError, Vec3
from sinsjax.units import ARCMIN, DEG

CONTRACT = """
run_id draw_id variant_id method reset_count reset_cycle_s reset_times_s start_s
phi_e0_deg phi_n0_deg phi_u0_deg phi_e_arcmin phi_n_arcmin phi_u_arcmin pitch_deg roll_deg yaw_deg
sigma_e_arcmin sigma_n_arcmin sigma_u_arcmin phi_u_mean_arcmin phi_u_std_arcmin phi_e_mean_arcmin
phi_e_std_arcmin phi_n_mean_arcmin phi_n_std_arcmin pitch_mean_deg pitch_std_deg roll_mean_deg
roll_std_deg yaw_mean_deg yaw_std_deg floor_arcmin settle_60_s settle_10_s settle_3_s nees nis_u
status
""".split()


def chunk(phi_u_arcmin: list[float], outside_until: list[list[float]], yaw: float = 1.0) -> Chunk:
    """Runs of draw 0 with these final heading errors and ends of their time outside the bands."""
    n = len(phi_u_arcmin)
    one = np.ones(n)
    phi = Vec3(one, 2 * one, np.array(phi_u_arcmin) * ARCMIN)
    last = Observation(phi, Vec3(one, one, one), 0.1 * one, 0.2 * one, yaw * one)
    outcome = Outcome(
        last=last,
        outside_until=np.array(outside_until),
        mean=(one,) * 6,
        std=(one,) * 6,
        above_share=(one,) * 3,
        nees=one,
        nis_u=one,
        floor=np.full(n, -20.0 * ARCMIN),
    )
    return Chunk(np.zeros(n, int), np.arange(n), outcome, None)


def test_the_contract_columns_are_there_with_every_axis() -> None:
    study = small_study(
        axes={"q_reading": ["psd", "per_step"], "p0_yaw_deg": [40.0, 80.0], "reset_count": [0, 2]},
        resets={"reset_cycle_s": 2.0},
    )
    made = results.Tables(study)
    names = [c.name for c in made.summary_columns]
    assert len(set(names)) == len(names)
    assert set(CONTRACT) | {"q_reading", "p0_yaw_deg"} <= set(names)
    table = made.summary(chunk([0.0] * 8, [[0.0] * 3] * 8), np.arange(8))
    assert table["q_reading"].to_pylist() == ["psd"] * 4 + ["per_step"] * 4
    assert table["reset_count"].to_pylist() == [0, 2] * 4
    assert table["reset_times_s"].to_pylist() == [[], [2.0, 4.0]] * 4
    assert table.schema.field("phi_u_arcmin").metadata[b"unit"] == b"arcmin"


@pytest.mark.parametrize("values", [[1, 2], [1.5, 2], ["a", "b"], [(), (1.0, 2.0)]])
def test_axis_columns_take_the_type_of_their_values(values: list) -> None:
    column = columns.axis_column("key", values)
    array = pa.array([list(v) if isinstance(v, tuple) else v for v in values], column.dtype)
    assert array.null_count == 0


def test_a_vector_key_may_be_swept_by_numbers_and_lists() -> None:
    study = small_study(axes={"gyro_bias_deg_per_h": [0.1, [0.1, 0.0, 0.0]]})
    table = results.Tables(study).summary(chunk([0.0] * 2, [[0.0] * 3] * 2), np.arange(2))
    assert table["gyro_bias_deg_per_h"].to_pylist() == [[0.1], [0.1, 0.0, 0.0]]


def test_settling_status_and_floor() -> None:
    study = small_study(axes={"phi_u0_deg": [float(i) for i in range(4)]})
    # Bands 60, 10, 3 arcmin; the run ends at 6 s.
    outside = [[0.0, 1.0, 6.0], [2.0, 6.0, 6.0], [6.0, 6.0, 6.0], [6.0, 6.0, 6.0]]
    rows = chunk([-21.0, -5.0, 700.0, np.nan], outside)
    made = results.Tables(study)
    table = made.summary(rows, np.arange(4))
    assert table["settle_60_s"].to_pylist() == [0.0, 2.0, None, None]
    assert table["settle_10_s"].to_pylist() == [1.0, None, None, None]
    assert table["status"].to_pylist() == ["ok", "not_settled", "diverged", "not_settled"]
    assert table["phi_u_arcmin"].null_count == 1
    assert table["phi_n_arcmin"].to_pylist() == pytest.approx([2 / ARCMIN] * 4)
    assert table["yaw_deg"].to_pylist() == pytest.approx([1 / DEG] * 4)
    broken = made.summary(chunk([0.0], [[6.0, 6.0, 6.0]], yaw=np.nan), np.arange(1))
    assert broken["status"].to_pylist() == ["nonfinite"]


def test_settling_is_told_in_update_time_and_in_data() -> None:
    """The data that was there: what had been recorded by then, and no more than the tape."""
    study = small_study(passes={"tape_s": 2.0}, axes={"passes": [1, 3], "phi_u0_deg": [0.0, 1.0]})
    # The first two runs end after 2 s, the others after 6 s.
    outside = [[0.0, 1.0, 2.0], [2.0, 2.0, 2.0], [1.0, 2.0, 5.0], [3.0, 4.0, 6.0]]
    table = results.Tables(study).summary(chunk([-21.0] * 4, outside), np.arange(4))
    for band, settled, data in (
        (60, [0.0, None, 1.0, 3.0], [0.0, None, 1.0, 2.0]),
        (10, [1.0, None, 2.0, 4.0], [1.0, None, 2.0, 2.0]),
        (3, [None, None, 5.0, None], [None, None, 2.0, None]),
    ):
        assert table[f"settle_{band}_s"].to_pylist() == settled
        assert table[f"settle_{band}_data_s"].to_pylist() == data
    assert table["status"].to_pylist() == ["ok", "not_settled", "ok", "ok"]
    made = results.Tables(small_study(passes={"tape_s": 2.0}), has_truth=False)
    table = made.summary(chunk([0.0], [[0.0] * 3]), np.arange(1))
    assert table["settle_10_data_s"].null_count == 1


def test_compass_loops_believe_nothing() -> None:
    """No sigma and no consistency; the keys that filters read are there, and null."""
    schedules = [([1.0], []), ([2.0, 1.0], [3.0])]
    study = small_study(
        alignment={"method": "compass"},
        compass={"level_sigma_per_s": 0.5, "level_time_s": 2.0},
        passes={"tape_s": 3.0},
        cases=[{"sigma_factors": f, "sigma_times_s": t} for f, t in schedules],
        axes={"turn": ["reflect", "keep"], "allow_unstable": [False, True]},
    )
    table = campaign.run(study).summary
    for name in ("sigma_u_arcmin", "nees", "nis_u", "p_above_error_share", "reset_cycle_s"):
        assert table[name].null_count == table.num_rows == 24
    assert table["reset_count"].to_pylist() == [0] * 24
    assert table["sigma_factors"].to_pylist()[:8] == [[1.0]] * 4 + [[2.0, 1.0]] * 4
    assert table["sigma_times_s"].to_pylist()[:8] == [[]] * 4 + [[3.0]] * 4
    assert table["turn"].to_pylist()[:4] == ["reflect"] * 2 + ["keep"] * 2
    assert table["allow_unstable"].to_pylist()[:2] == [False, True]
    assert table["phi_u_arcmin"].null_count == table["status"].null_count == 0


def test_without_truth_attitude_and_sigma_are_what_is_left() -> None:
    made = results.Tables(small_study(), has_truth=False)
    table = made.summary(chunk([0.0], [[0.0, 0.0, 0.0]]), np.arange(1))
    left = {name for name in CONTRACT if table[name].null_count == 0}
    assert {"pitch_deg", "yaw_mean_deg", "yaw_std_deg", "sigma_u_arcmin"} <= left
    needing = ("phi_u_arcmin", "phi_u_mean_arcmin", "settle_10_s", "floor_arcmin", "nees", "status")
    assert not left & set(needing)


def test_bands_always_hold_the_one_that_decides_the_status() -> None:
    study = small_study(study={"settle_bands_arcmin": [30.0]})
    names = [c.name for c in results.Tables(study).summary_columns]
    assert {"settle_30_s", "settle_10_s"} <= set(names)
    (part,) = scenario.parts(study)
    np.testing.assert_allclose(part.group.world.criteria.bands, np.array([30, 10]) * ARCMIN)


def test_single_precision_is_refused_before_earlier_results_go(tmp_path: Path) -> None:
    study = small_study()
    results.Store(tmp_path / "out", study)
    before = (tmp_path / "out" / "manifest.json").read_bytes()
    with jax.enable_x64(False):
        for call in (
            lambda: campaign.run_into(study, tmp_path / "out", overwrite=True),
            lambda: campaign.run(study),
            lambda: scenario.simulated_record(study),
        ):
            with pytest.raises(RuntimeError, match="double precision"):
                call()
    assert (tmp_path / "out" / "study.toml").exists()
    assert (tmp_path / "out" / "manifest.json").read_bytes() == before


def test_a_part_appears_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = small_study()
    store = results.Store(tmp_path / "out", study)
    made = results.Tables(study)
    table = made.summary(chunk([0.0], [[0.0] * 3]), np.arange(1))
    store.write("summary", "part-0", table, seconds=1.0)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results.pq, "write_table", full)
    with pytest.raises(InputError, match="part-1.parquet: cannot be written: No space left"):
        store.write("summary", "part-1", table, seconds=1.0)
    names = [path.name for path in (tmp_path / "out" / "summary").iterdir()]
    assert names == ["part-0.parquet"]
    assert results.read_summary(tmp_path / "out").num_rows == 1
