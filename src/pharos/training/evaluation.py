"""The value of what agents have learnt, in the settings of their tasks: of one, or of a batch together."""

from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import PharosError
from pharos.policies import (
    Evaluation,
    PolicyAnswers,
    PolicyLike,
    is_small_table,
    is_walk,
    policy_value,
    table_values,
    walk_values,
)
from pharos.training.task import Task

if TYPE_CHECKING:
    from pharos.training.task_cache import Member

BLOCK = 4096  # observations that policies are asked about at once


def evaluate_agent(
    agent: PolicyLike,
    task: Task,
    *,
    deterministic: bool = False,
    max_states: int = 100_000,
    episodes: int = 2_000,
    seed: int = 0,
    again: bool = False,
) -> Evaluation:
    """Return the value of an agent's current policy on a task.

    Args:
        agent: has `policy_table()` (S,), (S, A) or as `pharos.evaluate_policy` takes it; or
            `action_probabilities(observations)` -> (N, A); or is a model of Stable-Baselines3; or an array like the
            table; or a function of observations that returns (N, A) probabilities or (N,) actions; or one with a
            memory: `initial_state(n)` and `(observations, state, starts)` -> (probabilities or actions, next state),
            the state an array or nested tuples of arrays whose first axis is n. It is asked in histories.
        deterministic: whether the most probable action is taken (the first among equals) instead of one at random.
        max_states: how many states (pairs, where previous actions matter; histories, of a memory) the policy may
            reach for an exact value.
        episodes, seed: of the estimate beyond that.
        again: whether more policies of the task will be evaluated: what they share is remembered. Changes no value.
    Raises:
        ParameterError: the agent is none of these, or its answers are no probabilities.
    Cost: one answer of the policy for each state reached, then horizon x states reached.
    Source: exact policy evaluation, Puterman (1994), section 6.1; reached states: a closed class of an MDP has the same
        values alone; Maurer and Pontil (2009), theorem 4.
    """
    return policy_value(
        agent,
        task.mdp,
        lambda: task.sight,
        lambda: task.return_range,
        deterministic=deterministic,
        max_states=max_states,
        episodes=episodes,
        seed=seed,
        reach=task.reach if again else None,
    )


def values_together(batch: object, members: "Sequence[Member]") -> dict[int, Evaluation]:
    """place in the batch -> value of the run's policy, where that is had for less than one by one; others are left out.

    These are DQN where nothing is random, and runs that share a task of few states and see one frame.
    """
    walks = [i for i, each in enumerate(members) if each.error is None and _walks(each)]
    values = _values_of_walks(batch, members, walks)
    tasks = defaultdict(list)
    for i, member in enumerate(members):
        if member.error is None and i not in values and is_small_table(member.task.mdp) and _frames(member) == 1:
            tasks[id(member.task)].append(i)
    for places in tasks.values():
        if len(places) > 1:
            values |= _values_of_tables(batch, members[places[0]].task, places)
    return values


def _walks(member: "Member") -> bool:
    return member.config.agent == "dqn" and is_walk(member.task.mdp)


def _frames(member: "Member") -> int:
    """How many states the agent sees."""
    return 1 if member.config.is_tabular else member.task.sight.frames


def _values_of_walks(batch: Any, members: "Sequence[Member]", places: Sequence[int]) -> dict[int, Evaluation]:
    """An episode of a thousand steps costs a thousand calls of the networks of all runs, not of each."""
    if not places:
        return {}
    frames = _frames(members[places[0]])
    states = np.zeros((len(members), frames) if frames > 1 else len(members), np.int64)

    def act(now: np.ndarray) -> np.ndarray:
        states[places] = now
        actions: np.ndarray = batch.best_actions(states)
        return actions[places]

    mdps = [members[i].task.mdp for i in places]
    return dict(zip(places, walk_values(mdps, act, frames=frames), strict=True))


def _values_of_tables(batch: Any, task: Task, places: Sequence[int]) -> dict[int, Evaluation]:
    """Each policy is asked once about every state. One that gives no probabilities is left out."""
    actions = batch.greedy_actions(places)
    if actions is not None:
        return dict(zip(actions, table_values(task.mdp, list(actions.values())), strict=True))
    mdp, sight = task.mdp, task.sight
    answers = {i: PolicyAnswers(batch.policy(i), mdp, sight) for i in places}
    tables: dict[int, list[np.ndarray]] = {i: [] for i in places}
    for first in range(0, mdp.num_states, BLOCK):
        states = np.arange(first, min(first + BLOCK, mdp.num_states))
        context = sight.space.states(states), np.full(len(states), -1), np.zeros(len(states), np.int64)
        observations = sight.observe(*context)
        for i in list(tables):
            try:
                tables[i].append(answers[i].answer(observations, len(states)))
            except PharosError:  # which it will be told when it is evaluated alone
                del tables[i]
    if not tables:
        return {}
    return dict(zip(tables, table_values(mdp, [np.concatenate(each) for each in tables.values()]), strict=True))
