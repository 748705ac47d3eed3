"""Worlds without chance: jugs, a vault, frogs and toads, a bridge at night, crafting, juggling."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos import Environment, Layer
from pharos.environments import parameter

# Jugs ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Jugs(Environment):
    """Measure out `size` - 1 litres with three jugs of `size`, `size` + 1 and `size` + 2 litres and a tap.

    State    litres in each jug. Actions: fill one, empty one, pour one into another until that one is full.
    Reward   -1 for each move and -1 for each litre from the tap.
    Ends     with `size` - 1 litres in the largest jug and nothing in the others.
    """

    size: int = parameter(3, low=2, high=20)

    name = "jugs"
    actions = (
        *(f"fill {i + 1}" for i in range(3)),
        *(f"empty {i + 1}" for i in range(3)),
        *(f"pour {i + 1} into {j + 1}" for i in range(3) for j in range(3) if i != j),
    )
    layers = {"water": Layer("w", (60, 120, 200))}

    @property
    def max_episode_steps(self):
        return 20 * self.size

    def variables(self):
        return {
            "first": range(self.size + 1),
            "second": range(self.size + 2),
            "third": range(self.size + 3),
        }

    def initial_state(self):
        return (0, 0, 0)

    def transition(self, state, action, out):
        if action < 3:
            out[action] = self.size + action
        elif action < 6:
            out[action - 3] = 0
        else:
            giver = (action - 6) // 2
            taker = (action - 6) % 2
            if taker >= giver:
                taker += 1
            poured = min(state[giver], self.size + taker - state[taker])
            out[giver] = state[giver] - poured
            out[taker] = state[taker] + poured

    def is_terminal(self, state):
        return state[0] == 0 and state[1] == 0 and state[2] == self.size - 1

    def reward(self, state, action, next_state):
        drawn = self.size + action - state[action] if action < 3 else 0
        return -1.0 - drawn

    def grid(self):
        return 3, self.size + 2

    def draw(self, state, planes):
        for i in range(3):
            for k in range(state[i]):
                planes[0, i, k] = 1


# A vault ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Vault(Environment):
    """Walk along a row of rooms to the treasure, through doors that each need their own key. One hand, one key.

    State    room, key in the hand (0: none), doors that are open. Each key hangs in a room before its door. A key that
             is exchanged for another one goes back to its hook; the key of an opened door stays in the lock.
    Reward   4 for each door that is opened, 40 in the last room.
    """

    doors: int = parameter(2, low=1, high=8)
    length: int = parameter(3, low=2, high=12)

    name = "vault"
    actions = ("back", "forth", "take", "unlock")
    layers = {
        "thief": Layer("P", (66, 72, 200)),
        "key": Layer("k", (214, 186, 92)),
        "open": Layer("o", (120, 160, 120)),
    }

    @property
    def rooms(self):
        return self.length * (self.doors + 1)

    @property
    def max_episode_steps(self):
        return 10 * self.rooms

    @cached_property
    def hooks(self):
        """(rooms,): the key that hangs in each room, counted from 1, 0 without a key."""
        rng = np.random.default_rng(17)
        table = np.zeros(self.rooms, np.int64)
        for door in range(self.doors):
            free = [room for room in range((door + 1) * self.length) if table[room] == 0]
            table[free[int(rng.integers(len(free)))]] = door + 1
        return table

    def variables(self):
        return {"room": range(self.rooms), "hand": range(self.doors + 1), "open": range(self.doors + 1)}

    def initial_state(self):
        return (0, 0, 0)

    def transition(self, state, action, out):
        room, hand, opened = state[0], state[1], state[2]
        if action == 0:
            out[0] = max(room - 1, 0)
        elif action == 1:
            out[0] = min(room + 1, (opened + 1) * self.length - 1)
        elif action == 2:
            if self.hooks[room] > opened:
                out[1] = self.hooks[room]
        elif hand == opened + 1 and room == (opened + 1) * self.length - 1:
            out[1] = 0
            out[2] = opened + 1

    def is_terminal(self, state):
        return state[0] == self.rooms - 1

    def reward(self, state, action, next_state):
        if next_state[2] > state[2]:
            return 4.0
        return 40.0 if next_state[0] == self.rooms - 1 else 0.0

    def grid(self):
        return 3, self.rooms

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[1, 1, state[1]] = 1
        planes[2, 2, state[2]] = 1


# Frogs and toads ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Frogs(Environment):
    """Let frogs and toads change sides in a row: a step forth, or a jump over one of the other kind. Nobody goes back.

    State    what sits in each cell (1 a frog, 2 a toad). Actions: which cell's animal moves.
    Reward   1 for each move, -0.2 for one that is impossible, 10 more when the sides are changed.
    Ends     when nobody can move.
    """

    frogs: int = parameter(3, low=1, high=6)

    name = "frogs"
    layers = {"animal": Layer(("f", "t"), ((90, 170, 90), (150, 110, 60)))}

    @property
    def cells(self):
        return 2 * self.frogs + 1

    @property
    def actions(self):
        return tuple(f"cell {i + 1}" for i in range(2 * self.frogs + 1))

    @property
    def max_episode_steps(self):
        return 4 * self.frogs * (self.frogs + 2)

    def variables(self):
        return {"cells": [range(3)] * self.cells}

    def initial_state(self):
        return (1,) * self.frogs + (0,) + (2,) * self.frogs

    def transition(self, state, action, out):
        to = landing(state, action, self.cells)
        if to >= 0:
            out[to] = state[action]
            out[action] = 0

    def is_terminal(self, state):
        for i in range(self.cells):
            if landing(state, i, self.cells) >= 0:
                return False
        return True

    def reward(self, state, action, next_state):
        if landing(state, action, self.cells) < 0:
            return -0.2
        for i in range(self.frogs):
            if next_state[i] != 2 or next_state[self.cells - 1 - i] != 1:
                return 1.0
        return 11.0

    def grid(self):
        return 1, self.cells

    def draw(self, state, planes):
        for i in range(self.cells):
            planes[0, 0, i] = state[i]


def landing(state, cell, cells):
    """The cell where the animal of a cell gets by its move, -1 if it has none."""
    animal = state[cell]
    if animal == 0:
        return -1
    step = 1 if animal == 1 else -1
    near, far = cell + step, cell + 2 * step
    if 0 <= near < cells and state[near] == 0:
        return near
    if 0 <= far < cells and state[far] == 0 and state[near] == 3 - animal:
        return far
    return -1


# A bridge at night --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Bridge(Environment):
    """Get everybody over a bridge at night with one torch. At most two walk at once, as fast as the slower one.

    State    who is over, where the torch is. Actions: one person or two.
    Reward   minus the minutes of the walk, -1 where somebody is not on the torch's side.
    """

    people: int = parameter(4, low=2, high=9)

    name = "bridge"
    layers = {"over": Layer("o", (60, 120, 200)), "torch": Layer("t", (214, 186, 92))}

    @property
    def actions(self):
        pairs = [(i, j) for i in range(self.people) for j in range(i, self.people)]
        return tuple(f"{i + 1}" if i == j else f"{i + 1} and {j + 1}" for i, j in pairs)

    @property
    def max_episode_steps(self):
        return 12 * self.people

    @cached_property
    def pairs(self):
        """(actions, 2): who walks."""
        return np.array([(i, j) for i in range(self.people) for j in range(i, self.people)], np.int64)

    @cached_property
    def minutes(self):
        """(people,): how long each one takes, in no order."""
        return np.array([5, 1, 10, 2, 7, 3, 12, 4, 9], np.int64)[: self.people]

    def variables(self):
        return {"over": [range(2)] * self.people, "torch": range(2)}

    def initial_state(self):
        return (0,) * (self.people + 1)

    def transition(self, state, action, out):
        i, j, side = self.pairs[action, 0], self.pairs[action, 1], state[self.people]
        if state[i] == side and state[j] == side:
            out[i] = 1 - side
            out[j] = 1 - side
            out[self.people] = 1 - side

    def is_terminal(self, state):
        for i in range(self.people):
            if state[i] == 0:
                return False
        return True

    def reward(self, state, action, next_state):
        i, j, side = self.pairs[action, 0], self.pairs[action, 1], state[self.people]
        if state[i] != side or state[j] != side:
            return -1.0
        return -1.0 * max(self.minutes[i], self.minutes[j])

    def grid(self):
        return 2, self.people

    def draw(self, state, planes):
        for i in range(self.people):
            planes[0, 0, i] = state[i]
        planes[1, 1, state[self.people]] = 1


# Crafting -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Crafting(Environment):
    """Gather wood and stone for a house. An axe doubles the wood of a step; stone beyond the first needs a pick.

    State    wood, stone, whether there is an axe, a pick, the house. An axe takes 1 wood and 1 stone, a pick 2 and 1.
    Reward   1 for the house, which takes `wood` and `stone`, -0.01 for each step.
    """

    wood: int = parameter(3, low=2, high=30)
    stone: int = parameter(2, low=1, high=30)

    name = "crafting"
    actions = ("chop", "collect", "mine", "axe", "pick", "drop wood", "drop stone", "build")
    layers = {
        "wood": Layer("w", (150, 110, 60)),
        "stone": Layer("s", (120, 120, 120)),
        "tools": Layer("t", (200, 60, 60)),
    }

    @property
    def max_episode_steps(self):
        return 6 * (self.wood + self.stone)

    def variables(self):
        return {
            "wood": range(self.wood + 1),
            "stone": range(self.stone + 1),
            "axe": range(2),
            "pick": range(2),
            "built": range(2),
        }

    def initial_state(self):
        return (0, 0, 0, 0, 0)

    def transition(self, state, action, out):
        wood, stone, axe, pick = state[0], state[1], state[2], state[3]
        if action == 0:
            wood = min(wood + 1 + axe, self.wood)
        elif action == 1:
            stone = max(stone, 1)
        elif action == 2:
            stone = min(stone + pick, self.stone)
        elif action == 3:
            if axe == 0 and wood >= 1 and stone >= 1:
                wood, stone, axe = wood - 1, stone - 1, 1
        elif action == 4:
            if pick == 0 and wood >= 2 and stone >= 1:
                wood, stone, pick = wood - 2, stone - 1, 1
        elif action == 5:
            wood = max(wood - 1, 0)
        elif action == 6:
            stone = max(stone - 1, 0)
        elif wood == self.wood and stone == self.stone:
            wood, stone = 0, 0
            out[4] = 1
        out[0], out[1], out[2], out[3] = wood, stone, axe, pick

    def is_terminal(self, state):
        return state[4] == 1

    def reward(self, state, action, next_state):
        return 0.99 if next_state[4] == 1 else -0.01

    def grid(self):
        return 3, max(self.wood, self.stone, 2) + 1

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[1, 1, state[1]] = 1
        for i in range(3):
            planes[2, 2, i] = state[2 + i]


# Juggling -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Juggling(Environment):
    """Keep balls in the air with one hand. A throw of height k lands k beats later; two balls never land at once.

    State    for each of the next `height` beats whether a ball lands. Actions: throw what lands now to a height.
    Reward   a tenth of the square of the height; -3 for a ball put down (height 0) or thrown to where another lands,
             and that ball is lost; -0.1 for a throw without a ball.
    """

    height: int = parameter(5, low=2, high=10)
    balls: int = parameter(3, low=1, high=8)

    name = "juggling"
    max_episode_steps = 40
    layers = {"lands": Layer("o", (200, 60, 60))}

    @property
    def actions(self):
        return tuple(f"height {k}" for k in range(self.height + 1))

    def variables(self):
        return {"lands": [range(2)] * self.height}

    def initial_state(self):
        return (1,) * self.balls + (0,) * (self.height - self.balls)

    def transition(self, state, action, out):
        for k in range(self.height - 1):
            out[k] = state[k + 1]
        out[self.height - 1] = 0
        if state[0] == 1 and action > 0:
            out[action - 1] = 1

    def reward(self, state, action, next_state):
        if state[0] == 0:
            return -0.1 if action > 0 else 0.0
        if action == 0 or (action < self.height and state[action] == 1):
            return -3.0
        return 0.1 * action * action

    def grid(self):
        return 1, self.height

    def draw(self, state, planes):
        for k in range(self.height):
            planes[0, 0, k] = state[k]
