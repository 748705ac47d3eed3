"""Rules called on states and planes that notice forbidden access: `check_environment` calls every rule twice."""

import math
import numbers
import operator
from collections import deque
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np

from pharos.environments import Environment, Layer, State, start_distribution
from pharos.errors import RuleError
from pharos.system.arrays import SUM_TOLERANCE

Answer = TypeVar("Answer")
SAME_ANSWER = "expected the same answer to the same question"


class _StateWritten(Exception):
    """Raised when a rule writes to a state that it may only read."""


class _ReadOnly(tuple):
    """A state that raises when a rule writes to it."""

    def __setitem__(self, index, value):
        raise _StateWritten


class _Planes:
    """Planes that raise when a drawing leaves them. Compiled code would write elsewhere, or from the other end."""

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
    """The rules of an environment, called twice on guarded states. Answers are stored."""

    def __init__(self, env: Environment):
        self.env = env
        self.components = env.components
        self.terminal: dict[State, bool] = {}
        # by possible outcome: (state, action, outcome); outcome 0 without chance
        self.transitions: dict[tuple[State, int, int], State] = {}
        self.rewards: dict[tuple[State, int, int], float] = {}
        self.probabilities: dict[tuple[State, int, int], float] = {}
        self.ages: dict[State, int] = {}
        self.sets: dict[State, tuple[bool, ...]] = {}
        self.drawings: dict[State, np.ndarray] = {}

    def expand(self, state: State) -> list[State]:
        """The successors of `state` in the order of actions and outcomes, checked. None if it is terminal."""
        self.terminal[state] = self._is_terminal(state)
        if self.terminal[state]:
            return []
        successors = []
        if self.env.has_sets:
            self.sets[state] = self._set(state)
        for action in range(self.env.num_actions):
            for outcome, probability in enumerate(self._probabilities(state, action)):
                if probability == 0:
                    continue
                successor = self._transition(state, action, outcome)
                self.probabilities[state, action, outcome] = probability
                self.transitions[state, action, outcome] = successor
                self.rewards[state, action, outcome] = self._reward(state, action, successor, outcome)
                if self.env.has_age:
                    self._check_age(state, action, outcome, successor)
                successors.append(successor)
        return successors

    def branches(self, state: State) -> list[tuple[int, int]]:
        """Possible (action, outcome) pairs of an expanded state that is not terminal, in order."""
        outcomes = range(self.env.outcomes)
        pairs = ((action, outcome) for action in range(self.env.num_actions) for outcome in outcomes)
        return [pair for pair in pairs if (state, *pair) in self.transitions]

    def repeat(self, state: State) -> None:
        """Call the rules in a state again, after calls in other states: rules have no memory."""
        if self._is_terminal(state) != self.terminal[state]:
            raise RuleError(f"{self.where('is_terminal', state)} now says {not self.terminal[state]}; {SAME_ANSWER}")
        if self.terminal[state]:
            return
        if self.env.has_sets and self._set(state) != self.sets[state]:
            raise RuleError(f"{self.where('is_available', state)} now says other actions than before; {SAME_ANSWER}")
        for action in range(self.env.num_actions):
            for outcome, probability in enumerate(self._probabilities(state, action)):
                before = self.probabilities.get((state, action, outcome), 0.0)
                if probability != before:
                    raise RuleError(
                        f"{self.where('probability', state, action, outcome)} is now {probability}, "
                        f"before {before}; {SAME_ANSWER}"
                    )
        for action, outcome in self.branches(state):
            branch = state, action, outcome
            successor = self._transition(*branch)
            if successor != self.transitions[branch]:
                was = self.text(self.transitions[branch])
                raise RuleError(
                    f"{self.where('transition', *branch)} now leads to {self.text(successor)}, "
                    f"before to {was}; {SAME_ANSWER}"
                )
            reward = self._reward(state, action, successor, outcome)
            if reward != self.rewards[branch]:
                raise RuleError(
                    f"{self.where('reward', *branch)} is now {reward}, before {self.rewards[branch]}; {SAME_ANSWER}"
                )

    def drawing(self, state: State) -> None:
        """Draw a state, and its motion, and store the planes."""
        self.drawings[state] = self._planes("draw", self.env.layers, state)
        if self.env.has_motion:
            motion = self._planes("draw_motion", self.env.motion_layers, state)
            self.drawings[state] = np.concatenate([self.drawings[state], motion])

    def _planes(self, rule: str, layers: Mapping[str, Layer], state: State) -> np.ndarray:
        """Planes (L, rows, columns) uint8 that a rule draws, checked."""
        shape = (len(layers), *self.env.grid())
        where = self.where(rule, state)
        drawn = []
        for _ in range(2):
            planes = _Planes(shape)
            self._call(where, getattr(self.env, rule), _ReadOnly(state), planes)
            drawn.append(planes.array)
        if (drawn[0] != drawn[1]).any():
            raise RuleError(f"{where} draws two different things; {SAME_ANSWER}")
        for plane, (name, layer) in zip(drawn[0], layers.items(), strict=True):
            num_values = len(layer.glyph) if isinstance(layer.glyph, tuple) else 1
            if plane.max() > num_values:
                raise RuleError(
                    f"{where} writes {plane.max()} on layer {name!r}; expected 0 to {num_values}, its glyphs"
                )
        return drawn[0]

    def _is_terminal(self, state: State) -> bool:
        where = self.where("is_terminal", state)
        answers = [self._call(where, self.env.is_terminal, _ReadOnly(state)) for _ in range(2)]
        if not all(isinstance(answer, bool | np.bool_) for answer in answers):
            raise RuleError(f"{where} says {answers[0]!r}; expected True or False")
        if answers[0] != answers[1]:
            raise RuleError(f"{where} says {answers[0]}, then {answers[1]}; {SAME_ANSWER}")
        return bool(answers[0])

    def _set(self, state: State) -> tuple[bool, ...]:
        """Whether each action is available in a state. RuleError unless one is."""
        answers = []
        for action in range(self.env.num_actions):
            where = self.where("is_available", state, action)
            answer = self._call(where, self.env.is_available, _ReadOnly(state), action)
            if not isinstance(answer, bool | np.bool_):
                raise RuleError(f"{where} says {answer!r}; expected True or False")
            answers.append(bool(answer))
        if not any(answers):
            raise RuleError(
                f"{self.where('is_available', state)} says False of every action; expected one or more in every state "
                f"that is not terminal"
            )
        return tuple(answers)

    def _probabilities(self, state: State, action: int) -> list[float]:
        """The probabilities of the outcomes of an action, which sum to 1."""
        if not self.env.takes_outcomes():
            return [1.0]
        probabilities = [self._probability(state, action, outcome) for outcome in range(self.env.outcomes)]
        if abs(sum(probabilities) - 1) > SUM_TOLERANCE:
            raise RuleError(
                f"{self.where('probability', state, action)}: those of outcomes 0 to {self.env.outcomes - 1} sum to "
                f"{sum(probabilities)}; expected 1"
            )
        return probabilities

    def _probability(self, state: State, action: int, outcome: int) -> float:
        where = self.where("probability", state, action, outcome)
        answers = [self._call(where, self.env.probability, _ReadOnly(state), action, outcome) for _ in range(2)]
        for answer in answers:
            if not isinstance(answer, numbers.Real | np.bool_) or not 0 <= float(answer) <= 1 + SUM_TOLERANCE:
                raise RuleError(f"{where} is {answer!r}; expected a number from 0 to 1")
        if answers[0] != answers[1]:
            raise RuleError(f"{where} is {answers[0]}, then {answers[1]}; {SAME_ANSWER}")
        return float(answers[0])

    def _check_age(self, state: State, action: int, outcome: int, successor: State) -> None:
        """Raise a RuleError if a successor is not older."""
        before, after = self._age(state), self._age(successor)
        if after <= before:
            raise RuleError(
                f"{self.where('transition', state, action, outcome)} leads from age {before} to {self.text(successor)} "
                f"of age {after}; expected a larger one"
            )

    def _age(self, state: State) -> int:
        if state not in self.ages:
            where = self.where("age", state)
            answers = [self._call(where, self.env.age, _ReadOnly(state)) for _ in range(2)]
            if not isinstance(answers[0], numbers.Integral | np.bool_):
                raise RuleError(f"{where} is {answers[0]!r}; expected an integer")
            if answers[0] != answers[1]:
                raise RuleError(f"{where} is {answers[0]}, then {answers[1]}; {SAME_ANSWER}")
            self.ages[state] = int(answers[0])
        return self.ages[state]

    def _transition(self, state: State, action: int, outcome: int) -> State:
        where = self.where("transition", state, action, outcome)
        which = (action, outcome) if self.env.takes_outcomes() else (action,)
        results = []
        for _ in range(2):
            out = list(state)
            returned = self._call(where, self.env.transition, _ReadOnly(state), *which, out)
            if returned is not None:
                raise RuleError(f"{where} returns {returned!r}; expected nothing: write the new state into `out`")
            results.append(self._checked(where, out))
        if results[0] != results[1]:
            raise RuleError(f"{where} leads to {self.text(results[0])}, then to {self.text(results[1])}; {SAME_ANSWER}")
        return results[0]

    def _checked(self, where: str, out: list) -> State:
        """`out` as a state: D integers within their ranges. RuleError if it is none."""
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

    def _reward(self, state: State, action: int, successor: State, outcome: int) -> float:
        where = self.where("reward", state, action, outcome)
        which = (outcome,) if self.env.pays_by_outcome() else ()
        arguments = (_ReadOnly(state), action, _ReadOnly(successor), *which)
        answers = [self._call(where, self.env.reward, *arguments) for _ in range(2)]
        for answer in answers:
            if not isinstance(answer, numbers.Real | np.bool_) or not math.isfinite(answer):
                raise RuleError(f"{where} is {answer!r}; expected a finite number")
        if answers[0] != answers[1]:
            raise RuleError(f"{where} is {answers[0]}, then {answers[1]}; {SAME_ANSWER}")
        return float(answers[0])

    def _call(self, where: str, rule: Callable[..., Answer], *arguments) -> Answer:
        try:
            return rule(*arguments)
        except _StateWritten:
            raise RuleError(f"{where} writes to its state; expected it to be read only") from None
        except Exception as error:
            raise RuleError(f"{where} raises {type(error).__name__}: {error}") from error

    def where(self, rule: str, state: State, action: int | None = None, outcome: int | None = None) -> str:
        """Beginning of a message: the environment, the rule, the action and outcome, the state."""
        branch = "" if action is None else f" of action {self.env.actions[action]!r}"
        if outcome is not None and self.env.takes_outcomes():
            branch = f" of outcome {outcome}{branch}"
        return f"{self.env}: {rule}{branch} in state {self.text(state)}"

    def text(self, state: State) -> str:
        """Text of a state, with the names of its components if they are few."""
        if len(state) > 8:
            return str(state)
        return "(" + ", ".join(f"{n}={v}" for n, v in zip(self.components.names, state, strict=True)) + ")"


class _NotLooked(Exception):
    """Raised where a rule fails as the build itself tells it."""


class FirstLook(InterpretedCheck):
    """The rules of a few states: what a build would take in changed is refused, and all else is left to it.

    Truth may be a number here, and integers may be floats without a fraction, as compiled rules take both.
    """

    def states(self, most: int, most_branches: int) -> None:
        """Look at so many states near the start, fewer if these have many outcomes. RuleError: the first breach."""
        queue = deque(start_distribution(self.env)[0])
        states, branches = set(queue), self.env.num_actions * int(self.env.outcomes)
        while queue and len(self.terminal) < min(most, most_branches // branches):
            try:
                successors = self.expand(queue.popleft())
            except (_NotLooked, OverflowError):
                return
            queue.extend(state for state in dict.fromkeys(successors) if state not in states)
            states.update(successors)

    def _check_age(self, state: State, action: int, outcome: int, successor: State) -> None:
        """Nothing: a build compares all ages."""

    def _is_terminal(self, state: State) -> bool:
        return bool(self._call("", self.env.is_terminal, _ReadOnly(state)))

    def _set(self, state: State) -> tuple[bool, ...]:
        actions = range(self.env.num_actions)
        return tuple(bool(self._call("", self.env.is_available, _ReadOnly(state), action)) for action in actions)

    def _probabilities(self, state: State, action: int) -> list[float]:
        """None of an action that is not available: its rules are never asked."""
        if state in self.sets and not self.sets[state][action]:
            return []
        try:
            return super()._probabilities(state, action)
        except RuleError:
            if self.env.outcomes > 1:
                raise _NotLooked from None
            raise

    def _checked(self, where: str, out: list) -> State:
        whole = [int(x) if isinstance(x, float | np.floating) and x.is_integer() else x for x in out]
        if all(isinstance(x, numbers.Integral | np.bool_) for x in whole):
            low, high = self.components.low, self.components.high
            if len(whole) != len(low) or any(not a <= x <= b for a, x, b in zip(low, whole, high, strict=True)):
                raise _NotLooked
        return super()._checked(where, whole)

    def _reward(self, state: State, action: int, successor: State, outcome: int) -> float:
        try:
            return super()._reward(state, action, successor, outcome)
        except RuleError:
            which = (outcome,) if self.env.pays_by_outcome() else ()
            reward = self._call("", self.env.reward, _ReadOnly(state), action, _ReadOnly(successor), *which)
            if isinstance(reward, numbers.Real) and not math.isfinite(reward):
                raise _NotLooked from None
            raise

    def _call(self, where: str, rule: Callable[..., Answer], *arguments) -> Answer:
        try:
            return rule(*arguments)
        except Exception as error:
            raise _NotLooked from error
