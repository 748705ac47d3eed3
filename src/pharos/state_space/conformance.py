"""check_environment: does a class of environments keep the contract that `Environment` states?

Run it on every new class, on a few small instances. It looks at the declarations, then calls the rules on many states,
interpreted and compiled, and names the rule and the state that broke the contract.
"""

import json
import math
import numbers
import operator
import random
import tempfile
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import Environment, Layer, State, start_distribution
from pharos.errors import ParameterError, RuleError

SPRITE_LETTERS = set(".#123456789")


@dataclass(frozen=True)
class Conformance:
    """What `check_environment` looked at, and what it noted without calling it an error.

    Attributes:
        environment: the instance, as text.
        num_states, num_transitions: how many were checked.
        complete: whether these are all reachable states.
        compiled: whether Numba compiles the rules.
        notes: one sentence each: declared values never seen, rules that run interpreted, nothing to draw.
    """

    environment: str
    num_states: int
    num_transitions: int
    complete: bool
    compiled: bool
    notes: tuple[str, ...]

    def __str__(self) -> str:
        which = f"all {self.num_states}" if self.complete else f"a sample of {self.num_states}"
        first = f"{self.environment} keeps the contract in {which} states"
        return "\n".join([first, *(f"  note: {note}" for note in self.notes)])


def check_environment(env: Environment, *, max_states: int = 1000, seed: int = 0) -> Conformance:
    """Test an environment against the contract that the docstring of `Environment` states.

    Declarations: name, actions, version, time limit, layers, parameters that survive JSON, variables, start states. Rules, on
    the states nearest to the start and on states far from it: values are integers in their declared ranges, the same question has
    the same answer, nothing but `out` and the planes is written to, rewards are finite, drawings stay inside their planes,
    and compiled rules agree with interpreted ones. Where all states fit into `max_states`, the state space is built, too, and
    compared: the same states in the same order, terminal states absorbing.

    Args:
        max_states: how many states are looked at; half of them nearest to the start, half by depth-first search.
        seed: of the order of the depth-first search.
    Returns:
        a Conformance; print it.
    Raises:
        RuleError: the first breach found: the rule, the state and the action, what was found and what is expected.
    Cost: about 0.1 ms for each state and action, and a few seconds to compile the rules of a class for the first time.
    """
    if not isinstance(env, Environment):
        raise RuleError(f"check_environment: found {env!r}; expected an instance of a subclass of pharos.Environment")
    if max_states < 1:
        raise ParameterError(f"check_environment: max_states={max_states}; expected at least 1")
    notes: list[str] = []
    _check_declarations(env)
    _check_layers(env, notes)
    check = _InterpretedCheck(env)
    states, complete = _some_states(env, check, max_states, seed)
    if not check.transitions:
        notes.append("every start state is terminal: episodes end before they begin")
    _check_again(check, states, seed)
    if env.layers:
        for state in states:
            check.drawing(state)
    compiled = _check_compiled(env, check, states, notes)
    if complete:
        _check_built(env, check, states, notes)
    _note_unseen_values(env, states, complete, notes)
    return Conformance(
        environment=str(env),
        num_states=len(states),
        num_transitions=len(check.transitions),
        complete=complete,
        compiled=compiled,
        notes=tuple(notes),
    )


# Declarations ------------------------------------------------------------------------------------------------------------


def _check_declarations(env: Environment) -> None:
    cls = type(env)
    whose = cls.__name__
    parameters = getattr(cls, "__dataclass_params__", None)
    if parameters is None or not parameters.frozen or "__dataclass_params__" not in vars(cls):
        raise RuleError(f"{whose} is no frozen dataclass; decorate it with @dataclass(frozen=True, kw_only=True)")
    name = getattr(env, "name", None)
    if not isinstance(name, str) or not name:
        raise RuleError(f"{whose}.name is {name!r}; expected the name that users type, a text")
    actions = getattr(env, "actions", None)
    if (
        not isinstance(actions, tuple)
        or not actions
        or not all(isinstance(action, str) and action for action in actions)
        or len(set(actions)) < len(actions)
    ):
        raise RuleError(f"{whose}.actions is {actions!r}; expected a tuple of different names, at least one")
    for attribute in ("version", "max_episode_steps"):
        value = getattr(env, attribute)
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
            raise RuleError(f"{env}: {attribute} is {value!r}; expected an integer of at least 1")
    try:
        again = cls(**json.loads(json.dumps(env.parameters, allow_nan=False)))
    except (TypeError, ValueError) as error:
        raise RuleError(
            f"{env}: its parameters do not survive JSON ({error}); expected numbers, texts, None and tuples of these"
        ) from error
    if again != env:
        raise RuleError(
            f"{env}: read back from JSON it is {again}; expected an equal instance (JSON turns tuples into lists: "
            f"turn them back in validate, with object.__setattr__)"
        )
    try:
        components = env.components
        starts = start_distribution(env)
        again_starts = start_distribution(env)
    except ParameterError as error:
        raise RuleError(str(error)) from error
    if len(env.variables()) != len(components.variables):
        raise RuleError(f"{env}: variables() declares {len(env.variables())} names; expected the same at every call")
    if starts[0] != again_starts[0] or (starts[1] != again_starts[1]).any():
        raise RuleError(f"{env}: initial_states() differs from call to call; expected always the same")


def _check_layers(env: Environment, notes: list[str]) -> None:
    whose = type(env).__name__
    if not isinstance(env.layers, dict) or not all(isinstance(name, str) for name in env.layers):
        raise RuleError(f"{whose}.layers is {env.layers!r}; expected a dict of name -> Layer")
    if not env.layers:
        notes.append("it declares no layers: it cannot be drawn, and has no image observations")
        return
    for name, layer in env.layers.items():
        if not isinstance(layer, Layer):
            raise RuleError(f"{whose}.layers[{name!r}] is {layer!r}; expected a Layer")
        glyphs = layer.glyph if isinstance(layer.glyph, tuple) else (layer.glyph,)
        if not glyphs or not all(isinstance(glyph, str) and len(glyph) == 1 for glyph in glyphs):
            raise RuleError(
                f"{whose}.layers[{name!r}].glyph is {layer.glyph!r}; expected one character, or a tuple of them"
            )
        colors: Sequence[Any] = layer.color if isinstance(layer.color[0], tuple) else (layer.color,)
        for color in colors:
            if len(color) != 3 or not all(isinstance(part, int) and 0 <= part <= 255 for part in color):
                raise RuleError(f"{whose}.layers[{name!r}].color has {color!r}; expected (red, green, blue), 0 to 255")
        if len(colors) not in (1, len(glyphs)):
            raise RuleError(
                f"{whose}.layers[{name!r}] has {len(glyphs)} glyphs and {len(colors)} colors; expected one color for all, or "
                f"one for each"
            )
        if layer.sprite is not None:
            _check_sprites(f"{whose}.layers[{name!r}].sprite", layer.sprite, len(glyphs))
    try:
        rows, columns = env.grid()
        fits = operator.index(rows) >= 1 and operator.index(columns) >= 1
    except (TypeError, ValueError, NotImplementedError):
        fits = False
    if not fits:
        raise RuleError(
            f"{env}: it has layers but grid() does not give (rows, columns); expected two integers, at least 1"
        )


def _check_sprites(whose: str, sprite: Any, num_values: int) -> None:
    sprites = sprite if sprite and isinstance(sprite[0], tuple) else (sprite,)
    for rows in sprites:
        if not rows or len(set(map(len, rows))) != 1 or not rows[0] or set("".join(rows)) - SPRITE_LETTERS:
            raise RuleError(f"{whose} has {rows!r}; expected rows of equal length of the letters . # 1-9")
    if len(sprites) not in (1, num_values):
        raise RuleError(
            f"{whose} has {len(sprites)} sprites for {num_values} values; expected one for all, or one for each"
        )


# The rules, interpreted --------------------------------------------------------------------------------------------------


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


class _InterpretedCheck:
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
            raise RuleError(f"{self._where('is_terminal', state)} now says {not self.terminal[state]}; {SAME}")
        if self.terminal[state]:
            return
        for action in range(self.env.num_actions):
            successor = self._transition(state, action)
            if successor != self.transitions[state, action]:
                before = self._text(self.transitions[state, action])
                raise RuleError(
                    f"{self._where('transition', state, action)} now leads to {self._text(successor)}, before to {before}; {SAME}"
                )
            reward = self._reward(state, action, successor)
            if reward != self.rewards[state, action]:
                raise RuleError(
                    f"{self._where('reward', state, action)} is now {reward}, before {self.rewards[state, action]}; {SAME}"
                )

    def drawing(self, state: State) -> None:
        shape = (len(self.env.layers), *self.env.grid())
        where = self._where("draw", state)
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
        where = self._where("is_terminal", state)
        answers = [self._call(where, self.env.is_terminal, _ReadOnly(state)) for _ in range(2)]
        if not all(isinstance(answer, bool | np.bool_) for answer in answers):
            raise RuleError(f"{where} says {answers[0]!r}; expected True or False")
        if answers[0] != answers[1]:
            raise RuleError(f"{where} says {answers[0]}, then {answers[1]}; {SAME}")
        return bool(answers[0])

    def _transition(self, state: State, action: int) -> State:
        where = self._where("transition", state, action)
        results = []
        for _ in range(2):
            out = list(state)
            returned = self._call(where, self.env.transition, _ReadOnly(state), action, out)
            if returned is not None:
                raise RuleError(f"{where} returns {returned!r}; expected nothing: write the new state into `out`")
            results.append(self._checked(where, out))
        if results[0] != results[1]:
            raise RuleError(f"{where} leads to {self._text(results[0])}, then to {self._text(results[1])}; {SAME}")
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
        where = self._where("reward", state, action)
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

    def _where(self, rule: str, state: State, action: int | None = None) -> str:
        chosen = "" if action is None else f" of action {self.env.actions[action]!r}"
        return f"{self.env}: {rule}{chosen} in state {self._text(state)}"

    def _text(self, state: State) -> str:
        if len(state) > 8:
            return str(state)
        return "(" + ", ".join(f"{n}={v}" for n, v in zip(self.components.names, state, strict=True)) + ")"


SAME = "expected the same answer to the same question"


def _some_states(env: Environment, check: _InterpretedCheck, max_states: int, seed: int) -> tuple[list[State], bool]:
    """Expanded states, in the order of discovery, and whether these are all that can be reached."""
    starts, _ = start_distribution(env)
    found = dict.fromkeys(starts)
    queue = deque(starts)
    while queue and len(found) <= max_states:
        for successor in check.expand(queue.popleft()):
            if successor not in found:
                found[successor] = None
                queue.append(successor)
    if not queue:
        return list(found), True
    chosen = dict.fromkeys(list(check.terminal)[: (max_states + 1) // 2])
    rng = random.Random(seed)
    stack, visited = list(starts), set()
    while stack and len(chosen) < max_states:
        state = stack.pop()
        if state in visited:
            continue
        visited.add(state)
        chosen[state] = None
        if state not in check.terminal:
            check.expand(state)
        if not check.terminal[state]:
            successors = [check.transitions[state, action] for action in range(env.num_actions)]
            stack += rng.sample(successors, len(successors))
    return list(chosen), False


def _check_again(check: _InterpretedCheck, states: list[State], seed: int) -> None:
    for state in random.Random(seed).sample(states, min(len(states), 200)):
        check.repeat(state)


def _note_unseen_values(env: Environment, states: list[State], complete: bool, notes: list[str]) -> None:
    components = env.components
    table = np.array(states, np.int64)
    where = "in any reachable state" if complete else f"in the {len(states)} states looked at"
    for variable, part in components.variables.items():
        low, high = components.low[part].min(), components.high[part].max()
        seen = np.unique(table[:, part])
        if seen[0] > low or seen[-1] < high or len(seen) < high - low + 1:
            values = f"{seen[0]} to {seen[-1]}" if len(seen) == seen[-1] - seen[0] + 1 else f"{len(seen)} values"
            notes.append(f"{variable} is declared as {low} to {high}; {where} it takes {values}")


# The rules, compiled -----------------------------------------------------------------------------------------------------


def _check_compiled(env: Environment, check: _InterpretedCheck, states: list[State], notes: list[str]) -> bool:
    """Run the compiled rules on the same states; False, and a note, where Numba cannot compile them."""
    from pharos.rules import CompiledExploration, not_compiled, pack, rules_of, unpack

    rules = rules_of(env)
    layout = rules.layout
    if reason := rules.reason_not_compiled():
        notes.append(not_compiled(reason))
        return False
    num_states, num_actions = len(states), env.num_actions
    packed = pack(layout, np.array(states, np.int64))
    keys = np.zeros((num_states * num_actions, layout.num_words), np.uint64)
    terminal = np.zeros(num_states, np.uint8)
    exploration = CompiledExploration(env, layout)
    for i in range(num_states):  # one by one, to know the state of a fault
        component = exploration.component_at_fault(packed, i, keys, terminal)
        if component is not None:
            names = (*env.components.names, "a component that does not exist")
            raise RuleError(
                f"{check._where('transition or is_terminal', states[i])}: compiled, it reads or writes {names[component]} "
                f"outside its declared range; interpreted it does not: are there values in between that are not allowed?"
            )
        if bool(terminal[i]) != check.terminal[states[i]]:
            raise RuleError(
                f"{check._where('is_terminal', states[i])} says {bool(terminal[i])} compiled, "
                f"{check.terminal[states[i]]} interpreted; expected the same"
            )
    following = unpack(layout, keys)
    every = np.concatenate([packed, keys])
    successors = np.arange(num_states, num_states + len(keys), dtype=np.int32).reshape(num_states, num_actions)
    rewards = rules.rewards.block(every, successors, terminal.view(np.bool_), 0, num_states)
    for i, state in enumerate(states):
        for action in range(num_actions if not terminal[i] else 0):
            successor = tuple(following[i * num_actions + action].tolist())
            if successor != check.transitions[state, action]:
                raise RuleError(
                    f"{check._where('transition', state, action)} leads to {check._text(successor)} compiled, to "
                    f"{check._text(check.transitions[state, action])} interpreted; expected the same"
                )
            if rewards[i, action] != check.rewards[state, action]:
                raise RuleError(
                    f"{check._where('reward', state, action)} is {rewards[i, action]} compiled, "
                    f"{check.rewards[state, action]} interpreted; expected the same"
                )
    if env.layers:
        _check_compiled_drawings(check, states, notes)
    return True


def _check_compiled_drawings(check: _InterpretedCheck, states: list[State], notes: list[str]) -> None:
    from pharos.rules import CompiledDrawing, reason_of

    planes = np.zeros((len(states), *check.drawings[states[0]].shape), np.uint8)
    try:
        CompiledDrawing(check.env, "draw_planes", np.array(states, np.int64), planes)
    except Exception as error:  # Numba raises its own errors, and others from inside of it
        notes.append(f"Numba cannot compile draw, so drawing runs interpreted: {reason_of(error)}")
        return
    for state, drawn in zip(states, planes, strict=True):
        if (drawn != check.drawings[state]).any():
            layer, row, column = (int(i) for i in np.argwhere(drawn != check.drawings[state])[0])
            raise RuleError(
                f"{check._where('draw', state)} writes {drawn[layer, row, column]} at [{layer}, {row}, {column}] compiled, "
                f"{check.drawings[state][layer, row, column]} interpreted; expected the same"
            )


def _check_built(env: Environment, check: _InterpretedCheck, states: list[State], notes: list[str]) -> None:
    """Build the state space and compare it with the states found: same numbers, terminal states absorbing."""
    from pharos.state_space import build

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        space = build(env, Path(folder) / "space", progress=False)
        built = [tuple(state) for state in space.states().tolist()]
        successors = np.array(space.successors)
        terminal = np.array(space.terminal, bool)
        del space
    if built != states:
        raise RuleError(f"{env}: the builder finds {len(built)} states, calling the rules one by one {len(states)}")
    index = {state: i for i, state in enumerate(states)}
    for i, state in enumerate(states):
        ends = check.terminal[state]
        expected = [i if ends else index[check.transitions[state, a]] for a in range(env.num_actions)]
        if bool(terminal[i]) != ends or successors[i].tolist() != expected:
            raise RuleError(
                f"{check._where('transition', state)}: built, it leads to states {successors[i].tolist()}; expected {expected}"
            )
