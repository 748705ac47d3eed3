"""The public name of `pharos.interaction.sb3_env`."""

from pharos.interaction.sb3_env import make_sb3_vec

__all__ = ["make_sb3_vec"]
