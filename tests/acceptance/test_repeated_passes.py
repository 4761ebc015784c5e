"""Studies of repeated passes, forward and backward: from the study to the rows of its tables."""

import copy
from functools import cache
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from support.alone import run_alone
from support.batches import batch_of, batches_of, run_chunks
from support.studies import with_paper_values

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import run as study_run
from sinsjax.execution.tables import TableBuilder
from sinsjax.records import Record, Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict

pytestmark = pytest.mark.optimised(False)

BASE: dict[str, Any] = {
    "study": {"duration_s": 8.0, "rate_hz": 50.0, "draws": 2, "window_s": [1, 3], "curves": True},
    "earth": {"latitude_deg": 32.0},
    "motion": {
        "yaw_center_deg": 10.0,
        "pitch_amplitude_deg": 8.0,
        "pitch_period_s": 6.7,
        "roll_amplitude_deg": 6.0,
        "roll_period_s": 5.0,
        "yaw_amplitude_deg": 5.0,
        "yaw_period_s": 8.0,
    },
    "sensors": {
        "gyro_bias_deg_per_h": 0.1,
        "gyro_noise_deg_per_h": 0.1,
        "accel_bias_ug": 100.0,
        "accel_noise_ug": 100.0,
    },
    "alignment": {"phi_e0_deg": 0.1, "phi_n0_deg": -0.1, "phi_u0_deg": 1.0},
}
QUICK = {
    "alignment": {"method": "compass"},
    "compass": {"level_sigma_per_s": 0.5, "level_time_s": 2.0, "azimuth_sigma_per_s": 0.05},
}
PERFECT = {"sensors": None}


def merged(*changes: dict[str, Any]) -> dict[str, Any]:
    data = copy.deepcopy(BASE)
    for tables in changes:
        for name, table in tables.items():
            if isinstance(table, dict):
                data[name] = data.get(name, {}) | table
            elif table is None:
                del data[name]
            else:
                data[name] = table
    return data


def run(*changes: dict[str, Any]) -> study_run.Results:
    return study_run.run(study_from_dict(with_paper_values(merged(*changes))))


def columns_of(table: pa.Table, run_id: int, *names: str) -> list[list[Any]]:
    own = table.filter(pc.equal(table["run_id"], run_id))
    return [own[name].to_pylist() for name in names]


PLACES = ("time_s", "update_time_s", "stored_time_s", "pass")


@pytest.mark.parametrize(
    ("passes", "stored_times_of", "numbers"),
    [
        ({"stored_s": 3.0}, [1, 2, 3, 2, 1, 0, 1, 2], [1, 1, 1, 2, 2, 2, 3, 3]),
        ({"stored_s": 2.0, "passes": 2}, [1, 2, 1, 0], [1, 1, 2, 2]),
        ({"stored_s": 2.0, "ending": "forward"}, [1, 2, 1, 0, 1, 2], [1, 1, 2, 2, 3, 3]),
        ({"stored_s": 5.0, "ending": "forward"}, [1, 2, 3, 4, 5], [1] * 5),
        ({"stored_s": 1.0, "passes": 3}, [1, 0, 1], [1, 2, 3]),
        ({"stored_s": 8.0}, [*range(1, 9)], [1] * 8),
        ({}, [*range(1, 9)], [1] * 8),
        (
            {"stored_s": 3.0, "direction": "rewind"},
            [1, 2, 3] * 2 + [1, 2],
            [1, 1, 1, 2, 2, 2, 3, 3],
        ),
        (
            {"stored_s": 3.0, "direction": "rewind", "ending": "forward"},
            [1, 2, 3] * 2,
            [1, 1, 1, 2, 2, 2],
        ),
        ({"stored_s": 2.0, "passes": 2, "direction": "rewind"}, [1, 2, 1, 2], [1, 1, 2, 2]),
    ],
)
def test_stored_times_and_pass_numbers_follow_passes(
    passes: dict[str, Any], stored_times_of: list[int], numbers: list[int]
) -> None:
    """Times by hand; the engine gets the same times from the truth, see below."""
    study = study_from_dict(merged({"passes": passes}, QUICK))
    (span,) = set(study.lengths.to_list())
    updates = list(range(1, len(stored_times_of) + 1))
    assert study.update_times(span).tolist() == updates
    assert study.stored_times(span).tolist() == stored_times_of
    assert span.pass_numbers().tolist() == numbers


TURNS = {"turn": ["reflect", "velocity"]}


@cache
def swept() -> study_run.Results:
    return run(QUICK, {"passes": {}, "axes": {"stored_s": [3.0, 4.0]} | TURNS})


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_passes_add_time_and_data_columns_to_tables() -> None:
    curves, summary = swept().curves, swept().summary
    got = columns_of(curves, 0, *PLACES)
    times = [float(t) for t in range(1, 9)]
    assert got == [times, times, [1, 2, 3, 2, 1, 0, 1, 2], [1, 1, 1, 2, 2, 2, 3, 3]]
    units = [curves.schema.field(name).metadata[b"unit"] for name in PLACES]
    assert units == [b"s", b"s", b"s", b""]
    names = summary.column_names
    bands = [name for name in names if name.startswith("settle_")]
    kinds = ("s", "truth_s", "data_s", "truth_data_s")
    assert bands == [f"settle_{b}_{kind}" for kind in kinds for b in (60, 10, 3)]
    plain = TableBuilder(study_from_dict(merged(QUICK)))
    assert not set(PLACES[1:]) & {c.name for c in plain.curve_columns}
    assert not any(c.name.endswith("data_s") for c in plain.summary_columns)


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_single_pass_of_full_duration_gives_identical_results() -> None:
    """The program that could turn gives what the one that cannot does, for any method."""
    methods = {"axes": {"method": ["compass", "kalman5"]}, "compass": QUICK["compass"]}
    plain = run(methods)
    for passes in ({"stored_s": 8.0}, {}):
        over = run(methods, {"passes": passes})
        for a, b in ((plain.summary, over.summary), (plain.curves, over.curves)):
            assert b.select(a.column_names).equals(a)


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_swept_stored_durations_give_same_rows_as_each_alone() -> None:
    """Every bit is equal, though the parts share a record of one length."""
    alone = run(QUICK, {"passes": {"stored_s": 3.0}, "axes": TURNS})
    rows = swept().summary.filter(pc.less(swept().summary["variant_id"], 2))
    names = [n for n in alone.summary.column_names if n != "run_id"]
    assert rows.select(names).equals(alone.summary.select(names))
    names = [n for n in alone.curves.column_names if n != "run_id"]
    for number in range(4):
        draw, turn = divmod(number, 2)
        together = columns_of(swept().curves, 4 * draw + turn, *names)
        assert together == columns_of(alone.curves, number, *names)
        assert together != columns_of(swept().curves, 4 * draw + 2 + turn, *names)


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_backward_pass_undoes_noise_of_forward_pass() -> None:
    """Without gains the backward pass undoes the noise of the forward pass, to rounding."""
    still = {"level_gains": [0.0] * 3, "azimuth_gains": [0.0] * 4, "allow_unstable": True}
    start = {"method": "compass", "phi_e0_deg": 0.0, "phi_n0_deg": 0.0, "phi_u0_deg": 0.0}
    loops = {"alignment": start, "compass": still}
    loud = {"sensors": {"gyro_noise_deg_per_h": 1e4, "accel_noise_ug": 0.0}}
    out = run(loops, loud, {"passes": {"stored_s": 4.0}, "axes": TURNS})
    flipped = out.summary.filter(pc.equal(out.summary["turn"], "velocity"))["run_id"]
    assert len(flipped) == 2
    for run_id in flipped.to_pylist():
        (phi,) = columns_of(out.curves, run_id, "phi_u_arcmin")
        assert abs(phi[3]) > 1 and abs(phi[7]) < 1e-6 * abs(phi[3])
        np.testing.assert_allclose(phi[:3], phi[6:3:-1], rtol=1e-6)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "tables",
    [
        pytest.param(QUICK | {"axes": TURNS}, id="compass", marks=pytest.mark.optimised(True)),
        pytest.param(
            {
                "alignment": {"specific_force": "gravity"},
                "axes": {"turn_covariance": ["inflated", "reset"]},
            },
            id="shared covariance",
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            {"alignment": {"method": "kalman10"}, "passes": {"direction": "rewind"}}
            | {"axes": {"p0_yaw_deg": [10.0, 80.0]}},
            id="rewound",
        ),
        pytest.param(
            {"alignment": {"method": "kalman_sincos"}, "passes": {"direction": "rewind"}}
            | {"coarse": {"coarse_duration_s": 2.0}}
            | {"axes": {"coarse_then": ["hand_over"], "p0_level_deg": [1.0, 10.0]}},
            id="shared covariance, rewound, after coarse alignment",
        ),
        pytest.param(
            {"coarse": {"coarse_duration_s": 2.0, "coarse_then": "replay"}}
            | {"axes": {"p0_yaw_deg": [10.0, 80.0]}},
            id="replayed",
        ),
    ],
)
def test_batched_runs_with_passes_match_single_runs(tables: dict[str, Any]) -> None:
    """Tiles of runs, and filters that share P, reverse as a single run does."""
    group = batch_of(study_from_dict(merged({"passes": {"stored_s": 3.0}}, tables)))
    pieces = [(c.outcome, c.curves) for c in run_chunks(group)]
    many = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
    alone = jax.jit(lambda draw, params: run_alone(group.spec, group.environment, draw, params))
    for run_id in range(4):
        draw, variant = divmod(run_id, 2)
        params = jax.tree.map(lambda a, v=variant: np.asarray(a)[v], group.params)
        drawn = jax.tree.map(lambda a, d=draw: a[d] if np.ndim(a) else a, group.draws)
        one = alone(drawn, params)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
            np.testing.assert_allclose(a, b[run_id], rtol=1e-9, atol=1e-9)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("method", "direction"),
    [
        ("compass", "alternate"),
        pytest.param("kalman10", "alternate", marks=pytest.mark.nightly),
        ("compass", "rewind"),
    ],
)
def test_error_free_run_keeps_true_attitude_over_every_pass(method: str, direction: str) -> None:
    """The reference of a run is the attitude at its place in the record, also backward."""
    start = {"alignment": {"method": method, "phi_e0_deg": 0.0, "phi_n0_deg": 0, "phi_u0_deg": 0}}
    loops = {"compass": QUICK["compass"]} if method == "compass" else {}
    out = run(PERFECT, loops, start, {"passes": {"stored_s": 3.0, "direction": direction}})
    for axis in "enu":
        assert np.abs(np.array(out.curves[f"phi_{axis}_arcmin"])).max() < 1e-3
    t = np.array(columns_of(out.curves, 0, "stored_time_s")[0])
    motion = BASE["motion"]
    for angle, center in (("pitch", 0.0), ("roll", 0.0), ("yaw", 10.0)):
        turn = 2 * np.pi * t / motion[f"{angle}_period_s"]
        swing = center + motion[f"{angle}_amplitude_deg"] * np.sin(turn)
        got = columns_of(out.curves, 0, f"{angle}_deg")[0]
        np.testing.assert_allclose(got, swing, rtol=0, atol=1e-5)


@pytest.mark.nightly
def test_simulated_record_is_one_pass_long() -> None:
    study = study_from_dict(merged({"passes": {"stored_s": 3.0}}))
    record = simulated_record(study)
    whole = simulated_record(study_from_dict(merged()))
    assert len(record.dtheta) == 150 and len(whole.dtheta) == 400
    np.testing.assert_array_equal(record.dtheta, whole.dtheta[:150])
    np.testing.assert_array_equal(record.dv, whole.dv[:150])


# A filter that hears the same data again, [P2] has none of it


def repeated(draws: int, passes: list[int], turns: list[str], spread: int = 4) -> pa.Table:
    """A study in which truth is what the filter believes, but for the repetition.

    A static base; no biases; white noise as Q says, sample by sample; velocity known to 1e-6 m/s;
    initial errors drawn from P0; what is estimated is fed back at once, so that A(t) is that of the
    true attitude.
    """
    p0 = {"p0_velocity_m_per_s": 1e-3, "p0_level_deg": 0.05, "p0_yaw_deg": 2.0}
    rng = np.random.default_rng(0)
    sizes = np.array([0.05, 0.05, 2.0, 1e-3, 1e-3])
    keys = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "ve0_m_per_s", "vn0_m_per_s")
    starts = [
        dict(zip(keys, map(float, row), strict=True))
        for row in rng.normal(size=(spread, 5)) * sizes
    ]
    stored, rate = 40.0, 50.0
    study = {
        "study": {
            "duration_s": stored * max(passes),
            "rate_hz": rate,
            "draws": draws,
            "window_s": [0, stored],
        },
        "earth": {"latitude_deg": 32.0},
        "motion": {"yaw_center_deg": 0.0},
        "sensors": {"gyro_noise_deg_per_h": 0.1, "accel_noise_ug": 50.0},
        "alignment": {"method": "kalman5", "feedback_interval_s": 1 / rate},
        "filter": p0
        | {"q_accel_ug": 50.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_sample"}
        | {"r_velocity_m_per_s": 1e-6},
        "passes": {"stored_s": stored},
        "cases": starts,
        "axes": {"passes": passes, "turn_covariance": turns},
    }
    return study_run.run(study_from_dict(study)).summary


def mean_and_half_width(rows: pa.Table, key: str, passes: int, turn: str) -> tuple[float, float]:
    """Return the mean over all runs and its 95 % half-width over the draws."""
    own = (pc.field("passes") == passes) & (pc.field("turn_covariance") == turn)
    kept = rows.filter(own).sort_by("draw_id")
    values = np.array(kept[key]).reshape(len(set(kept["draw_id"].to_pylist())), -1).mean(axis=1)
    return values.mean(), 1.96 * values.std(ddof=1) / np.sqrt(len(values))


@pytest.mark.nightly
def test_carried_covariance_is_overconfident_after_repeated_passes() -> None:
    """One pass is consistent; N passes count as N times the data, so P_UU is N times too small.

    The error itself stays: repetition adds no information.
    """
    turns = ["carried", "inflated", "reset"]
    rows = repeated(64, [1, 4], turns)
    for turn in turns:
        mean, half = mean_and_half_width(rows, "nees", 1, turn)
        assert abs(mean - 3) < 1.5 * half
    error, sigma, nis = (
        {n: mean_and_half_width(rows, key, n, "carried") for n in (1, 4)}
        for key in ("phi_u_arcmin", "sigma_u_arcmin", "nis_u")
    )
    assert sigma[1][0] / sigma[4][0] == pytest.approx(2, rel=0.02)
    assert nis[4][0] / nis[1][0] == pytest.approx(4, rel=0.1)
    assert error[4][0] == pytest.approx(error[1][0], abs=0.2)
    mean, half = mean_and_half_width(rows, "nees", 4, "carried")
    assert mean - half > 6
    for turn in ("inflated", "reset"):
        mean, half = mean_and_half_width(rows, "nees", 4, turn)
        assert abs(mean - 3) < 1.5 * half


# Records

RECORD_S = 20.0
SWING = {"pitch_amplitude_deg": 4.0, "pitch_period_s": 7.0, "yaw_center_deg": 10.0}


@cache
def record() -> Record:
    settings = {"duration_s": RECORD_S, "rate_hz": 50.0, "draws": 1}
    study = {"study": settings, "earth": {"latitude_deg": 32.0}, "motion": SWING}
    return simulated_record(study_from_dict(with_paper_values(study)))


def reference(end_s: float) -> Reference:
    t = np.arange(0, end_s + 1e-9, 0.02)
    pitch = SWING["pitch_amplitude_deg"] * np.sin(2 * np.pi * t / SWING["pitch_period_s"])
    return Reference(t, np.stack([pitch, 0 * t, 10 + 0 * t], axis=1), None)


def recorded(**passes: Any) -> dict[str, Any]:
    tables = {
        "study": {"duration_s": 12.0, "rate_hz": 50.0, "window_s": [1, 4], "curves": True},
        "record": {"format": "psins", "start_s": [0.0, 4.0]},
        "coarse": {"coarse_duration_s": 6.0},
        "passes": passes,
        **QUICK,
    }
    return with_paper_values(tables)


def test_every_start_time_is_judged_by_reference_of_its_own_passes() -> None:
    study = study_from_dict(recorded(stored_s=6.0))
    group = batch_of(study, StoredRecord(record(), reference(RECORD_S)))
    w, x, y, z = np.moveaxis(np.asarray(group.environment.attitudes)[group.draws.row], -1, 0)
    stored = np.array([1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1, 0])
    t = np.array([[0.0], [4.0]]) + 6.0 + stored
    pitch_deg = np.rad2deg(np.arcsin(2 * (w * x + y * z)))
    np.testing.assert_allclose(pitch_deg, 4 * np.sin(2 * np.pi * t / 7), rtol=0, atol=1e-4)


@pytest.mark.nightly
def test_recorded_passes_follow_record_from_every_start_time() -> None:
    """The coarse attitude is good to arcseconds here; each start has a record of its own."""
    study = study_from_dict(recorded(stored_s=6.0))
    curves = study_run.run(study, StoredRecord(record(), reference(RECORD_S))).curves
    for draw, start in enumerate((0.0, 4.0)):
        times, pitch, phi_e = columns_of(curves, draw, "stored_time_s", "pitch_deg", "phi_e_arcmin")
        assert times == [1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1, 0]
        t = start + 6.0 + np.array(times)
        np.testing.assert_allclose(pitch, 4 * np.sin(2 * np.pi * t / 7), rtol=0, atol=0.02)
        assert np.abs(phi_e).max() < 0.5


def test_pass_longer_than_record_is_refused() -> None:
    """The record, not the duration: passes of 6 s may last 12 s on a record that holds 16."""
    study = study_from_dict(recorded(stored_s=11.0))
    with pytest.raises(InputError) as caught:
        (batches_of(study, StoredRecord(record(), None)))
    line = "has 20 s, but 17 s from start_s = 4 need 21 s"
    assert str(caught.value) == f"{record().source}: {line}"
    part = batch_of(study_from_dict(recorded(stored_s=6.0)), StoredRecord(record(), None))
    assert len(part.environment.increments) == 800  # of the 1000 of the record, what is read


def test_only_needed_part_of_record_is_loaded() -> None:
    """Run that begin at 10 s of the record begin where their fine alignment does on the record."""
    data = recorded(stored_s=6.0)
    data["record"] = data["record"] | {"start_s": 4.0}
    part = batch_of(study_from_dict(data), StoredRecord(record(), None))
    np.testing.assert_array_equal(part.environment.increments[:, :3], record().dtheta[200:800])
    np.testing.assert_array_equal(part.environment.increments[:, 3:], record().dv[200:800])
    np.testing.assert_array_equal(part.draws.start, [300])


@pytest.mark.parametrize("passes", [1, 2])
def test_reference_must_cover_whole_stored_record(passes: int) -> None:
    """With two passes a run ends at the beginning of its record, which the reference covers."""
    study = study_from_dict(recorded(stored_s=6.0, passes=passes))
    with pytest.raises(InputError, match=r"covers 0 to 13 s, but the study needs 1. to 16 s"):
        (batches_of(study, StoredRecord(record(), reference(13.0))))
