"""Compass loops against closed forms, and against the same loops written naively.

The closed forms are the transfer functions of [P2] section 2.1, put into the time domain by a
companion form. A step of the engine is first order in dt: two sample rates extrapolate it away, so
that the comparison is as sharp as the terms that a closed form leaves out.
"""

from functools import cache

import numpy as np
import pytest
from oracles.in_engine import (
    ARCMIN,
    DEG_PER_H,
    PAPER2,
    UG,
    loops,
    one_run,
    record_world,
    site,
    trail,
)
from oracles.in_engine import swing_increments as record_of
from oracles.naive import (
    DEG,
    SECOND_PAPER,
    WGS84,
    Loops,
    Swing,
    azimuth_gains,
    compass_loop,
    exp,
    level_gains,
    log,
    of_quaternion,
)
from scipy import linalg, signal

from sinsjax.engine.run import Static
from sinsjax.methods.compass import REVERSALS
from sinsjax.methods.compass_design import (
    AzimuthGains,
    LevelGains,
    azimuth_matrix,
    is_stable,
    level_matrix,
)
from sinsjax.methods.method import Options
from sinsjax.methods.schedules import PiecewiseConstant
from sinsjax.strapdown import sensors

EARTH = SECOND_PAPER
G, R = EARTH.gravity, EARTH.a
SLOW = EARTH._replace(rate=EARTH.rate / 10)
"""On its equator omega_U is zero, and omega_N^2 too small to matter: there [P2]'s forms hold."""
LATITUDE = 32.057313 * DEG
STILL = Swing(*np.zeros((2, 3)), np.ones(3), np.zeros(3))
NEVER, SECONDS = np.inf, 1500
KEEP = REVERSALS["keep"]


LEVEL, AZIMUTH = level_gains(0.02, EARTH), azimuth_gains(0.01, EARTH)
NO_AZIMUTH = (NEVER, AZIMUTH)


@cache
def still_world(planet, latitude, rate):
    rows = record_of(STILL, planet, latitude, rate=rate, samples=rate * SECONDS)
    return record_world(rows, site(planet, latitude), pass_records=SECONDS)


def fly(params, *, planet, latitude, rate, phi=(0, 0, 0), v=(0, 0), eps=0.0, nabla=0.0):
    """The engine's run on a static base, level and pointing north, without noise."""
    errors = sensors.error_free_sensors()._replace(
        gyro_bias=np.zeros(3) + eps, accel_bias=np.array([1.0, 1.0, 0.0]) * nabla
    )
    environment = still_world(planet, latitude, rate)
    environment = environment._replace(sensors=environment.sensors._replace(errors=errors))
    static = Static("compass", Options(1 / rate), rate, SECONDS, curves=False)
    return states(trail(static, environment, one_run(np.eye(3), phi, v, params)))


def states(state):
    """[dVE, dVN, phiE, phiN, phiU, IE, IN, w], one row a record."""
    c = of_quaternion(np.stack(state.nav.q, axis=1))
    v = np.stack([state.nav.ve, state.nav.vn], axis=1)
    rest = np.stack([state.integral_e, state.integral_n, state.rate_u], axis=1)
    return np.concatenate([v, log(np.swapaxes(c, 1, 2)), rest], axis=1)


def extrapolated(given, pieces=(), **case):
    """`fly` at two sample rates, extrapolated to none."""
    coarse, fine = (fly(at_rate(given, rate, *pieces), rate=rate, **case) for rate in (50, 100))
    return 2 * fine - coarse


def at_rate(given, rate, begin_s=NEVER, pace=1.0):
    """Loops whose azimuth gains begin at a time, and have another pace later."""
    ((from_s, gains),) = given.azimuth
    params = loops(given._replace(azimuth=((from_s * rate, gains),)), KEEP)
    return params._replace(
        pace=PiecewiseConstant(np.array([begin_s * rate]), np.array([1.0, pace]))
    )


def close(got, expected, tolerance):
    """To a tolerance of the largest expected value."""
    assert np.abs(got - expected).max() < tolerance * np.abs(expected).max()


def response(numerator, denominator, kind):
    """Impulse or step response of a transfer function every second, from its companion form."""
    a, b, c, d = signal.tf2ss(numerator, denominator)
    whole = linalg.expm(np.block([[a, b], [np.zeros((1, len(a) + 1))]]))
    free, forced = whole[:-1, :-1], whole[:-1, -1:]
    state, out = (b, []) if kind == "impulse" else (0 * b, [])
    assert d.item() == 0
    for _ in range(SECONDS):
        state = free @ state + (forced if kind == "step" else 0)
        out.append((c @ state).item())
    return np.array(out)


LEVELLING = {
    # input: transfer functions to phi_E and to dV_N, with the kind and size of the input
    "phi_E(0)": ("impulse", 1e-5, lambda k1, k2, k3: ([1, k1, 0], [G, 0])),
    "dV_N(0)": ("impulse", 1e-5, lambda k1, k2, k3: ([-(1 + k2) / R, -k3], [1, 0, 0])),
    "nabla_N": ("step", 50 * UG, lambda k1, k2, k3: ([-(1 + k2) / R, -k3], [1, 0, 0])),
    "eps_E": ("step", DEG_PER_H, lambda k1, k2, k3: ([-1, -k1, 0], [-G, 0])),
}


def driven(name, size):
    """A start or an error of the sensors, by the name of an input."""
    return {
        "phi_E(0)": {"phi": (size, 0, 0)},
        "phi_U(0)": {"phi": (0, 0, size)},
        "dV_N(0)": {"v": (0, size)},
        "nabla_N": {"nabla": np.array([0, size, 0])},
        "eps_E": {"eps": np.array([size, 0, 0])},
        "eps_U": {"eps": np.array([0, 0, size])},
    }[name]


@pytest.mark.nightly
@pytest.mark.parametrize("name", LEVELLING)
def test_levelling_loop_matches_closed_form_of_paper(name):
    """Eq. (1), Delta3 = s^3 + K1 s^2 + (1 + K2) (g/R) s + g K3."""
    kind, size, numerators = LEVELLING[name]
    k1, k2, k3 = LEVEL
    delta = [1, k1, (1 + k2) * G / R, G * k3]
    tilt, velocity = (size * response(n, delta, kind) for n in numerators(*LEVEL))
    given = Loops(LEVEL, (NO_AZIMUTH,))
    got = extrapolated(given, planet=SLOW, latitude=0.0, **driven(name, size))
    # Left out: omega_N phi_U with phi_U' = omega_N phi_E - eps_U.
    close(got[:, 2], tilt, 2e-6)
    close(got[:, 1], velocity, 2e-6)


def azimuth_forms(k1, k2, k3, k4, omega):
    """Transfer functions to phi_U of eq. (2), by their inputs, and Delta4."""
    q2 = [1, k1, (1 + k2) * G / R]
    delta = np.polyadd(np.polymul([1, k4, 0], q2), [G * k3])
    own = np.polymul([1, k4], q2)
    return delta, {
        "phi_U(0)": ("impulse", 1e-5, own),
        "eps_U": ("step", 0.01 * DEG_PER_H, -own),
        "phi_E(0)": ("impulse", 1e-8, [G * k3 / omega]),
        "eps_E": ("step", 1e-5 * DEG_PER_H, [-G * k3 / omega]),
        "nabla_N": ("step", 0.01 * UG, [k3 / omega, 0]),
        "dV_N(0)": ("impulse", 1e-8, [k3 / omega, 0]),
    }


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["phi_U(0)", "eps_U", "phi_E(0)", "eps_E", "nabla_N", "dV_N(0)"])
def test_azimuth_loop_matches_closed_form_of_paper(name):
    """Eq. (2), Delta4 = s (s + K4) (s^2 + K1 s + (1 + K2) g/R) + g K3."""
    delta, forms = azimuth_forms(*AZIMUTH, SLOW.rate)
    kind, size, numerator = forms[name]
    heading = size * response(numerator, delta, kind)
    given = Loops(LEVEL, ((0.0, AZIMUTH),))
    got = extrapolated(given, planet=SLOW, latitude=0.0, **driven(name, size))
    # Left out: omega_N phi_E in phi_U', of the order (omega_N / sigma)^2 = 5e-7.
    close(got[:, 4], heading, 1e-5)


def linear(level, azimuth, earth, latitude):
    """The whole linear model of both channels: x' = A x + B u, u = (nabla_E, nabla_N, eps_E, N, U).

    x = [dVE, dVN, phiE, phiN, phiU, IE, IN, w], with every coupling of a base at rest:
    dV' = f x phi - 2 w_ie x dV + nabla - K1 dV, phi' = phi x w_ie + dw_in + w_c - eps.
    ``azimuth`` None: levelling in both channels.
    """
    wn, wu, t = earth.rate * np.cos(latitude), earth.rate * np.sin(latitude), np.tan(latitude)
    k1, k2, k3 = level
    z1, z2, z3, z4 = azimuth or (k1, k2, 0.0, 0.0)
    holds = 1.0 if azimuth is None else 0.0
    a = np.array(
        [
            [-k1, 2 * wu, 0, -G, 0, 0, 0, 0],
            [-2 * wu, -z1, G, 0, 0, 0, 0, 0],
            [0, -(1 + z2) / R, 0, wu, -wn, 0, -holds, 0],
            [(1 + k2) / R, 0, -wu, 0, 0, 1, 0, 0],
            [t / R, 0, wn, 0, 0, 0, 0, 1],
            [k3, 0, 0, 0, 0, 0, 0, 0],
            [0, k3 * holds, 0, 0, 0, 0, 0, 0],
            [0, z3 / wn, 0, 0, 0, 0, 0, -z4],
        ]
    )
    return a, np.concatenate([np.diag([1.0, 1, -1, -1, -1]), np.zeros((3, 5))])


def linear_run(pieces, x, u, latitude):
    """The linear model every second over pieces (seconds, azimuth gains or None)."""
    rows = []
    for seconds, azimuth in pieces:
        a, b = linear(LEVEL, azimuth, EARTH, latitude)
        whole = linalg.expm(np.block([[a, (b @ u)[:, None]], [np.zeros((1, 9))]]))
        for _ in range(seconds):
            x = whole[:-1, :-1] @ x + whole[:-1, -1]
            rows.append(x)
    return np.array(rows)


DRIVEN = {
    "tilts": {"phi": np.array([2, -3, 0]) * 1e-6},
    "heading": {"phi": np.array([0, 0, 1e-6])},
    "velocity": {"v": np.array([1e-5, -2e-5])},
    "drift": {"eps": np.array([1, -2, 3]) * 1e-4 * DEG_PER_H},
    "accelerometers": {"nabla": np.array([1, -2, 0]) * 0.1 * UG},
}


@pytest.mark.optimised(False)
@pytest.mark.parametrize("name", DRIVEN)
def test_both_channels_match_coupled_linear_model(name):
    """With all couplings, through levelling, the switch to azimuth and a change of pace."""
    case = {"phi": np.zeros(3), "v": np.zeros(2), "eps": np.zeros(3), "nabla": np.zeros(3)}
    case |= DRIVEN[name]
    x = np.concatenate([case["v"], case["phi"], np.zeros(3)])
    u = np.concatenate([case["nabla"][:2], case["eps"]])
    gains = (100, None), (150, AZIMUTH), (SECONDS - 250, azimuth_gains(0.03, EARTH))
    expected = linear_run(gains, x, u, LATITUDE)
    given = Loops(LEVEL, ((100.0, AZIMUTH),))
    got = extrapolated(given, (250.0, 3.0), planet=EARTH, latitude=LATITUDE, **case)
    for column in np.flatnonzero(np.abs(expected).max(axis=0)):
        close(got[:, column], expected[:, column], 5e-4)


@pytest.mark.optimised(False)
def test_steady_state_errors_from_constant_biases_match_theory():
    """Tilts at -nabla_N/g and nabla_E/g, whatever drifts; phi_U as in theory, with every term."""
    eps, nabla = np.array([2, -3, 4]) * 1e-5 * DEG_PER_H, np.array([0.5, -0.3, 0.0]) * UG
    case = {"planet": EARTH, "latitude": LATITUDE, "rate": 50, "nabla": nabla}
    drift = np.array([1e-2, -1e-2, 0.0]) * DEG_PER_H
    level = fly(at_rate(Loops(LEVEL, (NO_AZIMUTH,)), 50), eps=drift, **case)[-1]
    np.testing.assert_allclose(level[2:4], [-nabla[1] / G, nabla[0] / G], rtol=2e-4)
    sigma = 0.02
    k1, k2, k3, k4 = gains = azimuth_gains(sigma, EARTH)
    both = fly(at_rate(Loops(LEVEL, ((300.0, gains),)), 50), eps=eps, **case)[-1]
    a, b = linear(LEVEL, gains, EARTH, LATITUDE)
    # The north integral is held, and read no more.
    free = [0, 1, 2, 3, 4, 5, 7]
    rest = np.linalg.solve(a[np.ix_(free, free)], -(b @ [*nabla[:2], *eps])[free])
    np.testing.assert_allclose(both[free], rest, rtol=1e-5, atol=1e-13)
    omega = EARTH.rate * np.cos(LATITUDE)
    # The azimuth loop takes omega_N phi_E, which eq. (21) leaves out, for a drift.
    up = eps[2] - omega * both[2]
    heading = -eps[0] / omega + nabla[0] / G * np.tan(LATITUDE) - (1 + k2) * k4 / (R * k3) * up
    assert (1 + k2) * k4 / (R * k3) == pytest.approx(2 / sigma)
    assert both[4] == pytest.approx(heading, rel=1e-4)
    np.testing.assert_allclose(both[3], nabla[0] / G, rtol=1e-3)
    np.testing.assert_allclose(both[1], k4 * omega * up / k3, rtol=1e-3)


@pytest.mark.optimised(False)
def test_loop_without_gains_oscillates_at_schuler_frequency():
    """The 1 in 1 + K2: what is left of the levelling loop is Schuler's."""
    given = Loops((0.0, 0.0, 0.0), ((NEVER, (0.0, 0.0, 0.0, 0.0)),))
    got = extrapolated(given, planet=SLOW, latitude=0.0, phi=(1e-5, 0, 0))
    t = np.arange(1, SECONDS + 1)
    close(got[:, 2], 1e-5 * np.cos(np.sqrt(G / R) * t), 1e-3)


def short_run(given, phi):
    """States of a static run of 20 s at 50 Hz after every sample."""
    rows = record_of(STILL, EARTH, LATITUDE, rate=50, samples=1000)
    environment = record_world(rows, site(EARTH, LATITUDE), pass_records=1000)
    static = Static("compass", Options(0.02), 1, 1000, curves=False)
    return trail(static, environment, one_run(np.eye(3), phi, (0, 0), given))


@pytest.mark.optimised(False)
@pytest.mark.parametrize(("loop", "grows"), [("level", 1.01), ("azimuth", 1.25)])
def test_stability_bound_on_sigma_separates_decay_from_growth(loop, grows):
    """A per cent below the bound on sigma a loop decays, and a little above it grows.

    In azimuth the bound is on the safe side: it leaves out that the mean heading of a step counts.
    """
    g_and_r = {"gravity": G, "radius": R}

    def matrix(sigma):
        if loop == "level":
            return level_matrix(LevelGains(*level_gains(sigma, EARTH)), **g_and_r)
        gains = AzimuthGains(*azimuth_gains(sigma, EARTH))
        return azimuth_matrix(gains, rate_n=EARTH.rate * np.cos(LATITUDE), **g_and_r)

    sigmas = np.linspace(1, 100, 1000)
    carried = np.array([is_stable(matrix(sigma), 0.02) for sigma in sigmas])
    last = sigmas[carried].max()
    assert np.all(carried == (sigmas <= last)) and 10 < last < 90
    left = []
    for sigma in (0.99 * last, grows * last):
        given = Loops(level_gains(sigma, EARTH), (NO_AZIMUTH,))
        if loop == "azimuth":
            given = Loops(LEVEL, ((0.0, azimuth_gains(sigma, EARTH)),))
        vn = np.abs(short_run(at_rate(given, 50), (1e-14, 0, 0)).nav.vn)
        left.append(np.nan_to_num(vn[400:500].max() / vn[:5].max(), nan=np.inf))
    assert left[0] < 0.5 and left[1] > 2


RATE, PASS = 100, 600
ERRORS = {
    "gyro": ((0.2 * DEG_PER_H, -0.1 * DEG_PER_H, 0.3 * DEG_PER_H), 0.2 * DEG_PER_H),
    "accel": ((1e1 * UG, -5e0 * UG, 3e1 * UG), 1e1 * UG),
}


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("planet", "latitude_deg", "position"), [(EARTH, 32.0, "fixed"), (WGS84, -41.0, "integrated")]
)
@pytest.mark.parametrize("rule", [*REVERSALS, "rewind"])
def test_three_compass_passes_match_naive_loop(rule, planet, latitude_deg, position):
    """Forward, backward, forward over 6 s of swing, azimuth taking over within the first pass.

    Or all three forward.
    """
    latitude, phi, v = (
        latitude_deg * DEG,
        np.array([0.1, -0.2, 5]) * ARCMIN,
        np.array([3e-4, -2e-4]),
    )
    rows = record_of(PAPER2, planet, latitude, rate=RATE, samples=PASS, **ERRORS)
    given = Loops(
        level_gains(0.2, EARTH), ((330, azimuth_gains(0.1, EARTH)),), 0.01, rule, position
    )
    start = exp(-phi) @ PAPER2.matrix(0.0)
    naive = compass_loop(
        rows,
        1 / RATE,
        planet,
        latitude=latitude,
        c=start,
        v=v,
        loops=given,
        stored=PASS,
        count=1800,
    )
    static = Static(
        "compass", Options(1 / RATE, position=position), 50, 36, False, passes="alternate"
    )
    static = static._replace(passes="rewind" if rule == "rewind" else "alternate")
    environment = record_world(rows, site(planet, latitude), pass_records=PASS // 50)
    turn = REVERSALS.get(rule, REVERSALS["keep"])
    params = one_run(PAPER2.matrix(0.0), phi, v, loops(given, turn))
    state = trail(static, environment, params)
    at = np.arange(50, 1801, 50) - 1
    np.testing.assert_allclose(
        of_quaternion(np.stack(state.nav.q, axis=1)), naive.c[at], rtol=0, atol=1e-11
    )
    close(np.stack([state.nav.ve, state.nav.vn], axis=1), naive.v[at], 1e-10)
    close(np.stack([state.integral_e, state.integral_n], axis=1), naive.integral[at], 1e-10)
    force = np.moveaxis([state.force_e, state.force_n], -1, 0)  # records, axes, stages
    close(force.swapaxes(1, 2), naive.force[at], 1e-10)
    # The naive way back multiplies as many matrices again.
    close(state.rate_u, naive.rate[at], 5e-10 if rule == "rewind" else 1e-10)
    np.testing.assert_allclose(state.nav.latitude, naive.latitude[at], rtol=0, atol=1e-15)
    np.testing.assert_allclose(state.nav.longitude, naive.longitude[at], rtol=0, atol=1e-15)
