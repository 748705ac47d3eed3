"""The policies of a batch, evaluated together where that is possible."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from pharos.errors import PharosError
from pharos.policies import Evaluation, PolicyAnswers, is_small_table, is_walk, table_values, walk_values, whole_values
from pharos.training.task import Task
from pharos.training.task_cache import Member

BLOCK = 4096  # observations that policies are asked about at once


def values_together(batch: Any, members: Sequence[Member]) -> dict[int, Evaluation]:
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


def _walks(member: Member) -> bool:
    return member.config.agent == "dqn" and is_walk(member.task.mdp)


def _frames(member: Member) -> int:
    """How many states the agent sees."""
    return 1 if member.config.is_tabular else member.task.sight.frames


def _values_of_walks(batch: Any, members: Sequence[Member], places: Sequence[int]) -> dict[int, Evaluation]:
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
        return dict(zip(actions, whole_values(task.mdp, list(actions.values())), strict=True))
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
