"""Figures of the page on performance, from the rows of the history."""

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from store import Machine
from targets import PAIRS

from sinsjax.bench.timing import Row
from sinsjax.plots.style import COLOURS, GREY, add_legend_below, line_colour, with_style


class Panel(NamedTuple):
    """Time of a step over a size.

    Attributes:
        prefix: of the rows' names in the set of throughput; the size follows it.
        title: of the panel.
    """

    prefix: str
    title: str


PANELS = (
    Panel("lanes_", "Lanes per tile, without noise"),
    Panel("variants_", "Variants per draw, with noise"),
)


def rows_by_size(machine: Machine, prefix: str) -> list[tuple[int, Row]]:
    """Return sizes and rows of the set of throughput, in order of size.

    Args:
        machine: with the rows.
        prefix: of their names; the size follows it.
    """
    rows = machine.sets.get("throughput", {})
    sizes = {name.removeprefix(prefix): row for name, row in rows.items()}
    return sorted(
        ((int(size), row) for size, row in sizes.items() if size.isdecimal()),
        key=lambda found: found[0],
    )


@with_style
def bends(machines: Sequence[Machine]) -> Figure | None:
    """Where the cost bends: a panel per size, a line per machine; None without rows."""
    measured = [m for m in machines if any(rows_by_size(m, panel.prefix) for panel in PANELS)]
    panels = [p for p in PANELS if any(rows_by_size(m, p.prefix) for m in measured)]
    if not panels:
        return None
    figure = Figure(figsize=(3.8 * len(panels), 3.0))
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for panel, axes in zip(panels, grid, strict=True):
        _draw(axes, panel, measured)
    grid[0].set_ylim(bottom=0)
    grid[0].set_ylabel("ns per step per run")
    if len(measured) > 1:
        add_legend_below(figure, grid[0])
    return figure


def _draw(axes: Axes, panel: Panel, machines: Sequence[Machine]) -> None:
    shown: set[int] = set()
    for number, machine in enumerate(machines):
        found = rows_by_size(machine, panel.prefix)
        sizes = [size for size, _ in found]
        ns = [row["ns_per_step_run"] for _, row in found]
        error = [row["ns_per_step_run"] * row["spread_s"] / row["median_s"] for _, row in found]
        axes.errorbar(
            sizes, ns, error, fmt="o-", color=line_colour(number), label=machine.name, capsize=2
        )
        shown.update(sizes)
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(FixedLocator(_readable(sorted(shown))))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_title(panel.title)


def _readable(sizes: Sequence[int]) -> list[int]:
    """The sizes whose labels do not run into one another: powers of two where there are many."""
    powers = [size for size in sizes if size & (size - 1) == 0]
    return powers if len(sizes) > 5 and powers else list(sizes)


@with_style
def beside_limit(machine: Machine, ns: Sequence[tuple[str, float]], kernel: float) -> Figure:
    """The ns per step per run of every row, and how far that is from the limit kernel's.

    Args:
        machine: with the rows.
        ns: names and numbers, in this order from the top.
        kernel: ns of the limit kernel.
    """
    figure = Figure(figsize=(8.6, 1.1 + 0.32 * len(ns)))
    axes = figure.subplots()
    for place, (name, value) in enumerate(ns):
        shade = GREY if name == "limit_kernel" else COLOURS[0]
        axes.plot([kernel, value], [place, place], color=shade, linewidth=2.5, alpha=0.5)
        axes.plot(value, place, "o", color=shade)
        said = f"{_round(value)} ns, {_round(value / kernel)} x"
        axes.annotate(
            said, (max(value, kernel), place), (9, 0), textcoords="offset points", va="center"
        )
    values = [value for _, value in ns]
    axes.axvline(kernel, color=GREY, linewidth=0.9, linestyle="--")
    axes.set_xscale("log")
    axes.set_xlim(min(values) / 2, max(values) * 60)
    axes.set_yticks(range(len(ns)), [name for name, _ in ns])
    axes.set_ylim(len(ns) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("ns per step per run (logarithmic)")
    axes.set_title(f"sinsjax {machine.version}, {machine.name}")
    return figure


def _round(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


@with_style
def history(machines: Sequence[Machine]) -> Figure:
    """The engine's ns over the limit kernel's by version, a line per machine."""
    versions = list(dict.fromkeys(machine.version for machine in machines))
    names = list(dict.fromkeys(machine.name for machine in machines))
    figure = Figure(figsize=(7.2, 3.0))
    axes = figure.subplots()
    for number, name in enumerate(names):
        found = [(m.version, m.x_limit) for m in machines if m.name == name]
        x = [versions.index(version) for version, ratio in found if ratio is not None]
        y = [ratio for _, ratio in found if ratio is not None]
        axes.plot(x, y, "o-", color=line_colour(number), label=name)
    targets = PAIRS["kalman_shared_record"]
    for (instructions, most), line in zip(targets.items(), ("--", ":"), strict=True):
        told = f"target {most:g}, {instructions}"
        axes.axhline(most, color=GREY, linestyle=line, linewidth=0.9, label=told)
    axes.axhline(1, color=GREY, linewidth=0.9, label="limit kernel")
    axes.set_xticks(range(len(versions)), versions)
    axes.set_xlim(-0.5, len(versions) - 0.5)
    axes.set_ylim(0, 1.1 * max(axes.get_ylim()[1], *targets.values()))
    axes.set_xlabel("sinsjax")
    axes.set_ylabel("times the limit kernel")
    add_legend_below(figure, axes)
    return figure
