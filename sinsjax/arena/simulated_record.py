"""The output of simulated sensors as records, which can be written to files."""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.batch import Batch
from sinsjax.engine.inputs import Draw, Environment, ProgramSpec, derive_inputs, true_increments
from sinsjax.engine.samples import TileSensors
from sinsjax.engine.scenario import Scenario, StudySource
from sinsjax.errors import InputError
from sinsjax.methods.method import Site
from sinsjax.records import Record
from sinsjax.types import Array
from sinsjax.units import DEG


def simulated_record(study: StudySource, draw_id: int = 0, variant_id: int = 0) -> Record:
    """Return the output of a simulated study's sensors as a record that can be written to a file.

    Args:
        study: simulated study, its file, or the name of a shipped study.
        draw_id: draw of the noise.
        variant_id: variant of Earth, motion and sensors, if these are swept.

    Raises:
        InputError: the study has no such variant or draw, or reads a record itself.

    Examples:
        >>> record = sinsjax.simulated_record("paper1_resets")
        >>> record.rate_hz, record.dtheta.shape  # rad per sample
        (100.0, (90000, 3))
    """
    scenario = Scenario(study, curves=False)
    if draw_id < 0:
        raise InputError(f"{scenario.study.name}: has no draw {draw_id}")
    number, _ = scenario.find(variant_id)
    batch = scenario.batch(number, range(draw_id, draw_id + 1))
    return next(simulated_records(batch, scenario.study.rate_hz, scenario.study.name))


def simulated_records(batch: Batch, rate_hz: float, source: str) -> Iterator[Record]:
    """Yield the record of each draw of a simulation, of a rate in Hz; one program serves all."""
    spec, environment = batch.spec, batch.environment
    samples = min(spec.intervals, int(environment.pass_intervals)) * spec.interval_samples
    if environment.increments is None and environment.motion is not None:
        motion, place = environment.motion, environment.site.place
        rows = true_increments(motion, place, rate_hz, samples, axes=True)
        environment = environment._replace(increments=rows[:, :6], axes=rows[:, 6:])
    for number in range(batch.n_draws):
        draws = batch.select_draws(np.array([number])).draws
        rows, site = jax.tree.map(np.array, _measure(spec, samples, environment, draws))
        yield Record(
            dtheta=rows[:, :3],
            dv=rows[:, 3:],
            rate_hz=rate_hz,
            latitude_deg=float(site.latitude / DEG),
            height_m=float(site.earth.height),
            gravity_m_per_s2=float(site.place.gravity),
            source=source,
        )


@partial(jax.jit, static_argnums=(0, 1))
def _measure(
    spec: ProgramSpec, samples: int, environment: Environment, draws: Draw
) -> tuple[Array, Site]:
    """Return the measured increments (samples, 6) of a single draw, and its site."""
    draws = derive_inputs(spec, environment, draws)
    tile, all_ = TileSensors(spec, environment, draws), jnp.arange(samples)
    now, _ = tile.make_sampler(all_)(tile.start(), all_)
    site = environment.site
    if draws.site is not None:
        site = jax.tree.map(lambda a: a[0], draws.site)
    return jnp.stack([axis[:, 0] for axis in jax.tree.leaves(now)], axis=1), site
