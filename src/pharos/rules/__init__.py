"""The rules of an environment at three speeds: compiled, traced and interpreted."""

from pharos.rules.stepping import CompiledStepping, InterpretedStepping, stepping_rules

__all__ = ["CompiledStepping", "InterpretedStepping", "stepping_rules"]
