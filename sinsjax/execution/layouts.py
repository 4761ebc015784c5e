"""Columns of a study's results."""

from collections.abc import Iterable
from typing import Literal, NamedTuple

import pyarrow as pa

from sinsjax import columns
from sinsjax.alignment.description import OwnColumn
from sinsjax.alignment.methods import METHODS
from sinsjax.columns import Column
from sinsjax.study.distributions import BIASES, NUMBERS_DRAWN
from sinsjax.study.keys import meaning
from sinsjax.study.resolved import Coded, same
from sinsjax.study.study import Study
from sinsjax.study.success import bands
from sinsjax.study.times import report_times


def summary(study: Study) -> tuple[Column, ...]:
    """Columns of the summary: those of runs, and of their companions where they have any."""
    return (*of_runs(study), *(of_companions(study) if study.is_controlled else ()))


def of_runs(study: Study) -> tuple[Column, ...]:
    """Columns of runs; the cost is proportional to the total length of the axes."""
    return (
        *columns.IDENTITY,
        *_of_keys(study),
        *columns.OBSERVED,
        *_settling(study),
        *(column for t in report_times(study) for column in columns.report_columns(t)),
        *columns.JUDGED,
        *(own.column for own in of_methods(study).values()),
    )


def of_companions(study: Study) -> tuple[Column, ...]:
    """Columns of the companions of runs: misalignment about up and settling times."""
    (at_the_end,) = (c for c in columns.OBSERVED if c.name == "phi_u_arcmin")
    at_times = (columns.report_columns(time_s)[0] for time_s in report_times(study))
    return tuple(map(columns.companion, (*at_times, at_the_end, *_settling(study))))


def draws_limits(study: Study) -> bool:
    """Whether draws have biases of their own, and limits with them."""
    return any(key in study.drawn_keys for key in BIASES)


def estimates(study: Study) -> tuple[Column, ...]:
    """Columns of the estimates."""
    of_runs = ("run_id", "draw_id", "start_s")
    times: list[float | None] = [*report_times(study), None]
    return (
        *(column for column in columns.IDENTITY if column.name not in of_runs),
        *_of_keys(study),
        *(
            c
            for time_s in times
            for c in columns.estimated(bands(study), time_s, own_limits=draws_limits(study))
        ),
        *(
            c
            for truth in (False, True)
            for band in bands(study)
            for c in columns.settle_estimates(band, truth=truth)
        ),
        *columns.LIMIT,
        *((columns.DRAWS,) if study.is_controlled else ()),
        *(c for one in controlled(study) for c in one.columns),
        *(map(columns.nonlinearity, times) if study.checks_linearity else ()),
        *((columns.FILLED,) if study.checks_linearity else ()),
    )


class Statistic(NamedTuple):
    """What is estimated from draws and their companions.

    Attributes:
        kind: mean settling time, share within a band, or rms heading error.
        truth: whether from the truth, else from the limit.
        band_arcmin: of the heading; None for an rms.
        time_s: from the first sample of data; None for the end.
    """

    kind: Literal["settle", "within", "rms"]
    truth: bool
    band_arcmin: float | None = None
    time_s: float | None = None

    @property
    def at(self) -> str:
        """The end of names of columns of its time."""
        return "" if self.time_s is None else f"_at_{self.time_s:g}"

    @property
    def column(self) -> str:
        """Of the summary: the settling time that its mean is of."""
        assert self.band_arcmin is not None
        return columns.settle_column(self.band_arcmin, truth=self.truth).name

    @property
    def settled(self) -> str:
        """The same without its unit, which names of statistics begin with."""
        return self.column.removesuffix("_s")

    @property
    def columns(self) -> tuple[Column, ...]:
        """Plain and controlled estimate, and the factor saved."""
        side, when = "_truth" if self.truth else "", self.at.replace("_at_", " at ")
        error = "|phi_u|" if self.truth else "|phi_u - floor|"
        if self.kind == "settle":
            text = f"mean of {self.settled}_s, never counted as the end of the run"
            return columns.controlled(f"{self.settled}_mean", "s", text)
        if self.kind == "within":
            text = f"share of runs with {error} <= {self.band_arcmin:g} arcmin{when}"
            return columns.controlled(f"within_{self.band_arcmin:g}{side}{self.at}", "share", text)
        return columns.controlled(f"error_rms{side}{self.at}", "arcmin", f"rms of {error}{when}")


def controlled(study: Study) -> tuple[Statistic, ...]:
    """The statistics that companions control; none where a study has no companions."""
    if not study.is_controlled:
        return ()
    times: list[float | None] = [*report_times(study), None]
    sides, wide = (False, True), bands(study)
    return (
        *(Statistic("settle", truth, band) for truth in sides for band in wide),
        *(Statistic("within", s, b, time_s) for time_s in times for s in sides for b in wide),
        *(Statistic("rms", truth, None, time_s) for time_s in times for truth in sides),
    )


def of_variants(study: Study, layout: Iterable[Column]) -> dict[str, pa.Array]:
    """What the study says of its variants, in the types of some columns; leaves (variants,)."""
    resets, cycle = study.schedules, same(study.n_variants, None)
    if study.has("resets"):
        cycle = study.resolved.column("reset_cycle_s")
    fixed = {
        "method": study.resolved.column("method"),
        "reset_count": resets.map(len),
        "reset_cycle_s": cycle,
        "reset_times_s": resets.map(list),
        **{(key := f"phi_{a}0_deg"): study.resolved.column(key) for a in "enu"},
    }
    swept = {key: study.resolved.column(key) for key in study.axis_keys}
    kinds = {c.name: c.dtype for c in layout}
    return {
        name: _coded(column, kinds[name])
        for name, column in (swept | fixed).items()
        if name not in study.drawn_keys
    }


def _coded(column: Coded, dtype: pa.DataType) -> pa.Array:
    """Values of a key, one per variant; a number among lists applies to all axes."""
    codes, choices = column
    if pa.types.is_list(dtype):
        choices = tuple([v] if isinstance(v, int | float) else v for v in choices)
    return pa.array(choices, dtype).take(pa.array(codes))


def _of_keys(study: Study) -> list[Column]:
    """Columns of swept and of drawn keys that are not among those of every study."""
    known = {c.name for c in columns.IDENTITY}
    swept = {key: values for dimension in study.dimensions for key, values in dimension.items()}
    return [
        *(columns.axis_column(k, v, meaning(k)) for k, v in swept.items() if k not in known),
        *(
            columns.drawn_column(k, 1 if NUMBERS_DRAWN[k] == 1 else 2, meaning(k))
            for k in study.drawn_keys
            if k not in known
        ),
    ]


def of_methods(study: Study) -> dict[str, OwnColumn]:
    """Columns specific to the study's methods, by name; methods may share a column."""
    methods = (method for name, method in METHODS.items() if name in study.methods)
    return {own.column.name: own for method in methods for own in method.columns_of(study)}


def curves(study: Study) -> tuple[Column, ...]:
    """Columns of the curves."""
    return columns.curves(passes=study.passes is not None, coarse=bool(study.coarse_stages))


def tells_data(study: Study) -> bool:
    """Whether the length of data stands beside settling times."""
    return bool(study.passes or study.coarse_stages)


def _settling(study: Study) -> list[Column]:
    """Settling times of all bands about the limit and the truth; then the data used until then."""
    kinds = [columns.settle_column, *([columns.settle_data_column] * tells_data(study))]
    return [kind(b, truth=t) for kind in kinds for t in (False, True) for b in bands(study)]
