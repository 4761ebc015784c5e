"""Render docs/methods.md: ``python -m docs.studies.methods_page > docs/methods.md``."""

from collections.abc import Iterable

from sinsjax.methods.gravity_fit.method import REFITS
from sinsjax.methods.method import Method
from sinsjax.methods.registry import METHODS


def render_methods_page() -> str:
    """Return what every method does, reads and returns as Markdown."""
    methods = list(METHODS.values())
    owners: dict[tuple[str, str], list[Method]] = {}
    for method in methods:
        for own in method.columns:
            owners.setdefault((own.column.name, own.column.meaning), []).append(method)
    columns: dict[tuple[str, str], list[str]] = {}
    for (name, meaning), by in owners.items():
        columns.setdefault((_name_all(by), meaning), []).append(f"`{name}`")
    lines = [
        "# Alignment methods",
        "",
        "`[alignment] method` names one; it may be swept. `sinsjax keys METHOD` lists the keys that"
        " it reads. A numeric key of a method's own sections has a gradient for `[tune]`, unless it"
        " counts samples or chooses.",
        "",
        "| method | what it does | sections | source |",
        "| --- | --- | --- | --- |",
        *(f"| `{m.name}` | {m.summary} | {', '.join(m.sections)} | {m.source} |" for m in methods),
        "",
        f"Without a covariance: {_name_all(m for m in methods if not m.has_covariance)}. Without a"
        " known bias floor, the heading error that constant sensor biases leave:"
        f" {_name_all(m for m in methods if not m.has_floor)}.",
        "",
        f"{REFITS}.",
        "",
        "## Columns of methods",
        "",
        *(f"- {', '.join(names)} ({by}): {text}" for (by, text), names in columns.items()),
    ]
    return "\n".join(lines) + "\n"


def _name_all(methods: Iterable[Method]) -> str:
    """Return the names of methods, all filters as one word."""
    names = [method.name for method in methods]
    filters = [name for name, method in METHODS.items() if "filter" in method.sections]
    if {*filters} <= {*names}:
        names = ["filters", *(name for name in names if name not in filters)]
    return ", ".join(name if name == "filters" else f"`{name}`" for name in names)


if __name__ == "__main__":
    print(render_methods_page(), end="")
