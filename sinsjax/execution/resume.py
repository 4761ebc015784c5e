"""Whether a job may be written to a results directory, and how it continues the results there."""

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.execution.directory import (
    DATASETS,
    MANIFEST,
    ONE_ROW_EACH,
    STUDY,
    FileState,
    Manifest,
    OtherVersion,
    find_manifest,
    list_parts,
    present_names,
)
from sinsjax.execution.results import CHUNK_MARK, STUDY_MARK, part_marks
from sinsjax.execution.tasks import Job
from sinsjax.messages import shorten, to_one_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime
from sinsjax.platform.files import read_regular_file
from sinsjax.study.identity import differences, fingerprint, with_draws
from sinsjax.study.load import load_study
from sinsjax.study.study import Study

_NAMES = (*DATASETS, "figures", STUDY, MANIFEST)


def check_free(directory: Path, *, overwrite: bool, resume: bool) -> None:
    """Reject a directory that holds results, unless they may be used, or foreign files.

    Results are identified by their manifest or parts; a foreign file of the same name is never
    touched.

    Args:
        directory: results directory, which may be missing.
        overwrite: whether results may be replaced.
        resume: whether results may be continued.

    Raises:
        InputError: the directory cannot be used.
    """
    taken = present_names(directory, _NAMES)
    if not taken:
        return
    try:
        known = _known(directory)
    except OtherVersion:
        if overwrite:
            return
        raise
    if known is None:
        raise InputError(
            f"{directory}: holds a {taken[0]} that is not a result (give another directory)"
        )
    if not (overwrite or resume):
        raise InputError(
            f"{directory}: already holds results (give --resume to continue them, or --overwrite"
            " to replace them; in Python resume=True or overwrite=True)"
        )


def state_of(directory: Path) -> FileState | None:
    """Return the state of a directory's manifest, which every writer changes; None without one."""
    try:
        return FileState.of(directory / MANIFEST)
    except OSError:
        return None


def continued(job: Job) -> Job:
    """Return the job as a continuation of the results in its directory, if it holds any.

    It keeps their runs per chunk and choice of curves. Its draws may be more than theirs: it is
    then marked as extended.

    Args:
        job: the job as requested now.

    Raises:
        InputError: the directory holds results of another study (names the keys that differ), of
            another record or version, or with other chunks.
    """
    directory = job.directory
    assert directory is not None
    known = _known(directory)
    is_same = known is not None and _is_same(job, known)
    # Whatever study.toml contains, it is written again for results of the same study.
    stored = None if is_same else _check_same_study(directory, job.study)
    if known is None:
        return job
    if job.chunk_runs not in (None, known.chunk_runs):
        raise InputError(
            f"{directory}: chunk_runs: {job.chunk_runs} requested, but its results were begun with"
            f" {known.chunk_runs or 'the default'} (--resume keeps that: leave --chunk-runs out)"
        )
    extended = stored is not None and _is_extended(stored, job.study)
    before = {*known.extended_at, *([stored.n_draws] if stored is not None and extended else [])}
    job = _extended(job, before)._replace(curves=known.curves, chunk_runs=known.chunk_runs)
    _check_versions(directory, known, packages_of(job.study.methods))
    if known.identity != job.identity:
        kind = "record or reference" if is_same or stored else "study"
        raise InputError(f"{directory}: holds results of another {kind}")
    return job


def _is_same(job: Job, known: Manifest) -> bool:
    """Whether results are certainly of a job's study, with as many draws."""
    same_study = known.fingerprint == fingerprint(job.study)
    return same_study or (not known.extended_at and known.identity == job.identity)


def _extended(job: Job, before: Iterable[int]) -> Job:
    """A job whose results had numbers of draws before, those that it has not yet left out."""
    return job._replace(extended_at=tuple(sorted(d for d in before if d <= job.study.n_draws)))


def check_instructions(directory: Path, here: str) -> None:
    """Reject rows of another instruction set: last bits differ, and the difference grows.

    Args:
        directory: results directory.
        here: instruction set that will compute the missing rows.

    Raises:
        InputError: names both instruction sets.
    """
    known = find_manifest(directory)
    for session in known.sessions if known else ():
        if (there := shorten(to_one_line(session.instructions or here))) != here:
            raise InputError(
                f"{directory}: was computed with instruction set {there}, but here is {here} (use a"
                f" machine with that one, XLA_FLAGS=--xla_cpu_max_isa={there} on a larger one, or"
                " --overwrite)"
            )


def _check_same_study(directory: Path, study: Study) -> Study | None:
    """Reject results of another study than this one with as many draws, or with fewer.

    Gives the study that the results are of; None if the directory has none that can be read.
    """
    try:
        stored = load_study(directory / STUDY)
    except InputError:  # the parts identify their study too
        return None
    if _is_extended(stored, study):
        _check_extension(directory, stored, study)
    elif fingerprint(stored) != fingerprint(study):
        text = "; ".join(differences(stored, study))
        if _is_extended(study, stored):
            text += f" (there can be more, not fewer: continue with --draws {stored.n_draws})"
        elif more := _added_values(stored, study):
            text += f" ({more})"
        raise InputError(f"{directory}: holds results of another study: {text}")
    return stored


def _is_extended(stored: Study, study: Study) -> bool:
    """Whether a study is a simulated one, ``stored``, with more draws and nothing else changed."""
    draws = study.study.draws
    if stored.study.draws is None or draws is None or draws <= stored.study.draws:
        return False
    return fingerprint(with_draws(stored, draws)) == fingerprint(study)


def _added_values(stored: Study, study: Study) -> str:
    """The way on if axes have further values: run ids number all variants, and would move."""
    added = [
        key
        for key, values in study.axes.items()
        if key in stored.axes and set(map(str, stored.axes[key])) < set(map(str, values))
    ]
    if not added or list(stored.axes) != list(study.axes):
        return ""
    key = added[0]
    new = [value for value in study.axes[key] if value not in stored.axes[key]]
    return (
        f"run the added values, axes.{key}={shorten(str(new), 40)}, into another directory;"
        " read both together with their paths in one list, and tell the runs apart by directory and"
        " run_id, which counts within a directory"
    )


def _check_extension(directory: Path, stored: Study, study: Study) -> None:
    """Reject more draws if the existing ones would mean something else.

    A list with an entry for every draw would begin again, which nobody meant who wrote it.
    """
    if stored.is_estimated:
        raise InputError(
            f"{directory}: [study] draws: {stored.study.draws} there, {study.study.draws} here:"
            " estimates of all draws cannot be extended (give another directory)"
        )
    laws = stored.drawn.laws if stored.drawn else {}
    for key, law in laws.items():
        if law.values and len(law.values) == stored.n_draws > 1:
            raise InputError(
                f"{directory}: [drawn] {key}.values: ends with the {stored.n_draws} draws that are"
                " there (give another directory to begin it again)"
            )


def _check_versions(directory: Path, known: Manifest, packages: Iterable[str]) -> None:
    """Reject rows of other versions, packages that provide methods included: bits may differ."""
    here = runtime.relevant_versions()
    for session in known.sessions:
        for name in (*runtime.RESULT_PACKAGES, *packages):
            there = shorten(to_one_line(session.versions.get(name, here[name])))
            if there != here[name]:
                raise InputError(
                    f"{directory}: was computed with {name} {there}, but here is {here[name]}"
                    " (install that one, or give --overwrite)"
                )


def _known(directory: Path) -> Manifest | None:
    """The manifest of a directory, or one from its intact parts; None if it holds no results."""
    return find_manifest(directory) or _from_parts(directory)


def _from_parts(directory: Path) -> Manifest | None:
    """A manifest from the intact part with most extensions."""
    curves = True if list_parts(directory, "curves") else None
    found = []
    for path in (path for name in ONE_ROW_EACH for path in list_parts(directory, name)):
        with suppress(OSError, InputError):
            if marks := part_marks(read_regular_file(path)):
                chunk = json.loads(marks[CHUNK_MARK])
                found.append(
                    Manifest(
                        identity=marks[STUDY_MARK],
                        curves=curves,
                        chunk_runs=chunk["chunk_runs"],
                        extended_at=chunk.get("extended_at", ()),
                    )
                )
    return max(found, key=lambda part: len(part.extended_at), default=None)
