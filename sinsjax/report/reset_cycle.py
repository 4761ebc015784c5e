"""The sweep that paper 1 leaves open: its questions on resets, one after another."""

from sinsjax.execution import tables
from sinsjax.report import reset_choice, reset_claim, reset_failure, reset_timing
from sinsjax.report.base import Report, Section, Source, Table
from sinsjax.report.reset_grid import Answer, Grid

_QUESTIONS = (reset_choice, reset_timing, reset_failure, reset_claim)


def report(source: Source) -> Report:
    """How many resets, when, what governs failure, where the paper's claim holds, at what cost.

    Raises:
        InputError: runs are missing, or the study is no grid of reset schedules over reading, level
            and yaw that holds the paper's point.
    """
    grid = Grid.of(source)
    answers = [*(question.answer(grid) for question in _QUESTIONS), cost(source)]
    return Report(
        [_scope(source, grid), *(answer.headline for answer in answers)],
        [Section(answer.heading, answer.blocks) for answer in answers],
    )


def _scope(source: Source, grid: Grid) -> str:
    return (
        f"{source.runs:,} runs of {grid.study.run_s:g} s: {len(grid.schedules)} schedules of resets"
        f" x {grid.n_points} misalignments x {len(grid.readings)} readings of what the paper does"
        f" not print x {grid.draws} draws."
    )


def cost(source: Source) -> Answer:
    """What the runs took, as the manifest tells."""
    study, manifest = source.study, tables.read_manifest(source.directory)
    sessions = manifest.get("sessions") or [manifest]
    wall_s = sum(session["wall_s"] for session in sessions)
    each = [session.get("devices") or session.get("workers") or 1 for session in sessions]
    busy_s = sum(session["wall_s"] * n for session, n in zip(sessions, each, strict=True))
    devices = " and ".join(map(str, dict.fromkeys(each)))
    steps = source.runs * study.records * study.record_every
    cpus = {session.get("cpu") for session in sessions} - {None}
    rows = [
        ["runs", f"{source.runs:,}"],
        ["steps of sensors, navigation and filter", f"{steps:,}"],
        ["wall time (s)", f"{wall_s:,.0f}"],
        ["devices or workers", devices],
        ["time a step and run on one of them (ns)", f"{busy_s / steps * 1e9:.0f}"],
        ["runs a second", f"{source.runs / wall_s:,.0f}"],
        ["times real time", f"{source.runs * study.run_s / wall_s:,.0f}"],
        *(["processor", cpu] for cpu in sorted(cpus)),
        ["versions", ", ".join(f"{name} {v}" for name, v in manifest["versions"].items())],
    ]
    headline = (
        f"What did it cost? {wall_s / 60:,.1f} min on {devices} devices or workers, for"
        f" {steps:.2g} steps of sensors, navigation and filter."
    )
    note = "From the manifest of the results; compilation and writing are in the wall time."
    return Answer(headline, "What did it cost?", [Table("Cost", ["", ""], rows, note)])
