"""Columns of a study's results."""

from collections.abc import Iterable

import pyarrow as pa

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.methods.description import OwnColumn
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import meaning
from sinsjax.study.resolved import Coded, constant_column
from sinsjax.study.schema import BIAS_KEYS, NUMBERS_DRAWN
from sinsjax.study.study import Study
from sinsjax.study.success import bands


def summary(study: Study) -> tuple[Column, ...]:
    """Columns of the summary; the cost is proportional to the total length of the axes."""
    return (
        *columns.IDENTITY,
        *_of_keys(study),
        *columns.OBSERVED,
        *_settling(study),
        *(column for t in study.report_times_s for column in columns.report_time_columns(t)),
        *columns.JUDGED,
        *(own.column for own in of_methods(study).values()),
    )


def draws_limits(study: Study) -> bool:
    """Whether draws have biases of their own, and bias floors with them."""
    return any(key in study.drawn_keys for key in BIAS_KEYS)


def estimates(study: Study) -> tuple[Column, ...]:
    """Columns of the estimates."""
    of_runs = ("run_id", "draw_id", "start_s")
    times: list[float | None] = [*study.report_times_s, None]
    return (
        *(column for column in columns.IDENTITY if column.name not in of_runs),
        *_of_keys(study),
        *(
            c
            for time_s in times
            for c in columns.estimate_columns(bands(study), time_s, floors_vary=draws_limits(study))
        ),
        *(
            c
            for truth in (False, True)
            for band in bands(study)
            for c in columns.settle_estimate_columns(band, truth=truth)
        ),
        *columns.FLOOR,
        *(map(columns.nonlinearity_column, times) if study.checks_linearity else ()),
        *((columns.FILLED,) if study.checks_linearity else ()),
    )


def of_variants(study: Study, layout: Iterable[Column]) -> dict[str, pa.Array]:
    """What the study says of its variants, in the types of some columns; leaves (variants,)."""
    resets, cycle = study.schedules, constant_column(study.n_variants, None)
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
    return columns.curve_columns(passes=study.passes is not None, coarse=bool(study.coarse_stages))


def tells_data(study: Study) -> bool:
    """Whether the length of data stands beside settling times."""
    return bool(study.passes or study.coarse_stages)


def _settling(study: Study) -> list[Column]:
    """Settling times of all bands about bias floor and truth; then the data used until then."""
    kinds = [columns.settle_column, *([columns.settle_data_column] * tells_data(study))]
    return [kind(b, truth=t) for kind in kinds for t in (False, True) for b in bands(study)]
