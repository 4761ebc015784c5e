"""Batching changes nothing: not the noise, not the results, not for any chunk or device count."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from studies import small_study

from sinsjax import batch, imu, scenario
from sinsjax.simulate import ONE, Draw, simulate, stream
from sinsjax.types import Quat


def all_runs(group: batch.Group, **options: int) -> tuple:
    """Outcome and curves of all runs of a group."""
    pieces = [(c.outcome, c.curves) for c in batch.chunks(group, **options)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)


def assert_same_bits(one: object, other: object) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def six_variants() -> batch.Group:
    """Six variants a draw: tiles hold eleven or twelve draws, and the last one is padded."""
    study = small_study(
        study={"draws": 50, "curves": True},
        axes={"phi_u0_deg": [0.0, 10.0, 30.0], "reset_times_s": [[], [1.37, 4.0]]},
    )
    (part,) = scenario.parts(study)
    return part.group


@pytest.fixture(scope="module")
def reference(six_variants: batch.Group) -> tuple:
    return all_runs(six_variants, devices=1, tiles_a_chunk=8)


@pytest.mark.parametrize(("devices", "tiles"), [(1, 2), (2, 2), (2, 64)])
def test_results_have_the_same_bits_for_any_chunk_and_device_count(
    six_variants: batch.Group, reference: tuple, devices: int, tiles: int
) -> None:
    got = all_runs(six_variants, devices=devices, tiles_a_chunk=tiles)
    assert_same_bits(got, reference)


def test_every_run_equals_itself_alone(six_variants: batch.Group, reference: tuple) -> None:
    """The unmapped function of one run gives what the tile gave, to rounding."""
    group = six_variants
    alone = jax.jit(lambda d, p: simulate(group.static, group.world, d, p, ONE))
    for run in (0, 5, 64, 299):
        draw, variant = divmod(run, 6)
        params = jax.tree.map(lambda a, v=variant: np.asarray(a)[v], group.variants)
        params = params._replace(q=Quat(*group.q[draw]))
        one = alone(jax.tree.map(lambda a, d=draw: np.asarray(a)[d], group.draws), params)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(reference), strict=True):
            np.testing.assert_allclose(a, b[run], rtol=1e-9, atol=1e-9)


def test_later_draws_leave_earlier_rows_alone(six_variants: batch.Group, reference: tuple) -> None:
    fewer = 30
    group = six_variants._replace(
        draws=jax.tree.map(lambda a: a[:fewer], six_variants.draws), q=six_variants.q[:fewer]
    )
    got = all_runs(group, devices=1, tiles_a_chunk=8)
    assert_same_bits(got, jax.tree.map(lambda a: a[: fewer * 6], reference))


def test_draws_differ_and_variants_share_their_noise(reference: tuple) -> None:
    """Without initial misalignment and resets, variants would be one and the same run."""
    phi = reference[0].last.phi.z.reshape(50, 6)
    assert np.unique(phi[:, 0]).size == 50


@given(st.integers(1, 400))
def test_a_tile_never_holds_more_draws_than_counted(variants: int) -> None:
    draws = 130
    runs = np.arange(draws * variants // batch.LANES * batch.LANES).reshape(-1, batch.LANES)
    held = [np.unique(row // variants).size for row in runs]
    assert max(held, default=1) <= batch.distinct_draws(variants)
    if len(held) > variants:
        assert max(held) == batch.distinct_draws(variants)


@pytest.mark.parametrize("cuts", [(600,), (100, 500), (300, 200, 100)])
def test_noise_is_the_same_however_the_run_is_cut(
    six_variants: batch.Group, cuts: tuple[int, ...]
) -> None:
    """Blocks of any length draw the same numbers, and shorter runs draw the first of them."""
    world, draw = six_variants.world, Draw(np.int64(7), np.int64(0), np.int64(0))
    whole, _ = stream(world, draw, np.zeros(6), np.int64(0), samples=600, dt=0.01)
    previous, first, pieces = np.zeros(6), 0, []
    for n in cuts:
        piece, previous = stream(world, draw, previous, np.int64(first), samples=n, dt=0.01)
        pieces.append(piece)
        first += n
    joined = jax.tree.map(lambda *a: np.concatenate(a), *pieces)
    for a, b in zip(jax.tree.leaves(joined), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-17)


@pytest.mark.parametrize("every", [0.07, 0.5])
def test_the_record_interval_does_not_touch_the_noise(every: float) -> None:
    """Final attitude after the same samples, to rounding: records only scale quaternions."""
    last = []
    for interval in (every, 0.01 * round(every * 100) * 2):
        study = small_study(
            study={
                "record_interval_s": interval,
                "duration_s": 8 * every,
                "window_s": [0, 8 * every],
            },
        )
        (part,) = scenario.parts(study)
        outcome, _ = all_runs(part.group)
        last.append(np.array([outcome.last.pitch, outcome.last.roll, outcome.last.yaw]))
    np.testing.assert_allclose(last[0], last[1], rtol=0, atol=1e-11)


def test_noise_is_standard_normal_and_independent() -> None:
    draws = jax.vmap(lambda d: imu.noise(np.int64(3), d, np.int64(0)))(np.arange(500))
    values = np.asarray(draws, dtype=float).reshape(500, -1)
    assert abs(values.mean()) < 4 / np.sqrt(values.size)
    assert abs(values.var() - 1) < 4 * np.sqrt(2 / values.size)
    neighbours = np.mean(values[:-1] * values[1:])
    assert abs(neighbours) < 4 / np.sqrt(values.size)


def test_broken_runs_are_rows_and_leave_their_neighbours_alone(
    six_variants: batch.Group, reference: tuple
) -> None:
    phi = six_variants.variants.phi
    broken = phi._replace(z=np.where(np.arange(6) == 2, np.nan, phi.z))
    group = six_variants._replace(variants=six_variants.variants._replace(phi=broken))
    outcome, _ = all_runs(group, devices=1, tiles_a_chunk=8)
    variant = np.arange(300) % 6
    assert np.isnan(outcome.last.yaw[variant == 2]).all()
    good = jax.tree.map(lambda a: a[variant != 2], outcome)
    assert_same_bits(good, jax.tree.map(lambda a: a[variant != 2], reference[0]))
