"""The interface of an alignment method: a few pure functions of one run, in groups.

A method is built once from `Options`, which decide its program, and is then given numbers, its
params. Methods never import one another; the engine knows them by `Method` alone.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.methods.description import StudyView
from sinsjax.methods.floors import BiasFloor, MeanBiases
from sinsjax.strapdown import earth
from sinsjax.strapdown.earth import Earth, Place
from sinsjax.types import Array, Count, Flag, Navigation, Quat, Sample, Scalar, Vec3


class Site(NamedTuple):
    """The Earth at the place of a run.

    Attributes:
        earth: Earth model.
        place: rates, curvatures and gravity at the starting latitude.
        latitude: rad.
    """

    earth: Earth
    place: Place
    latitude: Scalar


class Options(NamedTuple):
    """Choices that decide the program of a method but are no numbers of it (hashable).

    Attributes:
        dt: sample time, s.
        specific_force: in A(t): "measured" (transformed to n with the computed attitude) or
            "gravity" (the constant (0, 0, g) and zero velocity: A(t) of a base at rest).
        position: "fixed" or "integrated".
        trigger: name of a trigger, or "none".
        innovations: whether a filter sums its normalised innovations.
        record_every: samples per record interval, for a method that stores blocks; 0 for others.
        records: record intervals of a run, likewise.
    """

    dt: float
    specific_force: str = "measured"
    position: str = "fixed"
    trigger: str = "none"
    innovations: bool = False
    record_every: int = 0
    records: int = 0

    def place(self, site: Site, nav: Navigation) -> Place:
        """Return the Earth where a run starts, or at the latitude of its solution."""
        if self.position == "integrated":
            return earth.place(site.earth, nav.latitude)
        return site.place


class TriggerCounts(NamedTuple):
    """Resets by a trigger in a run.

    Attributes:
        count: number of resets.
        first: sample of the first of them, 0 for none.
        last: sample of the last of them, 0 for none.
    """

    count: Scalar
    first: Scalar
    last: Scalar


class InnovationSum(NamedTuple):
    """Sum and number of the normalised innovations squared r' S^-1 r of a run."""

    sum: Scalar
    count: Scalar


class FilterResults(NamedTuple):
    """Basis of a filter's own result columns.

    Attributes:
        trigger_counts: resets by its trigger; None without one.
        innovations: sum of its innovations; None if they are not summed.
        extra: basis of the columns of this filter alone; None if the filter has none.
    """

    trigger_counts: TriggerCounts | None
    innovations: InnovationSum | None
    extra: Any = None


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


UNKNOWN_ANGLE = jnp.pi**2 / 3
"""Variance of an angle that may be any, rad^2."""


def unknown_covariance(like: Scalar) -> AttitudeCovariance:
    """Return NaN of the given number's type and shape, for a method without a covariance."""
    unknown = jnp.full_like(like, jnp.nan)
    return AttitudeCovariance(*(unknown for _ in AttitudeCovariance._fields))


class RunEnd(NamedTuple):
    """The end of a run.

    Attributes:
        n: number of its last sample.
        backward: whether the last sample is of a backward pass.
    """

    n: Scalar
    backward: Flag


Change = Callable[[Any, int | None, Scalar, Scalar], Any]
"""(params of one run, entry of a list or None, value of a key, its value before) -> params."""


class Relaxation(NamedTuple):
    """Differentiable dependence of a method's params on the keys of a study.

    Each key changes the params by the ratio of its value to the one before, so that no unit and no
    formula of the method's `parameters` is written twice.

    Attributes:
        changes: effect of each key on the params; a key without one has no gradient.
        follows: keys whose value another key takes if that is left out.
        times: the key of times that are smoothed; None if the method has none.
        moves: the keys of ``changes`` that move resets, too.
        smooth_resets: (params, times in samples or None, half width in samples) -> params with each
            reset spread over a smooth window, at these times if given; None if the method has none.
        find_unsupported: (study, whether resets are smoothed) -> first key without a gradient, as
            ``[section] key``; None if there is none.
    """

    changes: Mapping[str, Change]
    follows: Mapping[str, str] = {}
    times: str | None = None
    moves: tuple[str, ...] = ()
    smooth_resets: Callable[[Any, Array | None, Scalar], Any] | None = None
    find_unsupported: Callable[[StudyView, bool], str | None] = lambda study, smoothed: None


class Feedback(NamedTuple):
    """Closing the loop of a method: feedback of the estimate and resets of P.

    Attributes:
        close: (params, state, n) -> state after the feedback and reset that are due after the n-th
            sample. If nothing is due, the state is unchanged to the bit.
        next_event: (params, state, n) -> number of the first sample after the n-th at which
            anything is due; None if that is known only as the run proceeds.
        triggered: (state, n) -> whether the n-th sample itself called for the loop to be closed,
            which `next_event` could not foresee; None if the method has none.
    """

    close: Callable[[Any, Any, Scalar], Any]
    next_event: Callable[[Any, Any, Scalar], Scalar | None]
    triggered: Callable[[Any, Scalar], Flag] | None = None


class Passes(NamedTuple):
    """Repeated passes over a stored record.

    Attributes:
        reverse: (params, site, state) -> state after a direction reversal; the site is that of the
            pass that ends.
        rewind: (params, navigation, state) -> state that starts the record again, from its first
            solution, propagated back from the state at its end; None if the method reads a
            record once.
        begin_after: (first state, n) -> the same with sample n + 1 as its first; None if
            the state does not count samples.
        gyro_bias: state -> estimated gyro bias in b, rad/s, which is removed from the stored
            samples as the attitude is propagated back; None if the method estimates none.
    """

    reverse: Callable[[Any, Site, Any], Any]
    rewind: Callable[[Any, Navigation, Any], Any] | None = None
    begin_after: Callable[[Any, Scalar], Any] | None = None
    gyro_bias: Callable[[Any], Vec3] | None = None


class BlockFit(NamedTuple):
    """A method that stores blocks of samples, and fits all of them at some record times.

    Attributes:
        store: (state, number of the record interval) -> state after its end.
        is_due: (number, whether its end is reported) -> whether a fit is due, for all runs.
        fit: (params, site, state, number) -> what a fit replaces of the state. Not the blocks,
            which would be copied.
        previous: state -> the same parts of it, unchanged.
        merge: (state, result of ``fit``) -> state.
    """

    store: Callable[[Any, Count], Any]
    is_due: Callable[[Count, Flag], Flag]
    fit: Callable[[Any, Site, Any, Count], Any]
    previous: Callable[[Any], Any]
    merge: Callable[[Any, Any], Any]


class Method(NamedTuple):
    """An alignment method. Its state has the navigation solution as ``nav``.

    Attributes:
        init: (params, navigation) -> state before the first sample.
        step: (params, site, state, sample, n) -> state after the n-th sample, n from 1, before the
            loop is closed.
        attitude: state -> best attitude: the solution's with the estimated misalignment removed.
        covariance: state -> `AttitudeCovariance` of that attitude.
        normalise: state -> state with its quaternions scaled to unit length.
        floor: (params, place, biases, `RunEnd`) -> `BiasFloor` left by constant sensor biases; the
            place is that of a forward pass. `floors.bias_floor` also of a method that finds no
            heading, whose level part counts.
        results: (site, state) -> basis of the method's own result columns at the end of a run, see
            `description.OwnColumn`; None if the method has none.
        shares_covariance: whether the covariance depends on params and n alone, so that runs that
            differ in their draw can share it.
        feedback: how the loop is closed; None if the method closes it within ``step``.
        passes: how passes over a stored record begin; None if the method reads it once.
        block_fit: fits at record times; None for a method whose steps are all there is.
    """

    init: Callable[[Any, Navigation], Any]
    step: Callable[[Any, Site, Any, Sample, Scalar], Any]
    attitude: Callable[[Any], Quat]
    covariance: Callable[[Any], AttitudeCovariance]
    normalise: Callable[[Any], Any]
    floor: Callable[[Any, Place, MeanBiases, RunEnd], BiasFloor]
    results: Callable[[Site, Any], Any] | None = None
    shares_covariance: bool = False
    feedback: Feedback | None = None
    passes: Passes | None = None
    block_fit: BlockFit | None = None
