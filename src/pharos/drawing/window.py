"""A window that shows pictures, by pygame."""

from typing import Any

import numpy as np

from pharos.errors import MissingExtra


class Window:
    """Shows pictures, one after the other, `fps` a second at most; opens with the first.

    Raises:
        MissingExtra: pygame is not installed.
    """

    def __init__(self, caption: str, fps: int):
        try:
            import pygame
        except ImportError as error:
            raise MissingExtra("render_mode='human'", "pygame-ce", "play") from error
        self._pygame, self._caption, self._fps = pygame, caption, fps
        self._surface: Any = None
        self._clock = pygame.time.Clock()

    def show(self, picture: np.ndarray) -> None:
        """Show (H, W, 3) uint8."""
        pygame, size = self._pygame, (picture.shape[1], picture.shape[0])
        if self._surface is None or self._surface.get_size() != size:
            pygame.display.init()
            pygame.display.set_caption(self._caption)
            self._surface = pygame.display.set_mode(size)
        pygame.surfarray.blit_array(self._surface, picture.swapaxes(0, 1))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close it; the next picture opens another."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None
