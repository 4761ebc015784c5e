"""Gradient search: several descents in parallel lanes, differentiated in forward mode.

Descents start at the best of some points, one of them the reset schedule by the law, and the edge
of the band is soft; it sharpens from step to step. Each step uses the next few draws, and resets
that move are smooth windows, which sharpen too. The final points are scored like any other point,
with hard resets on all tuning draws, and so is the law's schedule.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.engine.batch import LANES, Batch, Layout, map_in_threads
from sinsjax.engine.inputs import Environment, Tiles
from sinsjax.engine.run import map_tiles, run_tile
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import run
from sinsjax.execution.run import ProgressCallback, RunProgress
from sinsjax.execution.success import require_floor
from sinsjax.methods.filters.keys import SCHEDULE_KEYS, reset_key_without_gradient
from sinsjax.methods.method import Site
from sinsjax.methods.registry import METHODS
from sinsjax.methods.schedules import smooth_resets
from sinsjax.records.reference import StoredRecord
from sinsjax.strapdown import earth
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import with_point
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.study.sweep import COUNT, TIMES, CodedColumn
from sinsjax.study.values import Variants
from sinsjax.tuning import objective, search
from sinsjax.tuning.history import Evaluation, SearchPoint, SearchResult
from sinsjax.tuning.search import GRADIENT, reset_law_schedule_in_unit_box
from sinsjax.types import Array, Count
from sinsjax.units import DEG, micro_g

TANGENT_STEPS = 2
"""Cost of one tangent of a step, in steps of a plain run; timed by the benchmark ``derivative``."""


def check_gradients(study: Study) -> None:
    """Refuse a study with [tune] of which a variable has no gradient."""
    for combination in SearchSpace.from_study(study).combinations:
        TunedParams(study, combination)


def descend(
    study: Study, stored: StoredRecord | None = None, *, on_progress: ProgressCallback | None = None
) -> SearchResult:
    """Tune a study by gradient, for every combination of its candidates.

    Returns every step of every descent with its relaxed objective, and the final points with their
    unrelaxed objective on all tuning draws, the law's schedule among them. The progress is that of
    runs, after every step.

    Raises:
        InputError: a variable has no gradient, or the record does not fit.
    """
    evaluations: list[Evaluation] = []
    for number in range(len(SearchSpace.from_study(study).combinations)):
        cost = evaluations[-1].cost if evaluations else 0
        evaluations += _descend_combination(study, stored, number, cost, on_progress)
    return SearchResult(GRADIENT, evaluations)


def _descend_combination(
    study: Study,
    stored: StoredRecord | None,
    number: int,
    spent: int,
    on_progress: ProgressCallback | None,
) -> list[Evaluation]:
    """Return the evaluations of the descents of a combination of candidates, in order.

    The descents start at the best of some points, one of them the reset schedule by the law. The
    relaxed objective may lead a descent from the law's point to a worse one, so the law's is
    evaluated at the end with the final points.
    """
    tune, space = search.require_tune(study), SearchSpace.from_study(study)
    parameters, evaluations = TunedParams(study, space.combinations[number]), list[Evaluation]()
    law, p = reset_law_schedule_in_unit_box(study, number), len(parameters.variables)
    laws, box = np.empty((0, p)) if law is None else law[None], np.empty((1, p))
    if p:
        import optax  # late: it is slow to import, and only descents need it

        steps, starts = tune.descent_steps, tune.descent_starts
        slope = DescentObjectives(parameters, stored, starts=starts, draws=tune.descent_draws)
        screened = max(tune.descent_screen, starts)
        box = np.concatenate([laws, search.sobol_box_points(study, GRADIENT, number, screened)])
        if screened > starts:
            points = search.points_at(space, number, box)
            scored = score_with_hard_resets(study, stored, points, slope.draws)
            box, spent = box[np.argsort(scored.scores, kind="stable")], spent + scored.costs[-1]
        box = box[:starts]
        adam = optax.adam(optax.cosine_decay_schedule(tune.descent_rate, steps, alpha=0.1))
        state = adam.init(box)
        for step in range(steps):
            draws = (step * slope.draws + np.arange(slope.draws)) % slope.n_draws
            softness = Softness.at_step(tune, step)
            scores, gradient = slope(box, draws, softness)
            spent += slope.cost
            window_s = softness.window_s if parameters.moves_resets else None
            evaluations += [
                Evaluation(step, *point, float(score), spent, start, window_s, softness.sharpness)
                for start, (point, score) in enumerate(
                    zip(search.points_at(space, number, box), scores, strict=True)
                )
            ]
            if on_progress is not None:
                done, total = ((n * starts * slope.draws) for n in (step + 1, steps))
                on_progress(RunProgress(done, total, 0, 0))
            finite = np.nan_to_num(gradient, posinf=0.0, neginf=0.0)
            with jax.numpy_dtype_promotion("standard"):  # which optax is written for
                moves, state = adam.update(finite, state)
            box = np.asarray(optax.projections.projection_box(box + moves, 0.0, 1.0))
    points = search.points_at(space, number, np.concatenate([box, laws]))
    scored = score_with_hard_resets(study, stored, points)
    ends = zip(points, scored.scores, strict=True)
    return evaluations + [
        Evaluation(
            tune.descent_steps, *point, score, spent + scored.costs[-1], i if i < len(box) else None
        )
        for i, (point, score) in enumerate(ends)
    ]


def score_with_hard_resets(
    study: Study,
    stored: StoredRecord | None,
    points: Sequence[SearchPoint],
    draws: int | None = None,
) -> search.PointScores:
    """Return the objective at some points with hard resets, on all tuning draws or the first."""
    if draws is not None and not study.is_recorded:
        study = study.replace({"tune.tune_draws": draws})

    def run_cases(derived: Study) -> pa.Table:
        return run.run(derived, stored, curves=False, progress=False).summary

    return search.score_points(study, GRADIENT, points, run_cases)


# The objective of some descents and its gradient


class Softness(NamedTuple):
    """Degree of relaxation of a step."""

    window_s: float  # half width of the reset windows, s
    sharpness: float  # sharpness of the band's edge, see `metrics.Criteria`

    @classmethod
    def at_step(cls, tune: TuneSection, step: int) -> "Softness":
        """Return that of a step, geometric from the first to the last."""
        share = step / max(tune.descent_steps - 1, 1)
        ends = (tune.relaxed_window_s, tune.relaxed_sharpness)
        return cls(*(first * (last / first) ** share for first, last in ends))


class _Lane(NamedTuple):
    """What lanes have in place of the method's params until they are run."""

    params: Any  # leaves (lanes, ...)
    # derivatives of the leaves that depend on the variables, (lanes, p, ...), by number
    slopes: dict[int, Array]
    width: Array | None  # (lanes,) half width of the windows of resets, samples; None if none moves


class DescentObjectives:
    """Relaxed objective of some descents and its gradient, for one combination of candidates.

    Attributes:
        draws: number of draws per step.
        n_draws: number of tuning draws.
        cost: cost of one gradient of all descents, in steps of a plain run, tangents included.
    """

    def __init__(
        self,
        parameters: "TunedParams",
        stored: StoredRecord | None = None,
        *,
        starts: int,
        draws: int,
    ) -> None:
        """Prepare the runs of some descents, with at most so many draws per step."""
        study = parameters.study
        self._tune = search.require_tune(study)
        derived = search.derive_study(study, {"base": parameters.point}, name=study.name)
        require_floor(derived)
        scenario = Scenario(derived, stored, curves=False)
        batches = [scenario.batch(number) for number in range(len(scenario.specs))]
        self.n_draws = batches[0].n_draws
        self.draws = min(draws, self.n_draws)
        self._programs = [
            _Program(parameters, batch, scenario.keys(number), starts, self.draws)
            for number, batch in enumerate(batches)
        ]
        plain = starts * self.draws * search.total_steps(derived) / derived.n_draws
        self.cost = round(plain * (1 + TANGENT_STEPS * len(parameters.variables)))

    def __call__(self, box: NDArray, draws: NDArray, softness: Softness) -> tuple[NDArray, NDArray]:
        """Return the objective of each descent, (starts,), and its gradient, (starts, p).

        Args:
            box: (starts, p) positions of the variables in their ranges, 0 to 1.
            draws: (draws,) indices of the draws to use.
            softness: degree of relaxation.
        """
        by_program = [program.run_each(box, draws, softness) for program in self._programs]
        runs, slopes = (np.concatenate(parts, axis=1) for parts in zip(*by_program, strict=True))
        score, by_run = map(np.asarray, objective.relaxed_score(self._tune, runs))
        return score, np.einsum("svd,svdp->sp", by_run, slopes)


class _Program:
    """Runs of all descents that share a compiled program, with lanes for each start and variant."""

    def __init__(
        self, parameters: "TunedParams", batch: Batch, keys: Variants, starts: int, draws: int
    ) -> None:
        study = parameters.study
        self._tune = search.require_tune(study)
        self._from_truth = success_criteria(study).from_truth
        self._rate_hz, self._moves_resets = study.rate_hz, parameters.moves_resets
        self._starts, self._params = starts, parameters.differentiate(batch.spec.method, keys)
        repeated = jax.tree.map(lambda a: np.concatenate([np.asarray(a)] * starts), batch.params)
        self._batch = batch._replace(params=repeated)
        self._p = len(parameters.variables)
        _, slopes = self._params(np.full((starts, self._p), 0.5))
        # The leaves of the params that depend on the variables.
        self._active = [i for i, leaf in enumerate(jax.tree.leaves(slopes)) if np.any(leaf)]
        variants, devices = self._batch.n_variants, len(jax.devices())
        # Few runs need fewer lanes; a call has at least two blocks for each device.
        lanes = min(LANES, 1 << (max(draws * variants // (2 * devices), 8) - 1).bit_length())
        tiles = -(-draws * variants // (lanes * devices))
        self._layout = Layout(batch.spec, draws, variants, tiles_per_chunk=tiles, lanes=lanes)
        self._jitted = jax.jit(self._differentiate_objective_values)

    def run_each(self, box: NDArray, draws: NDArray, softness: Softness) -> tuple[NDArray, NDArray]:
        """Return relaxed values (starts, variants, draws) and derivatives (..., p)."""
        arguments = self._call_arguments(box, draws, softness)
        self._jitted.lower(*arguments[0]).compile()  # otherwise every thread would compile
        calls = map_in_threads(
            lambda call: jax.device_get(self._jitted(*call)), arguments, len(jax.devices())
        )
        values = np.empty((self._batch.n_variants, len(draws)))
        slopes = np.empty((*values.shape, self._p))
        for number, (value, slope) in enumerate(calls):
            runs = self._layout.active(number)
            values[runs.variant, runs.draw] = value.ravel()[runs.lane]
            by_lane = np.moveaxis(slope, -2, -1).reshape(-1, self._p)
            slopes[runs.variant, runs.draw] = by_lane[runs.lane]
        shape = self._starts, -1, len(draws)
        return values.reshape(shape), slopes.reshape(*shape, self._p)

    def _call_arguments(self, box: NDArray, draws: NDArray, softness: Softness) -> list[tuple]:
        """Return the arguments of every call."""
        batch, layout = self._batch.select_draws(draws), self._layout
        params, slopes = self._params(box)
        leaves, width = jax.tree.leaves(slopes), None
        if self._moves_resets:
            width = np.full(batch.n_variants, softness.window_s * self._rate_hz)
        lane = _Lane(params, {i: leaves[i] for i in self._active}, width)
        batch = batch._replace(params=batch.params._replace(method=lane))
        # What is only reported has no part in the objective, nor in its derivatives.
        criteria = batch.environment.criteria._replace(
            sharpness=np.float64(softness.sharpness), report_samples=None
        )
        environment = batch.environment._replace(criteria=criteria)
        return [
            (environment, layout.tiles_of_chunk(batch, call), np.int32(layout.blocks(call)))
            for call in range(len(layout))
        ]

    def _differentiate_objective_values(
        self, environment: Environment, tiles: Tiles, blocks: Count
    ) -> tuple[Array, Array]:
        """Return the values of some tiles' runs and their derivatives by their descent's box."""
        spec = self._batch.spec

        def tile_values(tile: Tiles, change: Array) -> Array:
            lane: _Lane = tile.params.method
            leaves, structure = jax.tree.flatten(lane.params)
            for i, slope in lane.slopes.items():
                leaves[i] = leaves[i] + jnp.einsum("lp...,p->l...", slope, change)
            method = structure.unflatten(leaves)
            method = method if lane.width is None else smooth_resets(method, lane.width)
            lanes = tile._replace(params=tile.params._replace(method=method))
            outcome, _ = run_tile(spec, environment, lanes)
            return objective.relaxed_values(
                self._tune, environment.criteria, outcome, from_truth_not_floor=self._from_truth
            )

        def differentiate_tile(tile: Tiles) -> tuple[Array, Array]:
            return value_and_derivatives(partial(tile_values, tile), jnp.zeros(self._p))

        values: tuple[Array, Array] = map_tiles(spec, differentiate_tile, tiles, blocks)
        return values


def value_and_derivatives(function: Callable[[Array], Any], point: Array) -> tuple[Any, Any]:
    """Return value and derivatives of a function at a point, (p,), in one forward pass.

    The derivatives have a leading axis of p.
    """

    def derivative(direction: Array) -> tuple[Any, Any]:
        return jax.jvp(function, (point,), (direction,))

    # The value does not depend on the direction, so it is computed once for all of them.
    return jax.vmap(derivative, out_axes=(None, 0))(jnp.eye(len(point)))


# What the variables do to the params of methods


class _TracedColumn(CodedColumn):
    """A column whose choices are traced numbers."""

    def expand(self, dtype: Any = float) -> Any:
        """Return the values as an array, (variants, ...)."""
        return jnp.stack([jnp.asarray(choice) for choice in self.choices])[self.codes]


class _TunedKeys(Variants):
    """The keys of some variants, of which the tuned ones have traced values."""

    def __init__(self, keys: Variants, tuned: Mapping[str, Any]) -> None:
        self.__dict__ |= vars(keys)
        self._tuned = tuned

    def coded(self, *keys: str) -> CodedColumn:
        """Return the column of these variants, a traced one if any of the keys is tuned."""
        column = super().coded(*keys)
        if self._tuned.keys().isdisjoint(keys):
            return column
        if len(keys) == 1:
            return _TracedColumn(column.codes, tuple(self._tuned[keys[0]] for _ in column.choices))
        rows = (zip(keys, row, strict=True) for row in column.choices)
        choices = (tuple(self._tuned.get(key, value) for key, value in row) for row in rows)
        return _TracedColumn(column.codes, tuple(choices))


class TunedParams:
    """The params of methods as functions of the variables, with resets relaxed.

    Attributes:
        study: study with [tune].
        variables: (p,) variables that the combination of candidates uses.
        point: a point in the middle of all ranges.
        moves_resets: whether a variable moves resets, all of which are then smooth windows.
    """

    def __init__(self, study: Study, combination: TomlTable) -> None:
        """Refuse a combination of candidates of which a variable has no gradient."""
        self.study, space = study, SearchSpace.from_study(study)
        self.variables = [space.variables[i] for i in space.used_variables(combination)]
        self.point = space.make_point(space.to_values([0.5] * len(space.variables)), combination)
        times = space.ranges.get(TIMES, ())
        assert isinstance(times, tuple)
        self._fixed_times = [kind.fixed for kind in times[: combination.get(COUNT, len(times))]]
        based = with_point(study, self.point)
        self.moves_resets = any(variable.key in SCHEDULE_KEYS for variable in self.variables)
        if key := reset_key_without_gradient(Variants.all_of(based), smoothed=self.moves_resets):
            _refuse(study, key)
        methods, moved = based.values("method"), np.zeros(len(self.variables), bool)
        for name in set(methods):
            ids = np.array([methods.index(name)])
            keys = Variants(based, ids, site=_ANY_SITE, micro_g=micro_g())
            _, slopes = self.differentiate(name, keys)(np.full((1, len(moved)), 0.5))
            for leaf in jax.tree.leaves(slopes):
                moved |= np.any(leaf, axis=(0, *range(2, leaf.ndim)))
        for variable, is_moved in zip(self.variables, moved, strict=True):
            if not is_moved and variable.key not in SCHEDULE_KEYS:  # there may be no reset
                _refuse(study, f"[tune.variables] {variable.key}")

    def at(self, method: str, keys: Variants, box: Array) -> Any:
        """Return the params of a method at a point, leaves (variants, ...); resets are hard.

        The box has the (p,) positions of the variables in their ranges, 0 to 1.
        """
        tuned: dict[str, Any] = {}
        for place, variable in zip(box, self.variables, strict=True):
            value = variable.value(place)
            if variable.entry is not None:
                whole = self._fixed_times if variable.key == TIMES else keys.common(variable.key)
                entries = [*tuned.get(variable.key, whole)]
                entries[variable.entry] = value
                value = tuple(entries)
            tuned[variable.key] = value
        with jax.numpy_dtype_promotion("standard"):  # as NumPy, which params are written for
            return METHODS[method].params(_TunedKeys(keys, tuned), jnp)

    def differentiate(self, method: str, keys: Variants) -> Callable[[NDArray], tuple[Any, Any]]:
        """Return a function of the points of all starts, compiled once: params and derivatives.

        Of (starts, p) positions in the ranges, 0 to 1, it returns leaves (starts * variants, ...)
        and (starts * variants, p, ...).
        """
        at = partial(self.at, method, keys)

        def of_start(place: Array) -> tuple[Any, Any]:
            value, slope = value_and_derivatives(at, place)
            return value, jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), slope)

        of_starts = jax.jit(jax.vmap(of_start))
        return lambda box: jax.tree.map(lambda a: np.concatenate(np.asarray(a)), of_starts(box))


_ANY_SITE = Site(earth.wgs84(0.0), earth.place(earth.wgs84(0.0), 45 * DEG), 45 * DEG)
"""Whether params depend on a variable is the same at every place."""


def _refuse(study: Study, what: str) -> NoReturn:
    text = "has no gradient (use 'sobol' instead of 'gradient')"
    raise InputError(f"{study.name}: {what}: {text}")
