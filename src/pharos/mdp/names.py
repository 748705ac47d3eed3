"""Names of states and actions, and sets of states by labels and by expressions over variables.

The expressions follow PRISM's language without functions: comparisons of sums and products of whole numbers and
variables, joined by & | ! and parentheses. They are parsed, never executed.

Source: Kwiatkowska, Norman and Parker (2011), "PRISM 4.0", and its manual, section "Expressions", for what binds
stronger.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pharos.errors import ParameterError, UnknownName
from pharos.system.wording import capped

if TYPE_CHECKING:
    from pharos.mdp.tabular import TabularMDP
    from pharos.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class Names:
    """Names of the S states and A actions of an MDP.

    Attributes:
        labels: name -> (S,) bool, the states that have the label.
        variables: name -> (S,) integers or bool, the value of a variable in each state.
        actions: (A,) names of the actions, if they have the same one in each state. None: they are numbers.
        choices: (S, A) positions in `choice_names`, if names of actions differ between states. -1: see actions.
    """

    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    variables: Mapping[str, np.ndarray] = field(default_factory=dict)
    actions: tuple[str, ...] | None = None
    choices: np.ndarray | None = None
    choice_names: tuple[str, ...] = ()

    def of(self, states: np.ndarray) -> "Names":
        """The names of some states, in their order."""
        columns = self.variables
        variables = (
            columns.of(states)
            if isinstance(columns, SpaceColumns)
            else {name: np.asarray(column)[states] for name, column in columns.items()}
        )
        return replace(
            self,
            labels={name: mask[states] for name, mask in self.labels.items()},
            variables=variables,
            choices=None if self.choices is None else self.choices[states],
        )

    def action(self, state: int, action: int) -> str:
        """Name of an action in a state, or its number if it has none."""
        if self.choices is not None and (code := int(self.choices[state, action])) >= 0:
            return self.choice_names[code]
        return str(action) if self.actions is None else self.actions[action]

    def state(self, state: int) -> str:
        """The values of the variables, such as "x=3 y=0 done=true", or "" if there are none."""
        return " ".join(f"{name}={_written(column[state])}" for name, column in self.variables.items())

    def labels_of(self, state: int) -> list[str]:
        """Names of the labels of a state."""
        return [name for name, mask in self.labels.items() if mask[state]]

    def states_where(self, expression: str, num_states: int) -> np.ndarray:
        """(S,) bool: the states of a label, or those in which an expression holds.

        An expression has labels ("goal", or goal if no variable has this name), comparisons of variables and whole
        numbers by = != < <= > >= and + - *, variables that are true or false, and & | ! with parentheses. As in PRISM,
        ! binds weaker than comparisons: !x=3 is !(x=3).

        Raises:
            ParameterError: it is none. UnknownName: it names something else. The message lists what there is.
        """
        if expression in self.labels:
            return np.array(self.labels[expression], np.bool_)
        return np.broadcast_to(Parser(expression, self).truth(), (num_states,)).copy()

    @property
    def in_words(self) -> str:
        """Targets that there are: "terminal; labels done, goal; variables x (0 to 7), open (true, false)"."""
        ranges = [f"{name} ({_range_in_words(column)})" for name, column in self.variables.items()]
        parts = ["terminal"]
        parts += [f"labels {', '.join(sorted(self.labels))}"] if self.labels else []
        parts += [f"variables {', '.join(ranges)}"] if ranges else []
        return capped("; ".join(parts), 1000)


def names_of(mdp: "TabularMDP") -> Names:
    """The names that an MDP came with, else the variables and actions of the state space that it is of."""
    if mdp.names is not None:
        return mdp.names
    if mdp.space is None:
        return Names()
    env = mdp.space.environment
    return Names(variables=SpaceColumns(mdp.space), actions=None if env is None else tuple(env.actions))


def names_from(
    labels: Mapping[str, object],
    variables: Mapping[str, object],
    actions: Sequence[str] | None,
    shape: tuple[int, int],
) -> Names:
    """Names from what a user gives. ParameterError if they do not fit (S, A) states and actions."""
    num_states, num_actions = shape
    masks = {name: _label_mask(name, each, num_states) for name, each in labels.items()}
    columns = {name: np.asarray(each) for name, each in variables.items()}
    for name, column in columns.items():
        if column.shape != (num_states,) or column.dtype.kind not in "biu":
            raise ParameterError(
                f"variable {name}: has shape {column.shape} and type {column.dtype}; expected {num_states} integers or "
                "bool"
            )
    if actions is not None and (len(actions) != num_actions or not all(isinstance(a, str) and a for a in actions)):
        raise ParameterError(f"actions are {actions!r}; expected {num_actions} names")
    return Names(masks, columns, None if actions is None else tuple(actions))


def _label_mask(name: str, states: object, num_states: int) -> np.ndarray:
    array = np.asarray(states)
    if array.dtype == np.bool_ and array.shape == (num_states,):
        return array
    if array.size and (array.dtype.kind not in "iu" or array.ndim > 1 or array.min() < 0 or array.max() >= num_states):
        raise ParameterError(
            f"label {name}: is {array.dtype} of shape {array.shape}; expected ({num_states},) bool, or indices of "
            f"states from 0 to {num_states - 1}"
        )
    mask = np.zeros(num_states, np.bool_)
    mask[array.astype(np.int64)] = True
    return mask


class SpaceColumns(Mapping[str, np.ndarray]):
    """The variables of a state space by name, each unpacked when it is asked for."""

    def __init__(self, space: "StateSpace"):
        self.space = space

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.space.component_names:
            raise KeyError(name)
        return self.space.column(self.space.component_names.index(name))

    def __iter__(self) -> Iterator[str]:
        return iter(self.space.component_names)

    def __len__(self) -> int:
        return len(self.space.component_names)

    def of(self, states: np.ndarray) -> dict[str, np.ndarray]:
        """The values in some states alone."""
        return dict(zip(self.space.component_names, self.space.states(states).T, strict=True))


def _written(value: object) -> str:
    return str(value).lower() if isinstance(value, bool | np.bool_) else str(value)


def _range_in_words(column: np.ndarray) -> str:
    return "true, false" if column.dtype == np.bool_ else f"{column.min()} to {column.max()}"


# Expressions ----------------------------------------------------------------------------------------------------------


TOKEN = re.compile(r'\s*(?:([A-Za-z_]\w*)|(\d+)|"([^"]*)"|(!=|<=|>=|[=<>&|!()+*-]))')
COMPARISONS = {
    "=": np.equal,
    "!=": np.not_equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}
MOST_PARENTHESES, MOST_CHARACTERS = 40, 10_000
"""Parentheses within each other, and characters, of an expression."""
LARGEST_NUMBER = 2**62
"""What numbers of an expression stay below, in size: so nothing overflows."""


class Term(NamedTuple):
    """A number or truth in each state.

    Attributes:
        values: () or (S,) int64 or bool. size: of integers, a bound on their absolute values. text: what it is of.
    """

    values: np.ndarray
    size: int
    text: str

    @property
    def is_number(self) -> bool:
        return self.values.dtype != np.bool_


class Parser:
    """Recursive descent over an expression that computes the set of states on the way."""

    def __init__(self, text: str, names: Names):
        self.text, self.names, self.index, self.depth = text, names, 0, 0
        self.tokens = self._tokens()

    def truth(self) -> np.ndarray:
        """(S,) or () bool. ParameterError if the text is no expression."""
        result = self._either()
        if self.index < len(self.tokens):
            raise self._error(f"{self._shown()} after {capped(result.text, 60)!r}", "& or | between two conditions")
        return self._truth(result)

    # From the weakest to what binds most ------------------------------------------------------------------------------

    def _either(self) -> Term:
        return self._joined("|", self._both, np.logical_or)

    def _both(self) -> Term:
        return self._joined("&", self._denied, np.logical_and)

    def _joined(self, sign: str, part: Callable[[], Term], join: np.ufunc) -> Term:
        left = part()
        while self._takes(sign):
            right = part()
            left = Term(join(self._truth(left), self._truth(right)), 0, f"{left.text} {sign} {right.text}")
        return left

    def _denied(self) -> Term:
        count = 0
        while self._takes("!"):
            count += 1
        term = self._compared()
        return term if not count else Term(self._truth(term) ^ bool(count % 2), 0, "!" * count + term.text)

    def _compared(self) -> Term:
        left = self._sum()
        sign = next((each for each in COMPARISONS if self._takes(each)), None)
        if sign is None:
            return left
        right = self._sum()
        text = f"{left.text}{sign}{right.text}"
        if left.is_number != right.is_number:
            left, right = (Term(self._truth(each), 0, each.text) for each in (left, right))
        if not left.is_number and sign not in ("=", "!="):
            raise self._error(f"{text!r}, whose sides are true or false", "= or !=")
        return Term(COMPARISONS[sign](left.values, right.values), 0, text)

    def _sum(self) -> Term:
        left = self._product()
        while (sign := self._takes("+") or self._takes("-")) is not None:
            right = self._product()
            operation = np.add if sign == "+" else np.subtract
            left = self._computed(operation, left, right, left.size + right.size, sign)
        return left

    def _product(self) -> Term:
        left = self._signed()
        while self._takes("*"):
            right = self._signed()
            left = self._computed(np.multiply, left, right, left.size * right.size, "*")
        return left

    def _signed(self) -> Term:
        is_negated = self._takes("-") is not None
        term = self._atom()
        return Term(-self._numbers(term), term.size, f"-{term.text}") if is_negated else term

    def _atom(self) -> Term:
        kind, word = self.tokens[self.index] if self.index < len(self.tokens) else ("end", "")
        self.index += 1
        if kind == "number":
            return Term(np.array(int(word), np.int64), int(word), word)
        if kind == "label":
            if word not in self.names.labels:
                raise self._unknown("label", word)
            return Term(self.names.labels[word], 0, f'"{word}"')
        if kind == "name":
            return self._named(word)
        if word == "(":
            self.depth += 1
            if self.depth > MOST_PARENTHESES:
                raise self._error(f"{self.depth} parentheses within each other", f"at most {MOST_PARENTHESES}")
            inner = self._either()
            self.depth -= 1
            if not self._takes(")"):
                raise self._error(self._shown(), "a closing parenthesis")
            return inner._replace(text=f"({inner.text})")
        self.index -= 1
        raise self._error(self._shown(), "a variable, a label, a number or a parenthesis")

    def _named(self, word: str) -> Term:
        if word in self.names.variables:
            column = np.asarray(self.names.variables[word])
            if column.dtype == np.bool_:
                return Term(column, 0, word)
            size = max(abs(int(column.min(initial=0))), abs(int(column.max(initial=0))))
            if size > LARGEST_NUMBER:
                raise self._error(f"{word}, whose values are up to {size}", f"at most {LARGEST_NUMBER}")
            return Term(column.astype(np.int64), size, word)
        if word in self.names.labels:
            return Term(self.names.labels[word], 0, word)
        if word in ("true", "false"):
            return Term(np.array(word == "true"), 0, word)
        raise self._unknown("label or variable", word)

    # Kinds ----------------------------------------------------------------------------------------------------------

    def _truth(self, term: Term) -> np.ndarray:
        """The truth of a term. A variable that is only 0 or 1 is true if it is 1."""
        if not term.is_number:
            return term.values
        if term.values.ndim and term.size <= 1 and term.values.min(initial=0) >= 0:
            return term.values == 1
        raise self._error(f"{capped(term.text, 60)!r}, which is a number", "a condition, such as x=3")

    def _numbers(self, term: Term) -> np.ndarray:
        if not term.is_number:
            raise self._error(f"{capped(term.text, 60)!r}, which is true or false", "a number")
        return term.values

    def _computed(self, operation: np.ufunc, left: Term, right: Term, size: int, sign: str) -> Term:
        text = f"{left.text}{sign}{right.text}"
        a, b = self._numbers(left), self._numbers(right)
        if size > LARGEST_NUMBER:
            raise self._error(
                f"{capped(text, 60)!r}, which may be as large as {size:.3g}", f"at most {LARGEST_NUMBER:.3g}"
            )
        return Term(operation(a, b), size, text)

    # Words ----------------------------------------------------------------------------------------------------------

    def _tokens(self) -> list[tuple[str, str]]:
        text, index, tokens = self.text.rstrip(), 0, []
        if len(text) > MOST_CHARACTERS:
            raise ParameterError(f"expression of {len(text):,} characters; expected at most {MOST_CHARACTERS:,}")
        while index < len(text):
            match = TOKEN.match(text, index)
            if match is None:
                raise self._error(
                    f"{text[index:].strip()[0]!r}", "names, whole numbers, = != < <= > >= & | ! + - * and ( )"
                )
            kind = ("name", "number", "label", "sign")[match.lastindex - 1]  # type: ignore[operator]
            word = match[match.lastindex]  # type: ignore[index]
            if kind == "number" and len(word) > 18:
                raise self._error(capped(word, 40), f"numbers of at most {LARGEST_NUMBER:.3g}")
            tokens.append((kind, word))
            index = match.end()
        return tokens

    def _takes(self, sign: str) -> str | None:
        if self.index < len(self.tokens) and self.tokens[self.index] == ("sign", sign):
            self.index += 1
            return sign
        return None

    def _shown(self) -> str:
        return repr(self.tokens[self.index][1]) if self.index < len(self.tokens) else "its end"

    def _error(self, what: str, expected: str) -> ParameterError:
        return ParameterError(f"expression {capped(self.text, 120)!r}: found {what}; expected {expected}")

    def _unknown(self, kind: str, word: str) -> ParameterError:
        return UnknownName(kind, capped(word, 60), (), f"there are {self.names.in_words}")
