"""Opponents and beliefs: a game of chomp, a race of tokens, a trial of two drugs, a search."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos import Environment, Layer
from pharos.environments import parameter

# Chomp --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Chomp(Environment):
    """Bite from a bar of chocolate, in turn with a random opponent: a piece and all that are below or right of it.

    State    pieces left in each row. Actions: the pieces. Who bites the first one, which is poisoned, loses.
    Reward   1 or -1 in the end, -0.1 for a piece that is gone.
    """

    rows: int = parameter(3, low=2, high=5)
    columns: int = parameter(4, low=2, high=8)

    name = "chomp"
    layers = {"piece": Layer("c", (150, 90, 50))}

    @property
    def actions(self):
        return tuple(f"row {i + 1}, column {j + 1}" for i in range(self.rows) for j in range(self.columns))

    @property
    def outcomes(self):
        return self.rows * self.columns

    @property
    def max_episode_steps(self):
        return self.rows * self.columns

    def variables(self):
        return {"pieces": [range(self.columns + 1)] * self.rows}

    def initial_state(self):
        return (self.columns,) * self.rows

    def probability(self, state, action, outcome):
        row, column = action // self.columns, action % self.columns
        if action == 0 or column >= state[row]:
            return 1.0 if outcome == 0 else 0.0
        left, here = 0, 0.0
        for i in range(self.rows):
            pieces = min(state[i], column) if i >= row else state[i]
            left += pieces
            if i == outcome // self.columns and outcome % self.columns < pieces:
                here = 1.0
        return here / left

    def transition(self, state, action, outcome, out):
        row, column = action // self.columns, action % self.columns
        if column >= state[row]:
            return
        for i in range(self.rows):
            pieces = min(state[i], column) if i >= row else state[i]
            if i >= outcome // self.columns:
                pieces = min(pieces, outcome % self.columns)
            out[i] = pieces

    def is_terminal(self, state):
        return state[0] == 0

    def reward(self, state, action, next_state):
        if action == 0:
            return -1.0
        if action % self.columns >= state[action // self.columns]:
            return -0.1
        return 1.0 if next_state[0] == 0 else 0.0

    def grid(self):
        return self.rows, self.columns

    def draw(self, state, planes):
        for i in range(self.rows):
            for j in range(state[i]):
                planes[0, i, j] = 1


# A race of tokens ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Ludo(Environment):
    """Bring two tokens home before a rival, who comes the other way by luck, brings home its one.

    State    places of the two tokens, place of the rival from its own end, the die (1 or 2). Who lands on another one
             sends it back to its start. Actions: which token moves by the die.
    Chance   the rival advances with probability 0.6, by one place; the next die.
    Reward   1 with both tokens home, -1 with the rival home, at the end alone.
    """

    track: int = parameter(3, low=2, high=12)

    name = "ludo"
    actions = ("first", "second")
    outcomes = 4
    layers = {
        "token": Layer(("a", "b", "c"), ((66, 72, 200), (66, 160, 200), (66, 200, 120))),
        "rival": Layer("R", (200, 60, 60)),
        "die": Layer("d", (120, 120, 120)),
    }

    @property
    def max_episode_steps(self):
        return 8 * self.track

    def variables(self):
        return {"tokens": [range(self.track + 1)] * 2, "rival": range(self.track + 1), "die": range(1, 3)}

    def initial_states(self):
        return [((0, 0, 0, 1), 0.5), ((0, 0, 0, 2), 0.5)]

    def probability(self, state, action, outcome):
        return 0.3 if outcome // 2 == 1 else 0.2

    def transition(self, state, action, outcome, out):
        first, second, rival = state[0], state[1], state[2]
        if action == 0:
            first = min(first + state[3], self.track)
            moved = first
        else:
            second = min(second + state[3], self.track)
            moved = second
        if rival > 0 and moved == self.track - rival:
            rival = 0
        if outcome // 2 == 1 and not (first == self.track and second == self.track):
            rival += 1
            if first == self.track - rival and rival < self.track:
                first = 0
            if second == self.track - rival and rival < self.track:
                second = 0
        out[0], out[1], out[2] = first, second, rival
        out[3] = 1 + outcome % 2

    def is_terminal(self, state):
        return state[2] == self.track or (state[0] == self.track and state[1] == self.track)

    def reward(self, state, action, next_state):
        if next_state[0] == self.track and next_state[1] == self.track:
            return 1.0
        return -1.0 if next_state[2] == self.track else 0.0

    def grid(self):
        return 3, max(self.track + 1, 3)

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[0, 0, state[1]] = 2 if state[0] != state[1] else 3
        planes[1, 1, self.track - state[2]] = 1
        planes[2, 2, state[3]] = 1


# A trial ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Trial(Environment):
    """Give one of two drugs to each of several patients, one after another, and learn from those before.

    State    cures and failures of each drug: all that is known of it, every rate of cure being alike before.
    Chance   a cure, as likely as the mean of the rate given what is known: (cures + 1) / (patients + 2).
    Reward   the cured patient's share of all patients.
    """

    patients: int = parameter(4, low=2, high=12)

    name = "trial"
    actions = ("first drug", "second drug")
    outcomes = 2
    layers = {"count": Layer("n", (120, 120, 200))}

    @property
    def max_episode_steps(self):
        return self.patients

    def variables(self):
        return {"first": [range(self.patients + 1)] * 2, "second": [range(self.patients + 1)] * 2}

    def initial_state(self):
        return (0, 0, 0, 0)

    def probability(self, state, action, outcome):
        cures, failures = state[2 * action], state[2 * action + 1]
        cure = (cures + 1) / (cures + failures + 2)
        return cure if outcome == 0 else 1.0 - cure

    def transition(self, state, action, outcome, out):
        out[2 * action + outcome] = state[2 * action + outcome] + 1

    def is_terminal(self, state):
        return state[0] + state[1] + state[2] + state[3] == self.patients

    def reward(self, state, action, next_state):
        return 1.0 / self.patients if next_state[2 * action] > state[2 * action] else 0.0

    def grid(self):
        return 4, self.patients + 1

    def draw(self, state, planes):
        for i in range(4):
            planes[0, i, state[i]] = 1


# A search -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Search(Environment):
    """Look for a lost thing in drawers, or give up. A look overlooks it half the time; it may be in none of them.

    State    looks into each drawer, from which the belief follows; how it ended. A drawer is looked into twice at most.
    Reward   1 for the thing, minus the price of each look (0.02 to 0.1 by the drawer).
    """

    drawers: int = parameter(3, low=2, high=6)

    name = "search"
    layers = {
        "looks": Layer(("0", "1", "2"), ((230, 230, 230), (160, 160, 160), (90, 90, 90))),
        "end": Layer(("f", "g"), ((90, 170, 90), (200, 60, 60))),
    }

    @property
    def actions(self):
        return (*(f"look into {i + 1}" for i in range(self.drawers)), "give up")

    @property
    def outcomes(self):
        return 2

    @property
    def max_episode_steps(self):
        return 6 * self.drawers

    @cached_property
    def likely(self):
        """(drawers + 1,): how likely the thing is in each drawer before any look, and in none."""
        share = np.array([3.0, 8.0, 1.0, 5.0, 2.0, 4.0])[: self.drawers]
        return np.append(0.9 * share / share.sum(), 0.1)

    @cached_property
    def prices(self):
        """(drawers,): price of a look."""
        return np.array([0.02, 0.1, 0.08, 0.04, 0.06, 0.02])[: self.drawers]

    def variables(self):
        return {"looks": [range(3)] * self.drawers, "end": range(3)}

    def initial_state(self):
        return (0,) * (self.drawers + 1)

    def probability(self, state, action, outcome):
        if action == self.drawers or state[action] == 2:
            return 1.0 if outcome == 0 else 0.0
        total = self.likely[self.drawers]
        for i in range(self.drawers):
            total += self.likely[i] * 0.5 ** state[i]
        found = 0.5 * self.likely[action] * 0.5 ** state[action] / total
        return found if outcome == 1 else 1.0 - found

    def transition(self, state, action, outcome, out):
        if action == self.drawers or outcome == 1:
            for i in range(self.drawers):
                out[i] = 0
            out[self.drawers] = 1 if outcome == 1 else 2
        elif state[action] < 2:
            out[action] = state[action] + 1

    def is_terminal(self, state):
        return state[self.drawers] > 0

    def reward(self, state, action, next_state):
        if action == self.drawers:
            return 0.0
        return (1.0 if next_state[self.drawers] == 1 else 0.0) - self.prices[action]

    def grid(self):
        return 2, self.drawers

    def draw(self, state, planes):
        for i in range(self.drawers):
            planes[0, 0, i] = 1 + state[i]
        if state[self.drawers] > 0:
            planes[1, 1, 0] = state[self.drawers]
