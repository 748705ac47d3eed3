"""The policies of a batch, evaluated together where that is possible."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pharos.experiments.members import Member
from pharos.policies import Evaluation, is_walk, walk_values


def values_together(batch: Any, members: Sequence[Member]) -> dict[int, Evaluation]:
    """place in the batch -> value of the run's policy, for DQN where nothing is random; the others are left out.

    An episode of a thousand steps costs a thousand calls of the networks of all runs, not of each.
    """
    places = [
        i
        for i, member in enumerate(members)
        if member.config.agent == "dqn" and member.error is None and is_walk(member.task.mdp)
    ]
    if not places:
        return {}
    states = np.zeros(len(members), np.int64)

    def act(now: np.ndarray) -> np.ndarray:
        states[places] = now
        actions: np.ndarray = batch.best_actions(states)
        return actions[places]

    return dict(zip(places, walk_values([members[i].task.mdp for i in places], act), strict=True))
