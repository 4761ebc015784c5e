"""Keys and values of version 1.0 that this version does not have, with what to use instead."""

MARK = "was removed after 1.0"
LINE = MARK + " ({})"

KEYS: dict[str, str] = {
    "study.check_linearity": "drop it, with estimate = 'covariance'",
    "study.estimate_samples": "drop it, with estimate = 'covariance'",
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
    ("tune.searches", "random"): "use 'sobol'",
    ("tune.searches", "covariance"): "use 'gradient' or 'sobol'",
}
"""Values of keys, by ``section.key`` and value."""
