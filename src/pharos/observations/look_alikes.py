"""Which states look alike: an observation that some states share does not tell the agent the state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pharos.observations.observation import Observation

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

BLOCK = 4096

Progress = Callable[[int, str], None]
"""Called with how many states are done, and a text."""


@dataclass(frozen=True)
class Aliasing:
    """How many of the reachable states share their observation with another state.

    Attributes:
        num_states: reachable states, terminal ones included.
        num_observations: different observations among them.
        num_sharing: states whose observation another state has as well; terminal states count like others.
        num_confused: states in which the agent acts, that is, not terminal, whose observation another such state has as
            well. 0: for one who acts the observation tells the state, so it is Markov.
    """

    num_states: int
    num_observations: int
    num_sharing: int
    num_confused: int

    @property
    def share(self) -> float:
        """The part of the states that share their observation; 0 where the observation tells the state."""
        return self.num_sharing / self.num_states


def aliasing(space: "StateSpace", observation: Observation, *, progress: Progress | None = None) -> Aliasing:
    """Count the states of a state space that an observation does not tell apart.

    Cost: as for `observation_classes`.
    """
    return counted(observation_classes(space, observation, progress=progress), np.asarray(space.terminal))


def observation_classes(
    space: "StateSpace", observation: Observation, *, progress: Progress | None = None
) -> np.ndarray:
    """Number the different observations of a state space.

    Observations count as equal where their digests of 128 bits are: of 10^9 different ones two are taken for one with a
    probability below 10^-20.

    Returns:
        (S,) int64, the number of the observation of each state, from 0.
    Cost: one observation and about 40 bytes for each state; sorting S digests.
    """
    import xxhash

    digests = np.empty(space.num_states, "V16")
    for start in range(0, space.num_states, BLOCK):
        if progress is not None:
            progress(start, observation.name)
        observations = observation(space.states(slice(start, start + BLOCK)))
        rows = np.ascontiguousarray(observations).reshape(len(observations), -1).view(np.uint8)
        digests[start : start + len(rows)] = [xxhash.xxh3_128_digest(row.data) for row in rows]
    halves = digests.view(np.uint64).reshape(-1, 2)
    order = np.lexsort((halves[:, 1], halves[:, 0]))
    is_new = np.zeros(space.num_states, np.int64)
    is_new[1:] = (halves[order[1:]] != halves[order[:-1]]).any(axis=1)
    classes = np.empty(space.num_states, np.int64)
    classes[order] = np.cumsum(is_new)
    return classes


def counted(classes: np.ndarray, terminal: np.ndarray) -> Aliasing:
    """The counts of numbered observations (S,); terminal (S,) bool."""
    counts = np.bincount(classes)
    alive = np.bincount(classes[~terminal])
    return Aliasing(len(classes), len(counts), int(counts[counts > 1].sum()), int(alive[alive > 1].sum()))
