"""From a study to arrays: the one place where units are left behind and programs part from numbers.

A `Part` holds the variants that share a compiled program and a world (Earth, base motion, sensors);
within a part everything that differs is a number. Parts are cut from the study's variants by the
values of `PROGRAM_KEYS`, `WORLD_KEYS` and `PASS_KEYS`, wherever these are swept.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from sinsjax import runtime, tunings
from sinsjax.alignment.base import Options, Site
from sinsjax.batch import Group
from sinsjax.columns import bands
from sinsjax.metrics import Criteria
from sinsjax.records import Record
from sinsjax.rotations import from_euler, log
from sinsjax.sections import Earth, Motion, Sensors
from sinsjax.simulate import Draw, Params, Static, World, noise, sense
from sinsjax.studies import PASS_KEYS, Study
from sinsjax.types import Array, Increments, InputError, Quat, Vec3
from sinsjax.units import ARCMIN, DEG
from sinsjax.worlds import Tape, Variants, recorded, simulated, site_of

PROGRAM_KEYS = ("method", "specific_force", "position")
"""Keys whose values decide the compiled program."""

WORLD_KEYS = tuple(key for model in (Earth, Motion, Sensors) for key in model.model_fields)
"""Keys whose values decide the truth that runs share."""


class Part(NamedTuple):
    """Variants of a study that run together.

    Attributes:
        group: what the engine runs.
        variant_ids: (variants,) their numbers in the study.
    """

    group: Group
    variant_ids: np.ndarray


def parts(study: Study, tape: Tape | None = None, *, curves: bool | None = None) -> Iterator[Part]:
    """What the engine runs for a study, part by part: a part is made when it is asked for.

    Args:
        study: checked study.
        tape: the record of a recorded study, else None.
        curves: whether curves are returned; None takes the study's word.

    Raises:
        InputError: a record that does not fit the study, or compass loops that cannot be run.
    """
    if study.is_recorded != (tape is not None):
        what = "reads a record, none is given" if study.is_recorded else "reads no record"
        raise InputError(f"{study.study.name}: the study {what}: see [record]")
    keep_curves = study.study.curves if curves is None else curves
    split = [Variants(study, ids) for ids in _split(study)]
    for variants in split:
        tunings.check_loops(study, variants, site_of(study, variants, tape)[0])
    return (_part(study, variants, tape, keep_curves) for variants in split)


def simulated_record(study: Study, draw_id: int = 0, variant_id: int = 0) -> Record:
    """What the sensors of a simulated study put out, as a record that can be written to a file.

    Args:
        study: a simulated study.
        draw_id: whose noise.
        variant_id: whose Earth, motion and sensors, where these are swept.

    Raises:
        InputError: the study has no such variant, or reads a record itself.
    """
    if study.is_recorded or not 0 <= variant_id < study.n_variants:
        raise InputError(f"{study.study.name}: has no simulated variant {variant_id}")
    part = _part(study, Variants(study, np.array([variant_id])), None, False)
    static, world = part.group.static, part.group.world
    draw = Draw(np.asarray(draw_id), np.asarray(0), np.asarray(0))

    @jax.jit
    def rows(world: World, draw: Draw, numbers: Array) -> Increments:
        normal = noise(static, world, draw, numbers)
        return jax.vmap(partial(sense, static, world, draw))(numbers, normal)

    records = min(static.records, int(world.pass_records))
    out = rows(world, draw, np.arange(records * static.record_every))
    return Record(
        dtheta=np.stack(out.dtheta, axis=1),
        dv=np.stack(out.dv, axis=1),
        rate_hz=study.study.rate_hz,
        latitude_deg=float(world.site.latitude / DEG),
        height_m=float(world.site.earth.height),
        gravity_m_per_s2=float(world.site.place.gravity),
        source=study.study.name,
    )


def _split(study: Study) -> Iterator[np.ndarray]:
    """Numbers of the variants that share program and world, in order of first appearance."""
    keys = {*PROGRAM_KEYS, *WORLD_KEYS, *PASS_KEYS}
    swept = [key for key in study.axis_keys if key in keys]
    columns = [study.values(key) for key in swept]
    groups: dict[tuple[Any, ...], list[int]] = {}
    for i in range(study.n_variants):
        groups.setdefault(tuple(column[i] for column in columns), []).append(i)
    yield from (np.asarray(ids) for ids in groups.values())


def _part(study: Study, variants: Variants, tape: Tape | None, curves: bool) -> Part:
    runtime.require_x64()
    options = Options(
        dt=1 / study.study.rate_hz,
        specific_force=variants.common("specific_force") or "measured",
        position=variants.common("position"),
    )
    site, ug = site_of(study, variants, tape)
    criteria = Criteria(
        bands=np.asarray(bands(study.study.settle_bands_arcmin)) * ARCMIN,
        window_start=np.float64(study.study.window_s[0]),
        window_end=np.float64(study.study.window_s[1]),
        consistency_after=np.float64(study.study.consistency_after_s),
        steady_after=np.float64(study.study.steady_after_s),
    )
    span = study.span(**{k: variants.common(k) for k in PASS_KEYS} if study.passes else {})
    if tape is None:
        world, draws, q = simulated(study, variants, span, site, criteria, ug)
    else:
        world, draws, q = recorded(study, tape, span, site, criteria)
    noise = (world.errors.gyro_noise, world.errors.accel_noise)
    static = Static(
        variants.common("method"),
        options,
        study.record_every,
        span.records,
        curves,
        noisy=bool(np.any(noise)),
        repeats=study.passes is not None,
    )
    group = Group(static, world, draws, q, _params(study, variants, site, ug))
    return Part(group, variants.ids)


def _params(study: Study, variants: Variants, site: Site, ug: float) -> Params:
    """Numbers of the part's variants, leaves (variants, ...)."""
    zero = np.zeros(len(variants.ids))
    return Params(
        q=Quat(zero, zero, zero, zero),
        phi=_misalignment(variants),
        ve=variants.column("ve0_m_per_s"),
        vn=variants.column("vn0_m_per_s"),
        method=tunings.of_method(study, variants, site, ug),
    )


@jax.jit
def _euler_vectors(e: Array, n: Array, u: Array) -> Vec3:
    return jax.vmap(lambda *angles: log(from_euler(*angles)))(e, n, u)


def _misalignment(variants: Variants) -> Vec3:
    e, n, u = (variants.column(f"phi_{axis}0_deg", DEG) for axis in "enu")
    euler = np.asarray(variants.raw("misalignment")) == "euler"
    if not euler.any():
        return Vec3(e, n, u)
    # [P1] section 1: angles from the ideal to the computed frame, about U, E, N in turn.
    vector = _euler_vectors(e, n, u)
    return Vec3(*(np.where(euler, v, a) for v, a in zip(vector, (e, n, u), strict=True)))
