"""Pixels and text from the layers and the look that an environment declares. It knows no class.

A file is loaded when something in it is first used.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.drawing.pictures import (
        GROUNDS,
        INK,
        NIGHT,
        Window,
        check_state,
        colored_text,
        empty_grid,
        enlarged,
        episode,
        fitting_cell,
        ground_of,
        human,
        image,
        planes_of,
        save_gif,
        save_png,
        scenery_of,
        text_drawing,
        without_margin,
    )
    from pharos.drawing.shapes import SHAPES, color_of, glyph_of, letter_color, shape_of, sprite_of, sprite_pixels, tile

__all__ = [
    "GROUNDS",
    "SHAPES",
    "episode",
    "human",
    "image",
    "text_drawing",
]

__getattr__ = lazy.attributes(__name__)
