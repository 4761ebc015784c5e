"""What version 1.0 had and this version does not have, each with what to use instead.

The texts end a line such as ``[filter] turning: was removed after 1.0 (...)``.
"""

MARK = "was removed after 1.0"
LINE = MARK + " ({})"
"""The message about something that is gone, with the text about it."""

KEYS: dict[str, str] = {
    "advise.known_heading_deg": "drop it: no number depended on it",
    "study.check_linearity": "drop it, with estimate = 'covariance'",
    "study.estimate_samples": "drop it, with estimate = 'covariance'",
    **dict.fromkeys(
        ("compass.level_adjustment_s", "compass.azimuth_adjustment_s"),
        "give the loop's sigma_per_s; `sinsjax gains` shows its period and settling time",
    ),
    **dict.fromkeys(
        ("compass.adjustment_reading", "compass.adjustment_remainder"),
        "drop it; `sinsjax gains` shows period and settling time of a sigma",
    ),
    "compass.allow_unstable": "drop it: runs of unstable loops have the status 'diverged'",
    "compass.level_passes": "use level_time_s",
    "compass.sigma_passes": "use sigma_times_s",
    "passes.direction": "drop it: every second pass is backward",
    "filter.turning": "drop it; on turned bases use method = 'gravity_fit'",
    "filter.turning_rate_deg_per_s": "drop it; on turned bases use method = 'gravity_fit'",
}
"""Keys of studies, by ``section.key``."""

_TRIGGERS = ("nis", "whiteness", "tilt_drift", "levelled", "strong_tracking", "fading")
_TRIGGER = "use 'linearisation', or the textbook's test 'innovation'"

VALUES: dict[tuple[str, str], str] = {
    ("study.estimate", "covariance"): "drop it to run draws; a lower bound of the heading error"
    " is `sinsjax.information_bound`",
    **dict.fromkeys((("resets.reset_trigger", name) for name in _TRIGGERS), _TRIGGER),
    ("coarse.coarse_method", "analytic"): "use 'inertial', which needs no rigid mount",
    ("tune.searches", "random"): "use 'sobol'",
    ("tune.searches", "covariance"): "use 'gradient' or 'sobol'",
}
"""Values of keys, by ``section.key`` and value."""

COMMANDS: dict[str, str] = {
    "bench": "python benchmarks/bench.py, in the repository",
    "terms": "docs/glossary.md",
}
"""Commands of the command line."""

OPTIONS: dict[tuple[str, str], str] = {
    ("export", "--blind"): "leave truth.parquet out of what you hand on",
    ("export", "--draws"): "use --set study.draws=N",
    ("export", "--overwrite"): "delete the export, or give another directory",
    ("export", "--quantity"): "mean rates are the increments times rate_hz",
    ("export", "--resume"): "export again",
    ("report", "--page"): "use --html FILE",
    ("score", "--against"): "the study's own methods run once, into own in the export",
    ("score", "--frame"): "export with the --frame of the program",
    ("score", "--out"): "the results are in scores/NAME in the export",
    ("score", "--overwrite"): "results of the same name are replaced",
    ("schedule", "--study"): 'write schedule = "law" in [resets], or --set resets.schedule=law',
    ("sweep", "--workers"): "start `dask scheduler` and `dask worker`, give --scheduler URL",
}
"""Options, by command and option with its dashes."""

NAMES: dict[str, str] = {
    "Score": "`sinsjax.score_results` returns results",
    "estimate": "use `sinsjax.run`: every result is of draws",
    "estimated_curves": "use `sinsjax.read_curves`",
    "read_estimates": "use `sinsjax.read_summary`",
}
"""Names of the package in Python."""
