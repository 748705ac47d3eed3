"""What the parameters of a class may be: declared in the fields of its dataclass, and checked when an instance is made.

height: int = parameter(12, low=4)
restart_on_hit: bool = parameter(True)
car_speeds: tuple[int, ...] = parameter(None, kind=integers("at least 1", lambda period: period >= 1))
"""

import dataclasses
import math
import numbers
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol, SupportsIndex, TypeGuard, TypeVar

from pharos.errors import ParameterError

T = TypeVar("T")


@dataclass(frozen=True)
class Kind:
    """A kind of values beside numbers and truths.

    Attributes:
        text: how a value is written on the command line, such as "row,column".
        checked: function(environment, name of the parameter, value) -> the value as it is stored; raises
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
        low, high: of numbers; constants, or functions of the environment.
        optional: whether None is a value too.
        added: whether it came after instances had been kept by their parameters: where it has its default, it is not
            among `Environment.parameters`, so that these stay what they were.
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
        """The type, and the range where it is constant: "integer >= 1", "number in [0, 1]", "true or false"."""
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
        """The value as it is stored; ParameterError where it is out of range."""
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
        default: the value when none is given; None as a default is a value that is not checked.
        low, high: bounds of a number; functions of the environment where they depend on other parameters.
        kind: int, float, bool, or a Kind; None: the type of the default.
        added: True for a parameter that a class gets when there are results of it already: what is kept by the
            parameters of an instance, such as built state spaces, is found again where the new one has its default.
    """
    declared = Parameter(kind or type(default), low, high, default is None, added)
    return dataclasses.field(default=default, metadata={_DECLARED: declared})


def declared_parameters(cls: type) -> dict[str, Parameter]:
    """Name -> what `parameter` declared. A subclass that gives another default keeps the declaration."""
    declared: dict[str, Parameter] = {}
    for base in reversed(cls.__mro__):
        for name, field in vars(base).get("__dataclass_fields__", {}).items():
            if _DECLARED in field.metadata:
                declared[name] = field.metadata[_DECLARED]
    return declared


def check_parameters(env: object) -> None:
    """Check and store the parameters of an environment being made; ParameterError names the first wrong one."""
    declared = declared_parameters(type(env))
    for name in sorted(declared, key=lambda name: declared[name].is_bounded_by_others):
        store(env, name, declared[name].checked(env, name, getattr(env, name)))


def store(env: object, name: str, value: T) -> T:
    """Set a field of a frozen dataclass while it is being made."""
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
            pairs = [(place, float(number)) for place, number in texts]
        else:
            pairs = [(place, number) for place, number in _items(value)]
    except (TypeError, ValueError):
        pairs = [(None, None)]
    if not all(is_real(number) for _, number in pairs):
        raise ParameterError(
            f"{type(env).__name__}: {name}={value!r}; expected ((row, column), value) pairs, "
            f"or text such as '2,2:0.1; 0,3:0.5'"
        )
    return tuple((_cell(env, name, place), float(number)) for place, number in pairs)


def _cells(env: Grid, name: str, value: object) -> tuple[Cell, ...]:
    """Cells, from pairs (row, column) or text such as "0,1; 2,3"."""
    places = [part for part in value.split(";") if part.strip()] if isinstance(value, str) else value
    if not isinstance(places, Iterable):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected cells, such as '0,1; 2,3'")
    return tuple(_cell(env, name, place) for place in places)


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
    """Lists as tuples, all the way down: parameters as JSON or YAML writes them become those of a class."""
    return tuple(as_tuples(item) for item in value) if isinstance(value, list | tuple) else value
