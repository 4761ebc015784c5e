"""Whether a job may be written to a results directory, and how it continues the results there."""

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.execution.directory import (
    DATASETS,
    MANIFEST,
    ROW_DATASETS,
    STUDY,
    FileState,
    Manifest,
    OtherVersionError,
    existing_names,
    find_manifest,
    list_parts,
)
from sinsjax.execution.results import CHUNK_METADATA, STUDY_METADATA, read_part_metadata
from sinsjax.execution.tasks import Job
from sinsjax.messages import one_line, shortened
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime
from sinsjax.platform.files import read_regular
from sinsjax.study.identity import differences, fingerprint, with_draws
from sinsjax.study.load import load_study
from sinsjax.study.study import Study

_RESULT_NAMES = (*DATASETS, "figures", STUDY, MANIFEST)


def check_available(directory: Path, *, overwrite: bool, resume: bool) -> None:
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
    existing = existing_names(directory, _RESULT_NAMES)
    if not existing:
        return
    try:
        manifest = _find_or_rebuild_manifest(directory)
    except OtherVersionError:
        if overwrite:
            return
        raise
    if manifest is None:
        raise InputError(
            f"{directory}: holds a {existing[0]} that is not a result (give another directory)"
        )
    if not (overwrite or resume):
        raise InputError(
            f"{directory}: already holds results (give --resume to continue them, or --overwrite"
            " to replace them; in Python resume=True or overwrite=True)"
        )


def manifest_state(directory: Path) -> FileState | None:
    """Return the state of a directory's manifest, which every writer changes; None without one."""
    try:
        return FileState.from_path(directory / MANIFEST)
    except OSError:
        return None


def continue_job(job: Job) -> Job:
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
    manifest = _find_or_rebuild_manifest(directory)
    is_same = manifest is not None and _has_same_study(job, manifest)
    # Whatever study.toml contains, it is written again for results of the same study.
    stored = None if is_same else _check_same_study(directory, job.study)
    if manifest is None:
        return job
    if job.chunk_runs not in (None, manifest.chunk_runs):
        raise InputError(
            f"{directory}: chunk_runs: {job.chunk_runs} requested, but its results were begun with"
            f" {manifest.chunk_runs or 'the default'} (--resume keeps that: leave --chunk-runs out)"
        )
    extended = stored is not None and _has_more_draws(stored, job.study)
    earlier_draws = {
        *manifest.extended_at,
        *([stored.n_draws] if stored is not None and extended else []),
    }
    job = _with_extensions(job, earlier_draws)._replace(
        curves=manifest.curves, chunk_runs=manifest.chunk_runs
    )
    _check_versions(directory, manifest, packages_of(job.study.methods))
    if manifest.identity != job.identity:
        kind = "record or reference" if is_same or stored else "study"
        raise InputError(f"{directory}: holds results of another {kind}")
    return job


def _has_same_study(job: Job, manifest: Manifest) -> bool:
    """Whether results are certainly of a job's study, with as many draws."""
    same_study = manifest.fingerprint == fingerprint(job.study)
    return same_study or (not manifest.extended_at and manifest.identity == job.identity)


def _with_extensions(job: Job, earlier_draws: Iterable[int]) -> Job:
    """A job whose results had numbers of draws before, those that it has not yet left out."""
    return job._replace(
        extended_at=tuple(sorted(d for d in earlier_draws if d <= job.study.n_draws))
    )


def check_instruction_set(directory: Path, current: str) -> None:
    """Reject rows of another instruction set: last bits differ, and the difference grows.

    Args:
        directory: results directory.
        current: instruction set that will compute the missing rows.

    Raises:
        InputError: names both instruction sets.
    """
    manifest = find_manifest(directory)
    for session in manifest.sessions if manifest else ():
        if (stored := shortened(one_line(session.instructions or current))) != current:
            raise InputError(
                f"{directory}: was computed with instruction set {stored}, but here is {current}"
                f" (use a machine with that one, XLA_FLAGS=--xla_cpu_max_isa={stored} on a"
                " larger one, or --overwrite)"
            )


def _check_same_study(directory: Path, study: Study) -> Study | None:
    """Reject results of another study than this one with as many draws, or with fewer.

    Gives the study that the results are of; None if the directory has none that can be read.
    """
    try:
        stored = load_study(directory / STUDY)
    except InputError:  # the parts identify their study too
        return None
    if _has_more_draws(stored, study):
        _check_extension(directory, stored, study)
    elif fingerprint(stored) != fingerprint(study):
        text = "; ".join(differences(stored, study))
        if _has_more_draws(study, stored):
            text += f" (there can be more, not fewer: continue with --draws {stored.n_draws})"
        elif hint := _added_values_hint(stored, study):
            text += f" ({hint})"
        raise InputError(f"{directory}: holds results of another study: {text}")
    return stored


def _has_more_draws(stored: Study, study: Study) -> bool:
    """Whether a study is a simulated one, ``stored``, with more draws and nothing else changed."""
    draws = study.study.draws
    if stored.study.draws is None or draws is None or draws <= stored.study.draws:
        return False
    return fingerprint(with_draws(stored, draws)) == fingerprint(study)


def _added_values_hint(stored: Study, study: Study) -> str:
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
        f"run the added values, axes.{key}={shortened(str(new), 40)}, into another directory;"
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


def _check_versions(directory: Path, manifest: Manifest, packages: Iterable[str]) -> None:
    """Reject rows of other versions, packages that provide methods included: bits may differ."""
    current = runtime.versions()
    for session in manifest.sessions:
        for name in (*runtime.DECISIVE, *packages):
            stored = shortened(one_line(session.versions.get(name, current[name])))
            if stored != current[name]:
                raise InputError(
                    f"{directory}: was computed with {name} {stored}, but here is {current[name]}"
                    " (install that one, or give --overwrite)"
                )


def _find_or_rebuild_manifest(directory: Path) -> Manifest | None:
    """The manifest of a directory, or one from its intact parts; None if it holds no results."""
    return find_manifest(directory) or _manifest_from_parts(directory)


def _manifest_from_parts(directory: Path) -> Manifest | None:
    """A manifest from the intact part with most extensions."""
    curves = True if list_parts(directory, "curves") else None
    manifests = []
    for path in (path for name in ROW_DATASETS for path in list_parts(directory, name)):
        with suppress(OSError, InputError):
            if metadata := read_part_metadata(read_regular(path)):
                chunk = json.loads(metadata[CHUNK_METADATA])
                manifests.append(
                    Manifest(
                        identity=metadata[STUDY_METADATA],
                        curves=curves,
                        chunk_runs=chunk["chunk_runs"],
                        extended_at=chunk.get("extended_at", ()),
                    )
                )
    return max(manifests, key=lambda part: len(part.extended_at), default=None)
