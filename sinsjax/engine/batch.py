"""Many runs in one compiled call.

Runs are numbered draw by draw (`run_id = draw_id * variants + variant_id`) and cut into tiles of
64 lanes. A tile is one vectorised scan whose state stays in the first-level cache; in a call tiles
follow one another under `lax.map`. Threads make calls: on a CPU all of one program, elsewhere each
of the program of its own device. Samples are made once for each distinct draw of a tile and handed
to its lanes, so that variants share their noise.

Where the covariance is the same for all runs of a variant (`Method.common_covariance`), tiles of
the same variants and different draws are stacked into sets, which share it: JAX finds by itself
that it does not depend on what the sets are mapped over.
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

from sinsjax.engine.covariance import Spread
from sinsjax.engine.lanes import LANES, Group, Lanes, Tiles, layout, shown, tiles_of
from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.engine.realisations import Environment, Static
from sinsjax.engine.tile import over_stacked_tiles, run_tile

CHUNK_TILES = 32
CHUNK_STEPS = 2**28
CHUNK_RECORDS = 2**20
"""The most that a chunk has: tiles; steps, some 15 s of a core; rows of curves, some 100 MB."""

MOST_PROGRAMS = 64
"""Programs that a process keeps, some MB each; the least recently used go first."""

LEAST_CHUNKS = 16
"""Chunks that a group is cut into if it has the tiles for them, so that many cores find work."""


class Chunk(NamedTuple):
    """Results of some runs of a group, by draw and variant.

    Attributes:
        draw: (runs,) number of each run's draw in the study.
        variant: (runs,) place of each run's variant in the group.
        outcome: `Outcome` with leaves (runs, ...).
        curves: `Observation` with leaves (runs, records), or `Spread` with leaves (runs, ...),
            or None.
    """

    draw: np.ndarray
    variant: np.ndarray
    outcome: Outcome
    curves: Observation | Spread | None


class Plan:
    """The runs of a group laid into the lanes of calls of one size.

    In their order; where tiles are stacked, a few draws at a time. Depends on the group alone,
    never on the machine. What is missing at the end is filled up with idle lanes. A call is never
    given a single block of tiles, whose loop the compiler would unroll to other bits.
    """

    def __init__(
        self,
        static: Static,
        draws: int,
        variants: int,
        *,
        tiles_a_chunk: int | None = None,
        lanes: int = LANES,
    ) -> None:
        """Cut a group.

        Args:
            static: its program.
            draws: how many it has.
            variants: how many it has.
            tiles_a_chunk: tiles a call, stacked ones counted singly, as far as two blocks or more
                make them; None takes what `CHUNK_TILES` and the other limits allow.
            lanes: runs a tile.
        """
        self._draws, self._variants, self._lanes = draws, variants, lanes
        self._sets, self._width = layout(static, variants, lanes)
        # A block, which cannot be cut, is a tile, or the stacked ones of several draws.
        self._stride = lanes if self._sets == 1 else max(lanes, self._width)
        self._across = self._stride // lanes  # blocks beside one another for the same draws
        blocks = -(-draws * self._width // (self._sets * self._stride)) * self._across
        if tiles_a_chunk is None:
            records = lanes * static.records
            most = min(CHUNK_TILES, CHUNK_STEPS // (records * static.record_every))
            if static.curves:
                most = min(most, CHUNK_RECORDS // records)
            wanted = min(most // self._sets, -(-blocks // LEAST_CHUNKS))
        else:
            wanted = min(tiles_a_chunk // self._sets, blocks)
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
        """How many tiles all its calls have."""
        return self._count * self._size * self._sets

    def busy(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Places of draw and variant in the lanes of a call that are not idle, (runs,) each."""
        places = self[number]
        busy = (places.draw < self._draws) & (places.variant < self._variants)
        return places.draw[busy], places.variant[busy]

    def runs(self, number: int) -> int:
        """How many runs a call has."""
        return len(self.busy(number)[0])

    def call_of(self, draw: int, variant: int) -> int:
        """The number of the call that has a run."""
        row, place = divmod(draw * self._width + variant, self._stride)
        block = row // self._sets * self._across + place // self._lanes
        return block // self._size


def plan(group: Group, *, tiles_a_chunk: int | None = None, lanes: int = LANES) -> Plan:
    """How the runs of a group are cut into calls, see `Plan`."""
    return Plan(group.static, *group.sizes, tiles_a_chunk=tiles_a_chunk, lanes=lanes)


def targets() -> list[jax.Device | None]:
    """The devices that programs are compiled for.

    On a CPU one program serves all threads, at the same speed and with the same bits as one each;
    accelerators have one each.
    """
    return [None] if jax.default_backend() == "cpu" else list(jax.local_devices())


class Program:
    """What `run_tile` becomes for tiles of some shapes: traced when made, compiled when asked for.

    It gives the same bits whatever thread calls it.
    """

    def __init__(self, lowered: jax.stages.Lowered) -> None:
        self._lowered: jax.stages.Lowered | None = lowered
        self._compiled: jax.stages.Compiled | None = None
        self._lock = threading.Lock()

    def compiled(self) -> jax.stages.Compiled:
        """The compiled program; XLA compiles it once, for the first who asks."""
        with self._lock:
            if self._compiled is None:
                assert self._lowered is not None
                self._compiled, self._lowered = self._lowered.compile(), None
            return self._compiled


def program(
    static: Static,
    environment: Environment,
    tiles: Tiles,
    shown: int | None = None,
    device: jax.Device | None = None,
) -> Program:
    """The program for arguments of these shapes, whatever their values.

    Args:
        static: what decides it.
        environment: of these shapes.
        tiles: of these shapes.
        shown: lanes of a tile whose curves are returned, see `run_tile`.
        device: that it runs on; None for the default one.
    """
    leaves, structure = jax.tree.flatten((environment, tiles))
    home = None if device is None else jax.sharding.SingleDeviceSharding(device)
    shapes = tuple(
        jax.ShapeDtypeStruct(np.shape(a), np.asarray(a).dtype, sharding=home) for a in leaves
    )
    return _trace(static, shown, structure, shapes)


def compiled(
    static: Static, environment: Environment, tiles: Tiles, device: jax.Device | None = None
) -> jax.stages.Compiled:
    """`program`, compiled."""
    return program(static, environment, tiles, device).compiled()


@lru_cache(maxsize=MOST_PROGRAMS)
def _trace(static: Static, shown: int | None, structure: Any, shapes: tuple) -> Program:
    def run_tiles(environment: Environment, tiles: Tiles) -> Any:
        one = partial(run_tile, static, environment, shown=shown)
        return jax.lax.map(over_stacked_tiles(static, one, tiles), tiles)

    return Program(jax.jit(run_tiles).lower(*jax.tree.unflatten(structure, shapes)))


class _Thread(threading.local):
    """The number of a thread of `in_threads`; 0 of any other."""

    number = 0


_thread = _Thread()


def in_threads(call: Callable[[Any], Any], arguments: Iterable, devices: int) -> Iterator[Any]:
    """Results of calls in their order, with ``devices`` of them under way, a thread each."""
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
    """The calls of a group: its chunks, any of them in any order and from any thread."""

    def __init__(self, group: Group, *, tiles_a_chunk: int | None = None) -> None:
        """Trace the program of a group.

        Args:
            group: what to run.
            tiles_a_chunk: as for `Plan`.
        """
        self._group = group
        self.plan = plan(group, tiles_a_chunk=tiles_a_chunk)
        arguments = group.static, group.environment, tiles_of(group, self.plan[0]), shown(group)
        self._programs = [program(*arguments, device) for device in targets()]
        # Once, and not with every call.
        self._environments = [jax.device_put(group.environment, device) for device in targets()]

    def compile(self) -> None:
        """Compile what the first chunk would else compile; Python is idle meanwhile."""
        for one in self._programs:
            one.compiled()

    def whole(self) -> Chunk:
        """All chunks as one, by draw and variant."""
        found = [self.chunk(number) for number in range(len(self.plan))]
        made: Chunk = jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
        order = np.lexsort((made.variant, made.draw))
        ordered: Chunk = jax.tree.map(lambda a: a[order], made)
        return ordered

    def chunk(self, number: int) -> Chunk:
        """Run one of the plan's calls, on the device of the thread that asks."""
        group, places = self._group, self.plan[number]
        draws, variants = group.sizes
        home = _thread.number % len(self._programs)
        call, environment = self._programs[home].compiled(), self._environments[home]
        outcome, curves = jax.device_get(call(environment, tiles_of(group, places)))
        draw, variant = places.draw.ravel(), places.variant.ravel()
        busy = np.flatnonzero((draw < draws) & (variant < variants))
        runs = busy[np.argsort(draw[busy] * variants + variant[busy])]
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


def chunks(group: Group, *, devices: int = 1, tiles_a_chunk: int | None = None) -> Iterator[Chunk]:
    """Run a group, chunk by chunk.

    Args:
        group: what to run.
        devices: how many chunks are under way at a time.
        tiles_a_chunk: as for `Plan`.

    Yields:
        Results in the order of the plan.
    """
    calls = Calls(group, tiles_a_chunk=tiles_a_chunk)
    calls.compile()
    yield from in_threads(calls.chunk, range(len(calls.plan)), devices)
