"""Gaps of all states, a block at a time, and how often each of them counts."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pharos.errors import ParameterError
from pharos.kernels import gaps as kernels
from pharos.mdp import TabularMDP
from pharos.solvers import Solution, value_iteration

# States at once; fixed, so that sums do not depend on the machine, and so few that a block stays in the cache.
_BLOCK = 1 << 14
# Bytes for the values of every step, with a horizon.
_MEMORY = 8 * 2**30


class Step(NamedTuple):
    """A time step, or all where there is no horizon: x (S + 1, W), what follows it; which states count, how often."""

    own: np.ndarray
    next_x: np.ndarray
    later: np.ndarray
    first: np.ndarray


class GapBlock(NamedTuple):
    """Gaps of a block of states.

    Attributes:
        step: what they belong to. number: of that step.
        states: (N,) indices. is_whole: whether they are a range.
        rewards, following: (N, A), what executing an action pays, and the value of what follows.
        gap: (N, A).
        scale: the probability that the chosen action is executed, which each gap is multiplied by.
        weight: (N,) how many pairs (state, previous action) a row stands for.
        counted: (N,) the same; 0 for terminal states and those that cannot be reached.
    """

    step: Step
    number: int
    states: np.ndarray
    rewards: np.ndarray
    following: np.ndarray
    gap: np.ndarray
    scale: float
    weight: np.ndarray
    counted: np.ndarray
    is_whole: bool = True


def weighted_gaps(mdp: TabularMDP, solution: Solution) -> Iterator[GapBlock]:
    """The gaps of all states, in blocks."""
    for number, step in enumerate(steps_of(mdp, solution)):
        yield from _gaps_of_step(mdp, step, number, solution.horizon is None and not mdp.is_sticky)


def _gaps_of_step(mdp: TabularMDP, step: Step, number: int, everywhere: bool) -> Iterator[GapBlock]:
    """The gaps of one step, in blocks; `everywhere`: states that cannot be reached have a weight, too."""
    chance = mdp.chance
    for first in range(0, mdp.num_states, _BLOCK):
        block = slice(first, min(first + _BLOCK, mdp.num_states))
        states = np.arange(block.start, block.stop)
        rewards = mdp.reward_table.rows(block)
        following = mdp.dynamics.expected(step.next_x, block)
        difference = kernels.differences(rewards, following, mdp.gamma)
        live = ~np.asarray(mdp.terminal[block])
        later = step.later[block].astype(np.int64)
        weight = later + (everywhere & (later == 0))
        arrays = (number, states, rewards, following)
        gap = difference if chance.chosen == 1.0 else chance.chosen * difference
        yield GapBlock(step, *arrays, gap, chance.chosen, weight, np.where(live, later, 0))
        if step.first[block].any():
            some = np.flatnonzero(step.first[block])
            arrays = (number, states[some], rewards[some], following[some])
            once = np.ones(some.size, np.int64)
            gap = chance.first_chosen * difference[some]
            yield GapBlock(step, *arrays, gap, chance.first_chosen, once, live[some] * once, False)


def steps_of(mdp: TabularMDP, solution: Solution) -> Iterator[Step]:
    """For each step t = 1, ..., T, or once: values, and how many times each state counts.

    later (S,): 1 for a reachable state, under sticky actions the number of actions by which it can be
    reached; first (S,) bool: start states, which count once more under sticky actions, without a previous action.
    """
    lone = mdp.lone_starts
    if solution.horizon is None:
        yield Step(solution.x, solution.x, mdp.nodes_within().sum(axis=1), lone)
        return
    all_steps = _all_steps(mdp, solution)
    nodes = np.zeros((mdp.num_states, mdp.width), np.bool_)
    nodes[mdp.starts[~lone[mdp.starts]]] = True
    for step in range(1, solution.horizon + 1):
        to_go = solution.horizon - step + 1
        own, following = (_with_end(all_steps[n]) for n in (to_go, to_go - 1))
        yield Step(own, following, nodes.sum(axis=1), lone)
        nodes, lone = mdp.nodes_after(nodes, lone), np.zeros_like(lone)


def _all_steps(mdp: TabularMDP, solution: Solution) -> np.ndarray:
    """(T + 1, S) or (T + 1, S, A), the values with every number of steps to go."""
    needed = 8 * ((solution.horizon or 0) + 1) * mdp.num_states * mdp.width
    if solution.all_steps is None:
        if needed > _MEMORY:
            raise ParameterError(
                f"gaps of {solution.horizon} steps of {mdp.num_states} states need {needed / 2**30:.1f} GiB; expected "
                f"at most {_MEMORY / 2**30:.0f}: leave out the horizon, or make it or the space smaller"
            )
        solution = value_iteration(mdp, horizon=solution.horizon, keep_all=True)
    assert solution.all_steps is not None
    return solution.all_steps


def _with_end(values: np.ndarray) -> np.ndarray:
    """(S + 1, W), from (S,) or (S, A)."""
    return np.concatenate([values.reshape(len(values), -1), np.zeros((1, values[0].size))])
