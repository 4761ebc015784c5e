"""Initial alignment of strapdown inertial navigators: thousands of runs in one compiled call.

Terms and conventions of the whole package:

**Frames.** n is the navigation frame, east-north-up; b is the body frame, right-front-up.
``C_nb`` (and the quaternion ``q_nb``, scalar first) takes body vectors to n.

**Attitude.** ``C_b^n = Rz(yaw) Rx(pitch) Ry(roll)``. Yaw is counter-clockwise from north.

**Misalignment.** ``phi`` is the rotation vector between the true and the computed navigation
frame: ``C_b^{n'} = exp(-phi x) C_b^n``. A correction is ``C <- exp(+phi x) C``, ``V <- V - dV``.
A ``phi`` column is the rotation vector of ``C_true C_hat^T``, each component in (-180, 180] deg,
where ``C_hat`` is the corrected attitude that a user receives.

**Units.** SI units, radians and seconds inside. Outside (TOML keys, columns, axis labels) the unit
is part of the name: ``_deg``, ``_arcmin``, ``_deg_per_h``, ``_ug``, ``_s``, ``_m_per_s``.

**Bias floor and truth.** A heading is judged either from the truth (true north, or a record's
reference) or from the bias floor, the heading error that the run's own constant sensor biases make
unavoidable; every success and settling time states which.

**Letters.** ``eps`` gyro bias, ``nabla`` accelerometer bias, ``Phi`` transition, ``Q`` process
noise, ``R`` measurement noise, ``P`` covariance, ``K`` gain, as in the papers.

**Draws, variants, runs.** A draw is one realisation of the sensor noise; a variant is one point of
a study's axes; a run is one draw of one variant: ``run_id = draw_id * n_variants + variant_id``.
Noise depends on the seed and the draw alone, so all variants of a draw share it.

**Order within a sample.** Mechanise, predict, update, then feed back, reset and record if due. A
reset at t acts after the update of sample ``round(t/dt)``: the whole state is fed back, then the
covariance is reset.

**Import.** Importing the package changes nothing. `sinsjax.configure` sets double precision, the
number of CPU devices and XLA's compiler options for the whole process, as long as JAX has not
started. Every command calls it, and so does every function that computes if it was not called.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sinsjax.platform import runtime

if TYPE_CHECKING:
    from sinsjax.advice.advise import Advice, advise
    from sinsjax.analysis import summarise
    from sinsjax.arena.export import export_study, simulated_record
    from sinsjax.arena.score import score_results
    from sinsjax.bounds.turn_planner import TurnChoice, plan_turns
    from sinsjax.engine.one_run import one_run
    from sinsjax.errors import InputError, StudyWarning
    from sinsjax.execution.directory import read_manifest
    from sinsjax.execution.information import information_bound
    from sinsjax.execution.prepare import load_increments
    from sinsjax.execution.results import Results, read_curves, read_summary
    from sinsjax.execution.run import align, run, run_into
    from sinsjax.platform.runtime import configure, info
    from sinsjax.plots import plot_belief, plot_compare, plot_curves, plot_map
    from sinsjax.records import read_record, read_reference, record_from_arrays
    from sinsjax.study.load import load_study, study_from_dict
    from sinsjax.study.reset_plan import ResetPlan, reset_schedule
    from sinsjax.study.study import Study
    from sinsjax.tuning.history import read_history
    from sinsjax.tuning.results import TuningResults
    from sinsjax.tuning.run_tuning import tune

__version__ = runtime.package_version()

# fmt: off
__all__ = [
    "Advice", "InputError", "ResetPlan", "Results", "Study", "StudyWarning",
    "TuningResults", "TurnChoice", "advise", "align", "configure", "export_study", "info",
    "information_bound", "load_study", "load_increments", "one_run", "plan_turns",
    "plot_belief", "plot_compare", "plot_curves", "plot_map", "read_curves", "read_history",
    "read_manifest", "read_record", "read_reference", "read_summary", "record_from_arrays",
    "reset_schedule", "run", "run_into", "score_results", "simulated_record",
    "study_from_dict", "summarise", "tune",
]
# fmt: on

_HOMES = {
    "advice.advise": ("Advice", "advise"),
    "analysis": ("summarise",),
    "arena.export": ("export_study", "simulated_record"),
    "arena.score": ("score_results",),
    "execution.information": ("information_bound",),
    "bounds.turn_planner": ("TurnChoice", "plan_turns"),
    "engine.one_run": ("one_run",),
    "errors": ("InputError", "StudyWarning"),
    "execution.directory": ("read_manifest",),
    "execution.prepare": ("load_increments",),
    "execution.results": ("Results", "read_curves", "read_summary"),
    "execution.run": ("align", "run", "run_into"),
    "platform.runtime": ("configure", "info"),
    "plots": ("plot_belief", "plot_compare", "plot_curves", "plot_map"),
    "records": ("read_record", "read_reference", "record_from_arrays"),
    "study.load": ("Study", "load_study", "study_from_dict"),
    "study.reset_plan": ("ResetPlan", "reset_schedule"),
    "tuning.run_tuning": ("tune",),
    "tuning.history": ("read_history",),
    "tuning.results": ("TuningResults",),
}


def __getattr__(name: str) -> Any:
    # Imported on first use: a command needs only part of the package before XLA compiles.
    for home, names in _HOMES.items():
        if name in names:
            return globals().setdefault(name, getattr(import_module(f"sinsjax.{home}"), name))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
