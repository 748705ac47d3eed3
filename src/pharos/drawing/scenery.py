"""What lies below all things: grounds by name, and the scenery of complex images.

The look of "asphalt" and "walls" follows the Atari 2600 games (colours of its palette, wide pixels).
"""

import numpy as np

from pharos.environments import Environment, Ground, Margin, Scenery
from pharos.errors import UnknownName


def ground_of(ground: str | Ground) -> Ground:
    """The function that paints a ground; UnknownName where GROUNDS has none of this name."""
    if not isinstance(ground, str):
        return ground
    if ground not in GROUNDS:
        raise UnknownName("ground", ground, GROUNDS)
    return GROUNDS[ground]


def scenery_of(env: Environment) -> Scenery:
    """The scenery of complex images: that of the class, or square cells on the ground of pictures for people."""
    return env.look.scenery or Scenery(cell=(16, 16), margin=(0, 0, 0, 0), ground=env.look.ground)


def inside(picture: np.ndarray, margin: Margin) -> np.ndarray:
    """The part of a picture that its cells fill; a view."""
    top, right, bottom, left = margin
    return picture[top : len(picture) - bottom, left : picture.shape[1] - right]


# Of pictures for people: cells are square, and margins even ---------------------------------------------------------


def _plain(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Dark cells with thin lines between them."""
    court = inside(picture, margin)
    court[:] = (30, 33, 41)
    court[:: cell[0]] = court[:, :: cell[1]] = (40, 44, 54)


def _road(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Asphalt, with dashes between the lanes; the first and the last row are pavements."""
    court, side = inside(picture, margin), cell[0]
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
    inside(picture, margin)[:] = (12, 13, 18)


def _tiles(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Pale tiles, like a chessboard."""
    court = inside(picture, margin)
    rows, columns = (np.arange(n) // side for n, side in zip(court.shape, cell, strict=False))
    odd = ((rows[:, None] + columns) % 2)[..., None]
    court[:] = np.where(odd, (216, 211, 200), (226, 221, 210))


def _ice(picture: np.ndarray, cell: tuple[int, int], margin: Margin) -> None:
    """Pale blue ice with faint seams and scratches."""
    court, side = inside(picture, margin), cell[0]
    court[:] = (176, 210, 232)
    court[::side] = court[:, ::side] = (150, 190, 218)
    y, x = np.mgrid[: court.shape[0], : court.shape[1]]
    scratch = ((x + 2 * y) % (3 * side) < max(1, side // 24)) & ((x // side + y // side) % 3 == 0)
    court[scratch] = (206, 229, 243)


# Of complex images --------------------------------------------------------------------------------------------------

ASPHALT, PAVEMENT, KERB, WHITE, YELLOW = (142, 142, 142), (170, 170, 170), (96, 96, 96), (214, 214, 214), (210, 210, 64)
WALL = (142, 142, 142)


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
    picture[:] = WALL
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
