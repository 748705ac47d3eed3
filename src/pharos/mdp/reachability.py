"""The states of an MDP that can be reached from its start, MDPs of some of the states, and end components.

A node is what a value belongs to: a state, or under sticky actions a pair of a state and the action executed before.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pharos.kernels import end_components as kernels
from pharos.mdp.actions import Chance, PolicyTable, Selection
from pharos.mdp.dynamics import Dynamics
from pharos.mdp.rewards import Rewards
from pharos.mdp.tabular import TabularMDP


def states_within(mdp: TabularMDP, steps: int | None = None) -> np.ndarray:
    """(S,) bool: the states that some actions lead to within `steps` steps (None: any number) from a start."""
    return mdp.dynamics.reachable(mdp.starts, steps)


def pairs_within(mdp: TabularMDP, steps: int | None = None) -> np.ndarray:
    """(S, A) bool: pairs (state, previously executed action) that can be reached within `steps` steps of a start.

    Chance decides which actions can be executed after which: if every action is a repetition, the action of the first
    step is executed always. Start states without a previous action are not among them.
    """
    is_reached = now = np.zeros((mdp.num_states, mdp.num_actions), np.bool_)
    if mdp.chance.executes_any:
        return is_reached if steps == 0 else _arrivals(mdp, states_within(mdp, None if steps is None else steps - 1))
    lone, level = np.zeros(mdp.num_states, np.bool_), 0
    lone[mdp.starts] = True
    while (lone.any() or now.any()) and (steps is None or level < steps):
        now = nodes_after(mdp, now, lone) & ~is_reached
        is_reached, lone, level = is_reached | now, np.zeros_like(lone), level + 1
    return is_reached


def nodes_within(mdp: TabularMDP) -> np.ndarray:
    """(S, W) bool: the nodes of values that can be reached from a start: `pairs_within` under sticky actions, else
    `states_within`. Start states without a previous action are not among them."""
    return pairs_within(mdp) if mdp.is_sticky else states_within(mdp)[:, None]


def nodes_after(mdp: TabularMDP, nodes: np.ndarray, lone: np.ndarray) -> np.ndarray:
    """(S, W) bool: the nodes one step after nodes (S, W), or after start states `lone` (S,) with no action."""
    if nodes.shape[1] < mdp.num_actions or mdp.chance.executes_any:
        after = _arrivals(mdp, nodes.any(axis=1) | lone)
        return after if nodes.shape[1] == mdp.num_actions else np.asarray(after.any(axis=1, keepdims=True))
    executed = nodes  # every action is a repetition, of one that is available
    if mdp.available is not None:
        chooses = (nodes & ~mdp.available).any(axis=1, keepdims=True)
        executed = mdp.available & (nodes | chooses)
    states, actions = np.nonzero(executed & ~np.asarray(mdp.terminal)[:, None])
    outcomes = mdp.dynamics.outcomes(states, actions)
    after = np.vstack([_arrivals(mdp, lone), np.zeros_like(nodes[:1])])
    after[outcomes.states, actions[outcomes.which]] = True
    return after[:-1]


def _arrivals(mdp: TabularMDP, is_visited: np.ndarray) -> np.ndarray:
    """(S, A) bool: the pairs (state, executed action) one step after some states (S,) bool."""
    states = np.flatnonzero(is_visited & ~np.asarray(mdp.terminal))
    if mdp.available is None:
        return mdp.dynamics.arrivals(states)
    which, actions = np.nonzero(mdp.available[states])
    outcomes, after = mdp.dynamics.outcomes(states[which], actions), np.zeros((mdp.num_states + 1, mdp.num_actions))
    after[outcomes.states, actions[outcomes.which]] = 1
    return after[:-1] > 0


def lone_starts(mdp: TabularMDP) -> np.ndarray:
    """(S,) bool: under sticky actions the start states, nodes of their own without a previous action."""
    lone = np.zeros(mdp.num_states, np.bool_)
    lone[mdp.starts] = mdp.is_sticky
    return lone


def mdp_within(mdp: TabularMDP, steps: int) -> TabularMDP:
    """The same MDP with only those states that can be reached within `steps` steps from a start, in their order.

    Both agree on every episode of at most `steps` steps from the start: values there, returns, effective horizon.
    Transitions of states that take all the steps to reach may be wrong: those that leave the set are replaced.

    Returns:
        This MDP if all of its states are reached, else one without a folder, as its states have other numbers.
    Cost: one read of each transition of the reached states, and a copy of them.
    """
    is_reached = states_within(mdp, steps)
    is_reached[mdp.start_states] = True
    if is_reached.all():
        return mdp
    return restricted_to(mdp, np.flatnonzero(is_reached))


def restricted_to(mdp: TabularMDP, states: np.ndarray) -> TabularMDP:
    """The MDP of some states, ascending, the start states among them. They are numbered anew."""
    number = np.full(mdp.num_states, -1, np.int64)
    number[states] = np.arange(len(states))
    return replace(
        mdp,
        dynamics=mdp.dynamics.restricted_to(states),
        reward_table=mdp.reward_table.of(states),
        staying=None if mdp.staying is None else partial(_some, mdp.staying, states),
        terminal=np.asarray(mdp.terminal[states]),
        start_states=number[mdp.start_states],
        folder=None,
        space=None,
        age=None,
        available=None if mdp.available is None else mdp.available[states],
        names=None if mdp.names is None else mdp.names.of(states),
    )


def _some(rewards: Callable[[], Rewards], states: np.ndarray) -> Rewards:
    return rewards().of(states)


# Parts ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Part:
    """A part of an MDP: a contiguous range of its states, [start, stop), and the outside states whose values it needs.

    Numbers of breadth-first search are local, so a range leads to few states outside of it, its *halo*: with 16 ranges
    9 % of a range's rows on a Breakout of 2.4 million states, 0.03 % on a Freeway. Ranges are what several processes
    sweep together (solvers/ranked.py).

    Inside a part its own states have the numbers 0 .. n - 1, in order, and states of the halo n .. n + H - 1,
    ascending. -1 is the end. Arrays of values have n + H + 1 rows, so the compiled sweeps run over parts as they are.

    Attributes:
        halo: (H,) int64, ascending: the states outside that these may lead to.
        dynamics: of n states, whose next states may be in the halo. reward_table: (n, A).
        gamma, chance: of the MDP.
    """

    start: int
    stop: int
    halo: np.ndarray
    dynamics: Dynamics
    reward_table: Rewards
    gamma: float
    chance: Chance

    @staticmethod
    def of(mdp: TabularMDP, start: int, stop: int) -> "Part":
        """The states [start, stop) of an MDP. Copies their next states, renumbered."""
        dynamics, halo = mdp.dynamics.part(start, stop)
        rewards = mdp.reward_table.of(slice(start, stop))
        return Part(start, stop, halo, dynamics, rewards, mdp.gamma, mdp.chance.at(slice(start, stop)))

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def num_states(self) -> int:
        """n."""
        return len(self)

    @property
    def num_actions(self) -> int:
        """A."""
        return self.dynamics.num_actions

    @property
    def width(self) -> int:
        """W: A previous actions under sticky actions, else 1."""
        return self.chance.width(self.num_actions)

    def zeros(self) -> np.ndarray:
        """(n + H + 1, W) values: of its states, of the halo, of the end."""
        return np.zeros((len(self) + len(self.halo) + 1, self.width))

    def selection(self, select: Selection) -> Selection:
        """The selection of actions in the states of this part, of a selection in the whole MDP."""
        return select.of_states(slice(self.start, self.stop)) if isinstance(select, PolicyTable) else select


# End components -------------------------------------------------------------------------------------------------------


class EndComponents(NamedTuple):
    """The maximal end components of an MDP.

    Attributes:
        labels: (S,) integers, under sticky actions (S, A) by the previously executed action: the number of the
            component that a node is in, from 0 on, -1 for none.
        pairs: (S, A) bool, under sticky actions (S, A, A): the choices that stay in the component, whatever happens.
        total: how many components there are.
    """

    labels: np.ndarray
    pairs: np.ndarray
    total: int


def end_components(mdp: TabularMDP, pairs: np.ndarray | None = None) -> EndComponents:
    """The maximal end components of an MDP: sets in which play can stay for ever, and come from any node to any other.

    An end component is a set of nodes and at least one choice for each of them, such that no choice leads out of the
    set, whatever chance does, and every node can be reached from every other one. Maximal ones do not overlap, and
    almost surely every episode that does not end is in one of them from some step on, by its choices alone. Terminal
    states, and choices that may end the episode, are in none.

    Args:
        pairs: (S, A) bool, under sticky actions also (S, A, A) with the previously executed action second: the choices
            that may be made. None: all.
    Cost: a few reads of all transitions, of which only the transitions of nodes in question are looked at again. A + 33
        bytes a node. Source: de Alfaro (1997), section 3.3.
    """
    width, num_actions = mdp.width, mdp.num_actions
    num_nodes, dtype = mdp.num_states * width, np.int32 if mdp.num_states * width < 2**31 else np.int64
    live = ~np.asarray(mdp.terminal)
    allowed = np.repeat(np.broadcast_to(live[:, None], (mdp.num_states, num_actions)), width, axis=0)
    if pairs is not None:
        allowed &= np.repeat(pairs, width, axis=0) if pairs.ndim == 2 else pairs.reshape(num_nodes, num_actions)
    weights: tuple = mdp.chance.triple
    if mdp.is_sticky and mdp.available is not None:  # else one that is not available is as the first one that is
        weights = mdp.chance.for_kernels
        allowed &= np.repeat(mdp.available, width, axis=0)
    count = np.count_nonzero(allowed, axis=1).astype(np.int32)
    transitions = mdp.dynamics.for_kernels
    component, path, waiting = (np.empty(num_nodes, dtype) for _ in range(3))
    leaves, removed = np.empty(num_actions, np.bool_), 1
    while removed:
        kernels.number_components(transitions, weights, allowed, count, component, path, waiting)
        removed, last = 0, 1
        while last:
            last = kernels.remove_leaving(transitions, weights, component, allowed, count, leaves)
            removed += last
    labels = np.full(num_nodes, -1, np.int64)
    inside = np.flatnonzero(count)
    numbers, labels[inside] = np.unique(component[inside], return_inverse=True)
    shape = (mdp.num_states, width)[: 1 + mdp.is_sticky]
    return EndComponents(labels.reshape(shape), allowed.reshape(*shape, num_actions), len(numbers))
