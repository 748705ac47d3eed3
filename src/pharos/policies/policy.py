"""Kinds of policies: a table over the states, or a function of observations that returns probabilities or actions."""

import inspect
from collections.abc import Callable
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from pharos.errors import ParameterError


@runtime_checkable
class Policy(Protocol):
    """Chooses actions from observations."""

    def action_probabilities(self, observations: Any) -> np.ndarray:
        """(N, A) probabilities, or (N,) actions, for a batch of N observations as the environment gives them."""


@runtime_checkable
class TabularAgent(Protocol):
    """Chooses actions from the index of the state."""

    def policy_table(self) -> np.ndarray:
        """(S,) actions, (S, A) probabilities, or (S, A + 1, A) where previous actions are seen."""


@runtime_checkable
class Model(Protocol):
    """An algorithm of Stable-Baselines3."""

    policy: Any

    def predict(self, observation: Any, *, deterministic: bool = False) -> Any:
        """(actions, state of a recurrent policy) for a batch of observations."""


Arrays: TypeAlias = Any
"""An array, or tuples of arrays, nested at will."""


@runtime_checkable
class RecurrentPolicy(Protocol):
    """Chooses actions from observations and from what it has kept of those before.

    The first axis of the arrays of a state has one entry for each of n episodes. What comes back must depend on nothing
    else than what is given.
    """

    def initial_state(self, n: int) -> Arrays:
        """The state of n episodes that begin."""

    def __call__(self, observations: Arrays, state: Arrays, starts: np.ndarray) -> tuple[np.ndarray, Arrays]:
        """((N, A) probabilities or (N,) actions, the next state); starts: (N,) bool, where an episode begins."""


PolicyLike = np.ndarray | TabularAgent | Policy | RecurrentPolicy | Model | Callable[[Any], Any]
"""What is taken for a policy: a table (S,), (S, A) or (S, A + 1, A), an agent, a model of Stable-Baselines3, a function
from a batch of observations to (N, A) probabilities or (N,) actions, or one that keeps a state besides."""


def policy_function(policy: PolicyLike) -> Callable[[Any], Any]:
    """A policy over observations as a function of a batch of them.

    Raises:
        ParameterError: it is none, or has a memory.
    """
    if isinstance(policy, RecurrentPolicy) and not isinstance(policy, Policy | Model):
        raise _remembers(policy)
    if isinstance(policy, Policy):
        return policy.action_probabilities
    if isinstance(policy, Model):
        return DeepPolicy(policy).action_probabilities
    if callable(policy):
        return policy
    raise ParameterError(
        f"agent is {policy!r}; expected a policy table, a model of Stable-Baselines3, or a function of observations"
    )


class DeepPolicy:
    """The policy of a model as probabilities: greedy for DQN and its kin, the distribution itself for PPO and its kin.

    The probabilities are those that the network computes, in 32-bit floats on this processor: an exact value is the
    value of these.

    Args:
        deterministic: the most probable action of a distribution, instead of the distribution.
    Raises:
        ParameterError: the policy has a memory, so that its probabilities do not belong to observations.
    """

    def __init__(self, model: Any, *, deterministic: bool = False):
        if _has_memory(model):
            raise _remembers(model)
        self.model, self.deterministic = model, deterministic

    def action_probabilities(self, observations: Any) -> np.ndarray:
        """(N, A) probabilities for a batch of observations as the environment gives them."""
        import torch

        policy = self.model.policy
        policy.set_training_mode(False)
        batch = _as_policy_sees(observations, policy.observation_space)
        with torch.no_grad():
            tensor, _ = policy.obs_to_tensor(batch)
            if hasattr(policy, "q_net"):
                scores = policy.q_net(tensor).numpy()
                return np.eye(scores.shape[1])[scores.argmax(axis=1)]
            if hasattr(policy, "get_distribution"):
                probabilities = policy.get_distribution(tensor).distribution.probs.numpy().astype(np.float64)
                if self.deterministic:
                    return np.eye(probabilities.shape[1])[probabilities.argmax(axis=1)]
                return probabilities
        actions, _ = self.model.predict(batch, deterministic=True)
        return np.asarray(actions)


class RecurrentDeepPolicy:
    """The policy of a model with an LSTM, of sb3-contrib: a `RecurrentPolicy`, the distribution itself.

    Its state is that of the actor: hidden and cell states, (n, layers, size) float32 each.
    """

    def __init__(self, model: Any):
        self.model = model

    def initial_state(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Zeros."""
        layers, _, size = self.model.policy.lstm_hidden_state_shape
        return np.zeros((n, layers, size), np.float32), np.zeros((n, layers, size), np.float32)

    def __call__(
        self, observations: Any, state: tuple[np.ndarray, np.ndarray], starts: np.ndarray
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """((N, A) probabilities, the next state) for a batch of observations as the environment gives them."""
        import torch

        policy = self.model.policy
        policy.set_training_mode(False)
        with torch.no_grad():
            tensor, _ = policy.obs_to_tensor(_as_policy_sees(observations, policy.observation_space))
            hidden, cell = (torch.from_numpy(part.swapaxes(0, 1).copy()) for part in state)
            begins = torch.from_numpy(starts.astype(np.float32))
            distribution, (hidden, cell) = policy.get_distribution(tensor, (hidden, cell), begins)
        after = hidden.numpy().swapaxes(0, 1), cell.numpy().swapaxes(0, 1)
        return distribution.distribution.probs.numpy().astype(np.float64), after


def deep_policy(model: Model) -> "DeepPolicy | RecurrentDeepPolicy":
    """The policy of a model of Stable-Baselines3 or sb3-contrib, with a memory or without."""
    return RecurrentDeepPolicy(model) if _has_memory(model) else DeepPolicy(model)


def _has_memory(model: Any) -> bool:
    distribution = getattr(model.policy, "get_distribution", None)
    return distribution is not None and "lstm_states" in inspect.signature(distribution).parameters


def _remembers(policy: object) -> ParameterError:
    return ParameterError(
        f"{type(policy).__name__}: its policy has a memory, so its values belong to no state; use "
        f"training.evaluate_agent, which goes through histories, or frames=4 among the observation's options in place "
        f"of the memory"
    )


def _as_policy_sees(observations: Any, space: Any) -> Any:
    """Images moved to channel first where Stable-Baselines3 has done so with those of the environment."""
    if isinstance(observations, dict):
        return {name: _as_policy_sees(values, space.spaces[name]) for name, values in observations.items()}
    if observations.ndim == 4 and observations.shape[1:] != space.shape:
        return observations.transpose(0, 3, 1, 2)
    return observations
