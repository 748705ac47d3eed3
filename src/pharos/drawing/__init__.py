"""Pixels and text from the layers that an environment declares; knows no class."""

from pharos.drawing.text import text_drawing

__all__ = ["text_drawing"]
