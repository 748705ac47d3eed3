"""Rules called on states and planes that notice what a rule may not do: `check_environment` asks everything twice."""

import math
import numbers
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from pharos.environments import Environment, State
from pharos.errors import RuleError

SAME = "expected the same answer to the same question"


class _StateWritten(Exception):
    """A rule wrote to what it may only read."""


class _ReadOnly(tuple):
    """A state that says so when a rule writes to it."""

    def __setitem__(self, index, value):
        raise _StateWritten


class _Planes:
    """Planes that say so when a drawing leaves them; compiled code would write elsewhere, or from the other end."""

    def __init__(self, shape: tuple[int, int, int]):
        self.array = np.zeros(shape, np.uint8)
        self.shape = shape

    def _checked(self, index):
        indices = index if isinstance(index, tuple) else (index,)
        for i, size in zip(indices, self.shape, strict=False):
            if not isinstance(i, slice) and not 0 <= operator.index(i) < size:
                raise IndexError(f"planes[{', '.join(map(str, indices))}] lies outside of planes {self.shape}")
        return index

    def __getitem__(self, index):
        return self.array[self._checked(index)]

    def __setitem__(self, index, value):
        self.array[self._checked(index)] = value


class InterpretedCheck:
    """Calls the rules twice on guarded states and remembers their answers."""

    def __init__(self, env: Environment):
        self.env = env
        self.components = env.components
        self.terminal: dict[State, bool] = {}
        self.transitions: dict[tuple[State, int], State] = {}
        self.rewards: dict[tuple[State, int], float] = {}
        self.drawings: dict[State, np.ndarray] = {}

    def expand(self, state: State) -> list[State]:
        """The successors of `state` in the order of the actions, checked; none where it is terminal."""
        self.terminal[state] = self._is_terminal(state)
        if self.terminal[state]:
            return []
        successors = []
        for action in range(self.env.num_actions):
            successor = self._transition(state, action)
            self.transitions[state, action] = successor
            self.rewards[state, action] = self._reward(state, action, successor)
            successors.append(successor)
        return successors

    def repeat(self, state: State) -> None:
        """Ask again, with other questions asked in between: rules have no memory."""
        if self._is_terminal(state) != self.terminal[state]:
            raise RuleError(f"{self.where('is_terminal', state)} now says {not self.terminal[state]}; {SAME}")
        if self.terminal[state]:
            return
        for action in range(self.env.num_actions):
            successor = self._transition(state, action)
            if successor != self.transitions[state, action]:
                before = self.text(self.transitions[state, action])
                raise RuleError(
                    f"{self.where('transition', state, action)} now leads to {self.text(successor)}, "
                    f"before to {before}; {SAME}"
                )
            reward = self._reward(state, action, successor)
            if reward != self.rewards[state, action]:
                raise RuleError(
                    f"{self.where('reward', state, action)} is now {reward}, "
                    f"before {self.rewards[state, action]}; {SAME}"
                )

    def drawing(self, state: State) -> None:
        shape = (len(self.env.layers), *self.env.grid())
        where = self.where("draw", state)
        found = []
        for _ in range(2):
            planes = _Planes(shape)
            self._call(where, self.env.draw, _ReadOnly(state), planes)
            found.append(planes.array)
        if (found[0] != found[1]).any():
            raise RuleError(f"{where} draws two different things; {SAME}")
        for plane, (name, layer) in zip(found[0], self.env.layers.items(), strict=True):
            num_values = len(layer.glyph) if isinstance(layer.glyph, tuple) else 1
            if plane.max() > num_values:
                raise RuleError(
                    f"{where} writes {plane.max()} on layer {name!r}; expected 0 to {num_values}, its glyphs"
                )
        self.drawings[state] = found[0]

    def _is_terminal(self, state: State) -> bool:
        where = self.where("is_terminal", state)
        answers = [self._call(where, self.env.is_terminal, _ReadOnly(state)) for _ in range(2)]
        if not all(isinstance(answer, bool | np.bool_) for answer in answers):
            raise RuleError(f"{where} says {answers[0]!r}; expected True or False")
        if answers[0] != answers[1]:
            raise RuleError(f"{where} says {answers[0]}, then {answers[1]}; {SAME}")
        return bool(answers[0])

    def _transition(self, state: State, action: int) -> State:
        where = self.where("transition", state, action)
        results = []
        for _ in range(2):
            out = list(state)
            returned = self._call(where, self.env.transition, _ReadOnly(state), action, out)
            if returned is not None:
                raise RuleError(f"{where} returns {returned!r}; expected nothing: write the new state into `out`")
            results.append(self._checked(where, out))
        if results[0] != results[1]:
            raise RuleError(f"{where} leads to {self.text(results[0])}, then to {self.text(results[1])}; {SAME}")
        return results[0]

    def _checked(self, where: str, out: list) -> State:
        """`out` as a state: D integers within their ranges."""
        components = self.components
        if len(out) != len(components):
            raise RuleError(f"{where} leaves {len(out)} components in `out`; expected {len(components)}")
        for i, value in enumerate(out):
            if not isinstance(value, numbers.Integral | np.bool_):
                raise RuleError(f"{where} writes {components.names[i]} = {value!r}; expected an integer")
            if not components.low[i] <= int(value) <= components.high[i]:
                raise RuleError(
                    f"{where} writes {components.names[i]} = {value}; "
                    f"declared: {components.low[i]} to {components.high[i]}"
                )
        return tuple(int(value) for value in out)

    def _reward(self, state: State, action: int, successor: State) -> float:
        where = self.where("reward", state, action)
        answers = [self._call(where, self.env.reward, _ReadOnly(state), action, _ReadOnly(successor)) for _ in range(2)]
        for answer in answers:
            if not isinstance(answer, numbers.Real | np.bool_) or not math.isfinite(answer):
                raise RuleError(f"{where} is {answer!r}; expected a finite number")
        if answers[0] != answers[1]:
            raise RuleError(f"{where} is {answers[0]}, then {answers[1]}; {SAME}")
        return float(answers[0])

    def _call(self, where: str, rule: Callable, *arguments) -> Any:
        try:
            return rule(*arguments)
        except _StateWritten:
            raise RuleError(f"{where} writes to its state; expected it to be read only") from None
        except Exception as error:
            raise RuleError(f"{where} raises {type(error).__name__}: {error}") from error

    def where(self, rule: str, state: State, action: int | None = None) -> str:
        """How a message begins: whose rule, by which action, in which state."""
        chosen = "" if action is None else f" of action {self.env.actions[action]!r}"
        return f"{self.env}: {rule}{chosen} in state {self.text(state)}"

    def text(self, state: State) -> str:
        """A state, with the names of its components where they are few."""
        if len(state) > 8:
            return str(state)
        return "(" + ", ".join(f"{n}={v}" for n, v in zip(self.components.names, state, strict=True)) + ")"
