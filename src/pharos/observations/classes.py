"""Numbers of the different observations of a state space: which states, or histories, an agent cannot tell apart."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from pharos.errors import ParameterError
from pharos.hardness import Aliasing, aliasing_of_classes
from pharos.observations.observation import Observation

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

CLASS_BLOCK = 4096
MOST_HISTORIES = 1_000_000

AliasingCallback = Callable[[int, str], None]
"""Called with how many states are done, and a text."""


def aliasing(space: "StateSpace", observation: Observation, *, progress: AliasingCallback | None = None) -> Aliasing:
    """Count the states of a state space that an observation does not tell apart.

    Of an observation of k frames the states that some histories do not tell apart, see `history_aliasing`.

    Cost: as for `observation_classes`.
    """
    if observation.frames > 1:
        return history_aliasing(space, observation, progress=progress)
    return aliasing_of_classes(observation_classes(space, observation, progress=progress), np.asarray(space.terminal))


def observation_classes(
    space: "StateSpace", observation: Observation, *, progress: AliasingCallback | None = None
) -> np.ndarray:
    """Number the different observations of a state space.

    Observations count as equal if their digests of 128 bits are: of 10^9 different ones two are taken for one with a
    probability below 10^-20.

    Returns:
        (S,) int64, the number of the observation of each state, from 0.
    Raises:
        ParameterError: the observation has several frames, so it is no function of the state.
    Cost: one observation and about 40 bytes for each state, and sorting S digests.
    """
    if observation.frames > 1:
        raise ParameterError(
            f"{observation.name} with {observation.frames} frames is no function of the state; "
            f"history_aliasing counts what it tells"
        )

    def observations_of(block: slice) -> np.ndarray:
        return observation(space.states(block))

    return _class_numbers(observations_of, space.num_states, observation.name, progress)


def history_aliasing(
    space: "StateSpace",
    observation: Observation,
    *,
    most: int = MOST_HISTORIES,
    progress: AliasingCallback | None = None,
) -> Aliasing:
    """Count the states that an observation of k frames does not tell apart, over all histories that play can have.

    A history is what the last k states of an episode can be. At its start the first state stands k times. A state
    shares an observation if some history that ends in it gives the same frames as one that ends in another state.
    `num_observations` are the different stacks of frames.

    Raises:
        ParameterError: there are more than `most` histories.
    Cost: k frames for each history, of which there are up to S (A K)^(k - 1).
    """
    histories = _histories(space, observation.frames, most)

    def observations_of(block: slice) -> np.ndarray:
        part = histories[block]
        states = space.states(part.ravel())
        return observation.of_histories(states.reshape(*part.shape, -1))

    classes = _class_numbers(observations_of, len(histories), observation.name, progress)
    ends, terminal = histories[:, -1], np.asarray(space.terminal)

    def sharing(among: np.ndarray) -> int:
        pairs = np.unique(np.stack([classes[among], ends[among]], axis=1), axis=0)
        several = np.bincount(pairs[:, 0], minlength=1) > 1
        return len(np.unique(pairs[several[pairs[:, 0]], 1]))

    everything = np.ones(len(ends), np.bool_)
    return Aliasing(space.num_states, int(classes.max()) + 1, sharing(everything), sharing(~terminal[ends]))


def _histories(space: "StateSpace", length: int, max_histories: int) -> np.ndarray:
    """(H, length) int64, all histories that play can have."""
    starts = np.unique(np.repeat(space.start_states[:, None], length, axis=1), axis=0).astype(np.int64)
    visited, frontier, terminal = set(map(tuple, starts.tolist())), starts, np.asarray(space.terminal)
    while len(frontier):
        going = frontier[~terminal[frontier[:, -1]]]
        rows = np.repeat(np.arange(len(going)), space.num_actions)
        actions = np.tile(np.arange(space.num_actions), len(going))
        outcomes = space.dynamics.outcomes(going[rows, -1], actions)
        inside = outcomes.states < space.num_states
        before = going[rows[outcomes.which[inside]], 1:]
        after = np.unique(np.concatenate([before, outcomes.states[inside][:, None]], axis=1), axis=0)
        frontier = np.array([each for each in after.tolist() if tuple(each) not in visited], np.int64).reshape(
            -1, length
        )
        visited.update(map(tuple, frontier.tolist()))
        if len(visited) > max_histories:
            raise ParameterError(
                f"{space} has more than {max_histories:,} histories of {length} states; expected fewer, so that they "
                f"can be counted: look at a smaller instance, or at fewer frames"
            )
    return np.array(sorted(visited), np.int64)


def _class_numbers(
    observations_of: Callable[[slice], np.ndarray], count: int, name: str, progress: AliasingCallback | None
) -> np.ndarray:
    """(count,) int64, the numbers of different observations, which `observations_of` gives for blocks of rows."""
    import xxhash

    digests = np.empty(count, "V16")
    for start in range(0, count, CLASS_BLOCK):
        if progress is not None:
            progress(start, name)
        observations = observations_of(slice(start, min(start + CLASS_BLOCK, count)))
        rows = np.ascontiguousarray(observations).reshape(len(observations), -1).view(np.uint8)
        digests[start : start + len(rows)] = [xxhash.xxh3_128_digest(row.data) for row in rows]
    halves = digests.view(np.uint64).reshape(-1, 2)
    order = np.lexsort((halves[:, 1], halves[:, 0]))
    is_new = np.zeros(count, np.int64)
    is_new[1:] = (halves[order[1:]] != halves[order[:-1]]).any(axis=1)
    classes = np.empty(count, np.int64)
    classes[order] = np.cumsum(is_new)
    return classes
