"""The public name of what `pharos.interaction` has for Stable-Baselines3."""

from pharos.interaction import SB3VecEnv, make_sb3_vec

__all__ = ["SB3VecEnv", "make_sb3_vec"]
