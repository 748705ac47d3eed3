"""What the functions on MDPs say where they are given something that an MDP can be made of."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from pharos.errors import ParameterError

P = ParamSpec("P")
R = TypeVar("R")


def require_mdp(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which raises ParameterError, with what to write, unless its first argument is a TabularMDP."""

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        from pharos.mdp.tabular import TabularMDP  # which imports files of this package that use this function

        value = args[0] if args else kwargs.get("mdp")
        if not isinstance(value, TabularMDP) and (args or "mdp" in kwargs):
            raise ParameterError(
                f"{function.__name__}: found {_described(value)}; expected a TabularMDP: write {_remedy(value)}"
            )
        return function(*args, **kwargs)

    return checked


def _described(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _remedy(value: Any) -> str:
    from pharos.environments import Environment
    from pharos.state_space import StateSpace  # which takes longer to load than all that chance needs

    if isinstance(value, StateSpace):
        return "space.mdp(gamma=0.99)"
    if isinstance(value, Environment):
        return "pharos.build(env).mdp(gamma=0.99)"
    if isinstance(value, str):
        return f"pharos.build({value!r}).mdp(gamma=0.99)"
    return "pharos.build(env).mdp(gamma=0.99), or TabularMDP.from_arrays(...)"
