"""Checks and errors of plug-in methods, which `registry.add_plugins` loads from other packages."""

from importlib.metadata import EntryPoint
from traceback import walk_tb
from typing import Any

import jax
import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.methods.method import AttitudeCovariance, Program
from sinsjax.platform import runtime
from sinsjax.types import Navigation, Quat, Sample, Vec3


def check_plugin(
    name: str, program: Program, params: Any, variants: int, site: Any, *, passes: str = "once"
) -> None:
    """Check what a plug-in's functions return, without running them (`jax.eval_shape`).

    Its params, leaves (variants, ...), need one value per variant; the state after a sample must be
    like that of ``init``, attitude and covariance like those of one run at a `Site`; and a record
    can be read repeatedly ("alternate" or "rewind") only with ``passes``.

    Raises:
        InputError: the first of these that fails; begins with the name, that of the method.
    """
    if any(np.shape(leaf)[:1] != (variants,) for leaf in jax.tree.leaves(params)):
        raise InputError(f"{name}: params must return one value per variant")
    if passes != "once" and program.passes is None:
        raise InputError(f"{name}: reads a stored record once (drop [passes])")
    if passes == "rewind" and program.passes and program.passes.rewind is None:
        raise InputError(f"{name}: cannot rewind a record (use direction = 'alternate')")

    def first_sample(params: Any, nav: Navigation, sample: Sample) -> Any:
        state = program.init(params, nav)
        after = program.normalise(program.step(params, site, state, sample, nav.ve))
        if program.feedback is not None:
            after = program.feedback.close(params, after, nav.ve)
        covariance = unknown if program.covariance is None else program.covariance(state)
        return (after, state), (program.attitude(state), nav.q), (covariance, unknown)

    def describe(tree: Any) -> str:
        leaves = jax.tree.map(lambda leaf: f"{leaf.dtype}{[*leaf.shape]}", tree)
        return str(leaves).replace("'", "")

    zero = np.float64(0.0)
    q, unknown = Quat(*(zero,) * 4), AttitudeCovariance(*(zero,) * 6)
    nav, sample = Navigation(q, *(zero,) * 4), Sample(q, Vec3(*(zero,) * 3))
    of_run = jax.tree.map(lambda leaf: np.asarray(leaf)[0], params)
    pairs = jax.eval_shape(first_sample, of_run, nav, sample)
    names = "step, normalise or close", "attitude", "covariance"
    for what, pair in zip(names, pairs, strict=True):
        returned, wanted = map(describe, pair)
        if returned != wanted:
            texts = f"{shorten(returned, 300)}, expected {shorten(wanted, 300)}"
            raise InputError(f"{name}: {what} returns {texts}")


def describe_plugin_error(error: BaseException) -> str | None:
    """Return method, package, kind, file and line of an error of a plug-in's code; else None."""
    for point in runtime.method_entry_points():
        if _last_place(error, point):
            return f"method {point.name!r}{package_label(point)}: {describe_error(error, point)}"
    return None


def package_label(point: EntryPoint) -> str:
    """Return the package of a plug-in and its version, for a message."""
    return f" of {point.dist.name} {point.dist.version}" if point.dist else ""


def describe_error(error: BaseException, point: EntryPoint) -> str:
    """Return an error in one line, with the place in a plug-in's code."""
    return f"{type(error).__name__}: {first_error_line(error)}{_last_place(error, point)}"


def _last_place(error: BaseException, point: EntryPoint) -> str:
    """Return the last place of a traceback in a plug-in's code, as ``, in file:line``."""
    package = point.module.partition(".")[0]
    inside = [
        f", in {frame.f_code.co_filename}:{line}"
        for frame, line in walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").partition(".")[0] == package
    ]
    return inside[-1] if inside else ""
