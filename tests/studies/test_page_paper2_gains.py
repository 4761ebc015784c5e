import pytest

from docs.studies.paper2 import gains
from sinsjax.report.base import Table


def table(number: int) -> Table:
    return gains.gain_blocks()[number]


def column(block: Table, name: str, occurrence: int = 0) -> list[str]:
    at = [i for i, head in enumerate(block.header) if head == name][occurrence]
    return [row[at] for row in block.rows]


@pytest.mark.parametrize(
    ("text", "value", "digits"),
    [
        ("0.06", 0.06, 1),
        ("0.06", 0.0649, 1),
        ("0.06", 0.066, 0),
        ("4.082e-9", 4.0816e-9, 4),
        ("4.082e-9", 4.0814e-9, 3),
        ("0.000081632653", 1.6326530612e-6, 0),
        ("1040.33306122", 1040.33224, 6),
        ("1.9999", 2.0001, 4),
    ],
)
def test_agreeing_digits(text, value, digits):
    assert gains.agreeing_digits(text, value) == digits


def test_every_printed_gain_but_the_horizontal_k3_follows_its_formula():
    block = table(0)
    assert column(block, "Printed") == [
        "0.06",
        "1040.33306122",
        "0.000081632653",
        "0.02",
        "259.3332653",
        "4.082e-9",
    ]
    agreeing = column(block, "Digits that agree")
    assert agreeing == ["1 of 1", "12 of 12", "0 of 8", "1 of 1", "10 of 10", "4 of 4"]
    remarks = column(block, "Remark")
    assert [bool(remark) for remark in remarks] == [False, False, True, False, False, False]
    assert remarks[2] == ("printed / formula = 50; 2 σ²/g = 8.1632653e-05 has 8 of 8 digits")


def test_the_printed_horizontal_k3_makes_the_loop_unstable():
    block = table(1)
    assert column(block, "Roots, 1/s") == [
        "+0.0254 +0.0811j, +0.0254 -0.0811j, -0.1108",
        "-0.0200 +0.0200j, -0.0200, -0.0200 -0.0200j",
    ]
    assert column(block, "Loop") == ["unstable", "stable"]


def test_sigma_by_two_readings():
    block = table(2)
    assert column(block, "Paper's formula") == ["0.041888", "0.013963"]
    assert column(block, "Printed gains") == ["0.020000 = 3/150", "0.010000 = 4.5/450"]
    assert column(block, "Left after it") == ["5.0 %", "1.1 %"]


def test_the_radius_that_the_printed_digits_fix():
    block = table(3)
    assert column(block, "R, m") == ["6378165", "6378160", "6378137"]
    assert column(block, "Digits that agree") == ["12 of 12", "6 of 12", "6 of 12"]
    assert column(block, "Digits that agree", 1) == ["10 of 10", "6 of 10", "5 of 10"]
    assert "6378164.99997 m by the horizontal" in block.note
    assert "6378164.99985 m by the azimuth" in block.note
