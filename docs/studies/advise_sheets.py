"""Against draws: 60 random sheets, each as it is and turned, for docs/advise.md.

    python -m docs.studies.advise_sheets docs/tables/advise_sheets.csv      # an hour on two cores

A row is a figure that `sinsjax advise` prints, next to the rms of 1,024 draws of the study that it
writes. Sheets whose rows are in the file are not run again.
"""

import csv
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import sinsjax
from sinsjax import analysis
from sinsjax.advice.advise import describe_advice, rms_and_q95_of_noisy_direction
from sinsjax.analysis import Estimate
from sinsjax.units import ARCMIN

COLUMNS = (
    *("sheet", "sensors", "motion", "latitude (deg)", "time (s)", "turn", "method"),
    *("rms by advice (')", "rms of 1,024 draws (')", "ratio"),
)
SHEETS, SEED, DRAWS = 60, 20261130, 1024
GRADES = {"laser": (1.0, 1.0), "fibre": (8.0, 3.0), "mems": (300.0, 20.0)}
"""How many times the errors of a laser gyro those of gyros and of accelerometers are."""


def make_sheet(number: int) -> dict[str, Any]:
    """Return a random sheet."""
    rng = np.random.default_rng([SEED, number])

    def size(low: float, high: float) -> float:
        return float(f"{np.exp(rng.uniform(np.log(low), np.log(high))):.3g}")

    def some(share: float) -> bool:
        return rng.random() < share

    grade = str(rng.choice([*GRADES], p=[0.35, 0.4, 0.25]))
    scale, rough = GRADES[grade]
    arw, bias = size(0.0003, 0.003) * scale, size(0.002, 0.02) * scale
    vrw, accel = size(3.0, 20.0) * rough**0.6, size(15.0, 100.0) * rough
    sensors = {"gyro_arw_deg_per_sqrt_h": arw, "accel_vrw_ug_per_sqrt_hz": vrw}
    drawn = {"gyro_bias_deg_per_h": bias, "accel_bias_ug": accel}
    if some(0.6):
        sensors["gyro_instability_deg_per_h"] = size(0.2, 1.2) * bias
        sensors["gyro_instability_time_s"] = size(50.0, 1000.0)
    if some(0.5):
        sensors["gyro_rrw_deg_per_h_per_sqrt_h"] = size(0.5, 5.0) * bias
    if some(0.6):
        sensors["accel_instability_ug"] = size(0.1, 0.6) * accel
        sensors["accel_instability_time_s"] = size(50.0, 1000.0)
    if some(0.4):
        sensors["accel_rrw_ug_per_sqrt_h"] = size(0.2, 2.0) * accel
    if some(0.4):
        sensors["gyro_quantisation_arcsec"] = size(0.1, 2.0) * scale**0.6
    if some(0.4):
        sensors["accel_quantisation_um_per_s"] = size(20.0, 1000.0) * rough
    if some(0.5):
        drawn["gyro_scale_ppm"] = size(3.0, 30.0) * scale**0.8
        drawn["gyro_misalignment_arcsec"] = size(2.0, 20.0) * scale**0.5
    if some(0.3):
        drawn["accel_scale_ppm"] = size(30.0, 300.0) * rough**0.5
        drawn["accel_misalignment_arcsec"] = size(3.0, 30.0) * rough**0.5
    motion: dict[str, Any] = {}
    kind = str(rng.choice(["still", "rocking", "surging"], p=[0.25, 0.45, 0.3]))
    if kind != "still" and (kind == "rocking" or some(0.7)):
        for axis in ("pitch", "roll", "yaw"):
            if some(0.85) or axis == "roll":
                motion[f"{axis}_amplitude_deg"] = size(0.1, 5.0)
                motion[f"{axis}_period_s"] = float(f"{rng.uniform(3.0, 12.0):.3g}")
                motion[f"{axis}_phase_deg"] = float(round(rng.uniform(0, 360)))
    if kind == "surging":
        motion |= {"surge_m_per_s": size(0.05, 0.3), "surge_time_s": size(2.0, 10.0)}
    if some(0.4):
        arm = size(0.1, 3.0)
        axes = some(0.5)
        motion["lever_arm_m"] = arm if axes else [round(arm * x, 3) for x in rng.normal(size=3)]
    time_s = float(np.round(size(60.0, 600.0)))
    return {
        "study": {"name": f"{grade}, {kind}"},
        "earth": {"latitude_deg": float(round(rng.uniform(-60.0, 70.0)))},
        "sensors": {key: float(f"{value:.3g}") for key, value in sensors.items()},
        "drawn": {key: {"normal": [0.0, float(f"{v:.3g}")]} for key, v in drawn.items()},
        "motion": motion,
        "advise": {"time_s": time_s},
    }


def iter_figures(sheet: dict[str, Any]) -> Iterator[tuple[str, float, sinsjax.Advice]]:
    """Yield the turn, the rms (arcmin) and the advice of each figure that an advice prints."""
    advice = sinsjax.advise(sheet)
    yield "", advice.heading.rms_arcmin, advice
    printed = " ".join(" ".join(describe_advice(advice)).split())
    for one in advice.turns.options if advice.turns else ():
        words = "one 180 deg turn" if one.name == "half turn" else one.name
        if one.motion and words in printed:
            rms, _ = rms_and_q95_of_noisy_direction(one.sigma_arcmin * ARCMIN)
            turned = sinsjax.advise(sheet | {"motion": sheet["motion"] | one.motion})
            yield one.name, rms / ARCMIN, turned


def measure_rms(advice: sinsjax.Advice) -> Estimate:
    """Return the rms of the draws of the study that an advice writes, arcmin."""
    study = sinsjax.study_from_dict(tomllib.loads(advice.study()))
    if study.values("lever_arm_m") == [0.0]:  # the swing of an arm needs 100 Hz
        study = study.replace({"study.rate_hz": 20.0})
    results = sinsjax.run(study.replace({"study.draws": DRAWS}), curves=False)
    return analysis.rms(results.summary["phi_u_arcmin"].to_numpy())


def main() -> None:
    """Add the rows that a table lacks."""
    path = Path(sys.argv[1])
    sinsjax.configure()
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    with path.open(encoding="utf-8", newline="") as file:
        known = {int(row["sheet"]) for row in csv.DictReader(file)}
    for number in sorted({*range(SHEETS)} - known):
        sheet, rows = make_sheet(number), []
        for turn, said, advice in iter_figures(sheet):
            found = measure_rms(advice)
            place = sheet["earth"]["latitude_deg"], sheet["advise"]["time_s"]
            names = *sheet["study"]["name"].split(", "), *place, turn or "-", advice.choice.method
            measured = f"{found.value:.4g} [{found.low:.4g}, {found.high:.4g}]"
            numbers = f"{said:.4g}", measured, f"{said / found.value:.3f}"
            rows.append([number, *names, *numbers])
        with path.open("a", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()
