import itertools
import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.errors import InputError
from sinsjax.report import (
    reset_best,
    reset_choice,
    reset_claim,
    reset_cycle,
    reset_failure,
    reset_timing,
)
from sinsjax.report.base import Picture, Source, Table, percent
from sinsjax.report.reset_grid import (
    NONE,
    PAPER_SCHEDULE,
    Grid,
    Reading,
    against,
    percent_mean,
    schedule_name,
)
from sinsjax.study.load import load_study, study_from_dict

CONFIG = Path(__file__).parents[2] / "configs" / "reset_cycle_study.toml"
DRAWS = 8
SCHEDULES = [(0, 50, 50), (1, 10, 50), (1, 100, 50), (2, 10, 100), (3, 50, 50), (2, 25, 50)]
NEVER = math.inf

pytestmark = pytest.mark.usefixtures("drawn_on_request")


def reset_study(*, turned=False, **changes):
    """The study on a small grid, its axes turned round; ``changes`` replace keys of sections."""
    data = tomllib.loads(CONFIG.read_text())
    data["study"]["draws"] = DRAWS
    keys = ("reset_count", "reset_first_s", "reset_cycle_s")
    data["axes"] |= {
        "q_reading": ["per_step", "psd"],
        "feedback_interval_s": [1, 10],
        "phi_u0_deg": [5, 120, 30],
        "level": {"phi_e0_deg": [5, 0], "phi_n0_deg": [5, 0]},
        "schedule": dict(zip(keys, map(list, zip(*SCHEDULES, strict=True)), strict=True)),
    }
    for section, change in changes.items():
        data[section] |= change
    if turned:
        data["axes"] = dict(reversed(data["axes"].items()))
    return study_from_dict(data)


def source_of(study, settle=100.0, yaw=-26.0, directory="results"):
    """Results that no engine made; settling times and yaws are given by run or broadcast."""
    shape = (study.n_draws, study.n_variants)
    settle, yaw = (np.broadcast_to(values, shape).ravel() for values in (settle, yaw))
    columns = {
        "settle_10_s": pa.array(np.where(np.isinf(settle), np.nan, settle), from_pandas=True),
        "phi_u_mean_arcmin": pa.array(yaw, from_pandas=True),
    }
    return Source(Path(directory), study, "study.toml", pa.table(columns))


def by_variant(study, of):
    """A value for each variant, from its reading, level, yaw and reset times."""
    keys = ("specific_force", "q_reading", "feedback_interval_s", "phi_e0_deg", "phi_u0_deg")
    points = zip(*map(study.values, keys), study.reset_times(), strict=True)
    return np.array([of(Reading(*p[:3]), *p[3:]) for p in points])


def grid_of(of, *, noise=0.0, yaw=-26.0, **changes):
    """A grid whose settling times are ``of`` a variant, plus noise by draw."""
    study = reset_study(**changes)
    wobble = noise * np.random.default_rng(1).standard_normal((study.n_draws, 1))
    return Grid.of(source_of(study, by_variant(study, of) + wobble, yaw))


def tables(answer):
    return {block.title: block for block in answer.blocks if isinstance(block, Table)}


def row_of(table, *first):
    (row,) = (row for row in table.rows if tuple(row[: len(first)]) == first)
    return dict(zip(table.header, row, strict=True))


# --- the study ----------------------------------------------------------------------------------


def test_the_study_holds_what_was_asked_for():
    study = load_study(CONFIG)
    runs = study.n_draws * study.n_variants
    assert 100_000 <= runs <= 200_000 and study.run_s == 900
    assert study.n_draws >= 16 and study.n_draws % 8 == 0
    times = study.reset_times()
    assert len(set(times)) * 5 * 4 * 3 * 3 * 2 == study.n_variants == 11_520
    assert {len(t) for t in times} == {0, 1, 2, 3, 5}
    assert PAPER_SCHEDULE in times and study.report.layout == "reset_cycle"
    comment = CONFIG.read_text().split("[study]")[0]
    assert f"{study.n_variants:,} variants x {study.n_draws} draws = {runs:,} runs" in comment


def test_sensors_motion_and_filter_are_those_of_the_default_sweep():
    study, default = load_study(CONFIG), load_study(CONFIG.with_name("reset_sweep.toml"))
    for section in ("earth", "motion", "sensors"):
        assert getattr(study, section) == getattr(default, section)
    for section in ("alignment", "filter"):
        mine, other = (getattr(s, section).model_dump() for s in (study, default))
        assert {k: v for k, v in mine.items() if k not in study.axis_keys} == {
            k: v for k, v in other.items() if k not in study.axis_keys
        }


# --- the grid -----------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_every_run_is_found_at_its_place(turned):
    study = reset_study(turned=turned)
    runs = np.arange(study.n_draws * study.n_variants, dtype=float)
    settle = np.where(runs % 7 == 3, NEVER, runs).reshape(study.n_draws, -1)
    grid = Grid.of(source_of(study, settle, yaw=-settle))
    variants = iter(range(study.n_variants))

    def check(reading, level, yaw, times):
        i = next(variants)
        place = (
            grid.readings.index(reading),
            grid.levels.index(level),
            grid.yaws.index(yaw),
            grid.schedule(times),
        )
        np.testing.assert_array_equal(grid.settle_s[place], settle[:, i])
        known = np.isfinite(settle[:, i])
        np.testing.assert_array_equal(grid.yaw_mean[place][known], -settle[known, i])
        return 0

    assert by_variant(study, check).size == study.n_variants
    assert grid.settle_s.shape == (8, 2, 3, 6, DRAWS) and grid.draws == DRAWS
    assert [grid.readings[i][1:] for i in grid.measured] == [
        ("per_step", 1.0),
        ("per_step", 10.0),
        ("psd", 1.0),
        ("psd", 10.0),
    ]
    assert grid.levels == (0.0, 5.0) and grid.yaws == (5.0, 30.0, 120.0)
    assert sorted([*grid.measured, *grid.gravity]) == list(range(8))
    assert grid.readings[grid.paper_reading] == ("measured", "per_step", 1.0)
    level, yaw = grid.paper_point
    assert (grid.levels[level], grid.yaws[yaw]) == (5.0, 30.0)


def test_schedules_are_found_by_their_count():
    grid = grid_of(lambda *point: 100.0)
    assert [grid.schedules[i] for i in grid.with_count(1, 1)] == [(10.0,), (100.0,)]
    assert [len(grid.schedules[i]) for i in grid.with_count(2)] == [2, 2, 3]
    assert [schedule_name(times) for times in grid.schedules] == [
        "none",
        "1 at 10 s",
        "1 at 100 s",
        "2 from 10 s, 100 s apart",
        "2 from 25 s, 50 s apart",
        "3 from 50 s, 50 s apart",
    ]


@pytest.mark.parametrize(
    ("changes", "needs"),
    [
        ({"axes": {"specific_force": ["measured"]}}, "both specific forces"),
        ({"axes": {"feedback_interval_s": [0.1, 10]}}, "the reading Q `per_step`, feedback 1 s"),
        ({"axes": {"level": {"phi_e0_deg": [0, 5], "phi_n0_deg": [0, 4]}}}, "that are the same"),
        ({"axes": {"level": {"phi_e0_deg": [0, 4], "phi_n0_deg": [0, 4]}}}, "level error of 5"),
        ({"axes": {"phi_u0_deg": [30]}}, "two levels and two yaws"),
        ({"axes": {"r_velocity_m_per_s": [0.1, 0.2]}, "filter": {}}, "every schedule once"),
        ({"axes": {"schedule": {"reset_count": [0, 1], "reset_cycle_s": [50, 50]}}}, "50, 100"),
        ({"study": {"draws": 1}}, "two draws"),
    ],
)
def test_a_study_that_does_not_answer_is_refused(changes, needs):
    data = tomllib.loads(CONFIG.read_text())
    if "r_velocity_m_per_s" in changes.get("axes", {}):
        del data["filter"]["r_velocity_m_per_s"]
    data["study"]["draws"] = DRAWS
    for section, change in changes.items():
        data[section] |= change
    study = study_from_dict(data)
    with pytest.raises(InputError, match=needs):
        Grid.of(source_of(study))


def test_incomplete_results_are_refused():
    source = source_of(reset_study())
    part = Source(source.directory, source.study, source.config, source.table.slice(1))
    with pytest.raises(InputError, match="are the results complete"):
        Grid.of(part)


# --- the best of several ------------------------------------------------------------------------


def naive_held_out(settle, places):
    """Draw by draw, the schedule that is best on the draws of the other half."""
    chosen = []
    for draw in range(settle.shape[1]):
        seen = [d for d in range(settle.shape[1]) if d % 2 != draw % 2]
        scores = []
        for place in places:
            times = sorted(settle[place, d] for d in seen)
            scores.append((times.count(NEVER), times[(len(times) - 1) // 2], places.index(place)))
        chosen.append(places[min(range(len(places)), key=lambda i: scores[i])])
    return chosen


@given(
    arrays.arrays(
        float,
        st.tuples(st.integers(2, 5), st.integers(2, 9)),
        elements=st.sampled_from([10.0, 20.0, 30.0, NEVER]),
    )
)
def test_each_half_tells_what_the_other_chose(settle):
    places = list(range(settle.shape[0]))[::2]
    pick = reset_best.held_out(settle, places)
    expected = naive_held_out(settle, places)
    np.testing.assert_array_equal(pick.places, expected)
    np.testing.assert_array_equal(pick.settle_s, settle[expected, np.arange(settle.shape[1])])


def test_a_choice_among_equals_gains_nothing():
    settle = 100 + 20 * np.random.default_rng(0).standard_normal((100, 40, 8))
    places = list(range(40))
    told = np.mean([reset_best.held_out(one, places).settle_s.mean() for one in settle])
    flattered = np.mean([np.sort(one.mean(axis=1))[0] for one in settle])
    assert told == pytest.approx(100, abs=2) and flattered < 90


def test_one_schedule_for_all_has_the_least_mean_with_failures_at_the_end_of_the_run():
    settle = np.full((2, 2, 3, 4), 300.0)
    settle[0, 0, 1] = 50.0  # fast at one misalignment
    settle[1, 1, 1] = NEVER  # but fails at another: mean 387.5
    settle[..., 2, :] = 320.0
    pick = reset_best.held_out_for_all(settle, [0, 1, 2], 900.0)
    np.testing.assert_array_equal(pick.places, 0)
    np.testing.assert_allclose(pick.settle_s, 300.0)
    np.testing.assert_allclose(
        reset_best.held_out_for_all(settle, [1], 900.0).settle_s, (50 + 300 + 300 + 900) / 4
    )


def times_of(reading, level, yaw, times):
    """More is better at yaw 120, one at yaw 30; at yaw 5 both are alike."""
    if not times:
        return NEVER if level or yaw > 100 else 100.0
    if yaw == 120:
        return 250.0 if len(times) > 1 else (NEVER if level else 400.0)
    return 200.0 + (50.0 if yaw == 30 and len(times) > 1 else 0.0)


def test_contests_are_decided_by_their_intervals():
    grid = grid_of(times_of, noise=3.0)
    found = {c.at: c for c in reset_best.contests(grid, grid.measured)}
    assert len(found) == 4 * 6
    for (_, level, yaw), contest in found.items():
        assert contest.better == ("", "one", "more")[yaw]
        assert contest.only_more == (yaw == 2 and level == 1)
        expected = (0.0, 50.0, -NEVER if level else -150.0)[yaw]
        assert contest.saved_s.value == pytest.approx(expected)


def test_where_neither_settles_none_is_better():
    grid = grid_of(lambda *point: NEVER)
    contest = reset_best.contests(grid, [0])[0]
    assert contest.better == "neither" and not contest.only_more


def test_question_1_counts_and_names():
    answer = reset_choice.answer(grid_of(times_of, noise=3.0))
    assert "at 8 of 24 points" in answer.headline and "of which at 4 " in answer.headline
    assert "sooner at 8," in answer.headline and "1.0 each way" in answer.headline
    assert "it settles 50 [50, 50] s later than the best single reset." in answer.headline
    counts = tables(answer)["At how many of 6 misalignments, by reading"]
    assert len(counts.rows) == 8
    row = row_of(counts, "gravity", "psd", "10")
    assert [row[f"{kind} is better"] for kind in ("more", "one")] == ["2", "2"]
    assert row["no difference shown"] == "2" and row["only more settles"] == "1"
    assert row["more minus one, least (s)"] == "-150 [-150, -150]"
    assert row["at"] == "(0, 0, 120) deg"
    points = tables(answer)["Every misalignment and reading"]
    assert points.folded and len(points.rows) == 24
    row = row_of(points, "psd", "10", "5", "120")
    assert row["none: median (s)"].startswith("never") and row["better"] == "more"
    assert row["one: settled (%)"] == "0 [0, 32]" and row["more: settled (%)"] == "100 [68, 100]"
    assert row["more minus one (s)"] == "one never settles"
    for_all = tables(answer)["One schedule for all misalignments"]
    row = row_of(for_all, "per_step", "1")
    # The same 5 of 6 misalignments in all 8 draws: no better known than by 48 runs.
    assert row["one: settled (%)"] == "83 [67, 92]"
    assert row["more: schedule"] == "2 from 10 s, 100 s apart"
    # means over (0, 5) deg x (5, 30, 120) deg: 200, 200, 400, 200, 200, 900; 200, 250, 250 twice
    assert row["more minus one (s)"].startswith(f"{1400 / 6 - 2100 / 6:.0f} [")


@pytest.mark.parametrize(
    ("estimate", "words"),
    [
        (Estimate(12, 3, 20, 8), "settles 12 [3, 20] s later than it"),
        (Estimate(-12, -20, 3, 8), "settles 12 [-3, 20] s sooner than it"),
        (Estimate(-NEVER, -NEVER, -NEVER, 8), "settles where it does not"),
        (Estimate(NEVER, NEVER, NEVER, 8), "does not settle"),
    ],
)
def test_differences_in_words(estimate, words):
    assert against(estimate, "it") == words


# --- when ---------------------------------------------------------------------------------------


def late_times(reading, level, yaw, times):
    """A single reset at 10 s is soonest but for large yaw, where only that at 100 s settles."""
    if len(times) != 1:
        return NEVER if not times else 300.0
    return times[0] + 100.0 if yaw < 100 or times[0] > 50 else NEVER


def test_question_2_tells_from_when_to_when():
    grid = grid_of(late_times, noise=1.0)
    found = {one.at: one for one in reset_timing.singles(grid)}
    near, far = found[grid.paper_reading, 1, 1], found[grid.paper_reading, 1, 2]
    assert near.works == (10.0, 100.0) and near.fastest == 10.0
    assert far.works == (100.0,) and far.fastest == 100.0
    assert near.fastest_s.value == pytest.approx(110, abs=3)
    assert near.latest_s.value == pytest.approx(200, abs=3) and near.none.value == 0
    answer = reset_timing.answer(grid)
    assert "settles if it comes at 10, 100 s; soonest with one at 10 s, 1" in answer.headline
    assert "(10 s is the earliest time tried: one still earlier may be better)" in answer.headline
    assert "enough at 24: at 10 s it is at 16, at 100 s at 24." in answer.headline
    by = tables(answer)["At how many points each time of a single reset is the soonest to settle"]
    assert by.header == ["", "10 s", "100 s", "none settles"]
    assert {row[0]: row[1:] for row in by.rows} == {
        "level 0 deg": ["8", "4", "0"],
        "level 5 deg": ["8", "4", "0"],
        "yaw 5 deg": ["8", "0", "0"],
        "yaw 30 deg": ["8", "0", "0"],
        "yaw 120 deg": ["0", "8", "0"],
    }
    ranked = tables(answer)["The schedules of more than one reset that are most often the best"]
    assert ranked.rows == [["2 from 10 s, 100 s apart", "24"]]
    others = tables(answer)["A single reset, all other readings"]
    assert others.folded and len(others.rows) == 18
    assert row_of(others, "psd", "10", "5", "120")["settles with one at (s)"] == "100"


def test_a_reset_that_never_works_is_told():
    answer = reset_timing.answer(grid_of(lambda *point: NEVER))
    assert "does not settle, whenever it comes" in answer.headline
    assert "enough at 0: at 10 s it is at 0" in answer.headline
    by = tables(answer)["At how many points each time of a single reset is the soonest to settle"]
    assert by.rows[0] == ["level 0 deg", "0", "0", "12"]


# --- what governs failure -----------------------------------------------------------------------


@given(arrays.arrays(bool, st.tuples(st.integers(2, 4), st.integers(2, 4), st.integers(1, 3))))
def test_variance_is_split_as_by_least_squares(failed):
    parts = reset_failure.governed(failed)
    levels, yaws, draws = failed.shape
    cells = list(itertools.product(range(levels), range(yaws)))
    design = {
        "level": np.array([[level == i for i in range(levels)] for level, _ in cells], float),
        "yaw": np.array([[yaw == i for i in range(yaws)] for _, yaw in cells], float),
    }
    for draw in range(draws):
        y = failed[..., draw].ravel().astype(float)
        whole = np.sum((y - y.mean()) ** 2)
        if whole == 0:
            assert all(np.isnan(part[draw]) for part in parts)
            continue
        explained = []
        for dummies in design.values():
            fit = dummies @ np.linalg.lstsq(dummies, y, rcond=None)[0]
            explained.append(1 - np.sum((y - fit) ** 2) / whole)
        expected = [*explained, 1 - sum(explained)]
        np.testing.assert_allclose([part[draw] for part in parts], expected, atol=1e-12)
        assert all(part[draw] >= 0 for part in parts)


def failing(reading, level, yaw, times):
    """Measured: by level at 1 s, by yaw at 10 s; gravity cures it. With psd: by either alone."""
    if reading.q == "psd":
        return NEVER if (level > 0) != (yaw > 5) else 100.0
    if reading.force == "gravity":
        return 100.0
    return NEVER if (level > 0 if reading.feedback_s == 1 else yaw > 5) else 100.0


def test_question_3_tells_level_from_yaw():
    answer = reset_failure.answer(grid_of(failing))
    assert "50 [34, 66] % against 0 [0, 41] %" in answer.headline
    assert "at level 0 deg 0 [0, 41] %, at yaw 5 deg 50 [25, 75] %" in answer.headline
    assert "level explains 100 [100, 100] %, yaw 0 [0, 0] %" in answer.headline
    # measured: 1/2, 2/3 and 1/2 twice of the grid; gravity: 0, 0 and 1/2 twice
    assert "54 [46, 62] % of the runs" in answer.headline
    assert "gravity in A(t) 25 [18, 33] %, a difference of -29 [-29, -29] %" in answer.headline
    parts = tables(answer)["What the variance of failure without reset comes from"]
    assert row_of(parts, "measured", "per_step", "10")["yaw (%)"] == "100 [100, 100]"
    assert row_of(parts, "gravity", "per_step", "10")["level (%)"] == "-"
    assert row_of(parts, "gravity", "psd", "1")["both together (%)"] == "89 [89, 89]"
    shares = tables(answer)["Runs that never settle without reset, of 2 levels x 3 yaws x 8 draws"]
    row = row_of(shares, "gravity", "per_step", "1")
    assert (
        row["all (%)"].startswith("0 [0, ") and row["all, minus measured (%)"] == "-50 [-50, -50]"
    )
    row = row_of(shares, "measured", "per_step", "10")
    assert row["level 0 deg, all yaws (%)"].startswith("67 [")
    assert row["yaw 5 deg, all levels (%)"].startswith("0 [0, ")
    assert row["all, minus measured (%)"] == "-"


def test_intervals_come_from_the_draws_and_stay_shares():
    study = reset_study()
    settle = np.full((DRAWS, study.n_variants), 100.0)
    settle[0] = NEVER
    answer = reset_failure.answer(Grid.of(source_of(study, settle)))
    failed = np.isinf(settle).ravel()
    expected = analysis.share(failed, np.repeat(np.arange(DRAWS), study.n_variants))
    as_if = analysis.proportion(int(failed.sum()), failed.size)
    assert expected.high - expected.low > 5 * (as_if.high - as_if.low)
    assert f"{percent(expected)} % of the runs" in answer.headline
    beyond = analysis.mean([1.0] + [0.0] * 7)
    assert beyond.low < 0
    assert percent_mean(beyond) == f"12 [0, {100 * beyond.high:.0f}]"


# --- the paper's claim --------------------------------------------------------------------------


def claim_at(settle_of, yaw=-26.0, wobble=0.1):
    """What the claim comes to at the paper's point, settling times by number of resets."""
    study = reset_study()
    settle = by_variant(
        study, lambda reading, level, yaw, times: settle_of.get(len(times), 300.0) if level else 90
    )
    large = by_variant(study, lambda reading, level, phi, times: float(bool(level and times)))
    noise = wobble * np.random.default_rng(2).standard_normal((DRAWS, 1))
    yaws = -26.0 + large * (yaw + 26.0 + noise)
    grid = Grid.of(source_of(study, settle, yaws))
    return reset_claim._claim(grid, (grid.paper_reading, *grid.paper_point))


def test_the_claim_has_five_outcomes():
    assert claim_at({0: 600.0}).kind == reset_claim.NOT_NEEDED
    assert claim_at({0: NEVER, 1: 200.0}).kind == reset_claim.ONE_TOO
    assert claim_at({0: NEVER, 1: NEVER}).kind == reset_claim.SEVERAL
    assert claim_at({0: NEVER, 1: 200.0}, yaw=-24.0).kind == reset_claim.COARSE
    assert claim_at({0: NEVER, 1: 200.0}, wobble=3.0).kind == reset_claim.COARSE
    assert claim_at({0: NEVER, 1: 200.0}, yaw=math.nan).kind == reset_claim.COARSE
    assert claim_at({0: NEVER, 1: 200.0, 3: NEVER}).kind == reset_claim.NOT_CURED


def test_the_claim_is_held_against_the_smallest_misalignment():
    claim = claim_at({0: NEVER, 1: 200.0, 3: 320.0}, yaw=-25.5)
    assert claim.later_s[:3] == (230.0, 230.0, 230.0)
    assert claim.apart.value == pytest.approx(0.5, abs=0.1) and claim.apart.n == DRAWS
    assert [share.value for share in (claim.none, claim.three, claim.one)] == [0, 1, 1]


def claimed(reading, level, yaw, times):
    """Fails without reset at 10 s of feedback and level 5, where one cures but at yaw 120."""
    if reading.feedback_s == 1 or not level:
        return 90.0
    return {0: NEVER, 1: NEVER if yaw == 120 else 150.0}.get(len(times), 200.0)


def test_question_4_counts_readings_and_points():
    answer = reset_claim.answer(grid_of(claimed))
    assert "under 2 of 4 readings (Q `per_step`, feedback 10 s; Q `psd`, fee" in answer.headline
    assert "Over 24 points of misalignment and reading 18 settle without" in answer.headline
    assert "the paper's three cure 6, and at 4 of these one does too" in answer.headline
    counts = tables(answer)["At how many of 6 misalignments"]
    assert row_of(counts, "psd", "10")[reset_claim.KINDS[reset_claim.SEVERAL].name] == "1"
    paper = tables(answer)["The paper's (5, 5, 30) deg"]
    row = row_of(paper, "per_step", "10")
    assert row["settles later than the smallest by (s)"] == "110 [110, 110]"
    assert row["ok without (%)"] == "0 [0, 32]" and row["so"] == "cured by the three, by one too"
    assert row_of(paper, "per_step", "1")["so"] == "settles without reset"


# --- the page -----------------------------------------------------------------------------------

MANIFEST = {"runs": 2304, "wall_s": 120.0, "devices": 2, "versions": {"sinsjax": "1", "jax": "2"}}


def results_in(directory, **changes):
    (directory / "manifest.json").write_text(json.dumps(MANIFEST | changes))
    study = reset_study()
    settle = by_variant(study, times_of) + np.arange(DRAWS)[:, None]
    return source_of(study, settle, directory=directory)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return reset_cycle.report(results_in(tmp_path_factory.mktemp("results")))


def test_the_page_answers_five_questions(report):
    assert [section.heading for section in report.sections] == [
        "Is more than one reset ever better than one?",
        "When must the reset come?",
        "What governs failure, level or yaw?",
        "Where does the paper's claim hold?",
        "What did it cost?",
    ]
    assert len(report.headline) == 6
    assert report.headline[0].startswith(
        "2,304 runs of 900 s: 6 schedules of resets x 6 misalignments x 8 readings"
    )
    names = [b.name for s in report.sections for b in s.blocks if isinstance(b, Picture)]
    assert names == ["settling_per_step", "settling_psd", "single_reset", "failure", "claim"]
    text = str(report)
    assert "nan" not in text and NONE not in text.split()


def test_the_cost_is_the_manifests(tmp_path):
    """Of all sessions, on devices or with workers: each second counts as often as there were."""
    sessions = [
        {"cpu": "A", "wall_s": 60.0, "devices": 2},
        {"cpu": "B", "wall_s": 40.0, "workers": 4},
        {"cpu": "A", "wall_s": 20.0, "devices": 2},
    ]
    answer = reset_cycle.cost(results_in(tmp_path, sessions=sessions))
    rows = answer.blocks[0].rows
    cost = dict(rows[:7])
    steps = 2304 * 90_000
    assert cost["steps of sensors, navigation and filter"] == f"{steps:,}"
    busy_s = 60 * 2 + 40 * 4 + 20 * 2
    assert cost["time a step and run on one of them (ns)"] == f"{busy_s / steps * 1e9:.0f}"
    assert cost["runs a second"] == "19" and cost["times real time"] == "17,280"
    assert [row[1] for row in rows if row[0] == "processor"] == ["A", "B"]
    assert rows[-1] == ["versions", "sinsjax 1, jax 2"]
    assert "2.0 min on 2 and 4 devices or workers, for 2.1e+08 steps" in answer.headline


def test_figures_show_the_medians(report):
    pictures = {b.name: b for s in report.sections for b in s.blocks if isinstance(b, Picture)}
    panels = {axes.get_title(loc="left"): axes for axes in pictures["settling_psd"].figure.axes}
    values = {name: axes.images[0].get_array() for name, axes in panels.items() if axes.images}
    assert values["none, 10 s"].mask.tolist() == [[False, False, True], [True, True, True]]
    np.testing.assert_allclose(values["more, 10 s"], [[203, 253, 253]] * 2)
    assert values["one, 10 s"].mask.tolist() == [[False] * 3, [False, False, True]]
    axes = pictures["failure"].figure.axes[0]
    np.testing.assert_allclose(axes.images[0].get_array(), [[0, 0, 100], [100, 100, 100]])
    figure = pictures["single_reset"].figure
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["0", "5"]
    assert figure.axes[-2].get_xlabel() == "time of the reset (s)"
