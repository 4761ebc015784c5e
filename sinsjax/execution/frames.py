"""Result tables as pandas frames and xarray datasets, with units; both libraries are optional."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax.errors import InputError
from sinsjax.messages import format_count
from sinsjax.study.study import Study


def to_dataframe(table: pa.Table) -> Any:
    """Return a table as a pandas frame; ``attrs`` has ``units`` and ``meanings`` by column.

    Raises:
        InputError: pandas is not installed.
    """
    try:
        import pandas  # noqa: F401  (pyarrow needs it)
    except ImportError:
        raise _missing_library_error("pandas") from None
    frame = table.to_pandas()
    frame.attrs |= {
        "units": {field.name: _field_metadata(field, "unit") for field in table.schema},
        "meanings": {field.name: _field_metadata(field, "meaning") for field in table.schema},
    }
    return frame


def to_dataset(study: Study, table: pa.Table) -> Any:
    """Return the summary of a study as an xarray dataset.

    The dimensions are ``draw`` and the axes of the study in their order. Keys that vary together
    are one dimension, called as the first of them. If no key of an axis identifies its points, one
    dimension ``variant`` replaces all axes.

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
        raise _missing_library_error("xarray") from None
    draws = np.unique(table["draw_id"].to_numpy())
    if table.num_rows != len(draws) * study.n_variants:
        present = f"{format_count(table.num_rows, 'run')} of {format_count(len(draws), 'draw')}"
        text = f"some variants are missing ({present}; to_pandas returns the rows that exist)"
        raise InputError(f"{study.name}: {text}")
    table = table.sort_by("run_id")
    dimensions: dict[str, Any] = {
        keys[0]: d for keys, d in zip(study.axes_shown, study.dimensions, strict=True)
    }
    if any(len(keys) > 1 for keys in study.axes_shown):
        dimensions = {"variant": dict.fromkeys(study.axis_keys, range(study.n_variants))}
    shape = {"draw": len(draws)}
    shape |= {name: len(next(iter(keys.values()))) for name, keys in dimensions.items()}
    values = {
        name: _column_values(table[name]).reshape(*shape.values()) for name in table.column_names
    }
    keys_of = {"draw": ["start_s"] if study.is_recorded else [], **dimensions}
    coordinates = {"draw": ("draw", draws)}
    if "variant" in dimensions:
        coordinates["variant"] = ("variant", np.arange(study.n_variants))
    for axis, (dimension, keys) in enumerate(keys_of.items()):
        for key in keys:
            along = np.moveaxis(values[key], axis, 0).reshape(shape[dimension], -1)[:, 0]
            coordinates[key] = (dimension, along)
    variables = {
        name: (tuple(shape), array)
        for name, array in values.items()
        if name not in {*coordinates, "draw_id", "variant_id"}
    }
    dataset = xarray.Dataset(variables, coordinates, {"title": study.name})
    for name in {*table.column_names} & dataset.variables.keys():
        field = table.schema.field(name)
        attributes = {
            "units": _field_metadata(field, "unit"),
            "long_name": _field_metadata(field, "meaning"),
        }
        dataset[name].attrs |= {key: text for key, text in attributes.items() if text}
    return dataset


def _column_values(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as an array: numbers, NaN if null, or text."""
    if pa.types.is_string(column.type) or pa.types.is_list(column.type):
        return np.array([_format_value(value) for value in column.to_pylist()])
    if column.null_count and not pa.types.is_floating(column.type):
        column = column.cast(pa.int8() if pa.types.is_boolean(column.type) else column.type)
        column = column.cast(pa.float64())
    return column.to_numpy()


def _format_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    return f"{value:g}" if isinstance(value, int | float) else value or ""


def _field_metadata(field: pa.Field, key: str) -> str:
    metadata: Mapping[bytes, bytes] = field.metadata or {}
    return metadata.get(key.encode(), b"").decode()


def _missing_library_error(library: str) -> InputError:
    return InputError(f"{library} is not installed (pip install {library})")
