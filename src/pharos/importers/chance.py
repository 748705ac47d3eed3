"""Random generators that branch: each draw of an environment's step is enumerated with its exact probability.

An environment gets `BranchingGenerator` in the place of its generators. The same step is then run once for each way in
which its draws can come out, depth first. A draw of `random()` stays a range of numbers, which only comparisons narrow:
`u < p` splits it in two, with the probabilities of the two parts. Whatever needs the number itself is refused.
"""

import bisect
import functools
import itertools
import math
import random as python_random
import sys
from collections.abc import Callable, Iterable, Iterator, MutableSequence, Sequence
from fractions import Fraction
from types import FrameType
from typing import Any, NoReturn, SupportsFloat

import numpy as np
import numpy.typing as npt

from pharos.errors import RuleError

MOST_PATH_DRAWS = 200
"""Draws with several outcomes in one step; more are taken for a rejection that never ends."""
MOST_DRAW_OUTCOMES = 3_000
"""Ways in which the draws of one step may come out."""
HIDDEN = ("pharos/importers/", "/numpy/", "site-packages/jax/", "<frozen", "<string>", "/random.py", "/functools.py")
"""Parts of the paths of files that are no code of an environment."""

ONE = Fraction(1)


class DrawError(RuleError):
    """A draw whose outcomes cannot be enumerated."""


def line_of_code(frame: FrameType | None = None) -> str:
    """The innermost line of the environment's code that is running, file and number; "" if there is none."""
    frame = frame or sys._getframe(1)
    while frame is not None:
        path = frame.f_code.co_filename.replace("\\", "/")
        if not any(part in path for part in HIDDEN):
            return f"{path.rpartition('/')[2]}, line {frame.f_lineno}"
        frame = frame.f_back
    return ""


def placed(text: str, line: str) -> str:
    """A text with a line of code behind it, if there is one."""
    return f"{text} ({line})" if line else text


class DrawTree:
    """Outcomes of the draws of a step, enumerated depth first.

    Args:
        most: runs of one step; more are an error.
    Attributes:
        probability: of the run that goes on, as an exact fraction.
        sampler: draws one outcome at random in place of enumerating, if it is set.
        refusal: of the last draw that was refused, which the environment's code may have caught.
    """

    def __init__(self, most: int = MOST_DRAW_OUTCOMES):
        self.most = most
        self.probability = ONE
        self.sampler: python_random.Random | None = None
        self.refusal: DrawError | None = None
        self._choices: list[int] = []
        self._sizes: list[int] = []
        self._depth = 0

    @property
    def script(self) -> tuple[int, ...]:
        """The outcomes that the draws of this run had, among the possible ones."""
        return tuple(self._choices[: self._depth])

    def runs(self) -> Iterator[None]:
        """Yield once for each run, until all outcomes had their turn.

        Raises:
            DrawError: there are more than `most`.
        """
        self._choices, self._sizes = [], []
        total = Fraction(0)
        for _ in range(self.most):
            self._depth, self.probability = 0, ONE
            yield
            total += self.probability
            while self._choices and self._choices[-1] + 1 == self._sizes[-1]:
                self._choices.pop()
                self._sizes.pop()
            if not self._choices:
                return
            self._choices[-1] += 1
        raise DrawError(
            f"one action has more than {self.most:,} outcomes, {float(total):.0%} of the probability so far: rejection "
            f"sampling or a shuffle? start from one layout with a seed (--seed 0), or replace the draw"
        )

    def refused(self, text: str) -> DrawError:
        """An error for the environment's code, which is kept, as that code may catch it."""
        self.refusal = DrawError(text)
        return self.refusal

    def check(self) -> None:
        """Raise the error of a draw that was refused, if there was one."""
        refusal, self.refusal = self.refusal, None
        if refusal is not None:
            raise refusal

    def replay(self, script: Sequence[int]) -> None:
        """Let the next draws come out as they did in a run with this script."""
        self._choices, self._sizes = list(script), [0] * len(script)
        self._depth, self.probability = 0, ONE

    def draw(self, weights: Sequence[Fraction], *, are_positive: bool = False) -> int:
        """Index of the outcome that this run has; weights are probabilities that sum to 1; a weight of 0 is never
        drawn."""
        live: Sequence[int] = range(len(weights))
        if not are_positive:
            live = [i for i, weight in enumerate(weights) if weight > 0]
        if len(live) == 1:
            return live[0]
        if self.sampler is not None:
            return self.sampler.choices(live, [float(weights[i]) for i in live])[0]
        if self._depth >= MOST_PATH_DRAWS:
            raise self.refused(
                placed(
                    f"more than {MOST_PATH_DRAWS} draws in one step: rejection sampling, which may never end", here()
                )
                + "; start from one layout with a seed (--seed 0), or draw among what is accepted"
            )
        if self._depth == len(self._choices):
            self._choices.append(0)
            self._sizes.append(len(live))
        self._sizes[self._depth] = len(live)
        if self._choices[self._depth] >= len(live):
            raise self.refused(f"two runs with the same draws drew differently{here() and f' ({here()})'}")
        index = live[self._choices[self._depth]]
        self._depth += 1
        self.probability *= weights[index]
        return index


def here() -> str:
    """The line of the environment's code that is running."""
    return line_of_code(sys._getframe(1))


@functools.cache
def _evenly(count: int) -> tuple[Fraction, ...]:
    return (Fraction(1, count),) * count


def _continuous(branches: DrawTree, call: str, line: str = "") -> DrawError:
    where = placed(f"{call}", line or here())
    return branches.refused(
        f"drew {where}; a distribution without finitely many outcomes cannot be enumerated; draw from a list, or start "
        f"from one state with a seed (--seed 0) if only the start is drawn so"
    )


class _Unit:
    """A number drawn evenly from [0, 1), of which only a range is known: [low, high)."""

    def __init__(self, branches: DrawTree):
        self.branches = branches
        self.low, self.high = Fraction(0), ONE
        self.line = here()

    def below(self, values: tuple, scale: Fraction, offset: Fraction) -> np.ndarray:
        """Whether scale u + offset is below each value, after u was narrowed to one of the ranges between them."""
        edges, weights, ranks = _ranges(values, scale, offset, self.low, self.high)
        index = self.branches.draw(weights, are_positive=True)
        self.low, self.high = edges[index], edges[index + 1]
        return ranks > index if scale > 0 else ranks <= index


@functools.lru_cache(1024)
def _ranges(
    values: tuple, scale: Fraction, offset: Fraction, low: Fraction, high: Fraction
) -> tuple[list[Fraction], list[Fraction], np.ndarray]:
    """(edges of the ranges between values, their probabilities, how many ranges lie below each value)."""
    limits = [(_exact(value) - offset) / scale for value in values]
    edges = [low, *sorted({limit for limit in limits if low < limit < high}), high]
    weights = [(right - left) / (high - low) for left, right in itertools.pairwise(edges)]
    return edges, weights, np.array([bisect.bisect_right(edges, limit, 1) - 1 for limit in limits], int)


def _exact(value: SupportsFloat) -> Fraction:
    return value if isinstance(value, Fraction) else Fraction(float(value))


UFUNCS = {
    "less": ("__lt__", "__gt__"),
    "less_equal": ("__le__", "__ge__"),
    "greater": ("__gt__", "__lt__"),
    "greater_equal": ("__ge__", "__le__"),
    "add": ("__add__", "__radd__"),
    "subtract": ("__sub__", "__rsub__"),
    "multiply": ("__mul__", "__rmul__"),
    "divide": ("__truediv__", "__rtruediv__"),
    "negative": ("__neg__",),
    "floor": ("__floor__",),
    "ceil": ("__ceil__",),
    "trunc": ("__trunc__",),
    "rint": ("__round__",),
}
"""Functions of NumPy -> the methods of a random number, where it is the first and the second argument."""


class RandomNumber:
    """offset + scale u of a number u drawn evenly from [0, 1): comparisons and whole parts have exact probabilities.

    Whether a comparison includes the end makes no difference, as single numbers have probability 0.
    """

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, unit: _Unit, scale: Fraction = ONE, offset: Fraction = Fraction(0)):
        self._unit, self._scale, self._offset = unit, scale, offset

    def _is_below(self, values: Any) -> Any:
        """Whether the number is below a value, or each value of an array."""
        if isinstance(values, RandomNumber):
            raise self._refusal()
        if np.ndim(values) == 0:
            return bool(self._unit.below((values,), self._scale, self._offset)[0])
        array = np.asarray(values)
        if any(isinstance(value, RandomNumber) for value in array.flat if array.dtype == object):
            raise self._refusal()
        return self._unit.below(tuple(array.ravel().tolist()), self._scale, self._offset).reshape(array.shape)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: object, **_: object) -> object:
        """Answers to NumPy's functions: comparisons, whole parts, sums and products."""
        names = UFUNCS.get(ufunc.__name__) if method == "__call__" else None
        if names is None:
            raise self._refusal()
        if len(inputs) == 1:
            return getattr(self, names[0])()
        is_first = inputs[0] is self
        answer = getattr(self, names[0 if is_first else 1])(inputs[is_first])
        if answer is NotImplemented:
            raise self._refusal()
        return answer

    def __lt__(self, other: object) -> object:
        return self._is_below(other)

    __le__ = __lt__

    def __gt__(self, other: npt.ArrayLike) -> object:
        return np.logical_not(self._is_below(other)) if np.ndim(other) else not self._is_below(other)

    __ge__ = __gt__

    def __eq__(self, other: object) -> bool:
        return False

    def __ne__(self, other: object) -> bool:
        return True

    def _moved(self, scale: Any, offset: Any) -> Any:
        """scale x + offset, for numbers or an array of them."""
        if np.ndim(scale) or np.ndim(offset):
            return NotImplemented
        if isinstance(scale, RandomNumber) or isinstance(offset, RandomNumber):
            raise self._refusal()
        scale, offset = _exact(scale), _exact(offset)
        if scale == 0:
            return float(offset)
        return RandomNumber(self._unit, self._scale * scale, self._offset * scale + offset)

    def __mul__(self, other: object) -> object:
        return self._moved(other, 0)

    def __add__(self, other: object) -> object:
        return self._moved(1, other)

    __rmul__, __radd__ = __mul__, __add__

    def __sub__(self, other: Any) -> object:
        return self._moved(1, -_exact(other) if np.ndim(other) == 0 else other)

    def __rsub__(self, other: object) -> object:
        return self._moved(-1, other)

    def __neg__(self) -> object:
        return self._moved(-1, 0)

    def __truediv__(self, other: Any) -> object:
        return self._moved(1 / _exact(other) if np.ndim(other) == 0 else other, 0)

    def __floor__(self) -> int:
        ends = (self._offset, self._offset + self._scale)
        low, high = math.floor(min(ends)), math.ceil(max(ends))
        if high - low > self._unit.branches.most:
            raise self._refusal()
        below = self._is_below(np.array([Fraction(k) for k in range(low + 1, high)], object))
        return low + len(below) - int(np.count_nonzero(below))

    def __trunc__(self) -> int:
        whole = math.floor(self)
        return whole + 1 if whole < 0 else whole  # between whole and whole + 1, and never an integer

    __int__ = __trunc__

    def __ceil__(self) -> int:
        return math.floor(self) + 1

    def __round__(self, digits: int | None = None) -> int:
        if digits:
            raise self._refusal()
        return math.floor(self._moved(1, Fraction(1, 2)))

    floor, ceil, rint, trunc = __floor__, __ceil__, __round__, __trunc__  # which NumPy calls in arrays of objects

    def __bool__(self) -> bool:
        return True

    def _refusal(self) -> DrawError:
        return _continuous(
            self._unit.branches, "random(), and used the number itself and not a comparison with it", self._unit.line
        )

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise self._refusal()

    __float__ = __index__ = __complex__ = __array__ = __reduce__ = _refuse
    __pow__ = __rpow__ = __mod__ = __rmod__ = __floordiv__ = __rfloordiv__ = __rtruediv__ = __abs__ = _refuse

    def __getattr__(self, name: str) -> object:
        if name.startswith("__"):
            raise AttributeError(name)
        raise self._refusal()


def _array_of(items: Sequence[object]) -> np.ndarray:
    """An array of objects, set one by one, as NumPy would ask each for its numbers."""
    array = np.empty(len(items), object)
    for i, item in enumerate(items):
        array[i] = item
    return array


_CHOSEN = type(np.random.default_rng(0).choice(2))
"""Of a number below another one that `choice` draws: int, or a type of NumPy, by its version."""
_COUNTED = type(np.random.default_rng(0).binomial(1, 0.5))


class BranchingGenerator:
    """Stands in for the generators of NumPy: `Generator` and `RandomState`."""

    def __init__(self, branches: DrawTree):
        self._branches = branches

    def __deepcopy__(self, _: object) -> "BranchingGenerator":
        return self

    def __copy__(self) -> "BranchingGenerator":
        return self

    def _index(self, count: int, weights: Sequence[Fraction] | None = None) -> int:
        if count > self._branches.most:
            raise _continuous(self._branches, f"one of {count:,} numbers")
        if count < 1:
            raise ValueError("low >= high")
        return self._branches.draw(_evenly(count) if weights is None else weights, are_positive=weights is None)

    def _many(self, size: npt.ArrayLike, draw: Callable[[], object]) -> np.ndarray:
        shape = tuple(np.atleast_1d(np.asarray(size, int)).tolist())
        items = [draw() for _ in range(math.prod(shape))]
        if not any(isinstance(item, RandomNumber) for item in items):
            return np.array(items).reshape(shape)
        return _array_of(items).reshape(shape)

    def integers(
        self,
        low: Any,
        high: Any = None,
        size: npt.ArrayLike | None = None,
        dtype: npt.DTypeLike = np.int64,
        endpoint: bool = False,
    ) -> object:
        """An integer from low on and below high, or up to high; of one argument, from 0 on."""
        low, high = (0, low) if high is None else (low, high)
        if np.ndim(low) or np.ndim(high):
            lows, highs = np.broadcast_arrays(low, high)
            each = [self.integers(a, b, None, dtype, endpoint) for a, b in zip(lows.flat, highs.flat, strict=True)]
            return np.array(each).reshape(lows.shape)
        if size is not None:
            return self._many(size, lambda: self.integers(low, high, None, dtype, endpoint))
        drawn = int(low) + self._index(int(high) - int(low) + bool(endpoint))
        return drawn if dtype is int else np.dtype(dtype).type(drawn)

    def random(self, size: npt.ArrayLike | None = None, *_: object, **__: object) -> object:
        """A number from [0, 1)."""
        return self.uniform(size=size)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: npt.ArrayLike | None = None) -> object:
        """A number from [low, high)."""
        if np.ndim(low) or np.ndim(high):
            lows, highs = np.broadcast_arrays(low, high)
            pairs = zip(lows.flat, highs.flat, strict=True)
            return _array_of([self.uniform(low, high) for low, high in pairs]).reshape(lows.shape)
        if size is not None and size != ():
            return self._many(size, lambda: self.uniform(low, high))
        scale, offset = _exact(high) - _exact(low), _exact(low)
        return RandomNumber(_Unit(self._branches), scale, offset) if scale else float(low)

    def choice(
        self,
        a: Any,
        size: npt.ArrayLike | None = None,
        replace: bool = True,
        p: object = None,
        axis: int = 0,
        shuffle: bool = True,
    ) -> object:
        """One of several things, or an array of them; equal things are one outcome.

        Of the types that NumPy returns: environments keep what they have drawn in their states.
        """
        items: list[Any]
        items = [*map(_CHOSEN, range(int(a)))] if np.ndim(a) == 0 else [*np.moveaxis(np.asarray(a), axis, 0)]
        weights = None if p is None else _normalized(p)
        if size is None:
            return self._one_of(items, weights)
        if replace:
            return self._many(size, lambda: self._one_of(items, weights))
        if weights is not None:
            raise _continuous(self._branches, "choice() without replacement with probabilities")
        rest = list(items)
        return self._many(size, lambda: rest.pop(self._index(len(rest))))

    def _one_of(self, items: Sequence[Any], weights: Sequence[Fraction] | None) -> object:
        """One of the items; equal numbers and texts are one outcome."""
        if not len(items):
            raise ValueError("a cannot be empty unless no samples are taken")
        shares = _evenly(len(items)) if weights is None else weights
        merged: dict[Any, list] = {}
        for i, (item, share) in enumerate(zip(items, shares, strict=True)):
            name = (type(item), item) if isinstance(item, int | float | str | bool | np.generic) else i
            merged.setdefault(name, [item, Fraction(0)])[1] += share
        drawn = list(merged.values())
        return drawn[self._index(len(drawn), [share for _, share in drawn])][0]

    def shuffle(self, x: np.ndarray | MutableSequence[Any], axis: int = 0) -> None:
        """Permute a sequence in place."""
        for i in range(len(x) - 1, 0, -1):
            j = self._index(i + 1)
            if isinstance(x, np.ndarray) and x.ndim > 1:
                x[[i, j]] = x[[j, i]]
            else:
                x[i], x[j] = x[j], x[i]

    def permutation(self, x: Any, axis: int = 0) -> np.ndarray:
        """A permuted copy, or the permuted numbers below x."""
        items = np.arange(x) if np.ndim(x) == 0 else np.array(x)
        self.shuffle(items)
        return items

    permuted = permutation

    def binomial(self, n: int, p: float, size: npt.ArrayLike | None = None) -> object:
        """Number of successes in n trials."""
        if size is not None:
            return self._many(size, lambda: self.binomial(n, p))
        q = _exact(p)
        weights = [math.comb(int(n), k) * q**k * (1 - q) ** (int(n) - k) for k in range(int(n) + 1)]
        return _COUNTED(self._index(len(weights), weights))

    def multinomial(self, n: int, pvals: object, size: npt.ArrayLike | None = None) -> object:
        """Counts of each outcome in n trials."""
        if size is not None:
            return self._many(size, lambda: self.multinomial(n, pvals))
        weights = _normalized(pvals)
        draws = [self._index(len(weights), weights) for _ in range(int(n))]
        return np.bincount(draws, minlength=len(weights))

    def rand(self, *shape: int) -> object:
        """Numbers from [0, 1) in an array of this shape."""
        return self.uniform(size=shape or None)

    def random_sample(self, size: npt.ArrayLike | None = None) -> object:
        """A number from [0, 1)."""
        return self.uniform(size=size)

    def randint(
        self, low: object, high: object = None, size: npt.ArrayLike | None = None, dtype: npt.DTypeLike = int
    ) -> object:
        """An integer from low on and below high."""
        return self.integers(low, high, size, dtype)

    def seed(self, *_: object, **__: object) -> None:
        """Seeding changes nothing: every outcome is drawn."""

    def __reduce__(self) -> NoReturn:
        raise RuleError("a generator is no part of a state")

    def __getattr__(self, name: str) -> object:
        if name.startswith("__"):
            raise AttributeError(name)
        raise _continuous(self._branches, f"{name}()")


class BranchingPythonGenerator(BranchingGenerator):
    """Stands in for `random.Random`, which includes ends and returns Python's numbers."""

    def randint(self, low: Any, high: Any = None, size: object = None, dtype: object = int) -> int:
        """An integer from low to high, both included."""
        return int(low) + self._index(int(high) - int(low) + 1)

    def randrange(self, low: int, high: int | None = None, step: int = 1) -> int:
        """One of a range."""
        values = range(low) if high is None else range(low, high, step)
        return values[self._index(len(values))]

    def choice(self, a: Sequence[object], *_: object, **__: object) -> object:
        """One of a sequence."""
        return self._one_of([a[i] for i in range(len(a))], None)

    def choices(
        self, items: Iterable[object], weights: object = None, *, cum_weights: Iterable[float] | None = None, k: int = 1
    ) -> list:
        """A list of k of a sequence, with repetitions."""
        if cum_weights is not None:
            weights = np.diff([0, *cum_weights])
        shares = None if weights is None else _normalized(weights)
        return [self._one_of(list(items), shares) for _ in range(k)]

    def sample(self, items: Iterable[object], k: int, **_: object) -> list:
        """A list of k of a sequence, without repetitions."""
        rest = list(items)
        return [rest.pop(self._index(len(rest))) for _ in range(k)]

    def uniform(self, low: object = 0.0, high: object = 1.0, size: object = None) -> object:
        """A number from [low, high]."""
        return super().uniform(low, high)

    def getrandbits(self, bits: int) -> int:
        """An integer of so many bits."""
        return self._index(1 << bits)


def _normalized(weights: object) -> list[Fraction]:
    """Weights as fractions that sum to 1 exactly."""
    shares = [_exact(weight) for weight in np.asarray(weights).ravel()]
    total = sum(shares)
    if total <= 0 or min(shares) < 0:
        raise ValueError("probabilities are negative, or sum to 0")
    return [share / total for share in shares]
