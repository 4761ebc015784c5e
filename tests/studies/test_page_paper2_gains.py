import pytest

from docs.studies.paper2 import page as paper2
from sinsjax.methods.compass import design


@pytest.mark.parametrize(
    ("text", "value", "same"),
    [
        ("0.06", 0.0649, True),
        ("0.06", 0.066, False),
        ("4.082e-9", 4.0816e-9, True),
        ("4.082e-9", 4.0814e-9, False),
        ("0.000081632653", 1.6326530612e-6, False),
        ("1040.33306122", 1040.33224, False),
    ],
)
def test_agrees_compares_to_last_printed_digit(text, value, same):
    assert paper2.agrees(text, value) is same


def test_printed_k3_makes_level_loop_unstable():
    earth = {"gravity": 9.8, "radius": paper2.RADIUS}
    formula = design.level_gains(0.02, design.PAPER_DAMPING, **earth)
    printed = formula._replace(k3=float(paper2.LEVEL_K3))
    found = [design.roots(design.level_polynomial(g, **earth)) for g in (printed, formula)]
    assert sorted(found[0].real.round(4)) == [-0.1108, 0.0254, 0.0254]
    assert sorted(found[1].real.round(4)) == [-0.02, -0.02, -0.02]
