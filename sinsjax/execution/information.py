"""Lower bound of the heading error of any method on the data of a study, in memory."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.covariance.information import heading_bound
from sinsjax.engine.build import ENVIRONMENT_KEYS, Scenario
from sinsjax.engine.sensor_inputs import read_sways
from sinsjax.errors import InputError
from sinsjax.execution.tables import make_table
from sinsjax.methods.floors import mean_attitude
from sinsjax.platform import runtime
from sinsjax.strapdown.base_motion import Motion
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.load import load_study
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.units import ARCMIN


def information_bound(study: Study | str | Path) -> pa.Table:
    """Return the information bound of a simulated study's heading, see `methods.information`.

    No unbiased method has a smaller standard deviation of phi_u about its bias floor, whatever its
    initial state; the settings of the study's methods have no influence. Variants with the same
    Earth, motion and sensors share a bound; each takes about a second for 300 s at 100 Hz.

    Args:
        study: study, its file, or the name of a shipped study.

    Returns:
        One row per variant and time, `report_times_s` and the end of its run: the least 1 sigma of
        phi_u. The schema has units and meanings.

    Raises:
        InputError: the study has a record or passes, draws a value that affects the bound, or has
            accelerometers without white noise.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.rate_hz": 10.0})
        >>> bound = sinsjax.information_bound(study)
        >>> [round(sigma, 2) for sigma in bound["bound_u_arcmin"].to_pylist()]
        [1.17, 1.17, 1.17]
    """
    runtime.ensure_configured()
    study = load_study(study)
    _check_bound_applies(study)
    scenario, ends = Scenario(study), study.spans_s[:, 0]
    swept = [key for key in study.axis_keys if key in ENVIRONMENT_KEYS]
    codes = study.resolved.column(*swept).codes if swept else np.zeros(study.n_variants, int)
    bounds: dict[tuple[int, float], dict[float, float]] = {}
    rows: list[tuple[int, float, float]] = []
    for part, ids in enumerate(scenario.variant_ids):
        for variant in ids:
            key = int(codes[variant]), float(ends[variant])
            if key not in bounds:
                times = sorted({*(t for t in study.report_times_s if t < key[1]), key[1]})
                bounds[key] = dict(
                    zip(times, _heading_sigma_bound(scenario, part, times), strict=True)
                )
            rows += [(int(variant), time, sigma) for time, sigma in bounds[key].items()]
    names = (c.name for c in columns.INFORMATION_BOUND)
    values = zip(
        names, (np.array(column) for column in zip(*sorted(rows), strict=True)), strict=True
    )
    return make_table(columns.INFORMATION_BOUND, dict(values))


def _heading_sigma_bound(scenario: Scenario, part: int, times_s: Sequence[float]) -> np.ndarray:
    """Return the bound of 1 sigma of the heading at some times, arcmin."""
    study = scenario.study
    environment = scenario.part(part, range(1), blank=True).group.environment
    sensors = environment.sensors
    if not np.all(sensors.errors.accel_noise):
        raise InputError("[sensors] accel_noise_ug: the information bound needs white noise")
    motion = read_sways(Variants(study, scenario.variant_ids[part]).common)
    pitch, roll, yaw = (s._replace(amplitude=0.0 * s.amplitude) for s in motion.angles)
    still_motion = Motion(pitch, roll, yaw)
    sigma = heading_bound(
        times_s,
        place=environment.site.place,
        errors=sensors.errors,
        disturbances=sensors.disturbances,
        dt=1 / study.rate_hz,
        to_n=np.asarray(mean_attitude(still_motion)),
    )
    return sigma / ARCMIN


def _check_bound_applies(study: Study) -> None:
    """Refuse a study for which the bound is unknown."""
    if study.is_recorded:
        raise InputError("[record]: the information bound needs the noise of a simulation")
    if study.passes:
        text = (
            "repeated passes add no information (drop [passes]; duration_s is the record's length)"
        )
        raise InputError(f"[passes]: {text}")
    for key in study.drawn_keys:
        if key in ENVIRONMENT_KEYS:
            text = "the information bound needs a fixed value (sweep it instead of drawing it)"
            raise InputError(f"[{SECTION_OF[key]}] {key}: {text}")
