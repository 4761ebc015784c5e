import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import dblquad

from sinsjax.strapdown import processes

pytestmark = pytest.mark.optimised(False)

RMS = np.array([1.0, 2.0, 0.5])


def covariances(process, lags=1):
    """Of y of the first axis with itself, by lag, from A, b, c and d."""
    a, b, c = process.transition, process.drive, process.output
    start = process.begin @ process.begin.T
    with_next, out = a @ start @ c + b * process.direct, [c @ start @ c + process.direct**2]
    for _ in range(lags):
        out.append(c @ with_next)
        with_next = a @ with_next
    return process.scale[0] ** 2 * np.array(out)


def assert_stationary(process):
    a, b = process.transition, process.drive
    covariance = process.begin @ process.begin.T
    after = a @ covariance @ a.T + np.outer(b, b)
    np.testing.assert_allclose(after, covariance, rtol=1e-6, atol=1e-9 * covariance.max())


@given(st.floats(0.02, 1e5), st.floats(1, 1000))
def test_gauss_markov_keeps_its_variance_and_correlation(time, rate):
    process = processes.gauss_markov_process(RMS, time, 1 / rate)
    assert_stationary(process)
    expected = np.exp(-np.arange(3) / (rate * time))
    np.testing.assert_allclose(covariances(process, 2), expected, rtol=1e-9)


@pytest.mark.parametrize("ratio", [1e-6, 1e-3, 0.0099, 0.0101, 0.3, 4.0])
def test_mean_gauss_markov_covariance_matches_integrals(ratio):
    """Of sample times up to four times the correlation time."""
    process = processes.sampled_mean_of_gauss_markov(RMS, np.asarray(1.0), ratio)
    assert_stationary(process)

    def integral(lag):
        if lag == 0:  # twice the half in which the difference is positive
            return 2 * dblquad(lambda s, t: np.exp(-(t - s) * ratio), 0, 1, 0, lambda t: t)[0]
        return dblquad(lambda s, t: np.exp(-(t + lag - s) * ratio), 0, 1, 0, 1)[0]

    expected = [integral(lag) for lag in range(3)]
    np.testing.assert_allclose(covariances(process, 2), expected, rtol=1e-9)
    # What is driven is what is left of the variance: it tells small ratios apart.
    assert -np.diff(covariances(process)) == pytest.approx(expected[0] - expected[1], rel=1e-5)


def test_mean_random_walk_variance_grows_as_its_integral():
    """Var of the difference of two means k samples apart: (k - 1/3) times that of a sample."""
    process = processes.sampled_mean_of_random_walk(RMS, 0.1)
    (a, d) = process.drive[0], process.direct
    for k in (1, 2, 5):
        between = d**2 + (k - 1) * a**2 + (a - d) ** 2
        assert between == pytest.approx(k - 1 / 3)
    assert not process.begin.any() and process.scale[0] == pytest.approx(np.sqrt(0.1))


@pytest.mark.parametrize("rate", [100.0, 200.0, 400.0])
def test_surge_velocity_acceleration_and_position_rms_at_any_rate(rate):
    """The third-order process of 0.1 m/s, 5 s, 1 Hz: 0.114 m/s^2, of which a sample has the mean.

    Of y''' + a2 y'' + a1 y' + a0 y = white, var y'' / var y' is a1.
    """
    time, bandwidth, rms = 5.0, 1.0, 0.1
    process = processes.velocity_of_bounded_position(np.full(3, rms), time, bandwidth, 1 / rate)
    assert_stationary(process)
    velocity, nearby = covariances(process)
    assert velocity == pytest.approx(rms**2)
    acceleration = np.sqrt(2 * (velocity - nearby)) * rate
    whole = rms * np.sqrt(2 * np.pi * bandwidth / time + 1 / time**2)
    assert whole == pytest.approx(0.114, abs=5e-4)
    lag = 2 * np.pi * bandwidth / rate
    assert acceleration == pytest.approx(whole * np.sqrt(1 - lag / 3), rel=6e-3)
    # The position stays within bounds: what the velocity integrates to has no variance at zero.
    later = covariances(process, round(200 * rate))
    assert abs(later[0] + 2 * later[1:].sum()) < 1e-3 * later[0] * rate


@given(st.floats(0.01, 0.9), st.floats(0.1, 40))
def test_resonance_has_given_variance_and_frequency(damping, frequency):
    process = processes.resonance_process(RMS, frequency, damping, 1 / 400)
    assert_stationary(process)
    found, omega = covariances(process, 4), 2 * np.pi * frequency
    damped = omega * np.sqrt(1 - damping**2)
    t = np.arange(5) / 400
    expected = np.exp(-damping * omega * t) * (
        np.cos(damped * t) + damping * omega / damped * np.sin(damped * t)
    )
    # Held over a sample, the noise is a little less white.
    np.testing.assert_allclose(found, expected, atol=0.1 * (omega / 400) ** 2)


DRIVING = jax.jit(processes.driving_noise, static_argnums=3)


def drawn(seed, draws, samples, triads):
    made = DRIVING(np.asarray(seed), np.asarray(draws), np.asarray(samples), triads)
    return {triad: np.stack(axes) for triad, axes in made.items()}


@pytest.mark.optimised(True)
def test_driving_noise_depends_only_on_seed_draw_sample_and_triad():
    many = drawn(7, np.arange(4), np.arange(9), (2, 7))
    for triad, axes in many.items():
        alone = drawn(7, 3, [5], (triad,))[triad]
        np.testing.assert_array_equal(alone[:, 0], axes[:, 5, 3])
    whole = np.concatenate([axes.reshape(-1, 36) for axes in many.values()])
    assert len(np.unique(whole, axis=0)) == len(whole)
    assert not np.array_equal(drawn(8, np.arange(4), np.arange(9), (2, 7))[2], many[2])


def test_driving_noise_is_white_with_unit_variance():
    count = 400_000
    rows = np.concatenate([*drawn(3, 1, np.arange(count), (0, 3)).values()])
    error = 1 / np.sqrt(count)
    products = rows @ rows.T / count
    assert np.abs(rows.mean(axis=1)).max() < 4 * error
    np.testing.assert_allclose(products, np.eye(6), atol=5 * error)
    lagged = rows[:, 1:] @ rows[:, :-1].T / count
    assert np.abs(lagged).max() < 4.5 * error
    assert (rows**4).mean(axis=1) == pytest.approx(3 - 2 / 16, abs=0.03)


def test_rounding_process_is_what_rounding_leaves():
    rng, process = np.random.default_rng(2), processes.rounding_process(np.array([2.0] * 3))
    total = np.cumsum(rng.normal(0, 50.0, 200_000))
    error = np.diff(2.0 * np.round(total / 2.0) - total)
    x = rng.standard_normal(200_001)  # y = c x + d w, and x becomes w
    made = process.scale[0] * (process.output[0] * x[:-1] + process.direct * x[1:])
    assert float(process.transition[0, 0]) == 0 and float(process.drive[0]) == 1
    for lag, tolerance in ((0, 0.02), (1, 0.03)):
        pair = [np.mean(a[lag:] * a[: a.size - lag]) for a in (made, error)]
        assert pair[0] == pytest.approx(pair[1], rel=tolerance)
