"""Methods against the information bound: how far each is from the least that noise allows."""

import numpy as np

import sinsjax
from sinsjax.analysis import Estimate, format_estimate, rms
from sinsjax.execution.source import Source
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page

from ..common.grids import grid_of
from .field import bases_of, start_samples

TIME_S = 300
AIM = 1.5
"""What is aimed at, times the bound."""

SURGE, SINCOS, PUBLISHED = "kalman_surge", "kalman_sincos", "kalman_sincos, published Q"


def bounded(source: Source) -> Page:
    """Every method's rms error over the bound, on every base."""
    study = source.study
    models = study.values("surge_model")
    words = [
        f"{base.words} ({model.replace('_', ' ')})"
        if base.surge and not base.vibration
        else base.words
        for base, model in zip(bases_of(source), models, strict=True)
    ]
    column = f"phi_u_at_{TIME_S}_arcmin"
    grid = grid_of(
        source, [column, "floor_arcmin"], case="case", start=start_samples(source), base=words
    )
    bounds = {
        words[row["variant_id"]]: row["bound_u_arcmin"]
        for row in sinsjax.information_bound(study).to_pylist()
        if row["time_s"] == TIME_S
    }

    def ratio(case: str, base: str) -> Estimate:
        errors = grid.at(column, case=case, base=base) - grid.at(
            "floor_arcmin", case=case, base=base
        )
        cluster = np.broadcast_to(np.arange(grid.draws), errors.shape)
        told = rms(errors.ravel(), cluster.ravel())
        value, low, high = (number / bounds[base] for number in told[:3])
        return Estimate(value, low, high, told.n)

    bases = grid.axes["base"]
    cases = [
        one for one in grid.axes["case"] if np.isfinite(grid.at("floor_arcmin", case=one)).all()
    ]
    ratios = {case: {base: ratio(case, base) for base in bases} for case in cases}
    rows = [["the bound (arcmin)", *(f"{bounds[base]:.2f}" for base in bases)]]
    rows += [
        [case, *(format_estimate(one, digits=2) for one in of.values())]
        for case, of in ratios.items()
    ]
    note = f"Rms error from the bias floor after {TIME_S} s, {grid.draws} draws, no biases."
    table = Table("Ratios to the bound", ["method", *bases], rows, note, folded=True)
    worst = {case: max(ratios[case].values()) for case in cases}
    values = {
        "sincos": f"{worst[SINCOS].value:.2f}",
        "surge": f"{worst[SURGE].value:.2f}",
        "published": f"{worst[PUBLISHED].value:.2f}",
        "optimisation": f"{worst['optimisation'].value:.2f}",
        "position": f"{worst['optimisation_position'].value:.2f}",
    }
    claims = {
        "two filters reach the aim on every base": all(
            worst[case].value <= AIM for case in (SINCOS, SURGE)
        ),
        "published settings and velocities do not": all(
            worst[case].low > AIM for case in (PUBLISHED, "optimisation")
        ),
    }
    return Page({"better": values}, {"bounded": table}, claims=claims)
