"""Draws the body axes of records and the sign of yaw: ``python docs/figures/body_axes.py``."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon

from sinsjax.plots.style import GREY, line_colour, render_png, with_style

_ALONG = {"right": (0.86, -0.3), "front": (0.62, 0.5), "up": (0.0, 1.0)}
"""Where the ways of the body point on paper, seen from behind, from the right and from above."""

_WAYS = {
    "frd": ("front", "right", "down"),
    "flu": ("front", "left", "up"),
    "rfu": ("right", "front", "up"),
}
_OPPOSITE = {"down": "up", "left": "right"}
_HALF = {"right": 0.75, "front": 1.1, "up": 0.22}
_BESIDE = {"right": (0.0, -0.12)}
_TOLD = {"frd": "aerospace", "flu": "ROS", "rfu": "PSINS, and inside sinsjax"}


def _paper(right: float = 0.0, front: float = 0.0, up: float = 0.0) -> np.ndarray:
    ways = zip((right, front, up), _ALONG.values(), strict=True)
    return sum((size * np.asarray(way) for size, way in ways), np.zeros(2))


def _box(axes: Axes) -> None:
    """The box of the sensors, with an arrowhead on top that points front."""
    right, front, up = _HALF.values()
    ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    faces = {
        "#f1f1f1": [(a * right, b * front, up) for a, b in ring],
        "#dddddd": [(a * right, -front, b * up) for a, b in ring],
        "#c9c9c9": [(right, a * front, b * up) for a, b in ring],
    }
    for shade, corners in faces.items():
        axes.add_patch(Polygon([_paper(*corner) for corner in corners], fc=shade, ec=GREY, lw=0.8))
    head = [(-0.3, 0.55, up), (0.3, 0.55, up), (0.0, 1.0, up)]
    axes.add_patch(Polygon([_paper(*corner) for corner in head], fc=GREY, ec="none"))


def _triad(axes: Axes, name: str) -> None:
    _box(axes)
    for number, (letter, way) in enumerate(zip("xyz", _WAYS[name], strict=True)):
        base = _OPPOSITE.get(way, way)
        size = (2.0 if base == "front" else 1.75) * (1 if way == base else -1)
        tip = _paper(**{base: size})
        begin = _paper(up=_HALF["up"])
        style = {"arrowstyle": "-|>", "lw": 2.2, "color": line_colour(number), "mutation_scale": 16}
        axes.annotate("", begin + tip, begin, arrowprops=style)
        place = begin + tip * (1.16 if base == "up" else 1.22) + _BESIDE.get(base, 0)
        axes.text(*place, f"{letter} {way}", color=line_colour(number), ha="center", va="center")
    axes.set_title(f'axes_order = "{name}"', loc="center")
    axes.text(0, -2.6, _TOLD[name], ha="center", color="#555555")
    axes.set(xlim=(-2.6, 2.6), ylim=(-2.8, 2.6))


def _yaw(axes: Axes, yaw_deg: float = 35.0) -> None:
    """Seen from above: north, and the front of a body whose yaw is positive."""
    style = {"arrowstyle": "-|>", "lw": 1.6, "color": GREY, "mutation_scale": 14}
    for tip, word in (((0, 2.0), "north"), ((2.0, 0), "east")):
        axes.annotate("", tip, (0, 0), arrowprops=style)
        axes.text(*(1.14 * np.asarray(tip)), word, ha="center", va="center", color="#555555")
    yaw = np.radians(yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    body = np.array([(-0.4, -0.7), (0.4, -0.7), (0.4, 0.5), (0.0, 0.9), (-0.4, 0.5)])
    axes.add_patch(Polygon(body @ turn.T, fc="#e6e6e6", ec=GREY, lw=0.8, zorder=0))
    front = turn @ (0, 2.0)
    axes.annotate("", front, (0, 0), arrowprops=style | {"color": line_colour(0), "lw": 2.2})
    axes.text(*(1.14 * front), "front", ha="center", va="center", color=line_colour(0))
    axes.add_patch(
        Arc((0, 0), 2.6, 2.6, theta1=90, theta2=90 + yaw_deg, color=line_colour(1), lw=2)
    )
    axes.text(-0.55, 1.45, "yaw", color=line_colour(1), ha="center")
    axes.text(0, -1.75, f"yaw_deg = +{yaw_deg:g}\nheading_deg = {360 - yaw_deg:g}", ha="center",
              va="center")  # fmt: skip
    axes.set_title("from above", loc="center")
    axes.text(0, -2.6, "counter-clockwise from north", ha="center", color="#555555")
    axes.set(xlim=(-2.6, 2.6), ylim=(-2.8, 2.6))


@with_style
def figure() -> Figure:
    """The three orders of axes, and yaw against heading."""
    drawn = Figure(figsize=(12.4, 3.9))
    panels = drawn.subplots(1, 4)
    for axes, name in zip(panels, _WAYS, strict=False):
        _triad(axes, name)
    _yaw(panels[3])
    for axes in panels:
        axes.set_aspect("equal")
        axes.set_axis_off()
    return drawn


if __name__ == "__main__":
    Path(__file__).with_suffix(".png").write_bytes(render_png(figure()))
