"""Least squares of the turn of gravity in inertial space, with the sensor biases as unknowns.

The gyros carry the specific force to an inertial frame l, level at the first sample and of unknown
heading. There gravity's reaction turns with the Earth. Blocks j of length h, about a second, give
level velocity increments; with a complex number for the two level axes,

    y_j = g h c G_j + g h U_j (k_y - i k_x) + sum over the errors e of X_j e + noise,
    G = cos L sin Wt + i cos L sin L (1 - cos Wt),    U = 1 - cos^2 L (1 - cos Wt).

c = e^{i heading of l} turns east and north to the axes of l, k is the tilt of l. Gyro errors rotate
l by p(t) = sum of C d(angle), which for a constant bias b is P(t) b:

    X_j b = g h [U (p_y - i p_x) + i c G p_z],

and accelerometer errors enter as the level part of C a h. White noise of the gyros adds a random
walk w to p, so that the sums over the blocks need a whitening filter: a Kalman filter of w, whose
innovations are independent. It filters every column alike, see `noise`. Then

    N = Re sum of x x^*,    N e = Re sum of x z^*

has the prior of the biases on its diagonal.

The first pass takes c for an arbitrary complex number, which makes it linear from any heading. Each
further pass carries the blocks again without the biases found, levels l, and solves for a small
change of the heading: Gauss-Newton. X follows from the modelled force; the measured one would make
the sigma several per cent too small. The length of a change e is sqrt(e^T N e), in sigma: of the
third pass it is below 0.01 where biases turn l by less than a degree, and passes end when it is
below 0.1. A bias of 900 deg/h, which turns l by 75 deg in 300 s, takes 6 passes over two to four
positions of the base.

The attitude at the end is C = Rz(-heading) exp(-(P b + k + w)) C_b^l, so its misalignment is linear
in the errors as well: a gyro bias along the vertical, which nothing shows on a base that does not
tilt, leaves P_z b.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.methods.azimuth_and_tilt import rotate_covariance, rotation_about_vertical
from sinsjax.methods.gravity_fit.noise import (
    Covariance,
    NoiseModel,
    SensorNoise,
    block_noise_model,
    kalman_predictor_step,
    multiply_pairs,
    vertical_gyro_heading_variance,
)
from sinsjax.methods.method import UNKNOWN_ANGLE, AttitudeCovariance
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Count, Flag, Quat, Scalar, Vec3

LEAST_PASSES, MOST_PASSES = 3, 10
_CONVERGED = 0.1
"""Change of a pass, in sigma, after which no other follows: what is left is of its second order."""
_FOUND = 0.5
"""Standard deviation of the heading, rad, beyond which passes wander, and end after the least."""

NUMBERS = 17
"""Numbers of a block."""

HEADING, GYRO = 1, 4
"""Places of unknowns: |c|, heading, two tilts, the gyro errors, accelerometer biases, lever arm."""

_ANY, _LEVEL, _KNOWN = 1e3, 1.0, 1e-9
"""Sigma of |c| and heading before the data, of the tilt, rad, and of |c| after the first pass."""

_AXES = (Vec3(1.0, 0.0, 0.0), Vec3(0.0, 1.0, 0.0), Vec3(0.0, 0.0, 1.0))


class FitParams(NamedTuple):
    """Beliefs about sensors and base: their noise, and 1 sigma of each axis' errors, SI units."""

    noise: SensorNoise
    gyro_bias: Scalar
    accel_bias: Scalar
    # Of the gyros; None leaves these, and the cross-axis errors, out
    scale_factor: Scalar | None = None
    cross_axis: Scalar | None = None  # of the gyros, rad
    lever_arm: Scalar | None = None  # from the turn axis to the sensors, m; None for sensors in it

    def sigmas(self) -> tuple[tuple[Vec3, ...], tuple[Vec3, ...]]:
        """Return 1 sigma of the triads of `_Guess.gyro` and of `_Guess.others`."""
        s, c = self.scale_factor, self.cross_axis
        gyro, others = [(self.gyro_bias,) * 3], [(self.accel_bias,) * 3]
        gyro += [] if s is None else [(s, c, c), (c, s, c), (c, c, s)]
        others += [] if self.lever_arm is None else [(self.lever_arm,) * 3]
        return tuple(Vec3(*sigma) for sigma in gyro), tuple(Vec3(*sigma) for sigma in others)


class Block(NamedTuple):
    """The samples of about a second."""

    turn: Quat  # rotation of the body
    mean: Quat  # mean of the rotation over the time
    angle: Vec3  # rotation vector of ``turn``, rad
    dv: Vec3  # velocity increment in b at the start, m/s
    rate: Vec3  # angular rate in b at the end, rad/s, or the mean while it overlaps the next

    @classmethod
    def of_turn(cls, turn: Quat, dv: Vec3, rate: Vec3, mean: Quat | None = None) -> "Block":
        """Return the block with its angle; without a mean the base turns at a constant rate."""
        angle = rotations.log(turn)
        return cls(turn, mean or rotations.exp(scale(0.5, angle)), angle, dv, rate)

    @classmethod
    def of_row(cls, row: Array) -> "Block":
        """Return the block of its numbers."""
        vectors = (Vec3(*row[i : i + 3]) for i in (8, 11, 14))
        return cls(Quat(*row[:4]), Quat(*row[4:8]), *vectors)

    def row(self) -> Array:
        """Return its `NUMBERS`."""
        return jnp.stack(jax.tree.leaves(self))

    def rotations_by_gyro_errors(self, triads: int, length_s: float) -> list[Vec3]:
        """Return its rotation by each gyro error, see `Solution.gyro`, in b at its start.

        Each is a factor times the mean of an axis of b over the block: over the angle turned, by
        Simpson's rule, exact for turns about one axis at any rate. That of a bias is over the time,
        in which a swaying base can lead or lag by more than it turns.
        """
        half = rotations.exp(scale(0.5, self.angle))
        lead = rotations.multiply(self.mean, rotations.conjugate(half))
        rows = zip(rotations.matrix(half), rotations.matrix(self.turn), strict=True)
        mean = [
            [(float(i == k) + 4 * middle[k] + last[k]) / 6 for k in range(3)]
            for i, (middle, last) in enumerate(rows)
        ]
        axes = [Vec3(*axis) for axis in zip(*mean, strict=True)]
        biases = [scale(length_s, rotations.rotate(lead, axis)) for axis in axes]
        return biases + [scale(f, axis) for f in self.angle[: triads - 1] for axis in axes]

    def turn_without(self, rotation: Vec3) -> Quat:
        """Return the rotation of the body less that by errors."""
        return rotations.multiply(rotations.exp(scale(-1.0, rotation)), self.turn)


class Solution(NamedTuple):
    """The result of a fit."""

    # C_{b0}^{n0} that carries the body frame at the first sample to n at that time, such that
    # the attitude at the fit is that of the last block
    attitude: Quat
    carried: Quat  # C_b^{b0} at the end of the last block, without the gyro errors
    # Triads of gyro errors in b: the bias, rad/s; then, if they are unknowns, the columns of
    # the matrix of scale factors and cross-axis errors
    gyro: tuple[Vec3, ...]
    gyro_bias_variance: Vec3  # of each axis, (rad/s)^2
    covariance: AttitudeCovariance  # of the misalignment at the last block, in n0
    misfit: Scalar  # root mean square of the whitened residuals, 1 if the noise is as believed
    prior_ratio: Scalar  # the largest error found of sensors and lever arm over its prior sigma
    change: Scalar  # length of the last pass's change of the unknowns, in sigma

    @classmethod
    def of_unknown_attitude(cls, params: FitParams, zero: Scalar) -> "Solution":
        """Return that before the first fit: no attitude, no errors."""
        none, off, all_round = zero + jnp.nan, zero, zero + UNKNOWN_ANGLE
        return cls(
            attitude=Quat(none, none, none, none),
            carried=Quat(zero + 1, zero, zero, zero),
            gyro=tuple(Vec3(zero, zero, zero) for _ in params.sigmas()[0]),
            gyro_bias_variance=Vec3(none, none, none),
            covariance=AttitudeCovariance(all_round, off, off, all_round, off, all_round),
            misfit=none,
            prior_ratio=none,
            change=none,
        )


def solve(
    params: FitParams, place: Place, blocks: Array, count: Count, length_s: float
) -> Solution:
    """Fit attitude and biases to the first ``count`` blocks, at least 2, of (most, `NUMBERS`)."""
    first = Block.of_row(blocks[0]).dv
    zero = jnp.zeros_like(first.x)
    solution = Solution.of_unknown_attitude(params, zero)
    triads = jax.tree.map(lambda sigma: zero, params.sigmas())
    guess = _Guess(_level_attitude(first), (zero + 1, zero), *triads)
    model = block_noise_model(params.noise, place.gravity, length_s)

    def is_unfinished(carry: tuple[Count, _Guess, Solution]) -> Flag:
        number, _, solution = carry
        moves = (solution.change > _CONVERGED) & (solution.covariance.uu < _FOUND**2)
        return (moves & (number < MOST_PASSES)) | (number < LEAST_PASSES)

    def over_pass(carry: tuple[Count, _Guess, Solution]) -> tuple[Count, _Guess, Solution]:
        number, guess, _ = carry
        is_known = jnp.where(number == 0, zero, zero + 1)
        here = _GaussNewtonPass(place, model, guess, is_known, length_s)
        return number + 1, *here.run(params, blocks, count)

    return jax.lax.while_loop(is_unfinished, over_pass, (jnp.asarray(0), guess, solution))[2]


class _Guess(NamedTuple):
    """The point of linearisation."""

    level: Quat  # C_{b0}^l
    heading: tuple[Scalar, Scalar]  # c of unit length, real and imaginary part
    gyro: tuple[Vec3, ...]
    # Accelerometer bias, m/s^2, and if it is an unknown the lever arm, m, in b
    others: tuple[Vec3, ...]

    def errors(self) -> Array:
        """Return the unknowns from `GYRO` on."""
        return jnp.stack(jax.tree.leaves((self.gyro, self.others)))

    def corrected(self, unknown: Array, is_later_pass: Scalar) -> "_Guess":
        """Return the guess with the changes that a pass finds; the first knows no heading."""
        real, imaginary, kx, ky, *errors = unknown
        real, (cos, sin) = is_later_pass + real, self.heading
        cos, sin = cos * real - sin * imaginary, sin * real + cos * imaginary
        norm = jnp.hypot(cos, sin)
        leaves, structure = jax.tree.flatten((self.gyro, self.others))
        later = [old + change for old, change in zip(leaves, errors, strict=True)]
        level = rotations.multiply(rotations.exp(Vec3(-kx, -ky, 0.0 * kx)), self.level)
        return _Guess(level, (cos / norm, sin / norm), *jax.tree.unflatten(structure, later))


class _PassSums(NamedTuple):
    """A pass up to a block; complex numbers stand for the level axes of l."""

    body: Quat  # C_b^l at the end of the block
    turned: tuple[Vec3, ...]  # P, columns of how far each gyro error has rotated l, Vec3 by unknown
    swung: tuple[Vec3, ...]  # velocity in l per lever arm along each axis of b
    # (unknowns + 1, 2) estimates of w, of the drifts and of the surge for each column, and
    # last for the measurements
    walk: tuple[Array, ...]
    variance: Covariance  # their covariance, per axis
    # Rows of the upper triangle of N, with the measurements as last column
    normal: tuple[Array, ...]


class _GaussNewtonPass(NamedTuple):
    """A pass over the blocks; ``is_known`` is 0 in the first, where c is a free number, else 1."""

    place: Place
    noise: NoiseModel
    guess: _Guess
    is_known: Scalar
    length_s: float

    def run(self, params: FitParams, blocks: Array, count: Count) -> tuple[_Guess, Solution]:
        """Return the next guess and the solution."""

        def over_block(j: Count, sums: _PassSums) -> _PassSums:
            row = jax.lax.dynamic_index_in_dim(blocks, j, keepdims=False)
            return self.add_block(sums, Block.of_row(row), j)

        end = jax.lax.fori_loop(0, count, over_block, self.start())
        amplitude = jnp.where(self.is_known > 0, _KNOWN, _ANY)
        sigmas = amplitude, _ANY, _LEVEL, _LEVEL, *jax.tree.leaves(params.sigmas())
        prior = jnp.stack([sigma + 0 * self.is_known for sigma in sigmas])
        unknown, covariance, square, change = _solve_change_covariance_misfit_length(
            end.normal, self.guess, prior
        )
        later = self.guess.corrected(unknown, self.is_known)

        rotation, in_l = _final_attitude_error(end, unknown, covariance)
        ratio = jnp.abs(later.errors()) / jnp.where(prior > 0, prior, jnp.inf)[GYRO:]
        data_s = jnp.asarray(count, square.dtype) * self.length_s
        level, heading = end.variance[0, 0], vertical_gyro_heading_variance(params.noise, data_s)
        in_l = in_l + jnp.diag(jnp.stack([level, level, heading]))
        cos, sin = later.heading[0], -later.heading[1]
        levelled = rotations.multiply(rotations.exp(scale(-1.0, rotation)), self.guess.level)
        return later, Solution(
            attitude=rotations.multiply(rotation_about_vertical(sin, cos), levelled),
            carried=rotations.multiply(rotations.conjugate(self.guess.level), end.body),
            gyro=later.gyro,
            gyro_bias_variance=Vec3(*jnp.diagonal(covariance)[GYRO : GYRO + 3]),
            covariance=rotate_covariance(AttitudeCovariance(*in_l[jnp.triu_indices(3)]), sin, cos),
            misfit=jnp.sqrt(jnp.maximum(square, 0.0) / (2 * data_s / self.length_s - 4)),
            prior_ratio=jnp.max(ratio),
            change=change,
        )

    def start(self) -> _PassSums:
        """Return the sums before the first block."""
        zero = jnp.zeros_like(self.is_known)
        none = Vec3(zero, zero, zero)
        n = GYRO + 3 * (len(self.guess.gyro) + len(self.guess.others))
        return _PassSums(
            self.guess.level,
            (none,) * (3 * len(self.guess.gyro)),
            (none,) * (3 * len(self.guess.others[1:])),
            (jnp.zeros((n + 1, 2)) + zero,) * len(self.noise.states),
            self.noise.initial(),
            tuple(jnp.zeros(n + 1 - i) + zero for i in range(n + 1)),
        )

    def gravity_turn(self, j: Count) -> tuple[Scalar, Scalar, Scalar]:
        """Return c G and U at the middle of a block."""
        rate = jnp.hypot(self.place.rate_n, self.place.rate_u)
        cos, sin = self.place.rate_n / rate, self.place.rate_u / rate
        angle = rate * (jnp.asarray(j, rate.dtype) + 0.5) * self.length_s
        versed = 2 * jnp.sin(0.5 * angle) ** 2
        east, north = cos * jnp.sin(angle), cos * sin * versed
        real, imaginary = self.guess.heading
        return real * east - imaginary * north, imaginary * east + real * north, 1 - cos**2 * versed

    def add_block(self, sums: _PassSums, block: Block, number: Count) -> _PassSums:
        """Return the sums with one more block."""
        guess, h = self.guess, self.length_s
        accel_bias, *lever = guess.others
        errors = block.rotations_by_gyro_errors(len(guess.gyro), h)
        estimate = combine(errors, guess.gyro)
        dv = add(block.dv, scale(-0.5, cross(estimate, block.dv)))
        dv = add(dv, scale(-1.0, combine(errors[:3], (accel_bias,))))
        measured = rotations.rotate(sums.body, dv)
        body = rotations.multiply(sums.body, block.turn_without(estimate))

        gx, gy, up = self.gravity_turn(number)
        gh, zero = self.place.gravity * h, jnp.zeros_like(up)
        # In the first pass c is unknown, and the amplitude is that of c itself.
        mx, my = self.is_known * gx, self.is_known * gy
        rotated = [rotations.rotate(sums.body, error) for error in errors]
        middle = [add(a, scale(0.5, b)) for a, b in zip(sums.turned, rotated, strict=True)]
        # A bias of the accelerometers acts along the same axes for as long as one of the gyros.
        x = [
            (gh * gx, gh * gy),
            (-gh * gy, gh * gx),
            (zero, -gh * up),
            (gh * up, zero),
            *((gh * (up * p.y - my * p.z), gh * (mx * p.z - up * p.x)) for p in middle),
            *((p.x, p.y) for p in rotated[:3]),
        ]
        swung: tuple[Vec3, ...] = ()
        if lever:
            swung = tuple(rotations.rotate(body, cross(block.rate, axis)) for axis in _AXES)
            gained = [add(a, scale(-1.0, b)) for a, b in zip(swung, sums.swung, strict=True)]
            x += [(a.x, a.y) for a in gained]
            measured = add(measured, scale(-1.0, combine(gained, lever)))
        x += [(measured.x - gh * mx, measured.y - gh * my)]

        angles = rotations.log(block.mean), block.angle
        turns = (rotations.rotate(sums.body, angle).z for angle in angles)
        sees, step, gain, s, variance = kalman_predictor_step(self.noise, sums.variance, *turns)
        residual = jnp.stack([jnp.stack(row) for row in x])
        if lever:  # its velocity at the first sample is unknown
            residual = jnp.where(jnp.asarray(number) > 0, residual, 0.0 * residual)
        for factor, estimates in zip(sees, sums.walk, strict=True):
            residual = residual - multiply_pairs(factor, estimates)
        walk = tuple(
            sum(multiply_pairs(f, sums.walk[j]) for j, f in row.items())
            + multiply_pairs(k, residual)
            for row, k in zip(step, gain, strict=True)
        )
        # Row by row: what a row needs stays in the registers.
        normal = tuple(
            old + (row[0] * residual[i:, 0] + row[1] * residual[i:, 1]) / s
            for i, (old, row) in enumerate(zip(sums.normal, residual, strict=True))
        )
        turned = tuple(add(a, b) for a, b in zip(sums.turned, rotated, strict=True))
        return _PassSums(body, turned, swung, walk, variance, normal)


def combine(vectors: Sequence[Vec3], factors: Sequence[Vec3]) -> Vec3:
    """Return a linear combination of vectors, of which each triad of factors takes three."""
    return reduce(add, map(scale, jax.tree.leaves(factors), vectors))


def _solve_change_covariance_misfit_length(
    normal: tuple[Array, ...], guess: _Guess, prior_sigmas: Array
) -> tuple[Array, Array, Scalar, Scalar]:
    """Return changes of the unknowns, covariance, squared residuals, length of changes in sigma."""
    n = len(prior_sigmas)
    upper = jnp.stack([jnp.pad(row, (i, 0)) for i, row in enumerate(normal)])
    whole = upper + jnp.triu(upper, 1).T
    matrix, right = whole[:n, :n], whole[:n, n]
    # A known unknown, of sigma 0, is left out. The others differ by ten powers of ten: they are
    # scaled to the same information, without which the inverse would lose the small variances.
    is_free = prior_sigmas > 0
    belief = jnp.where(is_free, 1 / jnp.where(is_free, prior_sigmas, 1.0) ** 2, 0.0)
    information = jnp.where(is_free, jnp.diagonal(matrix) + belief, 1.0)
    size = jnp.where(is_free, 1 / jnp.sqrt(information), 0.0)
    scaled = matrix * size[:, None] * size[None, :]
    scaled = scaled + jnp.diag(jnp.where(is_free, belief * size**2, 1.0))
    covariance = invert_by_gauss_jordan(scaled) * size[:, None] * size[None, :]
    # The belief is about the whole error, of which the guess has a part.
    pull = right - belief * jnp.pad(guess.errors(), (GYRO, 0))
    unknown = covariance @ pull
    length = jnp.sqrt(jnp.maximum(unknown @ pull, 0.0))
    return unknown, covariance, whole[n, n] - unknown @ right, length


def invert_by_gauss_jordan(positive_definite: Array) -> Array:
    """Return the inverse of a symmetric positive definite matrix (n, n) of unit diagonal.

    By Gauss and Jordan, which needs no pivots here. For `jnp.linalg.inv` XLA calls LAPACK, from
    the threads of several devices at once, and has been seen to wait for ever.
    """
    places = jnp.arange(len(positive_definite))

    def eliminate(k: Count, a: Array) -> Array:
        is_pivot = places == k
        row = jnp.where(is_pivot, 1.0, a[k]) / a[k, k]
        column = jnp.where(is_pivot, 0.0, a[:, k])
        rest = jnp.where(is_pivot[None, :], 0.0, a) - column[:, None] * row[None, :]
        return jnp.where(is_pivot[:, None], row[None, :], rest)

    return jax.lax.fori_loop(0, len(places), eliminate, positive_definite)


def _final_attitude_error(end: _PassSums, unknown: Array, covariance: Array) -> tuple[Vec3, Array]:
    """Return the rotation in l by which the carried attitude is off, and the error's covariance.

    That of the noise which nothing shows is left out.
    """
    turned = jnp.stack([jnp.stack(part) for part in zip(*end.turned, strict=True)])
    rest = len(unknown) - GYRO - len(end.turned)
    effect = jnp.pad(turned, ((0, 0), (GYRO, rest))).at[0, 2].set(1.0).at[1, 3].set(1.0)
    # w = p_y - i p_x of the white noise, as the last blocks show it
    walk = end.walk[0]
    of_walk = jnp.stack([-walk[:, 1], walk[:, 0], jnp.zeros_like(walk[:, 0])])
    effect = effect - of_walk[:, :-1]
    rotation = effect @ unknown + of_walk[:, -1]
    with_heading = effect.at[2, HEADING].add(1.0)
    return Vec3(*rotation), with_heading @ covariance @ with_heading.T


def _level_attitude(force: Vec3) -> Quat:
    """Return the least rotation that turns a specific force upwards."""
    length = jnp.sqrt(dot(force, force))
    x, y, w = force.x / length, force.y / length, 1 + force.z / length
    # Axis force x up = (y, -x, 0); half angle from w = 1 + cos
    norm = jnp.sqrt(w * w + x * x + y * y)
    return Quat(w / norm, y / norm, -x / norm, jnp.zeros_like(w))
