"""PPO. Source: Schulman et al. (2017), Proximal policy optimization algorithms."""

from pharos.agents.idealised import IdealisedActorCritic
from pharos.agents.sb3 import BatchedAgent

PPO = BatchedAgent(
    name="ppo",
    title="PPO",
    path="stable_baselines3:PPO",
    defaults={
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
    space={
        "learning_rate": ("log", 5e-5, 2e-3),
        "n_steps": ("one of", 16, 32, 64, 128, 256),
        "n_epochs": ("one of", 4, 8),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "gae_lambda": ("linear", 0.8, 1.0),
        "ent_coef": ("log", 1e-4, 0.1),
        "clip_range": ("one of", 0.1, 0.2, 0.3),
    },
    idealised=IdealisedActorCritic(predictor="network_policy_regret", fallback="kernel_policy_regret", clip_range=0.2),
    relatives=("trpo",),
)
