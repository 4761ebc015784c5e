"""How the numbers follow the keys of a study: what a search by gradient needs."""

import jax.numpy as jnp

from averaged_alignment.method import Numbers
from sinsjax.methods.base import Relaxed
from sinsjax.types import Scalar


def _time(params: Numbers, entry: int | None, value: Scalar, base: Scalar) -> Numbers:
    # kept = exp(-1 / samples), and twice the time is twice the samples.
    return params._replace(kept=jnp.exp(jnp.log(params.kept) * base / value))


RELAXED = Relaxed({"averaging_time_s": _time})
