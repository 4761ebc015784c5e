"""The heading error of an IMU over time, and the sources of its variance as areas."""

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from sinsjax.plots.style import line_colour, set_log_scale, with_style

_LEAST_SHARE = 0.03  # at some time, of a source with an area of its own
_WIDTH, _HEIGHT = 6.4, 6.0
_LETTERS = 66  # of a line of the title


@with_style
def plot_budget(
    times_s: NDArray,
    rms_arcmin: NDArray,
    shares: NDArray,
    names: Sequence[str],
    asked_s: float,
    title: str,
) -> Figure:
    """Plot the heading error over time above the shares of its sources.

    Args:
        times_s: (times,) s.
        rms_arcmin: (times,) rms heading error, arcmin.
        shares: (times, sources) parts of the variance, which add up to 1.
        names: of the sources.
        asked_s: time to mark, s.
        title: what the figure shows.
    """
    figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.set_title(fill(title, _LETTERS), loc="left")
    above.plot(times_s, rms_arcmin, color=line_colour(0))
    above.axvline(asked_s, color="0.5", linewidth=0.8)
    (asked,) = rms_arcmin[times_s == asked_s]
    above.plot(asked_s, asked, "o", color=line_colour(0))
    text = f"{asked:.3g} arcmin rms at {asked_s:g} s"
    above.text(0.98, 0.95, text, transform=above.transAxes, ha="right", va="top")
    above.set_ylabel("rms heading error (arcmin)")
    set_log_scale(above.xaxis, 1.0, 10.0)
    set_log_scale(above.yaxis, 1.0, 10.0)
    above.grid(visible=True, which="both", alpha=0.3)
    order = np.argsort(-shares[times_s == asked_s][0])
    large = [k for k in order if shares[:, k].max() >= _LEAST_SHARE]
    rest = shares.sum(axis=1) - shares[:, large].sum(axis=1)
    areas, labels = [shares[:, k] for k in large], [names[k] for k in large]
    if len(large) < len(names):
        areas, labels = [*areas, rest], [*labels, "others"]
    colours = [line_colour(k) for k in range(len(large))] + ["0.8"]
    below.stackplot(times_s, areas, labels=labels, colors=colours[: len(areas)], alpha=0.85)
    below.axvline(asked_s, color="0.2", linewidth=0.8)
    below.set_ylim(0, 1)
    below.set_xlim(times_s[0], times_s[-1])
    below.set_ylabel("share of the variance")
    below.yaxis.set_major_formatter(PercentFormatter(1.0))
    below.set_xlabel("length of the data (s)")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure
