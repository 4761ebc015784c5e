"""Tables of statistics: the long table `Estimates`, of groups of runs or of their differences."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sinsjax.analysis.estimates import (
    CLUSTER_COLUMNS,
    UNKNOWN,
    Estimate,
    draw_id_clusters,
    mean,
    mean_difference,
    proportion_difference,
    quantile,
    quantile_difference,
    rms,
    share,
)
from sinsjax.analysis.tables import (
    group_rows,
    has_truth,
    numeric_column,
    pair_by_draw,
    require_column,
    to_arrow_table,
    to_key_list,
)
from sinsjax.errors import InputError

_YAW, _FLOOR = "phi_u_mean_arcmin", "floor_arcmin"
_MOST = 180 * 60.0  # arcmin, of a heading error
_FLAGS = {"ok_floor": "success_floor_rate", "ok_truth": "success_truth_rate"}
REQUIRED_COLUMNS = ("draw_id", "start_s", "status", "phi_u_arcmin", "has_floor", _YAW, _FLOOR)
"""Columns that `summarise` needs in addition to keys and the columns of its statistics."""


class _Statistic(NamedTuple):
    """A statistic of some columns of the runs, perhaps of those with a floor only.

    ``difference`` is that of a group from a baseline, a function of a pair for each column.
    """

    columns: tuple[str, ...]
    estimate: Callable[..., Estimate | int]
    needs_truth: bool = False
    needs_floor: bool = False
    difference: Callable[..., Estimate] | None = None


class Estimates(NamedTuple):
    """The long table of statistics: key values and statistics by name, group by group.

    Each is an `Estimate`; ``n``, ``nonfinite``, ``no_floor`` and ``never_settled_B`` are counts,
    None if unknown.
    """

    groups: list[tuple[dict[str, Any], dict[str, Any]]]

    def pivot(self, key_types: pa.Schema) -> pa.Table:
        """One row per group: its keys with their types in a schema, counts whole, NaN as null."""
        (first, statistics), columns = self.groups[0], {}
        for name in first:
            cells = [keys[name] for keys, _ in self.groups]
            columns[name] = pa.array(cells, key_types.field(name).type)
        for name, example in statistics.items():
            cells = [found[name] for _, found in self.groups]
            if not isinstance(example, Estimate):
                columns[name] = pa.array(cells, pa.int64())
                continue
            for place, suffix in enumerate(("", "_low", "_high", "_n")):
                dtype = pa.int64() if suffix == "_n" else pa.float64()
                numbers = [cell[place] for cell in cells]
                columns[name + suffix] = pa.array(numbers, dtype, from_pandas=True)
        return pa.table(columns)


def summarise(table: Any, by: str | Sequence[str], names: Sequence[str] | None = None) -> pa.Table:
    """Compute the statistics of each group of runs, one row per group.

    Columns: the keys; ``n`` runs, of which ``nonfinite`` and ``no_floor``; then for every statistic
    X also ``X_low`` and ``X_high``, its 95 % interval over the draws (none on a record), and
    ``X_n``, the runs used, as means omit non-finite values:

    * ``success_rate`` (status ``ok``), ``diverged_rate``, ``success_truth_rate`` and
      ``success_floor_rate`` (about the truth, about the bias floor): shares of runs;
    * for each band B ``settle_B_s_median``, ``settle_B_s_q90`` (infinite: never),
      ``settle_B_s_mean`` of the runs that settled and the count ``never_settled_B``, and the same
      of ``settle_B_truth_s`` and, in time of stored data, ``settle_B_data_s``;
    * the heading error from the truth, arcmin: ``phi_u_arcmin_rms`` (180 deg at most),
      ``phi_u_arcmin_abs_q90`` (a run without a number counts as infinite), at report times
      ``phi_u_at_T_arcmin_rms`` and ``phi_u_at_T_arcmin_abs_q90``;
    * signed window means, arcmin: ``phi_u_mean_arcmin_mean``, ``..._q10``, ``..._median``,
      ``..._q90``, ``phi_u_from_floor_arcmin_mean``; ``phi_u_std_arcmin_mean`` within the window;
    * ``nees_median``, ``nees_mean`` and ``nis_u_mean``.

    Statistics about the bias floor use only runs that have one. Null is unknown, as all but ``n``
    and ``nonfinite`` are without truth or reference.

    Args:
        table: the summary, one row per run; an Arrow table or a pandas frame.
        by: a key column, or several, of any type, lists included; [] for one group.
        names: statistics and counts to compute, in this order; None for all. The columns of other
            statistics may then be missing.

    Raises:
        InputError: this is no table or has no rows, a column is missing, or there is no such
            statistic.

    Example:
        >>> import pyarrow as pa
        >>> draws = {"draw_id": range(16), "status": ["ok"] * 16, "phi_u_arcmin": [2.0] * 16}
        >>> (row,) = sinsjax.summarise(pa.table(draws), [], ["success_rate"]).to_pylist()
        >>> row["n"], row["success_rate"], round(row["success_rate_low"], 3)
        (16, 1.0, 0.794)
    """
    table, by = to_arrow_table(table), to_key_list(by)
    return estimate_groups(table, by, names).pivot(table.schema)


def estimate_groups(
    table: pa.Table, by: Sequence[str], names: Sequence[str] | None = None
) -> Estimates:
    """Return the statistics of `summarise` as a long table, with the same arguments."""
    if table.num_rows == 0:
        raise InputError("summary: there are no runs to summarise")
    offered = _available_statistics(table.column_names)
    names = list(offered) if names is None else names
    if unknown := [name for name in names if name not in offered]:
        raise InputError(f"summary: there is no statistic {unknown[0]} of these columns")
    statistics = {name: offered[name] for name in names}
    used = [column.partition("=")[0] for one in statistics.values() for column in one.columns]
    optional = {"has_floor", *CLUSTER_COLUMNS}.intersection(table.column_names)
    used = list(dict.fromkeys([*by, "status", "phi_u_arcmin", *used, *optional]))
    for column in used:
        require_column(table, column)
    groups = group_rows(table.select(used), by)
    return Estimates([(key, _statistics(rows, statistics)) for key, rows in groups])


def _statistics(rows: pa.Table, statistics: Mapping[str, _Statistic]) -> dict[str, Any]:
    """The statistics of a group."""
    truth, with_floor = has_truth(rows), rows
    if "has_floor" in rows.column_names:
        with_floor = rows.filter(pc.fill_null(rows["has_floor"], True))
    found: dict[str, Any] = {
        "n": rows.num_rows,
        "nonfinite": int(numeric_column(rows, "status=nonfinite").sum()),
        "no_floor": rows.num_rows - with_floor.num_rows,
    }
    for name, one in statistics.items():
        used = with_floor if one.needs_floor else rows
        found[name] = None if one.estimate is _count_missing else UNKNOWN
        if used.num_rows and (truth or not one.needs_truth):
            values = (numeric_column(used, column) for column in one.columns)
            found[name] = one.estimate(*values, cluster=draw_id_clusters(used))
    return found


def _available_statistics(columns: Sequence[str]) -> dict[str, _Statistic]:
    """All statistics of a table with these columns, by name."""
    flags = {"success_rate": "status=ok", "diverged_rate": "status=diverged"}
    flags |= {_FLAGS[flag]: flag for flag in columns if flag in _FLAGS}
    found = {
        name: _Statistic(
            (flag,),
            _SHARE,
            needs_truth=True,
            needs_floor=flag == "ok_floor",
            difference=None if name == "diverged_rate" else _share_difference,
        )
        for name, flag in flags.items()
    }
    for name in (name for name in columns if name.startswith("settle_")):
        times = _Statistic((name,), quantile, True, "_truth_" not in name)
        if not name.endswith("_data_s"):
            count = name.replace("settle_", "never_settled_").removesuffix("_s")
            found[count] = times._replace(estimate=_count_missing)
        found[f"{name}_median"] = times._replace(difference=lambda pair: quantile_difference(*pair))
        found[f"{name}_q90"] = times._replace(estimate=partial(quantile, q=0.9))
        found[f"{name}_mean"] = times._replace(estimate=partial(mean, limits=(0.0, math.inf)))
    for name in (x for x in columns if x == "phi_u_arcmin" or x.startswith("phi_u_at_")):
        found[f"{name}_rms"] = _Statistic((name,), partial(rms, max_magnitude=_MOST))
        found[f"{name}_abs_q90"] = _Statistic((name,), _magnitude_q90)
    found["phi_u_mean_arcmin_mean"] = _Statistic((_YAW,), mean)
    for name, q in {"q10": 0.1, "median": 0.5, "q90": 0.9}.items():
        of_finite = partial(_of_finite, partial(quantile, q=q))
        found[f"phi_u_mean_arcmin_{name}"] = _Statistic((_YAW,), of_finite)
    return found | {
        "phi_u_from_floor_arcmin_mean": _Statistic((_YAW, _FLOOR), mean_difference),
        "phi_u_std_arcmin_mean": _Statistic(("phi_u_std_arcmin",), mean),
        "nees_median": _Statistic(("nees",), _known_quantile),
        "nees_mean": _Statistic(("nees",), mean),
        "nis_u_mean": _Statistic(("nis_u",), mean),
    }


def _count_missing(values: NDArray, cluster: NDArray | None) -> int:
    return int(np.isnan(values).sum())


def _of_finite(
    estimate: Callable[..., Estimate], values: NDArray, cluster: NDArray | None
) -> Estimate:
    """An estimate of the finite values; unknown without any."""
    known = np.isfinite(values)
    of_known = None if cluster is None else cluster[known]
    return estimate(values[known], cluster=of_known) if known.any() else UNKNOWN


_SHARE = partial(_of_finite, share)
"""The share of runs whose flag is set; unknown if it was not recorded."""


def _known_quantile(values: NDArray, cluster: NDArray | None, q: float = 0.5) -> Estimate:
    """A quantile in which a run without a number counts as infinite; unknown if all do."""
    return quantile(values, q, cluster) if np.isfinite(values).any() else UNKNOWN


def _magnitude_q90(values: NDArray, cluster: NDArray | None) -> Estimate:
    return _known_quantile(np.abs(values), cluster, 0.9)


def compare_with_baseline(
    table: pa.Table, by: Sequence[str], baseline: Mapping[str, Any]
) -> Estimates:
    """Compare each group of runs with a baseline group on the same draws.

    The statistics are group minus baseline: ``success_rate_difference``, and the same of
    ``success_floor_rate`` and ``success_truth_rate`` (paired shares, Newcombe's interval);
    ``settle_B_s_median_difference`` for each band B (infinite: only one of the two ever settles;
    NaN between two ends: neither does); and ``phi_u_error_arcmin_difference`` (distance of the
    window mean of phi_u from its floor, by draw; mean). All are unknown without truth or reference,
    and all ends of intervals for runs on a record.

    Keys are those of `group_rows`, with one run per draw in each group; the baseline is a group by
    its key values, and left out. ``n`` is the number of draws.

    Raises:
        InputError: no runs, no such baseline, a missing column, or draws that differ or repeat.
    """
    groups = list(group_rows(table, by))
    key = {name: list(x) if isinstance(x, tuple) else x for name, x in baseline.items()}
    base = next((rows for group, rows in groups if group == key), None)
    if base is None:
        raise InputError(f"summary: there are no runs of the baseline {key}")
    offered = _available_statistics(table.column_names)
    statistics = {name: one for name, one in offered.items() if one.difference}
    statistics["phi_u_error_arcmin"] = _Statistic(
        (_YAW, _FLOOR),
        mean_difference,
        difference=lambda yaw, floor: mean_difference(*np.abs(np.subtract(yaw, floor))),
    )
    used = statistics if has_truth(table) else {}
    unknown = {f"{name}_difference": UNKNOWN for name in statistics}
    return Estimates(
        [
            (group, {"n": rows.num_rows} | unknown | _differences(rows, base, used))
            for group, rows in groups
            if rows is not base
        ]
    )


def _differences(
    rows: pa.Table, base: pa.Table, statistics: Mapping[str, _Statistic]
) -> dict[str, Estimate]:
    """The known differences of a group from the baseline, by name."""
    clusters, found = draw_id_clusters(rows), {}
    is_recorded = clusters is not None and np.unique(clusters).size < rows.num_rows
    flags = [t["has_floor"] for t in (rows, base) if "has_floor" in t.column_names]
    with_floor = all(pc.all(pc.fill_null(flag, True)).as_py() for flag in flags)
    for name, one in statistics.items():
        pairs = [pair_by_draw(rows, base, column) for column in one.columns]
        if one.difference and (with_floor or not one.needs_floor):
            estimate = one.difference(*pairs)
            if is_recorded:
                estimate = estimate._replace(low=math.nan, high=math.nan)
            found[f"{name}_difference"] = estimate
    return found


def _share_difference(flags: tuple[NDArray, NDArray]) -> Estimate:
    """The difference of two shares; unknown unless the flag was recorded in every run."""
    return proportion_difference(*flags) if np.isfinite(flags).all() else UNKNOWN
