"""Columns of a study's results."""

from sinsjax import columns
from sinsjax.alignment.description import OwnColumn
from sinsjax.alignment.methods import METHODS
from sinsjax.columns import Column
from sinsjax.study.distributions import NUMBERS_DRAWN
from sinsjax.study.keys import meaning
from sinsjax.study.study import Study
from sinsjax.study.success import bands
from sinsjax.study.times import report_times


def summary(study: Study) -> tuple[Column, ...]:
    """Columns of the summary; the cost is proportional to the total length of the axes."""
    known = {c.name for c in columns.IDENTITY}
    swept = {key: values for dimension in study.dimensions for key, values in dimension.items()}
    extra = [
        *(columns.axis_column(k, v, meaning(k)) for k, v in swept.items() if k not in known),
        *(
            columns.drawn_column(k, 1 if NUMBERS_DRAWN[k] == 1 else 2, meaning(k))
            for k in study.drawn_keys
            if k not in known
        ),
    ]
    return (
        *columns.IDENTITY,
        *extra,
        *columns.OBSERVED,
        *_settling(study),
        *(column for t in report_times(study) for column in columns.report_columns(t)),
        *columns.JUDGED,
        *(own.column for own in of_methods(study).values()),
    )


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
