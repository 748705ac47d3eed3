"""Pictures of states for people: as text, as pixels, written to files, in a window.

Everything is made from what an environment declares: `draw` marks the things in one plane of cells for each layer,
`layers` and `look` say how it looks. As text: one glyph a cell, later layers cover earlier ones. Grounds, by name, lie
below all things. The look of "asphalt" and "walls" follows the Atari 2600 games (colours of its palette, wide pixels).
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pharos.drawing.shapes import color_of, glyph_of, tile
from pharos.environments import Environment, Ground, Margin, Scenery, State
from pharos.errors import MissingExtra, ParameterError, UnknownName
from pharos.system import storage

if TYPE_CHECKING:
    from PIL.Image import Image
    from rich.text import Text


GROUND = "."


def text_drawing(env: Environment, state: Sequence[int]) -> str:
    """Return `state` drawn as text: a line for each row of `env.grid()`, a glyph for each cell.

    Args:
        state: D integers.
    Raises:
        ParameterError: the class declares no `grid` or `draw`, or `state` is none of its states.
    """
    planes = planes_of(env, state)
    picture = np.full(planes.shape[1:], GROUND)
    for plane, layer in zip(planes, env.layers.values(), strict=True):
        for value, glyph in enumerate(layer.glyph, start=1):
            picture[plane == value] = glyph
    return "\n".join("".join(row) for row in picture)


def colored_text(env: Environment, state: Sequence[int]) -> "Text":
    """Return `state` as Rich text for a terminal: two columns for each cell, in the colours of the layers."""
    from rich.text import Text

    drawn = Text()
    planes = planes_of(env, state)
    layers = list(env.layers.values())
    for row in range(planes.shape[1]):
        for column in range(planes.shape[2]):
            here = np.flatnonzero(planes[:, row, column])
            if not here.size:
                drawn.append(" .", style="bright_black")
                continue
            layer, value = layers[here[-1]], int(planes[here[-1], row, column])
            red, green, blue = color_of(layer, value)
            drawn.append(f" {glyph_of(layer, value)}", style=f"bold rgb({red},{green},{blue})")
        drawn.append("\n")
    drawn.rstrip()
    return drawn


# Planes ---------------------------------------------------------------------------------------------------------------


def planes_of(env: Environment, state: Sequence[int]) -> np.ndarray:
    """(L, rows, columns) uint8: for each layer, 0 in empty cells, 1, 2, ... in cells with its things.

    Raises:
        ParameterError: the class declares no `grid` or `draw`, or `state` is none of its states.
    """
    check_state(env, state)
    try:
        rows, columns = env.grid()
        planes = np.zeros((len(env.layers), rows, columns), np.uint8)
        env.draw(tuple(int(value) for value in state), planes)
    except NotImplementedError as error:
        raise ParameterError(f"{env}: cannot be drawn: {error}") from error
    return planes


def check_state(env: Environment, state: Sequence[int]) -> None:
    """ParameterError unless `state` has D components, each in its declared range."""
    components = env.components
    if len(state) != len(components):
        raise ParameterError(f"{env}: found a state with {len(state)} components; expected {len(components)}")
    for name, value, low, high in zip(components.names, state, components.low, components.high, strict=True):
        if not low <= value <= high:
            raise ParameterError(f"{env}: state has {name} = {value}; expected {low} to {high}")


# Pictures -------------------------------------------------------------------------------------------------------------


PICTURE_HEIGHT, PICTURE_WIDTH = (
    720,
    960,
)  # most pixels of a picture, unless its cells would be below CELL_SIZES[0]
CELL_SIZES = (8, 16, 24, 32, 40, 48, 64)  # pixels of a cell; multiples of 8, so that sprites of 8 x 8 stay sharp
LEAST_PICTURE = 400  # pixels of the longer side of a picture that a class has of its own
NIGHT, INK = (16, 18, 24), (226, 228, 232)

# States -> pictures ---------------------------------------------------------------------------------------------------


def human(env: Environment, state: Sequence[int], *, cell: int | None = None) -> np.ndarray:
    """Return `state` drawn for people: (H, W, 3) uint8.

    Args:
        state: D integers.
        cell: pixels of a cell. Default: as many as fit into a picture of 960 x 720.
    """
    planes = planes_of(env, state)
    if (own := env.picture(state)) is not None:
        return enlarged(own, LEAST_PICTURE)
    cell = cell or fitting_cell(planes.shape[1], planes.shape[2], PICTURE_HEIGHT, PICTURE_WIDTH)
    canvas = empty_grid(env, cell)
    court = without_margin(canvas, (cell // 2,) * 4)
    for plane, (name, layer) in zip(planes, env.layers.items(), strict=True):
        for row, column in np.argwhere(plane):
            thing = tile(name, layer, int(plane[row, column]), cell)
            area = court[row * cell : (row + 1) * cell, column * cell : (column + 1) * cell]
            area += (thing[..., :3] - area) * thing[..., 3:]
    return np.rint(canvas).astype(np.uint8)


def empty_grid(env: Environment, cell: int) -> np.ndarray:
    """(H, W, 3) float64: the ground of an environment, without things, within margins of half a cell."""
    rows, columns = env.grid()
    margin = cell // 2
    canvas = np.empty((rows * cell + 2 * margin, columns * cell + 2 * margin, 3), np.float64)
    canvas[:] = NIGHT
    ground_of(env.look.ground)(canvas, (cell, cell), (margin,) * 4)
    return canvas


# Pictures -> files ----------------------------------------------------------------------------------------------------


def image(picture: np.ndarray, caption: str = "") -> "Image":
    """A Pillow image of an (H, W, 3) picture, with a line of text below it."""
    from PIL import Image, ImageDraw, ImageFont

    drawn = Image.fromarray(picture)
    if not caption:
        return drawn
    size = max(12, min(20, drawn.width // 22))
    font = ImageFont.load_default(size)
    framed = Image.new("RGB", (drawn.width, drawn.height + 2 * size), NIGHT)
    framed.paste(drawn, (0, 0))
    ImageDraw.Draw(framed).text((size // 2, drawn.height + size // 3), caption, fill=INK, font=font)
    return framed


def save_png(path: str | os.PathLike, picture: np.ndarray, *, caption: str = "", at_least: int = 0) -> Path:
    """Write a picture as PNG. Small ones are enlarged by a whole factor to `at_least` pixels on their longer side."""
    path = Path(path)
    with storage.replacing(path, follow=True) as file:
        image(enlarged(picture, at_least), caption).save(file, format="PNG", optimize=True)
    return path


def save_gif(
    path: str | os.PathLike,
    pictures: Sequence[np.ndarray],
    *,
    captions: Sequence[str] = (),
    frames_per_second: float = 12.0,
    at_least: int = 0,
) -> Path:
    """Write pictures as an animated GIF that runs for ever and rests a while on the last one."""
    from PIL import Image

    path = Path(path)
    lines = captions or [""] * len(pictures)
    frames = [image(enlarged(picture, at_least), line) for picture, line in zip(pictures, lines, strict=True)]
    samples = frames[:: max(1, len(frames) // 8)][:8] + frames[-1:]
    montage = Image.new("RGB", (frames[0].width, frames[0].height * len(samples)))
    for i, frame in enumerate(samples):
        montage.paste(frame, (0, i * frame.height))
    palette = montage.quantize(colors=255, method=Image.Quantize.MEDIANCUT)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    milliseconds = [max(20, round(1000 / frames_per_second))] * len(frames)
    milliseconds[-1] += 1000
    with storage.replacing(path, follow=True) as file:
        frames[0].save(file, format="GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)
    return path


def enlarged(picture: np.ndarray, at_least: int) -> np.ndarray:
    """A picture by a whole factor so large that its longer side has `at_least` pixels."""
    factor = max(1, -(-at_least // max(picture.shape[:2])))
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def fitting_cell(rows: int, columns: int, height: int, width: int) -> int:
    """Pixels of a cell, the most with which a grid and its margins fit, CELL_SIZES[0] if none does."""
    fits = [cell for cell in CELL_SIZES if (rows + 1) * cell <= height and (columns + 1) * cell <= width]
    return fits[-1] if fits else CELL_SIZES[0]


# Episodes -------------------------------------------------------------------------------------------------------------

Policy = Callable[[State], int]


def episode(
    env: Environment, policy: Policy, start: Sequence[int], *, steps: int, seed: int = 0
) -> list[tuple[State, int, float]]:
    """Play from `start`: (state, action, reward) for each step, then (last state, -1, 0.0), for at most `steps` steps.

    `seed` is of the chance in the rules. Without chance nothing is drawn.

    The rules run interpreted: a few microseconds to a millisecond a step.
    """
    state: State = tuple(int(value) for value in start)
    rng = np.random.default_rng((seed, 1))  # not the draws of a policy with that seed
    played = []
    for _ in range(steps):
        if env.is_terminal(state):
            break
        action = int(policy(state))
        outcome = env.drawn_outcome(state, action, rng.random()) if env.has_chance else 0
        next_state = env.next_state(state, action, outcome)
        played.append((state, action, float(env.reward_of(state, action, next_state, outcome))))
        state = next_state
    played.append((state, -1, 0.0))
    return played


# Scenery --------------------------------------------------------------------------------------------------------------


def ground_of(ground: str | Ground) -> Ground:
    """The function that paints a ground. UnknownName if GROUNDS has none of this name."""
    if not isinstance(ground, str):
        return ground
    if ground not in GROUNDS:
        raise UnknownName("ground", ground, GROUNDS)
    return GROUNDS[ground]


def scenery_of(env: Environment) -> Scenery:
    """The scenery of complex images: the scenery of the class, or square cells on the ground of pictures for people."""
    return env.look.scenery or Scenery(cell=(16, 16), margin=(0, 0, 0, 0), ground=env.look.ground)


def without_margin(picture: np.ndarray, margin: Margin) -> np.ndarray:
    """The part of a picture that its cells fill, as a view."""
    top, right, bottom, left = margin
    return picture[top : len(picture) - bottom, left : picture.shape[1] - right]


# Of pictures for people: cells are square, and margins even -----------------------------------------------------------


def _plain(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Dark cells with thin lines between them."""
    court = without_margin(picture, margin)
    court[:] = (30, 33, 41)
    court[:: cell[0]] = court[:, :: cell[1]] = (40, 44, 54)


def _road(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Asphalt, with dashes between the lanes. The first and the last row are pavements."""
    court, side = without_margin(picture, margin), cell[0]
    court[:] = (52, 54, 60)
    thickness = max(1, side // 16)
    lanes = len(court) // side - 2
    dashes = (np.arange(court.shape[1]) // max(2, side // 2)) % 2 == 0
    for lane in range(1, lanes):
        y = (1 + lane) * side
        court[y - thickness // 2 : y - thickness // 2 + thickness, dashes] = (128, 130, 136)


def _court(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """A dark court inside grey walls, open at the bottom."""
    top, _, bottom, _ = margin
    picture[: len(picture) - bottom] = (142, 142, 146)
    picture[: max(1, top // 6)] = (176, 176, 180)
    without_margin(picture, margin)[:] = (12, 13, 18)


def _tiles(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Pale tiles, like a chessboard."""
    court = without_margin(picture, margin)
    rows, columns = (np.arange(n) // side for n, side in zip(court.shape, cell, strict=False))
    odd = ((rows[:, None] + columns) % 2)[..., None]
    court[:] = np.where(odd, (216, 211, 200), (226, 221, 210))


def _ice(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Pale blue ice with faint seams and scratches."""
    court, side = without_margin(picture, margin), cell[0]
    court[:] = (176, 210, 232)
    court[::side] = court[:, ::side] = (150, 190, 218)
    y, x = np.mgrid[: court.shape[0], : court.shape[1]]
    scratch = ((x + 2 * y) % (3 * side) < max(1, side // 24)) & ((x // side + y // side) % 3 == 0)
    court[scratch] = (206, 229, 243)


# Of complex images ----------------------------------------------------------------------------------------------------

ASPHALT, PAVEMENT, KERB, WHITE, YELLOW = (142, 142, 142), (170, 170, 170), (96, 96, 96), (214, 214, 214), (210, 210, 64)
WALL_COLOR = (142, 142, 142)


def _asphalt(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Grey asphalt with dashed lines between the lanes, a double line in the middle, and pavements with kerbs."""
    height = cell[0]
    picture[:] = ASPHALT
    lanes = len(picture) // height - 2
    dashes = np.arange(picture.shape[1]) % 20 < 10
    for lane in range(1, lanes):
        y = (1 + lane) * height
        if lanes >= 4 and lane == lanes // 2:
            picture[y - 2 : y - 1] = picture[y : y + 1] = YELLOW
        else:
            picture[y - 1 : y, dashes] = WHITE
    for pavement, kerb in ((slice(0, height), height - 2), (slice(-height, None), -height)):
        picture[pavement] = PAVEMENT
        picture[kerb : kerb + 2] = KERB


def _walls(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """A black court inside grey walls, open at the bottom."""
    top, right, _, left = margin
    picture[:] = WALL_COLOR
    picture[top:, left : picture.shape[1] - right] = 0


GROUNDS: dict[str, Ground] = {
    "plain": _plain,
    "road": _road,
    "court": _court,
    "tiles": _tiles,
    "ice": _ice,
    "asphalt": _asphalt,
    "walls": _walls,
}
"""Name of a ground -> function that paints it. Classes choose by name, or bring a function of their own."""


# Window ---------------------------------------------------------------------------------------------------------------


class Window:
    """Shows pictures, one after the other, `fps` a second at most. Opens with the first.

    Raises:
        MissingExtra: pygame is not installed.
    """

    def __init__(self, caption: str, fps: int):
        try:
            import pygame
        except ImportError as error:
            raise MissingExtra("render_mode='human'", "pygame-ce", "play") from error
        self._pygame, self._caption, self._fps = pygame, caption, fps
        self._surface: pygame.Surface | None = None
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
        """Close it. The next picture opens another."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None
