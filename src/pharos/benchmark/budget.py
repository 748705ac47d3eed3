"""An agent as a generator: it steps an environment that counts, and yields policies, which are evaluated exactly.

    def learn(env, steps, seed):
        observation, _ = env.reset(seed=seed)
        ...
        yield policy

A policy is a function from a batch of N observations to (N,) actions or (N, A) probabilities, or whatever else
`pharos.training.evaluate_agent` takes. It is asked about every state at the moment when it is yielded, and never again,
so that what it is made of may change afterwards: one forward pass for all states, some thousand observations. An agent
that yields about as often as it is evaluated, every `steps` / 15 steps, loses nothing by yielding more often.

At an evaluation point the policy counts that was yielded last, at that step or before; none yet: uniform play. The end
of the generator, and `BudgetSpent`, are the end of training; its last policy counts from there on.

Every copy of the environment counts against the same budget, or refuses to be made or stepped (`CountedEnv`). So a run
without a single counted step cannot have learnt: if its policy is better or worse than uniform play, it is refused.
"""

import copy
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NoReturn, SupportsIndex

import gymnasium
import numpy as np

from pharos.errors import ParameterError
from pharos.interaction import GymEnv
from pharos.mdp import uniform_choice
from pharos.policies import PolicyAnswers, PolicyLike, RecurrentPolicy, SB3Model, deep_policy
from pharos.training import Curve, Evaluation, Task, evaluate_agent

BLOCK = 4096  # observations that a policy is asked about at once
LARGEST = 100_000  # states that it is asked about in advance
KEPT = 1 << 28  # bytes of observations that are kept between snapshots
TOLERANCE = 1e-9  # of normalised regret: as far from uniform play a policy without a step may be, by rounding
SEVERAL = (
    "for several at once: gymnasium.vector.SyncVectorEnv([env.copy] * 4), or DummyVecEnv([env.copy] * 4) of "
    "Stable-Baselines3"
)

Learn = Callable[[gymnasium.Env, int, int], Iterator[PolicyLike]]
"""learn(env, steps, seed) -> policies, as it learns."""


class BudgetSpent(Exception):
    """The environment was stepped more often than the budget allows: training is over."""


@dataclass
class StepBudget:
    """Steps of all copies of an environment together.

    Attributes:
        limit: steps that may be taken. interval: between evaluation points.
        steps, episodes, returns: taken; finished; the sum of the returns of finished ones, without noise and delay.
        at: episodes and returns at the evaluation points so far.
        process: the one that counts. lock: held during a step.
    """

    limit: int
    interval: int
    steps: int = 0
    episodes: int = 0
    returns: float = 0.0
    at: list[tuple[int, float]] = field(default_factory=list)
    process: int = field(default_factory=os.getpid)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def check_process(self) -> None:
        """Raise ParameterError in any other process, whose steps would not be counted."""
        if os.getpid() != self.process:
            raise ParameterError(
                f"the environment of the benchmark was made in process {self.process}, which counts its steps; found "
                f"process {os.getpid()} (AsyncVectorEnv, SubprocVecEnv, a fork); {SEVERAL}"
            )


class CountedEnv(gymnasium.Wrapper):
    """The environment of a task, whose steps count against a budget.

    Without a seed in its first `reset` it has that of the run, as its action space has, so that a run is the same
    again. `copy()` gives another one with the same budget, for vector environments:
    `gymnasium.vector.SyncVectorEnv([env.copy] * 8)`.

    `copy.copy` and `copy.deepcopy` give an environment of its own in the same state, with the same budget. It cannot be
    pickled, nor be used in another process than the one that made it: nobody would count there.
    """

    def __init__(self, task: Task, budget: StepBudget, seed: int):
        super().__init__(GymEnv(task.env, **task.interaction))
        self.task, self.budget, self.seed = task, budget, seed
        self.seeds = np.random.SeedSequence(seed)
        self.action_space.seed(seed)
        self._return, self._is_seeded = 0.0, False
        self._last_seed: int | None = None  # of a reset that no step has followed

    def copy(self) -> "CountedEnv":
        """A new environment of the same task and budget, with random numbers of its own."""
        (child,) = self.seeds.spawn(1)
        return CountedEnv(self.task, self.budget, int(child.generate_state(1)[0]))

    def __copy__(self) -> "CountedEnv":
        return self.__deepcopy__({})

    def __deepcopy__(self, memo: dict[int, Any]) -> "CountedEnv":
        twin = memo[id(self)] = self.copy()
        if self._is_seeded:  # it has a state
            twin.env, twin._return, twin._is_seeded = copy.deepcopy(self.env, memo), self._return, True
        return twin

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise ParameterError(
            f"the environment of the benchmark cannot be pickled: its steps are counted in this process alone; "
            f"{SEVERAL}"
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset as in Gymnasium; a first reset without a seed takes the seed of the run.

        Raises:
            ParameterError: it was made in another process; or it was just reset with the seed before, as a vector
                environment does in which one environment stands several times.
        """
        self.budget.check_process()
        if seed is not None and self._last_seed == seed - 1:
            raise ParameterError(
                f"the environment of the benchmark was reset with seed {self._last_seed}, then with {seed}, without a "
                f"step between: it stands several times in a vector environment; {SEVERAL}"
            )
        self._last_seed = seed
        if seed is None and not self._is_seeded:
            seed = self.seed
        self._return, self._is_seeded = 0.0, True
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step as in Gymnasium. Raises BudgetSpent if no steps are left, ParameterError in another process."""
        budget = self.budget
        budget.check_process()
        with budget.lock:  # of threads
            if budget.steps >= budget.limit:
                raise BudgetSpent(f"{budget.limit:,} steps are taken")
            observation, reward, terminated, truncated, info = self.env.step(action)
            budget.steps += 1
            self._last_seed = None
            self._return += float(info.get("earned_reward", reward))
            if terminated or truncated:
                budget.episodes += 1
                budget.returns += self._return
                self._return = 0.0
            if budget.steps % budget.interval == 0:
                budget.at.append((budget.episodes, budget.returns))
        return observation, float(reward), terminated, truncated, info


class Snapshots:
    """Policies of a task as tables; each policy is queried about all states at once."""

    def __init__(self, task: Task):
        self.task = task
        self._kept: list[tuple[int, Any]] | None = None

    def taken(self, policy: PolicyLike) -> PolicyLike | Evaluation:
        """The current policy as (S, A) probabilities; or its value if it sees more than the state, or there are too
        many states.

        Raises:
            ParameterError: it answers something else than actions or probabilities.
        """
        task = self.task
        if isinstance(policy, SB3Model):
            policy = deep_policy(policy)
        has_no_table = isinstance(policy, np.ndarray | RecurrentPolicy)
        if has_no_table or task.observer.frames > 1 or task.mdp.num_states > LARGEST:
            return evaluate_agent(policy, task)
        answers = PolicyAnswers(policy, task.mdp, task.observer)
        if task.observer.observe.observation.irrelevant:
            states = np.arange(task.mdp.num_states)
            return answers.query(states * answers.width + (answers.width - 1))
        return np.concatenate([answers.answer(observations, count) for count, observations in self._observations()])

    def _observations(self) -> Iterator[tuple[int, Any]]:
        """Blocks of observations of all states, kept where they are small."""
        if self._kept is not None:
            yield from self._kept
            return
        blocks, size = [], 0
        for first in range(0, self.task.mdp.num_states, BLOCK):
            states = np.arange(first, min(first + BLOCK, self.task.mdp.num_states))
            context = self.task.observer.space.states(states), np.full(len(states), -1), np.zeros(len(states), np.int64)
            block = len(states), self.task.observer.observe(*context)
            size += getattr(block[1], "nbytes", KEPT)
            blocks.append(block)
            yield block
        if size < KEPT:
            self._kept = blocks


def generated_curve(learn: Learn, task: Task, *, steps: int, evaluations: int, seed: int) -> Curve:
    """Train with a generator, and evaluate the policy in force at each evaluation point, and uniform play before.

    Returns:
        A row before the first step, that of uniform play, and one for each point; and the number of counted steps.
    Raises:
        ParameterError: it is no generator of policies; or it has a second policy, or ends with another one than uniform
            play, when no step was counted; or whatever its code raises.
    """
    budget = StepBudget(steps, steps // evaluations)
    snapshots = Snapshots(task)
    last: PolicyLike | Evaluation = uniform_policy(task)
    counting: list[PolicyLike | Evaluation] = [last]
    try:
        policies = learn(CountedEnv(task, budget, seed), steps, seed)
        if not isinstance(policies, Iterator):
            raise ParameterError(f"learn(env, steps, seed) returned {policies!r}; expected a generator: yield policies")
        for number, policy in enumerate(policies):
            if number and not budget.steps:
                raise _not_stepped(steps)
            num_points = (budget.steps - 1) // budget.interval  # evaluation points before this step
            counting += [last] * (num_points + 1 - len(counting))
            last = snapshots.taken(policy)
    except BudgetSpent:
        pass
    counting += [last] * (evaluations + 1 - len(counting))
    budget.at += [(budget.episodes, budget.returns)] * (evaluations - len(budget.at))
    curve, values = Curve(task, counted_steps=budget.steps), {}
    for place, (counted, ended) in enumerate(zip(counting, [(0, 0.0), *budget.at], strict=True)):
        if id(counted) not in values:
            values[id(counted)] = counted if isinstance(counted, Evaluation) else evaluate_agent(counted, task)
        curve.add(place * budget.interval, *ended, counted, values[id(counted)])
    uniform, ended_with = (curve.rows[place]["normalized_regret"] for place in (0, -1))
    if not budget.steps and abs(ended_with - uniform) > TOLERANCE:
        raise _not_stepped(steps)
    return curve


def _not_stepped(steps: int) -> ParameterError:
    return ParameterError(
        f"learn has a policy other than uniform play, and 0 of its {steps:,} steps were counted; expected it to step "
        f"the environment that it was given, or copies of it; {SEVERAL}"
    )


def uniform_policy(task: Task) -> np.ndarray:
    """(S, A) probabilities of uniform play."""
    return uniform_choice(task.mdp)
