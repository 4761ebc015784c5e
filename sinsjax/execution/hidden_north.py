"""Whether the gyro biases of a study's runs hide the rotation of the Earth, and so north."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from sinsjax.engine.scenario import earth_rate, read_errors, read_sways
from sinsjax.methods.floors import mean_attitude
from sinsjax.study import sampling
from sinsjax.study.schema import MotionSection
from sinsjax.study.study import Study
from sinsjax.units import DEG, DEG_PER_H

_MOST_DRAWS = 4096  # draws, of a study with more
_BLOCK = 256  # draws averaged at a time: some 10 MB


def hidden_north(study: Study) -> str | None:
    """Return a warning if the level gyro bias of some runs exceeds Omega cos L, None if none does.

    Such a run cannot find north, since the measured rate may point anywhere. The gyro biases are
    averaged over the motion, as in its bias floor; turns average them out. Of many draws the first
    4,096 are examined.

    Args:
        study: checked study; the biases of a recorded one are unknown.
    """
    if study.is_recorded:
        return None
    earth_keys = ("earth", "latitude_deg", "earth_rate_deg_per_h")
    keys = ("gyro_bias_deg_per_h", *MotionSection.model_fields, *earth_keys)
    draws = min(study.n_draws, _MOST_DRAWS)
    drawn = sampling.drawn_values(study, draws)
    drawn = {key: values for key, values in drawn.items() if key in keys}
    codes, points = study.coded(*keys)
    worst, runs = (0.0, 0.0, 0.0), 0  # ratio, bias and rate; deg/h
    for values, count in zip(points, np.bincount(codes, minlength=len(points)), strict=True):
        point = dict(zip(keys, values, strict=True)) | drawn
        if point["turn_times_s"] or point["attitude_file"]:
            continue
        n = draws if drawn else 1
        rate = earth_rate(point["earth"], point["earth_rate_deg_per_h"]) / DEG_PER_H
        rates = np.broadcast_to(rate * np.cos(np.asarray(point["latitude_deg"], float) * DEG), n)
        biases = _level_bias(point, n, rates)
        hidden = biases > rates
        runs += int(count) * int(hidden.sum()) * (draws // n)
        at = int(np.argmax(biases / rates))
        if hidden[at]:
            worst = max(worst, (biases[at] / rates[at], float(biases[at]), float(rates[at])))
    if not runs:
        return None
    return (
        f"the level gyro bias is up to {worst[1]:.3g} deg/h, the level part of the Earth rate"
        f" {worst[2]:.3g} deg/h: {runs:,} of {draws * study.n_variants:,} runs cannot find north"
        " (status no_north)"
    )


def _level_bias(values: Mapping[str, Any], draws: int, rates: np.ndarray) -> np.ndarray:
    """Return the level gyro bias of some draws at a point of a sweep, (draws,), deg/h.

    A bias that is below the rate as a whole is returned in place of its level part.
    """
    gyro_bias = read_errors(values.get, 1.0, 1.0).gyro_bias / DEG_PER_H
    bias = np.broadcast_to(gyro_bias, (draws, 3))
    level = np.linalg.norm(bias, axis=-1)
    motion = jax.tree.map(lambda a: np.broadcast_to(a, draws), read_sways(values.get))
    doubtful = np.flatnonzero(level > rates)
    for block in np.split(doubtful, range(_BLOCK, len(doubtful), _BLOCK)):
        here = jax.tree.map(lambda a, block=block: a[block], motion)
        turned = (mean_attitude(here) @ bias[block][..., None])[..., 0]
        level[block] = np.hypot(turned[:, 0], turned[:, 1])
    return level
