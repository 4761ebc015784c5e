"""What version 1.0 had and this version does not have, each with what to use instead.

The texts end a line such as ``[filter] turning: is gone since 1.1 (...)``.
"""

KEYS: dict[str, str] = {
    "study.check_linearity": "results are of draws; drop it",
    "study.estimate_samples": "results are of draws; drop it",
}
"""Keys of studies, by ``section.key``."""

VALUES: dict[tuple[str, str], str] = {
    ("study.estimate", "covariance"): "drop it to run draws; a lower bound of the heading error"
    " is `sinsjax.information_bound`",
    ("tune.searches", "covariance"): "use 'gradient' or 'sobol'",
}
"""Values of keys, by ``section.key`` and value."""

COMMANDS: dict[str, str] = {}
"""Commands of the command line."""

OPTIONS: dict[tuple[str, str], str] = {}
"""Options, by command and option with its dashes."""
