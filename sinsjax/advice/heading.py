"""The heading error to expect with a sheet's sensors, and what each source adds to it."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from sinsjax.advice.method import accel_density, gyro_density
from sinsjax.advice.sheet import Sheet
from sinsjax.bounds.estimator import heading_variances
from sinsjax.bounds.information import HeadingProblem
from sinsjax.bounds.study_bound import budget_problem

SOURCES = {
    "gyro_bias": "gyro turn-on bias",
    "accel_bias": "accelerometer turn-on bias",
    "gyro_noise": "angle random walk",
    "accel_noise": "velocity random walk",
    "gyro_instability": "gyro bias instability",
    "accel_instability": "accelerometer bias instability",
    "gyro_walk": "gyro rate random walk",
    "accel_walk": "accelerometer random walk",
    "gyro_quantisation": "gyro quantisation",
    "accel_quantisation": "accelerometer quantisation",
    "surge": "surge of the base",
    "shaking": "vibration",
    "gyro_scale": "gyro scale factor",
    "gyro_misalignment": "gyro axis misalignment",
    "accel_scale": "accelerometer scale factor",
    "accel_misalignment": "accelerometer axis misalignment",
}
"""Sources of errors by their names in `heading_variances`."""

KEYS = {
    "gyro_bias": ("gyro_bias_deg_per_h",),
    "accel_bias": ("accel_bias_ug",),
    "gyro_noise": ("gyro_arw_deg_per_sqrt_h", "gyro_noise_deg_per_h"),
    "accel_noise": ("accel_vrw_ug_per_sqrt_hz", "accel_noise_ug"),
    "gyro_instability": ("gyro_instability_deg_per_h",),
    "accel_instability": ("accel_instability_ug",),
    "gyro_walk": ("gyro_rrw_deg_per_h_per_sqrt_h",),
    "accel_walk": ("accel_rrw_ug_per_sqrt_h",),
    "gyro_quantisation": ("gyro_quantisation_arcsec",),
    "accel_quantisation": ("accel_quantisation_um_per_s",),
    "surge": ("surge_m_per_s",),
    "shaking": ("vibration_ug_rms",),
    "gyro_scale": ("gyro_scale_ppm",),
    "gyro_misalignment": ("gyro_misalignment_arcsec",),
    "accel_scale": ("accel_scale_ppm",),
    "accel_misalignment": ("accel_misalignment_arcsec",),
}
"""Keys of each source."""

TURN_ON = ("gyro_bias", "accel_bias")
"""Sources that are constant in a run."""

_LEAST_SHARE = 1e-9
_CELLS = 4000
_RATE_HZ = 100.0


@dataclass(frozen=True)
class Budget:
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
        """(times,) 1 sigma of all but the `TURN_ON` biases, rad."""
        varying = [source not in TURN_ON for source in self.sources]
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
    tables = sheet.tables["drawn"]
    drawn = {key: table for key, table in tables.items() if key != "yaw_center_deg"}
    motion = {"yaw_center_deg": 0.0} | sheet.tables["motion"]
    if "attitude_file" in motion:
        del motion["yaw_center_deg"]
    sections = {"alignment": {"method": "inertial"}, "motion": motion, "drawn": drawn}
    sensors = dict(sheet.tables["sensors"])
    for key, density, of in (
        ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h", gyro_density),
        ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz", accel_density),
    ):
        if sensors.pop(key, None):
            sensors[density] = of(sheet)
    rate = _RATE_HZ * math.ceil(float(motion.get("vibration_hz", 0.0)) / _RATE_HZ * 3 or 1)
    settings = {"rate_hz": rate, "duration_s": max(sheet.times_s), "draws": 1, "report_times_s": []}
    return budget_problem(sheet.study(sections | {"sensors": sensors}, **settings))


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
    angles, reached = _distribution(sigma)
    return float(np.interp(share, reached, angles))


def share_beyond(sigma: float, angle: float) -> float:
    """Return the share of these headings that is off by more than an angle, rad."""
    angles, reached = _distribution(sigma)
    return float(1 - np.interp(angle, angles, reached))


def _distribution(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return angles and the share of the headings within them."""
    angles, density = _density(sigma)
    reached = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    return angles, reached / reached[-1]


def _density(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return angles, and up to a factor the density of the direction of a vector with noise."""
    angles = np.linspace(0.0, min(math.pi, 10 * sigma), _CELLS + 1)
    length = 1 / sigma
    along = length * np.cos(angles)
    across = np.exp(-0.5 * (length * np.sin(angles)) ** 2)
    tail = math.exp(-0.5 * length**2)
    return angles, tail + math.sqrt(2 * math.pi) * along * special.ndtr(along) * across
