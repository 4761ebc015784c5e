"""The relaxed objective of some points and its gradient, differentiated in forward mode.

Runs with noise are differentiated on a few draws, or, where covariance analysis holds and no reset
is moved, one noise-free run of each variant with errors sampled from the covariance of the true
error. Resets that are moved are smooth windows, and the edge of the band is soft.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sinsjax.engine import batch, covariance
from sinsjax.engine.batch import Plan
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import LANES, Group, Tiles, tiles_of
from sinsjax.engine.realisations import Environment
from sinsjax.engine.tile import over_stacked_tiles, run_tile
from sinsjax.records.reference import StoredRecord
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.tuning import estimates, objective, search
from sinsjax.tuning.relaxation import Relaxation
from sinsjax.types import Array, Count

TANGENT_STEPS = 2
"""Cost of one tangent of a step, in steps of a plain run; timed by the benchmark ``derivative``."""


class Softness(NamedTuple):
    """Degree of relaxation of a step.

    Attributes:
        window_s: half width of the reset windows, s.
        sharpness: sharpness of the band's edge, see `metrics.Criteria`.
    """

    window_s: float
    sharpness: float


class Lane(NamedTuple):
    """Parameters of a lane.

    Attributes:
        base: `Params` of the method at the base point.
        start: number of the descent that the lane belongs to.
    """

    base: Any
    start: Count


def sensitivities(
    function: Callable[[Array], Any], point: Array, directions: Array
) -> tuple[Any, Any]:
    """Value and derivatives of a function along some directions, in one forward pass.

    Args:
        function: function of an array of the shape of ``point``.
        point: where to differentiate.
        directions: (p, *shape of the point).

    Returns:
        The value, and its derivatives with a leading axis of p.
    """

    def along(direction: Array) -> tuple[Any, Any]:
        return jax.jvp(function, (point,), (direction,))

    # The value does not depend on the direction, so it is computed once for all of them.
    return jax.vmap(along, out_axes=(None, 0))(directions)


class Slope:
    """The relaxed objective of some descents and its gradient, for one combination of candidates.

    Attributes:
        used: (p,) indices in the search space of the variables that the combination uses.
        samples: sampled errors that stand for the draws; 0 where runs have noise.
        draws: number of draws per step; 1, without noise, where errors are sampled.
        n_draws: number of tuning draws, likewise.
        run_steps: steps of one draw and descent, all variants together.
    """

    def __init__(
        self,
        study: Study,
        stored: StoredRecord | None,
        number: int,
        *,
        starts: int,
        draws: int,
        samples: int = 0,
    ) -> None:
        """Prepare the runs.

        Args:
            study: study with [tune].
            stored: the record of a recorded study.
            number: number of the combination of candidates.
            starts: number of descents.
            draws: number of draws per step, at most.
            samples: how many errors are sampled for each variant instead; an even number, 0 for
                runs with noise. Only where `Relaxation.by_covariance` holds.

        Raises:
            InputError: a variable has no gradient, or the record does not fit.
        """
        assert study.tune is not None
        space = SearchSpace.from_study(study)
        combination = space.combinations[number]
        self.used = space.used_variables(combination)
        self._relaxation = Relaxation(study, space, combination)
        derived = search.derive(study, {"base": self._relaxation.point}, name=study.name)
        self._tune, self._starts, self.samples = study.tune, starts, samples
        self._truth = success_criteria(study).from_truth
        scenario = Scenario(derived, stored, curves=False)
        groups = [self._group(scenario, number) for number in range(len(scenario.programs))]
        self.n_draws = len(groups[0].draws.draw_id)
        self.draws = min(draws, self.n_draws)
        self.run_steps = search.cost(derived) // derived.n_draws
        self._run_cost = 1.0
        if samples:
            self._run_cost = estimates.runs(derived)
        self._rate_hz = study.rate_hz
        self._parts = [self._laid_out(group) for group in groups]

    @property
    def cost(self) -> int:
        """Cost of one gradient of all descents, in steps of a plain run, tangents included."""
        factor = self._run_cost * (1 + TANGENT_STEPS * len(self.used))
        return round(self._starts * self.draws * self.run_steps * factor)

    def __call__(self, box: NDArray, draws: NDArray, softness: Softness) -> tuple[NDArray, NDArray]:
        """The objective of each descent, and its gradient.

        Args:
            box: (starts, p) positions of the variables in their ranges, 0 to 1.
            draws: (draws,) indices of the draws to use.
            softness: degree of relaxation.

        Returns:
            The objective (starts,) in its unit, and its gradient (starts, p).
        """
        found = [self._runs(part, box, draws, softness) for part in self._parts]
        runs, slopes = (np.concatenate(some, axis=1) for some in zip(*found, strict=True))
        score, by_run = map(np.asarray, objective.relaxed_score(self._tune, runs))
        return score, np.einsum("svd,svdp->sp", by_run, slopes)

    def programs(
        self, box: NDArray, draws: NDArray, softness: Softness
    ) -> list[jax.stages.Compiled]:
        """The compiled programs of a call with these arguments, one per group of runs."""
        first = [(part, self._arguments(part, box, draws, softness)[0]) for part in self._parts]
        return [part.program.lower(*arguments).compile() for part, arguments in first]

    def _group(self, scenario: Scenario, number: int) -> Group:
        """The runs of one program, of all draws or of one without noise."""
        if not self.samples:
            return scenario.part(number).group
        group = scenario.part(number, range(1)).group
        return covariance.watched(group, self.samples, np.array([group.static.records - 1]))

    def _laid_out(self, group: Group) -> "_PartRuns":
        """A group with lanes for each descent and variant."""
        params = jax.tree.map(
            lambda a: np.concatenate([np.asarray(a)] * self._starts), group.variants
        )
        start = np.repeat(np.arange(self._starts), group.sizes[1])
        group = group._replace(variants=params._replace(method=Lane(params.method, start)))
        runs, devices = self.draws * len(start), len(jax.devices())
        # Few runs need fewer lanes. With noise a call has at least two blocks for each device.
        blocks = devices if self.samples else 2 * devices
        lanes = min(LANES, 1 << (max(runs // blocks, 8) - 1).bit_length())
        tiles = -(-runs // (lanes * devices))
        plan = Plan(group.static, self.draws, len(start), tiles_a_chunk=tiles, lanes=lanes)
        return _PartRuns(group, plan, jax.jit(partial(self._tiles, group)))

    def _runs(
        self, part: "_PartRuns", box: NDArray, draws: NDArray, softness: Softness
    ) -> tuple[NDArray, NDArray]:
        """Relaxed values (starts, variants, draws or samples), and their derivatives (..., p)."""
        group, plan, program = part
        arguments = self._arguments(part, box, draws, softness)
        program.lower(*arguments[0]).compile()  # otherwise every thread would compile
        calls = list(
            batch.in_threads(
                lambda one: jax.device_get(program(*one)), arguments, len(jax.devices())
            )
        )
        _, variants = group.sizes
        p, each = len(self.used), calls[0][0].shape[-1]
        out = np.empty((len(draws) * variants, each, 1 + p))
        for places, (value, slope) in zip(plan, calls, strict=True):
            draw, variant = places.draw.ravel(), places.variant.ravel()
            busy = np.flatnonzero((draw < len(draws)) & (variant < variants))
            rows = draw[busy] * variants + variant[busy]
            out[rows, :, 0] = value.reshape(-1, each)[busy]
            out[rows, :, 1:] = np.moveaxis(slope, -3, -1).reshape(-1, each, p)[busy]
        shape = (len(draws), self._starts, variants // self._starts, each, 1 + p)
        out = np.moveaxis(out.reshape(shape), 0, 2)
        out = out.reshape(*out.shape[:2], len(draws) * each, 1 + p)
        return out[..., 0], out[..., 1:]

    def _arguments(
        self, part: "_PartRuns", box: NDArray, draws: NDArray, softness: Softness
    ) -> list[tuple]:
        """The arguments of every call of a program."""
        group = part.group
        some = jax.tree.map(lambda a: a[draws] if np.ndim(a) else a, group.draws)
        group = group._replace(draws=some, q=group.q[draws])
        # What is only reported has no part in the objective, nor in its derivatives.
        soft = group.environment.criteria._replace(
            sharpness=np.float64(softness.sharpness), report_samples=None
        )
        environment = group.environment._replace(criteria=soft)
        width = np.float64(softness.window_s * self._rate_hz)
        return [(environment, tiles_of(group, lanes), box, width) for lanes in part.plan]

    def _tiles(
        self, group: Group, environment: Environment, tiles: Tiles, box: Array, width: Array
    ) -> tuple[Array, Array]:
        """Values of the runs of some tiles, and their derivatives by their descent's position."""
        p = len(self.used)
        directions = jnp.broadcast_to(jnp.eye(p)[:, None, :], (p, self._starts, p))

        def one_lane(lane: Lane, box: Array) -> Any:
            relax = partial(self._relaxation, group.static.method)
            if not self.samples:
                return relax(lane.base, box[lane.start], width)
            return lane.base._replace(inner=relax(lane.base.inner, box[lane.start], width))

        def one_tile(tile: Tiles) -> tuple[Array, Array]:
            def of(box: Array) -> Array:
                method = jax.vmap(one_lane, in_axes=(0, None))(tile.params.method, box)
                lanes = tile._replace(params=tile.params._replace(method=method))
                outcome, told = run_tile(group.static, environment, lanes)
                given, truth = (self._tune, environment.criteria, outcome), self._truth
                if isinstance(told, covariance.Spread):
                    return objective.relaxed_estimates(*given, told, truth=truth)
                return objective.relaxed_values(*given, truth=truth)

            return sensitivities(of, box, directions)

        return jax.lax.map(over_stacked_tiles(group.static, one_tile, tiles), tiles)


class _PartRuns(NamedTuple):
    """A group of runs with lanes for each descent, its plan of calls, and its program."""

    group: Group
    plan: Plan
    program: Any
