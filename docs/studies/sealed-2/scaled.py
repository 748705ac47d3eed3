"""POST HOC: four classes with rewards in another unit."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos import Environment, Layer
from pharos.environments import parameter

SHADES = tuple((250 - 16 * i, 120, 40 + 14 * i) for i in range(13))


@dataclass(frozen=True, kw_only=True)
class MachinesScaled(Environment):
    """Run machines that wear at random, and overhaul them in time. A worn one makes less; a broken one costs, and more to repair.

    State    wear of each machine, 0 (new) to `worst` (broken).
    Actions  run all, or overhaul one, which makes nothing in this step.
    """

    machines: int = parameter(2, low=1, high=4)
    worst: int = parameter(4, low=2, high=12)
    wearing: float = parameter(0.4)
    unit: float = parameter(1.0)

    name = "machines_scaled"
    max_episode_steps = 50
    layers = {"wear": Layer(tuple("123456789abcd"), SHADES)}

    @property
    def actions(self):
        return ("run", *(f"overhaul {i + 1}" for i in range(self.machines)))

    @property
    def outcomes(self):
        return 2**self.machines

    def variables(self):
        return {"wear": [range(self.worst + 1)] * self.machines}

    def initial_state(self):
        return (0,) * self.machines

    def probability(self, state, action, outcome):
        likely = 1.0
        for i in range(self.machines):
            wears = (outcome >> i) & 1
            if action == i + 1 or state[i] == self.worst:
                likely *= 0.0 if wears == 1 else 1.0
            else:
                likely *= self.wearing if wears == 1 else 1.0 - self.wearing
        return likely

    def transition(self, state, action, outcome, out):
        for i in range(self.machines):
            if action == i + 1:
                out[i] = 0
            elif (outcome >> i) & 1 == 1 and state[i] < self.worst:
                out[i] = state[i] + 1

    def reward(self, state, action, next_state):
        pay = 0.0
        for i in range(self.machines):
            if action == i + 1:
                pay -= 2.5 if state[i] == self.worst else 0.5
            elif state[i] == self.worst:
                pay -= 0.5
            else:
                pay += 1.0 - 0.5 * state[i] / self.worst
        return pay * self.unit

    def grid(self):
        return self.machines, self.worst + 1

    def draw(self, state, planes):
        for i in range(self.machines):
            planes[0, i, state[i]] = 1 + state[i]


@dataclass(frozen=True, kw_only=True)
class DosingScaled(Environment):
    """Cure a patient by doses that harm as well: the drug stays in the blood, halved each day.

    State    drug in the blood, illness, harm. Chance: illness and harm rise or fall. Cure pays 1, death -1, a day -0.01.
    """

    drug: int = parameter(3, low=2, high=12)
    illness: int = parameter(4, low=2, high=20)
    harm: int = parameter(3, low=2, high=20)
    unit: float = parameter(1.0)

    name = "dosing_scaled"
    actions = ("none", "dose 1", "dose 2", "dose 3")
    outcomes = 9
    max_episode_steps = 60
    layers = {
        "drug": Layer("d", (60, 120, 200)),
        "illness": Layer("i", (200, 120, 60)),
        "harm": Layer("h", (120, 40, 120)),
    }

    def variables(self):
        return {"drug": range(self.drug + 1), "illness": range(self.illness + 1), "harm": range(self.harm + 1)}

    def initial_state(self):
        return (0, self.illness // 2, 0)

    def probability(self, state, action, outcome):
        level = blood(state[0], action, self.drug) / self.drug
        fall, rise = 0.6 * level, 0.4 * (1.0 - level)
        heal, hurt = 0.2 * (1.0 - level), 0.8 * level * level
        illness = fall if outcome // 3 == 0 else rise if outcome // 3 == 2 else 1.0 - fall - rise
        harm = heal if outcome % 3 == 0 else hurt if outcome % 3 == 2 else 1.0 - heal - hurt
        return illness * harm

    def transition(self, state, action, outcome, out):
        out[0] = blood(state[0], action, self.drug)
        out[1] = min(max(state[1] + outcome // 3 - 1, 0), self.illness)
        out[2] = min(max(state[2] + outcome % 3 - 1, 0), self.harm)

    def is_terminal(self, state):
        return state[1] == 0 or state[1] == self.illness or state[2] == self.harm

    def reward(self, state, action, next_state):
        if next_state[1] == self.illness or next_state[2] == self.harm:
            return -1.01 * self.unit
        return 0.99 * self.unit if next_state[1] == 0 else -0.01 * self.unit

    def grid(self):
        return 3, max(self.drug, self.illness, self.harm) + 1

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[1, 1, state[1]] = 1
        planes[2, 2, state[2]] = 1


@dataclass(frozen=True, kw_only=True)
class NetworkScaled(Environment):
    """Send a packet through a network to its address, around a jam that wanders. A hop costs 1, one into the jam 4.

    State    name of the node, name of the jammed node. Actions: eight ports; each node numbers its own as it likes.
    """

    nodes: int = parameter(8, low=6, high=60)
    unit: float = parameter(1.0)

    name = "network_scaled"
    actions = tuple(f"port {i + 1}" for i in range(8))
    outcomes = 3
    layers = {"packet": Layer("P", (66, 72, 200)), "jam": Layer("J", (200, 60, 60))}

    @property
    def max_episode_steps(self):
        return 3 * self.nodes

    @cached_property
    def names(self):
        """(nodes,): name of each place around the ring."""
        return np.random.default_rng(2).permutation(self.nodes)

    @cached_property
    def order(self):
        """(nodes,): place of each name."""
        return np.argsort(self.names)

    @cached_property
    def ports(self):
        """(nodes, 8): the name of the node behind each port, by names."""
        rng, n = np.random.default_rng(3), self.nodes
        table = np.zeros((n, 8), np.int64)
        for place in range(n):
            near = [(place + d) % n for d in (1, -1, 2, -2)]
            there = [*near, 0, int(rng.integers(n // 3)), (place - 3) % n, place]
            table[self.names[place]] = self.names[rng.permutation(np.array(there))]
        return table

    @property
    def goal(self):
        return self.nodes // 2

    def variables(self):
        return {"node": range(self.nodes), "jam": range(self.nodes)}

    def initial_states(self):
        return [((int(self.names[0]), int(self.names[k])), 1 / self.nodes) for k in range(self.nodes)]

    def probability(self, state, action, outcome):
        return 0.6 if outcome == 0 else 0.2

    def transition(self, state, action, outcome, out):
        out[0] = self.ports[state[0], action]
        step = 0 if outcome == 0 else 1 if outcome == 1 else self.nodes - 1
        out[1] = self.names[(self.order[state[1]] + step) % self.nodes]

    def is_terminal(self, state):
        return self.order[state[0]] == self.goal

    def reward(self, state, action, next_state):
        return -4.0 * self.unit if next_state[0] == next_state[1] else -1.0 * self.unit

    def grid(self):
        return 2, self.nodes

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[1, 1, state[1]] = 1


@dataclass(frozen=True, kw_only=True)
class NimScaled(Environment):
    """Take up to `most` matches from one of three heaps before a random opponent does; who takes the last wins.

    State    matches in each heap. A win pays 1, a loss -1, a move that is not there -0.1.
    """

    height: int = parameter(3, low=2, high=12)
    most: int = parameter(3, low=1, high=4)
    unit: float = parameter(1.0)

    name = "nim_scaled"
    layers = {"matches": Layer("|", (200, 150, 90))}

    @property
    def actions(self):
        return tuple(f"{k + 1} from {i + 1}" for i in range(3) for k in range(self.most))

    @property
    def outcomes(self):
        return 3 * self.most

    @property
    def max_episode_steps(self):
        return 3 * self.height + 3

    def variables(self):
        return {"heaps": [range(self.height + 1)] * 3}

    def initial_state(self):
        return (self.height, self.height, self.height - 1)

    def probability(self, state, action, outcome):
        heap, taken = action // self.most, 1 + action % self.most
        if taken > state[heap] or taken == state[0] + state[1] + state[2]:
            return 1.0 if outcome == 0 else 0.0
        total, here = 0, 0.0
        for move in range(3 * self.most):
            i = move // self.most
            left = state[i] - taken if i == heap else state[i]
            if left >= 1 + move % self.most:
                total += 1
                if move == outcome:
                    here = 1.0
        return here / total

    def transition(self, state, action, outcome, out):
        heap, taken = action // self.most, 1 + action % self.most
        if taken > state[heap]:
            return
        out[heap] = state[heap] - taken
        if out[0] + out[1] + out[2] == 0:
            return
        out[outcome // self.most] = max(out[outcome // self.most] - 1 - outcome % self.most, 0)

    def is_terminal(self, state):
        return state[0] + state[1] + state[2] == 0

    def reward(self, state, action, next_state):
        heap, taken = action // self.most, 1 + action % self.most
        if taken > state[heap]:
            return -0.1 * self.unit
        if taken == state[0] + state[1] + state[2]:
            return self.unit
        return -self.unit if next_state[0] + next_state[1] + next_state[2] == 0 else 0.0

    def grid(self):
        return 3, self.height

    def draw(self, state, planes):
        for i in range(3):
            for k in range(state[i]):
                planes[0, i, k] = 1


def blood(before, dose, most):
    """What is in the blood after a dose."""
    return min(before // 2 + dose, most)
