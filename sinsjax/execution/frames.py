"""Result tables as pandas frames and xarray datasets, with units; both libraries are optional."""

from collections.abc import Mapping
from typing import Any

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
        import xarray  # noqa: F401  (pandas needs it)
    except ImportError:
        raise _missing_library_error("xarray") from None
    table = table.sort_by("run_id")
    frame = to_dataframe(table).rename(columns={"draw_id": "draw"})
    draws = frame["draw"].nunique()
    if len(frame) != draws * study.n_variants:
        present = f"{format_count(len(frame), 'run')} of {format_count(draws, 'draw')}"
        text = f"some variants are missing ({present}; to_pandas returns the rows that exist)"
        raise InputError(f"{study.name}: {text}")
    for field in table.schema:
        if pa.types.is_string(field.type) or pa.types.is_list(field.type):
            frame[field.name] = [_format_value(value) for value in table[field.name].to_pylist()]
        elif pa.types.is_boolean(field.type) and table[field.name].null_count:
            frame[field.name] = frame[field.name].astype(float)
    # The keys of each dimension, called as the first of them.
    dimensions = {keys[0]: [*d] for keys, d in zip(study.axes_shown, study.dimensions, strict=True)}
    if any(len(keys) > 1 for keys in study.axes_shown):
        frame["variant"] = frame["variant_id"]
        dimensions = {"variant": [*study.axis_keys]}
    dimensions = {"draw": ["start_s"] if study.is_recorded else [], **dimensions}
    order = {name: frame[name].unique() for name in dimensions}
    dataset = frame.drop(columns="variant_id").set_index([*order]).to_xarray().reindex(order)
    for name, keys in dimensions.items():
        others = dict.fromkeys(order.keys() - {name}, 0)
        for key in set(keys) - {name}:
            dataset = dataset.assign_coords({key: dataset[key].isel(others, drop=True)})
    dataset.attrs = {"title": study.name}
    for name, unit in frame.attrs["units"].items():
        if name in dataset.variables:
            texts = {"units": unit, "long_name": frame.attrs["meanings"][name]}
            dataset[name].attrs = {key: text for key, text in texts.items() if text}
    return dataset


def _format_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    return f"{value:g}" if isinstance(value, int | float) else value or ""


def _field_metadata(field: pa.Field, key: str) -> str:
    metadata: Mapping[bytes, bytes] = field.metadata or {}
    return metadata.get(key.encode(), b"").decode()


def _missing_library_error(library: str) -> InputError:
    return InputError(f"{library} is not installed (pip install {library})")
