"""Many runs in one compiled call.

A study has draws x variants runs, numbered draw by draw (run_id = draw_id * variants + variant_id).
They are laid into the lanes of tiles, tiles follow one another in a chunk, and chunks are computed
by one thread per device:

    runs      d0v0 d0v1 d0v2 d1v0 d1v1 d1v2 d2v0 ...                 (here 3 variants)
               |    |    |    |    |    |    |
    tile 0   [ 0    1    2    3    4    5    6   ...  63 ]  64 lanes, one vectorised scan
    tile 1   [ 0    1    2   ...                      63 ]
      ...                                                   up to 32 tiles: a chunk = one call
    chunk 0, chunk 1, chunk 2, ...      chunk k -> device k mod n, results in the order of chunks

The state of a tile stays in the first-level cache; the tiles of a call follow one another under
`lax.map`. The samples of each draw of a tile are made once and handed to its lanes, so variants
share their noise. On a CPU all threads call one program, elsewhere each that of its device.

If all runs of a variant have the same covariance (`Method.shares_covariance`), tiles of the same
variants and different draws are stacked into sets, which share it: JAX itself finds that it does
not depend on the axis of sets.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import count
from typing import Any, NamedTuple

import jax
import numpy as np

from sinsjax.engine.environment import Static
from sinsjax.engine.lanes import LANES, Group, Lanes, Tiles, curve_lanes, layout, tiles_of
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import map_stacked_tiles, run_tile

CHUNK_TILES = 32
CHUNK_STEPS = 2**28
CHUNK_RECORDS = 2**20
"""Limits of a chunk: tiles; steps, some 15 s of a core; rows of curves, some 100 MB."""

MOST_PROGRAMS = 64
"""Programs that a process keeps, some MB each; the least recently used are dropped first."""

LEAST_CHUNKS = 16
"""Chunks that a group is cut into if it has enough tiles, so that many cores find work."""


class Chunk(NamedTuple):
    """Results of some runs of a group, by draw and variant.

    Attributes:
        draw: (runs,) number of each run's draw in the study.
        variant: (runs,) place of each run's variant in the group.
        outcome: `Outcome` with leaves (runs, ...).
        curves: `Observation` with leaves (runs, records); None without curves.
    """

    draw: np.ndarray
    variant: np.ndarray
    outcome: Outcome
    curves: Any


class Plan:
    """The layout of a group's runs in the lanes of calls of one size.

    Runs keep their order; stacked tiles take a few draws at a time. The plan depends on the group
    alone, never on the machine. The last call is filled up with idle lanes. A call never has a
    single block of tiles, whose loop the compiler would unroll to other bits.
    """

    def __init__(
        self,
        static: Static,
        draws: int,
        variants: int,
        *,
        tiles_per_chunk: int | None = None,
        lanes: int = LANES,
    ) -> None:
        """Lay out a group.

        Args:
            static: its program.
            draws: number of its draws.
            variants: number of its variants.
            tiles_per_chunk: tiles per call, stacked ones counted singly, rounded to two blocks or
                more; None for as many as `CHUNK_TILES` and the other limits allow.
            lanes: runs per tile.
        """
        self._draws, self._variants, self._lanes = draws, variants, lanes
        self._sets, self._width = layout(static, variants, lanes)
        # A block, which cannot be cut, is a tile, or stacked tiles of several draws.
        self._stride = lanes if self._sets == 1 else max(lanes, self._width)
        self._across = self._stride // lanes  # blocks beside one another for the same draws
        blocks = -(-draws * self._width // (self._sets * self._stride)) * self._across
        if tiles_per_chunk is None:
            records = lanes * static.records
            most = min(CHUNK_TILES, CHUNK_STEPS // (records * static.record_every))
            if static.curves:
                most = min(most, CHUNK_RECORDS // records)
            wanted = min(most // self._sets, -(-blocks // LEAST_CHUNKS))
        else:
            wanted = min(tiles_per_chunk // self._sets, blocks)
        self._size = max(2, wanted)
        self._count = -(-blocks // self._size)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, number: int) -> Lanes:
        if not 0 <= number < self._count:
            raise IndexError(number)
        blocks = number * self._size + np.arange(self._size)
        stacks, beside = np.divmod(blocks, self._across)
        draws = stacks[:, None, None] * self._sets + np.arange(self._sets)[:, None]
        places = draws * self._stride + beside[:, None, None] * self._lanes + np.arange(self._lanes)
        return Lanes(places // self._width, places % self._width)

    def __iter__(self) -> Iterator[Lanes]:
        return map(self.__getitem__, range(len(self)))

    @property
    def tiles(self) -> int:
        """Number of tiles in all calls."""
        return self._count * self._size * self._sets

    def active_lanes(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the places of draw and variant of a call's lanes that are not idle, (runs,)."""
        places = self[number]
        active = (places.draw < self._draws) & (places.variant < self._variants)
        return places.draw[active], places.variant[active]

    def count_runs(self, number: int) -> int:
        """Return the number of runs of a call."""
        return len(self.active_lanes(number)[0])

    def call_of(self, draw: int, variant: int) -> int:
        """Return the number of the call that has a run."""
        row, place = divmod(draw * self._width + variant, self._stride)
        block = row // self._sets * self._across + place // self._lanes
        return block // self._size


def plan(group: Group, *, tiles_per_chunk: int | None = None, lanes: int = LANES) -> Plan:
    """Return the `Plan` of a group."""
    return Plan(group.static, *group.sizes, tiles_per_chunk=tiles_per_chunk, lanes=lanes)


def target_devices() -> list[jax.Device | None]:
    """Return the devices that programs are compiled for.

    On a CPU one program serves all threads, at the same speed and with the same bits as one per
    thread; accelerators have one each.
    """
    return [None] if jax.default_backend() == "cpu" else list(jax.local_devices())


class Program:
    """The program of a group for tiles of given shapes, traced when made, compiled on demand.

    Its results have the same bits in every thread.
    """

    def __init__(self, lowered: jax.stages.Lowered) -> None:
        self._lowered: jax.stages.Lowered | None = lowered
        self._compiled: jax.stages.Compiled | None = None
        self._lock = threading.Lock()

    def compiled(self) -> jax.stages.Compiled:
        """Return the compiled program, compiled once for all threads."""
        with self._lock:
            if self._compiled is None:
                assert self._lowered is not None
                self._compiled, self._lowered = self._lowered.compile(), None
            return self._compiled


def trace_program(group: Group, tiles: Tiles, device: jax.Device | None = None) -> Program:
    """Return the program of a group for arguments of these shapes, whatever their values.

    Args:
        group: with an environment of these shapes.
        tiles: of these shapes.
        device: on which it runs; None for the default one.
    """
    leaves, structure = jax.tree.flatten((group.environment, tiles))
    home = None if device is None else jax.sharding.SingleDeviceSharding(device)
    shapes = tuple(
        jax.ShapeDtypeStruct(np.shape(a), np.asarray(a).dtype, sharding=home) for a in leaves
    )
    return _trace(group.static, curve_lanes(group), structure, shapes)


def compile_program(
    group: Group, tiles: Tiles, device: jax.Device | None = None
) -> jax.stages.Compiled:
    """Return `trace_program`, compiled."""
    return trace_program(group, tiles, device).compiled()


@lru_cache(maxsize=MOST_PROGRAMS)
def _trace(static: Static, kept_lanes: int | None, structure: Any, shapes: tuple) -> Program:
    def run_tiles(environment: Any, tiles: Tiles) -> Any:
        one = partial(run_tile, static, environment, curve_lanes=kept_lanes)
        return jax.lax.map(map_stacked_tiles(static, one, tiles), tiles)

    return Program(jax.jit(run_tiles).lower(*jax.tree.unflatten(structure, shapes)))


class _Thread(threading.local):
    """Number of a thread of `map_in_threads`; 0 in all other threads."""

    number = 0


_thread = _Thread()


def map_in_threads(call: Callable[[Any], Any], arguments: Iterable, devices: int) -> Iterator[Any]:
    """Yield the results of calls in order, computed by ``devices`` threads ahead of it."""
    numbers = count()

    def begin() -> None:
        _thread.number = next(numbers)

    with ThreadPoolExecutor(devices, initializer=begin) as pool:
        ahead: deque[Future] = deque()
        for argument in arguments:
            ahead.append(pool.submit(call, argument))
            if len(ahead) > devices:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


class Calls:
    """The calls of a group: its chunks, in any order and from any thread."""

    def __init__(self, group: Group, *, tiles_per_chunk: int | None = None) -> None:
        """Trace the program of a group.

        Args:
            group: the runs.
            tiles_per_chunk: as for `Plan`.
        """
        self._group = group
        self.plan = plan(group, tiles_per_chunk=tiles_per_chunk)
        tiles = tiles_of(group, self.plan[0])
        self._programs = [trace_program(group, tiles, device) for device in target_devices()]
        # Once, and not with every call.
        self._environments = [
            jax.device_put(group.environment, device) for device in target_devices()
        ]

    def compile(self) -> None:
        """Compile all programs now rather than with the first chunk."""
        for compilable in self._programs:
            compilable.compiled()

    def chunk(self, number: int) -> Chunk:
        """Run one call of the plan, on the device of the calling thread."""
        group, places = self._group, self.plan[number]
        draws, variants = group.sizes
        home = _thread.number % len(self._programs)
        call, environment = self._programs[home].compiled(), self._environments[home]
        outcome, curves = jax.device_get(call(environment, tiles_of(group, places)))
        draw, variant = places.draw.ravel(), places.variant.ravel()
        active = np.flatnonzero((draw < draws) & (variant < variants))
        runs = active[np.argsort(draw[active] * variants + variant[active])]
        tile, lane = np.divmod(runs, places.draw.shape[-1])
        axes = 1 + (places.draw.shape[1] > 1)  # of tiles, and of sets
        outcome, curves = (
            jax.tree.map(lambda a: a.reshape(-1, *a.shape[axes:]), tree)
            for tree in (outcome, curves)
        )
        return Chunk(
            group.draws.draw_id[draw[runs]],
            variant[runs],
            jax.tree.map(lambda a: a[tile, lane], outcome),
            jax.tree.map(lambda a: a[tile, ..., lane], curves),
        )


def run_chunks(
    group: Group, *, devices: int = 1, tiles_per_chunk: int | None = None
) -> Iterator[Chunk]:
    """Run a group, chunk by chunk.

    Args:
        group: the runs.
        devices: number of chunks computed at a time.
        tiles_per_chunk: as for `Plan`.

    Yields:
        Results in the order of the plan.
    """
    calls = Calls(group, tiles_per_chunk=tiles_per_chunk)
    calls.compile()
    yield from map_in_threads(calls.chunk, range(len(calls.plan)), devices)
