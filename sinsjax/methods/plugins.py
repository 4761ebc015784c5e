"""The check of a plug-in method, which `registry.add_plugins` loads from another package."""

from typing import Any

import jax
import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.methods.method import AttitudeCovariance, Program
from sinsjax.types import Navigation, Quat, Sample, Vec3


def check_plugin(name: str, program: Program, params: Any, variants: int, site: Any) -> None:
    """Check what a plug-in's functions return, without running them (`jax.eval_shape`).

    Its params, leaves (variants, ...), need one value per variant; the state after a sample must be
    like that of ``init``, attitude and covariance like those of one run at a `Site`.

    Raises:
        InputError: the first of these that fails; begins with the name, that of the method.
    """
    if any(np.shape(leaf)[:1] != (variants,) for leaf in jax.tree.leaves(params)):
        raise InputError(f"{name}: params must return one value per variant")

    def first_sample(params: Any, nav: Navigation, sample: Sample) -> dict[str, Any]:
        state = program.init(params, nav)
        after = program.normalise(program.step(params, site, state, sample, nav.ve))
        if program.feedback is not None:
            after = program.feedback.close(params, after, nav.ve)
        covariance = unknown if program.covariance is None else program.covariance(state)
        return {
            "step, normalise or close": (after, state),
            "attitude": (program.attitude(state), nav.q),
            "covariance": (covariance, unknown),
        }

    zero = np.float64(0.0)
    q, unknown = Quat(*(zero,) * 4), AttitudeCovariance(*(zero,) * 6)
    nav, sample = Navigation(q, *(zero,) * 4), Sample(q, Vec3(*(zero,) * 3))
    of_run = jax.tree.map(lambda leaf: np.asarray(leaf)[0], params)
    shapes = jax.eval_shape(first_sample, of_run, nav, sample)
    for what, (returned, wanted) in shapes.items():
        if returned != wanted:
            texts = f"{shorten(str(returned), 300)}, expected {shorten(str(wanted), 300)}"
            raise InputError(f"{name}: {what} returns {texts}")
