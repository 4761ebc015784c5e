"""What the scripts of the pages share: runs by axes, estimates as text, tables and figures.

    python -m docs.studies.NAME DIR... [-o FOLDER]

Each DIR has the results of one study of the page. Tables and figures go to FOLDER, docs by default,
and the numbers of the page's sentences are printed.
"""

import argparse
import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

import sinsjax
from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate

DOCS = Path(__file__).resolve().parents[1]
GREY = "#8a8a8a"


class Grid(NamedTuple):
    """A column of every run by axes and draw: (points of the first axis, ..., draws)."""

    axes: dict[str, tuple[Any, ...]]
    values: NDArray

    def at(self, **points: Any) -> NDArray:
        """Return the values at a point of some axes; a list of points keeps its axis."""
        found = self.values
        for number, (name, known) in reversed(list(enumerate(self.axes.items()))):
            if name in points:
                wanted = points[name]
                places = [known.index(one) for one in wanted] if isinstance(wanted, list) else None
                found = np.take(found, places or known.index(wanted), axis=number)
        return found


class Runs:
    """The runs of a study in a results directory."""

    def __init__(self, directory: Path) -> None:
        """Open a directory; `InputError` if it has no results, or runs are missing."""
        self.directory, self.study = directory, sinsjax.Results.read(directory).study
        self.draws, self.end_s = self.study.n_draws, self.study.study.duration_s
        self.count = self.rows("run_id").num_rows
        if self.count != self.draws * self.study.n_variants:
            raise sinsjax.InputError(f"{directory}: runs are missing (continue with `--resume`)")

    def rows(self, *names: str) -> pa.Table:
        """Return columns of the summary, all by default, one row per run."""
        return sinsjax.read_summary(self.directory, names or None)

    def column(self, name: str) -> NDArray:
        """Return a column, (variants, draws); a time to settle that is null is inf."""
        values = analysis.numeric_column(self.rows(name), name).reshape(self.draws, -1).T
        return np.where(np.isnan(values), np.inf, values) if "settle_" in name else values

    def grid(self, column: str, **axes: str | Sequence[Any]) -> Grid:
        """Return a column over axes, each a key of the study or a value for each variant."""
        given = {n: self.study.values(v) if isinstance(v, str) else v for n, v in axes.items()}
        points = {name: tuple(dict.fromkeys(values)) for name, values in given.items()}
        shape = tuple(map(len, points.values()))
        places = [[points[name].index(one) for one in values] for name, values in given.items()]
        order = np.ravel_multi_index(places, shape)
        if not np.array_equal(np.sort(order), np.arange(np.prod(shape))):
            raise sinsjax.InputError(f"{self.directory}: is no full grid of {', '.join(axes)}")
        return Grid(points, self.column(column)[np.argsort(order)].reshape(*shape, self.draws))

    @property
    def footer(self) -> str:
        """The sample size, for the footer of a figure."""
        variants = f"{self.study.n_variants:,} variants × {self.draws:,} Monte Carlo runs"
        return f"{self.study.name}: {variants} = {self.count:,} runs"


class Page(NamedTuple):
    """Where the tables and figures of a page go."""

    folder: Path

    def print_numbers(self, **numbers: Any) -> None:
        """Print numbers of the page's sentences."""
        for name, text in numbers.items():
            print(f"{name}: {text}")

    def show(self, title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Print a table of the page in Markdown."""
        lines = [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]
        print("\n".join([f"\n**{title}**\n", *lines, ""]))

    def table(self, stem: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Write a table as a CSV file."""
        (self.folder / "tables").mkdir(parents=True, exist_ok=True)
        with (self.folder / "tables" / f"{stem}.csv").open("w", newline="", encoding="utf-8") as f:
            csv.writer(f, lineterminator="\n").writerows([header, *rows])

    def figure(self, stem: str, figure: Figure, footer: str) -> None:
        """Write a figure as a PNG file."""
        (self.folder / "figures").mkdir(parents=True, exist_ok=True)
        (self.folder / "figures" / f"{stem}.png").write_bytes(plots.render_png(figure, footer))


def read_arguments(text: str | None, studies: Sequence[str]) -> tuple[Mapping[str, Runs], Page]:
    """Return the runs of each study by its name, from the command line, and the page."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("directories", nargs="+", type=Path, help=f"of {', '.join(studies)}")
    parser.add_argument("-o", "--out", type=Path, default=DOCS, help="folder of tables and figures")
    given = parser.parse_args()
    try:
        runs = {one.study.name: one for one in map(Runs, given.directories)}
    except sinsjax.InputError as error:
        parser.error(str(error))
    if missing := [name for name in studies if name not in runs]:
        parser.error(f"results are missing: {', '.join(missing)}")
    return {name: runs[name] for name in studies}, Page(given.out)


def medians(settle_s: NDArray) -> NDArray:
    """Return medians over the draws, the last axis; inf if fewer than half settle."""
    return np.asarray(np.quantile(settle_s, 0.5, axis=-1, method="inverted_cdf"))


def pooled(values: NDArray) -> Estimate:
    """Return the mean of values (..., draws), with the interval over the draws."""
    return analysis.mean(values.ravel(), np.indices(values.shape)[-1].ravel())


def share(flags: NDArray) -> Estimate:
    """Return the share of flags (..., draws), with the interval over the draws."""
    return analysis.share(flags.ravel(), np.indices(flags.shape)[-1].ravel())


def percent(one: Estimate) -> str:
    """Return a share as text, such as ``45 [43, 47]``."""
    return format_estimate(
        Estimate(100 * one.value, 100 * one.low, 100 * one.high, one.n), digits=0
    )


def mean_time(settle_s: NDArray, end_s: float) -> str:
    """Return the mean of settling times (..., draws) as text, with the whole run for never."""
    return format_estimate(pooled(np.minimum(settle_s, end_s)), "s", 0)
