"""Resets that set themselves: triggers against the best fixed single reset of each cell."""

from collections.abc import Iterator

import numpy as np

from sinsjax.analysis import Estimate
from sinsjax.report import adaptive_figures, adaptive_tables, adaptive_triggers, reset_cycle
from sinsjax.report.adaptive_cells import HEALTHY_LEVEL_DEG, HEALTHY_YAW_DEG, Cells
from sinsjax.report.adaptive_scores import FEW_ALARMS, Scores
from sinsjax.report.adaptive_tables import (
    LESS,
    cell_name,
    cells_within,
    counted,
    is_reached,
    ratio_text,
)
from sinsjax.report.base import Block, Report, Section, Source, Text
from sinsjax.report.reset_grid import BAND_ARCMIN, NONE, PAPER_SCHEDULE


def report(source: Source) -> Report:
    """Whether one trigger with one threshold does what the best single reset of each cell does.

    Raises:
        InputError: runs are missing, or the study is no grid of policies over starts and tunings
            with no reset, the paper's three, single resets, a trigger and healthy starts.
    """
    cells = Cells.of(source)
    scores = Scores(cells)
    cost = reset_cycle.cost(source)
    found: list[Block] = [
        Text(_method(cells)),
        adaptive_tables.by_feedback(scores),
        adaptive_tables.beyond(scores),
        adaptive_figures.ratios(scores),
        adaptive_figures.settling(scores),
        adaptive_tables.policies(scores),
        adaptive_tables.by_cell(scores),
    ]
    return Report(
        [_scope(source, cells), *_headline(scores), cost.headline],
        [
            Section("Does one trigger do what the best single reset does?", found),
            adaptive_triggers.section(scores),
            Section(cost.heading, cost.blocks),
        ],
    )


def _scope(source: Source, cells: Cells) -> str:
    return (
        f"{source.runs:,} runs of {cells.study.run_s:g} s: {len(cells.policies)} policies x"
        f" {len(cells.starts)} starts x {len(cells.tunings)} tunings of the filter x {cells.draws}"
        " draws."
    )


def _headline(scores: Scores) -> Iterator[str]:
    yield _winner(scores)
    yield _goal(scores)
    yield _others(scores)


def _winner(scores: Scores) -> str:
    cells, choice = scores.cells, scores.choice
    policy, worst = cells.policies[choice.place], scores.worst(choice.place)
    ratio = scores.ratio(worst, choice.place)
    so = f"it is {ratio_text(ratio)} times that" if np.isfinite(ratio.value) else "it never settles"
    told = "chosen by each half of the draws and told by the other"
    if not choice.is_held_out:
        halves = " and ".join(cells.policies[i].name for i in dict.fromkeys(choice.halves))
        told = f"chosen on the draws that tell it; its halves alone chose {halves}"
    numbers = f"{policy.settings}; " if policy.settings else ""
    return (
        f"The best of {len(cells.triggered)} triggers and thresholds is `{policy.trigger}` at"
        f" {policy.threshold:g} ({numbers}{told}). Its median settling time is within {LESS} of"
        f" that of the best single reset in {cells_within(scores.within(choice.place))} cells; at"
        f" worst, {cell_name(scores, worst)}, {so}. False alarms among the healthy runs:"
        f" {_alarms(scores)}."
    )


def _alarms(scores: Scores) -> str:
    place = scores.choice.place
    without, biased = (scores.alarms(place, biased=b).false for b in (False, True))
    return f"{counted(without)} without gyro bias, {counted(biased)} with it"


def _goal(scores: Scores) -> str:
    """Whether the goal is reached, in all and at each feedback interval."""
    cells, place = scores.cells, scores.choice.place
    parts = []
    for feedback in (None, *cells.feedbacks):
        within, alarms = scores.within(place, feedback), scores.alarms(place, feedback_s=feedback)
        reached = "reached" if is_reached(within, alarms) else "not reached"
        told = f"{cells_within(within)} cells, false alarms {counted(alarms.false)}"
        parts.append(f"{reached} ({told})")
    every, *each = parts
    by_feedback = "; ".join(
        f"feedback {feedback:g} s: {part}"
        for feedback, part in zip(cells.feedbacks, each, strict=True)
    )
    return (
        f"The goal, every cell within {LESS} of the best single reset and under"
        f" {100 * FEW_ALARMS:g} % false alarms: {every}. By feedback interval: {by_feedback}."
    )


def _others(scores: Scores) -> str:
    cells = scores.cells
    mine = cells.policies[scores.choice.place].trigger
    rest = [place for name, place in scores.by_trigger.items() if name != mine]
    fixed = [cells_within(scores.within(cells.policy(t))) for t in (NONE, PAPER_SCHEDULE)]
    text = f"Without reset it is {fixed[0]} cells, with the paper's three {fixed[1]}"
    if rest:
        place = scores.best(rest)
        alarms = scores.alarms(place).false
        text += (
            f"; the best of the other triggers, {cells.policies[place].name}, comes to"
            f" {cells_within(scores.within(place))} with {counted(alarms)} false alarms"
        )
    return f"{text}. {_sooner(scores)}"


def _sooner(scores: Scores) -> str:
    """Where the best trigger beats the oracle."""
    found: list[Estimate] = [scores.ratio(at, scores.choice.place) for at in scores.at]
    sooner = [ratio for ratio in found if ratio.high < 1]
    only = sum(ratio.value == 0 for ratio in sooner)
    return (
        f"The best trigger settles sooner than the best single reset in {len(sooner)} cells,"
        f" interval included, of which in {only} no single reset settles half of the runs: it may"
        " reset more than once."
    )


def _method(cells: Cells) -> str:
    times = ", ".join(f"{cells.policies[i].times[0]:g}" for i in cells.singles)
    bias = cells.starts[cells.judged[0]].bias
    return (
        "A cell is a tuning of the filter (how Q is read, feedback interval) and a start (level"
        " errors about east and north, yaw error) with a gyro bias of"
        f" {bias:g} deg/h, which no state models. The oracle is the best single reset of each cell,"
        f" of those at {times} s: where most draws settle to {BAND_ARCMIN} arcmin,"
        " then with the least median settling time; each half of the"
        f" {cells.draws} draws chooses it for the other. A trigger has one threshold for all cells."
        " A run that never settles counts as one that takes for ever; where neither settles half of"
        " its runs, the ratio of the medians is 1. All policies have the same noise. Healthy starts"
        f" have level errors up to {HEALTHY_LEVEL_DEG:g} deg and a yaw error up to"
        f" {HEALTHY_YAW_DEG:g} deg."
    )
