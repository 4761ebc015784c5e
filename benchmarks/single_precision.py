"""What single precision gains and costs: the covariance and the error states in float32.

Navigation stays in double precision, or the Earth's turn would be lost in the quaternion. The
method is made here for the comparison and is not offered: the rows say why.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.bench.cases import default_group, engine_workload, remove_noise, shorten_runs
from sinsjax.bench.timing import Row, measure_relative_to_base
from sinsjax.engine.batch import run_chunks
from sinsjax.engine.lanes import Group
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.success import FLOOR
from sinsjax.maths.algebra import entries_as_numbers
from sinsjax.methods import kalman
from sinsjax.methods.base import Method, Options, Site
from sinsjax.methods.registry import METHODS
from sinsjax.methods.zero_velocity import method as zero_velocity
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.error_model import MODELS, LinearModel
from sinsjax.types import Navigation, Sample, Scalar
from sinsjax.units import ARCMIN

NAME = "kalman5_single"


def single(tree: Any) -> Any:
    """Every number of a tree in single precision."""
    return jax.tree.map(lambda a: jnp.asarray(a).astype(jnp.float32), tree)


def double(tree: Any) -> Any:
    """Every number of a tree in double precision."""
    return jax.tree.map(lambda a: jnp.asarray(a).astype(jnp.float64), tree)


def build(model: LinearModel, options: Options) -> Method:
    """`zero_velocity` with its belief in single precision; the 5-state model, f measured."""
    whole = zero_velocity.build(model, options)
    feedback, passes = whole.feedback, whole.passes
    assert feedback is not None and passes is not None

    def init(params: zero_velocity.FilterParams, nav: Navigation) -> zero_velocity.FilterState:
        state = whole.init(params, nav)
        return state._replace(belief=single(state.belief))

    def step(
        params: zero_velocity.FilterParams,
        site: Site,
        state: zero_velocity.FilterState,
        sample: Sample,
        n: Scalar,
    ) -> zero_velocity.FilterState:
        nav, f_dt = mechanisation.advance_navigation(state.nav, sample, site.place, options.dt)
        entries = entries_as_numbers(model.transition(state.nav, site.place, f_dt, options.dt))
        transition = single(entries)
        belief = kalman.predict(state.belief, transition, single(params.q))
        belief = kalman.update(belief, (0, 1), single((nav.ve, nav.vn)), single(params.r))
        return state._replace(nav=nav, belief=belief)

    def close(
        params: zero_velocity.FilterParams, state: zero_velocity.FilterState, n: Scalar
    ) -> zero_velocity.FilterState:
        closed = feedback.close(params, state._replace(belief=double(state.belief)), n)
        return closed._replace(belief=single(closed.belief))

    def reverse(
        params: zero_velocity.FilterParams, site: Site, state: zero_velocity.FilterState
    ) -> zero_velocity.FilterState:
        turned = passes.reverse(params, site, state._replace(belief=double(state.belief)))
        return turned._replace(belief=single(turned.belief))

    def widened(f: Callable) -> Callable:
        return lambda state: f(state._replace(belief=double(state.belief)))

    return whole._replace(
        init=init,
        step=step,
        attitude=widened(whole.attitude),
        covariance=widened(whole.covariance),
        feedback=feedback._replace(close=close),
        passes=passes._replace(reverse=reverse),
        results=None,
    )


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the default sweep's step, and compare all its runs with those in double precision.

    Returns:
        ``double_precision`` and ``single_precision``; the latter with ``ratio`` and the most that
        phi_u differs (``phi_u_arcmin_max``, ``_median``), the most that a sigma differs
        (``sigma_share_max``), and for each band the share of runs that settle at another record
        (``settle_changed_share``) and by how much at most (``settle_changed_s``).
    """
    kalman5 = METHODS["kalman5"]
    implementation = kalman5.implementation._replace(build=partial(build, MODELS["kalman5"]))
    METHODS[NAME] = replace(kalman5, name=NAME, load=lambda: implementation)
    try:
        return compared(quick, repeats)
    finally:
        del METHODS[NAME]


def compared(quick: bool, repeats: int) -> list[Row]:
    """`rows`, while the method of this file has a name."""
    group = shorten_runs(default_group(), 2) if quick else default_group()
    silent = remove_noise(shorten_runs(group, min(group.static.records, 300)))
    made = measure_relative_to_base(
        engine_workload("double_precision", silent),
        [engine_workload("single_precision", in_single(silent))],
        repeats,
    )
    made[1] |= differences(outcome(group), outcome(in_single(group))) | {"dtype": "float32"}
    return made


def in_single(group: Group) -> Group:
    """The group with the method of this file."""
    return group._replace(static=group.static._replace(method=NAME))


def outcome(group: Group) -> Outcome:
    """Outcomes of all runs."""
    parts = [chunk.outcome for chunk in run_chunks(group)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def differences(exact: Outcome, ours: Outcome) -> Row:
    """By how much outcomes differ."""
    phi = np.abs(exact.last.phi.z - ours.last.phi.z) / ARCMIN
    sigma = [np.abs(b / a - 1) for a, b in zip(exact.last.sigma, ours.last.sigma, strict=True)]
    settled = np.abs(exact.outside_until - ours.outside_until)[:, FLOOR]
    return {
        "phi_u_arcmin_max": float(f"{phi.max():.3g}"),
        "phi_u_arcmin_median": float(f"{np.median(phi):.3g}"),
        "sigma_share_max": float(f"{np.max(sigma):.3g}"),
        "settle_changed_share": [round(share, 4) for share in np.mean(settled > 0, axis=0)],
        "settle_changed_s": settled.max(axis=0).tolist(),
    }


if __name__ == "__main__":
    common.main(rows)
