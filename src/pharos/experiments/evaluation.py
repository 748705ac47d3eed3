"""The exact value of what an agent has learnt: its policy is asked in the states that it reaches, and evaluated there.

A deterministic policy in a deterministic game of a million states reaches some hundred of them; under chance it may reach many,
and beyond a limit the value is estimated from simulated episodes instead, and the answer says so.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pharos.errors import DivergenceError, ParameterError
from pharos.experiments.task import Task
from pharos.mdp import PolicyTable, TabularMDP
from pharos.solvers import Solution

BATCH = 4096  # observations that a policy is asked about at once
TAIL = 1e-9  # of a discounted value, left out where the policy takes as long to get there
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
    agent: Any,
    task: Task,
    *,
    deterministic: bool = False,
    max_states: int = 100_000,
    episodes: int = 2_000,
    seed: int = 0,
) -> Evaluation:
    """Return the value of an agent's current policy on a task.

    Args:
        agent: has `policy_table()` (S,), (S, A) or as `pharos.evaluate_policy` takes it; or `action_probabilities(observations)`
            -> (N, A); or is a model of Stable-Baselines3; or an array like the table; or a function of observations that returns
            (N, A) probabilities or (N,) actions.
        deterministic: whether the most probable action is taken (the first among equals) instead of one at random.
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
        table = agent.argmax(axis=-1) if deterministic and agent.dtype.kind == "f" else agent
        if task.mdp.num_states <= max_states:
            solution = evaluate_policy(task.mdp, table)
            return Evaluation(solution.value_at_start, True, solution.error_bound, task.mdp.num_states)
        asked: _Asked = _AskedTable(table, task)
    else:
        asked = _Asked(agent, task, deterministic)
    steps, error = _steps_that_matter(task.mdp)
    if _reach(task, asked, max_states, steps):
        sub, policy = _sub_mdp(task, asked)
        solution = evaluate_policy(sub, policy)
        return Evaluation(solution.value_at_start, True, solution.error_bound + error, len(asked.rows))
    value, width = _estimate(task, asked, episodes, np.random.default_rng(seed))
    return Evaluation(value, False, width, len(asked.rows), episodes)


@dataclass(frozen=True, eq=False, repr=False)
class ReachedSolution(Solution):
    """Values of a policy where it gets from the start, in the numbering of the whole MDP; NaN elsewhere.

    Attributes:
        start: value of an episode's first state.
        states_reached: number of states in which the policy was asked.
    """

    start: float = math.nan
    states_reached: int = 0

    @property
    def value_at_start(self) -> float:
        """The expected value of an episode's first state."""
        return self.start


def evaluate_observing(
    mdp: TabularMDP,
    policy: Any,
    tolerance: float = 1e-6,
    *,
    observation: Any = "vector",
    observation_options: Mapping[str, Any] | None = None,
    previous_action: bool = False,
    deterministic: bool = False,
) -> ReachedSolution:
    """What `pharos.evaluate_policy` does for policies that see observations; `evaluate_agent` also gives estimates.

    Raises:
        ParameterError: the MDP was not made from a state space of an environment, the policy is none for its observations, or
            it sees the previous action where actions are not sticky, so that values do not belong to states.
        DivergenceError: gamma is 1 and there is no horizon.
    """
    from pharos.solvers import evaluate_policy
    from pharos.state_space import load

    if mdp.horizon is None and mdp.gamma == 1.0:
        raise DivergenceError(
            f"{mdp}: gamma is 1 and there is no horizon, so the value may be infinite; give one, or gamma < 1"
        )
    if previous_action and not mdp.is_sticky:
        raise ParameterError(
            "the policy sees the previous action, so its values belong to no state; use experiments.evaluate_agent"
        )
    space = None if mdp.folder is None else load(mdp.folder, verify=False)
    if space is None or space.environment is None:
        raise ParameterError(
            f"{mdp}: is not of a state space whose environment is known, so there is nothing to observe; give the policy as a table"
        )
    options = dict(observation_options or {})
    task = Task(
        space.environment,
        observation=observation,
        observation_options=options,
        previous_action=previous_action,
        gamma=mdp.gamma,
        horizon=mdp.horizon,
    )
    task.__dict__.update(mdp=mdp, space=space)  # its cached properties
    asked = _Asked(policy, task, deterministic)
    _reach(task, asked, None, None)
    sub, chosen = _sub_mdp(task, asked)
    found = evaluate_policy(sub, chosen, tolerance)
    x, following = (_on_all_states(task, asked, each) for each in (found.x, found.next_x))
    if mdp.is_sticky:
        table = np.full((mdp.num_states, asked.width, mdp.num_actions), np.nan)
        table[asked.rows // asked.width, asked.rows % asked.width] = asked.probabilities
    else:
        table = _scattered(asked.probabilities, asked.rows, mdp.num_states)[:, None]
    return ReachedSolution(
        mdp,
        found.error_bound,
        found.sweeps,
        found.seconds,
        mdp.horizon,
        PolicyTable(mdp.num_actions, table),
        x,
        following,
        start=found.value_at_start,
        states_reached=len(np.unique(asked.rows // asked.width)),
    )


def _on_all_states(task: Task, asked: "_Asked", x: np.ndarray) -> np.ndarray:
    """(S + 1, W): values on the states that the policy reaches (N + 1, W), NaN elsewhere; 0 in terminal states."""
    mdp = task.mdp
    states = np.unique(asked.rows // asked.width) if mdp.is_sticky else asked.rows
    values = np.full((mdp.num_states + 1, x.shape[1]), np.nan)
    values[states] = x[:-1]
    if mdp.is_sticky:
        rows = states[:, None] * asked.width + np.arange(mdp.num_actions)
        values[states] = np.where(asked.index(rows) >= 0, values[states], np.nan)
    values[:-1][np.asarray(mdp.terminal)] = 0.0
    values[-1] = 0.0
    return values


def _scattered(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    out = np.full((count, *values.shape[1:]), np.nan)
    out[rows] = values
    return out


def _policy_of(agent: Any) -> Callable[[Any], Any]:
    if hasattr(agent, "action_probabilities"):
        return agent.action_probabilities
    if hasattr(agent, "predict") and hasattr(agent, "policy"):
        from pharos.agents.deep import DeepPolicy

        return DeepPolicy(agent).action_probabilities
    if callable(agent):
        return agent
    raise ParameterError(
        f"agent is {agent!r}; expected a policy table, a model of Stable-Baselines3, or a function of observations"
    )


class _Asked:
    """What a policy answered so far, by row: a state s, or s (A + 1) + b where the previous action b matters (A: none)."""

    def __init__(self, agent: Any, task: Task, deterministic: bool = False):
        from pharos.observations import observe
        from pharos.observations.context import ObservationInContext

        self._start(task)
        self.policy, self.deterministic = _policy_of(agent), deterministic
        options = dict(task.observation_options)
        observation = observe(task.env, task.observation, state_space=task.space, **options)
        self.observe = ObservationInContext(
            observation, previous_action=task.previous_action, remaining_time=False, limit=task.time_limit
        )
        _check_observation(agent, self.observe.space, task.observation)

    def _start(self, task: Task) -> None:
        mdp = task.mdp
        self.task, self.num_actions = task, mdp.num_actions
        self.by_pairs = mdp.is_sticky or task.previous_action
        self.width = mdp.num_actions + 1 if self.by_pairs else 1
        self._place = np.zeros(
            mdp.num_states * self.width, np.int32
        )  # index + 1; memory is taken where something is written
        self._count = 0  # of what is filled in the two arrays that follow, which double when they are full
        self._rows, self._answers = np.empty(64, np.int64), np.empty((64, mdp.num_actions))

    @property
    def rows(self) -> np.ndarray:
        """(N,) the rows that the policy was asked about."""
        return self._rows[: self._count]

    @property
    def probabilities(self) -> np.ndarray:
        """(N, A) what it answered."""
        return self._answers[: self._count]

    def index(self, rows: np.ndarray) -> np.ndarray:
        """Where each row stands in `rows` and `probabilities`; -1 where it was not asked about."""
        return self._place[rows] - 1

    def of(self, rows: np.ndarray) -> np.ndarray:
        """(N, A) probabilities of distinct or repeated rows; the policy is asked about new ones only."""
        unknown = np.unique(rows[self._place[rows] == 0])
        if unknown.size:
            count = self._count + unknown.size
            if count > len(self._rows):
                more = max(count, 2 * len(self._rows)) - len(self._rows)
                self._rows = np.concatenate([self._rows, np.empty(more, np.int64)])
                self._answers = np.concatenate([self._answers, np.empty((more, self.num_actions))])
            for start in range(0, unknown.size, BATCH):
                block = unknown[start : start + BATCH]
                place = slice(self._count + start, self._count + start + len(block))
                self._rows[place], self._answers[place] = block, self._ask(block)
            self._place[unknown] = np.arange(self._count, count) + 1
            self._count = count
        return self.probabilities[self.index(rows)]

    def _ask(self, rows: np.ndarray) -> np.ndarray:
        states, previous = np.divmod(rows, self.width)
        previous = np.where(previous == self.num_actions, -1, previous) if self.by_pairs else np.full(len(rows), -1)
        seen = self.observe(self.task.space.states(states), previous, np.zeros(len(rows), np.int64))
        return self.answer(seen, len(rows))

    def answer(self, seen: Any, count: int = 1) -> np.ndarray:
        """(N, A) probabilities for a batch of `count` observations; ParameterError where the policy answers otherwise."""
        answer = np.asarray(self.policy(seen))
        if answer.dtype.kind in "iu" and answer.shape == (count,):
            if (answer < 0).any() or (answer >= self.num_actions).any():
                raise ParameterError(
                    f"the policy chose action {answer.min()} to {answer.max()}; expected 0 to {self.num_actions - 1}"
                )
            return np.eye(self.num_actions)[answer]
        answer = answer.astype(np.float64)
        if answer.shape != (count, self.num_actions) or not (answer >= 0).all():
            raise ParameterError(
                f"the policy answered with shape {answer.shape} for {count} observations; expected "
                f"({count}, {self.num_actions}) probabilities, or ({count},) actions"
            )
        total = answer.sum(axis=1, keepdims=True)
        if not np.allclose(total, 1, atol=1e-4):
            raise ParameterError(f"the policy's probabilities sum to {total.min():g}; expected 1")
        if self.deterministic:
            return np.eye(self.num_actions)[answer.argmax(axis=1)]
        return answer / total


class _AskedTable(_Asked):
    """The same for a table: (S,) actions, (S, A) probabilities, or for each previous action, as `pharos.evaluate_policy` takes it."""

    def __init__(self, table: np.ndarray, task: Task):
        self._start(task)
        states, actions = task.mdp.num_states, task.mdp.num_actions
        shapes = [(states,), (states, actions)]
        if self.by_pairs:
            shapes += [(states, actions + 1), (states, actions + 1, actions)]
        if table.shape not in shapes or (table.ndim == 2 and self.by_pairs and table.dtype.kind in "iu") != (
            table.shape == (states, actions + 1)
        ):
            raise ParameterError(f"the policy has shape {table.shape}; expected one of {', '.join(map(str, shapes))}")
        self.table = table

    def _ask(self, rows: np.ndarray) -> np.ndarray:
        states, previous = np.divmod(rows, self.width)
        by_previous = self.table.ndim == 3 or self.table.shape == (self.task.mdp.num_states, self.num_actions + 1)
        found = self.table[states, previous] if by_previous else self.table[states]
        return np.eye(self.num_actions)[found] if found.ndim == 1 else np.asarray(found, np.float64)


def _check_observation(agent: Any, given: Any, name: Any) -> None:
    """ParameterError where a model was trained on observations of another shape."""
    model = getattr(agent, "model", agent)
    expected = getattr(getattr(model, "observation_space", None), "shape", None)
    shape = given.shape
    if expected is None or shape is None or expected in (shape, shape[2:] + shape[:2]):
        return
    raise ParameterError(
        f"the model was trained on observations of shape {expected}; {name!r} gives {shape}: name the observation it was trained on"
    )


def _steps_that_matter(mdp: TabularMDP) -> tuple[int, float]:
    """The number of steps after which nothing changes the value at the start by more than a bound, and the bound.

    Without a horizon 2 gamma^n max |r| / (1 - gamma), below TAIL; what a policy would do later is not asked.
    """
    if mdp.horizon is not None:
        return mdp.horizon, 0.0
    largest = 2 * max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest)) / (1 - mdp.gamma)
    if largest <= TAIL or mdp.gamma == 0.0:
        return 1, largest * mdp.gamma
    steps = max(1, math.ceil(math.log(TAIL / largest) / math.log(mdp.gamma)))
    return steps, largest * mdp.gamma**steps


def _start_rows(task: Task, asked: _Asked) -> np.ndarray:
    return task.mdp.start_states * asked.width + (asked.num_actions if asked.by_pairs else 0)


def _reach(task: Task, asked: _Asked, max_rows: int | None, steps: int | None) -> bool:
    """Ask the policy in all rows that it reaches (within `steps`), level by level; False where they are more than `max_rows`."""
    mdp, chance = task.mdp, task.mdp.chance
    table, actions = mdp.next_states, np.arange(mdp.num_actions)
    assert table is not None
    frontier = np.unique(_start_rows(task, asked))
    level = 0
    while frontier.size and (steps is None or level < steps):
        level += 1
        probabilities = asked.of(frontier)
        if max_rows is not None and len(asked.rows) > max_rows:
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
        frontier = rows[asked.index(rows) < 0]
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
        following = np.where(table >= 0, asked.index(arrived), -1)
        policy = asked.probabilities  # type: ignore[assignment]
        starts = asked.index(_start_rows(task, asked))
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
