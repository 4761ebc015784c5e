"""Why paper 2's stated numbers do not give its printed tables."""

from collections.abc import Mapping, Sequence

import numpy as np

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.report.base import Source, Table, only, percent, value_text
from sinsjax.report.folder import Page
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, MICRO

from ..loops.linear import heading_from_limit, loops_of
from ..loops.runs import bound_arcmin
from .cases import ANGLES, DIGITS, PRINTED, Case, Curves, cases_of, drift_text

_HORIZON_S = 3000.0  # how far the linear loops are followed


def limit(cases: Sequence[Case]) -> Page:
    """The limit of the heading error, and the biases that the printed means would follow from."""
    first = cases[0]
    implied = {
        scheme: {angle: _implied(first, angle, printed[angle]) for angle in ANGLES}
        for scheme, printed in PRINTED.items()
    }
    random = only(first.study, "gyro_noise_deg_per_h")
    drifts = [biases["heading"] for biases in implied.values()]
    values = {
        "limit": {
            "drift": drift_text(first.drift),
            "heading": f"{first.limits.heading:.4f} deg",
            "implied": f"{drifts[0]:.4f} and {drifts[1]:.4f} deg/h",
            "random": f"{value_text(random)} deg/h",
            "printed": f"{PRINTED[1]['heading']:.4f}",
            "printed_2": f"{PRINTED[2]['heading']:.4f} deg",
        }
    }
    claims = {
        "the stated drift cannot settle to the printed headings": all(
            first.limits.heading > 2 * printed["heading"] for printed in PRINTED.values()
        ),
        "the printed headings are limits of a drift of the size of the stated random one": all(
            abs(drift / random - 1) < 0.1 for drift in drifts
        ),
    }
    rows = [
        [
            f"Scheme {scheme}",
            *(f"{biases[angle]:.1f}" for angle in ("pitch", "roll")),
            f"{biases['heading']:.4f}",
        ]
        for scheme, biases in implied.items()
    ]
    behind = Table(
        "The biases of which the printed means are the limits",
        ["", "accelerometer, by pitch (ug)", "by roll (ug)", "gyro drift, by heading (deg/h)"],
        rows,
        f"Stated: {value_text(only(first.study, 'accel_bias_ug'))} ug and"
        f" {drift_text(first.drift)}.",
        folded=True,
    )
    return Page(values, {"limit": _limit_table(cases), "behind": behind}, claims=claims)


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
        folded=True,
    )


def _implied(case: Case, angle: str, printed: float) -> float:
    """The bias of which a printed mean is the limit: ug for pitch and roll, deg/h for heading."""
    if angle == "heading":
        return case.drift * (printed - case.limits.accel) / case.limits.gyro
    return printed * DEG / MICRO * (1 if angle == "pitch" else -1)


def unsettled(cases: Sequence[Case], curves: Mapping[str, Curves]) -> Page:
    """How far from its limit the heading is in the window, and how it still moves there."""
    drift = cases[0].drift
    stable = [case for case in cases if case.is_stable and case.drift == drift]
    forward = [case for case in stable if case.scheme == 1]
    start, end = forward[0].study.study.window_s
    sizes = [
        abs(
            analysis.difference(
                *(curves[case.label].at("heading", time) for time in (end, start))
            ).value
        )
        for case in forward
    ]
    means = [analysis.mean(case.mean_errors("heading")).value for case in forward]
    linear = heading_from_limit(forward[0].study, np.array([end]))[0]
    simulated = curves[forward[0].label].at("heading", end) - forward[0].limits.heading
    every = [case for case in cases if case.is_stable and case.scheme == 1]
    printed = PRINTED[1]["heading"]
    near = min(
        (analysis.mean(case.mean_errors("heading")) for case in every),
        key=lambda mean: abs(mean.value - printed),
    )
    values = {
        "unsettled": {
            "window": f"{start:g} to {end:g} s",
            "least": f"{min(sizes):.3f}",
            "most": f"{max(sizes):.3f} deg",
            "low": f"{min(means):.4f}",
            "high": f"{max(means):.4f} deg",
            "nearest": f"{_deg(near)} deg",
            "readings": str(len(every)),
            "sigma": f"{loops_of(forward[0].study).sigma:g} 1/s",
        }
    }
    claims = {
        "Scheme 1 has not settled in the window": min(sizes) > 0.05,
        "linear loops without noise leave the same": bool(
            abs(linear - analysis.mean(simulated).value) < 0.01
        ),
        "no reading comes to the printed heading": not near.low <= printed <= near.high,
    }
    return Page(values, {"unsettled": _unsettled_table(stable, curves)}, claims=claims)


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
        folded=True,
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


def spread(cases: Sequence[Case]) -> Page:
    """How far apart the draws are in heading where 600 s are used and where a tape is."""
    firsts = [next(c for c in cases if c.scheme == n and _converges(c)) for n in (1, 2)]
    found = [(c, analysis.std(c.mean_errors("heading"), is_normal=True), _bound(c)) for c in firsts]
    (_, whole, _), (_, few, least) = found
    start, end = firsts[0].study.study.window_s
    rows = [
        [c.label, f"{loops_of(c.study).tape_s:g}", _deg(apart), f"{bound:.4f}"]
        for c, apart, bound in found
    ]
    table = Table(
        f"Standard deviation over draws of the mean heading, {start:g} to {end:g} s",
        ["", "data (s)", "simulated (deg)", "least that noise leaves (deg)"],
        rows,
        "Number [95 % interval]. Least: of any unbiased estimate from the same data.",
    )
    values = {
        "spread": {
            "times": f"{few.value / whole.value:.0f}",
            "over_bound": f"{few.value / least:.1f}",
        }
    }
    claims = {
        "the tape's heading scatters far more than that of 600 s": few.value > 5 * whole.value,
        "it is near what the noise of the tape must leave": 1 <= few.value / least < 2,
    }
    return Page(values, {"spread": table}, claims=claims)


def _bound(case: Case) -> float:
    """The least 1 sigma of the heading that the noise in a case's data leaves, deg."""
    return float(bound_arcmin(case.study, loops_of(case.study).tape_s)) * ARCMIN / DEG


def _converges(case: Case) -> bool:
    """Whether linear loops end within the widest settle band."""
    widest = max(case.study.study.settle_bands_arcmin)
    end = np.array([case.study.duration_s])
    return case.is_stable and bool(abs(heading_from_limit(case.study, end)[0]) * 60 < widest)


def angles(source: Source, cases: Sequence[Case]) -> Page:
    """What reading the initial errors as Euler angles changes."""
    plain = {case.label: case for case in cases}
    rows, pairs = [], []
    for case in cases_of(source, "euler"):
        own = plain.get(case.label.removesuffix(", Euler angles"))
        if own is None or own.drift != case.drift:
            continue
        apart = analysis.difference(case.mean_errors("heading"), own.mean_errors("heading"))
        means = [analysis.mean(c.mean_errors("heading")) for c in (own, case)]
        pairs.append((own.label, *(mean.value for mean in means)))
        rows.append([own.label, *map(_deg, means), _deg(apart)])
    label, vector, euler = pairs[0]
    table = Table(
        "Mean heading error by the reading of the initial errors",
        ["", "rotation vector (deg)", "Euler angles (deg)", "difference (deg)"],
        rows,
        f"Number [95 % interval] over {source.study.n_draws} draws on the same noise.",
        folded=True,
    )
    values = {
        "angles": {"case": label, "vector": f"{vector:.4f}", "euler": f"{euler:.4f} deg"},
    }
    return Page(values, {"angles": table})


def bases(sources: Sequence[Source]) -> Page:
    """How far the means of two bases are apart on the same noise."""
    first, second = ({(c.label, c.drift): c for c in cases_of(source)} for source in sources)
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
    table = Table(
        "Swing base less static base, mean error",
        ["", *(f"{angle} (deg)" for angle in ANGLES)],
        rows,
        "Mean difference [95 % interval] over pairs of runs with the same noise; printed: 0 in all."
        " A reflecting turn reads the tilt from a few seconds of specific force, in which the"
        " accelerometer biases swing with the base.",
        folded=True,
    )
    values = {"bases": {"least": f"{min(sizes):.4f}", "most": f"{max(sizes):.4f} deg"}}
    claims = {"the bases are not the same": max(sizes) > 1e-4}
    return Page(values, {"bases": table}, claims=claims)


def _deg(estimate: Estimate) -> str:
    return format_estimate(estimate, digits=4)
