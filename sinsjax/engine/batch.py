"""Many runs in one compiled call.

A study has draws x variants runs, numbered draw by draw (run_id = draw_id * variants + variant_id).
A `Batch` holds those that share a compiled program and an environment. They are laid into the lanes
of tiles, tiles follow one another in a chunk, and chunks are computed by one thread per device:

    runs      d0v0 d0v1 d0v2 d1v0 d1v1 d1v2 d2v0 ...                 (here 3 variants)
               |    |    |    |    |    |    |
    tile 0   [ 0    1    2    3    4    5    6   ...  63 ]  64 lanes, one vectorised scan
    tile 1   [ 0    1    2   ...                      63 ]
      ...                                                   up to 32 tiles: a chunk = one call
    chunk 0, chunk 1, chunk 2, ...      chunk k -> device k mod n, results in the order of chunks

The state of a tile stays in the first-level cache; those of a call that have runs are computed one
after another. The samples of each draw of a tile are made once and handed to its lanes, so variants
share their noise. On a CPU all threads call one program, elsewhere each that of its device.

If all runs of a variant have the same covariance (`Program.shares_covariance`), tiles of the same
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

from sinsjax.engine.inputs import Draw, Environment, ProgramSpec, RunParams, Tiles
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import map_tiles, run_tile
from sinsjax.types import Count

LANES = 64
"""Runs per tile. Results are bit-equal for any chunk and device count only at one lane count."""

STACKED_TILES = 8
"""Tiles that share one covariance; like `LANES`, it decides the last bits."""

MOST_IDLE = 1 / 8
"""Largest share of idle lanes in a draw's last tile; beyond it another draw is put there."""

VECTOR = 16
"""Single-precision numbers in the widest vector of a CPU."""

CHUNK_TILES = 32
CHUNK_STEPS = 2**28
CHUNK_RECORDS = 2**20
"""Limits of a chunk: tiles; steps, some 15 s of a core; rows of curves, some 100 MB."""

LEAST_SAVED = 1 / 4
"""Share of its tiles that a program must save by computing one of duplicate variants."""

MOST_PROGRAMS = 64
"""Programs that a process keeps, some MB each; the least recently used are dropped first."""

LEAST_CHUNKS = 16
"""Chunks that a batch is cut into if it has enough tiles, so that many cores find work."""


class Batch(NamedTuple):
    """Runs that share one compiled program and one environment.

    Attributes:
        spec: program.
        environment: shared by all runs.
        draws: leaves (draws,), or () for what all share.
        params: leaves (variants, ...).
        variant_ids: (variants,) their numbers in the study.
    """

    spec: ProgramSpec
    environment: Environment
    draws: Draw
    params: RunParams
    variant_ids: np.ndarray

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self.draws.draw_id)

    @property
    def n_variants(self) -> int:
        """Number of variants."""
        return len(self.params.ve)

    def lay_out(self, *, tiles_per_chunk: int | None = None, lanes: int = LANES) -> "Layout":
        """Return the `Layout` of its runs."""
        sizes = self.n_draws, self.n_variants
        return Layout(self.spec, *sizes, tiles_per_chunk=tiles_per_chunk, lanes=lanes)

    def select_draws(self, places: np.ndarray) -> "Batch":
        """Return the batch with some draws only, by their places."""
        draws = jax.tree.map(lambda a: a[places] if np.ndim(a) else a, self.draws)
        return self._replace(draws=draws)


class Lanes(NamedTuple):
    """Draw and variant of each lane of a chunk; leaves (tiles, sets, lanes).

    Attributes:
        draw: place of the draw in the batch; beyond its end for idle lanes.
        variant: place of the variant, the same for all sets; beyond its end for idle lanes.
    """

    draw: np.ndarray
    variant: np.ndarray


class ActiveLanes(NamedTuple):
    """The lanes of a chunk that are not idle, by draw and variant; leaves (runs,)."""

    lane: np.ndarray  # place among all lanes of all tiles
    draw: np.ndarray  # place of the draw in the batch
    variant: np.ndarray  # place of the variant in the batch


class Chunk(NamedTuple):
    """Results of some runs of a batch, by draw and variant."""

    draw: np.ndarray  # (runs,) number of each run's draw in the study
    variant: np.ndarray  # (runs,) place of each run's variant in the batch
    outcome: Outcome  # leaves (runs, ...)
    curves: Any  # `Observation` with leaves (runs, intervals); None without curves


class Layout:
    """The layout of runs in the lanes of chunks of one size.

    Runs keep their order; stacked tiles take a few draws at a time. The layout depends on the
    program and the numbers of draws and variants alone, never on the machine. The last chunk is
    filled up with idle blocks, which are not computed. A chunk has room for two blocks of tiles or
    more: the compiler would simplify the arguments of a single one, which may change bits.

    Attributes:
        width: lanes that a draw takes.
        lanes: runs per tile.
    """

    def __init__(
        self,
        spec: ProgramSpec,
        draws: int,
        variants: int,
        *,
        tiles_per_chunk: int | None = None,
        lanes: int = LANES,
    ) -> None:
        """Lay out the runs of a batch.

        Args:
            spec: its program.
            draws: number of its draws.
            variants: number of its variants.
            tiles_per_chunk: tiles per chunk, stacked ones counted singly, rounded to two blocks or
                more; None for as many as `CHUNK_TILES` and the other limits allow.
            lanes: runs per tile.
        """
        self._draws, self._variants, self.lanes = draws, variants, lanes
        self._sets = STACKED_TILES if spec.shares_covariance else 1
        self.width = _lanes_of_draw_padded_to_tiles(spec, variants, lanes)
        # A block, which cannot be cut, is a tile, or stacked tiles of several draws.
        self._stride = lanes if self._sets == 1 else max(lanes, self.width)
        self._across = self._stride // lanes  # blocks beside one another for the same draws
        blocks = -(-draws * self.width // (self._sets * self._stride)) * self._across
        self._blocks = blocks
        if tiles_per_chunk is None:
            rows = lanes * spec.intervals
            most = min(CHUNK_TILES, CHUNK_STEPS // (rows * spec.interval_samples))
            if spec.curves:
                most = min(most, CHUNK_RECORDS // rows)
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
        places = draws * self._stride + beside[:, None, None] * self.lanes + np.arange(self.lanes)
        return Lanes(places // self.width, places % self.width)

    @property
    def tiles(self) -> int:
        """Number of tiles that are computed, in all chunks."""
        return self._blocks * self._sets

    def blocks(self, number: int) -> int:
        """Return the number of blocks of a chunk that have runs; they come first."""
        return min(self._size, self._blocks - number * self._size)

    @property
    def curve_lanes(self) -> int | None:
        """The lanes of a tile whose curves are returned, the first ones; None for all.

        A few runs are in the first lanes, and the curves of idle lanes would fill the memory.
        """
        used = self._draws * self.width
        return used if used < self.lanes else None

    def active(self, number: int) -> ActiveLanes:
        """Return the lanes of a chunk that are not idle."""
        draw, variant = (places.ravel() for places in self[number])
        lane = np.flatnonzero((draw < self._draws) & (variant < self._variants))
        lane = lane[np.argsort(draw[lane] * self._variants + variant[lane])]
        return ActiveLanes(lane, draw[lane], variant[lane])

    def chunk_of(self, draw: int, variant: int) -> int:
        """Return the number of the chunk that has a run."""
        row, place = divmod(draw * self.width + variant, self._stride)
        return (row // self._sets * self._across + place // self.lanes) // self._size

    def tiles_of_chunk(self, batch: Batch, number: int) -> Tiles:
        """Return the arguments of a chunk; idle lanes repeat the last draw or variant."""
        places = self[number]
        first = places.draw[..., :1]
        draw = first + np.arange(_draws_of_tile(self.width, self.lanes))
        draw = np.minimum(draw if self._sets > 1 else draw[:, 0], self._draws - 1)
        variant = np.minimum(places.variant[:, 0], self._variants - 1)
        return Tiles(
            draws=jax.tree.map(
                lambda a: a[draw] if np.ndim(a) else np.full(len(draw), a), batch.draws
            ),
            row=(places.draw - first)[:, 0].astype(np.int32),
            params=jax.tree.map(lambda a: np.asarray(a)[variant], batch.params),
        )


def _lanes_of_draw_padded_to_tiles(spec: ProgramSpec, variants: int, tile_lanes: int) -> int:
    """Return the lanes that a draw takes.

    Stacked tiles need the same variants in the same lanes: a draw is widened there, with idle
    lanes, to whole tiles or to a divisor of a tile. Otherwise it is widened to whole tiles if few
    lanes stay idle, since a tile of two draws makes the samples of `VECTOR`.
    """
    whole = tile_lanes * -(-variants // tile_lanes)
    if not spec.shares_covariance:
        few = variants > tile_lanes and whole - variants <= MOST_IDLE * variants
        return whole if few else variants
    if variants > tile_lanes:
        return whole
    return next(n for n in range(variants, tile_lanes + 1) if tile_lanes % n == 0)


def _draws_of_tile(width: int, lanes: int) -> int:
    """Return the number of draws that a tile has room for if each takes ``width`` lanes in a row.

    That is at least the most that it can hold, in whole vectors, since a part of a vector takes as
    long as a whole one; it is as many as there are lanes only if a draw takes one lane.
    """
    if width % lanes == 0:
        return 1
    if lanes % width == 0:
        return lanes // width
    most = (lanes + width - 2) // width + 1
    whole = -(-most // VECTOR) * VECTOR
    return whole if whole < lanes else most


# Programs


def target_devices() -> list[jax.Device | None]:
    """Return the devices that programs are compiled for.

    On a CPU one program serves all threads, at the same speed and with the same bits as one per
    thread; accelerators have one each.
    """
    return [None] if jax.default_backend() == "cpu" else list(jax.local_devices())


class LazyProgram:
    """A program that is traced when made, and compiled once for all threads when first wanted.

    It is the same for all arguments of some shapes, whatever their values.
    """

    def __init__(
        self, spec: ProgramSpec, curve_lanes: int | None, structure: Any, shapes: tuple
    ) -> None:
        def run_tiles(environment: Environment, tiles: Tiles, blocks: Count) -> Any:
            one = partial(run_tile, spec, environment, curve_lanes=curve_lanes)
            return map_tiles(spec, one, tiles, blocks)

        arguments = *jax.tree.unflatten(structure, shapes), jax.ShapeDtypeStruct((), np.int32)
        self._lowered: jax.stages.Lowered | None = jax.jit(run_tiles).lower(*arguments)
        self._compiled: jax.stages.Compiled | None = None
        self._lock = threading.Lock()

    def compiled(self) -> jax.stages.Compiled:
        """Return the compiled program; its results have the same bits in every thread."""
        with self._lock:
            if self._compiled is None:
                assert self._lowered is not None
                self._compiled, self._lowered = self._lowered.compile(), None
            return self._compiled


_traced = lru_cache(maxsize=MOST_PROGRAMS)(LazyProgram)


def trace_program(batch: Batch, layout: Layout, device: jax.Device | None = None) -> LazyProgram:
    """Return the program of a batch's chunks on a device, None for the default one."""
    leaves, structure = jax.tree.flatten((batch.environment, layout.tiles_of_chunk(batch, 0)))
    home = None if device is None else jax.sharding.SingleDeviceSharding(device)
    shapes = tuple(
        jax.ShapeDtypeStruct(np.shape(a), np.asarray(a).dtype, sharding=home) for a in leaves
    )
    return _traced(batch.spec, layout.curve_lanes if batch.spec.curves else None, structure, shapes)


class Chunks:
    """The chunks of a batch, each computed on demand, in any order and from any thread.

    Attributes:
        layout: of the runs in chunks.
    """

    def __init__(self, batch: Batch, *, tiles_per_chunk: int | None = None) -> None:
        """Trace the program of a batch.

        Args:
            batch: the runs.
            tiles_per_chunk: as for `Layout`.
        """
        self._batch = batch
        self.layout = batch.lay_out(tiles_per_chunk=tiles_per_chunk)
        devices = target_devices()
        self._programs = [trace_program(batch, self.layout, device) for device in devices]
        # Once, and not with every call.
        self._environments = [jax.device_put(batch.environment, device) for device in devices]

    def __len__(self) -> int:
        return len(self.layout)

    def compile(self) -> None:
        """Compile all programs now rather than with the first chunk."""
        for program in self._programs:
            program.compiled()

    def compute(self, number: int) -> Chunk:
        """Compute a chunk, on the device of the calling thread."""
        home = getattr(_thread, "number", 0) % len(self._programs)
        call, environment = self._programs[home].compiled(), self._environments[home]
        tiles = self.layout.tiles_of_chunk(self._batch, number)
        blocks = np.int32(self.layout.blocks(number))
        outcome, curves = jax.device_get(call(environment, tiles, blocks))
        runs, axes = self.layout.active(number), tiles.draws.draw_id.ndim - 1  # tiles, and sets
        tile, lane = np.divmod(runs.lane, self.layout.lanes)

        def of_tiles(a: np.ndarray) -> np.ndarray:
            return a.reshape(-1, *a.shape[axes:])

        return Chunk(
            self._batch.draws.draw_id[runs.draw],
            runs.variant,
            jax.tree.map(lambda a: of_tiles(a)[tile, lane], outcome),
            jax.tree.map(lambda a: of_tiles(a)[tile, ..., lane], curves),
        )


_thread = threading.local()
"""Its ``number`` is that of a thread of `map_in_threads`; others have none, and count as 0."""


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


# Variants with identical runs


class DuplicateVariants(NamedTuple):
    """Variants of a program, grouped by identical runs: one of each group is computed.

    Attributes:
        computed: (computed,) one variant of each group, as places in the program.
        variants: (variants,) places in the program, group by group in the order of ``computed``.
        counts: (computed,) number of variants of each group.
    """

    computed: np.ndarray
    variants: np.ndarray
    counts: np.ndarray

    def expand(self, chunk: Chunk) -> Chunk:
        """Return the results of all variants from those computed, by draw and variant."""
        counts = self.counts[chunk.variant]
        run = np.repeat(np.arange(len(counts)), counts)
        within = np.arange(len(run)) - np.repeat(np.cumsum(counts) - counts, counts)
        starts = np.cumsum(self.counts) - self.counts
        variant = self.variants[starts[chunk.variant][run] + within]
        in_order = np.lexsort((variant, chunk.draw[run]))
        run, variant = run[in_order], variant[in_order]
        outcome, curves = jax.tree.map(lambda a: a[run], (chunk.outcome, chunk.curves))
        return Chunk(chunk.draw[run], variant, outcome, curves)


def duplicates_to_skip(
    spec: ProgramSpec, draws: int, run_kinds: np.ndarray
) -> DuplicateVariants | None:
    """Return the duplicate variants of a program; None if all of them are to be computed.

    ``run_kinds``, (variants,), has a number that variants with identical runs share.
    """
    _, computed, kind, counts = np.unique(
        run_kinds, return_index=True, return_inverse=True, return_counts=True
    )
    all_tiles, tiles = (Layout(spec, draws, count).tiles for count in (len(kind), len(computed)))
    if tiles > (1 - LEAST_SAVED) * all_tiles:
        return None
    return DuplicateVariants(computed, np.argsort(kind, kind="stable"), counts)
