"""Stepping an environment: one (Gymnasium), many at once (vector), and for Stable-Baselines3.

`import pharos` needs `registration` alone, so that everything else is loaded when it is first used.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.interaction.gym_env import GymEnv
    from pharos.interaction.jax_export import to_gymnax
    from pharos.interaction.registration import ids_of, register_class
    from pharos.interaction.sb3_env import SB3VecEnv, make_sb3_vec
    from pharos.interaction.simulator import Interaction, Simulator
    from pharos.interaction.vector_env import VectorEnv, make_vec

__all__ = [
    "GymEnv",
    "VectorEnv",
    "make_sb3_vec",
    "make_vec",
    "to_gymnax",
]

__getattr__ = lazy.attributes(__name__)
