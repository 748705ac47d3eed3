"""Many environments for Stable-Baselines3: its VecEnv over the native vector environment, without a loop in Python."""

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.interaction.vector_env import VectorEnv


class SB3VecEnv(VecEnv):
    """A VectorEnv in the mode SAME_STEP as a VecEnv of Stable-Baselines3.

    `infos` are empty but at the end of an episode: "terminal_observation", "TimeLimit.truncated", "episode" with the
    undiscounted return r, length l and seconds t (as a Monitor writes them), and the last "state" (D,) or "index".
    Discrete observations such as "index" come as (N,) int64.

    Attributes:
        earned: (N,) float32, what the rules paid for the last step. If rewards are paid late or with noise, that is
            not what `step` returned.
    """

    def __init__(self, env: VectorEnv):
        if env.metadata["autoreset_mode"] != AutoresetMode.SAME_STEP:
            raise ParameterError(f"{env.environment}: autoreset_mode is not SAME_STEP; Stable-Baselines3 needs that")
        self.env = env
        self.render_mode = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros(env.num_envs, np.int64)
        self.earned = np.zeros(env.num_envs, np.float32)
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, np.int64)
        self._began = time.perf_counter()

    def reset(self) -> VecEnvObs:
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        options = {"state": self._options[0]["state"]} if "state" in (self._options[0] or {}) else None
        observations, _ = self.env.reset(seed=seeds, options=options)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[VecEnvObs, np.ndarray, np.ndarray, list[dict]]:
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        self.earned = info.get("earned_reward", rewards).astype(np.float32)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        if "final_obs" in info:
            seconds = round(time.perf_counter() - self._began, 6)
            name = "index" if "index" in info else "state"
            for i in np.flatnonzero(done):
                infos[i] = {
                    "terminal_observation": info["final_obs"][i],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i]), "t": seconds},
                    name: info["final_info"][name][i],
                }
            self._returns[done] = 0
            self._lengths[done] = 0
        return observations, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        raise ParameterError(f"{attr_name!r} cannot be set: the environments share their settings; make another VecEnv")

    def env_method(
        self, method_name: str, *method_args: object, indices: VecEnvIndices = None, **method_kwargs: object
    ) -> list[Any]:
        if method_name == "action_masks":  # as sb3-contrib asks for them
            return list(self.env.action_masks()[list(self._get_indices(indices))])
        raise ParameterError(
            f"{method_name!r} cannot be called: there are no single environments; use `.env`, a VectorEnv"
        )

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Episodes are monitored already, other wrappers there are none."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor)] * len(list(self._get_indices(indices)))


def make_sb3_vec(
    env: Environment | str,
    num_envs: int = 1,
    *,
    seed: int | None = None,
    **options: Any,
) -> SB3VecEnv:
    """Return `num_envs` copies of an environment as a VecEnv of Stable-Baselines3.

    Args:
        env: a name that `pharos.make` knows, or an Environment.
        seed: of the first reset. Environment i is seeded with seed + i.
        options: see `pharos.interaction.Interaction`, and the parameters of the environment if `env`
            is a name.
    Raises:
        ParameterError: an option or parameter is wrong.
    """
    return SB3VecEnv(VectorEnv(env, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, seed=seed, **options))
