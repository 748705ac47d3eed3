"""The rules of an environment at three speeds: compiled, traced and interpreted."""
