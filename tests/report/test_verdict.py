"""The verdict: what it chooses, on which draws it judges, and how it fits a terminal."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.stored_results import report_text, store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax import analysis
from sinsjax.execution.source import Source
from sinsjax.report import terminal
from sinsjax.report.base import Verdict
from sinsjax.report.choices import Choices, best_option, best_option_per_draw
from sinsjax.report.verdict import process_noise_caution, sweep_verdict
from sinsjax.study.study import Study

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

SWEEP = {"reset_count": [0, 1, 2], "reset_cycle_s": [1.0, 2.0], "phi_u0_deg": [5.0, 30.0, 60.0]}
NEVER = np.inf


def sweep_study(draws: int = 16, **changes: Any) -> Study:
    return small_study(study={"draws": draws, "name": "sweep"}, axes=SWEEP, **changes)


def facts_by_label(found: Verdict) -> dict[str, str]:
    """The facts by label; several of a label are joined."""
    texts: dict[str, str] = {}
    for label, text, _ in found.facts:
        texts[label] = f"{texts[label]}; {text}" if label in texts else text
    return texts


def verdict_from_times(study: Study, settle_s: np.ndarray) -> Verdict:
    """The verdict on settling times (draws, variants), NaN for never."""
    flags = np.isfinite(settle_s.ravel())
    status = list(np.where(flags, "ok", "not_settled"))
    names = ("settle_10_s", "settle_10_truth_s")
    columns = dict.fromkeys(names, np.where(flags, settle_s.ravel(), np.nan))
    summary = synthetic_summary(study, status=status, **columns)
    return sweep_verdict(Source(Path("out"), study, "x.toml", summary))


# --- the choice -----------------------------------------------------------------------------


def test_each_draw_is_judged_with_option_chosen_by_the_other_half() -> None:
    random = np.random.default_rng(3)
    time_s = random.gamma(4.0, 10.0, (5, 3, 17))
    time_s[random.random(time_s.shape) < 0.1] = NEVER
    found = best_option_per_draw(time_s, 90.0)
    for draw in range(17):
        others = [other for other in range(17) if other % 2 != draw % 2]
        ranks = []
        for option in range(5):
            own = time_s[option][:, others]
            ranks.append((np.isinf(own).sum(), np.where(np.isinf(own), 90.0, own).mean(), option))
        assert found[draw] == min(ranks)[-1]
    assert len(set(found)) <= 2


def test_choice_prefers_fewest_failures_then_fastest() -> None:
    time_s = np.array([[[NEVER, 1.0]], [[50.0, 60.0]], [[50.0, 40.0]]])
    assert best_option(time_s, 100.0) == 2
    assert best_option(time_s[:2], 100.0) == 1


def test_held_out_choice_is_not_flattered_by_many_equal_options() -> None:
    """All options are equal: judged on its own draws, the best would seem faster."""
    random = np.random.default_rng(1)
    own, fresh = [], []
    for _ in range(200):
        time_s = random.normal(100.0, 10.0, (50, 1, 16))
        places = best_option_per_draw(time_s, 200.0)
        fresh.append(time_s[places, 0, np.arange(16)].mean())
        own.append(time_s[best_option(time_s, 200.0), 0].mean())
    assert abs(np.mean(fresh) - 100.0) < 3 * np.std(fresh) / np.sqrt(200) < 1.0
    assert np.mean(own) < 96.0


def test_copies_of_a_variant_are_one_option() -> None:
    choices = Choices.from_study(sweep_study())
    assert choices.options == [
        "no reset",
        "1 reset at 1 s",
        "1 reset at 2 s",
        "2 resets, every 1 s",
        "2 resets, every 2 s",
    ]
    assert choices.reset_counts == [0, 1, 1, 2, 2] and choices.variants.shape == (5, 3)
    column = np.arange(18 * 4.0)
    runs = choices.arrange_runs(column)
    assert runs.shape == (5, 3, 4)
    np.testing.assert_array_equal(runs[0, 0], [0, 18, 36, 54])


# --- what it states -------------------------------------------------------------------------


def settling_times() -> np.ndarray:
    """Settling times (16 draws, 18 variants): 2 resets every 2 s are best from 30 and 60 deg."""
    draw = np.arange(16.0)[:, None, None]
    at = np.full((16, 6, 3), np.nan)  # counts and cycles, misalignments
    at[:, 0:2, 0] = 30.0 + draw[:, 0]  # without a reset, from 5 deg alone
    at[:, 2] = (20.0 + draw)[:, 0]
    at[:, 3] = (60.0 + draw)[:, 0]
    at[:, 4] = (50.0 + draw)[:, 0]
    at[:, 5] = (np.array([45.0, 40.0, 30.0]) + draw)[:, 0]
    at[:2, 2, 2] = np.nan  # the fastest fails once in each half
    return at.reshape(16, 18)


def test_verdict_names_best_schedule_its_rivals_and_each_condition() -> None:
    found = verdict_from_times(sweep_study(), settling_times())
    told = facts_by_label(found)
    mean = analysis.mean((np.array([45.0, 40.0, 30.0]) + np.arange(16.0)[:, None]).ravel(), DRAW)
    assert told["Best"] == (
        "2 resets, every 2 s: every heading error from 5 to 60 deg settles,"
        f" after {analysis.format_estimate(mean, 's', 0)} on average"
    )
    assert told["Others"].startswith("1 reset at 2 s: 68 [") and "no reset: 33 [" in told["Others"]
    assert told["Draws"] == "16: each half evaluates the choice of the other"
    assert told["Success"] == "100 [79, 100] % within 10' of true north"
    assert found.title == "sweep: 288 runs (240 distinct), none failed"
    table = found.table
    assert table is not None
    assert table.header == [
        "heading error",
        "best schedule",
        "settles after, mean (s)",
        "no reset (s)",
    ]
    assert [row[0] for row in table.rows] == ["5 deg", "30 deg", "60 deg"]
    assert [row[1] for row in table.rows] == ["1 reset at 1 s"] * 2 + ["2 resets, every 2 s"]
    assert table.rows[0][3].startswith("38 [") and table.rows[1][3] == "never"


DRAW = np.repeat(np.arange(16), 3)


def test_mean_time_of_few_settled_runs_stays_within_the_run() -> None:
    """Of 8 runs of 6 s two settle, far apart: Student's interval would be 8 times as long."""
    settle_s = np.full((8, 1), np.nan)
    settle_s[:2, 0] = 1.0, 5.0
    told = facts_by_label(verdict_from_times(small_study(study={"draws": 8}), settle_s))
    assert told["Settling"].endswith("% of the runs settle, after 3 [0, 6] s on average")


def test_runs_that_never_settle_limit_the_accuracy() -> None:
    study = small_study(study={"draws": 8}, axes={"phi_u0_deg": [5.0, 60.0]}, sensors={})
    never = np.tile([False, True], 8)
    summary = synthetic_summary(
        study,
        ok_truth=~never,
        phi_u_arcmin=np.where(never, 500.0, 5.0),
        floor_arcmin=np.full(16, 4.0),
    )
    source = Source(Path("out"), study, "x.toml", summary)
    assert "mostly of runs that never settle" in facts_by_label(sweep_verdict(source))["Accuracy"]
    near = synthetic_summary(study, phi_u_arcmin=np.full(16, 5.0), floor_arcmin=np.full(16, 4.0))
    found = facts_by_label(sweep_verdict(Source(Path("out"), study, "x.toml", near)))["Accuracy"]
    assert found.startswith("5.0 [") and found.endswith("mostly bias floor (4.0')")


@pytest.mark.parametrize(("scale", "cautions"), [(None, True), (1e-3, False)])
def test_q_above_ten_times_the_noise_is_cautioned(scale: float | None, cautions: bool) -> None:
    study = small_study(filter={} if scale is None else {"q_scale": scale})
    (*told,) = process_noise_caution(Source(Path("out"), study, "x.toml"))
    assert bool(told) == cautions
    if told:  # 100 Hz with Q per step: 100 times the standard deviation of a sample
        assert told[0].text.startswith("Q is 100 times the sensors' noise") and told[0].is_caution


def test_method_that_has_no_bias_floor_is_compared_from_the_truth() -> None:
    study = small_study(study={"draws": 8, "judged_from": "floor"}, axes={"phi_u0_deg": [0.0, 9.0]})
    flags = [True] * 15 + [None]
    summary = synthetic_summary(study, ok_floor=flags)
    found = sweep_verdict(Source(Path("out"), study, "x.toml", summary))
    assert "of true north" in facts_by_label(found)["Success"]


# --- the terminal ---------------------------------------------------------------------------


def test_report_prints_verdict_alone_until_all_tables_are_asked_for(tmp_path: Path) -> None:
    study = small_study(study={"draws": 8}, axes={"phi_u0_deg": [0.0, 30.0]})
    directory = store_results(tmp_path / "out", study, synthetic_summary(study))
    short = report_text(directory, full=False, width=80)
    assert (
        len(short.splitlines()) <= 1 + terminal.MAX_VERDICT_LINES and "Every variant" not in short
    )
    assert "--full" in short
    full = report_text(directory)
    assert "Every variant" in full and "Heading error from true north" in full
