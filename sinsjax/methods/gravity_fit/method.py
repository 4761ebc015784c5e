"""The fit to the turn of gravity as a method: blocks of samples, and fits at some record times.

The samples of a block of about a second are summed in the body frame at its start. At a record
time the rotation and the velocity increment of the block are stored, 136 bytes per second of a run,
and when a fit is due all blocks so far are fitted, see `fit`: after 4, 8, 16, ... blocks, at
reported times and at the end. In between the gyros carry the attitude, without the biases found.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, dot, scale, select_tree
from sinsjax.methods.gravity_fit.fit import NUMBERS, Block, FitParams, Solution, solve
from sinsjax.methods.method import (
    UNKNOWN_ANGLE,
    AttitudeCovariance,
    BlockFit,
    Options,
    Program,
    Site,
)
from sinsjax.types import Array, Count, Flag, Navigation, Quat, Sample, Scalar, Vec3

BLOCK_S = 1.0
LEAST_BLOCKS = 4
GROWTH = 2
"""A fit is made after 4, 8, 16, ... blocks: all of them cost as much as the last."""


class FitState(NamedTuple):
    """A run between two samples.

    Attributes:
        nav: initial solution, whose attitude is the result before the first sample.
        turn: rotation of the body since the block began.
        dv: velocity increment since then, in b at that time, m/s.
        last: half the rotation of the last sample, rad.
        rate: half the rotation of a sample at the rate at its end, rad: extrapolated, since a lag
            of half a sample shows in the velocity of a long lever arm.
        carried: C_b^{b0} as the block began, without the gyro errors found so far.
        earth: rotation rate of the Earth in n, rad/s.
        count: samples so far.
        blocks: (most, `NUMBERS`) ended blocks, each a `fit.Block`.
        solution: of the last fit; NaN before the first.
    """

    nav: Navigation
    turn: Quat
    dv: Vec3
    last: Vec3
    rate: Vec3
    carried: Quat
    earth: Vec3
    count: Scalar
    blocks: Array
    solution: Solution


class Fitted(NamedTuple):
    """What a fit replaces of a `FitState`."""

    solution: Solution
    carried: Quat


def build(options: Options) -> Program:
    """Return the method; its params are `FitParams`."""
    record_s = options.record_every * options.dt
    records = max(1, round(BLOCK_S / record_s)) if record_s else 1
    length_s = records * record_s
    most = options.records // records
    counts = jnp.asarray(_fit_counts(most))

    def init(params: FitParams, nav: Navigation) -> FitState:
        zero = jnp.zeros_like(nav.ve)
        one = Quat(zero + 1, zero, zero, zero)
        still = Vec3(zero, zero, zero)
        blank = jnp.zeros((most, NUMBERS)) + zero
        gyro = (still,) * (1 if params.scale_factor is None else 4)
        covariance = AttitudeCovariance(
            *(UNKNOWN_ANGLE * (i == k) + zero for i in range(3) for k in range(i, 3))
        )
        nothing = Solution(one, gyro, still, still, covariance, zero, zero, zero)
        unknown = jax.tree.map(lambda a: a + jnp.nan, nothing)._replace(
            gyro=gyro, covariance=covariance
        )
        return FitState(nav, one, still, still, still, one, still, zero, blank, unknown)

    def step(params: Any, site: Site, state: FitState, sample: Sample, n: Scalar) -> FitState:
        dv = add(state.dv, rotations.rotate(state.turn, sample.dv))
        turn = rotations.multiply(state.turn, sample.turn)
        zero = jnp.zeros_like(n)
        earth = Vec3(zero, zero + site.place.rate_n, zero + site.place.rate_u)
        last = Vec3(*sample.turn[1:])
        rate = add(scale(1.5, last), scale(-0.5, state.last))
        return state._replace(turn=turn, dv=dv, last=last, rate=rate, earth=earth, count=n)

    def store(state: FitState, number: Count) -> FitState:
        ends = (number + 1) % records == 0
        rate = scale(2 / options.dt, state.rate)
        block = Block.of_turn(rotations.normalise(state.turn), state.dv, rate)
        place = jnp.minimum(number // records, most - 1)
        blocks = jax.lax.dynamic_update_index_in_dim(state.blocks, block.row(), place, 0)
        corrected = block.without_errors(state.solution.gyro, length_s)
        zero = jnp.zeros_like(state.count)
        begun = (
            Quat(zero + 1, zero, zero, zero),
            Vec3(zero, zero, zero),
            rotations.normalise(rotations.multiply(state.carried, corrected)),
        )
        turn, dv, carried = select_tree(ends, begun, (state.turn, state.dv, state.carried))
        return state._replace(blocks=blocks, turn=turn, dv=dv, carried=carried)

    def is_due(number: Count, reported: Flag) -> Flag:
        ended, rest = (number + 1) // records, (number + 1) % records
        spaced = jnp.any(counts == ended) & (rest == 0)
        last = number + 1 == options.records
        return (spaced | reported | last) & (ended >= LEAST_BLOCKS)

    def fit(params: FitParams, site: Site, state: FitState, number: Count) -> Fitted:
        ended = (number + 1) // records
        return Fitted(*solve(params, site.place, state.blocks, ended, length_s))

    def attitude(state: FitState) -> Quat:
        body = rotations.multiply(state.carried, state.turn)
        in_n0 = rotations.multiply(state.solution.attitude, body)
        q = rotations.multiply(_earth_rotation(state), in_n0)
        return select_tree(state.count > 0, q, state.nav.q)

    def covariance(state: FitState) -> AttitudeCovariance:
        ee, en, eu, nn, nu, uu = state.solution.covariance
        rows = rotations.matrix(_earth_rotation(state))
        turned = [
            Vec3(dot(row, Vec3(ee, en, eu)), dot(row, Vec3(en, nn, nu)), dot(row, Vec3(eu, nu, uu)))
            for row in rows
        ]
        return AttitudeCovariance(*(dot(turned[i], rows[k]) for i in range(3) for k in range(i, 3)))

    def _earth_rotation(state: FitState) -> Quat:
        """Return C_{n0}^n."""
        return rotations.exp(scale(-state.count * options.dt, state.earth))

    return Program(
        init=init,
        step=step,
        attitude=attitude,
        covariance=covariance,
        normalise=_normalise,
        floor=None,
        results=lambda site, state: state.solution,
        block_fit=BlockFit(
            store,
            is_due,
            fit,
            previous=lambda state: Fitted(state.solution, state.carried),
            merge=lambda state, fitted: state._replace(**fitted._asdict()),
        ),
    )


def _normalise(state: FitState) -> FitState:
    nav = state.nav._replace(q=rotations.normalise(state.nav.q))
    return state._replace(nav=nav, turn=rotations.normalise(state.turn))


def _fit_counts(most: int) -> list[int]:
    """Return the numbers of blocks after which a fit is made, each `GROWTH` times the last."""
    counts, count = [LEAST_BLOCKS], float(LEAST_BLOCKS)
    while (count := GROWTH * count) < most:
        counts.append(round(count))
    return counts
