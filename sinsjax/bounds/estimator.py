"""The heading error of a linear estimator whose model leaves some of the errors out.

The errors of the information bound, see `bounds.information`, are the states of a Kalman filter
that measures the computed velocity u after each step: the misalignment phi, the states of drifts,
surge and vibration, and the constant errors. An alignment method models some of them, with true
sizes, and has no states for the others. Its gains follow from the covariance of those that it
models. The heading error at a time t is then a known sum of all that happens before,

    phi_U(t) = w_0' x_0 + sum over the steps of v_k' noise_k,

whose weights a recursion backward from t gives: v_k = B_k' w_k and w_(k-1) = F_k' v_k, with F_k of
the step and B_k of its measurement. Each source adds the variance of its own initial states and
noise under these weights, so the variances add up to that of the heading. If the model leaves
nothing out, their sum is the information bound.
"""

from collections.abc import Collection, Sequence

import numpy as np

from sinsjax.bounds.information import (
    HEADING,
    LEVEL,
    NOISE_SOURCES,
    HeadingProblem,
    StepGrid,
    inverse_root,
    iter_steps,
    stack_processes,
)

_CROSS = (1, 2, 3, 5, 6, 7)
CONSTANT_SOURCES = {
    **{"gyro_bias": range(3), "accel_bias": range(3, 6)},
    **{"gyro_scale": range(6, 15, 4), "gyro_misalignment": [6 + k for k in _CROSS]},
    **{"accel_scale": range(15, 24, 4), "accel_misalignment": [15 + k for k in _CROSS]},
    "lever_arm": range(24, 27),
}
"""Places of each source of constant errors among `HeadingProblem.constant_sigmas`."""

_PHI_SIGMAS = (1.0, 1.0, 100.0)
"""Of tilts and heading before the data, rad: in linear theory nothing is known of them."""


def heading_variances(
    times_s: Sequence[float], problem: HeadingProblem, unmodelled: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Return the variance of the heading error of a linear estimator, by source.

    Args:
        times_s: lengths of the data, s, ascending, of whole samples.
        problem: base and sensors; not `still`.
        unmodelled: sources that the model of the estimator leaves out, none of them white noise.

    Returns:
        (times,) rad^2, of `NOISE_SOURCES`, the `increment_errors` and `CONSTANT_SOURCES`.
    """
    grid = StepGrid.of_times(times_s, problem)
    increment_errors = problem.increment_errors(grid.step)
    processes = stack_processes(tuple(increment_errors.values()))
    sigmas = problem.constant_sigmas
    constant = np.flatnonzero(sigmas)
    n = 3 + len(processes.transition)
    in_model = np.array([source not in unmodelled for source in increment_errors], bool)
    left_out = [k for source in unmodelled for k in CONSTANT_SOURCES.get(source, ())]
    states = np.concatenate(
        [np.ones(3, bool), in_model[processes.owner], ~np.isin(constant, left_out)]
    )

    # Forward: the gains of the estimator, and each step as the matrix of all errors.
    prior = np.zeros((len(states),) * 2)
    prior[:3, :3] = np.diag(np.square(_PHI_SIGMAS))
    prior[3:n, 3:n] = processes.begin[in_model].sum(axis=0)
    prior[n:, n:] = np.diag(np.square(sigmas[constant]))
    measured = np.concatenate([[True, True], states])
    # A method with a lever arm as an unknown does not know its velocity before the first step.
    ignored = int(len(problem.lever_arms) > 0 and "lever_arm" not in unmodelled)
    p = prior[np.ix_(states, states)]
    steps = []
    for number, one in enumerate(iter_steps(grid, problem, processes)):
        f = np.eye(len(states) + 2, len(states), -2)
        f[: n + 2, :n] = one.transition
        f[:5, n:] = one.constant[:, constant]
        own = f[np.ix_(measured, states)]
        p = own @ p @ own.T
        noise = one.noise(in_model)
        p += np.pad(noise, (0, len(constant)))[np.ix_(measured, measured)]
        root = inverse_root(p[LEVEL, LEVEL]) * (number >= ignored)
        half = p[2:, LEVEL] @ root.T
        p = p[2:, 2:] - half @ half.T
        gain = np.zeros((len(states), 2))
        gain[states] = half @ root
        steps.append((one, f, gain))

    # Backward: the weights of the heading errors at all times.
    white = np.zeros((len(NOISE_SOURCES), len(times_s)))
    coloured = np.zeros((len(increment_errors), len(times_s)))
    w = np.zeros((len(states), len(times_s)))
    for number, (one, f, gain) in zip(range(len(steps), 0, -1), reversed(steps), strict=True):
        w[HEADING, np.equal(grid.ends, number)] = 1.0
        v = np.concatenate([-gain.T @ w, w])
        white += (v[:5] * (one.white @ v[:5])).sum(axis=1)
        driven = np.tensordot(one.driven, v[: n + 2], (0, 0))
        coloured += np.square(driven).sum(axis=1)
        w = f.T @ v
    coloured += (w[3:n] * (processes.begin @ w[3:n])).sum(axis=1)
    errors = np.zeros((27, len(times_s)))
    errors[constant] = np.square(sigmas[constant, None] * w[n:])
    names = (*NOISE_SOURCES, *increment_errors)
    variances = dict(zip(names, (*white, *coloured), strict=True))
    return variances | {
        source: errors[list(places)].sum(axis=0) for source, places in CONSTANT_SOURCES.items()
    }
