"""What every alignment method has to do, whatever it is made of.

A new method is found in the registry; `support.methods` is the only table of methods in the tests.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import (
    ARCMIN,
    PAPER1,
    loops,
    navigation,
    paper_params,
    site,
    step_and_close,
    swing_increments,
)
from oracles.naive import DEG, PAPER, Loops, azimuth_gains, exp, level_gains, log, of_quaternion
from support.methods import FACTS
from support.studies import refusal_line, small_study

from sinsjax.engine import batch, build
from sinsjax.engine.build import Scenario
from sinsjax.execution import schemas
from sinsjax.maths import rotations
from sinsjax.methods import passes
from sinsjax.methods.compass import REVERSALS
from sinsjax.methods.floors import NO_BIASES
from sinsjax.methods.method import COMMON_KEYS, UNKNOWN_ANGLE, Options, RunEnd
from sinsjax.methods.plugins import check_plugin
from sinsjax.methods.registry import METHODS, PACKAGES
from sinsjax.strapdown import sensors
from sinsjax.study.keys import SECTIONS, TUNABLE

pytestmark = pytest.mark.optimised(False)

RATE, SECONDS, LATITUDE = 100, 60, 32 * DEG
SWING = PAPER1._replace(center=np.array([0.05, -0.1, 2.0]))
NEVER = 10**9

FILTERS = [name for name in METHODS if name in FACTS and FACTS[name].states]
STEPPED = [name for name, method in METHODS.items() if not method.stores_blocks]
COVARIANCE = [name for name in STEPPED if METHODS[name].has_covariance]
methods = pytest.mark.parametrize("name", METHODS)
filters = pytest.mark.parametrize("name", FILTERS)
few = pytest.mark.nightly(fast=("compass", "kalman5", "kalman_sincos", "level"))
"""With and without P, and with and without a heading of the start."""
few_filters = pytest.mark.nightly(fast=("kalman5",))

COMPASS = Loops(level_gains(0.3, PAPER), ((20.0 * RATE, azimuth_gains(0.1, PAPER)),), 0.01)
"""Loops quick enough for a minute: sigma 0.3 1/s in level, from 20 s on 0.1 1/s in azimuth."""


def method_of(name, **choices):
    blocks = {"record_every": RATE, "records": SECONDS} if METHODS[name].stores_blocks else {}
    return METHODS[name](Options(1 / RATE, **blocks | choices))


REVERSING = [name for name in METHODS if method_of(name).passes]
reversing = pytest.mark.parametrize("name", REVERSING)
few_reversing = pytest.mark.nightly(fast=("compass", "kalman10"))


@cache
def params_of_study(name):
    """The method's params of a small study."""
    group = Scenario(small_study(alignment={"method": name})).part(0).group
    return jax.tree.map(lambda a: np.asarray(a)[0], group.variants.method)


def numbers(name, **changes):
    if name == "compass":
        return loops(COMPASS, REVERSALS["reflect"])
    if name not in FILTERS:
        return params_of_study(name)
    given, extra = paper_params(FACTS[name].states, **changes), FACTS[name].extra
    return given if extra is None else given._replace(extra=np.float64(extra))


def test_table_of_methods_has_every_method():
    assert {*FACTS} == METHODS.keys() - PACKAGES.keys()


# What a method states of itself


@methods
def test_description_names_existing_keys_only(name):
    method = METHODS[name]
    assert method.name == name and method.summary
    known = {key for section in TUNABLE for key in SECTIONS[section].model_fields}
    assert {*method.reads} <= known and {*method.without_effect} <= {*method.keys, *COMMON_KEYS}
    for pair in method.gyro_bias_keys:
        assert {*pair} <= method.keys
    if relaxed := method.implementation.relaxation:
        followed = {*relaxed.follows, *relaxed.follows.values()}
        assert {*relaxed.changes, *followed, *({relaxed.times} - {None})} <= method.keys


@methods
def test_own_columns_are_in_summary_layout(name):
    study = small_study(alignment={"method": name})
    names = [own.column.name for own in METHODS[name].own_columns(study)]
    assert len({*names}) == len(names)
    assert {*names} <= {column.name for column in schemas.summary_columns(study)}


@methods
def test_description_is_true_of_what_it_builds(name):
    built, described, params = method_of(name), METHODS[name], params_of_study(name)
    # As of a plug-in: states keep their structure, attitude and covariance have theirs.
    one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], params)
    check_plugin(name, built, one, 1, site(PAPER, LATITUDE))
    assert (built.block_fit is not None) == described.stores_blocks
    covariance = built.covariance(built.init(params, nav_off(np.zeros(3))))
    assert np.isfinite(covariance).all() == described.has_covariance


@methods
def test_bias_floor_is_zero_without_biases(name):
    params, here = params_of_study(name), site(PAPER, LATITUDE).place
    for backward in (False, True):
        end = RunEnd(np.float64(RATE * SECONDS), np.asarray(backward))
        floor = method_of(name).floor(params, here, NO_BIASES, end)
        np.testing.assert_allclose([*floor.phi], 0.0, rtol=0, atol=1e-15)
        assert floor.no_north != METHODS[name].finds_heading


@methods
def test_stored_record_is_read_again_only_by_methods_with_passes(name):
    given = {"alignment": {"method": name}, "passes": {"stored_s": 2.0}}
    if name in REVERSING:
        (part,) = build.parts(small_study(**given))
        assert part.group.static.passes == "alternate"
    else:
        line = refusal_line(**given)
        assert line.startswith("[passes] stored_s: ") and name in line


# Its steps


@cache
def increments():
    return swing_increments(SWING, PAPER, LATITUDE, rate=RATE, samples=RATE * SECONDS)


@cache
def runner(name):
    """A compiled run without sensor errors: corrected attitudes and covariances every second."""
    method = method_of(name)
    rows = increments()
    samples = jax.tree.map(
        lambda a: a.reshape(SECONDS, RATE), sensors.compensate_record(rows, rows[0])
    )
    here = site(PAPER, LATITUDE)

    def run(filt, nav):
        def one_second(state, xs):
            second, block = xs

            def step(i, state):
                sample = jax.tree.map(lambda a: a[i], block)
                return step_and_close(method, filt, here, state, sample, second * RATE + 1.0 + i)

            state = method.normalise(jax.lax.fori_loop(0, RATE, step, state))
            seen = method.attitude(state), method.covariance(state), state.nav
            return state, seen

        seconds = jnp.arange(float(SECONDS))
        return jax.lax.scan(one_second, method.init(filt, nav), (seconds, samples))[1]

    return jax.jit(run)


def nav_off(phi, v=(0.0, 0.0)):
    return navigation(exp(-np.asarray(phi)) @ SWING.matrix(0.0), v, LATITUDE)


def run(name, phi, v=(0.0, 0.0), **changes):
    """Misalignment left every second (rad), covariances (seconds, 3, 3), and speed (m/s)."""
    q, covariance, nav = runner(name)(numbers(name, **changes), nav_off(phi, v))
    c = of_quaternion(np.stack(q, axis=1))
    left = [log(SWING.matrix(k + 1.0) @ c[k].T) for k in range(SECONDS)]
    ee, en, eu, nn, nu, uu = np.array(covariance)
    p = np.moveaxis(np.array([[ee, en, eu], [en, nn, nu], [eu, nu, uu]]), -1, 0)
    return np.array(left), p, np.hypot(nav.ve, nav.vn)


@few
@methods
def test_init_keeps_given_navigation_and_initial_covariance(name):
    method = method_of(name)
    nav = nav_off([0.1, 0.2, 0.3], (0.5, -0.6))
    state = method.init(numbers(name), nav)
    for a, b in zip(
        jax.tree.leaves((method.attitude(state), state.nav)),
        jax.tree.leaves((nav.q, nav)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-16)
    if "filter" in METHODS[name].sections:
        p0 = numbers(name).p0
        heading = UNKNOWN_ANGLE if "p0_yaw_deg" in METHODS[name].without_effect else p0[4]
        believed = (p0[2], 0, 0, p0[3], 0, heading)
    elif METHODS[name].has_covariance:
        believed = (UNKNOWN_ANGLE, 0, 0, UNKNOWN_ANGLE, 0, UNKNOWN_ANGLE)
    else:
        believed = (np.nan,) * 6
    np.testing.assert_array_equal(method.covariance(state), believed)


@few
@methods
def test_normalise_changes_only_quaternion_length(name):
    method = method_of(name)
    state = method.init(numbers(name), nav_off([0.1, 0.2, 0.3]))
    q = state.nav.q
    long = state._replace(nav=state.nav._replace(q=type(q)(*(1.5 * c for c in q))))
    for a, b in zip(*map(jax.tree.leaves, (method.normalise(long), state)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)


@cache
def flight(name, seconds, **choices):
    """Some seconds of a run: navigation -> its state; and the same for several."""
    method, here, given = method_of(name, **choices), site(PAPER, LATITUDE), numbers(name)
    rows = increments()[: RATE * seconds]

    def fly(nav):
        samples = sensors.compensate_record(rows, rows[0])
        counts = 1.0 + jnp.arange(float(len(rows)))

        def step(state, xs):
            return step_and_close(method, given, here, state, *xs), None

        return jax.lax.scan(step, method.init(given, nav), (samples, counts))[0]

    return jax.jit(fly), jax.jit(jax.vmap(fly))


START = nav_off(np.array([1.0, -2.0, 5.0]) * DEG, (0.3, 0.4))
"""Off in everything."""


@pytest.mark.nightly(fast=("compass", "level"))
@methods
def test_run_depends_on_its_own_start_alone(name):
    """Again it has the same bits; side by side with a broken one, what it has alone."""
    alone, mapped = flight(name, 2)
    other, broken = nav_off([0.0, 0.1, -1.0]), jax.tree.map(lambda a: a * np.nan, START)
    together = mapped(jax.tree.map(lambda *leaves: jnp.stack(leaves), START, broken, other))
    for place, nav in ((0, START), (2, other)):
        once, again = (jax.tree.leaves(alone(nav)) for _ in "ab")
        for a, b, c in zip(once, again, jax.tree.leaves(together), strict=True):
            np.testing.assert_array_equal(a, b)
            np.testing.assert_allclose(c[place], a, rtol=1e-9, atol=1e-12)


SILENT_START = [name for name in STEPPED if "phi_u0_deg" in METHODS[name].without_effect]


@pytest.mark.nightly(fast=("inertial", "level"))
@pytest.mark.parametrize("name", SILENT_START)
def test_start_without_effect_changes_no_bit(name):
    alone, _ = flight(name, 2)
    one, other = (method_of(name).attitude(alone(nav)) for nav in (START, nav_off([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(one, other)


SHARING = [
    (name, force, position)
    for name in METHODS
    for force in ("measured", "gravity")
    for position in ("fixed", "integrated")
    if method_of(name, specific_force=force, position=position).shares_covariance
]


@pytest.mark.nightly(fast=("kalman_sincos-measured-fixed",))
@pytest.mark.parametrize(("name", "force", "position"), SHARING)
def test_shared_covariance_does_not_depend_on_the_start(name, force, position):
    """To the bit; runs that differ in their draw have it in common."""
    alone, _ = flight(name, 2, specific_force=force, position=position)
    one, other = (alone(nav).belief.p for nav in (START, nav_off(np.zeros(3))))
    np.testing.assert_array_equal(one, other)


@pytest.mark.nightly
@methods
def test_runs_of_a_study_have_the_same_bits_in_any_chunk(name):
    study = small_study(
        study={"draws": 70, "duration_s": 4.0, "rate_hz": 20.0, "window_s": [1, 4]},
        alignment={"method": name},
        axes={"yaw_center_deg": [0.0]},
        drawn={"gyro_bias_deg_per_h": {"normal": [0.0, 0.1]}},
        sensors={"gyro_bias_deg_per_h": None},
    )
    group = Scenario(study).part(0).group
    whole, parts = (
        jax.tree.map(
            lambda *leaves: np.concatenate(leaves),
            *(chunk.outcome for chunk in batch.run_chunks(group, devices=n, tiles_per_chunk=tiles)),
        )
        for n, tiles in ((1, 64), (2, 2))
    )
    for a, b in zip(*map(jax.tree.leaves, (whole, parts)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert len({*np.asarray(whole.last.phi.x).tolist()}) == 70


@pytest.mark.nightly(fast=("kalman5", "compass"))
@pytest.mark.parametrize("name", STEPPED)
def test_tangents_are_finite_at_zero_error(name):
    """There a root or an arc tangent might have none."""
    method, here, filt = method_of(name), site(PAPER, LATITUDE), numbers(name, every=1)
    sample = jax.tree.map(
        lambda a: a[0], sensors.compensate_record(increments()[:1], increments()[0])
    )

    def after(filt, nav):
        state = step_and_close(method, filt, here, method.init(filt, nav), sample, 1.0)
        return method.attitude(state), method.covariance(state), state.nav

    point = filt, nav_off(np.zeros(3))
    ones = jax.tree.map(lambda a: np.ones_like(a, dtype=float), point)
    tangent = jax.jit(lambda *given: jax.jvp(after, *given)[1])(point, ones)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tangent))


@pytest.mark.nightly(fast=("compass", "kalman5"))
@pytest.mark.parametrize("name", [n for n in METHODS if n in FACTS and FACTS[n].stays_at_truth])
def test_run_started_at_truth_stays_at_truth(name):
    left, _, speed = run(name, np.zeros(3), **({"every": 10} if name in FILTERS else {}))
    assert np.abs(left).max() < 1e-3 * ARCMIN
    assert speed.max() < 1e-6


@pytest.mark.nightly(fast=("compass-None", "kalman5-100"))
@pytest.mark.parametrize(
    ("name", "every"),
    [("compass", None), *((name, every) for name in FILTERS for every in (1, 100))],
)
def test_run_levels_and_then_finds_north(name, every):
    phi = np.array([10.0, -10.0, 60.0]) * ARCMIN
    changes = {} if every is None else {"every": every}
    left, p, _ = run(name, phi, v=(0.05, -0.05), **changes)
    # Level first, in seconds; north slowly, out of the Earth's rate.
    assert np.abs(left[20:, :2]).max() < 0.2 * ARCMIN
    assert abs(left[-1, 2]) < 30 * ARCMIN
    # Within what is believed, if anything is.
    sigma = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    assert np.all(sigma[-1] < sigma[0]) if name in FILTERS else np.all(np.isnan(sigma))


# Its covariance


@few_filters
@pytest.mark.parametrize("name", COVARIANCE)
def test_covariance_is_symmetric_positive(name):
    changes = {"every": 30, "resets": (1000, 2000)} if name in FILTERS else {}
    _, p, _ = run(name, np.array([1.0, 2.0, 5.0]) * DEG, **changes)
    assert np.linalg.eigvalsh(p).min() > 0


@few_filters
@filters
def test_feedback_interval_does_not_matter_for_small_errors(name):
    """The loop is linear there: what is fed back early or late is the same estimate."""
    phi = np.array([0.05, -0.05, 0.2]) * ARCMIN
    each, seldom, never = (run(name, phi, every=every)[0] for every in (1, 700, NEVER))
    np.testing.assert_allclose(seldom, each, rtol=0, atol=1e-3 * ARCMIN)
    np.testing.assert_allclose(never, each, rtol=0, atol=1e-3 * ARCMIN)


@few_filters
@filters
def test_reset_restores_initial_covariance(name):
    k = 40
    phi = np.array([10.0, -10.0, 60.0]) * ARCMIN
    _, p, _ = run(name, phi, every=100)
    _, again, _ = run(name, phi, every=100, resets=(RATE * k,))
    np.testing.assert_array_equal(again[: k - 1], p[: k - 1])
    p0 = np.array(numbers(name).p0[2:5])
    np.testing.assert_allclose(again[k - 1], np.diag(p0), rtol=1e-14, atol=0)
    assert np.all(np.diagonal(again[-1]) >= np.diagonal(p[-1]) * (1 - 1e-9))


@few_filters
@filters
def test_feedback_does_not_change_corrected_attitude(name):
    """The estimate moves into the solution: its sum with the solution, the user's, stays."""
    start = nav_off(np.array([1.0, -2.0, 5.0]) * DEG, (0.3, 0.4))
    given = []
    for gain, every in ((0.0, NEVER), (0.3, RATE), (1.0, RATE)):
        attitude, _, nav = runner(name)(numbers(name, every=every, gain=gain), start)
        given.append([np.stack(q, axis=1)[0] for q in (attitude, nav.q)])
    # Rz(a) e of a share and of the rest make that of the whole to third order only.
    third_order = np.radians(2.0) ** 2 * np.radians(5.0)
    of_shares = third_order if FACTS[name].extra is not None else 1e-13
    for (attitude, q), atol in zip(given[1:], (of_shares, 1e-13), strict=True):
        np.testing.assert_allclose(attitude, given[0][0], rtol=0, atol=atol)
        assert np.abs(q - given[0][1]).max() > 1e-3
    np.testing.assert_allclose(*given[2], rtol=0, atol=1e-14)


# Its passes over a stored record


@few_reversing
@reversing
def test_two_turns_at_one_place_cancel(name):
    """A turn runs time the other way: it reverses the velocity and keeps place and heading."""
    method, given, here = method_of(name), numbers(name), site(PAPER, LATITUDE)
    state = flight(name, 2)[0](START)
    once = method.passes.reverse(given, here, state)
    twice = method.passes.reverse(given, passes.site_of_pass(here, jnp.asarray(True)), once)
    for a, b in zip(jax.tree.leaves(twice), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)
    assert once.nav.ve == -state.nav.ve != 0 and once.nav.vn == -state.nav.vn != 0
    assert (once.nav.latitude, once.nav.longitude) == (state.nav.latitude, state.nav.longitude)
    turned = rotations.misalignment(method.attitude(once), method.attitude(state))
    assert abs(turned.z) < 1e-15
    # A filter does not touch its attitude, a compass levels by the specific force.
    if name in FILTERS or name == "compass":
        assert (max(abs(turned.x), abs(turned.y)) > 1e-6) == (name == "compass")


@few_reversing
@reversing
def test_rewound_state_is_that_of_a_new_start(name):
    """But for the count of samples, with which schedules go on."""
    method, given = method_of(name), numbers(name)
    ended = flight(name, 2)[0](START)
    first = method.init(given, START)
    if begin_after := method.passes.begin_after:
        first = begin_after(first, np.float64(2 * RATE))
    again = method.passes.rewind(given, START, ended)
    assert jax.tree.structure(again) == jax.tree.structure(first)
    for a, b in zip(*map(jax.tree.leaves, (again.nav, first.nav)), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(method.covariance(again), method.covariance(first), rtol=1e-12)
