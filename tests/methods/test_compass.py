"""Compass loops: their design, their keys, and the same loops written naively."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.in_engine import ARCMIN, DEG_PER_H, PAPER2, UG, follow, loops, site
from oracles.in_engine import swing_increments as record_of
from oracles.naive import (
    DEG,
    SECOND_PAPER,
    WGS84,
    Loops,
    azimuth_gains,
    compass_loop,
    exp,
    level_gains,
    of_quaternion,
)
from support.batches import batch_of
from support.studies import with_paper_values

from sinsjax.methods import compass as design
from sinsjax.methods.compass import REVERSALS
from sinsjax.methods.method import Options
from sinsjax.study.load import study_from_dict

EARTH = SECOND_PAPER
G, R = EARTH.gravity, EARTH.a
G_AND_R = {"gravity": G, "radius": R}

# Design

sigmas, dampings = st.floats(1e-3, 1.0), st.floats(0.1, 1.0)


@given(sigmas, dampings)
def test_gains_place_the_designed_roots(sigma, damping):
    wd = sigma * np.sqrt(1 / damping**2 - 1)
    pair = [-sigma + 1j * wd, -sigma - 1j * wd]
    level = design.level_gains(sigma, damping, **G_AND_R)
    found = [1, level.k1, (1 + level.k2) * G / R, G * level.k3]
    np.testing.assert_allclose(found, np.poly([-sigma, *pair]), rtol=1e-9)
    k1, k2, k3, k4 = design.azimuth_gains(sigma, damping, **G_AND_R)
    found = np.polymul([1, k4, 0], [1, k1, (1 + k2) * G / R]) + [0, 0, 0, 0, G * k3]
    np.testing.assert_allclose(found, np.poly(pair * 2), rtol=1e-9)


@given(sigmas, dampings, st.floats(0.1, 10))
def test_at_pace_scales_sigma(sigma, damping, pace):
    gains = design.scale_azimuth_gains(design.azimuth_gains(sigma, damping, **G_AND_R), pace)
    expected = design.azimuth_gains(pace * sigma, damping, **G_AND_R)
    np.testing.assert_allclose(gains, expected, rtol=1e-11)


# Keys


def numbers(**tables):
    """The params of the variants of a study, leaves (variants, ...)."""
    data = {
        "study": {"duration_s": 20.0, "rate_hz": 100.0, "draws": 1, "window_s": [4, 6]},
        "earth": {"latitude_deg": 32.057313, "radius_m": R},
        "motion": {"yaw_center_deg": 0.0},
        "alignment": {"method": "compass"},
    }
    return batch_of(study_from_dict(with_paper_values(data | tables))).params.method


def test_gains_are_those_of_sigma_and_damping_or_given():
    """By default those of [P2] section 3.1, whose K3 of the level is 50 times what it should be."""
    printed = [0.06, 1040.33306122, 0.000081632653], [0.02, 259.3332653, 4.082e-9, 0.02]
    made = numbers()
    np.testing.assert_allclose(made.level[:2], np.transpose([printed[0][:2]]), rtol=5e-11)
    np.testing.assert_allclose(made.level.k3, printed[0][2] / 50, rtol=1e-8)
    np.testing.assert_allclose(made.azimuth, np.transpose([printed[1]]), rtol=1e-4)
    of_azimuth = {"azimuth_sigma_per_s": 0.02, "azimuth_damping": 0.8}
    made = numbers(compass={"level_gains": printed[0]} | of_azimuth)
    np.testing.assert_allclose(np.ravel(made.level), printed[0])
    np.testing.assert_allclose(np.ravel(made.azimuth), design.azimuth_gains(0.02, 0.8, **G_AND_R))


# Runs


def close(got, expected, tolerance):
    """To a tolerance of the largest expected value."""
    assert np.abs(got - expected).max() < tolerance * np.abs(expected).max()


RATE, PASS = 100, 600
ERRORS = {
    "gyro": ((0.2 * DEG_PER_H, -0.1 * DEG_PER_H, 0.3 * DEG_PER_H), 0.2 * DEG_PER_H),
    "accel": ((1e1 * UG, -5e0 * UG, 3e1 * UG), 1e1 * UG),
}


@pytest.mark.nightly(fast=("reflect-integrated",))
@pytest.mark.parametrize(
    ("planet", "latitude_deg", "position"),
    [(EARTH, 32.0, "fixed"), (WGS84, -41.0, "integrated")],
    ids=["fixed", "integrated"],
)
@pytest.mark.parametrize("rule", REVERSALS)
def test_three_compass_passes_match_naive_loop(rule, planet, latitude_deg, position):
    """Forward, backward, forward over 6 s of swing, azimuth taking over within the first pass."""
    phi, v = np.array([0.1, -0.2, 5]) * ARCMIN, np.array([3e-4, -2e-4])
    latitude, azimuth = latitude_deg * DEG, ((330, azimuth_gains(0.1, EARTH)),)
    rows = record_of(PAPER2, planet, latitude, rate=RATE, samples=PASS, **ERRORS)
    given = Loops(level_gains(0.2, EARTH), azimuth, 0.01, rule, position)
    case = {"latitude": latitude, "c": exp(-phi) @ PAPER2.matrix(0.0), "v": v, "loops": given}
    naive = compass_loop(rows, 1 / RATE, planet, stored=PASS, count=1800, **case)
    options = Options(1 / RATE, position=position)
    params = loops(given, REVERSALS[rule])
    passes = {"every": 50, "records": 36, "stored": PASS // 50}
    here, start = site(planet, latitude), (PAPER2.matrix(0.0), phi, v)
    state = follow("compass", params, rows, here, start, options=options, **passes)
    at = np.arange(50, 1801, 50) - 1
    np.testing.assert_allclose(
        of_quaternion(np.stack(state.nav.q, axis=1)), naive.c[at], rtol=0, atol=1e-11
    )
    close(np.stack([state.nav.ve, state.nav.vn], axis=1), naive.v[at], 1e-10)
    close(np.stack([state.integral_e, state.integral_n], axis=1), naive.integral[at], 1e-10)
    force = np.moveaxis([state.force_e, state.force_n], -1, 0)  # records, axes, stages
    close(force.swapaxes(1, 2), naive.force[at], 1e-10)
    close(state.rate_u, naive.rate[at], 1e-10)
    np.testing.assert_allclose(state.nav.latitude, naive.latitude[at], rtol=0, atol=1e-15)
    np.testing.assert_allclose(state.nav.longitude, naive.longitude[at], rtol=0, atol=1e-15)
