"""Pixels and text from the layers and the look that an environment declares; knows no class."""

from pharos.drawing.pictures import INK, NIGHT, episode, human, image, save_gif, save_png
from pharos.drawing.planes import check_state, planes_of
from pharos.drawing.scenery import GROUNDS, ground_of, inside, scenery_of
from pharos.drawing.shapes import SHAPES, color_of, glyph_of, shade, shape_of, sprite_of, sprite_pixels, tile
from pharos.drawing.text import colored_text, text_drawing
from pharos.drawing.window import Window

__all__ = [
    "GROUNDS",
    "INK",
    "NIGHT",
    "SHAPES",
    "Window",
    "check_state",
    "color_of",
    "colored_text",
    "episode",
    "glyph_of",
    "ground_of",
    "human",
    "image",
    "inside",
    "planes_of",
    "save_gif",
    "save_png",
    "scenery_of",
    "shade",
    "shape_of",
    "sprite_of",
    "sprite_pixels",
    "text_drawing",
    "tile",
]
