"""The heading error to expect with a sheet's sensors, and what each source adds to it."""

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from sinsjax.advice.sheet import Sheet
from sinsjax.bounds.estimator import heading_variances
from sinsjax.bounds.information import HeadingProblem
from sinsjax.execution.information import budget_problem
from sinsjax.study.load import study_from_dict


class Source(NamedTuple):
    """A source of errors: its name in words, and its key."""

    words: str
    key: str


SOURCES = {
    "gyro_bias": Source("gyro turn-on bias", "gyro_bias_deg_per_h"),
    "accel_bias": Source("accelerometer turn-on bias", "accel_bias_ug"),
    "gyro_noise": Source("angle random walk", "gyro_arw_deg_per_sqrt_h"),
    "accel_noise": Source("velocity random walk", "accel_vrw_ug_per_sqrt_hz"),
    "gyro_instability": Source("gyro bias instability", "gyro_instability_deg_per_h"),
    "accel_instability": Source("accelerometer bias instability", "accel_instability_ug"),
    "gyro_walk": Source("gyro rate random walk", "gyro_rrw_deg_per_h_per_sqrt_h"),
    "accel_walk": Source("accelerometer random walk", "accel_rrw_ug_per_sqrt_h"),
    "gyro_quantisation": Source("gyro quantisation", "gyro_quantisation_arcsec"),
    "accel_quantisation": Source("accelerometer quantisation", "accel_quantisation_um_per_s"),
    "surge": Source("surge of the base", "surge_m_per_s"),
    "shaking": Source("vibration", "vibration_ug_rms"),
    "gyro_scale": Source("gyro scale factor", "gyro_scale_ppm"),
    "gyro_misalignment": Source("gyro axis misalignment", "gyro_misalignment_arcsec"),
    "accel_scale": Source("accelerometer scale factor", "accel_scale_ppm"),
    "accel_misalignment": Source("accelerometer axis misalignment", "accel_misalignment_arcsec"),
}
"""Sources of errors by their names in `heading_variances`."""

_TURN_ON = ("gyro_bias", "accel_bias")
_LEAST_SHARE = 1e-9
_CELLS = 4000
_RATE_HZ = 100.0


class Budget(NamedTuple):
    """Variance of the heading over time, by source, of a linear estimator.

    Attributes:
        times_s: (times,).
        sources: names of the sources, see `SOURCES`.
        variance: (times, sources), rad^2; linear theory.
    """

    times_s: np.ndarray
    sources: tuple[str, ...]
    variance: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(times,) 1 sigma of the sum, rad."""
        return np.sqrt(self.variance.sum(axis=1))

    @property
    def varying(self) -> np.ndarray:
        """(times,) 1 sigma of all but the turn-on biases, rad."""
        varying = [source not in _TURN_ON for source in self.sources]
        return np.sqrt(self.variance[:, varying].sum(axis=1))

    def shares(self, time_s: float) -> dict[str, float]:
        """Return the part of each source in the variance at a time, the largest first."""
        (row,) = self.variance[self.times_s == time_s]
        parts = dict(zip(self.sources, row / row.sum(), strict=True))
        return dict(sorted(parts.items(), key=lambda part: -part[1]))


def sheet_problem(sheet: Sheet) -> HeadingProblem:
    """Return the base and the sensors of a sheet.

    The bound does not depend on the rate of the data, but a round one makes whole steps.
    """
    drawn = {key: law for key, law in sheet.tables["drawn"].items() if key != "yaw_center_deg"}
    motion = {"yaw_center_deg": 0.0} | sheet.motion
    if "attitude_file" in motion:
        del motion["yaw_center_deg"]
    sections = {"alignment": {"method": "inertial"}, "motion": motion, "drawn": drawn}
    rate = _RATE_HZ * math.ceil(float(motion.get("vibration_hz", 0.0)) / _RATE_HZ * 3 or 1)
    settings = {"rate_hz": rate, "duration_s": max(sheet.times_s), "draws": 1}
    return budget_problem(study_from_dict(sheet.study_tables(sections, **settings), sheet.name))


def heading_budget(
    problem: HeadingProblem, times_s: Sequence[float], left_out: Collection[str] = ()
) -> Budget:
    """Return the budget of an estimator at some times, whole seconds, see `heading_variances`."""
    budget = heading_variances(times_s, problem, left_out)
    total = sum(budget.values())
    present = {name: part for name, part in budget.items() if np.any(part > _LEAST_SHARE * total)}
    return Budget(np.asarray(times_s), tuple(present), np.stack([*present.values()], axis=1))


def wrapped_rms(sigma: float) -> float:
    """Return the rms of a heading that a vector with noise shows, rad, of its linear 1 sigma.

    The data show the level part of the Earth rate with an error of ``sigma`` times its length along
    each of the two level axes. Small errors are ``sigma``; large ones tend to those of a heading
    about which nothing is known, 104 deg.
    """
    angles, density = _density(sigma)
    return float(np.sqrt(np.trapezoid(density * angles**2) / np.trapezoid(density)))


def wrapped_quantile(sigma: float, share: float) -> float:
    """Return the angle, rad, that a share of these headings stays within."""
    angles, density = _density(sigma)
    reached = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    return float(np.interp(share, reached / reached[-1], angles))


def _density(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return angles, and up to a factor the density of the direction of a vector with noise."""
    angles = np.linspace(0.0, min(math.pi, 10 * sigma), _CELLS + 1)
    length = 1 / sigma
    along = length * np.cos(angles)
    across = np.exp(-0.5 * (length * np.sin(angles)) ** 2)
    tail = math.exp(-0.5 * length**2)
    return angles, tail + math.sqrt(2 * math.pi) * along * special.ndtr(along) * across


def format_angle(arcmin: float) -> str:
    """Return an angle, arcmin, in degrees where it is large."""
    if arcmin < 100:
        return f"{arcmin:.1f}'" if arcmin < 20 else f"{arcmin:.0f}'"
    return f"{arcmin / 60:.1f} deg" if arcmin < 600 else f"{arcmin / 60:.0f} deg"
