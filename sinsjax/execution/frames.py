"""Result tables as pandas frames and xarray datasets, with units; both libraries are optional."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax.errors import InputError
from sinsjax.messages import format_count
from sinsjax.study.study import Study


def frame_of(table: pa.Table) -> Any:
    """Return a table as a pandas frame; ``attrs`` has ``units`` and ``meanings`` by column.

    Raises:
        InputError: pandas is not installed.
    """
    try:
        import pandas  # noqa: F401  (pyarrow needs it)
    except ImportError:
        raise _missing("pandas") from None
    frame = table.to_pandas()
    frame.attrs |= {
        "units": {field.name: _about(field, "unit") for field in table.schema},
        "meanings": {field.name: _about(field, "meaning") for field in table.schema},
    }
    return frame


def dataset_of(study: Study, table: pa.Table) -> Any:
    """Return the summary of a study, or its estimates, as an xarray dataset.

    The dimensions are ``draw``, unless these are estimates, and the axes of the study in their
    order. Keys that vary together are one dimension, called as the first of them. If no key of an
    axis identifies its points, one dimension ``variant`` replaces all axes.

    Args:
        study: the study.
        table: all of its rows.

    Returns:
        A variable per column that is not an axis, with ``units`` and ``long_name``. A null is NaN,
        in a column of text an empty one; a list is text.

    Raises:
        InputError: xarray is not installed, or draws lack some variants.
    """
    try:
        import xarray
    except ImportError:
        raise _missing("xarray") from None
    per_draw = "draw_id" in table.column_names
    draws = np.unique(table["draw_id"].to_numpy()) if per_draw else np.zeros(1, int)
    if table.num_rows != len(draws) * study.n_variants:
        there = f"{format_count(table.num_rows, 'run')} of {format_count(len(draws), 'draw')}"
        text = f"some variants are missing ({there}; to_pandas has the rows that are there)"
        raise InputError(f"{study.name}: {text}")
    table = table.sort_by("run_id" if per_draw else "variant_id")
    axes, coordinates = _axes(study)
    shape = {"draw": len(draws), **axes} if per_draw else axes
    if per_draw:
        coordinates["draw"] = ("draw", draws)
        if study.is_recorded:
            starts = table["start_s"].to_numpy().reshape(len(draws), -1)[:, 0]
            coordinates["start_s"] = ("draw", starts)
    fields = {field.name: field for field in table.schema}
    known = {*coordinates, "draw_id", "variant_id"}
    variables = {
        name: (tuple(shape), _array(table[name]).reshape(*shape.values()))
        for name in fields
        if name not in known
    }
    dataset = xarray.Dataset(variables, coordinates, {"title": study.name})
    for name in fields.keys() & dataset.variables.keys():
        told = {"units": _about(fields[name], "unit"), "long_name": _about(fields[name], "meaning")}
        dataset[name].attrs |= {key: text for key, text in told.items() if text}
    return dataset


def _axes(study: Study) -> tuple[dict[str, int], dict[str, tuple[str, np.ndarray]]]:
    """Return the length of each dimension, and the coordinates with their dimensions."""
    shown = study.axes_shown
    if any(len(keys) > 1 for keys in shown):
        values = {"variant": range(study.n_variants), **study.variant_values()}
        sizes = {"variant": study.n_variants}
        return sizes, {key: ("variant", _coordinate(one)) for key, one in values.items()}
    names = {keys[0]: dimension for keys, dimension in zip(shown, study.dimensions, strict=True)}
    coordinates = {
        key: (name, _coordinate(values))
        for name, dimension in names.items()
        for key, values in dimension.items()
    }
    return {name: len(dimension[name]) for name, dimension in names.items()}, coordinates


def _coordinate(values: Any) -> np.ndarray:
    """Return values of a key as an array: numbers, or text."""
    kinds = {type(value) for value in values}
    if kinds == {bool} or kinds <= {int, float}:
        return np.array(values)
    if kinds <= {int, float, type(None)}:
        return np.array([np.nan if value is None else value for value in values])
    return np.array([_text(value) for value in values])


def _array(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as an array: numbers, NaN if null, or text."""
    if pa.types.is_string(column.type) or pa.types.is_list(column.type):
        return np.array([_text(value) for value in column.to_pylist()])
    if column.null_count and not pa.types.is_floating(column.type):
        column = column.cast(pa.int8() if pa.types.is_boolean(column.type) else column.type)
        column = column.cast(pa.float64())
    return column.to_numpy()


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    return f"{value:g}" if isinstance(value, int | float) else value or ""


def _about(field: pa.Field, key: str) -> str:
    metadata: Mapping[bytes, bytes] = field.metadata or {}
    return metadata.get(key.encode(), b"").decode()


def _missing(library: str) -> InputError:
    return InputError(f"{library} is not installed (pip install {library})")
