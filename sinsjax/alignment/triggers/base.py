"""When a filter resets itself: small pure objects that watch it and are carried along with it.

A trigger has a memory, which begins anew with every reset, and gives a score after each update; P
is reset where the score exceeds the threshold. Two rivals do not reset: they fade, multiplying the
propagated P before the process noise is added. Which there are stands in `scores`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.alignment.base import Fired
from sinsjax.alignment.kalman import Belief
from sinsjax.maths.algebra import Entries, Triangle
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Flag, Scalar, Vec3

Pair = tuple[Scalar, Scalar]
"""Of east and north."""


class Numbers(NamedTuple):
    """Numbers of a trigger; times in samples.

    Attributes:
        threshold: that the score has to exceed; of what fades, see there.
        window: over which a trigger that looks back sums up.
        refractory: that a reset has to be after the start, and after the reset before it.
        most: resets that it may call for.
        until: last sample after which it may.
    """

    threshold: Scalar
    window: Scalar
    refractory: Scalar
    most: Scalar
    until: Scalar


class Noise(NamedTuple):
    """What the filter believes: variances added to the states, variance of a measurement."""

    q: tuple[Scalar, ...]
    r: Scalar


class Seen(NamedTuple):
    """What a trigger sees after the update of a sample.

    Attributes:
        innovation: measured minus predicted velocity, m/s.
        variance: upper triangle of its believed covariance S (ee, en, nn), (m/s)^2.
        belief: after the update.
        correction: of the attitude since the last reset or turn of the tape: what was fed back and
            what is not yet, rad.
        at_rest: transition of a base at rest, its specific force (0, 0, g).
        place: Earth rates there.
        dt: s.
    """

    innovation: Pair
    variance: tuple[Scalar, Scalar, Scalar]
    belief: Belief
    correction: Vec3
    at_rest: Entries
    place: Place
    dt: float


class Watch(NamedTuple):
    """A trigger at work.

    Attributes:
        memory: of the trigger.
        fed: attitude corrections fed back since the last reset or turn, less what was estimated
            before that turn, rad.
        fired: what it did so far.
        since: sample of the last reset of any kind.
    """

    memory: Any
    fed: Vec3
    fired: Fired
    since: Scalar


class Trigger(NamedTuple):
    """A trigger.

    Attributes:
        start: (numbers, P) -> memory at the start and after a reset, which leaves P.
        look: (numbers, noise, memory, seen) -> memory and score.
        fade: (numbers, noise, memory, propagated P, innovation) -> memory and factor on P.
    """

    start: Callable[[Numbers, Triangle], Any]
    look: Callable[[Numbers, Noise, Any, Seen], tuple[Any, Scalar]] | None = None
    fade: Callable[[Numbers, Noise, Any, Triangle, Pair], tuple[Any, Scalar]] | None = None


def start(trigger: Trigger, numbers: Numbers, p: Triangle) -> Watch:
    """A trigger before the first sample, and the covariance P of the start."""
    zero = jnp.zeros_like(numbers.threshold)
    fired = Fired(zero, zero, zero)
    return Watch(trigger.start(numbers, p), Vec3(zero, zero, zero), fired, zero)


def fade(
    trigger: Trigger, numbers: Numbers, noise: Noise, watch: Watch, belief: Belief, measured: Pair
) -> tuple[Watch, Belief]:
    """Multiply P by the trigger's factor, if it has one.

    Args:
        trigger: which.
        numbers: its numbers.
        noise: that the filter believes in.
        watch: so far.
        belief: propagated, its process noise not yet added.
        measured: velocity, m/s.
    """
    if trigger.fade is None:
        return watch, belief
    r = (measured[0] - belief.x[VE], measured[1] - belief.x[VN])
    memory, factor = trigger.fade(numbers, noise, watch.memory, belief.p, r)
    return watch._replace(memory=memory), Belief(belief.x, tuple(factor * v for v in belief.p))


def look(
    trigger: Trigger, numbers: Numbers, noise: Noise, watch: Watch, seen: Seen, n: Scalar
) -> Watch:
    """Take one sample in, and note whether P is to be reset after it, see `fires`.

    Args:
        trigger: which.
        numbers: its numbers.
        noise: that the filter believes in.
        watch: so far.
        seen: what there is to see.
        n: number of the sample.
    """
    if trigger.look is None:
        return watch
    memory, score = trigger.look(numbers, noise, watch.memory, seen)
    fired = watch.fired
    calls = (
        (score > numbers.threshold)
        & (n - watch.since >= numbers.refractory)
        & (fired.count < numbers.most)
        & (n <= numbers.until)
    )
    fired = Fired(
        count=jnp.where(calls, fired.count + 1, fired.count),
        first=jnp.where(calls & (fired.count == 0), n, fired.first),
        last=jnp.where(calls, n, fired.last),
    )
    return watch._replace(memory=memory, fired=fired)


def fires(watch: Watch, n: Scalar) -> Flag:
    """Whether the trigger called for a reset after the n-th sample."""
    return watch.fired.last == n


def after(
    trigger: Trigger,
    numbers: Numbers,
    watch: Watch,
    *,
    reset: Flag,
    p: Triangle,
    fed: Vec3,
    n: Scalar,
) -> Watch:
    """The watch after a sample's feedback, and after its reset if there was one.

    Args:
        trigger: which.
        numbers: its numbers.
        watch: so far.
        reset: whether P was reset.
        p: the covariance that is left.
        fed: attitude correction that was fed back, rad.
        n: number of the sample.
    """
    anew = trigger.start(numbers, p)
    total = Vec3(*(jnp.where(reset, 0.0, a + b) for a, b in zip(watch.fed, fed, strict=True)))
    return watch._replace(
        memory=jax.tree.map(lambda a, b: jnp.where(reset, a, b), anew, watch.memory),
        fed=total,
        since=jnp.where(reset, n, watch.since),
    )


def turned(
    trigger: Trigger, numbers: Numbers, watch: Watch, *, p: Triangle, misalignment: Vec3
) -> Watch:
    """The watch after a turn of the tape: its memory begins anew, what it did stays.

    Args:
        trigger: which.
        numbers: its numbers.
        watch: so far.
        p: the covariance that is left.
        misalignment: estimated and not yet fed back, rad: no correction of the pass that begins.
    """
    fed = Vec3(*(-angle for angle in misalignment))
    return watch._replace(memory=trigger.start(numbers, p), fed=fed)
