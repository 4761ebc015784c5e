"""Tables of statistics: the long table `Estimates`, of groups of runs or of their differences."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.analysis.estimates import (
    CLUSTER_COLUMNS,
    UNKNOWN,
    Estimate,
    chi2_mean_band,
    cluster_ids,
    has_independent_runs,
    mean,
    mean_difference,
    proportion_difference,
    quantile,
    quantile_difference,
    rms,
    share,
    std,
)
from sinsjax.analysis.tables import (
    encode_values,
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
_OK = "status=ok"
REQUIRED_COLUMNS = ("draw_id", "start_s", "status", "phi_u_arcmin", "has_floor", _YAW, _FLOOR)
"""Columns that `summarise` needs in addition to keys and the columns of its statistics."""

_COUNT, _INTERVAL = ("",), ("", "_low", "_high")
_MEAN = (*_INTERVAL, "_n")  # a mean omits non-finite values, so its number of values is given


class _Statistic(NamedTuple):
    """One statistic of a group of runs, or of the difference of two.

    Attributes:
        columns: columns that it uses; ``status=ok`` for the runs with this status.
        estimate: function of these columns as numbers, and of the cluster of each run.
        suffixes: suffixes of its columns in a wide table.
        needs_truth: whether it requires a truth.
        needs_floor: whether it uses only runs that have a bias floor.
    """

    columns: tuple[str, ...]
    estimate: Callable[..., Estimate]
    suffixes: tuple[str, ...] = _INTERVAL
    needs_truth: bool = False
    needs_floor: bool = False


class Estimates(NamedTuple):
    """The long table of statistics, one `Estimate` per group and statistic.

    Attributes:
        groups: key values and estimates by the name of the statistic, group by group. ``n``,
            ``nonfinite``, ``no_floor`` and ``never_settled_B`` are counts without interval, and
            ``X_chi2`` is the band of a mean of chi-square values.
        suffixes: suffixes of the columns of each statistic in a wide table.
    """

    groups: list[tuple[dict[str, Any], dict[str, Estimate]]]
    suffixes: dict[str, tuple[str, ...]]

    def pivot(self, schema: pa.Schema) -> pa.Table:
        """One row per group: its keys with their types in a schema, counts whole, NaN as null."""
        columns: dict[str, list] = {}
        types: dict[str, pa.DataType] = {}
        for keys, found in self.groups:
            for key, value in keys.items():
                columns.setdefault(key, []).append(value)
                types[key] = schema.field(key).type
            for name, estimate in found.items():
                cells = dict(zip(_MEAN, estimate, strict=True))
                for end in self.suffixes[name]:
                    columns.setdefault(name + end, []).append(cells[end])
                    whole = end == "_n" or self.suffixes[name] == _COUNT
                    types[name + end] = pa.int64() if whole else pa.float64()
        arrays = [pa.array(cells, types[name], from_pandas=True) for name, cells in columns.items()]
        return pa.table(arrays, names=list(columns))


def summarise(table: Any, by: str | Sequence[str], names: Sequence[str] | None = None) -> pa.Table:
    """Compute the statistics of each group of runs, one row per group.

    Columns: the keys; ``n`` runs, of which ``nonfinite`` and ``no_floor``; then ``X``, ``X_low``
    and ``X_high`` for every statistic X with its 95 % interval (over the draws; none for runs on a
    record, see `sinsjax.analysis.estimates`), and ``X_n``, the runs used, if X omits non-finite
    values:

    * ``success_rate`` (status ``ok``) and ``diverged_rate``: shares of all runs;
      ``success_truth_rate``, ``success_floor_rate``: that end within the band about the truth, and
      about the bias floor;
    * for each band B ``settle_B_s_median`` and ``settle_B_s_q90`` (infinite: never),
      ``settle_B_s_mean`` of the runs that settled, and ``never_settled_B``, a count without
      interval; about the truth the same of ``settle_B_truth_s``; all but the count also of
      ``settle_B_data_s`` and ``settle_B_truth_data_s``, with repeated passes over a stored record;
    * the heading error from the truth, arcmin, at the end and at report times: ``phi_u_arcmin_rms``
      (180 deg at most), ``phi_u_arcmin_abs_q90``, which 90 % of the runs do not exceed (a run
      without a number counts as infinite), and the same of ``phi_u_at_T_arcmin``;
    * the signed window means, arcmin: ``phi_u_mean_arcmin_mean``, ``..._std`` (null if the runs
      ended in more than one status), ``..._q10``, ``..._median``, ``..._q90`` of the finite values;
      ``phi_u_from_floor_arcmin_mean``: window mean minus floor; ``phi_u_std_arcmin_mean``: the
      standard deviation inside a run's window;
    * ``nees_median``, ``nees_mean`` and ``nis_u_mean``, the means with the band of a consistent
      filter in ``X_chi2_low`` and ``X_chi2_high``.

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
    chosen = list(offered) if names is None else list(names)
    if unknown := [name for name in chosen if name not in offered]:
        raise InputError(f"summary: there is no statistic {unknown[0]} of these columns")
    statistics = {name: offered[name] for name in chosen}
    suffixes: dict[str, tuple[str, ...]] = dict.fromkeys(("n", "nonfinite", "no_floor"), _COUNT)
    for name, statistic in statistics.items():
        suffixes[name] = statistic.suffixes
        if name in _CHI2:
            suffixes[f"{name}_chi2"] = _INTERVAL[1:]
    groups = _groups(table, by, statistics.values())
    return Estimates([(key, _statistics(rows, statistics)) for key, rows in groups], suffixes)


def _groups(
    table: pa.Table, by: Sequence[str], statistics: Iterable[_Statistic]
) -> Iterator[tuple[dict[str, Any], pa.Table]]:
    """The groups of a table, with the columns that some statistics need."""
    used = [column.partition("=")[0] for one in statistics for column in one.columns]
    optional = {"has_floor", *CLUSTER_COLUMNS}.intersection(table.column_names)
    used = [*by, "status", "phi_u_arcmin", *used, *optional]
    for column in used:
        require_column(table, column)
    yield from group_rows(table.select(list(dict.fromkeys(used))), by)


def _statistics(rows: pa.Table, statistics: Mapping[str, _Statistic]) -> dict[str, Estimate]:
    """The statistics of a group."""
    truth, with_floor = has_truth(rows), select_runs_with_floor(rows)
    found = {
        "n": _count(rows.num_rows),
        "nonfinite": _count(int(status_mask(rows, "nonfinite").sum())),
        "no_floor": _count(rows.num_rows - with_floor.num_rows),
    }
    for name, (columns, estimate, _, needs_truth, needs_floor) in statistics.items():
        used, found[name] = with_floor if needs_floor else rows, UNKNOWN
        if used.num_rows and (truth or not needs_truth):
            values = (_numbers(used, column) for column in columns)
            found[name] = estimate(*values, cluster=cluster_ids(used))
        if name in _CHI2:  # valid for independent runs only
            band = chi2_mean_band(_CHI2[name], found[name].n * has_independent_runs(rows))
            found[f"{name}_chi2"] = Estimate(_CHI2[name], *band, found[name].n)
    return found


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

    Args:
        table: the summary, one row per run.
        by: key columns as for `group_rows`; one run per draw in each group.
        baseline: key values of the group to compare with.

    Returns:
        The groups but the baseline, by first appearance; ``n`` is the number of draws.

    Raises:
        InputError: no runs, no such baseline, a missing column, or draws that differ or repeat.
    """
    statistics = _available_differences(table.column_names)
    found = list(_groups(table, by, statistics.values()))
    key = {name: list(x) if isinstance(x, tuple) else x for name, x in baseline.items()}
    base = next((rows for group, rows in found if group == key), None)
    if base is None:
        raise InputError(f"summary: there are no runs of the baseline {key}")
    truth = has_truth(table)
    groups = [
        (group, {"n": _count(rows.num_rows)} | _differences(rows, base, statistics, truth=truth))
        for group, rows in found
        if rows is not base
    ]
    suffixes = {name: statistic.suffixes for name, statistic in statistics.items()}
    return Estimates(groups, {"n": _COUNT} | suffixes)


def _differences(
    rows: pa.Table, base: pa.Table, statistics: Mapping[str, _Statistic], *, truth: bool
) -> dict[str, Estimate]:
    """The differences of a group from the baseline."""
    orders = paired_row_indices(rows, base)
    pair = [one.take(order) for one, order in zip((rows, base), orders, strict=True)]
    with_floor = all(select_runs_with_floor(one).num_rows == one.num_rows for one in pair)
    found = {}
    for name, (columns, estimate, _, needs_truth, needs_floor) in statistics.items():
        found[name] = UNKNOWN
        if (truth or not needs_truth) and (with_floor or not needs_floor):
            found[name] = estimate(*([_numbers(one, column) for column in columns] for one in pair))
        if not has_independent_runs(rows):  # on one record, where no difference has an interval
            found[name] = found[name]._replace(low=math.nan, high=math.nan)
    return found


# --- the statistics -----------------------------------------------------------------------------

_CHI2 = {"nees_mean": NEES_FREEDOM, "nis_u_mean": 1}
"""Means of chi-square values, and their degrees of freedom."""


def _available_statistics(columns: Sequence[str]) -> dict[str, _Statistic]:
    """All statistics of a table with these columns, by name."""
    found = {
        f"{name}_rate": _Statistic((f"status={status}",), _recorded_share, needs_truth=True)
        for name, status in {"success": "ok", "diverged": "diverged"}.items()
    }
    for flag in (name for name in ("ok_floor", "ok_truth") if name in columns):
        found[f"{flag.replace('ok', 'success')}_rate"] = _Statistic(
            (flag,), _recorded_share, needs_truth=True, needs_floor=flag == "ok_floor"
        )
    for name in (name for name in columns if name.startswith("settle_")):
        by_end: dict[str, tuple[Callable[..., Estimate], tuple[str, ...]]] = {
            f"{name}_median": (quantile, _INTERVAL),
            f"{name}_q90": (partial(quantile, q=0.9), _INTERVAL),
            f"{name}_mean": (partial(mean, limits=(0.0, math.inf)), _MEAN),
        }
        if not name.endswith("_data_s"):
            count = name.replace("settle_", "never_settled_").removesuffix("_s")
            by_end = {count: (_count_missing, _COUNT)} | by_end
        for end, (estimate, suffixes) in by_end.items():
            found[end] = _Statistic((name,), estimate, suffixes, True, "_truth_" not in name)
    for name in (name for name in columns if name == "phi_u_arcmin" or name.startswith(_AT)):
        found[f"{name}_rms"] = _Statistic((name,), partial(rms, max_magnitude=_MOST), _MEAN)
        found[f"{name}_abs_q90"] = _Statistic((name,), partial(_known_quantile, q=0.9, of=np.abs))
    quantiles = {"q10": 0.1, "median": 0.5, "q90": 0.9}
    return found | {
        "phi_u_mean_arcmin_mean": _Statistic((_YAW,), mean, _MEAN),
        "phi_u_mean_arcmin_std": _Statistic((_YAW, "status"), _std_of_single_status, _MEAN),
        **{
            f"phi_u_mean_arcmin_{name}": _Statistic((_YAW,), partial(_finite_quantile, q=q))
            for name, q in quantiles.items()
        },
        "phi_u_from_floor_arcmin_mean": _Statistic((_YAW, _FLOOR), mean_difference, _MEAN),
        "phi_u_std_arcmin_mean": _Statistic(("phi_u_std_arcmin",), mean, _MEAN),
        "nees_median": _Statistic(("nees",), _known_quantile),
        "nees_mean": _Statistic(("nees",), mean, _MEAN),
        "nis_u_mean": _Statistic(("nis_u",), mean, _MEAN),
    }


def _available_differences(columns: Sequence[str]) -> dict[str, _Statistic]:
    """All differences of a table with these columns, by name."""
    found = {"success_rate_difference": _Statistic((_OK,), _share_difference, needs_truth=True)}
    for flag in (name for name in ("ok_floor", "ok_truth") if name in columns):
        found[f"{flag.replace('ok', 'success')}_rate_difference"] = _Statistic(
            (flag,), _share_difference, needs_truth=True, needs_floor=flag == "ok_floor"
        )
    for name in (name for name in columns if name.startswith("settle_")):
        found[f"{name}_median_difference"] = _Statistic(
            (name,),
            lambda a, b: quantile_difference(*a, *b),
            needs_truth=True,
            needs_floor="_truth" not in name,
        )
    return found | {"phi_u_error_arcmin_difference": _Statistic((_YAW, _FLOOR), _closer, _MEAN)}


def _numbers(rows: pa.Table, column: str) -> NDArray:
    """A column as numbers: ``status=ok`` as whether it is, and other words by a code."""
    name, _, word = column.partition("=")
    if word:
        return status_mask(rows, word)
    return encode_values(rows[name]) if name == "status" else numeric_column(rows, name)


def _count(number: int) -> Estimate:
    return Estimate(number, math.nan, math.nan, number)


def _count_missing(values: NDArray, cluster: NDArray | None) -> Estimate:
    return _count(int(np.isnan(values).sum()))


def _recorded_share(flags: NDArray, cluster: NDArray | None) -> Estimate:
    """The share of runs whose flag is set; unknown if it was not recorded."""
    known = np.isfinite(flags)
    of_known = None if cluster is None else cluster[known]
    return share(flags[known], of_known) if known.any() else UNKNOWN


def _std_of_single_status(values: NDArray, status: NDArray, cluster: NDArray | None) -> Estimate:
    """The spread of the window means, which is meaningful only for runs of the same status."""
    return UNKNOWN if np.ptp(status) else std(values, cluster)


def _known_quantile(
    values: NDArray,
    cluster: NDArray | None,
    q: float = 0.5,
    of: Callable[[NDArray], NDArray] = np.asarray,
) -> Estimate:
    return quantile(of(values), q, cluster) if np.isfinite(values).any() else UNKNOWN


def _finite_quantile(values: NDArray, cluster: NDArray | None, q: float) -> Estimate:
    known = np.isfinite(values)
    of_known = None if cluster is None else cluster[known]
    return quantile(values[known], q, of_known) if known.any() else UNKNOWN


def _share_difference(a: Sequence[NDArray], b: Sequence[NDArray]) -> Estimate:
    """The difference of two shares; unknown unless the flag was recorded in every run."""
    return proportion_difference(*a, *b) if np.isfinite([*a, *b]).all() else UNKNOWN


def _closer(a: Sequence[NDArray], b: Sequence[NDArray]) -> Estimate:
    """The difference of two distances of window means from their floors."""
    return mean_difference(*(np.abs(yaw - floor) for yaw, floor in (a, b)))


def read_estimate(row: Mapping[str, Any], name: str) -> Estimate:
    """A statistic in a row of `summarise`; NaN where it is unknown."""
    ends = (row[f"{name}{end}"] for end in _INTERVAL)
    value, low, high = (math.nan if end is None else end for end in ends)
    return Estimate(value, low, high, row["n"])
