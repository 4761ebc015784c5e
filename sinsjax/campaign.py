"""A study carried out: every part and chunk of it, into tables in memory or a directory."""

import time
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import jax
import pyarrow as pa

from sinsjax import columns, results, runtime
from sinsjax.batch import chunks
from sinsjax.records import Layout, read_record, read_reference
from sinsjax.scenario import Part, parts
from sinsjax.sections import Record
from sinsjax.studies import Study
from sinsjax.types import InputError
from sinsjax.worlds import Tape


class Results(NamedTuple):
    """What a study gave.

    Attributes:
        summary: one row a run, by run_id.
        curves: one row a run and record time; empty if curves were not kept.
    """

    summary: pa.Table
    curves: pa.Table


Progress = Callable[[int, int], None]
"""Called with (runs done, runs in all) after every chunk."""


def load_tape(study: Study, record: str | Path, reference: str | Path | None = None) -> Tape:
    """Read the record of a recorded study, and a reference attitude if there is one.

    Raises:
        InputError: a file that cannot be used, or a study without [record].
    """
    if study.record is None:
        raise InputError(f"{study.study.name}: has no [record] section")
    layout = _layout(study.record, study.study.rate_hz)
    return Tape(
        record=read_record(record, layout),
        reference=None if reference is None else read_reference(reference),
    )


def _layout(section: Record, rate_hz: float) -> Layout:
    given = {key: getattr(section, key) for key in Layout._fields if hasattr(section, key)}
    return Layout(**{k: v for k, v in given.items() if v is not None}, rate_hz=rate_hz)


def run(
    study: Study,
    tape: Tape | None = None,
    *,
    curves: bool | None = None,
    progress: Progress | None = None,
) -> Results:
    """Run a study in memory.

    Args:
        study: checked study.
        tape: the record of a recorded study.
        curves: whether curves are kept; None takes the study's word.
        progress: told after every chunk.

    Returns:
        Tables of all runs.

    Raises:
        InputError: a record that does not fit.
        RuntimeError: double precision is off (`runtime.configure` turns it on).
    """
    summaries, kept = [], []
    for piece in _pieces(study, tape, parts(study, tape, curves=curves), progress):
        summaries.append(piece.summary)
        if piece.curves is not None:
            kept.append(piece.curves)
    order = [("run_id", "ascending"), ("time_s", "ascending")]
    layout = columns.curves(passes=study.passes is not None)
    kept_curves = pa.concat_tables(kept or [columns.schema(layout).empty_table()])
    return Results(pa.concat_tables(summaries).sort_by("run_id"), kept_curves.sort_by(order))


def run_into(
    study: Study,
    directory: str | Path,
    tape: Tape | None = None,
    *,
    curves: bool | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    source: Path | None = None,
) -> None:
    """Run a study into a directory, a Parquet part a chunk.

    Args:
        study: checked study.
        directory: where; must hold no results unless ``overwrite``.
        tape: the record of a recorded study.
        curves: whether curves are kept; None takes the study's word.
        overwrite: whether earlier results are removed.
        progress: told after every chunk.
        source: the study's file, named in the manifest.

    Raises:
        InputError: a record that does not fit, or a directory that cannot be used. Nothing is
            written or removed before both are known to be good.
        RuntimeError: double precision is off.
    """
    started, directory = time.time(), Path(directory)
    results.check_free(directory, overwrite=overwrite)
    remaining = parts(study, tape, curves=curves)
    first = next(remaining)
    store = results.Store(directory, study, overwrite=overwrite)
    for piece in _pieces(study, tape, chain([first], remaining), progress):
        store.write("summary", piece.name, piece.summary, seconds=piece.seconds)
        if piece.curves is not None:
            store.write("curves", piece.name, piece.curves, seconds=piece.seconds)
    store.finish(
        {
            "config": None if source is None else source.name,
            "record": None if tape is None else Path(tape.record.source).name,
            "versions": runtime.versions(),
            "devices": len(jax.devices()),
            "started_unix_s": round(started, 3),
            "wall_s": round(time.time() - started, 3),
        }
    )


class _Piece(NamedTuple):
    """Tables of one chunk, and what computing it took."""

    name: str
    summary: pa.Table
    curves: pa.Table | None
    seconds: float


def _pieces(
    study: Study, tape: Tape | None, todo: Iterable[Part], progress: Progress | None
) -> Iterator[_Piece]:
    has_truth = tape is None or tape.reference is not None
    made = results.Tables(study, has_truth=has_truth)
    done, total = 0, study.n_draws * study.n_variants
    for number, part in enumerate(todo):
        for piece in _part_pieces(part, made, number):
            done += piece.summary.num_rows
            if progress is not None:
                progress(done, total)
            yield piece


def _part_pieces(part: Part, made: results.Tables, number: int) -> Iterator[_Piece]:
    since = time.perf_counter()
    for count, chunk in enumerate(chunks(part.group, devices=len(jax.devices()))):
        seconds = time.perf_counter() - since
        has_curves = chunk.curves is not None
        yield _Piece(
            name=f"part-{number:04d}-{count:06d}",
            summary=made.summary(chunk, part.variant_ids),
            curves=made.curves(chunk, part.variant_ids) if has_curves else None,
            seconds=seconds,
        )
        since = time.perf_counter()
