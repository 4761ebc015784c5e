"""Batching changes nothing: not the noise, not the results, not for any chunk or device count."""

import threading
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.alone import run_alone
from support.studies import small_study

from sinsjax.engine import batch, build
from sinsjax.engine import lanes as lane_layout
from sinsjax.engine.environment import Draw, RunParams
from sinsjax.engine.run import run_tile
from sinsjax.types import Quat


def all_runs(group: lane_layout.Group, **options: int) -> tuple:
    """Outcome and curves of all runs of a group, in their order."""
    pieces = list(batch.run_chunks(group, **options))
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
    order = np.lexsort((whole.variant, whole.draw))
    return jax.tree.map(lambda a: a[order], (whole.outcome, whole.curves))


def assert_same_bits(one: object, other: object) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def six_variants_of(force: str) -> lane_layout.Group:
    """Six variants a draw: tiles hold eleven or twelve draws, and the last one is padded.

    With gravity in A(t) they share their covariance: eight draws a tile, eight tiles a set.
    """
    study = small_study(
        study={"draws": 50, "curves": True},
        alignment={"specific_force": force},
        axes={"phi_u0_deg": [0.0, 10.0, 30.0], "reset_times_s": [[], [1.37, 4.0]]},
    )
    (part,) = build.parts(study)
    return part.group


FORCES = [
    pytest.param("plain", marks=pytest.mark.optimised(False)),
    *(pytest.param(force, marks=pytest.mark.nightly) for force in ("measured", "gravity")),
]
"""Plain is measured in programs that take a quarter of the time to compile."""


@pytest.fixture(scope="module", params=FORCES)
def six_variants(request: pytest.FixtureRequest) -> lane_layout.Group:
    return six_variants_of({"plain": "measured"}.get(request.param, request.param))


@pytest.fixture(scope="module")
def reference(six_variants: lane_layout.Group) -> tuple:
    """All runs in one call."""
    return all_runs(six_variants, devices=1, tiles_per_chunk=64)


@pytest.mark.nightly(fast=("plain-1-2", "plain-2-2"))
@pytest.mark.parametrize(("devices", "tiles"), [(1, 2), (2, 2)])
def test_results_have_the_same_bits_for_any_chunk_and_device_count(
    six_variants: lane_layout.Group, reference: tuple, devices: int, tiles: int
) -> None:
    got = all_runs(six_variants, devices=devices, tiles_per_chunk=tiles)
    assert_same_bits(got, reference)


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_program_per_device_runs_each_thread_on_separate_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on accelerators: the two virtual devices of the tests have a program each."""
    group, devices = six_variants_of("measured"), jax.local_devices()
    assert len(devices) == 2
    monkeypatch.setattr(batch, "target_devices", lambda: devices[:1])
    reference = all_runs(group, devices=1, tiles_per_chunk=2)
    monkeypatch.setattr(batch, "target_devices", lambda: devices)
    program, used = batch.trace_program, []

    class Watched(NamedTuple):
        program: batch.Program
        home: jax.Device

        def compiled(self) -> Any:
            return self

        def __call__(self, *given: Any) -> Any:
            out = self.program.compiled()(*given)
            used.append((self.home, *{leaf.device for leaf in jax.tree.leaves(out)}))
            return out

    monkeypatch.setattr(batch, "trace_program", lambda *given: Watched(program(*given), given[-1]))
    got = all_runs(group, devices=2, tiles_per_chunk=2)
    assert_same_bits(got, reference)
    assert used and all(home == on for home, on in used)
    calls, both = batch.Calls(group, tiles_per_chunk=2), threading.Barrier(2, timeout=60)

    def together(number: int) -> batch.Chunk:
        both.wait()
        return calls.chunk(number)

    used.clear()
    list(batch.map_in_threads(together, [0, 0], 2))
    assert sorted(used, key=str) == [(device, device) for device in devices]


@pytest.mark.nightly
def test_every_run_matches_same_run_simulated_alone(
    six_variants: lane_layout.Group, reference: tuple
) -> None:
    """The unmapped function of one run gives what the tile gave, to rounding."""
    group = six_variants
    alone = jax.jit(lambda d, p: run_alone(group.static, group.environment, d, p))
    for run in (0, 5, 64, 299):
        draw, variant = divmod(run, 6)
        params = jax.tree.map(lambda a, v=variant: np.asarray(a)[v], group.variants)
        params = params._replace(q=Quat(*group.q[draw]))
        one = alone(Draw(group.draws.draw_id[draw], np.asarray(0), np.asarray(0)), params)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(reference), strict=True):
            np.testing.assert_allclose(a, b[run], rtol=1e-9, atol=1e-9)


@pytest.mark.nightly
def test_later_draws_do_not_change_earlier_rows(
    six_variants: lane_layout.Group, reference: tuple
) -> None:
    fewer = 30
    group = six_variants._replace(
        draws=six_variants.draws._replace(draw_id=np.arange(fewer), row=np.zeros(fewer, int)),
        q=six_variants.q[:fewer],
    )
    got = all_runs(group, devices=1, tiles_per_chunk=2)
    assert_same_bits(got, jax.tree.map(lambda a: a[: fewer * 6], reference))


def test_broken_runs_give_nan_rows_without_changing_other_runs(
    six_variants: lane_layout.Group, reference: tuple
) -> None:
    phi = six_variants.variants.phi
    broken = phi._replace(z=np.where(np.arange(6) == 2, np.nan, phi.z))
    group = six_variants._replace(variants=six_variants.variants._replace(phi=broken))
    outcome, _ = all_runs(group, devices=1, tiles_per_chunk=2)
    variant = np.arange(300) % 6
    assert np.isnan(outcome.last.yaw[variant == 2]).all()
    good = jax.tree.map(lambda a: a[variant != 2], outcome)
    assert_same_bits(good, jax.tree.map(lambda a: a[variant != 2], reference[0]))


def some_group(
    force: str, method: str = "kalman5", *, draws: int, variants: int
) -> lane_layout.Group:
    study = small_study(
        study={"draws": draws, "duration_s": 2.0, "window_s": [0, 2]},
        alignment={"specific_force": force, "method": method},
        axes={"p0_yaw_deg": list(np.linspace(10.0, 80.0, variants))},
    )
    (part,) = build.parts(study)
    return part.group


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
    """Calls of one size; each run once; its tile holds its draw; sets share variants."""
    group = some_group(force, draws=1, variants=1)._replace(
        draws=Draw(np.arange(draws), np.zeros(draws, int), np.zeros(draws, int)),
        q=np.zeros((draws, 4)),
        variants=jax.tree.map(lambda a: np.arange(variants), RunParams(*range(5))),
    )
    group = group._replace(variants=group.variants._replace(q=Quat(*[np.zeros(variants)] * 4)))
    runs, shapes = [], set()
    plan = batch.plan(group, tiles_per_chunk=tiles_per_chunk)
    assert sum(map(plan.count_runs, range(len(plan)))) == draws * variants
    for number, places in enumerate(plan):
        tiles = lane_layout.tiles_of(group, places)
        shapes.add(jax.tree.leaves(jax.tree.map(lambda a: a.shape, tuple(tiles))).__repr__())
        assert len(tiles.row) >= 2
        assert np.all(places.variant == places.variant[:, :1])
        ids = np.asarray(tiles.draws.draw_id).reshape(*places.draw.shape[:2], -1)
        row = np.broadcast_to(tiles.row[:, None], places.draw.shape)
        held = np.take_along_axis(ids, row, axis=2)
        busy = (places.draw < draws) & (places.variant < variants)
        np.testing.assert_array_equal(held[busy], places.draw[busy])
        taken = np.broadcast_to(tiles.params.ve[:, None], places.draw.shape)
        np.testing.assert_array_equal(taken[busy], places.variant[busy])
        chunk = np.sort((places.draw * variants + places.variant)[busy])
        assert len(chunk) == plan.count_runs(number)
        assert {plan.call_of(*divmod(int(run), variants)) for run in chunk} == {number}
        runs.extend(chunk)
    if force == "measured":
        assert runs == sorted(runs)
    np.testing.assert_array_equal(np.sort(runs), np.arange(draws * variants))
    assert len(shapes) == 1


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_shared_covariance_matches_covariance_computed_per_run() -> None:
    """To rounding, against tiles of the same program in which every run has its own."""
    variants = 70
    group = some_group("gravity", draws=9, variants=variants)
    shared, _ = all_runs(group)
    own = jax.jit(partial(run_tile, group.static))
    flat = group._replace(static=some_group("measured", draws=1, variants=1).static)
    for places in batch.plan(flat):
        tiles = lane_layout.tiles_of(flat, places)
        for k in range(len(tiles.row)):
            outcome, _ = own(group.environment, jax.tree.map(lambda a, k=k: a[k], tiles))
            runs = places.draw[k, 0] * variants + places.variant[k, 0]
            busy = places.draw[k, 0] < 9
            for a, b in zip(jax.tree.leaves(outcome), jax.tree.leaves(shared), strict=True):
                np.testing.assert_allclose(a[busy], b[runs[busy]], rtol=1e-9, atol=1e-12)
