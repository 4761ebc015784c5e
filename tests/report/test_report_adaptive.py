"""The page on resets that set themselves, against naive counts over hand-made runs."""

import json
import math
import statistics
import tomllib
from pathlib import Path
from typing import get_args

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.stored import store, told

from sinsjax import analysis
from sinsjax.alignment.triggers.scores import TRIGGERS
from sinsjax.alignment.triggers.section import TriggerName
from sinsjax.analysis.estimates import bootstrap
from sinsjax.errors import InputError
from sinsjax.report import adaptive, adaptive_figures, adaptive_tables, adaptive_triggers
from sinsjax.report.adaptive_cells import Cells, Policy, Start, Tuning
from sinsjax.report.adaptive_scores import Alarms, Scores, ratio_of
from sinsjax.report.base import Picture, Source
from sinsjax.report.reset_best import held_out
from sinsjax.report.reset_grid import NONE, PAPER_SCHEDULE
from sinsjax.study.load import load_study, study_from_dict

CONFIG = Path(__file__).parents[2] / "configs" / "adaptive_resets.toml"
DRAWS = 8
NEVER = math.inf
STARTS = [(0.1, 0, 0), (0.1, 0.1, 1), (0, 0, 0), (0, 0.1, 1), (0.1, 5, 30), (0.1, 20, 120)]
POLICIES = [
    ([], "none", 0),
    ([10], "none", 0),
    ([100], "none", 0),
    ([50, 100, 150], "none", 0),
    ([], "nis", 9),
    ([], "linearisation", 1.2),
    ([], "linearisation", 1.5),
    ([], "fading", 1.0001),
]
NAMES = ["none", "ten", "hundred", "paper", "nis", "early", "late", "fading"]

pytestmark = pytest.mark.usefixtures("drawn_on_request")


def adaptive_study(*, turned=False, **changes):
    """The study on a small grid, its axes turned round; ``changes`` replace keys of sections."""
    data = tomllib.loads(CONFIG.read_text())
    data["study"]["draws"] = DRAWS
    bias, level, yaw = map(list, zip(*STARTS, strict=True))
    times, names, thresholds = map(list, zip(*POLICIES, strict=True))
    data["axes"] |= {
        "q_reading": ["per_step", "psd"],
        "feedback_interval_s": [10, 1],
        "start": {
            "gyro_bias_deg_per_h": bias,
            "phi_e0_deg": level,
            "phi_n0_deg": level,
            "phi_u0_deg": yaw,
        },
        "policy": {
            "reset_times_s": times,
            "reset_trigger": names,
            "trigger_threshold": thresholds,
        },
    }
    for section, change in changes.items():
        data[section] |= change
    if turned:
        data["axes"] = dict(reversed(data["axes"].items()))
    return study_from_dict(data)


def points(study):
    """Tuning, start and policy of each variant, as keys tell them."""
    keys = ("gyro_bias_deg_per_h", "phi_e0_deg", "phi_u0_deg")
    tunings = zip(*map(study.values, ("q_reading", "feedback_interval_s")), strict=True)
    starts = zip(*map(study.values, keys), strict=True)
    triggers = zip(*map(study.values, ("reset_trigger", "trigger_threshold")), strict=True)
    each = zip(tunings, starts, study.reset_times(), triggers, strict=True)
    found = []
    for tuning, start, times, (name, threshold) in each:
        policy = NAMES[POLICIES.index((list(times), name, threshold))]
        found.append((tuning, start, policy))
    return found


def table_of(study, settle, count=None):
    """A summary that no engine made; arrays (draws, variants)."""
    shape = (study.n_draws, study.n_variants)
    settle = np.broadcast_to(settle, shape).ravel()
    count = np.broadcast_to(0 if count is None else count, shape).ravel()
    trigger_counts = count > 0
    first = np.where(trigger_counts, 2.0 * count, np.nan)
    last = np.where(trigger_counts, 7.0 * count, np.nan)
    return pa.table(
        {
            "run_id": np.arange(settle.size),
            "settle_10_s": pa.array(np.where(np.isinf(settle), np.nan, settle), from_pandas=True),
            "triggered_count": pa.array(count.astype(int)),
            "triggered_first_s": pa.array(first, from_pandas=True),
            "triggered_last_s": pa.array(last, from_pandas=True),
        }
    )


def source_of(study, settle, count=None, directory="results"):
    return Source(Path(directory), study, "study.toml", table_of(study, settle, count))


MEDIANS = {
    "none": lambda level, yaw: 100 if level < 1 else (400 if level < 10 else NEVER),
    "ten": lambda level, yaw: 120 if level < 1 else (200 if level < 10 else NEVER),
    "hundred": lambda level, yaw: 210 if level < 1 else (300 if level < 10 else 500),
    "paper": lambda level, yaw: 250 if level < 1 else (300 if level < 10 else 450),
    "nis": lambda level, yaw: 100 if level < 1 else (260 if level < 10 else NEVER),
    "early": lambda level, yaw: 100 if level < 1 else (205 if level < 10 else 250),
    "late": lambda level, yaw: 100 if level < 1 else (240 if level < 10 else 250),
    "fading": lambda level, yaw: 130 if level < 1 else 700,
}
COUNTS = {"early": 2, "late": 1, "nis": 1}


def medians_of(study, noise=2.0):
    """Settling times around the medians, with the noise of a draw in all of its runs."""
    wobble = noise * np.random.default_rng(1).standard_normal((study.n_draws, 1))
    base = [MEDIANS[policy](*start[1:]) for _, start, policy in points(study)]
    return np.array(base) + wobble


def counts_of(study):
    """Resets of triggers: none from a healthy start."""
    return np.array([COUNTS.get(policy, 0) * (start[1] > 1) for _, start, policy in points(study)])


def random_source(seed):
    """Runs at random: settling times on a coarse grid, so that many are equal or never."""
    rng = np.random.default_rng(seed)
    study = adaptive_study()
    shape = (study.n_draws, study.n_variants)
    settle = rng.choice([60.0, 63.0, 80.0, 84.0, 100.0, 160.0, NEVER], size=shape)
    triggered = [policy in COUNTS for *_, policy in points(study)]
    return source_of(study, settle, rng.integers(0, 3, shape) * triggered)


def runs_of(source):
    """Settling times and resets by tuning, start and policy: (settle, count), one a draw."""
    study, table = source.study, source.table
    settle = [NEVER if v is None else v for v in table["settle_10_s"].to_pylist()]
    count = table["triggered_count"].to_pylist()
    n = study.n_variants
    return {key: (settle[i::n], count[i::n]) for i, key in enumerate(points(study))}


def lower_median(values):
    return sorted(values)[(len(values) - 1) // 2]


def ratio(one, other):
    if one == other:
        return 1.0
    return 0.0 if other == NEVER else one / other


def naive_oracle(runs, tuning, start):
    """Settling times of the single reset that is best on the draws of the other half."""
    chosen = []
    for draw in range(DRAWS):
        scores = []
        for policy in ("ten", "hundred"):
            seen = [s for d, s in enumerate(runs[tuning, start, policy][0]) if d % 2 != draw % 2]
            scores.append((seen.count(NEVER), lower_median(seen), policy))
        best = min(scores, key=lambda score: score[:2])[2]
        chosen.append(runs[tuning, start, best][0][draw])
    return chosen


def place(name):
    return NAMES.index(name)


# --- the study ----------------------------------------------------------------------------------


def test_the_study_holds_what_was_asked_for():
    study = load_study(CONFIG)
    assert study.report.layout == "adaptive" and study.study.seed == 2 and study.n_draws == 16
    cells = {(tuning, start) for tuning, start, _ in zip(*_keys(study), strict=True)}
    assert len({tuning for tuning, _ in cells}) == 9
    judged = {start for _, start in cells if start[0] == 0.1}
    assert {(level, yaw) for _, level, yaw in judged} >= {(0, 0), (0.1, 1), (20, 120), (0, 120)}
    assert len(judged) == 15
    runs = study.n_draws * study.n_variants
    comment = CONFIG.read_text().split("[study]")[0]
    assert f"= {study.n_variants:,} variants x {study.n_draws} draws = {runs:,} runs" in comment
    triggers = study.zips["policy"]["reset_trigger"]
    assert set(triggers) == set(get_args(TriggerName))
    times = study.zips["policy"]["reset_times_s"]
    assert (50.0, 100.0, 150.0) in times and sum(len(t) == 1 for t in times) == 14
    new = [
        row
        for row in zip(*(study.zips["policy"].values()), strict=True)
        if row[1] == "linearisation"
    ]
    assert [row[2] for row in new] == [1.1, 1.2, 1.3, 1.5, 2]
    assert {row[4:] for row in new} == {(2, 150, 10)}


def _keys(study):
    tunings = zip(*map(study.values, ("q_reading", "feedback_interval_s")), strict=True)
    keys = ("gyro_bias_deg_per_h", "phi_e0_deg", "phi_u0_deg")
    return list(tunings), list(zip(*map(study.values, keys), strict=True)), study.reset_times()


def test_sensors_motion_and_filter_are_those_of_the_sweep_of_schedules():
    study, other = load_study(CONFIG), load_study(CONFIG.with_name("reset_cycle_study.toml"))
    assert study.earth == other.earth and study.motion == other.motion
    swept = {*study.axis_keys, *other.axis_keys}
    for section in ("sensors", "alignment", "filter"):
        mine, theirs = (getattr(s, section).model_dump() for s in (study, other))
        assert {k: v for k, v in mine.items() if k not in swept} == {
            k: v for k, v in theirs.items() if k not in swept
        }


# --- the cells ----------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_every_run_is_found_at_its_place(turned):
    study = adaptive_study(turned=turned)
    number = np.arange(study.n_draws * study.n_variants, dtype=float)
    settle = np.where(number % 7 == 3, NEVER, number).reshape(study.n_draws, -1)
    count = (number % 3).astype(int).reshape(study.n_draws, -1)
    cells = Cells.of(source_of(study, settle, count))
    assert cells.settle_s.shape == (4, 6, 8, DRAWS) and cells.draws == DRAWS
    for i, ((q, feedback), (bias, level, yaw), policy) in enumerate(points(study)):
        at = (
            cells.tunings.index(Tuning(q, feedback)),
            cells.starts.index(Start(bias, level, yaw)),
            place(policy),
        )
        np.testing.assert_array_equal(cells.settle_s[at], settle[:, i])
        np.testing.assert_array_equal(cells.count[at], count[:, i])
        trigger_counts = count[:, i] > 0
        np.testing.assert_array_equal(
            cells.first_s[at], np.where(trigger_counts, 2.0 * count[:, i], np.nan)
        )
        np.testing.assert_array_equal(
            cells.last_s[at], np.where(trigger_counts, 7.0 * count[:, i], np.nan)
        )
    assert [t.name for t in cells.tunings] == [
        "per_step, 1 s",
        "per_step, 10 s",
        "psd, 1 s",
        "psd, 10 s",
    ]
    assert (
        cells.feedbacks == (1, 10) and cells.tuned(10.0) == [1, 3] and cells.tuned() == [0, 1, 2, 3]
    )
    assert [cells.starts[i].bias for i in cells.judged] == [0.1] * 4 and cells.n_cells == 16
    assert [cells.starts[i] for i in cells.healthy(biased=False)] == [(0, 0, 0), (0, 0.1, 1)]
    assert [cells.starts[i][1:] for i in cells.healthy(biased=True)] == [(0, 0), (0.1, 1)]


def test_policies_are_told_by_their_keys():
    cells = Cells.of(source_of(adaptive_study(), 100.0))
    assert [p.name for p in cells.policies] == [
        "none",
        "1 at 10 s",
        "1 at 100 s",
        "3 from 50 s, 50 s apart",
        "nis 9",
        "linearisation 1.2",
        "linearisation 1.5",
        "fading 1.0001",
    ]
    assert cells.singles == [1, 2] and cells.triggered == [4, 5, 6, 7]
    assert [p.fades for p in cells.policies] == [False] * 7 + [True]
    assert (cells.policy(NONE), cells.policy(PAPER_SCHEDULE)) == (0, 3)
    full = Policy((), "tilt_drift", 2.0, 5.0, 3.0, 150.0, 4)
    assert full.settings == "window 5 s, refractory 3 s, until 150 s, at most 4"
    assert full._replace(trigger="nis").settings == "refractory 3 s, until 150 s, at most 4"
    assert full._replace(trigger="fading").settings == ""
    assert full._replace(until_s=None, most=None).settings == "window 5 s, refractory 3 s"
    assert Policy.of((5.0,), "none", 1.0, 2.0, 3.0, 4.0, 5) == Policy((5.0,))
    assert Policy.of((5.0,), None, None, None, None, None, None).settings == ""


def changed_policies(*rows):
    times, names, thresholds = map(list, zip(*rows, strict=True))
    keys = ("reset_times_s", "reset_trigger", "trigger_threshold")
    return {"policy": dict(zip(keys, (times, names, thresholds), strict=True))}


def changed_starts(bias, level, yaw, north=None):
    keys = ("gyro_bias_deg_per_h", "phi_e0_deg", "phi_n0_deg", "phi_u0_deg")
    return {"start": dict(zip(keys, (bias, level, north or level, yaw), strict=True))}


@pytest.mark.parametrize(
    ("changes", "needs"),
    [
        ({"axes": {"feedback_interval_s": [0.1, 10]}}, "the tuning Q `per_step`, feedback 1 s"),
        ({"axes": changed_starts([0.1, 0], [0, 0], [0, 0], [0, 0.1])}, "that are the same"),
        ({"axes": changed_starts([0.1, 0.1], [0, 0.1], [0, 1])}, "a healthy start without one"),
        ({"axes": changed_starts([0, 0.1], [0, 0], [0, 3])}, "a healthy start with a gyro bias"),
        ({"axes": changed_starts([[0.1, 0, 0], [0, 0, 0]], [0, 0], [0, 0])}, "a number"),
        ({"axes": changed_policies(*POLICIES[1:])}, "resets at none s"),
        ({"axes": changed_policies(*POLICIES[:3], *POLICIES[4:])}, "resets at 50, 100, 150 s"),
        ({"axes": changed_policies(POLICIES[0], *POLICIES[3:])}, "a single reset"),
        ({"axes": changed_policies(*POLICIES[:4], POLICIES[7])}, "a trigger that resets"),
        ({"axes": {"accel_bias_ug": [400, 500]}}, "every policy once"),
        ({"study": {"draws": 1}}, "two draws"),
    ],
)
def test_a_study_that_does_not_answer_is_refused(changes, needs):
    data = tomllib.loads(CONFIG.read_text())
    study = None
    if "accel_bias_ug" in changes.get("axes", {}):
        del data["sensors"]["accel_bias_ug"]
        data["study"]["draws"] = DRAWS
        data["axes"] |= changes["axes"]
        study = study_from_dict(data)
    study = study or adaptive_study(**changes)
    with pytest.raises(InputError, match=needs):
        Cells.of(source_of(study, 100.0))


def test_incomplete_results_are_refused():
    source = source_of(adaptive_study(), 100.0)
    part = Source(source.directory, source.study, source.config, source.table.slice(1))
    with pytest.raises(InputError, match="are the results complete"):
        Cells.of(part)


# --- the scores ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_the_oracle_is_told_by_the_half_that_did_not_choose_it(seed):
    source = random_source(seed)
    scores, runs = Scores(Cells.of(source)), runs_of(source)
    assert len(scores.at) == 16
    for t, s in scores.at:
        key = scores.cells.tunings[t], scores.cells.starts[s]
        np.testing.assert_array_equal(scores.oracle[t, s].settle_s, naive_oracle(runs, *key))


@pytest.mark.parametrize("seed", range(3))
def test_ratios_have_the_bootstraps_interval(seed):
    """Against one bootstrap a ratio, by the general function."""
    source = random_source(seed)
    scores, runs = Scores(Cells.of(source)), runs_of(source)
    cells = scores.cells

    def statistic(x, y):
        return ratio_of(*(np.sort(z, axis=-1)[..., (DRAWS - 1) // 2] for z in (x, y)))

    for at in scores.at[::3]:
        key = cells.tunings[at[0]], cells.starts[at[1]]
        oracle = naive_oracle(runs, *key)
        for policy, name in enumerate(NAMES):
            settle = runs[*key, name][0]
            found = scores.ratio(at, policy)
            assert found.value == ratio(lower_median(settle), lower_median(oracle))
            ends = bootstrap(statistic, np.array(settle), np.array(oracle))
            assert (found.low, found.high, found.n) == (*ends, DRAWS)


@given(st.sampled_from([0.0, 50.0, 100.0, NEVER]), st.sampled_from([0.0, 50.0, 100.0, NEVER]))
def test_ratios_know_what_never_settles(one, other):
    expected = 1.0 if one == other else NEVER if other == 0 else ratio(one, other)
    assert ratio_of(np.array(one), np.array(other)) == expected


@pytest.mark.parametrize("seed", range(4))
def test_cells_are_counted_and_the_best_found(seed):
    source = random_source(seed)
    scores, runs = Scores(Cells.of(source)), runs_of(source)
    cells = scores.cells
    judged = [(t, s) for t in cells.tunings for s in cells.starts if s.bias == 0.1]

    def ratios(name, draws=range(DRAWS)):
        found = []
        for key in judged:
            settle, oracle = runs[*key, name][0], naive_oracle(runs, *key)
            medians = (lower_median([values[d] for d in draws]) for values in (settle, oracle))
            found.append(ratio(*medians))
        return found

    def rank(name, draws=range(DRAWS)):
        here = ratios(name, draws)
        return sum(r > 1.1 for r in here), max(here)

    for number, name in enumerate(NAMES):
        here = ratios(name)
        within = scores.within(number)
        assert within.value == sum(r <= 1.1 for r in here) and within.n == 16
        assert within.low <= within.value <= within.high
        assert scores.at.index(scores.worst(number)) == here.index(max(here))
        slow = [r <= 1.1 for r, (tuning, _) in zip(here, judged, strict=True) if tuning[1] == 10]
        assert scores.within(number, 10.0)[0::3] == (sum(slow), 8)
        ends = [scores.ratio(at, number) for at in scores.at]
        assert within.low == min(within.value, sum(r.high <= 1.1 for r in ends))
        assert within.high == max(within.value, sum(r.low <= 1.1 for r in ends))
        settled = [s < NEVER for key in judged for s in runs[*key, name][0]]
        draws = np.tile(np.arange(DRAWS), 16)
        assert scores.settled(number) == analysis.share(settled, draws)
    names = NAMES[4:]
    best = min(names, key=rank)
    halves = tuple(
        place(min(names, key=lambda name, h=half: rank(name, range(h, DRAWS, 2))))
        for half in range(2)
    )
    assert scores.choice == (place(best), halves)
    assert scores.choice.is_held_out == (set(halves) == {place(best)})
    assert scores.by_trigger == {
        "nis": 4,
        "linearisation": place(min(("early", "late"), key=rank)),
        "fading": 7,
    }


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("biased", [None, False, True])
@pytest.mark.parametrize("feedback", [None, 10.0])
def test_alarms_are_those_of_the_definition(seed, biased, feedback):
    source = random_source(seed)
    scores, runs = Scores(Cells.of(source)), runs_of(source)
    for number, name in enumerate(NAMES):
        false, both, acts, draws = [], [], [], []
        for (tuning, start, policy), (settle, count) in runs.items():
            if policy != name or start[1] > 0.1 or start[2] > 1:
                continue
            if biased not in (None, start[0] > 0) or feedback not in (None, tuning[1]):
                continue
            without = runs[tuning, start, "none"][0]
            for draw, (one, other, resets) in enumerate(zip(settle, without, count, strict=True)):
                acted = resets > 0 or name in ("ten", "hundred", "paper", "fading")
                later = 0.0 if one == other else one - other
                share = later > 0 and (other == NEVER or later > 0.1 * other)
                draws.append(draw)
                acts.append(acted)
                false.append(acted and (share or later > 5))
                both.append(acted and share and later > 5)
        # Runs of a draw share their noise: draws are counted.
        expected = Alarms(*(analysis.share(which, draws) for which in (false, both, acts)))
        assert scores.alarms(number, biased=biased, feedback_s=feedback) == expected


def test_a_delay_by_the_limits_themselves_is_no_alarm():
    """10 % and 5 s are passed one at a time."""
    study = adaptive_study()
    found = {}
    for none, later in [(100, 5), (100, 5.5), (100, 10.5), (40, 4), (40, 4.5), (40, 5.5)]:
        settle = [none + later * (policy == "early") for *_, policy in points(study)]
        count = [int(policy == "early") for *_, policy in points(study)]
        scores = Scores(Cells.of(source_of(study, settle, count)))
        alarms = scores.alarms(place("early"))
        found[none, later] = alarms.false.value, alarms.both.value
    assert found == {
        (100, 5): (0, 0),
        (100, 5.5): (1, 0),
        (100, 10.5): (1, 1),
        (40, 4): (0, 0),
        (40, 4.5): (1, 0),
        (40, 5.5): (1, 1),
    }


def test_cells_in_need_are_those_that_no_reset_leaves_behind():
    study = adaptive_study()
    scores = Scores(Cells.of(source_of(study, medians_of(study), counts_of(study))))
    need = scores.in_need()
    assert [scores.cells.starts[s].level for _, s in need] == [5, 20] * 4
    draws = np.tile(np.arange(DRAWS), 64 // DRAWS)
    assert scores.acts_in_need(place("early")) == analysis.share([True] * 64, draws)
    assert scores.acts_in_need(place("none")) == analysis.share([False] * 64, draws)
    assert scores.acts_in_need(place("fading")).value == 1
    none = Scores(Cells.of(source_of(study, 100.0)))
    assert none.in_need() == [] and none.acts_in_need(5) == analysis.UNKNOWN


# --- the page -----------------------------------------------------------------------------------

MANIFEST = {"runs": 1536, "wall_s": 60.0, "devices": 2, "versions": {"sinsjax": "1"}}


def report_of(directory, settle=None, count=None):
    (directory / "manifest.json").write_text(json.dumps(MANIFEST))
    study = adaptive_study()
    settle = medians_of(study) if settle is None else settle(study)
    count = counts_of(study) if count is None else count(study)
    source = source_of(study, settle, count, directory)
    return adaptive.report(source), Scores(Cells.of(source))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return report_of(tmp_path_factory.mktemp("results"))


def rows_of(table):
    return [dict(zip(table.header, row, strict=True)) for row in table.rows]


def test_the_headline_tells_the_winner_and_the_goal(made):
    report, _ = made
    scope, winner, goal, others, cost = report.headline
    assert scope == (
        "1,536 runs of 900 s: 8 policies x 6 starts x 4 tunings of the filter x 8 draws."
    )
    assert "The best of 4 triggers and thresholds is `linearisation` at 1.2" in winner
    assert "chosen by each half of the draws and told by the other" in winner
    assert (
        "in 16 [16, 16] of 16 cells; at worst, per_step, 1 s, (5, 5, 30) deg, it is 1.0" in winner
    )
    none = "0 of 64, 0.0 [0.0, 41.1] %"  # 8 draws: t^2 / (8 + t^2)
    assert f"healthy runs: {none} without gyro bias, {none} with it." in winner
    assert (
        "under 1 % false alarms: reached (16 [16, 16] of 16 cells, false alarms 0 of 128, 0.0"
        in goal
    )
    assert goal.count(": reached (8 [8, 8] of 8 cells, false alarms 0 of 64") == 2
    assert "feedback 1 s: reached" in goal and "feedback 10 s: reached" in goal
    # Healthy cells are within without reset and with nis; the paper's three are at (20, 20, 120).
    assert "Without reset it is 8 [8, 8] of 16 cells, with the paper's three 4 [4, 4]" in others
    # nis never settles at (20, 20, 120); fading is late everywhere, but not as late.
    assert "fading 1.0001, comes to 8 [8, 8] of 16 with 128 of 128, 100.0 [58.9" in others
    # Sooner: healthy ones, 100 s against the 120 s of the best single reset, and (20, 20, 120).
    assert "in 12 cells, interval included, of which in 0 no single reset" in others
    assert cost.startswith("What did it cost? 1.0 min on 2 devices")


def slower_at_10_s(study):
    """The best trigger delays healthy runs by 6 s, and large ones by half, at slow feedback."""
    settle = medians_of(study)
    for i, ((_, feedback), start, policy) in enumerate(points(study)):
        if feedback == 10 and policy == "early":
            settle[:, i] = settle[:, i] + 6 if start[1] < 1 else 1.5 * settle[:, i]
    return settle


def test_a_goal_that_is_missed_is_told_by_feedback(tmp_path):
    def counts(study):
        return [COUNTS.get(policy, 0) for *_, policy in points(study)]

    report, scores = report_of(tmp_path, slower_at_10_s, counts)
    assert scores.choice.place == place("early")
    goal = report.headline[2]
    assert (
        "false alarms: not reached (14 [14, 14] of 16 cells, false alarms 64 of 128, 50.0" in goal
    )
    assert "feedback 1 s: reached (8 [8, 8] of 8 cells, false alarms 0 of 64" in goal
    assert "feedback 10 s: not reached (6 [6, 6] of 8 cells, false alarms 64 of 64, 100.0" in goal
    rows = rows_of(report.sections[0].blocks[1])
    assert [row["feedback (s)"] for row in rows] == ["1", "10", "all"]
    assert [row["goal reached"] for row in rows] == ["yes", "no", "no"]
    slow = rows[1]
    assert slow["false alarms, no gyro bias"] == "32 of 32, 100.0 [58.9, 100.0] %"
    assert slow["later by both limits"].startswith("0 of 64, 0.0 [0.0, 41.1]")
    before, after = (slow[f"healthy, {kind}: median (s)"] for kind in ("none", "trigger"))
    assert float(after.split()[0]) == pytest.approx(float(before.split()[0]) + 6)
    beyond = rows_of(report.sections[0].blocks[2])
    assert [row["start (deg)"] for row in beyond] == ["(5, 5, 30)"] * 2
    assert {row["feedback (s)"] for row in beyond} == {"10"}
    found = [float(row["ratio"].split()[0]) for row in beyond]
    assert found == pytest.approx([1.5 * 205 / 200] * 2, abs=0.01)
    later = [float(row["later by (s)"].split()[0]) for row in beyond]
    assert later == pytest.approx([1.5 * 205 - 200] * 2, abs=2)


def test_a_choice_that_the_halves_do_not_share_is_told(tmp_path):
    """Threshold 1.2 is better on even draws, 1.5 on odd ones, and a little better by all."""

    def settle(study):
        times = medians_of(study)
        for i, (_, start, policy) in enumerate(points(study)):
            if start[1] == 5 and policy in ("early", "late"):
                times[:, i] = 210.0
                worse = slice(1, None, 2) if policy == "early" else slice(0, None, 2)
                times[worse, i] = 400.0 if policy == "early" else 300.0
        return times

    report, scores = report_of(tmp_path, settle)
    assert scores.choice.halves == (place("early"), place("late"))
    assert not scores.choice.is_held_out
    told = "chosen on the draws that tell it; its halves alone chose linearisation 1.2 and"
    assert told in report.headline[1]


def test_a_best_trigger_that_fails_somewhere_is_told(tmp_path):
    def settle(study):
        times = medians_of(study)
        lost = [
            start[1] == 5 and policy in NAMES[4:] and tuning == ("psd", 10)
            for tuning, start, policy in points(study)
        ]
        times[:, lost] = NEVER
        return times

    report, _ = report_of(tmp_path, settle)
    assert "at worst, psd, 10 s, (5, 5, 30) deg, it never settles." in report.headline[1]


def test_every_policy_has_its_row(made):
    report, scores = made
    table = report.sections[0].blocks[5]
    rows = {row["policy"]: row for row in rows_of(table)}
    names = [p.name for i, p in enumerate(scores.cells.policies) if i not in (1, 2)]
    assert list(rows) == ["oracle", *names]
    assert rows["oracle"]["settled (%)"] == "100 [59, 100]"
    none = rows["none"]
    assert none["settled (%)"] == "75 [65, 83]" and none["resets, median"] == "0"
    assert none["worst ratio"] == "never [never, never]"
    assert none["in"] == "per_step, 1 s, (20, 20, 120) deg"
    three = rows["3 from 50 s, 50 s apart"]
    assert three["resets, median"] == "3" and three["acts in need (%)"] == "100 [59, 100]"
    assert three["false alarms, gyro bias"] == "64 of 64, 100.0 [58.9, 100.0] %"
    assert float(three["worst ratio"].split()[0]) == pytest.approx(250 / 120, abs=0.05)
    best = rows["linearisation 1.2"]
    assert best["its numbers"] == "refractory 5 s, at most 10"
    assert best["resets, median"] == "1"  # 2 in half of the cells
    assert best["acts in healthy runs (%)"] == "0 [0, 41]"
    fading = rows["fading 1.0001"]
    assert fading["resets, median"] == "-" and fading["acts in healthy runs (%)"] == "100 [59, 100]"
    assert fading["later by both limits, all"] == "128 of 128, 100.0 [58.9, 100.0] %"


def test_every_cell_has_its_row(made):
    report, scores = made
    table = report.sections[0].blocks[6]
    assert table.folded and len(table.rows) == 16
    runs = {at: scores.cells.settle_s[at] for at in scores.at}
    for row, at in zip(rows_of(table), scores.at, strict=True):
        start = scores.cells.starts[at[1]]
        assert row["start (deg)"] == f"({start.level:g}, {start.level:g}, {start.yaw:g})"
        assert row["oracle: reset at (s)"] == ("100" if start.level == 20 else "10")
        pick = held_out(runs[at], [1, 2])
        for column, settle in [
            ("oracle: median (s)", pick.settle_s),
            ("none: median (s)", runs[at][0]),
            ("paper's three: median (s)", runs[at][3]),
            ("linearisation 1.2: median (s)", runs[at][5]),
        ]:
            estimate = analysis.quantile(settle)
            assert row[column] == analysis.format_estimate(estimate, digits=0)
        fires = start.level > 1
        assert row["resets (least to most)"] == ("2 (2 to 2)" if fires else "0 (0 to 0)")
        assert (row["first (s)"], row["last (s)"]) == (("4.0", "14.0") if fires else ("-", "-"))


def test_the_triggers_are_told_by_their_docstrings(made):
    report, scores = made
    text, table = report.sections[1].blocks
    rows = {row["trigger"]: row for row in rows_of(table)}
    assert list(rows) == ["nis", "linearisation", "fading"]
    assert rows["nis"]["score"].startswith("Normalised innovation squared of a sample")
    assert rows["fading"]["score"].startswith("Fading memory: P is multiplied")
    assert rows["linearisation"]["best threshold"] == "1.2"
    assert rows["nis"]["acts in need (%)"] == "100 [59, 100]"
    assert "`nis` at 9 in 100 [59, 100] %" in text.text and "innovation`" not in text.text
    assert {*adaptive_triggers._SEES} == {*TRIGGERS}
    assert scores.choice.place == place("early")


def test_figures_show_the_ratios_and_the_times(made):
    report, scores = made
    pictures = {b.name: b for b in report.sections[0].blocks if isinstance(b, Picture)}
    axes = pictures["ratios"].figure.axes
    titles = [a.get_title(loc="left") for a in axes if a.get_visible()]
    names = ["nis 9: 8 of 16", "linearisation 1.2: 16 of 16", "fading 1.0001: 8 of 16"]
    assert titles[:3] == names
    shown = axes[1].images[0].get_array()
    expected = scores.ratios[:, place("early")].reshape(4, 4).T
    np.testing.assert_array_equal(shown, np.digitize(expected, [0.9, 1.1, 1.5, 3], right=True))
    assert axes[0].images[0].get_array().mask[3].all()  # nis never settles at (20, 20, 120)
    assert [t.get_text() for t in axes[0].get_yticklabels()][-1] == "(20, 20, 120)"
    texts = [t.get_text() for t in axes[1].texts]
    assert texts == [f"{r:.2f}" for r in expected.ravel()]
    panels = pictures["settling"].figure.axes
    assert [a.get_title(loc="left") for a in panels] == [
        "Q per_step, feedback 1 s",
        "Q psd, feedback 1 s",
    ]
    lines = [c.lines[0].get_ydata() for c in panels[0].containers]
    want = [[scores.cells.settle_s[0, s, p] for s in scores.cells.judged] for p in (0, 3, 5)]
    medians = np.array([[lower_median(list(runs)) for runs in line] for line in want])
    medians[np.isinf(medians)] = np.nan
    np.testing.assert_array_equal([lines[0], lines[1], lines[3]], medians)
    bars = [bar.tolist() for c in panels[0].collections for bar in c.get_segments() if len(bar)]
    assert [[2, 4], [2, 14]] in bars and [[3, 4], [3, 14]] in bars


def test_the_time_of_resets_is_told_where_half_of_the_runs_have_one():
    few = np.array([5.0, math.nan, math.nan])
    assert math.isnan(adaptive_figures.middle(few))
    assert adaptive_figures.middle(np.array([5.0, 9.0, math.nan, math.nan])) == 5.0
    assert math.isnan(adaptive_figures.middle(np.full(3, math.nan)))
    assert adaptive_figures.middle(np.array([7.0, 5.0, 9.0])) == statistics.median([5, 7, 9])


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (analysis.Estimate(1.05, 1.0, 1.2, 8), "1.05 [1.00, 1.20]"),
        (analysis.Estimate(0.0, 0.0, 0.0, 8), "only it settles"),
        (analysis.Estimate(NEVER, 1.2, NEVER, 8), "never [1.20, never]"),
    ],
)
def test_ratios_in_words(ratio, text):
    assert adaptive_tables.ratio_text(ratio) == text


def test_the_page_is_written_by_the_command(tmp_path):
    study = adaptive_study()
    out = store(tmp_path / "out", study, table_of(study, medians_of(study), counts_of(study)))
    (out / "manifest.json").write_text(json.dumps(MANIFEST))
    printed = told(out, page=tmp_path / "adaptive.md")
    assert "The best of 4 triggers" in printed
    page = (tmp_path / "adaptive.md").read_text()
    assert "# Resets that set themselves" in page
    assert [line for line in page.split("\n") if line.startswith("## ")] == [
        "## Does one trigger do what the best single reset does?",
        "## How do the triggers work, and what do they see?",
        "## What did it cost?",
        "## What the words mean",
    ]
    for name in ("ratios", "settling"):
        assert (tmp_path / "figures" / f"adaptive_resets_{name}.png").exists()
    assert "nan" not in page and "unknown" not in page
