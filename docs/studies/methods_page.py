"""Render docs/methods.md: ``python -m docs.studies.methods_page > docs/methods.md``."""

from collections.abc import Iterable

from sinsjax.methods.gravity_fit import REFITS
from sinsjax.methods.method import Method
from sinsjax.methods.registry import METHODS

_RESETS_AND_FEEDBACK = (
    "At a reset the whole estimate is fed back, then P is set anew; its effect depends on how "
    "soon the next feedback follows. With `reset_restarts_feedback = true` the next feedback "
    "follows a whole interval after a reset. With `reset_at_feedback = true` a scheduled reset "
    "waits for the next feedback: two that wait for the same one are one, and the columns of "
    "the schedule give its times as written. Both together act like the second alone; with "
    "feedback at every sample neither has an effect, nor has either a gradient. After coarse "
    "alignment that hands over, the clock starts with fine alignment."
)

_TURNING = (
    "One turn or a few give 1.0 to 1.25 times the information bound in rms, for gyro biases of 0.01"
    " to 1 deg/h, 300 s or more and gyros without errors of scale factor and cross-axis. With 300"
    " ppm and 1 mrad of these it is 1.3 to 1.9 times the bound, and some runs on a carousel"
    " diverge: use `gravity_fit`, which estimates them. Beyond 1 deg/h the heading of the first"
    " position is too bad for a linear filter."
)


def render_methods_page() -> str:
    """Return what every method does, reads and returns as Markdown."""
    methods = list(METHODS.values())
    columns: dict[tuple[str, str], list[Method]] = {}
    for method in methods:
        for own in method.columns:
            columns.setdefault((own.column.name, own.column.meaning), []).append(method)
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
        *(f"- `{name}` ({_name_all(by)}): {text}" for (name, text), by in columns.items()),
    ]
    lines += ["", "## `kalman10` on a base that is turned", "", _TURNING]
    lines += ["", "## Resets between two feedbacks", "", _RESETS_AND_FEEDBACK]
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
