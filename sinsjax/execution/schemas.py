"""Columns of a study's result tables."""

from collections.abc import Iterable

import pyarrow as pa

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.methods.method import OwnColumn
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import key_meaning
from sinsjax.study.schema import NUMBERS_DRAWN
from sinsjax.study.study import Study
from sinsjax.study.success import settling_bands
from sinsjax.study.sweep_columns import CodedColumn
from sinsjax.study.variants import Variants


def summary_columns(study: Study) -> tuple[Column, ...]:
    """Return the columns of the summary, in a time proportional to the total length of the axes."""
    return (
        *columns.IDENTITY,
        *_key_columns(study),
        *columns.OBSERVED,
        *_settling_columns(study),
        *(column for t in study.report_times_s for column in columns.report_time_columns(t)),
        *columns.JUDGED,
        *(method_column.column for method_column in method_columns(study).values()),
    )


def variant_columns(study: Study, schema: Iterable[Column]) -> dict[str, pa.Array]:
    """Return the columns that the study determines, by name, (variants,), in the schema's types."""
    resets, cycle = study.schedules, study.coded().map(lambda _: None)
    if study.has("resets"):
        cycle = study.coded("reset_cycle_s")
    fixed = {
        "method": study.coded("method"),
        "reset_count": resets.map(len),
        "reset_cycle_s": cycle,
        "reset_times_s": resets.map(list),
        **{(key := f"phi_{a}0_deg"): study.coded(key) for a in "enu"},
    }
    swept = {key: study.coded(key) for key in study.axis_keys}
    kinds = {c.name: c.dtype for c in schema}
    return {
        name: _to_array(column, kinds[name])
        for name, column in (swept | fixed).items()
        if name not in study.drawn_keys
    }


def _to_array(column: CodedColumn, dtype: pa.DataType) -> pa.Array:
    """Return the values of a key, one per variant; a number among lists applies to all axes."""
    codes, choices = column
    if pa.types.is_list(dtype):
        choices = tuple([v] if isinstance(v, int | float) else v for v in choices)
    return pa.array(choices, dtype).take(pa.array(codes))


def _key_columns(study: Study) -> list[Column]:
    """Return the columns of swept and drawn keys, without those of every study."""
    known = {c.name for c in columns.IDENTITY}
    swept = {key: values for dimension in study.dimensions for key, values in dimension.items()}
    return [
        *(columns.axis_column(k, v, key_meaning(k)) for k, v in swept.items() if k not in known),
        *(
            columns.drawn_column(k, 1 if NUMBERS_DRAWN[k] == 1 else 2, key_meaning(k))
            for k in study.drawn_keys
            if k not in known
        ),
    ]


def method_columns(study: Study) -> dict[str, OwnColumn]:
    """Return the columns specific to the study's methods, by name; methods may share a column."""
    methods = (method for name, method in METHODS.items() if name in study.methods)
    keys = Variants.all_of(study)
    return {
        method_column.column.name: method_column
        for method in methods
        for method_column in method.own_columns(keys)
    }


def curve_columns(study: Study) -> tuple[Column, ...]:
    """Return the columns of the curves."""
    return columns.curve_columns(passes=study.passes is not None, coarse=bool(study.coarse_stages))


def has_data_columns(study: Study) -> bool:
    """Return whether there are columns for the length of data used until heading settles."""
    return bool(study.passes or study.coarse_stages)


def _settling_columns(study: Study) -> list[Column]:
    """Return the settling times of all bands about bias floor and truth, then the data used."""
    kinds = [columns.settle_column, *([columns.settle_data_column] * has_data_columns(study))]
    return [
        kind(b, truth=t) for kind in kinds for t in (False, True) for b in settling_bands(study)
    ]
