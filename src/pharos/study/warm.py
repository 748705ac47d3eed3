"""Loaded once by the process from which the workers of a study are forked: a run then starts in milliseconds.

Everything a run imports, and a few steps of training, which makes PyTorch and Stable-Baselines3 load what they load
late. One thread only, by the variables with which it is started: a process with threads must not be forked.
"""

import contextlib
import importlib
import warnings


def _load() -> None:
    for name in ("numpy", "scipy.sparse", "numba", "gymnasium", "pandas", "pyarrow.parquet"):
        importlib.import_module(name)
    for name in (
        "pharos.interaction.gym_env",
        "pharos.mdp",
        "pharos.observations",
        "pharos.solvers",
        "pharos.state_space",
    ):
        importlib.import_module(name)
    importlib.import_module("pharos.study.worker")


def _train() -> None:
    import gymnasium
    import torch
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.logger import Logger

    torch.set_num_threads(1)
    env = gymnasium.make("CartPole-v1")
    for model in (
        DQN("MlpPolicy", env, device="cpu", learning_starts=20, buffer_size=100),
        PPO("MlpPolicy", env, device="cpu", n_steps=30, batch_size=30),
    ):
        model.set_logger(Logger(folder=None, output_formats=[]))  # its own makes a folder among the temporary files
        model.learn(60)


with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    _load()
    with contextlib.suppress(ImportError):  # without the agents extra there are tabular agents
        _train()
