"""Small environments for tests of importers.stepping, each with one thing planted. Factories are functions here, so
that other processes can import them."""

import copy
import itertools
import os
import random
import signal
import sys
import threading
import time

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle


class Walk(gymnasium.Env):
    """A corridor of five cells; `move` says how a step moves. Ends, and pays 1, on the right."""

    def __init__(self):
        self.action_space, self.observation_space = spaces.Discrete(2), spaces.Discrete(5)
        self.cell = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 1
        return self.cell, {}

    def move(self, action):
        return 2 * action - 1

    def step(self, action):
        self.cell = min(max(self.cell + self.move(action), 0), 4)
        return self.cell, float(self.cell == 4), self.cell == 4, False, {}


class Slips(Walk):
    def move(self, action):
        return 0 if self.np_random.random() < 0.25 else 2 * action - 1


class Pictures(Walk):
    """Draws a white point where it stands."""

    metadata = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def render(self):
        picture = np.zeros((1, 5, 3), np.uint8)
        picture[0, self.cell] = 255
        return picture


def pictured():
    """Shows pictures alone, by a function that the wrapper makes and that holds the wrapper."""
    return gymnasium.wrappers.AddRenderObservation(Pictures())


class WithEzPickle(Walk, EzPickle):
    def __init__(self, start=1):
        EzPickle.__init__(self, start)
        super().__init__()
        self.visited = []

    def step(self, action):
        self.visited = [*self.visited, action][-1:]
        return super().step(action)


class Forgetful(Walk):
    """Holds an object whose pickles lose what it counts."""

    def __init__(self):
        super().__init__()
        self.counter = Counter()

    def step(self, action):
        self.counter.count = (self.counter.count + 1) % 3
        return super().step(action)


class Counter:
    def __init__(self):
        self.count = 0

    def __reduce__(self):
        return Counter, ()


class HiddenPython(Walk):
    def move(self, action):
        return random.choice([-1, 1])  # the line that tests look for


class HiddenNumpy(Walk):
    def move(self, action):
        return 1 if np.random.random() < 0.5 else -1


class SeedsItself(Walk):
    """Seeds a global generator and draws from it: no chance at all."""

    def move(self, action):
        random.seed(self.cell)
        return random.choice([-1, 1]) if action else 1


class ReadsTheTime(Walk):
    def move(self, action):
        return 1 if time.perf_counter_ns() // 1000 % 2 else -1


class DrawsAnew(Walk):
    def move(self, action):
        return int(np.random.default_rng().integers(1 << 30)) % 3 - 1


class LazyGenerator(Walk):
    """Makes its generator at the first step, which the reset does not see."""

    rng = None

    def move(self, action):
        if self.rng is None:
            self.rng = np.random.default_rng(0)
        return int(self.rng.integers(2)) * 2 - 1


class StartsAnywhere(Walk):
    """The generator of Gymnasium is made when it is first used, in the reset."""

    def reset(self, *, seed=None, options=None):
        self.cell = int(self.np_random.integers(4))
        return self.cell, {}


class Place(Walk):
    """Begins at the wall, so that its place is the least number of steps to it."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self.cell, {}


class MasksInInformation(Walk):
    """Says with its reset which actions are allowed."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0], {"action_mask": np.array([1, 0], np.int8)}


class MasksInMethod(Walk):
    """Says which actions are allowed when it is asked."""

    def action_masks(self):
        return np.array([True, self.cell > 0])


class Clock(Walk):
    """Counts its steps, and ends by that."""

    limit = 12

    def reset(self, *, seed=None, options=None):
        self.elapsed = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.elapsed += 1
        cell, reward, ended, _, info = super().step(action)
        return cell, reward, ended, self.elapsed >= self.limit, info


class PaysByTheClock(Clock):
    def step(self, action):
        cell, reward, *rest = super().step(action)
        return cell, reward * self.elapsed, *rest


class Rejects(Walk):
    def move(self, action):
        while True:
            move = int(self.np_random.integers(-1, 2))
            if move != 0:
                return move


class Continuous(Walk):
    def move(self, action):
        self.speed = float(self.np_random.normal())
        return 1


class UsesTheNumber(Walk):
    def move(self, action):
        self.wind = np.sqrt(self.np_random.random())
        return 1


class CatchesErrors(Walk):
    def move(self, action):
        try:
            return int(self.np_random.normal() > 0)
        except Exception:
            return 1


class PaysVectors(Walk):
    def step(self, action):
        cell, reward, *rest = super().step(action)
        return cell, np.array([reward, -1.0]), *rest


class Loud(Walk):
    """Prints, warns, and changes a seed."""

    def __init__(self):
        super().__init__()
        import warnings

        print("hello from the factory")
        warnings.warn("old style", DeprecationWarning, stacklevel=1)
        np.random.seed(3)

    def step(self, action):
        print("step", action, file=sys.stderr)
        return super().step(action)


class StartsThreads(Walk):
    def step(self, action):
        threading.Thread(target=time.sleep, args=(5,), daemon=True).start()
        return super().step(action)


class View(Walk):
    """Keeps a view of its grid: a copy must keep it a view."""

    def __init__(self):
        super().__init__()
        self.grid = np.zeros((2, 3), np.int8)
        self.row = self.grid[1]

    def reset(self, *, seed=None, options=None):
        self.grid[:] = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.row[action] = 1
        cell = int(self.grid.sum())
        return cell, 1.0, cell == 2, False, {}


class ChangesATable(Walk):
    """A large table that changes only after more steps than are probed."""

    def __init__(self):
        super().__init__()
        self.table = list(range(500))
        self.count = 0

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.count += 1
        if self.count == 340:
            self.table[0] = 7
        return 0, float(self.table[0]), self.count == 342, False, {}


class Unpicklable(Walk):
    def __init__(self):
        super().__init__()
        self.stream = iter(lambda: 0, 1)
        self.file = (i for i in range(3))


class Raises(Walk):
    def step(self, action):
        if self.cell == 3:
            raise IndexError("off the map")
        return super().step(action)


class ManyKinds(gymnasium.Env):
    """Observations in a dictionary, actions of several parts."""

    def __init__(self):
        self.action_space = spaces.MultiDiscrete([2, 3])
        self.observation_space = spaces.Dict({"place": spaces.Discrete(4), "speed": spaces.Box(0, 9, (2,), np.float32)})
        self.place = 0

    def _shown(self):
        return {"place": self.place, "speed": np.full(2, self.place, np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self._shown(), {}

    def step(self, action):
        self.place = (self.place + int(action[0]) + int(action[1])) % 4
        return self._shown(), 0.0, False, False, {}


class Different(Walk):
    """Another map each time that it is made."""

    made = itertools.count()

    def __init__(self):
        super().__init__()
        self.map = [next(self.made)] * 200

    def step(self, action):
        cell, reward, *rest = super().step(action)
        return cell, reward + self.map[0], *rest


class TicTacToe(gymnasium.Env):
    """Tic-tac-toe against an opponent who plays uniformly among the free cells; an illegal move loses."""

    LINES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))

    def __init__(self):
        self.action_space, self.observation_space = spaces.Discrete(9), spaces.MultiDiscrete([3] * 9)
        self.board = [0] * 9

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.board = [0] * 9
        return np.array(self.board), {}

    def _has_won(self, who):
        return any(all(self.board[cell] == who for cell in line) for line in self.LINES)

    def step(self, action):
        if self.board[action]:
            return np.array(self.board), -1.0, True, False, {}
        self.board[action] = 1
        if self._has_won(1) or all(self.board):
            return np.array(self.board), float(self._has_won(1)), True, False, {}
        free = [cell for cell in range(9) if not self.board[cell]]
        self.board[int(self.np_random.choice(free))] = 2
        return np.array(self.board), -float(self._has_won(2)), self._has_won(2), False, {}


def cell(env):
    """A key that leaves nothing out of Walk."""
    return env.unwrapped.cell


def nothing(env):
    """A key that merges everything."""
    return 0


def slips():
    return gymnasium.wrappers.TimeLimit(Slips(), 50)


def sticky():
    return gymnasium.wrappers.StickyAction(Walk(), 0.25)


class KillsItself(Slips):
    """Ends its process at once in the third cell, while the file of `armed` is there."""

    def __init__(self, armed=""):
        super().__init__()
        self.armed = armed

    def step(self, action):
        if self.cell == 3 and os.path.exists(self.armed):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


class Number(int):
    """An integer of a class of its own."""


class KeepsNumbers(Walk):
    """The state is in objects of classes of the user's own, which have no fields."""

    def reset(self, *, seed=None, options=None):
        self.place = Number(0)
        return super().reset(seed=seed)

    def step(self, action):
        self.place = Number((self.place + 1 + action) % 5)
        return 0, 1.0, self.place == 4, False, {}


class CountsInTheClass(Walk):
    count = 0

    def step(self, action):
        type(self).count += 1
        cell, reward, *rest = super().step(action)
        return cell, reward + self.count % 3, *rest


class Heavy(Walk):
    """Some hundred states of 40 kB each."""

    def reset(self, *, seed=None, options=None):
        self.pad = np.zeros(5_000)
        return super().reset(seed=seed)

    def step(self, action):
        self.pad = self.pad + 2 * action + 1
        return 0, 1.0, self.pad[0] > 150, False, {}


class ManyGenerators(Walk):
    """Draws from generators of three kinds, within other objects, and from a space."""

    def __init__(self):
        super().__init__()
        self.dice = {"python": random.Random(1), "old": [np.random.RandomState(2)]}

    def move(self, action):
        first = self.dice["python"].randint(0, 1)
        second = self.dice["old"][0].randint(2)
        third = int(self.action_space.sample())
        return 1 if first and second and third else 0


GENERATOR = np.random.default_rng(0)


class GeneratorOfTheModule(Walk):
    def move(self, action):
        return int(GENERATOR.integers(2))


class CopiesItself(Slips):
    """Draws from a copy of its generator, which so gives the same number in every step of an episode."""

    def move(self, action):
        twin = copy.deepcopy(self)
        return Slips.move(twin, action)
