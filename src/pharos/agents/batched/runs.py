"""Specification of one run: MDP, observations, hyperparameters, and which runs can share a batch."""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from pharos.agents.agent import RunShape, SizedRun
from pharos.errors import ParameterError
from pharos.mdp import ChanceSetting, TabularMDP

if TYPE_CHECKING:
    from pharos.observations import ObservationInContext
    from pharos.state_space import StateSpace

WIDTH_OF_VECTORS, WIDTH_OF_IMAGES = 32, 8  # most runs of a lane, or of a batch of small images
WIDTH_OF_SMALL_IMAGES, WIDTH_OF_WIDE_IMAGES = 4, 2  # most runs of a lane of these
WIDE_IMAGE = 100  # pixels of a small image whose networks do not fit the second-level cache
NARROWEST = 4
WIDTH_ELSEWHERE = 256  # on other devices than the processor

# What Stable-Baselines3 takes if nothing is given. The first part may differ among the runs of a batch.
OF_A_RUN: dict[str, dict[str, Any]] = {
    "dqn": {
        "learning_rate": 1e-4,
        "learning_starts": 100,
        "tau": 1.0,
        "gamma": 0.99,
        "target_update_interval": 10_000,
        "exploration_fraction": 0.1,
        "exploration_initial_eps": 1.0,
        "exploration_final_eps": 0.05,
        "max_grad_norm": 10.0,
    },
    "ppo": {
        "learning_rate": 3e-4,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "clip_range": 0.2,
        "ent_coef": 0.0,
        "vf_coef": 0.5,
        "max_grad_norm": 0.5,
    },
}
OF_A_BATCH: dict[str, dict[str, Any]] = {
    "dqn": {
        "n_envs": 1,
        "buffer_size": 1_000_000,
        "batch_size": 32,
        "train_freq": 4,
        "gradient_steps": 1,
        "n_steps": 1,
        "net_arch": [128],
        "double": False,
    },
    "ppo": {
        "n_envs": 1,
        "n_steps": 2048,
        "batch_size": 64,
        "n_epochs": 10,
        "normalize_advantage": True,
        "target_kl": None,
        "net_arch": [128],
    },
}
OWN_OPTIONS = ("double",)
"""Hyperparameters that Stable-Baselines3 does not have."""
# Names that change nothing here, or that may have this one value only.
WITHOUT_EFFECT = ("n_timesteps", "verbose", "stats_window_size")
ONLY: dict[str, Any] = {
    "policy": "MlpPolicy",
    "optimize_memory_usage": False,
    "replay_buffer_class": None,
    "replay_buffer_kwargs": None,
    "rollout_buffer_class": None,
    "rollout_buffer_kwargs": None,
    "use_sde": False,
    "sde_sample_freq": -1,
    "clip_range_vf": None,
}
NATURE_PIXELS = 36  # pixels from which the three convolutions of Mnih et al. (2015) take the place of one, as in sb3.py
MOST_REMEMBERED = 1 << 14  # states whose target values are kept
OBSERVED_AT_ONCE = 4096  # states that are observed at once


class ObservationSource:
    """Observations of the states of a space, by state number.

    Attributes:
        frames: k, how many states an observation shows, the last ones of the episode.
        shape, dtype: of one observation.
        is_image: whether Stable-Baselines3 takes it for an image: (C, H, W) or (H, W, C) uint8 from 0 to 255.
        num_states: S.
    Raises:
        ParameterError: the observation is more than a function of the last k states.
    """

    def __init__(self, space: "StateSpace", observe: "ObservationInContext"):
        if not observe.is_alone or observe.observation.irrelevant:
            raise ParameterError(
                "the batched engine sees functions of the last states; expected neither previous_action nor "
                "remaining_time or irrelevant entries; the engine sb3 has them"
            )
        self.space, self.num_states = space, space.num_states
        self.observe = cast(Any, observe.observation)
        self.frames: int = self.observe.frames
        box = observe.space
        self.shape, self.dtype = tuple(box.shape or ()), np.dtype(box.dtype)  # type: ignore[arg-type]
        if not self.shape:
            raise ParameterError(
                "the batched engine has no network for the number of the state; the engine sb3 has one"
            )
        self.is_image = False
        if len(self.shape) == 3 and self.dtype == np.uint8:
            low, high = np.asarray(getattr(box, "low", 1)), np.asarray(getattr(box, "high", 1))
            self.is_image = bool((low == 0).all() and (high == 255).all())
        if self.frames > 1 and self.observe.channel_axis != (2 if as_networks_see(self.shape, True)[1] else 0):
            raise ParameterError(
                f"the batched engine: {self.frames} frames have as many channels as rows, {self.shape}, and networks "
                f"would take the rows for channels; expected fewer frames, or a larger size; the engine sb3 has it"
            )

    @staticmethod
    def of(space: "StateSpace", observe: "ObservationInContext") -> "ObservationSource":
        """The observations of a state space."""
        return ObservationSource(space, observe)

    def at(self, indices: np.ndarray) -> np.ndarray:
        """(N, ...): the observations of states (N,), or of histories (N, k), the oldest first, if k frames are seen."""
        states = self.space.states(indices.ravel())
        if self.frames == 1:
            return np.asarray(self.observe(states))
        return np.asarray(self.observe.of_histories(states.reshape(*indices.shape, -1)))

    def frame(self, indices: np.ndarray) -> np.ndarray:
        """(N, ...): one frame of each of the states (N,)."""
        return np.asarray(self.observe.frame(self.space.states(indices)))


@dataclass(frozen=True, eq=False)
class BatchRun:
    """Specification of one run.

    Attributes:
        mdp: with its chance, apart from lazy actions. Runs of one task share the same.
        observe: what the agent sees of the states. Runs of one task share the same.
        time_limit: steps of an episode.
        hyperparameters: under the names of Stable-Baselines3.
        steps: of the whole training, for the schedules.
        seed: for the record.
        key: 64 bits that name the run. All its random numbers follow from them.
        gamma: of the returns that are counted, not the agent's own discount.
        outcome_rewards: (N,) what each possible outcome pays, as `rewards_of_outcomes` gives it. None: expected rewards
            are paid.
        chance: of it laziness, and noise and delay in what is paid. The rest is in `mdp`. Returns are of what is
            earned.
        staying: (S, A) what an action without effect pays. Needed if actions are lazy.
    """

    mdp: TabularMDP
    observe: ObservationSource
    time_limit: int
    hyperparameters: Mapping[str, Any]
    steps: int
    seed: int
    key: int
    gamma: float = 1.0
    outcome_rewards: np.ndarray | None = None
    chance: ChanceSetting = ChanceSetting()
    staying: np.ndarray | None = None

    @property
    def shape(self) -> RunShape:
        """Its sizes."""
        look = self.observe
        sizes = self.mdp.num_actions, self.mdp.num_states
        return RunShape(tuple(look.shape), str(look.dtype), look.is_image, look.frames, *sizes)


def supports(agent: str, hyperparameters: Mapping[str, Any]) -> str | None:
    """None if the engine has the agent and its hyperparameters, else the first that it lacks, and why."""
    if agent not in OF_A_RUN:
        return f"agent {agent!r}: the batched engine has {' and '.join(OF_A_RUN)}"
    for name, value in hyperparameters.items():
        if name == "policy_kwargs":
            if value is not None and not isinstance(value, Mapping):
                return f"policy_kwargs: {value!r}; expected a mapping"
            others = sorted(set(value or {}) - {"net_arch"})
            if others:
                return f"policy_kwargs: {others[0]}"
        elif name in ONLY:
            if value != ONLY[name]:
                return f"{name}: {value!r}; the batched engine has {ONLY[name]!r} alone"
        elif name not in OF_A_RUN[agent] and name not in OF_A_BATCH[agent] and name not in WITHOUT_EFFECT:
            return f"{name}: the batched engine does not have it"
        elif name == "train_freq" and not _is_in_steps(value):
            return f"train_freq: {value!r}; the batched engine counts steps"
        elif name in OF_A_RUN[agent] and (isinstance(value, bool) or not isinstance(value, int | float)):
            return f"{name}: {value!r}; the batched engine takes a number"
    if agent == "dqn" and isinstance(_net_arch(hyperparameters), Mapping):
        return "net_arch: a list of sizes for DQN"
    return None


def resolved(agent: str, hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """All hyperparameters of an agent. ParameterError if the engine lacks one."""
    lacking = supports(agent, hyperparameters)
    if lacking is not None:
        raise ParameterError(f"{lacking}; the engine sb3 has it")
    defaults = {**OF_A_RUN[agent], **OF_A_BATCH[agent]}
    result = {**defaults, **{name: value for name, value in hyperparameters.items() if name in defaults}}
    result["net_arch"] = _net_arch(hyperparameters)
    if agent == "dqn" and not isinstance(result["train_freq"], int):
        result["train_freq"] = int(result["train_freq"][0])
    return result


def group_key(agent: str, run: SizedRun, device: str = "cpu") -> Hashable:
    """Key of a run. Runs with equal keys can share a batch.

    On the processor they see observations of one shape. On other devices a wide lane costs hardly more than a
    narrow one: vectors share a batch with others of about their length, and small images with images of as many
    channels and about as many pixels (see `_scale`).
    """
    options, size = resolved(agent, run.hyperparameters), run.shape
    shared = tuple((name, repr(options[name])) for name in OF_A_BATCH[agent])
    observation: tuple[Any, ...] = (size.shape, size.dtype, size.is_image)
    remembers = device == "cpu" and agent == "dqn" and remembers_targets(run)
    if device != "cpu":
        shape, _ = as_networks_see(size.shape, size.is_image)
        if is_small(shape, size.is_image):
            observation = ("small image", shape[0], _scale(shape[1] * shape[2]))
        elif not size.is_image:
            observation = ("vector", _scale(math.prod(shape)))
    return agent, run.steps, size.num_actions, observation, size.frames, shared, remembers


def _scale(number: int) -> int:
    """Size class of a number: one for 1 to 64, one for 65 to 512, one for 513 to 4,096, ..."""
    return max(2, ((number - 1).bit_length() + 2) // 3)


def is_small(shape: tuple[int, ...], is_image: bool) -> bool:
    """Whether an observation is an image of the small convolution, which sees the neighbours of each pixel."""
    return is_image and min(shape[1:]) < NATURE_PIXELS


def as_networks_see(shape: tuple[int, ...], is_image: bool) -> tuple[tuple[int, ...], bool]:
    """(shape as networks take it, whether images are transposed): channels come first.

    Stable-Baselines3 takes the smallest side of an image for its channels, and turns it unless that comes first.
    """
    if not is_image or int(np.argmin(shape)) == 0:
        return shape, False
    return (shape[2], *shape[:2]), True


def remembers_targets(run: SizedRun) -> bool:
    """Whether DQN queries its target network for every state once per copy: fewer queries than all minibatches make.

    Never if several frames are seen: there are more histories than states.
    """
    if run.shape.frames > 1:
        return False
    options = resolved("dqn", run.hyperparameters)
    rollout = options["train_freq"] * options["n_envs"]
    updates = options["gradient_steps"] if options["gradient_steps"] >= 0 else rollout
    queries = options["target_update_interval"] / rollout * updates * options["batch_size"]
    return 2 * run.shape.num_states <= min(queries, 2 * MOST_REMEMBERED)


def _net_arch(hyperparameters: Mapping[str, Any]) -> Any:
    layers = hyperparameters.get("net_arch", OF_A_BATCH["dqn"]["net_arch"])
    return (hyperparameters.get("policy_kwargs") or {}).get("net_arch", layers)


def _is_in_steps(value: int | tuple[int, str]) -> bool:
    return isinstance(value, int) or (len(value) == 2 and value[1] == "step")


def lane_width(is_image: bool, device: str = "cpu") -> int:
    """Most runs that one program trains, chosen by measurement on the processor
    (docs/decisions/0013-batched-training.md).
    """
    if device != "cpu":
        return WIDTH_ELSEWHERE
    return WIDTH_OF_IMAGES if is_image else WIDTH_OF_VECTORS


def lane_widths(number: int, shape: RunShape, device: str = "cpu") -> list[int]:
    """The widths of the lanes of a batch: the last one has at most one idle run, or NARROWEST rows.

    A width is even, as the processor adds up products of single runs in another order.
    """
    widest = lane_width(shape.is_image, device)
    picture = as_networks_see(shape.shape, shape.is_image)[0]
    if device == "cpu" and is_small(picture, shape.is_image):
        widest = WIDTH_OF_SMALL_IMAGES if math.prod(picture[1:]) < WIDE_IMAGE else WIDTH_OF_WIDE_IMAGES
    full, rest = divmod(number, widest)
    return [widest] * full + ([max(rest + rest % 2, min(NARROWEST, widest))] if rest else [])
