"""Render docs/methods.md: ``python -m sinsjax.methods.page > docs/methods.md``."""

from sinsjax.methods.description import Description
from sinsjax.methods.registry import METHODS
from sinsjax.methods.triggers.config import TRIGGERS

_RESETS_AND_FEEDBACK = (
    "At a reset all of the estimate is fed back, then P is set anew. The effect depends on"
    " how soon after the reset the next feedback is due, which is whatever part of"
    " `feedback_interval_s` the schedule happens to leave. Two keys of [resets] define it, for"
    " schedules and triggers alike. With `reset_restarts_feedback = true` the next feedback comes"
    " a whole interval after a reset, and the following ones an interval apart from there, over"
    " the ends of passes too. With `reset_at_feedback = true` a reset waits for the next feedback."
    " Two that wait for the same one are one reset; the columns of the schedule give its times as"
    " written. A reset by a trigger is counted when it takes place, and forgotten if a pass"
    " ends before. A reset that has waited restarts nothing, so that both keys together do what"
    " the second does alone; with feedback after every sample neither does anything. Neither has"
    " a gradient, as a reset spread over a window has no phase. After coarse alignment that hands"
    " over, the clock begins with fine alignment: a schedule can wait for feedback there only if"
    " the coarse alignment lasts whole feedback intervals."
)

_TURNING = (
    'With `turning = "update"`, the default, one turn or a few give a heading of 1.0 to 1.25 times'
    " `sinsjax.information_bound` in rms, for gyro biases of 0.01 to 1 deg/h, 300 s or more, and"
    " gyros without errors of scale factor and cross-axis, which no state models. With 300 ppm and"
    " 1 mrad of these, one turn of 180 deg in 300 s and gyros of 0.1 deg/h, it is 1.3 to 1.9 times"
    " the bound (9.8' to 14.2' of 7.5'), the more the smaller `r_velocity_m_per_s` (0.1 to 0.001"
    " m/s), and 1.1 to 1.2 times (9.0' to 8.3') with `turning = \"reopen\"`: there is no update"
    " while the base turns, then velocity restarts from zero, and P of velocity, level and"
    " accelerometer biases from P0. Without such errors updates are better (1.1 instead of 1.3"
    " times for four positions, 1.2 instead of 1.4 for one turn in 120 s), and a carousel needs"
    " them, since it never rests; with such errors some runs on a carousel diverge. Beyond 1 deg/h"
    " the heading of the first position is too bad for a linear filter: at 10 deg/h it is 2 to 3"
    " times the bound from a heading known to 1 deg, and 7.5 times or more from one 45 deg off. A"
    " reset of P after"
    " the beginning of a turn forgets the first position."
)


def render_methods_page() -> str:
    """Return the keys, columns and gradients of every method as Markdown."""
    cells = (
        (f"`{m.name}`", m.summary, m.source, _yes_or_no(m.has_covariance), _yes_or_no(m.has_floor))
        for m in METHODS.values()
    )
    lines = [
        "# Alignment methods",
        "",
        "`[alignment] method` names one; it may be swept. The bias floor is the heading error that"
        " constant sensor biases leave.",
        "",
        "| method | what it does | source | covariance | bias floor |",
        "| --- | --- | --- | --- | --- |",
        *(f"| {' | '.join(row)} |" for row in cells),
    ]
    for method in METHODS.values():
        lines += ["", f"## `{method.name}`", "", *_describe_keys(method)]
    lines += ["", "## `kalman10` on a base that is turned", "", _TURNING]
    lines += ["", "## Resets between two feedbacks", "", _RESETS_AND_FEEDBACK]
    lines += ["", "## Triggers", "", "`[resets] reset_trigger` names one.", ""]
    lines += ["| trigger | calls for a reset at |", "| --- | --- |"]
    lines += [
        f"| `{t.name}` | {t.summary}{' (P fades instead)' if t.fades else ''} |"
        for t in TRIGGERS.values()
    ]
    return "\n".join(lines) + "\n"


def _yes_or_no(flag: bool) -> str:
    return "yes" if flag else "no"


def _describe_keys(method: Description) -> list[str]:
    """Return the keys that a method reads, and those with a gradient in `[tune]`."""
    own = {"alignment, passes": sorted(method.reads)}
    for name, section in method.sections.items():
        own[name] = [key for key in section.model_fields if key in method.keys]
    relaxed = method.implementation.relaxation
    lines = []
    for name, its_keys in own.items():
        read = ", ".join(f"`{key}`" for key in its_keys if key not in method.without_effect)
        lines.append(f"- `[{name}]`: {read or 'none'}.")
    if method.columns:
        columns = (f"`{own.column.name}` ({own.column.meaning})" for own in method.columns)
        lines.append(f"- Own columns: {', '.join(columns)}.")
    if relaxed:
        keys = {*relaxed.changes, *filter(None, [relaxed.times])}
        with_gradient = sorted(keys.difference(method.without_effect))
        lines.append(f"- With a gradient: {', '.join(f'`{key}`' for key in with_gradient)}.")
    return lines


if __name__ == "__main__":
    print(render_methods_page(), end="")
