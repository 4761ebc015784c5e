"""Numbers of the page on the car test of paper 1, on another car's record."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.plots import Scale, Shown
from sinsjax.report.base import Picture, Source, Table
from sinsjax.report.folder import Page, Sources
from sinsjax.report.grids import Grid, median
from sinsjax.report.output import counted
from sinsjax.units import ARCMIN, DEG

PRINTED = {
    "PHINS, the reference": ((-0.8292, 0.0011), (-0.2441, 0.0046), (85.5903, 0.0024)),
    "Scheme 1": ((-0.8200, 0.0092), (-0.2433, 0.0056), (84.6823, 0.3092)),
    "Scheme 3": ((-0.8202, 0.0098), (-0.2455, 0.0061), (85.0917, 0.1906)),
}
"""Table 3 of the paper: pitch, roll, yaw, each as mean and standard deviation, deg."""

PAPER, UNIT = "paper's tuning", "laser-gyro tuning"
RESETS = (50.0, 100.0, 150.0, 200.0)
ANGLES = ("pitch", "roll", "yaw")
TRUTH = "settle_10_truth_s"


class Scheme(NamedTuple):
    """One scheme under one tuning and feedback interval (s), from every start time."""

    name: str
    tuning: str
    feedback: float
    rows: pa.Table

    @property
    def end(self) -> NDArray:
        """(starts,) heading error from the reference at the end, deg."""
        return analysis.numbers(self.rows, "phi_u_arcmin") * ARCMIN / DEG

    @property
    def mean(self) -> NDArray:
        """(starts,) the same over the window of the paper's table, deg."""
        return analysis.numbers(self.rows, "phi_u_mean_arcmin") * ARCMIN / DEG


def page(sources: Sources) -> Page:
    """The three schemes over all start times, and a batch of misalignments."""
    test, batch = sources["car_test"], sources["car_batch"]
    schemes = schemes_of(test)
    told, claims = _told(schemes)
    covered, more = _batch(batch)
    off = {
        name: abs(angles[2][0] - PRINTED["PHINS, the reference"][2][0])
        for name, angles in PRINTED.items()
    }
    values: dict[str, Any] = {
        "starts": str(test.draws),
        "schemes": told,
        "batch": covered,
        "printed": {"one": f"{off['Scheme 1']:.2f}", "three": f"{off['Scheme 3']:.2f} deg"},
        "no_interval": analysis.NO_INTERVAL,
    }
    return Page(
        values,
        {
            "expected": _expected(schemes),
            "first": _first(test, schemes),
            "printed": _printed(),
        },
        {"yaw": _figure(test, schemes), "batch": _batch_figure(batch)},
        claims
        | more
        | {
            "the paper's schemes are not equally near its reference": (
                off["Scheme 1"] > 1.5 * off["Scheme 3"]
            )
        },
    )


def schemes_of(source: Source) -> list[Scheme]:
    """The runs by scheme and setting, in the study's order."""
    found = []
    keys = ("case", "feedback_interval_s")
    for key, rows in analysis.groups(source.summary, keys):
        name, _, tuning = str(key["case"]).partition(", ")
        found.append(Scheme(name.capitalize(), tuning, float(key["feedback_interval_s"]), rows))
    return found


def _told(schemes: Sequence[Scheme]) -> tuple[dict[str, Any], dict[str, bool]]:
    worst = {(s.name, s.tuning, s.feedback): float(np.abs(s.end).max()) for s in schemes}

    def over(name: str, tuning: str) -> float:
        return max(worst[name, tuning, feedback] for feedback in (0.01, 1.0))

    values = {
        "aligned": f"{over('Scheme 1', UNIT):.3f} deg",
        "resets": f"{over('Scheme 3', UNIT):.3f} deg",
        "without": f"{over('Scheme 2', UNIT):.3f} deg",
        "often": f"{worst['Scheme 2', UNIT, 0.01]:.3f} deg",
        "paper_resets": f"{over('Scheme 3', PAPER):.3f} deg",
        "paper_without": f"{over('Scheme 2', PAPER):.1f} deg",
    }
    claims = {
        "with resets the misaligned runs end as near as the aligned ones": (
            over("Scheme 3", UNIT) < 1.5 * over("Scheme 1", UNIT)
        ),
        "without resets the paper's tuning and feedback every second fail": (
            over("Scheme 2", PAPER) > 1
        ),
        "with feedback at every sample the unit's tuning needs no resets": (
            worst["Scheme 2", UNIT, 0.01] < 1.5 * over("Scheme 1", UNIT)
        ),
        "the unit's tuning ends nearer than the paper's": (
            over("Scheme 3", UNIT) < over("Scheme 3", PAPER) / 2
        ),
    }
    return values, claims


def _grid(source: Source) -> Grid:
    return Grid.of(
        source,
        (TRUTH,),
        resets=[tuple(times) for times in source.study.reset_times()],
        level=source.study.values("phi_e0_deg"),
        yaw=source.study.values("phi_u0_deg"),
    )


def _batch(source: Source) -> tuple[dict[str, Any], dict[str, bool]]:
    grid = _grid(source)
    without, resets = (grid.at(TRUTH, resets=times) for times in ((), RESETS))
    share = [100 * float(np.isfinite(runs).mean()) for runs in (without, resets)]
    small = grid.at(TRUTH, resets=(), yaw=[-10, 0, 10])
    values = {
        "runs": str(source.runs),
        "without": f"{share[0]:.0f} %",
        "resets": f"{share[1]:.0f} %",
        "misalignments": str(without[..., 0].size),
        "slowest": f"{median(resets).max():.0f} s",
        "small": f"{100 * np.isfinite(small).mean():.0f} %",
    }
    claims = {
        "with four resets every run of the batch settles": share[1] == 100,
        "without them many do not": share[0] < 75,
        "small heading errors settle without": bool(np.isfinite(small).all()),
    }
    return values, claims


def _batch_figure(source: Source) -> Picture:
    grid = _grid(source)
    panels = [
        (words, median(grid.at(TRUTH, resets=times)))
        for words, times in (("no reset", ()), ("four at 50, 100, 150 and 200 s", RESETS))
    ]
    figure = plots.heat_maps(
        panels,
        "How long until the heading stays within 10' of the reference?",
        Shown("median settling time (s)", 0.0, source.study.duration_s, reverse=True),
        rows=Scale("added level error_deg", grid.axes["level"]),
        columns=Scale("added heading error_deg", grid.axes["yaw"]),
        across=2,
    )
    caption = (
        f"Median over {grid.draws} start times on one record; light is good, hatched: at least half"
        " never settle. Level errors about east, 5 deg about north."
    )
    return Picture("batch", caption, figure, counted(source))


def _expected(schemes: Sequence[Scheme]) -> Table:
    rows = []
    for s in schemes:
        settle = analysis.numbers(s.rows, TRUTH)
        ok = int(np.isfinite(settle).sum())
        time = analysis.quantile(settle).value
        rows.append(
            [
                s.name,
                f"{s.tuning}, feedback {s.feedback:g} s",
                f"{np.median(s.end):+.4f}",
                f"{np.abs(s.end).max():.4f}",
                f"{np.abs(s.mean).max():.4f}",
                f"{ok} of {settle.size}",
                "never" if np.isinf(time) else f"{time:.0f}",
            ]
        )
    header = ["", "setting", "at the end: median", "worst", "300 to 500 s mean: worst"]
    return Table(
        "What to expect: heading error from the reference (deg)",
        [*header, "settled to 10'", "median time (s)"],
        rows,
    )


def _first(source: Source, schemes: Sequence[Scheme]) -> Table:
    """Window statistics from the first start time, beside the reference's, as Table 3."""
    header = ["", "setting"]
    for angle in ANGLES:
        header += [f"{angle} mean (deg)", "std"]
    header += [f"{angle} from reference (deg)" for angle in ANGLES]
    reference = _reference_window(source, schemes[0])
    rows = [["reference", "", *(f"{x:.4f}" for pair in reference for x in pair), *["-"] * 3]]
    for s in schemes:
        first = s.rows.slice(0, 1).to_pylist()[0]
        cells = [
            f"{first[f'{a}_{statistic}_deg']:.4f}" for a in ANGLES for statistic in ("mean", "std")
        ]
        cells += [
            f"{_wrapped(first[f'{a}_mean_deg'] - mean):+.4f}"
            for a, (mean, _) in zip(ANGLES, reference, strict=True)
        ]
        rows.append([s.name, f"{s.tuning}, feedback {s.feedback:g} s", *cells])
    start, end = source.study.study.window_s
    title = f"From the record's first start: mean and standard deviation, {start:g} to {end:g} s"
    return Table(title, header, rows, folded=True)


def _printed() -> Table:
    reference = PRINTED["PHINS, the reference"]
    rows = []
    for name, angles in PRINTED.items():
        cells = [f"{x:.4f}" for pair in angles for x in pair]
        apart = [f"{a[0] - r[0]:+.4f}" for a, r in zip(angles, reference, strict=True)]
        rows.append([name, *cells, *(["-"] * 3 if angles is reference else apart)])
    header = [""]
    for angle in ANGLES:
        header += [f"{angle} mean (deg)", "std"]
    header += [f"{angle} from reference (deg)" for angle in ANGLES]
    return Table("The paper's Table 3, another vehicle", header, rows, folded=True)


def reference_attitude(curves: pa.Table) -> NDArray:
    """Pitch, roll and yaw of the reference, (records, 3) deg, from a run's attitude and phi.

    C_true = exp(phi x) C_hat, so that the reference needs no file of its own.
    """
    from scipy.spatial.transform import Rotation

    columns = [analysis.numbers(curves, f"{angle}_deg") for angle in ("yaw", "pitch", "roll")]
    phi = np.column_stack([analysis.numbers(curves, f"phi_{a}_arcmin") for a in "enu"])
    estimate = Rotation.from_euler("ZXY", np.column_stack(columns), degrees=True)
    true = Rotation.from_rotvec(phi * ARCMIN) * estimate
    return np.asarray(true.as_euler("ZXY", degrees=True)[:, [1, 2, 0]])


def _reference_window(source: Source, scheme: Scheme) -> list[tuple[float, float]]:
    curves = source.curves([scheme.rows["run_id"][0].as_py()])
    time = analysis.numbers(curves, "time_s")
    start, end = source.study.study.window_s
    angles = reference_attitude(curves)[(time > start) & (time <= end)]
    angles = np.rad2deg(np.unwrap(np.deg2rad(angles), axis=0))
    return [(float(a.mean()), float(a.std(ddof=1))) for a in angles.T]


def _wrapped(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0


def _figure(source: Source, schemes: Sequence[Scheme]) -> Picture:
    settings: dict[str, dict[str, Sequence[int]]] = {}
    for s in schemes:
        panel = f"{s.tuning}, feedback {s.feedback:g} s"
        settings.setdefault(panel, {})[s.name] = s.rows["run_id"].to_pylist()
    curves = source.curves()
    panels = {name: plots.ensembles(curves, runs) for name, runs in settings.items()}
    figure = plots.yaw_errors(panels, "Heading error of the three schemes, from the reference")
    caption = f"Mean over {source.draws} start times on one record; shading: 95 % of them."
    return Picture("yaw_error", caption, figure, counted(source))
