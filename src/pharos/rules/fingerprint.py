"""A text for the rules of an environment that changes whenever what they do may change.

It covers a rule's bytecode and constants, and everything that the rule reaches by name: functions, constants, arrays,
enums, attributes of modules, and methods and attributes of `self`. Compiled code and cached state spaces are filed
under it, so that edited rules never meet what was made from the old ones. Needs no Numba.
"""

import enum
import hashlib
import sys
import types
from collections.abc import Iterable

import numpy as np

_STABLE = (
    "builtins",
    "math",
    "numpy",
    "numba",
    "operator",
    "itertools",
    "functools",
    "random",
    "typing",
    "dataclasses",
)


def fingerprint_of_rules(env: object, rules: Iterable[str]) -> str:
    """SHA-256 of these rules of `env` and of the attributes of the instance that they mention."""
    numbers: dict[object, int] = {}
    functions = [getattr(type(env), rule) for rule in rules]
    parts = [function_text(function, numbers) for function in functions]
    for name in sorted(mentioned_names(functions, type(env))):
        if name in dir(type(env)) or name in vars(env):
            value = getattr(env, name)
            parts.append(f"self.{name}={value_text(getattr(value, '__func__', value), set(), numbers)}")
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def mutable_attributes(env: object, rules: Iterable[str]) -> list[str]:
    """Names of attributes of `env` that these rules mention, and whose content can be changed after they were read."""
    names = mentioned_names((getattr(type(env), rule) for rule in rules), type(env))
    return sorted(n for n in names if isinstance(getattr(env, n, None), list | dict | set | bytearray))


def mentioned_names(functions: Iterable[object], owner: type | None = None) -> set[str]:
    """Names of attributes and globals in these functions, in those that they call by a global name, and in methods of
    `owner`.
    """
    names: set[str] = set()
    closure: set[object] = set()
    pending = [plain_function(function) for function in functions]
    while pending:
        function = pending.pop()
        if not isinstance(function, types.FunctionType) or function in closure:
            continue
        closure.add(function)
        mentioned = names_in(function.__code__)
        names |= mentioned
        pending.extend(plain_function(function.__globals__.get(name)) for name in mentioned)
        pending.extend(plain_function(value) for value in closure_of(function).values())
        pending.extend(plain_function(getattr(owner, name, None)) for name in mentioned)
    return names


def plain_function(value: object) -> object:
    """The Python function behind one that Numba has compiled; anything else as it is."""
    return getattr(value, "py_func", value)


def names_in(code: types.CodeType) -> set[str]:
    """Every name that a code object, or one nested in it, looks up."""
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names |= names_in(constant)
    return names


def closure_of(function: types.FunctionType) -> dict[str, object]:
    """Name -> value of the variables that a function takes from an enclosing one."""
    variables = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            variables[name] = cell.cell_contents
        except ValueError:  # not assigned yet
            continue
    return variables


def function_text(function: object, numbers: dict[object, int]) -> str:
    """A text for a function and for everything that it reaches by name."""
    function = plain_function(function)
    if not isinstance(function, types.FunctionType):
        return repr(function)
    if function in numbers:
        return f"again {numbers[function]}"
    numbers[function] = len(numbers)
    names = names_in(function.__code__)
    parts = [_code_text(function.__code__), repr(function.__defaults__), repr(function.__kwdefaults__)]
    reached = {name: function.__globals__[name] for name in names if name in function.__globals__}
    for name, value in sorted({**reached, **closure_of(function)}.items()):
        parts.append(f"{name}={value_text(value, names, numbers)}")
    return "\n".join(parts)


def value_text(value: object, names: set[str], numbers: dict[object, int]) -> str:
    """A text for a value; of a module, for those of its attributes that are among `names`."""
    value = plain_function(value)
    home = getattr(value, "__module__", None) or ""
    if isinstance(value, types.ModuleType):
        if value.__name__.split(".")[0] in _STABLE:
            return f"{value.__name__} {getattr(value, '__version__', '')}"
        inside = (
            f"{name}={value_text(vars(value)[name], names, numbers)}" for name in sorted(names & set(vars(value)))
        )
        return f"{value.__name__}({', '.join(inside)})" if _first_time(value, numbers) else value.__name__
    if isinstance(value, types.FunctionType):
        return f"{home}.{value.__qualname__}" if home.split(".")[0] in _STABLE else function_text(value, numbers)
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"
    if isinstance(value, type) and home.split(".")[0] not in _STABLE:
        if issubclass(value, enum.Enum):
            return repr([(member.name, repr(member.value)) for member in value])
        inside = (
            f"{name}={value_text(vars(value)[name], names, numbers)}" for name in sorted(names & set(vars(value)))
        )
        return (
            f"{home}.{value.__qualname__}({', '.join(inside)})" if _first_time(value, numbers) else value.__qualname__
        )
    if isinstance(value, tuple | list):
        return f"{type(value).__name__}({', '.join(value_text(item, names, numbers) for item in value)})"
    if isinstance(value, dict):
        items = (
            f"{value_text(key, names, numbers)}: {value_text(item, names, numbers)}" for key, item in value.items()
        )
        return f"{type(value).__name__}({', '.join(items)})"
    if isinstance(value, set | frozenset):  # whose order may vary from process to process
        return f"{type(value).__name__}({', '.join(sorted(value_text(item, names, numbers) for item in value))})"
    if type(value).__repr__ is object.__repr__:  # which tells an address, another one in each process
        kind = f"{home}.{type(value).__qualname__}"
        first = _first_time(f"{kind} {id(value)}", numbers)
        return f"{kind}({value_text(getattr(value, '__dict__', {}), names, numbers)})" if first else kind
    return repr(value)


def _first_time(value: object, numbers: dict[object, int]) -> bool:
    first = value not in numbers
    numbers.setdefault(value, len(numbers))
    return first


def _code_text(code: types.CodeType) -> str:
    constants = [_constant_text(constant) for constant in code.co_consts]
    return f"{sys.version_info[:2]}{code.co_code.hex()}{constants}{code.co_names}{code.co_varnames}{code.co_freevars}"


def _constant_text(constant: object) -> str:
    if isinstance(constant, types.CodeType):
        return _code_text(constant)
    if isinstance(constant, frozenset):  # whose order may vary from process to process
        return repr(sorted(map(repr, constant)))
    return repr(constant)
