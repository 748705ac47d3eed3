"""The states of several learners as one dictionary of arrays, as checkpoints keep them: "3/q" is `q` of learner 3."""

from collections.abc import Iterable, Mapping

import numpy as np

State = Mapping[str, np.ndarray]


def joined_states(states: Iterable[State]) -> dict[str, np.ndarray]:
    """One dictionary of all of them, in their order."""
    return {f"{i}/{name}": array for i, state in enumerate(states) for name, array in state.items()}


def state_of(joined: State, i: int) -> dict[str, np.ndarray]:
    """State of learner i."""
    prefix = f"{i}/"
    return {name[len(prefix) :]: array for name, array in joined.items() if name.startswith(prefix)}
