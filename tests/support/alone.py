"""A run alone, by the engine's only driver."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.inputs import Draw, Environment, ProgramSpec, RunParams, Tiles
from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.engine.run import TileRuns, prepare_tile, run_tile


def first_lane(tree: Any) -> Any:
    """Add the axis of lanes, or of draws."""
    return jax.tree.map(lambda a: jnp.asarray(a)[None], tree)


def tile_of_one(draw: Draw, params: RunParams) -> Tiles:
    return Tiles(first_lane(draw), np.zeros(1, np.int32), first_lane(params))


def set_up_alone(
    spec: ProgramSpec, environment: Environment, draw: Draw, params: RunParams
) -> TileRuns:
    return prepare_tile(spec, environment, tile_of_one(draw, params))


def run_alone(
    spec: ProgramSpec, environment: Environment, draw: Draw, params: RunParams
) -> tuple[Outcome, Observation | None]:
    """The outcome of one run, closed after every sample, and its curves, leaves (records,)."""
    tile = tile_of_one(draw, params)
    outcome, curves = run_tile(spec, environment, tile, by_event=False)
    outcome = jax.tree.map(lambda a: a[0], outcome)
    return outcome, jax.tree.map(lambda a: a[..., 0], curves)
