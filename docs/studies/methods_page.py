"""Render docs/methods.md: ``python -m docs.studies.methods_page > docs/methods.md``."""

from collections.abc import Iterable

from sinsjax.methods.filters.triggers import TRIGGERS
from sinsjax.methods.gravity_fit.method import REFITS
from sinsjax.methods.method import INITIAL_KEYS, Method
from sinsjax.methods.registry import METHODS

_RESETS_AND_FEEDBACK = (
    "At a reset the whole estimate is fed back, then P is set anew. Its effect depends on how"
    " soon the next feedback follows. Two keys of [resets] define that, for schedules and"
    " triggers alike. With `reset_restarts_feedback = true` the next feedback follows a whole"
    " interval after a reset, and later ones at intervals from there, across the ends of passes"
    " too. With `reset_at_feedback = true` a reset waits for the next feedback: two that wait"
    " for the same one are one reset, the columns of the schedule give its times as written, and"
    " a reset by a trigger is counted when it takes place, or dropped if a pass ends before. A"
    " reset that has waited restarts nothing, so both keys together act like the second alone;"
    " with feedback after every sample neither has an effect. Neither has a gradient: a reset"
    " spread over a window has no phase. After coarse alignment that hands over, the clock"
    " starts with fine alignment: a schedule can wait for feedback there only if the coarse"
    " alignment lasts whole feedback intervals."
)

_TURNING = (
    "One turn or a few give a heading of 1.0 to 1.25 times `sinsjax.information_bound` in rms, for"
    " gyro biases of 0.01 to 1 deg/h, 300 s or more, and gyros without errors of scale factor and"
    " cross-axis, which no state models. With 300 ppm and 1 mrad of these, one turn of 180 deg in"
    " 300 s and gyros of 0.1 deg/h, it is 1.3 to 1.9 times the bound (9.8' to 14.2' of 7.5'), more"
    " for a smaller `r_velocity_m_per_s` (0.1 to 0.001 m/s), and some runs on a carousel diverge:"
    " use `gravity_fit`, which estimates them. Beyond 1 deg/h the heading of the first position is"
    " too bad for a linear filter: at 10 deg/h it is 2 to 3 times the bound from a heading known to"
    " 1 deg, and 7.5 times or more from one 45 deg off. A reset of P after the start of a turn"
    " forgets the first position."
)

_GRADIENTS = (
    "A numeric key of a method's own sections has a gradient for `[tune]`, unless it counts samples"
    " or chooses; `tune` refuses the others by name."
)


def render_methods_page() -> str:
    """Return the keys and columns of every method as Markdown."""
    methods = list(METHODS.values())
    filters = [method for method in methods if "filter" in method.sections]
    shared = set.intersection(*({*_entries(method)} for method in filters))
    lines = [
        "# Alignment methods",
        "",
        "`[alignment] method` names one; it may be swept.",
        "",
        "| method | what it does | source |",
        "| --- | --- | --- |",
        *(f"| `{m.name}` | {m.summary} | {m.source} |" for m in methods),
        "",
        f"Without a covariance: {_name_all(m for m in methods if not m.has_covariance)}. Without a"
        " known bias floor, the heading error that constant sensor biases leave:"
        f" {_name_all(m for m in methods if not m.has_floor)}.",
        "",
        "## Keys and columns",
        "",
        f"{_GRADIENTS} Every Kalman filter ({_name_all(filters)}) reads and returns:",
        "",
        *_format(entry for entry in _entries(filters[0]) if entry in shared),
        "",
        "Further keys and columns:",
        "",
    ]
    alike: dict[tuple[str, ...], list[Method]] = {}
    for method in methods:
        left_out = shared if method in filters else set()
        own = _format(entry for entry in _entries(method) if entry not in left_out)
        alike.setdefault((*own,), []).append(method)
    for rows, found in alike.items():
        lines.append(f"- {_name_all(found)}:{'' if rows else ' none.'}")
        lines += [f"    {row}" for row in rows]
    lines += ["", f"{REFITS}."]
    lines += ["", "## `kalman10` on a base that is turned", "", _TURNING]
    lines += ["", "## Resets between two feedbacks", "", _RESETS_AND_FEEDBACK]
    lines += ["", "## Triggers", "", "`[resets] reset_trigger` names one.", ""]
    lines += ["| trigger | calls for a reset at |", "| --- | --- |"]
    lines += [f"| `{name}` | {trigger.summary} |" for name, trigger in TRIGGERS.items()]
    return "\n".join(lines) + "\n"


def _name_all(methods: Iterable[Method]) -> str:
    return ", ".join(f"`{method.name}`" for method in methods)


def _entries(method: Method) -> list[tuple[str, str]]:
    """Return heading and text of each key that a method reads, and of each of its columns."""
    keys = [("alignment, passes", key) for key in sorted([*INITIAL_KEYS, *method.reads])]
    for name, section in method.sections.items():
        keys += [(name, key) for key in section.model_fields]
    columns = (own.column for own in method.columns)
    return [
        *((f"`[{name}]`", f"`{key}`") for name, key in keys if key not in method.idle_keys),
        *(("Columns", f"`{column.name}` ({column.meaning})") for column in columns),
    ]


def _format(entries: Iterable[tuple[str, str]]) -> list[str]:
    """Return a line for each heading."""
    texts: dict[str, list[str]] = {}
    for heading, text in entries:
        texts.setdefault(heading, []).append(text)
    return [f"- {heading}: {', '.join(found)}." for heading, found in texts.items()]


if __name__ == "__main__":
    print(render_methods_page(), end="")
