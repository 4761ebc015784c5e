"""A study in which the filter's belief can be true: mean NEES against its chi-square band.

Only here a band is asserted. It needs a truth as the filter believes it: errors and velocities that
begin with the distribution of P0, white noise of the size of Q, no bias, errors so small that the
linear model is exact.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from scipy import special

from sinsjax import analysis
from sinsjax.analysis import Estimate, chi2_mean_band, format_estimate
from sinsjax.errors import InputError
from sinsjax.report.base import (
    Block,
    Report,
    Section,
    Source,
    Table,
    Text,
    name_of,
    percent,
    shown_keys,
)
from sinsjax.report.spreads import belief, consistency
from sinsjax.study.schema import SensorsSection
from sinsjax.study.study import Study

_STARTS = {  # an initial error, and the 1 sigma that the filter believes of it
    "phi_e0_deg": "p0_level_deg",
    "phi_n0_deg": "p0_level_deg",
    "phi_u0_deg": "p0_yaw_deg",
    "ve0_m_per_s": "p0_velocity_m_per_s",
    "vn0_m_per_s": "p0_velocity_m_per_s",
}
_NOISES = {"accel_noise_ug": "q_accel_ug", "gyro_noise_deg_per_h": "q_gyro_deg_per_h"}
_CHI2 = float(special.chdtri(analysis.NEES_FREEDOM, 1 - analysis.CONFIDENCE))
_COLUMNS = ("nees", "nis_u", "p_above_error_share", "p_above_floor_error_share")


class Checked(NamedTuple):
    """A variant against the chi-square bands of its belief.

    Attributes:
        name: of the variant.
        expected: whether its belief is true, so that it is expected in its bands.
        nees: mean over the draws.
        nees_band: 95 % band of that mean.
        nis_u: mean over the draws.
        nis_u_band: 95 % band of that mean.
        inside: share of runs with a NEES up to the 95 % quantile of chi-square.
        rows: its runs.
    """

    name: str
    expected: bool
    nees: Estimate
    nees_band: tuple[float, float]
    nis_u: Estimate
    nis_u_band: tuple[float, float]
    inside: Estimate
    rows: pa.Table

    @property
    def holds(self) -> bool:
        """Whether the mean NEES lies in its band."""
        low, high = self.nees_band
        return low <= self.nees.value <= high


def report(source: Source) -> Report:
    """Mean NEES and NIS of every variant in their bands or out, and the distribution of NEES."""
    checked = list(checked_of(source))
    if not any(one.expected for one in checked):
        name = source.study.name
        raise InputError(f"{name}: its layout needs a variant whose filter believes what is true")
    blocks: list[Block] = [
        _table(checked),
        Text(
            "*Belief true*: initial errors and velocities are drawn from P0, Q is the variance of"
            " the noise, and nothing is biased; errors are small enough for the linear model. In 95"
            " of 100 studies such as this one the mean of such a filter lies in its band, and 95 %"
            f" of its runs have a NEES up to {_CHI2:.2f}."
        ),
        consistency([belief(one.name, one.rows) for one in checked]),
    ]
    return Report(list(_headline(source, checked)), [Section("Consistency", blocks)])


def checked_of(source: Source) -> Iterator[Checked]:
    """Every variant of a study against its bands, in the study's order."""
    keys = shown_keys(source.study)
    true = belief_is_true(source.study)
    table = source.rows(["variant_id", *keys, *_COLUMNS])
    for key, rows in analysis.groups(table, ["variant_id", *keys]):
        nees, nis = (analysis.numbers(rows, column) for column in ("nees", "nis_u"))
        means = analysis.mean(nees), analysis.mean(nis)
        yield Checked(
            expected=true[key.pop("variant_id")],
            name=name_of(key),
            nees=means[0],
            nees_band=chi2_mean_band(analysis.NEES_FREEDOM, means[0].n),
            nis_u=means[1],
            nis_u_band=chi2_mean_band(1, means[1].n),
            inside=analysis.proportion(int(np.count_nonzero(nees <= _CHI2)), nees.size),
            rows=rows,
        )


def belief_is_true(study: Study) -> list[bool]:
    """Whether P0 and Q of each variant are those of its errors and noise, and nothing is biased."""
    laws = study.drawn.laws if study.drawn else {}
    # The distribution of each start as (mean, standard deviation).
    starts = {key: laws[key].normal if key in laws else None for key in _STARTS}
    if (
        study.sensors is None
        or not study.has("filter")
        or laws.keys() & SensorsSection.model_fields.keys()
    ):
        return [False] * study.n_variants
    if study.drawn and study.drawn.sampling != "random":  # draws that know of one another
        return [False] * study.n_variants
    pairs = [
        *((noise, study.values(believed)) for noise, believed in _NOISES.items()),
        *(
            (bias, [0.0] * study.n_variants)
            for bias in SensorsSection.model_fields
            if "noise" not in bias
        ),
    ]
    true = np.array([reading == "per_sample" for reading in study.values("q_reading")])
    true &= [method == "kalman5" for method in study.values("method")]
    true &= [not times for times in study.reset_times()]
    for key, sigma in _STARTS.items():
        true &= [starts[key] == (0.0, believed) for believed in study.values(sigma)]
    for key, believed in pairs:
        there = study.values(key)
        true &= [np.all(np.equal(x or 0.0, y)) for x, y in zip(there, believed, strict=True)]
    return [bool(one) for one in true]


def _table(checked: Sequence[Checked]) -> Table:
    rows = [
        [
            one.name,
            "true" if one.expected else "not true",
            *(
                cell
                for mean, band in ((one.nees, one.nees_band), (one.nis_u, one.nis_u_band))
                for cell in (format_estimate(mean, digits=2), _band(band), _verdict(mean, band))
            ),
            percent(one.inside),
        ]
        for one in checked
    ]
    header = ["variant", "belief", "NEES, mean", "its band", "lies"]
    header += ["NIS of phi_u, mean", "its band", "lies"]
    return Table(
        "Mean NEES and NIS against the 95 % band of a filter whose belief is true",
        [*header, "runs up to the 95 % quantile (%)"],
        rows,
        "Number [95 % interval over the draws]. NEES = phi' P^-1 phi at the end,"
        f" {analysis.NEES_FREEDOM} degrees of freedom; NIS of phi_u = (phi_u - floor)^2 / P_UU, 1:"
        " what a bias does to the floor is not in it.",
    )


def _band(band: tuple[float, float]) -> str:
    return f"{band[0]:.2f} to {band[1]:.2f}"


def _verdict(mean: Estimate, band: tuple[float, float]) -> str:
    if mean.value > band[1]:
        return "above"
    return "inside" if mean.value >= band[0] else "below"


def _headline(source: Source, checked: Sequence[Checked]) -> Iterator[str]:
    for one in checked:
        if one.expected:
            yield (
                f"{one.name}: over {source.draws:,} draws the mean NEES is {one.nees.value:.2f},"
                f" {_verdict(one.nees, one.nees_band)} its 95 % band of {_band(one.nees_band)};"
                f" {percent(one.inside)} % of the runs have a NEES up to the 95 % quantile."
            )
    if wrong := [one for one in checked if not one.expected]:
        outside = sum(not one.holds for one in wrong)
        yield (
            f"{len(wrong)} variants believe what is not true and are expected outside:"
            f" {outside} of them {'is' if outside == 1 else 'are'}."
        )
