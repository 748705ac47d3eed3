"""Models of Stable-Baselines3 and sb3-contrib as policies: networks, with what stands between them and the world.

A VecNormalize is applied, masks are handed over, and the observation that a model was trained on is compared with the
one that it gets. What cannot be applied is refused.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeGuard, runtime_checkable

import numpy as np

from pharos.errors import ParameterError

if TYPE_CHECKING:
    from gymnasium import Space
    from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
    from stable_baselines3.common.distributions import CategoricalDistribution
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.vec_env import VecNormalize

Observations: TypeAlias = np.ndarray | dict[str, np.ndarray]
"""A batch, as the environment gives them."""


@runtime_checkable
class SB3Model(Protocol):
    """An algorithm of Stable-Baselines3."""

    @property
    def policy(self) -> "BasePolicy":
        """Its networks."""

    def predict(self, observation: Observations, *, deterministic: bool = False) -> tuple[np.ndarray, object]:
        """(actions, state of a recurrent policy) for a batch of observations."""


class RecurrentModel(Protocol):
    """An algorithm of sb3-contrib whose policy has an LSTM."""

    @property
    def policy(self) -> "RecurrentActorCriticPolicy":
        """Its networks."""


class DeepPolicy:
    """The policy of a model as probabilities: greedy for DQN and its kin, the distribution itself for PPO and its kin.

    The probabilities are those that the network computes, in 32-bit floats on this processor: an exact value is the
    value of these.

    Args:
        deterministic: the most probable action of a distribution, instead of the distribution.
        masked: whether the model was trained under action masks (MaskablePPO), which come with the observations then.
        imposed: whether masks may be the masks of the batched engine, of whose networks the model itself knows nothing.
    Raises:
        ParameterError: the policy has a memory, so that its probabilities do not belong to observations. Or it needs
            masks and there are none, or takes none, or the VecNormalize that it was trained behind is missing.
    """

    def __init__(self, model: SB3Model, *, deterministic: bool = False, masked: bool = False, imposed: bool = False):
        if _has_memory(model):
            raise memory_error(model)
        if masked != takes_masks(model) and not (masked and imposed):
            raise no_masks_error(model) if masked else _needs_masks(model)
        check_normalizer(model)
        self.model, self.deterministic, self.masked = model, deterministic, masked
        self._takes_masks = takes_masks(model)

    def action_probabilities(self, observations: Observations, masks: np.ndarray | None = None) -> np.ndarray:
        """(N, A) probabilities for a batch of observations as the environment gives them.

        Args:
            masks: (N, A) bool, the actions that may be chosen, of a model that was trained under masks.
        """
        import torch

        policy = self.model.policy
        policy.set_training_mode(False)
        batch = _as_policy_sees(_as_normalizer_gives(self.model, observations), policy.observation_space)
        with torch.no_grad():
            tensor, _ = policy.obs_to_tensor(batch)
            q_net: Callable[..., torch.Tensor] | None = getattr(policy, "q_net", None)
            if q_net is not None:
                scores = q_net(tensor).numpy()
                scores = scores if masks is None else np.where(masks, scores, -np.inf)
                return np.eye(scores.shape[1])[scores.argmax(axis=1)]
            distribution_of: Callable[..., CategoricalDistribution] | None = getattr(policy, "get_distribution", None)
            if distribution_of is not None:
                options = {"action_masks": masks} if masks is not None and self._takes_masks else {}
                distribution = distribution_of(tensor, **options).distribution
                probabilities = distribution.probs.numpy().astype(np.float64)
                if masks is not None and not self._takes_masks:  # by the logits, as its masks are in the batched engine
                    probabilities = restricted(distribution.logits.numpy().astype(np.float64), masks)
                if self.deterministic:
                    return np.eye(probabilities.shape[1])[probabilities.argmax(axis=1)]
                return probabilities
        actions, _ = self.model.predict(batch, deterministic=True)
        return np.asarray(actions)


def restricted(logits: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """(N, A) the softmax of logits over the actions of masks (N, A) bool."""
    logits = np.where(masks, logits, -np.inf)
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


class RecurrentDeepPolicy:
    """The policy of a model with an LSTM, of sb3-contrib: a `RecurrentPolicy`, the distribution itself.

    Its state is the actor's: hidden and cell states, (n, layers, size) float32 each.
    """

    def __init__(self, model: RecurrentModel):
        check_normalizer(model)
        self.model = model

    def initial_state(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Hidden and cell states of n episodes that begin: zeros."""
        layers, _, size = self.model.policy.lstm_hidden_state_shape
        return np.zeros((n, layers, size), np.float32), np.zeros((n, layers, size), np.float32)

    def __call__(
        self, observations: Observations, state: tuple[np.ndarray, np.ndarray], starts: np.ndarray
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """((N, A) probabilities, the next state) for a batch of observations as the environment gives them."""
        import torch

        policy = self.model.policy
        policy.set_training_mode(False)
        with torch.no_grad():
            batch = _as_policy_sees(_as_normalizer_gives(self.model, observations), policy.observation_space)
            tensor, _ = policy.obs_to_tensor(batch)
            hidden, cell = (torch.from_numpy(part.swapaxes(0, 1).copy()) for part in state)
            begins = torch.from_numpy(starts.astype(np.float32))
            distribution_of: Callable[..., tuple] = policy.get_distribution
            distribution, (hidden, cell) = distribution_of(tensor, (hidden, cell), begins)
        after = hidden.numpy().swapaxes(0, 1), cell.numpy().swapaxes(0, 1)
        return distribution.distribution.probs.numpy().astype(np.float64), after


def deep_policy(model: SB3Model, *, masked: bool = False, imposed: bool = False) -> "DeepPolicy | RecurrentDeepPolicy":
    """The policy of a model of Stable-Baselines3 or sb3-contrib, with a memory or without.

    Args:
        masked, imposed: as for `DeepPolicy`.
    """
    if _has_memory(model) and not masked:
        return RecurrentDeepPolicy(model)
    return DeepPolicy(model, masked=masked, imposed=imposed)


def _has_memory(model: SB3Model) -> TypeGuard["RecurrentModel"]:
    return _distribution_takes(model, "lstm_states")


def takes_masks(model: SB3Model) -> bool:
    """Whether a model was trained under action masks, as MaskablePPO of sb3-contrib."""
    return _distribution_takes(model, "action_masks")


def _distribution_takes(model: SB3Model, name: str) -> bool:
    distribution = getattr(model.policy, "get_distribution", None)
    return distribution is not None and name in inspect.signature(distribution).parameters


def _needs_masks(model: object) -> ParameterError:
    return ParameterError(
        f"{type(model).__name__}: was trained under action masks, without which it is another policy; give masks=, "
        f"(S, A) bool or a function of states, to pharos.evaluate_policy or training.evaluate_agent"
    )


def no_masks_error(policy: object) -> ParameterError:
    """Error of a policy that is given masks and takes none."""
    return ParameterError(
        f"{type(policy).__name__}: takes no action masks; leave masks= out, or give a model that was trained under "
        f"masks, such as MaskablePPO"
    )


# Stable-Baselines3's VecNormalize, which stands between environment and network and is no part of the model's file


def check_normalizer(model: object) -> None:
    """ParameterError if a model was trained behind a VecNormalize that is not with it, or that cannot be applied."""
    normalizer = _normalizer(model)
    name = type(model).__name__
    if normalizer is None:
        # algorithms with a replay buffer keep the last observation whatever they were trained behind
        if getattr(model, "_last_original_obs", None) is None or hasattr(model, "replay_buffer"):
            return
        raise ParameterError(
            f"{name}: was trained behind a VecNormalize, which is not with it; load it with "
            f"env=VecNormalize.load(FILE, venv) of the file that was saved beside it"
        )
    if not normalizer.norm_obs:
        return
    own, expected = (getattr(each, "observation_space", None) for each in (normalizer, model))
    between = space_difference(expected, own, is_dtype_compared=False)
    if between is not None:
        raise ParameterError(
            f"{name}: something changes observations between its VecNormalize and its network ({between}), so they "
            f"cannot be normalised; train it with VecNormalize as the last wrapper"
        )


def _normalizer(model: object) -> "VecNormalize | None":
    of: Callable[[], VecNormalize | None] | None = getattr(model, "get_vec_normalize_env", None)
    return None if of is None else of()


def _as_normalizer_gives(model: object, observations: Observations) -> Observations:
    """Observations as the VecNormalize of a model gives them, whose statistics stay as they are."""
    normalizer = _normalizer(model)
    if normalizer is None or not normalizer.norm_obs:
        return observations
    return normalizer.normalize_obs(_as_policy_sees(observations, normalizer.observation_space))


def memory_error(policy: object) -> ParameterError:
    """Error of a policy whose values belong to no state."""
    return ParameterError(
        f"{type(policy).__name__}: its policy has a memory, so its values belong to no state; use "
        f"training.evaluate_agent, which goes through histories, or frames=4 among the observation's options in place "
        f"of the memory"
    )


def _as_policy_sees(observations: Observations, space: "Space") -> Observations:
    """Images moved to channel first if Stable-Baselines3 has done so with the environment's."""
    if isinstance(observations, dict):
        from gymnasium.spaces import Dict

        assert isinstance(space, Dict)
        return {name: _channel_first(values, space[name]) for name, values in observations.items()}
    return _channel_first(observations, space)


def _channel_first(observations: np.ndarray, space: "Space") -> np.ndarray:
    if observations.ndim == 4 and observations.shape[1:] != space.shape:
        return observations.transpose(0, 3, 1, 2)
    return observations


def check_observation(policy: object, space: "Space", name: object) -> None:
    """ParameterError if a model was trained on observations of another kind or size, or with other numbers."""
    model, name = getattr(policy, "model", policy), getattr(name, "name", name)
    normalizer = _normalizer(model)
    own = model if normalizer is None or not normalizer.norm_obs else normalizer.venv
    expected = getattr(own, "observation_space", None)
    difference = None if expected is None else space_difference(expected, space)
    if difference is not None:
        remedy = "; 'number' is the numbering of Gymnasium" if hasattr(expected, "n") and name != "number" else ""
        raise ParameterError(
            f"the model was trained on observations of {difference.replace(' beside ', f'; {name!r} gives ')}: name "
            f"the observation it was trained on{remedy}"
        )
    is_number = type(expected).__name__ == "Discrete"
    source = _numbering_of(model) if is_number else None
    if is_number and ((name == "index" != source) or (name == "number" and source == "index")):
        raise ParameterError(
            f"the model was trained on numbers of states, {source or 'of an environment that is not with it'}; "
            f"{name!r} numbers them as {NUMBERINGS[name]}: name the numbering it was trained on, 'index' or 'number', "
            f"or load it with env= the environment it was trained on"
        )


NUMBERINGS = {"index": "the search found them", "number": "the source does"}


def _numbering_of(model: object) -> str | None:
    """Numbering that a model was trained on, by the environment that is attached to it.

    An observation of pharos, or "those of CLASS" for other environments. None if there is no environment.
    """
    env: Any = getattr(model, "env", None)
    while hasattr(env, "venv"):
        env = env.venv
    env = env.envs[0] if getattr(env, "envs", None) else getattr(env, "env", env)
    env = getattr(env, "unwrapped", env)
    simulator = getattr(env, "simulator", None)
    if simulator is not None:
        return str(simulator.context.observation.name)
    return None if env is None or type(env).__name__ == "SubprocVecEnv" else f"those of {type(env).__name__}"


def space_difference(expected: object, actual: object, *, is_dtype_compared: bool = True) -> str | None:
    """Difference of two spaces in kind or size, "shape (3,) beside (4,)", or None if a network sees the same.

    Images may have their channels first in `expected`. Bounds are not compared.
    """
    kinds = type(expected).__name__, type(actual).__name__
    if kinds[0] != kinds[1]:
        return f"{expected} beside {actual}".replace("\n", " ")
    if isinstance(actual, Mapping) and isinstance(expected, Mapping):
        if set(expected) != set(actual):
            return f"parts {', '.join(expected)} beside {', '.join(actual)}"
        parts = (space_difference(expected[name], actual[name], is_dtype_compared=is_dtype_compared) for name in actual)
        return next((part for part in parts if part is not None), None)
    if kinds[0] != "Box":
        sizes = [[getattr(each, name, None) for name in ("n", "start", "nvec")] for each in (expected, actual)]
        same = all(np.array_equal(one, other) for one, other in zip(*sizes, strict=True))
        return None if same else f"{expected} beside {actual}"
    shapes = [tuple(getattr(each, "shape", ())) for each in (expected, actual)]
    if shapes[0] not in (shapes[1], shapes[1][2:] + shapes[1][:2]):
        return f"shape {shapes[0]} beside {shapes[1]}"
    dtypes = [np.dtype(getattr(each, "dtype", np.float32)) for each in (expected, actual)]
    is_image = is_dtype_compared and len(shapes[1]) == 3
    if is_image and (dtypes[0] == np.uint8) != (dtypes[1] == np.uint8):  # integers are divided by 255 first
        return f"type {dtypes[0]} beside {dtypes[1]}"
    return None
