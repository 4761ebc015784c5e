"""Filters with their published settings and at their best, on conditions that favour none."""

from sinsjax.analysis import Estimate
from sinsjax.execution.source import Source
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page

from .field import angle, bases_of, brief, worst_start
from .why import Experiment

TIME_S = 300
COLUMN = f"phi_u_at_{TIME_S}_arcmin"
PUBLISHED, OWN, LAW = "kalman5", "kalman5, own noise", "kalman5, own noise, resets by the law"
INERTIAL, SINCOS = "inertial", "kalman_sincos, own noise"
BIASES = "kalman10, own noise"
SWAY, LEVER, SURGE = "sway", "sway with a lever arm", "sway and surge"


def at_their_best(source: Source) -> Page:
    """Every filter with both settings on every base, worst of the initial misalignments."""
    run = Experiment(source, COLUMN, base=bases_of(source))
    bases = {base.words: base for base in run.grid.axes["base"]}
    count = len(run.grid.axes["start"])

    def error(case: str, base: str) -> Estimate:
        return worst_start(run.errors(COLUMN, case=case, base=bases[base]))

    cases = run.grid.axes["case"]
    rows = [[case, *(angle(error(case, base)) for base in bases)] for case in cases]
    note = f"90 % of {run.grid.draws} draws after {TIME_S} s, worst of {count} misalignments."
    table = Table("All filters", ["method", *bases], rows, note, folded=True)
    told = {
        "published": (PUBLISHED, {"sway": SWAY}),
        "own": (OWN, {"sway": SWAY}),
        "law": (LAW, {"sway": SWAY}),
        "biases": (BIASES, {"sway": SWAY}),
        "inertial": (INERTIAL, {"sway": SWAY}),
        "sincos": (SINCOS, {"sway": SWAY, "lever": LEVER, "surge": SURGE}),
    }
    values = {
        name: {word: brief(error(case, base)) for word, base in on.items()}
        for name, (case, on) in told.items()
    }
    claims = {
        "the sensors' own noise repairs the plain filter on a swaying base": (
            10 * error(OWN, SWAY).high < error(PUBLISHED, SWAY).low
        ),
        "with resets by the law it is nearly as good as the best there": (
            error(LAW, SWAY).value < 1.2 * min(error(case, SWAY).value for case in cases)
        ),
        "with a lever arm or surge it has no heading": all(
            error(case, base).low > 5 * 60 for case in (OWN, LAW) for base in (LEVER, SURGE)
        ),
        "the filter in sine and cosine has one there": all(
            error(SINCOS, base).high < 60 for base in (LEVER, SURGE)
        ),
    }
    return Page({"fair": values}, {"fair": table}, claims=claims)
