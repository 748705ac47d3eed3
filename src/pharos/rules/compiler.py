"""Rules in Python -> kernels compiled by Numba, once per class of environments, cached on disk across processes.

Numba's own file cache knows a function by its file and does not see changes in the functions that it calls. So kernels
that call a user's rules (`exploration.py`, `interaction.py`) are cached under a fingerprint of the rules and of the
code around them: edited rules get another file, unchanged ones are found compiled. The parameters of an instance are
arguments, not constants: all instances of a class share one compilation.

The fingerprint: a text that changes whenever the behaviour of the rules may change. It covers a rule's bytecode and
constants, and everything that the rule reaches by name: functions, constants, arrays, enums, attributes of modules, and
methods and attributes of `self`. Compiled code and cached state spaces are filed under it, so that edited rules never
meet results of the old ones.
"""

import enum
import hashlib
import os
import re
import sys
import types
from collections import namedtuple
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.extending import overload

from pharos.environments import Environment
from pharos.kernels.kernel_cache import cache_in, called_by_kernels, called_by_python, folder_of_rules, inlined

Function = Callable[..., Any]
"""A function that Numba compiles, or has compiled."""
CompiledRules = dict[str, Function]
"""Rules by their names."""
Constructor = Callable[..., tuple[object, ...]]
"""The class of `self` in compiled rules, a named tuple."""
COMPILED_RULES = ("transition", "is_terminal", "reward", "draw")
_COLOURS = re.compile("\x1b\\[[0-9;]*m")  # Numba writes them if colorama is installed
_RULES_FOLDER = Path(__file__).parent
_KERNELS_FOLDER = _RULES_FOLDER.parent / "kernels"
_MACHINERY = (
    *(_RULES_FOLDER / name for name in ("compiler.py", "exploration.py", "interaction.py", "packed_view.py")),
    *(_KERNELS_FOLDER / name for name in ("hash_table.py", "stepping.py")),
)


def rules_of_class(cls: type[Environment]) -> tuple[str, ...]:
    """Names of the rules of a class: the rules of every class, and the optional ones that it defines."""
    optional = {
        "probability": cls.takes_outcomes(),
        "age": cls.age is not Environment.age,
        "is_available": cls.is_available is not Environment.is_available,
        "draw_motion": cls.draw_motion is not Environment.draw_motion,
    }
    return COMPILED_RULES + tuple(rule for rule, is_defined in optional.items() if is_defined)


def numeric_attributes(env: Environment) -> tuple[tuple[str, ...], tuple[object, ...]]:
    """(names, values) of the attributes of `self` in compiled rules: numbers, tuples of numbers and arrays.

    Those that the rules mention. Private ones are left out: a named tuple has no fields with an underscore.
    """
    attributes = set(dir(type(env))) | set(vars(env))
    names = sorted(attributes & mentioned_names(getattr(type(env), rule) for rule in rules_of_class(type(env))))
    values = {name: getattr(env, name) for name in names if not name.startswith("_")}
    numeric = {name: _plain(value) for name, value in values.items() if _is_numeric(value)}
    return tuple(numeric), tuple(numeric.values())


def _is_numeric(value: object) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    if isinstance(value, tuple):
        return bool(value) and all(_is_numeric(item) for item in value)
    return isinstance(value, bool | int | float | np.number)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return np.ascontiguousarray(value)
    if isinstance(value, np.number):
        return value.item()
    return value


def compiler_of(
    cls: type[Environment], names: tuple[str, ...], outcomes: int, *numbers: int
) -> tuple["Compiler", CompiledRules, Constructor]:
    """(compiler, compiled rules by their names, class of `self`) for the makers of kernels.

    With one outcome, `transition` and `reward` take none, whatever the class; with more of them, both do.
    """
    rule_compiler = _RuleCompiler()
    rules = {rule: rule_compiler.compiled(getattr(cls, rule)) for rule in rules_of_class(cls)}
    texts = {rule: (_home(cls, rule), function_text(getattr(cls, rule), {})) for rule in rules}
    key = (names, numbers, *((outcomes,) if outcomes > 1 else ()))
    compiler = Compiler(texts, key)
    if outcomes == 1 and cls.takes_outcomes():
        rules["transition"] = one_outcome(compiler.calling("transition"), rules["transition"])
    if outcomes == 1 and cls.pays_by_outcome():
        rules["reward"] = reward_of_one_outcome(compiler.calling("reward"), rules["reward"])
    if outcomes > 1 and not cls.pays_by_outcome():
        rules["reward"] = reward_of_any_outcome(compiler.calling("reward"), rules["reward"])
    return compiler, rules, namedtuple("Parameters", names)


def _home(cls: type[Environment], rule: str) -> str:
    """Name, in small letters, of the class that defines the rule: classes that inherit it share its kernels."""
    return next(base.__name__ for base in cls.__mro__ if rule in vars(base)).lower()


@cache
def _machinery() -> tuple[str, ...]:
    return tuple(path.read_text() for path in _MACHINERY)


class Compiler:
    """Compiler of the inner functions of makers, under a name that is unique to these rules.

    The name goes into the symbols of the machine code: code of several classes of environments, compiled in several
    processes, is loaded into one.

    Args:
        texts: of the rules that the functions call, each with the name of its class; the name begins with the first of
            these. key: other things they depend on.
    """

    def __init__(self, texts: dict[str, tuple[str, str]], key: tuple):
        self.texts, self.key = texts, key
        everything = (_machinery(), [text for _, text in texts.values()], *key, numba.__version__)
        label = next(iter(texts.values()))[0]
        self.name = f"{label}_{hashlib.sha256(repr(everything).encode()).hexdigest()[:20]}"

    def calling(self, *rules: str) -> "Compiler":
        """Compiler of functions that call these rules alone: when another rule is edited, they stay compiled."""
        return Compiler({rule: self.texts[rule] for rule in rules}, self.key)

    def inlined(self, function: Function) -> Function:
        """Compile a function that becomes part of its callers."""
        return inlined(self._named(function))

    def function(self, function: Function) -> Function:
        """Compile a function that kernels call."""
        return called_by_kernels(self._named(function), nogil=True)

    def kernel(self, function: Function) -> Function:
        """Compile a function that Python calls; the compiled form is kept on disk."""
        kernel = called_by_python(nogil=True)(self._named(function))
        kernel._cache = cache_in(folder_of_rules(), f"{self.name}.{function.__name__}")
        return kernel

    def _named(self, function: Function) -> Function:
        function.__qualname__ = f"{self.name}.{function.__name__}"
        return function


def one_outcome(compiler: Compiler, transition: Function) -> Function:
    """The transition of a class that takes outcomes, without the argument: outcome 0 is the only one."""

    @compiler.inlined
    def transition_of_one(self, state, action, out):
        transition(self, state, action, 0, out)

    return transition_of_one


def reward_of_one_outcome(compiler: Compiler, reward: Function) -> Function:
    """The reward of a class that pays by outcome, without the argument: outcome 0 is the only one."""

    @compiler.inlined
    def reward_of_one(self, state, action, next_state):
        return reward(self, state, action, next_state, 0)

    return reward_of_one


def reward_of_any_outcome(compiler: Compiler, reward: Function) -> Function:
    """The reward of a class that does not pay by outcome, with the argument, which it ignores."""

    @compiler.inlined
    def reward_of_any(self, state, action, next_state, outcome):
        return reward(self, state, action, next_state)

    return reward_of_any


class _RuleCompiler:
    """Compiler of a rule and, recursively, of the plain functions that it mentions by a global name."""

    def __init__(self):
        self._done: dict[object, Function] = {}

    def compiled(self, rule: Function) -> Function:
        function = plain_function(rule)
        if not isinstance(function, types.FunctionType):
            return rule  # Numba refuses or calls it
        if function in self._done:
            return self._done[function]
        self._done[function] = function  # a function that calls itself keeps its interpreted self, which Numba refuses
        # a copy of the function, whose globals and closure hold compiled functions
        mentioned = {name: function.__globals__.get(name) for name in names_in(function.__code__)}
        replaced = {**function.__globals__, **self._compiled_among(mentioned)}
        cells = {name: types.CellType(value) for name, value in self._compiled_among(closure_of(function)).items()}
        free = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        closure = tuple(cells.get(name, cell) for name, cell in free)
        clone = types.FunctionType(
            function.__code__, replaced, function.__name__, function.__defaults__, closure or None
        )
        clone.__kwdefaults__ = function.__kwdefaults__
        clone.__qualname__, clone.__module__ = function.__qualname__, __name__
        self._done[function] = inlined(clone)
        return self._done[function]

    def _compiled_among(self, values: Mapping[str, object]) -> CompiledRules:
        functions = {name: plain_function(value) for name, value in values.items()}
        return {n: self.compiled(f) for n, f in functions.items() if isinstance(f, types.FunctionType)}


@overload(float)
def _float_of_truth(value):
    """`float` of a truth, such as `float(x == y)`: the most natural reward of 0 or 1, which Numba does not know."""
    if isinstance(value, numba.types.Boolean):
        return lambda value: 1.0 if value else 0.0
    return None


def type_text(value: object) -> str:
    """The Numba type of a parameter, as text."""
    try:
        return str(numba.typeof(value))
    except Exception:  # Numba has no type for it, such as an integer of more than 64 bits
        return repr(value)


def reason_of(error: BaseException) -> str:
    """The reason and the line of a failed compilation, from Numba's long message."""
    message = _COLOURS.sub("", str(error)) or type(error).__name__
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    start = next((i for i, line in enumerate(lines) if not line.startswith(("Failed in", "During:"))), 0)
    # the first line that gives a reason, and the last place outside the makers of kernels
    what = lines[start] if lines else ""
    if what.endswith("for signature:"):  # the useful words stand below
        what += "".join(f" {line.removeprefix('>>>').strip()}" for line in lines[start + 1 : start + 2])
    ours = tuple(os.path.join("rules", file) for file in ("exploration.py", "interaction.py"))
    where = [line for line in lines if line.startswith("File ") and not any(file in line for file in ours)]
    return what + (f" ({where[-1].rstrip(':')})" if where else "")


# Fingerprints of rules ------------------------------------------------------------------------------------------------


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
    """Names of attributes and globals that these functions mention, directly or by functions that they call.

    Those are functions by a global name or from a closure, and methods of `owner`.
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
    """Names that a code object, or one nested in it, looks up."""
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
    """A text of a function and of everything that it reaches by name; equal texts mean equal behaviour."""
    function = plain_function(function)
    if not isinstance(function, types.FunctionType):
        return repr(function)
    if function in numbers:
        return f"again {numbers[function]}"
    numbers[function] = len(numbers)
    names = names_in(function.__code__)
    parts = [_code_text(function.__code__), repr(function.__defaults__), repr(function.__kwdefaults__)]
    mentioned = {name: function.__globals__[name] for name in names if name in function.__globals__}
    for name, value in sorted({**mentioned, **closure_of(function)}.items()):
        parts.append(f"{name}={value_text(value, names, numbers)}")
    return "\n".join(parts)


def value_text(value: object, names: set[str], numbers: dict[object, int]) -> str:
    """A text of a value; of a module or a class, by its attributes that are among `names`."""
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
