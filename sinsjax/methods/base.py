"""What every alignment method is: a handful of pure functions of one run.

A method is built once from what decides the program (model, options, sample time) and is then fed
numbers. Methods never import one another; whoever drives them sees only this shape.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import Entries
from sinsjax.methods.description import StudyView
from sinsjax.methods.limits import Biases, Limit
from sinsjax.strapdown.earth import Earth, Place
from sinsjax.types import Array, Flag, Navigation, Quat, Sample, Scalar, Vec3


class Site(NamedTuple):
    """Where a run takes place.

    Attributes:
        earth: Earth model.
        place: its rates, curvatures and gravity at the starting latitude.
        latitude: rad.
    """

    earth: Earth
    place: Place
    latitude: Scalar


class Options(NamedTuple):
    """Choices that decide the program of a method, not its numbers (hashable).

    Attributes:
        dt: sample time, s.
        specific_force: in A(t): "measured" (turned to n by the computed attitude) or "gravity"
            (the constant (0, 0, g), with the velocity zero: A(t) of a base that is at rest).
        position: "fixed" or "integrated".
        trigger: name of a trigger, or "none".
        innovations: whether a filter sums up its normalised innovations.
    """

    dt: float
    specific_force: str = "measured"
    position: str = "fixed"
    trigger: str = "none"
    innovations: bool = False


class TriggerCounts(NamedTuple):
    """What a trigger did in a run.

    Attributes:
        count: resets that it called for.
        first: sample of the first of them, 0 for none.
        last: sample of the last of them, 0 for none.
    """

    count: Scalar
    first: Scalar
    last: Scalar


class Innovations(NamedTuple):
    """Sum of the normalised innovations squared r' S^-1 r of a run, and how many they are."""

    sum: Scalar
    count: Scalar


class FilterResults(NamedTuple):
    """What a filter tells of itself at the end of a run.

    Attributes:
        trigger_counts: what its trigger did; None without one.
        innovations: their sum; None where they are not summed up.
        own: what the columns of this filter alone are made of; None of one without.
    """

    trigger_counts: TriggerCounts | None
    innovations: Innovations | None
    own: Any = None


class AttitudeCovariance(NamedTuple):
    """Covariance of the misalignment, upper triangle row by row; NaN for methods without one.

    Attributes:
        ee: variance about east, rad^2.
        en: covariance about east and north, rad^2.
        eu: covariance about east and up, rad^2.
        nn: variance about north, rad^2.
        nu: covariance about north and up, rad^2.
        uu: variance about up, that of the heading, rad^2.
    """

    ee: Scalar
    en: Scalar
    eu: Scalar
    nn: Scalar
    nu: Scalar
    uu: Scalar


def no_covariance(like: Scalar) -> AttitudeCovariance:
    """That of a method without one, in numbers of the type given."""
    unknown = jnp.full_like(like, jnp.nan)
    return AttitudeCovariance(*(unknown for _ in AttitudeCovariance._fields))


class Ending(NamedTuple):
    """How a run ends.

    Attributes:
        n: number of its last sample.
        backward: whether that belongs to a backward pass.
    """

    n: Scalar
    backward: Flag


class ErrorStep(NamedTuple):
    """What a sample does to the error d of the corrected solution, to first order.

    d <- (I - k_m h_m) ... (I - k_1 h_1) ((I + A dt) d + G w): estimates that are fed back leave d
    as it is, and what is measured, a velocity that is truly zero, has no noise of its own.

    Attributes:
        transition: non-zero entries of A dt.
        inputs: non-zero entries of G, of errors of the increments in n: velocity east, north, up,
            m/s, then angle, rad.
        gains: k of each measurement, in the order they are taken, n entries each.
        measured: numbers of the measured states.
        axes: what takes b to the axes in which errors of the increments enter, where those are not
            n of the navigation solution.
    """

    transition: Entries
    inputs: Entries
    gains: tuple[tuple[Scalar, ...], ...]
    measured: tuple[int, ...]
    axes: Quat | None = None

    def entering(self, q: Quat) -> Quat:
        """What takes b to these axes; ``q`` is the attitude of the navigation solution."""
        return q if self.axes is None else self.axes


def updated(d: tuple[Scalar, ...], k: tuple[Scalar, ...], m: int) -> tuple[Scalar, ...]:
    """(I - k h) d, h the row that measures state m."""
    return tuple(one - gain * d[m] for one, gain in zip(d, k, strict=True))


class StartChange(NamedTuple):
    """What is added to the error of a solution before its first sample, to first order.

    Attributes:
        attitude: error C_true C_hat^T that it is added to.
        phi: misalignment about the computed axes, rad.
        ve: velocity east, m/s.
        vn: velocity north, m/s.
    """

    attitude: Quat
    phi: Vec3
    ve: Scalar
    vn: Scalar


Change = Callable[[Any, int | None, Scalar, Scalar], Any]
"""(params of one run, entry of a list or None, value of a key, its value before) -> params."""


class Relaxed(NamedTuple):
    """How a method's numbers follow the keys of a study, to be differentiated by them.

    Each key changes the numbers by the ratio of its value to the one before, so that no unit and no
    formula of the method's `parameters` is said twice.

    Attributes:
        changes: what a key of the study does to the numbers; those missing have no gradient.
        follows: keys that another one stands for where it is left out.
        times: the key of times that are spread; None where the method has none.
        moves: those of ``changes`` that move resets, too.
        soften: (params, times in samples or None, half width in samples) -> params, resets spread
            over smooth windows, at these times if given; None of a method that has none.
        refused: (study, whether resets are spread) -> what has no gradient, ``[section] key``; None
            if nothing.
    """

    changes: Mapping[str, Change]
    follows: Mapping[str, str] = {}
    times: str | None = None
    moves: tuple[str, ...] = ()
    soften: Callable[[Any, Array | None, Scalar], Any] | None = None
    refused: Callable[[StudyView, bool], str | None] = lambda study, spread: None


class Method(NamedTuple):
    """An alignment method. Its state has the navigation solution as ``nav``, or wraps one that has.

    Attributes:
        init: (params, navigation) -> state.
        step: (params, site, state, sample, n) -> state after the n-th sample, n from 1, its loop
            not yet closed.
        turn: (params, site, state) -> state after a direction reversal; the site is that of the
            pass that ends.
        attitude: state -> best attitude, i.e. with the estimated misalignment taken out.
        covariance: state -> `AttitudeCovariance` of that attitude.
        normalise: state -> state with its quaternion scaled to unit length.
        limit: (params, place, biases, `Ending`) -> `Limit` that constant biases leave; the place is
            that of a forward pass. `limits.unaided` where a method finds no heading: its level part
            counts all the same.
        results: (site, state) -> what the method's own columns are made of at the end of a run,
            see `description.OwnColumn`; None of a method without.
        close: (params, state, n) -> state after what is due after the n-th sample: feedback and
            reset. Where nothing is due it is the state as it stands, to the bit. None of a method
            whose loop is closed within the step.
        next_event: (params, state, n) -> sample after the n-th at which anything is due next, as a
            number; None, of some params or of all, where that is found out as it goes.
        rewind: (params, navigation, state) -> state that begins the record again: the solution is
            that of its beginning, wound back from the state at its end. None of a method that takes
            in a record once.
        begin_after: (state that begins, n) -> the same with sample n + 1 as its first; None of a
            method whose state does not count samples.
        gyro_bias: state -> estimated gyro bias in b that samples are to be freed from, rad/s; None
            of a method that estimates none.
        called: (state, n) -> whether the n-th sample itself called for the loop to be closed after
            it, which no `next_event` could tell before; None of a method where none does.
        error_step: (params, site, state, sample, n) -> `ErrorStep` of the step from that state;
            None of a method whose step tells no linear part.
        error_angles: state -> phi of the corrected attitude by the states of d, (3, n) rows in n;
            None with ``error_step``.
        start_error: (state that begins, `StartChange`) -> d of a start that is off by so much more;
            None with ``error_step``.
        per_record: state at a record time -> state that begins the next interval, and what is
            told of this one beside the observation; None of a method that tells no more.
        common_covariance: whether the covariance depends on params and n alone, so that runs that
            differ in their draw can share it.
    """

    init: Callable[[Any, Navigation], Any]
    step: Callable[[Any, Site, Any, Sample, Scalar], Any]
    turn: Callable[[Any, Site, Any], Any]
    attitude: Callable[[Any], Quat]
    covariance: Callable[[Any], AttitudeCovariance]
    normalise: Callable[[Any], Any]
    limit: Callable[[Any, Place, Biases, Ending], Limit]
    results: Callable[[Site, Any], Any] | None = None
    close: Callable[[Any, Any, Scalar], Any] | None = None
    next_event: Callable[[Any, Any, Scalar], Scalar | None] | None = None
    called: Callable[[Any, Scalar], Flag] | None = None
    common_covariance: bool = False
    rewind: Callable[[Any, Navigation, Any], Any] | None = None
    gyro_bias: Callable[[Any], Vec3] | None = None
    begin_after: Callable[[Any, Scalar], Any] | None = None
    error_step: Callable[[Any, Site, Any, Sample, Scalar], ErrorStep] | None = None
    error_angles: Callable[[Any], tuple[tuple[Scalar, ...], ...]] | None = None
    start_error: Callable[[Any, StartChange], tuple[Scalar, ...]] | None = None
    per_record: Callable[[Any], tuple[Any, tuple[Scalar, ...]]] | None = None
