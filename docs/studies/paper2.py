"""Tables, figure and numbers of docs/paper2.md.

    python -m docs.studies.paper2 DIR DIR [-o FOLDER]

The directories have the results of paper2_static and paper2_swing. An error is estimate minus
truth, which is -phi; heading is positive counter-clockwise.
"""

import math
from collections.abc import Mapping, Sequence
from decimal import Decimal

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import expm

import sinsjax
from docs.studies.common import Page, Runs, read_arguments
from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate
from sinsjax.plots.style import with_style

GRAVITY, RADIUS = 9.8, 6378165.0  # m/s^2, m: of the paper's gains; the digits of K2 fix R
LEVEL_SIGMA, AZIMUTH_SIGMA = 0.02, 0.01  # 1/s, decay rates that the printed K1 mean
DAMPING = math.sqrt(0.5)
LEVEL_K3 = "0.000081632653"  # as printed
ANGLES = {"pitch": ("e", 5), "roll": ("n", 5), "heading": ("u", 4)}
"""The axis of phi of each angle, and the decimals of a degree in the paper's tables."""

PRINTED = {1: (0.00261, -0.00208, 0.0251), 2: (0.00234, -0.00209, 0.0236)}
"""Pitch, roll and heading of Tables 1 and 2 by scheme, deg; the two tables are identical."""

TURNS = {
    "velocity": "paper's turn",
    "velocity_and_rate": "rate reversed too",
    "reflect": "tilt reflected",
}
SHOWN = ("Scheme 2, V flipped", "Scheme 2, V and azimuth rate flipped", "Scheme 2, reflected")
PRINTED_K3 = "Scheme 1, K3 as printed"


class Case:
    """The runs of one variant of a study."""

    def __init__(self, runs: Runs, variant: int) -> None:
        """Read a variant."""
        self.runs, self.variant = runs, variant
        keys = ("case", "turn", "stored_s", "phi_u0_deg", "misalignment", "gyro_bias_deg_per_h")
        self.name, turn, self.stored_s, self.start_deg, self.misalignment, self.drift = (
            runs.study.values(key)[variant] for key in keys
        )
        self.scheme = 1 if self.stored_s >= runs.end_s else 2
        more = self.name.split(", ")[2:]
        self.label = ", ".join(["Scheme 2", TURNS[turn], *more]) if self.scheme == 2 else self.name
        self.floor = floor_deg(runs, self.drift)

    def means(self, angle: str) -> NDArray:
        """Return window means of an angle's error, (draws,), deg."""
        return -self.runs.column(f"phi_{ANGLES[angle][0]}_mean_arcmin")[self.variant] / 60

    def mean(self, angle: str) -> str:
        """Return the mean over the draws as text."""
        return format_estimate(analysis.mean(self.means(angle)), digits=ANGLES[angle][1])

    def headings(self) -> tuple[NDArray, NDArray]:
        """Return record times (T,), s, and heading errors from the floor, (draws, T), deg."""
        study = self.runs.study
        ids = [draw * study.n_variants + self.variant for draw in range(self.runs.draws)]
        curves = sinsjax.read_curves(self.runs.directory, ids)
        (one,) = plots.group_curves(curves, {self.name: ids})
        return one.time_s, -one.columns["phi_u_arcmin"] / 60 - self.floor

    def heading_at(self, time_s: float) -> NDArray:
        """Return heading errors from the floor at the record nearest to a time, (draws,), deg."""
        times, errors = self.headings()
        return np.asarray(errors[:, np.argmin(np.abs(times - time_s))])


def biases(runs: Runs) -> tuple[float, float]:
    """Return the north Earth rate, deg/h, and the heading of the accelerometer bias, deg."""
    keys = ("earth_rate_deg_per_h", "latitude_deg", "accel_bias_ug")
    rate, latitude_deg, bias_ug = (float(runs.study.values(key)[0]) for key in keys)
    latitude = math.radians(latitude_deg)
    return rate * math.cos(latitude), math.degrees(bias_ug * 1e-6) * math.tan(latitude)


def floor_deg(runs: Runs, drift: float) -> float:
    """Return what the heading error settles to, eps_E/omega_N - (nabla_E/g) tan L, deg."""
    rate_n, accel = biases(runs)
    return math.degrees(drift / rate_n) - accel


def cycle_radius(turn: str, stored_s: float, smoothing_s: float) -> float:
    """Return the spectral radius of the azimuth loop over a forward and a backward pass.

    The states are dV_N, phi_E, phi_U, w_cU, and the specific force over g, low-passed twice; units
    of g = R = omega_N = 1.
    """
    square, lag = (AZIMUTH_SIGMA / DAMPING) ** 2, 2 / smoothing_s
    matrix = np.zeros((6, 6))
    matrix[0, :2] = -2 * AZIMUTH_SIGMA, 1.0
    matrix[1, [0, 2]] = -2 * square, -1.0
    matrix[2, 3] = 1.0
    matrix[3, [0, 3]] = square**2, -2 * AZIMUTH_SIGMA
    matrix[4, [1, 4]] = matrix[5, [4, 5]] = lag, -lag
    forward = expm(matrix * stored_s)
    mirror = np.diag([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])  # time reversed: velocity, tilt, force
    rate, left = (-1.0 if turn == name else 1.0 for name in ("velocity_and_rate", "reflect"))
    made = np.diag([-1.0, 1.0, 1.0, rate, left, left])
    made[1, 5] = left - 1
    return float(np.abs(np.linalg.eigvals(made @ mirror @ forward @ mirror @ made @ forward)).max())


def write_tables(cases: Sequence[Case], page: Page) -> None:
    """Write the window means of every case next to the printed ones."""
    heading_rows, rows = [], []
    for scheme, printed in PRINTED.items():
        label = f"Scheme {scheme}, as printed"
        texts = [f"{a:.{n}f}" for a, (_, n) in zip(printed, ANGLES.values(), strict=True)]
        rows.append([label, "", *texts, ""])
        heading_rows.append([label, texts[-1]])
        for case in (case for case in cases if case.scheme == scheme):
            means = [case.mean(angle) for angle in ANGLES]
            rows.append([case.label, f"{case.drift:g}", *means, f"{case.floor:.4f}"])
            if case in stated(cases):
                heading_rows.append([case.label, means[-1]])
    page.show("Expected and printed", ["", "heading (deg)"], heading_rows)
    header = ["", "gyro drift (deg/h)", *(f"{a} (deg)" for a in ANGLES), "bias floor (deg)"]
    page.table("paper2_table_1", header, rows)


def stated(cases: Sequence[Case]) -> list[Case]:
    """Return the cases with the stated drift and signs of the start, as a rotation vector."""
    drift = cases[0].drift
    same = [case for case in cases if case.drift == drift and case.start_deg < 0]
    return [case for case in same if case.misalignment == "vector"]


def say_drift(runs: Runs, page: Page) -> None:
    """Print the biases that the printed means would follow from."""
    rate_n, accel = biases(runs)
    drifts = [math.radians(heading + accel) * rate_n for *_, heading in PRINTED.values()]
    levels = [abs(math.radians(angle)) * 1e6 for means in PRINTED.values() for angle in means[:2]]
    page.print_numbers(
        floor=f"{floor_deg(runs, runs.study.values('gyro_bias_deg_per_h')[0]):.4f} deg",
        drifts_of_printed_headings=" and ".join(f"{drift:.4f}" for drift in drifts) + " deg/h",
        accel_biases_of_printed_levels=f"{min(levels):.0f} to {max(levels):.0f} ug",
    )


def say_unsettled(cases: Sequence[Case], page: Page) -> None:
    """Print how far from its floor the heading of Scheme 1 is in the window, and how it moves."""
    start, end = cases[0].runs.study.study.window_s
    ours = [case for case in cases if case.drift == cases[0].drift]
    moves = [abs(np.mean(case.heading_at(end) - case.heading_at(start))) for case in ours]
    means = [np.mean(case.means("heading")) for case in ours]
    every = [analysis.mean(case.means("heading")) for case in cases]
    near = min(every, key=lambda one: abs(one.value - PRINTED[1][2]))
    page.print_numbers(
        moves=f"{min(moves):.3f} to {max(moves):.3f} deg from {start:g} to {end:g} s",
        means=f"{min(means):.4f} to {max(means):.4f} deg",
        nearest=f"{format_estimate(near, 'deg', 4)} of {len(cases)} interpretations",
        first_at_start=format_estimate(analysis.mean(cases[0].heading_at(start)), "deg", 4),
    )


def say_gains(status: Sequence[str], page: Page) -> None:
    """Print the printed gains beside the formulas of eqs (18) and (23), and what their K3 does."""

    def gains(sigma: float, level: bool) -> tuple[float, float, float]:
        square, g = (sigma / DAMPING) ** 2, GRAVITY
        if level:
            return 3 * sigma, (2 * sigma**2 + square) * RADIUS / g - 1, sigma * square / g
        return 2 * sigma, 2 * square * RADIUS / g - 1, square**2 / g

    k1, k2, k3 = gains(LEVEL_SIGMA, True)
    texts = ("0.06", "1040.33306122", LEVEL_K3, "0.02", "259.3332653", "4.082e-9")
    formulas = (k1, k2, k3, *gains(AZIMUTH_SIGMA, False))
    unlike = [text for text, one in zip(texts, formulas, strict=True) if not agrees(text, one)]
    polynomial = [1.0, k1, (1 + k2) * GRAVITY / RADIUS, GRAVITY * float(LEVEL_K3)]
    root = max(np.roots(polynomial), key=lambda one: one.real)
    period_s = 2 * math.pi / abs(root.imag)
    page.print_numbers(
        printed_unlike_formula=", ".join(unlike),
        k3_ratio=f"{float(LEVEL_K3) / k3:.0f}",
        k3_lacks_a_sigma=agrees(LEVEL_K3, k3 / LEVEL_SIGMA),
        root=f"{root.real:+.4f} ± {abs(root.imag):.4f}j 1/s",
        grows=f"{math.exp(root.real * period_s):.2f} times every {period_s:.1f} s",
        diverged=f"{status.count('diverged')} of {len(status)}",
    )


def agrees(text: str, value: float) -> bool:
    """Return whether a value, rounded to the digits of a printed number, is that number."""
    printed = Decimal(text)
    digits = len(printed.as_tuple().digits) - 1
    return f"{Decimal(value):.{digits}e}" == f"{printed:.{digits}e}"


def say_turns(cases: Mapping[str, Case], page: Page) -> None:
    """Print what each turn leaves of the heading error, and draw it."""
    shown = [cases[name] for name in SHOWN]
    runs, stored_s = shown[0].runs, shown[0].stored_s
    smoothing_s = runs.study.values("turn_smoothing_s")[0]
    radii = [cycle_radius(turn, stored_s, smoothing_s) for turn in TURNS]
    ends = [float(np.mean(case.means("heading"))) - case.floor for case in shown]
    page.print_numbers(
        grows=f"{np.mean(shown[0].heading_at(0.0)):.1f} to {ends[0]:.1f} deg",
        reflected_ends=f"{abs(ends[2]):.2f} deg",
        cycle_leaves=f"{radii[0]:.3f}, {radii[1]:.3f}, {radii[2]:.2f}",
        without_lag=f"{math.exp(-2 * AZIMUTH_SIGMA * stored_s):.2f}",
    )
    page.figure("paper2_turns", draw_turns(shown), runs.footer)


@with_style
def draw_turns(cases: Sequence[Case]) -> Figure:
    """Draw the heading error over update time, by turn."""
    figure = Figure(figsize=(9.2, 4.6))
    figure.suptitle("Heading error of Scheme 2 from its bias floor, by its turn")
    axes = figure.subplots()
    for case, label, colour in zip(cases, TURNS.values(), plots.COLOURS, strict=False):
        plots.draw_mean_and_95_percent_band(axes, label, *case.headings(), colour)
    axes.set(xlim=(0, cases[0].runs.end_s), xlabel="update time (s)")
    axes.set_ylabel("heading error from its bias floor (deg)")
    figure.legend(loc="outside lower center", ncols=len(cases))
    return figure


def main() -> None:
    """Write the tables and the figure."""
    runs, page = read_arguments(__doc__, ("paper2_static", "paper2_swing"))
    static, swing = ([Case(r, k) for k in range(r.study.n_variants)] for r in runs.values())
    shown = [case for case in static if case.name != PRINTED_K3]
    first = {case.name: case for case in static if case.drift == static[0].drift}
    write_tables(shown, page)
    say_drift(runs["paper2_static"], page)
    say_unsettled([case for case in shown if case.scheme == 1], page)
    say_turns(first, page)
    rows = runs["paper2_static"].rows("case", "status").to_pylist()
    say_gains([row["status"] for row in rows if row["case"] == PRINTED_K3], page)
    moved = {(case.name, case.drift): case.means("heading") for case in swing}
    pairs = [(moved[c.name, c.drift], c.means("heading")) for c in stated(shown)]
    apart = sorted(abs(analysis.mean_difference(*pair).value) for pair in pairs)
    page.print_numbers(bases_differ=f"{apart[0]:.4f} to {apart[-1]:.4f} deg")


if __name__ == "__main__":
    main()
