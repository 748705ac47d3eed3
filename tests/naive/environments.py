"""The built-in environments once more, written to be obviously right: objects, sets, sentences; no state vectors
inside.

Each twin is a game one plays: `state()` is the vector that the environment should be in, `step(action)` plays a step
and returns (reward, terminated). Nothing is shared with `pharos.environments` but the names of the actions.
"""

OFFSETS = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}


class Walk:
    """On a grid of letters: '.' open, and a value and an end for special cells."""

    def __init__(self, height, width, start, values, ends):
        self.cells = {(row, column) for row in range(height) for column in range(width)}
        self.at, self.values, self.ends = start, values, ends

    def state(self):
        return self.at

    def step(self, action):
        target = tuple(a + b for a, b in zip(self.at, OFFSETS[action], strict=True))
        if target not in self.cells:
            return 0.0, False
        self.at = target
        return self.values.get(target, 0.0), target in self.ends


def simple_grid(height, width, goal, rewards, penalties):
    goal = goal or (height - 1, width - 1)
    values = {goal: 1.0, **dict(rewards), **dict(penalties)}
    return Walk(height, width, (0, 0), values, {goal, *dict(rewards)})


def frozen_lake(rows):
    tiles = {(r, c): tile for r, row in enumerate(rows) for c, tile in enumerate(row)}
    where = {letter: {cell for cell, tile in tiles.items() if tile == letter} for letter in "SFHG"}
    return Walk(len(rows), len(rows[0]), *where["S"], dict.fromkeys(where["G"], 1.0), where["G"] | where["H"])


class Freeway:
    """Cars as closed formulas of the time: after t steps a car of period p has moved t // p cells."""

    def __init__(self, num_cars, lane_length, player_speed, car_speeds, directions, restart_on_hit, hit_penalty):
        self.num_cars, self.lane_length, self.player_speed = num_cars, lane_length, player_speed
        self.periods = [car_speeds[i % len(car_speeds)] for i in range(num_cars)]
        self.directions = [directions[i % len(directions)] for i in range(num_cars)]
        self.restart_on_hit, self.hit_penalty = restart_on_hit, hit_penalty
        self.time = 0
        self.lanes_crossed = 0  # 0: at the start; num_cars + 1: across

    def car_columns(self):
        return [
            direction * (self.time // period) % self.lane_length
            for period, direction in zip(self.periods, self.directions, strict=True)
        ]

    def state(self):
        timers = [self.time % period for period in self.periods]
        row = self.num_cars + 1 - self.lanes_crossed
        return (row, self.time % self.player_speed, *self.car_columns(), *timers)

    def step(self, action):
        if self.time % self.player_speed == 0:
            self.lanes_crossed += {"up": 1, "stay": 0, "down": -1}[action]
            self.lanes_crossed = max(self.lanes_crossed, 0)
        self.time += 1
        if self.lanes_crossed == self.num_cars + 1:
            return 1.0, True
        if self.lanes_crossed > 0 and self.car_columns()[-self.lanes_crossed] == self.lane_length // 2:
            self.lanes_crossed = 0 if self.restart_on_hit else self.lanes_crossed - 1
            return -self.hit_penalty, False
        return 0.0, False


class Breakout:
    """The ball has a cell and a velocity; bricks and paddle are sets of cells."""

    def __init__(self, height, columns, brick_rows, extra_paddle_width, respawn):
        self.height, self.columns, self.respawn = height, columns, respawn
        self.wall = {(row, column) for row in range(1, brick_rows + 1) for column in range(columns)}
        self.bricks = set(self.wall)
        self.width = 2 * extra_paddle_width + 1
        self.left_end = (columns - self.width) // 2
        self.ball, self.velocity = (brick_rows + 1, (columns - 1) // 2), (1, 1)

    def paddle(self):
        return {(self.height - 1, self.left_end + i) for i in range(self.width)}

    def state(self):
        bricks = [int(cell in self.bricks) for cell in sorted(self.wall)]
        return (*self.ball, int(self.velocity[1] > 0), int(self.velocity[0] > 0), self.left_end, *bricks)

    def step(self, action):
        shifted = self.left_end + {"left": -1, "stay": 0, "right": 1}[action]
        if shifted >= 0 and shifted + self.width <= self.columns:
            self.left_end = shifted
        (row, column), (down, right) = self.ball, self.velocity
        if not 0 <= column + right < self.columns:
            right = -right
        if row + down < 0:
            down = -down
        ahead = (row + down, column + right)
        reward = 0.0
        if ahead in self.bricks:
            self.bricks.remove(ahead)
            reward, down = 1.0, -down
        elif ahead in self.paddle():
            self.ball, down = (row, ahead[1]), -1
            self._come_back()
        elif ahead[0] == self.height - 1 and (self.height - 1, column) in self.paddle():
            down, right = -1, -right
            inside = 0 <= column + right < self.columns
            self.ball = (row, column + right if inside else column)
            self._come_back()
        else:
            self.ball = ahead
        self.velocity = (down, right)
        return reward, self.ball[0] == self.height - 1 or not (self.bricks or self.respawn)

    def _come_back(self):
        if self.respawn and not self.bricks:
            self.bricks = set(self.wall)


class SlidingTiles:
    """A tray as a dictionary of the cells; a step looks for the blank and swaps."""

    def __init__(self, tiles, columns):
        self.tray = {(i // columns, i % columns): tile for i, tile in enumerate(tiles)}

    def state(self):
        return tuple(self.tray[cell] for cell in sorted(self.tray))

    def step(self, action):
        (row, column) = next(cell for cell, tile in self.tray.items() if tile == 0)
        beside = (row + OFFSETS[action][0], column + OFFSETS[action][1])
        if beside in self.tray:
            self.tray[row, column], self.tray[beside] = self.tray[beside], 0
        return -1.0, self.state() == (*range(1, len(self.tray)), 0)


class PocketCube:
    """24 stickers in space, each at the place of its corner, facing out; a turn rotates those of one side.

    x points right, y up, z to the front; the corner left down back is never turned.
    """

    SIDES = {"U": (0, 1, 0), "R": (1, 0, 0), "F": (0, 0, 1), "D": (0, -1, 0), "L": (-1, 0, 0), "B": (0, 0, -1)}
    # Of each side: where it begins on the net, and the ways in which its columns and its rows go
    NET = {
        "U": ((0, 2), (1, 0, 0), (0, 0, 1)),
        "L": ((2, 0), (0, 0, 1), (0, -1, 0)),
        "F": ((2, 2), (1, 0, 0), (0, -1, 0)),
        "R": ((2, 4), (0, 0, -1), (0, -1, 0)),
        "B": ((2, 6), (-1, 0, 0), (0, -1, 0)),
        "D": ((4, 2), (1, 0, 0), (0, 0, -1)),
    }

    def __init__(self):
        places = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        self.stickers = {
            (place, out): side for side, out in self.SIDES.items() for place in places if _dot(place, out) > 0
        }

    def step(self, turn):
        axis = self.SIDES[turn[0]]
        for _ in range({"": 1, "2": 2, "'": 3}[turn[1:]]):
            self.stickers = {
                (_clockwise(place, axis), _clockwise(out, axis)) if _dot(place, axis) > 0 else (place, out): side
                for (place, out), side in self.stickers.items()
            }
        return -1.0, all(
            len({side for (_, o), side in self.stickers.items() if o == out}) == 1 for out in self.SIDES.values()
        )

    def net(self):
        """The drawing, a letter for each sticker."""
        rows = [["."] * 8 for _ in range(6)]
        for (place, out), side in self.stickers.items():
            (top, left), right, down = next(self.NET[name] for name, normal in self.SIDES.items() if normal == out)
            rows[top + (_dot(place, down) + 1) // 2][left + (_dot(place, right) + 1) // 2] = side
        return "\n".join(map("".join, rows))


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def _clockwise(v, axis):
    """v turned by a quarter, clockwise for whoever looks against the axis: what is across it becomes v x axis."""
    along = tuple(_dot(v, axis) * part for part in axis)
    across = (v[1] * axis[2] - v[2] * axis[1], v[2] * axis[0] - v[0] * axis[2], v[0] * axis[1] - v[1] * axis[0])
    return tuple(a + b for a, b in zip(along, across, strict=True))


class Sokoban:
    """Sets of cells: walls, targets, boxes; and where the player stands."""

    def __init__(self, level):
        cells = {(y, x): letter for y, row in enumerate(level.split("/")) for x, letter in enumerate(row)}
        where = {letter: {cell for cell, other in cells.items() if other == letter} for letter in "#@$.+*"}
        self.walls, self.targets = where["#"], where["."] | where["+"] | where["*"]
        self.boxes = frozenset(where["$"] | where["*"])
        (self.player,) = where["@"] | where["+"]

    def state(self):
        return self.player, self.boxes

    def step(self, action):
        down, right = OFFSETS[action]
        ahead, beyond = ((self.player[0] + n * down, self.player[1] + n * right) for n in (1, 2))
        before = len(self.boxes & self.targets)
        if ahead in self.boxes and beyond not in self.walls | self.boxes:
            self.boxes = self.boxes - {ahead} | {beyond}
        if ahead not in self.walls | self.boxes:
            self.player = ahead
        solved = self.boxes == self.targets
        return -0.1 + len(self.boxes & self.targets) - before + 10 * solved, solved

    def solution(self):
        """(least number of steps to a solution, states within reach, the solved ones included but not gone through)."""
        frontier, seen, steps, least = [self.state()], {self.state()}, 0, None
        while frontier:
            steps, reached = steps + 1, []
            for position in frontier:
                for action in OFFSETS:
                    self.player, self.boxes = position
                    _, solved = self.step(action)
                    if self.state() not in seen:
                        seen.add(self.state())
                        if solved:
                            least = least or steps
                        else:
                            reached.append(self.state())
            frontier = reached
        return least, len(seen)
