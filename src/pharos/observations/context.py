"""An observation with inputs beyond the state: the previous action, the remaining time."""

import numpy as np

from pharos.environments import NO_ACTION
from pharos.errors import ParameterError
from pharos.observations.observation import Observation, kernels
from pharos.observations.vector import Vector

Seen = np.ndarray | dict[str, np.ndarray]  # one observation or a batch of them; a dict if there are several parts


class ObservationInContext:
    """Input of an agent: an observation of the state, with the previous action and the remaining time if wanted.

    Without either, the observation itself. A `vector` is extended: one entry for each action (1 for the previous one,
    all 0 on the first step), then the remaining time. Any other observation becomes a Dict of "observation",
    "previous_action" (Discrete(A + 1), A on the first step) and "remaining_time" (Box (1,)).
    The remaining time is (limit - elapsed) / limit, in [0, 1]. Frames and coins, which some observations want
    besides, are brought along by who knows them. Without, a state is seen as at the start of an episode, and coins are
    0.

    Attributes:
        observation: the function of the state.
        space: Gymnasium space of what the agent gets.
        names: of the entries of a vector, None for others.
        has_more: whether frames or coins are wanted.
        is_alone: whether neither the previous action nor the remaining time is wanted.
        vector: the observation, if it is one. is_vector: whether it is.
        is_plain: whether nothing at all is: a function of the state.
    Raises:
        ParameterError: the remaining time is wanted although there is no time limit.
    """

    def __init__(self, observation: Observation, *, previous_action: bool, remaining_time: bool, limit: int | None):
        from gymnasium.spaces import Box, Dict, Discrete, Space

        if remaining_time and limit is None:
            raise ParameterError(f"{observation.env}: remaining_time=True without a time limit; set time_limit")
        env = observation.env
        self.observation = observation
        self.names = observation.names
        self.has_more = observation.frames > 1 or observation.irrelevant > 0
        self.is_alone = not previous_action and not remaining_time
        self.is_plain = self.is_alone and not self.has_more
        self.vector = observation if isinstance(observation, Vector) else None
        self.is_vector = self.vector is not None
        self._previous_action = previous_action
        self._remaining_time = remaining_time
        self._limit = limit
        self._num_actions = env.num_actions
        self.space: Space = observation.space
        if self.is_alone:
            return
        if self.is_vector:
            self.names = (
                *(observation.names or ()),
                *(f"previous_action={action}" for action in env.actions if previous_action),
                *(["remaining_time"] if remaining_time else []),
            )
            self.space = Box(0.0, 1.0, (len(self.names),), np.float32)
            return
        parts: dict[str, Space] = {"observation": observation.space}
        if previous_action:
            parts["previous_action"] = Discrete(env.num_actions + 1)
        if remaining_time:
            parts["remaining_time"] = Box(0.0, 1.0, (1,), np.float32)
        self.space = Dict(parts)

    def __call__(
        self,
        states: np.ndarray,
        previous: np.ndarray,
        elapsed: np.ndarray,
        *,
        seen: np.ndarray | None = None,
        coins: np.ndarray | None = None,
    ) -> Seen:
        """States (N, D), previous actions (N,), elapsed steps (N,) -> a batch of observations (a dict of batches).

        Args:
            seen: stacked frames, in place of what the observation is as a function of the states.
            coins: (N, irrelevant), entries that mean nothing.
        """
        if self.is_plain:
            return self.observation(states)
        if self.vector is not None:
            out = np.zeros((len(states), *self.space.shape), np.float32)  # type: ignore[misc]
            kernels().normalize(states, self.vector.low, self.vector.scale, out)
            column = states.shape[1]
            if coins is not None:
                out[:, column : column + coins.shape[1]] = coins
            self._write_context(out, column + self.observation.irrelevant, previous, elapsed)
            return out
        seen = self.observation(states) if seen is None else seen
        if self.is_alone:
            return seen
        batch = {"observation": seen}
        if self._previous_action:
            batch["previous_action"] = np.where(previous == NO_ACTION, self._num_actions, previous).astype(np.int64)
        if self._remaining_time:
            batch["remaining_time"] = self._remaining(elapsed).astype(np.float32)[:, None]
        return batch

    def one(self, state: np.ndarray, previous: int, elapsed: int) -> Seen:
        """The observation of one state (D,)."""
        if self.is_plain:
            return self.observation.one(state)
        batch = self(state[None], np.array([previous]), np.array([elapsed]))
        return {name: values[0] for name, values in batch.items()} if isinstance(batch, dict) else batch[0]

    def _write_context(self, out: np.ndarray, column: int, previous: np.ndarray, elapsed: np.ndarray) -> None:
        if self._previous_action:
            rows = np.flatnonzero(previous != NO_ACTION)
            out[rows, column + previous[rows]] = 1
        if self._remaining_time:
            out[:, -1] = self._remaining(elapsed)

    def _remaining(self, elapsed: np.ndarray) -> np.ndarray:
        assert self._limit is not None
        return np.maximum(self._limit - elapsed, 0) / self._limit
