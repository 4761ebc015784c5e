"""Keys and values of version 1.0 that this version does not have, with what to use instead."""

MARK = "was removed after 1.0"
LINE = MARK + " ({})"

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
    **dict.fromkeys(
        (("passes.turn", name) for name in ("velocity_drop_rate", "restart")), "use 'reflect'"
    ),
    ("tune.searches", "random"): "use 'sobol'",
    ("tune.searches", "covariance"): "use 'gradient' or 'sobol'",
}
"""Values of keys, by ``section.key`` and value."""
