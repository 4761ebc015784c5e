"""Whether the gyro biases of a study's runs hide the rotation of the Earth, and so north."""

from collections.abc import Mapping
from typing import Any, NamedTuple

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


class HiddenNorth(NamedTuple):
    """The run whose level gyro bias most exceeds the north component of the Earth rate.

    Attributes:
        bias_deg_per_h: its level gyro bias, averaged over the motion.
        rate_deg_per_h: Omega cos L.
        runs: number of runs whose bias exceeds their rate.
        of_runs: number of runs examined: all, or those of the first 4,096 draws.
    """

    bias_deg_per_h: float
    rate_deg_per_h: float
    runs: int
    of_runs: int

    def __str__(self) -> str:
        """Return a warning in one sentence."""
        return (
            f"the level gyro bias is up to {self.bias_deg_per_h:.3g} deg/h, the level part of the"
            f" Earth rate {self.rate_deg_per_h:.3g} deg/h: {self.runs:,} of {self.of_runs:,} runs"
            " cannot find north (status no_north)"
        )


def hidden_north(study: Study) -> HiddenNorth | None:
    """Return the worst run whose level gyro bias exceeds Omega cos L, None if there is none.

    Such a run cannot find north, since the measured rate may point anywhere. The gyro biases are
    averaged over the motion, as in its bias floor; turns average them out.

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
    worst, runs = (0.0, 0.0, 0.0), 0
    for values, count in zip(points, np.bincount(codes, minlength=len(points)), strict=True):
        point = dict(zip(keys, values, strict=True)) | drawn
        if point["turn_times_s"] or point["attitude_file"]:
            continue
        biases, rates = _level_bias(point, draws if drawn else 1)
        hidden = biases > rates
        runs += int(count) * int(hidden.sum()) * (draws // len(hidden))
        at = int(np.argmax(biases / rates))
        if hidden[at]:
            worst = max(worst, (biases[at] / rates[at], float(biases[at]), float(rates[at])))
    bias, rate = (rad_per_s / DEG_PER_H for rad_per_s in worst[1:])
    return HiddenNorth(bias, rate, runs, draws * study.n_variants) if runs else None


class _Rates(NamedTuple):
    """Level gyro bias and Omega cos L of some draws, rad/s, (draws,)."""

    bias: np.ndarray
    north: np.ndarray


def _level_bias(values: Mapping[str, Any], draws: int) -> _Rates:
    """Return level gyro bias and Omega cos L at a point of a sweep.

    A bias below Omega cos L as a whole is returned in place of its level part.
    """
    rate = earth_rate(values["earth"], values["earth_rate_deg_per_h"])
    rate_n = np.broadcast_to(rate * np.cos(np.asarray(values["latitude_deg"], float) * DEG), draws)
    bias = np.broadcast_to(read_errors(values.get, 1.0, 1.0).gyro_bias, (draws, 3))
    level = np.linalg.norm(bias, axis=-1)
    motion = jax.tree.map(lambda a: np.broadcast_to(a, draws), read_sways(values.get))
    doubtful = np.flatnonzero(level > rate_n)
    for block in np.split(doubtful, range(_BLOCK, len(doubtful), _BLOCK)):
        here = jax.tree.map(lambda a, block=block: a[block], motion)
        turned = (mean_attitude(here) @ bias[block][..., None])[..., 0]
        level[block] = np.hypot(turned[:, 0], turned[:, 1])
    return _Rates(level, rate_n)
