"""Which runs of a study have the bias floor of `methods.floors`, and which cannot find north."""

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from sinsjax.engine.sensor_inputs import read_errors, read_sways
from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import RESET_KEYS, acting_reset_times
from sinsjax.methods.floors import mean_attitude
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import earth
from sinsjax.study import sampling
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.schema import MotionSection
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.units import ARCMIN, DEG, DEG_PER_H

LEAST_PERIODS = 10
"""Sway periods since the last reset that are needed to average a bias."""

MOST_SHARED = 5 * ARCMIN
"""Largest part of one sigma of heading taken for gyro bias with which the floor holds, rad."""

_MOST_DRAWS = 4096  # draws, of a study with more
_BLOCK = 256  # draws averaged at a time: some 10 MB
_ANGLES = ("pitch", "roll", "yaw")
_BIASES = ("gyro_bias_deg_per_h", "accel_bias_ug")
_EARTH = ("earth", "latitude_deg", "earth_rate_deg_per_h")


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


def has_floor(
    study: Study, draw_ids: np.ndarray, variant_ids: np.ndarray, last_reset_s: np.ndarray
) -> np.ndarray:
    """Return whether runs have a bias floor, (runs,) bool.

    Biases rotated by a sway need `LEAST_PERIODS` of it since the last reset (and in the stored
    record, if passes repeat). A filter with gyro bias states distinguishes them from the heading
    once the base moves. On a still base it cannot, and has the bias floor of a filter without them
    if P0, and the P of a reset, attribute the east bias to the heading: see `MOST_SHARED`. Some
    methods have no floor, and no run has one whose base is turned. Runs of a recorded study, whose
    reference is their floor, all have one.

    Args:
        study: checked study.
        draw_ids: (runs,).
        variant_ids: (runs,).
        last_reset_s: (runs,) time of the last reset, s from the start of the run; 0 for none.
    """
    if study.is_recorded:
        return np.ones(np.shape(variant_ids), bool)
    runs = _RunKeys(study, np.asarray(draw_ids), np.asarray(variant_ids))
    amplitudes, periods = (
        np.stack([runs.numbers(f"{angle}_{what}") for angle in _ANGLES])
        for what in ("amplitude_deg", "period_s")
    )
    biased = np.stack([runs.vectors(key).any(-1) for key in _BIASES]).any(0)
    length, pass_s = study.spans_s[runs.variant_ids].T
    averaged_over = np.minimum(length - last_reset_s, pass_s) * (1 + 1e-9)
    slow = (amplitudes != 0) & (LEAST_PERIODS * periods > averaged_over)
    still = ~(amplitudes != 0).any(0)
    names, floors = runs.raw("method"), ~(biased & slow.any(0))
    for name in study.methods:
        method = METHODS[name]
        if method.gyro_bias_keys:
            shared = _sigma_shared_with_bias(study, runs, method.gyro_bias_keys)
            floors = np.where(names == name, still & (shared <= MOST_SHARED), floors)
        floors &= method.has_floor | (names != name)
    return floors & ~runs.turned


def last_scheduled_reset_s(study: Study) -> np.ndarray:
    """Return the time of the last reset of each variant's schedule, (variants,), s; 0 for none."""
    if not study.has("resets"):
        return np.zeros(study.n_variants)
    values = study.resolved.column(*RESET_KEYS)
    return values.compute(lambda keys: max(acting_reset_times(study.rate_hz, *keys), default=0.0))


def variants_with_floor(study: Study) -> np.ndarray:
    """Return which variants have a bias floor, if no draw or trigger affects it, (variants,)."""
    variants = np.arange(study.n_variants)
    return has_floor(study, np.zeros_like(variants), variants, last_scheduled_reset_s(study))


def require_floor(study: Study) -> None:
    """Refuse a study that is judged from a bias floor if some run has none.

    The resets of a trigger are not known yet; draws that differ are examined if they are few.

    Raises:
        InputError: names the method.
    """
    if success_criteria(study).from_truth:
        return
    draws = np.arange(min(study.n_draws, 1 + _MOST_DRAWS // study.n_variants))
    variants = np.tile(np.arange(study.n_variants), len(draws))
    last_s = last_scheduled_reset_s(study)[variants]
    floors = has_floor(study, np.repeat(draws, study.n_variants), variants, last_s)
    if floors.all():
        return
    variant = int(variants[~floors][0])
    method = study.values("method")[variant]
    why = "has no bias floor on this base"
    if study.values("turn_times_s")[variant] or study.values("attitude_file")[variant]:
        why = "has no bias floor on a base that is turned"
    elif METHODS[method].has_floor and not METHODS[method].gyro_bias_keys:
        why = (
            "has no bias floor where a sway period exceeds a tenth of the time since the last reset"
        )
    raise InputError(
        f"{study.name}: [study] judged_from: 'floor' cannot be judged: method '{method}'"
        f" {why} (variant {variant}; use 'truth')"
    )


def _sigma_shared_with_bias(
    study: Study, runs: "_RunKeys", pairs: tuple[tuple[str, str], ...]
) -> np.ndarray:
    """Return the part of one sigma of heading that a filter takes for east gyro bias, (runs,), rad.

    Heading and east bias are observed only as their sum, omega_N phi_U + eps_E, which least squares
    splits by their variances.

    Args:
        study: checked study.
        runs: values of their keys.
        pairs: keys of the sigmas of gyro bias and heading: at the start, then at a reset.
    """
    models = study.resolved.column("earth", "earth_rate_deg_per_h")
    rates = models.compute(lambda values: _earth_rate(*values))
    rate_n = rates[runs.variant_ids] * np.cos(runs.numbers("latitude_deg") * DEG)
    most = np.zeros(len(rate_n))
    start: list[np.ndarray] = []
    for keys in (pair for pair in pairs if study.has(SECTION_OF[pair[0]])):
        sigmas = [np.asarray(runs.raw(key), dtype=float) for key in keys]
        start = start or sigmas  # left out, a reset sets P as at the start
        bias, yaw = (np.where(np.isnan(a), b, a) for a, b in zip(sigmas, start, strict=True))
        ratio = (bias * DEG_PER_H / (rate_n * yaw * DEG)) ** 2
        most = np.maximum(most, yaw * DEG * ratio / (1 + ratio))
    return most


def _earth_rate(model: str, rate_deg_per_h: float | None) -> float:
    """Return the rate of an Earth model by its name in a study, rad/s."""
    return earth.WGS84_RATE if model == "wgs84" else (rate_deg_per_h or 0.0) * DEG_PER_H


class _RunKeys:
    """Values of keys, one per run."""

    def __init__(self, study: Study, draw_ids: np.ndarray, variant_ids: np.ndarray) -> None:
        self.variant_ids = variant_ids
        self._study = study
        first, last = (int(f(draw_ids, initial=0)) for f in (np.min, np.max))
        self._drawn = sampling.drawn_values(study, last + 1 - first, first=first)
        self._draws = draw_ids - first

    def raw(self, key: str) -> np.ndarray:
        """Return a key that is not drawn; None is NaN among numbers."""
        codes, choices = self._study.resolved.column(key)
        return np.asarray(choices)[codes[self.variant_ids]]

    def numbers(self, key: str) -> np.ndarray:
        """Return a key with one number, (runs,)."""
        if key in self._drawn:
            return self._drawn[key][self._draws]
        return np.asarray(self.raw(key), dtype=float)

    @property
    def turned(self) -> np.ndarray:
        """Whether the base is turned, or its attitude is that of a file, (runs,)."""
        column = self._study.resolved.column("turn_times_s", "attitude_file")
        return column.compute(any, bool)[self.variant_ids]

    def vectors(self, key: str) -> np.ndarray:
        """Return a key with a number per axis, or one for all, (runs, 3)."""
        if key in self._drawn:
            return self._drawn[key][self._draws]
        column = self._study.resolved.column(key)
        return column.compute(lambda value: np.broadcast_to(value, 3))[self.variant_ids]


def hidden_north(study: Study) -> HiddenNorth | None:
    """Return the worst run whose level gyro bias exceeds Omega cos L, None if there is none.

    Such a run cannot find north, since the measured rate may point anywhere. The gyro biases are
    averaged over the motion, as in its bias floor.

    Args:
        study: checked study; the biases of a recorded one are unknown.
    """
    if study.is_recorded:
        return None
    keys = ("gyro_bias_deg_per_h", *MotionSection.model_fields, *_EARTH)
    drawn = sampling.drawn_values(study, min(study.n_draws, _MOST_DRAWS))
    drawn = {key: values for key, values in drawn.items() if key in keys}
    draws = min(study.n_draws, _MOST_DRAWS)
    swept = [key for key in study.axis_keys if key in keys]
    variants = Counter(zip(*map(study.values, swept), strict=True)) if swept else Counter([()])
    variants_per_point = 1 if swept else study.n_variants
    worst, runs = None, 0
    for point in study.combinations(*keys):
        if point["turn_times_s"] or point["attitude_file"]:
            continue  # turns average the bias out
        count = variants_per_point * variants[tuple(point[key] for key in swept)]
        biases, rates = _level_bias({**point, **drawn}, draws if drawn else 1)
        hidden = biases > rates
        runs += count * int(hidden.sum()) * (draws // len(hidden))
        at = int(np.argmax(biases / rates))
        case = float(biases[at]), float(rates[at])
        if hidden[at] and (worst is None or case[0] / case[1] > worst[0] / worst[1]):
            worst = case
    if worst is None:
        return None
    bias, rate = (x / DEG_PER_H for x in worst)
    return HiddenNorth(bias, rate, runs, draws * study.n_variants)


def _level_bias(values: Mapping[str, Any], draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Return level gyro bias and Omega cos L at a point of a sweep, rad/s, (draws,).

    A bias below Omega cos L as a whole is returned in place of its level part.
    """
    shape = (draws,)
    rate = _earth_rate(values["earth"], values["earth_rate_deg_per_h"])
    rate_n = rate * np.cos(np.asarray(values["latitude_deg"], float) * DEG)
    bias = read_errors(values.get, 1.0, 1.0).gyro_bias
    rate_n, level = (np.broadcast_to(a, shape) for a in (rate_n, np.linalg.norm(bias, axis=-1)))
    level = level.copy()
    doubtful = np.flatnonzero(level > rate_n)
    bias = np.broadcast_to(bias, (*shape, 3))
    motion = jax.tree.map(lambda a: np.broadcast_to(a, shape), read_sways(values.get))
    for block in np.split(doubtful, range(_BLOCK, len(doubtful), _BLOCK)):
        here = jax.tree.map(lambda a, block=block: a[block], motion)
        turned = (mean_attitude(here) @ bias[block][..., None])[..., 0]
        level[block] = np.hypot(turned[:, 0], turned[:, 1])
    return level, rate_n
