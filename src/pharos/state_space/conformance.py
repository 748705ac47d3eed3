"""Check of a class of environments against the contract that `Environment` states: `check_environment`.

Run it on every new class, on a few small instances. It looks at the declarations (`check_declarations`), then calls the
rules on many states, interpreted (guarded_rules.py) and compiled, and names the rule and the state that broke the
contract.
"""

import contextlib
import difflib
import json
import numbers
import operator
import random
import tempfile
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.drawing import ground_of, shape_of
from pharos.environments import Environment, Layer, State, classes, start_distribution
from pharos.errors import ParameterError, RuleError, UnknownName
from pharos.rules import mentioned_names, mutable_attributes, pack_states, unpack_states
from pharos.state_space.guarded_rules import InterpretedCheck
from pharos.system.arrays import SUM_TOLERANCE

if TYPE_CHECKING:
    from pharos.rules import Rules

CHECKED_RULES = ("transition", "is_terminal", "reward", "draw", "probability", "age", "is_available", "draw_motion")


@dataclass(frozen=True)
class Conformance:
    """Result of `check_environment`: how much was checked, and notes on things that are no errors.

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
        first = f"{self.environment} keeps the contract in {which} {'state' if self.num_states == 1 else 'states'}"
        return "\n".join([first, *(f"  note: {note}" for note in self.notes)])


def check_environment(env: Environment, *, max_states: int = 1000, seed: int = 0) -> Conformance:
    """Test an environment against the contract that the docstring of `Environment` states.

    Declarations: name, actions, version, time limit, layers, parameters that survive JSON, variables, start states.
    Rules, on the states nearest to the start and on states far from it: values are integers in their declared ranges,
    the same question has the same answer, nothing but `out` and the planes is written to, rewards are finite, drawings
    stay inside their planes, the probabilities of the outcomes of an action sum to 1, ages increase, and compiled rules
    agree with interpreted ones. If all states fit into `max_states`, the state space is built, too, and compared: the
    same states in the same order, terminal states absorbing.

    Args:
        max_states: how many states are looked at: half of them nearest to the start, half by depth-first search.
        seed: of the order of the depth-first search.
    Returns:
        a Conformance. Print it.
    Raises:
        RuleError: the first breach found: the rule, the state and the action, what was found and what is expected.
    Cost: about 0.1 ms for each state and action, and a few seconds to compile the rules of a class for the first time.
    """
    if not isinstance(env, Environment):
        raise RuleError(f"check_environment: found {env!r}; expected an instance of a subclass of pharos.Environment")
    if max_states < 1:
        raise ParameterError(f"check_environment: max_states={max_states}; expected at least 1")
    notes: list[str] = []
    # declarations, then the rules: interpreted, called again, compiled, and in a built state space
    check_declarations(env)
    check_layers(env, notes)
    check = InterpretedCheck(env)
    states, complete = _some_states(env, check, max_states, seed)
    if not check.transitions:
        notes.append("every start state is terminal: episodes end before they begin")
    _check_no_memory(check, states, seed)
    if env.layers:
        for state in states:
            check.drawing(state)
    compiled = _check_compiled(env, check, states, notes)
    if complete:
        _check_built(env, check, states)
        if check.transitions and not _has_choice(check, states):
            notes.append("no policy beats another: at discount 0.99, V* is the value of uniform play")
    for name in mutable_attributes(env, CHECKED_RULES):
        kind = type(getattr(env, name)).__name__
        notes.append(f"rules read {name}, a {kind}, which can change after states were enumerated; expected a tuple")
    _note_unseen_values(env, states, complete, notes)
    _note_names(env, notes)
    return Conformance(
        environment=str(env),
        num_states=len(states),
        num_transitions=len(check.transitions),
        complete=complete,
        compiled=compiled,
        notes=tuple(notes),
    )


# The rules, interpreted -----------------------------------------------------------------------------------------------


def _some_states(env: Environment, check: InterpretedCheck, max_states: int, seed: int) -> tuple[list[State], bool]:
    """(expanded states in the order of discovery, whether these are all reachable ones)."""
    starts, _ = start_distribution(env)
    states = dict.fromkeys(starts)
    # breadth-first: the states nearest to the start, all of them if they are few
    queue = deque(starts)
    while queue and len(states) <= max_states:
        for successor in check.expand(queue.popleft()):
            if successor not in states:
                states[successor] = None
                queue.append(successor)
    if not queue:
        return list(states), True
    # a half of these, and states far from the start, by a random depth-first search
    sample = dict.fromkeys(list(check.terminal)[: (max_states + 1) // 2])
    rng = random.Random(seed)
    stack, visited = list(starts), set()
    while stack and len(sample) < max_states:
        state = stack.pop()
        if state in visited:
            continue
        visited.add(state)
        sample[state] = None
        if state not in check.terminal:
            check.expand(state)
        if not check.terminal[state]:
            successors = [check.transitions[state, *branch] for branch in check.branches(state)]
            stack += rng.sample(successors, len(successors))
    return list(sample), False


def _has_choice(check: InterpretedCheck, states: list[State], gamma: float = 0.99) -> bool:
    """Whether some action, in some state, has another value than the others, when uniform play follows."""
    number = {state: i for i, state in enumerate(states)}
    num_actions = check.env.num_actions
    rows = np.array([number[state] * num_actions + action for state, action, _ in check.transitions], np.int64)
    successors = np.array([number[state] for state in check.transitions.values()], np.int64)
    probabilities, rewards = (np.array([*each.values()]) for each in (check.probabilities, check.rewards))
    matrix = np.eye(len(states))
    np.add.at(matrix, (rows // num_actions, successors), -gamma * probabilities / num_actions)
    v = np.linalg.solve(matrix, np.bincount(rows // num_actions, probabilities * rewards / num_actions, len(states)))
    q = np.bincount(rows, probabilities * (rewards + gamma * v[successors]), len(states) * num_actions)
    return bool((np.ptp(q.reshape(-1, num_actions), axis=1) > 1e-9 * np.abs(q).max()).any())


def _check_no_memory(check: InterpretedCheck, states: list[State], seed: int) -> None:
    """Call the rules again in some states, in random order: they must have no memory."""
    for state in random.Random(seed).sample(states, min(len(states), 200)):
        check.repeat(state)


def _note_unseen_values(env: Environment, states: list[State], complete: bool, notes: list[str]) -> None:
    """Note the variables that do not take all of their declared values."""
    components = env.components
    table = np.array(states, np.int64)
    where = "in any reachable state" if complete else f"in the {len(states)} states looked at"
    for variable, part in components.variables.items():
        low, high = components.low[part].min(), components.high[part].max()
        values = np.unique(table[:, part])
        if values[0] > low or values[-1] < high or len(values) < high - low + 1:
            description = (
                f"{values[0]} to {values[-1]}" if len(values) == values[-1] - values[0] + 1 else f"{len(values)} values"
            )
            notes.append(f"{variable} is declared as {low} to {high}; {where} it takes {description}")


# What users call the attributes of a class, beside names that are merely spelt wrong
OTHER_NAMES = dict.fromkeys(("time_limit", "horizon", "max_steps", "episode_length", "timeout"), "max_episode_steps")
OTHER_NAMES |= {"done": "is_terminal", "terminal": "is_terminal", "step": "transition"}
NEAR = 0.8  # share of letters in common from which on a name is taken for a slip


def _note_names(env: Environment, notes: list[str]) -> None:
    """Note an end that is left out, attributes that nothing reads and are near to one of the contract, and a name that
    a class of pharos has."""
    cls = type(env)
    if cls.is_terminal is Environment.is_terminal and cls.max_episode_steps is Environment.max_episode_steps:
        notes.append(
            "no state is terminal, as it has no is_terminal: episodes end at the time limit, "
            f"{env.max_episode_steps:,} steps; max_episode_steps sets another one"
        )
    contract = {name for name in vars(Environment) if not name.startswith("_")}
    own = [each for each in cls.__mro__ if not each.__module__.startswith("pharos.")]
    names = dict.fromkeys(name for each in own for name in vars(each) if not name.startswith("_"))
    used = {name for each in own for value in vars(each).values() for name in _names_in(value)}
    for name in names:
        if name in contract or name in used or name in env.parameters or hasattr(object, name):
            continue
        near = difflib.get_close_matches(name, contract, n=1, cutoff=NEAR)
        if meant := OTHER_NAMES.get(name) or (near[0] if near else ""):
            notes.append(f"{name} is not used; did you mean {meant}?")
    if not cls.__module__.startswith("pharos.") and classes().get(env.name, cls).__module__.startswith("pharos."):
        notes.append(f"{env.name!r} is the name of a class of pharos as well; choose another name")


def _names_in(value: object) -> tuple[str, ...]:
    """Names that a rule or a property reads."""
    function = value.fget if isinstance(value, property) else value
    code = getattr(function, "__code__", None)
    return () if code is None else code.co_names


# The rules, compiled --------------------------------------------------------------------------------------------------


def _check_compiled(env: Environment, check: InterpretedCheck, states: list[State], notes: list[str]) -> bool:
    """Compare compiled rules with interpreted ones on `states`. False, and a note, if Numba cannot compile them."""
    from pharos.rules import CompiledExpansion, not_compiled, rules_of

    rules = rules_of(env)
    layout = rules.layout
    if reason := rules.reason_not_compiled():
        notes.append(not_compiled(reason))
        return False
    num_states, branches = len(states), env.num_actions * env.outcomes
    packed = pack_states(layout, np.array(states, np.int64))
    keys = np.zeros((num_states * branches, layout.num_words), np.uint64)
    terminal = np.zeros(num_states, np.uint8)
    probabilities = np.ones((num_states, branches))
    exploration = CompiledExpansion(env, layout)
    for i in range(num_states):  # one by one, to know the state of a fault
        component = exploration.component_at_fault(packed, i, keys, terminal, probabilities)
        if component is not None and component > len(env.components):
            raise RuleError(
                f"{check.where('probability or age', states[i])}: compiled, it is not as the contract says; "
                f"interpreted it is"
            )
        if component is not None:
            names = (*env.components.names, "a component that does not exist")
            raise RuleError(
                f"{check.where('transition or is_terminal', states[i])}: compiled, it reads or writes "
                f"{names[component]} outside its declared range; interpreted it does not: "
                f"are there values in between that are not allowed?"
            )
        if bool(terminal[i]) != check.terminal[states[i]]:
            raise RuleError(
                f"{check.where('is_terminal', states[i])} says {bool(terminal[i])} compiled, "
                f"{check.terminal[states[i]]} interpreted; expected the same"
            )
    # probability and next state of each branch
    next_states = unpack_states(layout, keys)
    for j in range(len(keys)):
        i, branch = divmod(j, branches)
        if not terminal[i]:
            which = states[i], *divmod(branch, env.outcomes)
            _check_compiled_branch(check, which, float(probabilities[i, branch]), tuple(next_states[j].tolist()))
    _check_compiled_rewards(check, rules, states, np.concatenate([packed, keys]))
    if env.has_sets:
        _check_compiled_sets(check, rules, states)
    if env.layers:
        _check_compiled_drawings(check, states, notes)
    return True


def _check_compiled_branch(
    check: InterpretedCheck, branch: tuple[State, int, int], probability: float, successor: State
) -> None:
    """Raise a RuleError if an outcome of an action in a state differs between compiled and interpreted rules."""
    if probability != check.probabilities.get(branch, 0.0):
        raise RuleError(
            f"{check.where('probability', *branch)} is {probability} compiled, "
            f"{check.probabilities.get(branch, 0.0)} interpreted; expected the same"
        )
    if probability > 0 and successor != check.transitions[branch]:
        raise RuleError(
            f"{check.where('transition', *branch)} leads to {check.text(successor)} compiled, to "
            f"{check.text(check.transitions[branch])} interpreted; expected the same"
        )


def _check_compiled_sets(check: InterpretedCheck, rules: "Rules", states: list[State]) -> None:
    """Raise a RuleError if the actions that are available in a state differ."""
    sets = np.empty((len(states), check.env.num_actions), np.bool_)
    rules.stepping.mark_available(np.array(states, np.int64), sets)
    for state, compiled in zip(states, sets.tolist(), strict=True):
        if not check.terminal[state] and tuple(compiled) != check.sets[state]:
            raise RuleError(
                f"{check.where('is_available', state)} says {compiled} compiled, {list(check.sets[state])} "
                f"interpreted; expected the same"
            )


def _check_compiled_rewards(check: InterpretedCheck, rules: "Rules", states: list[State], every: np.ndarray) -> None:
    """Raise a RuleError if a reward differs between compiled and interpreted rules.

    Args:
        every: the states, packed, and then the successors of each one by all branches.
    """
    env, num_states = check.env, len(states)
    terminal = np.array([check.terminal[state] for state in states])
    successors = np.arange(num_states, len(every)).reshape(num_states, env.num_actions, env.outcomes)
    for outcome in range(env.outcomes):
        rows = [(i, a) for i, state in enumerate(states) for a in range(env.num_actions)]
        rows = [(i, a) for i, a in rows if (states[i], a, outcome) in check.transitions]
        if env.has_chance:
            which = np.array([i * env.num_actions + a for i, a in rows], np.int64)
            outcomes = which, successors[..., outcome].ravel()[which], np.ones(len(which))
            possible = [sum((states[i], a, k) in check.transitions for k in range(outcome)) for i, a in rows]
            ranks = np.array(possible, np.int64)
            rewards = rules.rewards.expected_block(every, outcomes, terminal, 0, num_states, ranks)
        else:
            rewards = rules.rewards.block(every, successors[..., 0].astype(np.int32), terminal, 0, num_states)
        for i, a in rows:
            branch = states[i], a, outcome
            if rewards[i, a] != check.rewards[branch]:
                raise RuleError(
                    f"{check.where('reward', *branch)} is {rewards[i, a]} compiled, "
                    f"{check.rewards[branch]} interpreted; expected the same"
                )


def _check_compiled_drawings(check: InterpretedCheck, states: list[State], notes: list[str]) -> None:
    """Raise a RuleError if a drawing differs between compiled and interpreted rules."""
    from pharos.rules import CompiledDrawing, CompiledMotion, reason_of

    planes = np.zeros((len(states), *check.drawings[states[0]].shape), np.uint8)
    try:
        engine = CompiledMotion if check.env.has_motion else CompiledDrawing
        engine(check.env, "draw_planes", np.array(states, np.int64), planes)
    except Exception as error:  # Numba raises its own errors, and others from inside of it
        notes.append(f"Numba cannot compile draw, so drawing runs interpreted: {reason_of(error)}")
        return
    for state, drawn in zip(states, planes, strict=True):
        if (drawn != check.drawings[state]).any():
            layer, row, column = (int(i) for i in np.argwhere(drawn != check.drawings[state])[0])
            raise RuleError(
                f"{check.where('draw', state)} writes {drawn[layer, row, column]} at [{layer}, {row}, {column}] "
                f"compiled, {check.drawings[state][layer, row, column]} interpreted; expected the same"
            )


def _check_built(env: Environment, check: InterpretedCheck, states: list[State]) -> None:
    """Build the state space and compare it with the checked states: same numbers, terminal states absorbing."""
    from pharos.state_space import build

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        space = build(env, Path(folder) / "space", progress=False)
        built = [tuple(state) for state in space.states().tolist()]
        matrix, terminal = space.dynamics.matrix(), np.array(space.terminal, bool)
        successors = None if env.has_chance else np.array(space.successors)
        del space
    if built != states:
        raise RuleError(f"{env}: the builder finds {len(built)} states, calling the rules one by one {len(states)}")
    # successors of each state, or with chance the distribution of next states of each pair
    index = {state: i for i, state in enumerate(states)}
    for i, state in enumerate(states):
        ends = check.terminal[state]
        if successors is not None:
            expected = [i if ends else index[check.transitions[state, a, 0]] for a in range(env.num_actions)]
            if bool(terminal[i]) != ends or successors[i].tolist() != expected:
                raise RuleError(
                    f"{check.where('transition', state)}: built, it leads to states {successors[i].tolist()}; "
                    f"expected {expected}"
                )
            continue
        for a in range(env.num_actions):
            row, target = matrix[i * env.num_actions + a].toarray()[0], np.zeros(len(states) + 1)
            target[i] += ends
            for outcome in range(env.outcomes):
                if (branch := (state, a, outcome)) in check.transitions:
                    target[index[check.transitions[branch]]] += check.probabilities[branch]
            if bool(terminal[i]) != ends or (abs(row - target) > SUM_TOLERANCE).any():
                raise RuleError(
                    f"{check.where('transition', state, a)}: built, it leads to {_row_text(row)}; "
                    f"expected {_row_text(target)}"
                )


def _row_text(row: np.ndarray) -> str:
    """Text of a distribution over states."""
    return ", ".join(f"state {i} ({row[i]:.6g})" for i in np.flatnonzero(row))


SPRITE_LETTERS = set(".#123456789")


# Declarations: attributes, variables, start states, layers ------------------------------------------------------------


def check_declarations(env: Environment) -> None:
    """Raise a RuleError if an attribute, the parameters, the variables or the start states break the contract."""
    cls = type(env)
    source = cls.__name__
    # attributes of the class
    parameters = getattr(cls, "__dataclass_params__", None)
    if parameters is None or not parameters.frozen or "__dataclass_params__" not in vars(cls):
        raise RuleError(f"{source} is no frozen dataclass; decorate it with @dataclass(frozen=True, kw_only=True)")
    name = getattr(env, "name", None)
    if not isinstance(name, str) or not name:
        raise RuleError(f"{source}.name is {name!r}; expected the name that users type, a text")
    actions = getattr(env, "actions", None)
    if (
        not isinstance(actions, tuple)
        or not actions
        or not all(isinstance(action, str) and action for action in actions)
        or len(set(actions)) < len(actions)
    ):
        raise RuleError(f"{source}.actions is {actions!r}; expected a tuple of different names, at least one")
    for attribute in ("version", "max_episode_steps"):
        value = getattr(env, attribute)
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
            raise RuleError(f"{env}: {attribute} is {value!r}; expected an integer of at least 1")
    _ = env.has_chance  # which looks at `outcomes`
    for rule in CHECKED_RULES:
        if "print" in mentioned_names([getattr(cls, rule)], cls):
            raise RuleError(
                f"{env}: {rule} prints: remove it; rules compute a state, and a compiled one prints no array"
            )
    # parameters, which must survive JSON
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
    # variables and start states, the same at every call
    try:
        components = env.components
        starts = start_distribution(env)
        again_starts = start_distribution(env)
    except ParameterError as error:
        raise RuleError(str(error)) from error
    except Exception as error:  # of code of the user's own
        raise RuleError(f"{env}: variables() or initial_state() fails: {_message_of(error)}") from error
    if len(env.variables()) != len(components.variables):
        raise RuleError(f"{env}: variables() declares {len(env.variables())} names; expected the same at every call")
    if starts[0] != again_starts[0] or (starts[1] != again_starts[1]).any():
        raise RuleError(f"{env}: initial_states() differs from call to call; expected always the same")


def check_layers(env: Environment, notes: list[str]) -> None:
    """Raise a RuleError if a layer or the grid breaks the contract. A note if there are no layers."""
    source = type(env).__name__
    if not isinstance(env.layers, dict) or not all(isinstance(name, str) for name in env.layers):
        raise RuleError(f"{source}.layers is {env.layers!r}; expected a dict of name -> Layer")
    if not env.layers:
        notes.append("it declares no layers: it cannot be drawn, and has no image observations")
        return
    for name, layer in env.layers.items():
        _check_layer(f"{source}.layers[{name!r}]", name, layer)
    motion = env.motion_layers
    names = set(motion) if isinstance(motion, dict) else set()
    if bool(names) != env.has_motion or names & set(env.layers):
        raise RuleError(
            f"{source}.motion_layers is {motion!r}; expected a dict of name -> Layer, with other names than layers, "
            f"where the class defines draw_motion, and {{}} elsewhere"
        )
    for name, layer in motion.items():
        _check_layer(f"{source}.motion_layers[{name!r}]", name, layer)
    for attribute, look in (("look", env.look), ("look.scenery", env.look.scenery)):
        if look is not None:
            with _named(f"{source}.{attribute}.ground"):
                ground_of(look.ground)
    try:
        rows, columns = env.grid()
        fits = operator.index(rows) >= 1 and operator.index(columns) >= 1
    except (TypeError, ValueError, NotImplementedError):
        fits = False
    except Exception as error:  # of code of the user's own
        raise RuleError(f"{env}: grid() fails: {_message_of(error)}") from error
    if not fits:
        raise RuleError(
            f"{env}: it has layers but grid() does not give (rows, columns); expected two integers, at least 1"
        )


def _message_of(error: Exception) -> str:
    """An error of the user's code in a line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _check_layer(where: str, name: object, layer: object) -> None:
    """Raise a RuleError if a layer, called `where` in messages, breaks the contract."""
    if not isinstance(name, str) or not isinstance(layer, Layer):
        raise RuleError(f"{where} is {layer!r}; expected a Layer")
    glyphs = layer.glyph if isinstance(layer.glyph, tuple) else (layer.glyph,)
    if not glyphs or not all(isinstance(glyph, str) and len(glyph) == 1 for glyph in glyphs):
        raise RuleError(f"{where}.glyph is {layer.glyph!r}; expected one character, or a tuple of them")
    colors: Sequence[Any] = layer.color if isinstance(layer.color[0], tuple) else (layer.color,)
    for color in colors:
        if len(color) != 3 or not all(isinstance(part, int) and 0 <= part <= 255 for part in color):
            raise RuleError(f"{where}.color has {color!r}; expected (red, green, blue), 0 to 255")
    if len(colors) not in (1, len(glyphs)):
        raise RuleError(
            f"{where} has {len(glyphs)} glyphs and {len(colors)} colors; expected one color for all, or one for each"
        )
    with _named(f"{where}.shape"):
        shape_of(name, layer)
    if layer.sprite is not None:
        _check_sprites(f"{where}.sprite", layer.sprite, len(glyphs))


@contextlib.contextmanager
def _named(source: str) -> Iterator[None]:
    """Context in which an unknown name, such as the name of a shape, is a RuleError of `source`."""
    try:
        yield
    except UnknownName as error:
        raise RuleError(f"{source}: {error}") from None


def _check_sprites(source: str, sprite: Sequence[Any], num_values: int) -> None:
    """Raise a RuleError if the sprites of a layer are no pixels, or too few or many for its values."""
    sprites = sprite if sprite and isinstance(sprite[0], tuple) else (sprite,)
    for rows in sprites:
        if not rows or len(set(map(len, rows))) != 1 or not rows[0] or set("".join(rows)) - SPRITE_LETTERS:
            raise RuleError(f"{source} has {rows!r}; expected rows of equal length of the letters . # 1-9")
    if len(sprites) not in (1, num_values):
        raise RuleError(
            f"{source} has {len(sprites)} sprites for {num_values} values; expected one for all, or one for each"
        )
