"""Which runs of a study have the bias floor that `limits` gives, and which cannot find north."""

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from sinsjax.engine.simulator import errors_of, motion_of
from sinsjax.errors import InputError
from sinsjax.methods.filters.section import OF_RESETS, times_of_resets
from sinsjax.methods.limits import mean_attitude
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import earth
from sinsjax.study import sampling
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.schema import MotionSection
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.units import ARCMIN, DEG, DEG_PER_H

LEAST_PERIODS = 10
"""Periods of a sway since the last reset without which a bias is not averaged."""

MOST_SHARED = 5 * ARCMIN
"""Of one sigma of heading: what a filter may take for gyro bias and still have the floor, rad."""

_LOOKED_AT = 4096  # draws, of a study with more
_BLOCK = 256  # draws averaged at a time: some 10 MB
_ANGLES = ("pitch", "roll", "yaw")
_BIASES = ("gyro_bias_deg_per_h", "accel_bias_ug")
_EARTH = ("earth", "latitude_deg", "earth_rate_deg_per_h")


class HiddenNorth(NamedTuple):
    """The run whose level gyro bias exceeds the north component of the Earth rate by most.

    Attributes:
        bias_deg_per_h: its level gyro bias, averaged over the motion.
        rate_deg_per_h: Omega cos L.
        runs: how many runs have a bias above theirs.
        of_runs: how many were looked at: all, or those of the first 4,096 draws.
    """

    bias_deg_per_h: float
    rate_deg_per_h: float
    runs: int
    of_runs: int

    def __str__(self) -> str:
        """A warning in one sentence."""
        return (
            f"the level gyro bias is up to {self.bias_deg_per_h:.3g} deg/h, the level part of the"
            f" Earth rate {self.rate_deg_per_h:.3g} deg/h: {self.runs:,} of {self.of_runs:,} runs"
            " cannot find north (status no_north)"
        )


def has_floor(
    study: Study, draw_ids: np.ndarray, variant_ids: np.ndarray, last_reset_s: np.ndarray
) -> np.ndarray:
    """Whether runs have a bias floor at all, (runs,) bool.

    Biases that a sway turns need `LEAST_PERIODS` of it since the last reset (and in the stored
    record, if passes repeat). A filter with gyro bias states tells them from the heading once the
    base moves; on a still one it cannot, and has the bias floor of one without as far as its P0,
    and what P is reset to, leave the east bias to the heading: see `MOST_SHARED`. Some methods have
    none. Runs of a recorded study, whose reference is their bias floor, all have one.

    Args:
        study: checked study.
        draw_ids: (runs,).
        variant_ids: (runs,).
        last_reset_s: (runs,) time of the last reset, s from the start of the run; 0 for none.
    """
    if study.is_recorded:
        return np.ones(np.shape(variant_ids), bool)
    runs = _Runs(study, np.asarray(draw_ids), np.asarray(variant_ids))
    amplitudes, periods = (
        np.stack([runs.numbers(f"{angle}_{what}") for angle in _ANGLES])
        for what in ("amplitude_deg", "period_s")
    )
    biased = np.stack([runs.vectors(key).any(-1) for key in _BIASES]).any(0)
    length, pass_s = study.spans_s[runs.variant_ids].T
    averaged_over = np.minimum(length - last_reset_s, pass_s) * (1 + 1e-9)
    slow = (amplitudes != 0) & (LEAST_PERIODS * periods > averaged_over)
    still = ~(amplitudes != 0).any(0)
    names, found = runs.raw("method"), ~(biased & slow.any(0))
    for name in study.methods:
        method = METHODS[name]
        if method.gyro_bias_keys:
            apart = still & (_shared(study, runs, method.gyro_bias_keys) <= MOST_SHARED)
            found = np.where(names == name, apart, found)
        found &= method.has_floor | (names != name)
    return found


def scheduled_last_s(study: Study) -> np.ndarray:
    """(variants,) time of the last reset of every schedule, s; 0 for none."""
    if not study.has("resets"):
        return np.zeros(study.n_variants)
    values = study.resolved.column(*OF_RESETS)
    return values.each(lambda own: max(times_of_resets(study.rate_hz, *own), default=0.0))


def limited_variants(study: Study) -> np.ndarray:
    """(variants,) which have a bias floor, where that depends neither on draws nor on triggers."""
    variants = np.arange(study.n_variants)
    return has_floor(study, np.zeros_like(variants), variants, scheduled_last_s(study))


def require_floor(study: Study) -> None:
    """Refuses a study that is judged from a bias floor where some run has none.

    The resets of a trigger are not known yet; draws that differ are looked at where they are few.

    Raises:
        InputError: it names the method.
    """
    if success_criteria(study).from_truth:
        return
    draws = np.arange(min(study.n_draws, 1 + _LOOKED_AT // study.n_variants))
    variants = np.tile(np.arange(study.n_variants), len(draws))
    last_s = scheduled_last_s(study)[variants]
    found = has_floor(study, np.repeat(draws, study.n_variants), variants, last_s)
    if found.all():
        return
    variant = int(variants[~found][0])
    method = study.values("method")[variant]
    why = "has no bias floor on this base"
    if METHODS[method].has_floor and not METHODS[method].gyro_bias_keys:
        why = (
            "has no bias floor where a sway period exceeds a tenth of the time since the last reset"
        )
    raise InputError(
        f"{study.name}: [study] judged_from: 'floor' cannot be judged: method '{method}'"
        f" {why} (variant {variant}; use 'truth')"
    )


def _shared(study: Study, runs: "_Runs", pairs: tuple[tuple[str, str], ...]) -> np.ndarray:
    """Of one sigma of heading, what a filter takes for east gyro bias, (runs,), rad.

    Heading and east bias are seen only as their sum, omega_N phi_U + eps_E, and the least squares
    of that split it by their variances.

    Args:
        study: checked study.
        runs: whose.
        pairs: keys of the sigmas of gyro bias and heading: at the start, then at a reset.
    """
    models = study.resolved.column("earth", "earth_rate_deg_per_h")
    rates = models.each(lambda values: _earth_rate(*values))
    rate_n = rates[runs.variant_ids] * np.cos(runs.numbers("latitude_deg") * DEG)
    most = np.zeros(len(rate_n))
    start: list[np.ndarray] = []
    for keys in (pair for pair in pairs if study.has(SECTION_OF[pair[0]])):
        own = [np.asarray(runs.raw(key), dtype=float) for key in keys]
        start = start or own  # what P is reset to is as at the start where it is not told
        bias, yaw = (np.where(np.isnan(a), b, a) for a, b in zip(own, start, strict=True))
        ratio = (bias * DEG_PER_H / (rate_n * yaw * DEG)) ** 2
        most = np.maximum(most, yaw * DEG * ratio / (1 + ratio))
    return most


def _earth_rate(model: str, rate_deg_per_h: float | None) -> float:
    """Of an Earth model as a study names it, rad/s."""
    return earth.WGS84_RATE if model == "wgs84" else (rate_deg_per_h or 0.0) * DEG_PER_H


class _Runs:
    """Values of keys, one a run."""

    def __init__(self, study: Study, draw_ids: np.ndarray, variant_ids: np.ndarray) -> None:
        self.variant_ids = variant_ids
        self._study = study
        first, last = (int(f(draw_ids, initial=0)) for f in (np.min, np.max))
        self._drawn = sampling.drawn_values(study, last + 1 - first, first=first)
        self._draws = draw_ids - first

    def raw(self, key: str) -> np.ndarray:
        """Of a key that is not drawn, None being NaN where others are numbers."""
        codes, choices = self._study.resolved.column(key)
        return np.asarray(choices)[codes[self.variant_ids]]

    def numbers(self, key: str) -> np.ndarray:
        """Of a key that has one number."""
        if key in self._drawn:
            return self._drawn[key][self._draws]
        return np.asarray(self.raw(key), dtype=float)

    def vectors(self, key: str) -> np.ndarray:
        """Of a key that has a number an axis, or one for all, (runs, 3)."""
        if key in self._drawn:
            return self._drawn[key][self._draws]
        column = self._study.resolved.column(key)
        return column.each(lambda value: np.broadcast_to(value, 3))[self.variant_ids]


def hidden_north(study: Study) -> HiddenNorth | None:
    """The worst run whose level gyro bias exceeds Omega cos L, None if there is no such run.

    Such a run cannot find north: what its gyros feel points anywhere. The gyro biases are averaged
    over the motion, as in its bias floor.

    Args:
        study: checked study; of a recorded one the biases are not known.
    """
    if study.is_recorded:
        return None
    keys = ("gyro_bias_deg_per_h", *MotionSection.model_fields, *_EARTH)
    drawn = sampling.drawn_values(study, min(study.n_draws, _LOOKED_AT))
    drawn = {key: values for key, values in drawn.items() if key in keys}
    draws = min(study.n_draws, _LOOKED_AT)
    swept = [key for key in study.axis_keys if key in keys]
    variants = Counter(zip(*map(study.values, swept), strict=True)) if swept else Counter([()])
    each = 1 if swept else study.n_variants
    worst, runs = None, 0
    for point in study.combinations(*keys):
        count = each * variants[tuple(point[key] for key in swept)]
        biases, rates = _level_bias({**point, **drawn}, draws if drawn else 1)
        hidden = biases > rates
        runs += count * int(hidden.sum()) * (draws // len(hidden))
        at = int(np.argmax(biases / rates))
        found = float(biases[at]), float(rates[at])
        if hidden[at] and (worst is None or found[0] / found[1] > worst[0] / worst[1]):
            worst = found
    if worst is None:
        return None
    bias, rate = (x / DEG_PER_H for x in worst)
    return HiddenNorth(bias, rate, runs, draws * study.n_variants)


def _level_bias(values: Mapping[str, Any], draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Level gyro bias and Omega cos L at a point of a sweep, rad/s, (draws,).

    Where the whole bias is below Omega cos L it stands for its level part.
    """
    shape = (draws,)
    rate = _earth_rate(values["earth"], values["earth_rate_deg_per_h"])
    rate_n = rate * np.cos(np.asarray(values["latitude_deg"], float) * DEG)
    bias = errors_of(values.get, 1.0, 1.0).gyro_bias
    rate_n, level = (np.broadcast_to(a, shape) for a in (rate_n, np.linalg.norm(bias, axis=-1)))
    level = level.copy()
    doubtful = np.flatnonzero(level > rate_n)
    bias = np.broadcast_to(bias, (*shape, 3))
    motion = jax.tree.map(lambda a: np.broadcast_to(a, shape), motion_of(values.get))
    for block in np.split(doubtful, range(_BLOCK, len(doubtful), _BLOCK)):
        here = jax.tree.map(lambda a, block=block: a[block], motion)
        turned = (mean_attitude(here) @ bias[block][..., None])[..., 0]
        level[block] = np.hypot(turned[:, 0], turned[:, 1])
    return level, rate_n
