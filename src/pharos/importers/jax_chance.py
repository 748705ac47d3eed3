"""Functions of JAX traced with their chance on a tape: each draw of `jax.random` takes the outcome that the tape says.

While a function is traced, the functions of `jax.random` are replaced. A draw among finitely many outcomes reads its
outcome from an argument of the program, so that one compiled program runs all combinations at once. Probabilities that
the code gives as numbers are exact fractions; those that depend on the state are computed with it, in its precision.
"""

import contextlib
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial, wraps
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun

from pharos.importers.chance import DrawError, here, placed

Traced: TypeAlias = Any
"""An array of JAX or a tree of such, traced or not, or a number."""
MOST_TRACED_DRAWS = 64
"""Draws of one step."""
KEY_FUNCTIONS = ("key", "PRNGKey", "split", "fold_in", "clone", "key_data", "wrap_key_data", "key_impl")
"""Functions that draw nothing."""
BIT_DRAWS = frozenset(["random_bits", "random_gamma", "threefry2x32", "rng_bit_generator", "rng_uniform"])
"""Operations of draws that were not replaced."""


class Draw(NamedTuple):
    """A draw among finitely many outcomes.

    Attributes:
        words: its function and line, for messages. size: number of outcomes.
        weights: their probabilities; None if they depend on the state.
    """

    words: str
    size: int
    weights: tuple[Fraction, ...] | None


class TracedFunction:
    """A function (key, ...) -> arrays as a program (tape, ...) -> (arrays, probabilities of state-dependent draws).

    Args:
        what: the function's name, for messages.
        arguments: arrays, or their shapes, like those that it will get.
        most: combinations of outcomes; more are an error.
    Attributes:
        run: the program, which can be compiled and mapped.
        result: shapes and dtypes of the arrays.
        tapes: (N, D) int32, all combinations of outcomes. weights: (N,) fractions, the exact part of their probability.
    Raises:
        DrawError: a draw has no finite list of outcomes, cannot be followed, or there are too many.
    """

    def __init__(self, what: str, function: Callable[..., Any], arguments: Sequence[Any], most: int):
        tape: Tape

        def program(key: Traced, values: Traced, *rest: Traced) -> Traced:
            nonlocal tape
            tape = Tape(values)
            with _replaced(tape):
                return jax.tree.map(jnp.asarray, function(key, *rest)), tuple(tape.shares)

        with jax.disable_jit():  # what was compiled before would keep its draws
            start = jax.random.key(0), jnp.zeros(MOST_TRACED_DRAWS, jnp.int32)
            traced, shapes = jax.make_jaxpr(program, return_shape=True)(*start, *arguments)
        if BIT_DRAWS & _operations(traced.jaxpr):
            raise DrawError(f"{what} draws by other ways than the functions of jax.random, which cannot be followed")
        sizes = [draw.size for draw in tape.draws]
        if math.prod(sizes) > most:
            counts = Counter(f"{draw.words}: one of {draw.size:,}" for draw in tape.draws)
            words = ", ".join(text + f", {count} times" * (count > 1) for text, count in counts.items())
            advice = "; start from one state with a seed (--seed 0)" if what == "reset()" else ""
            raise DrawError(f"{what} has more than {most:,} outcomes ({words}){advice}")
        combinations = list(itertools.product(*map(range, sizes)))
        self.tapes = np.zeros((len(combinations), MOST_TRACED_DRAWS), np.int32)
        self.tapes[:, : len(sizes)] = np.array(combinations, np.int32).reshape(len(combinations), len(sizes))
        self.weights = [
            math.prod(
                (draw.weights[i] for draw, i in zip(tape.draws, each, strict=True) if draw.weights), start=Fraction(1)
            )
            for each in combinations
        ]
        self.result, self._flat, self._tree = shapes[0], jaxpr_as_fun(traced), jax.tree.structure(shapes)

    def run(self, tape: Traced, *arguments: Traced) -> Traced:
        """(arrays, probabilities of state-dependent draws) for one tape."""
        return jax.tree.unflatten(self._tree, self._flat(jax.random.key(0), tape, *jax.tree.leaves(arguments)))


def _operations(jaxpr: Traced) -> set[str]:
    """Names of the operations of a program, with its branches and loops."""
    names = set[str]()
    for equation in jaxpr.eqns:
        names.add(equation.primitive.name)
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda each: hasattr(each, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                names |= _operations(inner)
    return names


class Tape:
    """Draws of one call while it is traced.

    Args:
        values: (D,) traced, the outcome of each draw.
    Attributes:
        draws: so far. shares: traced probabilities of the outcomes of those whose probabilities depend on the state.
    """

    def __init__(self, values: Traced):
        self.values = values
        self.draws: list[Draw] = []
        self.shares: list[Any] = []

    def one_of(self, name: str, key: Traced, weights: Sequence[Fraction] | Any) -> Traced:
        """Traced number of the outcome of a draw with these probabilities, fractions or a traced vector."""
        words = placed(f"{name}()", here())
        if len(self.draws) == MOST_TRACED_DRAWS:
            raise DrawError(f"drew more than {MOST_TRACED_DRAWS} times in one step, at last {words}")
        if any(type(each).__name__ == "BatchTracer" for each in (key, weights)):
            raise DrawError(f"drew {words} under jax.vmap, one draw for many; draw an array with shape=")
        value = self.values[len(self.draws)]
        if (value + 0)._trace is not self.values._trace:
            raise DrawError(f"drew {words} in a loop whose length depends on the state, or a branch that is compiled")
        if isinstance(weights, jax.core.Tracer):
            self.draws.append(Draw(words, weights.shape[0], None))
            self.shares.append(weights[value])
            return value
        live = [i for i, weight in enumerate(weights) if weight > 0]
        if len(live) == 1:
            return jnp.int32(live[0])
        self.draws.append(Draw(words, len(live), tuple(weights[i] for i in live)))
        return value if len(live) == len(weights) else jnp.array(live, jnp.int32)[value]

    def many(self, shape: Traced, draw: Callable[[int], Any]) -> Traced:
        """An array of draws of this shape; `draw` gets the place of each in it."""
        shape = _shape(shape)
        if not math.prod(shape):
            return jnp.zeros(shape, jnp.int32)
        drawn = [jnp.asarray(draw(i)) for i in range(math.prod(shape))]
        return jnp.stack(drawn).reshape(shape + drawn[0].shape) if shape else drawn[0]


def _shape(shape: Traced) -> tuple[int, ...]:
    return tuple(int(n) for n in shape) if isinstance(shape, Sequence) else (int(shape),)


def _is_traced(*values: Traced) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def _refusal(name: str, why: str = "a distribution without finitely many outcomes cannot be enumerated") -> DrawError:
    return DrawError(f"drew {placed(f'{name}()', here())}; {why}")


@contextlib.contextmanager
def _replaced(tape: Tape) -> Iterator[None]:
    """Let the functions of jax.random draw from a tape, and branches be taken both, as `vmap` takes them."""
    names = ("bernoulli", "randint", "choice", "categorical", "permutation", "uniform")
    draws: dict[str, Callable[..., Any]] = {name: globals()[f"_{name}"] for name in names}
    patches: list[tuple[Any, str, Any]] = [(jax.lax, "cond", _both), (jax.lax, "switch", _all_branches)]
    for name, original in vars(jax.random).items():
        if name in KEY_FUNCTIONS:
            patches.append((jax.random, name, _concretely(original)))
        elif not name.startswith("_") and callable(original) and not isinstance(original, type):
            patches.append((jax.random, name, _drawing(name, original, draws.get(name), tape)))
    before = [(module, name, getattr(module, name)) for module, name, _ in patches]
    try:
        for module, name, function in patches:
            setattr(module, name, function)
        yield
    finally:
        for module, name, original in before:
            setattr(module, name, original)


def _concretely(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, evaluated at once if nothing is traced: a fixed key makes fixed draws."""

    @wraps(function)
    def evaluated(*arguments: Traced, **options: object) -> Traced:
        if _is_traced(arguments, options):
            return function(*arguments, **options)
        with jax.ensure_compile_time_eval():
            return function(*arguments, **options)

    return evaluated


def _drawing(
    name: str, original: Callable[..., Any], draw: Callable[..., Any] | None, tape: Tape
) -> Callable[..., Any]:
    @wraps(original)
    def drawn(key: Traced, *arguments: Traced, **options: object) -> Traced:
        if not _is_traced(key):
            return _concretely(original)(key, *arguments, **options)
        if draw is None:
            raise _refusal(name)
        return draw(tape, key, *arguments, **options)

    return drawn


# Draws ----------------------------------------------------------------------------------------------------------------


def _coin(tape: Tape, name: str, key: Traced, p: Traced) -> Traced:
    """Whether an event of probability p happens."""
    if _is_traced(p):
        p = jnp.clip(p, 0, 1)
        return tape.one_of(name, key, jnp.stack([1 - p, p])) == 1
    p = min(max(Fraction(float(p)), Fraction(0)), Fraction(1))
    return tape.one_of(name, key, (1 - p, p)) == 1


def _bernoulli(tape: Tape, key: Traced, p: Traced = 0.5, shape: Traced = None, **_: object) -> Traced:
    shape = np.shape(p) if shape is None else _shape(shape)
    flat = jnp.broadcast_to(p, shape).ravel() if _is_traced(p) else np.broadcast_to(np.asarray(p, float), shape).ravel()
    return tape.many(shape, lambda i: _coin(tape, "bernoulli", key, flat[i]))


def _evenly(count: int) -> tuple[Fraction, ...]:
    return (Fraction(1, count),) * count


def _randint(
    tape: Tape, key: Traced, shape: Traced, minval: Traced, maxval: Traced, dtype: Traced = None, **_: object
) -> Traced:
    if _is_traced(minval, maxval):
        raise _refusal("randint", "its bounds depend on the state")
    lows, highs = (np.broadcast_to(np.asarray(bound), _shape(shape)).ravel() for bound in (minval, maxval))

    def number(i: int) -> Traced:
        count = max(int(highs[i]) - int(lows[i]), 1)
        return int(lows[i]) + tape.one_of("randint", key, _evenly(count))

    return tape.many(shape, number).astype(dtype or jnp.asarray(0).dtype)


def _choice(
    tape: Tape,
    key: Traced,
    a: Traced,
    shape: Traced = (),
    replace: bool = True,
    p: Traced = None,
    axis: int = 0,
    **_: object,
) -> Traced:
    items = jnp.arange(a) if np.ndim(a) == 0 else jnp.moveaxis(jnp.asarray(a), axis, 0)
    count, shape = items.shape[0], _shape(shape)
    if replace or not shape:
        weights = _evenly(count) if p is None else _normalized(p)
        return tape.many(shape, lambda _: items[tape.one_of("choice", key, weights)])
    if p is not None:
        raise _refusal("choice", "without replacement, it has to be without p")
    return items[_arrangement(tape, "choice", key, count, math.prod(shape)).reshape(shape)]


def _permutation(tape: Tape, key: Traced, x: Traced, axis: int = 0, independent: bool = False, **_: object) -> Traced:
    items = jnp.arange(x) if np.ndim(x) == 0 else jnp.asarray(x)
    if independent and items.ndim > 1:
        raise _refusal("permutation", "of each row by itself")
    order = _arrangement(tape, "permutation", key, items.shape[axis], items.shape[axis])
    return jnp.take(items, order, axis)


def _arrangement(tape: Tape, name: str, key: Traced, count: int, length: int) -> Traced:
    """Numbers of `length` of `count` things, in any order."""
    number = math.perm(count, length)
    if number > 10_000:
        raise _refusal(name, f"it has {number:,} outcomes")
    table = np.array(list(itertools.permutations(range(count), length)), np.int32).reshape(number, length)
    return jnp.asarray(table)[tape.one_of(name, key, _evenly(number))]


def _categorical(tape: Tape, key: Traced, logits: Traced, axis: int = -1, shape: Traced = None, **_: object) -> Traced:
    rows = jnp.moveaxis(logits, axis, -1) if _is_traced(logits) else np.moveaxis(np.asarray(logits, float), axis, -1)
    outer = rows.shape[:-1]
    if shape is not None and _shape(shape) != outer and outer:
        raise _refusal("categorical", "of logits that are repeated")
    rows = rows.reshape(-1, rows.shape[-1])

    def number(i: int) -> Traced:
        row = rows[i] if outer else rows[0]
        weights = jax.nn.softmax(row) if _is_traced(row) else _normalized(np.exp(row - row.max()))
        return tape.one_of("categorical", key, weights)

    return tape.many(outer if shape is None else shape, number)


def _normalized(weights: Traced) -> Traced:
    """Probabilities: fractions that sum to 1, or a traced vector."""
    if _is_traced(weights):
        return weights / jnp.sum(weights)
    shares = [Fraction(float(weight)) for weight in np.asarray(weights).ravel()]
    return tuple(share / sum(shares) for share in shares)


class _Uniform:
    """Numbers drawn evenly from [low, high), each of which may be compared once."""

    def __init__(self, draw: Callable[[Any], Any], indices: np.ndarray, low: Traced, high: Traced, compared: set[int]):
        self._draw, self._indices, self._low, self._high, self._compared = draw, indices, low, high, compared
        self.shape = indices.shape

    def __getitem__(self, index: Traced) -> "_Uniform":
        return _Uniform(self._draw, self._indices[index], self._low, self._high, self._compared)

    def _is_below(self, limit: Traced) -> Traced:
        indices = self._indices.ravel().tolist()
        if isinstance(limit, _Uniform) or np.shape(limit) not in ((), self.shape) or self._compared & set(indices):
            raise _refusal("uniform", "its number may be compared once, with one number")
        self._compared |= set(indices)
        share = limit if (self._low, self._high) == (0, 1) else (limit - self._low) / (self._high - self._low)
        flat = [share] * len(indices) if np.ndim(share) == 0 else share.ravel()
        drawn = [self._draw(flat[i]) for i in range(len(indices))]
        return jnp.stack(drawn).reshape(self.shape) if self.shape else drawn[0]

    def __lt__(self, limit: Traced) -> Traced:
        return self._is_below(limit)

    __le__ = __lt__

    def __gt__(self, limit: Traced) -> Traced:
        return ~self._is_below(limit)

    __ge__ = __gt__

    def _refuse(self, *_: Traced, **__: Traced) -> Traced:
        raise _refusal("uniform", "it used the number itself and not a comparison with it")

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __pow__ = _refuse
    __neg__ = __float__ = __int__ = __bool__ = __array__ = __jax_array__ = __getattr__ = _refuse
    __hash__ = None  # type: ignore[assignment]


def _uniform(
    tape: Tape,
    key: Traced,
    shape: Traced = (),
    _dtype: Traced = None,
    minval: Traced = 0.0,
    maxval: Traced = 1.0,
    **_: object,
) -> Traced:
    shape = _shape(shape)
    indices = np.arange(math.prod(shape)).reshape(shape)
    return _Uniform(partial(_coin, tape, "uniform", key), indices, minval, maxval, set())


# Branches -------------------------------------------------------------------------------------------------------------


def _both(
    pred: Traced, true_fun: Callable[..., Any], false_fun: Callable[..., Any], *operands: Traced, **named: Traced
) -> Traced:
    """The result of one of two functions that are both traced: the draws of the other one change nothing."""
    operands = operands or ((named["operand"],) if "operand" in named else ())
    return _all_branches(pred, [false_fun, true_fun], *operands)


def _all_branches(index: Traced, branches: Sequence[Callable[..., Any]], *operands: Traced, **_: object) -> Traced:
    results = [branch(*operands) for branch in branches]
    number = jnp.clip(jnp.asarray(index).astype(jnp.int32), 0, len(branches) - 1)
    answer = results[0]
    for i, result in enumerate(results[1:], 1):
        answer = jax.tree.map(partial(jnp.where, number == i), result, answer)
    return answer


def refusal_behind(error: Exception) -> DrawError | None:
    """The refusal of a draw behind an error that the code under trace may have changed; None if there is none."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, DrawError):
            return cause
        cause = cause.__cause__ or cause.__context__
    return None
