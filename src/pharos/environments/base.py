"""Environment: the interface of a class of environments. Small deterministic rules on integer states, nothing else.

A state is a vector of D integers. A stochastic action has outcomes, each with a probability and a next state. Sticky
and random actions, time limits, observations and pixels are added outside, so that the same state space serves every
one of them.

How a class looks is declared too: `Layer`, `Scenery`, `Look`. `pharos.drawing` paints from these. A function may
replace any name of a ground or a shape.
"""

import dataclasses
import inspect
import math
import numbers
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, SupportsIndex, TypeGuard, TypeVar

import numpy as np

from pharos.errors import ParameterError, RuleError
from pharos.system.wording import capped

if TYPE_CHECKING:
    from pharos.system.distinct_rows import DistinctRows

NO_ACTION = -1  # the previous action on the first step of an episode

# Parameters -----------------------------------------------------------------------------------------------------------
#
# Declared in the fields of a dataclass, and checked when an instance is made:
#
#     height: int = parameter(12, low=4)
#     car_speeds: tuple[int, ...] = parameter(None, kind=integers("at least 1", lambda period: period >= 1))


T = TypeVar("T")


@dataclass(frozen=True)
class Kind:
    """A kind of values beside numbers and truths.

    Attributes:
        text: how a value is written on the command line, such as "row,column".
        checked: function(environment, name of the parameter, value) -> the value as it is stored. It raises
            ParameterError.
    """

    text: str
    checked: Callable[[Any, str, Any], Any]


Cell = tuple[int, int]
"""(row, column)."""

Bound = float | Callable[..., float] | None
_DECLARED = "pharos parameter"


@dataclass(frozen=True)
class Parameter:
    """The values that a parameter may take.

    Attributes:
        kind: int, float, bool, or a Kind.
        low, high: of numbers: constants, or functions of the environment.
        optional: whether None is a value too.
        added: whether the class got it when instances were already stored by their parameters. If it has its default,
            it is not among `Environment.parameters`, so that these stay as they were.
    """

    kind: type | Kind
    low: Bound = None
    high: Bound = None
    optional: bool = False
    added: bool = False

    @property
    def is_bounded_by_others(self) -> bool:
        """Whether a bound depends on other parameters, which have to be checked first."""
        return callable(self.low) or callable(self.high)

    @property
    def text(self) -> str:
        """Type and, if constant, range as text: "integer >= 1", "number in [0, 1]", "true or false"."""
        if self.kind is bool:
            return "true or false"
        if isinstance(self.kind, Kind):
            return self.kind.text
        name = "integer" if self.kind is int else "number"
        low, high = (None if callable(bound) else bound for bound in (self.low, self.high))
        if low is not None and high is not None:
            return f"{name} in [{low:g}, {high:g}]"
        return name + (f" >= {low:g}" if low is not None else f" <= {high:g}" if high is not None else "")

    def checked(self, env: object, name: str, value: object) -> object:
        """The value converted to its stored form. ParameterError if it is out of range."""
        if value is None and self.optional:
            return None
        low, high = (bound(env) if callable(bound) else bound for bound in (self.low, self.high))
        if self.kind is int:
            return _integer(env, name, value, low, high)
        if self.kind is float:
            return _number(env, name, value, -math.inf if low is None else low, math.inf if high is None else high)
        if self.kind is bool:
            return _truth(env, name, value)
        assert isinstance(self.kind, Kind)
        return self.kind.checked(env, name, value)


def parameter(
    default: object, *, low: Bound = None, high: Bound = None, kind: type | Kind | None = None, added: bool = False
) -> Any:
    """A field of an environment's dataclass, with the values that it may take.

    Args:
        default: the value if none is passed. None as a default is not checked.
        low, high: bounds of a number, or functions of the environment if they depend on other parameters.
        kind: int, float, bool, or a Kind. Default: the type of the default.
        added: True for a parameter that a class gets when there are results of it already. If it has its default,
            what was stored before, such as built state spaces, is found again.
    """
    declared = Parameter(kind or type(default), low, high, default is None, added)
    return dataclasses.field(default=default, metadata={_DECLARED: declared})


def declared_parameters(cls: type) -> dict[str, Parameter]:
    """Name -> declaration by `parameter`. A subclass that gives another default keeps the declaration."""
    declared: dict[str, Parameter] = {}
    for base in reversed(cls.__mro__):
        for name, entry in vars(base).get("__dataclass_fields__", {}).items():
            if _DECLARED in entry.metadata:
                declared[name] = entry.metadata[_DECLARED]
    return declared


def check_parameters(env: object) -> None:
    """Check and store the parameters of an environment being made. ParameterError names the first wrong one."""
    declared = declared_parameters(type(env))
    for name in sorted(declared, key=lambda name: declared[name].is_bounded_by_others):
        store(env, name, declared[name].checked(env, name, getattr(env, name)))
    for each in dataclasses.fields(env) if dataclasses.is_dataclass(env) else ():
        if each.name not in declared:
            _check_annotated(env, each.name, each.type)


def _check_annotated(env: object, name: str, annotation: object) -> None:
    """ParameterError if a field that is annotated as bool, int or float is something else: `flag=no` is a text."""
    value, kind = getattr(env, name), getattr(annotation, "__name__", annotation)
    if value is None:
        return
    if kind == "bool" and (isinstance(value, str) or value not in (True, False)):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected true or false")
    if kind == "int" and (isinstance(value, str) or (isinstance(value, float) and not value.is_integer())):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected an integer")
    if kind == "int" and isinstance(value, float):
        store(env, name, int(value))
    if kind == "float" and isinstance(value, str):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected a number")


def store(env: object, name: str, value: T) -> T:
    """Set a field of a frozen dataclass during its construction."""
    object.__setattr__(env, name, value)
    return value


# Kinds ----------------------------------------------------------------------------------------------------------------


def integers(expected: str, allowed: Callable[[int], bool]) -> Kind:
    """Non-empty tuples of integers, from a number, a sequence, or text such as "1,2,3".

    Args:
        expected: of each, in words, such as "at least 1".
        allowed: whether an integer is.
    """

    def checked(env: object, name: str, value: object) -> tuple[int, ...]:
        try:
            if isinstance(value, str):
                values = tuple(int(part) for part in value.split(","))
            else:
                items: Iterable[Any] = value if isinstance(value, Iterable) else (value,)
                values = tuple(map(operator.index, items))
        except (TypeError, ValueError):
            values = ()
        if not values or not all(map(allowed, values)):
            raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected integers, each {expected}")
        return values

    return Kind(f"integers, each {expected}", checked)


def one_of(*names: str) -> Kind:
    """Texts, each one of `names`."""

    def checked(env: object, name: str, value: object) -> str:
        if value not in names:
            raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected {' or '.join(names)}")
        return str(value)

    return Kind(" or ".join(names), checked)


class Grid(Protocol):
    """A class with cells."""

    height: int
    width: int


def _cell(env: Grid, name: str, value: object) -> Cell:
    """A cell inside `env.height` x `env.width`, from (row, column) or text such as "3,2"."""
    try:
        row, column = map(int, value.split(",")) if isinstance(value, str) else _items(value)
        inside = 0 <= row < env.height and 0 <= column < env.width and int(row) == row and int(column) == column
    except (TypeError, ValueError):
        inside = False
    if not inside:
        raise ParameterError(
            f"{type(env).__name__}: {name} has {value!r}; "
            f"expected a cell (row, column) inside {env.height} x {env.width}"
        )
    return int(row), int(column)


def _valued_cells(env: Grid, name: str, value: object) -> tuple[tuple[Cell, float], ...]:
    """Cells with a number each, from ((row, column), number) pairs or text such as "2,2:0.1; 0,3:0.5"."""
    pairs: list[tuple[Any, Any]]
    try:
        if isinstance(value, str):
            texts = [part.split(":") for part in value.split(";") if part.strip()]
            pairs = [(cell, float(number)) for cell, number in texts]
        else:
            pairs = [(cell, number) for cell, number in _items(value)]
    except (TypeError, ValueError):
        pairs = [(None, None)]
    if not all(is_real(number) for _, number in pairs):
        raise ParameterError(
            f"{type(env).__name__}: {name}={value!r}; expected ((row, column), value) pairs, "
            f"or text such as '2,2:0.1; 0,3:0.5'"
        )
    return tuple((_cell(env, name, cell), float(number)) for cell, number in pairs)


def _cells(env: Grid, name: str, value: object) -> tuple[Cell, ...]:
    """Cells, from pairs (row, column) or text such as "0,1; 2,3"."""
    parts = [part for part in value.split(";") if part.strip()] if isinstance(value, str) else value
    if not isinstance(parts, Iterable):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected cells, such as '0,1; 2,3'")
    return tuple(_cell(env, name, part) for part in parts)


def _items(value: object) -> Iterable[Any]:
    if not isinstance(value, Iterable):
        raise TypeError(f"{value!r} has no items")
    return value


CELL = Kind("row,column", _cell)
CELLS = Kind("row,column; ...", _cells)
VALUED_CELLS = Kind("row,column:value; ...", _valued_cells)


def is_real(value: object) -> TypeGuard[float]:
    """Whether `value` is a finite real number (and not a bool)."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond 1.8e308
        return False


def _integer(env: object, name: str, value: object, low: float | None, high: float | None) -> int:
    bounds = "" if low is None else f" of at least {low}" if high is None else f" from {low} to {high}"
    try:
        number = operator.index(value) if isinstance(value, SupportsIndex) else None
    except TypeError:
        number = None
    outside = number is not None and ((low is not None and number < low) or (high is not None and number > high))
    if number is None or isinstance(value, bool) or outside:
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected an integer{bounds}")
    return int(number)


def _number(env: object, name: str, value: object, low: float, high: float) -> float:
    if not is_real(value) or not low <= value <= high:
        bounds = "" if math.isinf(low) and math.isinf(high) else f" from {low:g} to {high:g}"
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected a finite number{bounds}")
    return float(value)


def _truth(env: object, name: str, value: object) -> bool:
    if isinstance(value, str) or value not in (True, False):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected True or False")
    return bool(value)


def as_tuples(value: object) -> Any:
    """Convert nested lists to tuples, as JSON or YAML writes the parameters of a class."""
    return tuple(as_tuples(item) for item in value) if isinstance(value, list | tuple) else value


# Environments ---------------------------------------------------------------------------------------------------------


Color = tuple[int, int, int]
"""(red, green, blue), 0 to 255."""

Rows = tuple[str, ...]
Sprite = Rows | tuple[Rows, ...] | None

Margin = tuple[int, int, int, int]
"""Pixels around the cells: (top, right, bottom, left)."""

Ground = Callable[[np.ndarray, tuple[int, int], Margin], None]
"""Function(picture (H, W, 3) float64, (height, width) of a cell, margin) that paints what lies below all layers."""

Shape = Callable[[np.ndarray, int, str], np.ndarray]
"""Function(color (3,) float64, pixels of a cell, glyph) -> (cell, cell, 4): red, green, blue, cover in [0, 1]."""


@dataclass(frozen=True)
class Layer:
    """Appearance of one kind of thing. `draw` puts it on its plane. Every picture is made from the planes.

    Attributes:
        glyph: one character for text drawings, or several, one for each value 1, 2, ... on the plane.
        color: (red, green, blue), 0 to 255, or several, one for each value on the plane.
        sprite: rows of text: '#' is the colour, '.' lets the ground show through, digits 1-9 pick shades from light to
            dark. Several sprites stand for the values on the plane. None draws a full cell.
        shape: how pictures for people draw it, in place of the sprite: a name in `pharos.drawing.SHAPES`, or a function
            (see `Shape`). None: the sprite, or else the shape that is called like the layer ("ball", "agent", "holes",
            "goal", "paddle"), or else a block.
    """

    glyph: str | tuple[str, ...]
    color: Color | tuple[Color, ...]
    sprite: Sprite = None
    shape: str | Shape | None = None


@dataclass(frozen=True)
class Scenery:
    """Layout and sprites of complex images of a class, in pixels of their natural size.

    Attributes:
        cell: (height, width) of a cell.
        margin: (top, right, bottom, left) around the cells.
        ground: a name in `pharos.drawing.GROUNDS`, or a function (see `Ground`).
        sprites: name of a layer -> sprite in place of its own (see `Layer`), or None: the layer is not drawn.
        row_colors: name of a layer -> colours of rows 0, 1, ... of the grid, again from the first after the last.
    """

    cell: tuple[int, int]
    margin: Margin
    ground: str | Ground
    sprites: Mapping[str, Sprite] = field(default_factory=dict)
    row_colors: Mapping[str, tuple[Color, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Look:
    """Appearance of a class of environments beside its layers: ground, scenery, and colour in plots.

    Attributes:
        ground: of pictures for people: a name in `pharos.drawing.GROUNDS`, or a function (see `Ground`).
        scenery: of complex images. Default: square cells on `ground`, with the sprites and shapes of the layers.
        color: of the class in plots, such as "#0072B2". Default: one that no other class has.
    """

    ground: str | Ground = "plain"
    scenery: Scenery | None = None
    color: str | None = None


State = tuple[int, ...]
Ranges = Any  # range, or a nested sequence of ranges


@dataclass(frozen=True)
class Components:
    """The D components of a state vector, derived from `Environment.variables`.

    Attributes:
        names: D names, such as `row` or `bricks[0,3]`.
        variables: name of a variable -> slice of the state vector.
        low, size: (D,) int64. Component i takes the values low[i], ..., low[i] + size[i] - 1.
    """

    names: tuple[str, ...]
    variables: Mapping[str, slice]
    low: np.ndarray
    size: np.ndarray

    @property
    def high(self) -> np.ndarray:
        """(D,) int64, the largest value of each component."""
        return self.low + self.size - 1

    def __len__(self) -> int:
        return len(self.names)


class Environment:
    """Base class of environments: a frozen dataclass of parameters, and pure functions of one state.

    A subclass is decorated with `@dataclass(frozen=True, kw_only=True)` and defines:

    Class attributes
        name: str                   the name users type, such as "breakout"
        actions: tuple[str, ...]    names of the A actions, the integers 0 .. A-1; an attribute or a property
        version: int                raised when a transition or reward changes, never for a refactoring
        max_episode_steps: int      the time limit that the Gymnasium environments use unless told otherwise;
                                    an attribute or a property
        layers: dict[str, Layer]    how each plane of `draw` looks. Later layers cover earlier ones

    Class attributes that may be left out
        look: Look                  the ground below the layers, the screen of complex images, the colour in plots
        instances: dict             name -> parameters: `make("breakout/12x8x1")` and "pharos/Breakout-12x8x1-v0"
        paper_instances: tuple      names of instances in the tables of the pharos paper, in their order
        hyperparameters: dict       agent -> observation, or "default" for all -> values that suit the class; they
                                    override `Agent.defaults`
        foreign_parameters: dict    name that other libraries have -> what to do here instead; for the error message
        numbered_by: tuple          variables by which the source numbers its states, the last one fastest, as Gymnasium
                                    does; for the observation `number`
        motion_layers: dict         how each plane of `draw_motion` looks; an attribute or a property
        first_version: int          the `version` that the Gymnasium id pharos/ClassName-v0 stands for
        outcomes: int               K, how many outcomes an action has at most: of classes with chance; an attribute or
                                    a property. 1 in the base class
        residual: tuple             of an imported MDP: what its source leaves open, see `mdp.Residual`

    Parameters are the fields of the dataclass. `parameter(12, low=4)` as a default declares what they may be.

    Methods that describe an instance (ordinary Python)
        validate(self)              raises ParameterError if parameters do not go together
        variables(self)             name -> range, or a nested sequence of ranges for an array of variables
        initial_state(self)         the start state, a sequence of D integers;
                                    or `initial_states`: several of them with their probabilities
        grid(self)                  (rows, columns) of the drawing

    Methods that are the rules (compiled by Numba where possible; one state, plain branches, integers)
        transition(self, state, action, out)        `out` holds a copy of `state`: write what changes
        is_terminal(self, state) -> bool            the episode has ended in `state`
        reward(self, state, action, next_state)     the reward of a transition, a float
        draw(self, state, planes)                   planes (L, rows, columns) uint8, zero: write 1, 2, ... at things

    Methods that are the rules of a class with chance: it defines `probability`, and its `transition` takes the outcome
        probability(self, state, action, outcome)   of outcome 0 .. K-1, a float; 0: it is impossible here. They sum to
                                                    1 over the outcomes, up to 1e-9
        transition(self, state, action, outcome, out)    where this outcome leads; asked for possible ones only
        reward(self, state, action, next_state, outcome)    if outcomes that lead to the same state pay different
                                    rewards; otherwise use the shorter form. Outcome -1: the action has no effect
                                    (`lazy`), and next_state is the state

    Rules that may be left out
        draw_motion(self, state, planes)    what one picture of `draw` does not show, such as where a ball comes from:
                                    planes (M, rows, columns) uint8, zero, for the M motion_layers. Images have it with
                                    `motion=True`; with it no two states should look alike
        age(self, state) -> int     a number that every transition out of a state that is not terminal increases, such
                                    as the steps taken: values are then solved in one backward pass
        is_available(self, state, action) -> bool    whether an action exists in a state; one or more do in each that is
                                    not terminal. `transition`, `reward` and `probability` are never asked for others:
                                    an action that does not exist acts as the first one that does

    In compiled rules `self` offers the numeric fields of the dataclass and the numeric properties of the class
    (numbers, tuples of numbers, arrays), under the same names; it has no methods. Call module-level functions instead:
    pharos compiles those that a rule mentions. Rules never change `state`, and draw no lots, and use neither time nor
    anything global that varies. An outcome is a number that the rule is given, so `transition` is deterministic, too.
    """

    name: ClassVar[str]
    actions: ClassVar[tuple[str, ...]]
    version: ClassVar[int] = 1
    layers: ClassVar[dict[str, Layer]] = {}
    look: ClassVar[Look] = Look()
    instances: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    paper_instances: ClassVar[tuple[str, ...]] = ()
    hyperparameters: ClassVar[Mapping[str, Mapping[str, Mapping[str, Any]]]] = {}
    foreign_parameters: ClassVar[Mapping[str, str]] = {}
    first_version: ClassVar[int] = 1
    residual: ClassVar[tuple[float, float]] = (0.0, 0.0)
    numbered_by: ClassVar[tuple[str, ...]] = ()
    is_filled: ClassVar[bool] = False
    """Whether the rules answer for actions that are not available as for the first one that is."""

    if TYPE_CHECKING:  # attributes, or properties

        @property
        def max_episode_steps(self) -> int: ...

        @property
        def motion_layers(self) -> Mapping[str, Layer]: ...

        @property
        def outcomes(self) -> int: ...
    else:
        max_episode_steps = 1000
        motion_layers = {}
        outcomes = 1

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.is_available is not Environment.is_available and not cls.is_filled:
            act_as_available(cls)

    def __post_init__(self) -> None:
        check_parameters(self)
        self.validate()

    # What an instance is ----------------------------------------------------------------------------------------------

    def validate(self) -> None:
        """Raise ParameterError if parameters do not go together. Each has been checked against its declaration."""

    def variables(self) -> Mapping[str, Ranges]:
        """Name -> range of values, or a nested sequence of ranges for an array of variables (flattened in C order)."""
        raise NotImplementedError(f"{type(self).__name__} must define variables()")

    def initial_state(self) -> Sequence[int]:
        """The state in which every episode starts."""
        raise NotImplementedError(f"{type(self).__name__} must define initial_state() or initial_states()")

    def initial_states(self) -> Sequence[tuple[Sequence[int], float]]:
        """The start states with their probabilities, which sum to 1."""
        return [(self.initial_state(), 1.0)]

    def grid(self) -> tuple[int, int]:
        """(rows, columns) of the drawing."""
        raise NotImplementedError(f"{type(self).__name__} must define grid() to be drawn")

    # The rules --------------------------------------------------------------------------------------------------------

    if TYPE_CHECKING:
        transition: Callable[..., None]  # takes (state, action, out), or (state, action, outcome, out)
    else:

        def transition(self, state, action, out) -> None:
            """Write into `out`, a copy of `state`, what `action` changes."""
            raise NotImplementedError(f"{type(self).__name__} must define transition()")

    def probability(self, state, action, outcome) -> float:
        """The probability of an outcome of `action` in `state`; 0 where it is impossible. Here: there is but one."""
        return 1.0 if outcome == 0 else 0.0

    def age(self, state) -> int:
        """A number that every transition out of a state that is not terminal increases."""
        raise NotImplementedError(f"{type(self).__name__} defines no age()")

    def is_terminal(self, state) -> bool:
        """Whether the episode has ended in `state`. The base class never ends."""
        return False

    def is_available(self, state, action) -> bool:
        """Whether `action` exists in `state`, which is not terminal. In the base class all do."""
        return True

    if TYPE_CHECKING:
        reward: Callable[..., float]  # takes (state, action, next_state), or (state, action, next_state, outcome)
    else:

        def reward(self, state, action, next_state) -> float:
            """The reward of going from `state` to `next_state` by `action`."""
            raise NotImplementedError(f"{type(self).__name__} must define reward()")

    def draw(self, state, planes) -> None:
        """Write 1, 2, ... into planes (L, rows, columns) uint8 where the thing of each layer is."""
        raise NotImplementedError(f"{type(self).__name__} must define draw() to be drawn")

    def picture(self, state) -> np.ndarray | None:
        """A picture of `state` for people, (H, W, 3) uint8, in place of the drawing. Here None: there is no other."""
        return None

    def draw_motion(self, state, planes) -> None:
        """Write 1, 2, ... into planes (M, rows, columns) uint8: what `draw` does not tell of the state."""

    @property
    def recorded(self) -> "np.ndarray | DistinctRows | None":
        """(states, ...) recorded observation of each state, for the observation "recorded". The base class has None."""
        return None

    @property
    def num_numbered(self) -> int:
        """Number of states that the source numbers by `numbered_by`, in the observation `number`."""
        variables, size = self.components.variables, self.components.size
        return math.prod(int(size[variables[name]].prod()) for name in self.numbered_by)

    # Derived ----------------------------------------------------------------------------------------------------------

    @property
    def num_actions(self) -> int:
        """A, the number of actions."""
        return len(self.actions)

    @classmethod
    def takes_outcomes(cls) -> bool:
        """Whether the rule of this class is `transition(self, state, action, outcome, out)`."""
        return cls.probability is not Environment.probability

    @classmethod
    def pays_by_outcome(cls) -> bool:
        """Whether the rule of this class is `reward(self, state, action, next_state, outcome)`."""
        return num_arguments(cls.reward) == 5

    @property
    def has_chance(self) -> bool:
        """Whether an action may have several outcomes in this instance.

        Raises:
            RuleError: `outcomes` is no integer of at least 1, or is more than 1 in a class without `probability`.
        """
        outcomes = self.outcomes
        if not isinstance(outcomes, int | np.integer) or isinstance(outcomes, bool) or outcomes < 1:
            raise RuleError(f"{self}: outcomes is {outcomes!r}; expected an integer of at least 1")
        if outcomes > 1 and not self.takes_outcomes():
            raise RuleError(f"{self}: outcomes is {outcomes}, but {type(self).__name__} defines no probability()")
        return bool(outcomes > 1)

    @property
    def has_age(self) -> bool:
        """Whether the class defines `age`."""
        return type(self).age is not Environment.age

    @property
    def has_sets(self) -> bool:
        """Whether some actions may not be available in some states: whether the class defines `is_available`."""
        return type(self).is_available is not Environment.is_available

    @property
    def has_motion(self) -> bool:
        """Whether the class defines `draw_motion`."""
        return type(self).draw_motion is not Environment.draw_motion

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters of this instance, in the order of the dataclass, JSON-able.

        Without those that were `added` to the class and have their default: see `parameter`.
        """
        added = {name for name, declared in declared_parameters(type(self)).items() if declared.added}
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        values = {field.name: getattr(self, field.name) for field in fields}
        return {f.name: values[f.name] for f in fields if f.name not in added or values[f.name] != f.default}

    @cached_property
    def components(self) -> Components:
        """The D components of a state vector, with their names and ranges."""
        names: list[str] = []
        ranges: list[range] = []
        slices: dict[str, slice] = {}
        for variable, declared in self.variables().items():
            start = len(names)
            for index, values in _flattened(declared):
                if not isinstance(values, range) or values.step != 1 or not values:
                    raise ParameterError(
                        f"{self}: variable {variable!r} is declared as {capped(declared)}; "
                        f"expected a non-empty range with step 1, or a nested sequence of such ranges"
                    )
                if values.start < -(2**63) or values.stop > 2**63 or values.stop - values.start >= 2**63:
                    raise ParameterError(
                        f"{self}: variable {variable!r} is declared as {values!r}; "
                        f"expected integers of 64 bits, and at most 2^63 - 1 values"
                    )
                names.append(variable + (f"[{','.join(map(str, index))}]" if index else ""))
                ranges.append(values)
            slices[variable] = slice(start, len(names))
        if not names:
            raise ParameterError(f"{self}: variables() declares nothing; a state needs at least one variable")
        low = np.array([values.start for values in ranges], np.int64)
        size = np.array([values.stop - values.start for values in ranges], np.int64)
        low.flags.writeable = size.flags.writeable = False
        return Components(tuple(names), slices, low, size)

    def next_state(self, state: Sequence[int], action: int, outcome: int = 0) -> State:
        """The state after `action` in `state`, terminal ones included; interpreted: for reading, testing, drawing.

        Args:
            outcome: which one of a class with chance, whether it is possible in `state` or not; else 0.
        """
        out = list(state)
        if self.takes_outcomes():
            self.transition(tuple(state), action, outcome, out)
        elif outcome == 0:
            self.transition(tuple(state), action, out)
        else:
            raise ParameterError(f"{self}: an action has one outcome; found outcome {outcome}, expected 0")
        return tuple(int(value) for value in out)

    def reward_of(self, state: object, action: int, next_state: object, outcome: int = 0) -> float:
        """Reward of a step, for either form of `reward` that a class may have; interpreted."""
        if type(self).pays_by_outcome():
            return self.reward(state, action, next_state, outcome)
        return self.reward(state, action, next_state)

    def drawn_outcome(self, state: Sequence[int], action: int, u: float) -> int:
        """Outcome drawn by a uniform number u in [0, 1): those before it have total probability <= u; interpreted."""
        drawn, passed = 0, 0.0
        for outcome in range(self.outcomes if self.has_chance else 0):
            likely = float(self.probability(tuple(state), action, outcome))
            if likely > 0 and passed <= u:
                drawn, passed = outcome, passed + likely
        return drawn

    def __str__(self) -> str:
        fields = ", ".join(f"{name}={value!r}" for name, value in self.parameters.items())
        return f"{type(self).__name__}({fields})"


def act_as_available(cls: type[Environment]) -> None:
    """Replace the rules of a class by those in which an action that is not available acts as the first one that is."""
    is_available: Any = cls.is_available

    def acting(self, state, action):
        if is_available(self, state, action):
            return action
        for other in range(self.num_actions):
            if is_available(self, state, other):
                return other
        return action

    for name in ("transition", "reward", "probability"):
        rule = getattr(cls, name)
        rule = getattr(rule, "of_available", rule)
        if rule is not getattr(Environment, name):
            guarded = _guarded(name, num_arguments(rule), rule, acting)
            guarded.of_available = rule
            setattr(cls, name, guarded)


def _guarded(name: str, arguments: int, rule: Any, acting: Any) -> Any:
    """A rule that is asked for what actions act as, with the arguments that it has."""

    def transition(self, state, action, out):
        rule(self, state, acting(self, state, action), out)

    def transition_of_outcome(self, state, action, outcome, out):
        rule(self, state, acting(self, state, action), outcome, out)

    def reward(self, state, action, next_state):
        return rule(self, state, acting(self, state, action), next_state)

    def reward_of_outcome(self, state, action, next_state, outcome):
        return rule(self, state, acting(self, state, action), next_state, outcome)

    def probability(self, state, action, outcome):
        return rule(self, state, acting(self, state, action), outcome)

    if name == "probability":
        return probability
    if name == "reward":
        return reward_of_outcome if arguments == 5 else reward
    return transition_of_outcome if arguments == 5 else transition


@cache
def num_arguments(rule: Callable[..., object]) -> int:
    """Number of positional arguments of a rule, `self` among them. 0 if Python does not say."""
    try:
        parameters = inspect.signature(rule).parameters.values()
    except (TypeError, ValueError):
        return 0
    return sum(each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD) for each in parameters)


def start_distribution(env: Environment) -> tuple[list[State], np.ndarray]:
    """The start states, each once, and their probabilities. ParameterError if they are not a distribution."""
    merged: dict[State, float] = {}
    components = env.components
    for state, probability in env.initial_states():
        values = np.asarray(state)
        if values.shape != (len(components),):
            raise ParameterError(
                f"{env}: start state {tuple(state)} has {values.size} components; expected {len(components)}"
            )
        if values.dtype.kind not in "iub":
            i = next(i for i, value in enumerate(state) if not isinstance(value, int | np.integer))
            raise ParameterError(
                f"{env}: start state {tuple(state)} has {components.names[i]} = {state[i]!r}; expected an integer"
            )
        outside = np.flatnonzero((values < components.low) | (values > components.high))
        if outside.size:
            i = int(outside[0])
            raise ParameterError(
                f"{env}: start state {tuple(state)} has {components.names[i]} = {values[i]}; "
                f"expected {components.low[i]} to {components.high[i]}"
            )
        if not (math.isfinite(probability) and probability > 0):
            raise ParameterError(
                f"{env}: start state {tuple(state)} has probability {probability}; expected one in (0, 1]"
            )
        key = tuple(int(value) for value in state)
        merged[key] = merged.get(key, 0.0) + float(probability)
    if not merged or abs(sum(merged.values()) - 1) > 1e-9:
        raise ParameterError(f"{env}: probabilities of the start states sum to {sum(merged.values())}; expected 1")
    return list(merged), np.array(list(merged.values()))


def _flattened(declared: Ranges, index: tuple[int, ...] = ()):
    if isinstance(declared, Sequence) and not isinstance(declared, range | str):
        for i, inner in enumerate(declared):
            yield from _flattened(inner, (*index, i))
    else:
        yield index, declared
