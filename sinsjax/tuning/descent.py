"""Gradient search: several descents in parallel lanes, differentiated in forward mode.

Descents start at the best of some points evaluated on a few draws, and each step uses the next few
draws. Resets are smooth windows and the edge of the band is soft; both sharpen from step to step.
The final points are scored like any other point, with hard resets on all tuning draws.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import NDArray

from sinsjax.engine import batch
from sinsjax.engine.batch import Plan
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import LANES, Group, Tiles, tiles_of
from sinsjax.engine.realisations import Environment
from sinsjax.engine.tile import over_stacked_tiles, run_tile
from sinsjax.execution import run
from sinsjax.execution.run import RunProgress, Tell
from sinsjax.records.reference import StoredRecord
from sinsjax.study.ranges import TuneSection
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.study.success import success_of
from sinsjax.tuning import objective, search
from sinsjax.tuning.history import Evaluation, Found
from sinsjax.tuning.relaxation import Relaxation
from sinsjax.types import Array, Count

NAME = "gradient"

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
        draws: number of draws per step.
        n_draws: number of tuning draws.
        run_steps: steps of one draw and descent, all variants together.
    """

    def __init__(
        self, study: Study, stored: StoredRecord | None, number: int, *, starts: int, draws: int
    ) -> None:
        """Prepare the runs.

        Args:
            study: study with [tune].
            stored: the record of a recorded study.
            number: number of the combination of candidates.
            starts: number of descents.
            draws: number of draws per step, at most.

        Raises:
            InputError: a variable has no gradient, or the record does not fit.
        """
        assert study.tune is not None
        space = SearchSpace.of(study)
        combination = space.combinations[number]
        self.used = space.used(combination)
        self._relaxation = Relaxation(study, space, combination)
        derived = search.derive(study, {"base": self._relaxation.point}, name=study.name)
        self._tune, self._starts = study.tune, starts
        self._truth = success_of(study).from_truth
        scenario = Scenario(derived, stored, curves=False)
        groups = [scenario.part(i).group for i in range(len(scenario.programs))]
        self.n_draws = len(groups[0].draws.draw_id)
        self.draws = min(draws, self.n_draws)
        self.run_steps = search.cost(derived) // self.n_draws
        self._rate_hz = study.rate_hz
        self._parts = [self._laid_out(group) for group in groups]

    @property
    def cost(self) -> int:
        """Cost of one gradient of all descents, in steps of a plain run, tangents included."""
        factor = 1 + TANGENT_STEPS * len(self.used)
        return self._starts * self.draws * self.run_steps * factor

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

    def _laid_out(self, group: Group) -> "_PartRuns":
        """A group with lanes for each descent and variant."""
        params = jax.tree.map(
            lambda a: np.concatenate([np.asarray(a)] * self._starts), group.variants
        )
        start = np.repeat(np.arange(self._starts), group.sizes[1])
        group = group._replace(variants=params._replace(method=Lane(params.method, start)))
        runs, devices = self.draws * len(start), len(jax.devices())
        # Few runs need fewer lanes, and a call has at least two blocks.
        lanes = min(LANES, 1 << (max(runs // (2 * devices), 8) - 1).bit_length())
        tiles = -(-runs // (lanes * devices))
        plan = Plan(group.static, self.draws, len(start), tiles_a_chunk=tiles, lanes=lanes)
        return _PartRuns(group, plan, jax.jit(partial(self._tiles, group)))

    def _runs(
        self, part: "_PartRuns", box: NDArray, draws: NDArray, softness: Softness
    ) -> tuple[NDArray, NDArray]:
        """Relaxed values of runs (starts, variants, draws), and their derivatives (..., p)."""
        group, plan, program = part
        arguments = self._arguments(part, box, draws, softness)
        program.lower(*arguments[0]).compile()  # otherwise every thread would compile
        calls = batch.in_threads(
            lambda one: jax.device_get(program(*one)), arguments, len(jax.devices())
        )
        _, variants = group.sizes
        out = np.empty((len(draws) * variants, 1 + len(self.used)))
        for places, (value, slope) in zip(plan, calls, strict=True):
            draw, variant = places.draw.ravel(), places.variant.ravel()
            busy = np.flatnonzero((draw < len(draws)) & (variant < variants))
            rows = draw[busy] * variants + variant[busy]
            out[rows, 0] = value.ravel()[busy]
            out[rows, 1:] = np.moveaxis(slope, -2, -1).reshape(-1, len(self.used))[busy]
        shape = (len(draws), self._starts, variants // self._starts, -1)
        out = np.moveaxis(out.reshape(shape), 0, 2)
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
            return self._relaxation(group.static.method, lane.base, box[lane.start], width)

        def one_tile(tile: Tiles) -> tuple[Array, Array]:
            def of(box: Array) -> Array:
                method = jax.vmap(one_lane, in_axes=(0, None))(tile.params.method, box)
                lanes = tile._replace(params=tile.params._replace(method=method))
                outcome, _ = run_tile(group.static, environment, lanes)
                return objective.relaxed_values(
                    self._tune, environment.criteria, outcome, truth=self._truth
                )

            return sensitivities(of, box, directions)

        return jax.lax.map(over_stacked_tiles(group.static, one_tile, tiles), tiles)


class _PartRuns(NamedTuple):
    """A group of runs with lanes for each descent, its plan of calls, and its program."""

    group: Group
    plan: Plan
    program: Any


def descend(study: Study, stored: StoredRecord | None = None, *, tell: Tell | None = None) -> Found:
    """Tune a study by gradient, for every combination of its candidates.

    Args:
        study: study with [tune].
        stored: the record of a recorded study.
        tell: called with the progress, in runs, after every step.

    Returns:
        Every step of every descent with its relaxed objective, and the final points with their
        unrelaxed objective on all tuning draws.

    Raises:
        InputError: a variable has no gradient, or the record does not fit.
    """
    looks: list[Evaluation] = []
    for number in range(len(SearchSpace.of(study).combinations)):
        looks += _Descents(study, stored, number, looks[-1].cost if looks else 0).looks(tell)
    return Found(NAME, looks)


class _Descents:
    """The descents of one combination of candidates."""

    def __init__(self, study: Study, stored: StoredRecord | None, number: int, cost: int) -> None:
        assert study.tune is not None
        self._study, self._stored, self._number, self._cost = study, stored, number, cost
        self._tune, self._space = study.tune, SearchSpace.of(study)

    def looks(self, tell: Tell | None) -> list[Evaluation]:
        """Run the descents; gives all evaluations in order."""
        tune, steps = self._tune, self._tune.descent_steps
        if not self._space.used(self._space.combinations[self._number]):
            return self._scored(np.empty((1, 0)), [])
        slope = Slope(
            self._study,
            self._stored,
            self._number,
            starts=tune.descent_starts,
            draws=tune.descent_draws,
        )
        box = self._begin(slope)
        adam = optax.adam(optax.cosine_decay_schedule(tune.descent_rate, steps, alpha=0.1))
        state = adam.init(box)
        looks: list[Evaluation] = []
        for step in range(steps):
            draws = (step * slope.draws + np.arange(slope.draws)) % slope.n_draws
            softness = _softness(tune, step)
            score, gradient = slope(box, draws, softness)
            self._cost += slope.cost
            looks += [
                Evaluation(step, self._number, values, float(one), self._cost, start, *softness)
                for start, (values, one) in enumerate(
                    zip(self._values(box, slope.used), score, strict=True)
                )
            ]
            if tell is not None:
                done, total = ((n * tune.descent_starts * slope.draws) for n in (step + 1, steps))
                tell(RunProgress(done, total, 0, 0))
            moves, state = adam.update(np.nan_to_num(gradient, posinf=0.0, neginf=0.0), state)
            box = np.asarray(optax.projections.projection_box(box + moves, 0.0, 1.0))
        return [*looks, *self._scored(box, slope.used)]

    def _begin(self, slope: Slope) -> NDArray:
        """(starts, p) initial positions of the descents: the best of some, on a few draws."""
        count = max(self._tune.descent_screen, self._tune.descent_starts)
        counts = [count] * len(self._space.combinations)
        design = search.sobol(self._space, counts, search.seed_of(self._study, NAME))
        box = design.box[design.candidate == self._number][:, slope.used]
        if count == self._tune.descent_starts:
            return box
        scores = self._hard(self._values(box, slope.used), slope.draws)
        return box[np.argsort(scores, kind="stable")[: self._tune.descent_starts]]

    def _scored(self, box: NDArray, used: Sequence[int]) -> list[Evaluation]:
        """Evaluate the final points of the descents on all tuning draws."""
        values = self._values(box, used)
        scores = self._hard(values, None)
        step = self._tune.descent_steps
        return [
            Evaluation(step, self._number, own, float(score), self._cost, start)
            for start, (own, score) in enumerate(zip(values, scores, strict=True))
        ]

    def _values(self, box: NDArray, used: Sequence[int]) -> list[list[float]]:
        """Values of all variables at positions of the used ones; NaN for the others."""
        whole = np.full((len(box), len(self._space.variables)), np.nan)
        whole[:, used] = box
        return [self._space.values(row) for row in whole]

    def _hard(self, values: Sequence[Sequence[float]], draws: int | None) -> NDArray:
        """The objective at some points with hard resets, on the first tuning draws or all."""
        study = self._study
        if draws is not None and not study.is_recorded:
            study = study.model_copy(
                update={"tune": self._tune.model_copy(update={"tune_draws": draws})}
            )
        combination = self._space.combinations[self._number]
        points = [self._space.point(list(np.nan_to_num(own)), combination) for own in values]
        scores, taken, each = search.scored(
            study, NAME, points, lambda one: run.run(one, self._stored, curves=False).summary
        )
        self._cost += len(set(taken)) * each
        return np.array(scores)


def _softness(tune: TuneSection, step: int) -> Softness:
    """Degree of relaxation of a step, geometrically from the first to the last."""
    way = step / max(tune.descent_steps - 1, 1)
    ends = (tune.relaxed_window_s, tune.relaxed_sharpness)
    return Softness(*(first * (last / first) ** way for first, last in ends))
