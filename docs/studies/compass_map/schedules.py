"""Gain schedules for a tape of 80 s: the search, and the best beside the paper's schemes."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate, rms
from sinsjax.report.base import Picture, Source, Table, percent, shown_keys, value_text
from sinsjax.report.folder import Page
from sinsjax.report.output import counted
from sinsjax.report.words import seconds, share

from ..loops.linear import all_loops, heading_of, start_of
from .scores import Scored, bands_of, rank, scored_of

_MOST_ROWS = 10
_HORIZON = 4  # durations that the linear loops are followed for
SCHEME_1, SCHEME_2 = "Scheme 1", "Scheme 2"
LONG, TAPE = "600 s, best schedule", "80 s tape, best schedule"


def searched(source: Source) -> Page:
    """The schedules of the search in the order of the rule."""
    ranking = rank(scored_of(source))
    best = ranking.ordered[0]
    gains = {key: best.key[key] for key in shown_keys(source.study)}
    values = {
        "search": {
            "schedules": str(len(ranking.ordered)),
            "draws": str(source.study.n_draws),
            "tied": str(ranking.tied),
            "wide": seconds(best.wide),
            "narrow": seconds(best.narrow),
        },
        "set": {
            "factors": value_text(source.study.values("sigma_factors")[best.variant]),
            "times": value_text(source.study.values("sigma_times_s")[best.variant]),
            "level_sigma": value_text(gains["level_sigma_per_s"]),
            "level_time": value_text(gains["level_time_s"]),
            "sigma": value_text(gains["azimuth_sigma_per_s"]),
            "smoothing": value_text(gains["turn_smoothing_s"]),
        },
    }
    shown = ranking.ordered[:_MOST_ROWS]
    return Page(values, {"search": _table(source, shown, f"The first {len(shown)} schedules")})


def compared(source: Source) -> Page:
    """The best schedule beside the paper's schemes."""
    scored = scored_of(source)
    wide, narrow = bands_of(source)
    found = {_short(one): one for one in scored}
    one, two = found[SCHEME_1], found[SCHEME_2]
    long, tape = found[LONG], found[TAPE]
    linear = _run_on(source, scored)[scored.index(one)]
    values: dict[str, Any] = {
        "bands": {"wide": f"{wide:g} arcmin", "narrow": f"{narrow:g} arcmin"},
        "draws": f"{source.study.n_draws:,}",
        "tape": {
            "wide": seconds(tape.wide),
            "narrow": share(_settled(tape.narrow_s)),
            "bound": f"{100 * (1 - tape.outside):.0f} %",
            "cycle": share(tape.last_cycle or analysis.UNKNOWN),
        },
        "long": {"wide": seconds(long.wide), "narrow": seconds(long.narrow)},
        "scheme_1": {
            "wide": seconds(one.wide),
            "narrow": seconds(one.narrow),
            "linear": f"{linear[1]:.0f} s",
        },
        "scheme_2": share(_settled(two.wide_s)),
    }
    claims = {
        "80 s with the best schedule settle far sooner than Scheme 1": bool(
            tape.wide.high < one.wide.low / 4 and np.isfinite(tape.wide_s).mean() > 0.99
        ),
        "no draw of Scheme 2 settles with the paper's turn": not np.isfinite(two.wide_s).any(),
        "the tape comes near its bound": _settled(tape.narrow_s).value > 0.8 * (1 - tape.outside),
        "with 600 s of data every draw comes within the narrow band": bool(
            _settled(long.narrow_s).value > 0.99
        ),
        "Scheme 1 leaves the narrow band again after the end": linear[1] > source.study.run_s,
    }
    panels = {
        f"within {band:g} arcmin": {_short(s): getattr(s, name) for s in scored}
        for band, name in ((wide, "wide_s"), (narrow, "narrow_s"))
    }
    figure = plots.survival(
        panels,
        "Who has not settled yet? Heading from its limit",
        end_s=source.study.duration_s,
        levels={f"within {narrow:g} arcmin": {_short(s): s.outside for s in scored}},
    )
    caption = (
        f"Share of {source.study.n_draws:,} draws outside the band; down is good. Dashed: the share"
        " that the noise of that tape alone leaves outside, whatever the method."
    )
    picture = Picture("settling", caption, figure, counted(source))
    return Page(values, {"cases": _cases(source, scored)}, {"settling": picture}, claims)


def _short(s: Scored) -> str:
    return s.name.partition(":")[0]


def _settled(times: NDArray) -> Estimate:
    return analysis.proportion(int(np.isfinite(times).sum()), times.size)


def _cases(source: Source, scored: Sequence[Scored]) -> Table:
    wide, narrow = bands_of(source)
    rows = [
        [
            s.name,
            f"{s.tape_s:g} s",
            *(
                cell
                for times in (s.wide_s, s.narrow_s)
                for cell in (
                    percent(_settled(times)),
                    format_estimate(analysis.quantile(times), digits=0),
                )
            ),
            f"{100 * (1 - s.outside):.0f}",
        ]
        for s in scored
    ]
    header = ["", "data", f"within {wide:g}' (%)", "median (s)", f"within {narrow:g}' (%)"]
    note = (
        f"Number [95 % interval] over {source.study.n_draws:,} draws; time of updates. *At most*:"
        " what an estimator at the tape's information bound could reach."
    )
    return Table("What to expect", [*header, "median (s)", "at most (%)"], rows, note)


def _table(source: Source, shown: Sequence[Scored], title: str) -> Table:
    wide, narrow = bands_of(source)
    keys = shown_keys(source.study)
    rows = [
        [
            *(value_text(s.key[key]) for key in keys),
            format_estimate(s.wide, digits=0),
            percent(_settled(s.narrow_s)),
            format_estimate(s.narrow, digits=0),
            percent(s.last_cycle) if s.last_cycle else "-",
            format_estimate(rms(s.errors), digits=2) if np.isfinite(s.errors).all() else "unknown",
        ]
        for s in shown
    ]
    header = [
        *map(plots.label, keys),
        f"to {wide:g}': median (s)",
        f"to {narrow:g}': settled (%)",
        "median (s)",
        "for the last cycle (%)",
        "rms error (arcmin)",
    ]
    note = "Number [95 % interval]. *For the last cycle*: inside throughout the last two passes."
    return Table(title, header, rows, note, folded=True)


def _run_on(source: Source, scored: Sequence[Scored]) -> list[tuple[float, float]]:
    """When the linear loops, run on beyond the end, are within each band for good, s.

    A tape that the duration goes over once is one that goes on.
    """
    study = source.study
    duration, step = study.duration_s, study.study.record_interval_s
    times = np.arange(1, round(_HORIZON * duration / step) + 1) * step
    start = start_of(study)
    found = []
    for s, model in zip(scored, all_loops(study), strict=True):
        if s.tape_s >= study.run_s:
            model = model._replace(tape_s=math.inf)
        error = np.abs(heading_of(model, start, times)) * 60
        outside = [times[error > band] for band in bands_of(source)]
        wide, narrow = (float(t[-1]) if t.size else 0.0 for t in outside)
        found.append((wide, narrow))
    return found
