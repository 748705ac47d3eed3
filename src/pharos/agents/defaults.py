"""Hyperparameters of each agent in every environment, under the names of Stable-Baselines3 and of `QLearning`.

`n_envs` stands beside them. What suits a class of environments better stands in its file.
"""

from typing import Any

DEFAULTS: dict[str, dict[str, Any]] = {
    "q_learning": {
        "learning_rate": 0.02,
        "visits_exponent": 0.6,
        "gamma": 0.99,
        "initial_q": 1.0,  # optimistic: the largest return of grids and lakes
        "exploration_initial_eps": 1.0,
        "exploration_final_eps": 0.02,
        "exploration_fraction": 0.3,
    },
    "dqn": {
        "learning_rate": 0.0005,
        "buffer_size": 50000,
        "learning_starts": 1000,
        "batch_size": 64,
        "gamma": 0.99,
        "train_freq": 4,
        "gradient_steps": 1,
        "target_update_interval": 500,
        "exploration_initial_eps": 1.0,
        "exploration_final_eps": 0.05,
        "exploration_fraction": 0.3,
        "max_grad_norm": 10,
    },
    "ppo": {
        "n_envs": 8,
        "n_steps": 64,
        "batch_size": 128,
        "n_epochs": 4,
        "learning_rate": 0.0005,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "ent_coef": 0.01,
        "clip_range": 0.2,
    },
    "a2c": {"n_envs": 8, "n_steps": 5, "learning_rate": 0.0007, "gamma": 0.99, "ent_coef": 0.01},
}
