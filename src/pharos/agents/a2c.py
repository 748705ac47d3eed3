"""A2C of Stable-Baselines3. Source: Mnih et al. (2016), Asynchronous methods for deep reinforcement learning."""

from pharos.agents.idealised import IdealisedActorCritic
from pharos.agents.sb3 import DeepAgent

A2C = DeepAgent(
    name="a2c",
    title="A2C",
    path="stable_baselines3:A2C",
    defaults={"n_envs": 8, "n_steps": 5, "learning_rate": 0.0007, "gamma": 0.99, "ent_coef": 0.01},
    space={
        "learning_rate": ("log", 5e-5, 5e-3),
        "n_steps": ("one of", 5, 16, 32),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "gae_lambda": ("linear", 0.8, 1.0),
        "ent_coef": ("log", 1e-4, 0.1),
    },
    idealised=IdealisedActorCritic(gae_lambda=1.0),
)
