"""Pictures of states: for people (`human`, `text`), and a place where observations add theirs.

Everything is made from what an environment declares: `draw` says what is where (one plane of cells for each layer) and
`layers` say how each looks. A class of environments may have a ground of its own (`GROUNDS`), and layers shapes of their own
(`SHAPES`); otherwise a layer without sprite is drawn as blocks.
"""

import os
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment, Layer, State
from pharos.errors import ParameterError, UnknownName

if TYPE_CHECKING:
    from PIL.Image import Image
    from rich.text import Text

Color = tuple[int, int, int]
Renderer = Callable[[Environment, Sequence[int]], np.ndarray]

HEIGHT, WIDTH = 720, 960  # pixels that a picture takes at most, where its cells are not smaller than CELLS[0] for it
CELLS = (8, 16, 24, 32, 40, 48, 64)  # pixels of a cell; multiples of 8, so that sprites of 8 x 8 stay sharp
NIGHT, INK = (16, 18, 24), (226, 228, 232)

# States -> arrays -------------------------------------------------------------------------------------------------------


def planes_of(env: Environment, state: Sequence[int]) -> np.ndarray:
    """(L, rows, columns) uint8: for each layer, 0 where nothing is, 1, 2, ... where its things are.

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


def human(env: Environment, state: Sequence[int], *, cell: int | None = None) -> np.ndarray:
    """Return `state` drawn for people: (H, W, 3) uint8.

    Args:
        state: D integers.
        cell: pixels of a cell; None for as many as fit into a picture of 960 x 720.
    """
    planes = planes_of(env, state)
    _, rows, columns = planes.shape
    cell = cell or _fitting_cell(rows, columns)
    margin = cell // 2
    canvas = np.empty((rows * cell + 2 * margin, columns * cell + 2 * margin, 3), np.float64)
    canvas[:] = NIGHT
    court = canvas[margin : margin + rows * cell, margin : margin + columns * cell]
    GROUNDS.get(env.name, _plain_ground)(canvas, court, cell)
    for plane, (name, layer) in zip(planes, env.layers.items(), strict=True):
        for row, column in np.argwhere(plane):
            tile = _tile(env.name, name, layer, int(plane[row, column]), cell)
            place = court[row * cell : (row + 1) * cell, column * cell : (column + 1) * cell]
            place += (tile[..., :3] - place) * tile[..., 3:]
    return np.rint(canvas).astype(np.uint8)


def text(env: Environment, state: Sequence[int]) -> str:
    """Return `state` drawn as text, a glyph for each cell."""
    from pharos.drawing.text import text_drawing

    planes_of(env, state)
    return text_drawing(env, state)


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
            red, green, blue = _of_value(layer.color, value, np.ndim(layer.color) == 2)
            glyph = _of_value(layer.glyph, value, True)
            drawn.append(f" {glyph}", style=f"bold rgb({red},{green},{blue})")
        drawn.append("\n")
    drawn.rstrip()
    return drawn


RENDERERS: dict[str, Renderer] = {"human": human}
"""Name of an observation -> function (environment, state) -> (H, W, 3) or (H, W) uint8. Packages add theirs."""


def render(env: Environment, state: Sequence[int], observation: str = "human", **options: Any) -> np.ndarray:
    """Return the picture of `state` under an observation, (H, W, 3) uint8.

    Args:
        observation: "human", another of RENDERERS, or an observation whose values are images; planes stand side by side.
        options: of the observation, such as `size="natural"` of "complex_image".
    Raises:
        UnknownName: no observation or option of this name. ParameterError: `state` is none of the environment's, or cannot be
            drawn; the observation is no image.
    """
    if observation in RENDERERS:
        if options:
            raise ParameterError(f"{observation!r} takes no options; found {', '.join(options)}")
        picture = RENDERERS[observation](env, state)
    else:
        check_state(env, state)
        observe = _observer(env, observation, tuple(sorted(options.items())))
        picture = _side_by_side(observe(np.array([state], np.int64))[0], observation)
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture


def renderers() -> list[str]:
    """The names that `render` knows; of the observations, those that may be images."""
    from pharos import observations

    return [*RENDERERS, *(name for name in observations.names() if name not in ("vector", "one_hot", "index"))]


@cache
def _observer(env: Environment, name: str, options: tuple[tuple[str, Any], ...]) -> Any:
    from pharos.observations import names, observe

    if name not in names():
        raise UnknownName("observation to render", name, [*renderers(), "text"])
    return observe(env, name, **dict(options))


def _side_by_side(values: np.ndarray, name: str) -> np.ndarray:
    """An image (H, W, 3), (H, W, 1) or (H, W) as it is; planes (L, H, W) beside each other with a line between them."""
    if values.dtype != np.uint8 or values.ndim not in (2, 3):
        raise ParameterError(
            f"observation {name!r} is no image: shape {values.shape}, type {values.dtype}; "
            f"expected one of {', '.join(renderers())}"
        )
    if values.ndim == 2 or values.shape[2] == 3:
        return values
    if values.shape[2] == 1:
        return values[..., 0]
    line = np.full((values.shape[1], 1), 64, np.uint8)
    parts = [part for plane in values for part in (line, plane)][1:]
    return np.concatenate(parts, axis=1)


# Pictures -> files ------------------------------------------------------------------------------------------------------


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
    """Write a picture as PNG; small ones are enlarged by a whole factor to `at_least` pixels on their longer side."""
    path = Path(path)
    image(_enlarged(picture, at_least), caption).save(path, format="PNG", optimize=True)
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
    frames = [image(_enlarged(picture, at_least), line) for picture, line in zip(pictures, lines, strict=True)]
    samples = frames[:: max(1, len(frames) // 8)][:8] + frames[-1:]
    montage = Image.new("RGB", (frames[0].width, frames[0].height * len(samples)))
    for i, frame in enumerate(samples):
        montage.paste(frame, (0, i * frame.height))
    palette = montage.quantize(colors=255, method=Image.Quantize.MEDIANCUT)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    milliseconds = [max(20, round(1000 / frames_per_second))] * len(frames)
    milliseconds[-1] += 1000
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)
    return path


def _enlarged(picture: np.ndarray, at_least: int) -> np.ndarray:
    factor = max(1, -(-at_least // max(picture.shape[:2])))
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def _fitting_cell(rows: int, columns: int) -> int:
    fits = [cell for cell in CELLS if (rows + 1) * cell <= HEIGHT and (columns + 1) * cell <= WIDTH]
    return fits[-1] if fits else CELLS[0]


# Episodes ---------------------------------------------------------------------------------------------------------------

Policy = Callable[[State], int]


def episode(env: Environment, policy: Policy, start: Sequence[int], *, steps: int) -> list[tuple[State, int, float]]:
    """Play from `start`: (state, action, reward) for each step, then (last state, -1, 0.0); at most `steps` steps.

    The rules run interpreted: a few microseconds to a millisecond a step.
    """
    state: State = tuple(int(value) for value in start)
    played = []
    for _ in range(steps):
        if env.is_terminal(state):
            break
        action = int(policy(state))
        following = env.next_state(state, action)
        played.append((state, action, float(env.reward(state, action, following))))
        state = following
    played.append((state, -1, 0.0))
    return played


# Grounds: what lies below everything else -------------------------------------------------------------------------------


def _plain_ground(canvas: np.ndarray, court: np.ndarray, cell: int) -> None:
    court[:] = (30, 33, 41)
    court[::cell] = court[:, ::cell] = (40, 44, 54)


def _road(canvas: np.ndarray, court: np.ndarray, cell: int) -> None:
    """Asphalt, white lines along the edges, dashes between the lanes."""
    court[:] = (52, 54, 60)
    thickness = max(1, cell // 16)
    lanes = len(court) // cell - 2
    dashes = (np.arange(court.shape[1]) // max(2, cell // 2)) % 2 == 0
    for lane in range(1, lanes):
        y = (1 + lane) * cell
        court[y - thickness // 2 : y - thickness // 2 + thickness, dashes] = (128, 130, 136)


def _walls(canvas: np.ndarray, court: np.ndarray, cell: int) -> None:
    """A dark court inside grey walls, open at the bottom."""
    margin = (canvas.shape[1] - court.shape[1]) // 2
    canvas[: margin + len(court)] = (142, 142, 146)
    canvas[: max(1, margin // 6)] = (176, 176, 180)
    court[:] = (12, 13, 18)


def _floor(canvas: np.ndarray, court: np.ndarray, cell: int) -> None:
    """Pale tiles, like a chessboard."""
    rows, columns = (np.arange(n) // cell for n in court.shape[:2])
    odd = ((rows[:, None] + columns) % 2)[..., None]
    court[:] = np.where(odd, (216, 211, 200), (226, 221, 210))


def _ice(canvas: np.ndarray, court: np.ndarray, cell: int) -> None:
    """Pale blue ice with faint seams and scratches."""
    court[:] = (176, 210, 232)
    court[::cell] = court[:, ::cell] = (150, 190, 218)
    y, x = np.mgrid[: court.shape[0], : court.shape[1]]
    scratch = ((x + 2 * y) % (3 * cell) < max(1, cell // 24)) & ((x // cell + y // cell) % 3 == 0)
    court[scratch] = (206, 229, 243)


Ground = Callable[[np.ndarray, np.ndarray, int], None]
GROUNDS: dict[str, Ground] = {
    "freeway": _road,
    "breakout": _walls,
    "simple_grid": _floor,
    "frozen_lake": _ice,
}
"""Name of a class of environments -> function (canvas, court, pixels of a cell): the court is the part with the cells."""


# Things: (cell, cell, 4), red, green, blue in 0..255 and cover in 0..1 ----------------------------------------------------


@cache
def _tile(class_name: str, name: str, layer: Layer, value: int, cell: int) -> np.ndarray:
    """How the thing number `value` of a layer looks: a shape for this class, the sprite, a shape for any class, a block."""
    color = np.array(_of_value(layer.color, value, np.ndim(layer.color) == 2), np.float64)
    glyph = _of_value(layer.glyph, value, True)
    shape = SHAPES.get(f"{class_name}.{name}")
    if shape is None and layer.sprite is not None:
        rows = _of_value(layer.sprite, value, not isinstance(layer.sprite[0], str))
        return _sprite(rows, _of_value(layer.color, value, np.ndim(layer.color) == 2), cell)
    return (shape or SHAPES.get(name, _block))(color, cell, glyph)


def _of_value(given: Any, value: int, several: bool) -> Any:
    return given[min(value, len(given)) - 1] if several else given


def _sprite(rows: Sequence[str], color: Color, cell: int) -> np.ndarray:
    """A sprite of text, enlarged without smoothing."""
    small = np.zeros((len(rows), max(map(len, rows)), 4))
    for y, row in enumerate(rows):
        for x, letter in enumerate(row):
            if letter not in ". ":
                small[y, x] = (*shade(color, letter), 1.0)
    ys, xs = (np.arange(cell) * n // cell for n in small.shape[:2])
    return small[ys[:, None], xs]


def shade(color: Color, letter: str) -> Color:
    """The colour of a letter of a sprite: '#' is `color`, '1' nearly white, '5' `color`, '9' nearly black."""
    if not letter.isdigit() or letter == "0":
        return color
    distance = (int(letter) - 5) / 5
    target = 255.0 if distance < 0 else 0.0
    red, green, blue = (round(part + (target - part) * abs(distance)) for part in color)
    return red, green, blue


def _block(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A tile with a light upper and a dark lower edge and a hair of ground around it."""
    tile = np.empty((cell, cell, 4))
    tile[..., :3], tile[..., 3] = color, 1.0
    edge, gap = max(1, cell // 12), max(1, cell // 32)
    tile[: gap + edge, :, :3] = _mixed(color, 255, 0.28)
    tile[-gap - edge :, :, :3] = _mixed(color, 0, 0.28)
    for side in (np.s_[:gap], np.s_[-gap:], np.s_[:, :gap], np.s_[:, -gap:]):
        tile[side] = (*_mixed(color, 0, 0.55), 1.0)
    return tile


def _disc(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A ball with a highlight and a thin dark rim."""
    distance = _distance(cell, 0.5, 0.5)
    light = np.clip(1 - _distance(cell, 0.38, 0.34) / 0.5, 0, 1)[..., None]
    body = color + (255 - color) * 0.55 * light**2
    body = np.where((distance > 0.35)[..., None], _mixed(color, 0, 0.45), body)
    return np.concatenate((body, _cover(distance, 0.40, cell)[..., None]), axis=2)


def _pit(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A hole: dark water that is deeper in the middle, with a bright rim of broken ice."""
    distance = _distance(cell, 0.5, 0.5)
    deep = np.clip(1 - distance / 0.42, 0, 1)[..., None]
    water = np.array((38, 84, 128.0)) * (1 - 0.6 * deep)
    water = np.where((distance > 0.38)[..., None], (232, 243, 250), water)
    return np.concatenate((water, _cover(distance, 0.42, cell)[..., None]), axis=2)


def _flag(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A goal: a golden cell with a flag on it."""
    y, x = _grid(cell)
    tile = np.empty((cell, cell, 4))
    tile[..., :3], tile[..., 3] = (236, 190, 66), 1.0
    border = (np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y)) < 0.07)[..., None]
    tile[..., :3] = np.where(border, (196, 148, 40), tile[..., :3])
    pole = (abs(x - 0.32) < 0.035) & (y > 0.16) & (y < 0.86)
    cloth = (x > 0.34) & (x < 0.78 - 1.6 * abs(y - 0.34)) & (abs(y - 0.34) < 0.17)
    tile[pole, :3] = (70, 52, 30)
    tile[cloth, :3] = (196, 52, 44)
    return tile


def _mixed(color: np.ndarray, target: float, share: float) -> np.ndarray:
    return color + (target - color) * share


def _grid(cell: int) -> tuple[np.ndarray, np.ndarray]:
    centre = (np.arange(cell) + 0.5) / cell
    return np.meshgrid(centre, centre, indexing="ij")  # type: ignore[return-value]


def _distance(cell: int, x0: float, y0: float) -> np.ndarray:
    y, x = _grid(cell)
    return np.hypot(x - x0, y - y0)


def _cover(distance: np.ndarray, radius: float, cell: int) -> np.ndarray:
    """1 inside, 0 outside, smooth over one pixel."""
    return np.clip((radius - distance) * cell + 0.5, 0, 1)


def _bar(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A slab in the upper half of the cell; neighbours join."""
    tile = np.zeros((cell, cell, 4))
    height, edge = max(3, cell * 7 // 16), max(1, cell // 12)
    tile[:height, :, :3], tile[:height, :, 3] = color, 1.0
    tile[:edge, :, :3] = _mixed(color, 255, 0.4)
    tile[height - edge : height, :, :3] = _mixed(color, 0, 0.35)
    return tile


def _car(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A car from above, with its lights on; it goes left where its glyph is "<"."""
    fine = 4
    y, x = _grid(fine * cell)
    if glyph == "<":
        x = 1 - x
    canvas = np.zeros((*x.shape, 4))

    def box(x0: float, x1: float, half: float, round_off: float, paint: Any) -> None:
        dx = np.maximum(np.maximum(x0 + round_off - x, x - x1 + round_off), 0)
        dy = np.maximum(abs(y - 0.5) - half + round_off, 0)
        canvas[np.hypot(dx, dy) <= round_off] = (*np.broadcast_to(paint, 3), 1.0)

    for start in (0.16, 0.66):  # wheels
        box(start, start + 0.18, 0.34, 0.03, 14.0)
    box(0.04, 0.96, 0.28, 0.10, _mixed(color, 0, 0.35))  # rim
    box(0.06, 0.94, 0.25, 0.09, color)
    box(0.22, 0.72, 0.21, 0.06, (34, 40, 52))  # windows
    box(0.31, 0.58, 0.19, 0.04, _mixed(color, 255, 0.22))  # roof
    for sign in (-1, 1):  # headlights, brake lights
        canvas[(x > 0.89) & (x < 0.95) & (abs(y - 0.5 - 0.16 * sign) < 0.05), :3] = (255, 246, 190)
        canvas[(x > 0.05) & (x < 0.09) & (abs(y - 0.5 - 0.17 * sign) < 0.05), :3] = (230, 30, 30)
    parts = canvas.reshape(cell, fine, cell, fine, 4)
    cover = parts[..., 3].mean(axis=(1, 3))
    body = (parts[..., :3] * parts[..., 3:]).sum(axis=(1, 3)) / np.maximum(cover[..., None] * fine**2, 1e-9)
    return np.concatenate((body, cover[..., None]), axis=2)


Shape = Callable[[np.ndarray, int, str], np.ndarray]
SHAPES: dict[str, Shape] = {
    "ball": _disc,
    "agent": _disc,
    "holes": _pit,
    "goal": _flag,
    "paddle": _bar,
    "freeway.cars": _car,
}
"""Name of a layer without sprite, or "class.layer" -> function (colour, pixels of a cell, glyph) -> (cell, cell, 4)."""
