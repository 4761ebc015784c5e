"""Batching changes nothing: not the noise, not the results, not for any chunk or device count."""

import threading
from itertools import count
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.batches import all_runs, assert_same, batch_of
from support.studies import small_study

from sinsjax.engine import batch, samples, scenario

DRAWS, VARIANTS = 50, 6


STUDIES: dict[str, dict[str, Any]] = {
    "plain": {},
    "measured": {},
    "gravity": {"alignment": {"specific_force": "gravity"}},
    "drawn": {
        "alignment": {"phi_e0_deg": None},
        "drawn": {
            "pitch_center_deg": {"values": [-5.0, 5.0]},
            "phi_e0_deg": {"normal": [0.0, 3.0]},
        },
    },
}
"""Plain is measured in programs that take a quarter of the time to compile."""


def six_variants(name: str) -> Any:
    """Six variants of each draw: tiles have eleven or twelve draws, and the last one is padded.

    With gravity in A(t) they share their covariance: eight draws a tile, eight tiles a set.
    """
    axes = {"phi_u0_deg": [0.0, 10.0, 30.0], "reset_times_s": [[], [1.37, 4.0]]}
    length = {"draws": DRAWS, "curves": True}
    return batch_of(small_study(study=length, axes=axes, **STUDIES[name]))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param("plain", marks=pytest.mark.optimised(False)),
        *(pytest.param(name, marks=pytest.mark.nightly) for name in [*STUDIES][1:]),
    ],
)
def pair(request: pytest.FixtureRequest) -> tuple[Any, tuple]:
    """A batch, and all its runs in one call."""
    runs = six_variants(request.param)
    return runs, all_runs(runs, devices=1, tiles_per_chunk=64)


def break_variant(runs, variant):
    """Return a batch in which one variant starts from an angle that is no number."""
    phi = runs.params.phi
    up = np.where(np.arange(len(phi.z)) == variant, np.nan, phi.z)
    return runs._replace(params=runs.params._replace(phi=phi._replace(z=up)))


def lay_out(study, tiles_per_chunk):
    """Return, chunk by chunk, the runs of its lanes: as planned, and as its tiles have them.

    The p0 of the last state, in degrees, numbers the variants from 1.
    """
    runs = batch_of(study)
    layout, chunks = runs.lay_out(tiles_per_chunk=tiles_per_chunk), []
    for number in range(len(layout)):
        places, active_lanes = layout[number], layout.active(number)
        in_lanes = np.argsort(active_lanes.lane)
        draws, variants = active_lanes.draw[in_lanes], active_lanes.variant[in_lanes]
        planned = list(zip(draws.tolist(), variants.tolist(), strict=True))
        assert {layout.chunk_of(*run) for run in planned} == {number}
        tiles = layout.tiles_of_chunk(runs, number)
        ids = np.asarray(tiles.draws.draw_id).reshape(*places.draw.shape[:2], -1)
        draw = np.take_along_axis(ids, np.broadcast_to(tiles.row[:, None], places.draw.shape), 2)
        variant = np.sqrt(tiles.params.method.p0[-1]) / np.deg2rad(1) - 1
        active = (places.draw < runs.n_draws) & (places.variant < runs.n_variants)
        variant = np.broadcast_to(variant[:, None], active.shape).round().astype(int)
        given = list(zip(draw[active].tolist(), variant[active].tolist(), strict=True))
        chunks.append((planned, given))
    return chunks


@pytest.mark.parametrize("devices", [1, 2])
def test_results_have_the_same_bits_for_any_chunk_and_device_count(
    pair: tuple[Any, tuple], devices: int
) -> None:
    runs, reference = pair
    assert_same(all_runs(runs, devices=devices, tiles_per_chunk=2), reference)


def test_broken_runs_give_nan_rows_without_changing_other_runs(pair: tuple[Any, tuple]) -> None:
    runs, (reference, _) = pair
    outcome, _ = all_runs(break_variant(runs, 2), devices=1, tiles_per_chunk=2)
    variant = np.arange(DRAWS * VARIANTS) % VARIANTS
    assert np.isnan(outcome.last.yaw[variant == 2]).all()
    good = (jax.tree.map(lambda a: a[variant != 2], tree) for tree in (outcome, reference))
    assert_same(*good)


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_program_per_device_runs_each_thread_on_separate_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on accelerators: the two virtual devices of the tests have a program each."""
    runs, devices = six_variants("measured"), jax.local_devices()
    assert len(devices) == 2
    reference = all_runs(runs, devices=1, tiles_per_chunk=2)
    monkeypatch.setattr(batch, "target_devices", lambda: devices)
    used, calls, both = [], count(), threading.Barrier(2, timeout=60)
    fetch = jax.device_get

    def watch(results: Any) -> Any:
        if next(calls) < 2:  # the first two chunks are computed at the same time
            both.wait()
        used.append({leaf.device for leaf in jax.tree.leaves(results)})
        return fetch(results)

    monkeypatch.setattr(jax, "device_get", watch)
    assert_same(all_runs(runs, devices=2, tiles_per_chunk=2), reference)
    assert sorted(used[:2], key=str) == [{device} for device in devices]
    assert all(len(one) == 1 for one in used)


@given(
    st.sampled_from(["measured", "gravity"]),
    st.integers(1, 150),
    st.integers(1, 200),
    st.sampled_from([None, 2, 40]),
)
@settings(max_examples=20)
def test_every_run_occupies_exactly_one_lane(
    force: str, draws: int, variants: int, tiles_per_chunk: int | None
) -> None:
    study = small_study(
        study={"draws": draws},
        alignment={"specific_force": force},
        axes={"p0_yaw_deg": [float(number) for number in range(1, variants + 1)]},
    )
    chunks = lay_out(study, tiles_per_chunk)
    runs = [run for planned, _ in chunks for run in sorted(planned)]
    assert all(planned == given for planned, given in chunks)
    every = [(draw, variant) for draw in range(draws) for variant in range(variants)]
    assert sorted(runs) == every
    if force == "measured":
        assert runs == every


DAY_S = 86_400.0


@pytest.mark.nightly
@pytest.mark.optimised(False)
@pytest.mark.parametrize(("specific_force", "most_bytes"), [("measured", 50e6), ("gravity", 3e8)])
def test_day_long_run_allocates_no_large_array(specific_force: str, most_bytes: float) -> None:
    """Curves of 12 MB, and their copy; with gravity, 8 tiles share a covariance.

    A record would have 415 MB, and idle lanes eight times the curves.
    """
    study = small_study(
        study={"duration_s": DAY_S, "draws": 1}, alignment={"specific_force": specific_force}
    )
    part = batch_of(study, curves=True)
    layout = part.lay_out()
    assert layout.curve_lanes == 1 and part.spec.intervals == DAY_S
    memory = batch.trace_program(part, layout).compiled().memory_analysis()
    assert 6e6 < memory.temp_size_in_bytes + memory.output_size_in_bytes < most_bytes


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_curves_without_stored_increments_match_stored_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Equal to rounding, forward and backward: the formulas are the same, the loop differs."""
    study = small_study(
        study={"draws": 2, "duration_s": 2.0, "window_s": [0, 2]},
        passes={"stored_s": 1.0},
        alignment={"method": "compass"},
    )
    _, stored = all_runs(batch_of(study, curves=True))
    monkeypatch.setattr(scenario, "MOST_STORED_SAMPLES", 0)
    monkeypatch.setattr(samples, "SAMPLES_PER_CALL", 30)
    runs = batch_of(study, curves=True)
    assert runs.environment.increments is None
    assert_same(all_runs(runs)[1], stored, 1e-10)
