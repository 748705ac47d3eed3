"""DQN. Source: Mnih et al. (2015), Human-level control through deep reinforcement learning."""

from pharos.agents.idealised import IdealisedDQN
from pharos.agents.sb3 import BatchedAgent

DQN = BatchedAgent(
    name="dqn",
    title="DQN",
    path="stable_baselines3:DQN",
    defaults={
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
    space={
        "learning_rate": ("log", 5e-5, 2e-3),
        "batch_size": ("one of", 32, 64, 128),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "n_steps": ("one of", 1, 3, 5),
        "train_freq": ("one of", 1, 4, 8),
        "learning_starts": ("one of", 200, 1000, 5000),
        "target_update_interval": ("one of", 100, 500, 1000, 2500),
        "exploration_fraction": ("linear", 0.05, 0.5),
        "exploration_final_eps": ("linear", 0.01, 0.1),
    },
    benchmark_defaults={"n_envs": 1, "n_steps": 1},
    idealised=IdealisedDQN(),
    is_greedy=True,
)
