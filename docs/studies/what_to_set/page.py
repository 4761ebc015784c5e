"""The settings that the studies support: numbers of their pages, gathered."""

from sinsjax.report.folder import Page, Sources

from ..adaptive import page as adaptive
from ..compass_map import page as compass_map
from ..consistency import page as consistency
from ..kalman_passes import page as kalman_passes
from ..reset_cycle import page as reset_cycle
from ..tuning import page as tuning

CLAIMS = (
    (
        "reset_cycle",
        "two resets settle every misalignment with feedback up to 1 s",
        "three late resets settle every misalignment under every reading and feedback",
        "with gravity in A(t) every misalignment settles without reset, feedback up to 1 s",
        "one reset at the right time is nearly always enough",
        "just before or with a feedback is a bad time for a reset",
    ),
    (
        "adaptive",
        "with feedback up to 1 s it is as fast in every cell, without a false alarm",
        "with feedback every 10 s it misses some cells and raises false alarms",
        "on the record the trigger settles every start, sooner than the paper's four",
    ),
    ("tuning", "the plain two are nearly as fast at condition 5", "the tuned Q breaks NEES"),
    (
        "compass_map",
        "80 s with the best schedule settle far sooner than Scheme 1",
        "with 600 s of data nearly every draw comes within the narrow band",
    ),
    (
        "kalman_passes",
        "inflated or reset, NEES lies about its band",
        "a second pass takes most of a large error, a third nothing",
    ),
    ("consistency", "too small a Q is above", "a bias is above in NEES and not in NIS"),
)
"""By page, what a line of this one rests on."""


def page(sources: Sources) -> Page:
    """The values and claims of other pages that a line rests on."""
    scripts = {
        "reset_cycle": reset_cycle,
        "adaptive": adaptive,
        "tuning": tuning,
        "compass_map": compass_map,
        "kalman_passes": kalman_passes,
        "consistency": consistency,
    }
    made = {name: script.page(sources) for name, script in scripts.items()}
    cycle, trigger = made["reset_cycle"].values, made["adaptive"].values
    compass, passes = made["compass_map"].values, made["kalman_passes"].values
    values = {
        "worst": cycle["worst"],
        "two": cycle["two"],
        "three": {"name": cycle["slow"]["late"], "mean": cycle["slow"]["mean"]},
        "gravity": cycle["gravity"],
        "single": {name: cycle["single"][name] for name in ("enough", "points")},
        "phase": cycle["phase"],
        "trigger": {name: trigger["best"][name] for name in ("threshold", "short", "slow_alarms")},
        "car": {name: trigger["car"][name] for name in ("time", "fixed")},
        "tuned": {name: made["tuning"].values["small"][name] for name in ("best", "plain")},
        "record": {name: compass["record"][name] for name in ("wide", "narrow", "bound")},
        "long": {name: compass["long"][name] for name in ("narrow", "share")},
        "bands": compass["bands"],
        "set": compass["set"],
        "passes": {name: passes["reset"][name] for name in ("first", "second", "third")},
        "biased": {"nees": made["consistency"].values["biased"]["nees"]},
    }
    claims = {text: made[name].claims[text] for name, *texts in CLAIMS for text in texts}
    tables = {"filter": made["reset_cycle"].tables["settings"]}
    return Page(values, tables, {"answer": made["reset_cycle"].figures["answer"]}, claims)
