"""An agent as a generator: it steps an environment that counts, and yields policies, which are evaluated exactly.

    def learn(env, steps, seed):
        observation, _ = env.reset(seed=seed)
        ...
        yield policy

A policy is a function from a batch of N observations to (N,) actions or (N, A) probabilities, or whatever else
`pharos.training.evaluate_agent` takes. It is asked about every state at the moment when it is yielded, and never again,
so that what it is made of may change afterwards: one forward pass for all states, some thousand observations. An agent
that yields about as often as it is evaluated, every `steps` / 15 steps, loses nothing by yielding more often.

At an evaluation point the policy counts that was yielded last, at that step or before. Before the first, uniform play
counts. The end of the generator, and `BudgetSpent`, are the end of training. Its last policy counts from there on.

Every copy of the environment counts against the same budget, or refuses to be made or stepped (`CountedEnv`). So a run
without a single counted step cannot have learnt: if its policy is better or worse than uniform play, it is refused.

A loop that is no generator uses the same parts: `PolicyRecorder` has the environment, takes policies, and makes the
curve. What looks like a mistake and is no error is a note (`PolicyRecorder.notes`).
"""

import contextlib
import copy
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn, SupportsIndex

import gymnasium
import numpy as np

from pharos.errors import ParameterError, PharosError
from pharos.interaction import GymEnv
from pharos.mdp import uniform_choice
from pharos.policies import PolicyAnswers, PolicyLike, RecurrentPolicy, SB3Model, deep_policy
from pharos.system.wording import capped, in_one_line, line_in
from pharos.system.workers import Terminated
from pharos.training.curve import Curve, Evaluation, evaluate_agent, policy_facts
from pharos.training.task import Task

RECORDER_BLOCK = 4096  # observations that a policy is asked about at once
MOST_STATES_ASKED = 100_000  # states that it is asked about in advance
MOST_ERROR_LETTERS = 500  # letters of an agent's error
KEPT = 1 << 28  # bytes of observations that are kept between snapshots
UNIFORM_TOLERANCE = 1e-9  # of normalised regret: as far from uniform play a policy without a step may be, by rounding
IGNORED = 1000
"""Steps beyond the budget, or policies in a row without a step, after which an agent is ended that goes on."""
OFTEN = 10
"""A slip that happens more often than this in a run is noted."""
MOST_UNNOTED = 0.01
"""Of steps after the end of an episode that is not noted."""
SAME_PROBABILITY = 1e-3
"""Probabilities that differ by less are the same: a network may round in another way."""
NETWORK_POLICY = "network(torch.as_tensor(seen)).argmax(dim=1).numpy()"
CHECKED = 3
"""First policies of a run that are asked again."""
MOST_QUERIES, FEW_ANSWERS = 8, 128
"""Up to MOST_QUERIES times, up to FEW_ANSWERS in all: a policy that samples seldom would answer the same by
chance if there are few observations."""
INFO = ("action_mask", "prob")
"""Entries of `info` that Gymnasium's own environments give as well; others say what an agent is to find out."""
SEVERAL = (
    "for several at once: gymnasium.vector.SyncVectorEnv([env.copy] * 4), or DummyVecEnv([env.copy] * 4) of "
    "Stable-Baselines3"
)

Learn = Callable[[gymnasium.Env, int, int], Iterator[PolicyLike]]
"""learn(env, steps, seed) -> policies, as it learns."""


class BudgetSpent(BaseException):
    """The environment was stepped more often than the budget allows: training is over.

    It is no `Exception`, so that an agent that catches those around `step` ends as well.
    """


@dataclass
class StepBudget:
    """Steps of all copies of an environment together, and slips of whoever steps them.

    Attributes:
        limit: steps that may be taken. interval: between evaluation points.
        steps: taken so far. episodes: finished so far. returns: the sum of their returns, without noise and delay.
        at: episodes and returns at the evaluation points so far.
        refused: steps that were asked for when none was left.
        after_end: steps between the end of an episode and the next reset.
        same_seeds: resets with the seed of the reset before.
        give_up: called instead of refusing once more when IGNORED steps were refused. It does not return.
        process: the one that counts. lock: held during a step.
    """

    limit: int
    interval: int
    steps: int = 0
    episodes: int = 0
    returns: float = 0.0
    at: list[tuple[int, float]] = field(default_factory=list)
    refused: int = 0
    after_end: int = 0
    same_seeds: int = 0
    give_up: Callable[[], NoReturn] | None = None
    process: int = field(default_factory=os.getpid)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def check_process(self) -> None:
        """Raise ParameterError in any other process, whose steps would not be counted."""
        if os.getpid() != self.process:
            raise ParameterError(
                f"the environment of the run was made in process {self.process}, which counts its steps; found "
                f"process {os.getpid()} (AsyncVectorEnv, SubprocVecEnv, a fork); {SEVERAL}"
            )

    def check_left(self) -> None:
        """Raise BudgetSpent if no step is left, and end an agent that asks for more all the same."""
        if self.steps < self.limit:
            return
        self.refused += 1
        if self.refused > IGNORED and self.give_up is not None:
            self.give_up()
        raise BudgetSpent(f"{self.limit:,} steps are taken")


class CountedEnv(gymnasium.Wrapper):
    """The environment of a task, whose steps count against a budget.

    Without a seed in its first `reset` it has the seed of the run, as its action space has, so that a run is the same
    again. `copy()` gives another one with the same budget, for vector environments:
    `gymnasium.vector.SyncVectorEnv([env.copy] * 8)`.

    `copy.copy` and `copy.deepcopy` give an environment of its own in the same state, with the same budget. It cannot be
    pickled, nor be used in another process than the one that made it: nobody would count there.

    `info` has nothing of what an agent is to learn: neither the state nor its index, neither the executed action nor
        what was earned without noise. INFO is what is left. Episodes begin in the start states of the task: `reset`
        takes
    no options.
    """

    def __init__(self, task: Task, budget: StepBudget, seed: int):
        super().__init__(GymEnv(task.env, **task.interaction))
        self.budget, self.seed = budget, seed
        self.seeds = np.random.SeedSequence(seed)
        self.action_space.seed(seed)
        self._task, self._return, self._is_seeded, self._is_over = task, 0.0, False, False
        self._last_seed: int | None = None  # of a reset that no step has followed
        self._seed_before: int | None = None  # of the last reset that had one

    @property
    def steps(self) -> int:
        """Steps that may be taken, of all copies together."""
        return self.budget.limit

    def copy(self) -> "CountedEnv":
        """A new environment of the same task and budget, with random numbers of its own."""
        (child,) = self.seeds.spawn(1)
        return CountedEnv(self._task, self.budget, int(child.generate_state(1)[0]))

    def __copy__(self) -> "CountedEnv":
        return self.__deepcopy__({})

    def __deepcopy__(self, memo: dict[int, Any]) -> "CountedEnv":
        twin = memo[id(self)] = self.copy()
        if self._is_seeded:  # it has a state
            twin.env, twin._return, twin._is_seeded = copy.deepcopy(self.env, memo), self._return, True
            twin._is_over = self._is_over
        return twin

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise ParameterError(
            f"the environment of the run cannot be pickled: its steps are counted in this process alone; {SEVERAL}"
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset as in Gymnasium. A first reset without a seed takes the seed of the run.

        Raises:
            ParameterError: it was made in another process, or it has options. Or it was just reset with the seed
                before, as a vector environment does in which one environment stands several times.
        """
        self.budget.check_process()
        if options:
            raise ParameterError(
                f"reset has the options {', '.join(map(str, options))}; expected none: episodes of the run begin "
                f"where its task says"
            )
        if seed is not None and self._last_seed == seed - 1:
            raise ParameterError(
                f"the environment of the run was reset with seed {self._last_seed}, then with {seed}, without a "
                f"step between: it stands several times in a vector environment; {SEVERAL}"
            )
        self._last_seed = seed
        if seed is not None:
            self.budget.same_seeds += seed == self._seed_before
            self._seed_before = seed
        elif not self._is_seeded:
            seed = self.seed
        self._return, self._is_seeded, self._is_over = 0.0, True, False
        observation, info = self.env.reset(seed=seed)
        return observation, _public(info)

    def step(self, action: object) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step as in Gymnasium. Raises BudgetSpent if no steps are left, ParameterError in another process."""
        budget = self.budget
        budget.check_process()
        with budget.lock:  # of threads
            budget.check_left()
            observation, reward, terminated, truncated, info = self.env.step(action)
            budget.steps += 1
            self._last_seed = None
            self._return += float(info.get("earned_reward", reward))
            if self._is_over:
                budget.after_end += 1
            elif terminated or truncated:
                budget.episodes += 1
                budget.returns += self._return
                self._is_over = True
            if budget.steps % budget.interval == 0:
                budget.at.append((budget.episodes, budget.returns))
        return observation, float(reward), terminated, truncated, _public(info)


def _public(info: Mapping[str, Any]) -> dict[str, Any]:
    return {name: info[name] for name in INFO if name in info}


class Snapshots:
    """Policies of a task as tables. Each policy is queried about all states at once."""

    def __init__(self, task: Task):
        self.task = task
        self._kept: list[tuple[int, Any]] | None = None
        self._num_checked = 0

    def evaluate(self, policy: PolicyLike) -> PolicyLike | Evaluation:
        """The current policy as (S, A) probabilities. Its value instead if it sees more than the state, or there are
        too many states.

        Raises:
            ParameterError: it raises, it answers something else than actions or probabilities, or one of the first
                CHECKED policies answers something else when it is asked again.
        """
        task = self.task
        if isinstance(policy, SB3Model):
            policy = deep_policy(policy)
        has_no_table = isinstance(policy, np.ndarray | RecurrentPolicy)
        if has_no_table or task.observer.frames > 1 or task.mdp.num_states > MOST_STATES_ASKED:
            return evaluate_agent(policy, task)
        answers = PolicyAnswers(policy, task.mdp, task.observer)
        if task.observer.observe.observation.irrelevant:
            states = np.arange(task.mdp.num_states)
            return answers.query(states * answers.width + (answers.width - 1))
        tables = []
        for count, observations in self._observations():
            tables.append(_answer(answers, policy, observations, count))
            if len(tables) == 1 and self._num_checked < CHECKED:
                self._num_checked += 1
                for _ in range(min(max(1, FEW_ANSWERS // count), MOST_QUERIES)):
                    _check_same_answers(tables[0], _answer(answers, policy, observations, count))
        return np.concatenate(tables)

    def _observations(self) -> Iterator[tuple[int, Any]]:
        """Blocks of observations of all states, kept if they are small."""
        if self._kept is not None:
            yield from self._kept
            return
        blocks, size = [], 0
        for first in range(0, self.task.mdp.num_states, RECORDER_BLOCK):
            states = np.arange(first, min(first + RECORDER_BLOCK, self.task.mdp.num_states))
            context = self.task.observer.space.states(states), np.full(len(states), -1), np.zeros(len(states), np.int64)
            block = len(states), self.task.observer.observe(*context)
            size += getattr(block[1], "nbytes", KEPT)
            blocks.append(block)
            yield block
        if size < KEPT:
            self._kept = blocks


def _answer(
    answers: PolicyAnswers, policy: PolicyLike, observations: np.ndarray | dict[str, np.ndarray], count: int
) -> np.ndarray:
    """(N, A) probabilities. ParameterError, one line that says what was asked, for an error in the policy's code."""
    try:
        return answers.answer(observations, count)
    except PharosError:
        raise
    except Exception as error:
        kind = f"{getattr(observations, 'shape', '')} {getattr(observations, 'dtype', '')}".strip()
        hint = "" if not hasattr(policy, "state_dict") else "; of a network: lambda seen: " + NETWORK_POLICY
        if hasattr(getattr(policy, "__self__", policy), "predict"):
            hint = "; of Stable-Baselines3: the model itself"
        raise ParameterError(
            f"the policy raised {in_one_line(error)}, asked about {count} observations, an array {kind}; expected a "
            f"function of such arrays that returns ({count}, A) probabilities or ({count},) actions{hint}"
        ) from error


def _check_same_answers(table: np.ndarray, again: np.ndarray) -> None:
    """Raise ParameterError for a policy whose second answer is another one than the first."""
    differ = np.abs(table - again).max(axis=1) > SAME_PROBABILITY
    if differ.any():
        raise ParameterError(
            f"the policy was asked twice, and answered otherwise for {differ.sum():,} of {len(table):,} observations; "
            f"expected the same: return (N, A) probabilities instead of sampled actions, and switch dropout off"
        )


class PolicyRecorder:
    """A run: an environment with a budget, policies as they are learnt, and the curve that they make.

    A policy is asked about every state when it is recorded. It counts at the points after its step, or at it.

    Args:
        task: of the run.
        steps: that may be taken. interval: between evaluation points. The last one is the end.
        seed: of the environment.
    Attributes:
        env: the environment. budget: its steps so far.
        count: policies so far.
        in_force: the policy of the points to come, a table or its value. Uniform play before the first.
        ended: finished episodes, and the sum of their returns, at the point that was passed last.
        at_point: called at each point.
    """

    def __init__(self, task: Task, *, steps: int, interval: int, seed: int):
        self.task = task
        self.budget = StepBudget(steps, interval)
        self.env = CountedEnv(task, self.budget, seed)
        self.count = 0
        self.in_force: PolicyLike | Evaluation = uniform_choice(task.mdp)
        self.ended = 0, 0.0
        self.at_point: Callable[[int], object] = self._remember
        self._points = deque([*range(interval, steps, interval), steps])  # to come
        self._num_points = len(self._points)
        self._first_step = steps  # of the first policy
        self._snapshots = Snapshots(task)
        self._passed: list[tuple[int, int, float, PolicyLike | Evaluation]] = [(0, 0, 0.0, self.in_force)]

    def record(self, policy: PolicyLike) -> None:
        """Let a policy be the one in force from this step on.

        Raises:
            ParameterError: it is no policy, or the second one and no step was counted.
        """
        if self.count and not self.budget.steps:
            raise not_stepped(self.budget.limit)
        self.pass_points(self.budget.steps)
        self.in_force = self._snapshots.evaluate(policy)
        if not self.count:
            self._first_step = self.budget.steps
        self.count += 1

    def pass_points(self, step: float) -> None:
        """Call `at_point` at the points before a step, with the policy in force."""
        while self._points and self._points[0] < step:
            point = self._points.popleft()
            self.ended = self._ended_at(point)
            self.at_point(point)

    def _remember(self, point: int) -> None:
        """Remember the policy in force, for the curve."""
        self._passed.append((point, *self.ended, self.in_force))

    def _ended_at(self, point: int) -> tuple[int, float]:
        budget = self.budget
        number = point // budget.interval
        is_passed = point % budget.interval == 0 and number <= len(budget.at)
        return budget.at[number - 1] if is_passed else (budget.episodes, budget.returns)

    def curve(self) -> Curve:
        """The curve, with the last policy in force at all points that were not passed.

        Raises:
            ParameterError: it ends with another policy than uniform play, and no step was counted.
        """
        curve = Curve(self.task, counted_steps=self.budget.steps)
        values: dict[int, Evaluation] = {}  # by the identity of the policy
        tables: list[np.ndarray | None] = []
        to_come = ((point, *self._ended_at(point), self.in_force) for point in self._points)
        for point, episodes, returns, policy in [*self._passed, *to_come]:
            if id(policy) not in values:
                values[id(policy)] = policy if isinstance(policy, Evaluation) else evaluate_agent(policy, self.task)
            curve.add(point, episodes, returns, policy, values[id(policy)])
            tables.append(policy if isinstance(policy, np.ndarray) else None)
        self.check_steps(curve)
        if self.count:
            regrets = [row["normalized_regret"] for row in curve.rows]
            curve.policies = policy_facts(self.task, tables[1:], regrets[1:])
        return curve

    def check_steps(self, curve: Curve) -> None:
        """Raise ParameterError if a curve ends elsewhere than it begins, and no step was counted."""
        first, last = (curve.rows[index]["normalized_regret"] for index in (0, -1))
        if not self.budget.steps and abs(last - first) > UNIFORM_TOLERANCE:
            raise not_stepped(self.budget.limit)

    def notes(self) -> dict[str, str]:
        """Sentences on what looks like a mistake of the agent, by kind: found, expected, what to try."""
        budget, points = self.budget, self._num_points
        notes = {}
        random = min(points, max(0, -(-self._first_step // budget.interval) - 1))
        if not self.count:
            notes["no policy"] = (
                f"yielded no policy: all {points} evaluations are random play; expected one from time to time, such as "
                f"every {budget.interval:,} steps"
            )
        elif random > points / 2:
            notes["late policy"] = (
                f"its first policy came after {self._first_step:,} of {budget.limit:,} steps: {random} of {points} "
                f"evaluations are random play; expected one about every {budget.interval:,} steps"
            )
        if budget.after_end > MOST_UNNOTED * budget.steps:
            notes["steps after an end"] = (
                f"{budget.after_end / budget.steps:.0%} of {budget.steps:,} steps came after the end of an episode; "
                f"expected reset() after a step that is terminated or truncated"
            )
        if budget.same_seeds > OFTEN and _has_chance(self.task):
            notes["same seed"] = (
                f"{budget.same_seeds:,} resets had the seed of the reset before, so that chance repeats itself; "
                f"expected a seed in the first reset alone"
            )
        if budget.refused > OFTEN:
            notes["steps beyond the budget"] = (
                f"asked for {budget.refused:,} steps beyond its {budget.limit:,}, which were refused; expected its "
                f"loop to end: catch no BudgetSpent (`except:`, `except BaseException`) around step"
            )
        if self.count and budget.steps < budget.limit / 2:
            notes["few steps"] = (
                f"used {budget.steps:,} of {budget.limit:,} steps; its last policy counts from there on"
            )
        return notes


def _has_chance(task: Task) -> bool:
    return bool(task.chance.to_dict()) or task.mdp.dynamics.has_chance or len(task.mdp.start_states) > 1


def generated_curve(learn: Learn, task: Task, *, steps: int, evaluations: int, seed: int) -> Curve:
    """Train with a generator, and evaluate the policy in force at each evaluation point, and uniform play before.

    Returns:
        A row before the first step, for uniform play, and one for each point. Also the number of counted steps.
    Raises:
        ParameterError: it is no generator of policies. Or it has a second policy, or ends with another one than uniform
            play, when no step was counted. Or whatever its code raises.
    """
    recorder = PolicyRecorder(task, steps=steps, interval=steps // evaluations, seed=seed)
    generate(learn, recorder, seed)
    return recorder.curve()


def end_process(agent: str, limit: int) -> NoReturn:
    """End this process: what catches BudgetSpent around `step`, and goes on, cannot be ended otherwise."""
    sys.stderr.write(
        f"pharos: agent {agent} went on for {IGNORED:,} steps after its {limit:,}; expected its loop to end: catch no "
        f"BudgetSpent (`except:`, `except BaseException`) around step\n"
    )
    sys.stderr.flush()
    os._exit(1)


@contextlib.contextmanager
def errors_in_one_line(agent: str, file: str | None) -> Iterator[None]:
    """Raise PharosError, which names the agent and the line of its file, for what its code raises, SystemExit included.

    file: with the code of the agent. Errors that do not pass through it are raised as they are, such as a full disk.
    """
    try:
        yield
    except (PharosError, MemoryError, KeyboardInterrupt, Terminated):
        raise
    except BaseException as error:
        if not (line := line_in(error, file)):
            raise
        text = capped(in_one_line(error).rstrip(": "), MOST_ERROR_LETTERS)
        raise PharosError(f"agent {agent} raised {text}{line}") from error


def generate(learn: Callable[..., Any], recorder: PolicyRecorder, seed: int) -> None:
    """Train with a generator, and record its policies until it, or its budget, has ended. Errors are the same as for
    `generated_curve`.

    After a refused step one more policy counts. A generator that yields IGNORED policies in a row without a step is
    refused, or, if its budget is spent, has ended.
    """
    budget = recorder.budget
    before, idle = 0, 0
    policies = None
    try:
        policies = learn(recorder.env, budget.limit, seed)
        if not isinstance(policies, Iterator):
            raise ParameterError(f"learn(env, steps, seed) returned {policies!r}; expected a generator: yield policies")
        for policy in policies:
            recorder.record(policy)
            idle = idle + 1 if budget.steps == before else 0
            before = budget.steps
            if budget.refused or (idle >= IGNORED and budget.steps == budget.limit):
                break
            if idle >= IGNORED:
                raise ParameterError(
                    f"learn yielded {idle:,} policies in a row without a step, after {budget.steps:,} of "
                    f"{budget.limit:,}; expected it to step the environment, or to end"
                )
    except BudgetSpent:
        pass
    finally:
        with contextlib.suppress(Exception, BudgetSpent):  # of its `finally` blocks, or that it goes on
            getattr(policies, "close", int)()


def not_stepped(steps: int) -> ParameterError:
    """The error of a function that has learnt without a counted step."""
    return ParameterError(
        f"learn has a policy other than uniform play, and 0 of its {steps:,} steps were counted; expected it to step "
        f"the environment that it was given, or copies of it; {SEVERAL}"
    )
