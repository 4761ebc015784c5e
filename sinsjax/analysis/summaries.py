"""Tables of statistics: one row per group of runs, or per group compared with a baseline."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sinsjax.analysis.clusters import CLUSTER_COLUMNS, cluster_ids, has_independent_runs
from sinsjax.analysis.differences import mean_difference, proportion_difference, quantile_difference
from sinsjax.analysis.estimates import (
    UNKNOWN,
    Estimate,
    chi2_mean_band,
    mean,
    quantile,
    rms,
    share,
    std,
)
from sinsjax.analysis.tables import (
    group_rows,
    has_truth,
    numeric_column,
    paired_row_indices,
    require_column,
    select_runs_with_floor,
    status_mask,
    to_arrow_table,
    to_key_list,
)
from sinsjax.errors import InputError

NEES_FREEDOM = 3
"""Degrees of freedom of ``nees``: three angles."""
_YAW, _FLOOR, _AT = "phi_u_mean_arcmin", "floor_arcmin", "phi_u_at_"
_MOST = 180 * 60.0  # arcmin, of a heading error
REQUIRED_COLUMNS = ("draw_id", "start_s", "status", "phi_u_arcmin", "has_floor", _YAW, _FLOOR)
"""Columns that `summarise` needs in addition to keys and the columns of its statistics."""

_INTERVAL = ("", "_low", "_high")
_MEAN = (*_INTERVAL, "_n")  # a mean omits non-finite values, so its number of values is given
_CHI2 = (*_MEAN, "_chi2_low", "_chi2_high")


class _Statistic(NamedTuple):
    """One statistic of a group.

    Attributes:
        columns: columns that it uses.
        estimate: function that estimates it from a group's rows.
        suffixes: suffixes of its columns.
        needs_truth: whether it requires a truth.
        needs_floor: whether it uses only runs that have a bias floor.
        freedom: degrees of freedom if it is a mean of chi-square values; 0 otherwise.
    """

    columns: tuple[str, ...]
    estimate: Callable[[pa.Table], Estimate]
    suffixes: tuple[str, ...] = _INTERVAL
    needs_truth: bool = False
    needs_floor: bool = False
    freedom: int = 0


def summarise(table: Any, by: str | Sequence[str], names: Sequence[str] | None = None) -> pa.Table:
    """Compute the statistics of each group of runs, one row per group.

    Columns: the keys; ``n`` runs, of which ``nonfinite`` and ``no_floor``; then ``X``, ``X_low``
    and ``X_high`` for every statistic X with its 95 % interval. If a group has several runs of a
    draw, the interval counts draws; for runs on a record there is none (see
    `sinsjax.analysis.clusters`):

    * ``success_rate`` (status ``ok``, by the study's criterion) and ``diverged_rate``: shares of
      all runs; ``success_truth_rate``: the share of runs that end within the success band about the
      truth; ``success_floor_rate``: the same about the bias floor, of the runs that have one;
    * for each band B of the table ``settle_B_s_median`` and ``settle_B_s_q90`` (infinite: never),
      ``settle_B_s_mean`` of the runs that settled, and ``never_settled_B``, a count without
      interval, all about the bias floor; about the truth the same of ``settle_B_truth_s``; all but
      the count also for ``settle_B_data_s`` and ``settle_B_truth_data_s``, with repeated passes
      over a stored record;
    * the heading error from the truth, arcmin, for ``phi_u_arcmin`` at the end and every column
      ``phi_u_at_T_arcmin``: ``phi_u_arcmin_rms`` of the finite values (180 deg at most), and
      ``phi_u_arcmin_abs_q90``, the value that |phi_u| of 90 % of the runs does not exceed (a run
      without a number counts as infinite);
    * ``phi_u_mean_arcmin_mean`` and ``phi_u_mean_arcmin_std``: the signed window means over the
      runs, the second null if they ended in more than one status: then ``phi_u_mean_arcmin_q10``,
      ``..._median`` and ``..._q90`` give the spread of the finite values;
      ``phi_u_from_floor_arcmin_mean``: window mean minus floor; ``phi_u_std_arcmin_mean``: the
      standard deviation inside a run's window;
    * ``nees_median`` (a non-finite run counts as infinite), ``nees_mean`` and ``nis_u_mean``, the
      last two with the chi-square band of the mean in ``X_chi2_low`` and ``X_chi2_high``, which
      holds only for a consistent filter.

    Statistics about the bias floor use only runs that have one, all but ``no_floor`` of them. A
    mean, standard deviation or rms omits non-finite values; ``X_n`` is the number of runs used.
    Null is unknown, as all but ``n`` and ``nonfinite`` are without truth or reference.

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
    if table.num_rows == 0:
        raise InputError("summary: there are no runs to summarise")
    offered = _available_statistics(table.column_names)
    chosen = list(offered) if names is None else list(names)
    if unknown := [name for name in chosen if name not in offered]:
        raise InputError(f"summary: there is no statistic {unknown[0]} of these columns")
    statistics = {name: offered[name] for name in chosen}
    used = [column for statistic in statistics.values() for column in statistic.columns]
    used += [column for column in CLUSTER_COLUMNS if column in table.column_names]
    rows_of_groups = (
        key | _statistics_row(rows, statistics)
        for key, rows in group_rows(_select_columns(table, *by, *_status_columns(table), *used), by)
    )
    return _build_table(rows_of_groups, table.schema, by)


def read_estimate(row: Mapping[str, Any], name: str) -> Estimate:
    """A statistic in a row of `summarise`; NaN where it is unknown."""
    ends = (row[f"{name}{end}"] for end in _INTERVAL)
    value, low, high = (math.nan if end is None else end for end in ends)
    return Estimate(value, low, high, row["n"])


def compare_with_baseline(
    table: pa.Table, by: Sequence[str], baseline: Mapping[str, Any]
) -> pa.Table:
    """Compare each group of runs with a baseline group on the same draws.

    Columns: the keys; ``n`` draws; then ``X``, ``X_low`` and ``X_high``, group minus baseline, for
    X in ``success_rate_difference``, and the same of ``success_floor_rate`` and
    ``success_truth_rate`` (paired shares, Newcombe's interval),
    ``settle_B_s_median_difference`` for each band B (infinite: only one of the two ever settles;
    null between two ends: neither does) and
    ``phi_u_error_arcmin_difference`` (distance of the window mean of phi_u from its floor, by draw;
    mean), whose ``X_n`` is the number of draws used. Null means unknown,
    as all are without truth or reference, and all ends of intervals for runs on a record.

    Args:
        table: the summary, one row per run.
        by: key columns as for `group_rows`; one run per draw in each group.
        baseline: key values of the group to compare with.

    Returns:
        One row for each group but the baseline, by first appearance.

    Raises:
        InputError: no runs, no such baseline, a missing column, or draws that differ or repeat.
    """
    settling = [name for name in table.column_names if name.startswith("settle_")]
    flags = [name for name in ("ok_floor", "ok_truth") if name in table.column_names]
    used = ["draw_id", *_status_columns(table), *flags, _YAW, _FLOOR, *settling]
    used += [column for column in CLUSTER_COLUMNS if column in table.column_names]
    found = list(group_rows(_select_columns(table, *by, *used), by))
    baseline_key = {key: _tuple_to_list(value) for key, value in baseline.items()}
    base = next((rows for key, rows in found if key == baseline_key), None)
    if base is None:
        raise InputError(f"summary: there are no runs of the baseline {baseline_key}")
    known = has_truth(table)
    rows_of_groups = (
        key | {"n": rows.num_rows} | _difference_cells(rows, base, [*flags, *settling], known=known)
        for key, rows in found
        if rows is not base
    )
    return _build_table(rows_of_groups, table.schema, by)


def _status_columns(table: pa.Table) -> tuple[str, ...]:
    """Columns that determine which statistics of a run are defined."""
    return ("status", "phi_u_arcmin", *{"has_floor"}.intersection(table.column_names))


def _tuple_to_list(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _difference_cells(
    rows: pa.Table, baseline: pa.Table, columns: Sequence[str], *, known: bool
) -> dict[str, Any]:
    """One group's cells of `compare_with_baseline`."""
    rows_order, base_order = paired_row_indices(rows, baseline)
    single = has_independent_runs(
        rows
    )  # otherwise on one record, where no difference has an interval

    def pair(column: str) -> tuple[NDArray, NDArray]:
        return numeric_column(rows, column)[rows_order], numeric_column(baseline, column)[
            base_order
        ]

    yaw, floor = pair(_YAW), pair(_FLOOR)
    errors = (np.abs(a - b) for a, b in zip(yaw, floor, strict=True))
    ok = status_mask(rows, "ok")[rows_order], status_mask(baseline, "ok")[base_order]
    found = {"success_rate_difference": proportion_difference(*ok) if known else UNKNOWN}
    limited = all(
        select_runs_with_floor(group).num_rows == group.num_rows for group in (rows, baseline)
    )
    for name in columns:
        judged = known and (limited or "_truth" in name)
        if name.startswith("ok_"):
            pairs = pair(name)
            recorded = judged and bool(np.isfinite(pairs).all())
            rate = f"{name.replace('ok', 'success')}_rate_difference"
            found[rate] = proportion_difference(*pairs) if recorded else UNKNOWN
        else:
            difference = quantile_difference(*pair(name)) if judged else UNKNOWN
            found[f"{name}_median_difference"] = difference
    cells: dict[str, Any] = {}
    found["phi_u_error_arcmin_difference"] = mean_difference(*errors)
    for name, estimate in found.items():
        suffixes = _MEAN if name.startswith("phi_u") else _INTERVAL
        bare = estimate._replace(low=math.nan, high=math.nan)
        cells |= _estimate_cells(name, estimate if single else bare, suffixes)
    return cells


def _available_statistics(columns: Sequence[str]) -> dict[str, _Statistic]:
    """All statistics of a table with these columns, by name."""
    offered = {
        f"{name}_rate": _Statistic(
            ("status",), partial(_status_share, status=status), needs_truth=True
        )
        for name, status in {"success": "ok", "diverged": "diverged"}.items()
    }
    for name in (name for name in ("ok_floor", "ok_truth") if name in columns):
        rate = name.replace("ok", "success") + "_rate"
        flagged = partial(_flag_share, name=name)
        offered[rate] = _Statistic(
            (name,), flagged, needs_truth=True, needs_floor=name == "ok_floor"
        )
    for name in (name for name in columns if name.startswith("settle_")):
        about = {"needs_truth": True, "needs_floor": "_truth_" not in name}
        if not name.endswith("_data_s"):
            count = name.replace("settle_", "never_settled_").removesuffix("_s")
            offered[count] = _column_statistic(_count_missing, name, suffixes=("",), **about)
        offered[f"{name}_median"] = _column_statistic(quantile, name, **about)
        offered[f"{name}_q90"] = _column_statistic(partial(quantile, q=0.9), name, **about)
        time_mean = partial(mean, limits=(0.0, math.inf))
        offered[f"{name}_mean"] = _column_statistic(time_mean, name, suffixes=_MEAN, **about)
    for name in (name for name in columns if name == "phi_u_arcmin" or name.startswith(_AT)):
        offered[f"{name}_rms"] = _column_statistic(
            partial(rms, max_magnitude=_MOST), name, suffixes=_MEAN
        )
        offered[f"{name}_abs_q90"] = _column_statistic(_abs_quantile_90, name)
    return offered | {
        "phi_u_mean_arcmin_mean": _column_statistic(mean, _YAW, suffixes=_MEAN),
        "phi_u_mean_arcmin_std": _Statistic((_YAW,), _std_of_single_status, suffixes=_MEAN),
        **{
            f"phi_u_mean_arcmin_{name}": _column_statistic(partial(_quantile_of_finite, q=q), _YAW)
            for name, q in {"q10": 0.1, "median": 0.5, "q90": 0.9}.items()
        },
        "phi_u_from_floor_arcmin_mean": _column_statistic(
            mean_difference, _YAW, _FLOOR, suffixes=_MEAN
        ),
        "phi_u_std_arcmin_mean": _column_statistic(mean, "phi_u_std_arcmin", suffixes=_MEAN),
        "nees_median": _column_statistic(_median_if_any_finite, "nees"),
        "nees_mean": _column_statistic(mean, "nees", suffixes=_CHI2, freedom=NEES_FREEDOM),
        "nis_u_mean": _column_statistic(mean, "nis_u", suffixes=_CHI2, freedom=1),
    }


def _column_statistic(
    estimator: Callable[..., Estimate], *columns: str, **properties: Any
) -> _Statistic:
    """A function of some numeric columns as a statistic."""

    def estimate(rows: pa.Table) -> Estimate:
        return estimator(
            *(numeric_column(rows, column) for column in columns), cluster=cluster_ids(rows)
        )

    return _Statistic(columns, estimate, **properties)


def _status_share(rows: pa.Table, status: str) -> Estimate:
    return share(status_mask(rows, status), cluster_ids(rows))


def _flag_share(rows: pa.Table, name: str) -> Estimate:
    """The share of runs whose flag is set; unknown if it was not recorded."""
    recorded = rows.filter(pc.is_valid(require_column(rows, name)))
    if not recorded.num_rows:
        return UNKNOWN
    return share(recorded[name].to_numpy(), cluster_ids(recorded))


def _std_of_single_status(rows: pa.Table) -> Estimate:
    """The spread of the window means, which is meaningful only for runs of the same status."""
    if len(rows["status"].unique()) > 1:
        return UNKNOWN
    return std(numeric_column(rows, _YAW), cluster_ids(rows))


def _count_missing(values: NDArray, cluster: NDArray | None) -> Estimate:
    return UNKNOWN._replace(value=float(np.isnan(values).sum()))


def _median_if_any_finite(values: NDArray, cluster: NDArray | None) -> Estimate:
    return quantile(values, cluster=cluster) if np.isfinite(values).any() else UNKNOWN


def _abs_quantile_90(values: NDArray, cluster: NDArray | None) -> Estimate:
    if not np.isfinite(values).any():
        return UNKNOWN
    return quantile(np.abs(values), 0.9, cluster)


def _quantile_of_finite(values: NDArray, cluster: NDArray | None, q: float) -> Estimate:
    is_finite = np.isfinite(values)
    if not is_finite.any():
        return UNKNOWN
    return quantile(values[is_finite], q, None if cluster is None else cluster[is_finite])


def _statistics_row(rows: pa.Table, statistics: Mapping[str, _Statistic]) -> dict[str, Any]:
    """One group's cells of `summarise`."""
    truth, single, limited = (
        has_truth(rows),
        has_independent_runs(rows),
        select_runs_with_floor(rows),
    )
    row = {
        "n": rows.num_rows,
        "nonfinite": int(status_mask(rows, "nonfinite").sum()),
        "no_floor": rows.num_rows - limited.num_rows,
    }
    for name, statistic in statistics.items():
        judged = limited if statistic.needs_floor else rows
        known = judged.num_rows and (truth or not statistic.needs_truth)
        estimate = statistic.estimate(judged) if known else UNKNOWN
        # The band is valid for independent runs only.
        row |= _estimate_cells(
            name, estimate, statistic.suffixes, statistic.freedom, with_band=single
        )
    return row


def _estimate_cells(
    name: str,
    estimate: Estimate,
    suffixes: Sequence[str],
    freedom: int = 0,
    *,
    with_band: bool = True,
) -> dict[str, Any]:
    cells: dict[str, Any] = dict(zip(_MEAN, estimate, strict=True))
    if freedom:
        band = chi2_mean_band(freedom, estimate.n if with_band else 0)
        cells |= zip(_CHI2[len(_MEAN) :], band, strict=True)
    return {f"{name}{end}": cells[end] for end in suffixes}


def _select_columns(table: pa.Table, *columns: str) -> pa.Table:
    for column in columns:
        require_column(table, column)
    return table.select(list(dict.fromkeys(columns)))


def _build_table(
    rows: Iterable[Mapping[str, Any]], schema: pa.Schema, by: Sequence[str]
) -> pa.Table:
    """Rows as a table: keys as they were, counts as whole numbers, NaN as null."""
    columns: dict[str, list] = {}
    for row in rows:
        for name, value in row.items():
            columns.setdefault(name, []).append(value)

    def kind(name: str) -> pa.DataType:
        if name in by:
            return schema.field(name).type
        whole = name in ("n", "nonfinite", "no_floor") or name.endswith("_n")
        return pa.int64() if whole or name.startswith("never_settled_") else pa.float64()

    arrays = [pa.array(v, kind(name), from_pandas=True) for name, v in columns.items()]
    return pa.table(arrays, names=list(columns))
