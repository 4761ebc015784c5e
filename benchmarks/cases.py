"""What is timed: the compiled function of `sweep`, with base and sensors of the default sweep."""

import time
import tomllib
from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import numpy as np
from timing import Workload

from sinsjax.engine.batch import LANES, STACKED_TILES, Batch, map_in_threads, trace_program
from sinsjax.engine.inputs import Draw, Tiles
from sinsjax.engine.scenario import Scenario
from sinsjax.methods.registry import METHODS, unread_keys
from sinsjax.platform.files import asset_path
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import study_from_dict

TILES = 2
"""Tiles per call: two at least, since the compiler unrolls the loop over a single one."""

RECORD_S = 80.0
"""Length of a stored record, as in [P2]."""

_DEFAULT = "configs/reset_sweep.toml"
_SIGMAS = {
    "level_sigma_per_s": [0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06],
    "azimuth_sigma_per_s": [0.01, 0.012, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05],
}


def _default_tables() -> TomlTable:
    return tomllib.loads(asset_path(_DEFAULT).read_text("utf-8"))


def _group_of(tables: TomlTable) -> Batch:
    return Scenario(study_from_dict(tables, _DEFAULT)).batch(0)


@cache
def default_group() -> Batch:
    """The group of runs of the default sweep, ``configs/reset_sweep.toml``."""
    return _group_of(_default_tables())


@cache
def method_group(method: str) -> Batch:
    """The default sweep with another method, without the keys that the method does not read."""
    data = _default_tables()
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
    return _group_of({k: v for k, v in data.items() if v})


@cache
def compass_group(record_s: float | None = None) -> Batch:
    """The default sweep with compass loops, over a stored record of this length if given."""
    data = _default_tables()
    del data["alignment"]["specific_force"], data["alignment"]["feedback_interval_s"]
    del data["axes"]["reset_count"], data["axes"]["reset_cycle_s"], data["filter"], data["resets"]
    data["study"]["judged_from"] = "truth"  # a pass is too short for a bias floor
    data["alignment"]["method"] = "compass"
    data["axes"] |= _SIGMAS
    if record_s is not None:
        data["passes"] = {"stored_s": record_s}
    return _group_of(data)


def remove_noise(group: Batch) -> Batch:
    """The group without sensor noise."""
    environment = group.environment
    quiet = environment.errors._replace(gyro_noise=np.zeros(3), accel_noise=np.zeros(3))
    return group._replace(
        spec=group.spec._replace(noisy=False),
        environment=environment._replace(errors=quiet),
    )


def shared_covariance_group(group: Batch) -> Batch:
    """A tenth of the group's duration, with A(t) of a base at rest: draws share a covariance."""
    options = group.spec.options._replace(specific_force="gravity")
    group = group._replace(spec=group.spec._replace(options=options))
    return shorten_runs(group, max(2, group.spec.intervals // 10))


def set_feedback_every_sample(group: Batch) -> Batch:
    """The group with feedback at every sample."""
    method = group.params.method
    ones = np.ones_like(method.feedback.every)
    method = method._replace(feedback=method.feedback._replace(every=ones))
    return group._replace(params=group.params._replace(method=method))


def select_last_variants(group: Batch, n_variants: int) -> Batch:
    """The group with its last variants only, and enough draws for `TILES`."""
    draws = _draw_count(n_variants)
    q = jax.tree.map(lambda a: np.full(draws, a[0]), group.draws.q)
    return group._replace(
        params=jax.tree.map(lambda a: a[-n_variants:], group.params),
        draws=Draw(np.arange(draws), np.asarray(0), np.zeros(draws, int), q),
    )


def _draw_count(n_variants: int) -> int:
    return TILES * STACKED_TILES * max(LANES, n_variants) // n_variants + 1


def shorten_runs(group: Batch, records: int) -> Batch:
    """The group with shorter runs, in record intervals."""
    return group._replace(spec=group.spec._replace(intervals=records))


def engine_workload(
    name: str, group: Batch, *, tiles: int = TILES, lanes: int = LANES, devices: int = 1
) -> Workload:
    """The compiled function of `sweep` on its first calls for a group, one a device."""
    layout = group.lay_out(tiles_per_chunk=tiles, lanes=lanes)
    chunks = [i % len(layout) for i in range(devices)]
    runs = sum(len(layout.active(chunk).lane) for chunk in chunks)
    arguments = [
        (group.environment, layout.tiles_of_chunk(group, chunk), np.int32(layout.blocks(chunk)))
        for chunk in chunks
    ]
    since = time.perf_counter()
    program = trace_program(group, layout).compiled()
    compile_s = time.perf_counter() - since
    placed = jax.device_put(arguments)

    def one(arguments: tuple[Any, Tiles, np.int32]) -> None:
        jax.block_until_ready(program(*arguments))

    # One device is timed in CPU time, which excludes other processes on the machine.
    clock = time.process_time if devices == 1 else time.perf_counter

    def call() -> float:
        since = clock()
        list(map_in_threads(one, placed, devices))
        return clock() - since

    call()
    steps = group.spec.intervals * group.spec.interval_samples
    return Workload(name, runs, steps, compile_s, call, devices=devices)


def _silent(name: str, group: Batch) -> Workload:
    return engine_workload(name, remove_noise(group))


def _noisy(name: str, variants: int) -> Workload:
    return engine_workload(name, select_last_variants(default_group(), variants))


SHORT: dict[str, Callable[[], Workload]] = {
    "kalman_shared_record": lambda: _silent("kalman_shared_record", default_group()),
    "kalman_noise_64": lambda: _noisy("kalman_noise_64", 64),
    "kalman_noise_6": lambda: _noisy("kalman_noise_6", 6),
    "kalman_noise_1": lambda: _noisy("kalman_noise_1", 1),
    "kalman_shared_covariance": lambda: _silent(
        "kalman_shared_covariance", shared_covariance_group(default_group())
    ),
    "compass_shared_record": lambda: _silent("compass_shared_record", compass_group()),
    "compass_stored_tape": lambda: _silent("compass_stored_tape", compass_group(RECORD_S)),
}
"""The short set: functions that give each row, by name and in order."""
