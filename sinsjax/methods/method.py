"""The interface of an alignment method: a `Method` is what studies know, a `Program` what runs.

A `Method` names its keys and columns, makes its numbers (params) from a study, and builds its
`Program` from `Options`: a few pure functions of one run. Methods never import one another; the
engine knows them by these types alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeAlias

import jax.numpy as jnp
from numpy.typing import NDArray

from sinsjax.columns import Column
from sinsjax.maths import rotations
from sinsjax.methods import floors
from sinsjax.methods.floors import BiasFloor, MeanBiases
from sinsjax.strapdown import earth
from sinsjax.strapdown.earth import Earth, Place
from sinsjax.types import Count, Flag, Navigation, Quat, Sample, Scalar
from sinsjax.value_types import Section

INITIAL_KEYS = (
    *("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "misalignment"),
    *("ve0_m_per_s", "vn0_m_per_s"),
)
"""The keys of [alignment] for a method that starts from an attitude and a velocity."""

# What runs


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


class AttitudeCovariance(NamedTuple):
    """Covariance of the misalignment about east, north and up, rad^2; NaN for methods without one.

    Its upper triangle row by row: ``ee`` is the variance about east, ``uu`` that of the heading.
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
        begin_after: (first state, n) -> the same with sample n + 1 as its first; None if
            the state does not count samples.
    """

    reverse: Callable[[Any, Site, Any], Any]
    begin_after: Callable[[Any, Scalar], Any] | None = None


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


def normalise_solution(state: Any) -> Any:
    """Return a state with the attitude of its navigation solution ``nav`` scaled to unit length."""
    return state._replace(nav=state.nav._replace(q=rotations.normalise(state.nav.q)))


def earth_floor(
    params: Any, place: Place, biases: MeanBiases, n: Scalar, backward: Flag
) -> BiasFloor:
    """Return the floor of a method that attributes the effect of constant biases to the Earth."""
    return floors.bias_floor(place, biases)


class Program(NamedTuple):
    """The functions of a method. Its state has the navigation solution as ``nav``.

    Attributes:
        init: (params, navigation) -> state before the first sample.
        step: (params, site, state, sample, n) -> state after the n-th sample, n from 1, before the
            loop is closed.
        attitude: state -> best attitude: the solution's with the estimated misalignment removed.
        normalise: state -> state with its quaternions scaled to unit length.
        covariance: state -> `AttitudeCovariance` of that attitude; None if the method has none.
        floor: (params, place, biases, n, backward) -> `BiasFloor` left by constant sensor biases
            after the n-th sample, the last of a run, in a forward or backward pass; the place is
            that of a forward pass. None if it is not known.
        results: (site, state) -> basis of the method's own result columns at the end of a run, see
            `OwnColumn`; None if the method has none.
        shares_covariance: whether the covariance depends on params and n alone, so that runs that
            differ in their draw can share it.
        feedback: how the loop is closed; None if the method closes it within ``step``.
        passes: how passes over a stored record begin; None if the method reads it once.
        block_fit: fits at record times; None for a method whose steps are all there is.
    """

    init: Callable[[Any, Navigation], Any]
    step: Callable[[Any, Site, Any, Sample, Scalar], Any]
    attitude: Callable[[Any], Quat]
    normalise: Callable[[Any], Any] = normalise_solution
    covariance: Callable[[Any], AttitudeCovariance] | None = None
    floor: Callable[[Any, Place, MeanBiases, Scalar, Flag], BiasFloor] | None = earth_floor
    results: Callable[[Site, Any], Any] | None = None
    shares_covariance: bool = False
    feedback: Feedback | None = None
    passes: Passes | None = None
    block_fit: BlockFit | None = None


# What studies know


StudyKeys: TypeAlias = Any
"""The keys of a study as a method reads them: `sinsjax.study.values.Variants`.

Params are made for the variants of one program and one site, rules see all variants of a study. In
a gradient the values of tuned keys are traced.
"""


class OwnColumn(NamedTuple):
    """A result column that belongs to one method.

    Attributes:
        column: name, type, unit and meaning.
        value: (`Program.results` of runs, samples a second) -> values, (runs,), NaN for none.
        missing: value of runs whose method has no such column; NaN for none.
        applies_to: study -> whether it has the column.
    """

    column: Column
    value: Callable[[Any, float], NDArray]
    missing: float = float("nan")
    applies_to: Callable[[StudyKeys], bool] = lambda study: True


@dataclass(frozen=True)
class Method:
    """An alignment method. What its program has (a covariance, passes, ...) is read from that.

    Attributes:
        name: in ``[alignment] method``.
        summary: half a line on the method.
        source: paper and equation.
        build: `Options` -> `Program`.
        params: (`StudyKeys`, NumPy or `jax.numpy`) -> the method's numbers, SI, leaves
            (variants, ...). With `jax.numpy` values of tuned keys are traced, and the derivative of
            the params is the gradient of a tuning: use the given module for them, and no ``if``.
        sections: its sections of a study file, by name; methods may share one.
        reads: keys of [alignment] and [passes] that act on it, beyond those that act on all.
        without_effect: keys of its sections that change nothing.
        columns: its own result columns.
        rules: check the rules between its keys, see `StudyKeys.refuse`.
        needs_start: whether it starts from an attitude and a velocity; if not, the keys of a start
            change nothing.
        finds_heading: whether it finds a heading. If not, only its pitch and roll are observed, and
            its runs have the status ``no_north``.
        gyro_bias_keys: pairs of keys, the sigma of the gyro bias states and the sigma of heading.
            Such a filter distinguishes gyro biases from heading once the base moves. Empty if the
            method has no such states.
        turning: the turns of a base over which its heading averages constant gyro biases: "any", if
            a single turn is enough, "many", as of a carousel, or "none"; None if that is unknown.
        step_s: time of a sample of one run on one core, s, roughly; see `docs/performance.md`.
        compile_s: time to compile its program on one core, s, roughly.
        is_external: whether it is a program outside sinsjax, whose runs cannot be repeated here.
    """

    name: str
    summary: str
    source: str
    build: Callable[[Options], Program]
    params: Callable[[StudyKeys, Any], Any] = lambda keys, xp: ()
    sections: Mapping[str, type[Section]] = field(default_factory=dict)
    reads: tuple[str, ...] = ()
    without_effect: tuple[str, ...] = ()
    columns: tuple[OwnColumn, ...] = ()
    rules: tuple[Callable[[StudyKeys], None], ...] = ()
    needs_start: bool = True
    finds_heading: bool = True
    gyro_bias_keys: tuple[tuple[str, str], ...] = ()
    turning: Literal["any", "many", "none"] | None = None
    step_s: float = 20e-9
    compile_s: float = 4.5
    is_external: bool = False

    @cached_property
    def keys(self) -> frozenset[str]:
        """Every key of a study that it reads, except those of all methods."""
        own = (key for section in self.sections.values() for key in section.model_fields)
        return frozenset([*own, *INITIAL_KEYS, *self.reads])

    @cached_property
    def idle_keys(self) -> tuple[str, ...]:
        """The keys that change nothing, although it or all methods read them."""
        start = () if self.needs_start else (*INITIAL_KEYS, "position")
        return (*start, *self.without_effect)

    def check_data(self, study: StudyKeys) -> None:
        """Refuse passes over a record that it reads once, and a coarse start without need."""
        refused = {}
        if study.has("passes") and self.program.passes is None:
            refused["stored_s"] = f"method {self.name} reads a record once (drop it)"
        if study.has("coarse") and not (self.needs_start or study.is_recorded):
            refused["coarse_method"] = f"method {self.name} needs no coarse start (give 'none')"
        for key, text in refused.items():
            for point in study.combinations("method", key):
                if point["method"] == self.name and point[key] not in (None, "none"):
                    study.refuse(key, text)

    def own_columns(self, study: StudyKeys) -> tuple[OwnColumn, ...]:
        """Return its own result columns in a study."""
        return tuple(own for own in self.columns if own.applies_to(study))

    @cached_property
    def program(self) -> Program:
        """Its program with plain options, from which its properties are read."""
        return self.build(Options(dt=0.01))

    @property
    def has_covariance(self) -> bool:
        """Whether it has a covariance P."""
        return self.program.covariance is not None

    @property
    def has_floor(self) -> bool:
        """Whether constant sensor biases leave its heading a bias floor that is known."""
        return self.finds_heading and self.program.floor is not None
