"""Sokoban: push the boxes onto the targets. Source: Hiroyuki Imabayashi (1982); rewards of Racaniere et al. (2017)."""

import itertools
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pharos.environments.base import Environment, Layer, Look, parameter, store
from pharos.errors import ParameterError

ROW, COLUMN, BOXES = range(3)  # of the player; then a bit for each cell of the floor: whether a box is there

LEVELS = {  # ours
    "corridor": "#######/#@-$-.#/#######",
    "corner": "#####/#@--#/#-$-#/#--.#/#####",
    "two-rooms": "########/#--#---#/#@$----#/#--#-.-#/####--##/########",
    "pillar": "#######/#-----#/#-$#$-#/#.-@-.#/#-----#/#######",
    "three-in-a-row": "########/#--@---#/#-$$$--#/#------#/#...---#/########",
    "storehouse": "#########/#--##---#/#-$---$-#/#--##.--#/#@-.-.--#/#-$-#.$-#/#--##---#/#########",
}
CRATE = ("55555555", "57777775", "57577575", "57755775", "57755775", "57577575", "57777775", "55555555")
MARK = ("........", "........", "..#..#..", "...##...", "...##...", "..#..#..", "........", "........")


@dataclass(frozen=True, kw_only=True)
class Sokoban(Environment):
    """Push every box onto a target. Boxes cannot be pulled, so some pushes can never be made good.

    Rules    A step onto a box pushes it on by one cell, if no wall and no other box lies behind it. Otherwise nothing
             happens.
    State    (row, column) of the player, and for each cell of the floor whether a box is there: boxes are all alike, so
             their permutations are one state. The floor are the cells within reach of a player without boxes, row by
             row.
    Actions  up, right, down, left.
    Reward   -0.1 a step, 1 for each box pushed onto a target, -1 for each pushed off, 10 when all are on targets. So
             the undiscounted optimal return is 10 and the boxes not on targets at the start, less 0.1 for each step of
             a shortest solution.
    Ends     when a box is on every target.
    Limit    120 steps, as in Boxoban.
    Ours     the levels.
    Source   rewards and limit: Racaniere et al. (2017), "Imagination-augmented agents for deep reinforcement learning";
             Guez et al. (2019), "An investigation of model-free planning".

    Attributes:
        level: rows of # (wall), - or a space (floor), @ (player), $ (box), . (target), + (player on a target) and *
            (box on a target), separated by "/" or line ends. Or a file of levels, such as Boxoban's, and the number of
            one: "000.txt:17". None stands for the level "corner", or for the level of `seed`.
        seed: draws a level of `height` x `width` cells, walls around it included, that can be solved.
        height, width: of a random level, at least 4.
        boxes: of a random level, at least 1.
    """

    level: str | None = None
    seed: int | None = parameter(None, kind=int, low=0)
    height: int = parameter(7, low=4)
    width: int = parameter(7, low=4)
    boxes: int = parameter(2, low=1)

    name = "sokoban"
    actions = ("up", "right", "down", "left")
    version = 1
    max_episode_steps = 120
    layers = {
        "walls": Layer("#", (112, 98, 92)),
        "targets": Layer("x", (206, 92, 84), MARK),
        "boxes": Layer(("$", "*"), ((196, 148, 84), (110, 168, 96)), CRATE),
        "player": Layer("@", (66, 72, 200), shape="agent"),
    }

    look = Look(ground="tiles", color="#999999")
    instances = {
        **{name: {"level": level} for name, level in LEVELS.items()},
        **{f"random-{boxes}": {"seed": seed, "boxes": boxes} for boxes, seed in ((1, 2), (2, 2), (3, 6))},
    }
    hyperparameters = {  # chosen by hand, on the level "corner"
        "dqn": {
            "default": {
                "gamma": 0.95,
                "learning_rate": 0.001,
                "buffer_size": 100000,
                "exploration_fraction": 0.5,
                "exploration_final_eps": 0.02,
            }
        }
    }

    def validate(self) -> None:
        if self.level is not None and self.seed is not None:
            raise ParameterError("Sokoban: level was given with seed; expected one of them")
        if self.seed is None and (self.height, self.width, self.boxes) != (7, 7, 2):
            raise ParameterError("Sokoban: height, width and boxes have no effect without a seed; add seed=...")
        try:
            if self.level is not None:
                store(self, "level", level_text(self.level if isinstance(self.level, str) else str(self.level)))
            self._check_level()
        except ValueError as error:
            raise ParameterError(f"Sokoban: level={self.level!r}: {error}") from error

    def _check_level(self) -> None:
        text, (floor, letters) = self.text, within_reach(self.text)
        players, boxes, targets = (sum(map(text.count, signs)) for signs in ("@+", "$*", ".+*"))
        if players != 1 or not boxes == targets > 0:
            raise ValueError(f"{players} players, {boxes} boxes, {targets} targets; expected 1, and as many of both")
        if any(letter in "$*.+" and cell not in floor for cell, letter in letters.items()):
            raise ValueError("a box or a target is out of reach of the player")
        if "$" not in text:
            raise ValueError("all boxes are on targets; expected one that is not")

    @cached_property
    def text(self) -> str:
        """The level, its rows separated by "/"."""
        if self.seed is not None:
            return random_level(self.height, self.width, self.boxes, self.seed)
        return LEVELS["corner"] if self.level is None else self.level

    @cached_property
    def cells(self) -> np.ndarray:
        """(F, 2) int64: row and column of each cell of the floor."""
        return np.array(within_reach(self.text)[0], np.int64)

    @cached_property
    def floor(self) -> np.ndarray:
        """(rows, columns) int64: the number of each cell of the floor; -1: a wall, or out of reach."""
        rows = self.text.split("/")
        floor = np.full((len(rows), len(rows[0])), -1, np.int64)
        floor[tuple(self.cells.T)] = np.arange(len(self.cells))
        return floor

    @cached_property
    def neighbors(self) -> np.ndarray:
        """(F, A) int64: the cell of the floor to which each action leads from each; -1: none."""
        walled = np.pad(self.floor, 1, constant_values=-1)
        return np.array([[walled[row + 1 + y, column + 1 + x] for y, x in WAYS] for row, column in self.cells])

    @cached_property
    def targets(self) -> np.ndarray:
        """(boxes,) int64: the cells of the floor that are targets."""
        return self._marked(".+*")

    def _marked(self, signs: str) -> np.ndarray:
        rows = self.text.split("/")
        return np.array([i for i, (row, column) in enumerate(self.cells) if rows[row][column] in signs], np.int64)

    def variables(self):
        rows, columns = self.floor.shape
        return {"row": range(rows), "column": range(columns), "boxes": [range(2)] * len(self.cells)}

    def initial_state(self):
        boxes = np.zeros(len(self.cells), np.int64)
        boxes[self._marked("$*")] = 1
        return (*self.cells[self._marked("@+")[0]].tolist(), *boxes.tolist())

    def transition(self, state, action, out):
        there = self.neighbors[self.floor[state[ROW], state[COLUMN]], action]
        if there < 0:
            return
        if state[BOXES + there] == 1:
            beyond = self.neighbors[there, action]
            if beyond < 0 or state[BOXES + beyond] == 1:
                return
            out[BOXES + there] = 0
            out[BOXES + beyond] = 1
        out[ROW] = self.cells[there, 0]
        out[COLUMN] = self.cells[there, 1]

    def is_terminal(self, state):
        return boxes_on(self.targets, state) == len(self.targets)

    def reward(self, state, action, next_state):
        before, after = boxes_on(self.targets, state), boxes_on(self.targets, next_state)
        return after - before - 0.1 + (10.0 if after == len(self.targets) else 0.0)

    def grid(self):
        return self.floor.shape

    def draw(self, state, planes):
        for row in range(len(self.floor)):
            for column in range(len(self.floor[0])):
                if self.floor[row, column] < 0:
                    planes[0, row, column] = 1
        for i in self.targets:
            planes[1, self.cells[i, 0], self.cells[i, 1]] = 1
        for i in range(len(self.cells)):
            planes[2, self.cells[i, 0], self.cells[i, 1]] = state[BOXES + i] * (
                1 + planes[1, self.cells[i, 0], self.cells[i, 1]]
            )
        planes[3, state[ROW], state[COLUMN]] = 1


def boxes_on(targets, state):
    total = 0
    for i in targets:
        total += state[BOXES + i]
    return total


# Levels: their text, files of them (Boxoban among others), and a generator --------------------------------------------
#
# A level is rows of letters: # wall, @ player, $ box, . target, + player on a target, * box on a target, and - or a
# space for the floor. In one line rows are separated by "/".

WALL_LETTER, FLOOR_LETTER, PLAYER_LETTER, BOX_LETTER, TARGET_LETTER = "#-@$."
LEVEL_LETTERS = "#-@$.+*"
ROW_LETTERS = LEVEL_LETTERS + " _"
HEADING = r"\W*(?:level|maze|puzzle|title)?\W*(\d+)\W*"
"""A line of a file that numbers a level."""
WAYS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up, right, down, left
OPEN_CHANCE, PULL_CHANCE = 0.75, 0.5  # chance of a cell to be floor, and of a step to pull a box along
STEPS, ROOM_ATTEMPTS = 400, 1000
LARGEST_FILE = 2**26

Cell = tuple[int, int]


def level_text(source: str) -> str:
    """The level in one line: of a text, or of a file, `levels.txt` or `levels.txt:3`. ValueError says what is wrong.

    In a file any line that is no row ends a level. A line with a number, "; 3" or "Level 3", numbers the level after
    it, as in Boxoban's files: then each level needs one. Without such lines levels count from 0.
    """
    if set(source) <= set(ROW_LETTERS + "/\n"):
        rows = re.split(r"[/\n]", source.strip("\n"))
    else:
        file, _, number = source.rpartition(":") if re.search(r":\d+$", source) else (source, "", "0")
        levels = _levels_of(Path(file))
        if int(number) not in levels:
            levels_there = f"it has {len(levels)}, numbered {min(levels)} to {max(levels)}" if levels else "it has none"
            raise ValueError(f"the file has no level {number}; {levels_there}")
        rows = levels[int(number)]
    width = max(map(len, rows))
    rows = [re.sub("[ _]", FLOOR_LETTER, row).ljust(width, FLOOR_LETTER) for row in rows]
    if not width or set("".join(rows)) - set(LEVEL_LETTERS):
        raise ValueError(f"expected rows of the letters {LEVEL_LETTERS}")
    return "/".join(rows)


def _levels_of(file: Path) -> dict[int, list[str]]:
    """The rows of each level of a file by its number. ValueError if it is not clear which is which."""
    from pharos.system.storage import check_regular  # which levels in text do without

    try:
        check_regular(file)
        if file.stat().st_size > LARGEST_FILE:
            raise ValueError(f"the file is larger than {LARGEST_FILE >> 20} MiB")
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"it is neither a level nor a file that can be read ({error})") from error
    numbers: dict[int, int] = {}  # line -> number
    boards: dict[int, list[str]] = {}  # first line -> rows
    first = None
    for at, line in enumerate(lines, 1):
        if set(line) & set("#@$.+*") and set(line) <= set(ROW_LETTERS):
            first = first or at
            boards.setdefault(first, []).append(line.rstrip())
            continue
        first = None
        if WALL_LETTER in line and set(line) <= set(ROW_LETTERS + "|()pPbB0123456789"):
            raise ValueError(
                f"line {at} has run lengths or other letters, {line[:40]!r}; expected rows of {LEVEL_LETTERS}"
            )
        heading = re.fullmatch(HEADING, line, re.IGNORECASE)
        if heading:
            numbers[at] = int(heading[1])
    boards = {at: rows for at, rows in boards.items() if any(WALL_LETTER in row for row in rows)}
    if not numbers:
        return dict(enumerate(boards.values()))
    order, levels = sorted([*numbers, *boards]), {}
    for number_at, board_at in itertools.zip_longest(order[::2], order[1::2]):
        if number_at not in numbers or board_at not in boards:
            at = number_at if number_at in boards else board_at if board_at in numbers else number_at
            kind = "a level without a number" if at in boards else "a number without a level"
            raise ValueError(f"line {at} begins {kind}; expected a line '; N' before each level, or no such lines")
        if numbers[number_at] in levels:
            raise ValueError(f"line {number_at}: two levels have the number {numbers[number_at]}")
        levels[numbers[number_at]] = boards[board_at]
    return levels


def within_reach(text: str) -> tuple[list[Cell], dict[Cell, str]]:
    """The cells that a player without boxes could walk to, row by row, and every letter of the level by its cell."""
    letters = {(y, x): letter for y, row in enumerate(text.split("/")) for x, letter in enumerate(row)}
    frontier = [cell for cell, letter in letters.items() if letter in "@+"]
    reachable = set(frontier)
    while frontier:
        row, column = frontier.pop()
        for down, right in WAYS:
            cell = row + down, column + right
            if letters.get(cell, WALL_LETTER) != WALL_LETTER and cell not in reachable:
                reachable.add(cell)
                frontier.append(cell)
    return sorted(reachable), letters


def random_level(height: int, width: int, boxes: int, seed: int) -> str:
    """A level that can be solved: boxes on targets, pulled away from them at random. ValueError if there is none.

    Source: ours, after the reverse play of Racaniere et al. (2017), appendix.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    for _ in range(ROOM_ATTEMPTS):
        is_floor = np.zeros((height, width), np.bool_)
        is_floor[1:-1, 1:-1] = rng.random((height - 2, width - 2)) < OPEN_CHANCE
        cells = [(int(y), int(x)) for y, x in np.argwhere(is_floor)]
        if len(cells) <= boxes + 1:
            continue
        player, *targets = (cells[i] for i in np.argsort(rng.random(len(cells)))[: boxes + 1])
        free, placed = set(cells), set(targets)
        for step, pulls in zip(rng.integers(0, 4, STEPS), rng.random(STEPS) < PULL_CHANCE, strict=True):
            down, right = WAYS[step]
            ahead, behind = ((player[0] + sign * down, player[1] + sign * right) for sign in (1, -1))
            if ahead not in free or ahead in placed:
                continue
            if pulls and behind in placed:
                placed = placed - {behind} | {player}
            player = ahead
        if placed & set(targets):
            continue
        text = _text(height, width, free, player, placed, set(targets))
        if {*placed, *targets} <= set(within_reach(text)[0]):
            return text
    raise ValueError(f"none of {ROOM_ATTEMPTS} random levels has its {boxes} boxes off their targets")


def _text(height: int, width: int, free: set[Cell], player: Cell, boxes: set[Cell], targets: set[Cell]) -> str:
    letters = {
        **dict.fromkeys(free, FLOOR_LETTER),
        **dict.fromkeys(targets, TARGET_LETTER),
        **dict.fromkeys(boxes, BOX_LETTER),
    }
    letters[player] = "+" if player in targets else PLAYER_LETTER
    return "/".join("".join(letters.get((y, x), WALL_LETTER) for x in range(width)) for y in range(height))
