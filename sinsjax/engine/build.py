"""From a study to the groups of runs that the engine computes, in SI units.

A `Part` holds the variants that share a compiled program and an environment (Earth, motion of the
base, sensors); within a part all differences are numbers. The variants of a study are split into
parts by the values of `PROGRAM_KEYS`, `ENVIRONMENT_KEYS` and `PASS_KEYS`.
"""

from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.bias_floors import require_floor
from sinsjax.engine.environment import (
    CoarseStage,
    Draw,
    Environment,
    RunParams,
    SensorProgram,
    Static,
    derive_inputs,
    select_site,
)
from sinsjax.engine.lanes import Group
from sinsjax.engine.metrics import Criteria
from sinsjax.engine.samples import build_sensors
from sinsjax.engine.sensor_inputs import DISTORTION_KEYS, NOISE_KEYS, moves
from sinsjax.engine.truth import (
    read_site,
    record_environment,
    simulate_environment,
    true_increments,
)
from sinsjax.errors import InputError
from sinsjax.maths.rotations import euler_vector
from sinsjax.methods.method import Options, Site
from sinsjax.methods.registry import METHODS
from sinsjax.platform import runtime
from sinsjax.records import Record
from sinsjax.records.reference import StoredRecord
from sinsjax.study.keys import COARSE_KEYS, PASS_KEYS
from sinsjax.study.load import load_study
from sinsjax.study.resolved import CodedColumn
from sinsjax.study.schema import EarthSection, MotionSection, SensorsSection
from sinsjax.study.study import SEQUENTIAL_KEYS, Span, Study
from sinsjax.study.success import settling_bands
from sinsjax.study.variants import Variants
from sinsjax.types import Array, Increments, Quat, Vec3
from sinsjax.units import ARCMIN, DEG

PROGRAM_KEYS = (
    *("method", "specific_force", "position", "reset_trigger"),
    *COARSE_KEYS,
)
"""Keys whose values decide the compiled program."""

ENVIRONMENT_KEYS = tuple(
    key for model in (EarthSection, MotionSection, SensorsSection) for key in model.model_fields
)
"""Keys whose values decide the environment."""


class Part(NamedTuple):
    """Variants of a study that run together.

    Attributes:
        group: of their runs.
        variant_ids: (variants,) their numbers in the study.
    """

    group: Group
    variant_ids: np.ndarray


class Scenario:
    """A study ready to be run: its parts, each made on demand.

    Attributes:
        study: checked study.
        stored: the record of a recorded study, else None.
        curves: whether curves are returned.
        variant_ids: numbers of the variants of each part.
    """

    def __init__(
        self, study: Study, stored: StoredRecord | None = None, *, curves: bool | None = None
    ) -> None:
        """Check all that can be checked before any run.

        Args:
            study: checked study.
            stored: the record of a recorded study, else None.
            curves: whether curves are returned; None for what the study asks.

        Raises:
            InputError: a record is missing or not needed, compass loops cannot be run, runs without
                a bias floor are to be judged from it, or double precision cannot be enabled
                (`runtime.ensure_configured`).
        """
        runtime.ensure_configured()
        if study.is_recorded != (stored is not None):
            text = "reads a record, none is given" if study.is_recorded else "reads no record"
            raise InputError(f"{study.name}: the study {text}: see [record]")
        require_floor(study)
        self.study, self.stored = study, stored
        self.curves = study.study.curves if curves is None else curves
        self.variant_ids = list(_split(study))
        for ids in self.variant_ids:
            variants = self._variants(ids)
            if check := METHODS[variants.common("method")].check:
                check(variants)

    def keys(self, number: int) -> Variants:
        """Return the keys of a part."""
        return self._variants(self.variant_ids[number])

    def _variants(self, ids: np.ndarray) -> Variants:
        """Return some variants of one program, with their site."""
        site, micro_g = read_site(self.study, Variants(self.study, ids), self.stored)
        return Variants(self.study, ids, site=site, micro_g=micro_g)

    @property
    def has_truth(self) -> bool:
        """Whether runs can be judged, by the truth of a simulation or the reference of a record."""
        return self.stored is None or self.stored.reference is not None

    @cached_property
    def statics(self) -> list[Static]:
        """The options that are fixed when each part is compiled."""
        variants = (Variants(self.study, ids) for ids in self.variant_ids)
        return [_program(self.study, part, self.curves) for part in variants]

    def part(
        self,
        number: int,
        draws: range | None = None,
        *,
        variants: np.ndarray | None = None,
        blank: bool = False,
    ) -> Part:
        """Return a part with all its draws, or a range of them.

        Args:
            number: of the part.
            draws: range of draws; None for all.
            variants: places of variants; None for all.
            blank: whether the truth of a simulation is replaced by zeros, enough to compile.

        Raises:
            InputError: a record that does not fit the study.
        """
        study, ids = self.study, self.variant_ids[number]
        ids = ids if variants is None else ids[variants]
        columns = self._variants(ids)
        span, criteria = _span(study, columns), _criteria(study, columns)
        if self.stored is None:
            draws = range(study.n_draws) if draws is None else draws
            environment, drawn, q = simulate_environment(
                study, columns, span, criteria, draws, blank=blank
            )
        else:
            environment, drawn, q = record_environment(study, columns, span, criteria, self.stored)
        params = _run_params(study, columns)
        return Part(Group(self.statics[number], environment, drawn, q, params), ids)


def parts(
    study: Study, stored: StoredRecord | None = None, *, curves: bool | None = None
) -> Iterator[Part]:
    """Yield the parts of a study, see `Scenario`."""
    scenario = Scenario(study, stored, curves=curves)
    return (scenario.part(number) for number in range(len(scenario.variant_ids)))


def simulated_record(study: Study | str | Path, draw_id: int = 0, variant_id: int = 0) -> Record:
    """Return the output of a simulated study's sensors as a record that can be written to a file.

    Args:
        study: simulated study, its file, or the name of a shipped study.
        draw_id: draw of the noise.
        variant_id: variant of Earth, motion and sensors, if these are swept.

    Raises:
        InputError: the study has no such variant or draw, or reads a record itself.

    Examples:
        >>> record = sinsjax.simulated_record("paper1_resets")
        >>> record.rate_hz, record.dtheta.shape  # rad per sample
        (100.0, (90000, 3))
    """
    runtime.ensure_configured()
    study = load_study(study)
    if study.is_recorded or not 0 <= variant_id < study.n_variants:
        raise InputError(f"{study.name}: has no simulated variant {variant_id}")
    if draw_id < 0:
        raise InputError(f"{study.name}: has no draw {draw_id}")
    scenario = Scenario(study, curves=False)
    number = next(i for i, ids in enumerate(scenario.variant_ids) if variant_id in ids)
    part = scenario.part(number, range(draw_id, draw_id + 1))
    return next(simulated_records(study, part.group))


def simulated_records(study: Study, group: Group) -> Iterator[Record]:
    """Yield the record of each draw of a group, see `simulated_record`; one program serves all."""
    static, environment = group.static, group.environment
    model = environment.sensors
    samples = min(static.records, int(environment.pass_records)) * static.record_every
    if model.increments is None and model.motion is not None:
        place = environment.site.place
        whole = true_increments(model.motion, place, study.rate_hz, samples, axes=True)
        model = model._replace(increments=whole[:, :6], axes=whole[:, 6:])
        environment = environment._replace(sensors=model)
    for number in range(group.sizes[0]):
        draw = jax.tree.map(
            lambda a, at=number: a[at : at + 1] if np.ndim(a) else np.full(1, a), group.draws
        )
        out, site = _measure(static, samples, environment, draw)
        site = jax.tree.map(lambda a: np.ravel(a)[0], site)
        yield Record(
            dtheta=np.stack([np.asarray(axis)[:, 0] for axis in out.dtheta], axis=1),
            dv=np.stack([np.asarray(axis)[:, 0] for axis in out.dv], axis=1),
            rate_hz=study.rate_hz,
            latitude_deg=float(site.latitude / DEG),
            height_m=float(site.earth.height),
            gravity_m_per_s2=float(site.place.gravity),
            source=study.name,
        )


@partial(jax.jit, static_argnums=(0, 1))
def _measure(
    static: Static, samples: int, environment: Environment, draw: Draw
) -> tuple[Increments, Site]:
    """Return the increments (samples, 1) of a single draw, leaves (1, ...), and its site."""
    draw = _with_derived_inputs(static, environment, draw)
    sensors = build_sensors(static, environment, draw)
    measure = sensors.make_sampler(jnp.arange(samples))
    increments, _ = measure(sensors.initial_state(), jnp.arange(samples))
    return increments, select_site(environment.site, draw)


def _with_derived_inputs(static: Static, environment: Environment, draws: Draw) -> Draw:
    """Return a single draw, leaves (1, ...), with the inputs that follow from it."""
    derived = jax.vmap(partial(derive_inputs, static, environment))(draws)
    return draws._replace(derived=derived)


def _split(study: Study) -> Iterator[np.ndarray]:
    """Yield the numbers of variants that share program and environment, by first appearance."""
    keys = {*PROGRAM_KEYS, *ENVIRONMENT_KEYS, *PASS_KEYS}
    swept = [key for key in study.axis_keys if key in keys]
    swept += ["reset_trigger"] if study.names_schedules else []
    codes = study.resolved.column(*swept).codes if swept else np.zeros(study.n_variants, int)
    _, first, part = np.unique(codes, return_index=True, return_inverse=True)
    in_order = np.argsort(part, kind="stable")
    ids = np.split(in_order, np.cumsum(np.bincount(part))[:-1])
    yield from (ids[number] for number in np.argsort(first))


def _span(study: Study, variants: Variants) -> Span:
    return study.span(**{k: variants.common(k) for k in PASS_KEYS} if study.passes else {})


def _criteria(study: Study, variants: Variants) -> Criteria:
    """Return the criteria by which the runs of some variants are judged."""
    settings, before = study.study, 0
    if study.counts_before:
        coarse = (variants.common(key) for key in COARSE_KEYS)
        before = study.samples_before(study.rate_hz, *coarse)
    return Criteria(
        bands=np.asarray(settling_bands(study)) * ARCMIN,
        window_start=np.float64(settings.window_s[0]),
        window_end=np.float64(settings.window_s[1]),
        consistency_after=np.float64(settings.consistency_after_s),
        steady_after=np.float64(settings.steady_after_s),
        report_samples=study.report_samples(before) if study.report_times_s else None,
    )


def _program(study: Study, variants: Variants, curves: bool) -> Static:
    """Return the program of some variants."""
    simulated = not study.is_recorded
    span, kept = _span(study, variants), 0
    method = variants.common("method")
    stores_blocks = METHODS[method].program.block_fit is not None
    blocks = (study.record_every, span.records) if stores_blocks else (0, 0)
    reverses = study.passes is not None and not span.rewinds
    if simulated and reverses and variants.is_active(*SEQUENTIAL_KEYS):
        # Of one length for all parts, so that they share a program.
        kept = max(span.records_read for span in study.distinct_spans) * study.record_every
    return Static(
        method,
        Options(
            dt=1 / study.rate_hz,
            specific_force=variants.common("specific_force") or "measured",
            position=variants.common("position"),
            trigger=(study.has("resets") and variants.common("reset_trigger")) or "none",
            innovations=study.is_recorded,  # a simulation has the truth to be judged by
            record_every=blocks[0],
            records=blocks[1],
        ),
        study.record_every,
        span.records,
        curves,
        sensors=SensorProgram(
            noisy=simulated and variants.is_active(*NOISE_KEYS),
            distorted=simulated and variants.is_active(*DISTORTION_KEYS),
            sways=simulated and moves(variants),
            kept=kept,
        ),
        passes="rewind" if span.rewinds else "alternate" if study.passes is not None else "once",
        coarse=_coarse_stage(study, variants),
    )


def _coarse_stage(study: Study, variants: Variants) -> CoarseStage | None:
    """Return coarse alignment if it is a stage of the runs of some variants, else None."""
    if not study.coarse:
        return None
    method, length_s, then = (variants.common(key) for key in COARSE_KEYS)
    if not study.has_coarse_stage(method, then):
        return None
    records = round(length_s * study.rate_hz / study.record_every)
    return CoarseStage(method, records, then == "replay")


def _run_params(study: Study, variants: Variants) -> RunParams:
    """Return the params of a part's variants, leaves (variants, ...)."""
    zero = np.zeros(len(variants.ids))
    start = [f"phi_{axis}0_deg" for axis in "enu"]
    drawn = any(key in study.drawn_keys for key in start)
    euler = variants.coded("misalignment").compute(lambda meaning: meaning == "euler", bool)
    phi = Vec3(*(variants.column(key, DEG) for key in start))
    if euler.any() and not drawn:
        phi = _rotation_vectors(variants.coded("misalignment", *start))
    return RunParams(
        q=Quat(zero, zero, zero, zero),
        phi=phi,
        ve=variants.column("ve0_m_per_s"),
        vn=variants.column("vn0_m_per_s"),
        method=METHODS[variants.common("method")].params(variants, np),
        euler=euler if drawn and euler.any() else None,
    )


def _rotation_vectors(starts: CodedColumn) -> Vec3:
    """Return rotation vectors of initial misalignments given in degrees, leaves (variants,)."""
    angles = np.asarray([values[1:] for values in starts.choices], dtype=float).T * DEG
    euler = np.asarray([values[0] == "euler" for values in starts.choices])
    vectors = np.where(euler, np.stack(_euler_vectors(*angles)), angles)
    return Vec3(*vectors[:, starts.codes])


@jax.jit
def _euler_vectors(e: Array, n: Array, u: Array) -> Vec3:
    return jax.vmap(euler_vector)(e, n, u)
