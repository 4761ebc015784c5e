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
from numpy.typing import NDArray

from sinsjax.engine.batch import LANES, Batch, Layout, map_in_threads
from sinsjax.engine.inputs import Environment, ProgramSpec, Tiles
from sinsjax.engine.run import map_tiles, run_tile
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import run
from sinsjax.execution.run import ProgressCallback, RunProgress
from sinsjax.execution.success import require_floor
from sinsjax.methods.filters.keys import SCHEDULE_KEYS, find_without_gradient
from sinsjax.methods.method import Site
from sinsjax.methods.registry import METHODS
from sinsjax.methods.schedules import smooth_resets
from sinsjax.records.reference import StoredRecord
from sinsjax.strapdown import earth
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.study.sweep import COUNT, TIMES
from sinsjax.study.variants import Variants
from sinsjax.tuning import objective, search
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.law_point import law_point
from sinsjax.types import Array, Count
from sinsjax.units import DEG, micro_g, si_factor

NAME = "gradient"

TANGENT_STEPS = 2
"""Cost of one tangent of a step, in steps of a plain run; timed by the benchmark ``derivative``."""


def check_gradients(study: Study) -> None:
    """Check that all variables of a study with [tune] have a gradient.

    Raises:
        InputError: ``[tune.variables] key: has no gradient (hint)``.
    """
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
        evaluations += _Descents(study, stored, number, cost).run(on_progress)
    return SearchResult(NAME, evaluations)


class _Descents:
    """The descents of one combination of candidates."""

    def __init__(self, study: Study, stored: StoredRecord | None, number: int, cost: int) -> None:
        assert study.tune is not None
        self._study, self._stored, self._number, self._cost = study, stored, number, cost
        self._tune, self._space = study.tune, SearchSpace.from_study(study)
        self._parameters = TunedParams(study, self._space.combinations[number])
        self._used = self._space.used_variables(self._space.combinations[number])
        law = law_point(study, number)
        self._laws = np.empty((0, len(self._used))) if law is None else law[None, self._used]

    def run(self, on_progress: ProgressCallback | None) -> list[Evaluation]:
        """Run the descents; return all evaluations in order."""
        if not self._used:
            return self._evaluate_ends(np.empty((1, 0)))
        import optax  # late: it is slow to import, and only descents need it

        tune, steps, starts = self._tune, self._tune.descent_steps, self._tune.descent_starts
        slope = Slope(self._parameters, self._stored, starts=starts, draws=tune.descent_draws)
        box = self._choose_starts(slope.draws)
        adam = optax.adam(optax.cosine_decay_schedule(tune.descent_rate, steps, alpha=0.1))
        state = adam.init(box)
        evaluations: list[Evaluation] = []
        for step in range(steps):
            draws = (step * slope.draws + np.arange(slope.draws)) % slope.n_draws
            share = step / max(steps - 1, 1)  # geometric from the first to the last
            ends = (tune.relaxed_window_s, tune.relaxed_sharpness)
            softness = Softness(*(first * (last / first) ** share for first, last in ends))
            scores, gradient = slope(box, draws, softness)
            self._cost += slope.cost
            window_s = softness.window_s if self._parameters.moves_resets else None
            relaxed = window_s, softness.sharpness
            evaluations += [
                Evaluation(step, self._number, values, float(score), self._cost, start, *relaxed)
                for start, (values, score) in enumerate(zip(self._values(box), scores, strict=True))
            ]
            if on_progress is not None:
                done, total = ((n * starts * slope.draws) for n in (step + 1, steps))
                on_progress(RunProgress(done, total, 0, 0))
            finite = np.nan_to_num(gradient, posinf=0.0, neginf=0.0)
            with jax.numpy_dtype_promotion("standard"):  # which optax is written for
                moves, state = adam.update(finite, state)
            box = np.asarray(optax.projections.projection_box(box + moves, 0.0, 1.0))
        return [*evaluations, *self._evaluate_ends(box)]

    def _choose_starts(self, draws: int) -> NDArray:
        """Return the initial positions of the descents, (starts, p): the best of some points.

        The reset schedule by the law is one of them.
        """
        starts = self._tune.descent_starts
        count = max(self._tune.descent_screen, starts)
        design = search.sobol_design(self._study, NAME, count)
        box = design.box[design.candidate == self._number][:, self._used]
        box = np.concatenate([self._laws, box])
        if count == starts:
            return box[:count]
        return box[np.argsort(self._score(self._values(box), draws), kind="stable")[:starts]]

    def _evaluate_ends(self, box: NDArray) -> list[Evaluation]:
        """Evaluate the final points and the law's on all tuning draws, the latter without a start.

        The relaxed objective may lead a descent from the law's point to a worse one.
        """
        values = self._values(np.concatenate([box, self._laws]))
        scores, step = self._score(values), self._tune.descent_steps
        return [
            Evaluation(step, self._number, *end, self._cost, start if start < len(box) else None)
            for start, end in enumerate(zip(values, scores, strict=True))
        ]

    def _values(self, box: NDArray) -> list[list[float]]:
        """Return the values of all variables at positions of the used ones; NaN for the others."""
        whole = np.full((len(box), len(self._space.variables)), np.nan)
        whole[:, self._used] = box
        return [self._space.to_values(row) for row in whole]

    def _score(self, values: Sequence[Sequence[float]], draws: int | None = None) -> list[float]:
        """Return the objective at some points with hard resets, on all or the first draws."""
        study = self._study
        if draws is not None and not study.is_recorded:
            study = study.replace({"tune.tune_draws": draws})
        scored = search.score_points(
            study,
            NAME,
            [self._number] * len(values),
            values,
            lambda of: run.run(of, self._stored, curves=False, progress=False).summary,
        )
        self._cost += scored.costs[-1]
        return scored.scores


# The objective of some descents and its gradient


class Softness(NamedTuple):
    """Degree of relaxation of a step.

    Attributes:
        window_s: half width of the reset windows, s.
        sharpness: sharpness of the band's edge, see `metrics.Criteria`.
    """

    window_s: float
    sharpness: float


class _Lane(NamedTuple):
    """What lanes have in place of the method's params until they are run.

    Attributes:
        params: leaves (lanes, ...).
        slopes: derivatives of the leaves that depend on the variables, (lanes, p, ...), by number.
        width: (lanes,) half width of the windows of resets, samples; None if none moves.
    """

    params: Any
    slopes: dict[int, Array]
    width: Array | None


class _Program(NamedTuple):
    """Runs of all descents that share a program, and the program.

    Attributes:
        batch: of the runs, with variants for each descent.
        params: points of all descents -> params of their variants, and derivatives.
        layout: of the runs in chunks.
        jitted: the program.
        active: numbers of the leaves of the params that depend on the variables.
    """

    batch: Batch
    params: Callable[[NDArray], tuple[Any, Any]]
    layout: Layout
    jitted: Any
    active: tuple[int, ...]


class Slope:
    """Relaxed objective of some descents and its gradient, for one combination of candidates.

    Attributes:
        draws: number of draws per step.
        n_draws: number of tuning draws.
    """

    def __init__(
        self,
        parameters: "TunedParams",
        stored: StoredRecord | None = None,
        *,
        starts: int,
        draws: int,
    ) -> None:
        """Prepare the runs of some descents, with at most so many draws per step.

        Raises:
            InputError: the record does not fit.
        """
        study = parameters.study
        assert study.tune is not None
        self._tune, self._parameters, self._starts = study.tune, parameters, starts
        self._from_truth, self._rate_hz = success_criteria(study).from_truth, study.rate_hz
        derived = search.derive_study(study, {"base": parameters.point}, name=study.name)
        require_floor(derived)
        scenario = Scenario(derived, stored, curves=False)
        batches = [(scenario.batch(i), scenario.keys(i)) for i in range(len(scenario.specs))]
        self.n_draws = batches[0][0].n_draws
        self.draws = min(draws, self.n_draws)
        self._programs = [self._program(*batch) for batch in batches]
        self._draw_cost = search.total_steps(derived) / derived.n_draws

    @property
    def cost(self) -> int:
        """Cost of one gradient of all descents, in steps of a plain run, tangents included."""
        tangents = TANGENT_STEPS * len(self._parameters.variables)
        return round(self._starts * self.draws * self._draw_cost * (1 + tangents))

    def __call__(self, box: NDArray, draws: NDArray, softness: Softness) -> tuple[NDArray, NDArray]:
        """Return the objective of each descent, (starts,), and its gradient, (starts, p).

        Args:
            box: (starts, p) positions of the variables in their ranges, 0 to 1.
            draws: (draws,) indices of the draws to use.
            softness: degree of relaxation.
        """
        by_program = [self._run(program, box, draws, softness) for program in self._programs]
        runs, slopes = (np.concatenate(parts, axis=1) for parts in zip(*by_program, strict=True))
        score, by_run = map(np.asarray, objective.relaxed_score(self._tune, runs))
        return score, np.einsum("svd,svdp->sp", by_run, slopes)

    def _program(self, batch: Batch, keys: Variants) -> _Program:
        """Return the program of a batch with lanes for each descent and variant."""
        of_starts = jax.tree.map(
            lambda a: np.concatenate([np.asarray(a)] * self._starts), batch.params
        )
        batch = batch._replace(params=of_starts)
        params = self._parameters.differentiate(batch.spec.method, keys)
        middle = np.full((self._starts, len(self._parameters.variables)), 0.5)
        _, slopes = params(middle)
        active = [i for i, leaf in enumerate(jax.tree.leaves(slopes)) if np.any(leaf)]
        variants, devices = batch.n_variants, len(jax.devices())
        runs = self.draws * variants
        # Few runs need fewer lanes; a call has at least two blocks for each device.
        lanes = min(LANES, 1 << (max(runs // (2 * devices), 8) - 1).bit_length())
        tiles = -(-runs // (lanes * devices))
        layout = Layout(batch.spec, self.draws, variants, tiles_per_chunk=tiles, lanes=lanes)
        jitted = jax.jit(partial(self._differentiate, batch.spec))
        return _Program(batch, params, layout, jitted, (*active,))

    def _run(
        self, program: _Program, box: NDArray, draws: NDArray, softness: Softness
    ) -> tuple[NDArray, NDArray]:
        """Return relaxed values (starts, variants, draws) and derivatives (..., p)."""
        jitted, variants, p = program.jitted, program.batch.n_variants, box.shape[1]
        arguments = self._arguments(program, box, draws, softness)
        jitted.lower(*arguments[0]).compile()  # otherwise every thread would compile
        calls = map_in_threads(
            lambda call: jax.device_get(jitted(*call)), arguments, len(jax.devices())
        )
        values = np.empty((len(draws), variants))
        slopes = np.empty((len(draws), variants, p))
        for number, (value, slope) in enumerate(calls):
            runs = program.layout.active(number)
            values[runs.draw, runs.variant] = value.reshape(-1)[runs.lane]
            by_lane = np.moveaxis(slope, -2, -1).reshape(-1, p)
            slopes[runs.draw, runs.variant] = by_lane[runs.lane]
        shape = (len(draws), self._starts, variants // self._starts)
        return (
            np.moveaxis(values.reshape(shape), 0, 2),
            np.moveaxis(slopes.reshape(*shape, p), 0, 2),
        )

    def _arguments(
        self, program: _Program, box: NDArray, draws: NDArray, softness: Softness
    ) -> list[tuple]:
        """Return the arguments of every call of a program."""
        batch = program.batch.select_draws(draws)
        params, slopes = program.params(box)
        width = None
        if self._parameters.moves_resets:
            width = np.full(batch.n_variants, softness.window_s * self._rate_hz)
        leaves = jax.tree.leaves(slopes)
        lane = _Lane(params, {i: leaves[i] for i in program.active}, width)
        batch = batch._replace(params=batch.params._replace(method=lane))
        # What is only reported has no part in the objective, nor in its derivatives.
        environment, layout = batch.environment, program.layout
        soft = environment.criteria._replace(
            sharpness=np.float64(softness.sharpness), report_samples=None
        )
        environment = environment._replace(criteria=soft)
        return [
            (environment, layout.tiles_of(batch, call), np.int32(layout.blocks(call)))
            for call in range(len(layout))
        ]

    def _differentiate(
        self, spec: ProgramSpec, environment: Environment, tiles: Tiles, blocks: Count
    ) -> tuple[Array, Array]:
        """Return the values of some tiles' runs and their derivatives by their descent's box."""

        def tile_values(tile: Tiles, active: dict[int, Array]) -> Array:
            lane: _Lane = tile.params.method
            leaves, structure = jax.tree.flatten(lane.params)
            method = structure.unflatten(active.get(i, leaf) for i, leaf in enumerate(leaves))
            method = method if lane.width is None else smooth_resets(method, lane.width)
            lanes = tile._replace(params=tile.params._replace(method=method))
            outcome, _ = run_tile(spec, environment, lanes)
            return objective.relaxed_values(
                self._tune, environment.criteria, outcome, truth=self._from_truth
            )

        def differentiate_tile(tile: Tiles) -> tuple[Array, Array]:
            lane = tile.params.method
            leaves = jax.tree.leaves(lane.params)
            directions = {i: jnp.moveaxis(slope, 1, 0) for i, slope in lane.slopes.items()}
            active = {i: leaves[i] for i in directions}
            return sensitivities(partial(tile_values, tile), active, directions)

        values: tuple[Array, Array] = map_tiles(spec, differentiate_tile, tiles, blocks)
        return values


def sensitivities(function: Callable[[Any], Any], point: Any, directions: Any) -> tuple[Any, Any]:
    """Return value and derivatives of a function of a tree of arrays, in one forward pass.

    The directions have, and the derivatives get, a leading axis of p before the shape of the point.
    """

    def derivative(direction: Any) -> tuple[Any, Any]:
        return jax.jvp(function, (point,), (direction,))

    # The value does not depend on the direction, so it is computed once for all of them.
    return jax.vmap(derivative, out_axes=(None, 0))(directions)


# What the variables do to the params of methods


class _TunedKeys(Variants):
    """The keys of some variants, of which the tuned ones have traced values."""

    def __init__(self, keys: Variants, tuned: Mapping[str, Any]) -> None:
        self.__dict__ |= vars(keys)
        self._tuned = tuned

    def column(self, key: str, factor: float = 1.0) -> Any:
        """Return numbers times a factor, (variants,); NaN if the key is left out."""
        if key not in self._tuned:
            return super().column(key, factor)
        return jnp.full(self.count, self._tuned[key] * factor)

    def si(self, key: str) -> Any:
        """Return numbers in SI units, (variants,); NaN if the key is left out."""
        return self.column(key, si_factor(key, self.micro_g))

    def compute(self, function: Callable[..., Any], *keys: str, dtype: Any = float) -> Any:
        """Return a function of the values of some keys, (variants, ...)."""
        if self._tuned.keys().isdisjoint(keys):
            return super().compute(function, *keys, dtype=dtype)
        return self._by_variant(function, keys, lambda found: [jnp.asarray(one) for one in found])

    def lists(self, function: Callable[..., Any], *keys: str, padding: float) -> Any:
        """Return lists of a function of some keys, (variants, longest), padded with ``padding``."""
        if self._tuned.keys().isdisjoint(keys):
            return super().lists(function, *keys, padding=padding)

        def pad(found: list[Any]) -> list[Array]:
            longest = max(map(len, found))
            return [jnp.asarray([*one, *[padding] * (longest - len(one))]) for one in found]

        return self._by_variant(function, keys, pad)

    def _by_variant(
        self, function: Callable[..., Any], keys: tuple[str, ...], to_arrays: Callable
    ) -> Array:
        """Return a function of keys once per combination, expanded over the variants."""
        column = self.coded(*keys)
        used, codes = np.unique(column.codes, return_inverse=True)
        rows = [column.choices[code] if len(keys) > 1 else (column.choices[code],) for code in used]
        found = [
            function(*(self._tuned.get(key, value) for key, value in zip(keys, row, strict=True)))
            for row in rows
        ]
        return jnp.stack(to_arrays(found))[codes]


class TunedParams:
    """The params of methods as functions of the variables, with resets relaxed.

    Attributes:
        study: study with [tune].
        variables: (p,) variables that the combination of candidates uses.
        point: a point in the middle of all ranges.
        moves_resets: whether a variable moves resets, all of which are then smooth windows.
    """

    def __init__(self, study: Study, combination: TomlTable) -> None:
        """Check that all variables of a combination of candidates have a gradient.

        Raises:
            InputError: ``[tune.variables] key: has no gradient (hint)``.
        """
        self.study, space = study, SearchSpace.from_study(study)
        self.variables = [space.variables[i] for i in space.used_variables(combination)]
        self.point = space.make_point(space.to_values([0.5] * len(space.variables)), combination)
        times = space.ranges.get(TIMES, ())
        assert isinstance(times, tuple)
        self._fixed_times = [kind.fixed for kind in times[: combination.get(COUNT, len(times))]]
        based = with_point(study, self.point)
        self.moves_resets = any(variable.key in SCHEDULE_KEYS for variable in self.variables)
        if key := find_without_gradient(Variants.all_of(based), smoothed=self.moves_resets):
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
            directions = jnp.eye(len(place))
            value, slope = sensitivities(at, place, directions)
            return value, jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), slope)

        of_starts = jax.jit(jax.vmap(of_start))
        return lambda box: jax.tree.map(lambda a: np.concatenate(np.asarray(a)), of_starts(box))


_ANY_SITE = Site(earth.wgs84(0.0), earth.place(earth.wgs84(0.0), 45 * DEG), 45 * DEG)
"""Whether params depend on a variable is the same at every place."""


def _refuse(study: Study, what: str) -> NoReturn:
    text = "has no gradient (use 'sobol' instead of 'gradient')"
    raise InputError(f"{study.name}: {what}: {text}")
