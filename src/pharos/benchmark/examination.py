"""An agent trained on twelve small worlds, with all that there is to see of it: the material of `pharos diagnose`.

Each run ends in an `Examination`: the world as arrays, how often the agent took which action in which state while it
learnt, and what its last policy answers about every state. A policy may offer `q_values(observations)`, (N, A), or
`values(observations)`, (N,). Policies of Stable-Baselines3 are asked in their own way.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np

from pharos.agents import (
    CLASS,
    QLearning,
    agents,
    algorithm,
    check_hyperparameters,
    check_keywords,
    form_of,
    generator_of,
    is_known,
    make_model,
)
from pharos.benchmark.suite import BenchmarkTask, Protocol
from pharos.errors import ParameterError, TimeLimit, UnknownName
from pharos.policies import PolicyLike, SB3Model
from pharos.system.interrupts import time_limit
from pharos.system.sources import find_source, load_source
from pharos.system.workers import Terminated, check_timeout
from pharos.training import (
    BudgetSpent,
    CountedEnv,
    PolicyRecorder,
    StepBudget,
    Task,
    end_process,
    errors_in_one_line,
    evaluate_agent,
    generate,
    regret,
)

EXAMINATION_PROTOCOL = Protocol(steps=4000, evaluations=10, seeds=2)
LATE, LAST = 0.2, 0.025  # parts of a run


def _world(name: str, environment: str, observation: str = "vector", random: float = 0.0, **parameters: Any) -> Any:
    chance = {"random": random} if random else {}
    return BenchmarkTask(name, environment, parameters, observation, chance=chance)


WORLDS: tuple[BenchmarkTask, ...] = (
    _world("lake", "frozen_lake/4x4"),
    _world("windy-lake", "frozen_lake/4x4", "one_hot", random=0.1),
    _world("lake-image", "frozen_lake/4x4", "simple_image"),
    _world("cliff", "cliff_walking", "one_hot", height=3, width=5),
    _world("cliff-vector", "cliff_walking", height=3, width=4),
    _world("still", "mini_grid_empty", size=3),
    _world("umbrella", "umbrella_chain", "one_hot", chain_length=10),
    _world("sea-image", "deep_sea", "simple_image", size=5),
    _world("catch", "catch", rows=5, columns=3),
    _world("memory", "memory_chain", memory_length=2, num_bits=2),
    _world("decoy", "simple_grid/6x6-decoy"),
    _world("road", "freeway", num_cars=2, lane_length=3),
)
"""Two lakes, one with chance; images and vectors of one world; rewards of several sizes; an episode that only time
ends; a first action that pays at the end; costs on the way; states that must be told apart by their last number."""
NAMES = tuple(world.name for world in WORLDS)


@dataclass(frozen=True, eq=False)
class WorldArrays:
    """A world as arrays, S states and A actions.

    Attributes:
        transitions: (S, A, S) probabilities of the next state. rewards: (S, A) expected. terminal: (S,).
        start: (S,) probability that an episode begins there.
        vary: (D,) whether a number of the observation differs between two states.
    """

    transitions: np.ndarray
    rewards: np.ndarray
    terminal: np.ndarray
    start: np.ndarray
    vary: np.ndarray


@dataclass(frozen=True, eq=False)
class Examination:
    """Observations of one run, as arrays.

    Attributes:
        name: of the world. seed: of the run.
        world: as arrays.
        visits: (S, A) steps by state and action. late, last: in the last fifth and in the last fortieth.
        cuts: (S, A) steps after which the time limit ended the episode.
        policy: (S, A) probabilities of the last policy.
        q: (S, A) and v: (S,), if it offers them.
        reaction: (D,) mean change of its answers, or of its policy, if a number of the observation is taken from
            another state, relative to the deviation of answers between states.
        wavering: largest change of its answers if it is asked again, in another order.
        regret: of the last policy, 0 optimal and 1 as uniform play. late_regret: of the returns of the last fifth.
        notes: sentences on what looks like a mistake of its loop, by kind.
        onward: (S, A) probabilities of the next action whose value counts in a backup. None if the largest value does.
    """

    name: str
    seed: int
    world: WorldArrays
    visits: np.ndarray
    late: np.ndarray
    last: np.ndarray
    cuts: np.ndarray
    policy: np.ndarray
    q: np.ndarray | None
    v: np.ndarray | None
    reaction: np.ndarray
    wavering: float
    regret: float
    late_regret: float
    notes: Mapping[str, str] = field(default_factory=dict)
    onward: np.ndarray | None = None


@cache
def solved(name: str) -> tuple[Task, WorldArrays, np.ndarray]:
    """Task, arrays and observations of all states of one of WORLDS. UnknownName: there is none of this name."""
    if name not in NAMES:
        raise UnknownName("world", name, NAMES)
    task = WORLDS[NAMES.index(name)].training_task(EXAMINATION_PROTOCOL)
    mdp, size = task.mdp, task.mdp.num_states
    states = np.arange(size)
    observations: Any = task.observer.observe(task.space.states(states), np.full(size, -1), np.zeros(size, np.int64))
    pairs = np.arange(size * mdp.num_actions)
    which, after, probabilities = mdp.dynamics.entries(pairs // mdp.num_actions, pairs % mdp.num_actions)
    transitions = np.zeros((len(pairs), size))
    np.add.at(transitions, (which[after >= 0], after[after >= 0]), probabilities[after >= 0])
    start = np.zeros(size)
    start[mdp.start_states] = mdp.start_probabilities
    rows = observations.reshape(size, -1)
    world = WorldArrays(
        transitions.reshape(size, -1, size),
        np.asarray(mdp.rewards, np.float64),
        np.asarray(mdp.terminal, bool),
        start,
        (rows != rows[0]).any(axis=0),
    )
    return task, world, observations


# A run ----------------------------------------------------------------------------------------------------------------


@dataclass
class Log:
    """Steps of all copies of an environment: state before, action, whether time ended the episode, and returns."""

    states: list[np.ndarray] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    cuts: list[bool] = field(default_factory=list)
    returns: list[tuple[int, float]] = field(default_factory=list)


class WatchedEnv(CountedEnv):
    """The environment of a run that writes down what is done in it, in all of its copies."""

    def __init__(self, task: Task, budget: StepBudget, seed: int, log: Log):
        super().__init__(task, budget, seed)
        self.log = log

    def copy(self) -> "WatchedEnv":
        (child,) = self.seeds.spawn(1)
        return WatchedEnv(self._task, self.budget, int(child.generate_state(1)[0]), self.log)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        before = None if self._is_over else self.env.unwrapped.state  # type: ignore[attr-defined]
        answer = super().step(action)
        if before is not None:
            log, (_, _, terminated, truncated, _) = self.log, answer
            log.states.append(before)
            log.actions.append(int(action))
            log.cuts.append(truncated and not terminated)
            if self._is_over:
                log.returns.append((len(log.states), self._return))
        return answer


class Witness(PolicyRecorder):
    """A recorder of policies that also asks them for values."""

    def __init__(self, name: str, seed: int, steps: int):
        self.name, self.seed, self.log = name, seed, Log()
        task, self.world, self.observations = solved(name)
        super().__init__(task, steps=steps, interval=max(1, steps // EXAMINATION_PROTOCOL.evaluations), seed=seed)
        self.env = WatchedEnv(task, self.budget, seed, self.log)
        self.answers: tuple[np.ndarray | None, np.ndarray | None, np.ndarray, float] | None = None

    def record(self, policy: PolicyLike) -> None:
        super().record(policy)
        if self.budget.steps >= self.budget.limit * (1 - LATE):
            self.answers = self._answers(policy)

    def _answers(self, policy: PolicyLike) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray, float]:
        q_values, values = value_functions(policy)
        table, rng = np.asarray(self.in_force, np.float64), np.random.default_rng(0)
        if table.ndim == 1:
            table = np.eye(self.world.rewards.shape[1])[table.astype(int)]
        ask = q_values or values
        first = table if ask is None else ask(self.observations)
        order, wavering = rng.permutation(len(self.observations)), 0.0
        if ask is None:  # what is left of it is its table
            return None, None, np.full(self.world.vary.shape, np.nan), 0.0
        wavering = float(np.abs(ask(self.observations[order]) - first[order]).max() / (np.abs(first).max() + 1e-12))
        reaction = np.zeros(len(self.world.vary))
        deviation = float(first.std(axis=0).mean()) + 1e-12
        rows = self.observations.reshape(len(self.observations), -1)
        for column in np.flatnonzero(self.world.vary):
            other = rows.copy()
            other[:, column] = rows[order, column]
            reaction[column] = np.abs(ask(other.reshape(self.observations.shape)) - first).mean() / deviation
        return (first if q_values else None), (values(self.observations) if values else None), reaction, wavering

    def examination(self) -> Examination:
        """The examination of the run. ParameterError: it has recorded no policy in the last fifth of its steps."""
        if self.answers is None:
            raise ParameterError(
                f"world {self.name}, seed {self.seed}: no policy came in the last {LATE:.0%} of {self.budget.limit:,} "
                f"steps, of which it used {self.budget.steps:,}; expected one at the end: yield policy"
            )
        task, log, shape = self.task, self.log, self.world.rewards.shape
        table = np.asarray(self.in_force, np.float64)
        policy = np.eye(shape[1])[table.astype(int)] if table.ndim == 1 else table
        pairs = task.space.indices(np.array(log.states)) * shape[1] + np.array(log.actions)
        count, size = len(pairs), shape[0] * shape[1]

        def counts(which: np.ndarray) -> np.ndarray:
            return np.bincount(which, minlength=size).reshape(shape)

        reference, late = task.reference, [r for step, r in log.returns if step > count * (1 - LATE)]
        late_regret = regret(float(np.mean(late)), reference, normalized_by="uniform") if late else np.nan
        q, v, reaction, wavering = self.answers
        return Examination(
            self.name,
            self.seed,
            self.world,
            counts(pairs),
            counts(pairs[int(count * (1 - LATE)) :]),
            counts(pairs[int(count * (1 - LAST)) :]),
            counts(pairs[np.array(log.cuts)]),
            policy,
            q,
            v,
            reaction,
            wavering,
            float(regret(evaluate_agent(policy, task).value, reference, normalized_by="uniform")),
            float(late_regret),
            {kind: text for kind, text in self.notes().items() if kind != "late policy"},
        )


def table_examination(name: str, seed: int, steps: int, setting: Mapping[str, Any]) -> Examination:
    """The examination of pharos' own table, `QLearning`, by its counts of visits. It sees states, not numbers."""
    task, world, _ = solved(name)
    table = QLearning(task.mdp, total_steps=steps, seed=seed, time_limit=task.time_limit, **setting)
    ends = [int(steps * (1 - LATE)), int(steps * (1 - LAST)), steps]
    visits = []
    for end in ends:
        visits.append(table.learn(end - table.steps).visits.copy())
    policy = np.eye(world.rewards.shape[1])[table.policy_table()]
    return Examination(
        name,
        seed,
        world,
        visits[2],
        visits[2] - visits[0],
        visits[2] - visits[1],
        np.zeros_like(visits[2]),
        policy,
        table.q.copy(),
        None,
        np.ones(world.vary.shape),
        0.0,
        float(regret(evaluate_agent(policy, task).value, task.reference, normalized_by="uniform")),
        np.nan,
    )


def value_functions(policy: Any) -> tuple[Callable[[Any], np.ndarray] | None, Callable[[Any], np.ndarray] | None]:
    """Functions of observations to (N, A) values of actions and to (N,) values of states, or None if it has none.

    A method of an object that offers them, such as `policy` of a class with act and observe, has the functions of its
    object.
    """
    if not (hasattr(policy, "q_values") or hasattr(policy, "values")):
        policy = getattr(policy, "__self__", policy)
    q_values, values = getattr(policy, "q_values", None), getattr(policy, "values", None)
    if isinstance(policy, SB3Model):
        network: Any = getattr(policy, "q_net", None)
        inner: Any = getattr(policy, "policy", None)
        if network is not None:
            q_values = partial(_of_torch, inner, network)
        elif hasattr(inner, "predict_values"):
            values = partial(_of_torch, inner, inner.predict_values)
    return (
        (lambda observations: np.asarray(q_values(observations), np.float64)) if callable(q_values) else None,
        (lambda observations: np.asarray(values(observations), np.float64).reshape(len(observations)))
        if callable(values)
        else None,
    )


def _of_torch(policy: Any, network: Callable[[Any], Any], observations: np.ndarray) -> np.ndarray:
    import torch

    with torch.no_grad():
        return network(policy.obs_to_tensor(observations)[0]).cpu().numpy()


# Agents ---------------------------------------------------------------------------------------------------------------


def learner_of(agent: str | Callable[..., Any], hyperparameters: Mapping[str, Any] | None = None) -> Callable[..., Any]:
    """An agent as learn(env, steps, seed).

    Args:
        agent: a generator, or a class with act, observe and policy, or `file.py:Name` of one. Or the name or class of
            an algorithm of Stable-Baselines3, such as dqn.
    Raises:
        ParameterError, UnknownName: there is no such agent, it lacks a hyperparameter, or it is one in JAX.
    """
    setting = dict(hyperparameters or {})
    code: Any = agent
    if isinstance(agent, str) and not is_known(agent):
        code = load_source(find_source(agent))
    if not isinstance(code, str):
        form = form_of(str(agent), code)
        if form not in (CLASS, "generator"):
            raise ParameterError(f"agent {agent!r} is in JAX; expected a generator: learn(env, steps, seed)")
        if form != CLASS:
            check_keywords(str(agent), code, setting)
            return partial(generator_of(code), **setting)
    elif code in agents() and agents()[code].has_table:
        raise ParameterError(f"agent {code!r} is a table, which sees no observation; expected an agent with a network")
    defaults = dict(agents()[code].defaults) if isinstance(code, str) and code in agents() else {}
    algorithm(code)
    check_hyperparameters(code, setting)
    return partial(_model_learner, code, {**defaults, **setting})


def _file_of(agent: str | Callable[..., Any]) -> str | None:
    """The file with the code of an agent of the user's own."""
    if isinstance(agent, str):
        return None if is_known(agent) else find_source(agent).file
    return getattr(getattr(agent, "__code__", None), "co_filename", None)


def _model_learner(
    agent: str | Callable[..., Any], setting: dict[str, Any], env: Any, steps: int, seed: int
) -> Iterator[Any]:
    """Train a model of Stable-Baselines3, and yield it once."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    several = DummyVecEnv([env.copy for _ in range(int(setting.get("n_envs", 1)))])
    model = make_model(agent, several, setting, seed=seed)
    with contextlib.suppress(BudgetSpent):
        model.learn(steps)
    yield model


def examine(
    agent: str | Callable[..., Any],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    worlds: Sequence[str] = NAMES,
    seeds: Sequence[int] = (0, 1),
    steps: int = EXAMINATION_PROTOCOL.steps,
    timeout: float | None = None,
    progress: Callable[[float, str], object] = lambda share, text: None,
) -> list[Examination]:
    """Train an agent on small worlds, in this process, and write down all that there is to see.

    Args:
        agent, hyperparameters: as `learner_of` takes them.
        worlds: of NAMES. seeds: of the runs of each. steps: of each run.
        timeout: seconds after which a run is ended, or None for never. Counted in the main thread alone, not on
            Windows.
        progress: called with the share that is done, and a text.
    Raises:
        ParameterError: it is no agent, or it yields no policy.
        PharosError: its code raises something, SystemExit included. TimeLimit: a run took longer than was allowed.
    Cost: `len(worlds) * len(seeds)` runs, and values of some hundred states.
    """
    check_timeout(timeout)
    has_table = isinstance(agent, str) and agent in agents() and agents()[agent].has_table
    learn, file = (None, None) if has_table else (learner_of(agent, hyperparameters), _file_of(agent))
    setting = {**agents()[str(agent)].defaults, **(hyperparameters or {})} if has_table else {}
    examinations: list[Examination] = []
    for name in worlds:
        for seed in seeds:
            progress(len(examinations) / (len(worlds) * len(seeds)), f"{name}, seed {seed}")
            if learn is None:
                examinations.append(table_examination(name, seed, steps, setting))
                continue
            witness = Witness(name, seed, steps)
            witness.budget.give_up = partial(end_process, str(agent), steps)
            try:
                with time_limit(timeout, OutOfTime), np.errstate(all="ignore"), errors_in_one_line(str(agent), file):
                    generate(learn, witness, seed)
            except OutOfTime:
                raise TimeLimit(
                    f"agent {agent} on {name}, seed {seed}: took longer than {timeout:g} s; it was ended: raise the "
                    f"timeout, or look for a loop without an end"
                ) from None
            examinations.append(witness.examination())
    return examinations


class OutOfTime(Terminated):
    """The time of a run is over. `except Exception` of an agent does not catch it."""
