"""The verdict: what it chooses, what it states, and how it fits a terminal."""

from pathlib import Path

import numpy as np
import pytest
from support.stored_results import report_text, store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax import analysis
from sinsjax.execution.results import Results
from sinsjax.report.verdict import build_short_report, excessive_process_noise_caution

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]


def facts_by_label(found):
    """The facts by label; several of a label are joined."""
    texts = {}
    for label, text, _ in found.facts:
        texts[label] = f"{texts[label]}; {text}" if label in texts else text
    return texts


def verdict(study, **columns):
    """The facts about a study whose summary has these columns."""
    summary = synthetic_summary(study, **columns)
    return facts_by_label(build_short_report(Results(study, None, tables={"summary": summary})))


def settling(settle_s):
    """The columns of settling times (draws, variants), NaN for never."""
    status = list(np.where(np.isfinite(settle_s.ravel()), "ok", "not_settled"))
    times = dict.fromkeys(("settle_10_s", "settle_10_truth_s"), settle_s.ravel())
    return {"status": status, **times}


def settling_times():
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


def test_verdict_names_best_schedule_its_rivals_and_each_condition():
    axes = {"reset_count": [0, 1, 2], "reset_cycle_s": [1.0, 2.0], "phi_u0_deg": [5.0, 30.0, 60.0]}
    study = small_study(study={"draws": 16, "name": "sweep"}, axes=axes)
    summary = synthetic_summary(study, **settling(settling_times()))
    found = build_short_report(Results(study, None, tables={"summary": summary}))
    facts, table = facts_by_label(found), found.table
    times, draws = np.array([45.0, 40.0, 30.0]) + np.arange(16.0)[:, None], np.arange(16)
    mean = analysis.format_estimate(analysis.mean(times.ravel(), np.repeat(draws, 3)), "s", 0)
    assert facts["Best"] == f"2 resets, every 2 s: every run settles, after {mean} on average"
    assert "s; no reset: 33 [" in facts["Others"]
    # Faster, and two failures on 16 draws do not tell it apart.
    assert facts["Not told apart"] == "1 reset at 1 s (on 16 draws)"
    assert facts["Success"] == "100 [79, 100] % within 10' of true north"
    assert found.title == "sweep: 288 runs (240 distinct), none failed"
    header = "heading error | best option | settles after, mean (s) | no reset (s)"
    assert table.header == header.split(" | ")
    assert [row[0] for row in table.rows] == ["5 deg", "30 deg", "60 deg"]
    assert [row[1] for row in table.rows] == ["1 reset at 1 s"] * 2 + ["2 resets, every 2 s"]
    assert table.rows[0][3].startswith("38 [") and table.rows[1][3] == "never"


def test_mean_time_of_few_settled_runs_stays_within_the_run():
    """Of 8 runs of 6 s two settle, far apart: Student's interval would be 8 times as long."""
    settle_s = np.full((8, 1), np.nan)
    settle_s[:2, 0] = 1.0, 5.0
    facts = verdict(small_study(study={"draws": 8}), **settling(settle_s))
    assert facts["Settling"].endswith("% of the runs settle, after 3 [0, 6] s on average")


@pytest.mark.parametrize(
    ("errors", "end"),
    [((5.0, 500.0), ", mostly of runs that never settle"), ((5.0, 5.0), "bias floor (4.0')")],
)
def test_accuracy_is_limited_by_unsettled_runs_or_by_the_floor(errors, end):
    study = small_study(study={"draws": 8}, axes={"phi_u0_deg": [5.0, 60.0]}, sensors={})
    error = np.tile(errors, 8)
    floor = np.full(error.size, 4.0)
    facts = verdict(study, ok_truth=error < 10, phi_u_arcmin=error, floor_arcmin=floor)
    assert facts["Accuracy"].endswith(end)


@pytest.mark.parametrize(("scale", "cautions"), [(None, True), (1e-3, False)])
def test_q_above_ten_times_the_noise_is_cautioned(scale, cautions):
    study = small_study(filter={} if scale is None else {"q_scale": scale})
    (*found,) = excessive_process_noise_caution(Results(study, None))
    assert bool(found) == cautions
    if found:  # 100 Hz with Q per step: 100 times the standard deviation of a sample
        assert found[0].text.startswith("Q is 100 times the sensors' noise") and found[0].is_caution


def test_method_that_has_no_bias_floor_is_compared_from_the_truth():
    study = small_study(study={"draws": 8, "judged_from": "floor"}, axes={"phi_u0_deg": [0.0, 9.0]})
    assert "of true north" in verdict(study, ok_floor=[True] * 15 + [None])["Success"]


def test_numbers_of_the_best_are_its_own_and_equals_are_not_told_apart():
    """As anybody computes them from the rows: half of the draws would choose another option."""
    random = np.random.default_rng(5)
    axes = {"p0_yaw_deg": [5.0, 10.0, 20.0, 40.0]}
    study = small_study(study={"draws": 32}, axes=axes, sensors={})
    settle_s = random.normal(3.0, 0.3, (32, 1)) + random.normal(0.0, 0.2, (32, 4))
    settle_s[:, 1] -= 0.02
    settle_s[:, 3] += 2.0
    settle_s[::8, 2] = np.nan
    facts = verdict(study, **settling(settle_s))
    best = int(settle_s[:, [0, 1]].mean(axis=0).argmin())
    own = analysis.format_estimate(analysis.mean(settle_s[:, best]), "s", 0)
    best_option, other = (f"heading sigma in P0 {deg} deg" for deg in (5, 10)[:: 1 - 2 * best])
    assert facts["Best"] == f"{best_option}: every run settles, after {own} on average"
    assert facts["Not told apart"] == f"{other} (on 32 draws)"


def test_band_out_of_reach_is_the_first_line():
    noisy = {"gyro_arw_deg_per_sqrt_h": 1.0, "gyro_noise_deg_per_h": None}
    study = small_study(study={"draws": 8}, sensors=noisy)
    summary = synthetic_summary(study)
    source = Results(study, None, tables={"summary": summary}, directory=Path("out"))
    first, *_ = build_short_report(source, warnings_shown=True).facts
    assert first.is_caution and "cannot be reached" in first.text


@pytest.mark.parametrize(("shift_s", "warns"), [(0.0, False), (3.0, True)])
def test_choice_that_other_draws_contradict_is_a_caution(shift_s, warns):
    """Two options, each far faster on one half of the draws: no choice stands."""
    study = small_study(study={"draws": 32}, axes={"p0_yaw_deg": [5.0, 10.0]}, sensors={})
    settle_s = 1.0 + np.random.default_rng(2).uniform(0.0, 0.1, (32, 2))
    settle_s += shift_s * np.tile(np.eye(2), (16, 1))
    facts = verdict(study, **settling(settle_s))
    assert ("on draws that did not choose" in facts.get("Caution", "")) == warns


def test_headings_too_far_east_are_not_within_the_band_at_the_end():
    """The synthetic headings are west of north by their bias floor."""
    study = small_study(study={"judged_from": "floor"}, axes={"phi_u0_deg": [0.0, 30.0]})
    facts = verdict(study)
    assert facts["Settling"].startswith("every run settles")
    assert facts["Success"].endswith(", 0 [0, 71] % of north")


def test_report_prints_verdict_alone_until_all_tables_are_asked_for(tmp_path):
    study = small_study(study={"draws": 8, "dwell_s": 0.0}, axes={"phi_u0_deg": [0.0, 30.0]})
    directory = store_results(tmp_path / "out", study, synthetic_summary(study))
    short = report_text(directory, full=False, width=80)
    assert len(short.splitlines()) <= 18 and "Every variant" not in short and "--full" in short
    assert all(len(line) <= 80 or str(tmp_path) in line for line in short.splitlines())
    full = report_text(directory)
    assert "Every variant" in full and "Heading error from true north" in full
    assert "ok: it is there at the end" in " ".join(full.split())
