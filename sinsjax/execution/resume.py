"""Checks of a results directory before a job writes to it, and continuation of its results."""

import json
from contextlib import suppress
from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.execution.checks import refuse_external
from sinsjax.execution.directory import (
    DATASETS,
    MANIFEST,
    STUDY,
    Manifest,
    OtherVersionError,
    check_directory,
    list_parts,
)
from sinsjax.execution.results import CHUNK_METADATA, STUDY_METADATA, read_part_metadata
from sinsjax.execution.tasks import Job
from sinsjax.messages import shorten, to_one_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime
from sinsjax.platform.files import read_regular_file
from sinsjax.study.attitude_file import attitude_file
from sinsjax.study.identity import describe_differences, fingerprint, with_draws
from sinsjax.study.load import load_study
from sinsjax.study.study import Study


def check_available(directory: Path, *, overwrite: bool, resume: bool) -> None:
    """Reject a directory with foreign files, or with results that may not be used.

    Results are identified by their manifest or parts; a foreign file of the same name is never
    touched.

    Args:
        directory: results directory, which may be missing.
        overwrite: whether results may be replaced.
        resume: whether results may be continued.

    Raises:
        InputError: the directory cannot be used.
    """
    check_directory(directory)
    names = (*DATASETS, "figures", STUDY, MANIFEST)
    existing = [name for name in names if (directory / name).exists()]
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
            f"{directory}: contains {existing[0]}, which is not a result (give another directory)"
        )
    if not (overwrite or resume):
        raise InputError(
            f"{directory}: already contains results (give --resume to continue them, or --overwrite"
            " to replace them; in Python resume=True or overwrite=True)"
        )


def manifest_state(directory: Path) -> bytes | None:
    """Return the content of a directory's manifest, which every write changes; None without one."""
    try:
        return read_regular_file(directory / MANIFEST)
    except (OSError, InputError):
        return None


def continue_job(job: Job) -> Job:
    """Return the job as a continuation of the results in its directory, if there are any.

    It uses their runs per chunk and choice of curves. If it has more draws, it is marked as
    extended.

    Args:
        job: the job as requested now.

    Raises:
        InputError: the directory contains results of another study (names the keys that differ), of
            another record or version, or with other chunks.
    """
    directory, study = job.directory, job.study
    assert directory is not None
    manifest = _find_or_rebuild_manifest(directory)
    if manifest is not None:
        refuse_external(_external_programs(manifest), directory)
    is_same = manifest is not None and (
        manifest.fingerprint == fingerprint(study)
        or (not manifest.extended_at and manifest.identity == job.identity)
    )
    # study.toml is written again for results of the same study, whatever it contains.
    stored = None if is_same else _check_same_study(directory, study)
    if manifest is None:
        return job
    if job.chunk_runs not in (None, manifest.chunk_runs):
        raise InputError(
            f"{directory}: chunk_runs: {job.chunk_runs} requested, but its results were begun with"
            f" {manifest.chunk_runs or 'the default'} (--resume keeps that: leave --chunk-runs out)"
        )
    ends = {*manifest.extended_at}
    if stored is not None and _has_more_draws(stored, study):
        ends.add(stored.n_draws)
    job = job._replace(
        curves=manifest.curves,
        chunk_runs=manifest.chunk_runs,
        extended_at=tuple(sorted(end for end in ends if end <= study.n_draws)),
    )
    _check_versions(directory, manifest, study)
    if manifest.identity != job.identity:
        kind = "record or reference" if is_same or stored else "study"
        if stored and attitude_file(study):
            kind = "attitude_file"
        raise InputError(f"{directory}: contains results of another {kind}")
    return job


def _external_programs(manifest: Manifest) -> list[str]:
    """Return the programs outside sinsjax of a manifest, whose study may be anything."""
    settings = manifest.study.get("study")
    programs = settings.get("external") if isinstance(settings, dict) else None
    return list(map(str, programs)) if isinstance(programs, list) else []


def check_instruction_set(directory: Path, current: str) -> None:
    """Reject rows of another instruction set: last bits differ, and the differences grow.

    Args:
        directory: results directory.
        current: instruction set that will compute the missing rows.

    Raises:
        InputError: names both instruction sets.
    """
    manifest = Manifest.find(directory)
    stored = manifest and manifest.instructions
    if stored and stored != current:
        stored = shorten(to_one_line(stored))
        raise InputError(
            f"{directory}: was computed with instruction set {stored}, but here is {current}"
            f" (use a machine with that one, XLA_FLAGS=--xla_cpu_max_isa={stored} on a larger one,"
            " or --overwrite)"
        )


def _check_versions(directory: Path, manifest: Manifest, study: Study) -> None:
    """Reject rows of other versions, including packages that provide methods: bits may differ."""
    current = runtime.relevant_versions()
    for name in (*runtime.RESULT_PACKAGES, *packages_of(study.methods)):
        stored = manifest.versions.get(name, current[name])
        if stored != current[name]:
            raise InputError(
                f"{directory}: was computed with {name} {shorten(to_one_line(stored))}, but here is"
                f" {current[name]} (install that one, or give --overwrite)"
            )


def _check_same_study(directory: Path, study: Study) -> Study | None:
    """Reject results of another study; the same study may have had fewer draws.

    Returns the study of the results; None if the directory has no readable one.
    """
    try:
        stored = load_study(directory / STUDY)
    except InputError:  # the parts identify their study too
        return None
    if _has_more_draws(stored, study):
        _check_extension(directory, stored)
    elif fingerprint(stored) != fingerprint(study):
        text = "; ".join(describe_differences(stored, study))
        if _has_more_draws(study, stored):
            text += f" (draws can be added, not removed: continue with --draws {stored.n_draws})"
        elif added := _added_values(stored, study):
            text += f" (run the added values, axes.{added}, into another directory)"
        raise InputError(f"{directory}: contains results of another study: {text}")
    return stored


def _has_more_draws(stored: Study, study: Study) -> bool:
    """Whether a study is a simulated study ``stored`` with more draws and no other change."""
    draws = study.study.draws
    if stored.study.draws is None or draws is None or draws <= stored.study.draws:
        return False
    return fingerprint(with_draws(stored, draws)) == fingerprint(study)


def _added_values(stored: Study, study: Study) -> str | None:
    """Return an axis and its additional values, which would renumber all runs."""
    if list(stored.axes) != list(study.axes):
        return None
    for key, values in study.axes.items():
        before = stored.axes[key]
        if set(map(str, before)) < set(map(str, values)):
            return f"{key}={shorten(str([value for value in values if value not in before]), 40)}"
    return None


def _check_extension(directory: Path, stored: Study) -> None:
    """Reject more draws if the existing ones would change.

    A list with an entry for every draw would begin again, which is hardly intended.
    """
    laws = stored.drawn.laws if stored.drawn else {}
    for key, law in laws.items():
        if law.values and len(law.values) == stored.n_draws > 1:
            raise InputError(
                f"{directory}: [drawn] {key}.values: ends with the {stored.n_draws} existing draws"
                " (give another directory to begin it again)"
            )


def _find_or_rebuild_manifest(directory: Path) -> Manifest | None:
    """Return the manifest of a directory, or one from its parts; None without results."""
    if manifest := Manifest.find(directory):
        return manifest
    curves = True if list_parts(directory, "curves") else None
    manifests = []
    for path in list_parts(directory, "summary"):
        with suppress(OSError, InputError):
            if metadata := read_part_metadata(read_regular_file(path)):
                chunk = json.loads(metadata[CHUNK_METADATA])
                manifests.append(
                    Manifest(
                        identity=metadata[STUDY_METADATA],
                        curves=curves,
                        chunk_runs=chunk["chunk_runs"],
                        extended_at=chunk.get("extended_at", ()),
                    )
                )
    return max(manifests, key=lambda manifest: len(manifest.extended_at), default=None)
