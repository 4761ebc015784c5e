"""The stages of runs: coarse alignment, where a study has it, then the method's own."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine.measurements import Read
from sinsjax.engine.realisations import Static
from sinsjax.methods import passes
from sinsjax.methods.base import Options
from sinsjax.types import Array


class StageFunctions(NamedTuple):
    """What the stages of runs are made of, for one run or for many; a program is a `Static`.

    Attributes:
        begin: program -> `simulate.Run` before its first sample.
        over_record: (program, run and `Read`, record) -> both after the record, and what was
            observed: `simulate.over_record`.
        after_coarse: (state of the coarse method, `BodyTurn` or None) -> state of the method.
    """

    begin: Callable[[Static], Any]
    over_record: Callable[[Static, Any, Any], tuple[Any, Array | None]]
    after_coarse: Callable[[Any, Any], Any]


def over_stages(
    static: Static, functions: StageFunctions, nothing: Read, records: Any
) -> tuple[Any, Array | None]:
    """All record intervals: those of coarse alignment, if it is a stage, and of the method.

    Args:
        static: program.
        functions: what the stages are made of.
        nothing: what is read before the first sample.
        records: what `over_record` takes of each, leaves (records, ...), its number first.

    Returns:
        The run at its end, and what was observed, (records, ...), None where that is not kept.
    """
    over, coarse = functions.over_record, static.coarse
    if coarse is None:
        under_way = functions.begin(static), nothing
        (run, _), observed = jax.lax.scan(partial(over, static), under_way, records)
        return run, observed
    program, first = coarse_program(static), coarse.records
    early = jax.tree.map(lambda a: a[:first], records)
    under_way = functions.begin(program), nothing
    (run, read), observed = jax.lax.scan(partial(over, program), under_way, early)
    run = run._replace(state=functions.after_coarse(run.state, read.turn))
    if coarse.replays:
        again = partial(_unobserved_before, first, partial(over, static))
        (run, _), later = jax.lax.scan(again, (run, nothing), records)
        later = None if later is None else later[first:]
    else:
        late = jax.tree.map(lambda a: a[first:], records)
        (run, _), later = jax.lax.scan(partial(over, static), (run, read), late)
    return run, None if later is None else jnp.concatenate([observed, later])


def _unobserved_before(
    first: int, over: Callable[[Any, Any], tuple[Any, Any]], under_way: Any, record: Any
) -> tuple[Any, Any]:
    """A record interval whose observation does not count before the ``first`` one."""
    (run, read), observed = over(under_way, record)
    metrics = passes.where(record[0] >= first, run.metrics, under_way[0].metrics)
    return (run._replace(metrics=metrics), read), observed


def coarse_program(static: Static) -> Static:
    """The program of the coarse stage, within which no pass ends."""
    assert static.coarse is not None
    options = Options(static.options.dt)
    return static._replace(
        method=static.coarse.method, options=options, repeats=False, rewinds=False
    )
