"""The least heading error that the data of a study allow any method, in memory."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.covariance.information import heading_bound
from sinsjax.engine.build import ENVIRONMENT_KEYS, Scenario
from sinsjax.engine.sensor_inputs import read_motion
from sinsjax.errors import InputError
from sinsjax.execution.tables import table_of
from sinsjax.methods.floors import mean_attitude
from sinsjax.platform import runtime
from sinsjax.strapdown.base_motion import Motion
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.load import load_study
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.units import ARCMIN


def information_bound(study: Study | str | Path) -> pa.Table:
    """Information bound of a simulated study's heading, see `methods.information`.

    No unbiased method has a smaller standard deviation of phi_u from its bias floor than this,
    whatever it starts from; its methods' own settings do not enter. Variants that share Earth,
    motion and sensors share their bound; each takes about a second for 300 s at 100 Hz.

    Args:
        study: study, its file, or the name of a shipped study.

    Returns:
        One row per variant and time, `report_times_s` and the end of its run: the least 1 sigma of
        phi_u. The schema has units and meanings.

    Raises:
        InputError: a study of a record, with passes, or with draws of what decides the bound; or
            accelerometers without white noise.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.rate_hz": 10.0})
        >>> bound = sinsjax.information_bound(study)
        >>> [round(sigma, 2) for sigma in bound["bound_u_arcmin"].to_pylist()]
        [1.17, 1.17, 1.17]
    """
    runtime.ensure_configured()
    study = load_study(study)
    _require_bounded(study)
    scenario, ends = Scenario(study), study.spans_s[:, 0]
    swept = [key for key in study.axis_keys if key in ENVIRONMENT_KEYS]
    codes = study.resolved.column(*swept).codes if swept else np.zeros(study.n_variants, int)
    found: dict[tuple[int, float], dict[float, float]] = {}
    rows: list[tuple[int, float, float]] = []
    for number, ids in enumerate(scenario.variant_ids):
        for variant in ids:
            key = int(codes[variant]), float(ends[variant])
            if key not in found:
                times = sorted({*(t for t in study.report_times_s if t < key[1]), key[1]})
                found[key] = dict(zip(times, _bound(scenario, number, times), strict=True))
            rows += [(int(variant), time, sigma) for time, sigma in found[key].items()]
    names = (c.name for c in columns.INFORMATION_BOUND)
    values = zip(names, (np.array(one) for one in zip(*sorted(rows), strict=True)), strict=True)
    return table_of(columns.INFORMATION_BOUND, dict(values))


def _bound(scenario: Scenario, number: int, times_s: Sequence[float]) -> np.ndarray:
    """Of the variants of a part, arcmin."""
    study = scenario.study
    environment = scenario.part(number, range(1), blank=True).group.environment
    if not np.all(environment.errors.accel_noise):
        raise InputError("[sensors] accel_noise_ug: the information bound needs white noise")
    motion = read_motion(Variants(study, scenario.variant_ids[number]).common)
    pitch, roll, yaw = (s._replace(amplitude=0.0 * s.amplitude) for s in motion.angles)
    still = Motion(pitch, roll, yaw)
    sigma = heading_bound(
        times_s,
        place=environment.site.place,
        errors=environment.errors,
        disturbances=environment.disturbances,
        dt=1 / study.rate_hz,
        to_n=np.asarray(mean_attitude(still)),
    )
    return sigma / ARCMIN


def _require_bounded(study: Study) -> None:
    """Refuses what the bound is not known of."""
    if study.is_recorded:
        raise InputError("[record]: the information bound needs the noise of a simulation")
    if study.passes:
        text = "repeated passes add no information (take [passes] out, give the record's length)"
        raise InputError(f"[passes]: {text}")
    for key in study.drawn_keys:
        if key in ENVIRONMENT_KEYS:
            text = "the information bound takes its value as given (sweep it instead)"
            raise InputError(f"[{SECTION_OF[key]}] {key}: {text}")
