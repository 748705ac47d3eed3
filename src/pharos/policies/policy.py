"""Kinds of policies: a table over the states, or a function of observations that returns probabilities or actions."""

import inspect
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

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


PolicyLike = np.ndarray | TabularAgent | Policy | Model | Callable[[Any], Any]
"""What is taken for a policy: a table (S,), (S, A) or (S, A + 1, A), an agent, a model of Stable-Baselines3, or a
function from a batch of observations to (N, A) probabilities or (N,) actions."""


def policy_function(policy: PolicyLike) -> Callable[[Any], Any]:
    """A policy over observations as a function of a batch of them.

    Raises:
        ParameterError: it is none.
    """
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
        distribution = getattr(model.policy, "get_distribution", None)
        if distribution is not None and "lstm_states" in inspect.signature(distribution).parameters:
            raise ParameterError(
                f"{type(model).__name__}: its policy has a memory, so its values belong to whole histories, which are "
                f"not evaluated; expected a policy of observations: frames=4 among the observation's options shows the "
                f"last four"
            )
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


def _as_policy_sees(observations: Any, space: Any) -> Any:
    """Images moved to channel first where Stable-Baselines3 has done so with those of the environment."""
    if isinstance(observations, dict):
        return {name: _as_policy_sees(values, space.spaces[name]) for name, values in observations.items()}
    if observations.ndim == 4 and observations.shape[1:] != space.shape:
        return observations.transpose(0, 3, 1, 2)
    return observations
