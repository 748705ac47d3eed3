"""Values of learnt policies, of one or of a batch at once, and the curves that runs write of them.

A row of a curve has the exact value of the policy at an evaluation, and the regret of the episodes before it.
"""

import math
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import Learner, agent_called
from pharos.errors import PharosError
from pharos.policies import (
    AverageRegret,
    Evaluation,
    MasksLike,
    PolicyAnswers,
    PolicyLike,
    is_small_table,
    is_walk,
    policy_gain,
    policy_value,
    table_values,
    walk_values,
)
from pharos.regret import ReferenceValues, cumulative_expected_regret, regret, regret_scale
from pharos.solvers import GainInterval
from pharos.training import results as _results
from pharos.training.task import Task

if TYPE_CHECKING:
    from pharos.training.schedule import PreparedRun


CURVE_BLOCK = 4096  # observations that policies are asked about at once
CERTAIN, TIE = 0.999, 1e-9  # probability of a certain choice; difference of equal ones


def evaluate_agent(
    agent: PolicyLike,
    task: Task,
    *,
    deterministic: bool = False,
    masks: MasksLike | None = None,
    max_states: int = 100_000,
    episodes: int = 2_000,
    seed: int = 0,
    again: bool = False,
) -> Evaluation:
    """Return the value of an agent's current policy on a task.

    Args:
        agent: an object with `policy_table()` (S,), (S, A) or as `pharos.evaluate_policy` takes it, or with
            `action_probabilities(observations)` -> (N, A). Or a model of Stable-Baselines3, an array like the table, or
            a function of observations that returns (N, A) probabilities or (N,) actions. Or an agent with a memory:
            `initial_state(n)` and `(observations, state, starts)` -> (probabilities or actions, next state), the state
            an array or nested tuples of arrays whose first axis is n. It is asked in histories.
        deterministic: whether the most probable action is taken (the first among equals) instead of one at random.
        masks: the actions that a model trained under masks (MaskablePPO) may choose, (S, A) bool by the states of
            `task.space`, or a function from states (N, D) to (N, A) bool.
        max_states: how many states (pairs, if previous actions matter, histories for a memory) the policy may
            reach for an exact value.
        episodes, seed: of the estimate beyond that.
        again: whether more policies of the task will be evaluated: what they share is remembered. Changes no value.
            Policies of vectors under chance are then asked in blocks about all states that any policy reaches, if
            these are few enough, else about the states that they reach, step by step.
    Returns:
        Its `Evaluation`, with the `gain` if the objective of the task is the average reward. If the policy reaches more
        than `max_states`, the gain lies between the gains of the worst and the best policy.
    Raises:
        ParameterError: the agent is none of these, its answers are no probabilities, or it was trained on other
            observations, behind a VecNormalize that is not with it, or under masks that are not given.
    Cost: one answer of the policy for each state reached, then horizon x states reached.
    Source: exact policy evaluation, Puterman (1994), section 6.1; reached states: a closed class of an MDP has the same
        values alone; Maurer and Pontil (2009), theorem 4.
    """
    limits: dict[str, Any] = {"deterministic": deterministic, "masks": masks, "max_states": max_states}
    value = policy_value(
        agent,
        task.measured,
        lambda: task.observer,
        lambda: task.return_range,
        episodes=episodes,
        seed=seed,
        reach=task.reach if again else None,
        **limits,
    )
    if task.objective != "average":
        return value
    gain = policy_gain(agent, task.mdp, lambda: task.observer, **limits)
    return replace(value, gain=gain or GainInterval(task.gains["worst"].lower, task.gains["optimal"].upper))


def joint_values(batch: Learner, runs: "Sequence[PreparedRun]") -> dict[int, Evaluation]:
    """Values of policies by index in the batch, if computing them at once costs less. Others are left out.

    These are policies of DQN if nothing is random, and of runs that share a task of few states and see one frame.
    If gains are measured, too, each policy is evaluated alone.
    """
    joint = [i for i, each in enumerate(runs) if each.error is None and each.task.objective != "average"]
    walks = [i for i in joint if _walks(runs[i])] if hasattr(batch, "best_actions") else []
    values = _values_of_walks(batch, runs, walks)
    tasks = defaultdict(list)
    for i in joint:
        run = runs[i]
        if i not in values and is_small_table(run.task.measured) and _frames(run) == 1:
            tasks[id(run.task)].append(i)
    for indices in tasks.values():
        if len(indices) > 1:
            values |= _values_of_tables(batch, runs[indices[0]].task, indices)
    return values


def _walks(run: "PreparedRun") -> bool:
    return agent_called(run.config.agent).is_greedy and is_walk(run.task.mdp)


def _frames(run: "PreparedRun") -> int:
    """Number of states in one observation of the agent: more than 1 if frames are stacked."""
    return 1 if agent_called(run.config.agent).has_table else run.task.observer.frames


def _values_of_walks(batch: Learner, runs: "Sequence[PreparedRun]", indices: Sequence[int]) -> dict[int, Evaluation]:
    """Values by index: an episode of T steps costs T calls of the networks of all runs at once, not of each."""
    if not indices:
        return {}
    best_actions = getattr(batch, "best_actions")  # noqa: B009  (which not every learner has)
    frames = _frames(runs[indices[0]])
    states = np.zeros((len(runs), frames) if frames > 1 else len(runs), np.int64)

    def act(now: np.ndarray) -> np.ndarray:
        states[indices] = now
        return best_actions(states)[indices]

    mdps = [runs[i].task.mdp for i in indices]
    return dict(zip(indices, walk_values(mdps, act, frames=frames), strict=True))


def _values_of_tables(batch: Learner, task: Task, indices: Sequence[int]) -> dict[int, Evaluation]:
    """Values by index, each policy queried once in every state. One that gives no probabilities is left out."""
    actions = batch.greedy_actions(indices)
    if actions is not None:
        return dict(zip(actions, table_values(task.measured, list(actions.values())), strict=True))
    mdp, observer = task.measured, task.observer
    answers = {i: PolicyAnswers(batch.policy(i), mdp, observer) for i in indices}
    tables: dict[int, list[np.ndarray]] = {i: [] for i in indices}
    for first in range(0, mdp.num_states, CURVE_BLOCK):
        states = np.arange(first, min(first + CURVE_BLOCK, mdp.num_states))
        context = observer.space.states(states), np.full(len(states), -1), np.zeros(len(states), np.int64)
        observations = observer.observe(*context)
        for i in list(tables):
            try:
                tables[i].append(answers[i].answer(observations, len(states)))
            except PharosError:  # the error is reported when the run is evaluated alone
                del tables[i]
    if not tables:
        return {}
    return dict(zip(tables, table_values(mdp, [np.concatenate(each) for each in tables.values()]), strict=True))


# Curves ---------------------------------------------------------------------------------------------------------------


GAIN, AVERAGE_REGRET = tuple(_results.AVERAGE_COLUMNS)[:2], tuple(_results.AVERAGE_COLUMNS)[2:]
GAIN_TOLERANCE = 1e-6  # half the width of a gain's interval, at most


@dataclass
class Curve:
    """Learning curve of a run: a row for each evaluation so far, with the regret of the episodes between them.

    Attributes:
        table: the policy of the last row, if it is a table.
        counted_steps: of the environment, if it counts them itself (`pharos.benchmark`).
        policies: facts on the policies, see `policy_facts`. Empty if nobody asked for them.
    """

    task: Task
    rows: list[dict[str, Any]] = field(default_factory=list)
    table: np.ndarray | None = None
    counted_steps: int | None = None
    policies: dict[str, Any] = field(default_factory=dict)
    _evaluation: Evaluation | None = field(default=None, init=False, repr=False)  # of the table

    def add(
        self,
        step: int,
        episodes: int,
        returns: float,
        agent: PolicyLike | Evaluation | None,
        evaluation: Evaluation | None = None,
    ) -> dict[str, Any]:
        """Add the row of the policy after `step` steps and `episodes` finished episodes, whose returns sum to
        `returns`. The policy is evaluated unless its `evaluation` is there.
        """
        if evaluation is None and agent is self.table:
            evaluation = self._evaluation
        if evaluation is None:
            assert agent is not None and not isinstance(agent, Evaluation)
            evaluation = evaluate_agent(agent, self.task, again=True)
        reference = self.task.reference
        last = self.rows[-1] if self.rows else None
        finished = episodes - (last["episodes"] if last else 0)
        gained = returns - (last["returns"] if last else 0.0)
        mean = gained / finished if finished else math.nan
        row = {
            "step": step,
            "episodes": episodes,
            "value": evaluation.value,
            "expected_regret": regret(evaluation.value, reference),
            "cumulative_expected_regret": (
                last["cumulative_expected_regret"] + (finished * last["expected_regret"] if finished else 0.0)
                if last
                else 0.0
            ),
            "normalized_regret": regret(evaluation.value, reference, normalized_by="uniform"),
            "mean_return": mean,
            "realised_regret": regret(mean, reference),
            "cumulative_realised_regret": episodes * reference.optimal - returns,
            "exact": evaluation.exact,
            "error_bound": evaluation.error_bound,
            "returns": returns,
        }
        if evaluation.gain is not None:
            lost = AverageRegret.of(evaluation.gain, self.task.gains["optimal"]).regret
            row |= dict(zip(_results.AVERAGE_COLUMNS, (*evaluation.gain, *lost), strict=True))
        self.rows.append(row)
        self.table = agent if isinstance(agent, np.ndarray) else None
        self._evaluation = evaluation if isinstance(agent, np.ndarray) else None
        return row

    def result(self) -> dict[str, Any]:
        """The summary of a finished run."""
        values, last = self.task.reference, self.rows[-1]
        scale = last["episodes"] * values.spread() or math.nan
        counted = {} if self.counted_steps is None else {"counted_steps": self.counted_steps}
        return {
            "value_optimal": values.optimal,
            "value_uniform": values.uniform,
            "value_worst": values.worst,
            "value_error_bound": values.error_bound,
            "final_value": last["value"],
            "final_regret": last["expected_regret"],
            "cumulative_regret": last["cumulative_expected_regret"],
            "normalized_regret": last["cumulative_expected_regret"] / scale,
            "cumulative_realised_regret": last["cumulative_realised_regret"],
            "normalized_realised_regret": last["cumulative_realised_regret"] / scale,
            "mean_return": last["returns"] / last["episodes"] if last["episodes"] else math.nan,
            "episodes": last["episodes"],
            "exact": all(row["exact"] for row in self.rows),
            "conventions": self.task.conventions,
            **self._average_result(),
            **counted,
        }

    def _average_result(self) -> dict[str, Any]:
        """Average reward and regret a step in the long run, if the run measures them."""
        if self.task.objective != "average":
            return {}
        gains = self.task.gains
        gain, lost = ([self.rows[-1][name] for name in names] for names in (GAIN, AVERAGE_REGRET))
        # Between two evaluations every step counts with the policy of the earlier one
        lengths = np.diff([row["step"] for row in self.rows])
        total = [float(lengths @ [row[name] for row in self.rows[:-1]]) for name in AVERAGE_REGRET]
        steps = self.rows[-1]["step"]
        scale = regret_scale(sum(gains["optimal"]) / 2, sum(gains["uniform"]) / 2, GAIN_TOLERANCE)
        return {
            "gain_at_start": GainInterval(*gain)._asdict(),
            "average_regret": GainInterval(*lost)._asdict(),
            "cumulative_average_regret": GainInterval(*total)._asdict(),
            "normalized_average_regret": sum(total) / 2 / steps / scale if steps else math.nan,
            **{f"{name}_gain_at_start": each._asdict() for name, each in gains.items()},
        }


def policy_facts(task: Task, tables: Sequence[np.ndarray | None], regrets: Sequence[float]) -> dict[str, Any]:
    """Facts on the policies of a run, at its evaluations.

    Args:
        tables: policy of each evaluation, (S, A) probabilities. None if it is no table.
        regrets: normalised, of each as it is played.
    Returns:
        Empty if a policy is no table, else `one_action`: share of states in which the last policy prefers the same
        action; `deterministic`: whether its choice is certain in all of them, terminal ones left out; and if some
        policy is stochastic `greedy_regret`: normalised regret at each evaluation if the preferred action, the first
        among equals, is always played. Uniform play prefers none, and stays as it is.
    Cost: an evaluation of each stochastic table.
    """
    if not tables or any(table is None or table.ndim != 2 for table in tables):
        return {}
    goes_on = ~np.asarray(task.mdp.terminal, bool)
    values: dict[int, float] = {}  # by the identity of the policy
    is_stochastic = False
    for table, own in zip(tables, regrets, strict=True):
        assert table is not None
        if id(table) in values:
            continue
        played, values[id(table)] = table[goes_on], own
        if (played.max(axis=1) < CERTAIN).any() and not (np.ptp(played, axis=1) < TIE).all():
            is_stochastic = True
            value = evaluate_agent(table.argmax(axis=1), task).value
            values[id(table)] = float(regret(value, task.reference, normalized_by="uniform"))
    assert tables[-1] is not None
    last = tables[-1][goes_on]
    preferred = last.argmax(axis=1)[np.ptp(last, axis=1) >= TIE]  # uniform play prefers nothing
    facts = {
        "one_action": float(np.bincount(preferred, minlength=1).max() / len(last)),
        "deterministic": bool((last.max(axis=1) >= CERTAIN).all()),
    }
    return facts | ({"greedy_regret": [values[id(table)] for table in tables]} if is_stochastic else {})


@dataclass(frozen=True, eq=False)
class RegretCurve:
    """The regret of one run, at its N evaluations.

    Attributes:
        steps, episodes: (N,) environment steps and finished episodes before each evaluation.
        policy_values: (N,) value of the policy from the start.
        returns: (N,) sum of the returns of all episodes finished so far.
        values: of the task's reference policies.
    """

    steps: np.ndarray
    episodes: np.ndarray
    policy_values: np.ndarray
    returns: np.ndarray
    values: ReferenceValues

    @staticmethod
    def read(folder: str | os.PathLike) -> "RegretCurve":
        """The curve of a finished run.

        Raises:
            FileFormatError: the folder holds no finished run.
        """
        curve, result = _results.read_curve(folder), _results.read_record(folder)["result"]
        episodes = curve["episodes"].to_numpy(np.int64)
        entries = {name: result.get(f"value_{name}", 0.0) for name in ("optimal", "uniform", "worst", "error_bound")}
        values = ReferenceValues(**{name: math.nan if value is None else value for name, value in entries.items()})
        returns = episodes * values.optimal - curve["cumulative_realised_regret"].to_numpy(np.float64)
        return RegretCurve(curve["step"].to_numpy(np.int64), episodes, curve["value"].to_numpy(float), returns, values)

    @property
    def expected(self) -> np.ndarray:
        """(N,) expected regret of the policy at each evaluation."""
        return regret(self.policy_values, self.values)

    @property
    def cumulative_expected(self) -> np.ndarray:
        """(N,) expected regret summed over episodes, see `cumulative_expected_regret`."""
        return cumulative_expected_regret(self.episodes, self.expected)

    @property
    def cumulative_realised(self) -> np.ndarray:
        """(N,) episodes V*(s0) - sum of returns."""
        return self.episodes * self.values.optimal - self.returns

    def normalized(self, cumulative: np.ndarray, reference: str = "uniform") -> np.ndarray:
        """A cumulative regret of this run divided by what the reference policy loses in as many episodes.

        NaN before the first episode is finished, and if the reference policy is optimal.
        """
        lost = self.episodes * self.values.spread(reference)
        return np.divide(cumulative, lost, out=np.full(len(lost), math.nan), where=lost > 0)
