"""The runs of a program outside sinsjax: their records, where they start, and their outcomes.

Variants that differ only in a method and its settings are one run for a program: they have the
same condition. A record belongs to a draw and to an environment: Earth, motion, sensors. The
attitudes of a program take the place of those of a method that does nothing, and pass through the
same observation, metrics and criteria as those of any run.
"""

from collections.abc import Hashable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sinsjax.engine.batch import Batch
from sinsjax.engine.inputs import Environment, ProgramSpec, Tiles
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import Intervals, Run, prepare_tile
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution.prepare import refuse_external
from sinsjax.execution.success import require_floor
from sinsjax.maths.algebra import select_tree
from sinsjax.maths.rotations import normalise
from sinsjax.methods import method
from sinsjax.methods.registry import register_external
from sinsjax.study.keys import is_condition_key
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study, study_to_tables
from sinsjax.types import Array, Quat


class ProgramRuns:
    """The runs of a program on a simulated study, (draws, conditions).

    Attributes:
        source: the study without the program.
        study: the study with the program as a further method.
        has_start: (conditions,) whether a run starts from a given attitude.
        environments: (conditions,) number of the environment, each of which has its own records.
        run_id: (draws, conditions) their numbers in ``source``.
        end_s: length of a run, s.
    """

    def __init__(self, source: Study, name: str = "external") -> None:
        """Lay out the runs of a program, or raise as `add_program`."""
        self.source, self.study = source, add_program(source, name)
        has_start = ~source.without_effect("phi_u0_deg")
        swept = (key for key in source.axis_keys if is_condition_key(key))
        self._keys = [key for key in swept if has_start.any() or key not in method.INITIAL_KEYS]
        condition = self._conditions(source, range(source.n_variants))
        first = np.unique(condition, return_index=True)[1]
        self.has_start = np.isin(np.arange(len(first)), condition[has_start])
        data = [source.values(key) for key in self._keys if key not in method.INITIAL_KEYS]
        self.environments = _number(tuple(values[i] for values in data) for i in first)
        self.run_id = np.add.outer(source.n_variants * np.arange(source.n_draws), first)
        self.end_s = source.records * source.record_every / source.rate_hz

    def _conditions(self, study: Study, variants: Iterable[int]) -> NDArray:
        """Return the number of the condition of some variants, by first appearance."""
        columns = [study.values(key) for key in self._keys]
        return _number(tuple(column[i] for column in columns) for i in variants)

    def batches_and_variant_conditions(self) -> Iterator[tuple[Batch, NDArray]]:
        """Yield the program's runs by environment, and the condition of each of their variants."""
        require_floor(self.study)
        methods, (name,) = self.study.values("method"), self.study.study.external or ()
        program = [i for i, one in enumerate(methods) if one == name]
        condition = dict(zip(program, self._conditions(self.study, program), strict=True))
        scenario = Scenario(self.study, curves=False)
        for number, ids in enumerate(scenario.variant_ids):
            if ids[0] in condition:
                yield scenario.batch(number), np.array([condition[i] for i in ids])


def _number(values: Iterable[Hashable]) -> NDArray:
    """Return a number for each distinct value, by first appearance."""
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(value, len(numbers)) for value in values])


def add_program(study: Study, name: str) -> Study:
    """Return a study with a program as a further method, which has every condition of the others.

    Raises:
        InputError: the study has no draws to give to a program, or [axes] zips methods with other
            keys; or the name is that of a method of sinsjax.
    """
    if study.is_recorded:
        text = "reads a record: give that to the program (a simulated study has draws)"
        raise InputError(f"{study.name}: [record]: {text}")
    if study.passes is not None:
        text = "a program reads a record once (--set passes={} drops the section)"
        raise InputError(f"{study.name}: [passes]: {text}")
    refuse_external(study.study.external, study.name)
    register_external([name], _build_given_attitudes)
    tables = study_to_tables(study)
    tables["study"]["external"] = [name]
    axes, cases = dict(tables.get("axes", {})), list(tables.get("cases", ()))
    if any(isinstance(axis, dict) and "method" in axis for axis in axes.values()):
        text = "zips methods with other keys (give them as [[cases]])"
        raise InputError(f"{study.name}: [axes]: {text}")
    if any("method" in case for case in cases):
        first: dict[Any, Any] = {}  # the first case of each condition
        for case in cases:
            first.setdefault(tuple((k, case[k]) for k in case if is_condition_key(k)), case)
        for case in first.values():
            label = name if len(first) == 1 else f"{name}, {case.get('case')}"
            cases.append(case | {"method": name} | ({"case": label} if "case" in case else {}))
        tables["cases"] = cases
    elif "method" in axes:
        axes["method"] = [*axes["method"], name]
    else:
        axes = {"method": [tables["alignment"].pop("method"), name], **axes}
    return study_from_dict(tables | {"axes": axes}, study.name)


class GivenAttitudes(NamedTuple):
    """Solutions of some runs at record times, leaves (records, runs); of one run, its state."""

    present: Array  # whether a run is judged at a record time
    attitude: Quat  # from b to n; NaN counts as outside every band
    covariance: method.AttitudeCovariance  # of its misalignment; NaN if unknown


def _build_given_attitudes(options: method.Options) -> method.Program:
    """Return a method that keeps its first attitude, until others are put into its state.

    Runs are judged from the bias floor of a method that does not estimate the biases.
    """
    return method.Program(
        init=lambda params, nav: GivenAttitudes(
            jnp.isfinite(nav.ve), nav.q, method.unknown_covariance(nav.ve)
        ),
        step=lambda params, site, state, sample, n: state,
        attitude=lambda state: state.attitude,
        covariance=lambda state: state.covariance,
        normalise=lambda state: state._replace(attitude=normalise(state.attitude)),
    )


def find_starts(batch: Batch) -> NDArray:
    """Return misaligned attitudes, from b to n, and velocities east and north, m/s, (6, runs)."""
    return np.asarray(_find_starts(batch.spec, batch.environment, _tile(batch)))


def judge(batch: Batch, given: GivenAttitudes) -> Outcome:
    """Return the outcomes of all runs of a batch of the program, by draw and variant."""
    outcome = _judge(batch.spec, batch.environment, _tile(batch), given)
    return jax.tree.map(np.asarray, outcome)


def _tile(batch: Batch) -> Tiles:
    """Return one tile with all runs of a batch, by draw and variant."""
    row = np.repeat(np.arange(batch.n_draws, dtype=np.int32), batch.n_variants)
    params = jax.tree.map(lambda a: np.concatenate([a] * batch.n_draws), batch.params)
    return Tiles(batch.draws, row, params)


@partial(jax.jit, static_argnums=0)
def _find_starts(spec: ProgramSpec, environment: Environment, tile: Tiles) -> Array:
    runs = prepare_tile(spec, environment, tile)
    return jnp.stack([*runs.start().state.attitude, runs.params.ve, runs.params.vn])


@partial(jax.jit, static_argnums=0)
def _judge(
    spec: ProgramSpec, environment: Environment, tile: Tiles, given: GivenAttitudes
) -> Outcome:
    runs = prepare_tile(spec, environment, tile)
    turns = runs.sensors.housing_vibration_rotations(spec.intervals)

    def observe(run: Run, row: tuple[Intervals, GivenAttitudes]) -> tuple[Run, None]:
        interval, now = row
        turn = turns and jax.tree.map(lambda a: a[interval.number + 1], turns)
        observed = runs.observe(Run(now, run.metrics), interval, turn)
        return jax.vmap(select_tree)(now.present, observed, run), None

    last, _ = jax.lax.scan(observe, runs.start(), (runs.record_periods(), given))
    return runs.finish(last)
