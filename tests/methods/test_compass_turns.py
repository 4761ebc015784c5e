"""Turns of the compass between passes, against a general integrator."""

import math
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.studies import small_study

from sinsjax.execution import run as study_run
from sinsjax.methods import compass_design as loops

G, R = 9.8, 6378137.0
LATITUDE, RATE = math.radians(32.0), math.radians(15.041067) / 3600
OMEGA_N = RATE * math.cos(LATITUDE)
SMOOTHING_S = 1.0
NABLA_DEG = math.degrees(50e-6)
LIMIT_E_DEG = -NABLA_DEG
LIMIT_U_DEG = NABLA_DEG * math.tan(LATITUDE) - math.degrees(math.radians(0.02) / 3600 / OMEGA_N)
TURNS = {"velocity": (-1, 1, 1), "velocity_and_rate": (-1, 1, -1), "reflect": (-1, -1, 1)}


def compass_study(*, turn="velocity", stored_s=60.0, level_time_s=40.0, **changes):
    sections = {
        "study": {"duration_s": 240.0, "rate_hz": 20.0, "window_s": [200, 240], "draws": 1},
        "motion": {f"{a}_amplitude_deg": 0.0 for a in ("pitch", "roll", "yaw")}
        | {"yaw_center_deg": 0.0},
        "sensors": {"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0, "gyro_bias_deg_per_h": 0.02}
        | {"accel_bias_ug": 50.0},
        "alignment": {"method": "compass"}
        | dict(zip(("phi_e0_deg", "phi_n0_deg", "phi_u0_deg"), (0.1, 0.0, 1.0), strict=True)),
        "compass": {"level_time_s": level_time_s},
        "passes": {"stored_s": stored_s, "turn": turn, "turn_smoothing_s": SMOOTHING_S},
    }
    for name, change in changes.items():
        known = sections.get(name)
        sections[name] = (
            known | change if known is not None and isinstance(change, dict) else change
        )
    return small_study(**sections)


def integrated(times, turn, *, level_s, stored_s, sigma_az):
    """The north channel by a general integrator, its equations written out."""
    v, tilt, w = TURNS[turn]
    level = loops.level_gains(0.02, math.sqrt(0.5), gravity=G, radius=R)

    def slope(t, x, direction, sigma):
        dv, phi_e, phi_u, integral, spin, once, twice = x
        wn, lag = direction * OMEGA_N, [2 / SMOOTHING_S * a for a in (phi_e - once, once - twice)]
        if t < level_s:
            k1, k2, k3 = level
            tilting = -(1 + k2) / R * dv - integral - wn * phi_u
            return [-k1 * dv + G * phi_e, tilting, 0.0, k3 * dv, 0.0, *lag]
        k = loops.azimuth_gains(sigma, math.sqrt(0.5), gravity=G, radius=R)
        tilting = -(1 + k.k2) / R * dv - wn * phi_u
        return [-k.k1 * dv + G * phi_e, tilting, spin, 0.0, k.k3 / wn * dv - k.k4 * spin, *lag]

    phi = np.deg2rad(np.array([0.1 - LIMIT_E_DEG, 1.0 - LIMIT_U_DEG]))
    x = np.array([0.0, *phi, 0.0, 0.0, 0.0, 0.0])  # the last: f_N/g, low-passed, twice
    found, edges = [], sorted({0.0, level_s, 100.0, *np.arange(stored_s, 241, stored_s), 240.0})
    for since, until in zip(edges[:-1], edges[1:], strict=True):
        number = int(since // stored_s)
        if since and since % stored_s == 0:
            x = x * [v, 1, 1, -1, w, tilt, tilt] + [0, (tilt - 1) * x[6], 0, 0, 0, 0, 0]
        here = times[(times > since) & (times <= until)]
        middle = partial(
            slope, (since + until) / 2, direction=(-1) ** number, sigma=sigma_az(since)
        )
        out = solve_ivp(
            lambda t, x, piece=middle: piece(x),
            (since, until),
            x,
            t_eval=np.union1d(here, until),
            rtol=1e-11,
            atol=1e-16,
        )
        found += list(out.y[2][: here.size])
        x = out.y[:, -1]
    return -np.rad2deg(found)


@pytest.mark.nightly
@pytest.mark.parametrize("turn", TURNS)
def test_noise_free_engine_run_matches_integrated_north_channel(turn):
    factors = {"level_time_s": 40.0, "sigma_factors": [1.0, 2.0], "sigma_times_s": [100.0]}
    study = compass_study(turn=turn, compass=factors, study={"record_interval_s": 4.0})
    run = study_run.run(study, curves=True)
    times = run.curves["time_s"].to_numpy()
    simulated = LIMIT_U_DEG - run.curves["phi_u_arcmin"].to_numpy() / 60
    expected = integrated(
        times,
        turn,
        level_s=40.0,
        stored_s=60.0,
        sigma_az=lambda t: 0.02 if t >= 100.0 else 0.01,
    )
    # The east channel's part in the north one is left out of the equations.
    np.testing.assert_allclose(expected, simulated, atol=0.02)
    assert np.ptp(simulated) > 0.2
