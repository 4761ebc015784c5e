"""What methods say of themselves: ``python -m sinsjax.alignment.page > docs/methods.md``."""

from sinsjax.alignment.description import Description
from sinsjax.alignment.methods import METHODS
from sinsjax.alignment.triggers.description import TRIGGERS


def page() -> str:
    """What every method reads, gives and can be tuned by, as Markdown."""
    cells = (
        (f"`{m.name}`", m.summary, m.source, _yes(m.has_covariance), _yes(m.has_limit))
        for m in METHODS.values()
    )
    lines = [
        "# Alignment methods",
        "",
        "`[alignment] method` names one; it may be swept. The limit is the heading error that"
        " constant sensor biases leave.",
        "",
        "| method | what it does | source | covariance | limit |",
        "| --- | --- | --- | --- | --- |",
        *(f"| {' | '.join(row)} |" for row in cells),
    ]
    for method in METHODS.values():
        lines += ["", f"## `{method.name}`", "", *_keys(method)]
    lines += ["", "## Triggers", "", "`[resets] reset_trigger` names one.", ""]
    lines += ["| trigger | calls for a reset at |", "| --- | --- |"]
    lines += [
        f"| `{t.name}` | {t.summary}{' (P fades instead)' if t.fades else ''} |"
        for t in TRIGGERS.values()
    ]
    return "\n".join(lines) + "\n"


def _yes(flag: bool) -> str:
    return "yes" if flag else "no"


def _keys(method: Description) -> list[str]:
    """The keys that a method reads, and which of them have a gradient in `[tune]`."""
    own = {name: list(section.model_fields) for name, section in method.sections.items()}
    own = {"alignment, passes": sorted(method.reads)} | own
    relaxed = method.implementation.relaxed
    lines = [
        f"- [{name}]: {', '.join(f'`{key}`' for key in keys if key not in method.silent)}."
        for name, keys in own.items()
    ]
    if method.columns:
        told = (f"`{own.column.name}` ({own.column.meaning})" for own in method.columns)
        lines.append(f"- Own columns: {', '.join(told)}.")
    if relaxed:
        keys = {*relaxed.changes, *filter(None, [relaxed.times])}
        with_gradient = sorted(keys.difference(method.silent))
        lines.append(f"- With a gradient: {', '.join(f'`{key}`' for key in with_gradient)}.")
    return lines


if __name__ == "__main__":
    print(page(), end="")
