"""Benchmark workloads: the compiled function of `sweep`, and a plain NumPy loop.

All methods use the base motion and sensors of the default sweep.
"""

import time
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from sinsjax.bench.baseline import AlignmentSettings, align_with_numpy_loop
from sinsjax.bench.timing import Workload
from sinsjax.engine.batch import compile_program, map_in_threads, plan
from sinsjax.engine.build import parts
from sinsjax.engine.environment import Draw, RunParams
from sinsjax.engine.lanes import LANES, STACKED_TILES, Group, Tiles, tiles_of
from sinsjax.engine.run import run_tile
from sinsjax.maths.rotations import matrix, misalign
from sinsjax.methods.registry import METHODS, unread_keys
from sinsjax.platform.assets import asset_path
from sinsjax.study.load import load_study, study_from_dict
from sinsjax.toml_text import parse_toml
from sinsjax.types import Quat

TILES = 2
"""Tiles per call: two at least, since the compiler unrolls the loop over a single one."""

RECORD_S = 80.0
"""Length of a stored record, as in [P2]."""

_BASELINE_SAMPLES = 2000

_DEFAULT = "configs/reset_sweep.toml"
_SIGMAS: dict[str, list[float]] = {
    "level_sigma_per_s": [0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06],
    "azimuth_sigma_per_s": [0.01, 0.012, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05],
}

_MOTION_RANGES = {
    "yaw_center_deg": [0.0, 360.0],
    "pitch_amplitude_deg": [1.0, 3.0],
    "roll_period_s": [6.0, 10.0],
    "yaw_phase_deg": [-180.0, 180.0],
}
"""Base motion and orientation keys with a value per draw, and their ranges."""


@cache
def default_group() -> Group:
    """The group of runs of the default sweep, ``configs/reset_sweep.toml``."""
    (part,) = parts(load_study(asset_path(_DEFAULT)))
    return part.group


@cache
def method_group(method: str) -> Group:
    """The default sweep with another method, without the keys that the method does not read.

    A method that no swept key acts on has a single variant a draw, and draws enough for a call.
    """
    data = parse_toml(asset_path(_DEFAULT).read_text("utf-8"))
    if METHODS[method].gyro_bias_keys or not METHODS[method].has_floor:
        data["study"]["judged_from"] = "truth"  # the method has no bias floor on a moving base
    data["alignment"]["method"] = method
    unread = unread_keys([method]) | {*METHODS[method].without_effect}
    data = {
        section: {key: value for key, value in table.items() if key not in unread}
        for section, table in data.items()
    }
    if not data["axes"]:
        data["study"]["draws"] = _draw_count(1)
    (part,) = parts(study_from_dict({k: v for k, v in data.items() if v}, _DEFAULT))
    return part.group


@cache
def trigger_group() -> Group:
    """The default sweep with the `linearisation` trigger, and the same number of variants."""
    data = parse_toml(asset_path(_DEFAULT).read_text("utf-8"))
    for key in ("reset_count", "reset_cycle_s"):
        del data["axes"][key]
    data["resets"] = {"reset_trigger": "linearisation"}
    data["axes"] |= {
        "trigger_threshold": [1.1, 1.15, 1.2, 1.25, 1.3, 1.4, 1.5],
        "trigger_refractory_s": [1, 2, 3, 4, 5, 6, 8, 10],
    }
    (part,) = parts(study_from_dict(data, _DEFAULT))
    return part.group


@cache
def compass_group(record_s: float | None = None) -> Group:
    """The default sweep with compass loops: as many variants, of sigmas instead of resets.

    Args:
        record_s: length of the stored record for repeated passes, s; None for a single pass.
    """
    data = parse_toml(asset_path(_DEFAULT).read_text("utf-8"))
    for section, keys in (
        ("alignment", ("specific_force", "feedback_interval_s")),
        ("axes", ("reset_count", "reset_cycle_s")),
    ):
        for key in keys:
            del data[section][key]
    del data["filter"], data["resets"]
    data["study"]["judged_from"] = "truth"  # a pass is too short for a bias floor
    data["alignment"]["method"] = "compass"
    data["axes"] |= _SIGMAS
    if record_s is not None:
        data["passes"] = {"stored_s": record_s}
    (part,) = parts(study_from_dict(data, _DEFAULT))
    return part.group


def remove_noise(group: Group) -> Group:
    """The group without sensor noise."""
    model, static = group.environment.sensors, group.static
    quiet = model.errors._replace(gyro_noise=np.zeros(3), accel_noise=np.zeros(3))
    return group._replace(
        static=static._replace(sensors=static.sensors._replace(noisy=False)),
        environment=group.environment._replace(sensors=model._replace(errors=quiet)),
    )


def shared_covariance_group(group: Group) -> Group:
    """A tenth of the group's duration, with A(t) of a base at rest: draws share a covariance.

    Calls are large: all variants of several draws.
    """
    options = group.static.options._replace(specific_force="gravity")
    group = group._replace(static=group.static._replace(options=options))
    return shorten_runs(group, max(2, group.static.records // 10))


def set_feedback_every_sample(group: Group) -> Group:
    """The group with feedback at every sample."""
    method = group.variants.method
    ones = np.ones_like(method.feedback.every)
    method = method._replace(feedback=method.feedback._replace(every=ones))
    return group._replace(variants=group.variants._replace(method=method))


def select_last_variants(group: Group, n_variants: int, min_runs: int = 0) -> Group:
    """The group with its last variants only, and enough draws for `TILES` and a number of runs."""
    draws = _draw_count(n_variants, min_runs)
    return group._replace(
        variants=_last_variants(group, n_variants),
        draws=Draw(np.arange(draws), np.asarray(0), np.zeros(draws, int)),
        q=np.tile(group.q[:1], (draws, 1)),
    )


_DISTURBED: Mapping[str, Mapping[str, Any]] = {
    "motion": {"surge_m_per_s": 0.1, "lever_arm_m": 1.0},
    "sensors": {"gyro_instability_deg_per_h": 0.01, "accel_instability_ug": 10.0},
}


@cache
def disturbed_group(n_variants: int) -> Group:
    """`select_last_variants` of the default sweep with surge, a lever arm and bias instability."""
    data = parse_toml(asset_path(_DEFAULT).read_text("utf-8"))
    for name, keys in _DISTURBED.items():
        data[name] |= keys
    (part,) = parts(study_from_dict(data, _DEFAULT))
    return select_last_variants(part.group, n_variants)


@cache
def drawn_motion_group(n_variants: int) -> Group:
    """`select_last_variants` of the default sweep with a different base motion for each draw."""
    data = parse_toml(asset_path(_DEFAULT).read_text("utf-8"))
    data["study"]["draws"] = _draw_count(n_variants)
    for key in _MOTION_RANGES:
        data["motion"].pop(key, None)
    data["drawn"] = {"sampling": "random"} | {
        key: {"uniform": ends} for key, ends in _MOTION_RANGES.items()
    }
    (part,) = parts(study_from_dict(data, _DEFAULT))
    return part.group._replace(variants=_last_variants(part.group, n_variants))


def _draw_count(n_variants: int, min_runs: int = 0) -> int:
    return max(min_runs, TILES * STACKED_TILES * max(LANES, n_variants)) // n_variants + 1


def _last_variants(group: Group, n_variants: int) -> RunParams:
    variants: RunParams = jax.tree.map(lambda a: a[-n_variants:], group.variants)
    return variants


def shorten_runs(group: Group, records: int) -> Group:
    """The group with shorter runs, in record intervals."""
    return group._replace(static=group.static._replace(records=records))


def engine_workload(
    name: str, group: Group, *, tiles: int = TILES, lanes: int = LANES, devices: int = 1
) -> Workload:
    """The compiled function of `sweep` on its first call for a group.

    Args:
        name: name of the row.
        group: group to run; with too few runs for the call, lanes stay idle.
        tiles: tiles per call, at least.
        lanes: runs per tile.
        devices: number of devices, with one simultaneous call each.
    """
    draws, variants = group.sizes
    calls = plan(group, tiles_per_chunk=tiles, lanes=lanes)
    places = [calls[i % len(calls)] for i in range(devices)]
    runs = sum(int(np.sum((p.draw < draws) & (p.variant < variants))) for p in places)
    arguments = [(group.environment, tiles_of(group, p)) for p in places]
    since = time.perf_counter()
    program = compile_program(group, arguments[0][1])
    compile_s = time.perf_counter() - since
    placed = jax.device_put(arguments)

    def one(arguments: tuple[Any, Tiles]) -> None:
        jax.block_until_ready(program(*arguments))

    # One device is timed in CPU time, which excludes other processes on the machine.
    clock = time.process_time if devices == 1 else time.perf_counter

    def call() -> float:
        since = clock()
        list(map_in_threads(one, placed, devices))
        return clock() - since

    call()
    steps = group.static.records * group.static.record_every
    return Workload(name, runs, steps, compile_s, call, devices=devices)


def numpy_baseline_workload(group: Group) -> Workload:
    """The first run of a noise-free group as a plain NumPy loop, checked against the engine."""
    increments, start, setting = first_run_arguments(group)
    increments = increments[:_BASELINE_SAMPLES]
    _check_baseline(group, align_with_numpy_loop(increments, start, setting)[0])

    def call() -> float:
        since = time.process_time()
        align_with_numpy_loop(increments, start, setting)
        return time.process_time() - since

    return Workload("numpy_baseline", 1, _BASELINE_SAMPLES, 0.0, call)


def first_run_arguments(group: Group) -> tuple[np.ndarray, np.ndarray, AlignmentSettings]:
    """The first run of a noise-free group, as the arguments of `align_with_numpy_loop`."""
    model, place = group.environment.sensors, group.environment.site.place
    dt = group.static.options.dt
    bias = np.concatenate([model.errors.gyro_bias, model.errors.accel_bias])
    params = _first_run_params(group)
    method = params.method
    setting = AlignmentSettings(
        dt=dt,
        rate_n=float(place.rate_n),
        rate_u=float(place.rate_u),
        tan_latitude=float(place.tan_latitude),
        radius=float(1 / place.curvature_n),
        p0=np.array(method.p0),
        q=np.array(method.q),
        r=float(method.r),
        feedback_every=int(method.feedback.every),
        resets=tuple(int(n) for n in method.resets.samples if np.isfinite(n)),
    )
    start: np.ndarray = np.array(matrix(misalign(params.phi, params.q)))
    return np.asarray(model.increments) + bias * dt, start, setting


def _first_run_params(group: Group) -> RunParams:
    first = jax.tree.map(lambda a: np.asarray(a)[0], group.variants)
    return first._replace(q=Quat(*group.q[0]))


def _check_baseline(group: Group, c_nb: np.ndarray) -> None:
    """Check that the baseline reproduces the engine's attitude, or its time is meaningless."""
    static = group.static._replace(records=_BASELINE_SAMPLES // group.static.record_every)
    draw = jax.tree.map(lambda a: np.asarray(a).ravel()[:1], group.draws)
    params = jax.tree.map(lambda a: np.asarray(a)[None], _first_run_params(group))
    tile = Tiles(draw, np.zeros(1, np.int32), params)
    outcome, _ = jax.jit(partial(run_tile, static))(group.environment, tile)
    last = outcome.last
    engine_attitude = np.array([last.pitch[0], last.roll[0], last.yaw[0]])
    baseline_attitude = np.array(
        [
            np.arcsin(c_nb[2, 1]),
            np.arctan2(-c_nb[2, 0], c_nb[2, 2]),
            np.arctan2(-c_nb[0, 1], c_nb[1, 1]),
        ]
    )
    if not np.allclose(engine_attitude, baseline_attitude, atol=1e-9):
        raise RuntimeError(
            "the NumPy baseline and the engine differ:"
            f" {baseline_attitude} and {engine_attitude} rad"
        )


def _default_group_without_noise() -> Group:
    return remove_noise(default_group())


def _compass_workload(name: str, record_s: float | None = None) -> Workload:
    return engine_workload(name, remove_noise(compass_group(record_s)))


def _noisy_workload(variants: int) -> Workload:
    return engine_workload(
        f"kalman_noise_{variants}", select_last_variants(default_group(), variants)
    )


SHORT: dict[str, Callable[[], Workload]] = {
    "kalman_shared_record": lambda: engine_workload(
        "kalman_shared_record", _default_group_without_noise()
    ),
    "kalman_noise_64": lambda: _noisy_workload(64),
    "kalman_noise_6": lambda: _noisy_workload(6),
    "kalman_noise_1": lambda: _noisy_workload(1),
    "kalman_shared_covariance": lambda: engine_workload(
        "kalman_shared_covariance", shared_covariance_group(_default_group_without_noise())
    ),
    "compass_shared_record": lambda: _compass_workload("compass_shared_record"),
    "compass_stored_tape": lambda: _compass_workload("compass_stored_tape", RECORD_S),
    "numpy_baseline": lambda: numpy_baseline_workload(_default_group_without_noise()),
}
"""The short set: functions that give each row, by name and in order."""
