"""Where a report goes: a console, a directory of figures, a page of documentation."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from rich import box
from rich import table as rich_table
from rich.console import Console
from rich.measure import Measurement
from rich.text import Text as RichText

from sinsjax import plots, runtime
from sinsjax.records.files import replacing
from sinsjax.report.base import Block, Picture, Report, Source, Table, Text
from sinsjax.types import InputError

FIGURES = "figures"


def print_report(source: Source, report: Report, console: Console) -> None:
    """Prints what was found and every table that is not folded, and names the figures."""
    console.print(f"\n{source.study.study.name}", style="bold", markup=False, highlight=False)
    for line in report.headline:
        _say(console, line)
    for section in report.sections:
        for block in section.blocks:
            if isinstance(block, Text):
                _say(console, block.text)
            elif isinstance(block, Table) and not block.folded:
                _print_table(block, console)
    if names := [block.name for block in pictures(report)]:
        listed = ", ".join(f"{name}.png" for name in names)
        _say(console, f"Figures in {source.directory / FIGURES}: {listed}")


def pictures(report: Report) -> Iterable[Picture]:
    """Every figure of a report."""
    blocks = (block for section in report.sections for block in section.blocks)
    return (block for block in blocks if isinstance(block, Picture))


def save_figures(images: dict[str, bytes], directory: Path) -> None:
    """Writes PNG files.

    Args:
        images: content by name, without extension.
        directory: where; made if missing.

    Raises:
        InputError: the directory cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror or error}") from error
    for name, content in images.items():
        with replacing(directory / f"{name}.png") as file:
            file.write(content)


def write_page(
    page: Path, title: str, made: Sequence[tuple[Source, Report]], notes: Sequence[str] = ()
) -> None:
    """Writes a documentation page, and its figures beside it.

    Args:
        page: Markdown file; figures go to ``figures/`` in its directory.
        title: of the page.
        made: what stands on it, in this order.
        notes: said below the headline.

    Raises:
        InputError: the page cannot be written.
    """
    configs = ", ".join(f"configs/{source.config}" for source, _ in made)
    version = runtime.package_version()
    lines = [
        f"<!-- Written by: sinsjax report --page {page.name} ({configs}; sinsjax {version});"
        " do not edit -->",
        f"# {title}",
        *(f"- {line}" for _, report in made for line in report.headline),
        *notes,
    ]
    for source, report in made:
        prefix = f"{source.study.study.name}_"
        images = {f"{prefix}{block.name}": plots.png(block.figure) for block in pictures(report)}
        save_figures(images, page.parent / FIGURES)
        for section in report.sections:
            lines.append(f"## {section.heading}")
            lines += [markdown(block, prefix) for block in section.blocks]
    text = (
        "\n\n".join(lines).replace("\n\n- ", "\n- ").replace(f"# {title}\n- ", f"# {title}\n\n- ")
    )
    with replacing(page) as file:
        file.write(f"{text}\n".encode())


def markdown(block: Block, prefix: str = "") -> str:
    """A block as Markdown.

    Args:
        block: to write.
        prefix: before the file name of a figure.
    """
    if isinstance(block, Text):
        return block.text
    if isinstance(block, Picture):
        return f"![{block.caption}]({FIGURES}/{prefix}{block.name}.png)\n\n*{block.caption}*"
    rows = [block.header, ["---"] * len(block.header), *block.rows]
    body = "\n".join("| " + " | ".join(_cell(cell) for cell in row) + " |" for row in rows)
    note = f"\n\n{block.note}" if block.note else ""
    if block.folded:
        return f"<details>\n<summary>{block.title}</summary>\n\n{body}{note}\n\n</details>"
    return f"**{block.title}**\n\n{body}{note}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _plain(text: str) -> str:
    return text.replace("*", "").replace("`", "")


def _say(console: Console, text: str) -> None:
    console.print(_plain(text), markup=False, highlight=False, soft_wrap=not console.is_terminal)


def _print_table(block: Table, console: Console) -> None:
    table = rich_table.Table(
        title=RichText(block.title, style="bold"),
        caption=RichText(_plain(block.note)) if block.note else None,
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for name in block.header:
        table.add_column(RichText(name))
    for row in block.rows:
        table.add_row(*map(RichText, row))
    width = console.width
    if not console.is_terminal:  # a file or a pipe has no width to fit in
        wide = console.options.update(max_width=10_000)
        console.width = Measurement.get(console, wide, table).maximum
    console.print(table)
    console.width = width
