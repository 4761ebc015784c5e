"""What holds of some methods in the tests, beside what a `Method` says."""

from typing import NamedTuple


class MethodFacts(NamedTuple):
    """What the tests know of a method that its description does not state.

    Attributes:
        states: its states, if they are those of [P1], or [P1]'s and biases, with a P0 and Q each;
            empty for all other methods.
        stays_at_truth: whether a run without sensor errors that starts at the truth stays there.
            If not, the method takes that heading for no better than any other, or has no heading.
        extra: its params beside those of the filter of [P1]; None for none.
    """

    states: tuple[str, ...] = ()
    stays_at_truth: bool = False
    extra: float | None = None


FIVE = ("dve", "dvn", "phi_e", "phi_n", "phi_u")
TEN = (*FIVE, "nabla_x", "nabla_y", "eps_x", "eps_y", "eps_z")

FACTS = {
    "kalman5": MethodFacts(FIVE, stays_at_truth=True),
    "kalman10": MethodFacts(TEN, stays_at_truth=True),
    "ekf_azimuth": MethodFacts(FIVE, stays_at_truth=True, extra=1.0),
    "invariant": MethodFacts(FIVE, stays_at_truth=True),
    "unscented": MethodFacts(),  # its sigma points lie across the circle, so their mean is off
    "compass": MethodFacts(stays_at_truth=True),
}
