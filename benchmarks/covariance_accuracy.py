"""How near covariance analysis comes to draws: sigma, settling times and shares within a band.

Paper 1's base, sensors and filter. *Reference*: sigma of the heading error by derivatives of the
filter's own steps (`tests/oracles/tangents.py`), over that of draws, from four starts with four
schedules of resets at six times. *Estimates*: ``estimate = "covariance"`` over random schedules of
resets, the mean settling time averaged over eight heading errors, and the share of runs within the
band at six times. Each row says what it has to keep to and whether it does: of ratios and shares,
whether their 95 % intervals, corrected for how many they are, meet the bar.
"""

import argparse
import copy
import sys
import tomllib
from typing import Any, NamedTuple

import common
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy import stats

import sinsjax
from sinsjax.bench.timing import Row, measurement_conditions
from sinsjax.engine import build

sys.path.insert(0, str(common.ROOT / "tests"))

from oracles import tangents  # noqa: E402
from support.bootstrap import bootstrap_intervals  # noqa: E402

BAND = 10.0  # arcmin
STARTS = ((0.0, 0.0, 0.0), (0.0, 0.0, 30.0), (5.0, 5.0, 30.0), (20.0, 20.0, 120.0))
"""Misalignment about e, n and u, deg."""

SCHEDULES = ([], [10.0, 60.0], [11.0, 24.0, 57.0], [50.0, 100.0, 150.0])
"""Reset times, s."""

SIGMA_BAR = (0.90, 1.10)
SPEARMAN_BAR, RMS_BAR_S, SHARE_BAR = 0.995, 4.0, 0.05


class Size(NamedTuple):
    """What is run.

    Attributes:
        reference_draws: draws that the reference is held against.
        reference_times_s: times at which it is; the last is the length of its runs.
        schedules: random ones.
        draws: draws that estimates are held against.
        times_s: times of shares; the last is the length of those runs.
    """

    reference_draws: int = 1024
    reference_times_s: tuple[float, ...] = (30, 60, 120, 200, 300, 400)
    schedules: int = 40
    draws: int = 256
    times_s: tuple[float, ...] = (100, 200, 300, 450, 600, 900)


QUICK = Size(16, (20, 160), 3, 4, (100, 200))


def rows(size: Size, seed: int) -> list[Row]:
    """Both comparisons.

    Args:
        size: what is run.
        seed: of the schedules, of the noise and of the resamples.
    """
    return [_reference(size, seed), *_estimates(size, seed)]


def study_of(changes: dict[str, dict[str, Any]], times_s: tuple[float, ...], seed: int) -> Any:
    """The default sweep's base, sensors and filter with other starts and schedules."""
    data = tomllib.loads((common.ROOT / "configs/reset_sweep.toml").read_text(encoding="utf-8"))
    *earlier, end = times_s
    data["study"] |= {
        **{"duration_s": end, "window_s": [end / 2, end], "report_times_s": earlier},
        **{"steady_after_s": end / 2, "consistency_after_s": 1.0, "seed": seed},
        "settle_bands_arcmin": [BAND],
    }
    del data["axes"]
    for section, keys in copy.deepcopy(changes).items():
        data[section] = data.get(section, {}) | keys if isinstance(keys, dict) else keys
    data["study"] = {key: value for key, value in data["study"].items() if value is not None}
    return sinsjax.study_from_dict(data)


def _reference(size: Size, seed: int) -> Row:
    """The interval of each ratio, by the bootstrap, corrected for the number of them."""
    times = size.reference_times_s
    axes = [
        {"phi_e0_deg": e, "phi_n0_deg": n, "phi_u0_deg": u, "reset_times_s": resets}
        for e, n, u in STARTS
        for resets in SCHEDULES
    ]
    given = {"draws": size.reference_draws, "judged_from": "truth"}
    changes: Any = {"study": given, "cases": axes}
    study = study_of(changes, times, seed)
    (part,) = build.parts(study)
    sigma = tangents.spread(part.group).sigma[..., 2]
    at = [round(t / study.study.record_interval_s) - 1 for t in times]
    told = np.radians(_heading_errors(study, times) / 60).reshape(size.reference_draws, -1)
    expected = sigma[:, at].T.ravel()
    ratio = told.std(axis=0, ddof=1) / expected
    low, high = bootstrap_intervals(told, 0.05 / ratio.size, seed) / expected
    misses = (high < SIGMA_BAR[0]) | (low > SIGMA_BAR[1])
    return {
        **{"name": "sigma of draws / reference", "compared": ratio.size},
        **{"least": round(ratio.min(), 3), "greatest": round(ratio.max(), 3)},
        **{"bar": "0.90..1.10", "misses": int(misses.sum())},
        "kept": not misses.any(),
    }


def _heading_errors(study: Any, times_s: tuple[float, ...]) -> NDArray:
    """(draws, times, variants) heading errors of draws, arcmin."""
    summary = sinsjax.run(study).summary
    *earlier, _ = times_s
    names = [*(f"phi_u_at_{t:g}_arcmin" for t in earlier), "phi_u_arcmin"]
    columns = [summary[name].to_numpy().reshape(study.n_draws, -1) for name in names]
    return np.stack(columns, axis=1)


def _estimates(size: Size, seed: int) -> list[Row]:
    """Settling times and shares of the same variants, without draws and with them."""
    random, end = np.random.default_rng(seed), size.times_s[-1]
    schedules = [
        sorted(random.uniform(0.003 * end, end / 3, random.integers(1, 6)).round(2).tolist())
        for _ in range(size.schedules)
    ]
    headings = [0.0, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0]
    axes = {"reset_times_s": schedules, "phi_u0_deg": headings}
    estimated = {"estimate": "covariance", "draws": None, "check_linearity": False}
    table = sinsjax.estimate(study_of({"study": estimated, "axes": axes}, size.times_s, seed))
    drawn = study_of({"study": {"draws": size.draws}, "axes": axes}, size.times_s, seed + 1)
    summary = sinsjax.run(drawn).summary
    settled = summary[f"settle_{BAND:g}_s"].fill_null(float(end)).to_numpy()
    settled = settled.reshape(size.draws, len(schedules), -1).mean(axis=(0, 2))
    expected = table[f"settle_{BAND:g}_mean_s"].to_numpy().reshape(len(schedules), -1).mean(1)
    rms = float(np.sqrt(np.mean((settled - expected) ** 2)))
    spearman = float(stats.spearmanr(settled, expected).statistic)
    apart = shares(size, summary, table)
    return [
        {
            **{"name": "settling, Spearman", "compared": len(schedules)},
            **{"least": round(spearman, 5), "bar": f">= {SPEARMAN_BAR}"},
            "kept": spearman >= SPEARMAN_BAR,
        },
        {
            **{"name": "settling, rms (s)", "compared": len(schedules)},
            **{"greatest": round(rms, 2), "bar": f"<= {RMS_BAR_S:g}", "kept": rms <= RMS_BAR_S},
        },
        apart,
    ]


def shares(size: Size, summary: pa.Table, table: pa.Table) -> Row:
    """The exact interval of each share of draws, corrected for the number of them."""
    *earlier, _ = size.times_s
    inside, expected = [], []
    for at in (*(f"_at_{t:g}" for t in earlier), ""):
        error = summary[f"phi_u{at}_arcmin"].to_numpy() - summary["floor_arcmin"].to_numpy()
        inside.append((np.abs(error) <= BAND).reshape(size.draws, -1).sum(axis=0))
        expected.append(table[f"within_{BAND:g}{at}_share"].to_numpy())
    count, share = np.array(inside), np.array(expected)
    tail = 0.025 / count.size
    low = np.where(count == 0, 0.0, stats.beta.ppf(tail, count, size.draws - count + 1))
    high = np.where(
        count == size.draws, 1.0, stats.beta.ppf(1 - tail, count + 1, size.draws - count)
    )
    apart = np.abs(count / size.draws - share)
    misses = (low - share > SHARE_BAR) | (share - high > SHARE_BAR)
    return {
        **{"name": "share in band, apart", "compared": apart.size},
        **{"greatest": round(float(apart.max()), 3), "bar": f"<= {SHARE_BAR}"},
        **{"beyond": int((apart > SHARE_BAR).sum()), "misses": int(misses.sum())},
        "kept": not misses.any(),
    }


def main() -> None:
    """Measure and print; no timing, so it is no set of the history."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does it work?")
    parser.add_argument(
        "--draws", type=int, help=f"that estimates are held against ({Size().draws})"
    )
    parser.add_argument("--seed", type=int, default=1, help="of schedules and noise")
    flags = parser.parse_args()
    sinsjax.configure()
    size = QUICK if flags.quick else Size()
    size = size._replace(draws=flags.draws or size.draws)
    common.show(rows(size, flags.seed), measurement_conditions(), as_json=flags.json)


if __name__ == "__main__":
    main()
