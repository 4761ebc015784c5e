"""Numbers drawn from cached digits, since a map has hundreds of them.

Any other text is laid out and rendered each time it is drawn, which takes ten times as long.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.backend_bases import RendererBase
from matplotlib.colors import to_rgba
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.text import Text
from matplotlib.textpath import TextPath, text_to_path
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray


class Number(Text):
    """A number in upright digits, centred at its position; it is ignored by the layout."""

    def __init__(self, x: float, y: float, text: str, **style: Any) -> None:
        super().__init__(x, y, text, **style)
        self.set_in_layout(False)

    def draw(self, renderer: RendererBase) -> None:
        """Draw it as one path; with a box around it, as any text."""
        if self.get_bbox_patch() is not None:
            super().draw(renderer)
            return
        if not self.get_visible():
            return
        pixels = float(np.asarray(renderer.points_to_pixels(1.0)))
        x, y = self.get_transform().transform(self.get_position())
        place = Affine2D().scale(pixels).translate(x, y)
        gc = renderer.new_gc()
        gc.set_linewidth(0.0)
        path = _centred_outline(self.get_text(), float(self.get_fontsize()))
        renderer.draw_path(gc, path, place, to_rgba(self.get_color()))
        gc.restore()
        self.stale = False


@lru_cache(maxsize=4096)
def _centred_outline(text: str, size: float) -> Path:
    """The outline of a number about its centre, in points."""
    glyphs = [_glyph_outline(letter, size) for letter in text]
    starts = np.cumsum([0.0, *(width for *_, width in glyphs)])
    middle = (starts[-1] / 2, _digit_height(size) / 2)
    vertices = [
        outline + (start, 0.0) for (outline, *_), start in zip(glyphs, starts, strict=False)
    ]
    codes = [codes for _, codes, _ in glyphs]
    return Path(np.concatenate(vertices) - middle, np.concatenate(codes))


@lru_cache(maxsize=256)
def _glyph_outline(letter: str, size: float) -> tuple[NDArray, NDArray, float]:
    """Vertices (n, 2) and codes (n,) of a letter in the default font, and its width, in points."""
    font = FontProperties(size=size)
    path = TextPath((0.0, 0.0), letter, size=size, prop=font)
    width, _, _ = text_to_path.get_text_width_height_descent(letter, font, ismath=False)
    assert path.codes is not None
    return np.asarray(path.vertices), np.asarray(path.codes), float(width)


def _digit_height(size: float) -> float:
    """The height of a digit, in points."""
    vertices, _, _ = _glyph_outline("0", size)
    return float(vertices[:, 1].max())
