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
    """A number over a size.

    Attributes:
        set: of the rows.
        prefix: of their names; the size follows it.
        value: key of the number.
        title: of the panel.
        label: of the number's axis.
    """

    set: str
    prefix: str
    value: str
    title: str
    label: str = "ns a step and run"

    def points(self, machine: Machine) -> tuple[list[int], list[Row]]:
        """Sizes and rows of a machine, in order of size."""
        rows = machine.sets.get(self.set, {})
        sizes = {name.removeprefix(self.prefix): row for name, row in rows.items()}
        found = sorted((int(size), row) for size, row in sizes.items() if size.isdecimal())
        return [size for size, _ in found], [row for _, row in found]


PANELS = (
    Panel("throughput", "lanes_", "ns_per_step_run", "Lanes a tile, noise off"),
    Panel("throughput", "tiles_", "ns_per_step_run", "Tiles a call, noise off"),
    Panel("throughput", "variants_", "ns_per_step_run", "Variants a draw, noise on"),
    Panel("devices", "devices_", "speedup", "Devices, the same tiles", "speed-up"),
)


@with_style
def bends(machines: Sequence[Machine]) -> Figure | None:
    """Where the cost bends: a panel a size, a line a machine; None without rows."""
    panels = [panel for panel in PANELS if any(panel.points(m)[0] for m in machines)]
    if not panels:
        return None
    columns = min(2, len(panels))
    lines = -(-len(panels) // columns)
    figure = Figure(figsize=(4.6 * columns, 2.9 * lines))
    grid = figure.subplots(lines, columns, squeeze=False).flat
    for panel, axes in zip(panels, grid, strict=False):
        _draw(axes, panel, machines)
    for axes in list(grid)[len(panels) :]:
        axes.set_axis_off()
    if len(machines) > 1:
        add_legend_below(figure, figure.axes[0])
    return figure


def _draw(axes: Axes, panel: Panel, machines: Sequence[Machine]) -> None:
    sizes: set[int] = set()
    for number, machine in enumerate(machines):
        x, rows = panel.points(machine)
        y = [row[panel.value] for row in rows]
        error = [_half_range(row, panel.value) for row in rows]
        axes.errorbar(
            x, y, error, fmt="o-", color=line_colour(number), label=machine.name, capsize=2
        )
        sizes.update(x)
    if panel.value == "speedup":
        axes.plot(sorted(sizes), sorted(sizes), "--", color=GREY, linewidth=0.9, zorder=1.5)
        axes.annotate("ideal", (max(sizes), max(sizes)), color=GREY, ha="right", va="bottom")
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(FixedLocator(_readable(sorted(sizes))))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_ylim(bottom=0)
    axes.set_title(panel.title)
    axes.set_ylabel(panel.label)


def _half_range(row: Row, key: str) -> float:
    if key == "ns_per_step_run":
        return float(row[key] * row["spread_s"] / row["median_s"])
    return float(row[f"{key}_spread"])


def _readable(sizes: Sequence[int]) -> list[int]:
    """The sizes whose labels do not run into one another: powers of two where there are many."""
    powers = [size for size in sizes if size & (size - 1) == 0]
    return powers if len(sizes) > 5 and powers else list(sizes)


@with_style
def beside_limit(machine: Machine, ns: Sequence[tuple[str, float]], kernel: float) -> Figure:
    """The ns a step and run of every row, and how far that is from the limit kernel's.

    Args:
        machine: that took them.
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
    axes.set_xlabel("ns a step and run (logarithmic)")
    axes.set_title(f"sinsjax {machine.version}, {machine.name}")
    return figure


def _round(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


@with_style
def history(machines: Sequence[Machine]) -> Figure:
    """The engine's ns over the limit kernel's by version, a line a machine."""
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
