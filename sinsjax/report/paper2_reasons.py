"""Why paper 2's stated numbers do not give its printed tables, told once for both bases."""

from collections.abc import Mapping, Sequence

import numpy as np

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.report.base import Report, Section, Source, Table, Text, only, percent, value_text
from sinsjax.report.compass_runs import bound_arcmin
from sinsjax.report.gains import gain_blocks
from sinsjax.report.linear import heading_from_limit, loops_of
from sinsjax.report.paper2 import (
    ANGLES,
    DIGITS,
    PRINTED,
    Case,
    Curves,
    cases_of,
    curves_of,
    drift_text,
)
from sinsjax.report.paper2_loops import Told, divergence, turns
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, MICRO

_HORIZON_S = 3000.0  # how far the linear loops are followed


def report(sources: Sequence[Source]) -> Report:
    """The reasons, from the studies of one or both bases.

    Args:
        sources: results of layout ``paper2``; what one base shows is taken from the first.
    """
    source, cases = sources[0], cases_of(sources[0])
    stated = [case for case in cases if case.drift == cases[0].drift]
    curves = dict(zip((c.label for c in stated), curves_of(source, stated), strict=True))
    told = {
        "The limit, and the drift behind the printed headings": _limit(cases),
        "Not settled at the end": _unsettled(cases, curves),
        "The turn between passes": turns(stated, curves),
        "The printed K3 of the levelling loop": divergence(stated, curves),
        "What a short tape holds": _spread(stated),
        "Static and swing base": _bases(sources),
        "How the initial errors are read": _angles(source, stated),
    }
    found = {heading: one for heading, one in told.items() if one}
    sections = [Section(heading, one.blocks) for heading, one in found.items()]
    sections.append(Section("The printed gains", gain_blocks()))
    return Report([one.headline for one in found.values()], sections)


def _limit(cases: Sequence[Case]) -> Told:
    """The limit of the heading error, and the biases that the printed means would follow from."""
    first = cases[0]
    implied = {
        scheme: {angle: _implied(first, angle, printed[angle]) for angle in ANGLES}
        for scheme, printed in PRINTED.items()
    }
    random = only(first.study, "gyro_noise_deg_per_h")
    drifts = " and ".join(f"{biases['heading']:.4f}" for biases in implied.values())
    others = {case.drift: case.limits.heading for case in cases if case.drift != first.drift}
    found = "".join(f", {at:.4f} deg for {drift_text(drift)}" for drift, at in others.items())
    return Told(
        f"The limit of the heading error is {first.limits.heading:.4f} deg for the stated drift of"
        f" {drift_text(first.drift)}{found}. Had they settled, the printed headings would come from"
        f" drifts of {drifts} deg/h.",
        [
            _limit_table(cases),
            Table(
                "The biases of which the printed means are the limits",
                [
                    "",
                    "accelerometer, by pitch (ug)",
                    "accelerometer, by roll (ug)",
                    "gyro drift, by heading (deg/h)",
                ],
                [
                    [
                        f"Scheme {scheme}",
                        *(f"{biases[angle]:.1f}" for angle in ("pitch", "roll")),
                        f"{biases['heading']:.4f}",
                    ]
                    for scheme, biases in implied.items()
                ],
                f"Stated: {value_text(only(first.study, 'accel_bias_ug'))} ug and"
                f" {drift_text(first.drift)}.",
            ),
            Text(
                f"The stated {drift_text(first.drift)} cannot settle to the printed headings. They"
                " are what a constant drift of the size of the stated *random* one,"
                f" {value_text(random)} deg/h, settles to. That this is what was simulated is"
                " inferred, not printed."
            ),
        ],
    )


def _limit_table(cases: Sequence[Case]) -> Table:
    rows = []
    for drift, case in {case.drift: case for case in cases}.items():
        limits, model = case.limits, loops_of(case.study)
        k = model.params.azimuth
        # [P2] eq. (2) at rest: the loop answers eps_U with a velocity, and that with a heading.
        loop = (1 + k.k2) * k.k4 / (model.earth["radius"] * k.k3) * drift * DEG_PER_H / DEG
        rows.append(
            [
                value_text(drift),
                f"{limits.gyro:.4f}",
                f"{limits.accel:.4f}",
                f"{limits.heading:.4f}",
                f"{analysis.numbers(case.rows, 'floor_arcmin')[0]:.3f}",
                f"{loop:.4f}",
            ]
        )
    return Table(
        "The limit of the heading error (deg)",
        [
            "gyro drift (deg/h)",
            "eps_E/omega_N",
            "-(nabla_E/g) tan L",
            "both",
            "as phi_u, floor_arcmin (arcmin)",
            "left out: 2 eps_U/sigma of the azimuth loop",
        ],
        rows,
    )


def _implied(case: Case, angle: str, printed: float) -> float:
    """The bias of which a printed mean is the limit: ug for pitch and roll, deg/h for heading."""
    if angle == "heading":
        return case.drift * (printed - case.limits.accel) / case.limits.gyro
    return printed * DEG / MICRO * (1 if angle == "pitch" else -1)


def _unsettled(cases: Sequence[Case], curves: Mapping[str, Curves]) -> Told | None:
    """How far from its limit the heading is in the window, and how it still moves there."""
    drift = cases[0].drift
    stable = [case for case in cases if case.is_stable and case.drift == drift]
    forward = [case for case in stable if case.scheme == 1]
    if not forward:
        return None
    start, end = forward[0].study.study.window_s
    moved = {
        case.label: analysis.difference(
            *(curves[case.label].at("heading", time) for time in (end, start))
        ).value
        for case in forward
    }
    means = {case.label: analysis.mean(case.mean_errors("heading")).value for case in forward}
    told = (f"{name}: {means[name]:.4f} deg, moving by {moved[name]:+.3f} deg" for name in means)
    sizes = [abs(size) for size in moved.values()]
    return Told(
        f"Not settled: from {start:g} to {end:g} s the heading of Scheme 1 still moves by"
        f" {min(sizes):.3f} to {max(sizes):.3f} deg, and by what the paper leaves open its mean is"
        f" anything from {min(means.values()):.4f} to {max(means.values()):.4f} deg."
        f" {_nearest(cases)}",
        [
            _unsettled_table(stable, curves),
            Text(
                f"The paper calls {start:g} to {end:g} s fully stabilised. With its own gains,"
                f" sigma = {loops_of(forward[0].study).sigma:g} 1/s in azimuth, what is left of the"
                f" initial error is still there. Means: {'; '.join(told)}. How much is left depends"
                " on when the azimuth loop takes over and on the signs of the initial errors, and"
                " the paper tells neither. Linear loops without noise leave the same: it is no"
                " matter of draws."
            ),
        ],
    )


def _nearest(cases: Sequence[Case]) -> str:
    """Which run of Scheme 1 comes nearest to the printed heading, in a sentence."""
    printed = PRINTED[1]["heading"]
    forward = [case for case in cases if case.is_stable and case.scheme == 1]
    means = [analysis.mean(case.mean_errors("heading")) for case in forward]
    case, mean = min(
        zip(forward, means, strict=True), key=lambda pair: abs(pair[1].value - printed)
    )
    return (
        f"Nearest to the printed {printed:.4f} deg of {len(forward)} readings: {_deg(mean)} deg"
        f" ({case.label}, drift {drift_text(case.drift)})."
    )


def _unsettled_table(cases: Sequence[Case], curves: Mapping[str, Curves]) -> Table:
    settings = cases[0].study.study
    bands = sorted(settings.settle_bands_arcmin)[1::-1]
    times = np.asarray(settings.window_s)
    rows = []
    for case in cases:
        simulated = (curves[case.label].at("heading", t) - case.limits.heading for t in times)
        linear = heading_from_limit(case.study, times)
        pairs = zip(simulated, linear, strict=True)
        cells = [(_deg(analysis.mean(s)), f"{x:.4f}") for s, x in pairs]
        rows.append([case.label, *(c for pair in cells for c in pair), *_settling(case, bands)])
    header = [""]
    for time in times:
        header += [f"at {time:g} s (deg)", "linear loops"]
    for band in bands:
        header += [f"settled to {band:g}' (%)", "linear loops, after (s)"]
    return Table(
        f"Heading error from its limit, gyro drift {drift_text(cases[0].drift)}",
        header,
        rows,
        f"Number [95 % interval] over {cases[0].rows.num_rows} draws. *Settled*: stays within the"
        f" band of the limit to the last record, at {settings.duration_s:g} s; a run that swings"
        " through its limit then counts, though it leaves the band again. Linear loops: from the"
        f" same initial error without noise, for as long as it takes, up to {_HORIZON_S:g} s.",
    )


def _settling(case: Case, bands: Sequence[float]) -> list[str]:
    """For each band (arcmin) the share of draws that settle to it, and when linear loops do."""
    every = case.study.study.record_interval_s
    times = np.arange(1, round(_HORIZON_S / every) + 1) * every
    size = np.abs(heading_from_limit(case.study, times)) * DEG / ARCMIN
    cells = []
    for band in bands:
        settled = np.isfinite(analysis.numbers(case.rows, f"settle_{band:g}_s"))
        share = percent(analysis.proportion(int(settled.sum()), settled.size))
        after = f"{times[size > band].max(initial=0.0):g}" if size[-1] <= band else "never"
        cells += [share, after]
    return cells


def _spread(cases: Sequence[Case]) -> Told | None:
    """How far apart the draws are in heading where 600 s are used and where a tape is."""
    firsts = [next((c for c in cases if c.scheme == n and _converges(c)), None) for n in (1, 2)]
    found = [
        (c, analysis.std(c.mean_errors("heading"), is_normal=True), _bound(c)) for c in firsts if c
    ]
    if len(found) < 2:
        return None
    (_, whole, _), (taped, few, least) = found
    start, end = taped.study.study.window_s
    rows = [
        [c.label, f"{loops_of(c.study).tape_s:g}", _deg(spread), f"{bound:.4f}"]
        for c, spread, bound in found
    ]
    return Told(
        f"Going over {loops_of(taped.study).tape_s:g} s of data again adds no information: from"
        f" draw to draw, the heading of Scheme 2, where it converges, varies"
        f" {few.value / whole.value:.0f} times as much as that of Scheme 1 and"
        f" {few.value / least:.1f} times as much as the noise of the tape must leave.",
        [
            Table(
                f"Standard deviation over draws of the mean heading from {start:g} to {end:g} s",
                ["", "data (s)", "simulated (deg)", "least that noise leaves (deg)"],
                rows,
                "Number [95 % interval]. Least: of any unbiased estimate from the same data. The"
                " paper compares one run of each scheme.",
            )
        ],
    )


def _bound(case: Case) -> float:
    """The least 1 sigma of the heading that the noise in a case's data leaves, deg."""
    return float(bound_arcmin(case.study, loops_of(case.study).tape_s)) * ARCMIN / DEG


def _converges(case: Case) -> bool:
    """Whether linear loops end within the widest settle band."""
    widest = max(case.study.study.settle_bands_arcmin)
    end = np.array([case.study.duration_s])
    return case.is_stable and bool(abs(heading_from_limit(case.study, end)[0]) * 60 < widest)


def _angles(source: Source, cases: Sequence[Case]) -> Told | None:
    """What reading the initial errors as Euler angles changes."""
    plain = {case.label: case for case in cases}
    rows = []
    for case in cases_of(source, "euler"):
        own = plain.get(case.label.removesuffix(", Euler angles"))
        if own is None or own.drift != case.drift:
            continue
        apart = analysis.difference(case.mean_errors("heading"), own.mean_errors("heading"))
        means = (analysis.mean(c.mean_errors("heading")) for c in (own, case))
        rows.append([own.label, *map(_deg, means), _deg(apart)])
    if not rows:
        return None
    label, vector, euler, _ = (cell.partition(" [")[0] for cell in rows[0])
    start, end = source.study.study.window_s
    return Told(
        "The initial errors are read as a rotation vector, one rotation about one axis; as Euler"
        f" angles, three rotations in turn, as paper 1's are read, {label} would end at {euler}"
        f" instead of {vector} deg.",
        [
            Table(
                f"Mean heading error from {start:g} to {end:g} s by the reading of the initial"
                f" errors, gyro drift {drift_text(cases[0].drift)}",
                ["", "rotation vector (deg)", "Euler angles (deg)", "difference (deg)"],
                rows,
                f"Number [95 % interval] over {source.study.n_draws} draws on the same noise. The"
                " paper does not say which it means.",
            )
        ],
    )


def _bases(sources: Sequence[Source]) -> Told | None:
    """How far the means of two bases are apart on the same noise."""
    if len(sources) < 2:
        return None
    first, second = ({(c.label, c.drift): c for c in cases_of(source)} for source in sources[:2])
    drift = next(iter(first))[1]
    rows, sizes = [], []
    for key in (key for key in first if key in second and key[1] == drift):
        apart = {}
        for angle, axis in ANGLES.items():
            column = f"phi_{axis}_mean_arcmin"  # an error is -phi, so that the order is turned
            means = analysis.paired(first[key].rows, second[key].rows, column)
            apart[angle] = analysis.difference(*(mean * ARCMIN / DEG for mean in means))
        sizes.append(abs(apart["heading"].value))
        cells = (format_estimate(apart[a], digits=DIGITS[a] + 1) for a in ANGLES)
        rows.append([key[0], *cells])
    if not rows:
        return None
    names = [source.study.name for source in sources[:2]]
    return Told(
        "The paper's Tables 1 and 2 are the same to every digit. On the same noise the two bases"
        f" are {min(sizes):.4f} to {max(sizes):.4f} deg apart in heading here.",
        [
            Table(
                f"Mean error of {names[1]} minus that of {names[0]}, gyro drift"
                f" {drift_text(drift)}",
                ["", *(f"{angle} (deg)" for angle in ANGLES)],
                rows,
                "Mean difference [95 % interval] over pairs of runs with the same noise. Printed: 0"
                " in all of them. A reflecting turn reads the tilt from a few seconds of specific"
                " force, in which the accelerometer biases swing with the base.",
            )
        ],
    )


def _deg(estimate: Estimate) -> str:
    return format_estimate(estimate, digits=4)
