"""Rules in Python -> rules compiled by Numba, once per class of environments, cached on disk across processes.

Numba's own file cache knows a function by its file and does not see changes in what the function calls. So the kernels
that call a user's rules (`exploration_template.py`) are copied to a file of their own in the cache directory, named by a
fingerprint of the rules (`fingerprint.py`), and compiled from there: edited rules get another file, unchanged ones are found
compiled. The parameters of an instance are arguments, not constants: all instances of a class share one compilation.
"""

import hashlib
import os
import sys
import types as python_types
import warnings
from collections import namedtuple
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np

from pharos import paths
from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.rules.fingerprint import closure_of, function_text, mentioned_names, names_in, plain_function

RULES = ("transition", "is_terminal", "reward", "draw")
_HERE = Path(__file__).parent
_KERNELS = _HERE.parent / "kernels"
_TEMPLATE = _HERE / "exploration_template.py"
_MACHINERY = (Path(__file__), _HERE / "packed_view.py", _KERNELS / "hash_table.py", _KERNELS / "stepping.py")


class CompiledRules:
    """The rules of one environment instance, ready to be called from compiled code.

    Attributes:
        parameters: tuple of the numeric attributes of the instance that its rules mention, the first argument of every kernel.
        kernels: namespace of `exploration_template.py`, compiled for these rules and for states of `num_words` words.
    """

    def __init__(self, env: Environment, num_words: int):
        names, self.parameters = numeric_attributes(env)
        self.kernels = _kernels(type(env), names, num_words, env.num_actions)


def compiled_rules(
    env: Environment, num_words: int, kernels: Iterable[str] = ("explore", "rewards_of")
) -> CompiledRules | None:
    """The compiled rules of `env`; None, after one warning for each class, where Numba cannot compile one of `kernels`.

    Args:
        kernels: "explore" needs the rules transition and is_terminal, "rewards_of" the rule reward.
    """
    compiled = CompiledRules(env, num_words)
    for kernel in kernels:
        error = _compilation_error(compiled, kernel)
        if error:
            _warn_once(type(env), kernel, error)
            return None
    return compiled


class InteractionRules:
    """The rules of one environment instance, compiled for states that are rows of int64: stepping and drawing.

    Attributes:
        parameters: as in CompiledRules.
        kernels: namespace of `interaction_template.py`.
    """

    def __init__(self, env: Environment):
        names, self.parameters = numeric_attributes(env)
        self.kernels = _kernels(type(env), names, 0, env.num_actions, _HERE / "interaction_template.py")


def numeric_attributes(env: Environment) -> tuple[tuple[str, ...], tuple[Any, ...]]:
    """What compiled rules see as `self`: names and values of the numbers, tuples of numbers and arrays that they mention."""
    known = set(dir(type(env))) | set(vars(env))
    names = sorted(known & mentioned_names(getattr(type(env), rule) for rule in RULES))
    found = {name: getattr(env, name) for name in names if not name.startswith("__")}
    numeric = {name: _plain(value) for name, value in found.items() if _is_numeric(value)}
    return tuple(numeric), tuple(numeric.values())


def _is_numeric(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    if isinstance(value, tuple):
        return bool(value) and all(_is_numeric(item) for item in value)
    return isinstance(value, bool | int | float | np.number)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return np.ascontiguousarray(value)
    if isinstance(value, np.number):
        return value.item()
    return value


@cache
def _kernels(
    cls: type[Environment], names: tuple[str, ...], num_words: int, num_actions: int, template: Path = _TEMPLATE
) -> Any:
    compiler = _RuleCompiler()
    rules = {rule: compiler.compiled(getattr(cls, rule)) for rule in RULES}
    texts = [function_text(getattr(cls, rule), {}) for rule in RULES]
    source = template.read_text()
    machinery = [path.read_text() for path in _MACHINERY]
    key = (source, machinery, texts, names, num_words, num_actions, numba.__version__)
    digest = hashlib.sha256(repr(key).encode()).hexdigest()[:20]
    file = paths.cache_directory() / "compiled" / f"{cls.__name__.lower()}_{digest}.py"
    can_cache = _write_once(file, source)
    module = python_types.ModuleType(f"pharos_compiled_{digest}")
    sys.modules[module.__name__] = module  # Numba looks functions up by their module when it reads its cache
    vars(module).update(
        {
            "__file__": str(file),
            "Parameters": namedtuple("Parameters", names, module=module.__name__),
            "NUM_WORDS": num_words,
            "WORDS": (0,) * num_words,
            "NUM_ACTIONS": num_actions,
            "CACHE": can_cache,
            **rules,
        }
    )
    exec(compile(source, str(file), "exec"), vars(module))
    return module


class _RuleCompiler:
    """Compiles a rule and, recursively, the plain functions that it mentions by a global name."""

    def __init__(self):
        self._done: dict[Any, Any] = {}

    def compiled(self, function: Any) -> Any:
        function = plain_function(function)
        if not isinstance(function, python_types.FunctionType):
            return function  # Numba will say what it thinks of it
        if function in self._done:
            return self._done[function]
        self._done[function] = function  # a function that calls itself keeps its interpreted self, which Numba refuses
        reached = {name: function.__globals__.get(name) for name in names_in(function.__code__)}
        replaced = {**function.__globals__, **self._compiled_among(reached)}
        cells = {
            name: python_types.CellType(value) for name, value in self._compiled_among(closure_of(function)).items()
        }
        free = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        closure = tuple(cells.get(name, cell) for name, cell in free)
        clone = python_types.FunctionType(
            function.__code__, replaced, function.__name__, function.__defaults__, closure or None
        )
        clone.__kwdefaults__ = function.__kwdefaults__
        clone.__qualname__, clone.__module__ = function.__qualname__, __name__
        self._done[function] = numba.njit(forceinline=True)(clone)
        return self._done[function]

    def _compiled_among(self, values: dict[str, Any]) -> dict[str, Any]:
        functions = {name: plain_function(value) for name, value in values.items()}
        return {n: self.compiled(f) for n, f in functions.items() if isinstance(f, python_types.FunctionType)}


def _write_once(file: Path, source: str) -> bool:
    """Put the kernels' source where Numba keeps the compiled form beside it; False where nothing can be written."""
    try:
        if not file.exists() or file.read_text() != source:
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary = file.with_suffix(f".{os.getpid()}.tmp")
            temporary.write_text(source)
            os.replace(temporary, file)
        return os.access(file.parent, os.W_OK)
    except OSError:
        return False


# Rules that do not compile -----------------------------------------------------------------------------------------------

_known: dict[tuple, str] = {}  # (kernels, types of the parameters, kernel) -> why it does not compile; "" where it does
_warned: set[tuple[type, str]] = set()


def _compilation_error(compiled: CompiledRules, kernel: str) -> str:
    """Compile a kernel, by calling it with no work to do; "" where that works."""
    key = (compiled.kernels.__name__, tuple(map(_type_text, compiled.parameters)), kernel)
    if key in _known:
        return _known[key]
    try:
        _CALLS[kernel](compiled)
    except Exception as error:  # Numba raises its own errors, and others from inside of it
        found = _first_lines(str(error)) or type(error).__name__
    else:
        found = ""
    _known[key] = found
    return found


def _type_text(value: Any) -> str:
    try:
        return str(numba.typeof(value))
    except Exception:  # Numba has no type for it, such as an integer of more than 64 bits
        return repr(value)


def _call_explore(compiled: CompiledRules) -> None:
    table, layout = np.full(1 << 16, -1, np.int32), _empty_layout()
    rows = (np.empty((1, compiled.kernels.NUM_ACTIONS), np.int32), np.empty(1, np.uint8))
    states = np.empty((1, compiled.kernels.NUM_WORDS), np.uint64)
    compiled.kernels.explore(compiled.parameters, layout, states, *rows, table, 0, 0, 0, np.zeros(5, np.int64))


def _call_rewards_of(compiled: CompiledRules) -> None:
    states = np.empty((1, compiled.kernels.NUM_WORDS), np.uint64)
    successors = np.empty((1, compiled.kernels.NUM_ACTIONS), np.int32)
    terminal = np.empty(1, np.bool_)
    for array in (states, successors, terminal):
        array.flags.writeable = False  # as they come out of a StateSpace
    out = np.empty((0, compiled.kernels.NUM_ACTIONS))
    compiled.kernels.rewards_of(compiled.parameters, _empty_layout(), states, successors, terminal, 0, 0, out)


_CALLS = {"explore": _call_explore, "rewards_of": _call_rewards_of}


def _empty_layout() -> tuple[np.ndarray, ...]:
    return (np.zeros((1, 4), np.int64),)


def _warn_once(cls: type, kernel: str, error: str) -> None:
    if (cls, kernel) in _warned:
        return
    _warned.add((cls, kernel))
    warnings.warn(
        f"{cls.__name__}: Numba cannot compile its rules, so they run interpreted, up to 100 times slower: {error}",
        RuntimeWarning,
        stacklevel=5,
    )


def _first_lines(message: str) -> str:
    """What went wrong and in which line, out of Numba's long message."""
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    what = next((line for line in lines if not line.startswith(("Failed in", "During:"))), lines[0] if lines else "")
    where = [
        line
        for line in lines
        if line.startswith("File ") and "exploration_template" not in line and f"{os.sep}compiled{os.sep}" not in line
    ]
    return what + (f" ({where[-1].rstrip(':')})" if where else "")


def usable_workers(workers: int | None) -> int:
    """`workers`, or the number of processors that this process may use."""
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if workers < 1:
        raise ParameterError(f"workers is {workers}; expected at least 1")
    return int(workers)
