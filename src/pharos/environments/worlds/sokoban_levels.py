"""Levels of Sokoban: their text, files of them (Boxoban's among others), and a generator.

A level is rows of letters: # wall, @ player, $ box, . target, + player on a target, * box on a target, and - or a space
for the floor. In one line rows are separated by "/".
"""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

WALL, FLOOR, PLAYER, BOX, TARGET = "#-@$."
LETTERS = "#-@$.+*"
WAYS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up, right, down, left
OPEN, PULL = 0.75, 0.5  # chance of a cell to be floor, and of a step to pull a box along
STEPS, ATTEMPTS = 400, 1000
LARGEST_FILE = 2**26

Cell = tuple[int, int]


def level_text(source: str) -> str:
    """The level in one line: of a text, or of a file, `levels.txt` or `levels.txt:3`; ValueError says what is wrong.

    In a file a line such as "; 3" begins level 3, as in Boxoban's; without such lines empty lines separate levels, and
    they count from 0.
    """
    if set(source) <= set(LETTERS + " _/\n"):
        rows = re.split(r"[/\n]", source.strip("\n"))
    else:
        file, _, number = source.rpartition(":") if re.search(r":\d+$", source) else (source, "", "0")
        rows = _levels_of(Path(file)).get(int(number), [])
        if not rows:
            raise ValueError(f"the file has no level {number}")
    width = max(map(len, rows))
    rows = [re.sub("[ _]", FLOOR, row).ljust(width, FLOOR) for row in rows]
    if not width or set("".join(rows)) - set(LETTERS):
        raise ValueError(f"expected rows of the letters {LETTERS}")
    return "/".join(rows)


def _levels_of(file: Path) -> dict[int, list[str]]:
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise ValueError(f"the file is larger than {LARGEST_FILE >> 20} MiB")
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"it is neither a level nor a file that can be read ({error})") from error
    levels: dict[int, list[str]] = {}
    number, has_headings = -1, any(re.match(r";\s*\d+\s*$", line) for line in lines)
    for before, line in pairwise(["", *lines]):
        heading = re.match(r";\s*(\d+)\s*$", line)
        if heading:
            number = int(heading[1])
        elif WALL in line and set(line) <= set(LETTERS + " _"):
            number += not has_headings and WALL not in before
            levels.setdefault(number, []).append(line.rstrip())
    return levels


def within_reach(text: str) -> tuple[list[Cell], dict[Cell, str]]:
    """The cells that a player without boxes could walk to, row by row, and every letter of the level by its cell."""
    letters = {(y, x): letter for y, row in enumerate(text.split("/")) for x, letter in enumerate(row)}
    frontier = [cell for cell, letter in letters.items() if letter in "@+"]
    reached = set(frontier)
    while frontier:
        row, column = frontier.pop()
        for down, right in WAYS:
            cell = row + down, column + right
            if letters.get(cell, WALL) != WALL and cell not in reached:
                reached.add(cell)
                frontier.append(cell)
    return sorted(reached), letters


def random_level(height: int, width: int, boxes: int, seed: int) -> str:
    """A level that can be solved: boxes on targets, pulled away from them at random. ValueError where there is none.

    Source: ours, after the reverse play of Racaniere et al. (2017), appendix.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    for _ in range(ATTEMPTS):
        is_floor = np.zeros((height, width), np.bool_)
        is_floor[1:-1, 1:-1] = rng.random((height - 2, width - 2)) < OPEN
        cells = [(int(y), int(x)) for y, x in np.argwhere(is_floor)]
        if len(cells) <= boxes + 1:
            continue
        player, *targets = (cells[i] for i in np.argsort(rng.random(len(cells)))[: boxes + 1])
        free, placed = set(cells), set(targets)
        for step, pulls in zip(rng.integers(0, 4, STEPS), rng.random(STEPS) < PULL, strict=True):
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
    raise ValueError(f"none of {ATTEMPTS} random levels has its {boxes} boxes off their targets")


def _text(height: int, width: int, free: set[Cell], player: Cell, boxes: set[Cell], targets: set[Cell]) -> str:
    letters = {**dict.fromkeys(free, FLOOR), **dict.fromkeys(targets, TARGET), **dict.fromkeys(boxes, BOX)}
    letters[player] = "+" if player in targets else PLAYER
    return "/".join("".join(letters.get((y, x), WALL) for x in range(width)) for y in range(height))
