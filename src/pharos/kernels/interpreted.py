"""Kernels run by Python for little work, which is done long before a kernel is compiled, with the same results.

`interpreted_first` makes a kernel count the entries that its calls read. As long as they are few, and the kernel is not
compiled, Python runs its text, and the text of the functions it calls: the same operations on the same numbers, so the
same bits. (NumPy adds 1 to 32-bit integers in 32 bits and Numba in 64. Few entries do not come that far.)
"""

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import TypeVar

import numba
import numba.extending
import numpy as np
from numba.core.registry import CPUDispatcher

from pharos.kernels.kernel_cache import is_on_disk
from pharos.system import compiling

LOADING, COMPILING = 4, 2
"""Fewer entries, by this factor, are worth loading a kernel that is compiled on disk, and more are worth compiling one:
an entry takes 0.2 to 4 us, a kernel 0.4 to 1.1 s (benchmarks/startup.py)."""

Intrinsic = TypeVar("Intrinsic", bound=Callable)

_overloads: dict[Callable, Callable] = {}  # a function without a body -> its body for the types of arguments
_intrinsics: dict[Callable, Callable] = {}  # an intrinsic -> the same in Python


def overload(function: Callable, **options: object) -> Callable:
    """Decorator of the body of an overload: `numba.extending.overload`, also for interpreted kernels."""

    def decorate(choose: Callable) -> Callable:
        _overloads[function] = choose
        return numba.extending.overload(function, **options)(choose)

    return decorate


def in_python(meaning: Callable) -> Callable:
    """Decorator of an intrinsic: `meaning` is the same function in Python."""

    def decorate(intrinsic: Intrinsic) -> Intrinsic:
        _intrinsics[intrinsic] = meaning
        return intrinsic

    return decorate


def interpreted_first(*counted: str) -> Callable:
    """Decorator of a kernel: its calls are interpreted as long as they are small together, then compiled.

    They are small until they have counted COMPILING times `compiling.SMALL_STATES` entries, or 1 / LOADING of it if the
    compiled kernel is on disk, as loading takes so much less than compiling.

    Args:
        counted: arguments whose entries count, a whole number as so many. None: all arrays. The work of a call must not
            grow faster.
    """

    def decorate(kernel: CPUDispatcher) -> CPUDispatcher:
        compiled = kernel._compile_for_args  # asked for the function to call with types that are not compiled yet
        names = kernel.py_func.__code__.co_varnames
        indices = [names.index(name) for name in counted]
        count = 0

        def compiled_or_interpreted(*arguments: object) -> object:
            nonlocal count
            read = [arguments[i] for i in indices] or [each for each in arguments if not isinstance(each, int)]
            count += sum(map(_entries, read))
            is_small = count < compiling.SMALL_STATES // LOADING or (
                count < COMPILING * compiling.SMALL_STATES and not is_on_disk(kernel)
            )
            return quiet if is_small else compiled(*arguments)

        def quiet(*arguments: object) -> object:
            with np.errstate(all="ignore"):  # hashes wrap around, and 1 / 0 is infinite
                return _as_python(interpreted(kernel)(*arguments))

        kernel._compile_for_args = compiled_or_interpreted
        return kernel

    return decorate


def _as_python(result: object) -> object:
    """The result with numbers of Python, as a compiled kernel returns them."""
    if isinstance(result, tuple):
        return tuple(map(_as_python, result))
    return result.item() if isinstance(result, np.generic) else result


def _entries(argument: object) -> int:
    """Number of entries of an argument: of an array, of the arrays of a tuple. A whole number counts as itself."""
    if isinstance(argument, tuple):
        return sum(getattr(each, "size", 0) for each in argument)
    return int(argument) if isinstance(argument, int | np.integer) else getattr(argument, "size", 0)


@cache
def interpreted(called: Callable) -> Callable:
    """The Python function of a kernel, an overload or an intrinsic."""
    if called in _intrinsics:
        return _intrinsics[called]
    return _dispatched(_overloads[called]) if called in _overloads else _in_python(called.py_func)


def _in_python(function: FunctionType) -> Callable:
    """The function with all kernels, overloads and intrinsics that it calls replaced by Python functions.

    Numbers of Numba's types are made by NumPy's, which Numba does as well, by some detours.
    """
    names = {name: function.__globals__.get(name) for name in function.__code__.co_names}
    called = {
        name: interpreted(value)
        for name, value in names.items()
        if callable(value) and (isinstance(value, CPUDispatcher) or value in _overloads or value in _intrinsics)
    }
    called |= {name: getattr(np, str(value)) for name, value in names.items() if isinstance(value, numba.types.Number)}
    text = (function.__code__, {**function.__globals__, **called}, function.__name__, function.__defaults__)
    return FunctionType(*text, function.__closure__)


def _dispatched(body_for: Callable) -> Callable:
    """A function that runs the body which an overload has for the types of its arguments."""
    bodies: dict[tuple, Callable] = {}

    def call(*arguments: object) -> object:
        types = _types(arguments)
        if types not in bodies:
            bodies[types] = _in_python(body_for(*map(numba.typeof, arguments)))
        return bodies[types](*arguments)

    return call


def _types(argument: object) -> tuple:
    """The type, data type and number of dimensions of an argument, or of each entry of a tuple."""
    if isinstance(argument, tuple):
        return tuple(map(_types, argument))
    return type(argument), getattr(argument, "dtype", None), getattr(argument, "ndim", 0)
