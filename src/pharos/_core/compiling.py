"""Rules in Python -> rules compiled by Numba, once per class of environments, cached on disk across processes.

Numba's own file cache knows a function by its file and does not see changes in what the function calls. So the kernels
that call a user's rules (`rules_template.py`) are copied to a file of their own in the cache directory, named by a
fingerprint of the rules (their bytecode, constants, and everything global that they mention), and compiled from there:
edited rules get another file, unchanged ones are found compiled. The parameters of an instance are arguments, not
constants: all instances of a class share one compilation.
"""

import dataclasses
import hashlib
import os
import sys
import types as python_types
import warnings
from collections import namedtuple
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numba
import numpy as np

from pharos import paths
from pharos.environment import Environment
from pharos.errors import RuleError

RULES = ("transition", "is_terminal", "reward", "draw")
_TEMPLATE = Path(__file__).with_name("rules_template.py")


class CompiledRules:
    """The rules of one environment instance, ready to be called from compiled code.

    Attributes:
        parameters: tuple of the numeric fields and properties of the instance, the first argument of every kernel.
        kernels: namespace of `rules_template.py`, compiled for these rules and for states of `num_words` words.
    """

    def __init__(self, env: Environment, num_words: int):
        names, values = numeric_attributes(env)
        self.parameters = values
        self.kernels = _kernels(type(env), names, num_words, env.num_actions)


@cache
def _kernels(cls: type[Environment], names: tuple[str, ...], num_words: int, num_actions: int) -> Any:
    compiler = _RuleCompiler()
    rules = {rule: compiler.compiled(getattr(cls, rule)) for rule in RULES}
    key = (*(_fingerprint(getattr(cls, rule), {}) for rule in RULES), names, num_words, num_actions, numba.__version__)
    source = _TEMPLATE.read_text()
    machinery = [Path(__file__).read_text(), Path(__file__).with_name("packed.py").read_text()]
    digest = hashlib.sha256(repr((source, machinery, key)).encode()).hexdigest()[:20]
    file = paths.cache_directory() / "compiled" / f"{cls.__name__.lower()}_{digest}.py"
    can_cache = _write_once(file, source)
    module = python_types.ModuleType(f"pharos_compiled_{digest}")
    sys.modules[module.__name__] = module  # Numba looks functions up by their module when it reads its cache
    vars(module).update(
        {
            "__file__": str(file),
            "Parameters": namedtuple("Parameters", names),
            "NUM_WORDS": num_words,
            "WORDS": (0,) * num_words,
            "NUM_ACTIONS": num_actions,
            "CACHE": can_cache,
            **rules,
        }
    )
    exec(compile(source, str(file), "exec"), vars(module))
    return module


def compiled_rules(env: Environment, num_words: int) -> CompiledRules | None:
    """The compiled rules of `env`, or None (after one warning) where Numba cannot compile them."""
    rules = CompiledRules(env, num_words)
    error = _compilation_error(type(env), env, rules)
    return None if error else rules


_known_errors: dict[type, str] = {}
_known_good: set[tuple] = set()


def _compilation_error(cls: type, env: Environment, rules: CompiledRules) -> str:
    """Try the builder's rules on one state; "" where they compile."""
    if cls in _known_errors:
        return _known_errors[cls]
    key = (cls, tuple(map(str, map(type, rules.parameters))))
    if key in _known_good:
        return ""
    try:
        numba.typeof(rules.parameters)
        rules.kernels.compile_check(rules.parameters)
        _known_good.add(key)
        return ""
    except numba.core.errors.NumbaError as error:
        _known_errors[cls] = _first_lines(str(error))
    warnings.warn(
        f"{cls.__name__}: Numba cannot compile its rules, so they run interpreted, 30 to 100 times slower. "
        f"{_known_errors[cls]}",
        RuntimeWarning,
        stacklevel=4,
    )
    return _known_errors[cls]


def _first_lines(message: str) -> str:
    """What went wrong and in which line, out of Numba's long message."""
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    what = next((line for line in lines if not line.startswith(("Failed in", "During:"))), lines[0] if lines else "")
    where = [
        line
        for line in lines
        if line.startswith("File ") and "rules_template" not in line and "pharos_compiled" not in line
    ]
    return what + (f" ({where[-1].rstrip(':')})" if where else "")


def numeric_attributes(env: Environment) -> tuple[tuple[str, ...], tuple[Any, ...]]:
    """The numeric fields and properties of an instance, by name: what compiled rules see as `self`."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(env):  # type: ignore[arg-type]
        found[field.name] = getattr(env, field.name)
    for cls in reversed(type(env).__mro__):
        for name, attribute in vars(cls).items():
            if isinstance(attribute, property | cached_property) and name not in ("components", "parameters"):
                found[name] = getattr(env, name)
            elif isinstance(attribute, int | float) and not name.startswith("_") and name not in found:
                found[name] = attribute
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


class _RuleCompiler:
    """Compiles a rule and, recursively, the plain functions that it mentions by a global name."""

    def __init__(self):
        self._done: dict[Any, Any] = {}

    def compiled(self, function: Any) -> Any:
        if function in self._done:
            return self._done[function]
        if function.__closure__:
            raise RuleError(
                f"{function.__qualname__} uses variables of an enclosing function ({', '.join(function.__code__.co_freevars)}); "
                f"rules may use parameters (self.x), module-level constants and module-level functions"
            )
        replaced = dict(function.__globals__)
        for name in _global_names(function.__code__):
            value = replaced.get(name)
            if isinstance(value, python_types.FunctionType) and value is not function:
                replaced[name] = self.compiled(value)
        clone = python_types.FunctionType(function.__code__, replaced, function.__name__, function.__defaults__)
        clone.__qualname__, clone.__module__ = function.__qualname__, __name__
        self._done[function] = numba.njit(forceinline=True)(clone)
        return self._done[function]


def _global_names(code: python_types.CodeType) -> set[str]:
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, python_types.CodeType):
            names |= _global_names(constant)
    return names


def _fingerprint(function: Any, seen: dict[Any, int]) -> str:
    """A text that changes whenever the function, or anything global that it mentions, changes."""
    if function in seen:
        return f"again {seen[function]}"
    seen[function] = len(seen)
    parts = [_code_text(function.__code__), repr(function.__defaults__)]
    for name in sorted(_global_names(function.__code__)):
        if name in function.__globals__:
            parts.append(f"{name}={_value_text(function.__globals__[name], seen)}")
    return "\n".join(parts)


def _code_text(code: python_types.CodeType) -> str:
    constants = [_code_text(c) if isinstance(c, python_types.CodeType) else repr(c) for c in code.co_consts]
    return f"{sys.version_info[:2]}{code.co_code.hex()}{constants}{code.co_names}{code.co_varnames}"


def _value_text(value: Any, seen: dict[Any, int]) -> str:
    if isinstance(value, python_types.FunctionType):
        return _fingerprint(value, seen)
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"
    if isinstance(value, python_types.ModuleType):
        return value.__name__
    return repr(value)


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


def usable_workers(workers: int | None) -> int:
    """`workers`, or the number of processors that this process may use."""
    if workers is not None:
        return max(1, int(workers))
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
