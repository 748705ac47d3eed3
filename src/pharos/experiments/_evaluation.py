"""The exact value of what an agent has learnt: its policy is asked in the states that it reaches, and evaluated there.

A deterministic policy in a deterministic game of a million states reaches some hundred of them; under chance it may reach many,
and beyond a limit the value is estimated from simulated episodes instead, and the answer says so.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.experiments._task import Task
from pharos.mdp import TabularMDP

BATCH = 4096  # observations that a policy is asked about at once
RISK = 0.01  # that an estimate's interval misses the value


@dataclass(frozen=True)
class Evaluation:
    """The value of a policy from the start.

    Attributes:
        value: expected return of an episode, in the setting of the task.
        exact: whether the value is computed, not estimated.
        error_bound: proven bound on the error of an exact value; for an estimate, half the width of an interval that holds the
            value with a probability of at least 99 % (empirical Bernstein bound).
        states: number of states (or pairs of state and previous action) in which the policy was asked.
        episodes: simulated episodes behind an estimate; 0 where the value is exact.
    """

    value: float
    exact: bool
    error_bound: float
    states: int
    episodes: int = 0


def evaluate_agent(
    agent: Any, task: Task, *, max_states: int = 100_000, episodes: int = 2_000, seed: int = 0
) -> Evaluation:
    """Return the value of an agent's current policy on a task.

    Args:
        agent: has `policy_table()` (S,), (S, A) or as `pharos.evaluate_policy` takes it; or `action_probabilities(observations)`
            -> (N, A); or is a model of Stable-Baselines3; or an array like the table; or a function of observations that returns
            (N, A) probabilities or (N,) actions.
        max_states: how many states (pairs, where previous actions matter) the policy may reach for an exact value.
        episodes, seed: of the estimate beyond that.
    Raises:
        ParameterError: the agent is none of these, or its answers are no probabilities.
    Cost: one answer of the policy for each state reached, then horizon x states reached.
    Source: exact policy evaluation, Puterman (1994), section 6.1; reached states: a closed class of an MDP has the same values alone;
        Maurer and Pontil (2009), theorem 4.
    """
    from pharos.solvers import evaluate_policy

    if hasattr(agent, "policy_table"):
        agent = agent.policy_table()
    if isinstance(agent, np.ndarray):
        solution = evaluate_policy(task.mdp, agent)
        return Evaluation(solution.value_at_start, True, solution.error_bound, task.mdp.num_states)
    asked = _Asked(_policy_of(agent), task)
    if _reach(task, asked, max_states):
        sub, policy = _sub_mdp(task, asked)
        solution = evaluate_policy(sub, policy)
        return Evaluation(solution.value_at_start, True, solution.error_bound, len(asked.rows))
    value, width = _estimate(task, asked, episodes, np.random.default_rng(seed))
    return Evaluation(value, False, width, len(asked.rows), episodes)


def _policy_of(agent: Any) -> Callable[[Any], Any]:
    if hasattr(agent, "action_probabilities"):
        return agent.action_probabilities
    if hasattr(agent, "predict") and hasattr(agent, "policy"):
        from pharos.agents._deep import DeepPolicy

        return DeepPolicy(agent).action_probabilities
    if callable(agent):
        return agent
    raise ParameterError(
        f"agent is {agent!r}; expected a policy table, a model of Stable-Baselines3, or a function of observations"
    )


class _Asked:
    """What a policy answered so far, by row: a state s, or s (A + 1) + b where the previous action b matters (A: none)."""

    def __init__(self, policy: Callable[[Any], Any], task: Task):
        from pharos.observations import observe
        from pharos.observations._context import ObservationInContext

        mdp = task.mdp
        self.policy, self.task = policy, task
        self.num_actions = mdp.num_actions
        self.by_pairs = mdp.is_sticky or task.previous_action
        self.width = mdp.num_actions + 1 if self.by_pairs else 1
        self.position = np.full(mdp.num_states * self.width, -1, np.int32)
        self.rows = np.empty(0, np.int64)
        self.probabilities = np.empty((0, mdp.num_actions))
        options = dict(task.observation_options)
        observation = observe(task.env, task.observation, state_space=task.space, **options)
        self.observe = ObservationInContext(
            observation, previous_action=task.previous_action, remaining_time=False, limit=task.time_limit
        )

    def of(self, rows: np.ndarray) -> np.ndarray:
        """(N, A) probabilities of distinct or repeated rows; the policy is asked about new ones only."""
        unknown = np.unique(rows[self.position[rows] < 0])
        if unknown.size:
            self.position[unknown] = np.arange(len(self.rows), len(self.rows) + unknown.size)
            self.rows = np.concatenate([self.rows, unknown])
            answers = [self._ask(unknown[i : i + BATCH]) for i in range(0, unknown.size, BATCH)]
            self.probabilities = np.concatenate([self.probabilities, *answers])
        return self.probabilities[self.position[rows]]

    def _ask(self, rows: np.ndarray) -> np.ndarray:
        states, previous = np.divmod(rows, self.width)
        previous = np.where(previous == self.num_actions, -1, previous) if self.by_pairs else np.full(len(rows), -1)
        seen = self.observe(self.task.space.states(states), previous, np.zeros(len(rows), np.int64))
        answer = np.asarray(self.policy(seen))
        if answer.dtype.kind in "iu" and answer.shape == (len(rows),):
            if (answer < 0).any() or (answer >= self.num_actions).any():
                raise ParameterError(
                    f"the policy chose action {answer.min()} to {answer.max()}; expected 0 to {self.num_actions - 1}"
                )
            return np.eye(self.num_actions)[answer]
        answer = answer.astype(np.float64)
        if answer.shape != (len(rows), self.num_actions) or not (answer >= 0).all():
            raise ParameterError(
                f"the policy answered with shape {answer.shape} for {len(rows)} observations; expected "
                f"({len(rows)}, {self.num_actions}) probabilities, or ({len(rows)},) actions"
            )
        total = answer.sum(axis=1, keepdims=True)
        if not np.allclose(total, 1, atol=1e-4):
            raise ParameterError(f"the policy's probabilities sum to {total.min():g}; expected 1")
        return answer / total


def _start_rows(task: Task, asked: _Asked) -> np.ndarray:
    return task.mdp.start_states * asked.width + (asked.num_actions if asked.by_pairs else 0)


def _reach(task: Task, asked: _Asked, max_rows: int) -> bool:
    """Ask the policy in all rows that it reaches, level by level; False where they are more than `max_rows`."""
    mdp, chance = task.mdp, task.mdp.chance
    table, actions = mdp.next_states, np.arange(mdp.num_actions)
    assert table is not None
    frontier = np.unique(_start_rows(task, asked))
    while frontier.size:
        probabilities = asked.of(frontier)
        if len(asked.rows) > max_rows:
            return False
        states, previous = np.divmod(frontier, asked.width)
        executed = (probabilities > 0) & (chance.chosen > 0)
        if asked.by_pairs:
            first = previous == mdp.num_actions
            executed[first] = probabilities[first] > 0
            executed |= (previous[:, None] == actions) & (chance.previous > 0)
            executed[first] |= chance.first_uniform > 0
            executed[~first] |= chance.uniform > 0
        else:
            executed |= chance.uniform > 0
        who, what = np.nonzero(executed)
        following = table[states[who], what].astype(np.int64)
        live = (following >= 0) & ~np.asarray(mdp.terminal)[following]
        rows = following[live] * asked.width + (what[live] if asked.by_pairs else 0)
        rows = np.unique(rows)
        frontier = rows[asked.position[rows] < 0]
    return True


def _sub_mdp(task: Task, asked: _Asked) -> tuple[TabularMDP, np.ndarray]:
    """The MDP on what is reached, and the policy on it. What is not reached counts as the end: it has probability 0."""
    mdp = task.mdp
    assert mdp.next_states is not None
    if mdp.is_sticky:
        states = np.unique(asked.rows // asked.width)
        place = np.full(mdp.num_states, -1, np.int64)
        place[states] = np.arange(states.size)
        table = mdp.next_states[states].astype(np.int64)
        following = np.where(table >= 0, place[table], -1)
        policy = np.zeros((states.size, asked.width, mdp.num_actions))
        policy[:, :, 0] = 1.0  # of pairs that are not reached
        policy[place[asked.rows // asked.width], asked.rows % asked.width] = asked.probabilities
        starts = place[mdp.start_states]
    else:
        states = asked.rows // asked.width
        table = mdp.next_states[states].astype(np.int64)
        arrived = table * asked.width + (np.arange(mdp.num_actions) if asked.by_pairs else 0)
        following = np.where(table >= 0, asked.position[arrived], -1)
        policy = asked.probabilities  # type: ignore[assignment]
        starts = asked.position[_start_rows(task, asked)]
    initial = np.zeros(states.size)
    np.add.at(initial, starts, mdp.start_probabilities)
    sub = TabularMDP.from_arrays(
        following, mdp.reward_table.rows(states), gamma=mdp.gamma, initial=initial, horizon=mdp.horizon
    )
    return replace(sub, chance=mdp.chance), policy


def _estimate(task: Task, asked: _Asked, episodes: int, rng: np.random.Generator) -> tuple[float, float]:
    """(mean return, half the width of the interval around it) of simulated episodes."""
    mdp, chance = task.mdp, task.mdp.chance
    assert mdp.next_states is not None
    steps = mdp.horizon or math.ceil(math.log(1e-9) / math.log(mdp.gamma)) if mdp.gamma > 0 else 1
    states = rng.choice(mdp.start_states, episodes, p=mdp.start_probabilities)
    previous = np.full(episodes, mdp.num_actions)
    returns, alive = np.zeros(episodes), np.arange(episodes)
    for step in range(steps):
        s, b = states[alive], previous[alive]
        probabilities = asked.of(s * asked.width + (b if asked.by_pairs else 0))
        chosen = (probabilities.cumsum(axis=1) < rng.random((alive.size, 1))).sum(axis=1).clip(max=mdp.num_actions - 1)
        u, first = rng.random(alive.size), b == mdp.num_actions
        uniform = np.where(first, u >= chance.first_chosen, u >= chance.chosen + chance.previous)
        sticks = ~first & ~uniform & (u >= chance.chosen)
        executed = np.where(sticks, b, np.where(uniform, rng.integers(mdp.num_actions, size=alive.size), chosen))
        returns[alive] += mdp.gamma**step * mdp.reward_table.rows(s)[np.arange(alive.size), executed]
        following = mdp.next_states[s, executed]
        states[alive], previous[alive] = following, executed
        alive = alive[(following >= 0) & ~np.asarray(mdp.terminal)[following]]
        if not alive.size:
            break
    return float(returns.mean()), _half_width(returns, *task.return_range)


def _half_width(returns: np.ndarray, low: float, high: float) -> float:
    """Of an interval that holds the mean with probability 1 - RISK, for returns in [low, high]; rare returns included."""
    count, log = len(returns), math.log(4 / RISK)
    spread = math.sqrt(2 * float(returns.var(ddof=1)) * log / count)
    return spread + 7 * (high - low) * log / (3 * (count - 1))
