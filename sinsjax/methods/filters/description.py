"""What every filter that measures zero velocity says of itself."""

from functools import partial

from sinsjax.methods.description import INITIAL_KEYS, Description
from sinsjax.methods.filters.columns import INNOVATIONS
from sinsjax.methods.filters.section import FilterSection, ResetsSection, check_resets
from sinsjax.methods.triggers.columns import TRIGGER_COUNTS, last_called
from sinsjax.methods.triggers.section import check_trigger

READS = (
    *INITIAL_KEYS,
    *("feedback_interval_s", "feedback_time_constant_s"),
    *("turn_covariance", "turn_inflation"),
)
"""The keys of [alignment] and [passes] that act on every filter."""

OF_BIASES = (
    *("p0_gyro_bias_deg_per_h", "p0_accel_bias_ug"),
    *("reset_gyro_bias_deg_per_h", "reset_accel_bias_ug"),
)
"""The keys of states of sensor biases: silent for a filter without."""

COLUMNS = (*TRIGGER_COUNTS, *INNOVATIONS)

filter_description = partial(
    Description,
    sections={"filter": FilterSection, "resets": ResetsSection},
    reads=READS,
    silent=OF_BIASES,
    has_error_step=True,
    rules=(check_trigger, check_resets),
    columns=COLUMNS,
    last_called=last_called,
)
"""`Description` of a filter without states of sensor biases; what differs is given."""


def knows_biases(method: Description) -> bool:
    """Whether a filter has states of sensor biases."""
    return not {*OF_BIASES} <= {*method.silent}
